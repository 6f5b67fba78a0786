// SPDX-License-Identifier: Apache-2.0
// That the random estimators have the exact transmittance as their mean, to the standard error
// their exact second moment gives, and that a wrong estimator would be noticed.
#include "estimate/plan.h"
#include "estimate/ratio_tracking.h"
#include "estimate/rng.h"
#include "support/fixtures.h"
#include "support/rays.h"
#include "test_set.h"
#include "volume.h"

#include <gtest/gtest.h>

#include <array>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <string>
#include <utility>
#include <vector>

namespace {

using namespace estimates;

/// One estimate of one channel.
double estimateOnce(const Scene& scene, const PreparedRay& ray, trk::Rng& rng, size_t channel = 0) {
    trk::PathCost cost;
    return scene.estimate(ray, scene.settings(ray), rng, cost)[channel];
}

/// What the negative controls take apart: a grey volume with a constant control.
using Grey = trk::Variant<1, 1, ControlKind::kConstant>;

/// The procedural cloud, and the real volumes there are.
struct Source {
    std::string label;
    std::string vdb;
};
std::vector<Source> sources() {
    std::vector<Source> all{{"procedural cloud", fixtures::cloudFile(96)}};
    if (!fixtures::dataFolder().empty()) {
        all.push_back({"wdas cloud", fixtures::dataFolder() + "/wdas_cloud_sixteenth.vdb"});
        all.push_back({"smoke1", fixtures::dataFolder() + "/smoke1.vdb"});
    }
    return all;
}
Medium mediumOf(const Source& source) {
    return {source.label, source.vdb};
}

/// Tests one channel of a scene and says what it found.
void expectUnbiased(const Scene& scene, const std::string& label, size_t channel, uint64_t samples,
                    double bound) {
    const TestSet set = makeSet(scene, samples, channel);
    const double z = zOf(set, 1 + channel, [&](const PreparedRay& ray, trk::Rng& rng) {
        return estimateOnce(scene, ray, rng, channel);
    });
    std::printf("%-38s %-17s z %5.2f skewness %5.2f kurtosis %5.2f", label.c_str(),
                scene.way.name.c_str(), z, set.skewness, set.excessKurtosis);
    if (set.testedShare < 1) {
        std::printf(
            ", too heavy a tail on whole rays (kurtosis %.0e): tested %.0f %% of their "
            "length",
            set.wholeKurtosis, 100 * set.testedShare);
    }
    std::printf("\n");
    EXPECT_TRUE(set.isNormal()) << "too heavy a tail for this many samples";
    EXPECT_LT(std::fabs(z), bound) << label << " " << scene.way.name;
    // In a thick super-voxel, here the whole volume, these controls have tails beyond testing.
    const bool beyond = scene.way.choice == TRK_CHOICE_MAX || scene.way.choice == TRK_CHOICE_MEAN;
    if (set.testedShare < 0.01 && beyond && scene.way.global && scene.depth > 1) {
        std::printf("    not tested: the tail is too heavy on nearly all of the length\n");
        return;
    }
    EXPECT_GT(set.testedShare, 0.01);
    const bool tame = scene.way.choice == TRK_CHOICE_ROBUST || scene.way.choice == TRK_CHOICE_MIN;
    if (tame && scene.way.rateBase == RateBase::kMajorant && !scene.way.global &&
        scene.depth <= 10) {
        EXPECT_EQ(set.testedShare, 1) << label << " " << scene.way.name;
    }
}

/// Of one volume: which of sources().
class EveryWay : public testing::TestWithParam<size_t> {
  protected:
    void SetUp() override {
        if (GetParam() >= sources().size()) {
            GTEST_SKIP() << "TRACK_TEST_DATA names no folder of real volumes";
        }
    }
};

TEST_P(EveryWay, IsUnbiasedForEverySizeAndDepth) {
    const Medium medium = mediumOf(sources()[GetParam()]);
    // Sanitizers look at the same code on fewer estimates.
    const std::vector<std::pair<int, double>> cases =
        fixtures::kSanitized
            ? std::vector<std::pair<int, double>>{{8, 1}, {16, 10}}
            : std::vector<std::pair<int, double>>{{4, 1},  {4, 10},  {8, 1},  {8, 10}, {8, 100},
                                                  {16, 1}, {16, 10}, {32, 1}, {32, 10}};
    const double bound = sidakBound(cases.size() * kWays.size());
    std::printf("|z| must stay below %.2f\n", bound);
    for (const auto& [size, depth] : cases) {
        for (const Way& way : kWays) {
            const Scene scene(medium, size, way, depth, 300);
            char label[64];
            std::snprintf(label, sizeof(label), "%s, size %d, depth %g", medium.label.c_str(), size,
                          depth);
            expectUnbiased(scene, label, 0, 150, bound);
        }
    }
}

TEST_P(EveryWay, IsUnbiasedOverTheWholeVolumeAsOneSuperVoxel) {
    const Medium medium = mediumOf(sources()[GetParam()]);
    const std::vector<double> depths =
        fixtures::kSanitized ? std::vector<double>{10} : std::vector<double>{1, 10, 100};
    const double bound = sidakBound(depths.size() * kGlobalWays.size());
    std::printf("|z| must stay below %.2f\n", bound);
    for (const double depth : depths) {
        for (const Way& way : kGlobalWays) {
            const Scene scene(medium, 16, way, depth, 100);
            expectUnbiased(scene, medium.label + ", depth " + std::to_string(int(depth)), 0, 100,
                           bound);
        }
    }
}

INSTANTIATE_TEST_SUITE_P(Estimators, EveryWay, testing::Values(0, 1, 2));

TEST(Estimators, AreUnbiasedInColour) {
    struct Colour {
        Medium medium;
        std::array<float, 3> color;
    };
    const std::vector<Colour> colours{
        {{"tinted cloud", fixtures::cloudFile(96)}, {{1, 0.25f, 2}}},
        {{"colour cloud", fixtures::cloudFile(96, "color-cloud")}, {{1, 1, 1}}},
        {{"tinted colour cloud", fixtures::cloudFile(96, "color-cloud")}, {{1, 0.25f, 0}}}};
    const std::vector<double> depths =
        fixtures::kSanitized ? std::vector<double>{10} : std::vector<double>{1, 10, 100};
    std::vector<Way> ways = kWays;
    ways.insert(ways.end(), kGlobalWays.begin(), kGlobalWays.end());
    // One channel of the last volume is 0, and no estimate.
    const double bound = sidakBound((3 * colours.size() - 1) * depths.size() * ways.size());
    std::printf("|z| must stay below %.2f\n", bound);
    for (const auto& [medium, color] : colours) {
        for (const Way& way : ways) {
            for (const double depth : depths) {
                const Scene scene(medium, 8, way, depth, 100, color);
                ASSERT_EQ(scene.volume.channels(), 3u);
                for (size_t channel = 0; channel < 3; ++channel) {
                    if (color[channel] == 0) {
                        trk::Rng rng(1, 2, 3, 4);
                        EXPECT_EQ(estimateOnce(scene, scene.rays[0], rng, channel), 1.0);
                        continue;
                    }
                    char label[64];
                    std::snprintf(label, sizeof(label), "%s, depth %g, channel %zu",
                                  medium.label.c_str(), depth, channel);
                    expectUnbiased(scene, label, channel, 100, bound);
                }
            }
        }
    }
}

/// Runs a wrong estimator with as many samples as move its z by 10, and the right one beside it.
template <class Wrong, class Factor>
void expectRejected(const Scene& scene, const Wrong& wrong, const Factor& factor) {
    TestSet set = makeSet(scene, 50);
    while (std::fabs(shiftOf(set, factor)) < 10 && set.samples < 20000) {
        set = makeSet(scene, set.samples * 3 / 2);
    }
    const double good = zOf(set, 3, [&](const PreparedRay& ray, trk::Rng& rng) {
        return estimateOnce(scene, ray, rng);
    });
    const double bad = zOf(set, 3, wrong);
    std::printf("%s: %llu samples a ray, z %.2f right, %.2f wrong (expected %.2f)\n",
                scene.way.name.c_str(), static_cast<unsigned long long>(set.samples), good, bad,
                shiftOf(set, factor));
    EXPECT_TRUE(set.isNormal());
    EXPECT_LT(std::fabs(good), 3.5);
    EXPECT_GT(std::fabs(bad), 6);
}

TEST(Estimators, AControlDepthTwoPercentTooLargeIsRejected) {
    const Medium medium = mediumOf(sources().front());
    for (const char* way : {"robust", "mean"}) {  // `min` has next to no control to be wrong
        const Scene scene(medium, 8, wayNamed(way), 1, 300);
        const auto factor = [&](const PreparedRay& ray) {
            double depth = 0;
            const trk::TrackingSettings settings = scene.settings(ray);
            trk::forEachStretch<trk::Control::kChosen>(
                Grey::Walk(scene.volume), ray.local, settings,
                [&](const auto& plan, size_t i) { depth += plan.depth(i, 0); });
            return std::exp(-0.02 * depth);
        };
        expectRejected(
            scene,
            [&](const PreparedRay& ray, trk::Rng& rng) {
                return factor(ray) * estimateOnce(scene, ray, rng);
            },
            factor);
    }
}

/// The super-voxels of a volume, where some claim that the control, the minimum, leaves nothing.
struct LyingSuperVoxels {
    static constexpr size_t kChannels = 1;
    static constexpr ControlKind kKind = ControlKind::kConstant;
    const Grey::Walk& truth;

