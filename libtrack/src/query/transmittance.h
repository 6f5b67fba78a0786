// SPDX-License-Identifier: Apache-2.0
// Batches of rays: method x control over TBB.
#pragma once

#include "batch.h"
#include "track/track.h"
#include "volume.h"

namespace trk {

/// Where a batch puts what it took: arrays that may be none.
struct StatisticsOutput {
    Array<float> standardError;
    Array<uint64_t> lookups;
    Array<uint64_t> superVoxels;
    Array<float> exactShare;
};

/// A standard error as float; what is not 0 stays so, also in a host that flushes denormals.
float roundedError(double value);

/// As trkEstimateTransmittance, with `query` checked and complete. Throws Error before any result
/// is written.
void estimateTransmittance(const Volume& volume, const TrkQuery& query, const TrkRay* rays,
                           size_t rayCount, const Array<float>& transmittance,
                           const StatisticsOutput& statistics);

/// As trkIntegrateOpticalDepth, likewise.
void integrateOpticalDepth(const Volume& volume, const TrkQuery& query, const TrkRay* rays,
                           size_t rayCount, const Array<double>& opticalDepth);

}  // namespace trk
