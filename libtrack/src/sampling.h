// SPDX-License-Identifier: Apache-2.0
// Free paths and the extinction at points.
#pragma once

#include "track/track.h"
#include "volume.h"

namespace trk {

/// As trkSampleFreePath, with `query` checked and complete. Throws Error before any result is
/// written.
void sampleFreePaths(const Volume& volume, const TrkQuery& query, const TrkRay* rays,
                     size_t rayCount, TrkFreePath* results);

/// As trkSampleExtinction, with `pointStride` complete. Likewise.
void sampleExtinction(const Volume& volume, const float* points, size_t pointStride,
                      size_t pointCount, float* extinction);

}  // namespace trk
