// SPDX-License-Identifier: Apache-2.0
#include "transmittance.h"

#include "batch.h"
#include "estimate/exact.h"
#include "estimate/free_path.h"
#include "estimate/ratio_tracking.h"
#include "estimate/ray_marching.h"
#include "estimate/rng.h"
#include "failure.h"
#include "variant.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <string>

namespace trk {
namespace {

void checkMethod(const Volume& volume, const TrkQuery& query) {
    if (query.method != TRK_METHOD_CONTROL) {
        requireDensity(volume, "; or use TRK_METHOD_CONTROL");
    }
    if (query.method != TRK_METHOD_EXACT && query.method != TRK_METHOD_MARCH) {
        requireSuperVoxels(volume,
                           query.method == TRK_METHOD_CONTROL ? "" : ", or use TRK_METHOD_EXACT");
    }
    if (query.method == TRK_METHOD_CONTROL && query.level > volume.superVoxels.levelCount()) {
        throw Error(TRK_ERROR_INVALID_ARGUMENT,
                    "level " + std::to_string(query.level) + ": expected 0 to " +
                        std::to_string(volume.superVoxels.levelCount()) +
                        ", the levels of this sidecar");
    }
}

/// Optical depth by a method without noise.
template <class V>
std::array<double, V::kChannels> deterministicDepth(const Volume& volume, const TrkQuery& query,
                                                    const TrkRay& ray, double& clippedLength,
                                                    PathCost& cost) {
    const bool exact = query.method == TRK_METHOD_EXACT;
    const auto clipped =
        volume.clip(ray, exact ? volume.field->box() : volume.superVoxels.box(query.level));
    if (!clipped) {
        return {};
    }
    clippedLength = clipped->local.tEnd;
    if (exact) {
        return exactOpticalDepth(typename V::Extinction(volume), clipped->local,
                                 clipped->lengthPerVoxel, cost);
    }
    auto depth =
        V::integrateControl(volume.superVoxels, clipped->local, query.level, cost.superVoxels);
    for (double& d : depth) {
        d *= clipped->lengthPerVoxel;
    }
    return depth;
}

constexpr double kNaN = std::numeric_limits<double>::quiet_NaN();

/// Mean and standard error of the estimates of one ray, per channel. The error is NaN where it is
/// not known.
template <size_t C>
struct Estimate {
    std::array<double, C> mean;
    std::array<double, C> standardError;
};

/// Of query.samples estimates, each what `estimateOnce(rng)` answers; it adds to `cost`.
template <size_t C, class EstimateOnce>
Estimate<C> averageSamples(const TrkQuery& query, uint64_t rayId, const PathCost& cost,
                           const EstimateOnce& estimateOnce) {
    Estimate<C> result{};
    // Sums of squared deviations, updated without cancellation [Welford 1962].
    std::array<double, C> squares{};
    for (uint32_t i = 0; i < query.samples; ++i) {
        Rng rng(query.seed, query.stream, rayId, i);
        const std::array<double, C> estimate = estimateOnce(rng);
        for (size_t c = 0; c < C; ++c) {
            const double delta = estimate[c] - result.mean[c];
            result.mean[c] += delta / (i + 1.0);
            squares[c] += delta * (estimate[c] - result.mean[c]);
        }
    }
    const double n = query.samples;
    for (size_t c = 0; c < C; ++c) {
        // That random estimates agree says little: only a larger number of them would differ.
        result.standardError[c] = squares[c] > 0 ? std::sqrt(squares[c] / (n * (n - 1)))
                                  : cost.random  ? kNaN
                                                 : 0.0;
    }
    return result;
}

/// Of a random method.
template <class V>
Estimate<V::kChannels> estimateRandomly(const Volume& volume, const TrkQuery& query,
                                        const ClippedRay& clipped, uint64_t rayId, PathCost& cost) {
    constexpr size_t C = V::kChannels;
    const TrackingSettings settings = trackingSettings(query, clipped.lengthPerVoxel);
    const LocalRay& ray = clipped.local;
    const typename V::Extinction extinction(volume);
    const typename V::Walk superVoxels{volume.tracked()};
    const auto average = [&](const auto& estimateOnce) {
        return averageSamples<C>(query, rayId, cost, estimateOnce);
    };
    switch (query.method) {
        case TRK_METHOD_RESIDUAL:
            return average([&](Rng& rng) {
                return trackTransmittance<ResidualControl>(extinction, superVoxels, ray, settings,
                                                           rng, cost);
            });
        case TRK_METHOD_RATIO:
            return average([&](Rng& rng) {
                return trackTransmittance<NoControl>(extinction, superVoxels, ray, settings, rng,
                                                     cost);
            });
        case TRK_METHOD_DELTA:
            return average([&](Rng& rng) {
                return trackBinary(extinction, superVoxels, ray, settings, rng, cost);
            });
        default:  // TRK_METHOD_MARCH
            return average([&](Rng& rng) {
                auto result = marchOpticalDepth(extinction, ray, settings.lengthPerVoxel,
                                                static_cast<double>(query.step), rng, cost);
                for (double& value : result) {
                    value = std::exp(-value);
                }
                return result;
            });
    }
}

float toFloat(double value) {
    constexpr double kLimit = static_cast<double>(std::numeric_limits<float>::max());
    return static_cast<float>(std::fmin(std::fmax(value, -kLimit), kLimit));
}

template <class V>
void estimateRay(const Volume& volume, const TrkQuery& query, const TrkRay& ray, size_t i,
                 const Array<float>& transmittance, const StatisticsOutput& statistics) {
    constexpr size_t C = V::kChannels;
    PathCost cost;
    double clippedLength = 0;
    double samples = 1;
    Estimate<C> estimate;
    estimate.mean.fill(1);
    estimate.standardError.fill(0);  // of a ray that misses the volume, whatever the method
    if (query.method == TRK_METHOD_EXACT || query.method == TRK_METHOD_CONTROL) {
        const auto depth = deterministicDepth<V>(volume, query, ray, clippedLength, cost);
        for (size_t c = 0; c < C; ++c) {
            estimate.mean[c] = std::exp(-depth[c]);
        }
    } else if (const auto clipped = volume.clip(ray, volume.field->box())) {
        clippedLength = clipped->local.tEnd;
        samples = query.samples;
        estimate = estimateRandomly<V>(volume, query, *clipped, rayIdAt(query, i), cost);
    }
    const bool biased = query.method == TRK_METHOD_CONTROL || query.method == TRK_METHOD_MARCH;
    if (biased && clippedLength > 0) {
        estimate.standardError.fill(kNaN);
    }
    for (size_t c = 0; c < C; ++c) {
        if (volume.scales[c] == 0) {  // exactly 1, whatever the other channels met
            estimate.standardError[c] = 0;
        }
    }
    std::transform(estimate.mean.begin(), estimate.mean.end(), transmittance.at(i), toFloat);
    if (statistics.standardError) {
        std::transform(estimate.standardError.begin(), estimate.standardError.end(),
                       statistics.standardError.at(i), roundedError);
    }
    if (statistics.lookups) {
        *statistics.lookups.at(i) = cost.lookups;
    }
    if (statistics.superVoxels) {
        *statistics.superVoxels.at(i) = cost.superVoxels;
    }
    if (statistics.exactShare) {
        *statistics.exactShare.at(i) =
            clippedLength > 0 ? static_cast<float>(cost.exactLength / (samples * clippedLength))
                              : 0.0f;
    }
}

}  // namespace

float roundedError(double value) {
    const auto error = static_cast<float>(value);
    return value > 0 ? std::max(error, std::numeric_limits<float>::min()) : error;
}

void estimateTransmittance(const Volume& volume, const TrkQuery& query, const TrkRay* rays,
                           size_t rayCount, const Array<float>& transmittance,
                           const StatisticsOutput& statistics) {
    checkMethod(volume, query);
    checkRays(query, rays, rayCount);
    const ControlKind kind = query.method == TRK_METHOD_RESIDUAL  ? volume.tracked().kind()
                             : query.method == TRK_METHOD_CONTROL ? volume.superVoxels.kind()
                                                                  : ControlKind::kConstant;
    withVariant(volume, kind, [&](auto variant) {
        using V = decltype(variant);
        forEachRay(query, rayCount, [&](size_t i) {
            estimateRay<V>(volume, query, rayAt(query, rays, i), i, transmittance, statistics);
        });
    });
}

void integrateOpticalDepth(const Volume& volume, const TrkQuery& query, const TrkRay* rays,
                           size_t rayCount, const Array<double>& opticalDepth) {
    checkMethod(volume, query);
    checkRays(query, rays, rayCount);
    const ControlKind kind =
        query.method == TRK_METHOD_CONTROL ? volume.superVoxels.kind() : ControlKind::kConstant;
    withVariant(volume, kind, [&](auto variant) {
        using V = decltype(variant);
        forEachRay(query, rayCount, [&](size_t i) {
            PathCost cost;
            double clippedLength = 0;
            const auto depth =
                deterministicDepth<V>(volume, query, rayAt(query, rays, i), clippedLength, cost);
            std::copy(depth.begin(), depth.end(), opticalDepth.at(i));
        });
    });
}

}  // namespace trk
