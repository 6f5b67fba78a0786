// SPDX-License-Identifier: Apache-2.0
// The variance that a method's formula gives.
#pragma once

#include "track/track.h"
#include "volume.h"

#include <array>

namespace vdbtools {

/// Per channel, the variance of one estimate of residual or ratio tracking as `query` asks for it,
/// but without roulette: T^2 (exp(integral of residual^2 / rate) - 1) over what is not integrated
/// exactly [Novak14]. The method must be one of the two.
std::array<double, 3> predictVariance(const trk::Volume& volume, const TrkQuery& query,
                                      const TrkRay& ray);

}  // namespace vdbtools
