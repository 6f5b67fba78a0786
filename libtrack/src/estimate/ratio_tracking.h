// SPDX-License-Identifier: Apache-2.0
// Residual ratio tracking and ratio tracking over super-voxels [Novak14].
#pragma once

#include "plan.h"
#include "scaled_product.h"
#include "tracking.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <utility>

namespace trk {

/// Below this, the product of weights and control so far cannot matter, and the walk goes on only
/// with probability product / threshold, the product raised to the threshold if it does (Russian
/// roulette). An estimate then has a second moment larger by at most threshold x the largest
/// transmittance that the bounds of the super-voxels ahead allow: see Plan::lookAhead.
constexpr double kRouletteThreshold = 0x1p-4;

/// The weights of C channels on their way.
template <size_t C>
class Throughput {
  public:
    Throughput() {
        for (size_t c = 0; c < C; ++c) {
            setLimit(c);
        }
    }

    void multiply(size_t channel, double weight) {
        products_[channel].multiply(weight);
        setLimit(channel);
    }
    void integrate(size_t channel, double opticalDepth) { opticalDepth_[channel] += opticalDepth; }
    double value(size_t channel) const {
        return products_[channel].timesExp(opticalDepth_[channel]);
    }
    bool isZero() const {
        return std::all_of(products_.begin(), products_.end(),
                           [](const ScaledProduct& p) { return p.isZero(); });
    }
    const std::array<double, C>& opticalDepth() const { return opticalDepth_; }
    void setOpticalDepth(const std::array<double, C>& depth) { opticalDepth_ = depth; }
    /// Whether any product is large enough for roulette to leave it alone, were this the optical
    /// depth: by what is known without an exponential.
    bool matters(const std::array<double, C>& depth) const {
        bool any = false;
        for (size_t c = 0; c < C; ++c) {
            any = any || depth[c] < limits_[c];
        }
        return any;
    }
    /// Whether the walk goes on, were this the optical depth. Sets `isRandom` where that was left
    /// to chance.
    template <class Random>
    bool survives(const std::array<double, C>& depth, Random& random, bool& isRandom) {
        if (matters(depth)) {
            return true;
        }
        double largest = 0;
        for (size_t c = 0; c < C; ++c) {
            largest = std::max(largest, std::fabs(products_[c].timesExp(depth[c])));
        }
        const double probability = largest / kRouletteThreshold;
        isRandom = true;
        if (!(1 - random.uniform() <= probability)) {  // at least 2^-53 where it holds
            products_.fill(ScaledProduct::zero());
            return false;
        }
        for (size_t c = 0; c < C; ++c) {
            multiply(c, 1 / probability);
        }
        return true;
    }

  private:
    void setLimit(size_t c) { limits_[c] = products_[c].logBound() - std::log(kRouletteThreshold); }

    std::array<ScaledProduct, C> products_;
    std::array<double, C> opticalDepth_{};  // integrated so far
    std::array<double, C> limits_;          // below this optical depth the product may matter
};

/// One estimate of the transmittance of the whole ray, per channel:
///   exp(-integral of control) x product over collisions of (1 - (extinction - control) / rate),
/// collisions at `rate` per world length [Novak14, Eq. 4]. Unbiased for any rate > 0 wherever the
/// residual is not 0. All channels go one walk, whose rate covers the largest of their bounds, and
/// each carries its own weight.
///
/// Where collisions are does not depend on what is found there. So a walk goes by chunks: advance()
/// draws collisions in the stretches of a plan, prefetch() and weigh() look them up, and only then
/// roulette judges the weights. Between these steps other walks may take theirs, while memory
/// answers; those of one ray may share its plan. See trackTransmittance.
///
/// `field.extinction` and `field.integrate` yield the extinction of Field::kChannels channels; the
/// plan is for ratio tracking with Control::kNone, for residual ratio tracking with kChosen. All
/// arguments must live as long.
template <class Field, class Plan, class Random>
class RatioWalk {
  public:
    static constexpr size_t C = Field::kChannels;

