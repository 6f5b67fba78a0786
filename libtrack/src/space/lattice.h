// SPDX-License-Identifier: Apache-2.0
// Where a ray crosses a lattice of cubes: the loop under every walk.
#pragma once

#include "local_ray.h"

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstring>

namespace trk {

inline double powerOfTwo(int exponent) {
    const uint64_t bits = static_cast<uint64_t>(1023 + exponent) << 52;
    double value;
    std::memcpy(&value, &bits, sizeof(value));
    return value;
}

/// A box of cubes of one size, aligned to it.
struct Lattice {
    double size;        ///< an edge, in voxels; a power of two
    int64_t first[3];   ///< the lowest cell, in edges
    int32_t extent[3];  ///< cells

    /// The cell around a point of a ray, from the first on; of those in [lo, hi).
    int32_t cellAt(const LocalRay& ray, double t, size_t a, int32_t lo, int32_t hi) const {
        const int axis = static_cast<int>(a);
        const double x =
            (ray.origin[axis] + t * ray.direction[axis]) / size - static_cast<double>(first[a]);
        // Never negative but for rounding, so truncation is as good as floor.
        return static_cast<int32_t>(
            std::min(std::max(x, static_cast<double>(lo)), static_cast<double>(hi - 1)));
    }
};

/// A few cells that a ray meets, in order: N at most, a multiple of 16.
template <size_t N>
struct LatticeWindow {
    static constexpr size_t kMost = N;

    size_t count = 0;
    double time[kMost + 1];  ///< cell i is entered at time[i] and left at time[i + 1]

    /// Of a cell, from the lattice's first on.
    int32_t cell(size_t axis, size_t i) const {
        return start[axis] + sign[axis] * static_cast<int32_t>(crossed[i] >> (10 * axis) & 1023);
    }

    /// Cells, and some more that say nothing, for loops over as many as the processor takes at
    /// once.
    size_t padded() const { return (count + kPad - 1) / kPad * kPad; }
    static constexpr size_t kPad = 16;

    uint32_t crossed[kMost + kPad];  // planes of each axis before a cell, ten bits each
    int32_t start[3];
    int32_t sign[3] = {0, 0, 0};
};

/// A ray's way through a lattice, which may stop anywhere and go on. A ray meets the planes of an
/// axis at equal intervals. Times are whole numbers of a very small unit, so that sums of them are
/// exact, and a step (which plane is next, in what cell) takes a few cycles.
class LatticeWalk {
  public:
    /// Along [t0, t1] of the ray from `cell` on, which holds its start.
    void begin(const Lattice& lattice, const LocalRay& ray, const int32_t (&cell)[3], double t0,
               double t1) {
        start_ = t0;
        // All times that matter are below 2^60 units, and the sum of any two below 2^63.
        const double longest = std::max(t1 - t0, 1.0);
        uint64_t bits;
        std::memcpy(&bits, &longest, sizeof(bits));
        const int exponent = static_cast<int>(bits >> 52) - 1022;
        unit_ = powerOfTwo(exponent - 60);
        const double perVoxel = powerOfTwo(60 - exponent);
        const auto units = [&](double voxels) {
            return static_cast<int64_t>(std::min(std::max(voxels * perVoxel, 0.0), 0x1p61));
        };
        now_ = 0;
        end_ = units(t1 - t0);
        for (size_t a = 0; a < 3; ++a) {
            const int axis = static_cast<int>(a);
            const bool backwards = ray.direction[axis] < 0;
            const double plane = lattice.size * static_cast<double>(lattice.first[a] + cell[a] +
                                                                    (backwards ? 0 : 1));
            next_[a] = units((plane - ray.origin[axis]) * ray.inverse[axis] - t0);
            step_[a] = units(lattice.size * std::fabs(ray.inverse[axis]));
            cell_[a] = cell[a];
            sign_[a] = backwards ? -1 : 1;
            // The lattice ends there, whatever is rounded.
            const int32_t ahead = backwards ? cell[a] : lattice.extent[a] - 1 - cell[a];
            if (static_cast<double>(ahead) * static_cast<double>(step_[a]) < 0x1p61) {
                end_ = std::min(end_, next_[a] + ahead * step_[a]);
            }
        }
    }

    bool isDone() const { return now_ >= end_; }
    /// Where it is: a cell, and the time it is entered.
    const int32_t (&cell() const)[3] { return cell_; }
    double time() const { return timeOf(now_); }

    /// To the next cell; whether it took any time.
    bool step() {
        const int64_t plane = std::min({next_[0], next_[1], next_[2]});
        const int64_t before = now_;
        now_ = std::min(plane, end_);
        for (size_t a = 0; a < 3; ++a) {
            if (plane == next_[a]) {
                next_[a] += step_[a];
                cell_[a] += sign_[a];
            }
        }
        return now_ > before;
    }

    /// The next few cells. Some may take no time.
    template <size_t N>
    void cross(LatticeWindow<N>& window) {
        int64_t tX = next_[0];
        int64_t tY = next_[1];
        int64_t tZ = next_[2];
        int64_t plane = now_;
        uint32_t crossed = 0;
        size_t n = 0;
        window.time[0] = timeOf(plane);
        do {
            plane = std::min(std::min(tX, tY), tZ);
            window.crossed[n++] = crossed;
            window.time[n] = timeOf(plane);
            // Through an edge, two planes at once. (By masks instead of branches, which compilers
            // make of this, it takes as long.)
            crossed += static_cast<uint32_t>(plane == tX) +
                       (static_cast<uint32_t>(plane == tY) << 10) +
                       (static_cast<uint32_t>(plane == tZ) << 20);
            tX += plane == tX ? step_[0] : 0;
            tY += plane == tY ? step_[1] : 0;
            tZ += plane == tZ ? step_[2] : 0;
        } while (n < N && plane < end_);
        if (plane >= end_) {
            plane = end_;
            window.time[n] = timeOf(plane);
        }
        now_ = plane;
        next_[0] = tX;
        next_[1] = tY;
        next_[2] = tZ;
        window.count = n;
        std::memset(window.crossed + n, 0, sizeof(uint32_t) * LatticeWindow<N>::kPad);
        for (size_t a = 0; a < 3; ++a) {
            window.start[a] = cell_[a];
            window.sign[a] = sign_[a];
            cell_[a] += sign_[a] * static_cast<int32_t>(crossed >> (10 * a) & 1023);
        }
    }

  private:
    double timeOf(int64_t units) const { return start_ + unit_ * static_cast<double>(units); }

    double start_;
    double unit_;      // in voxels
    int64_t now_;      // when the current cell is entered
    int64_t end_;      // when the last one is left
    int64_t next_[3];  // when the next plane of each axis is met
    int64_t step_[3];  // between two planes
    int32_t cell_[3];
    int32_t sign_[3];
};

}  // namespace trk
