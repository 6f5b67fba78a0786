// SPDX-License-Identifier: Apache-2.0
// That free paths have the distribution they should: against the exact one by Kolmogorov-Smirnov in
// grey, by weighted bins in colour; and that wrong ones would be noticed.
#include "estimate/free_path.h"
#include "estimate/rng.h"
#include "support/fixtures.h"
#include "support/rays.h"
#include "test_set.h"
#include "volume.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <string>
#include <vector>

namespace {

using namespace estimates;

struct Sampler {
    std::string name;
    bool decompose;
    ControlKind kind;
};
const std::vector<Sampler> kSamplers{{"delta", false, ControlKind::kConstant},
                                     {"decomposition", true, ControlKind::kConstant},
                                     {"decomposition, affine bake", true, ControlKind::kAffine}};

/// A path as callers see it.
struct Path {
    bool collided;
    double t;
    std::array<double, 3> weight;
};

std::vector<Path> samplePaths(const Scene& scene, const PreparedRay& ray, bool decompose,
                              uint64_t count, uint64_t seed, trk::PathCost& cost,
                              bool wantsExtinction = true) {
    std::vector<Path> result;
    result.reserve(count);
    trk::TrackingSettings settings;
    settings.lengthPerVoxel = ray.lengthPerVoxel;
    settings.wantsExtinction = wantsExtinction;
    trk::withVariant(scene.volume, ControlKind::kConstant, [&](auto variant) {
        using V = decltype(variant);
        const typename V::Extinction field(scene.volume);
        const typename V::Walk superVoxels(scene.volume);
        for (uint64_t i = 0; i < count; ++i) {
            trk::Rng rng(seed, 0, i, 0);
            const auto path = decompose ? trk::sampleFreePath<true>(field, superVoxels, ray.local,
                                                                    settings, rng, cost)
                                        : trk::sampleFreePath<false>(field, superVoxels, ray.local,
                                                                     settings, rng, cost);
            Path p{path.collided, path.t, {}};
            std::copy(path.weight.begin(), path.weight.end(), p.weight.begin());
            result.push_back(p);
        }
    });
    return result;
}

double exactDepthTo(const Scene& scene, PreparedRay ray, double t, size_t channel) {
    ray.local.tEnd = t;
    return Scene::exactDepthOf(scene.volume, ray)[channel];
}

/// Probability that Kolmogorov's statistic, sqrt(n) x the largest distance, exceeds x.
double kolmogorovTail(double x) {
    double sum = 0;
    for (int k = 1; k < 100; ++k) {
        sum += (k % 2 ? 2 : -2) * std::exp(-2.0 * k * k * x * x);
    }
    return x < 0.2 ? 1 : std::min(1.0, sum);
}

/// The lesser of the probabilities that collisions lie as far from their exact distribution, and
/// that as many or as few escape. `truth` is the scene the paths should be of.
double probabilityOf(const Scene& truth, const PreparedRay& ray, const std::vector<Path>& paths) {
    const double all = -std::expm1(-truth.exactDepthOf(truth.volume, ray)[0]);
    std::vector<double> places;  // uniform, if all is well
    for (const Path& path : paths) {
        if (path.collided) {
            places.push_back(-std::expm1(-exactDepthTo(truth, ray, path.t, 0)) / all);
        }
    }
    std::sort(places.begin(), places.end());
    const auto n = static_cast<double>(places.size());
    double distance = 0;
    for (size_t i = 0; i < places.size(); ++i) {
        const auto k = static_cast<double>(i);
        distance = std::max({distance, places[i] - k / n, (k + 1) / n - places[i]});
    }
    const auto count = static_cast<double>(paths.size());
    const double z = (n - count * all) / std::sqrt(count * all * (1 - all) + 1e-12);
    return std::min(kolmogorovTail(distance * std::sqrt(n)),
                    std::erfc(std::fabs(z) / std::sqrt(2)));
}

/// What sampleFreePath sees of a way: its super-voxels.
Way wayFor(ControlKind kind) {
    return {"", TRK_METHOD_DELTA, TRK_CHOICE_ROBUST, kind};
}

/// Rays of a scene whose transmittance is neither 0 nor 1.
std::vector<PreparedRay> someRays(const Scene& scene, size_t count) {
    std::vector<PreparedRay> result;
    for (const PreparedRay& ray : scene.rays) {
        const double T = std::exp(-ray.exactDepth[0]);
        if (T < 0.98 && ray.exactDepth[0] < 700 && result.size() < count) {
            result.push_back(ray);
        }
    }
    return result;
}

constexpr uint64_t kPaths = fixtures::kSanitized ? 1000 : 10000;
constexpr size_t kRays = 6;

TEST(FreePath, HasTheExactDistribution) {
    const std::vector<Medium> volumes{{"cloud", fixtures::cloudFile(96)},
                                      {"smoke", fixtures::cloudFile(96, "smoke")}};
    const std::vector<std::pair<int, double>> cases{{8, 1}, {8, 10}, {32, 10}, {32, 3000}};
    const auto comparisons =
        static_cast<double>(volumes.size() * cases.size() * kSamplers.size() * kRays * 2);
    for (const Medium& medium : volumes) {
        for (const auto& [size, depth] : cases) {
            for (const Sampler& sampler : kSamplers) {
                const Scene scene(medium, size, wayFor(sampler.kind), depth, 60);
                double least = 1;
                trk::PathCost cost;
                double length = 0;
                for (const PreparedRay& ray : someRays(scene, kRays)) {
                    const uint64_t count = depth < 1000 ? kPaths : kPaths / 5;
                    const auto paths = samplePaths(scene, ray, sampler.decompose, count, 7, cost);
                    for (const Path& path : paths) {
                        ASSERT_EQ(path.weight[0], 1.0);
                        length += path.collided ? path.t : ray.local.tEnd;
                    }
                    least = std::min(least, probabilityOf(scene, ray, paths));
                }
                std::printf(
                    "size %d, depth %g, %s: least probability of %zu rays %.4f, %.0f %% "
                    "exact\n",
                    size, depth, sampler.name.c_str(), kRays, least,
                    100 * cost.exactLength / length);
                EXPECT_GT(least, 1 - std::pow(0.99, 1 / comparisons));
                EXPECT_TRUE(depth < 1000 || cost.exactLength > 0) << "the fallback was not tested";
            }
        }
    }
}

TEST(FreePath, OfAMediumTwoPercentDenserIsRejected) {
    const Medium medium("cloud", fixtures::cloudFile(96));
    const Scene truth(medium, 8, wayFor(ControlKind::kConstant), 2, 60);
    const Scene denser(medium, 8, wayFor(ControlKind::kConstant), 2 * 1.02, 60);
    for (const Sampler& sampler : kSamplers) {
        trk::PathCost cost;
        double least = 1;
        double control = 1;
        const std::vector<PreparedRay> rays = someRays(truth, 3);
        for (const PreparedRay& ray : rays) {
            const auto count = fixtures::kSanitized ? uint64_t{60000} : uint64_t{200000};
            const auto wrong = samplePaths(denser, ray, sampler.decompose, count, 8, cost);
            const auto right = samplePaths(truth, ray, sampler.decompose, count, 8, cost);
            least = std::min(least, probabilityOf(truth, ray, wrong));
            control = std::min(control, probabilityOf(truth, ray, right));
        }
        std::printf("%s: probability %.2g right, %.2g wrong\n", sampler.name.c_str(), control,
                    least);
        EXPECT_GT(control, 1e-3);
        EXPECT_LT(least, fixtures::kSanitized ? 1e-3 : 1e-6);
    }
}

/// For every channel and each of ten stretches of the ray with equal parts of the first channel's
/// collisions, and for the escape: z of the weights' sum. Answers the largest.
double largestZ(const Scene& truth, const PreparedRay& ray, const std::vector<Path>& paths,
                size_t& comparisons) {
    constexpr size_t kBins = 10;
    std::vector<double> ends;
    for (const Path& path : paths) {
        if (path.collided) {
            ends.push_back(path.t);
        }
    }
    std::sort(ends.begin(), ends.end());
    std::vector<double> cuts{0};
    for (size_t b = 1; b < kBins; ++b) {
        cuts.push_back(ends.empty() ? ray.local.tEnd : ends[ends.size() * b / kBins]);
    }
    cuts.push_back(ray.local.tEnd);
    const auto n = static_cast<double>(paths.size());
    double largest = 0;
    for (size_t c = 0; c < 3; ++c) {
        for (size_t b = 0; b <= kBins; ++b) {
            double expected = 0;
            if (b < kBins) {
                expected = std::exp(-exactDepthTo(truth, ray, cuts[b], c)) -
                           std::exp(-exactDepthTo(truth, ray, cuts[b + 1], c));
            } else {
                expected = std::exp(-exactDepthTo(truth, ray, ray.local.tEnd, c));
            }
            double sum = 0;
            double squares = 0;
            for (const Path& path : paths) {
                const bool inside = b < kBins
                                        ? path.collided && path.t >= cuts[b] && path.t < cuts[b + 1]
                                        : !path.collided;
                const double w = inside ? path.weight[c] : 0;
                sum += w;
                squares += w * w;
            }
            const double variance = squares / n - sum / n * (sum / n);
            if (squares == 0 || expected * n < 20) {  // too few for a normal sum
                continue;
            }
            ++comparisons;
            largest = std::max(largest, std::fabs(sum / n - expected) / std::sqrt(variance / n));
        }
    }
    return largest;
}

TEST(FreePath, WeightsMakeItThatOfEveryChannel) {
    struct Colour {
        Medium medium;
        std::array<float, 3> color;
    };
    const std::vector<Colour> colours{
        {{"tinted", fixtures::cloudFile(96)}, {{1, 0.25f, 2}}},
        {{"colour", fixtures::cloudFile(96, "color-cloud")}, {{1, 1, 1}}},
        {{"tinted colour", fixtures::cloudFile(96, "color-cloud")}, {{1, 0.25f, 0}}}};
    size_t comparisons = 0;
    double largest = 0;
    double falseLargest = 0;
    for (const Colour& colour : colours) {
        for (const auto& [size, depth] :
             {std::pair{8, 1.0}, std::pair{8, 10.0}, std::pair{32, 3000.0}}) {
            for (const Sampler& sampler : kSamplers) {
                const Scene scene(colour.medium, size, wayFor(sampler.kind), depth, 60,
                                  colour.color);
                trk::PathCost cost;
                double here = 0;
                double most = 0;
                for (const PreparedRay& ray : someRays(scene, kRays)) {
                    const uint64_t count = depth < 1000 ? kPaths : kPaths / 5;
                    auto paths = samplePaths(scene, ray, sampler.decompose, count, 9, cost);
                    here = std::max(here, largestZ(scene, ray, paths, comparisons));
                    for (Path& path : paths) {
                        const double sum = path.weight[0] + path.weight[1] + path.weight[2];
                        ASSERT_NEAR(sum, 3, 1e-9);
                        most = std::max({most, path.weight[0], path.weight[1], path.weight[2]});
                        ASSERT_GE(std::min({path.weight[0], path.weight[1], path.weight[2]}),
                                  -1e-9);
                        path.weight.fill(1);  // as if the paths were those of every channel
                    }
                    size_t ignored = 0;
                    falseLargest = std::max(falseLargest, largestZ(scene, ray, paths, ignored));
                }
                std::printf(
                    "size %d, depth %g, %s: largest |z| %.2f, largest weight %.3f, %.0f "
                    "voxels exact\n",
                    size, depth, sampler.name.c_str(), here, most, cost.exactLength);
                largest = std::max(largest, here);
                EXPECT_TRUE(depth < 1000 || cost.exactLength > 0) << "the fallback was not tested";
            }
        }
    }
    std::printf("largest |z| of %zu: %.2f (bound %.2f); with all weights 1: %.0f\n", comparisons,
                largest, sidakBound(comparisons), falseLargest);
    EXPECT_LT(largest, sidakBound(comparisons));
    EXPECT_GT(falseLargest, fixtures::kSanitized ? 10 : 20);
}

// Where the parameter is too coarse for the optical depth.
TEST(FreePath, WeightsHaveTheirMeanWhereExtinctionIsHuge) {
    const Medium medium("cloud", fixtures::cloudFile(96));
    for (const double depth : {1e13, 1e15, 1e17}) {
        const Scene scene(medium, 8, wayFor(ControlKind::kConstant), depth, 60, {{1, 0.6f, 0.3f}});
        trk::PathCost cost;
        std::array<double, 3> sum{};
        std::array<double, 3> squares{};
        double count = 0;
        for (const PreparedRay& ray : scene.rays) {
            for (const Path& path : samplePaths(scene, ray, true, kPaths / 10, 12, cost)) {
                ++count;
                for (size_t c = 0; c < 3; ++c) {
                    sum[c] += path.weight[c] - 1;
                    squares[c] += (path.weight[c] - 1) * (path.weight[c] - 1);
                }
            }
        }
        for (size_t c = 0; c < 3; ++c) {
            EXPECT_LT(std::fabs(sum[c]), 4.5 * std::sqrt(squares[c]) + 1e-6 * count)
                << "depth " << depth << ", channel " << c << ": mean " << 1 + sum[c] / count;
        }
    }
}

TEST(FreePath, DecompositionSavesTheLookupsOfTheControl) {
    // Where super-voxels have a minimum above 0.
    const auto grid =
        fixtures::makeGrid(openvdb::CoordBBox(0, 0, 0, 63, 63, 63), [](const openvdb::Coord& p) {
            return 1.0f + 0.5f * std::sin(0.3f * static_cast<float>(p.x() + 2 * p.y() - p.z()));
        });
    const Medium medium("waves", fixtures::write("waves.vdb", {grid}));
    const Scene scene(medium, 8, wayFor(ControlKind::kConstant), 2, 60);
    const auto lookups = [&](bool decompose, bool wantsExtinction) {
        trk::PathCost cost;
        for (const PreparedRay& ray : scene.rays) {
            samplePaths(scene, ray, decompose, 200, 10, cost, wantsExtinction);
        }
        return static_cast<double>(cost.lookups) / (200.0 * 60);
    };
    const double delta = lookups(false, true);
    std::printf("look-ups a path: delta %.2f, decomposition %.2f, without extinction %.2f\n", delta,
                lookups(true, true), lookups(true, false));
    EXPECT_LE(lookups(true, true), delta);
    EXPECT_LT(lookups(true, false), 0.8 * delta);
}

}  // namespace
