// SPDX-License-Identifier: Apache-2.0
// A trilinear density at equidistant points of a line, several combs of them at once, in short
// loops: which bricks the line meets, where the points in them lie, what is there.
#pragma once

#include "density_field.h"
#include "space/lanes.h"
#include "table_cursor.h"

#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <limits>

namespace trk {

/// Combs of equidistant points in a stretch of a ray, as many in each comb, all shifted by a part
/// of their distance. C: the density's channels.
template <size_t C, class Stored>
class LineSamples {
  public:
    /// Of `points` points a comb in [t0, t1): at t0 + (k + offset) x their distance, k from 0 on.
    /// `sums`: of each comb, C numbers, to which add() adds; `offsets`: from 0 to 1, `combs` of
    /// them. All arguments must live as long.
    LineSamples(const DensityField& field, const Stored* bricks, const LocalRay& ray, double t0,
                double t1, double points, const double* offsets, size_t combs,
                std::array<double, C>* sums)
        : field_(field),
          bricks_(bricks),
          ray_(ray),
          t0_(t0),
          t1_(t1),
          points_(points),
          step_((t1 - t0) / points),
          perStep_(points / (t1 - t0)),
          offsets_(offsets),
          combs_(combs),
          sums_(sums) {}

    /// The density at all points.
    void add() {
        TableCursor cursor(field_.table(), ray_, t0_, t1_);
        while (const size_t count = cursor.refill()) {
            const Lattice lattice = cursor.lattice();
            for (size_t i = 0; i < count; ++i) {
                const SparseTable::Entry entry = cursor.entry(i);
                const double tEnter = cursor.tEnter(i);
                const double tExit = cursor.tExit(i);
                if (DensityField::isConstant(entry)) {
                    const float* constant = field_.constant(entry);
                    for (size_t comb = 0; comb < combs_; ++comb) {
                        forEachPoint(tEnter, tExit, offsets_[comb], [&](double) {
                            ++met_;
                            for (size_t c = 0; c < C; ++c) {
                                sums_[comb][c] += static_cast<double>(constant[c]);
                            }
                        });
                    }
                    continue;
                }
                const Stored* brick = bricks_ + (entry - 1) * DensityField::kBrickVertices * C;
                const Vec3d lo = cursor.lo(i, lattice);
                for (size_t comb = 0; comb < combs_; ++comb) {
                    forEachPoint(tEnter, tExit, offsets_[comb],
                                 [&](double t) { find(brick, lo, t, comb); });
                }
            }
        }
        look();
    }
    uint64_t count() const { return met_; }

  private:
    static constexpr size_t kMost = 64;  // points whose values are on their way from memory at once

    /// Calls f(t) for the points of a comb in [tEnter, tExit). The first one is decided by the time
    /// itself, so that none is met twice or not at all.
    template <class F>
    void forEachPoint(double tEnter, double tExit, double offset, const F& f) const {
        double k = std::ceil((tEnter - t0_) * perStep_ - offset) - 1;
        while (t0_ + (k + offset) * step_ < tEnter) {
            ++k;
        }
        for (double t = t0_ + (k + offset) * step_; t < tExit && k < points_;
             t = t0_ + (++k + offset) * step_) {
            f(t);
        }
    }

    void find(const Stored* brick, const Vec3d& lo, double t, size_t comb) {
        if (found_ == kMost) {
            look();
        }
        time_[found_] = t;
        for (size_t a = 0; a < 3; ++a) {
            origin_[a][found_] = ray_.origin[static_cast<int>(a)] - lo[static_cast<int>(a)];
        }
        corner_[found_] = brick;
        comb_[found_] = static_cast<uint32_t>(comb);
        ++found_;
    }

