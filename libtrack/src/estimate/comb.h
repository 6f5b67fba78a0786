// SPDX-License-Identifier: Apache-2.0
// Unbiased ray marching: a power series of combs of equidistant look-ups [Kettunen21].
#pragma once

#include "ratio_tracking.h"
#include "scaled_product.h"
#include "tracking.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>

namespace trk {

/// How many terms of the series an estimate has, beside the first. With probability 0.9 none; else
/// at least two, and a k-th one with probability 2 / k after those before it [Kettunen21, Sec. 4].
class SeriesOrder {
  public:
    static constexpr size_t kMost = 31;  ///< a longer one has a probability below 1e-24

    template <class Random>
    explicit SeriesOrder(Random& random) {
        if (random.uniform() >= kGoesOn) {
            return;
        }
        order_ = 2;
        while (order_ < kMost && random.uniform() * static_cast<double>(order_ + 1) < 2) {
            ++order_;
        }
    }
    size_t order() const { return order_; }
    /// The probability that a k-th term is there.
    static double probability(size_t k) {
        double p = k == 0 ? 1 : kGoesOn;
        for (size_t j = 3; j <= k; ++j) {
            p *= 2 / static_cast<double>(j);
        }
        return p;
    }

  private:
    static constexpr double kGoesOn = 0.1;

