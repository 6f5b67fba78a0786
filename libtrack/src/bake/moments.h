// SPDX-License-Identifier: Apache-2.0
// Statistics of cubes of cells of one brick, in one channel. Vertices are summed column by column,
// which the compiler turns into vector code; the order is always the same.
#pragma once

#include "control/control_shape.h"
#include "control_fit.h"
#include "field/density_field.h"

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <type_traits>

namespace trk {

/// Statistics of a cube of M^3 cells over its (M+1)^3 vertices. `mean` and `squares` (the sum of
/// squared deviations from it) weigh a vertex by the part of it inside the cube, so that cubes side
/// by side add up without counting a shared face twice.
struct Moments {
    float min = 0;
    float max = 0;
    double mean = 0;
    double squares = 0;
};

inline Moments constantMoments(float value) {
    return {value, value, static_cast<double>(value), 0};
}

inline CornerMoments constantCorners(float value) {
    CornerMoments corners{};
    corners.fill(0.125 * static_cast<double>(value));
    return corners;
}

/// The weight of vertex `i` of `last` + 1 on a line.
constexpr double trapezoid(size_t i, size_t last) {
    return i == 0 || i == last ? 0.5 : 1.0;
}

/// Calls f(std::integral_constant<size_t, edge>) for an edge of cubes: 1, 2, 4 or 8.
template <class F>
auto withEdge(size_t edge, const F& f) {
    switch (edge) {
        case 1:
            return f(std::integral_constant<size_t, 1>{});
        case 2:
            return f(std::integral_constant<size_t, 2>{});
        case 4:
            return f(std::integral_constant<size_t, 4>{});
        default:
            return f(std::integral_constant<size_t, 8>{});
    }
}

/// The first vertex of a row of a cube, given the cube's own, of a channel as
/// DensityField::brickChannel gives it.
inline const float* cubeRow(const float* cube, size_t x, size_t y) {
    return cube + (x * DensityField::kBrickEdge + y) * DensityField::kBrickEdge;
}

/// The sum of weight x term(value, z) over the vertices of a cube of M^3 cells; f(x, y, row) gives
/// the term of a row.
template <size_t M, class TermOf>
double weightedSum(const float* cube, const TermOf& termOf) {
    double columns[M + 1] = {};
    for (size_t x = 0; x <= M; ++x) {
        for (size_t y = 0; y <= M; ++y) {
            const float* row = cubeRow(cube, x, y);
            const double weight = trapezoid(x, M) * trapezoid(y, M);
            const auto term = termOf(x, y);
            for (size_t z = 0; z <= M; ++z) {
                columns[z] += weight * term(static_cast<double>(row[z]), z);
            }
        }
    }
    double sum = 0.5 * (columns[0] + columns[M]);
    for (size_t z = 1; z < M; ++z) {
        sum += columns[z];
    }
    return sum;
}

/// The mean over a cube of M^3 cells; of equal values, that very value.
template <size_t M>
double cubeMean(const float* cube) {
    return weightedSum<M>(
               cube, [](size_t, size_t) { return [](double value, size_t) { return value; }; }) /
           static_cast<double>(M * M * M);
}

/// Moments of a cube of M^3 cells, and those of its corners. Two passes over values that are in L1:
/// deviations from the mean do not cancel.
template <size_t M>
Moments cubeMoments(const float* cube, CornerMoments& corners) {
    constexpr auto kEdge = static_cast<double>(M);
    Moments m;
    float lo[M + 1];
    float hi[M + 1];
    std::copy_n(cube, M + 1, lo);
    std::copy_n(cube, M + 1, hi);
    double columns[4][M + 1] = {};  // by corner in x and y
    for (size_t x = 0; x <= M; ++x) {
        double plane[2][M + 1] = {};  // by corner in y, the upper one; and both
        for (size_t y = 0; y <= M; ++y) {
            const float* row = cubeRow(cube, x, y);
            const double weight = trapezoid(y, M);
            const double upper = weight * static_cast<double>(y) / kEdge;
            for (size_t z = 0; z <= M; ++z) {
                lo[z] = row[z] < lo[z] ? row[z] : lo[z];
                hi[z] = row[z] > hi[z] ? row[z] : hi[z];
                const auto value = static_cast<double>(row[z]);
                plane[0][z] += upper * value;
                plane[1][z] += weight * value;
            }
        }
        const double upper = trapezoid(x, M) * static_cast<double>(x) / kEdge;
        const double lower = trapezoid(x, M) - upper;
        for (size_t z = 0; z <= M; ++z) {
            const double lowerPlane = plane[1][z] - plane[0][z];
            columns[0][z] += lower * lowerPlane;
            columns[1][z] += lower * plane[0][z];
            columns[2][z] += upper * lowerPlane;
            columns[3][z] += upper * plane[0][z];
        }
    }
    m.min = *std::min_element(lo, lo + M + 1);
    m.max = *std::max_element(hi, hi + M + 1);
    if (m.min == m.max) {
        corners = constantCorners(m.min);
        return constantMoments(m.min);
    }
    for (size_t k = 0; k < 4; ++k) {
        const double* column = columns[k];
        double sum = 0.5 * (column[0] + column[M]);
        double upper = 0.5 * column[M];
        for (size_t z = 1; z < M; ++z) {
            sum += column[z];
            upper += column[z] * (static_cast<double>(z) / kEdge);
        }
        corners[2 * k] = (sum - upper) / (kEdge * kEdge * kEdge);
        corners[2 * k + 1] = upper / (kEdge * kEdge * kEdge);
    }
    for (const double corner : corners) {
        m.mean += corner;
    }
    m.squares = weightedSum<M>(cube, [&](size_t, size_t) {
        return [&](double value, size_t) { return (value - m.mean) * (value - m.mean); };
    });
    return m;
}

/// What a control leaves of a cube's vertices.
struct ResidualMoments {
    double majorant = 0;
    double squares = 0;  ///< weighed as in Moments
};

/// Adds a cube of M^3 cells, whose first vertex lies at `start` of the control's super-voxel, in
/// [-1/2, 1/2]^3, its vertices `step` apart.
template <size_t M>
void addResidual(const float* cube, const ControlPolynomial& control, const Vec3d& start,
                 double step, ResidualMoments& residual) {
    double largest[M + 1] = {};
    residual.squares += weightedSum<M>(cube, [&](size_t x, size_t y) {
        // Linear along a row, whatever the kind.
        const double ux = start[0] + step * static_cast<double>(x);
        const double uy = start[1] + step * static_cast<double>(y);
        const double first = control.at({{ux, uy, start[2]}});
        const double slope = control.slopeZ(ux, uy) * step;
        return [first, slope, &largest](double value, size_t z) {
            const double r = value - (first + slope * static_cast<double>(z));
            const double size = std::fabs(r);
            largest[z] = size > largest[z] ? size : largest[z];
            return r * r;
        };
    });
    for (const double l : largest) {
        residual.majorant = std::max(residual.majorant, l);
    }
}

}  // namespace trk
