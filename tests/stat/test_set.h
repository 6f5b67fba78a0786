// SPDX-License-Identifier: Apache-2.0
// Sets of rays whose estimates are fit for a z-test: exact moments, tails, standard errors.
#pragma once

#include "estimators/exact.h"
#include "estimators/free_path.h"
#include "estimators/ratio_tracking.h"
#include "rng.h"
#include "support/rays.h"
#include "support/reference.h"
#include "variant.h"
#include "volume.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <random>
#include <string>
#include <vector>

namespace estimates {

using trk::LocalRay;

using trk::ControlKind;

using trk::RateBase;

/// One way of estimating: a method, what it walks over, its control and its rate.
struct Way {
    std::string name;
    TrkMethod method = TRK_METHOD_RESIDUAL;
    TrkChoice choice = TRK_CHOICE_ROBUST;
    ControlKind kind = ControlKind::kConstant;
    RateBase rateBase = RateBase::kMajorant;
    double rate = 1;
    bool global = false;
};

/// Every method x kind of control x choice x base of the rate that there is, over super-voxels.
inline const std::vector<Way> kWays{
    {"ratio", TRK_METHOD_RATIO},
    {"robust"},
    {"mean", TRK_METHOD_RESIDUAL, TRK_CHOICE_MEAN},
    {"min", TRK_METHOD_RESIDUAL, TRK_CHOICE_MIN},
    {"max", TRK_METHOD_RESIDUAL, TRK_CHOICE_MAX},
    {"affine robust", TRK_METHOD_RESIDUAL, TRK_CHOICE_ROBUST, ControlKind::kAffine},
    {"affine mean", TRK_METHOD_RESIDUAL, TRK_CHOICE_MEAN, ControlKind::kAffine},
    {"trilinear robust", TRK_METHOD_RESIDUAL, TRK_CHOICE_ROBUST, ControlKind::kTrilinear},
    {"trilinear mean", TRK_METHOD_RESIDUAL, TRK_CHOICE_MEAN, ControlKind::kTrilinear},
    {"delta", TRK_METHOD_DELTA},
    {"ratio, rms", TRK_METHOD_RATIO, TRK_CHOICE_ROBUST, ControlKind::kConstant, RateBase::kRms, 3},
    {"robust, rms", TRK_METHOD_RESIDUAL, TRK_CHOICE_ROBUST, ControlKind::kConstant, RateBase::kRms,
     3},
    {"affine robust, rms", TRK_METHOD_RESIDUAL, TRK_CHOICE_ROBUST, ControlKind::kAffine,
     RateBase::kRms, 3},
    {"trilinear robust, rms", TRK_METHOD_RESIDUAL, TRK_CHOICE_ROBUST, ControlKind::kTrilinear,
     RateBase::kRms, 3}};

/// Those over the whole volume as one super-voxel.
inline const std::vector<Way> kGlobalWays{{"global delta", TRK_METHOD_DELTA, TRK_CHOICE_ROBUST,
                                           ControlKind::kConstant, RateBase::kMajorant, 1, true},
                                          {"global ratio", TRK_METHOD_RATIO, TRK_CHOICE_ROBUST,
                                           ControlKind::kConstant, RateBase::kMajorant, 1, true},
                                          {"global robust", TRK_METHOD_RESIDUAL, TRK_CHOICE_ROBUST,
                                           ControlKind::kConstant, RateBase::kMajorant, 1, true},
                                          {"global mean", TRK_METHOD_RESIDUAL, TRK_CHOICE_MEAN,
                                           ControlKind::kConstant, RateBase::kMajorant, 1, true},
                                          {"global min", TRK_METHOD_RESIDUAL, TRK_CHOICE_MIN,
                                           ControlKind::kConstant, RateBase::kMajorant, 1, true},
                                          {"global max", TRK_METHOD_RESIDUAL, TRK_CHOICE_MAX,
                                           ControlKind::kConstant, RateBase::kMajorant, 1, true},
                                          {"global mean, rms", TRK_METHOD_RESIDUAL, TRK_CHOICE_MEAN,
                                           ControlKind::kConstant, RateBase::kRms, 3, true}};

inline Way wayNamed(const std::string& name) {
    for (const std::vector<Way>* ways : {&kWays, &kGlobalWays}) {
        for (const Way& way : *ways) {
            if (way.name == name) {
                return way;
            }
        }
    }
    ADD_FAILURE() << "no way is named " << name;
    return {};
}

/// z beyond which one of `comparisons` true hypotheses falls with probability 0.01 [Sidak 1967].
inline double sidakBound(size_t comparisons) {
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
    std::array<double, 3> exactDepth;  ///< true optical depth, per channel
};

/// An opened volume at a scale where the rays that hit have a given mean optical depth in the first
/// channel.
struct Scene {
    trk::Volume volume;
    Way way;
    double depth;  ///< the mean one
    std::vector<PreparedRay> rays;