    RatioWalk(const Field& field, const Plan& plan, const LocalRay& ray,
              const TrackingSettings& settings, Random& random, PathCost& cost)
        : field_(field),
          plan_(plan),
          ray_(ray),
          settings_(settings),
          random_(random),
          cost_(cost),
          distance_(random.exponential()) {}

    /// Into what the plan has crossed since it waits.
    void enter() {
        at_ = 0;
        if (state_ == State::kWaits) {
            state_ = State::kWeighs;
        }
    }
    /// What a walk came to.
    enum class State {
        kWeighs,  ///< collisions were drawn and are to be weighed
        kWaits,   ///< for the plan to go on; there may be collisions all the same
        kEnded    ///< what comes cannot change the result any more
    };
    /// Up to where it cannot go on by itself.
    State advance() {
        if (state_ == State::kWeighs) {
            while (count_ < kChunk && (isInside_ || enterNext())) {
                collideOrLeave();
            }
        }
        return state_;
    }
    State state() const { return state_; }

    /// Of the collisions that were drawn: asks memory for them.
    void prefetch() const {
        for (size_t i = 0; i < count_; ++i) {
            field_.prefetchBrick(collisions_[i].point);
        }
    }

    /// Looks the collisions up; of a walk that waits, only where the plan is at the end of the ray.
    void weigh() {
        for (size_t i = 0; i < count_; ++i) {
            const Collision& collision = collisions_[i];
            const auto extinction = field_.extinction(collision.point);
            for (size_t c = 0; c < C; ++c) {
                // A channel without residual there keeps its weight to the bit.
                if (C == 1 || collision.isTracked[c]) {
                    sofar_.multiply(c, 1 - (extinction[c] - collision.control[c]) / collision.rate);
                }
            }
        }
        cost_.lookups += count_;
        count_ = 0;
        // What is left of the stretch that the walk is in does not count, nor does its control: it
        // may still be needed to outweigh collisions that amplify. At the end of the ray, nothing
        // is left for roulette to spare.
        if (settings_.roulette && state_ == State::kWeighs) {
            sofar_.survives(depthAhead(at_ + (isInside_ ? 1 : 0)), random_, cost_.random);
        }
        if (sofar_.isZero()) {
            state_ = State::kEnded;
        }
    }

    std::array<double, C> result() const {
        std::array<double, C> values;
        for (size_t c = 0; c < C; ++c) {
            values[c] = sofar_.value(c);
        }
        return values;
    }

  private:
    static constexpr size_t kChunk = 2;

    struct Collision {
        Vec3d point;
        double rate;
        std::array<double, C> control;
        std::array<bool, C> isTracked;
    };

    /// The optical depth so far, and what the plan knows to come from stretch i on.
    std::array<double, C> depthAhead(size_t i) const {
        std::array<double, C> depth = sofar_.opticalDepth();
        for (size_t c = 0; c < C; ++c) {
            depth[c] += i < plan_.count() ? plan_.ahead(i, c) : 0.0;
        }
        return depth;
    }

    /// Into the next stretch where something collides; false where there is none, or where what
    /// was drawn is to be weighed first, or where roulette ends the walk.
    bool enterNext() {
        for (;;) {
            pass();
            if (at_ == plan_.count()) {
                // As long as all was homogeneous, walks do not end.
                if (!settings_.roulette || !isRandom_ || goesOn(at_)) {
                    state_ = State::kWaits;
                }
                return false;
            }
            if (settings_.roulette && !goesOn(at_)) {
                return false;
            }
            ++cost_.superVoxels;
            if (!plan_.isExact(at_)) {
                remaining_ = plan_.collisions(at_);
                cost_.random = isRandom_ = true;
                isInside_ = true;
                return true;
            }
            uint64_t bricks = 0;
            const auto exact =
                field_.integrate(ray_, plan_.tEnter(at_), plan_.tExit(at_), cost_.lookups, bricks);
            for (size_t c = 0; c < C; ++c) {
                sofar_.integrate(c, settings_.lengthPerVoxel * exact[c]);
            }
            cost_.exactLength += plan_.length(at_);
            ++at_;
        }
    }

