// SPDX-License-Identifier: Apache-2.0
// The baked grid: as it is stored (density units) and as a query reads it (extinction).
#pragma once

#include "control_shape.h"
#include "field/table_cursor.h"
#include "track/track.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <vector>

namespace trk {

/// Statistics of one channel of a super-voxel of size N over its (N+1)^3 vertices, in density
/// units. The mean weighs a vertex by the share of it that lies inside (1, 1/2, 1/4, 1/8), which
/// makes it the mean of the trilinear field. Bounds are rounded outward.
struct BakedSuperVoxel {
    float min = 0;
    float max = 0;
    float mean = 0;
    float deviation = 0;  ///< upper bound of the root mean square of density - mean
    float majorant = 0;   ///< sup |density - control|
    float rms = 0;        ///< upper bound of the residual's root mean square
};

/// `channels` numbers per super-voxel, those of a super-voxel side by side.
struct ValueTable {
    SparseTable table;  ///< entry: index of a super-voxel's values, plus one
    std::vector<float> values;
};

/// A whole bake. `table` maps local space to indices of super-voxels; equal ones are one. Each has
/// `channels` items and as many shapes, side by side. Where a control is not constant in its
/// super-voxel, the table's entry has SparseTable::kSingleFlag.
struct BakedVolume {
    int superVoxelShift = 4;  ///< log2 of the size
    size_t channels = 1;
    ControlKind kind = ControlKind::kConstant;
    SparseTable table;
    std::vector<BakedSuperVoxel> items;
    std::vector<float> shapes;  ///< shapeSize(kind) numbers a channel, see control_shape.h
    /// The density's least-squares gradient per voxel, 3 numbers a channel, whatever the kind:
    /// coarser super-voxels follow from it. Empty where nobody asked for it.
    std::vector<float> gradients;
    std::vector<ValueTable> levels;  ///< means of super-voxels 2, 4, … times as large
    int previewSize = 0;             ///< edge of the cubes of `preview`; 0: there is none
    ValueTable preview;              ///< means of smaller cubes, for pictures alone

    int superVoxelSize() const { return 1 << superVoxelShift; }
    const float* shape(size_t item) const { return shapes.data() + item * shapeSize(kind); }
    /// The control of an item (a super-voxel and channel).
    ControlPolynomial control(size_t item) const {
        return controlPolynomial(kind, items[item].mean, shape(item),
                                 std::ldexp(1.0, superVoxelShift));
    }
    /// Whether every channel of a super-voxel, whose first item is given, is the same everywhere.
    bool isHomogeneous(size_t firstItem) const {
        const auto first = items.begin() + static_cast<std::ptrdiff_t>(firstItem);
        return std::all_of(first, first + static_cast<std::ptrdiff_t>(channels),
                           [](const BakedSuperVoxel& v) { return v.min == v.max; });
    }
    float maxDensity() const {
        float max = 0;
        for (const BakedSuperVoxel& item : items) {
            max = std::max(max, item.max);
        }
        return max;
    }
    /// The largest coefficient of a control, in magnitude.
    double maxCoefficient() const {
        double max = 0;
        for (size_t i = 0; i < items.size(); ++i) {
            const ControlPolynomial c = control(i);
            max = std::max(max, std::fabs(c.centre));
            for (const double slope : c.slope) {
                max = std::max(max, std::fabs(slope));
            }
        }
        return max;
    }
};

/// What methods with a control need of one channel of a super-voxel, in extinction (1/world unit).
struct SuperVoxel {
    float baked;        ///< the baked control at the super-voxel's centre
    float control;      ///< of the residual method, as chosen, there
    float bound;        ///< sup |extinction - control|; 0 where the super-voxel is homogeneous
    float residualRms;  ///< root mean square of extinction - control, a quarter of bound at least
};

/// What methods without need. Apart, as none needs both.
struct ExtinctionRange {
    float min;
    float max;  ///< equal to `min` only where the super-voxel is homogeneous
    float rms;  ///< root mean square of the extinction, a quarter of max at least

    bool isHomogeneous() const { return min == max; }
};

/// A super-voxel on a ray's way: C channels, a control of kind K.
template <size_t C, ControlKind K>
class SuperVoxelView {
  public:
    SuperVoxelView() = default;
    SuperVoxelView(const SuperVoxel* items, const ExtinctionRange* ranges, const float* shapes,
                   const Vec3d& lo, double inverseSize)
        : items_(items), ranges_(ranges), shapes_(shapes), lo_(lo), inverseSize_(inverseSize) {}

