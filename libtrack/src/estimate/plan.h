// SPDX-License-Identifier: Apache-2.0
// What is done where on a ray: super-voxels that are crossed become stretches, each with a control
// to integrate, and a rate at which the rest is tracked or the word that it is integrated exactly.
#pragma once

#include "control/control_choice.h"
#include "control/super_voxels.h"
#include "space/lanes.h"
#include "tracking.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <cstring>
#include <limits>
#include <utility>

namespace trk {

/// What is taken out of the extinction of a super-voxel before the rest is tracked. Of a
/// homogeneous one that is always all, and nothing is left.
enum class Control {
    kNone,     ///< ratio tracking, delta tracking
    kMinimum,  ///< decomposition tracking
    kChosen    ///< residual ratio tracking: what the volume's choice makes of what was baked
};

/// The plan of a ray, a few stretches at a time: next() crosses some, in short loops over them, and
/// those from 0 to count() - 1 are they until it is called again. It goes by ray, settings and
/// baked numbers alone, never by what is looked up: were it otherwise, estimates would be biased.
/// So any number of estimates of one ray may share it, each going through the stretches that are
/// there before it is told to go on.
///
/// C channels go one walk, whose rate of collisions covers the largest of their bounds.
/// `superVoxels` is a Variant's Walk, or anything like it; it, ray and settings must live as long.
template <Control kControl, class SuperVoxels>
class Plan {
  public:
    static constexpr size_t C = SuperVoxels::kChannels;
    /// Whether a control may vary within a stretch.
    static constexpr bool kVaries =
        kControl == Control::kChosen && SuperVoxels::kKind != ControlKind::kConstant;

    Plan(const SuperVoxels& superVoxels, const LocalRay& ray, const TrackingSettings& settings)
        : superVoxels_(superVoxels),
          ray_(ray),
          settings_(settings),
          most_(ray, settings),
          cursor_(superVoxels.cursor(ray, 0, ray.tEnd)) {}

    /// Crosses the next few super-voxels; how many, 0 at the end of the ray.
    size_t next() {
        count_ = cursor_.refill();
        if (count_ > 0) {
            const size_t padded = (count_ + 3) / 4 * 4;
            for (size_t i = 0; i < count_; ++i) {
                length_[i] = cursor_.tExit(i) - cursor_.tEnter(i);
            }
            std::fill(length_ + count_, length_ + padded, 0.0);
            std::fill(rate_, rate_ + padded, 0.0);
            for (size_t c = 0; c < C; ++c) {
                takeOut(c);
            }
            decide();
            for (size_t c = 0; c < C; ++c) {
                lookAhead(c);
            }
        }
        return count_;
    }
    size_t count() const { return count_; }

    double tEnter(size_t i) const { return cursor_.tEnter(i); }
    double tExit(size_t i) const { return cursor_.tExit(i); }
    double length(size_t i) const { return length_[i]; }
    /// Of collisions, a voxel length; of what is left, or of everything.
    double rate(size_t i) const { return rate_[i]; }
    /// How many are expected.
    double collisions(size_t i) const { return collisions_[i]; }
    /// Whether it is integrated exactly, which takes less than tracking it.
    bool isExact(size_t i) const { return tracked_[i] == kInfinity; }
    /// As many, or infinity where it is integrated exactly.
    double collisionsToTrack(size_t i) const { return tracked_[i]; }
    /// Whether anything of a channel is left to track.
    bool isTracked(size_t i, size_t c) const { return bound_[c][i] > 0; }
    /// Of the magnitude of what is left, in extinction.
    double bound(size_t i, size_t c) const { return bound_[c][i]; }
    /// Optical depth of the control.
    double depth(size_t i, size_t c) const { return depth_[c][i]; }
    /// Of the stretch and all behind it in this plan: an optical depth by which roulette may judge
    /// a walk before anything is looked up. See lookAhead.
    double ahead(size_t i, size_t c) const { return ahead_[c][i]; }

    /// The control at a point of local space, in extinction.
    double control(size_t i, size_t c, const Vec3d& point) const {
        if constexpr (kVaries) {
            return control_[c][i] + slope_[c][i] * cursor_.slopeAt(i, c, point);
        } else {
            return control_[c][i];
        }
    }
    /// The bounds of the extinction.
    double min(size_t i, size_t c) const { return min_[c][i]; }
    double max(size_t i, size_t c) const { return max_[c][i]; }

