// SPDX-License-Identifier: Apache-2.0
// The little geometry the library needs: vectors, affine maps and integer boxes, in double and
// 64 bit, so that neither far origins nor far voxels lose precision.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <limits>

namespace trk {

struct Vec3d {
    double x[3] = {0, 0, 0};

    double& operator[](int axis) { return x[axis]; }
    double operator[](int axis) const { return x[axis]; }
};

inline Vec3d operator+(const Vec3d& a, const Vec3d& b) {
    return {{a[0] + b[0], a[1] + b[1], a[2] + b[2]}};
}
inline Vec3d operator-(const Vec3d& a, const Vec3d& b) {
    return {{a[0] - b[0], a[1] - b[1], a[2] - b[2]}};
}
inline Vec3d operator*(double s, const Vec3d& a) {
    return {{s * a[0], s * a[1], s * a[2]}};
}
inline double dot(const Vec3d& a, const Vec3d& b) {
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}
inline Vec3d cross(const Vec3d& a, const Vec3d& b) {
    return {{a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]}};
}
inline double length(const Vec3d& a) {
    return std::sqrt(dot(a, a));
}

using Int3 = std::array<int64_t, 3>;

/// Box of voxels or cells, `lo` inside, `hi` outside.
struct IntBox {
    Int3 lo{{0, 0, 0}};
    Int3 hi{{0, 0, 0}};

    bool empty() const { return lo[0] >= hi[0] || lo[1] >= hi[1] || lo[2] >= hi[2]; }
    void add(const Int3& boxLo, const Int3& boxHi) {
        const bool first = empty();
        for (size_t a = 0; a < 3; ++a) {
            lo[a] = first ? boxLo[a] : std::min(lo[a], boxLo[a]);
            hi[a] = first ? boxHi[a] : std::max(hi[a], boxHi[a]);
        }
    }
    void add(const IntBox& box) {
        if (!box.empty()) {
            add(box.lo, box.hi);
        }
    }
};

/// The smallest float that is not below `value`; the largest one where `value` exceeds all.
inline float roundUp(double value) {
    constexpr float kLargest = std::numeric_limits<float>::max();
    if (value >= static_cast<double>(kLargest)) {
        return kLargest;
    }
    const auto nearest = static_cast<float>(value);
    return static_cast<double>(nearest) < value
               ? std::nextafter(nearest, std::numeric_limits<float>::infinity())
               : nearest;
}

/// The largest float that is not above `value`, which must not be negative.
inline float roundDown(double value) {
    return -roundUp(-value);
}

/// x -> linear x + translation, from index space to world space. `linear[row][column]`.
struct AffineMap {
    double linear[3][3] = {{1, 0, 0}, {0, 1, 0}, {0, 0, 1}};
    double translation[3] = {0, 0, 0};

    Vec3d column(int c) const { return {{linear[0][c], linear[1][c], linear[2][c]}}; }
    Vec3d vector(const Vec3d& v) const {
        Vec3d r;
        for (int i = 0; i < 3; ++i) {
            r[i] = linear[i][0] * v[0] + linear[i][1] * v[1] + linear[i][2] * v[2];
        }
        return r;
    }
    Vec3d point(const Vec3d& p) const {
        return vector(p) + Vec3d{{translation[0], translation[1], translation[2]}};
    }
    double determinant() const { return dot(column(0), cross(column(1), column(2))); }

    /// Volume of the unit cell over the product of its edges: 1 for a box, 0 for a flat cell.
    double relativeDeterminant() const {
        return determinant() / (length(column(0)) * length(column(1)) * length(column(2)));
    }

    AffineMap inverse() const {
        // Columns are scaled to length 1 first: the determinant of a map with voxels of 1e-120
        // would underflow.
        Vec3d c[3];
        double s[3];
        for (int a = 0; a < 3; ++a) {
            s[a] = 1 / length(column(a));
            c[a] = s[a] * column(a);
        }
        const double invDet = 1 / dot(c[0], cross(c[1], c[2]));
        AffineMap r;
        for (int a = 0; a < 3; ++a) {
            const Vec3d row = (s[a] * invDet) * cross(c[(a + 1) % 3], c[(a + 2) % 3]);
            for (int b = 0; b < 3; ++b) {
                r.linear[a][b] = row[b];
            }
            r.translation[a] = -dot(row, {{translation[0], translation[1], translation[2]}});
        }
        return r;
    }

    /// Length in world space of the longest diagonal of an index-space box with these edges.
    double longestDiagonal(const Vec3d& edges) const {
        double longest = 0;
        for (int signs = 0; signs < 4; ++signs) {
            const Vec3d d = vector(
                {{edges[0], signs & 1 ? -edges[1] : edges[1], signs & 2 ? -edges[2] : edges[2]}});
            longest = std::max(longest, length(d));
        }
        return longest;
    }
};

/// World-space box of an integer box of local space. Both ends 0 where that is empty.
inline void worldBounds(const AffineMap& map, const Int3& anchor, const IntBox& box,
                        double (&lo)[3], double (&hi)[3]) {
    for (int a = 0; a < 3; ++a) {
        lo[a] = hi[a] = 0;
    }
    for (int corner = 0; corner < 8 && !box.empty(); ++corner) {
        Vec3d index;
        for (int a = 0; a < 3; ++a) {
            const auto axis = static_cast<size_t>(a);
            index[a] =
                static_cast<double>(anchor[axis] + (corner >> a & 1 ? box.hi[axis] : box.lo[axis]));
        }
        const Vec3d world = map.point(index);
        for (int a = 0; a < 3; ++a) {
            lo[a] = corner == 0 ? world[a] : std::min(lo[a], world[a]);
            hi[a] = corner == 0 ? world[a] : std::max(hi[a], world[a]);
        }
    }
}

}  // namespace trk
