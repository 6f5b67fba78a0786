// SPDX-License-Identifier: Apache-2.0
// That the random estimators have the exact transmittance as their mean, to the standard error
// their exact second moment gives, and that a wrong estimator would be noticed.
#include "estimators/ratio_tracking.h"
#include "rng.h"
#include "support/fixtures.h"
#include "support/rays.h"
#include "support/reference.h"
#include "volume.h"

#include <gtest/gtest.h>

#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <string>
#include <vector>

namespace {

using trk::LocalRay;

/// One way of estimating: a method and, for residual, its control.
struct Variant {
    std::string name;
    bool residual;
    TrkChoice choice;
};
const std::vector<Variant> kVariants{{"ratio", false, TRK_CHOICE_ROBUST},
                                     {"residual robust", true, TRK_CHOICE_ROBUST},
                                     {"residual mean", true, TRK_CHOICE_MEAN},
                                     {"residual min", true, TRK_CHOICE_MIN},
                                     {"residual max", true, TRK_CHOICE_MAX}};

/// z beyond which one of `comparisons` true hypotheses falls with probability 0.01 [Sidak 1967].
double sidakBound(size_t comparisons) {
    const double alpha = 1 - std::pow(0.99, 1.0 / static_cast<double>(comparisons));
    double lo = 0;
    double hi = 20;
    for (int i = 0; i < 100; ++i) {
        const double middle = 0.5 * (lo + hi);
        (std::erfc(middle / std::sqrt(2.0)) > alpha ? lo : hi) = middle;
    }
    return lo;
}

struct PreparedRay {
    LocalRay local;
    double lengthPerVoxel;
    double exactDepth;  ///< true optical depth
};

/// An opened volume at a scale where the rays that hit have a given mean optical depth.
struct Scene {
    trk::Volume volume;
    std::vector<PreparedRay> rays;

    Scene(const std::string& vdb, const std::string& sidecar, const Variant& variant,
          double meanDepth, size_t count) {
        trk::VolumeOptions options;
        options.choice = variant.choice;
        const trk::Volume unscaled = trk::openVolume(vdb.c_str(), "", options);
        rays = prepare(unscaled, count);
        double sum = 0;
        for (const PreparedRay& ray : rays) {
            sum += ray.exactDepth;
        }
        options.scale = static_cast<float>(meanDepth * static_cast<double>(rays.size()) / sum);
        volume = trk::openVolume(vdb.c_str(), sidecar.c_str(), options);
        rays = prepare(volume, count);
    }

    static std::vector<PreparedRay> prepare(const trk::Volume& volume, size_t count) {
        rays::Box box{};
        for (int a = 0; a < 3; ++a) {
            const auto axis = static_cast<size_t>(a);
            box.lo[a] = 0.2 * static_cast<double>(volume.field.box().hi[axis]) +
                        0.8 * static_cast<double>(volume.field.box().lo[axis]);
            box.hi[a] = 0.8 * static_cast<double>(volume.field.box().hi[axis]) +
                        0.2 * static_cast<double>(volume.field.box().lo[axis]);
        }
        std::vector<PreparedRay> result;
        std::mt19937_64 random(99);
        std::uniform_real_distribution<double> unit(0, 1);
        while (result.size() < count) {
            const auto d = rays::unitVector(random);
            trk::Vec3d index;
            trk::Vec3d direction{{d[0], d[1], d[2]}};
            for (int a = 0; a < 3; ++a) {
                index[a] = box.lo[a] + unit(random) * (box.hi[a] - box.lo[a]) -
                           1000 * d[static_cast<size_t>(a)] +
                           static_cast<double>(volume.anchor[static_cast<size_t>(a)]);
            }
            const trk::Vec3d o = volume.indexToWorld.point(index);
            const trk::Vec3d v = volume.indexToWorld.vector(direction);
            TrkRay ray{};
            for (int a = 0; a < 3; ++a) {
                ray.origin[a] = static_cast<float>(o[a]);
                ray.direction[a] = static_cast<float>(v[a]);
            }
            ray.tMax = rays::kInfinity;
            PreparedRay prepared;
            if (!volume.clip(ray, volume.field.box(), prepared.local, prepared.lengthPerVoxel)) {
                continue;
            }
            uint64_t ignored = 0;
            prepared.exactDepth =
                static_cast<double>(volume.scale) * prepared.lengthPerVoxel *
                volume.field.integrate(prepared.local, 0, prepared.local.tEnd, ignored, ignored);
            if (prepared.exactDepth > 0) {
                result.push_back(prepared);
            }
        }
        return result;
    }