  private:
    using Cursor = decltype(std::declval<const SuperVoxels&>().cursor(
        std::declval<const LocalRay&>(), 0.0, 0.0));
    static constexpr size_t kMost = Cursor::kMost;

    // Loops go by four stretches; those past the last one have no length.

    /// Four numbers of each of them, as vectors of the first, the second and so on.
    /// `numbersOf(i)`: where those of a stretch are.
    template <class NumbersOf>
    void load(size_t first, const NumbersOf& numbersOf, Double4 (&four)[4]) const {
        Float4 v[4];
        for (size_t k = 0; k < 4; ++k) {
            std::memcpy(&v[k], numbersOf(std::min(first + k, count_ - 1)), sizeof(v[k]));
        }
        const Float4 ab = __builtin_shufflevector(v[0], v[1], 0, 4, 1, 5);
        const Float4 cd = __builtin_shufflevector(v[2], v[3], 0, 4, 1, 5);
        const Float4 ef = __builtin_shufflevector(v[0], v[1], 2, 6, 3, 7);
        const Float4 gh = __builtin_shufflevector(v[2], v[3], 2, 6, 3, 7);
        four[0] = __builtin_convertvector(__builtin_shufflevector(ab, cd, 0, 1, 4, 5), Double4);
        four[1] = __builtin_convertvector(__builtin_shufflevector(ab, cd, 2, 3, 6, 7), Double4);
        four[2] = __builtin_convertvector(__builtin_shufflevector(ef, gh, 0, 1, 4, 5), Double4);
        four[3] = __builtin_convertvector(__builtin_shufflevector(ef, gh, 2, 3, 6, 7), Double4);
    }
    static void takeRoot(Double4& squares) {
        for (int k = 0; k < 4; ++k) {
            squares[k] = std::sqrt(squares[k]);
        }
    }

    /// One channel: its control, and what that leaves.
    void takeOut(size_t c) {
        const double scale = superVoxels_.scale(c);
        const ControlChoice& choice = superVoxels_.choice();
        const bool wantsRms = settings_.rateBase == RateBase::kRms;
        const double unit = settings_.rate * settings_.lengthPerVoxel;
        for (size_t i = 0; i < count_; i += 4) {
            Double4 baked[4];  // a SuperVoxel's
            SuperVoxel records[4];
            for (size_t k = 0; k < 4; ++k) {
                records[k] = cursor_.record(std::min(i + k, count_ - 1), c);
            }
            load(
                0, [&](size_t k) { return &records[k]; }, baked);
            const Double4 min = scale * baked[0];
            const Double4 max = scale * baked[1];
            const Double4 mean = scale * baked[2];
            const Double4 deviation = scale * baked[3];
            Double4 control;
            if constexpr (kVaries) {
                control = min;
            } else if constexpr (kControl == Control::kChosen) {
                choice.takeConstant(min, mean, max, control);
            } else if constexpr (kControl == Control::kMinimum) {
                control = min;
            } else {
                control = min == max ? min : Double4{};
            }
            Double4 bound = control - min;
            takeGreater(Double4(max - control), bound);
            Double4 rms{};  // of what is left
            if (wantsRms) {
                rms = deviation * deviation + (control - mean) * (control - mean);
                takeRoot(rms);
            }
            if constexpr (kVaries) {
                // What is left is share (extinction - baked control) + (1 - share) (extinction -
                // min), of which the second has been said already.
                Double4 shape[4];  // a ControlShape's head
                load(
                    i, [&](size_t k) { return cursor_.shape(k, c).numbers; }, shape);
                const Double4 centre = scale * shape[0];
                const Double4 majorant = scale * shape[2];
                Double4 excess = scale * shape[1] - min;
                takeLesser(majorant, excess);
                Double4 share;
                choice.takeShare(min, max, excess, share);
                control = min + share * (centre - min);
                bound = share * majorant + (1 - share) * bound;
                rms = share * scale * shape[3] + (1 - share) * rms;
                store(share * scale, slope_[c] + i);
            }
            store(min, min_[c] + i);
            store(max, max_[c] + i);
            store(control, control_[c] + i);
            store(bound, bound_[c] + i);
            Double4 base = bound;
            if (wantsRms) {
                base = kLeastRate * bound;
                takeGreater(rms, base);
            }
            Double4 rate;
            trk::load(rate_ + i, rate);
            takeGreater(Double4(unit * base), rate);
            store(rate, rate_ + i);
        }
    }

