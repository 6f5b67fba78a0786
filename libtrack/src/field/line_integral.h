// SPDX-License-Identifier: Apache-2.0
// The integral of a trilinear density along a line, in two short loops: which cells the line meets,
// then what they hold. Memory latency is paid once a loop.
#pragma once

#include "density_field.h"

#include <algorithm>
#include <array>
#include <cstddef>
#include <cstdint>
#include <cstring>

namespace trk {

/// Four or eight numbers at once, by the compiler's vector types: what the processor has of them.
using Float4 = float __attribute__((vector_size(16)));
using Float8 = float __attribute__((vector_size(32)));
using Double2 = double __attribute__((vector_size(16)));
using Double4 = double __attribute__((vector_size(32)));

/// Cells of bricks along a ray, and what the density there integrates to. C: its channels.
template <size_t C, class Stored>
class LineIntegral {
  public:
    explicit LineIntegral(const LocalRay& ray) : ray_(ray) {
        constexpr std::ptrdiff_t kStrides[3] = {81 * C, 9 * C, C};
        for (size_t a = 0; a < 3; ++a) {
            const bool backwards = ray.direction[static_cast<int>(a)] < 0;
            stride_[a] = backwards ? -kStrides[a] : kStrides[a];
            step_[a][1] = backwards ? -1 : 1;
        }
    }

    /// Adds the cells of a brick whose lower corner is at `lo`, between tEnter and tExit.
    void add(const Stored* brick, const Vec3d& lo, double tEnter, double tExit) {
        constexpr std::ptrdiff_t kStrides[3] = {81 * C, 9 * C, C};
        const auto within = [&](size_t a) {
            return static_cast<std::ptrdiff_t>(cellAt_[a] - lo[static_cast<int>(a)]);
        };
        // Most bricks begin where the last one ended.
        if (t_ != tEnter || ((within(0) | within(1) | within(2)) & ~std::ptrdiff_t{7}) != 0) {
            start(tEnter, lo);
        }
        const Stored* from =
            brick + within(0) * kStrides[0] + within(1) * kStrides[1] + within(2) * kStrides[2];
        double cell[3] = {cellAt_[0], cellAt_[1], cellAt_[2]};
        size_t x = at_[0];
        size_t y = at_[1];
        size_t z = at_[2];
        double t = tEnter;
        size_t n = count_;
        for (bool last = false; !last;) {
            const double tX = planes_[0][x];
            const double tY = planes_[1][y];
            const double tZ = planes_[2][z];
            const double next = std::min(std::min(tX, tY), tZ);
            last = !(next < tExit);
            tEnter_[n] = t;
            t = std::max(t, std::min(next, tExit));
            tExit_[n] = t;
            cell_[0][n] = cell[0];
            cell_[1][n] = cell[1];
            cell_[2][n] = cell[2];
            corner_[n++] = from;
            __builtin_prefetch(from);
            __builtin_prefetch(from + kStrides[1]);
            __builtin_prefetch(from + kStrides[0]);
            __builtin_prefetch(from + kStrides[0] + kStrides[1]);
            // Not by branches: nobody could predict them.
            const size_t isX = static_cast<size_t>(tX <= tY) & static_cast<size_t>(tX <= tZ);
            const size_t isY = static_cast<size_t>(tY <= tZ) & (isX ^ 1);
            const size_t isZ = (isX | isY) ^ 1;
            x += isX;
            y += isY;
            z += isZ;
            cell[0] += step_[0][isX];
            cell[1] += step_[1][isY];
            cell[2] += step_[2][isZ];
            from += stride_[isY + 2 * isZ];
            if ((x | y | z) >= kPlanes) {
                x == kPlanes ? refill(0, x) : y == kPlanes ? refill(1, y) : refill(2, z);
            }
        }
        t_ = t;
        cellAt_[0] = cell[0];
        cellAt_[1] = cell[1];
        cellAt_[2] = cell[2];
        at_[0] = x;
        at_[1] = y;
        at_[2] = z;
        cells_ += n - count_;
        count_ = n;
        if (count_ > kCells) {
            flush();
        }
    }

    /// Everything added so far, in voxel lengths.
    std::array<double, C> sum() {
        flush();
        std::array<double, C> result;
        for (size_t c = 0; c < C; ++c) {
            result[c] = (sum_[c][0] + sum_[c][1]) + (sum_[c][2] + sum_[c][3]);
        }
        return result;
    }
    uint64_t cells() const { return cells_; }

  private:
    static constexpr size_t kCells = 64;        // before they are looked at
    static constexpr size_t kMostInBrick = 22;  // a line meets no more
    static constexpr size_t kRoom = kCells + kMostInBrick + 4;

    static constexpr size_t kPlanes = 16;

    /// Where a ray that is at t is in a brick, and the times of the planes ahead.
    void start(double t, const Vec3d& lo) {
        t_ = t;
        for (size_t a = 0; a < 3; ++a) {
            const int axis = static_cast<int>(a);
            const double x = ray_.origin[axis] - lo[axis] + t * ray_.direction[axis];
            cellAt_[a] = lo[axis] + std::min(std::max(static_cast<int>(x), 0), 7);
            plane_[a] = cellAt_[a] + (step_[a][1] < 0 ? 0 : 1);
            refill(a, at_[a]);
        }
    }
    void refill(size_t axis, size_t& at) {
        const int a = static_cast<int>(axis);
        for (size_t k = 0; k < kPlanes; ++k) {
            planes_[axis][k] =
                (plane_[axis] + static_cast<double>(k) * step_[axis][1] - ray_.origin[a]) *
                ray_.inverse[a];
        }
        plane_[axis] += static_cast<double>(kPlanes) * step_[axis][1];
        at = 0;
    }

