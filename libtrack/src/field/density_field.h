// SPDX-License-Identifier: Apache-2.0
// The density as the runtime sees it: bricks of 8^3 cells in a sparse table, each with the apron
// that keeps all corners of a trilinear look-up in one brick.
#pragma once

#include "raw_array.h"
#include "table_cursor.h"

#include <algorithm>
#include <array>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <vector>

namespace trk {

/// Decodes an IEEE half that is finite and not negative. Integer arithmetic and one conversion, so
/// that a host that flushes denormals to zero gets the same values.
inline float decodeHalf(uint16_t half) {
    if (half < 0x400) {
        return static_cast<float>(half) * 0x1p-24f;
    }
    const uint32_t bits = (static_cast<uint32_t>(half) << 13) + (112u << 23);
    float value;
    std::memcpy(&value, &bits, sizeof(value));
    return value;
}

/// Whether decodeHalf can return exactly `value` (finite, not negative).
inline bool isExactHalf(float value) {
    if (value == 0) {
        return true;
    }
    if (value < 0x1p-14f) {
        const float scaled = value * 0x1p24f;
        return scaled == static_cast<float>(static_cast<uint32_t>(scaled));
    }
    uint32_t bits;
    std::memcpy(&bits, &value, sizeof(bits));
    return (bits & 0x1fff) == 0 && value <= 65504.0f;
}

/// The half that decodeHalf turns into `value`, for which isExactHalf holds.
inline uint16_t encodeHalf(float value) {
    if (value < 0x1p-14f) {
        return static_cast<uint16_t>(value * 0x1p24f);
    }
    uint32_t bits;
    std::memcpy(&bits, &value, sizeof(bits));
    return static_cast<uint16_t>((bits - (112u << 23)) >> 13);
}

/// Whether a type of storage holds a value exactly, and storing it.
inline bool isStorable(float, const float*) {
    return true;
}
inline bool isStorable(float value, const uint16_t*) {
    return isExactHalf(value);
}
inline void storeExactly(float value, float& to) {
    to = value;
}
inline void storeExactly(float value, uint16_t& to) {
    to = encodeHalf(value);
}

/// Trilinear density over local space: voxel centres at integer coordinates, 0 outside, of one
/// channel or three. Immutable.
///
/// A brick at b covers the cells b..b+7 per axis, hence the vertices b..b+8. Bricks whose vertices
/// all agree are not stored: their entry is a constant, and so are larger regions. All values are
/// finite and not negative, the channels of a vertex side by side. Storage is half where that is
/// exact for every value. Functions with a parameter C want the field's number of channels.
class DensityField {
  public:
    using Entry = SparseTable::Entry;

    static constexpr int kBrickShift = 3;
    static constexpr int64_t kBrickSize = 8;
    static constexpr size_t kBrickEdge = 9;
    static constexpr size_t kBrickVertices = kBrickEdge * kBrickEdge * kBrickEdge;
    static constexpr Entry kConstantFlag = 0x40000000u;  ///< else: index of a brick, plus one

    DensityField() = default;

    /// Bricks lie one after another in `floats` or `halfs`, x slowest; the other one is empty.
    /// `constants`: `channels` values each.
    DensityField(size_t channels, SparseTable table, std::vector<float> constants,
                 RawArray<float> floats, RawArray<uint16_t> halfs);

    size_t channels() const { return channels_; }

    /// Box of the occupied bricks and tiles, in cells; nothing but 0 lies outside.
    const IntBox& box() const { return box_; }
    bool isHalf() const { return !halfs_.empty(); }
    size_t bytes() const;
    size_t brickCount() const {
        return (floats_.size() + halfs_.size()) / (kBrickVertices * channels_);
    }
    const SparseTable& table() const { return table_; }

