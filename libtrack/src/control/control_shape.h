// SPDX-License-Identifier: Apache-2.0
// The kinds of control and how each varies inside its super-voxel.
#pragma once

#include "space/geometry.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <functional>
#include <limits>
#include <string>

namespace trk {

/// Within a super-voxel, the control is
///   constant   the mean;
///   affine     the mean at the centre, and a gradient: three numbers, density per voxel along the
///              index axes; discontinuous at faces;
///   trilinear  interpolated between eight corner values, which neighbours share: continuous.
enum class ControlKind { kConstant, kTrilinear, kAffine };

inline const char* controlName(ControlKind kind) {
    switch (kind) {
        case ControlKind::kTrilinear:
            return "trilinear";
        case ControlKind::kAffine:
            return "affine";
        case ControlKind::kConstant:
            break;
    }
    return "constant";
}

/// The gradient (density per voxel) of an affine control, from the least-squares one of the
/// density: the nearest for which the control, whose mean is given, is >= 0 everywhere in a
/// super-voxel of `size` voxels, and a float. Least squares are isotropic in the gradient, and such
/// are those with |gx| + |gy| + |gz| <= mean / (size / 2): all components are shortened by the same
/// amount [Duchi et al. 2008].
inline std::array<float, 3> constrainGradient(const float* gradient, double mean, int size) {
    constexpr auto kLargest = static_cast<double>(std::numeric_limits<float>::max());
    const double limit = 2 * std::min(mean, kLargest - mean) / size;
    std::array<double, 3> sizes{};
    for (size_t axis = 0; axis < 3; ++axis) {
        sizes[axis] = std::fabs(static_cast<double>(gradient[axis]));
    }
    std::sort(sizes.begin(), sizes.end(), std::greater<>());
    double shorten = 0;
    double sum = 0;
    for (size_t i = 0; i < 3; ++i) {
        sum += sizes[i];
        const double candidate = (sum - limit) / static_cast<double>(i + 1);
        if (candidate < sizes[i]) {
            shorten = std::max(candidate, 0.0);
        }
    }
    std::array<float, 3> result{};
    for (size_t axis = 0; axis < 3; ++axis) {
        const double length =
            std::max(std::fabs(static_cast<double>(gradient[axis])) - shorten, 0.0);
        // Rounded towards 0, lest rounding makes a corner negative.
        auto g = static_cast<float>(length);
        g = static_cast<double>(g) > length ? std::nextafter(g, 0.0f) : g;
        result[axis] = gradient[axis] < 0 ? -g : g;
    }
    return result;
}

/// Numbers a bake stores besides the mean: a gradient (x, y, z), or corner values (x slowest).
constexpr size_t shapeSize(ControlKind kind) {
    return kind == ControlKind::kConstant ? 0 : kind == ControlKind::kAffine ? 3 : 8;
}

/// Coefficients besides the value at the centre: of x, y, z, and for a trilinear control of xy, xz,
/// yz, xyz.
constexpr size_t slopeSize(ControlKind kind) {
    return kind == ControlKind::kConstant ? 0 : kind == ControlKind::kAffine ? 3 : 7;
}

/// What a control adds to its value at the centre, at u in [-1/2, 1/2]^3 of its super-voxel.
template <ControlKind K, class Real>
double evaluateSlope(const Real* s, const Vec3d& u) {
    if constexpr (K == ControlKind::kConstant) {
        return 0;
    } else {
        const auto k = [s](size_t i) { return static_cast<double>(s[i]); };
        const double affine = u[0] * k(0) + u[1] * k(1) + u[2] * k(2);
        if constexpr (K == ControlKind::kAffine) {
            return affine;
        } else {
            return affine + u[0] * (u[1] * (k(3) + u[2] * k(6)) + u[2] * k(4)) + u[1] * u[2] * k(5);
        }
    }
}

/// A control of any kind as a polynomial in u.
struct ControlPolynomial {
    double centre = 0;
    std::array<double, 7> slope{};

    double at(const Vec3d& u) const {
        return centre + evaluateSlope<ControlKind::kTrilinear>(slope.data(), u);
    }
    /// How it grows along z, in units of u, where x and y are these.
    double slopeZ(double x, double y) const {
        return slope[2] + x * slope[4] + y * slope[5] + x * y * slope[6];
    }
    /// The largest value at a corner, and anywhere in the super-voxel.
    double max() const {
        double result = at({{-0.5, -0.5, -0.5}});
        for (int corner = 1; corner < 8; ++corner) {
            result = std::max(
                result,
                at({{corner & 4 ? 0.5 : -0.5, corner & 2 ? 0.5 : -0.5, corner & 1 ? 0.5 : -0.5}}));
        }
        return result;
    }
};

/// The control that a bake's `mean` and `shape` stand for, in super-voxels of `size` voxels.
inline ControlPolynomial controlPolynomial(ControlKind kind, float mean, const float* shape,
                                           double size) {
    ControlPolynomial p;
    p.centre = static_cast<double>(mean);
    if (kind == ControlKind::kAffine) {
        for (size_t a = 0; a < 3; ++a) {
            p.slope[a] = static_cast<double>(shape[a]) * size;
        }
    } else if (kind == ControlKind::kTrilinear) {
        // Along each axis, pairs of corners become their average and their difference.
        std::array<double, 8> v{};
        std::copy(shape, shape + 8, v.begin());
        for (const size_t stride : {4u, 2u, 1u}) {
            for (size_t k = 0; k < 8; ++k) {
                if ((k & stride) == 0) {
                    const double lower = v[k];
                    v[k] = 0.5 * (lower + v[k + stride]);
                    v[k + stride] -= lower;
                }
            }
        }
        p.centre = v[0];
        p.slope = {{v[4], v[2], v[1], v[6], v[5], v[3], v[7]}};
    }
    return p;
}

}  // namespace trk
