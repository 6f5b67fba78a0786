// SPDX-License-Identifier: Apache-2.0
#include "transmittance.h"

#include "batch.h"
#include "estimate/exact.h"
#include "estimate/free_path.h"
#include "estimate/ratio_tracking.h"
#include "estimate/ray_marching.h"
#include "estimate/rng.h"
#include "failure.h"
#include "kernel.h"
#include "methods.h"
#include "variant.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <new>
#include <string>
#include <type_traits>
#include <utility>

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

constexpr double kNaN = std::numeric_limits<double>::quiet_NaN();

/// Mean and standard error of the estimates of one ray, per channel. The error is NaN where it is
/// not known.
template <size_t C>
struct Estimate {
    std::array<double, C> mean;
    std::array<double, C> standardError;
};

/// The mean of several estimates of one ray.
template <size_t C>
class SampleMean {
  public:
    void add(const std::array<double, C>& estimate) {
        ++count_;
        for (size_t c = 0; c < C; ++c) {
            // Sums of squared deviations, updated without cancellation [Welford 1962].
            const double delta = estimate[c] - mean_[c];
            mean_[c] += delta / count_;
            squares_[c] += delta * (estimate[c] - mean_[c]);
        }
    }
    /// `isRandom`: another estimate might have been another one.
    Estimate<C> result(bool isRandom) const {
        Estimate<C> result{};
        result.mean = mean_;
        for (size_t c = 0; c < C; ++c) {
            // That random estimates agree says little: only a larger number of them would differ.
            result.standardError[c] = squares_[c] > 0
                                          ? std::sqrt(squares_[c] / (count_ * (count_ - 1)))
                                      : isRandom ? kNaN
                                                 : 0.0;
        }
        return result;
    }

  private:
    double count_ = 0;
    std::array<double, C> mean_{};
    std::array<double, C> squares_{};
};

