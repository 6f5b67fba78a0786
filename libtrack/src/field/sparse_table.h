// SPDX-License-Identifier: Apache-2.0
// A sparse table over integer space. Both the density field (whose items are bricks of 8^3 voxels)
// and the super-voxels (items of N^3 voxels) live in one.
#pragma once

#include "kernel.h"
#include "space/lattice.h"

#include <array>
#include <bitset>
#include <cstdint>
#include <optional>
#include <unordered_map>
#include <vector>

namespace trk {

/// Maps integer points to 32-bit entries: a dense root box over nodes of 8^3 children, as deep as
/// the extent asks for. An entry above item level is a tile: it stands for its whole region. What
/// an entry means beyond "empty" is its owner's; equal entries must mean equal contents. Nodes with
/// equal children are one node, and one whose children are all one tile or item is that entry:
/// large tiles have large but very regular surfaces, which thus cost next to nothing. A node with
/// one child that is not empty is a link, of 8 bytes instead of 2048. Memory goes with what is
/// occupied. Immutable: TableBuilder makes it.
class SparseTable {
  public:
    using Entry = uint32_t;
    using Node = std::array<Entry, 512>;

    static constexpr Entry kEmpty = 0;
    static constexpr Entry kNodeFlag = 0x80000000u;
    /// On a node that is a link.
    static constexpr Entry kLinkFlag = 0x40000000u;
    /// On an entry whose contents vary within an item and go by the item's place: 512 of them are a
    /// node, not a tile.
    static constexpr Entry kSingleFlag = 0x20000000u;

    /// What the entry of an item says besides flags, counted from 0.
    static size_t index(Entry entry) { return (entry & ~kSingleFlag) - 1; }

    struct Found {
        Entry entry;
        int shift;  ///< log2 of the edge, in voxels, of the region the entry stands for
    };

    SparseTable() = default;

    /// A table with one entry for the one item it has, of 2^itemShift voxels from 0 on.
    static SparseTable uniform(int itemShift, Entry entry) {
        SparseTable table;
        table.itemShift_ = table.rootShift_ = itemShift;
        table.rootSize_ = {{1, 1, 1}};
        table.root_ = {entry};
        return table;
    }

    int itemShift() const { return itemShift_; }
    /// Levels below the root; that of the items.
    int depth() const { return (rootShift_ - itemShift_) / 3; }
    /// log2 of the edge of the regions of a level, in voxels; and all of them.
    int shiftAt(int level) const { return rootShift_ - 3 * level; }
    Lattice lattice(int level) const {
        Lattice all;
        all.size = powerOfTwo(shiftAt(level));
        for (size_t a = 0; a < 3; ++a) {
            all.first[a] = rootLo_[a] << 3 * level;
            all.extent[a] = static_cast<int32_t>(rootSize_[a] << 3 * level);
        }
        return all;
    }
    /// The entry of a cell of such a lattice, or of what is larger and holds it.
    TRACK_APART Entry entryAt(int level, int32_t x, int32_t y, int32_t z) const {
        int shift = 3 * level;
        Entry entry = root_[static_cast<size_t>(
            ((x >> shift) * rootSize_[1] + (y >> shift)) * rootSize_[2] + (z >> shift))];
        while (shift > 0 && (entry & kNodeFlag)) {
            shift -= 3;
            entry = child(entry, childIndex(x >> shift, y >> shift, z >> shift));
        }
        return entry;
    }
    bool empty() const { return root_.empty(); }
    size_t bytes() const {
        return root_.capacity() * sizeof(Entry) + nodes_.capacity() * sizeof(Node) +
               links_.capacity() * sizeof(Link);
    }

    /// What the contents of a region follow from; equal keys, equal contents.
    using Key = std::vector<Entry>;

    /// Appends what this table holds in a region: a key for tables derived from it. False where
    /// that would be too long to be worth it; the key is then incomplete.
    bool appendKey(const Int3& origin, int shift, Key& key) const;

    /// For tables that only rays and points are looked for in: the same table, as a root alone
    /// where that stays in cache and is not nearly empty. To find an item is then one step.
    SparseTable flattened() &&;

    /// As find's `step`: the node found is the last on the way that is as large as 2^minShift.
    static constexpr int kWhole = 3;

