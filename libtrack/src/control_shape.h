// SPDX-License-Identifier: Apache-2.0
// The kinds of control and how each varies inside its super-voxel.
#pragma once

#include "math.h"

#include <array>
#include <cstddef>
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
template <class Real>
struct ControlPolynomial {
    Real centre = 0;
    std::array<Real, 7> slope{};

    double at(const Vec3d& u) const {
        return static_cast<double>(centre) +
               evaluateSlope<ControlKind::kTrilinear>(slope.data(), u);
    }
    /// The largest value at a corner, and anywhere in the super-voxel.
    double max() const {
        double result = at({{-0.5, -0.5, -0.5}});
        for (int corner = 1; corner < 8; ++corner) {
            result = std::max(result, at({{corner & 4 ? 0.5 : -0.5, corner & 2 ? 0.5 : -0.5,
                                           corner & 1 ? 0.5 : -0.5}}));
        }
        return result;
    }
    bool isConstant() const { return slope == std::array<Real, 7>{}; }
};

/// The control that a bake's `mean` and `shape` stand for, in super-voxels of `size` voxels.
inline ControlPolynomial<double> controlPolynomial(ControlKind kind, float mean, const float* shape,
                                                   int size) {
    ControlPolynomial<double> p;
    p.centre = static_cast<double>(mean);
    if (kind == ControlKind::kAffine) {
        for (size_t a = 0; a < 3; ++a) {
            p.slope[a] = static_cast<double>(shape[a]) * size;
        }
    } else if (kind == ControlKind::kTrilinear) {
        // Each coefficient is a mean of signed corners: a product of differences along its axes and
        // averages along the others.
        constexpr int kAxes[8] = {0, 4, 2, 1, 6, 5, 3, 7};  // bit 4 stands for x, 2 for y, 1 for z
        for (size_t k = 0; k < 8; ++k) {
            double sum = 0;
            double scale = 0.125;
            for (int corner = 0; corner < 8; ++corner) {
                double sign = 1;
                for (const int bit : {4, 2, 1}) {
                    sign *= (kAxes[k] & bit) != 0 && (corner & bit) == 0 ? -1 : 1;
                }
                sum += sign * static_cast<double>(shape[corner]);
            }
            for (const int bit : {4, 2, 1}) {
                scale *= (kAxes[k] & bit) != 0 ? 2 : 1;
            }
            (k == 0 ? p.centre : p.slope[k - 1]) = sum * scale;
        }
    }
    return p;
}

}  // namespace trk
