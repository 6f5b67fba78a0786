// SPDX-License-Identifier: Apache-2.0
// Which bricks a field has, and where each has its values from: of leaves and tiles, and of what a
// pass over the leaves kept of them.
#pragma once

#include "density_types.h"
#include "field/density_field.h"
#include "field/table_builder.h"
#include "hash.h"
#include "progress.h"
#include "region_source.h"

#include <algorithm>
#include <array>
#include <cstdint>
#include <map>
#include <optional>
#include <unordered_map>
#include <vector>

namespace trk {

/// A corner's region gives a brick its own 8 vertices an axis, an upper neighbour 1 (bit 2 of
/// `corner`: along x, bit 0: along z). Calls f(offset) for every row of rowLength<C>(corner) values
/// along z, offsets in a brick of C channels, until it answers false.
template <size_t C, class F>
bool forEachRow(size_t corner, const F& f) {
    for (size_t x = 0; x < (corner & 4 ? 1u : 8u); ++x) {
        for (size_t y = 0; y < (corner & 2 ? 1u : 8u); ++y) {
            if (!f((x * 81 + y * 9) * C)) {
                return false;
            }
        }
    }
    return true;
}
template <size_t C>
constexpr size_t rowLength(size_t corner) {
    return (corner & 1 ? 1 : 8) * C;
}

/// What is kept of every leaf: its first voxel, and of which parts all are like it.
template <class Value>
struct LeafTraits {
    using FieldValue = Sample<Value>;

    std::vector<FieldValue> first;
    std::vector<uint8_t> alike;  ///< bit c: what the leaf gives a brick whose corner c it is

    void resize(size_t count) {
        first.resize(count);
        alike.resize(count);
    }
    size_t bytes() const { return first.size() * kBytes; }
    static constexpr size_t kBytes = sizeof(FieldValue) + 1;

    bool isConstant(size_t leaf) const { return (alike[leaf] & 1) != 0; }
    bool gives(size_t leaf, size_t corner, const FieldValue& value) const {
        return (alike[leaf] >> corner & 1) != 0 && first[leaf] == value;
    }

    /// `values`: the leaf's 8^3, x slowest.
    void set(size_t leaf, const FieldValue* values) {
        first[leaf] = values[0];
        unsigned bits = 0;
        for (size_t corner = 0; corner < 8; ++corner) {
            bool same = true;
            for (size_t x = 0; x < (corner & 4 ? 1u : 8u) && same; ++x) {
                for (size_t y = 0; y < (corner & 2 ? 1u : 8u) && same; ++y) {
                    const FieldValue* row = values + 64 * x + 8 * y;
                    same = std::all_of(row, row + rowLength<1>(corner),
                                       [&](const FieldValue& v) { return v == values[0]; });
                }
            }
            bits |= static_cast<unsigned>(same) << corner;
        }
        alike[leaf] = static_cast<uint8_t>(bits);
    }
};

template <class Value>
class BrickPlan {
  public:
    using Entry = SparseTable::Entry;
    using Corners = TableBuilder::Corners;
    using FieldValue = Sample<Value>;

    /// A brick whose values partly come from leaves, or are all given by constants: by region, an
    /// entry of what it is, a constant or a leaf's index plus one. Its own entry, less one, is its
    /// slot: the leaf's index where its own region is one.
    struct Brick {
        Corners corners;
        Entry entry;
    };

    /// `box`: of the field's cells. Both in space relative to `anchor`, a multiple of every tile's
    /// size.
    BrickPlan(const RegionSource<Value>& source, const LeafTraits<Value>& leaves,
              const Int3& anchor, const IntBox& box)
        : leaves_(leaves) {
        for (size_t i = 0; i < leaves.alike.size(); ++i) {
            if (leaves.isConstant(i)) {
                unused_.push_back(i);
            }
        }
        const SparseTable regions = sourceTable(source, anchor, box);
        table_ = TableBuilder(DensityField::kBrickShift, box)
                     .fillFrom(regions, [&](const Corners& corners, int shift) {
                         return entryOf(corners, shift);
                     });
    }

    /// The field's.
    SparseTable& table() { return table_; }
    const std::vector<Brick>& bricks() const { return bricks_; }
    /// Beyond every slot: a slot a leaf, then one for every brick beside leaves.
    size_t slots() const { return leaves_.alike.size() + added_; }
    /// Slots of leaves that no brick has, in rising order.
    std::vector<size_t> holes() const {
        return {unused_.begin() + static_cast<std::ptrdiff_t>(nextUnused_), unused_.end()};
    }
    size_t bytes() const {
        return table_.bytes() + bricks_.capacity() * sizeof(Brick) +
               unused_.capacity() * sizeof(size_t);
    }

    static bool isLeaf(Entry entry) { return !DensityField::isConstant(entry); }
    /// Of an entry that is no leaf.
    const FieldValue& constantOf(Entry entry) const {
        static constexpr FieldValue kNothing{};
        return entry == SparseTable::kEmpty ? kNothing : constants_[entry & ~kConstantFlag];
    }
    std::vector<float> constants() const {
        std::vector<float> all;
        for (const FieldValue& value : constants_) {
            all.insert(all.end(), value.begin(), value.end());
        }
        return all;
    }

    /// Writes what of a brick is not its own leaf's. `brickAt(slot)`: where the brick of a slot has
    /// its values.
    template <class BrickAt>
    void complete(const Brick& brick, const BrickAt& brickAt) const {
        for (size_t corner = 0; corner < 8; ++corner) {
            if (corner != 0 || !isLeaf(brick.corners[0])) {
                copyCorner(brick.corners[corner], corner, brickAt, brickAt(brick.entry - 1));
            }
        }
    }

