// SPDX-License-Identifier: Apache-2.0
// How a sparse table is made: top down, from another one, or from places in any order.
#pragma once

#include "hash.h"
#include "sparse_table.h"

#include <algorithm>
#include <array>
#include <cstdint>
#include <cstring>
#include <optional>
#include <unordered_map>
#include <utility>
#include <vector>

namespace trk {

/// Makes one table: one of fill, fillFrom and assemble ends it.
class TableBuilder {
  public:
    using Entry = SparseTable::Entry;
    using Node = SparseTable::Node;
    using Key = SparseTable::Key;

    /// Of items of 2^itemShift voxels over `box` (voxels, local, not negative).
    TableBuilder(int itemShift, const IntBox& box) {
        table_.itemShift_ = table_.rootShift_ = itemShift;
        if (box.empty()) {
            return;
        }
        // A root of up to 32^3 regions stays in cache; deeper tables only for larger extents.
        constexpr int64_t kMaxRootRegions = 1 << 15;
        for (table_.rootShift_ = itemShift + 3;; table_.rootShift_ += 3) {
            for (size_t a = 0; a < 3; ++a) {
                table_.rootLo_[a] = box.lo[a] >> table_.rootShift_;
                table_.rootSize_[a] =
                    ((box.hi[a] - 1) >> table_.rootShift_) + 1 - table_.rootLo_[a];
            }
            const double regions = static_cast<double>(table_.rootSize_[0]) *
                                   static_cast<double>(table_.rootSize_[1]) *
                                   static_cast<double>(table_.rootSize_[2]);
            if (regions <= kMaxRootRegions) {
                break;
            }
        }
        table_.root_.assign(
            static_cast<size_t>(table_.rootSize_[0] * table_.rootSize_[1] * table_.rootSize_[2]),
            SparseTable::kEmpty);
    }

    /// Tables whose contents another one's follow from.
    using Sources = std::vector<const SparseTable*>;

    /// Fills the table top down, wherever one of `sources` holds anything (everywhere, if there are
    /// none). `uniform(origin, shift)` answers for the region of 2^shift voxels: an entry that
    /// stands for all of it, or nothing, whereupon its eight times eight times eight parts are
    /// asked; `item(origin)` answers where items are not uniform. `keyOf(origin, shift, key)` may
    /// append what a region's contents follow from and answer true: regions with equal keys are
    /// built once.
    template <class Uniform, class Item, class KeyOf>
    SparseTable fill(const Sources& sources, Uniform&& uniform, Item&& item, KeyOf&& keyOf) {
        Memo memo;
        table_.forEachRootRegion([&](size_t i, const Int3& origin) {
            table_.root_[i] = build(sources, origin, table_.rootShift_, uniform, item, keyOf, memo);
        });
        return finish();
    }
    template <class Uniform, class Item>
    SparseTable fill(const Sources& sources, Uniform&& uniform, Item&& item) {
        return fill(sources, uniform, item, [](const Int3&, int, Key&) { return false; });
    }

    /// Entries of a region and of its seven upper neighbours: bit 2 is x, bit 0 z.
    using Corners = std::array<Entry, 8>;

    /// Fills the table from one over the same items and box, where what a region holds follows
    /// from what the other holds there and in its upper neighbours. `entryOf(corners, shift)` is
    /// asked where none of them is a node, and answers the region's entry, or nothing, whereupon
    /// its parts are asked; of an item it must answer one. Equal corners, equal entries, but for
    /// items.
    template <class EntryOf>
    SparseTable fillFrom(const SparseTable& source, EntryOf&& entryOf) {
        std::unordered_map<Key, Entry, KeyHash> memo;
        const int64_t size = int64_t{1} << table_.rootShift_;
        table_.forEachRootRegion([&](size_t i, const Int3& origin) {
            Corners corners{};
            for (size_t c = 0; c < 8; ++c) {
                corners[c] =
                    source
                        .find(origin[0] + (c & 4 ? size : 0), origin[1] + (c & 2 ? size : 0),
                              origin[2] + (c & 1 ? size : 0), table_.rootShift_)
                        .entry;
            }
            table_.root_[i] = derive(source, corners, table_.rootShift_, entryOf, memo);
        });
        return finish();
    }

