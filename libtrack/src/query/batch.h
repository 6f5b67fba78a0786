// SPDX-License-Identifier: Apache-2.0
// What queries of many rays share: checking them before any result is written, and running them.
#pragma once

#include "estimate/tracking.h"
#include "parallel.h"
#include "track/track.h"
#include "volume.h"

#include <tbb/task_arena.h>

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <type_traits>

namespace trk {

inline const TrkRay& rayAt(const TrkQuery& query, const TrkRay* rays, size_t i) {
    return *reinterpret_cast<const TrkRay*>(reinterpret_cast<const unsigned char*>(rays) +
                                            i * query.rayStride);
}

/// An array of the caller, or none. `width`: values a ray; `stride`: bytes from ray to ray, 0
/// for none in between.
template <class T>
class Array {
  public:
    Array() = default;
    Array(T* first, size_t width, size_t stride)
        : first_(first), stride_(stride == 0 ? width * sizeof(T) : stride) {}

    explicit operator bool() const { return first_ != nullptr; }
    T* at(size_t ray) const {
        return reinterpret_cast<T*>(reinterpret_cast<Byte*>(first_) + ray * stride_);
    }

  private:
    using Byte = std::conditional_t<std::is_const_v<T>, const unsigned char, unsigned char>;

    T* first_ = nullptr;
    size_t stride_ = 0;
};

inline uint64_t rayIdAt(const TrkQuery& query, size_t i) {
    return query.rayIds ? query.rayIds[i] : query.firstRayId + i;
}

inline TrackingSettings trackingSettings(const TrkQuery& query, double lengthPerVoxel) {
    TrackingSettings settings;
    settings.lengthPerVoxel = lengthPerVoxel;
    settings.rate = static_cast<double>(query.rate);
    settings.rateBase = query.rateBase == TRK_RATE_BASE_RMS ? RateBase::kRms : RateBase::kMajorant;
    settings.exactFallback = (query.flags & TRK_QUERY_EXACT_FALLBACK) != 0;
    settings.roulette = (query.flags & TRK_QUERY_ROULETTE) != 0;
    return settings;
}

/// Throws Error naming the first ray that is none.
void checkRays(const TrkQuery& query, const TrkRay* rays, size_t rayCount);

/// Throw Error, saying how to get it (and what else would do, `instead`), where the volume has no
/// density, or no super-voxels.
void requireDensity(const Volume& volume, const char* instead);
void requireSuperVoxels(const Volume& volume, const char* instead);

/// Runs body(begin, end) for parts of all rays: in this thread for one ray or one thread, else over
/// TBB.
template <class Body>
void forEachRange(const TrkQuery& query, size_t rayCount, const Body& body) {
    if (rayCount == 1 || query.threads == 1) {
        body(0, rayCount);
        return;
    }
    const auto run = [&] {
        // Isolated: a thread that waits here must not pick up a task of the caller's, who may hold
        // locks.
        tbb::this_task_arena::isolate([&] { parallelRanges(rayCount, 64, body); });
    };
    if (query.threads == 0) {
        run();
    } else {
        // More than the machine has would only make TBB print a warning.
        const int most = tbb::this_task_arena::max_concurrency();
        tbb::task_arena(std::min(query.threads, most)).execute(run);
    }
}

/// Runs body(i) for every ray, in the same way.
template <class Body>
void forEachRay(const TrkQuery& query, size_t rayCount, const Body& body) {
    forEachRange(query, rayCount, [&](size_t begin, size_t end) {
        for (size_t i = begin; i != end; ++i) {
            body(i);
        }
    });
}

}  // namespace trk
