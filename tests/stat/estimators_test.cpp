// SPDX-License-Identifier: Apache-2.0
// That the random estimators have the exact transmittance as their mean, to the standard error
// their exact second moment gives, and that a wrong estimator would be noticed.
#include "estimators/ratio_tracking.h"
#include "rng.h"
#include "stat/test_set.h"
#include "support/fixtures.h"
#include "support/rays.h"
#include "volume.h"

#include <gtest/gtest.h>

#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <string>
#include <utility>
#include <vector>

namespace {

using namespace estimates;

template <class SuperVoxels>
double estimateOnce(const Scene& scene, const Variant& variant, const SuperVoxels& superVoxels,
                    const PreparedRay& ray, trk::Rng& rng) {
    trk::PathCost cost;
    const trk::TrackingSettings settings = scene.settings(ray);
    return variant.residual ? trk::trackTransmittance<trk::ResidualControl>(
                                  scene.volume.field, superVoxels, ray.local, settings, rng, cost)
                            : trk::trackTransmittance<trk::NoControl>(
                                  scene.volume.field, superVoxels, ray.local, settings, rng, cost);
}

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

std::string sidecarOf(const Source& source, int size) {
    const std::string path = fixtures::path(source.label + std::to_string(size) + ".track.vdb");
    fixtures::bake(source.vdb, path, size, 0);
    return path;
}

TEST(Estimators, AreUnbiasedForEverySizeChoiceAndDepth) {
    const std::vector<int> sizes{4, 8, 16, 32};
    const std::vector<double> depths{1, 10};
    const std::vector<Source> all = sources();
    const double bound = sidakBound(all.size() * sizes.size() * depths.size() * kVariants.size());
    std::printf("|z| must stay below %.2f\n", bound);
    for (const Source& source : all) {
        for (const int size : sizes) {
            const std::string sidecar = sidecarOf(source, size);
            for (const double depth : depths) {
                for (const Variant& variant : kVariants) {
                    const Scene scene(source.vdb, sidecar, variant, depth, 300);
                    const TestSet set = makeSet(scene, variant, 200);
                    const double z = zOf(set, 1, [&](const PreparedRay& ray, trk::Rng& rng) {
                        return estimateOnce(scene, variant, scene.volume.superVoxels, ray, rng);
                    });
                    std::printf(
                        "%-16s size %2d depth %2g %-15s z %5.2f skewness %5.2f kurtosis "
                        "%5.2f, %.1f %% of the length exact",
                        source.label.c_str(), size, depth, variant.name.c_str(), z, set.skewness,
                        set.excessKurtosis, 100 * set.exactShare);
                    if (set.testedShare < 1) {
                        std::printf(
                            ", too heavy a tail on whole rays (kurtosis %.0e): tested %.0f "
                            "%% of their length",
                            set.wholeKurtosis, 100 * set.testedShare);
                    }
                    std::printf("\n");
                    EXPECT_TRUE(set.isNormal()) << "too heavy a tail for this many samples";
                    EXPECT_LT(std::fabs(z), bound);
                    EXPECT_LT(set.exactShare, 0.1);
                    EXPECT_GT(set.testedShare, 0.01);
                    if (variant.choice == TRK_CHOICE_ROBUST || variant.choice == TRK_CHOICE_MIN) {
                        EXPECT_EQ(set.testedShare, 1);
                    }
                }
            }
        }
    }
}

/// Runs a wrong estimator with as many samples as move its z by 10, and the right one beside it.
template <class Wrong, class Factor>
void expectRejected(const Scene& scene, const Variant& variant, const Wrong& wrong,
                    const Factor& factor) {
    TestSet set = makeSet(scene, variant, 50);
    while (std::fabs(shiftOf(set, factor)) < 10 && set.samples < 20000) {
        set = makeSet(scene, variant, set.samples * 3 / 2);
    }
    const double good = zOf(set, 3, [&](const PreparedRay& ray, trk::Rng& rng) {
        return estimateOnce(scene, variant, scene.volume.superVoxels, ray, rng);
    });
    const double bad = zOf(set, 3, wrong);
    std::printf("%s: %llu samples a ray, z %.2f right, %.2f wrong (expected %.2f)\n",
                variant.name.c_str(), static_cast<unsigned long long>(set.samples), good, bad,
                shiftOf(set, factor));
    EXPECT_TRUE(set.isNormal());
    EXPECT_LT(std::fabs(good), 3.5);
    EXPECT_GT(std::fabs(bad), 6);
}

TEST(Estimators, AControlDepthTwoPercentTooLargeIsRejected) {
    const Source source = sources().front();
    const std::string sidecar = sidecarOf(source, 8);
    for (const size_t v : {1u, 2u}) {  // `min` has next to no control that could be wrong
        const Variant& variant = kVariants[v];
        const Scene scene(source.vdb, sidecar, variant, 1, 300);
        const auto factor = [&](const PreparedRay& ray) {
            double depth = 0;
            scene.volume.superVoxels.walk(ray.local, 0, ray.local.tEnd,
                                          [&](const trk::SuperVoxel& item, double t0, double t1) {
                                              depth += static_cast<double>(item.control) *
                                                       ray.lengthPerVoxel * (t1 - t0);
                                              return true;
                                          });
            return std::exp(-0.02 * depth);
        };
        expectRejected(
            scene, variant,
            [&](const PreparedRay& ray, trk::Rng& rng) {
                return factor(ray) *
                       estimateOnce(scene, variant, scene.volume.superVoxels, ray, rng);
            },
            factor);
    }
}

/// The super-voxels of a volume, where some claim that the control leaves nothing.
struct LyingSuperVoxels {
    const trk::SuperVoxels& truth;