    /// The entry at a point: an item, a tile, or, with `minShift`, the first node on the way that
    /// is not larger than 2^minShift (or see kWhole).
    Found find(int64_t x, int64_t y, int64_t z, int minShift = 0, int step = 1) const {
        const uint64_t rx = static_cast<uint64_t>((x >> rootShift_) - rootLo_[0]);
        const uint64_t ry = static_cast<uint64_t>((y >> rootShift_) - rootLo_[1]);
        const uint64_t rz = static_cast<uint64_t>((z >> rootShift_) - rootLo_[2]);
        const uint64_t ny = static_cast<uint64_t>(rootSize_[1]);
        const uint64_t nz = static_cast<uint64_t>(rootSize_[2]);
        if (rx >= static_cast<uint64_t>(rootSize_[0]) || ry >= ny || rz >= nz) {
            return {kEmpty, rootShift_};
        }
        Entry entry = root_[(rx * ny + ry) * nz + rz];
        int shift = rootShift_;
        while ((entry & kNodeFlag) && shift >= minShift + step) {
            shift -= 3;
            entry = child(entry, childIndex(x >> shift, y >> shift, z >> shift));
        }
        return {entry, shift};
    }

    /// Says that find will be asked for the entry at a point.
    void prefetch(int64_t x, int64_t y, int64_t z) const {
        if (depth() == 0) {
            const Int3 at{{x >> rootShift_, y >> rootShift_, z >> rootShift_}};
            __builtin_prefetch(&root_[static_cast<size_t>(
                ((at[0] - rootLo_[0]) * rootSize_[1] + at[1] - rootLo_[1]) * rootSize_[2] + at[2] -
                rootLo_[2])]);
            return;
        }
        const Found found = find(x, y, z, rootShift_);
        if ((found.entry & kNodeFlag) && (found.entry & kLinkFlag) == 0) {
            __builtin_prefetch(&nodes_[found.entry & kIndexMask][childIndex(
                x >> (rootShift_ - 3), y >> (rootShift_ - 3), z >> (rootShift_ - 3))]);
        }
    }

    /// Calls `visit(entry, lo, shift, tEnter, tExit)` for every occupied region the ray meets in
    /// [t0, t1], in order, until it answers false. Regions abut: one's tExit is the next one's
    /// tEnter, both computed from the integer plane between them, and the last tExit is t1.
    template <class Visit>
    void walk(const LocalRay& ray, double t0, double t1, Visit&& visit) const;

    /// Calls `f(lo, shift, entry)` for every occupied item and tile.
    template <class F>
    void forEach(F&& f) const {
        forEachRootRegion(
            [&](size_t i, const Int3& origin) { visitEntry(root_[i], origin, rootShift_, f); });
    }

    /// Box around everything occupied.
    IntBox occupiedBox() const;

    /// How many items are occupied, tiles counted as the items they stand for.
    uint64_t occupiedItems() const;

    /// The one entry that stands for everywhere in the region of 2^shift voxels at `origin`,
    /// aligned to its size, if any. Items that fill the region count too.
    std::optional<Entry> uniformEntry(const Int3& origin, int shift) const;

    /// The parts, eight an axis, of a region of 2^shift voxels at `origin`.
    using Parts = std::bitset<512>;

    /// Marks the parts of a region, aligned to its size, in which this table holds anything.
    void markOccupied(const Int3& origin, int shift, Parts& parts) const;

    static size_t childIndex(int64_t x, int64_t y, int64_t z) {
        return static_cast<size_t>((x & 7) << 6 | (y & 7) << 3 | (z & 7));
    }
    static Int3 childOrigin(const Int3& origin, int childShift, size_t child) {
        const auto c = static_cast<int64_t>(child);
        return {{origin[0] + ((c >> 6) << childShift), origin[1] + ((c >> 3 & 7) << childShift),
                 origin[2] + ((c & 7) << childShift)}};
    }

  private:
    friend class TableBuilder;
    friend class TableCursor;

    /// A node with one child that is not empty.
    struct Link {
        uint32_t child;
        Entry entry;

        bool operator==(const Link& o) const { return child == o.child && entry == o.entry; }
    };
    static constexpr Entry kIndexMask = kLinkFlag - 1;

    Entry child(Entry node, size_t i) const {
        if (node & kLinkFlag) {
            const Link& link = links_[node & kIndexMask];
            return link.child == i ? link.entry : kEmpty;
        }
        return nodes_[node & kIndexMask][i];
    }

    /// What of a region is occupied: a box, counted from its origin, and items. Of nodes that are
    /// met more than once, found once.
    struct Extent {
        IntBox box;
        uint64_t items = 0;
    };
    Extent extentOf(Entry entry, int shift, std::unordered_map<Entry, Extent>& known) const;

