// SPDX-License-Identifier: Apache-2.0
// Ratio tracking, residual or not, of several rays and samples at a time.
#pragma once

#include "batch.h"
#include "estimate/plan.h"
#include "estimate/ratio_tracking.h"
#include "estimate/rng.h"
#include "ray_output.h"
#include "room.h"
#include "volume.h"

#include <algorithm>
#include <cstddef>
#include <cstdint>

namespace trk {

/// Walks in flight, so that one's look-ups come from memory while others walk. The samples of a ray
/// share what was crossed and planned for it. Results do not depend on who flies together.
template <class V, Control kControl>
class Flight {
  public:
    Flight(const Volume& volume, const TrkQuery& query)
        : volume_(volume),
          query_(query),
          extinction_(volume),
          superVoxels_(volume),
          samplesAtOnce_(std::min<size_t>(query.samples, kWalks)),
          raysAtOnce_(std::min(kRays, kWalks / samplesAtOnce_)) {}

    /// Of the rays from `begin` to `end` - 1.
    void estimate(const TrkRay* rays, size_t begin, size_t end, const RayOutput<V>& output) {
        for (size_t i = begin; i < end;) {
            size_t hits = 0;
            for (; i < end && hits < raysAtOnce_; ++i) {
                const auto clipped = volume_.clip(rayAt(query_, rays, i), volume_.field->box());
                if (clipped) {
                    lanes_[hits++].emplace(i, *clipped,
                                           trackingSettings(query_, clipped->lengthPerVoxel));
                } else {
                    output.writeMiss(i);
                }
            }
            for (size_t first = 0; hits > 0 && first < query_.samples; first += samplesAtOnce_) {
                track(hits, first, std::min(samplesAtOnce_, query_.samples - first));
            }
            for (size_t k = 0; k < hits; ++k) {
                const Lane& lane = lanes_[k].object;
                output.write(lane.index, lane.mean.result(lane.cost.random), lane.cost,
                             lane.clipped.local.tEnd, query_.samples);
            }
        }
    }

  private:
    static constexpr size_t kRays = 8;
    static constexpr size_t kWalks = 16;

    using RayPlan = Plan<kControl, typename V::Walk>;
    struct Lane {
        Lane(size_t ray, const ClippedRay& part, const TrackingSettings& how)
            : index(ray), clipped(part), settings(how) {}

        size_t index;
        ClippedRay clipped;
        TrackingSettings settings;
        PathCost cost;
        SampleMean<V::kChannels> mean;
        Room<RayPlan> plan;
        bool isAtEnd = false;  // of the ray, with the samples that are flying
    };
    using Walk = RatioWalk<typename V::Extinction, RayPlan, Rng>;
    using State = typename Walk::State;
    struct Sample {
        Sample(const typename V::Extinction& extinction, Lane& lane, const Rng& random)
            : rng(random),
              walk(extinction, lane.plan.object, lane.clipped.local, lane.settings, rng,
                   lane.cost) {}

        Rng rng;
        Walk walk;
    };

    /// `samples` samples, from one on, of each ray in the first lanes.
    void track(size_t lanes, size_t firstSample, size_t samples) {
        size_t going[kRays];
        for (size_t k = 0; k < lanes; ++k) {
            Lane& lane = lanes_[k].object;
            lane.plan.emplace(superVoxels_, lane.clipped.local, lane.settings);
            lane.isAtEnd = false;
            for (size_t s = 0; s < samples; ++s) {
                samples_[k * samples + s].emplace(
                    extinction_, lane,
                    Rng(query_.seed, query_.stream, rayIdAt(query_, lane.index),
                        static_cast<uint32_t>(firstSample + s)));
            }
            going[k] = k;
        }
        for (size_t count = lanes; count > 0;) {
            size_t kept = 0;
            for (size_t k = 0; k < count; ++k) {
                Lane& lane = lanes_[going[k]].object;
                Room<Sample>* its = samples_ + going[k] * samples;
                if (advance(lane, its, samples)) {
                    going[kept++] = going[k];
                }
            }
            count = kept;
            for (size_t k = 0; k < count; ++k) {
                for (size_t s = 0; s < samples; ++s) {
                    samples_[going[k] * samples + s].object.walk.prefetch();
                }
            }
            kept = 0;
            for (size_t k = 0; k < count; ++k) {
                const Lane& lane = lanes_[going[k]].object;
                for (size_t s = 0; s < samples; ++s) {
                    auto& walk = samples_[going[k] * samples + s].object.walk;
                    if (lane.isAtEnd || walk.state() == State::kWeighs) {
                        walk.weigh();
                    }
                }
                going[kept] = going[k];
                kept += lane.isAtEnd ? 0 : 1;
            }
            count = kept;
        }
        for (size_t k = 0; k < lanes; ++k) {
            for (size_t s = 0; s < samples; ++s) {
                lanes_[k].object.mean.add(samples_[k * samples + s].object.walk.result());
            }
        }
    }
    /// Until a walk of a ray has something to weigh, for which the others wait, or the ray is at
    /// its end; false where all walks have ended. What a walk draws and weighs is the same whoever
    /// flies with it.
    bool advance(Lane& lane, Room<Sample>* its, size_t samples) {
        for (;;) {
            bool isWeighing = false;
            bool isWaiting = false;
            for (size_t s = 0; s < samples; ++s) {
                const State state = its[s].object.walk.advance();
                isWeighing |= state == State::kWeighs;
                isWaiting |= state == State::kWaits;
            }
            if (isWeighing || !isWaiting) {
                return isWeighing;
            }
            if (lane.plan.object.next() == 0) {
                lane.isAtEnd = true;
                return true;
            }
            for (size_t s = 0; s < samples; ++s) {
                its[s].object.walk.enter();
            }
        }
    }

    const Volume& volume_;
    const TrkQuery& query_;
    typename V::Extinction extinction_;
    typename V::Walk superVoxels_;
    size_t samplesAtOnce_;
    size_t raysAtOnce_;
    Room<Lane> lanes_[kRays];
    Room<Sample> samples_[kWalks];
};

}  // namespace trk
