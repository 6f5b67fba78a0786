// SPDX-License-Identifier: Apache-2.0
// The variance that a method's formula gives.
#pragma once

#include "track/track.h"
#include "volume.h"

#include <array>

namespace vdbtools {

/// Per channel, the variance of one estimate of residual or ratio tracking as `query` asks for it,
/// but without roulette: T^2 (exp(integral of residual^2 / rate) - 1) over what is not integrated
/// exactly [Novak14]; of delta tracking, T (1 - T). The method must be one of the three.
std::array<double, 3> predictVariance(const trk::Volume& volume, const TrkQuery& query,
                                      const TrkRay& ray);

/// What an estimate of such a method costs, and what integrating the whole ray exactly does, in
/// random look-ups (see ExactCost in estimate/tracking.h); of delta tracking, at most.
struct PredictedCost {
    double estimate = 0;
    double exact = 0;
};
PredictedCost predictCost(const trk::Volume& volume, const TrkQuery& query, const TrkRay& ray);

}  // namespace vdbtools
