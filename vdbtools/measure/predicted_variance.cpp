// SPDX-License-Identifier: Apache-2.0
#include "predicted_variance.h"

#include "estimate/plan.h"
#include "query/batch.h"
#include "query/methods.h"
#include "query/variant.h"
#include "sweep_rays.h"

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <limits>
#include <vector>

namespace vdbtools {
namespace {

using trk::ControlKind;
using trk::Volume;

/// T^2 (exp(noise) - 1). Where there is noise it is not 0, however deep.
double varianceOf(double depth, double noise) {
    if (noise == 0) {
        return 0;
    }
    // Together where it is large, as the second factor alone may be too large.
    const double variance = noise > 1 ? std::exp(noise - 2 * depth) - std::exp(-2 * depth)
                                      : std::exp(-2 * depth) * std::expm1(noise);
    return std::max(variance, std::numeric_limits<double>::min());
}

/// Integral of g over [t0, t1] by four Gauss points: exact for polynomials of degree 7.
template <class G>
double integrateGauss(double t0, double t1, const G& g) {
    constexpr double kNodes[2] = {0.33998104358485626480, 0.86113631159405257522};
    constexpr double kWeights[2] = {0.65214515486254614263, 0.34785484513745385737};
    const double half = 0.5 * (t1 - t0);
    const double middle = 0.5 * (t1 + t0);
    double sum = 0;
    for (int i = 0; i < 2; ++i) {
        sum += kWeights[i] * (g(middle - half * kNodes[i]) + g(middle + half * kNodes[i]));
    }
    return half * sum;
}

template <class V, trk::Control kControl>
PredictedCost costOf(const Volume& volume, const TrkQuery& query, const trk::ClippedRay& clipped) {
    const trk::TrackingSettings settings = trk::trackingSettings(query, clipped.lengthPerVoxel);
    const trk::ExactCost exactCost(clipped.local);
    PredictedCost cost;
    trk::forEachStretch<kControl>(typename V::Walk(volume), clipped.local, settings,
                                  [&](const auto& plan, size_t i) {
                                      const double exact = exactCost(plan.length(i));
                                      cost.estimate += plan.isExact(i) ? exact : plan.collisions(i);
                                      cost.exact += exact;
                                  });
    return cost;
}

/// Per channel, the integral of residual^2 / rate over what is tracked.
template <class V, trk::Control kControl>
std::array<double, V::kChannels> integrateNoise(const Volume& volume, const TrkQuery& query,
                                                const trk::ClippedRay& clipped) {
    constexpr size_t C = V::kChannels;
    const trk::TrackingSettings settings = trk::trackingSettings(query, clipped.lengthPerVoxel);
    const typename V::Extinction field(volume);
    const trk::LocalRay& ray = clipped.local;
    const double unit = settings.lengthPerVoxel;
    std::array<double, C> sum{};
    trk::forEachStretch<kControl>(
        typename V::Walk(volume), ray, settings, [&](const auto& plan, size_t i) {
            if (plan.rate(i) == 0 || plan.isExact(i)) {
                return;
            }
            const auto add = [&](double a, double b, bool empty) {
                for (size_t c = 0; c < C; ++c) {
                    if (plan.isTracked(i, c)) {
                        sum[c] += unit * unit / plan.rate(i) * integrateGauss(a, b, [&](double t) {
                                      const trk::Vec3d p = ray.at(t);
                                      const double mu = empty ? 0 : field.extinction(p)[c];
                                      const double residual = mu - plan.control(i, c, p);
                                      return residual * residual;
                                  });
                    }
                }
            };
            double done = plan.tEnter(i);
            field.forEachCell(ray, done, plan.tExit(i),
                              [&](double tEnter, double tExit, const auto&) {
                                  if (tEnter > done) {
                                      add(done, tEnter, true);  // nothing, but perhaps a control
                                  }
                                  add(tEnter, tExit, false);
                                  done = tExit;
                                  return true;
                              });
            if (plan.tExit(i) > done) {
                add(done, plan.tExit(i), true);
            }
        });
    return sum;
}

}  // namespace

std::array<double, 3> predictVariance(const Volume& volume, const TrkQuery& query,
                                      const TrkRay& ray) {
    std::array<double, 3> result{};
    const auto clipped = volume.clip(ray, volume.field->box());
    if (!clipped) {
        return result;
    }
    const std::vector<double> depth = exactOpticalDepths(volume, {ray});
    if (query.method == TRK_METHOD_DELTA) {
        for (size_t c = 0; c < depth.size(); ++c) {
            result[c] = varianceOf(depth[c], depth[c]);  // T (1 - T)
        }
        return result;
    }
    const bool residual = trk::traitsOf(query.method).usesControl;
    trk::withVariant(
        volume, residual ? volume.tracked().kind() : ControlKind::kConstant, [&](auto variant) {
            using V = decltype(variant);
            const auto noise =
                residual ? integrateNoise<V, trk::Control::kChosen>(volume, query, *clipped)
                         : integrateNoise<V, trk::Control::kNone>(volume, query, *clipped);
            for (size_t c = 0; c < V::kChannels; ++c) {
                result[c] = varianceOf(depth[c], noise[c]);
            }
        });
    return result;
}

PredictedCost predictCost(const Volume& volume, const TrkQuery& query, const TrkRay& ray) {
    PredictedCost cost;
    if (const auto clipped = volume.clip(ray, volume.field->box())) {
        const bool residual = trk::traitsOf(query.method).usesControl;
        trk::withVariant(
            volume, residual ? volume.tracked().kind() : ControlKind::kConstant, [&](auto variant) {
                using V = decltype(variant);
                cost = residual ? costOf<V, trk::Control::kChosen>(volume, query, *clipped)
                                : costOf<V, trk::Control::kNone>(volume, query, *clipped);
            });
    }
    return cost;
}

}  // namespace vdbtools
