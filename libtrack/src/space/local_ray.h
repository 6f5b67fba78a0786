// SPDX-License-Identifier: Apache-2.0
// A ray as everything behind the C API sees it.
#pragma once

#include "geometry.h"

namespace trk {

/// A ray in local space (voxels, relative to the volume's anchor), clipped and re-origined: it
/// starts at t = 0 inside the volume's box. `direction` has unit length, so t counts voxels.
struct LocalRay {
    Vec3d origin;
    Vec3d direction;
    Vec3d inverse;  ///< 1 / direction; huge where that is 0, so that its planes are never next
    double tEnd = 0;

    Vec3d at(double t) const { return origin + t * direction; }
};

}  // namespace trk
