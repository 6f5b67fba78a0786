// SPDX-License-Identifier: Apache-2.0
// Where a ray crosses a sparse table.
#pragma once

#include "sparse_table.h"

#include <algorithm>
#include <cstddef>
#include <cstdint>

namespace trk {

/// An occupied region on a ray's way: an item or a tile of 2^shift voxels at `lo`, whose part of
/// the ray is [tEnter, tExit].
struct Crossing {
    SparseTable::Entry entry;
    int shift;
    double tEnter;
    double tExit;
    Vec3d lo;  ///< integers
};

/// Crosses a table along [t0, t1] of a ray, in order; may stop anywhere and go on. Regions abut:
/// one's tExit is the next one's tEnter, both computed from the integer plane between them, and the
/// last tExit is t1. Table and ray must live as long.
///
/// It steps through the children of one node at a time (of the root, up to eight an axis), for
/// which it knows the times of all planes ahead. Where the next child is a node, or these are left,
/// the region is found from the root again.
class TableCursor {
  public:
    TableCursor(const SparseTable& table, const LocalRay& ray, double t0, double t1)
        : table_(table), ray_(ray), t_(t0), tEnd_(t1), done_(table.root_.empty()) {
        if (done_) {
            return;
        }
        Int3 cell;
        const Vec3d start = ray.at(t0);
        for (size_t a = 0; a < 3; ++a) {
            const int64_t lo = table.rootLo_[a] << table.rootShift_;
            cell[a] = clamped(start[static_cast<int>(a)], lo,
                              lo + (table.rootSize_[a] << table.rootShift_));
        }
        enter(cell);
    }

    /// The next occupied region; false at the end. `kWithPlace`: with its lower corner.
    template <bool kWithPlace = true>
    bool next(Crossing& crossing) {
        while (!done_) {
            const double tX = planes_[0][at_[0]];
            const double tY = planes_[1][at_[1]];
            const double tZ = planes_[2][at_[2]];
            const double plane = std::min(std::min(tX, tY), tZ);
            const double tEnter = t_;
            t_ = std::max(tEnter, std::min(plane, tEnd_));
            done_ = !(plane < tEnd_);
            const bool found = entry_ != SparseTable::kEmpty && t_ > tEnter;
            if (found) {
                crossing.entry = entry_;
                crossing.shift = shift_;
                crossing.tEnter = tEnter;
                crossing.tExit = t_;
                for (int a = 0; kWithPlace && a < 3; ++a) {
                    crossing.lo[a] = lower(a);
                }
            }
            // Not by branches: nobody could predict them.
            const size_t isX = static_cast<size_t>(tX <= tY) & static_cast<size_t>(tX <= tZ);
            const size_t isY = static_cast<size_t>(tY <= tZ) & (isX ^ 1);
            const size_t isZ = (isX | isY) ^ 1;
            at_[0] += isX;
            at_[1] += isY;
            at_[2] += isZ;
            if (((at_[0] | at_[1] | at_[2]) & kPlanes) == 0) {
                child_ += stride_[isY + 2 * isZ];
                entry_ = childAt();
                if (entry_ & SparseTable::kNodeFlag) {
                    enterNext(static_cast<int>(isY + 2 * isZ));
                }
            } else if (!done_) {
                enterNext(static_cast<int>(isY + 2 * isZ));
            }
            if (found) {
                return true;
            }
        }
        return false;
    }

  private:
    using Entry = SparseTable::Entry;
    static constexpr size_t kPlanes = 8;

    static int64_t clamped(double x, int64_t lo, int64_t hi) {
        // Points here are never negative but for rounding, so truncation is as good as floor.
        return std::min(std::max(static_cast<int64_t>(x), lo), hi - 1);
    }
    /// The lower corner of the current cell.
    double lower(int axis) const {
        return last_[axis] + static_cast<double>(at_[axis]) * step_[axis];
    }

    /// The region beyond the plane of an axis that was just crossed.
    void enterNext(int axis) {
        if (isBelowRoot_ && at_[axis] == kPlanes && enterNeighbour(axis)) {
            return;
        }
        Int3 cell;
        for (int a = 0; a < 3; ++a) {
            const auto i = static_cast<size_t>(a);
            const auto lo = static_cast<int64_t>(lower(a));
            const int64_t size = int64_t{1} << shift_;
            cell[i] = a == axis ? (step_[a] > 0 ? lo : lo + size - 1)
                                : clamped(ray_.origin[a] + t_ * ray_.direction[a], lo, lo + size);
            const int64_t first = table_.rootLo_[i] << table_.rootShift_;
            if (cell[i] < first || cell[i] >= first + (table_.rootSize_[i] << table_.rootShift_)) {
                done_ = true;
                return;
            }
        }
        enter(cell);
    }