    static bool lies(const trk::SuperVoxel& v) {
        uint32_t bits;
        std::memcpy(&bits, &v.mean, sizeof(bits));
        return v.max > v.min && (bits >> 3 & 7) == 0;
    }
    double scale(size_t channel) const { return truth.scale(channel); }
    const trk::ControlChoice& choice() const { return truth.choice(); }
    struct Cursor : trk::SuperVoxelCursor<1, ControlKind::kConstant> {
        using Truth = trk::SuperVoxelCursor<1, ControlKind::kConstant>;
        explicit Cursor(const Truth& whole) : Truth(whole) {}
        trk::SuperVoxel record(size_t i, size_t channel) const {
            trk::SuperVoxel v = Truth::record(i, channel);
            v.max = lies(v) ? v.min : v.max;
            return v;
        }
    };
    Cursor cursor(const LocalRay& ray, double t0, double t1) const {
        return Cursor(truth.cursor(ray, t0, t1));
    }
};

TEST(Estimators, ABoundOfZeroWhereThereIsResidualIsRejected) {
    const Medium medium = mediumOf(sources().front());
    // Over many rays, residuals of a mean control cancel.
    const Scene scene(medium, 8, wayNamed("min"), 1, 300);
    const Grey::Walk truth(scene.volume);
    const LyingSuperVoxels lying{truth};
    const Grey::Extinction field(scene.volume);
    expectRejected(
        scene,
        [&](const PreparedRay& ray, trk::Rng& rng) {
            trk::PathCost cost;
            return trk::trackTransmittance<trk::Control::kChosen>(
                field, lying, ray.local, scene.settings(ray), rng, cost)[0];
        },
        [&](const PreparedRay& ray) {
            double untracked = 0;  // residual optical depth that nobody samples
            const trk::TrackingSettings settings = scene.settings(ray);
            trk::forEachStretch<trk::Control::kChosen>(
                lying, ray.local, settings, [&](const auto& plan, size_t i) {
                    if (plan.rate(i) == 0) {
                        uint64_t ignored = 0;
                        untracked += ray.lengthPerVoxel * field.integrate(ray.local, plan.tEnter(i),
                                                                          plan.tExit(i), ignored,
                                                                          ignored)[0] -
                                     plan.depth(i, 0);
                    }
                });
            return std::exp(untracked);
        });
}

TEST(Estimators, RobustResidualBeatsRatioInVarianceTimesLookups) {
    std::vector<Source> clouds{{"procedural cloud", fixtures::cloudFile(256)}};
    if (!fixtures::dataFolder().empty()) {
        clouds.push_back({"wdas cloud", fixtures::dataFolder() + "/wdas_cloud_sixteenth.vdb"});
    }
    for (const Source& source : clouds) {
        const Medium medium = mediumOf(source);
        for (const auto& [size, depth] :
             {std::pair{16, 1.0}, std::pair{16, 10.0}, std::pair{4, 1.0}, std::pair{4, 10.0}}) {
            double score[2];
            for (const size_t v : {0u, 1u}) {
                const Way way = wayNamed(v == 0 ? "ratio" : "robust");
                const Scene scene(medium, size, way, depth, 300);
                double variance = 0;
                double lookups = 0;
                for (const PreparedRay& ray : scene.rays) {
                    const Moments m = momentsOf(scene, ray);
                    variance += m.variance / static_cast<double>(scene.rays.size());
                    lookups += m.lookups / static_cast<double>(scene.rays.size());
                }
                score[v] = (0.01 + variance) * lookups;
                std::printf(
                    "%s size %d depth %g %s: variance %.3g, %.3g look-ups, (0.01 + variance) x "
                    "look-ups %.3g\n",
                    source.label.c_str(), size, depth, way.name.c_str(), variance, lookups,
                    score[v]);
            }
            std::printf("residual over ratio: %.3f\n", score[1] / score[0]);
            EXPECT_LT(score[1], score[0]);
        }
    }
}

}  // namespace