    static bool lies(const trk::SuperVoxel& v) {
        uint32_t bits;
        std::memcpy(&bits, &v.mean, sizeof(bits));
        return v.bound > 0 && (bits >> 3 & 7) == 0;
    }
    template <class Visit>
    void walk(const LocalRay& ray, double t0, double t1, Visit&& visit) const {
        truth.walk(ray, t0, t1, [&](trk::SuperVoxel v, double tEnter, double tExit) {
            v.bound = lies(v) ? 0 : v.bound;
            return visit(v, tEnter, tExit);
        });
    }
};

TEST(Estimators, ABoundOfZeroWhereThereIsResidualIsRejected) {
    const Source source = sources().front();
    const std::string sidecar = sidecarOf(source, 8);
    const Variant& variant = kVariants[3];  // over many rays, residuals of a mean control cancel
    const Scene scene(source.vdb, sidecar, variant, 1, 300);
    const LyingSuperVoxels lying{scene.volume.superVoxels};
    expectRejected(
        scene, variant,
        [&](const PreparedRay& ray, trk::Rng& rng) {
            return estimateOnce(scene, variant, lying, ray, rng);
        },
        [&](const PreparedRay& ray) {
            double untracked = 0;  // residual optical depth that nobody samples
            scene.volume.superVoxels.walk(
                ray.local, 0, ray.local.tEnd, [&](const trk::SuperVoxel& v, double t0, double t1) {
                    uint64_t ignored = 0;
                    if (LyingSuperVoxels::lies(v)) {
                        untracked +=
                            ray.lengthPerVoxel *
                            (static_cast<double>(scene.volume.scale) *
                                 scene.volume.field.integrate(ray.local, t0, t1, ignored, ignored) -
                             static_cast<double>(v.control) * (t1 - t0));
                    }
                    return true;
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
        for (const auto& [size, depth] :
             {std::pair{16, 1.0}, std::pair{16, 10.0}, std::pair{4, 1.0}, std::pair{4, 10.0}}) {
            const std::string sidecar = sidecarOf(source, size);
            double score[2];
            for (const size_t v : {0u, 1u}) {
                const Scene scene(source.vdb, sidecar, kVariants[v], depth, 300);
                double variance = 0;
                double lookups = 0;
                for (const PreparedRay& ray : scene.rays) {
                    const Moments m = momentsOf(scene, kVariants[v], ray);
                    variance += m.variance / static_cast<double>(scene.rays.size());
                    lookups += m.lookups / static_cast<double>(scene.rays.size());
                }
                score[v] = (0.01 + variance) * lookups;
                std::printf(
                    "%s size %d depth %g %s: variance %.3g, %.3g look-ups, (0.01 + variance) x "
                    "look-ups %.3g\n",
                    source.label.c_str(), size, depth, kVariants[v].name.c_str(), variance, lookups,
                    score[v]);
            }
            std::printf("residual over ratio: %.3f\n", score[1] / score[0]);
            EXPECT_LT(score[1], score[0]);
        }
    }
}

}  // namespace
