// SPDX-License-Identifier: Apache-2.0
// From a source of regions to bricks. One pass over the leaves checks them, sums their digest and
// puts their values into bricks; then the bricks learn their neighbours' edge. Work and memory go
// with leaves and tiles, not with boxes; beside the field itself only lists are held.
#pragma once

#include "../extinction_field.h"
#include "../failure.h"
#include "../hash.h"
#include "../parallel.h"
#include "../progress.h"
#include "density_types.h"
#include "region_scan.h"
#include "region_source.h"

#include <tbb/spin_mutex.h>

#include <algorithm>
#include <array>
#include <map>
#include <string>
#include <unordered_map>
#include <vector>

namespace trk {

/// Builds a field once: scan(), whose findings the caller judges, then build().
template <class Value>
class FieldBuilder {
  public:
    /// `maxMemory`: bytes that the bricks may take; 0: no limit.
    FieldBuilder(RegionSource<Value>& source, uint64_t maxMemory, std::string where)
        : source_(source), maxMemory_(maxMemory), where_(std::move(where)) {}

    /// The pass over the leaves. Throws OUT_OF_MEMORY, and what the source throws.
    const RegionScan& scan();

    /// The field, in space relative to `anchor`, a multiple of every tile's size; values that are
    /// negative or not finite count as 0.
    ExtinctionField build(const Int3& anchor);

  private:
    using Entry = SparseTable::Entry;
    using Origin = typename RegionSource<Value>::Origin;
    static constexpr size_t kBrickVertices = ExtinctionField::kBrickVertices;
    static constexpr size_t kLeafVoxels = LeafBatch<Value>::kLeafVoxels;
    static constexpr size_t kChannels = ValueTraits<Value>::kChannels;
    static constexpr size_t kBrickValues = kBrickVertices * kChannels;
    /// On an entry of the table of the source's regions: a constant. Else a leaf's index, plus one.
    static constexpr Entry kConstantFlag = ExtinctionField::kConstantFlag;
    using FieldValue = Sample<Value>;
    using Corners = SparseTable::Corners;

    struct CornersHash {
        size_t operator()(const Corners& corners) const {
            return hashWords(corners.data(), corners.size() / 2, 0);
        }
    };

    /// A brick whose values partly come from leaves, or are all given by constants.
    struct Brick {
        Corners corners;
        Entry entry;
    };

    /// What goes on while storage is of one type.
    template <class Stored>
    class Bricks;

    template <class Stored>
    bool tryScan(RawArray<Stored>& values);
    /// Beside the lists of the source.
    void checkMemory(uint64_t wanted) const;

    Entry constantEntry(const FieldValue& value);
    const FieldValue& constantOf(Entry entry) const {
        static constexpr FieldValue kNothing{};
        return entry == SparseTable::kEmpty ? kNothing : constants_[entry & ~kConstantFlag];
    }
    SparseTable sourceTable(const Int3& anchor, const IntBox& box);
    template <class Stored>
    ExtinctionField finish(RawArray<Stored>& values, const Int3& anchor);