    trk::TrackingSettings settings(const PreparedRay& ray) const {
        trk::TrackingSettings s;
        s.scale = static_cast<double>(volume.scale);
        s.lengthPerVoxel = ray.lengthPerVoxel;
        return s;
    }
};

/// Moments 2 to 4 of one estimate, from E[X^p] = exp(-p tau_c + integral of R ((1 - mu_r/R)^p -
/// 1)), and its expected look-ups while tracking.
struct Moments {
    double transmittance = 0;
    double variance = 0;
    double third = 0;   ///< third cumulant
    double fourth = 0;  ///< fourth cumulant
    double lookups = 0;
    double exactLength = 0;
    double length = 0;
};

template <class Method>
Moments momentsOf(const Scene& scene, const PreparedRay& ray) {
    const trk::TrackingSettings settings = scene.settings(ray);
    const LocalRay& r = ray.local;
    const double cellsPerVoxel =
        std::fabs(r.direction[0]) + std::fabs(r.direction[1]) + std::fabs(r.direction[2]);
    double logMoment[5] = {0, 0, 0, 0, 0};
    Moments m;
    m.length = r.tEnd;
    scene.volume.superVoxels.walk(
        r, 0, r.tEnd, [&](const trk::SuperVoxel& v, double t0, double t1) {
            const double control = Method::control(v);
            const double rate = Method::bound(v);
            const double unit = settings.lengthPerVoxel;
            const double expected = rate * unit * (t1 - t0);
            const auto extinction = [&](double t) {
                return settings.scale * static_cast<double>(scene.volume.field.density(r.at(t)));
            };
            if (rate == 0 || expected > 2 * (1 + cellsPerVoxel * (t1 - t0))) {
                const double depth = rate == 0
                                         ? control * unit * (t1 - t0)
                                         : unit * reference::integrateCells(r.origin, r.direction,
                                                                            t0, t1, extinction);
                for (int p = 1; p <= 4; ++p) {
                    logMoment[p] -= p * depth;
                }
                if (rate > 0) {
                    m.exactLength += t1 - t0;
                    m.lookups += 2 * cellsPerVoxel * (t1 - t0);
                }
                return true;
            }
            m.lookups += expected;
            for (int p = 1; p <= 4; ++p) {
                logMoment[p] +=
                    unit * reference::integrateCells(r.origin, r.direction, t0, t1, [&](double t) {
                        const double w = 1 - (extinction(t) - control) / rate;
                        return rate * (std::pow(w, p) - 1) - p * control;
                    });
            }
            return true;
        });
    const double T = std::exp(logMoment[1]);
    const double m2 = std::exp(logMoment[2]);
    const double m3 = std::exp(logMoment[3]);
    const double m4 = std::exp(logMoment[4]);
    m.transmittance = T;
    m.variance = std::max(m2 - T * T, 0.0);
    m.third = m3 - 3 * T * m2 + 2 * T * T * T;
    m.fourth = m4 - 4 * T * m3 + 6 * T * T * m2 - 3 * T * T * T * T - 3 * m.variance * m.variance;
    return m;
}

Moments momentsOf(const Scene& scene, const Variant& variant, const PreparedRay& ray) {
    return variant.residual ? momentsOf<trk::ResidualControl>(scene, ray)
                            : momentsOf<trk::NoControl>(scene, ray);
}

/// One ray of a set, with its estimate's moments and its weight in the set's sum.
struct TestRay {
    PreparedRay ray;
    Moments moments;
    double transmittance = 1;
    double weight = 1;
};

/// Rays whose weighted sum of errors, each the mean of `samples` estimates, is fit for a z-test:
/// normal enough, by its exact third and fourth moments.
struct TestSet {
    uint64_t samples = 0;
    std::vector<TestRay> rays;
    double testedShare = 1;  ///< of the rays' length
    double exactShare = 0;   ///< of the whole rays' length
    double skewness = 0;
    double excessKurtosis = 0;
    double standardError = 0;

    bool isNormal() const { return excessKurtosis < 0.5 && std::fabs(skewness) < 0.35; }

    void add(const Scene& scene, const PreparedRay& ray, const Moments& m, double weight) {
        // The transmittance comes from the cells, not from the moments it is compared through.
        uint64_t ignored = 0;
        const double depth =
            static_cast<double>(scene.volume.scale) * ray.lengthPerVoxel *
            scene.volume.field.integrate(ray.local, 0, ray.local.tEnd, ignored, ignored);
        EXPECT_NEAR(m.transmittance, std::exp(-depth), 1e-6);
        rays.push_back({ray, m, std::exp(-depth), weight});
    }

