// SPDX-License-Identifier: Apache-2.0
// Batches of rays: method x control over TBB.
#pragma once

#include "track/track.h"
#include "volume.h"

namespace trk {

/// As trkEstimateTransmittance, with `query` checked and complete. Throws Error before any result
/// is written.
void estimateTransmittance(const Volume& volume, const TrkQuery& query, const TrkRay* rays,
                           size_t rayCount, float* transmittance, TrkStatistics* statistics);

/// As trkIntegrateOpticalDepth, likewise.
void integrateOpticalDepth(const Volume& volume, const TrkQuery& query, const TrkRay* rays,
                           size_t rayCount, double* opticalDepth);

}  // namespace trk
