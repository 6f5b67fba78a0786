// SPDX-License-Identifier: Apache-2.0
// The experiments of the talk on residual ratio tracking [Novak14], run again; as markdown tables.
// talk_table [FILE.vdb …]: on those volumes, or on the procedural cloud and smoke.
//
// libtrack/docs/experiments.md says what they show. Dual scattering is `vdbtrack measure
// --scatter`.
#include "estimate/free_path.h"
#include "estimate/ratio_tracking.h"
#include "measure/recommendation.h"
#include "measure/sweep.h"
#include "stat/analytic.h"
#include "stat/test_set.h"
#include "support/fixtures.h"

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <string>
#include <utility>
#include <vector>

namespace {

using analytic::Everywhere;
using analytic::measure;
using analytic::Measured;
using analytic::Ramp;
using analytic::trackBinary;
using vdbtools::SweepRow;
using vdbtools::Way;

constexpr uint64_t kSamples = 1000000;

trk::TrackingSettings plainSettings() {
    trk::TrackingSettings settings;
    settings.exactFallback = false;
    settings.roulette = false;
    return settings;
}

/// A slab of extinction 1 and optical depth `depth`, whose super-voxel says 0 to `majorant`, with a
/// control of `control`.
struct Slab {
    Ramp medium;
    Everywhere super{};

    Slab(double depth, double majorant, double control) : medium{1, 1, depth} {
        super.item.max = static_cast<float>(majorant);
        super.item.mean = static_cast<float>(control);
    }
    Measured delta() const {
        return measure(kSamples, [&](trk::Rng& rng, trk::PathCost& cost) {
            return trackBinary(medium, super, medium.ray(), plainSettings(), rng, cost)[0];
        });
    }
    template <trk::Control kControl>
    Measured track() const {
        return measure(kSamples, [&](trk::Rng& rng, trk::PathCost& cost) {
            return trk::trackTransmittance<kControl>(medium, super, medium.ray(), plainSettings(),
                                                     rng, cost)[0];
        });
    }
};

void printMajorants() {
    std::printf(
        "## Majorants: ratio over delta tracking\n\n"
        "| depth | majorant / extinction | variance, delta | variance, ratio | look-ups, delta | "
        "look-ups, ratio | "
        "variance x look-ups, ratio over delta | formula |\n|---|---|---|---|---|---|---|---|\n");
    for (const double depth : {1.0, 4.0}) {
        for (const double kappa : {1.0, 1.25, 2.0, 4.0, 16.0}) {
            const Slab slab(depth, kappa, 0);
            const Measured delta = slab.delta();
            const Measured ratio = slab.track<trk::Control::kNone>();
            const double T = std::exp(-depth);
            const double formula = depth * T * std::expm1(depth / kappa) / ((1 - T) * (1 - T));
            std::printf("| %g | %g | %.4f | %.4f | %.2f | %.2f | %.3f | %.3f |\n", depth, kappa,
                        delta.variance, ratio.variance, delta.lookups, ratio.lookups,
                        ratio.variance * ratio.lookups / (delta.variance * delta.lookups), formula);
        }
    }
    std::printf("\n");
}

void printHomogeneous() {
    std::printf(
        "## A homogeneous medium, tight majorant\n\n"
        "| depth | method | mean | exact | variance | look-ups |\n|---|---|---|---|---|---|\n");
    for (const double depth : {1.0, 4.0}) {
        const auto print = [&](const char* name, const Measured& m) {
            std::printf("| %g | %s | %.4f | %.4f | %.3g | %.2f |\n", depth, name, m.mean,
                        std::exp(-depth), std::max(m.variance, 0.0), m.lookups);
        };
        print("delta", Slab(depth, 1, 0).delta());
        print("ratio", Slab(depth, 1, 0).track<trk::Control::kNone>());
        Slab perfect(depth, 1, 1);
        perfect.super.item.min = 1;  // nothing is left
        print("residual", perfect.track<trk::Control::kChosen>());
    }
    std::printf("\n");
}

/// The exact variance of each ray, by the formulas.
void printGlobalControl(const estimates::Medium& medium) {
    for (const auto& [name, title] :
         {std::make_pair("global ratio", "whole, none (ratio)"),
          std::make_pair("global min", "whole, min"), std::make_pair("global mean", "whole, mean"),
          std::make_pair("global max", "whole, max"),
          std::make_pair("global robust", "whole, robust"),
          std::make_pair("ratio", "size 16, none (ratio)"), std::make_pair("min", "size 16, min"),
          std::make_pair("mean", "size 16, mean"), std::make_pair("max", "size 16, max"),
          std::make_pair("robust", "size 16, robust")}) {
        const estimates::Scene scene(medium, 16, estimates::wayNamed(name), 1, 400);
        std::vector<double> variances;
        double sum = 0;
        double lookups = 0;
        for (const estimates::PreparedRay& ray : scene.rays) {
            const estimates::Moments m = estimates::momentsOf(scene, ray);
            variances.push_back(m.variance);
            sum += m.variance;
            lookups += m.lookups / static_cast<double>(scene.rays.size());
        }
        std::sort(variances.begin(), variances.end());
        double worst = 0;
        for (size_t i = variances.size() * 9 / 10; i < variances.size(); ++i) {
            worst += variances[i];
        }
        const double mean = sum / static_cast<double>(variances.size());
        std::printf("| %s | %s | %.3g | %.2f | %.3g | %.0f %% |\n", medium.label.c_str(), title,
                    mean, lookups, mean * lookups, 100 * worst / sum);
    }
    std::fflush(stdout);
}

/// Camera rays at depth 1 and 10.
vdbtools::Sweep sweepCamera(const std::string& vdb, bool coloured, std::vector<Way> ways) {
    vdbtools::SweepOptions options;
    options.depths = {1, 10};
    options.rays = {vdbtools::RayKind::kCamera};
    options.color = {{1, 0.6f, 0.3f}};
    options.grey = !coloured;
    options.coloured = coloured;
    options.ways = std::move(ways);
    return vdbtools::runSweep(fixtures::loadSource(vdb), options, [](double) {});
}

void printSuperVoxels(const std::string& label, const std::string& vdb) {
    const auto sweep = sweepCamera(
        vdb, false,
        vdbtools::sweepWays(
            {TRK_METHOD_RATIO, TRK_METHOD_RESIDUAL},
            {trk::ControlKind::kConstant, trk::ControlKind::kTrilinear, trk::ControlKind::kAffine},
            {TRK_CHOICE_ROBUST}, {4, 8, 16, 32}, {1}));
    for (const SweepRow& row : sweep.rows) {
        const SweepRow* base = vdbtools::findRow(
            sweep, row.set,
            Way{TRK_METHOD_RATIO, trk::ControlKind::kConstant, TRK_CHOICE_ROBUST, row.way.size, 1});
        std::printf("| %s | %g | %d | %s | %.3g | %.2f | %.2f | %.2f |\n", label.c_str(),
                    sweep.sets[row.set].depth, row.way.size,
                    row.way.usesControl() ? trk::controlName(row.way.kind) : "none (ratio)",
                    row.variance, row.lookups,
                    row.variance * row.lookups / (base->variance * base->lookups),
                    row.variance * row.nanoseconds / (base->variance * base->nanoseconds));
    }
    std::fflush(stdout);
}

/// RMSE at the look-ups, or the time, of one estimate by delta tracking: errors go with the square
/// root of the cost.
void printColour(const std::string& label, const std::string& vdb) {
    const auto sweep =
        sweepCamera(vdb, true,
                    vdbtools::sweepWays({TRK_METHOD_DELTA, TRK_METHOD_RATIO, TRK_METHOD_RESIDUAL},
                                        {trk::ControlKind::kConstant, trk::ControlKind::kAffine},
                                        {TRK_CHOICE_ROBUST}, {8}, {1}));
    for (const SweepRow& row : sweep.rows) {
        const SweepRow* delta = vdbtools::baseline(sweep, row.set, TRK_METHOD_DELTA);
        std::printf("| %s | %g | %s | %.4f | %.4f | %.4f | %.0f %% |\n", label.c_str(),
                    sweep.sets[row.set].depth, vdbtools::nameOf(row.way).c_str(), row.rmse,
                    row.rmse * std::sqrt(row.lookups / delta->lookups),
                    row.rmse * std::sqrt(row.nanoseconds / delta->nanoseconds), 50 * row.spread);
    }
    std::fflush(stdout);
}

}  // namespace