    const SuperVoxel& operator[](size_t channel) const { return items_[channel]; }
    const ExtinctionRange& range(size_t channel) const { return ranges_[channel]; }

    /// The chosen control at a point of local space.
    double control(size_t channel, const Vec3d& point) const {
        const auto centre = static_cast<double>(items_[channel].control);
        if constexpr (K == ControlKind::kConstant) {
            return centre;
        } else {
            const float* shape = shapes_ + channel * kStride;
            return centre +
                   static_cast<double>(shape[0]) * evaluateSlope<K>(shape + 1, toUnit(point));
        }
    }
    /// Integral of the chosen control over [t0, t1] of the ray, in voxel lengths.
    double integrateControl(size_t channel, const LocalRay& ray, double t0, double t1) const {
        const auto centre = static_cast<double>(items_[channel].control);
        if constexpr (K == ControlKind::kConstant) {
            return centre * (t1 - t0);
        } else {
            const float* shape = shapes_ + channel * kStride;
            return centre * (t1 - t0) +
                   static_cast<double>(shape[0]) * integrateSlope(shape + 1, ray, t0, t1);
        }
    }
    /// The same of the baked control.
    double integrateBaked(size_t channel, const LocalRay& ray, double t0, double t1) const {
        const auto centre = static_cast<double>(items_[channel].baked);
        if constexpr (K == ControlKind::kConstant) {
            return centre * (t1 - t0);
        } else {
            return centre * (t1 - t0) +
                   integrateSlope(shapes_ + channel * kStride + 1, ray, t0, t1);
        }
    }

    /// Floats of a channel in the array of shapes: the share of the baked control's slope that the
    /// chosen one keeps, then the coefficients of the slope in extinction.
    static constexpr size_t kStride = slopeSize(K) == 0 ? 0 : 1 + slopeSize(K);

  private:
    Vec3d toUnit(const Vec3d& point) const {
        Vec3d u;
        for (int a = 0; a < 3; ++a) {
            u[a] = (point[a] - lo_[a]) * inverseSize_ - 0.5;
        }
        return u;
    }
    /// An affine control is linear along a ray, a trilinear one cubic: one Gauss point is exact for
    /// the first, two for the second.
    double integrateSlope(const float* coefficients, const LocalRay& ray, double t0,
                          double t1) const {
        const double middle = 0.5 * (t0 + t1);
        if constexpr (K == ControlKind::kAffine) {
            return evaluateSlope<K>(coefficients, toUnit(ray.at(middle))) * (t1 - t0);
        } else {
            const double offset = 0.5 * (t1 - t0) * 0.57735026918962576451;  // 1/sqrt(3)
            return 0.5 * (t1 - t0) *
                   (evaluateSlope<K>(coefficients, toUnit(ray.at(middle - offset))) +
                    evaluateSlope<K>(coefficients, toUnit(ray.at(middle + offset))));
        }
    }

    const SuperVoxel* items_ = nullptr;
    const ExtinctionRange* ranges_ = nullptr;
    const float* shapes_ = nullptr;
    Vec3d lo_;
    double inverseSize_ = 1;
};

template <size_t C, ControlKind K>
class SuperVoxelCursor;

/// The super-voxels of an opened volume, of as many channels as its extinction has. Immutable.
class SuperVoxels {
  public:
    SuperVoxels() = default;

    /// `scales`: extinction of a density of 1, per channel; one or three, and as many as the bake
    /// has channels unless that is one. `diagonal`: world length of a super-voxel's longest
    /// diagonal.
    SuperVoxels(BakedVolume baked, const std::vector<double>& scales, TrkChoice choice,
                double diagonal);

    ControlKind kind() const { return kind_; }
    int size() const { return 1 << table_.itemShift(); }
    uint64_t count() const { return table_.occupiedItems(); }
    size_t levelCount() const { return levels_.size(); }
    /// Box of the occupied super-voxels of a level, in cells.
    const IntBox& box(size_t level = 0) const { return boxes_[level]; }
    size_t bytes() const;

    /// Calls `visit(const SuperVoxelView&, tEnter, tExit)` along the ray until it answers false.
    /// C: the volume's channels; K: its kind of control, or kConstant where only what a view says
    /// without a point is asked.
    template <size_t C, ControlKind K, class Visit>
    void walk(const LocalRay& ray, double t0, double t1, Visit&& visit) const;