    RegionSource<Value>& source_;
    uint64_t maxMemory_;
    std::string where_;
    RegionScan scan_;
    std::vector<FieldValue> constants_;
    std::map<FieldValue, Entry> constantEntries_;
    /// Of leaves of one value, that; of others, its first component is -1.
    std::vector<FieldValue> leafConstants_;
    RawArray<float> floats_;
    RawArray<uint16_t> halfs_;
    bool asHalfs_ = false;
};

namespace field_builder_internal {

inline bool isStorable(float, const float*) {
    return true;
}
inline bool isStorable(float value, const uint16_t*) {
    return isExactHalf(value);
}
inline void store(float value, float& to) {
    to = value;
}
inline void store(float value, uint16_t& to) {
    to = encodeHalf(value);
}

}  // namespace field_builder_internal

template <class Value>
void FieldBuilder<Value>::checkMemory(uint64_t wanted) const {
    const uint64_t all = wanted + source_.listBytes();
    if (maxMemory_ > 0 && all > maxMemory_) {
        throw Error(TRK_ERROR_OUT_OF_MEMORY,
                    where_ + ": needs " + std::to_string(all) +
                        " bytes for its bricks and tables, more than maxMemory = " +
                        std::to_string(maxMemory_));
    }
}

/// Scans with bricks of one type of storage; false where that cannot hold every value exactly.
template <class Value>
template <class Stored>
bool FieldBuilder<Value>::tryScan(RawArray<Stored>& values) {
    const size_t leafCount = source_.leafCount();
    checkMemory(leafCount * (kBrickValues * sizeof(Stored) + sizeof(FieldValue)));
    values.resize(leafCount * kBrickValues);
    leafConstants_.resize(leafCount);
    scan_ = {};
    struct Inexact {};
    tbb::spin_mutex lock;
    const auto body = [&](const LeafBatch<Value>& batch) {
        RegionScan part;
        std::array<FieldValue, kLeafVoxels> floats;
        for (size_t i = 0; i < batch.count; ++i) {
            const size_t leaf = batch.first + i;
            scanLeaf(batch.leaf(i), batch.mask(i), source_.leafOrigins()[leaf], part,
                     floats.data());
            const float* from = floats[0].data();
            bool storable = true;
            if (sizeof(Stored) < sizeof(float)) {
                for (size_t k = 0; k < kLeafVoxels * kChannels && storable; ++k) {
                    storable = field_builder_internal::isStorable(from[k], values.data());
                }
            }
            if (!storable) {
                throw Inexact{};
            }
            const bool same = std::all_of(floats.begin(), floats.end(),
                                          [&](const FieldValue& v) { return v == floats[0]; });
            leafConstants_[leaf] = floats[0];
            if (same) {
                continue;
            }
            leafConstants_[leaf][0] = -1;
            Stored* brick = &values[leaf * kBrickValues];
            for (size_t row = 0; row < 64; ++row) {
                Stored* to = brick + ((row >> 3) * 81 + (row & 7) * 9) * kChannels;
                for (size_t k = 0; k < 8 * kChannels; ++k) {
                    field_builder_internal::store(from[row * 8 * kChannels + k], to[k]);
                }
            }
        }
        const tbb::spin_mutex::scoped_lock guard(lock);
        scan_.join(part);
    };
    try {
        source_.forEachBatch(body);
    } catch (const Inexact&) {
        return false;
    }
    bool exact = true;
    for (const Tile<Value>& tile : source_.tiles()) {
        scanTile(tile, scan_);
        for (const float v : fieldValue(tile.value)) {
            exact = exact && field_builder_internal::isStorable(v, values.data());
        }
    }
    return exact;
}

template <class Value>
const RegionScan& FieldBuilder<Value>::scan() {
    if (source_.leafCount() >= kConstantFlag / 8) {
        throw Error(TRK_ERROR_OUT_OF_MEMORY, where_ + ": has more than 2^27 leaves of 8^3 voxels");
    }
    // Most volumes of floats are found to be no halfs by their first leaf.
    asHalfs_ = tryScan(halfs_);
    if (!asHalfs_) {
        halfs_.resize(0);
        tryScan(floats_);
    }
    return scan_;
}

template <class Value>
SparseTable::Entry FieldBuilder<Value>::constantEntry(const FieldValue& value) {
    if (value == FieldValue{}) {
        return SparseTable::kEmpty;
    }
    const auto [it, isNew] =
        constantEntries_.try_emplace(value, static_cast<Entry>(constants_.size()) | kConstantFlag);
    if (isNew) {
        constants_.push_back(value);
    }
    return it->second;
}

/// The regions of the source: leaves, and constants where a leaf or tile has one value.
template <class Value>
SparseTable FieldBuilder<Value>::sourceTable(const Int3& anchor, const IntBox& box) {
    SparseTable table(ExtinctionField::kBrickShift, box);
    std::vector<SparseTable::Place> places;
    places.reserve(source_.leafCount());
    const auto local = [&](const Origin& o) {
        return Int3{{o[0] - anchor[0], o[1] - anchor[1], o[2] - anchor[2]}};
    };
    for (size_t i = 0; i < source_.leafCount(); ++i) {
        const bool same = leafConstants_[i][0] >= 0;
        const Entry entry = same ? constantEntry(leafConstants_[i]) : static_cast<Entry>(i + 1);
        if (entry != SparseTable::kEmpty) {
            places.push_back(
                {local(source_.leafOrigins()[i]), ExtinctionField::kBrickShift, entry});
        }
    }
    for (const Tile<Value>& tile : source_.tiles()) {
        const Entry entry = constantEntry(fieldValue(tile.value));
        if (entry != SparseTable::kEmpty) {
            const Int3 lo = local(tile.origin);
            const int64_t size = int64_t{1} << tile.shift;
            table.addBox({lo, {{lo[0] + size, lo[1] + size, lo[2] + size}}}, entry, places);
        }
    }
    table.assemble(std::move(places));
    return table;
}

/// Makes the field's table of the source's, and bricks of what its entries say.
template <class Value>
template <class Stored>
class FieldBuilder<Value>::Bricks {
  public:
    Bricks(FieldBuilder& builder, RawArray<Stored>& values) : builder_(builder), values_(values) {
        for (size_t i = 0; i < builder.leafConstants_.size(); ++i) {
            if (builder.leafConstants_[i][0] >= 0) {
                unused_.push_back(i);
            }
        }
    }

