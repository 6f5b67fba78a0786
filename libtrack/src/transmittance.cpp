// SPDX-License-Identifier: Apache-2.0
#include "transmittance.h"

#include "error.h"
#include "estimators/exact.h"
#include "estimators/ratio_tracking.h"
#include "rng.h"

#include <tbb/blocked_range.h>
#include <tbb/parallel_for.h>
#include <tbb/task_arena.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <string>

namespace trk {
namespace {

const TrkRay& rayAt(const TrkQuery& query, const TrkRay* rays, size_t i) {
    return *reinterpret_cast<const TrkRay*>(reinterpret_cast<const unsigned char*>(rays) +
                                            i * query.rayStride);
}

bool isValid(const TrkRay& ray) {
    bool finite = !std::isnan(ray.tMin) && !std::isnan(ray.tMax);
    bool zero = true;
    for (int a = 0; a < 3; ++a) {
        finite = finite && std::isfinite(ray.origin[a]) && std::isfinite(ray.direction[a]);
        zero = zero && ray.direction[a] == 0;
    }
    return finite && !zero;
}

void checkRays(const TrkQuery& query, const TrkRay* rays, size_t rayCount) {
    for (size_t i = 0; i < rayCount; ++i) {
        if (!isValid(rayAt(query, rays, i))) {
            throw Error(TRK_ERROR_INVALID_ARGUMENT,
                        "ray " + std::to_string(i) +
                            ": expected a finite origin, a finite direction that is not zero, and "
                            "limits that are not NaN");
        }
    }
}

void checkMethod(const Volume& volume, const TrkQuery& query) {
    const bool needsDensity = query.method != TRK_METHOD_CONTROL;
    const bool needsSidecar = query.method != TRK_METHOD_EXACT;
    if (needsDensity && !volume.hasDensity) {
        throw Error(TRK_ERROR_NO_DENSITY,
                    volume.sidecarPath +
                        ": opened without its density, which this method looks up; open the "
                        "density's .vdb too, or use the control method");
    }
    if (needsSidecar && !volume.hasSuperVoxels) {
        throw Error(TRK_ERROR_NO_SIDECAR,
                    "grid " + volume.grid.name +
                        ": this method needs a sidecar, and none was found" +
                        (volume.sidecarPath.empty() ? "" : " at " + volume.sidecarPath) +
                        "; make it with `vdbtrack bake`, or use the exact method");
    }
    if (query.method == TRK_METHOD_CONTROL && query.level > volume.superVoxels.levelCount()) {
        throw Error(TRK_ERROR_INVALID_ARGUMENT,
                    "level " + std::to_string(query.level) + ": expected 0 to " +
                        std::to_string(volume.superVoxels.levelCount()) +
                        ", the levels of this sidecar");
    }
}

/// Optical depth by a method without noise.
double deterministicDepth(const Volume& volume, const TrkQuery& query, const TrkRay& ray,
                          double& clippedLength, PathCost& cost) {
    LocalRay local;
    double lengthPerVoxel = 0;
    if (query.method == TRK_METHOD_EXACT) {
        if (!volume.clip(ray, volume.field.box(), local, lengthPerVoxel)) {
            return 0;
        }
        clippedLength = local.tEnd;
        return exactOpticalDepth(volume.field, local,
                                 static_cast<double>(volume.scale) * lengthPerVoxel, cost);
    }
    if (!volume.clip(ray, volume.superVoxels.box(query.level), local, lengthPerVoxel)) {
        return 0;
    }
    clippedLength = local.tEnd;
    return lengthPerVoxel *
           volume.superVoxels.integrateControl(local, query.level, cost.superVoxels);
}

/// Mean and standard error of query.samples estimates of one ray.
template <class Method>
double trackSamples(const Volume& volume, const TrkQuery& query, const LocalRay& ray,
                    double lengthPerVoxel, uint64_t rayId, PathCost& cost, double& standardError) {
    TrackingSettings settings;
    settings.scale = static_cast<double>(volume.scale);
    settings.lengthPerVoxel = lengthPerVoxel;
    settings.rate = static_cast<double>(query.rate);
    settings.exactFallback = (query.flags & TRK_QUERY_EXACT_FALLBACK) != 0;
    double mean = 0;
    double squares = 0;  // sum of squared deviations, updated without cancellation [Welford 1962]
    for (uint32_t i = 0; i < query.samples; ++i) {
        Rng rng(query.seed, query.stream, rayId, i);
        const double estimate =
            trackTransmittance<Method>(volume.field, volume.superVoxels, ray, settings, rng, cost);
        const double delta = estimate - mean;
        mean += delta / (i + 1.0);
        squares += delta * (estimate - mean);
    }
    const double n = query.samples;
    standardError = query.samples > 1 ? std::sqrt(squares / (n * (n - 1)))
                                      : std::numeric_limits<double>::quiet_NaN();
    return mean;
}

float toFloat(double value) {
    constexpr double kLimit = static_cast<double>(std::numeric_limits<float>::max());
    return static_cast<float>(std::fmin(std::fmax(value, -kLimit), kLimit));
}

void estimateRay(const Volume& volume, const TrkQuery& query, const TrkRay& ray, uint64_t rayId,
                 float& transmittance, TrkStatistics* statistics) {
    PathCost cost;
    double clippedLength = 0;
    double mean = 1;
    double standardError = 0;
    double samples = 1;
    if (query.method == TRK_METHOD_EXACT || query.method == TRK_METHOD_CONTROL) {
        mean = std::exp(-deterministicDepth(volume, query, ray, clippedLength, cost));
    } else {
        LocalRay local;
        double lengthPerVoxel = 0;
        if (volume.clip(ray, volume.field.box(), local, lengthPerVoxel)) {
            clippedLength = local.tEnd;
            samples = query.samples;
            mean = query.method == TRK_METHOD_RESIDUAL
                       ? trackSamples<ResidualControl>(volume, query, local, lengthPerVoxel, rayId,
                                                       cost, standardError)
                       : trackSamples<NoControl>(volume, query, local, lengthPerVoxel, rayId, cost,
                                                 standardError);
        } else if (query.samples == 1) {
            standardError = std::numeric_limits<double>::quiet_NaN();
        }
    }
    transmittance = toFloat(mean);
    if (statistics) {
        *statistics = TrkStatistics{};
        statistics->lookups = cost.lookups;
        statistics->superVoxels = cost.superVoxels;
        statistics->standardError[0] = static_cast<float>(standardError);
        statistics->exactShare =
            clippedLength > 0 ? static_cast<float>(cost.exactLength / (samples * clippedLength))
                              : 0.0f;
    }
}

/// Runs body(i) for every ray: in this thread for one ray or one thread, else over TBB.
template <class Body>
void forEachRay(const TrkQuery& query, size_t rayCount, const Body& body) {
    if (rayCount == 1 || query.threads == 1) {
        for (size_t i = 0; i < rayCount; ++i) {
            body(i);
        }
        return;
    }
    const auto run = [&] {
        // Isolated: a thread that waits here must not pick up a task of the caller's, who may hold
        // locks.
        tbb::this_task_arena::isolate([&] {
            tbb::parallel_for(tbb::blocked_range<size_t>(0, rayCount, 64),
                              [&](const tbb::blocked_range<size_t>& range) {
                                  for (size_t i = range.begin(); i != range.end(); ++i) {
                                      body(i);
                                  }
                              });
        });
    };
    if (query.threads == 0) {
        run();
    } else {
        // More than the machine has would only make TBB print a warning.
        const int most = tbb::this_task_arena::max_concurrency();
        tbb::task_arena(std::min(query.threads, most)).execute(run);
    }
}

}  // namespace

void estimateTransmittance(const Volume& volume, const TrkQuery& query, const TrkRay* rays,
                           size_t rayCount, float* transmittance, TrkStatistics* statistics) {
    checkMethod(volume, query);
    checkRays(query, rays, rayCount);
    forEachRay(query, rayCount, [&](size_t i) {
        const uint64_t id = query.rayIds ? query.rayIds[i] : query.firstRayId + i;
        estimateRay(volume, query, rayAt(query, rays, i), id, transmittance[i],
                    statistics ? statistics + i : nullptr);
    });
}

void integrateOpticalDepth(const Volume& volume, const TrkQuery& query, const TrkRay* rays,
                           size_t rayCount, double* opticalDepth) {
    checkMethod(volume, query);
    checkRays(query, rays, rayCount);
    forEachRay(query, rayCount, [&](size_t i) {
        PathCost cost;
        double clippedLength = 0;
        opticalDepth[i] =
            deterministicDepth(volume, query, rayAt(query, rays, i), clippedLength, cost);
    });
}

}  // namespace trk
