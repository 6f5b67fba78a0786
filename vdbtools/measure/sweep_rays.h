// SPDX-License-Identifier: Apache-2.0
// The rays a sweep measures on.
#pragma once

#include "track/track.h"
#include "volume.h"

#include <cstddef>
#include <cstdint>
#include <vector>

namespace vdbtools {

/// Rays of an iso view of the volume, on a jittered grid of pixels, those that hit: about `count`.
std::vector<TrkRay> cameraRays(const trk::Volume& volume, size_t count, uint64_t seed);

/// Rays that start where light from `rays` collides, one a ray, in all directions, shuffled; those
/// that hit.
std::vector<TrkRay> secondaryRays(const trk::Volume& volume, const std::vector<TrkRay>& rays,
                                  uint64_t seed);

/// Exact ones, `channels` a ray. In parallel.
std::vector<double> exactOpticalDepths(const trk::Volume& volume, const std::vector<TrkRay>& rays);

}  // namespace vdbtools
