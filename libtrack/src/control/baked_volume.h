// SPDX-License-Identifier: Apache-2.0
// A bake as it is stored, in density units.
#pragma once

#include "control_shape.h"
#include "field/sparse_table.h"

#include <algorithm>
#include <cmath>
#include <cstddef>
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

}  // namespace trk
