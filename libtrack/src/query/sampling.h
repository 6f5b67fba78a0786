// SPDX-License-Identifier: Apache-2.0
// Free paths and the extinction at points.
#pragma once

#include "batch.h"
#include "track/track.h"
#include "volume.h"

namespace trk {

/// Where a batch puts its free paths: arrays that, but for `t`, may be none.
struct FreePathOutput {
    Array<float> t;
    Array<float> weight;
    Array<float> extinction;
    Array<uint32_t> lookups;
};

/// As trkSampleFreePath, with `query` checked and complete. Throws Error before any result is
/// written.
void sampleFreePaths(const Volume& volume, const TrkQuery& query, const TrkRay* rays,
                     size_t rayCount, const FreePathOutput& paths);

/// As trkSampleExtinction. Likewise.
void sampleExtinction(const Volume& volume, const Array<const float>& points, size_t pointCount,
                      const Array<float>& extinction);

}  // namespace trk
