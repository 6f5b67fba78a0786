// SPDX-License-Identifier: Apache-2.0
// What the random walks share: how they are set, what they spent, when they had better integrate.
#pragma once

#include "space/lanes.h"
#include "space/local_ray.h"

#include <cmath>
#include <cstdint>

namespace trk {

/// What an estimator spent on a ray.
struct PathCost {
    uint64_t lookups = 0;      ///< density values interpolated
    uint64_t superVoxels = 0;  ///< occupied regions met
    double exactLength = 0;    ///< voxel lengths integrated exactly
    bool random = false;       ///< another sample might have another result
};

/// What the rate of collisions is a multiple of: a bound of what is sampled, or its root mean
/// square.
enum class RateBase { kMajorant, kRms };

struct TrackingSettings {
    double lengthPerVoxel = 1;  ///< world length of one voxel length along the ray
    double rate = 1;            ///< multiplies the base
    RateBase rateBase = RateBase::kMajorant;
    bool exactFallback = true;
    bool roulette = true;         ///< of transmittance: see kRouletteThreshold
    bool wantsExtinction = true;  ///< of free paths: where they collide
};

/// How many random look-ups take as long as integrating voxel lengths exactly: half a one a cell,
/// whose values lie side by side (measured; see method.md). Whether an estimate of transmittance
/// takes more is decided from its expected number, not the drawn one, which would be bias.
class ExactCost {
  public:
    explicit ExactCost(const LocalRay& ray)
        : perVoxel_(0.5 * (std::fabs(ray.direction[0]) + std::fabs(ray.direction[1]) +
                           std::fabs(ray.direction[2]))) {}
    double operator()(double voxels) const { return 0.5 + perVoxel_ * voxels; }

  private:
    double perVoxel_;
};

/// More than this many look-ups in a super-voxel are never taken, whatever is asked for: the
/// steps of a walk would drown in the rounding of what remains, and it would never end.
inline constexpr double kMostLookups = 1e9;

/// How many look-ups are taken on voxel lengths of a ray before integrating them exactly is
/// preferred.
class MostLookups {
  public:
    MostLookups(const LocalRay& ray, const TrackingSettings& settings) {
        if (settings.exactFallback) {
            base_ = ExactCost(ray)(0);
            perVoxel_ = ExactCost(ray)(1) - base_;
        }
    }
    double operator()(double voxels) const { return base_ + perVoxel_ * voxels; }
    /// Of four lengths at once.
    void of(const Double4& voxels, Double4& most) const { most = base_ + perVoxel_ * voxels; }

  private:
    double base_ = kMostLookups;
    double perVoxel_ = 0;
};

}  // namespace trk
