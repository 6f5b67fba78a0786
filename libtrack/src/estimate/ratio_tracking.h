// SPDX-License-Identifier: Apache-2.0
// Residual ratio tracking and ratio tracking over super-voxels [Novak14].
#pragma once

#include "scaled_product.h"
#include "tracking.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>

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
    /// Whether the walk goes on. Sets `isRandom` where that was left to chance.
    template <class Random>
    bool survives(Random& random, bool& isRandom) {
        double largest = 0;
        for (size_t c = 0; c < C; ++c) {
            if (opticalDepth_[c] < limits_[c]) {
                return true;
            }
            largest = std::max(largest, std::fabs(value(c)));
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
/// each carries its own weight. `superVoxels.walk(ray, t0, t1, visit)` yields the segments,
/// `field.extinction` and `field.integrate` the extinction of Field::kChannels channels.
template <class Method, class Field, class SuperVoxels, class Random>
std::array<double, Field::kChannels> trackTransmittance(const Field& field,
                                                        const SuperVoxels& superVoxels,
                                                        const LocalRay& ray,
                                                        const TrackingSettings& settings,
                                                        Random& random, PathCost& cost) {
    constexpr size_t C = Field::kChannels;
    Throughput<C> sofar;
    // Optical distance (in units of the rate) to the next collision; carried over from one
    // super-voxel to the next, as the exponential distribution has no memory: one logarithm a
    // look-up, none where there is none.
    double distance = random.exponential();
    superVoxels.walk(ray, 0, ray.tEnd, [&](const auto& v, double tEnter, double tExit) {
        ++cost.superVoxels;
        double base = Method::rate(v, 0, settings.rateBase);
        for (size_t c = 1; c < C; ++c) {
            base = std::max(base, Method::rate(v, c, settings.rateBase));
        }
        // Where the super-voxel is homogeneous, walks do not end.
        if (settings.roulette && base > 0 && !sofar.survives(random, cost.random)) {
            return false;
        }
        const double rate = base * settings.rate;
        const double ratePerVoxel = rate * settings.lengthPerVoxel;
        double remaining = ratePerVoxel * (tExit - tEnter);
        if (remaining > (settings.exactFallback ? exactCost(ray, tExit - tEnter) : kMostLookups)) {
            uint64_t bricks = 0;
            const auto exact = field.integrate(ray, tEnter, tExit, cost.lookups, bricks);
            for (size_t c = 0; c < C; ++c) {
                sofar.integrate(c, settings.lengthPerVoxel * exact[c]);
            }
            cost.exactLength += tExit - tEnter;
            return true;
        }
        cost.random = cost.random || remaining > 0;
        while (distance < remaining) {
            remaining -= distance;
            const Vec3d point = ray.at(tExit - remaining / ratePerVoxel);
            const auto extinction = field.extinction(point);
            for (size_t c = 0; c < C; ++c) {
                // A channel without residual here keeps its weight to the bit.
                if (C == 1 || Method::rate(v, c, settings.rateBase) > 0) {
                    sofar.multiply(c, 1 - (extinction[c] - Method::control(v, c, point)) / rate);
                }
            }
            ++cost.lookups;
            // This super-voxel's control is not in the throughput yet: it may still be needed to
            // outweigh collisions that amplify.
            if (settings.roulette ? !sofar.survives(random, cost.random) : sofar.isZero()) {
                return false;
            }
            distance = random.exponential();
        }
        distance -= remaining;
        for (size_t c = 0; c < C; ++c) {
            sofar.integrate(c,
                            settings.lengthPerVoxel * Method::integrate(v, c, ray, tEnter, tExit));
        }
        return true;
    });
    std::array<double, C> result;
    for (size_t c = 0; c < C; ++c) {
        result[c] = sofar.value(c);
    }
    return result;
}

}  // namespace trk
