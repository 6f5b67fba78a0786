// SPDX-License-Identifier: Apache-2.0
#include "transmittance.h"

#include "batch.h"
#include "estimate/comb.h"
#include "estimate/exact.h"
#include "estimate/free_path.h"
#include "estimate/ray_marching.h"
#include "estimate/rng.h"
#include "failure.h"
#include "flight.h"
#include "kernel.h"
#include "methods.h"
#include "ray_output.h"
#include "variant.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <string>

namespace trk {
namespace {

void checkMethod(const Volume& volume, const TrkQuery& query) {
    const MethodTraits& method = traitsOf(query.method);
    if (method.usesDensity) {
        requireDensity(volume, "; or use TRK_METHOD_CONTROL");
    }
    if (method.usesSuperVoxels) {
        requireSuperVoxels(volume, method.usesDensity ? ", or use TRK_METHOD_EXACT" : "");
    }
    if (method.hasLevels() && query.level > volume.superVoxels->levelCount()) {
        throw Error(TRK_ERROR_INVALID_ARGUMENT,
                    "level " + std::to_string(query.level) + ": expected 0 to " +
                        std::to_string(volume.superVoxels->levelCount()) +
                        ", the levels of this sidecar");
    }
}

/// Of the super-voxels that a query walks, where their control is looked at.
ControlKind controlKind(const Volume& volume, const TrkQuery& query) {
    const MethodTraits& method = traitsOf(query.method);
    return method.usesChoice()  ? volume.tracked().kind()
           : method.hasLevels() ? volume.superVoxels->kind()
                                : ControlKind::kConstant;
}

/// Optical depth by a method without noise.
template <class V>
std::array<double, V::kChannels> deterministicDepth(const Volume& volume, const TrkQuery& query,
                                                    const TrkRay& ray, double& clippedLength,
                                                    PathCost& cost) {
    const bool exact = traitsOf(query.method).isUnbiased;
    const auto clipped =
        volume.clip(ray, exact ? volume.field->box() : volume.superVoxels->box(query.level));
    if (!clipped) {
        return {};
    }
    clippedLength = clipped->local.tEnd;
    if (exact) {
        return exactOpticalDepth(typename V::Extinction(volume), clipped->local,
                                 clipped->lengthPerVoxel, cost);
    }
    auto depth = V::integrateControl(volume, clipped->local, query.level, cost.superVoxels);
    for (double& d : depth) {
        d *= clipped->lengthPerVoxel;
    }
    return depth;
}

/// By a random method that takes one ray at a time: delta tracking, marching and combs.
template <class V>
Estimate<V::kChannels> estimateRandomly(const Volume& volume, const TrkQuery& query,
                                        const ClippedRay& clipped, uint64_t rayId, PathCost& cost) {
    constexpr size_t C = V::kChannels;
    const TrackingSettings settings = trackingSettings(query, clipped.lengthPerVoxel);
    const LocalRay& ray = clipped.local;
    const typename V::Extinction extinction(volume);
    SampleMean<C> mean;
    if (query.method == TRK_METHOD_DELTA) {
        const typename V::Walk superVoxels(volume);
        trackBinary(
            extinction, superVoxels, ray, settings, query.samples,
            [&](uint32_t sample) { return Rng(query.seed, query.stream, rayId, sample); }, cost,
            [&](const std::array<double, C>& passes) { mean.add(passes); });
        return mean.result(cost.random);
    }
    for (uint32_t i = 0; i < query.samples; ++i) {
        Rng rng(query.seed, query.stream, rayId, i);
        if (query.method == TRK_METHOD_COMB) {
            mean.add(combTransmittance(extinction, typename V::Walk(volume), ray, settings,
                                       static_cast<double>(query.step), rng, cost));
            continue;
        }
        auto depth = marchOpticalDepth(extinction, ray, settings.lengthPerVoxel,
                                       static_cast<double>(query.step), rng, cost);
        for (double& value : depth) {
            value = std::exp(-value);
        }
        mean.add(depth);
    }
    return mean.result(cost.random);
}

/// By any method but ratio tracking.
template <class V>
void estimateRay(const Volume& volume, const TrkQuery& query, const TrkRay& ray, size_t i,
                 const RayOutput<V>& output) {
    PathCost cost;
    if (!traitsOf(query.method).isRandom) {
        double clippedLength = 0;
        const auto depth = deterministicDepth<V>(volume, query, ray, clippedLength, cost);
        Estimate<V::kChannels> estimate{};
        for (size_t c = 0; c < V::kChannels; ++c) {
            estimate.mean[c] = std::exp(-depth[c]);
        }
        output.write(i, estimate, cost, clippedLength, 1);
    } else if constexpr (V::kKind == ControlKind::kConstant) {
        if (const auto clipped = volume.clip(ray, volume.field->box())) {
            const auto estimate =
                estimateRandomly<V>(volume, query, *clipped, rayIdAt(query, i), cost);
            output.write(i, estimate, cost, clipped->local.tEnd, query.samples);
        } else {
            output.writeMiss(i);
        }
    }
}

template <class V>
void estimateRange(const Volume& volume, const TrkQuery& query, const TrkRay* rays, size_t begin,
                   size_t end, const RayOutput<V>& output) {
    const MethodTraits& method = traitsOf(query.method);
    if (method.usesRate && method.usesControl) {
        Flight<V, Control::kChosen>(volume, query).estimate(rays, begin, end, output);
        return;
    }
    if constexpr (V::kKind == ControlKind::kConstant) {  // or none is looked at: see controlKind
        if (method.usesRate && method.usesRoulette) {
            Flight<V, Control::kNone>(volume, query).estimate(rays, begin, end, output);
            return;
        }
    }
    for (size_t i = begin; i < end; ++i) {
        estimateRay(volume, query, rayAt(query, rays, i), i, output);
    }
}
#ifdef TRACK_AVX2
template <class V>
TRACK_AVX2 void estimateRangeAvx2(const Volume& volume, const TrkQuery& query, const TrkRay* rays,
                                  size_t begin, size_t end, const RayOutput<V>& output) {
    estimateRange(volume, query, rays, begin, end, output);
}
#endif

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
    const ControlKind kind = controlKind(volume, query);
    withVariant(volume, kind, [&](auto variant) {
        using V = decltype(variant);
        const RayOutput<V> output(volume, query, transmittance, statistics);
        forEachRange(query, rayCount, [&](size_t begin, size_t end) {
#ifdef TRACK_AVX2
            if (volume.options.kernel == Kernel::kAvx2) {
                estimateRangeAvx2(volume, query, rays, begin, end, output);
                return;
            }
#endif
            estimateRange(volume, query, rays, begin, end, output);
        });
    });
}

void integrateOpticalDepth(const Volume& volume, const TrkQuery& query, const TrkRay* rays,
                           size_t rayCount, const Array<double>& opticalDepth) {
    checkMethod(volume, query);
    checkRays(query, rays, rayCount);
    const ControlKind kind = controlKind(volume, query);
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
