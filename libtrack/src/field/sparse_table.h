// SPDX-License-Identifier: Apache-2.0
// A sparse table over integer space. Both the density field (whose items are bricks of 8^3 voxels)
// and the super-voxels (items of N^3 voxels) live in one.
#pragma once

#include "hash.h"
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
/// occupied.
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

    /// An empty table of items of 2^itemShift voxels over `box` (voxels, local, not negative).
    SparseTable(int itemShift, const IntBox& box) : itemShift_(itemShift), rootShift_(itemShift) {
        if (box.empty()) {
            return;
        }
        // A root of up to 32^3 regions stays in cache; deeper tables only for larger extents.
        constexpr int64_t kMaxRootRegions = 1 << 15;
        for (rootShift_ = itemShift + 3;; rootShift_ += 3) {
            for (size_t a = 0; a < 3; ++a) {
                rootLo_[a] = box.lo[a] >> rootShift_;
                rootSize_[a] = ((box.hi[a] - 1) >> rootShift_) + 1 - rootLo_[a];
            }
            const double regions = static_cast<double>(rootSize_[0]) *
                                   static_cast<double>(rootSize_[1]) *
                                   static_cast<double>(rootSize_[2]);
            if (regions <= kMaxRootRegions) {
                break;
            }
        }
        root_.assign(static_cast<size_t>(rootSize_[0] * rootSize_[1] * rootSize_[2]), kEmpty);
    }

    /// A region of 2^shift voxels, aligned to its size, and what stands for it.
    struct Place {
        Int3 lo;
        int shift;
        Entry entry;
    };

    /// Fills the table with these disjoint places, in any order: items, tiles as addBox makes them,
    /// nodes as addNode does. Time and memory go with their number.
    void assemble(std::vector<Place> places) {
        std::vector<size_t> first(root_.size() + 1);
        for (const Place& place : places) {
            ++first[rootIndex(place.lo) + 1];
        }
        for (size_t i = 1; i < first.size(); ++i) {
            first[i] += first[i - 1];
        }
        std::vector<Place> sorted(places.size());
        std::vector<size_t> next = first;
        for (const Place& place : places) {
            sorted[next[rootIndex(place.lo)]++] = place;
        }
        for (size_t i = 0; i < root_.size(); ++i) {
            root_[i] = assemble(sorted.data() + first[i], first[i + 1] - first[i],
                                places.data() + first[i], rootShift_);
        }
        finish();
    }

    /// Adds a box of voxels, of whole items, to `places`: as the largest regions that this table
    /// has entries for.
    void addBox(const IntBox& box, Entry entry, std::vector<Place>& places) const {
        forEachRootRegion(box, [&](size_t, const Int3& origin) {
            addPart(box, origin, rootShift_, entry, places);
        });
    }

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

    /// Tables whose contents another one's follow from.
    using Sources = std::vector<const SparseTable*>;

    /// Fills the table top down, wherever one of `sources` holds anything (everywhere, if there are
    /// none). `uniform(origin, shift)` answers for the region of 2^shift voxels: an entry that
    /// stands for all of it, or nothing, whereupon its eight times eight times eight parts are
    /// asked; `item(origin)` answers where items are not uniform. `keyOf(origin, shift, key)` may
    /// append what a region's contents follow from and answer true: regions with equal keys are
    /// built once.
    template <class Uniform, class Item, class KeyOf>
    void fill(const Sources& sources, Uniform&& uniform, Item&& item, KeyOf&& keyOf) {
        Memo memo;
        forEachRootRegion([&](size_t i, const Int3& origin) {
            root_[i] = build(sources, origin, rootShift_, uniform, item, keyOf, memo);
        });
        finish();
    }
    template <class Uniform, class Item>
    void fill(const Sources& sources, Uniform&& uniform, Item&& item) {
        fill(sources, uniform, item, [](const Int3&, int, Key&) { return false; });
    }

    /// Entries of a region and of its seven upper neighbours: bit 2 is x, bit 0 z.
    using Corners = std::array<Entry, 8>;

    /// Fills this table from one over the same items and box, where what a region holds follows
    /// from what the other holds there and in its upper neighbours. `entryOf(corners, shift)` is
    /// asked where none of them is a node, and answers the region's entry, or nothing, whereupon
    /// its parts are asked; of an item it must answer one. Equal corners, equal entries, but for
    /// items.
    template <class EntryOf>
    void fillFrom(const SparseTable& source, EntryOf&& entryOf) {
        std::unordered_map<Key, Entry, KeyHash> memo;
        const int64_t size = int64_t{1} << rootShift_;
        forEachRootRegion([&](size_t i, const Int3& origin) {
            Corners corners{};
            for (size_t c = 0; c < 8; ++c) {
                corners[c] =
                    source
                        .find(origin[0] + (c & 4 ? size : 0), origin[1] + (c & 2 ? size : 0),
                              origin[2] + (c & 1 ? size : 0), rootShift_)
                        .entry;
            }
            root_[i] = derive(source, corners, rootShift_, entryOf, memo);
        });
        finish();
    }

    /// Appends what this table holds in a region: a key for tables derived from it. False where
    /// that would be too long to be worth it; the key is then incomplete.
    bool appendKey(const Int3& origin, int shift, Key& key) const {
        if (root_.empty()) {
            key.push_back(kEmpty);
            return true;
        }
        int part = itemShift_;
        while (part + 3 <= std::min(shift, rootShift_)) {
            part += 3;
        }
        const int64_t count = int64_t{1} << std::max(shift - part, 0);
        if (count > 8) {
            return false;
        }
        for (int64_t i = 0; i < count * count * count; ++i) {
            const Int3 at{{origin[0] + ((i / (count * count)) << part),
                           origin[1] + ((i / count % count) << part),
                           origin[2] + ((i % count) << part)}};
            const Found found = find(at[0], at[1], at[2], part);
            key.push_back(found.entry);
            if (shift < itemShift_) {  // a part of an item: which one matters
                const int64_t mask = (int64_t{1} << itemShift_) - 1;
                key.push_back(static_cast<Entry>((at[0] & mask) << 16 | (at[1] & mask) << 8 |
                                                 (at[2] & mask)));
            }
        }
        return true;
    }

    /// The entry of a node with these children: the children's own where they are all one tile or
    /// item, that of an equal node where there is one, else a new node's. For use while the table
    /// is filled.
    Entry addNode(const Node& node) {
        const bool same =
            std::all_of(node.begin(), node.end(), [&](Entry e) { return e == node[0]; });
        if (same && (node[0] & (kNodeFlag | kSingleFlag)) == 0) {
            return node[0];
        }
        size_t occupied = 0;
        size_t last = 0;
        for (size_t c = 0; c < node.size() && occupied < 2; ++c) {
            if (node[c] != kEmpty) {
                ++occupied;
                last = c;
            }
        }
        if (occupied == 1) {
            return addLink(last, node[last]);
        }
        return addKnown(hashWords(node.data(), node.size() / 2, 0), nodes_, node, kNodeFlag);
    }

    /// The same table with every item and tile entry replaced by `map(entry)`, nodes that became
    /// uniform collapsed, and the nodes of one region next to each other in memory.
    template <class Map>
    SparseTable mapped(Map&& map) const {
        SparseTable result;
        result.itemShift_ = itemShift_;
        result.rootShift_ = rootShift_;
        result.rootLo_ = rootLo_;
        result.rootSize_ = rootSize_;
        std::unordered_map<Entry, Entry> done;
        for (const Entry entry : root_) {
            result.root_.push_back(mapEntry(entry, map, done, result));
        }
        result.finish();
        return result;
    }

    /// For tables that only rays and points are looked for in: the same table, as a root alone
    /// where that stays in cache and is not nearly empty. To find an item is then one step.
    SparseTable flattened() && {
        constexpr uint64_t kMostItems = 1 << 17;
        constexpr uint64_t kMostPerOccupied = 64;
        const int levels = depth();
        const auto items = static_cast<double>(root_.size()) * std::ldexp(1.0, 9 * levels);
        if (levels == 0 || items > static_cast<double>(kMostItems) ||
            items > static_cast<double>(kMostPerOccupied * occupiedItems())) {
            return std::move(*this);
        }
        SparseTable flat;
        flat.itemShift_ = flat.rootShift_ = itemShift_;
        for (size_t a = 0; a < 3; ++a) {
            flat.rootLo_[a] = rootLo_[a] << 3 * levels;
            flat.rootSize_[a] = rootSize_[a] << 3 * levels;
        }
        flat.root_.reserve(static_cast<size_t>(items));
        flat.forEachRootRegion([&](size_t, const Int3& origin) {
            flat.root_.push_back(find(origin[0], origin[1], origin[2]).entry);
        });
        return flat;
    }

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
    IntBox occupiedBox() const {
        std::unordered_map<Entry, Extent> known;
        IntBox box;
        forEachRootRegion([&](size_t i, const Int3& origin) {
            box.add(moved(extentOf(root_[i], rootShift_, known).box, origin));
        });
        return box;
    }

    /// How many items are occupied, tiles counted as the items they stand for.
    uint64_t occupiedItems() const {
        std::unordered_map<Entry, Extent> known;
        uint64_t count = 0;
        for (const Entry entry : root_) {
            count += extentOf(entry, rootShift_, known).items;
        }
        return count;
    }

    /// The one entry that stands for everywhere in the region of 2^shift voxels at `origin`,
    /// aligned to its size, if any. Items that fill the region count too.
    std::optional<Entry> uniformEntry(const Int3& origin, int shift) const {
        if (root_.empty()) {
            return kEmpty;
        }
        const int64_t size = int64_t{1} << shift;
        const IntBox region{origin, {{origin[0] + size, origin[1] + size, origin[2] + size}}};
        if (shift <= rootShift_) {
            const Found found = find(origin[0], origin[1], origin[2], shift, kWhole);
            return uniformIn(found.entry, found.shift, region);
        }
        bool outside = false;
        for (size_t a = 0; a < 3; ++a) {
            outside = outside || region.lo[a] < rootLo_[a] << rootShift_ ||
                      region.hi[a] > (rootLo_[a] + rootSize_[a]) << rootShift_;
        }
        std::optional<Entry> all = outside ? std::optional<Entry>(kEmpty) : std::nullopt;
        bool same = true;
        forEachRootRegion(region, [&](size_t i, const Int3&) {
            same = same && (root_[i] & kNodeFlag) == 0 && (!all || *all == root_[i]);
            all = root_[i];
        });
        return same ? all : std::nullopt;
    }

    /// The parts, eight an axis, of a region of 2^shift voxels at `origin`.
    using Parts = std::bitset<512>;

    /// Marks the parts of a region, aligned to its size, in which this table holds anything.
    void markOccupied(const Int3& origin, int shift, Parts& parts) const {
        const int64_t size = int64_t{1} << shift;
        const IntBox region{origin, {{origin[0] + size, origin[1] + size, origin[2] + size}}};
        forEachRootRegion(region, [&](size_t i, const Int3& lo) {
            markEntry(root_[i], lo, rootShift_, region, shift - 3, parts);
        });
    }

    static size_t childIndex(int64_t x, int64_t y, int64_t z) {
        return static_cast<size_t>((x & 7) << 6 | (y & 7) << 3 | (z & 7));
    }
    static Int3 childOrigin(const Int3& origin, int childShift, size_t child) {
        const auto c = static_cast<int64_t>(child);
        return {{origin[0] + ((c >> 6) << childShift), origin[1] + ((c >> 3 & 7) << childShift),
                 origin[2] + ((c & 7) << childShift)}};
    }

  private:
    friend class TableCursor;

    struct KeyHash {
        size_t operator()(const Key& key) const {
            return hashWords(key.data(), key.size() / 2, key.size() % 2 ? key.back() : 0);
        }
    };
    using Memo = std::unordered_map<Key, Entry, KeyHash>;

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

    /// The entry of an equal one, or of a new one.
    template <class Item>
    Entry addKnown(uint64_t hash, std::vector<Item>& items, const Item& item, Entry flags) {
        const auto [begin, end] = known_.equal_range(hash);
        for (auto it = begin; it != end; ++it) {
            if ((it->second & ~kIndexMask) == flags && items[it->second & kIndexMask] == item) {
                return it->second;
            }
        }
        items.push_back(item);
        const Entry entry = static_cast<Entry>(items.size() - 1) | flags;
        known_.emplace(hash, entry);
        return entry;
    }
    Entry addLink(size_t childAt, Entry entry) {
        const Link link{static_cast<uint32_t>(childAt), entry};
        uint64_t word;
        static_assert(sizeof(word) == sizeof(link));
        std::memcpy(&word, &link, sizeof(word));
        return addKnown(hashWords(&word, 1, 1), links_, link, kNodeFlag | kLinkFlag);
    }

    /// What of a region is occupied: a box, counted from its origin, and items. Of nodes that are
    /// met more than once, found once.
    struct Extent {
        IntBox box;
        uint64_t items = 0;
    };
    static IntBox moved(IntBox box, const Int3& by) {
        for (size_t a = 0; a < 3 && !box.empty(); ++a) {
            box.lo[a] += by[a];
            box.hi[a] += by[a];
        }
        return box;
    }
    Extent extentOf(Entry entry, int shift, std::unordered_map<Entry, Extent>& known) const {
        Extent extent;
        if (entry == kEmpty) {
            return extent;
        }
        if ((entry & kNodeFlag) == 0) {
            const int64_t size = int64_t{1} << shift;
            extent.box.add({{0, 0, 0}}, {{size, size, size}});
            extent.items = uint64_t{1} << 3 * (shift - itemShift_);
            return extent;
        }
        if (const auto it = known.find(entry); it != known.end()) {
            return it->second;
        }
        const auto add = [&](size_t c, Entry e) {
            const Extent part = extentOf(e, shift - 3, known);
            extent.box.add(moved(part.box, childOrigin({{0, 0, 0}}, shift - 3, c)));
            extent.items += part.items;
        };
        if (entry & kLinkFlag) {
            const Link& link = links_[entry & kIndexMask];
            add(link.child, link.entry);
        } else {
            for (size_t c = 0; c < 512; ++c) {
                add(c, nodes_[entry & kIndexMask][c]);
            }
        }
        known.emplace(entry, extent);
        return extent;
    }

    /// Gives back what only filling needs.
    void finish() {
        nodes_.shrink_to_fit();
        links_.shrink_to_fit();
        known_ = {};
    }

    size_t rootIndex(const Int3& at) const {
        size_t index = 0;
        for (size_t a = 0; a < 3; ++a) {
            index = index * static_cast<size_t>(rootSize_[a]) +
                    static_cast<size_t>((at[a] >> rootShift_) - rootLo_[a]);
        }
        return index;
    }

    /// The entry of a region of 2^shift voxels with these `count` places; `scratch` has room for as
    /// many. Both are left in another order.
    Entry assemble(Place* places, size_t count, Place* scratch, int shift) {
        if (count == 0) {
            return kEmpty;
        }
        const auto childOf = [](const Int3& lo, int childShift) {
            return childIndex(lo[0] >> childShift, lo[1] >> childShift, lo[2] >> childShift);
        };
        if (count == 1) {
            Entry entry = places->entry;
            for (int s = places->shift; s < shift; s += 3) {
                entry = addLink(childOf(places->lo, s), entry);
            }
            return entry;
        }
        std::array<size_t, 513> first{};
        for (size_t i = 0; i < count; ++i) {
            ++first[childOf(places[i].lo, shift - 3) + 1];
        }
        for (size_t c = 1; c < first.size(); ++c) {
            first[c] += first[c - 1];
        }
        std::array<size_t, 513> next = first;
        for (size_t i = 0; i < count; ++i) {
            scratch[next[childOf(places[i].lo, shift - 3)]++] = places[i];
        }
        Node node;
        for (size_t c = 0; c < node.size(); ++c) {
            node[c] =
                assemble(scratch + first[c], first[c + 1] - first[c], places + first[c], shift - 3);
        }
        return addNode(node);
    }

    /// The part of a box in the region of 2^shift voxels at `origin`, which meets it.
    void addPart(const IntBox& box, const Int3& origin, int shift, Entry entry,
                 std::vector<Place>& places) const {
        const int64_t size = int64_t{1} << shift;
        bool inside = true;
        for (size_t a = 0; a < 3; ++a) {
            inside = inside && box.lo[a] <= origin[a] && box.hi[a] >= origin[a] + size;
        }
        if (inside) {
            places.push_back({origin, shift, entry});
            return;
        }
        forEachChild(box, origin, shift,
                     [&](size_t, const Int3& lo) { addPart(box, lo, shift - 3, entry, places); });
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
    static void markPart(const Int3& lo, const IntBox& region, int partShift, Parts& parts) {
        parts.set(childIndex((lo[0] - region.lo[0]) >> partShift,
                             (lo[1] - region.lo[1]) >> partShift,
                             (lo[2] - region.lo[2]) >> partShift));
    }
    void markEntry(Entry entry, const Int3& lo, int shift, const IntBox& region, int partShift,
                   Parts& parts) const {
        if (entry == kEmpty) {
            return;
        }
        if (shift <= partShift) {
            markPart(lo, region, partShift, parts);
            return;
        }
        if ((entry & kNodeFlag) == 0) {  // a tile: what it shares with the region
            IntBox box = region;
            for (size_t a = 0; a < 3; ++a) {
                box.lo[a] = std::max(box.lo[a], lo[a]);
                box.hi[a] = std::min(box.hi[a], lo[a] + (int64_t{1} << shift));
            }
            forEachChild(box, region.lo, partShift + 3,
                         [&](size_t c, const Int3&) { parts.set(c); });
            return;
        }
        if (entry & kLinkFlag) {
            const Link& link = links_[entry & kIndexMask];
            const Int3 at = childOrigin(lo, shift - 3, link.child);
            bool meets = true;
            for (size_t a = 0; a < 3; ++a) {
                meets = meets && at[a] < region.hi[a] &&
                        at[a] + (int64_t{1} << (shift - 3)) > region.lo[a];
            }
            if (meets) {
                markEntry(link.entry, at, shift - 3, region, partShift, parts);
            }
            return;
        }
        const Node& node = nodes_[entry & kIndexMask];
        forEachChild(region, lo, shift, [&](size_t c, const Int3& at) {
            if (node[c] != kEmpty) {
                markEntry(node[c], at, shift - 3, region, partShift, parts);
            }
        });
    }

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

    template <class Uniform, class Item, class KeyOf>
    Entry build(const Sources& sources, const Int3& origin, int shift, Uniform& uniform, Item& item,
                KeyOf& keyOf, Memo& memo) {
        if (const std::optional<Entry> entry = uniform(origin, shift)) {
            return *entry;
        }
        Key key;
        const bool known = keyOf(origin, shift, key);
        if (known) {
            key.push_back(static_cast<Entry>(shift));
            if (const auto it = memo.find(key); it != memo.end()) {
                return it->second;
            }
        }
        Entry entry = kEmpty;
        if (shift == itemShift_) {
            entry = item(origin);
        } else {
            Parts parts;
            for (const SparseTable* source : sources) {
                source->markOccupied(origin, shift, parts);
            }
            Node node;
            for (size_t c = 0; c < node.size(); ++c) {
                node[c] = sources.empty() || parts[c]
                              ? build(sources, childOrigin(origin, shift - 3, c), shift - 3,
                                      uniform, item, keyOf, memo)
                              : kEmpty;
            }
            entry = addNode(node);
        }
        if (known) {
            memo.emplace(std::move(key), entry);
        }
        return entry;
    }

    /// As uniformEntry, of a region in or of an entry of 2^shift voxels, which is a node only where
    /// its children are smaller than the region.
    std::optional<Entry> uniformIn(Entry entry, int shift, const IntBox& region) const {
        if ((entry & kNodeFlag) == 0) {
            return entry;
        }
        std::optional<Entry> all;
        bool same = true;
        const Int3 lo{{region.lo[0] >> shift << shift, region.lo[1] >> shift << shift,
                       region.lo[2] >> shift << shift}};
        forEachChild(region, lo, shift, [&](size_t c, const Int3&) {
            const Entry e = child(entry, c);
            same = same && (e & kNodeFlag) == 0 && (!all || *all == e);
            all = e;
        });
        return same ? all : std::nullopt;
    }

    template <class EntryOf>
    Entry derive(const SparseTable& source, const Corners& corners, int shift, EntryOf& entryOf,
                 std::unordered_map<Key, Entry, KeyHash>& memo) {
        Entry all = kEmpty;
        bool sparse = true;
        for (const Entry e : corners) {
            all |= e;
            sparse = sparse && (e == kEmpty || ((e & kNodeFlag) && (e & kLinkFlag)));
        }
        if (all == kEmpty) {
            return kEmpty;
        }
        if ((all & kNodeFlag) == 0) {
            if (const std::optional<Entry> entry = entryOf(corners, shift)) {
                return *entry;
            }
        }
        Key key(corners.begin(), corners.end());
        key.push_back(static_cast<Entry>(shift));
        if (const auto it = memo.find(key); it != memo.end()) {
            return it->second;
        }
        // The parts' entries, nine an axis: the last of each is the upper neighbour's.
        std::array<Entry, 729> parts{};
        Parts occupied;  // children that anything is at a corner of, where that is known
        const auto childFrom = [&](size_t c) {
            const Entry* at = &parts[(c >> 6) * 81 + (c >> 3 & 7) * 9 + (c & 7)];
            return derive(source, {at[0], at[1], at[9], at[10], at[81], at[82], at[90], at[91]},
                          shift - 3, entryOf, memo);
        };
        for (size_t c = 0; c < 8; ++c) {
            if (corners[c] == kEmpty) {
                continue;
            }
            const size_t first = (c & 4 ? 8 * 81 : 0) + (c & 2 ? 8 * 9 : 0) + (c & 1 ? 8 : 0);
            if (sparse) {
                const Link& link = source.links_[corners[c] & kIndexMask];
                const size_t at[3] = {link.child >> 6, link.child >> 3 & 7, link.child & 7};
                if ((c & 4 && at[0] > 0) || (c & 2 && at[1] > 0) || (c & 1 && at[2] > 0)) {
                    continue;
                }
                parts[first + at[0] * 81 + at[1] * 9 + at[2]] = link.entry;
                for (size_t k = 0; k < 8; ++k) {  // whose corner it is
                    const size_t x = at[0] + (c & 4 ? 8 : 0) - (k >> 2);
                    const size_t y = at[1] + (c & 2 ? 8 : 0) - (k >> 1 & 1);
                    const size_t z = at[2] + (c & 1 ? 8 : 0) - (k & 1);
                    if (x < 8 && y < 8 && z < 8) {
                        occupied.set(x << 6 | y << 3 | z);
                    }
                }
                continue;
            }
            for (size_t x = 0; x < (c & 4 ? 1u : 8u); ++x) {
                for (size_t y = 0; y < (c & 2 ? 1u : 8u); ++y) {
                    for (size_t z = 0; z < (c & 1 ? 1u : 8u); ++z) {
                        parts[first + x * 81 + y * 9 + z] =
                            corners[c] & kNodeFlag ? source.child(corners[c], x << 6 | y << 3 | z)
                                                   : corners[c];
                    }
                }
            }
        }
        Node node{};
        for (size_t c = 0; c < node.size(); ++c) {
            if (!sparse || occupied[c]) {
                node[c] = childFrom(c);
            }
        }
        const Entry entry = addNode(node);
        memo.emplace(std::move(key), entry);
        return entry;
    }

    template <class Map>
    Entry mapEntry(Entry entry, Map& map, std::unordered_map<Entry, Entry>& done,
                   SparseTable& result) const {
        if (entry == kEmpty) {
            return kEmpty;
        }
        if ((entry & kNodeFlag) == 0) {
            return map(entry);
        }
        if (const auto it = done.find(entry); it != done.end()) {
            return it->second;
        }
        if (entry & kLinkFlag) {
            const Link& link = links_[entry & kIndexMask];
            const Entry mapped = mapEntry(link.entry, map, done, result);
            return done[entry] = mapped == kEmpty ? kEmpty : result.addLink(link.child, mapped);
        }
        Node node = nodes_[entry & kIndexMask];
        for (Entry& e : node) {
            e = mapEntry(e, map, done, result);
        }
        return done[entry] = result.addNode(node);
    }

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
    std::unordered_multimap<uint64_t, Entry> known_;  // nodes and links by hash, while filling
};

}  // namespace trk