    /// Values of an entry that is empty or has the constant flag, one a channel.
    const float* constant(Entry entry) const {
        static constexpr float kNothing[3] = {0, 0, 0};
        return entry == SparseTable::kEmpty ? kNothing
                                            : &constants_[(entry & ~kConstantFlag) * channels_];
    }
    static bool isConstant(Entry entry) {
        return entry == SparseTable::kEmpty || (entry & kConstantFlag) != 0;
    }
    /// One channel of vertex `i` of brick `entry`.
    float vertex(Entry entry, size_t i, size_t channel) const {
        const size_t at = ((entry - 1) * kBrickVertices + i) * channels_ + channel;
        return isHalf() ? decodeHalf(halfs_[at]) : floats_[at];
    }

    /// All vertices of one channel of brick `entry`, x slowest: in place where they lie side by
    /// side as floats, else in `buffer`.
    const float* brickChannel(Entry entry, size_t channel, float (&buffer)[kBrickVertices]) const {
        const size_t first = (entry - 1) * kBrickVertices * channels_ + channel;
        if (!isHalf() && channels_ == 1) {
            return &floats_[first];
        }
        if (isHalf()) {
            for (size_t i = 0; i < kBrickVertices; ++i) {
                buffer[i] = decodeHalf(halfs_[first + i * channels_]);
            }
        } else {
            for (size_t i = 0; i < kBrickVertices; ++i) {
                buffer[i] = floats_[first + i * channels_];
            }
        }
        return buffer;
    }

    /// Says that the density at a point will be asked for: first where its brick is, then, once
    /// that has come, what is in it. Neither changes any result.
    void prefetchEntry(const Vec3d& point) const {
        table_.prefetch(static_cast<int64_t>(point[0]), static_cast<int64_t>(point[1]),
                        static_cast<int64_t>(point[2]));
    }
    void prefetchBrick(const Vec3d& point) const {
        const auto x = static_cast<int64_t>(point[0]);
        const auto y = static_cast<int64_t>(point[1]);
        const auto z = static_cast<int64_t>(point[2]);
        const Entry entry = table_.find(x, y, z).entry;
        if (isConstant(entry)) {
            return;
        }
        const size_t at = ((entry - 1) * kBrickVertices + vertexOf(x, y, z)) * channels_;
        const size_t bytes = channels_ * (isHalf() ? sizeof(uint16_t) : sizeof(float));
        const char* first = isHalf() ? reinterpret_cast<const char*>(&halfs_[at])
                                     : reinterpret_cast<const char*>(&floats_[at]);
        __builtin_prefetch(first);
        __builtin_prefetch(first + 10 * bytes);
        __builtin_prefetch(first + 81 * bytes);
        __builtin_prefetch(first + 91 * bytes);
    }

    /// Density at a point of local space (its coordinates not negative).
    template <size_t C>
    std::array<float, C> density(const Vec3d& point) const {
        const auto x = static_cast<int64_t>(point[0]);
        const auto y = static_cast<int64_t>(point[1]);
        const auto z = static_cast<int64_t>(point[2]);
        const Entry entry = table_.find(x, y, z).entry;
        std::array<float, C> result;
        if (isConstant(entry)) {
            std::copy_n(constant(entry), C, result.begin());
            return result;
        }
        const size_t vertex = (entry - 1) * kBrickVertices + vertexOf(x, y, z);
        const auto fx = static_cast<float>(point[0] - static_cast<double>(x));
        const auto fy = static_cast<float>(point[1] - static_cast<double>(y));
        const auto fz = static_cast<float>(point[2] - static_cast<double>(z));
        for (size_t c = 0; c < C; ++c) {
            const size_t at = vertex * C + c;
            result[c] = isHalf() ? interpolate<float>(Corners<float, C>(&halfs_[at]), fx, fy, fz)
                                 : interpolate<float>(Corners<float, C>(&floats_[at]), fx, fy, fz);
        }
        return result;
    }

    /// Integral of the density over [t0, t1] of the ray, in voxel lengths, by the closed form of
    /// each cell: along a line a trilinear field is a cubic there, for which two Gauss points are
    /// exact. Adds two look-ups a cell to `lookups` and the bricks and tiles met to `regions`.
    template <size_t C>
    std::array<double, C> integrate(const LocalRay& ray, double t0, double t1, Kernel kernel,
                                    uint64_t& lookups, uint64_t& regions) const;

