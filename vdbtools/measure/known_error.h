// SPDX-License-Identifier: Apache-2.0
// Estimates by random methods whose standard error is known before they are drawn.
#pragma once

#include "track/track.h"
#include "volume.h"

#include <array>
#include <cstdint>

namespace vdbtools {

/// One ray's transmittance, per channel.
struct KnownErrorEstimate {
    std::array<float, 3> transmittance{};
    std::array<float, 3> standardError{};  ///< true; 0 where it was integrated exactly
    std::array<double, 3> opticalDepth{};  ///< NaN unless it was integrated exactly
    uint64_t lookups = 0;
    uint32_t samples = 0;  ///< 0 where it was integrated exactly
};

/// By residual, ratio or delta tracking as `query` asks, without roulette, whose variance a formula
/// gives (see predictVariance). What samples show of their own variance misses the tails that
/// decide, by far in deep volumes, and a number of samples that depends on what they show is
/// biased; this does neither. `wantedError`: how many samples are taken is what a standard error of
/// this, of the worst channel, needs, query.samples at most, or none, and the ray is integrated
/// exactly, where that costs less; 0: query.samples.
KnownErrorEstimate estimateWithKnownError(const trk::Volume& volume, const TrkQuery& query,
                                          const TrkRay& ray, uint64_t rayId, double wantedError);

}  // namespace vdbtools