    Scene(const std::string& vdb, const std::string& sidecar, const Way& chosen, double meanDepth,
          size_t count, const std::array<float, 3>& color = {{1, 1, 1}})
        : way(chosen), depth(meanDepth) {
        trk::VolumeOptions options;
        options.choice = way.choice;
        options.global = way.global;
        options.color = color;
        const trk::Volume unscaled = trk::openVolume(vdb.c_str(), "", options);
        rays = prepare(unscaled, count);
        double sum = 0;
        for (const PreparedRay& ray : rays) {
            sum += ray.exactDepth[0];
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
            const auto clipped = volume.clip(ray, volume.field.box());
            if (!clipped) {
                continue;
            }
            PreparedRay prepared{clipped->local, clipped->lengthPerVoxel, {}};
            prepared.exactDepth = exactDepthOf(volume, prepared);
            if (prepared.exactDepth[0] > 0) {
                result.push_back(prepared);
            }
        }
        return result;
    }

    /// From the cells, not from the moments it is compared through.
    static std::array<double, 3> exactDepthOf(const trk::Volume& volume, const PreparedRay& ray) {
        std::array<double, 3> result{};
        trk::withVariant(volume, ControlKind::kConstant, [&](auto variant) {
            using V = decltype(variant);
            trk::PathCost cost;
            const auto depth = trk::exactOpticalDepth(typename V::Extinction(volume), ray.local,
                                                      ray.lengthPerVoxel, cost);
            std::copy(depth.begin(), depth.end(), result.begin());
        });
        return result;
    }

    trk::TrackingSettings settings(const PreparedRay& ray) const {
        trk::TrackingSettings s;
        s.lengthPerVoxel = ray.lengthPerVoxel;
        s.rateBase = way.rateBase;
        s.rate = way.rate;
        s.roulette = false;       // moments are known without
        s.exactFallback = false;  // where it sets in, nothing random is left to test
        return s;
    }

    /// Calls body(Variant, extinction, super-voxels) for the volume.
    template <class Body>
    void withFields(const Body& body) const {
        const bool controlMatters = way.method == TRK_METHOD_RESIDUAL;
        trk::withVariant(volume, controlMatters ? volume.tracked().kind() : ControlKind::kConstant,
                         [&](auto variant) {
                             using V = decltype(variant);
                             body(variant, typename V::Extinction(volume),
                                  typename V::Walk{volume.tracked()});
                         });
    }