  private:
    static constexpr Entry kConstantFlag = DensityField::kConstantFlag;
    static constexpr size_t kChannels = ValueTraits<Value>::kChannels;
    using Origin = typename RegionSource<Value>::Origin;

    struct CornersHash {
        size_t operator()(const Corners& corners) const {
            return hashWords(corners.data(), corners.size() / 2, 0);
        }
    };

    Entry constantEntry(const FieldValue& value) {
        if (value == FieldValue{}) {
            return SparseTable::kEmpty;
        }
        const auto [it, isNew] = constantEntries_.try_emplace(
            value, static_cast<Entry>(constants_.size()) | kConstantFlag);
        if (isNew) {
            constants_.push_back(value);
        }
        return it->second;
    }

    /// The regions of the source: leaves, and constants where a leaf or tile has one value.
    SparseTable sourceTable(const RegionSource<Value>& source, const Int3& anchor,
                            const IntBox& box) {
        TableBuilder table(DensityField::kBrickShift, box);
        std::vector<TableBuilder::Place> places;
        places.reserve(source.leafCount());
        const auto local = [&](const Origin& o) {
            return Int3{{o[0] - anchor[0], o[1] - anchor[1], o[2] - anchor[2]}};
        };
        for (size_t i = 0; i < source.leafCount(); ++i) {
            const Entry entry =
                leaves_.isConstant(i) ? constantEntry(leaves_.first[i]) : static_cast<Entry>(i + 1);
            if (entry != SparseTable::kEmpty) {
                places.push_back(
                    {local(source.leafOrigins()[i]), DensityField::kBrickShift, entry});
            }
        }
        for (const Tile<Value>& tile : source.tiles()) {
            const Entry entry = constantEntry(fieldValue(tile.value));
            if (entry != SparseTable::kEmpty) {
                const Int3 lo = local(tile.origin);
                const int64_t size = int64_t{1} << tile.shift;
                table.addBox({lo, {{lo[0] + size, lo[1] + size, lo[2] + size}}}, entry, places);
            }
        }
        return table.assemble(std::move(places));
    }

    template <class BrickAt, class Stored>
    void copyCorner(Entry from, size_t corner, const BrickAt& brickAt, Stored* brick) const {
        const size_t first =
            (corner & 4 ? 8 * 81 : 0) + (corner & 2 ? 8 * 9 : 0) + (corner & 1 ? 8 : 0);
        Stored* to = brick + first * kChannels;
        const size_t length = rowLength<kChannels>(corner);
        if (isLeaf(from)) {
            const Stored* leaf = brickAt(from - 1);
            forEachRow<kChannels>(corner, [&](size_t row) {
                std::copy_n(leaf + row, length, to + row);
                return true;
            });
            return;
        }
        std::array<Stored, 8 * kChannels> constant{};
        for (size_t k = 0; k < constant.size(); ++k) {
            storeExactly(constantOf(from)[k % kChannels], constant[k]);
        }
        forEachRow<kChannels>(corner, [&](size_t row) {
            std::copy_n(constant.data(), length, to + row);
            return true;
        });
    }

    /// Entry of a region of the field of which the source's entries, at its corners, are no nodes;
    /// nothing where its parts must be asked.
    std::optional<Entry> entryOf(const Corners& corners, int shift) {
        const bool same =
            std::all_of(corners.begin(), corners.end(), [&](Entry e) { return e == corners[0]; });
        if (same && !isLeaf(corners[0])) {
            return corners[0];
        }
        if (shift > DensityField::kBrickShift) {
            return std::nullopt;
        }
        const bool fromLeaves = std::any_of(corners.begin(), corners.end(), isLeaf);
        if (!fromLeaves) {  // alike all over the surface of a tile: built once
            const auto [it, isNew] = shared_.try_emplace(corners, SparseTable::kEmpty);
            if (isNew) {
                it->second = newSlot();
                bricks_.push_back({corners, it->second});
            }
            return it->second;
        }
        if (!isLeaf(corners[0])) {
            const FieldValue& own = constantOf(corners[0]);
            bool constant = true;
            for (size_t c = 1; c < 8 && constant; ++c) {
                constant = isLeaf(corners[c]) ? leaves_.gives(corners[c] - 1, c, own)
                                              : corners[c] == corners[0];
            }
            if (constant) {
                return corners[0];
            }
        }
        const Entry entry = isLeaf(corners[0]) ? corners[0] : newSlot();
        bricks_.push_back({corners, entry});
        if (bricks_.size() % 4096 == 0) {
            Progress::poll();
        }
        return entry;
    }

    Entry newSlot() {
        if (nextUnused_ < unused_.size()) {
            return static_cast<Entry>(unused_[nextUnused_++] + 1);
        }
        return static_cast<Entry>(leaves_.alike.size() + ++added_);
    }

    const LeafTraits<Value>& leaves_;
    SparseTable table_;
    std::vector<FieldValue> constants_;
    std::map<FieldValue, Entry> constantEntries_;
    std::vector<Brick> bricks_;
    std::unordered_map<Corners, Entry, CornersHash> shared_;
    std::vector<size_t> unused_;  // slots of leaves of one value
    size_t nextUnused_ = 0;
    size_t added_ = 0;
};

}  // namespace trk
