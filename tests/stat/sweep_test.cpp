// SPDX-License-Identifier: Apache-2.0
// What `vdbtrack measure` measures: is it true, and would it notice if it were not?
#include "measure/sweep.h"

#include "measure/recommendation.h"
#include "measure/strips.h"
#include "support/fixtures.h"

#include <gtest/gtest.h>

#include <cmath>
#include <string>

namespace {

using trk::ControlKind;
using vdbtools::RayKind;
using vdbtools::Sweep;
using vdbtools::SweepOptions;
using vdbtools::SweepRow;
using vdbtools::SweepSet;
using vdbtools::Way;

SweepOptions smallSweep() {
    SweepOptions options;
    options.depths = {1, 10};
    options.color = {{1, 0.5f, 0}};
    options.rounds = fixtures::kSanitized ? 16 : 64;
    options.rayCount = 300;
    options.ways = vdbtools::sweepWays(
        {TRK_METHOD_EXACT, TRK_METHOD_RESIDUAL, TRK_METHOD_RATIO, TRK_METHOD_CONTROL,
         TRK_METHOD_DELTA, TRK_METHOD_MARCH, TRK_METHOD_COMB},
        {ControlKind::kConstant, ControlKind::kAffine, ControlKind::kTrilinear},
        {TRK_CHOICE_ROBUST, TRK_CHOICE_MIN}, {8, Way::kWholeVolume}, {1, 4});
    return options;
}

Sweep run(const vdbtools::Source& source, const SweepOptions& options) {
    return vdbtools::runSweep(source, options, [](double) {});
}

TEST(Sweep, UnbiasedWaysAreWithinTheBoundAndBiasedOnesAreNot) {
    const SweepOptions options = smallSweep();
    const Sweep sweep = run(fixtures::loadSource(fixtures::cloudFile(64)), options);
    ASSERT_EQ(sweep.sets.size(), 8u);  // camera and secondary, grey and coloured, depths 1 and 10
    ASSERT_EQ(sweep.rows.size(), sweep.sets.size() * options.ways.size());
    EXPECT_GT(sweep.zBound, 3);
    double coarse = 0;
    double unbiased = 0;
    double tested = 0;
    for (const SweepRow& row : sweep.rows) {
        const std::string name = nameOf(row.way) + ", set " + std::to_string(row.set);
        EXPECT_GT(row.nanoseconds, 0) << name;
        if (row.way.isUnbiased() && row.way.isRandom()) {
            ++unbiased;
            EXPECT_EQ(std::isnan(row.z), !row.converged) << name;
            if (row.converged) {
                ++tested;
                EXPECT_LT(std::fabs(row.z), sweep.zBound) << name;
            }
        }
        if (!row.way.isRandom()) {
            EXPECT_TRUE(std::isnan(row.z)) << name;
            EXPECT_EQ(row.variance, 0) << name;
        }
        if (row.way.method == TRK_METHOD_EXACT) {
            EXPECT_LT(row.rmse, 1e-6) << name;
        }
        if (row.way.method == TRK_METHOD_CONTROL) {
            EXPECT_GT(row.rmse, 1e-3) << name;
        }
        if (row.way.method == TRK_METHOD_MARCH && row.way.rate == 4) {
            coarse = std::max(coarse, row.z);
        }
    }
    EXPECT_GT(tested, 0.95 * unbiased);
    // Marching is biased: it must be found out.
    EXPECT_GT(coarse, sweep.zBound);
}

TEST(Sweep, SetsAreAsDeepAsAsked) {
    const Sweep sweep = run(fixtures::loadSource(fixtures::cloudFile(64)), smallSweep());
    for (const SweepSet& set : sweep.sets) {
        EXPECT_GE(set.rayCount, 200u);
        if (set.rays == RayKind::kCamera && !set.coloured) {
            EXPECT_NEAR(set.meanDepth, set.depth, 1e-3 * set.depth);
        }
        if (set.coloured) {
            // The third channel is empty, the second has half the extinction.
            EXPECT_LT(set.meanDepth, 0.55 * set.depth);
        }
    }
}

// The sample's variance is the formula's: roulette adds at most 2 % at depth 1.
TEST(Sweep, MeasuredVarianceIsThePredictedOne) {
    SweepOptions options = smallSweep();
    options.depths = {1};
    options.coloured = false;
    options.rounds = fixtures::kSanitized ? 64 : 400;
    const Sweep sweep = run(fixtures::loadSource(fixtures::cloudFile(64)), options);
    int compared = 0;
    for (const SweepRow& row : sweep.rows) {
        const TrkMethod method = row.way.method;
        if ((method == TRK_METHOD_RESIDUAL || method == TRK_METHOD_RATIO) &&
            row.predictedVariance > 1e-6) {
            const double tolerance = fixtures::kSanitized ? 0.3 : 0.1;
            if (fixtures::kSanitized && !row.converged) {
                continue;  // as few rounds may not
            }
            EXPECT_TRUE(row.converged) << nameOf(row.way);
            EXPECT_NEAR(row.variance, row.predictedVariance, tolerance * row.predictedVariance)
                << nameOf(row.way);
            ++compared;
        }
    }
    EXPECT_GE(compared, 20);
}

TEST(Sweep, NumbersButTimesAreTheSameInEveryRun) {
    SweepOptions options = smallSweep();
    options.rounds = 4;
    const vdbtools::Source source = fixtures::loadSource(fixtures::cloudFile(64));
    const Sweep a = run(source, options);
    const Sweep b = run(source, options);
    ASSERT_EQ(a.rows.size(), b.rows.size());
    for (size_t i = 0; i < a.rows.size(); ++i) {
        EXPECT_EQ(a.rows[i].variance, b.rows[i].variance);
        EXPECT_EQ(a.rows[i].lookups, b.rows[i].lookups);
        EXPECT_EQ(a.rows[i].bias, b.rows[i].bias);
    }
    options.seed = 1;
    const Sweep c = run(source, options);
    EXPECT_NE(a.rows[1].bias, c.rows[1].bias);
}

// Where everything is integrated exactly, roulette is all the noise, and one that no walk may
// survive: that is no bias.
TEST(Sweep, RouletteAloneIsNoBias) {
    SweepOptions options = smallSweep();
    options.depths = {300};
    options.coloured = false;
    options.rays = {RayKind::kCamera};
    options.rayCount = 200;
    options.rounds = 16;
    options.ways = {{TRK_METHOD_RATIO, ControlKind::kConstant, TRK_CHOICE_ROBUST, 16, 1},
                    {TRK_METHOD_RESIDUAL, ControlKind::kConstant, TRK_CHOICE_ROBUST, 16, 1}};
    const vdbtools::Source source = fixtures::loadSource(fixtures::cloudFile(64));
    for (uint64_t seed = 0; seed < 8; ++seed) {
        options.seed = seed;
        for (const SweepRow& row : run(source, options).rows) {
            EXPECT_GT(row.exactShare, 0.3);
            EXPECT_LT(std::fabs(row.z), 3) << nameOf(row.way) << ", seed " << seed;
        }
    }
}

// `max` has a tail that no sample shows: it must not rank.
TEST(Sweep, TailsThatASampleMissesAreNotConverged) {
    SweepOptions options = smallSweep();
    options.depths = {3};
    options.ways = {{TRK_METHOD_RESIDUAL, ControlKind::kConstant, TRK_CHOICE_MAX, 16, 1},
                    {TRK_METHOD_EXACT}};
    const Sweep sweep = run(fixtures::loadSource(fixtures::cloudFile(64)), options);
    for (const SweepRow& row : sweep.rows) {
        EXPECT_EQ(row.converged, row.way.method == TRK_METHOD_EXACT)
            << row.variance << " " << row.predictedVariance;
        EXPECT_TRUE(std::isnan(row.z));
    }
    EXPECT_EQ(vdbtools::rank(sweep, {0}, 0.01).size(), 1u);
}

TEST(Sweep, ThreeChannelsAndAnEmptyVolume) {
    SweepOptions options = smallSweep();
    options.grey = false;
    options.color = {{1, 1, 1}};
    options.rounds = 8;
    const Sweep sweep = run(fixtures::loadSource(fixtures::cloudFile(48, "color-cloud")), options);
    EXPECT_EQ(sweep.sets.size(), 4u);
    for (const SweepRow& row : sweep.rows) {
        EXPECT_TRUE(!row.way.isUnbiased() || std::isnan(row.z) || std::fabs(row.z) < sweep.zBound)
            << nameOf(row.way);
    }
    const auto grid = openvdb::FloatGrid::create(0);
    grid->setName("density");
    EXPECT_THROW(run(fixtures::loadSource(fixtures::write("empty.vdb", {grid})), options),
                 std::exception);
}

TEST(Strips, RobustHasTheLeastNoiseAndAllMeanTheSame) {
    const vdbtools::Source source = fixtures::loadSource(fixtures::cloudFile(64));
    trk::BakeOptions bake;
    bake.superVoxelSize = 8;
    const vdbtools::Strip strip =
        vdbtools::drawStrip(source, trk::bake(*source.field, bake), false, 0.5f, 40, 64);
    ASSERT_EQ(strip.rows.size(), 4u);
    const auto meanOf = [](const std::vector<float>& values) {
        double sum = 0;
        for (const float v : values) {
            sum += static_cast<double>(v) / static_cast<double>(values.size());
        }
        return sum;
    };
    const vdbtools::StripRow& min = strip.rows[0];
    const vdbtools::StripRow& robust = strip.rows[3];
    EXPECT_EQ(robust.choice, TRK_CHOICE_ROBUST);
    EXPECT_LT(meanOf(robust.variance), 0.85 * meanOf(min.variance));
    EXPECT_LT(meanOf(robust.control), meanOf(min.control));
    EXPECT_NEAR(meanOf(robust.product), meanOf(min.product), 0.005);
    for (size_t i = 0; i < min.product.size(); ++i) {
        ASSERT_NEAR(min.product[i], min.control[i] * min.residual[i], 1e-5f);
    }
    // Nothing hides the noise of one control for everything, not even where it would be faster to
    // integrate exactly.
    const vdbtools::Strip whole =
        vdbtools::drawStrip(source, trk::bake(*source.field, bake), true, 20, 40, 16);
    double seen = 0;
    double noisy = 0;
    for (size_t i = 0; i < whole.rows[0].product.size(); ++i) {
        const float T = whole.rows[0].product[i];
        if (T > 0.01f && T < 0.9f) {
            ++seen;
            noisy += whole.rows[0].variance[i] > 1e-9f ? 1 : 0;
        }
    }
    EXPECT_GT(seen, 20);
    EXPECT_EQ(noisy, seen);
}

}  // namespace