    /// A region of 2^shift voxels, aligned to its size, and what stands for it.
    struct Place {
        Int3 lo;
        int shift;
        Entry entry;
    };

    /// Fills the table with these disjoint places, in any order: items, tiles as addBox makes them,
    /// nodes as addNode does. Time and memory go with their number.
    SparseTable assemble(std::vector<Place> places) {
        std::vector<size_t> first(table_.root_.size() + 1);
        for (const Place& place : places) {
            ++first[table_.rootIndex(place.lo) + 1];
        }
        for (size_t i = 1; i < first.size(); ++i) {
            first[i] += first[i - 1];
        }
        std::vector<Place> sorted(places.size());
        std::vector<size_t> next = first;
        for (const Place& place : places) {
            sorted[next[table_.rootIndex(place.lo)]++] = place;
        }
        for (size_t i = 0; i < table_.root_.size(); ++i) {
            table_.root_[i] = assemble(sorted.data() + first[i], first[i + 1] - first[i],
                                       places.data() + first[i], table_.rootShift_);
        }
        return finish();
    }

    /// Adds a box of voxels, of whole items, to `places`: as the largest regions that the
    /// table has entries for.
    void addBox(const IntBox& box, Entry entry, std::vector<Place>& places) const {
        table_.forEachRootRegion(box, [&](size_t, const Int3& origin) {
            addPart(box, origin, table_.rootShift_, entry, places);
        });
    }

    /// The entry of a node with these children: the children's own where they are all one tile or
    /// item, that of an equal node where there is one, else a new node's. For use while the table
    /// is filled.
    Entry addNode(const Node& node) {
        const bool same =
            std::all_of(node.begin(), node.end(), [&](Entry e) { return e == node[0]; });
        if (same && (node[0] & (SparseTable::kNodeFlag | SparseTable::kSingleFlag)) == 0) {
            return node[0];
        }
        size_t occupied = 0;
        size_t last = 0;
        for (size_t c = 0; c < node.size() && occupied < 2; ++c) {
            if (node[c] != SparseTable::kEmpty) {
                ++occupied;
                last = c;
            }
        }
        if (occupied == 1) {
            return addLink(last, node[last]);
        }
        return addKnown(hashWords(node.data(), node.size() / 2, 0), table_.nodes_, node,
                        SparseTable::kNodeFlag);
    }

    /// A table with every item and tile entry replaced by `map(entry)`, nodes that became uniform
    /// collapsed, and the nodes of one region next to each other in memory.
    template <class Map>
    static SparseTable mapped(const SparseTable& table, Map&& map) {
        TableBuilder builder;
        builder.table_.itemShift_ = table.itemShift_;
        builder.table_.rootShift_ = table.rootShift_;
        builder.table_.rootLo_ = table.rootLo_;
        builder.table_.rootSize_ = table.rootSize_;
        std::unordered_map<Entry, Entry> done;
        for (const Entry entry : table.root_) {
            builder.table_.root_.push_back(builder.mapEntry(table, entry, map, done));
        }
        return builder.finish();
    }

  private:
    using Parts = SparseTable::Parts;
    using Link = SparseTable::Link;

    TableBuilder() = default;

    struct KeyHash {
        size_t operator()(const Key& key) const {
            return hashWords(key.data(), key.size() / 2, key.size() % 2 ? key.back() : 0);
        }
    };
    using Memo = std::unordered_map<Key, Entry, KeyHash>;

