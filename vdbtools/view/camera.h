// SPDX-License-Identifier: Apache-2.0
// Pinhole cameras that look at a volume.
#pragma once

#include "space/geometry.h"
#include "track/track.h"

#include <string>
#include <vector>

namespace vdbtools {

/// Which axis of world space points up.
enum class UpAxis { kY, kZ };

/// A direction given with y up and z towards the front, as one of world space, and back. With z up,
/// the front is at -y.
trk::Vec3d toWorld(UpAxis up, const trk::Vec3d& v);
trk::Vec3d fromWorld(UpAxis up, const trk::Vec3d& v);

/// A camera in world space.
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
    Camera orbited(UpAxis up, const trk::Vec3d& centre, double angle) const;

    /// From world space to the camera's: x right, y up, the camera at 0 looking along -z.
    trk::AffineMap worldToCamera() const;
};

/// "front" looks at the front, "side" along -x, "top" down, "iso" along all three.
const std::vector<std::string>& viewNames();
Camera namedView(const std::string& view, UpAxis up = UpAxis::kY);

/// A camera at `eye` that looks at `target`. `fov`: vertical field of view in degrees.
Camera cameraAt(const trk::Vec3d& eye, const trk::Vec3d& target, double fov,
                UpAxis up = UpAxis::kY);

/// A box in world space.
struct WorldBox {
    trk::Vec3d lo;
    trk::Vec3d hi;
    trk::Vec3d centre() const { return 0.5 * (lo + hi); }
};

/// Moves the camera back until the whole box is in the picture, with a margin.
void frameBox(Camera& camera, const WorldBox& box, double aspect);

}  // namespace vdbtools
