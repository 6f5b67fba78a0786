// SPDX-License-Identifier: Apache-2.0
#include "transmittance.h"

#include "error.h"
#include "estimators/exact.h"
#include "estimators/ratio_tracking.h"
#include "rng.h"
#include "variant.h"

#include <tbb/blocked_range.h>
#include <tbb/parallel_for.h>
#include <tbb/task_arena.h>

#include <algorithm>
#include <array>
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
template <class V>
std::array<double, V::kChannels> deterministicDepth(const Volume& volume, const TrkQuery& query,
                                                    const TrkRay& ray, double& clippedLength,
                                                    PathCost& cost) {
    LocalRay local;
    double lengthPerVoxel = 0;
    const bool exact = query.method == TRK_METHOD_EXACT;
    const IntBox& box = exact ? volume.field.box() : volume.superVoxels.box(query.level);
    if (!volume.clip(ray, box, local, lengthPerVoxel)) {
        return {};
    }
    clippedLength = local.tEnd;
    if (exact) {
        return exactOpticalDepth(typename V::Extinction(volume), local, lengthPerVoxel, cost);
    }
    auto depth = V::integrateControl(volume.superVoxels, local, query.level, cost.superVoxels);
    for (double& d : depth) {
        d *= lengthPerVoxel;
    }
    return depth;
}

/// Mean and standard error of the estimates of one ray, per channel.
template <size_t C>
struct Estimate {
    std::array<double, C> mean;
    std::array<double, C> standardError;
};

/// Of query.samples estimates.
template <class V, class Method>
Estimate<V::kChannels> trackSamples(const Volume& volume, const TrkQuery& query,
                                    const LocalRay& ray, double lengthPerVoxel, uint64_t rayId,
                                    PathCost& cost) {
    TrackingSettings settings;
    settings.lengthPerVoxel = lengthPerVoxel;
    settings.rate = static_cast<double>(query.rate);
    settings.exactFallback = (query.flags & TRK_QUERY_EXACT_FALLBACK) != 0;
    const typename V::Extinction extinction(volume);
    const typename V::Walk superVoxels{volume.superVoxels};
    Estimate<V::kChannels> result{};
    // Sums of squared deviations, updated without cancellation [Welford 1962].
    std::array<double, V::kChannels> squares{};
    for (uint32_t i = 0; i < query.samples; ++i) {
        Rng rng(query.seed, query.stream, rayId, i);
        const auto estimate =
            trackTransmittance<Method>(extinction, superVoxels, ray, settings, rng, cost);
        for (size_t c = 0; c < V::kChannels; ++c) {
            const double delta = estimate[c] - result.mean[c];
            result.mean[c] += delta / (i + 1.0);
            squares[c] += delta * (estimate[c] - result.mean[c]);
        }
    }
    const double n = query.samples;
    for (size_t c = 0; c < V::kChannels; ++c) {
        result.standardError[c] = query.samples > 1 ? std::sqrt(squares[c] / (n * (n - 1)))
                                                    : std::numeric_limits<double>::quiet_NaN();
    }
    return result;
}

float toFloat(double value) {
    constexpr double kLimit = static_cast<double>(std::numeric_limits<float>::max());
    return static_cast<float>(std::fmin(std::fmax(value, -kLimit), kLimit));
}

template <class V>
void estimateRay(const Volume& volume, const TrkQuery& query, const TrkRay& ray, uint64_t rayId,
                 float* transmittance, TrkStatistics* statistics) {
    constexpr size_t C = V::kChannels;
    PathCost cost;
    double clippedLength = 0;
    double samples = 1;
    Estimate<C> estimate;
    estimate.mean.fill(1);
    estimate.standardError.fill(0);
    if (query.method == TRK_METHOD_EXACT || query.method == TRK_METHOD_CONTROL) {
        const auto depth = deterministicDepth<V>(volume, query, ray, clippedLength, cost);
        for (size_t c = 0; c < C; ++c) {
            estimate.mean[c] = std::exp(-depth[c]);
        }
    } else {
        LocalRay local;
        double lengthPerVoxel = 0;
        if (volume.clip(ray, volume.field.box(), local, lengthPerVoxel)) {
            clippedLength = local.tEnd;
            samples = query.samples;
            estimate =
                query.method == TRK_METHOD_RESIDUAL
                    ? trackSamples<V, ResidualControl>(volume, query, local, lengthPerVoxel, rayId,
                                                       cost)
                    : trackSamples<V, NoControl>(volume, query, local, lengthPerVoxel, rayId, cost);
        } else if (query.samples == 1) {
            estimate.standardError.fill(std::numeric_limits<double>::quiet_NaN());
        }
    }
    std::transform(estimate.mean.begin(), estimate.mean.end(), transmittance, toFloat);
    if (statistics) {
        *statistics = TrkStatistics{};
        statistics->lookups = cost.lookups;
        statistics->superVoxels = cost.superVoxels;
        for (size_t c = 0; c < C; ++c) {
            statistics->standardError[c] = static_cast<float>(estimate.standardError[c]);
        }
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
    const bool controlMatters =
        query.method == TRK_METHOD_RESIDUAL || query.method == TRK_METHOD_CONTROL;
    withVariant(volume, controlMatters, [&](auto variant) {
        using V = decltype(variant);
        forEachRay(query, rayCount, [&](size_t i) {
            const uint64_t id = query.rayIds ? query.rayIds[i] : query.firstRayId + i;
            estimateRay<V>(volume, query, rayAt(query, rays, i), id,
                           transmittance + i * V::kChannels, statistics ? statistics + i : nullptr);
        });
    });
}

void integrateOpticalDepth(const Volume& volume, const TrkQuery& query, const TrkRay* rays,
                           size_t rayCount, double* opticalDepth) {
    checkMethod(volume, query);
    checkRays(query, rays, rayCount);
    withVariant(volume, query.method == TRK_METHOD_CONTROL, [&](auto variant) {
        using V = decltype(variant);
        forEachRay(query, rayCount, [&](size_t i) {
            PathCost cost;
            double clippedLength = 0;
            const auto depth =
                deterministicDepth<V>(volume, query, rayAt(query, rays, i), clippedLength, cost);
            std::copy(depth.begin(), depth.end(), opticalDepth + i * V::kChannels);
        });
    });
}

}  // namespace trk
