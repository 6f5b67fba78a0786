// SPDX-License-Identifier: Apache-2.0
// The formulas for variance and look-ups, met by the estimators on analytic media: no VDB, no
// bake. And that what is homogeneous costs no look-up and has no noise, in real volumes.
#include "analytic.h"
#include "estimate/exact.h"
#include "estimate/free_path.h"
#include "estimate/ratio_tracking.h"
#include "estimate/ray_marching.h"
#include "estimate/rng.h"
#include "query/variant.h"
#include "support/fixtures.h"
#include "support/rays.h"
#include "track/track.h"
#include "volume.h"

#include <gtest/gtest.h>

#include <array>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <functional>
#include <string>
#include <vector>

namespace {

using analytic::Everywhere;
using analytic::measure;
using analytic::Measured;
using analytic::Ramp;
using analytic::trackBinary;
using trk::LocalRay;

void expectFormula(const char* what, const Measured& found, double transmittance,
                   double relativeVariance, double lookups) {
    const double relative = found.variance / (transmittance * transmittance);
    std::printf("%-34s relative variance %.4f, formula %.4f; look-ups %.4f, formula %.4f\n", what,
                relative, relativeVariance, found.lookups, lookups);
    EXPECT_NEAR(found.mean, transmittance, 0.01 * transmittance) << what;
    EXPECT_NEAR(relative, relativeVariance, 0.05 * relativeVariance) << what;
    EXPECT_NEAR(found.lookups, lookups, 0.05 * lookups) << what;
}

constexpr uint64_t kSamples = 400000;

/// Each method on a medium whose super-voxel says min to max, against the formulas.
void expectFormulas(const std::string& name, const Ramp& medium, double min, double max,
                    double control) {
    const LocalRay ray = medium.ray();
    const double T = std::exp(-medium.depth());
    // What is baked is the mean of the extinction; as a control, any number may be.
    const double average = medium.depth() / medium.length;
    const auto recordOf = [&](double mean) {
        return Everywhere{{static_cast<float>(min), static_cast<float>(max),
                           static_cast<float>(mean),
                           static_cast<float>(std::sqrt(medium.squares(mean) / medium.length))}};
    };
    const Everywhere super = recordOf(average);
    const Everywhere controlled = recordOf(control);
    const auto asFloat = [](double value) {
        return static_cast<double>(static_cast<float>(value));
    };
    const double residualBound = asFloat(std::max(max - control, control - min));
    // A plan's rate is a quarter of the bound at least.
    const auto rmsOf = [&](double taken, double bound) {
        return std::max(asFloat(std::sqrt(medium.squares(taken) / medium.length)), bound / 4);
    };
    const double ratioRms = rmsOf(0, max);
    const double residualRms = rmsOf(control, residualBound);
    trk::TrackingSettings settings;
    settings.exactFallback = false;
    settings.roulette = false;
    for (const trk::RateBase base : {trk::RateBase::kMajorant, trk::RateBase::kRms}) {
        for (const double multiplier : {1.0, 2.0}) {
            settings.rateBase = base;
            settings.rate = multiplier;
            char label[80];
            const bool rms = base == trk::RateBase::kRms;
            std::snprintf(label, sizeof(label), "%s, %g x %s, ratio", name.c_str(), multiplier,
                          rms ? "rms" : "majorant");
            double rate = multiplier * (rms ? ratioRms : max);
            const Measured ratio = measure(kSamples, [&](trk::Rng& rng, trk::PathCost& cost) {
                return trk::trackTransmittance<trk::Control::kNone>(medium, super, ray, settings,
                                                                    rng, cost)[0];
            });
            expectFormula(label, ratio, T, std::expm1(medium.squares(0) / rate),
                          rate * medium.length);

            std::snprintf(label, sizeof(label), "%s, %g x %s, residual", name.c_str(), multiplier,
                          rms ? "rms" : "majorant");
            rate = multiplier * (rms ? residualRms : residualBound);
            const Measured residual = measure(kSamples, [&](trk::Rng& rng, trk::PathCost& cost) {
                return trk::trackTransmittance<trk::Control::kChosen>(medium, controlled, ray,
                                                                      settings, rng, cost)[0];
            });
            expectFormula(label, residual, T, std::expm1(medium.squares(control) / rate),
                          rate * medium.length);
        }
    }
    settings.rateBase = trk::RateBase::kMajorant;
    for (const double multiplier : {1.0, 2.0}) {
        settings.rate = multiplier;
        const Measured delta = measure(kSamples, [&](trk::Rng& rng, trk::PathCost& cost) {
            return trackBinary(medium, super, ray, settings, rng, cost)[0];
        });
        // Tentative collisions up to the real one: the integral of rate x T.
        const double rate = multiplier * max;
        double lookups = 0;
        constexpr int kSteps = 10000;
        for (int i = 0; i < kSteps; ++i) {
            const double t = (i + 0.5) * medium.length / kSteps;
            const double depth =
                t * medium.first + 0.5 * t * t * (medium.last - medium.first) / medium.length;
            lookups += rate * std::exp(-depth) * medium.length / kSteps;
        }
        const std::string label =
            name + ", delta x " + std::to_string(static_cast<int>(multiplier));
        expectFormula(label.c_str(), delta, T, 1 / T - 1, lookups);
        if (medium.first == medium.last) {
            EXPECT_NEAR(lookups, rate / medium.first * (1 - T), 1e-4 * lookups);
        }
    }
}

TEST(Formulas, HoldOnAHomogeneousSlab) {
    // Majorants 2 and 4 times the extinction, at optical depths of 1 and 2.
    expectFormulas("slab, kappa 2, depth 1", {0.1, 0.1, 10}, 0, 0.2, 0.06);
    expectFormulas("slab, kappa 4, depth 2", {0.2, 0.2, 10}, 0, 0.8, 0.3);
}

TEST(Formulas, HoldOnARamp) {
    expectFormulas("ramp, depth 1", {0.02, 0.18, 10}, 0.02, 0.18, 0.1);
    expectFormulas("ramp, depth 2", {0.4, 0.0, 10}, 0, 0.5, 0.2);
}

TEST(Formulas, RatioOverDeltaIsThePredictedOne) {
    // Variance x cost, homogeneous: tau T (e^(tau / kappa) - 1) / (1 - T)^2.
    struct Case {
        double kappa;
        double depth;
        double predicted;
    };
    for (const Case& c : {Case{2, 1, 0.60}, Case{4, 4, 0.13}}) {
        const Ramp medium{0.1 * c.depth, 0.1 * c.depth, 10};
        const double T = std::exp(-c.depth);
        const double formula = c.depth * T * std::expm1(c.depth / c.kappa) / ((1 - T) * (1 - T));
        EXPECT_NEAR(formula, c.predicted, 0.005);
        Everywhere super{};
        super.item.max = static_cast<float>(c.kappa * medium.first);
        trk::TrackingSettings settings;
        settings.exactFallback = false;
        settings.roulette = false;
        const Measured ratio = measure(kSamples, [&](trk::Rng& rng, trk::PathCost& cost) {
            return trk::trackTransmittance<trk::Control::kNone>(medium, super, medium.ray(),
                                                                settings, rng, cost)[0];
        });
        const Measured delta = measure(kSamples, [&](trk::Rng& rng, trk::PathCost& cost) {
            return trackBinary(medium, super, medium.ray(), settings, rng, cost)[0];
        });
        const double found = ratio.variance * ratio.lookups / (delta.variance * delta.lookups);
        std::printf(
            "kappa %g, depth %g: variance x look-ups of ratio over delta %.3f, formula "
            "%.3f\n",
            c.kappa, c.depth, found, formula);
        EXPECT_NEAR(found, formula, 0.05 * formula);
    }
}

TEST(Formulas, MarchingIsUnbiasedInOpticalDepthAndBiasedByHalfItsVariance) {
    // On 10 voxels of a ramp, steps of 4 make an optical depth that is noisy.
    const Ramp medium{0.02, 0.18, 10};
    const auto depthOf = [&](trk::Rng& rng, trk::PathCost& cost) {
        return trk::marchOpticalDepth(medium, medium.ray(), 1, 4, rng, cost)[0];
    };
    const Measured depth = measure(kSamples, depthOf);
    const Measured T = measure(kSamples, [&](trk::Rng& rng, trk::PathCost& cost) {
        return std::exp(-depthOf(rng, cost));
    });
    const double n = static_cast<double>(kSamples);
    EXPECT_NEAR(depth.mean, medium.depth(), 5 * std::sqrt(depth.variance / n));
    EXPECT_NEAR(depth.lookups, 2.5, 0.01);
    const double bias = T.mean / std::exp(-medium.depth()) - 1;
    std::printf("variance of the optical depth %.4f, relative bias of the transmittance %.4f\n",
                depth.variance, bias);
    EXPECT_GT(bias, 10 * std::sqrt(T.variance / n) / T.mean);
    EXPECT_NEAR(bias, 0.5 * depth.variance, 0.1 * bias);
}

/// A tile, and beside it voxels of another value that fill super-voxels, so that rays along x cross
/// homogeneous super-voxels of two kinds.
struct HomogeneousFiles {
    std::string vdb;
    std::string sidecar;
};
HomogeneousFiles homogeneous() {
    openvdb::initialize();
    auto grid = openvdb::FloatGrid::create();
    grid->setName("density");
    grid->tree().addTile(1, openvdb::Coord(0, 0, 0), 0.05f, true);
    grid->denseFill(openvdb::CoordBBox(8, -8, -8, 47, 47, 47), 0.03f);
    const HomogeneousFiles files{fixtures::write("homogeneous.vdb", {grid}),
                                 fixtures::path("homogeneous.track.vdb")};
    fixtures::bake(files.vdb, files.sidecar, 8);
    return files;
}

TEST(Analytic, HomogeneousSuperVoxelsTakeNoLookupAndHaveNoNoise) {
    const HomogeneousFiles files = homogeneous();
    trk::VolumeOptions options;
    options.scale = 4;
    const trk::Volume volume = trk::openVolume(files.vdb.c_str(), files.sidecar.c_str(), options);
    // From x = 16 to 40, within what is 0.03 everywhere: depth 4 x 0.03 x 24.
    const TrkRay ray{{0, 20.3f, 19.1f}, 16, {1, 0, 0}, 40};
    const auto clipped = volume.clip(ray, volume.field->box());
    ASSERT_TRUE(clipped);
    const double T = std::exp(-4 * static_cast<double>(0.03f) * 24);
    using V = trk::Variant<1, 1, trk::ControlKind::kConstant>;
    const V::Extinction field(volume);
    const V::Walk superVoxels(volume);
    trk::TrackingSettings settings;
    settings.lengthPerVoxel = clipped->lengthPerVoxel;
    double binary = 0;
    constexpr uint64_t kCount = 20000;
    for (uint64_t i = 0; i < kCount; ++i) {
        trk::Rng rng(1, 2, 3, i);
        trk::PathCost cost;
        const LocalRay& local = clipped->local;
        const double ratio = trk::trackTransmittance<trk::Control::kNone>(field, superVoxels, local,
                                                                          settings, rng, cost)[0];
        const double residual = trk::trackTransmittance<trk::Control::kChosen>(
            field, superVoxels, local, settings, rng, cost)[0];
        const double marched = std::exp(
            -trk::marchOpticalDepth(field, local, settings.lengthPerVoxel, 2.7, rng, cost)[0]);
        const double exact =
            std::exp(-trk::exactOpticalDepth(field, local, settings.lengthPerVoxel, cost)[0]);
        for (const double found : {ratio, residual, marched, exact}) {
            ASSERT_NEAR(found, T, 1e-9);
        }
        binary += trackBinary(field, superVoxels, local, settings, rng, cost)[0];
        const auto path = trk::sampleFreePath<true>(field, superVoxels, local, settings, rng, cost);
        ASSERT_TRUE(!path.collided || path.extinction[0] == 4 * static_cast<double>(0.03f));
        ASSERT_EQ(cost.lookups, 0u);
    }
    // Delta tracking answers 0 or 1 even here.
    EXPECT_NEAR(binary / kCount, T, 5 * std::sqrt(T * (1 - T) / kCount));
}

}  // namespace