    /// One estimate by the scene's way, per channel, those that are not there 0.
    std::array<double, 3> estimate(const PreparedRay& ray, const trk::TrackingSettings& s,
                                   trk::Rng& rng, trk::PathCost& cost) const {
        std::array<double, 3> result{};
        withFields([&](auto, const auto& field, const auto& superVoxels) {
            const auto estimate =
                way.method == TRK_METHOD_DELTA
                    ? trk::trackBinary(field, superVoxels, ray.local, s, rng, cost)
                : way.method == TRK_METHOD_RATIO ? trk::trackTransmittance<trk::NoControl>(
                                                       field, superVoxels, ray.local, s, rng, cost)
                                                 : trk::trackTransmittance<trk::ResidualControl>(
                                                       field, superVoxels, ray.local, s, rng, cost);
            std::copy(estimate.begin(), estimate.end(), result.begin());
        });
        return result;
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
    double length = 0;
};

template <class V, class Method>
Moments momentsOf(const Scene& scene, const PreparedRay& ray, size_t channel) {
    const trk::TrackingSettings settings = scene.settings(ray);
    const typename V::Extinction field(scene.volume);
    const typename V::Walk superVoxels{scene.volume.tracked()};
    const LocalRay& r = ray.local;
    const double unit = settings.lengthPerVoxel;
    double logMoment[5] = {0, 0, 0, 0, 0};
    Moments m;
    m.length = r.tEnd;
    superVoxels.walk(r, 0, r.tEnd, [&](const auto& v, double t0, double t1) {
        double rate = 0;
        for (size_t c = 0; c < V::kChannels; ++c) {
            rate = std::max(rate, Method::rate(v, c, settings.rateBase));
        }
        const bool hasResidual = Method::rate(v, channel, settings.rateBase) > 0;
        rate *= settings.rate;
        const auto extinction = [&](double t) { return field.extinction(r.at(t))[channel]; };
        m.lookups += rate * unit * (t1 - t0);
        if (!hasResidual) {
            for (int p = 1; p <= 4; ++p) {
                logMoment[p] -= p * unit * Method::integrate(v, channel, r, t0, t1);
            }
            return true;
        }
        for (int p = 1; p <= 4; ++p) {
            logMoment[p] +=
                unit * reference::integrateCells(r.origin, r.direction, t0, t1, [&](double t) {
                    const double control = Method::control(v, channel, r.at(t));
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

/// Moments of a number that is 1 with probability T and else 0, T from the cells.
inline Moments binaryMoments(const Scene& scene, const PreparedRay& ray, size_t channel) {
    Moments m;
    const double T = std::exp(-Scene::exactDepthOf(scene.volume, ray)[channel]);
    m.length = ray.local.tEnd;
    m.transmittance = T;
    m.variance = T * (1 - T);
    m.third = m.variance * (1 - 2 * T);
    m.fourth = m.variance * (1 - 6 * m.variance);
    return m;
}

inline Moments momentsOf(const Scene& scene, const PreparedRay& ray, size_t channel = 0) {
    if (scene.way.method == TRK_METHOD_DELTA) {
        return binaryMoments(scene, ray, channel);
    }
    Moments m;
    scene.withFields([&](auto variant, const auto&, const auto&) {
        using V = decltype(variant);
        m = scene.way.method == TRK_METHOD_RESIDUAL
                ? momentsOf<V, trk::ResidualControl>(scene, ray, channel)
                : momentsOf<V, trk::NoControl>(scene, ray, channel);
    });
    return m;
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
    double skewness = 0;
    double excessKurtosis = 0;
    double wholeKurtosis = 0;  ///< of the sum over whole rays
    double standardError = 0;

    bool isNormal() const { return excessKurtosis < 0.5 && std::fabs(skewness) < 0.35; }

    void add(const Scene& scene, const PreparedRay& ray, const Moments& m, size_t channel,
             double weight) {
        const double depth = Scene::exactDepthOf(scene.volume, ray)[channel];
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
/// that no number of samples tames on whole rays (at depth 10 the exact kurtosis of
/// `max` is astronomical, see what the test prints): there the same code, at the same scale, is
/// tested on as much of each ray as can be, rays weighing alike.
inline TestSet makeSet(const Scene& scene, uint64_t samples, size_t channel = 0) {
    TestSet whole;
    whole.samples = samples;
    double length = 0;
    for (const PreparedRay& ray : scene.rays) {
        const Moments m = momentsOf(scene, ray, channel);
        length += m.length;
        whole.add(scene, ray, m, channel, 1);
    }
    whole.summarize();
    if (whole.isNormal()) {
        return whole;
    }
    constexpr double kTail = 30;
    TestSet cut;
    cut.samples = samples;
    cut.wholeKurtosis = whole.excessKurtosis;
    double tested = 0;
    for (PreparedRay ray : scene.rays) {
        for (Moments m = momentsOf(scene, ray, channel);; m = momentsOf(scene, ray, channel)) {
            // Below, moments are the rounding error of a difference: nothing random is left.
            if (m.variance < 1e-7 * m.transmittance * m.transmittance) {
                break;
            }
            if (m.fourth < kTail * static_cast<double>(samples) * m.variance * m.variance) {
                tested += m.length;
                cut.add(scene, ray, m, channel, 1 / std::sqrt(m.variance));
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

}  // namespace estimates
