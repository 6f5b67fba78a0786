// SPDX-License-Identifier: Apache-2.0
#include "camera.h"

#include <algorithm>
#include <cmath>
#include <limits>

namespace vdbtools {

using trk::Vec3d;

namespace {

constexpr double kPi = 3.14159265358979323846;

Vec3d normalized(const Vec3d& v) {
    return (1 / length(v)) * v;
}

Camera look(const Vec3d& forward, const Vec3d& roughlyUp) {
    Camera camera;
    camera.forward = normalized(forward);
    camera.right = normalized(cross(camera.forward, roughlyUp));
    camera.up = cross(camera.right, camera.forward);
    return camera;
}

}  // namespace

TrkRay Camera::ray(double x, double y, double aspect) const {
    const Vec3d d = normalized(forward + ((2 * x - 1) * tangent * aspect) * right +
                               ((1 - 2 * y) * tangent) * up);
    TrkRay ray;
    for (int a = 0; a < 3; ++a) {
        ray.origin[a] = static_cast<float>(eye[a]);
        ray.direction[a] = static_cast<float>(d[a]);
    }
    ray.tMin = 0;
    ray.tMax = std::numeric_limits<float>::infinity();
    return ray;
}

Camera Camera::orbited(UpAxis axis, const Vec3d& centre, double angle) const {
    const double c = std::cos(angle);
    const double s = std::sin(angle);
    const auto turn = [&](const Vec3d& world) {
        const Vec3d v = fromWorld(axis, world);
        return toWorld(axis, {{c * v[0] + s * v[2], v[1], c * v[2] - s * v[0]}});
    };
    Camera turned = *this;
    turned.eye = centre + turn(eye - centre);
    turned.right = turn(right);
    turned.up = turn(up);
    turned.forward = turn(forward);
    return turned;
}

trk::AffineMap Camera::worldToCamera() const {
    trk::AffineMap map;
    const Vec3d rows[3] = {right, up, -1.0 * forward};
    for (int row = 0; row < 3; ++row) {
        for (int column = 0; column < 3; ++column) {
            map.linear[row][column] = rows[row][column];
        }
        map.translation[row] = -dot(rows[row], eye);
    }
    return map;
}

Vec3d toWorld(UpAxis up, const Vec3d& v) {
    return up == UpAxis::kY ? v : Vec3d{{v[0], -v[2], v[1]}};
}

Vec3d fromWorld(UpAxis up, const Vec3d& v) {
    return up == UpAxis::kY ? v : Vec3d{{v[0], v[2], -v[1]}};
}

const std::vector<std::string>& viewNames() {
    static const std::vector<std::string> names{"front", "side", "top", "iso"};
    return names;
}

Camera namedView(const std::string& view, UpAxis up) {
    const auto looking = [up](const Vec3d& forward, const Vec3d& roughlyUp) {
        return look(toWorld(up, forward), toWorld(up, roughlyUp));
    };
    const Vec3d y{{0, 1, 0}};
    if (view == "front") {
        return looking({{0, 0, -1}}, y);
    }
    if (view == "side") {
        return looking({{-1, 0, 0}}, y);
    }
    if (view == "top") {
        return looking({{0, -1, 0}}, {{0, 0, -1}});
    }
    return looking({{-1, -0.62, -1}}, y);
}

Camera cameraAt(const Vec3d& eye, const Vec3d& target, double fov, UpAxis up) {
    const Vec3d unit = normalized(target - eye);
    const bool steep = std::fabs(fromWorld(up, unit)[1]) > 0.999;
    Camera camera = look(unit, toWorld(up, steep ? Vec3d{{0, 0, -1}} : Vec3d{{0, 1, 0}}));
    camera.eye = eye;
    camera.tangent = std::tan(fov * kPi / 360);
    return camera;
}

void frameBox(Camera& camera, const WorldBox& box, double aspect) {
    const Vec3d half = 0.5 * (box.hi - box.lo);
    constexpr double kMargin = 1.06;
    double distance = length(half) > 0 ? 0 : 1;
    for (int corner = 0; corner < 8; ++corner) {
        Vec3d p;
        for (int a = 0; a < 3; ++a) {
            p[a] = corner >> a & 1 ? half[a] : -half[a];
        }
        const double depth = -dot(p, camera.forward);
        const double x = std::fabs(dot(p, camera.right)) / (camera.tangent * aspect);
        const double y = std::fabs(dot(p, camera.up)) / camera.tangent;
        distance = std::max(distance, depth + kMargin * std::max(x, y));
    }
    camera.eye = box.centre() - distance * camera.forward;
}

}  // namespace vdbtools