/// By a random method that takes one ray at a time: delta tracking and marching.
template <class V>
Estimate<V::kChannels> estimateRandomly(const Volume& volume, const TrkQuery& query,
                                        const ClippedRay& clipped, uint64_t rayId, PathCost& cost) {
    const TrackingSettings settings = trackingSettings(query, clipped.lengthPerVoxel);
    const LocalRay& ray = clipped.local;
    const typename V::Extinction extinction(volume);
    SampleMean<V::kChannels> mean;
    for (uint32_t i = 0; i < query.samples; ++i) {
        Rng rng(query.seed, query.stream, rayId, i);
        if (query.method == TRK_METHOD_DELTA) {
            mean.add(trackBinary(extinction, typename V::Walk(volume), ray, settings, rng, cost));
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

float toFloat(double value) {
    constexpr double kLimit = static_cast<double>(std::numeric_limits<float>::max());
    return static_cast<float>(std::fmin(std::fmax(value, -kLimit), kLimit));
}

/// What is written for one ray.
template <class V>
class RayOutput {
  public:
    RayOutput(const Volume& volume, const TrkQuery& query, const Array<float>& transmittance,
              const StatisticsOutput& statistics)
        : volume_(volume), query_(query), transmittance_(transmittance), statistics_(statistics) {}

    /// `clippedLength`: voxel lengths within the volume; 0 where the ray misses it.
    void write(size_t ray, Estimate<V::kChannels> estimate, const PathCost& cost,
               double clippedLength, double samples) const {
        if (!traitsOf(query_.method).isUnbiased && clippedLength > 0) {
            estimate.standardError.fill(kNaN);
        }
        for (size_t c = 0; c < V::kChannels; ++c) {
            if (volume_.scales[c] == 0) {  // exactly 1, whatever the other channels met
                estimate.standardError[c] = 0;
            }
        }
        std::transform(estimate.mean.begin(), estimate.mean.end(), transmittance_.at(ray), toFloat);
        if (statistics_.standardError) {
            std::transform(estimate.standardError.begin(), estimate.standardError.end(),
                           statistics_.standardError.at(ray), roundedError);
        }
        if (statistics_.lookups) {
            *statistics_.lookups.at(ray) = cost.lookups;
        }
        if (statistics_.superVoxels) {
            *statistics_.superVoxels.at(ray) = cost.superVoxels;
        }
        if (statistics_.exactShare) {
            *statistics_.exactShare.at(ray) =
                clippedLength > 0 ? static_cast<float>(cost.exactLength / (samples * clippedLength))
                                  : 0.0f;
        }
    }
    /// Of a ray that misses the volume, whatever the method.
    void writeMiss(size_t ray) const {
        Estimate<V::kChannels> estimate{};
        estimate.mean.fill(1);
        write(ray, estimate, {}, 0, 1);
    }

  private:
    const Volume& volume_;
    const TrkQuery& query_;
    const Array<float>& transmittance_;
    const StatisticsOutput& statistics_;
};

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

/// Room for an object that is made when it is needed: most queries of one ray need none.
template <class T>
union Room {
    static_assert(std::is_trivially_destructible_v<T>);

    Room() {}
    template <class... Arguments>
    void emplace(Arguments&&... arguments) {
        new (static_cast<void*>(&object)) T(std::forward<Arguments>(arguments)...);
    }

    T object;
};

/// By ratio tracking (residual or not): several rays in flight, so that one's look-ups come from
/// memory while others walk.
template <class V, Control kControl>
class Flight {
  public:
    static constexpr size_t kRays = 8;

    Flight(const Volume& volume, const TrkQuery& query)
        : volume_(volume), query_(query), extinction_(volume), superVoxels_(volume) {}

    /// Of `count` rays, kRays at most.
    void estimate(const TrkRay* rays, size_t first, size_t count, const RayOutput<V>& output) {
        size_t hits = 0;
        for (size_t i = first; i < first + count; ++i) {
            const auto clipped = volume_.clip(rayAt(query_, rays, i), volume_.field->box());
            if (!clipped) {
                output.writeMiss(i);
                continue;
            }
            lanes_[hits++].emplace(i, *clipped, trackingSettings(query_, clipped->lengthPerVoxel));
        }
        for (uint32_t sample = 0; hits > 0 && sample < query_.samples; ++sample) {
            track(hits, sample);
        }
        for (size_t k = 0; k < hits; ++k) {
            const Lane& lane = lanes_[k].object;
            output.write(lane.index, lane.mean.result(lane.cost.random), lane.cost,
                         lane.clipped.local.tEnd, query_.samples);
        }
    }

  private:
    using Walk = RatioWalk<kControl, typename V::Extinction, typename V::Walk, Rng>;
    struct Lane {
        Lane(size_t ray, const ClippedRay& part, const TrackingSettings& how)
            : index(ray), clipped(part), settings(how) {}

        size_t index;
        ClippedRay clipped;
        TrackingSettings settings;
        PathCost cost;
        SampleMean<V::kChannels> mean;
        Rng rng{0, 0, 0, 0};
        Room<Walk> walk;
    };

    void track(size_t hits, uint32_t sample) {
        size_t flying[kRays];
        size_t count = 0;
        for (size_t k = 0; k < hits; ++k) {
            Lane& lane = lanes_[k].object;
            lane.rng = Rng(query_.seed, query_.stream, rayIdAt(query_, lane.index), sample);
            lane.walk.emplace(extinction_, superVoxels_, lane.clipped.local, lane.settings,
                              lane.rng, lane.cost);
            flying[count++] = k;
        }
        while (count > 0) {
            count = keep(flying, count, [](Walk& walk) { return walk.advance(); });
            for (size_t k = 0; k < count; ++k) {
                lanes_[flying[k]].object.walk.object.prefetch();
            }
            count = keep(flying, count, [](Walk& walk) { return walk.weigh(); });
        }
        for (size_t k = 0; k < hits; ++k) {
            lanes_[k].object.mean.add(lanes_[k].object.walk.object.result());
        }
    }
    template <class GoesOn>
    size_t keep(size_t (&flying)[kRays], size_t count, const GoesOn& goesOn) {
        size_t kept = 0;
        for (size_t k = 0; k < count; ++k) {
            if (goesOn(lanes_[flying[k]].object.walk.object)) {
                flying[kept++] = flying[k];
            }
        }
        return kept;
    }

    const Volume& volume_;
    const TrkQuery& query_;
    typename V::Extinction extinction_;
    typename V::Walk superVoxels_;
    Room<Lane> lanes_[kRays];
};

template <class V, Control kControl>
void estimateByFlights(const Volume& volume, const TrkQuery& query, const TrkRay* rays,
                       size_t begin, size_t end, const RayOutput<V>& output) {
    Flight<V, kControl> flight(volume, query);
    for (size_t i = begin; i < end; i += flight.kRays) {
        flight.estimate(rays, i, std::min(flight.kRays, end - i), output);
    }
}

template <class V>
void estimateRange(const Volume& volume, const TrkQuery& query, const TrkRay* rays, size_t begin,
                   size_t end, const RayOutput<V>& output) {
    const MethodTraits& method = traitsOf(query.method);
    if (method.usesRoulette && method.usesControl) {
        estimateByFlights<V, Control::kChosen>(volume, query, rays, begin, end, output);
        return;
    }
    if constexpr (V::kKind == ControlKind::kConstant) {  // or none is looked at: see controlKind
        if (method.usesRoulette) {
            estimateByFlights<V, Control::kNone>(volume, query, rays, begin, end, output);
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
