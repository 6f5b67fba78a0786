// SPDX-License-Identifier: Apache-2.0
// That ending walks early changes neither the mean nor, by more than is documented, the variance.
#include "estimate/rng.h"
#include "support/fixtures.h"
#include "test_set.h"

#include <gtest/gtest.h>

#include <cmath>
#include <cstdint>
#include <cstdio>
#include <string>

namespace {

using namespace estimates;

struct Sums {
    double difference = 0;  ///< of mean estimate and transmittance, summed over rays
    double variance = 0;    ///< of that
    double meanT = 0;       ///< mean transmittance
    double single = 0;      ///< mean variance of one estimate
    double lookups = 0;     ///< a sample

    double z() const { return difference / std::sqrt(variance); }
};

/// `estimate(ray, rng, cost)` of every ray of a scene whose transmittance is in [lo, hi].
template <class Estimate>
Sums sumsOf(const Scene& scene, double lo, double hi, uint64_t samples, const Estimate& estimate) {
    Sums result;
    trk::PathCost cost;
    const auto n = static_cast<double>(samples);
    double rays = 0;
    for (size_t i = 0; i < scene.rays.size(); ++i) {
        const double T = std::exp(-scene.rays[i].exactDepth[0]);
        if (T < lo || T > hi) {
            continue;
        }
        ++rays;
        double sum = 0;
        double squares = 0;
        for (uint64_t k = 0; k < samples; ++k) {
            trk::Rng rng(11, 0, i, k);
            const double value = estimate(scene.rays[i], rng, cost);
            sum += value;
            squares += (value - T) * (value - T);
        }
        const double variance = squares / n;
        result.difference += sum / n - T;
        result.variance += variance / n;
        result.meanT += T;
        result.single += variance;
    }
    result.single /= rays;
    result.meanT /= rays;
    result.lookups = static_cast<double>(cost.lookups) / (n * rays);
    return result;
}

TEST(Roulette, KeepsTheMeanSavesLookupsAndAddsLittleVariance) {
    const Medium medium("cloud", fixtures::cloudFile(96));
    const std::vector<std::string> names{"ratio", "robust", "min", "affine robust", "robust, rms"};
    const std::vector<double> depths{6, 12};
    const double bound = sidakBound(2 * names.size() * depths.size());
    double cutOffZ = 0;
    const uint64_t samples = fixtures::kSanitized ? 100 : 1000;
    for (const std::string& name : names) {
        const Way way = wayNamed(name);
        for (const double depth : depths) {
            const Scene scene(medium, 8, way, depth, 300);
            const auto estimateWith = [&](bool roulette, bool exactFallback) {
                return [&, roulette, exactFallback](const PreparedRay& ray, trk::Rng& rng,
                                                    trk::PathCost& cost) {
                    trk::TrackingSettings settings = scene.settings(ray);
                    settings.roulette = roulette;
                    settings.exactFallback = exactFallback;
                    return scene.estimate(ray, settings, rng, cost)[0];
                };
            };
            const Sums without = sumsOf(scene, 0, 1, samples, estimateWith(false, false));
            const Sums with = sumsOf(scene, 0, 1, samples, estimateWith(true, false));
            const double most = 1.03 * without.single + trk::kRouletteThreshold * without.meanT;
            std::printf(
                "%-14s depth %2g: look-ups %.2f -> %.2f, variance %.6f -> %.6f, at most "
                "%.6f\n",
                name.c_str(), depth, without.lookups, with.lookups, without.single, with.single,
                most);
            EXPECT_LT(with.lookups, 0.9 * without.lookups);
            EXPECT_LT(with.single, most);
            // Rays on which it matters whether what is ended early is made up for.
            const double lo = 1e-5;
            const double hi = 0.02 * trk::kRouletteThreshold;
            const Sums dim = sumsOf(scene, lo, hi, samples, estimateWith(true, false));
            const Sums both = sumsOf(scene, lo, hi, samples, estimateWith(true, true));
            // The wrong way to end early: what is below the threshold counts as nothing.
            const auto cutOff = [&](const PreparedRay& ray, trk::Rng& rng, trk::PathCost& cost) {
                const double value = estimateWith(false, false)(ray, rng, cost);
                return value < trk::kRouletteThreshold ? 0.0 : value;
            };
            const Sums cut = sumsOf(scene, lo, hi, samples, cutOff);
            std::printf("    dim rays: z %.2f, with exact fallback %.2f, cut off %.1f\n", dim.z(),
                        both.z(), cut.z());
            EXPECT_LT(std::fabs(dim.z()), bound);
            EXPECT_LT(std::fabs(both.z()), bound);
            cutOffZ += cut.z() / std::sqrt(static_cast<double>(names.size() * depths.size()));
        }
    }
    // Ratio tracking's dim rays are too noisy for one set to tell; all together do.
    std::printf("cut off, all together: z %.1f\n", cutOffZ);
    EXPECT_LT(cutOffZ, -10);
}

}  // namespace