int main(int argc, char** argv) {
    const std::vector<fixtures::NamedVolume> volumes = fixtures::volumesOf(argc, argv);
    printMajorants();
    printHomogeneous();
    std::printf(
        "## One control for the whole volume, and one a super-voxel; mean depth 1, variance by the "
        "formulas\n\n| volume | control | variance | look-ups | variance x look-ups | of the "
        "variance, in the worst tenth of rays |\n|---|---|---|---|---|---|\n");
    for (const auto& [label, vdb] : volumes) {
        printGlobalControl(estimates::Medium(label, vdb));
    }
    std::printf(
        "\n## Super-voxels; over ratio tracking of the same size\n\n| volume | depth | size | "
        "control | variance | look-ups | variance x look-ups | variance x time "
        "|\n|---|---|---|---|---|---|---|---|\n");
    for (const auto& [label, vdb] : volumes) {
        printSuperVoxels(label, vdb);
    }
    std::printf(
        "\n## Colour 1, 0.6, 0.3, camera rays\n\n| volume | depth | way | RMSE of one estimate | "
        "RMSE at delta's look-ups | RMSE at delta's time | time ± "
        "|\n|---|---|---|---|---|---|---|\n");
    for (const auto& [label, vdb] : volumes) {
        printColour(label, vdb);
    }
    return 0;
}