    size_t rootIndex(const Int3& at) const {
        size_t index = 0;
        for (size_t a = 0; a < 3; ++a) {
            index = index * static_cast<size_t>(rootSize_[a]) +
                    static_cast<size_t>((at[a] >> rootShift_) - rootLo_[a]);
        }
        return index;
    }

    /// Calls f(index, origin) for the children, of a node of 2^shift voxels at `origin`, that meet
    /// a box.
    template <class F>
    static void forEachChild(const IntBox& box, const Int3& origin, int shift, const F& f) {
        const int childShift = shift - 3;
        size_t lo[3];
        size_t hi[3];
        for (size_t a = 0; a < 3; ++a) {
            const int64_t size = int64_t{1} << shift;
            lo[a] = static_cast<size_t>(std::max<int64_t>(box.lo[a] - origin[a], 0) >> childShift);
            hi[a] = static_cast<size_t>(
                (std::min(box.hi[a] - origin[a], size) + (int64_t{1} << childShift) - 1) >>
                childShift);
        }
        for (size_t x = lo[0]; x < hi[0]; ++x) {
            for (size_t y = lo[1]; y < hi[1]; ++y) {
                for (size_t z = lo[2]; z < hi[2]; ++z) {
                    const size_t c = x << 6 | y << 3 | z;
                    f(c, childOrigin(origin, childShift, c));
                }
            }
        }
    }

    /// Marks the parts of 2^partShift voxels, of a region, that an entry of 2^shift voxels at `lo`
    /// occupies.
    void markEntry(Entry entry, const Int3& lo, int shift, const IntBox& region, int partShift,
                   Parts& parts) const;

    template <class F>
    void forEachRootRegion(F&& f) const {
        size_t i = 0;
        for (int64_t x = 0; x < rootSize_[0]; ++x) {
            for (int64_t y = 0; y < rootSize_[1]; ++y) {
                for (int64_t z = 0; z < rootSize_[2]; ++z, ++i) {
                    f(i, Int3{{(rootLo_[0] + x) << rootShift_, (rootLo_[1] + y) << rootShift_,
                               (rootLo_[2] + z) << rootShift_}});
                }
            }
        }
    }

    /// The same for the root's regions that meet a box.
    template <class F>
    void forEachRootRegion(const IntBox& box, F&& f) const {
        Int3 lo;
        Int3 hi;
        for (size_t a = 0; a < 3; ++a) {
            lo[a] = std::max(box.lo[a] >> rootShift_, rootLo_[a]);
            hi[a] = std::min(((box.hi[a] - 1) >> rootShift_) + 1, rootLo_[a] + rootSize_[a]);
        }
        Int3 at;
        for (at[0] = lo[0]; at[0] < hi[0]; ++at[0]) {
            for (at[1] = lo[1]; at[1] < hi[1]; ++at[1]) {
                for (at[2] = lo[2]; at[2] < hi[2]; ++at[2]) {
                    const Int3 origin{
                        {at[0] << rootShift_, at[1] << rootShift_, at[2] << rootShift_}};
                    f(rootIndex(origin), origin);
                }
            }
        }
    }

    /// As uniformEntry, of a region in or of an entry of 2^shift voxels, which is a node only where
    /// its children are smaller than the region.
    std::optional<Entry> uniformIn(Entry entry, int shift, const IntBox& region) const;

    template <class F>
    void visitEntry(Entry entry, const Int3& origin, int shift, F& f) const {
        if (entry == kEmpty) {
            return;
        }
        if ((entry & kNodeFlag) == 0) {
            f(origin, shift, entry);
            return;
        }
        if (entry & kLinkFlag) {
            const Link& link = links_[entry & kIndexMask];
            visitEntry(link.entry, childOrigin(origin, shift - 3, link.child), shift - 3, f);
            return;
        }
        for (size_t c = 0; c < 512; ++c) {
            visitEntry(nodes_[entry & kIndexMask][c], childOrigin(origin, shift - 3, c), shift - 3,
                       f);
        }
    }

    int itemShift_ = 0;
    int rootShift_ = 0;
    Int3 rootLo_{{0, 0, 0}};
    Int3 rootSize_{{0, 0, 0}};
    std::vector<Entry> root_;
    std::vector<Node> nodes_;
    std::vector<Link> links_;
};

}  // namespace trk
