// SPDX-License-Identifier: Apache-2.0
// The baked grid: as it is stored (density units) and as a query reads it (extinction).
#pragma once

#include "sparse_table.h"
#include "track/track.h"

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <vector>

namespace trk {

/// Statistics of one super-voxel of size N over its (N+1)^3 vertices, in density units. The mean
/// weighs a vertex by the share of it that lies inside (1, 1/2, 1/4, 1/8), which makes it the mean
/// of the trilinear field. Bounds are rounded outward.
struct BakedSuperVoxel {
    float min = 0;
    float max = 0;
    float control = 0;   ///< the mean
    float majorant = 0;  ///< sup |density - control|
    float rms = 0;       ///< upper bound of the residual's root mean square
};

/// One number per super-voxel.
struct ScalarTable {
    SparseTable table;  ///< entry: index into `values`, plus one
    std::vector<float> values;
};

/// A whole bake. `table` maps local space to indices into `items`, plus one.
struct BakedVolume {
    int superVoxelShift = 4;  ///< log2 of the size
    SparseTable table;
    std::vector<BakedSuperVoxel> items;
    std::vector<ScalarTable> levels;  ///< means of super-voxels 2, 4, … times as large

    int superVoxelSize() const { return 1 << superVoxelShift; }
    float maxDensity() const {
        float max = 0;
        for (const BakedSuperVoxel& item : items) {
            max = std::max(max, item.max);
        }
        return max;
    }
};

/// What a query needs of one super-voxel, in extinction (1/world unit).
struct SuperVoxel {
    float mean;     ///< the baked control
    float control;  ///< of the residual method, as chosen
    float bound;    ///< sup |extinction - control|
    float max;
};

/// The super-voxels of an opened volume. Immutable.
class SuperVoxels {
  public:
    SuperVoxels() = default;

    /// `diagonal`: world length of a voxel's longest diagonal.
    SuperVoxels(BakedVolume baked, float scale, TrkChoice choice, double diagonal);

    int size() const { return 1 << table_.itemShift(); }
    uint64_t count() const { return table_.occupiedItems(); }
    size_t levelCount() const { return levels_.size(); }
    /// Box of the occupied super-voxels of a level, in cells.
    const IntBox& box(size_t level = 0) const { return boxes_[level]; }
    size_t bytes() const;

    /// Calls `visit(const SuperVoxel&, tEnter, tExit)` along the ray until it answers false.
    template <class Visit>
    void walk(const LocalRay& ray, double t0, double t1, Visit&& visit) const {
        table_.walk(ray, t0, t1,
                    [&](SparseTable::Entry entry, const Int3&, int, double tEnter, double tExit) {
                        return visit(items_[entry - 1], tEnter, tExit);
                    });
    }

    /// Integral of the control extinction of a level over the ray, times the length of a voxel.
    /// Level 0 is the baked grid.
    double integrateControl(const LocalRay& ray, size_t level, uint64_t& regions) const;

    /// The control that `choice` makes of statistics given as true extinction. `diagonal`: world
    /// length of the super-voxel's longest diagonal.
    static double chooseControl(TrkChoice choice, double min, double mean, double max,
                                double diagonal);

  private:
    SparseTable table_;
    std::vector<SuperVoxel> items_;
    std::vector<ScalarTable> levels_;      // in extinction
    std::vector<IntBox> boxes_{IntBox{}};  // one a level, from 0
};

}  // namespace trk
