// SPDX-License-Identifier: Apache-2.0
// Pinhole cameras that look at a volume.
#pragma once

#include "geometry.h"
#include "track/track.h"

#include <string>
#include <vector>

namespace vdbtools {

/// A camera in world space; y is up.
struct Camera {
    trk::Vec3d eye;
    trk::Vec3d right;  // of unit length, like the other two
    trk::Vec3d up;
    trk::Vec3d forward;
    double tangent = 0.3;  // of half the vertical field of view

    /// The ray through a point of the picture: x and y from 0 (left, top) to 1, `aspect` width over
    /// height. Its direction has unit length.
    TrkRay ray(double x, double y, double aspect) const;

    /// The camera turned by an angle (radians) around the vertical through `centre`.
    Camera orbited(const trk::Vec3d& centre, double angle) const;
};

/// "front" looks along -z, "side" along -x, "top" along -y, "iso" along all three.
const std::vector<std::string>& viewNames();
Camera namedView(const std::string& view);

/// A camera at `eye` that looks at `target`. `fov`: vertical field of view in degrees.
Camera cameraAt(const trk::Vec3d& eye, const trk::Vec3d& target, double fov);

/// A box in world space.
struct WorldBox {
    trk::Vec3d lo;
    trk::Vec3d hi;
    trk::Vec3d centre() const { return 0.5 * (lo + hi); }
};

/// Moves the camera back until the whole box is in the picture, with a margin.
void frameBox(Camera& camera, const WorldBox& box, double aspect);

}  // namespace vdbtools
