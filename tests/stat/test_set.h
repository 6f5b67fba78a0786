// SPDX-License-Identifier: Apache-2.0
// Sets of rays whose estimates are fit for a z-test: exact moments, tails, standard errors.
#pragma once

#include "estimate/ratio_tracking.h"
#include "estimate/rng.h"
#include "measure/sweep.h"
#include "query/variant.h"
#include "volume.h"

#include <gtest/gtest.h>

#include <array>
#include <cmath>
#include <cstdint>
#include <map>
#include <string>
#include <utility>
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

Way wayNamed(const std::string& name);

using vdbtools::sidakBound;

struct PreparedRay {
    LocalRay local;
    double lengthPerVoxel;
    std::array<double, 3> exactDepth;  ///< true optical depth, per channel
};

/// A density, loaded once, and its bakes, each made once.
class Medium {
  public:
    Medium(std::string name, const std::string& vdb);

    const trk::BakedVolume& bake(int size, ControlKind kind) const;

    std::string label;
    vdbtools::Source source;

  private:
    mutable std::map<std::pair<int, ControlKind>, trk::BakedVolume> bakes_;
};

/// A volume at a scale where the rays that hit have a given mean optical depth in the first
/// channel.
struct Scene {
    trk::Volume volume;
    Way way;
    double depth;  ///< the mean one
    std::vector<PreparedRay> rays;

    /// `count` rays that hit; super-voxels of `size`, with the way's kind of control.
    Scene(const Medium& medium, int size, const Way& chosen, double meanDepth, size_t count,
          const std::array<float, 3>& color = {{1, 1, 1}});

    /// From the cells, not from the moments it is compared through.
    static std::array<double, 3> exactDepthOf(const trk::Volume& volume, const PreparedRay& ray);

    /// Of a walk without roulette and exact integration.
    trk::TrackingSettings settings(const PreparedRay& ray) const;

    /// Calls body(Variant, extinction, super-voxels) for the volume.
    template <class Body>
    void withFields(const Body& body) const {
        const bool controlMatters = way.method == TRK_METHOD_RESIDUAL;
        trk::withVariant(volume, controlMatters ? volume.tracked().kind() : ControlKind::kConstant,
                         [&](auto variant) {
                             using V = decltype(variant);
                             body(variant, typename V::Extinction(volume),
                                  typename V::Walk(volume));
                         });
    }

    /// One estimate by the scene's way, per channel, those that are not there 0.
    std::array<double, 3> estimate(const PreparedRay& ray, const trk::TrackingSettings& s,
                                   trk::Rng& rng, trk::PathCost& cost) const;
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

Moments momentsOf(const Scene& scene, const PreparedRay& ray, size_t channel = 0);

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
TestSet makeSet(const Scene& scene, uint64_t samples, size_t channel = 0);

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