    size_t order_ = 0;
};

/// An unbiased estimate of exp(X_0 - E[X]) from order + 1 unbiased estimates X of an optical depth,
/// of which the caller integrates the first, as they may be large: the mean, over each of them as
/// the pivot, of the series of the others' differences from it, by elementary symmetric means
/// [Kettunen21, Alg. 1].
inline double seriesEstimate(const double* depths, size_t order) {
    double total = 0;
    for (size_t pivot = 0; pivot <= order; ++pivot) {
        double means[SeriesOrder::kMost + 1] = {1};
        size_t n = 0;
        for (size_t j = 0; j <= order; ++j) {
            if (j == pivot) {
                continue;
            }
            ++n;
            const double x = depths[pivot] - depths[j];
            for (size_t k = n; k >= 1; --k) {
                means[k] +=
                    static_cast<double>(k) / static_cast<double>(n) * (means[k - 1] * x - means[k]);
            }
        }
        double sum = 0;
        double factorial = 1;
        for (size_t k = 0; k <= order; ++k) {
            factorial *= k == 0 ? 1 : static_cast<double>(k);
            sum += means[k] / (factorial * SeriesOrder::probability(k));
        }
        total += std::exp(depths[0] - depths[pivot]) * sum;
    }
    return total / static_cast<double>(order + 1);
}

/// One estimate of the transmittance of the whole ray, per channel, by combs of points at most
/// `step` voxel lengths apart over what varies little enough, exactly over the rest.
///
/// A comb has as many points in a stretch wherever it is shifted to, at a distance h; of them,
/// those in a super-voxel of length l take its part of the depth but for at most h. Let m be the
/// middle between its minimum and maximum, and r what these are apart. What the points leave of m
/// is at most r / 2 (l + h); what the m leave, summed by parts, at most h times what neighbours' m
/// differ by, which is r at most, as the density is continuous. So the depth X that a comb finds
/// lies within a range of the sum of r (l + 3 h), whatever the density is. And if lines meet what
/// super-voxels hold, its standard deviation is the sum of s (l + 3 h) at most, s being theirs,
/// were all points to err alike. Super-voxels that take more than their share of kMostDeviation or
/// kMostRange are integrated exactly: the series then converges fast, and always.
template <class Field, class SuperVoxels, class Random>
std::array<double, Field::kChannels> combTransmittance(
    const Field& field, const SuperVoxels& superVoxels, const LocalRay& ray,
    const TrackingSettings& settings, double step, Random& random, PathCost& cost) {
    constexpr size_t C = Field::kChannels;
    constexpr double kMostDeviation = 0.5;
    constexpr double kMostRange = 3;
    const double unit = settings.lengthPerVoxel;
    auto cursor = superVoxels.cursor(ray, 0, ray.tEnd);
    Throughput<C> sofar;
    std::array<double, C> values{};
    bool isRandom = false;  // something was left to chance
    while (const size_t count = cursor.refill()) {
        double length = 0;
        bool varies = isRandom;
        std::array<double, C> ahead = sofar.opticalDepth();
        for (size_t i = 0; i < count; ++i) {
            const double l = cursor.tExit(i) - cursor.tEnter(i);
            length += l;
            for (size_t c = 0; c < C; ++c) {
                const SuperVoxel& record = cursor.record(i, c);
                ahead[c] += unit * superVoxels.scale(c) * static_cast<double>(record.min) * l;
                varies = varies || record.min < record.max;
            }
        }
        // Roulette, by what is sure to come; as long as all is homogeneous, nothing is random.
        if (settings.roulette && varies && !sofar.survives(ahead, random, cost.random)) {
            return values;
        }
        cost.superVoxels += count;
        const double reach =
            unit * (length + 3 * static_cast<double>(count) * std::min(step, length));
        enum class Stretch { kHomogeneous, kSmooth, kRough };
        const auto kindOf = [&](size_t i) {
            Stretch kind = Stretch::kHomogeneous;
            for (size_t c = 0; c < C; ++c) {
                const SuperVoxel& record = cursor.record(i, c);
                const double scale = superVoxels.scale(c) * reach;
                const bool isRough =
                    scale * static_cast<double>(record.deviation) > kMostDeviation ||
                    scale * (static_cast<double>(record.max) - static_cast<double>(record.min)) >
                        kMostRange;
                const Stretch ofChannel = record.min == record.max ? Stretch::kHomogeneous
                                          : isRough                ? Stretch::kRough
                                                                   : Stretch::kSmooth;
                kind = std::max(kind, ofChannel);
            }
            return kind;
        };
        const SeriesOrder series(random);
        const size_t combs = series.order() + 1;
        double offsets[SeriesOrder::kMost + 1];
        for (size_t j = 0; j < combs; ++j) {
            offsets[j] = random.uniform();
        }
        double depths[C][SeriesOrder::kMost + 1] = {};
        std::array<double, C> exact{};
        for (size_t i = 0; i < count;) {
            const Stretch kind = kindOf(i);
            const double tEnter = cursor.tEnter(i);
            if (kind == Stretch::kHomogeneous) {
                for (size_t c = 0; c < C; ++c) {
                    exact[c] += superVoxels.scale(c) *
                                static_cast<double>(cursor.record(i, c).min) *
                                (cursor.tExit(i) - tEnter);
                }
                ++i;
                continue;
            }
            double tExit = cursor.tExit(i);
            for (++i; i < count && cursor.tEnter(i) == tExit && kindOf(i) == kind; ++i) {
                tExit = cursor.tExit(i);
            }
            if (kind == Stretch::kRough) {
                uint64_t bricks = 0;
                const auto depth = field.integrate(ray, tEnter, tExit, cost.lookups, bricks);
                for (size_t c = 0; c < C; ++c) {
                    exact[c] += depth[c];
                }
                cost.exactLength += tExit - tEnter;
            } else {
                const double points = std::ceil((tExit - tEnter) / step);
                std::array<double, C> found[SeriesOrder::kMost + 1];
                std::fill_n(found, combs, std::array<double, C>{});
                cost.lookups += field.addSamples(ray, tEnter, tExit, points, offsets, combs, found);
                for (size_t j = 0; j < combs; ++j) {
                    for (size_t c = 0; c < C; ++c) {
                        depths[c][j] += unit * (tExit - tEnter) / points * found[j][c];
                    }
                }
                isRandom = true;
            }
        }
        for (size_t c = 0; c < C; ++c) {
            sofar.multiply(c, seriesEstimate(depths[c], series.order()));
            sofar.integrate(c, unit * exact[c] + depths[c][0]);
        }
        cost.random = cost.random || isRandom;
        if (sofar.isZero()) {
            return values;
        }
    }
    for (size_t c = 0; c < C; ++c) {
        values[c] = sofar.value(c);
    }
    return values;
}

}  // namespace trk
