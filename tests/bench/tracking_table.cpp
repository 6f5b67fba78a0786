// SPDX-License-Identifier: Apache-2.0
// What the base of the rate, roulette and exact integration buy, per volume, as markdown tables.
// tracking_table [FILE.vdb …]: those volumes, or the procedural cloud and smoke. One thread.
//
// Rate: variance, from the formulas, of rates on the RMS over that of rates on the majorant, at
// equal look-ups. Ends: time, variance, look-ups, measured, with and without roulette and exact
// integration.
#include "estimate/plan.h"
#include "stat/test_set.h"
#include "support/fixtures.h"
#include "support/reference.h"

#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdio>
#include <string>
#include <vector>

namespace {

using namespace estimates;

/// A super-voxel on a ray's way.
struct Stretch {
    double squares;  ///< integral of the squared residual
    double length;
    double bases[2];  ///< majorant, RMS
};

struct Sum {
    double variance = 0;
    double lookups = 0;
};

Sum sumAt(const Scene& scene, const std::vector<std::vector<Stretch>>& rays, size_t base,
          double rate) {
    Sum sum;
    for (size_t i = 0; i < rays.size(); ++i) {
        double exponent = 0;
        for (const Stretch& s : rays[i]) {
            exponent += s.squares / (rate * s.bases[base]);
            sum.lookups += rate * s.bases[base] * s.length / static_cast<double>(rays.size());
        }
        sum.variance += std::exp(-2 * scene.rays[i].exactDepth[0]) * std::expm1(exponent) /
                        static_cast<double>(rays.size());
    }
    return sum;
}

std::vector<std::vector<Stretch>> stretchesOf(const Scene& scene) {
    std::vector<std::vector<Stretch>> result;
    for (const PreparedRay& ray : scene.rays) {
        std::vector<Stretch> stretches;
        scene.withFields([&](auto, const auto& field, const auto& superVoxels) {
            const LocalRay& r = ray.local;
            trk::TrackingSettings settings = scene.settings(ray);
            settings.rate = 1;
            settings.rateBase = RateBase::kRms;
            trk::forEachStretch<trk::Control::kChosen>(
                superVoxels, r, settings, [&](const auto& plan, size_t i) {
                    if (!plan.isTracked(i, 0)) {
                        return;
                    }
                    const double squares = reference::integrateCells(
                        r.origin, r.direction, plan.tEnter(i), plan.tExit(i), [&](double t) {
                            const double residual =
                                field.extinction(r.at(t))[0] - plan.control(i, 0, r.at(t));
                            return residual * residual;
                        });
                    stretches.push_back({ray.lengthPerVoxel * squares,
                                         ray.lengthPerVoxel * plan.length(i),
                                         {plan.bound(i, 0), plan.rate(i) / ray.lengthPerVoxel}});
                });
        });
        result.push_back(std::move(stretches));
    }
    return result;
}

void printRates(const Medium& medium) {
    for (const int size : {4, 8, 16}) {
        for (const char* name : {"robust", "affine robust"}) {
            const Way way = wayNamed(name);
            std::printf("| %s | %d | %s |", medium.label.c_str(), size, trk::controlName(way.kind));
            for (const double depth : {1.0, 10.0}) {
                const Scene scene(medium, size, way, depth, 300);
                const auto rays = stretchesOf(scene);
                const Sum majorant = sumAt(scene, rays, 0, 1);
                double lo = 0.01;
                double hi = 100;
                for (int i = 0; i < 60; ++i) {
                    const double middle = std::sqrt(lo * hi);
                    (sumAt(scene, rays, 1, middle).lookups < majorant.lookups ? lo : hi) = middle;
                }
                std::printf(" %.1f | %.2f |", lo,
                            sumAt(scene, rays, 1, lo).variance / majorant.variance);
            }
            std::printf("\n");
            std::fflush(stdout);
        }
    }
}

struct Ending {
    bool roulette;
    bool exactFallback;
    std::vector<double> times;
    double variance = 0;
    double lookups = 0;
};

void printEnds(const Medium& medium) {
    for (const char* name : {"ratio", "robust"}) {
        const Way way = wayNamed(name);
        for (const double depth : {1.0, 10.0, 100.0}) {
            const Scene scene(medium, 16, way, depth, 300);
            std::vector<Ending> endings{{false, false, {}}, {false, true, {}}, {true, true, {}}};
            constexpr uint64_t kRounds = 9;
            constexpr uint64_t kSamples = 60;
            const double count = static_cast<double>(kSamples * scene.rays.size());
            for (uint64_t round = 0; round < kRounds; ++round) {
                for (Ending& e : endings) {
                    trk::PathCost cost;
                    double squares = 0;
                    const auto start = std::chrono::steady_clock::now();
                    for (size_t i = 0; i < scene.rays.size(); ++i) {
                        trk::TrackingSettings settings = scene.settings(scene.rays[i]);
                        settings.roulette = e.roulette;
                        settings.exactFallback = e.exactFallback;
                        const double T = std::exp(-scene.rays[i].exactDepth[0]);
                        for (uint64_t k = 0; k < kSamples; ++k) {
                            trk::Rng rng(round, 0, i, k);
                            const double error =
                                scene.estimate(scene.rays[i], settings, rng, cost)[0] - T;
                            squares += error * error;
                        }
                    }
                    const std::chrono::duration<double> elapsed =
                        std::chrono::steady_clock::now() - start;
                    e.times.push_back(elapsed.count() / count);
                    e.variance += squares / (count * kRounds);
                    e.lookups += static_cast<double>(cost.lookups) / (count * kRounds);
                }
            }
            std::printf("| %s | %s | %g |", medium.label.c_str(), name, depth);
            const auto median = [](std::vector<double> values) {
                std::sort(values.begin(), values.end());
                return values[values.size() / 2];
            };
            for (const Ending& e : endings) {
                std::printf(" %.2f | %.2g | %.1f |", median(e.times) / median(endings[0].times),
                            e.variance, e.lookups);
            }
            std::printf("\n");
            std::fflush(stdout);
        }
    }
}

}  // namespace

int main(int argc, char** argv) {
    const std::vector<fixtures::NamedVolume> volumes = fixtures::volumesOf(argc, argv);
    std::printf(
        "| volume | size | control | rate, depth 1 | variance | rate, depth 10 | variance "
        "|\n|---|---|---|---|---|---|---|\n");
    for (const auto& [label, vdb] : volumes) {
        printRates(Medium(label, vdb));
    }
    std::printf(
        "\n| volume | method | depth | neither: time | variance | look-ups | exact: time | "
        "variance | look-ups | and roulette: time | variance | look-ups |\n"
        "|---|---|---|---|---|---|---|---|---|---|---|---|\n");
    for (const auto& [label, vdb] : volumes) {
        printEnds(Medium(label, vdb));
    }
    return 0;
}