    /// Adds up the density at `points` equidistant points of each of `combs` combs in [t0, t1) of
    /// the ray, at offsets from 0 to 1 of their distance. How many points were looked up.
    static constexpr size_t kMostCombs = 32;
    template <size_t C>
    uint64_t addSamples(const LocalRay& ray, double t0, double t1, Kernel kernel, double points,
                        const double* offsets, size_t combs, std::array<double, C>* sums) const;

    /// As integrate, over the part of a ray in the region at `lo` that an entry stands for; adds
    /// the cells of a brick to `cells`.
    template <size_t C>
    std::array<double, C> integrateRegion(Entry entry, const Int3& lo, const LocalRay& ray,
                                          double t0, double t1, uint64_t& cells) const {
        if (isConstant(entry)) {
            std::array<double, C> depth;
            for (size_t c = 0; c < C; ++c) {
                depth[c] = static_cast<double>(constant(entry)[c]) * (t1 - t0);
            }
            return depth;
        }
        const size_t first = (entry - 1) * kBrickVertices * C;
        return isHalf() ? integrateBrick<C>(&halfs_[first], lo, ray, t0, t1, cells)
                        : integrateBrick<C>(&floats_[first], lo, ray, t0, t1, cells);
    }

    /// The same of a brick, wherever its values are.
    template <size_t C, class Stored>
    static std::array<double, C> integrateBrick(const Stored* brick, const Int3& lo,
                                                const LocalRay& ray, double t0, double t1,
                                                uint64_t& cells) {
        std::array<double, C> depth{};
        uint64_t met = 0;  // apart, so that it stays in a register
        walkBrick<C>(brick, lo, ray, t0, t1,
                     [&](double, double, const std::array<double, C>& cell) {
                         ++met;
                         for (size_t c = 0; c < C; ++c) {
                             depth[c] += cell[c];
                         }
                         return true;
                     });
        cells += met;
        return depth;
    }

    /// Calls `visit(t0, t1, depth)` for every cell of a brick and every constant region on the
    /// ray's way where the density is not 0 throughout, until it answers false. `depth`: integral
    /// of the density over [t0, t1], in voxel lengths, in closed form.
    template <size_t C, class Visit>
    void forEachCell(const LocalRay& ray, double t0, double t1, Visit&& visit) const {
        table_.walk(
            ray, t0, t1, [&](Entry entry, const Int3& lo, int, double tEnter, double tExit) {
                if (isConstant(entry)) {
                    std::array<double, C> depth;
                    for (size_t c = 0; c < C; ++c) {
                        depth[c] = static_cast<double>(constant(entry)[c]) * (tExit - tEnter);
                    }
                    return visit(tEnter, tExit, depth);
                }
                const size_t first = (entry - 1) * kBrickVertices * C;
                return isHalf() ? walkBrick<C>(&halfs_[first], lo, ray, tEnter, tExit, visit)
                                : walkBrick<C>(&floats_[first], lo, ray, tEnter, tExit, visit);
            });
    }

  private:
    /// The lower corner of a cell in its brick.
    static size_t vertexOf(int64_t x, int64_t y, int64_t z) {
        return (static_cast<size_t>(x & 7) * kBrickEdge + static_cast<size_t>(y & 7)) * kBrickEdge +
               static_cast<size_t>(z & 7);
    }

    /// One channel at the corners of a cell, of C that lie side by side.
    template <class Real, size_t C>
    struct Corners {
        Real v[8];

        template <class Stored>
        explicit Corners(const Stored* p)
            : v{load(p[0]),      load(p[C]),      load(p[9 * C]),  load(p[10 * C]),
                load(p[81 * C]), load(p[82 * C]), load(p[90 * C]), load(p[91 * C])} {}
        static Real load(float value) { return value; }
        static Real load(uint16_t half) { return decodeHalf(half); }
    };