    /// Where in their bricks the points' cells are, and where in the cells the points.
    void locate(size_t padded) {
        for (size_t i = 0; i < padded; i += 4) {
            Double4 t;
            load(time_ + i, t);
            Int4 vertex{};
            for (size_t a = 0; a < 3; ++a) {
                Double4 x;
                load(origin_[a] + i, x);
                x += t * ray_.direction[static_cast<int>(a)];
                // By rounding, a point may lie beside its brick.
                Double4 inside = x;
                takeGreater(Double4{}, inside);
                takeLesser(Double4(Double4{} + 7.0), inside);
                const Int4 cell = __builtin_convertvector(inside, Int4);
                const Float4 part =
                    __builtin_convertvector(x - __builtin_convertvector(cell, Double4), Float4);
                std::memcpy(part_[a] + i, &part, sizeof(part));
                vertex = 9 * vertex + cell;
            }
            for (size_t k = 0; k < 4; ++k) {
                const Stored* corner = corner_[i + k] + vertex[k] * static_cast<std::ptrdiff_t>(C);
                __builtin_prefetch(corner);
                __builtin_prefetch(corner + 9 * C);
                __builtin_prefetch(corner + 81 * C);
                __builtin_prefetch(corner + 90 * C);
                corner_[i + k] = corner;
            }
        }
    }

    static float decoded(float value) { return value; }
    static float decoded(uint16_t half) { return decodeHalf(half); }

    /// The values at `at` from the corners of eight points, and of the next ones along z,
    /// interpolated between them.
    static void alongZ(const Stored* const* corners, size_t at, const Float8& far, Float8& to) {
        Float8 near;
        Float8 next;
        if constexpr (C == 1 && sizeof(Stored) == sizeof(float)) {
            // Neighbours along z lie side by side: two values a load.
            Float4 pairs[4];
            for (size_t k = 0; k < 4; ++k) {
                std::memcpy(&pairs[k], corners[2 * k] + at, 2 * sizeof(float));
                std::memcpy(reinterpret_cast<char*>(&pairs[k]) + 2 * sizeof(float),
                            corners[2 * k + 1] + at, 2 * sizeof(float));
            }
            const Float8 a = __builtin_shufflevector(pairs[0], pairs[1], 0, 1, 2, 3, 4, 5, 6, 7);
            const Float8 b = __builtin_shufflevector(pairs[2], pairs[3], 0, 1, 2, 3, 4, 5, 6, 7);
            near = __builtin_shufflevector(a, b, 0, 2, 4, 6, 8, 10, 12, 14);
            next = __builtin_shufflevector(a, b, 1, 3, 5, 7, 9, 11, 13, 15);
        } else {
            for (size_t p = 0; p < 8; ++p) {
                near[p] = decoded(corners[p][at]);
                next[p] = decoded(corners[p][at + C]);
            }
        }
        to = near + far * (next - near);
    }

    void look() {
        if (found_ == 0) {
            return;
        }
        met_ += found_;
        size_t padded = found_;
        for (; padded % 8 != 0; ++padded) {  // they say nothing
            time_[padded] = time_[padded - 1];
            for (auto& origin : origin_) {
                origin[padded] = origin[padded - 1];
            }
            corner_[padded] = corner_[padded - 1];
        }
        locate(padded);
        for (size_t i = 0; i < padded; i += 8) {
            Float8 far[3];
            for (size_t a = 0; a < 3; ++a) {
                std::memcpy(&far[a], part_[a] + i, sizeof(far[a]));
            }
            const size_t count = std::min<size_t>(found_ - i, 8);
            for (size_t c = 0; c < C; ++c) {
                Float8 v[4];
                for (size_t k = 0; k < 4; ++k) {
                    alongZ(corner_ + i, (81 * (k >> 1) + 9 * (k & 1)) * C + c, far[2], v[k]);
                }
                const Float8 v0 = v[0] + far[1] * (v[1] - v[0]);
                const Float8 v1 = v[2] + far[1] * (v[3] - v[2]);
                Float8 value = v0 + far[0] * (v1 - v0);
                // By rounding, it may be more than a float.
                takeLesser(Float8(Float8{} + std::numeric_limits<float>::max()), value);
                for (size_t k = 0; k < count; ++k) {
                    sums_[comb_[i + k]][c] += static_cast<double>(value[k]);
                }
            }
        }
        found_ = 0;
    }

    const DensityField& field_;
    const Stored* bricks_;
    const LocalRay& ray_;
    double t0_;
    double t1_;
    double points_;
    double step_;
    double perStep_;
    const double* offsets_;
    size_t combs_;
    std::array<double, C>* sums_;
    uint64_t met_ = 0;
    size_t found_ = 0;
    double time_[kMost];
    double origin_[3][kMost];      // of the ray, from the point's brick
    const Stored* corner_[kMost];  // of the brick, then the lower one of the cell
    float part_[3][kMost];         // where in the cell
    uint32_t comb_[kMost];
};

}  // namespace trk