    /// From a node of the root's to the one beside it, where there is one: the other axes have the
    /// planes that they had.
    bool enterNeighbour(int axis) {
        const auto i = static_cast<size_t>(axis);
        const int64_t beside = rootAt_[i] + (step_[axis] > 0 ? 1 : -1);
        if (beside < 0 || beside >= table_.rootSize_[i]) {
            return false;
        }
        Int3 at = rootAt_;
        at[i] = beside;
        const Entry node = table_.root_[static_cast<size_t>(
            (at[0] * table_.rootSize_[1] + at[1]) * table_.rootSize_[2] + at[2])];
        if ((node & SparseTable::kNodeFlag) == 0 || (node & SparseTable::kLinkFlag) != 0) {
            return false;
        }
        const Entry* entries = table_.nodes_[node & SparseTable::kIndexMask].data();
        const std::ptrdiff_t child = child_ - 7 * stride_[axis];
        if (entries[child] & SparseTable::kNodeFlag) {
            return false;
        }
        rootAt_ = at;
        entries_ = entries;
        child_ = child;
        entry_ = entries[child];
        at_[axis] = 0;
        last_[axis] += static_cast<double>(kPlanes) * step_[axis];
        fillPlanes(axis);
        return true;
    }
    void fillPlanes(int axis) {
        const double first = last_[axis] + std::max(step_[axis], 0.0);
        for (size_t k = 0; k < kPlanes; ++k) {
            planes_[axis][k] = (first + static_cast<double>(k) * step_[axis] - ray_.origin[axis]) *
                               ray_.inverse[axis];
        }
    }

    Entry childAt() const { return entries_ ? entries_[child_] : child_ == linked_ ? link_ : 0; }

    /// Finds the region around a voxel cell of the root's box, from the root.
    void enter(const Int3& cell) {
        shift_ = table_.rootShift_;
        entries_ = table_.root_.data();
        std::ptrdiff_t strides[3] = {
            static_cast<std::ptrdiff_t>(table_.rootSize_[1] * table_.rootSize_[2]),
            static_cast<std::ptrdiff_t>(table_.rootSize_[2]), 1};
        Int3 at;
        Int3 count = table_.rootSize_;
        for (size_t a = 0; a < 3; ++a) {
            at[a] = (cell[a] >> shift_) - table_.rootLo_[a];
        }
        rootAt_ = at;
        child_ = at[0] * strides[0] + at[1] * strides[1] + at[2];
        entry_ = childAt();
        while (entry_ & SparseTable::kNodeFlag) {
            shift_ -= 3;
            if (entry_ & SparseTable::kLinkFlag) {
                const SparseTable::Link& link = table_.links_[entry_ & SparseTable::kIndexMask];
                entries_ = nullptr;
                linked_ = link.child;
                link_ = link.entry;
            } else {
                entries_ = table_.nodes_[entry_ & SparseTable::kIndexMask].data();
            }
            for (size_t a = 0; a < 3; ++a) {
                at[a] = cell[a] >> shift_ & 7;
            }
            count = {{8, 8, 8}};
            strides[0] = 64;
            strides[1] = 8;
            child_ = at[0] << 6 | at[1] << 3 | at[2];
            entry_ = childAt();
        }
        isBelowRoot_ = entries_ && shift_ == table_.rootShift_ - 3;
        const int64_t size = int64_t{1} << shift_;
        for (int a = 0; a < 3; ++a) {
            const auto i = static_cast<size_t>(a);
            const bool backwards = ray_.direction[a] < 0;
            const int64_t ahead = std::min<int64_t>(backwards ? at[i] + 1 : count[i] - at[i], 8);
            const auto lo = static_cast<double>(cell[i] & -size);
            step_[a] = static_cast<double>(backwards ? -size : size);
            stride_[a] = backwards ? -strides[a] : strides[a];
            at_[a] = kPlanes - static_cast<size_t>(ahead);
            last_[a] = lo - static_cast<double>(at_[a]) * step_[a];
            fillPlanes(a);
        }
    }

    const SparseTable& table_;
    const LocalRay& ray_;
    double t_;
    double tEnd_;
    bool done_;
    Entry entry_ = 0;  // of the current cell
    int shift_ = 0;
    Int3 rootAt_{{0, 0, 0}};          // the root's child
    bool isBelowRoot_ = false;        // what is stepped through is that, and no link
    const Entry* entries_ = nullptr;  // the children stepped through, NULL where there is but one
    std::ptrdiff_t child_ = 0;        // the current one's place
    std::ptrdiff_t linked_ = 0;
    Entry link_ = 0;
    size_t at_[3];              // planes of an axis crossed, of the eight known
    std::ptrdiff_t stride_[3];  // to the next child of an axis
    double step_[3];            // the same in voxels
    double last_[3];            // where a cell would lie of which no plane is crossed
    double planes_[3][kPlanes];
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