    /// The field's table; `values` grows by the bricks beside leaves.
    SparseTable fill(const SparseTable& source, const IntBox& box) {
        SparseTable table(ExtinctionField::kBrickShift, box);
        table.fillFrom(source,
                       [&](const Corners& corners, int shift) { return entryOf(corners, shift); });
        return table;
    }

    const std::vector<Brick>& bricks() const { return bricks_; }
    size_t slots() const { return builder_.leafConstants_.size() + added_; }
    /// Slots of leaves that were left empty, in rising order, once everything is filled.
    std::vector<size_t> holes() const {
        return {unused_.begin() + static_cast<std::ptrdiff_t>(nextUnused_), unused_.end()};
    }

    /// Writes what of a brick is not its own leaf's.
    void complete(const Brick& brick) {
        Stored* to = &values_[(brick.entry - 1) * kBrickValues];
        for (size_t corner = 0; corner < 8; ++corner) {
            if (corner == 0 && isLeaf(brick.corners[0])) {
                continue;
            }
            copyCorner(brick.corners[corner], corner, to);
        }
    }

  private:
    static bool isLeaf(Entry entry) {
        return entry != SparseTable::kEmpty && (entry & kConstantFlag) == 0;
    }

    /// A corner's region gives a brick its own 8 vertices an axis, an upper neighbour 1. Calls
    /// f(offset) for every row of `rowLength(corner)` values along z, until it answers false.
    template <class F>
    static bool forEachRow(size_t corner, const F& f) {
        for (size_t x = 0; x < (corner & 4 ? 1u : 8u); ++x) {
            for (size_t y = 0; y < (corner & 2 ? 1u : 8u); ++y) {
                if (!f((x * 81 + y * 9) * kChannels)) {
                    return false;
                }
            }
        }
        return true;
    }
    static size_t rowLength(size_t corner) { return (corner & 1 ? 1 : 8) * kChannels; }

    /// A constant as stored, as often as the longest row has room for.
    std::array<Stored, 8 * kChannels> constantRow(const FieldValue& value) const {
        std::array<Stored, 8 * kChannels> row{};
        for (size_t k = 0; k < row.size(); ++k) {
            field_builder_internal::store(value[k % kChannels], row[k]);
        }
        return row;
    }

