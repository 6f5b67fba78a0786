// SPDX-License-Identifier: Apache-2.0
// Combs [Kettunen21]: the series' mean, what its order's probabilities are, and estimates of
// transmittance against exact ones, on clouds, in colour and on fields that are hard on them.
#include "estimate/comb.h"

#include "analytic.h"
#include "estimate/rng.h"
#include "support/fixtures.h"
#include "support/rays.h"
#include "track/track_openvdb.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <functional>
#include <random>
#include <string>
#include <vector>

namespace {

using analytic::measure;
using analytic::Measured;
using trk::SeriesOrder;

TEST(Comb, OrdersHaveTheirProbabilities) {
    constexpr uint64_t kCount = 1000000;
    std::array<double, 9> atLeast{};
    for (uint64_t i = 0; i < kCount; ++i) {
        trk::Rng rng(1, 2, 3, i);
        const size_t order = SeriesOrder(rng).order();
        ASSERT_NE(order, 1u);
        for (size_t k = 0; k < atLeast.size(); ++k) {
            atLeast[k] += order >= k ? 1 : 0;
        }
    }
    for (size_t k = 0; k < atLeast.size(); ++k) {
        const double p = SeriesOrder::probability(k);
        const double n = static_cast<double>(kCount);
        EXPECT_NEAR(atLeast[k] / n, p, 4 * std::sqrt(p * (1 - p) / n) + 1e-15) << k;
    }
    EXPECT_LT(SeriesOrder::probability(SeriesOrder::kMost), 1e-24);
}

TEST(Comb, TheSeriesIsUnbiasedAndItsFirstTermIsNot) {
    // Optical depths that are 0.3 to 1.7, or, rarely, 3 and else 0.5.
    const std::array<std::function<double(trk::Rng&)>, 2> depths{
        [](trk::Rng& rng) { return 0.3 + 1.4 * rng.uniform(); },
        [](trk::Rng& rng) { return rng.uniform() < 0.1 ? 3.0 : 0.5; }};
    const double means[2] = {1, 0.75};
    constexpr uint64_t kCount = 2000000;
    for (size_t d = 0; d < 2; ++d) {
        const Measured found = measure(kCount, [&](trk::Rng& rng, trk::PathCost&) {
            const SeriesOrder series(rng);
            double x[SeriesOrder::kMost + 1];
            for (size_t i = 0; i <= series.order(); ++i) {
                x[i] = depths[d](rng);
            }
            return std::exp(-x[0]) * trk::seriesEstimate(x, series.order());
        });
        const Measured first = measure(
            kCount, [&](trk::Rng& rng, trk::PathCost&) { return std::exp(-depths[d](rng)); });
        const double T = std::exp(-means[d]);
        const double n = static_cast<double>(kCount);
        const double z = (found.mean - T) / std::sqrt(found.variance / n);
        std::printf("series: mean %.5f, exp(-E) %.5f, z %.2f; first term alone %.5f\n", found.mean,
                    T, z, first.mean);
        EXPECT_LT(std::fabs(z), 4);
        EXPECT_GT((first.mean - T) / std::sqrt(first.variance / n), 20);
    }
}

TEST(Comb, OfEqualDepthsItIsExactWhateverTheOrder) {
    for (size_t order = 0; order <= SeriesOrder::kMost; ++order) {
        double depths[SeriesOrder::kMost + 1];
        std::fill(std::begin(depths), std::end(depths), 3.7);
        EXPECT_EQ(trk::seriesEstimate(depths, order), 1) << order;
    }
}

TEST(Comb, IsUnbiasedOnARamp) {
    const analytic::Ramp medium{0.01, 0.03, 10};
    analytic::Everywhere super{};
    super.item = {0.01f, 0.03f, 0.02f, 0.006f};
    constexpr uint64_t kCount = 1000000;
    for (const double step : {1.0, 4.0, 25.0}) {
        const Measured found = measure(kCount, [&](trk::Rng& rng, trk::PathCost& cost) {
            return trk::combTransmittance(medium, super, medium.ray(), {}, step, rng, cost)[0];
        });
        const double T = std::exp(-medium.depth());
        const double z = (found.mean - T) / std::sqrt(found.variance / static_cast<double>(kCount));
        std::printf("ramp, step %g: z %.2f, relative variance %.3g, look-ups %.2f\n", step, z,
                    found.variance / (T * T), found.lookups);
        EXPECT_LT(std::fabs(z), 4);
        // 1.32 combs an estimate.
        EXPECT_NEAR(found.lookups, 1.3188 * std::ceil(10 / step), 0.01 * std::ceil(10 / step));
        EXPECT_LT(found.variance, 0.01 * T * T);
    }
}

/// Combs against exact transmittances.
struct Compared {
    double z = 0;
    double shift = 0;  ///< of z, were all estimates 2 % too large
    double rms = 0;    ///< of one estimate's error
    double exactShare = 0;
};

/// Over rays through a volume at a mean depth.
template <class Grid>
Compared compare(const Grid& grid, double depth, double step, uint32_t size = 16,
                 bool roulette = true, const std::array<float, 3>& color = {{1, 1, 1}}) {
    TrkVolumeOptions options = trkDefaultVolumeOptions();
    std::copy(color.begin(), color.end(), options.color);
    const track::Volume plain = track::makeVolume(grid, options);
    const size_t channels = plain.info().channels;
    const std::vector<TrkRay> rays = rays::through(rays::boundsOf(plain.info()), 300, 100, 7);
    std::vector<double> depths(rays.size() * channels);
    track::Query exact(0, 0);
    exact.method = TRK_METHOD_EXACT;
    plain.integrateOpticalDepth(exact, rays.data(), rays.size(), depths.data());
    double sum = 0;
    double hits = 0;
    for (size_t i = 0; i < depths.size(); i += channels) {
        sum += depths[i];
        hits += depths[i] > 0 ? 1 : 0;
    }
    const double scale = depth * hits / sum;
    options.scale = static_cast<float>(scale);
    track::Volume volume = track::makeVolume(grid, options);
    TrkBakeOptions bake = trkDefaultBakeOptions();
    bake.superVoxelSize = size;
    volume.bake(bake);
    const auto transmittance = [&](size_t i) {
        return std::exp(-static_cast<double>(options.scale) * depths[i]);
    };
    track::Query query(3, 0);
    query.method = TRK_METHOD_COMB;
    query.step = static_cast<float>(step);
    query.flags = roulette ? query.flags : query.flags & ~uint32_t{TRK_QUERY_ROULETTE};
    constexpr uint64_t kStreams = 400;
    constexpr auto kCount = static_cast<double>(kStreams);
    std::vector<double> errors(depths.size());
    std::vector<double> squares(depths.size());
    std::vector<float> result(depths.size());
    track::Statistics statistics(rays.size(), channels);
    Compared found;
    for (uint64_t stream = 0; stream < kStreams; ++stream) {
        query.stream = stream;
        volume.estimateTransmittance(query, rays.data(), rays.size(), result.data(),
                                     statistics.view());
        for (size_t i = 0; i < result.size(); ++i) {
            const double error = static_cast<double>(result[i]) - transmittance(i);
            errors[i] += error;
            squares[i] += error * error;
        }
    }
    double difference = 0;
    double variance = 0;
    double mean = 0;
    for (size_t i = 0; i < depths.size(); ++i) {
        difference += errors[i] / kCount;
        variance += squares[i] / (kCount * kCount);
        mean += transmittance(i);
        found.rms += squares[i] / (kCount * hits * static_cast<double>(channels));
    }
    // The rounding of results to floats repeats.
    const double rounding = 1e-7 * mean;
    const double error = std::sqrt(variance + rounding * rounding);
    found.z = difference / error;
    found.shift = 0.02 * mean / error;
    found.rms = std::sqrt(found.rms);
    for (const float share : statistics.exactShare) {
        found.exactShare += static_cast<double>(share) / hits;
    }
    return found;
}

void expectUnbiased(const std::string& name, const Compared& found, double mostRms) {
    std::printf("%-40s z %5.2f (2 %% too much: %.1f), RMS %.2g, exact share %.2f\n", name.c_str(),
                found.z, found.shift, found.rms, found.exactShare);
    EXPECT_LT(std::fabs(found.z), 4) << name;
    EXPECT_GT(found.shift, 8) << name;  // the test would see that
    EXPECT_LT(found.rms, mostRms) << name;
}

openvdb::FloatGrid::Ptr procedural(const std::string& kind) {
    openvdb::io::File file(fixtures::cloudFile(64, kind));
    file.open();
    return openvdb::gridPtrCast<openvdb::FloatGrid>(file.readGrid("density"));
}

TEST(Comb, IsUnbiasedOnCloudsAndSmoke) {
    openvdb::initialize();
    for (const char* kind : {"cloud", "smoke"}) {
        const auto grid = procedural(kind);
        for (const double depth : {1.0, 10.0, 100.0}) {
            for (const double step : {1.0, 3.0}) {
                char name[80];
                std::snprintf(name, sizeof(name), "%s, depth %g, step %g", kind, depth, step);
                expectUnbiased(name, compare(*grid, depth, step), 0.05);
            }
        }
    }
}

// Where a comb had more points or fewer by chance, dense media would make the series diverge.
TEST(Comb, HasLittleNoiseInDenseMediaOfAnyLength) {
    openvdb::initialize();
    std::mt19937 random(1);
    std::uniform_real_distribution<float> noise(0.999f, 1.001f);
    const openvdb::CoordBBox box(0, 0, 0, 63, 63, 63);
    const auto grey = fixtures::makeGrid(box, [&](const openvdb::Coord&) { return noise(random); });
    const auto colours = fixtures::makeColorGrid(box, [&](const openvdb::Coord&) {
        return openvdb::Vec3f(1, noise(random), 0.5f * noise(random));
    });
    for (const float scale : {0.05f, 5.0f, 10.0f, 1000.0f}) {
        TrkVolumeOptions options = trkDefaultVolumeOptions();
        options.scale = scale;
        for (const bool isGrey : {true, false}) {
            const track::Volume volume =
                isGrey ? track::makeVolume(*grey, options) : track::makeVolume(*colours, options);
            const size_t channels = isGrey ? 1 : 3;
            std::vector<TrkRay> rays;
            for (int i = 0; i < 3000; ++i) {
                TrkRay ray{};
                for (float& x : ray.origin) {
                    x = 20 + 0.005f * static_cast<float>(i) * noise(random);
                }
                ray.direction[i % 3] = 1;
                ray.tMax = std::min(2 / scale, 20.0f);
                rays.push_back(ray);
            }
            track::Query query(0, 0);
            query.method = TRK_METHOD_EXACT;
            std::vector<float> exact(channels * rays.size());
            std::vector<float> found(exact.size());
            volume.estimateTransmittance(query, rays.data(), rays.size(), exact.data());
            query.method = TRK_METHOD_COMB;
            volume.estimateTransmittance(query, rays.data(), rays.size(), found.data());
            for (size_t i = 0; i < found.size(); ++i) {
                ASSERT_NEAR(found[i], exact[i], i % channels == 0 && !isGrey ? 1e-6 : 0.01)
                    << "scale " << scale << ", channel " << i % channels;
            }
        }
    }
}

TEST(Comb, IsUnbiasedWithRoulette) {
    openvdb::initialize();
    const auto grid = procedural("cloud");
    for (const double depth : {10.0, 100.0}) {
        const Compared without = compare(*grid, depth, 2, 4, false);
        const Compared with = compare(*grid, depth, 2, 4, true);
        expectUnbiased("super-voxels of 4, without roulette", without, 0.05);
        expectUnbiased("super-voxels of 4, with roulette", with, 0.05);
        EXPECT_LT(with.exactShare, 0.8 * without.exactShare);  // walks end
    }
}

TEST(Comb, IsUnbiasedInColour) {
    openvdb::initialize();
    const auto grid = procedural("cloud");
    expectUnbiased("tint", compare(*grid, 4, 2, 16, true, {{1, 0.5f, 0.1f}}), 0.1);
    const auto vectors = openvdb::Vec3SGrid::create();
    vectors->setName("density");
    for (auto value = grid->cbeginValueOn(); value; ++value) {
        vectors->tree().setValue(value.getCoord(),
                                 openvdb::Vec3f(*value, 0.4f * *value, *value * *value));
    }
    expectUnbiased("three channels", compare(*vectors, 4, 2), 0.1);
}

TEST(Comb, IsUnbiasedWhereItsPointsMayErrAlike) {
    openvdb::initialize();
    const openvdb::CoordBBox box(0, 0, 0, 47, 47, 47);
    for (const std::string name : {"checkerboard", "slabs", "shells", "voxel"}) {
        const auto grid = fixtures::makeGrid(box, [&](const openvdb::Coord& p) {
            const double r = (p.asVec3d() - openvdb::Vec3d(24)).length();
            const bool isIn = name == "checkerboard" ? (p.x() + p.y() + p.z()) % 2 == 0
                              : name == "slabs"      ? p.x() / 2 % 2 == 0
                              : name == "shells"     ? std::fmod(r, 12) < 1.5 && r < 23
                                                     : p == openvdb::Coord(24);
            return isIn ? 1.0f : name == "voxel" ? 1e-6f : 0.0f;
        });
        for (const double depth : {1.0, 10.0}) {
            expectUnbiased(name + ", depth " + std::to_string(static_cast<int>(depth)),
                           compare(*grid, depth, 2), 0.2);
        }
    }
}

}  // namespace
