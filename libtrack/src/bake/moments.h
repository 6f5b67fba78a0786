// SPDX-License-Identifier: Apache-2.0
// Statistics of cubes of cells of one brick, in one channel.
#pragma once

#include "../extinction_field.h"
#include "control_fit.h"

#include <algorithm>
#include <cstddef>

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
inline double trapezoid(size_t i, size_t last) {
    return i == 0 || i == last ? 0.5 : 1.0;
}

/// One channel of a brick of the field, or of a part of one.
struct BrickChannel {
    const float* first;  ///< vertex at the cube's origin

    const float* row(size_t x, size_t y) const {
        return first + (x * ExtinctionField::kBrickEdge + y) * ExtinctionField::kBrickEdge;
    }
};

inline CornerMoments cornerMoments(const BrickChannel& brick, size_t size) {
    CornerMoments corners{};
    const auto n = static_cast<double>(size);
    for (size_t x = 0; x <= size; ++x) {
        double plane[4] = {0, 0, 0, 0};  // by corner in y and z
        for (size_t y = 0; y <= size; ++y) {
            const float* row = brick.row(x, y);
            double sum = 0.5 * (static_cast<double>(row[0]) + static_cast<double>(row[size]));
            double upper = 0.5 * static_cast<double>(row[size]);
            for (size_t z = 1; z < size; ++z) {
                sum += static_cast<double>(row[z]);
                upper += static_cast<double>(row[z]) * (static_cast<double>(z) / n);
            }
            const double weight = trapezoid(y, size);
            const double up = static_cast<double>(y) / n;
            plane[0] += weight * (1 - up) * (sum - upper);
            plane[1] += weight * (1 - up) * upper;
            plane[2] += weight * up * (sum - upper);
            plane[3] += weight * up * upper;
        }
        const double weight = trapezoid(x, size) / (n * n * n);
        const double up = static_cast<double>(x) / n;
        for (size_t k = 0; k < 4; ++k) {
            corners[k] += weight * (1 - up) * plane[k];
            corners[4 + k] += weight * up * plane[k];
        }
    }
    return corners;
}

/// The sum of term(value) over the vertices of a cube of a brick, weighed by their part inside.
template <class Term>
double weightedSum(const BrickChannel& brick, size_t size, const Term& term) {
    double sum = 0;
    for (size_t x = 0; x <= size; ++x) {
        double plane = 0;
        for (size_t y = 0; y <= size; ++y) {
            const float* row = brick.row(x, y);
            double line = 0.5 * (term(row[0]) + term(row[size]));
            for (size_t z = 1; z < size; ++z) {
                line += term(row[z]);
            }
            plane += trapezoid(y, size) * line;
        }
        sum += trapezoid(x, size) * plane;
    }
    return sum;
}

/// The mean over a cube of `size`^3 cells of a brick; of equal values, that very value.
inline double cubeMean(const BrickChannel& brick, size_t size) {
    return weightedSum(brick, size, [](float v) { return static_cast<double>(v); }) /
           static_cast<double>(size * size * size);
}

/// Moments of one cube of `size`^3 cells of a brick. Two passes over values that are in L1:
/// deviations from the mean do not cancel.
inline Moments cubeMoments(const BrickChannel& brick, size_t size) {
    Moments m;
    m.min = m.max = *brick.first;
    for (size_t x = 0; x <= size; ++x) {
        for (size_t y = 0; y <= size; ++y) {
            const float* row = brick.row(x, y);
            for (size_t z = 0; z <= size; ++z) {
                m.min = std::min(m.min, row[z]);
                m.max = std::max(m.max, row[z]);
            }
        }
    }
    if (m.min == m.max) {
        return constantMoments(m.min);
    }
    m.mean = cubeMean(brick, size);
    m.squares = weightedSum(brick, size, [&](float v) {
        const double d = static_cast<double>(v) - m.mean;
        return d * d;
    });
    return m;
}

}  // namespace trk
