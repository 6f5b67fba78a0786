// SPDX-License-Identifier: Apache-2.0
#include "sampling.h"

#include "batch.h"
#include "estimate/free_path.h"
#include "estimate/rng.h"
#include "failure.h"
#include "variant.h"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <string>

namespace trk {
namespace {

template <class V>
void sampleOne(const Volume& volume, const TrkQuery& query, const TrkRay& ray, size_t i,
               const FreePathOutput& out) {
    constexpr size_t C = V::kChannels;
    PathCost cost;
    FreePath<C> path;
    const auto clipped = volume.clip(ray, volume.field->box());
    if (clipped) {
        TrackingSettings settings = trackingSettings(query, clipped->lengthPerVoxel);
        settings.wantsExtinction = static_cast<bool>(out.extinction);
        const typename V::Extinction extinction(volume);
        const typename V::Walk superVoxels(volume);
        Rng rng(query.seed, query.stream, rayIdAt(query, i), 0, Purpose::kFreePath);
        path = query.method == TRK_METHOD_DELTA
                   ? sampleFreePath<false>(extinction, superVoxels, clipped->local, settings, rng,
                                           cost)
                   : sampleFreePath<true>(extinction, superVoxels, clipped->local, settings, rng,
                                          cost);
    }
    float& t = *out.t.at(i);
    t = std::numeric_limits<float>::infinity();
    if (path.collided) {
        // Finite, as infinity says that it escapes.
        constexpr auto kLargest = static_cast<double>(std::numeric_limits<float>::max());
        const double at =
            std::min(std::max(clipped->tStart + path.t * clipped->tPerVoxel, -kLargest), kLargest);
        t = std::min(std::max(static_cast<float>(at), ray.tMin), ray.tMax);
    }
    const auto toFloat = [](double value) { return static_cast<float>(value); };
    if (out.weight) {
        std::transform(path.weight.begin(), path.weight.end(), out.weight.at(i), toFloat);
    }
    if (out.extinction) {
        std::transform(path.extinction.begin(), path.extinction.end(), out.extinction.at(i),
                       toFloat);
    }
    if (out.lookups) {
        *out.lookups.at(i) = static_cast<uint32_t>(
            std::min<uint64_t>(cost.lookups, std::numeric_limits<uint32_t>::max()));
    }
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
                     size_t rayCount, const FreePathOutput& paths) {
    requireDensity(volume, "");
    requireSuperVoxels(volume, "");
    checkRays(query, rays, rayCount);
    withVariant(volume, ControlKind::kConstant, [&](auto variant) {
        using V = decltype(variant);
        forEachRay(query, rayCount,
                   [&](size_t i) { sampleOne<V>(volume, query, rayAt(query, rays, i), i, paths); });
    });
}

void sampleExtinction(const Volume& volume, const Array<const float>& points, size_t pointCount,
                      const Array<float>& extinction) {
    requireDensity(volume, "");
    for (size_t i = 0; i < pointCount; ++i) {
        const float* p = points.at(i);
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
            const float* p = points.at(i);
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
            std::transform(value.begin(), value.end(), extinction.at(i),
                           [](double v) { return static_cast<float>(v); });
        }
    });
}

}  // namespace trk