    template <class Real, size_t C>
    static Real interpolate(const Corners<Real, C>& c, Real fx, Real fy, Real fz) {
        const Real v00 = c.v[0] + fz * (c.v[1] - c.v[0]);
        const Real v01 = c.v[2] + fz * (c.v[3] - c.v[2]);
        const Real v10 = c.v[4] + fz * (c.v[5] - c.v[4]);
        const Real v11 = c.v[6] + fz * (c.v[7] - c.v[6]);
        const Real v0 = v00 + fy * (v01 - v00);
        const Real v1 = v10 + fy * (v11 - v10);
        return v0 + fx * (v1 - v0);
    }

    /// Visits the cells of one brick; whether to go on.
    template <size_t C, class Stored, class Visit>
    static bool walkBrick(const Stored* brick, const Int3& lo, const LocalRay& ray, double t0,
                          double t1, Visit&& visit);

    size_t channels_ = 1;
    SparseTable table_;
    std::vector<float> constants_;
    RawArray<float> floats_;
    RawArray<uint16_t> halfs_;
    IntBox box_;
};

template <size_t C, class Stored, class Visit>
bool DensityField::walkBrick(const Stored* brick, const Int3& lo, const LocalRay& ray, double t0,
                             double t1, Visit&& visit) {
    constexpr std::ptrdiff_t kStride[3] = {81 * C, 9 * C, C};
    constexpr double kGauss = 0.57735026918962576451;  // 1/sqrt(3)
    double origin[3];
    double cellOrigin[3];  // of the current cell: integers, as doubles
    double planeStep[3];
    double tPlane[3];
    std::ptrdiff_t stride[3];
    const Stored* corner = brick;
    for (int a = 0; a < 3; ++a) {
        origin[a] = ray.origin[a] - static_cast<double>(lo[static_cast<size_t>(a)]);
        const bool backwards = ray.direction[a] < 0;
        const double start = origin[a] + t0 * ray.direction[a];
        const auto cell = std::min(std::max(static_cast<int>(start), 0), 7);
        cellOrigin[a] = cell;
        planeStep[a] = backwards ? -1 : 1;
        stride[a] = backwards ? -kStride[a] : kStride[a];
        corner += cell * kStride[a];
        tPlane[a] = (cell + (backwards ? 0 : 1) - origin[a]) * ray.inverse[a];
    }
    double t = t0;
    for (;;) {
        int axis = tPlane[0] < tPlane[1] ? 0 : 1;
        axis = tPlane[2] < tPlane[axis] ? 2 : axis;
        const bool last = !(tPlane[axis] < t1);
        const double tExit = last ? t1 : std::max(t, tPlane[axis]);
        const double half = 0.5 * (tExit - t);
        const double middle = t + half;
        double centre[3];
        double offset[3];
        for (int a = 0; a < 3; ++a) {
            centre[a] = origin[a] - cellOrigin[a] + middle * ray.direction[a];
            offset[a] = half * kGauss * ray.direction[a];
        }
        // In double: near the far face of a cell next to empty space the value is the small
        // difference between 1 and the fraction.
        std::array<double, C> depth;
        for (size_t c = 0; c < C; ++c) {
            const Corners<double, C> corners(corner + c);
            depth[c] = half * (interpolate<double>(corners, centre[0] - offset[0],
                                                   centre[1] - offset[1], centre[2] - offset[2]) +
                               interpolate<double>(corners, centre[0] + offset[0],
                                                   centre[1] + offset[1], centre[2] + offset[2]));
        }
        if (!visit(t, tExit, depth)) {
            return false;
        }
        if (last) {
            return true;
        }
        cellOrigin[axis] += planeStep[axis];
        if (cellOrigin[axis] < 0 || cellOrigin[axis] > 7) {
            return true;
        }
        corner += stride[axis];
        const double plane = cellOrigin[axis] + (planeStep[axis] > 0 ? 1 : 0);
        tPlane[axis] = (plane - origin[axis]) * ray.inverse[axis];
        t = tExit;
    }
}

}  // namespace trk
