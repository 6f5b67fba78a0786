// SPDX-License-Identifier: Apache-2.0
#include "sampling.h"

#include "batch.h"
#include "error.h"
#include "estimators/free_path.h"
#include "rng.h"
#include "variant.h"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <string>

namespace trk {
namespace {

template <class V>
TrkFreePath sampleOne(const Volume& volume, const TrkQuery& query, const TrkRay& ray,
                      uint64_t rayId) {
    constexpr size_t C = V::kChannels;
    PathCost cost;
    FreePath<C> path;
    const auto clipped = volume.clip(ray, volume.field->box());
    if (clipped) {
        const TrackingSettings settings = trackingSettings(query, clipped->lengthPerVoxel);
        const typename V::Extinction extinction(volume);
        const typename V::Walk superVoxels{volume.tracked()};
        Rng rng(query.seed, query.stream, rayId, 0, Purpose::kFreePath);
        path = query.method == TRK_METHOD_DELTA
                   ? sampleFreePath<false>(extinction, superVoxels, clipped->local, settings, rng,
                                           cost)
                   : sampleFreePath<true>(extinction, superVoxels, clipped->local, settings, rng,
                                          cost);
    }
    TrkFreePath result;
    result.t = std::numeric_limits<float>::infinity();
    if (path.collided) {
        // Finite, as infinity says that it escapes.
        const double t = std::min(clipped->tStart + path.t * clipped->tPerVoxel,
                                  static_cast<double>(std::numeric_limits<float>::max()));
        result.t = std::min(std::max(static_cast<float>(t), ray.tMin), ray.tMax);
    }
    for (size_t c = 0; c < 3; ++c) {
        result.weight[c] = static_cast<float>(path.weight[C == 1 ? 0 : c]);
        result.extinction[c] = (query.flags & TRK_QUERY_EXTINCTION) == 0
                                   ? 0.0f
                                   : static_cast<float>(path.extinction[C == 1 ? 0 : c]);
    }
    result.lookups = static_cast<uint32_t>(
        std::min<uint64_t>(cost.lookups, std::numeric_limits<uint32_t>::max()));
    return result;
}

bool contains(const IntBox& box, const Vec3d& point) {
    for (int a = 0; a < 3; ++a) {
        const auto axis = static_cast<size_t>(a);
        if (!(point[a] >= static_cast<double>(box.lo[axis]) &&
              point[a] <= static_cast<double>(box.hi[axis]))) {
            return false;
        }
    }
    return !box.empty();
}

}  // namespace

void sampleFreePaths(const Volume& volume, const TrkQuery& query, const TrkRay* rays,
                     size_t rayCount, TrkFreePath* results) {
    requireDensity(volume);
    requireSuperVoxels(volume);
    checkRays(query, rays, rayCount);
    withVariant(volume, ControlKind::kConstant, [&](auto variant) {
        using V = decltype(variant);
        forEachRay(query, rayCount, [&](size_t i) {
            results[i] = sampleOne<V>(volume, query, rayAt(query, rays, i), rayIdAt(query, i));
        });
    });
}

void sampleExtinction(const Volume& volume, const float* points, size_t pointStride,
                      size_t pointCount, float* extinction) {
    requireDensity(volume);
    const auto pointAt = [&](size_t i) {
        return reinterpret_cast<const float*>(reinterpret_cast<const unsigned char*>(points) +
                                              i * pointStride);
    };
    for (size_t i = 0; i < pointCount; ++i) {
        const float* p = pointAt(i);
        if (!std::isfinite(p[0]) || !std::isfinite(p[1]) || !std::isfinite(p[2])) {
            throw Error(TRK_ERROR_INVALID_ARGUMENT,
                        "point " + std::to_string(i) + ": expected finite coordinates");
        }
    }
    withVariant(volume, ControlKind::kConstant, [&](auto variant) {
        using V = decltype(variant);
        constexpr size_t C = V::kChannels;
        const typename V::Extinction field(volume);
        for (size_t i = 0; i < pointCount; ++i) {
            const float* p = pointAt(i);
            Vec3d local =
                volume.worldToIndex.point({{static_cast<double>(p[0]), static_cast<double>(p[1]),
                                            static_cast<double>(p[2])}});
            for (int a = 0; a < 3; ++a) {
                local[a] -= static_cast<double>(volume.anchor[static_cast<size_t>(a)]);
            }
            std::array<double, C> value{};
            if (contains(volume.field->box(), local)) {
                value = field.extinction(local);
            }
            std::transform(value.begin(), value.end(), extinction + i * C,
                           [](double v) { return static_cast<float>(v); });
        }
    });
}

}  // namespace trk