    // Vectors go by reference: how they would be returned depends on the processor.
    static void load(const double* from, Double4& to) { std::memcpy(&to, from, sizeof(to)); }
    static void join(const Double4& a, const Double4& b, Float8& to) {
        const Float4 x = __builtin_convertvector(a, Float4);
        const Float4 y = __builtin_convertvector(b, Float4);
        to = __builtin_shufflevector(x, y, 0, 1, 2, 3, 4, 5, 6, 7);
    }
    static float decoded(float value) { return value; }
    static float decoded(uint16_t half) { return decodeHalf(half); }

    /// The values of a corner of four cells, and of the next one along z, interpolated between
    /// them; twice, for two points of each.
    static void alongZ(const Stored* const* from, std::ptrdiff_t offset, const Float8& near,
                       const Float8& far, Float8& to) {
        constexpr auto kNext = static_cast<std::ptrdiff_t>(C);
        if constexpr (C == 1 && sizeof(Stored) == sizeof(float)) {
            // Neighbours along z lie side by side: two values a load.
            Double2 pairs[2];
            for (size_t k = 0; k < 4; ++k) {
                double pair;
                std::memcpy(&pair, from[k] + offset, sizeof(pair));
                pairs[k / 2][k % 2] = pair;
            }
            Float4 p;
            Float4 q;
            std::memcpy(&p, &pairs[0], sizeof(p));
            std::memcpy(&q, &pairs[1], sizeof(q));
            to = near * __builtin_shufflevector(p, q, 0, 2, 4, 6, 0, 2, 4, 6) +
                 far * __builtin_shufflevector(p, q, 1, 3, 5, 7, 1, 3, 5, 7);
        } else {
            float a[4];
            float b[4];
            for (size_t k = 0; k < 4; ++k) {
                a[k] = decoded(from[k][offset]);
                b[k] = decoded(from[k][offset + kNext]);
            }
            to = near * Float8{a[0], a[1], a[2], a[3], a[0], a[1], a[2], a[3]} +
                 far * Float8{b[0], b[1], b[2], b[3], b[0], b[1], b[2], b[3]};
        }
    }

    /// Four cells at a time, each at two Gauss points: along a line the density of a cell is a
    /// cubic, for which they are exact. Each weight is rounded on its own: near the far face of a
    /// cell next to empty space the value is the small difference between 1 and the fraction.
    void flush() {
        constexpr double kGauss = 0.57735026918962576451;  // 1/sqrt(3)
        for (; count_ % 4 != 0; ++count_) {                // of no length
            tEnter_[count_] = tExit_[count_] = tExit_[count_ - 1];
            for (auto& cell : cell_) {
                cell[count_] = cell[count_ - 1];
            }
            corner_[count_] = corner_[count_ - 1];
        }
        for (size_t i = 0; i < count_; i += 4) {
            Double4 tEnter;
            Double4 tExit;
            load(tEnter_ + i, tEnter);
            load(tExit_ + i, tExit);
            const Double4 half = 0.5 * (tExit - tEnter);
            const Double4 middle = tEnter + half;
            const Double4 first = middle - kGauss * half;
            const Double4 second = middle + kGauss * half;
            Float8 near[3];
            Float8 far[3];
            for (int a = 0; a < 3; ++a) {
                Double4 cell;
                load(cell_[a] + i, cell);
                const Double4 origin = ray_.origin[a] - cell;
                const Double4 f = origin + first * ray_.direction[a];
                const Double4 g = origin + second * ray_.direction[a];
                join(f, g, far[a]);
                join(1 - f, 1 - g, near[a]);
            }
            for (size_t c = 0; c < C; ++c) {
                constexpr auto kX = static_cast<std::ptrdiff_t>(81 * C);
                constexpr auto kY = static_cast<std::ptrdiff_t>(9 * C);
                const Stored* const* from = corner_ + i;
                const auto at = static_cast<std::ptrdiff_t>(c);
                Float8 v00;
                Float8 v01;
                Float8 v10;
                Float8 v11;
                alongZ(from, at, near[2], far[2], v00);
                alongZ(from, at + kY, near[2], far[2], v01);
                alongZ(from, at + kX, near[2], far[2], v10);
                alongZ(from, at + kX + kY, near[2], far[2], v11);
                const Float8 v0 = near[1] * v00 + far[1] * v01;
                const Float8 v1 = near[1] * v10 + far[1] * v11;
                const Float8 v = near[0] * v0 + far[0] * v1;
                const Float4 a = __builtin_shufflevector(v, v, 0, 1, 2, 3);
                const Float4 b = __builtin_shufflevector(v, v, 4, 5, 6, 7);
                sum_[c] += half * (__builtin_convertvector(a, Double4) +
                                   __builtin_convertvector(b, Double4));
            }
        }
        count_ = 0;
    }

    const LocalRay& ray_;
    std::ptrdiff_t stride_[3];   // to the next cell of an axis
    double step_[3][2]{};        // nothing, or a step
    double t_ = -1;              // where the cells added so far end
    double cellAt_[3]{};         // the cell there
    double plane_[3];            // the first one beyond planes_
    double planes_[3][kPlanes];  // times of the planes of an axis, from at_ on ahead
    size_t at_[3];
    size_t count_ = 0;
    uint64_t cells_ = 0;
    Double4 sum_[C]{};
    double tEnter_[kRoom];
    double tExit_[kRoom];
    double cell_[3][kRoom];  // lower corners, in local space
    const Stored* corner_[kRoom];
};

}  // namespace trk
