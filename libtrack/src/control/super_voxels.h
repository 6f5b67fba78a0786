// SPDX-License-Identifier: Apache-2.0
// A bake as queries read it: what a ray crosses, in density units, so that volumes of any scale,
// colour and choice of control share it.
#pragma once

#include "baked_volume.h"
#include "control_shape.h"
#include "field/table_cursor.h"

#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <vector>

namespace trk {

/// One channel of a super-voxel. `min` and `max` cover what look-ups return, rounding included, and
/// are equal only where it is homogeneous; then all are its value but for the deviation, which is
/// 0.
struct SuperVoxel {
    float min;
    float max;
    float mean;
    float deviation;  ///< upper bound of the root mean square of density - mean
};

/// One channel of a control that is not constant: kHead numbers, then the coefficients of
/// control_shape.h in units of kSlopeUnit: those of a trilinear control may be four times as large
/// as a float where the density is as large as one.
struct ControlShape {
    static constexpr size_t kHead = 4;
    static constexpr double kSlopeUnit = 4;
    const float* numbers;

    double centre() const { return static_cast<double>(numbers[0]); }
    double max() const { return static_cast<double>(numbers[1]); }  ///< anywhere in the super-voxel
    double majorant() const { return static_cast<double>(numbers[2]); }  ///< of density - control
    double rms() const { return static_cast<double>(numbers[3]); }       ///< of that too
    const float* slope() const { return numbers + kHead; }
};

template <size_t F, ControlKind K>
class SuperVoxelCursor;

/// The super-voxels of a bake, of as many channels as its density. Immutable.
class SuperVoxels {
  public:
    SuperVoxels() = default;
    explicit SuperVoxels(BakedVolume baked);

    size_t channels() const { return channels_; }
    ControlKind kind() const { return kind_; }
    int size() const { return 1 << table_.itemShift(); }
    uint64_t count() const { return table_.occupiedItems(); }
    size_t levelCount() const { return levels_.size(); }
    /// Box of the occupied super-voxels of a level, in cells.
    const IntBox& box(size_t level = 0) const { return boxes_[level]; }
    size_t bytes() const;

    /// Integral of the baked control of a level over the ray, in density and voxel lengths. Level 0
    /// is the baked grid. F: the bake's channels; K: its kind of control.
    template <size_t F, ControlKind K>
    std::array<double, F> integrateControl(const LocalRay& ray, size_t level,
                                           uint64_t& regions) const;

    /// The whole of a bake as one super-voxel over `box`, outside which the density is 0, with a
    /// constant control.
    static BakedVolume whole(const BakedVolume& baked, const IntBox& box);

  private:
    template <size_t F, ControlKind K>
    friend class SuperVoxelCursor;

    SparseTable table_;  // entry: index of a super-voxel, plus one
    size_t channels_ = 1;
    ControlKind kind_ = ControlKind::kConstant;
    std::vector<SuperVoxel> items_;
    std::vector<float> shapes_;  // of a ControlShape an item, where the kind has some
    std::vector<ValueTable> levels_;
    std::vector<IntBox> boxes_{IntBox{}};  // one a level, from 0
};

/// The super-voxels on a ray's way, in order, a few at a time. F: the bake's channels; one is that
/// of all channels of the extinction; K: its kind of control, or kConstant where nobody looks at
/// that.
template <size_t F, ControlKind K>
class SuperVoxelCursor {
  public:
    static constexpr size_t kMost = TableCursor::kMost;  ///< at a time

    SuperVoxelCursor(const SuperVoxels& superVoxels, const LocalRay& ray, double t0, double t1)
        : superVoxels_(superVoxels),
          table_(superVoxels.table_, ray, t0, t1),
          inverseSize_(powerOfTwo(-superVoxels.table_.itemShift())) {}

