// SPDX-License-Identifier: Apache-2.0
// The small pieces of arithmetic: scaled products, halfs, random numbers, the robust control, maps.
#include "control/control_choice.h"
#include "control/super_voxels.h"
#include "estimate/plan.h"
#include "estimate/rng.h"
#include "estimate/scaled_product.h"
#include "field/density_field.h"
#include "field/table_builder.h"
#include "query/variant.h"
#include "space/geometry.h"

#include <gtest/gtest.h>

#include <cmath>
#include <limits>
#include <memory>

namespace {

TEST(ScaledProduct, SurvivesWeightsAndDepthsThatCancel) {
    trk::ScaledProduct product;
    for (int i = 0; i < 10000; ++i) {
        product.multiply(2);
    }
    EXPECT_NEAR(product.timesExp(10000 * std::log(2.0)), 1, 1e-9);
    for (int i = 0; i < 20000; ++i) {
        product.multiply(0.5);
    }
    EXPECT_NEAR(product.timesExp(-10000 * std::log(2.0)), 1, 1e-9);
}

TEST(ScaledProduct, SaturatesInsteadOfOverflowing) {
    trk::ScaledProduct product;
    for (int i = 0; i < 100000; ++i) {
        product.multiply(-1.999);
    }
    const double limit = static_cast<double>(std::numeric_limits<float>::max());
    EXPECT_EQ(product.timesExp(0), limit);
    product.multiply(-1);
    EXPECT_EQ(product.timesExp(-1e300), -limit);
    EXPECT_EQ(product.timesExp(std::numeric_limits<double>::infinity()), 0);
    product.multiply(0);
    EXPECT_TRUE(product.isZero());
    EXPECT_EQ(product.timesExp(-1e300), 0);
}

TEST(Half, RoundTripsEveryFiniteValue) {
    for (uint32_t bits = 0; bits < 0x7c00; ++bits) {
        const float value = trk::decodeHalf(static_cast<uint16_t>(bits));
        ASSERT_TRUE(trk::isExactHalf(value)) << bits;
        ASSERT_EQ(trk::encodeHalf(value), bits);
        // Halfway to the next one is no half.
        if (bits > 0) {
            const float between = 0.5f * (value + trk::decodeHalf(static_cast<uint16_t>(bits - 1)));
            ASSERT_FALSE(trk::isExactHalf(between)) << bits;
        }
    }
    EXPECT_EQ(trk::decodeHalf(0x3c00), 1.0f);
    EXPECT_EQ(trk::decodeHalf(0x7bff), 65504.0f);
    EXPECT_FALSE(trk::isExactHalf(65536.0f));
    EXPECT_FALSE(trk::isExactHalf(1e-40f));
}

TEST(Rng, ExponentialHasMeanAndVarianceOne) {
    trk::Rng rng(1, 2, 3, 4);
    constexpr int kCount = 1000000;
    double sum = 0;
    double squares = 0;
    for (int i = 0; i < kCount; ++i) {
        const double x = rng.exponential();
        ASSERT_GT(x, 0);
        ASSERT_LT(x, 46);
        sum += x;
        squares += x * x;
    }
    const double n = kCount;
    EXPECT_NEAR(sum / n, 1, 5 / std::sqrt(n));                        // its variance is 1
    EXPECT_NEAR(squares / n, 2, 5 * std::sqrt(20.0) / std::sqrt(n));  // E[x^4] - 4 = 20
}

/// P(X < x), counted: how many of the 2^64 words the map, which grows, sends below x.
double countedBelow(double x, double (*map)(uint64_t)) {
    uint64_t lo = 0;  // words below it go below x
    uint64_t hi = ~uint64_t{0};
    while (lo < hi) {
        const uint64_t middle = lo + (hi - lo) / 2;
        if (map(middle) < x) {
            lo = middle + 1;
        } else {
            hi = middle;
        }
    }
    return static_cast<double>(lo) * 0x1p-64;
}

TEST(Rng, ExponentialHasTheRightProbabilityAtEveryScale) {
    for (double x = 1e-18; x < 40; x *= 1.7) {
        const double found = countedBelow(x, trk::Rng::exponentialOf);
        const double below = -std::expm1(-x);
        EXPECT_NEAR(found, below, 4e-5 * below + 0x1p-64) << x;
        const double above = std::exp(-x);
        if (x > 1 && x < 30) {
            EXPECT_NEAR(1 - found, above, 4e-5 * above + 0x1p-53) << x;
        }
    }
    EXPECT_EQ(trk::Rng::exponentialOf(0), 0x1p-65);
    EXPECT_GT(trk::Rng::exponentialOf(~uint64_t{0}), 44);
    // What the test is for: a number made of a float next to 1.
    const auto rounded = [](uint64_t bits) {
        const auto u = (static_cast<float>(~bits >> 32) + 0.5f) * 0x1p-32f;
        return static_cast<double>(-std::log(u));
    };
    EXPECT_GT(countedBelow(1e-8, rounded), 2.5e-8);
}

TEST(Rng, ExponentialNeverFallsWhereItsTwoHalvesMeet) {
    for (const uint64_t seam : {uint64_t{1} << 54, ~uint64_t{0} - (uint64_t{1} << 54)}) {
        double last = 0;
        for (uint64_t bits = seam - 20000; bits < seam + 20000; ++bits) {
            const double x = trk::Rng::exponentialOf(bits);
            ASSERT_GE(x, last * (1 - 1e-7));  // a float's rounding
            last = x;
        }
    }
}

TEST(Rng, EveryPartOfItsNameMatters) {
    const uint64_t base = trk::Rng(1, 1, 1, 1).next();
    EXPECT_EQ(trk::Rng(1, 1, 1, 1).next(), base);
    EXPECT_NE(trk::Rng(2, 1, 1, 1).next(), base);
    EXPECT_NE(trk::Rng(1, 2, 1, 1).next(), base);
    EXPECT_NE(trk::Rng(1, 1, 2, 1).next(), base);
    EXPECT_NE(trk::Rng(1, 1, 1, 2).next(), base);
}

double robust(double min, double mean, double max, double diagonal) {
    double control = 0;
    trk::ControlChoice{TRK_CHOICE_ROBUST, diagonal}.takeConstant(min, mean, max, control);
    return control;
}

TEST(RobustControl, MatchesTheKnownFactors) {
    // FACTS of the formula: (2^(1/(D S)) - 1) is 0.41 at D S = 2, 0.19 at 4, 0.07 at 10.
    EXPECT_NEAR(robust(0, 1, 1, 2), 0.4142, 1e-4);
    EXPECT_NEAR(robust(0, 1, 1, 4), 0.1892, 1e-4);
    EXPECT_NEAR(robust(0, 1, 1, 10), 0.0718, 1e-4);
    EXPECT_EQ(robust(0, 0.5, 1, 0.5), 0.5);  // thin: the mean
}

TEST(RobustControl, IsFiniteAndBetweenMinAndMeanAtTheExtremes) {
    for (const double range : {0.0, 1e-45, 1e-30, 1e-4, 1.0, 1e30, 3e38}) {
        for (const double diagonal : {1e-12, 1e-3, 1.0, 1e12}) {
            const double min = 0.25 * range;
            const double mean = 0.5 * range;
            const double control = robust(min, mean, range, diagonal);
            EXPECT_GE(control, min);
            EXPECT_LE(control, mean);
        }
    }
    EXPECT_EQ(robust(2, 2, 2, 1), 2);  // 0 x infinity in the formula as printed
}

TEST(SuperVoxels, BoundsCoverTheResidualOfEveryChoice) {
    for (const TrkChoice choice :
         {TRK_CHOICE_ROBUST, TRK_CHOICE_MEAN, TRK_CHOICE_MIN, TRK_CHOICE_MAX}) {
        trk::BakedVolume baked;
        baked.table = trk::TableBuilder(4, {{{0, 0, 0}}, {{16, 16, 16}}})
                          .fill(
                              {}, [](const trk::Int3&, int) { return std::nullopt; },
                              [](const trk::Int3&) { return 1u; });
        baked.items.push_back({0.1f, 0.7f, 0.3f, 0.2f, 0.4f, 0.2f});
        const float scale = 3.3f;
        trk::Volume opened;
        opened.scales = {static_cast<double>(scale)};
        opened.superVoxels = std::make_shared<const trk::SuperVoxels>(std::move(baked));
        opened.controlChoice = {choice, 0.05};
        trk::LocalRay ray;
        ray.direction[0] = 1;
        ray.inverse = {{1, 1e300, 1e300}};
        ray.tEnd = 16;
        int met = 0;
        trk::forEachStretch<trk::Control::kChosen>(
            trk::Variant<1, 1, trk::ControlKind::kConstant>::Walk(opened), ray, {},
            [&](const auto& plan, size_t i) {
                ++met;
                for (const float density : {0.1f, 0.3f, 0.7f}) {
                    const double residual =
                        static_cast<double>(scale) * static_cast<double>(density) -
                        plan.control(i, 0, {});
                    EXPECT_LE(std::fabs(residual), plan.bound(i, 0));
                }
            });
        EXPECT_EQ(met, 1);
    }
}

// Coefficients of a trilinear control may be four times as large as its values.
TEST(SuperVoxels, ControlsOfTheLargestDensitiesAreFinite) {
    constexpr float kLarge = 3e38f;
    trk::BakedVolume baked;
    baked.kind = trk::ControlKind::kTrilinear;
    baked.table = trk::TableBuilder(4, {{{0, 0, 0}}, {{16, 16, 16}}})
                      .fill(
                          {}, [](const trk::Int3&, int) { return std::nullopt; },
                          [](const trk::Int3&) { return 1u | trk::SparseTable::kSingleFlag; });
    baked.items.push_back({0, kLarge, kLarge / 2, kLarge / 2, kLarge, kLarge / 2});
    for (int corner = 0; corner < 8; ++corner) {
        baked.shapes.push_back((corner >> 2 ^ corner >> 1 ^ corner) & 1 ? kLarge : 0);
    }
    trk::Volume volume;
    volume.scales = {0.1};
    volume.superVoxels = std::make_shared<const trk::SuperVoxels>(std::move(baked));
    volume.controlChoice = {TRK_CHOICE_MEAN, 1};
    trk::LocalRay ray;
    ray.origin = {{0, 0.5, 0.5}};
    ray.direction[0] = 1;
    ray.inverse = {{1, 1e300, 1e300}};
    ray.tEnd = 16;
    int met = 0;
    trk::forEachStretch<trk::Control::kChosen>(
        trk::Variant<1, 1, trk::ControlKind::kTrilinear>::Walk(volume), ray, {},
        [&](const auto& plan, size_t i) {
            ++met;
            for (int corner = 0; corner < 8; ++corner) {
                const double control = plan.control(
                    i, 0, {{corner & 4 ? 16.0 : 0, corner & 2 ? 16.0 : 0, corner & 1 ? 16.0 : 0}});
                const bool large = (corner >> 2 ^ corner >> 1 ^ corner) & 1;
                EXPECT_NEAR(control, large ? 0.1 * static_cast<double>(kLarge) : 0, 1e32);
            }
            EXPECT_TRUE(std::isfinite(plan.depth(i, 0)));
        });
    EXPECT_EQ(met, 1);
}

TEST(AffineMap, InverseUndoesExtremeMaps) {
    for (const double voxel : {1e-120, 1e-9, 1.0, 1e9}) {
        trk::AffineMap map;
        const double rows[3][3] = {{voxel, 0.3 * voxel, 0}, {0, 1e-6 * voxel, 0}, {0, 0, -voxel}};
        for (int i = 0; i < 3; ++i) {
            for (int j = 0; j < 3; ++j) {
                map.linear[i][j] = rows[i][j];
            }
            map.translation[i] = 1e3 * voxel * (i + 1);
        }
        const trk::AffineMap inverse = map.inverse();
        const trk::Vec3d p{{12.5, -7.25, 100}};
        const trk::Vec3d q = inverse.point(map.point(p));
        for (int a = 0; a < 3; ++a) {
            EXPECT_NEAR(q[a], p[a], 1e-6);
        }
    }
}

}  // namespace
