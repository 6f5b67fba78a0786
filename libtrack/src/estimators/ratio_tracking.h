// SPDX-License-Identifier: Apache-2.0
// Residual ratio tracking and ratio tracking over super-voxels [Novak14].
#pragma once

#include "path_cost.h"
#include "scaled_product.h"

#include "../sparse_table.h"

#include <array>
#include <cstddef>

namespace trk {

/// Which part of the extinction is integrated analytically, and at what rate the rest is sampled:
/// a control and a bound of what it leaves, both in extinction, per channel.
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
    static double bound(const SuperVoxel& v, size_t channel) {
        return static_cast<double>(v[channel].bound);
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
        return isHomogeneous(v, channel) ? static_cast<double>(v[channel].baked) * (t1 - t0) : 0.0;
    }
    template <class SuperVoxel>
    static double bound(const SuperVoxel& v, size_t channel) {
        return isHomogeneous(v, channel) ? 0.0 : static_cast<double>(v[channel].max);
    }

  private:
    template <class SuperVoxel>
    static bool isHomogeneous(const SuperVoxel& v, size_t channel) {
        return v[channel].baked == v[channel].max;
    }
};

struct TrackingSettings {
    double lengthPerVoxel = 1;  ///< world length of one voxel length along the ray
    double rate = 1;            ///< multiplies the bound
    bool exactFallback = true;
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
    std::array<ScaledProduct, C> products;
    std::array<double, C> opticalDepth{};
    // Optical distance (in units of the rate) to the next collision; carried over from one
    // super-voxel to the next, as the exponential distribution has no memory: one logarithm a
    // look-up, none where there is none.
    double distance = random.exponential();
    const double cellsPerVoxel =
        std::fabs(ray.direction[0]) + std::fabs(ray.direction[1]) + std::fabs(ray.direction[2]);
    superVoxels.walk(ray, 0, ray.tEnd, [&](const auto& v, double tEnter, double tExit) {
        ++cost.superVoxels;
        double bound = Method::bound(v, 0);
        for (size_t c = 1; c < C; ++c) {
            bound = std::max(bound, Method::bound(v, c));
        }
        const double rate = bound * settings.rate;
        const double ratePerVoxel = rate * settings.lengthPerVoxel;
        double remaining = ratePerVoxel * (tExit - tEnter);
        // Decided from the expected number of collisions, not the drawn one, which would be bias.
        if (settings.exactFallback && remaining > 2 * (1 + cellsPerVoxel * (tExit - tEnter))) {
            uint64_t bricks = 0;
            const auto exact = field.integrate(ray, tEnter, tExit, cost.lookups, bricks);
            for (size_t c = 0; c < C; ++c) {
                opticalDepth[c] += settings.lengthPerVoxel * exact[c];
            }
            cost.exactLength += tExit - tEnter;
            return true;
        }
        for (size_t c = 0; c < C; ++c) {
            opticalDepth[c] +=
                settings.lengthPerVoxel * Method::integrate(v, c, ray, tEnter, tExit);
        }
        while (distance < remaining) {
            remaining -= distance;
            const Vec3d point = ray.at(tExit - remaining / ratePerVoxel);
            const auto extinction = field.extinction(point);
            bool allZero = true;
            for (size_t c = 0; c < C; ++c) {
                // A channel without residual here keeps its weight to the bit.
                if (C == 1 || Method::bound(v, c) > 0) {
                    products[c].multiply(1 - (extinction[c] - Method::control(v, c, point)) / rate);
                }
                allZero = allZero && products[c].isZero();
            }
            ++cost.lookups;
            if (allZero) {
                return false;
            }
            distance = random.exponential();
        }
        distance -= remaining;
        return true;
    });
    std::array<double, C> result;
    for (size_t c = 0; c < C; ++c) {
        result[c] = products[c].timesExp(opticalDepth[c]);
    }
    return result;
}

}  // namespace trk