    void copyCorner(Entry from, size_t corner, Stored* brick) const {
        const size_t first =
            (corner & 4 ? 8 * 81 : 0) + (corner & 2 ? 8 * 9 : 0) + (corner & 1 ? 8 : 0);
        Stored* to = brick + first * kChannels;
        if (isLeaf(from)) {
            const Stored* leaf = &values_[(from - 1) * kBrickValues];
            forEachRow(corner, [&](size_t row) {
                std::copy_n(leaf + row, rowLength(corner), to + row);
                return true;
            });
        } else {
            const auto constant = constantRow(builder_.constantOf(from));
            forEachRow(corner, [&](size_t row) {
                std::copy_n(constant.data(), rowLength(corner), to + row);
                return true;
            });
        }
    }

    /// Whether all that a leaf gives to a brick, as its upper neighbour, is one value.
    bool gives(Entry leaf, size_t corner, const FieldValue& value) const {
        const Stored* from = &values_[(leaf - 1) * kBrickValues];
        const auto constant = constantRow(value);
        return forEachRow(corner, [&](size_t row) {
            return std::equal(from + row, from + row + rowLength(corner), constant.data());
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
        if (shift > ExtinctionField::kBrickShift) {
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
            const FieldValue& own = builder_.constantOf(corners[0]);
            bool constant = true;
            for (size_t c = 1; c < 8 && constant; ++c) {
                constant =
                    isLeaf(corners[c]) ? gives(corners[c], c, own) : corners[c] == corners[0];
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
        return static_cast<Entry>(builder_.leafConstants_.size() + ++added_);
    }

    FieldBuilder& builder_;
    RawArray<Stored>& values_;
    std::vector<Brick> bricks_;
    std::unordered_map<Corners, Entry, CornersHash> shared_;
    std::vector<size_t> unused_;  // slots of leaves of one value
    size_t nextUnused_ = 0;
    size_t added_ = 0;
};

template <class Value>
template <class Stored>
ExtinctionField FieldBuilder<Value>::finish(RawArray<Stored>& values, const Int3& anchor) {
    IntBox box = scan_.box;
    for (size_t a = 0; a < 3; ++a) {
        box.lo[a] -= anchor[a];
        box.hi[a] -= anchor[a];
    }
    Bricks<Stored> bricks(*this, values);
    SparseTable table;
    {
        const SparseTable source = sourceTable(anchor, box);
        table = bricks.fill(source, box);
    }
    checkMemory(bricks.slots() * kBrickValues * sizeof(Stored) +
                leafConstants_.size() * sizeof(FieldValue) + table.bytes());
    values.resize(bricks.slots() * kBrickValues);
    const std::vector<Brick>& list = bricks.bricks();
    parallelFor(list.size(), 64, [&](size_t i) { bricks.complete(list[i]); });
    // Close what leaves of one value have left.
    const std::vector<size_t> holes = bricks.holes();
    if (!holes.empty()) {
        std::vector<Entry> moved(bricks.slots() + 1);
        size_t next = 0;
        size_t hole = 0;
        for (size_t slot = 0; slot < bricks.slots(); ++slot) {
            if (hole < holes.size() && holes[hole] == slot) {
                ++hole;
                continue;
            }
            if (next != slot) {
                std::memmove(&values[next * kBrickValues], &values[slot * kBrickValues],
                             kBrickValues * sizeof(Stored));
            }
            moved[slot + 1] = static_cast<Entry>(++next);
        }
        values.resize(next * kBrickValues);
        table =
            table.mapped([&](Entry entry) { return entry & kConstantFlag ? entry : moved[entry]; });
    }
    std::vector<float> constants;
    for (const FieldValue& value : constants_) {
        constants.insert(constants.end(), value.begin(), value.end());
    }
    return {kChannels, std::move(table), std::move(constants), std::move(floats_),
            std::move(halfs_)};
}

template <class Value>
ExtinctionField FieldBuilder<Value>::build(const Int3& anchor) {
    return asHalfs_ ? finish(halfs_, anchor) : finish(floats_, anchor);
}

}  // namespace trk