    void summarize() {
        const auto n = static_cast<double>(samples);
        double variance = 0;
        double third = 0;
        double fourth = 0;
        for (const TestRay& r : rays) {
            variance += r.weight * r.weight * r.moments.variance / n;
            third += std::pow(r.weight, 3) * r.moments.third / (n * n);
            fourth += std::pow(r.weight, 4) * r.moments.fourth / (n * n * n);
        }
        standardError = std::sqrt(variance);
        skewness = third / std::pow(variance, 1.5);
        excessKurtosis = fourth / (variance * variance);
    }
};

/// The whole rays, each with weight 1, where that sum is normal enough. Some controls have tails
/// that no number of samples tames on whole rays (the variance of `max` at depth 10 is beyond
/// 1e40): there the same code, at the same scale, is tested on as much of each ray as can be, rays
/// weighing alike.
TestSet makeSet(const Scene& scene, const Variant& variant, uint64_t samples) {
    TestSet whole;
    whole.samples = samples;
    double exactLength = 0;
    double length = 0;
    for (const PreparedRay& ray : scene.rays) {
        const Moments m = momentsOf(scene, variant, ray);
        exactLength += m.exactLength;
        length += m.length;
        whole.add(scene, ray, m, 1);
    }
    whole.exactShare = exactLength / length;
    whole.summarize();
    if (whole.isNormal()) {
        return whole;
    }
    constexpr double kTail = 30;
    TestSet cut;
    cut.samples = samples;
    cut.exactShare = whole.exactShare;
    double tested = 0;
    for (PreparedRay ray : scene.rays) {
        for (Moments m = momentsOf(scene, variant, ray);; m = momentsOf(scene, variant, ray)) {
            // Below, moments are the rounding error of a difference: nothing random is left.
            if (m.variance < 1e-7 * m.transmittance * m.transmittance) {
                break;
            }
            if (m.fourth < kTail * static_cast<double>(samples) * m.variance * m.variance) {
                tested += m.length;
                cut.add(scene, ray, m, 1 / std::sqrt(m.variance));
                break;
            }
            ray.local.tEnd *= 0.8;
        }
    }
    cut.testedShare = tested / length;
    cut.summarize();
    return cut;
}

/// z of a set: the weighted sum of (mean estimate - transmittance) in standard errors.
/// `estimate(ray, rng)` answers one estimate.
template <class Estimate>
double zOf(const TestSet& set, uint64_t seed, const Estimate& estimate) {
    double difference = 0;
    for (size_t i = 0; i < set.rays.size(); ++i) {
        const TestRay& r = set.rays[i];
        double sum = 0;
        for (uint64_t k = 0; k < set.samples; ++k) {
            trk::Rng rng(seed, 0, i, k);
            sum += estimate(r.ray, rng);
        }
        difference += r.weight * (sum / static_cast<double>(set.samples) - r.transmittance);
    }
    return difference / set.standardError;
}

/// Where z moves when an estimator's mean is `factor(ray)` times the transmittance.
template <class Factor>
double shiftOf(const TestSet& set, const Factor& factor) {
    double difference = 0;
    for (const TestRay& r : set.rays) {
        difference += r.weight * r.transmittance * (factor(r.ray) - 1);
    }
    return difference / set.standardError;
}

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
                        "%5.2f, %.1f %% of the length exact%s\n",
                        source.label.c_str(), size, depth, variant.name.c_str(), z, set.skewness,
                        set.excessKurtosis, 100 * set.exactShare,
                        set.testedShare == 1
                            ? ""
                            : (", too heavy a tail on whole rays: tested " +
                               std::to_string(static_cast<int>(100 * set.testedShare)) +
                               " % of their length")
                                  .c_str());
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
        const std::string sidecar = sidecarOf(source, 16);
        for (const double depth : {1.0, 10.0}) {
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
                    "%s depth %g %s: variance %.3g, %.3g look-ups, (0.01 + variance) x "
                    "look-ups %.3g\n",
                    source.label.c_str(), depth, kVariants[v].name.c_str(), variance, lookups,
                    score[v]);
            }
            std::printf("residual over ratio: %.3f\n", score[1] / score[0]);
            EXPECT_LT(score[1], score[0]);
        }
    }
}

}  // namespace