    /// The next few: how many; 0 at the end. The rest is about those from 0 on.
    size_t refill() {
        const size_t count = table_.refill();
        if (K != ControlKind::kConstant && count > 0) {
            lattice_ = table_.lattice();
            for (size_t i = 0; i < count; ++i) {
                __builtin_prefetch(&record(i, 0));
                __builtin_prefetch(shape(i, 0).numbers);
            }
        }
        return count;
    }
    double tEnter(size_t i) const { return table_.tEnter(i); }
    double tExit(size_t i) const { return table_.tExit(i); }
    const SuperVoxel& record(size_t i, size_t channel) const {
        return superVoxels_.items_[itemAt(i) + channelOf(channel)];
    }
    ControlShape shape(size_t i, size_t channel) const {
        return {superVoxels_.shapes_.data() + (itemAt(i) + channelOf(channel)) * kStride};
    }

    /// What the baked control adds to its value at the centre, at a point of local space.
    double slopeAt(size_t i, size_t channel, const Vec3d& point) const {
        return ControlShape::kSlopeUnit *
               evaluateSlope<K>(shape(i, channel).slope(), toUnit(table_.lo(i, lattice_), point));
    }
    /// Integral of that over the ray's part in the super-voxel. An affine control is linear along a
    /// ray, a trilinear one cubic: one Gauss point is exact for the first, two for the second.
    double integrateSlope(size_t i, size_t channel, const LocalRay& ray) const {
        const float* coefficients = shape(i, channel).slope();
        const Vec3d lo = table_.lo(i, lattice_);
        const double half = ControlShape::kSlopeUnit * 0.5 * (tExit(i) - tEnter(i));
        const double middle = 0.5 * (tExit(i) + tEnter(i));
        if constexpr (K == ControlKind::kAffine) {
            return 2 * half * evaluateSlope<K>(coefficients, toUnit(lo, ray.at(middle)));
        } else {
            const double offset =
                half / ControlShape::kSlopeUnit * 0.57735026918962576451;  // 1/sqrt(3)
            return half * (evaluateSlope<K>(coefficients, toUnit(lo, ray.at(middle - offset))) +
                           evaluateSlope<K>(coefficients, toUnit(lo, ray.at(middle + offset))));
        }
    }

  private:
    static constexpr size_t kStride = ControlShape::kHead + slopeSize(K);

    static size_t channelOf(size_t channel) { return F == 1 ? 0 : channel; }
    size_t itemAt(size_t i) const { return SparseTable::index(table_.entry(i)) * F; }
    Vec3d toUnit(const Vec3d& lo, const Vec3d& point) const {
        Vec3d u;
        for (int a = 0; a < 3; ++a) {
            u[a] = (point[a] - lo[a]) * inverseSize_ - 0.5;
        }
        return u;
    }

    const SuperVoxels& superVoxels_;
    TableCursor table_;
    Lattice lattice_;  // of what was found, where the control varies
    double inverseSize_;
};

template <size_t F, ControlKind K>
std::array<double, F> SuperVoxels::integrateControl(const LocalRay& ray, size_t level,
                                                    uint64_t& regions) const {
    std::array<double, F> sum{};
    if (level == 0) {
        SuperVoxelCursor<F, K> cursor(*this, ray, 0, ray.tEnd);
        while (const size_t count = cursor.refill()) {
            regions += count;
            for (size_t i = 0; i < count; ++i) {
                const double length = cursor.tExit(i) - cursor.tEnter(i);
                for (size_t c = 0; c < F; ++c) {
                    if constexpr (K == ControlKind::kConstant) {
                        sum[c] += static_cast<double>(cursor.record(i, c).mean) * length;
                    } else {
                        sum[c] +=
                            cursor.shape(i, c).centre() * length + cursor.integrateSlope(i, c, ray);
                    }
                }
            }
        }
        return sum;
    }
    const ValueTable& means = levels_[level - 1];
    means.table.walk(ray, 0, ray.tEnd,
                     [&](SparseTable::Entry entry, const Int3&, int, double tEnter, double tExit) {
                         ++regions;
                         const float* mean = &means.values[SparseTable::index(entry) * F];
                         for (size_t c = 0; c < F; ++c) {
                             sum[c] += static_cast<double>(mean[c]) * (tExit - tEnter);
                         }
                         return true;
                     });
    return sum;
}

}  // namespace trk
