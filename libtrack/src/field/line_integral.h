// SPDX-License-Identifier: Apache-2.0
// The integral of a trilinear density along a line, in two short loops: which cells the line meets,
// then what they hold. Memory latency is paid once a loop.
#pragma once

#include "density_field.h"
#include "space/lanes.h"
#include "space/lattice.h"

#include <algorithm>
#include <array>
#include <cstddef>
#include <cstdint>
#include <cstring>

namespace trk {

/// Stretches of a ray inside bricks, and what the density there integrates to. C: its channels.
template <size_t C, class Stored>
class LineIntegral {
  public:
    /// `bricks`: the values of all, one after another. All arguments must live as long.
    LineIntegral(const SparseTable& table, const Stored* bricks, const LocalRay& ray)
        : table_(table), bricks_(bricks), ray_(ray), all_(table.lattice(table.depth())) {}

    /// Adds [t0, t1], which begins in the brick at `lo`, lies in bricks alone and crosses 256 of
    /// them at most.
    void add(const Vec3d& lo, double t0, double t1) {
        // The cells of the bricks around: those of all may be more than can be counted.
        constexpr int64_t kAround = 256;
        Lattice cells;
        cells.size = 1;
        int32_t cell[3];
        for (size_t a = 0; a < 3; ++a) {
            const auto voxel = static_cast<int64_t>(lo[static_cast<int>(a)]);
            const int64_t brick = (voxel >> DensityField::kBrickShift) - all_.first[a];
            const int64_t first = std::max<int64_t>(brick - kAround, 0);
            const int64_t end = std::min<int64_t>(brick + kAround, all_.extent[a]);
            firstBrick_[a] = static_cast<int32_t>(first);
            cells.first[a] = (all_.first[a] + first) << DensityField::kBrickShift;
            cells.extent[a] = static_cast<int32_t>((end - first) << DensityField::kBrickShift);
            origin_[a] = ray_.origin[static_cast<int>(a)] - static_cast<double>(cells.first[a]);
            const auto begin = static_cast<int32_t>(voxel - cells.first[a]);
            cell[a] = cells.cellAt(ray_, t0, a, begin, begin + 8);
        }
        LatticeWalk walk;
        walk.begin(cells, ray_, cell, t0, t1);
        LatticeWindow<kMost> window;
        while (!walk.isDone()) {
            walk.cross(window);
            find(window);
            sumUp(window);
        }
    }

    /// Of everything added so far, in voxel lengths.
    std::array<double, C> sum() const {
        std::array<double, C> result;
        for (size_t c = 0; c < C; ++c) {
            result[c] = (sum_[c][0] + sum_[c][1]) + (sum_[c][2] + sum_[c][3]);
        }
        return result;
    }
    uint64_t cellCount() const { return met_; }

  private:
    static constexpr size_t kMost = 64;  // cells whose values are on their way from memory at once

    /// Where the lower corners of the cells are.
    void find(const LatticeWindow<kMost>& window) {
        int32_t vertex[kMost];
        int32_t brick[kMost];  // unlike that of any other brick nearby
        for (size_t i = 0; i < window.padded(); ++i) {
            const int32_t x = window.cell(0, i);
            const int32_t y = window.cell(1, i);
            const int32_t z = window.cell(2, i);
            cell_[0][i] = x;
            cell_[1][i] = y;
            cell_[2][i] = z;
            vertex[i] = ((x & 7) * 9 + (y & 7)) * 9 + (z & 7);
            brick[i] = (x >> 3) * 4096 + (y >> 3) * 64 + (z >> 3);
        }
        const Stored* values = nullptr;
        int32_t last = 0;
        for (size_t i = 0; i < window.count; ++i) {
            if (!values || brick[i] != last) {
                last = brick[i];
                const SparseTable::Entry entry = table_.entryAt(
                    table_.depth(), firstBrick_[0] + (cell_[0][i] >> 3),
                    firstBrick_[1] + (cell_[1][i] >> 3), firstBrick_[2] + (cell_[2][i] >> 3));
                // By rounding, a cell of no length may lie in what is no brick.
                values = DensityField::isConstant(entry)
                             ? kNothing
                             : bricks_ + (entry - 1) * DensityField::kBrickVertices * C;
            }
            const Stored* corner = values + static_cast<size_t>(vertex[i]) * C;
            corner_[i] = corner;
            __builtin_prefetch(corner);
            __builtin_prefetch(corner + 9 * C);
            __builtin_prefetch(corner + 81 * C);
            __builtin_prefetch(corner + 90 * C);
        }
        met_ += window.count;
    }

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
    void sumUp(LatticeWindow<kMost>& window) {
        constexpr double kGauss = 0.57735026918962576451;  // 1/sqrt(3)
        size_t count = window.count;
        for (; count % 4 != 0; ++count) {  // of no length
            window.time[count + 1] = window.time[count];
            for (auto& cell : cell_) {
                cell[count] = cell[count - 1];
            }
            corner_[count] = corner_[count - 1];
        }
        for (size_t i = 0; i < count; i += 4) {
            Double4 tEnter;
            Double4 tExit;
            load(window.time + i, tEnter);
            load(window.time + i + 1, tExit);
            const Double4 half = 0.5 * (tExit - tEnter);
            const Double4 middle = tEnter + half;
            const Double4 first = middle - kGauss * half;
            const Double4 second = middle + kGauss * half;
            Float8 near[3];
            Float8 far[3];
            for (int a = 0; a < 3; ++a) {
                Double4 cell;
                load(cell_[a] + i, cell);
                const Double4 origin = origin_[a] - cell;
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
    }

    static constexpr Stored kNothing[DensityField::kBrickVertices * C] = {};

    const SparseTable& table_;
    const Stored* bricks_;
    const LocalRay& ray_;
    Lattice all_;  // bricks
    int32_t firstBrick_[3];
    double origin_[3];  // of the ray, from the first brick on
    uint64_t met_ = 0;
    Double4 sum_[C]{};
    int32_t cell_[3][kMost];  // from the first brick on
    const Stored* corner_[kMost];
};

}  // namespace trk