    /// Whether to go on to stretch i: roulette, unless something is left to be weighed.
    bool goesOn(size_t i) {
        const std::array<double, C> depth = depthAhead(i);
        if (sofar_.matters(depth)) {
            return true;
        }
        if (count_ == 0) {
            if (sofar_.survives(depth, random_, cost_.random)) {
                return true;
            }
            state_ = State::kEnded;
        }
        return false;
    }

    /// Passes stretches as long as nothing happens in them but what is integrated.
    void pass() {
        double distance = distance_;
        std::array<double, C> depth = sofar_.opticalDepth();
        const size_t count = plan_.count();
        double passed = 0;  // which may be too little to change the distance
        size_t i = at_;
        while (i < count && distance >= plan_.collisionsToTrack(i)) {
            distance -= plan_.collisionsToTrack(i);
            passed += plan_.collisionsToTrack(i);
            for (size_t c = 0; c < C; ++c) {
                depth[c] += plan_.depth(i, c);
            }
            ++i;
        }
        cost_.superVoxels += i - at_;
        isRandom_ = isRandom_ || passed > 0;
        cost_.random = cost_.random || isRandom_;
        at_ = i;
        distance_ = distance;
        sofar_.setOpticalDepth(depth);
    }

    /// To the next collision, or out of the stretch. What is left of the optical distance (in units
    /// of the rate) is carried over from one stretch to the next, as the exponential distribution
    /// has no memory: one logarithm a look-up, none where there is none.
    void collideOrLeave() {
        if (distance_ < remaining_) {
            remaining_ -= distance_;
            distance_ = random_.exponential();
            Collision& collision = collisions_[count_++];
            const double rate = plan_.rate(at_);
            collision.point = ray_.at(plan_.tExit(at_) - remaining_ / rate);
            field_.prefetchEntry(collision.point);
            collision.rate = rate / settings_.lengthPerVoxel;
            for (size_t c = 0; c < C; ++c) {
                collision.control[c] = plan_.control(at_, c, collision.point);
                collision.isTracked[c] = plan_.isTracked(at_, c);
            }
            return;
        }
        distance_ -= remaining_;
        isInside_ = false;
        for (size_t c = 0; c < C; ++c) {
            sofar_.integrate(c, plan_.depth(at_, c));
        }
        ++at_;
    }

    const Field& field_;
    const Plan& plan_;
    const LocalRay& ray_;
    const TrackingSettings& settings_;
    Random& random_;
    PathCost& cost_;
    size_t at_ = 0;  // of the plan's stretches
    Throughput<C> sofar_;
    bool isRandom_ = false;  // another walk might have had another result, roulette apart
    bool isInside_ = false;  // a stretch, not done with its collisions
    State state_ = State::kWeighs;
    double remaining_ = 0;  // optical distances: to its end
    double distance_;       // and to the next collision
    size_t count_ = 0;
    Collision collisions_[kChunk];
};

/// One estimate of one ray. kControl: Control::kNone for ratio tracking, kChosen for residual ratio
/// tracking.
template <Control kControl, class Field, class SuperVoxels, class Random>
std::array<double, Field::kChannels> trackTransmittance(const Field& field,
                                                        const SuperVoxels& superVoxels,
                                                        const LocalRay& ray,
                                                        const TrackingSettings& settings,
                                                        Random& random, PathCost& cost) {
    Plan<kControl, SuperVoxels> plan(superVoxels, ray, settings);
    RatioWalk walk(field, std::as_const(plan), ray, settings, random, cost);
    for (;;) {
        using State = typename decltype(walk)::State;
        const State state = walk.advance();
        if (state == State::kWaits && plan.next() > 0) {
            walk.enter();
            continue;
        }
        walk.weigh();
        if (state != State::kWeighs) {
            return walk.result();
        }
    }
}

}  // namespace trk
