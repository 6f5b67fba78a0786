// SPDX-License-Identifier: Apache-2.0
#include "predicted_variance.h"

#include "estimate/ratio_tracking.h"
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

template <size_t C, class Method, class View>
double rateOf(const View& v, const trk::TrackingSettings& settings) {
    double rate = 0;
    for (size_t c = 0; c < C; ++c) {
        rate = std::max(rate, settings.rate * Method::rate(v, c, settings.rateBase));
    }
    return rate;
}
double expectedLookups(double rate, const trk::TrackingSettings& settings, double voxels) {
    return rate * settings.lengthPerVoxel * voxels;
}
/// Beyond which a super-voxel is integrated exactly.
double mostLookups(const trk::TrackingSettings& settings, const trk::LocalRay& ray, double voxels) {
    return settings.exactFallback ? trk::ExactCost(ray)(voxels) : trk::kMostLookups;
}

template <class V, class Method>
PredictedCost costOf(const Volume& volume, const TrkQuery& query, const trk::ClippedRay& clipped) {
    const trk::TrackingSettings settings = trk::trackingSettings(query, clipped.lengthPerVoxel);
    const trk::LocalRay& ray = clipped.local;
    PredictedCost cost;
    typename V::Walk{volume.tracked()}.walk(
        ray, 0, ray.tEnd, [&](const auto& v, double t0, double t1) {
            const double lookups =
                expectedLookups(rateOf<V::kChannels, Method>(v, settings), settings, t1 - t0);
            const bool tracked = lookups <= mostLookups(settings, ray, t1 - t0);
            cost.estimate += tracked ? lookups : trk::ExactCost(ray)(t1 - t0);
            cost.exact += trk::ExactCost(ray)(t1 - t0);
            return true;
        });
    return cost;
}

/// Per channel, the integral of residual^2 / rate over what is tracked.
template <class V, class Method>
std::array<double, V::kChannels> integrateNoise(const Volume& volume, const TrkQuery& query,
                                                const trk::ClippedRay& clipped) {
    constexpr size_t C = V::kChannels;
    const trk::TrackingSettings settings = trk::trackingSettings(query, clipped.lengthPerVoxel);
    const typename V::Extinction field(volume);
    const typename V::Walk superVoxels{volume.tracked()};
    const trk::LocalRay& ray = clipped.local;
    std::array<double, C> sum{};
    superVoxels.walk(ray, 0, ray.tEnd, [&](const auto& v, double t0, double t1) {
        const double rate = rateOf<C, Method>(v, settings);
        if (rate == 0 ||
            expectedLookups(rate, settings, t1 - t0) > mostLookups(settings, ray, t1 - t0)) {
            return true;
        }
        const auto add = [&](double a, double b, bool empty) {
            for (size_t c = 0; c < C; ++c) {
                if (C == 1 || Method::rate(v, c, settings.rateBase) > 0) {
                    sum[c] += settings.lengthPerVoxel / rate * integrateGauss(a, b, [&](double t) {
                                  const trk::Vec3d p = ray.at(t);
                                  const double mu = empty ? 0 : field.extinction(p)[c];
                                  const double residual = mu - Method::control(v, c, p);
                                  return residual * residual;
                              });
                }
            }
        };
        double done = t0;
        field.forEachCell(ray, t0, t1, [&](double tEnter, double tExit, const auto&) {
            if (tEnter > done) {
                add(done, tEnter, true);  // nothing there, but perhaps a control
            }
            add(tEnter, tExit, false);
            done = tExit;
            return true;
        });
        if (t1 > done) {
            add(done, t1, true);
        }
        return true;
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
                residual ? integrateNoise<V, trk::ResidualControl>(volume, query, *clipped)
                         : integrateNoise<V, trk::NoControl>(volume, query, *clipped);
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
                cost = residual ? costOf<V, trk::ResidualControl>(volume, query, *clipped)
                                : costOf<V, trk::NoControl>(volume, query, *clipped);
            });
    }
    return cost;
}

}  // namespace vdbtools
