// SPDX-License-Identifier: Apache-2.0
// Ranking and advice, on sweeps made up for it.
#include "measure/recommendation.h"

#include <gtest/gtest.h>

#include <cmath>

namespace {

using trk::ControlKind;
using vdbtools::Sweep;
using vdbtools::SweepRow;
using vdbtools::Way;

const Way kExact{TRK_METHOD_EXACT};
const Way kRatio{TRK_METHOD_RATIO, ControlKind::kConstant, TRK_CHOICE_ROBUST, 16, 1};
const Way kDelta{TRK_METHOD_DELTA, ControlKind::kConstant, TRK_CHOICE_ROBUST, 16, 1};
const Way kConstant{TRK_METHOD_RESIDUAL, ControlKind::kConstant, TRK_CHOICE_ROBUST, 16, 1};
const Way kAffine{TRK_METHOD_RESIDUAL, ControlKind::kAffine, TRK_CHOICE_ROBUST, 8, 1};
const Way kControl{TRK_METHOD_CONTROL, ControlKind::kConstant, TRK_CHOICE_ROBUST, 16, 1};

class MadeUp {
  public:
    explicit MadeUp(size_t sets) {
        sweep.sets.resize(sets);
        for (vdbtools::SweepSet& set : sweep.sets) {
            set.depth = 1;
        }
    }
    SweepRow& add(size_t set, const Way& way, double time, double variance) {
        SweepRow row;
        row.set = set;
        row.way = way;
        row.nanoseconds = time;
        row.variance = variance;
        row.rmse = std::sqrt(variance);
        sweep.rows.push_back(row);
        return sweep.rows.back();
    }

    Sweep sweep;
};

TEST(Recommendation, AccuracyDecides) {
    MadeUp m(1);
    m.add(0, kExact, 3000, 0);
    m.add(0, kRatio, 300, 0.1);
    m.add(0, kDelta, 250, 0.2);
    m.add(0, kAffine, 500, 0.01);
    const auto advice = vdbtools::recommend(m.sweep);
    ASSERT_EQ(advice.size(), 3u);
    // Rough: 0.1 + variance: 300, 60, 75, 55. Normal: 30, 33, 52, 10. Tight: 3, 30, 50, 5.5.
    EXPECT_TRUE(advice[0].choice.way == kAffine);
    EXPECT_TRUE(advice[1].choice.way == kAffine);
    EXPECT_TRUE(advice[2].choice.way == kExact);
    EXPECT_EQ(advice[1].bake, "--size 8 --control affine");
    EXPECT_EQ(advice[1].query, "--method residual");
    EXPECT_EQ(advice[2].bake, "");
    ASSERT_FALSE(advice[1].why.empty());
    const std::string& overall = advice[1].why.front();
    EXPECT_NE(overall.find("0.303 of ratio tracking's at size 16"), std::string::npos) << overall;
}

TEST(Recommendation, TheSimplerOneWhereThereIsNoDifference) {
    MadeUp m(1);
    m.add(0, kRatio, 500, 0.05);
    m.add(0, kAffine, 500, 0.0100);
    m.add(0, kConstant, 500, 0.0104);
    EXPECT_TRUE(vdbtools::rank(m.sweep, {0}, 0.01).front().way == kAffine);
    EXPECT_TRUE(vdbtools::recommend(m.sweep)[1].choice.way == kConstant);
    // Where there is one, the better one.
    m.sweep.rows.back().rmse = std::sqrt(0.012);
    EXPECT_TRUE(vdbtools::recommend(m.sweep)[1].choice.way == kAffine);
}

TEST(Recommendation, NeitherBiasedNorUnconvergedOnesRank) {
    MadeUp m(2);
    for (const size_t set : {0u, 1u}) {
        m.add(set, kControl, 1, 0);
        m.add(set, kRatio, 500, 0.05);
        m.add(set, kAffine, 500, 0.01).converged = set == 0;
    }
    EXPECT_EQ(vdbtools::rank(m.sweep, {0}, 0.01).size(), 2u);
    const auto ranked = vdbtools::rank(m.sweep, {0, 1}, 0.01);
    ASSERT_EQ(ranked.size(), 1u);
    EXPECT_TRUE(ranked[0].way == kRatio);
    // Its cost is still that over each set's best: (0.06 / 0.02) of the first set, 1 of the second.
    EXPECT_NEAR(ranked[0].cost, std::sqrt(3.0), 1e-6);
}

TEST(Recommendation, ParetoFront) {
    MadeUp m(1);
    m.add(0, kControl, 1, 0);
    m.add(0, kExact, 3000, 0);
    m.add(0, kRatio, 300, 0.1);
    m.add(0, kDelta, 310, 0.2);
    m.add(0, kAffine, 500, 0.01);
    const auto front = vdbtools::paretoFront(m.sweep, 0);
    ASSERT_EQ(front.size(), 3u);
    EXPECT_TRUE(front[0]->way == kRatio);
    EXPECT_TRUE(front[1]->way == kAffine);
    EXPECT_TRUE(front[2]->way == kExact);
}

TEST(Recommendation, NamesAndWays) {
    EXPECT_EQ(nameOf(kAffine), "residual, affine robust, size 8, rate 1");
    EXPECT_EQ(nameOf(kExact), "exact");
    EXPECT_EQ(nameOf(kRatio), "ratio, size 16, rate 1");
    // Only a constant control has a minimum; delta tracking has one rate, ratio no control.
    const auto ways = vdbtools::sweepWays({TRK_METHOD_RESIDUAL, TRK_METHOD_RATIO, TRK_METHOD_DELTA},
                                          {ControlKind::kConstant, ControlKind::kAffine},
                                          {TRK_CHOICE_ROBUST, TRK_CHOICE_MIN}, {8}, {1, 2});
    EXPECT_EQ(ways.size(), 4u + 2u + 2u + 1u);
}

TEST(Recommendation, SidakBound) {
    EXPECT_NEAR(vdbtools::sidakBound(1), 2.5758, 1e-3);
    EXPECT_NEAR(vdbtools::sidakBound(1000), 4.4164, 1e-2);
}

}  // namespace
