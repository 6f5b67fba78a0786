// SPDX-License-Identifier: Apache-2.0
// What each kind of control buys, as a Markdown table: residual RMS, variance and look-ups of
// residual tracking (from their formulas), time, sidecar size. Volumes: the procedural cloud and
// smoke of 256^3, or those named as arguments. Times are medians of interleaved rounds of one
// thread; compare them within one table.
#include "bake/bake.h"
#include "io/sidecar.h"
#include "stat/test_set.h"
#include "support/fixtures.h"

#include <chrono>
#include <cstdio>
#include <filesystem>
#include <memory>
#include <string>
#include <vector>

namespace {

using namespace estimates;

struct Row {
    Way way;
    int size;
    std::unique_ptr<Scene> scene;
    double variance = 0;
    double lookups = 0;
    std::vector<double> times;  // seconds a ray
};

/// Estimates every ray some times; answers seconds a ray.
double timeRays(const Row& row, uint64_t seed) {
    constexpr int kSamples = 20;
    double sum = 0;
    const auto start = std::chrono::steady_clock::now();
    trk::PathCost cost;
    for (size_t i = 0; i < row.scene->rays.size(); ++i) {
        const PreparedRay& ray = row.scene->rays[i];
        for (int k = 0; k < kSamples; ++k) {
            trk::Rng rng(seed, 0, i, static_cast<uint64_t>(k));
            sum += row.scene->estimate(ray, row.scene->settings(ray), rng, cost)[0];
        }
    }
    const std::chrono::duration<double> elapsed = std::chrono::steady_clock::now() - start;
    if (!(sum < 1e30)) {  // keeps the estimates from being optimised away
        std::fprintf(stderr, "unexpected sum %g\n", sum);
    }
    return elapsed.count() / (kSamples * static_cast<double>(row.scene->rays.size()));
}

double median(std::vector<double> values) {
    std::sort(values.begin(), values.end());
    return values[values.size() / 2];
}

void printVolume(const std::string& label, const std::string& vdb) {
    const Medium medium(label, vdb);
    std::printf("\n%s: %llu active voxels\n\n", label.c_str(),
                static_cast<unsigned long long>(medium.source.summary.activeVoxels));
    std::printf(
        "| size | control | RMS | sidecar | depth 1: variance | look-ups | time | score | depth "
        "10: "
        "variance | look-ups | time | score "
        "|\n|---|---|---|---|---|---|---|---|---|---|---|---|\n");
    for (const int size : {4, 8, 16, 32}) {
        std::vector<std::string> heads;
        std::vector<Row> rows;
        for (const ControlKind kind :
             {ControlKind::kConstant, ControlKind::kTrilinear, ControlKind::kAffine}) {
            const std::string sidecar = fixtures::path("table.track.vdb");
            fixtures::bake(vdb, sidecar, size, 4, kind);
            const trk::ControlFit fit = trk::measureFit(medium.bake(size, kind));
            char head[96];
            std::snprintf(head, sizeof(head), "| %d | %s | %.2f | %.0f kB |", size,
                          trk::controlName(kind), fit.residualRms / fit.constantRms,
                          static_cast<double>(std::filesystem::file_size(sidecar)) / 1000);
            heads.emplace_back(head);
            for (const double depth : {1.0, 10.0}) {
                const Way way{"", TRK_METHOD_RESIDUAL, TRK_CHOICE_ROBUST, kind};
                Row row{way, size, std::make_unique<Scene>(medium, size, way, depth, 300),
                        0,   0,    {}};
                for (const PreparedRay& ray : row.scene->rays) {
                    const Moments m = momentsOf(*row.scene, ray);
                    row.variance += m.variance / static_cast<double>(row.scene->rays.size());
                    row.lookups += m.lookups / static_cast<double>(row.scene->rays.size());
                }
                rows.push_back(std::move(row));
            }
        }
        constexpr uint64_t kRounds = 15;
        for (uint64_t round = 0; round < kRounds; ++round) {
            for (Row& row : rows) {
                row.times.push_back(timeRays(row, round));
            }
        }
        // Times and scores, (0.01 + variance) x time, are relative to the constant control's.
        for (size_t i = 0; i < heads.size(); ++i) {
            std::printf("%s", heads[i].c_str());
            for (size_t d = 0; d < 2; ++d) {
                const Row& row = rows[2 * i + d];
                const Row& constant = rows[d];
                const double time = median(row.times) / median(constant.times);
                const double score = (0.01 + row.variance) * time / (0.01 + constant.variance);
                std::printf(" %.4f | %.2f | %.2f | %.2f |", row.variance, row.lookups, time, score);
            }
            std::printf("\n");
        }
        std::fflush(stdout);
    }
}

}  // namespace

int main(int argc, char** argv) {
    for (const fixtures::NamedVolume& volume : fixtures::volumesOf(argc, argv)) {
        printVolume(volume.label, volume.vdb);
    }
    return 0;
}
