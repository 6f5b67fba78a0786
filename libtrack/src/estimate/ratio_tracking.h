// SPDX-License-Identifier: Apache-2.0
// Residual ratio tracking and ratio tracking over super-voxels [Novak14].
#pragma once

#include "scaled_product.h"
#include "tracking.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <utility>

namespace trk {

/// Which part of the extinction is integrated analytically, and at what rate the rest is sampled:
/// a control, and a bound or root mean square of what it leaves, all in extinction, per channel.
struct ResidualControl {
    template <class SuperVoxel>
    static double control(const SuperVoxel& v, size_t channel, const Vec3d& point) {
        return v.control(channel, point);
    }
    template <class SuperVoxel>
    static double integrate(const SuperVoxel& v, size_t channel, const LocalRay& ray, double t0,
                            double t1) {
        return v.integrateControl(channel, ray, t0, t1);
    }
    template <class SuperVoxel>
    static double rate(const SuperVoxel& v, size_t channel, RateBase base) {
        return static_cast<double>(base == RateBase::kRms ? v[channel].residualRms
                                                          : v[channel].bound);
    }
};

/// Ratio tracking is residual ratio tracking with nothing taken out, except where a super-voxel is
/// homogeneous: there the control is exact and nothing is left.
struct NoControl {
    template <class SuperVoxel>
    static double control(const SuperVoxel&, size_t, const Vec3d&) {
        return 0;
    }
    template <class SuperVoxel>
    static double integrate(const SuperVoxel& v, size_t channel, const LocalRay&, double t0,
                            double t1) {
        const auto& range = v.range(channel);
        return range.isHomogeneous() ? static_cast<double>(range.min) * (t1 - t0) : 0.0;
    }
    template <class SuperVoxel>
    static double rate(const SuperVoxel& v, size_t channel, RateBase base) {
        const auto& range = v.range(channel);
        return range.isHomogeneous()
                   ? 0.0
                   : static_cast<double>(base == RateBase::kRms ? range.rms : range.max);
    }
};

/// Below this, the product of weights and control so far cannot matter, and the walk goes on only
/// with probability product / threshold, the product raised to the threshold if it does (Russian
/// roulette). An estimate then has a second moment larger by at most threshold x T x (what the rest
/// of the ray's estimate has as second moment over its mean), which for ratio tracking is at most
/// threshold x T.
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
    /// Whether any product is large enough for roulette to leave it alone, by what is known without
    /// an exponential.
    bool matters() const { return matters(opticalDepth_); }
    /// The same, were this the optical depth.
    bool matters(const std::array<double, C>& depth) const {
        bool any = false;
        for (size_t c = 0; c < C; ++c) {
            any = any || depth[c] < limits_[c];
        }
        return any;
    }
    /// Whether the walk goes on. Sets `isRandom` where that was left to chance.
    template <class Random>
    bool survives(Random& random, bool& isRandom) {
        return survives(opticalDepth_, random, isRandom);
    }
    /// The same, were this the optical depth.
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
/// crosses super-voxels and draws collisions, prefetch() and weigh() look them up, and only then
/// roulette judges the weights. Between these steps other rays may take theirs, while memory
/// answers.
///
/// `superVoxels.cursor(ray, t0, t1)` yields the segments, `field.extinction` and `field.integrate`
/// the extinction of Field::kChannels channels. All arguments must live as long.
template <class Method, class Field, class SuperVoxels, class Random>
class RatioWalk {
  public:
    static constexpr size_t C = Field::kChannels;

    RatioWalk(const Field& field, const SuperVoxels& superVoxels, const LocalRay& ray,
              const TrackingSettings& settings, Random& random, PathCost& cost)
        : field_(field),
          ray_(ray),
          settings_(settings),
          random_(random),
          cost_(cost),
          exactCost_(ray),
          cursor_(superVoxels.cursor(ray, 0, ray.tEnd)),
          distance_(random.exponential()) {}

    /// Up to the next few collisions; false where there are none left.
    bool advance() {
        count_ = 0;
        while (count_ < kChunk) {
            if (!isInside_) {
                if (!hasNext_ && !findNext()) {
                    isDone_ = true;
                    break;
                }
                if (!enter()) {
                    break;
                }
            }
            while (isInside_ && count_ < kChunk) {
                collideOrLeave();
            }
        }
        return count_ > 0;
    }

    /// Of the collisions that were drawn: asks memory for them.
    void prefetch() const {
        for (size_t i = 0; i < count_; ++i) {
            field_.prefetchBrick(collisions_[i].point);
        }
    }