    /// How each is treated.
    void decide() {
        for (size_t i = 0; i < count_; i += 4) {
            Double4 length;
            Double4 collisions;
            trk::load(length_ + i, length);
            trk::load(rate_ + i, collisions);
            collisions = collisions * length;
            Double4 most;
            most_.of(length, most);
            store(collisions, collisions_ + i);
            store(collisions > most ? Double4{} + kInfinity : collisions, tracked_ + i);
        }
    }

    /// Optical depths: of the control, and such by which roulette may judge the walk beforehand.
    ///
    /// A walk of weight W that goes on with probability p = W exp(-D) / threshold over what is
    /// ahead, whose estimate is X, has a second moment of W^2 E[X^2] / p = threshold W E[X^2]
    /// exp(D) then. E[X^2] is exp(-integral of f), f = 2 extinction where it is integrated exactly
    /// and 2 extinction - (extinction - control)^2 / rate where it is tracked: concave in the
    /// extinction, so least at one of its bounds. With D = the least integral of f, less that of
    /// the extinction's minimum, the second moment is at most threshold W exp(-integral of the
    /// minimum): the threshold, times the largest transmittance that the bounds allow. That is said
    /// of what this plan has crossed; and where D is negative, 0 is counted on.
    void lookAhead(size_t c) {
        const double unit = settings_.lengthPerVoxel;
        double least[kMost];
        for (size_t i = 0; i < count_; i += 4) {
            Double4 min;
            Double4 max;
            Double4 control;
            Double4 rate;
            Double4 length;
            trk::load(min_[c] + i, min);
            trk::load(max_[c] + i, max);
            trk::load(control_[c] + i, control);
            trk::load(rate_ + i, rate);
            trk::load(length_ + i, length);
            const Double4 optical = unit * length;
            store(optical * control, depth_[c] + i);
            takeGreater(Double4{} + 1e-300, rate);
            const Double4 inverse = unit / rate;
            Double4 depth;
            if constexpr (kVaries) {
                Double4 bound;
                trk::load(bound_[c] + i, bound);
                depth = min - bound * bound * inverse;
            } else {
                const Double4 below = control - min;
                const Double4 above = max - control;
                depth = min - below * below * inverse;
                takeLesser(Double4(2 * max - above * above * inverse - min), depth);
            }
            Double4 tracked;
            trk::load(tracked_ + i, tracked);
            depth = tracked == kInfinity ? min : depth;
            store(optical * depth, least + i);
        }
        if constexpr (kVaries) {
            for (size_t i = 0; i < count_; ++i) {
                depth_[c][i] += unit * slope_[c][i] * cursor_.integrateSlope(i, c, ray_);
            }
        }
        double sum = 0;
        for (size_t i = count_; i-- > 0;) {
            sum += least[i];
            ahead_[c][i] = std::max(sum, 0.0);
        }
    }

    static constexpr double kInfinity = std::numeric_limits<double>::infinity();
    /// Of the bound, where the rate is that of the root mean square: lest there are weights that
    /// only a lucky sample would show.
    static constexpr double kLeastRate = 0.25;

    const SuperVoxels& superVoxels_;
    const LocalRay& ray_;
    const TrackingSettings& settings_;
    MostLookups most_;
    Cursor cursor_;
    size_t count_ = 0;
    double length_[kMost];
    double rate_[kMost];
    double collisions_[kMost];
    double tracked_[kMost];
    // A channel each, in extinction:
    double min_[C][kMost];
    double max_[C][kMost];
    double control_[C][kMost];  // where it varies, at the centre
    double slope_[C][kMost];    // and what of the baked one is added there
    double bound_[C][kMost];
    // and in optical depth.
    double depth_[C][kMost];
    double ahead_[C][kMost];
};

/// Calls visit(plan, i) for every stretch of a ray.
template <Control kControl, class SuperVoxels, class Visit>
void forEachStretch(const SuperVoxels& superVoxels, const LocalRay& ray,
                    const TrackingSettings& settings, Visit&& visit) {
    Plan<kControl, SuperVoxels> plan(superVoxels, ray, settings);
    while (plan.next() > 0) {
        for (size_t i = 0; i < plan.count(); ++i) {
            visit(std::as_const(plan), i);
        }
    }
}

}  // namespace trk
