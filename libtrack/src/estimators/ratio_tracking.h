// SPDX-License-Identifier: Apache-2.0
// Residual ratio tracking and ratio tracking over super-voxels [Novak14].
#pragma once

#include "path_cost.h"
#include "scaled_product.h"

#include "../sparse_table.h"

namespace trk {

/// Which part of the extinction is integrated analytically, and at what rate the rest is sampled:
/// a control and a bound of what it leaves, both in extinction.
struct ResidualControl {
    template <class SuperVoxel>
    static double control(const SuperVoxel& v) {
        return static_cast<double>(v.control);
    }
    template <class SuperVoxel>
    static double bound(const SuperVoxel& v) {
        return static_cast<double>(v.bound);
    }
};

/// Ratio tracking is residual ratio tracking with nothing taken out, except where a super-voxel is
/// homogeneous: there the control is exact and nothing is left.
struct NoControl {
    template <class SuperVoxel>
    static double control(const SuperVoxel& v) {
        return v.bound > 0 ? 0.0 : static_cast<double>(v.control);
    }
    template <class SuperVoxel>
    static double bound(const SuperVoxel& v) {
        return v.bound > 0 ? static_cast<double>(v.max) : 0.0;
    }
};

struct TrackingSettings {
    double scale = 1;           ///< extinction of a density of 1
    double lengthPerVoxel = 1;  ///< world length of one voxel length along the ray
    double rate = 1;            ///< multiplies the bound
    bool exactFallback = true;
};

/// One estimate of the transmittance of the whole ray:
///   exp(-integral of control) x product over collisions of (1 - (extinction - control) / rate),
/// collisions at `rate` per world length [Novak14, Eq. 4]. Unbiased for any rate > 0 wherever the
/// residual is not 0. `superVoxels.walk(ray, t0, t1, visit)` yields the segments, `field.density`
/// and `field.integrate` the density.
template <class Method, class Field, class SuperVoxels, class Random>
double trackTransmittance(const Field& field, const SuperVoxels& superVoxels, const LocalRay& ray,
                          const TrackingSettings& settings, Random& random, PathCost& cost) {
    ScaledProduct product;
    double opticalDepth = 0;
    // Optical distance (in units of the rate) to the next collision; carried over from one
    // super-voxel to the next, as the exponential distribution has no memory: one logarithm a
    // look-up, none where there is none.
    double distance = random.exponential();
    const double cellsPerVoxel =
        std::fabs(ray.direction[0]) + std::fabs(ray.direction[1]) + std::fabs(ray.direction[2]);
    superVoxels.walk(ray, 0, ray.tEnd, [&](const auto& v, double tEnter, double tExit) {
        ++cost.superVoxels;
        const double control = Method::control(v);
        const double rate = Method::bound(v) * settings.rate;
        const double ratePerVoxel = rate * settings.lengthPerVoxel;
        double remaining = ratePerVoxel * (tExit - tEnter);
        // Decided from the expected number of collisions, not the drawn one, which would be bias.
        if (settings.exactFallback && remaining > 2 * (1 + cellsPerVoxel * (tExit - tEnter))) {
            uint64_t bricks = 0;
            opticalDepth += settings.scale * settings.lengthPerVoxel *
                            field.integrate(ray, tEnter, tExit, cost.lookups, bricks);
            cost.exactLength += tExit - tEnter;
            return true;
        }
        opticalDepth += control * settings.lengthPerVoxel * (tExit - tEnter);
        while (distance < remaining) {
            remaining -= distance;
            const double density = field.density(ray.at(tExit - remaining / ratePerVoxel));
            product.multiply(1 - (settings.scale * density - control) / rate);
            ++cost.lookups;
            if (product.isZero()) {
                return false;
            }
            distance = random.exponential();
        }
        distance -= remaining;
        return true;
    });
    return product.timesExp(opticalDepth);
}

}  // namespace trk