    /// Looks the collisions up; false where the walk has ended.
    bool weigh() {
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
        if (isDone_) {  // nothing is left for roulette to spare
            return false;
        }
        // The control of the super-voxel that the walk is in is not in the throughput yet: it may
        // still be needed to outweigh collisions that amplify.
        return settings_.roulette ? sofar_.survives(random_, cost_.random) : !sofar_.isZero();
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
    using Cursor = decltype(std::declval<const SuperVoxels&>().cursor(
        std::declval<const LocalRay&>(), 0.0, 0.0));

    template <class View>
    double rateOf(const View& superVoxel) const {
        double rate = Method::rate(superVoxel, 0, settings_.rateBase);
        for (size_t c = 1; c < C; ++c) {
            rate = std::max(rate, Method::rate(superVoxel, c, settings_.rateBase));
        }
        return rate;
    }
    double mostLookups(double length) const {
        return settings_.exactFallback ? exactCost_(length) : kMostLookups;
    }

    /// Passes super-voxels as long as nothing happens in them but what is integrated; false where
    /// there are no more. What is true of most of them is worth a loop of its own, in registers.
    bool findNext() {
        const double perVoxel = settings_.rate * settings_.lengthPerVoxel;
        double distance = distance_;
        std::array<double, C> depth = sofar_.opticalDepth();
        uint64_t passed = 0;
        bool isRandom = false;
        typename Cursor::View view;
        double tEnter = 0;
        double tExit = 0;
        while ((hasNext_ = cursor_.next(view, tEnter, tExit))) {
            const double length = tExit - tEnter;
            const double optical = rateOf(view) * perVoxel * length;
            if (distance < optical || optical > mostLookups(length) ||
                (settings_.roulette && !sofar_.matters(depth))) {
                break;
            }
            distance -= optical;
            for (size_t c = 0; c < C; ++c) {
                depth[c] +=
                    settings_.lengthPerVoxel * Method::integrate(view, c, ray_, tEnter, tExit);
            }
            isRandom = isRandom || optical > 0;
            ++passed;
        }
        superVoxel_ = view;
        tEnter_ = tEnter;
        tExit_ = tExit;
        distance_ = distance;
        sofar_.setOpticalDepth(depth);
        cost_.superVoxels += passed;
        cost_.random = cost_.random || isRandom;
        return hasNext_;
    }

    /// Begins with the super-voxel at hand, unless what is left is to be weighed first, or to end.
    bool enter() {
        const double base = rateOf(superVoxel_);
        const double length = tExit_ - tEnter_;
        rate_ = base * settings_.rate;
        ratePerVoxel_ = rate_ * settings_.lengthPerVoxel;
        remaining_ = ratePerVoxel_ * length;
        const bool isExact = remaining_ > mostLookups(length);
        // Where the super-voxel is homogeneous, walks do not end.
        if (settings_.roulette && base > 0) {
            std::array<double, C> depth = sofar_.opticalDepth();
            for (size_t c = 0; c < C; ++c) {
                depth[c] += settings_.lengthPerVoxel * leastDepth(c, isExact);
            }
            if (!sofar_.matters(depth)) {
                if (count_ > 0) {
                    return false;
                }
                if (!sofar_.survives(depth, random_, cost_.random)) {
                    return false;
                }
            }
        }
        hasNext_ = false;
        ++cost_.superVoxels;
        if (isExact) {
            uint64_t bricks = 0;
            const auto exact = field_.integrate(ray_, tEnter_, tExit_, cost_.lookups, bricks);
            for (size_t c = 0; c < C; ++c) {
                sofar_.integrate(c, settings_.lengthPerVoxel * exact[c]);
            }
            cost_.exactLength += length;
            return true;
        }
        cost_.random = cost_.random || remaining_ > 0;
        isInside_ = true;
        return true;
    }

    /// Of the super-voxel at hand, in voxels: what both its optical depth and its control's have at
    /// least. Roulette may count on it before anything is looked up: an estimate of at least that
    /// depth makes up for the weight of the walks that go on.
    double leastDepth(size_t c, bool isExact) const {
        const double least = static_cast<double>(superVoxel_.range(c).min) * (tExit_ - tEnter_);
        return isExact ? least
                       : std::min(least, Method::integrate(superVoxel_, c, ray_, tEnter_, tExit_));
    }

    /// To the next collision, or out of the super-voxel. What is left of the optical distance (in
    /// units of the rate) is carried over from one super-voxel to the next, as the exponential
    /// distribution has no memory: one logarithm a look-up, none where there is none.
    void collideOrLeave() {
        if (distance_ < remaining_) {
            remaining_ -= distance_;
            distance_ = random_.exponential();
            Collision& collision = collisions_[count_++];
            collision.point = ray_.at(tExit_ - remaining_ / ratePerVoxel_);
            field_.prefetchEntry(collision.point);
            collision.rate = rate_;
            for (size_t c = 0; c < C; ++c) {
                collision.control[c] = Method::control(superVoxel_, c, collision.point);
                collision.isTracked[c] =
                    C == 1 || Method::rate(superVoxel_, c, settings_.rateBase) > 0;
            }
            return;
        }
        distance_ -= remaining_;
        isInside_ = false;
        for (size_t c = 0; c < C; ++c) {
            sofar_.integrate(c, settings_.lengthPerVoxel *
                                    Method::integrate(superVoxel_, c, ray_, tEnter_, tExit_));
        }
    }

    const Field& field_;
    const LocalRay& ray_;
    const TrackingSettings& settings_;
    Random& random_;
    PathCost& cost_;
    ExactCost exactCost_;
    Cursor cursor_;
    Throughput<C> sofar_;
    typename Cursor::View superVoxel_;  // at hand
    double tEnter_ = 0;
    double tExit_ = 0;
    bool hasNext_ = false;   // it is not begun
    bool isInside_ = false;  // it is not done
    bool isDone_ = false;    // nor is there another one
    double rate_ = 0;        // a world length
    double ratePerVoxel_ = 0;
    double remaining_ = 0;  // optical distances: to its end
    double distance_;       // and to the next collision
    size_t count_ = 0;
    Collision collisions_[kChunk];
};

/// The walk of one ray alone.
template <class Method, class Field, class SuperVoxels, class Random>
std::array<double, Field::kChannels> trackTransmittance(const Field& field,
                                                        const SuperVoxels& superVoxels,
                                                        const LocalRay& ray,
                                                        const TrackingSettings& settings,
                                                        Random& random, PathCost& cost) {
    RatioWalk<Method, Field, SuperVoxels, Random> walk(field, superVoxels, ray, settings, random,
                                                       cost);
    while (walk.advance() && walk.weigh()) {
    }
    return walk.result();
}

}  // namespace trk