    /// Integral of the baked control extinction of a level over the ray, times the length of a
    /// voxel. Level 0 is the baked grid.
    template <size_t C, ControlKind K>
    std::array<double, C> integrateControl(const LocalRay& ray, size_t level,
                                           uint64_t& regions) const {
        std::array<double, C> sum{};
        if (level == 0) {
            walk<C, K>(ray, 0, ray.tEnd, [&](const auto& v, double tEnter, double tExit) {
                ++regions;
                for (size_t c = 0; c < C; ++c) {
                    sum[c] += v.integrateBaked(c, ray, tEnter, tExit);
                }
                return true;
            });
            return sum;
        }
        const ValueTable& means = levels_[level - 1];
        means.table.walk(
            ray, 0, ray.tEnd,
            [&](SparseTable::Entry entry, const Int3&, int, double tEnter, double tExit) {
                ++regions;
                const float* mean = &means.values[SparseTable::index(entry) * C];
                for (size_t c = 0; c < C; ++c) {
                    sum[c] += static_cast<double>(mean[c]) * (tExit - tEnter);
                }
                return true;
            });
        return sum;
    }

    /// The whole of a bake as one super-voxel over `box`, outside which the density is 0, with a
    /// constant control.
    static BakedVolume whole(const BakedVolume& baked, const IntBox& box);

    /// The constant control that `choice` makes of statistics given as true extinction. `diagonal`:
    /// world length of the super-voxel's longest diagonal.
    static double chooseControl(TrkChoice choice, double min, double mean, double max,
                                double diagonal);

    /// The share a of a control that is not constant which `choice` (robust or mean) keeps: the
    /// chosen control is min + a (control - min). `excess`: a bound of control - extinction.
    static double chooseShare(TrkChoice choice, double min, double max, double excess,
                              double diagonal);

  private:
    template <size_t C, ControlKind K>
    friend class SuperVoxelCursor;

    SparseTable table_;
    ControlKind kind_ = ControlKind::kConstant;
    std::vector<SuperVoxel> items_;
    std::vector<ExtinctionRange> ranges_;
    std::vector<float> shapes_;
    std::vector<ValueTable> levels_;       // in extinction
    std::vector<IntBox> boxes_{IntBox{}};  // one a level, from 0
};

/// The super-voxels on a ray's way, in order; may stop anywhere and go on. A few are found at a
/// time, so that what is baked of them is on its way from memory when they are asked for.
template <size_t C, ControlKind K>
class SuperVoxelCursor {
  public:
    using View = SuperVoxelView<C, K>;

    SuperVoxelCursor(const SuperVoxels& superVoxels, const LocalRay& ray, double t0, double t1)
        : superVoxels_(superVoxels),
          table_(superVoxels.table_, ray, t0, t1),
          inverseSize_(std::ldexp(1.0, -superVoxels.table_.itemShift())) {}

    bool next(View& view, double& tEnter, double& tExit) {
        if (at_ == count_) {
            at_ = 0;
            count_ = table_.refill();
            if (count_ == 0) {
                return false;
            }
            for (size_t i = 0; i < count_; ++i) {
                const size_t item = SparseTable::index(table_.entry(i)) * C;
                __builtin_prefetch(&superVoxels_.items_[item]);
                if constexpr (K != ControlKind::kConstant) {
                    __builtin_prefetch(superVoxels_.shapes_.data() + item * View::kStride);
                }
            }
        }
        Crossing crossing;
        table_.template take<K != ControlKind::kConstant>(at_++, crossing);
        const size_t item = SparseTable::index(crossing.entry) * C;
        view = View(&superVoxels_.items_[item], &superVoxels_.ranges_[item],
                    superVoxels_.shapes_.data() + item * View::kStride, crossing.lo, inverseSize_);
        tEnter = crossing.tEnter;
        tExit = crossing.tExit;
        return true;
    }

  private:
    const SuperVoxels& superVoxels_;
    TableCursor table_;
    double inverseSize_;
    size_t at_ = 0;
    size_t count_ = 0;
};

template <size_t C, ControlKind K, class Visit>
void SuperVoxels::walk(const LocalRay& ray, double t0, double t1, Visit&& visit) const {
    SuperVoxelCursor<C, K> cursor(*this, ray, t0, t1);
    SuperVoxelView<C, K> view;
    double tEnter = 0;
    double tExit = 0;
    while (cursor.next(view, tEnter, tExit)) {
        if (!visit(view, tEnter, tExit)) {
            return;
        }
    }
}

}  // namespace trk