    /// The entry of an equal one, or of a new one.
    template <class Item>
    Entry addKnown(uint64_t hash, std::vector<Item>& items, const Item& item, Entry flags) {
        const auto [begin, end] = known_.equal_range(hash);
        for (auto it = begin; it != end; ++it) {
            if ((it->second & ~SparseTable::kIndexMask) == flags &&
                items[it->second & SparseTable::kIndexMask] == item) {
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
        return addKnown(hashWords(&word, 1, 1), table_.links_, link,
                        SparseTable::kNodeFlag | SparseTable::kLinkFlag);
    }

    SparseTable finish() {
        table_.nodes_.shrink_to_fit();
        table_.links_.shrink_to_fit();
        return std::move(table_);
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
        Entry entry = SparseTable::kEmpty;
        if (shift == table_.itemShift_) {
            entry = item(origin);
        } else {
            Parts parts;
            for (const SparseTable* source : sources) {
                source->markOccupied(origin, shift, parts);
            }
            Node node;
            for (size_t c = 0; c < node.size(); ++c) {
                node[c] = sources.empty() || parts[c]
                              ? build(sources, SparseTable::childOrigin(origin, shift - 3, c),
                                      shift - 3, uniform, item, keyOf, memo)
                              : SparseTable::kEmpty;
            }
            entry = addNode(node);
        }
        if (known) {
            memo.emplace(std::move(key), entry);
        }
        return entry;
    }

    template <class EntryOf>
    Entry derive(const SparseTable& source, const Corners& corners, int shift, EntryOf& entryOf,
                 std::unordered_map<Key, Entry, KeyHash>& memo) {
        Entry all = SparseTable::kEmpty;
        bool sparse = true;
        for (const Entry e : corners) {
            all |= e;
            sparse = sparse && (e == SparseTable::kEmpty ||
                                ((e & SparseTable::kNodeFlag) && (e & SparseTable::kLinkFlag)));
        }
        if (all == SparseTable::kEmpty) {
            return SparseTable::kEmpty;
        }
        if ((all & SparseTable::kNodeFlag) == 0) {
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
            if (corners[c] == SparseTable::kEmpty) {
                continue;
            }
            const size_t first = (c & 4 ? 8 * 81 : 0) + (c & 2 ? 8 * 9 : 0) + (c & 1 ? 8 : 0);
            if (sparse) {
                const Link& link = source.links_[corners[c] & SparseTable::kIndexMask];
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
                            corners[c] & SparseTable::kNodeFlag
                                ? source.child(corners[c], x << 6 | y << 3 | z)
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

    /// The entry of a region of 2^shift voxels with these `count` places; `scratch` has room for as
    /// many. Both are left in another order.
    Entry assemble(Place* places, size_t count, Place* scratch, int shift) {
        if (count == 0) {
            return SparseTable::kEmpty;
        }
        const auto childOf = [](const Int3& lo, int childShift) {
            return SparseTable::childIndex(lo[0] >> childShift, lo[1] >> childShift,
                                           lo[2] >> childShift);
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
        SparseTable::forEachChild(box, origin, shift, [&](size_t, const Int3& lo) {
            addPart(box, lo, shift - 3, entry, places);
        });
    }

    template <class Map>
    Entry mapEntry(const SparseTable& table, Entry entry, Map& map,
                   std::unordered_map<Entry, Entry>& done) {
        if (entry == SparseTable::kEmpty) {
            return entry;
        }
        if ((entry & SparseTable::kNodeFlag) == 0) {
            return map(entry);
        }
        if (const auto it = done.find(entry); it != done.end()) {
            return it->second;
        }
        if (entry & SparseTable::kLinkFlag) {
            const Link& link = table.links_[entry & SparseTable::kIndexMask];
            const Entry mapped = mapEntry(table, link.entry, map, done);
            return done[entry] =
                       mapped == SparseTable::kEmpty ? mapped : addLink(link.child, mapped);
        }
        Node node = table.nodes_[entry & SparseTable::kIndexMask];
        for (Entry& e : node) {
            e = mapEntry(table, e, map, done);
        }
        return done[entry] = addNode(node);
    }

    SparseTable table_;
    std::unordered_multimap<uint64_t, Entry> known_;  // nodes and links by hash
};

}  // namespace trk
