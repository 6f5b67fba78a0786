// SPDX-License-Identifier: Apache-2.0
// Where a ray crosses a sparse table.
#pragma once

#include "kernel.h"
#include "space/lattice.h"
#include "sparse_table.h"

#include <cstddef>
#include <cstdint>

namespace trk {

/// An occupied region on a ray's way: an item or a tile of 2^shift voxels at `lo`, or a part of a
/// tile; its part of the ray is [tEnter, tExit].
struct Crossing {
    SparseTable::Entry entry;
    int shift;
    double tEnter;
    double tExit;
    Vec3d lo;  ///< integers
};

/// Crosses a table along [t0, t1] of a ray, in order; may stop anywhere and go on. Regions abut:
/// one's tExit is the next one's tEnter, and the last tExit is t1. Table and ray must live as long.
///
/// Each level of the table is a lattice. Items are crossed a window at a time, in short loops: when
/// cells are left, where they are, what they hold. Where several nodes lie one after another on the
/// way, their children are crossed as one lattice; empty regions and tiles are one step.
class TableCursor {
  public:
    using Entry = SparseTable::Entry;

    static constexpr size_t kMost = 16;  ///< items found at once

    TableCursor(const SparseTable& table, const LocalRay& ray, double t0, double t1)
        : table_(table), ray_(ray) {
        if (table.empty()) {
            depth_ = -1;
            return;
        }
        const Lattice root = table.lattice(0);
        int32_t cell[3];
        for (size_t a = 0; a < 3; ++a) {
            cell[a] = root.cellAt(ray, t0, a, 0, root.extent[a]);
        }
        depth_ = 0;
        levels_[0].begin(root, ray, cell, t0, t1);
    }

    /// The next occupied region; false at the end.
    bool next(Crossing& crossing) {
        if (at_ == count_ && refill() == 0) {
            return false;
        }
        const size_t i = at_++;
        crossing = {entry(i), table_.shiftAt(depth_), tEnter(i), tExit(i), lo(i)};
        return true;
    }

    /// The next occupied regions, a few at once: how many; 0 at the end. They are those from 0 on,
    /// until the next call. Not to be mixed with next().
    size_t refill() {
        at_ = count_ = 0;
        while (count_ == 0 && depth_ >= 0) {
            if (levels_[depth_].isDone()) {
                --depth_;
            } else if (depth_ < table_.depth()) {
                crossNodes();
            } else {
                levels_[depth_].cross(window_);
                depth_ == 0 ? findItems<0>() : depth_ == 1 ? findItems<1>() : findItems<2>();
            }
        }
        return count_;
    }
    Entry entry(size_t i) const { return entries_[i]; }
    double tEnter(size_t i) const { return window_.time[cells_[i]]; }
    double tExit(size_t i) const { return window_.time[cells_[i] + size_t{1}]; }
    /// Of what was found.
    Lattice lattice() const { return table_.lattice(depth_); }
    /// The lower corner. `lattice`: as above.
    Vec3d lo(size_t i, const Lattice& lattice) const {
        Vec3d corner;
        for (size_t a = 0; a < 3; ++a) {
            corner[static_cast<int>(a)] =
                lattice.size * static_cast<double>(lattice.first[a] + window_.cell(a, cells_[i]));
        }
        return corner;
    }
    Vec3d lo(size_t i) const { return lo(i, lattice()); }

  private:
    /// Of items of one voxel in the largest box.
    static constexpr int kMostLevels = 11;

    /// Up to the next nodes, where the walk then is, or the next tile.
    TRACK_APART void crossNodes() {
        LatticeWalk& level = levels_[depth_];
        bool inNodes = false;
        double t0 = 0;
        int32_t first[3] = {0, 0, 0};
        while (!level.isDone()) {
            const auto& at = level.cell();
            const Entry entry = table_.entryAt(depth_, at[0], at[1], at[2]);
            const bool isNode = (entry & SparseTable::kNodeFlag) != 0;
            if (inNodes && !isNode) {
                break;
            }
            const double tEnter = level.time();
            int32_t cell[3] = {at[0], at[1], at[2]};
            if (!level.step() || entry == SparseTable::kEmpty) {
                continue;
            }
            if (!isNode) {
                std::copy_n(cell, 3, window_.start);
                window_.crossed[0] = 0;
                window_.time[0] = tEnter;
                window_.time[1] = level.time();
                entries_[0] = entry;
                cells_[0] = 0;
                count_ = 1;
                return;
            }
            if (!inNodes) {
                inNodes = true;
                t0 = tEnter;
                std::copy_n(cell, 3, first);
            }
        }
        if (inNodes) {
            const Lattice children = table_.lattice(depth_ + 1);
            int32_t cell[3];
            for (size_t a = 0; a < 3; ++a) {
                cell[a] = children.cellAt(ray_, t0, a, 8 * first[a], 8 * first[a] + 8);
            }
            levels_[depth_ + 1].begin(children, ray_, cell, t0, level.time());
            ++depth_;
        }
    }

    /// What the cells of the window hold. kDepth: of the level, where it is 0 or 1.
    template <int kDepth>
    void findItems() {
        // Where their entries are.
        int32_t root[kMost];
        int32_t child[kMost];
        const auto rootY = static_cast<int32_t>(table_.rootSize_[1]);
        const auto rootZ = static_cast<int32_t>(table_.rootSize_[2]);
        for (size_t i = 0; i < window_.padded(); ++i) {
            const int32_t x = window_.cell(0, i);
            const int32_t y = window_.cell(1, i);
            const int32_t z = window_.cell(2, i);
            root[i] = ((x >> 3 * kDepth) * rootY + (y >> 3 * kDepth)) * rootZ + (z >> 3 * kDepth);
            child[i] = (x & 7) << 6 | (y & 7) << 3 | (z & 7);
        }
        size_t n = 0;
        for (size_t i = 0; i < window_.count; ++i) {
            Entry entry;
            if constexpr (kDepth == 2) {
                entry = table_.entryAt(depth_, window_.cell(0, i), window_.cell(1, i),
                                       window_.cell(2, i));
            } else {
                entry = table_.root_[static_cast<size_t>(root[i])];
                if (kDepth == 1 && (entry & SparseTable::kNodeFlag)) {
                    entry = table_.child(entry, static_cast<size_t>(child[i]));
                }
            }
            entries_[n] = entry;
            cells_[n] = static_cast<uint8_t>(i);
            n += static_cast<size_t>(entry != SparseTable::kEmpty) &
                 static_cast<size_t>(window_.time[i] < window_.time[i + 1]);
        }
        count_ = n;
    }

    const SparseTable& table_;
    const LocalRay& ray_;
    int depth_;  // of the level that is crossed; -1 at the end
    size_t at_ = 0;
    size_t count_ = 0;
    LatticeWindow<kMost> window_;
    Entry entries_[kMost];  // of the window's cells, those that are not empty
    uint8_t cells_[kMost];
    LatticeWalk levels_[kMostLevels];
};

template <class Visit>
void SparseTable::walk(const LocalRay& ray, double t0, double t1, Visit&& visit) const {
    TableCursor cursor(*this, ray, t0, t1);
    Crossing c{};
    while (cursor.next(c)) {
        const Int3 lo{{static_cast<int64_t>(c.lo[0]), static_cast<int64_t>(c.lo[1]),
                       static_cast<int64_t>(c.lo[2])}};
        if (!visit(c.entry, lo, c.shift, c.tEnter, c.tExit)) {
            return;
        }
    }
}

}  // namespace trk
