// SPDX-License-Identifier: Apache-2.0
// From a source of regions to bricks. One pass over the leaves checks them, sums their digest and
// puts their values into bricks; then the bricks learn their neighbours' edge. Work and memory go
// with leaves and tiles, not with boxes; beside the field itself only lists are held.
#pragma once

#include "brick_plan.h"
#include "density_types.h"
#include "failure.h"
#include "field/density_field.h"
#include "field/table_builder.h"
#include "parallel.h"
#include "region_scan.h"
#include "region_source.h"

#include <tbb/spin_mutex.h>

#include <array>
#include <cstring>
#include <string>
#include <utility>
#include <vector>

namespace trk {

/// Puts the values of a leaf into a brick of its own; false where its storage cannot hold them
/// exactly.
template <class Value, class Stored>
bool storeLeaf(const std::array<Sample<Value>, LeafBatch<Value>::kLeafVoxels>& values,
               Stored* brick) {
    constexpr size_t kChannels = ValueTraits<Value>::kChannels;
    const float* from = values[0].data();
    if (sizeof(Stored) < sizeof(float)) {
        for (size_t k = 0; k < values.size() * kChannels; ++k) {
            if (!isStorable(from[k], brick)) {
                return false;
            }
        }
    }
    for (size_t row = 0; row < 64; ++row) {
        Stored* to = brick + ((row >> 3) * 81 + (row & 7) * 9) * kChannels;
        for (size_t k = 0; k < 8 * kChannels; ++k) {
            storeExactly(from[row * 8 * kChannels + k], to[k]);
        }
    }
    return true;
}

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
    DensityField build(const Int3& anchor);

  private:
    using Entry = SparseTable::Entry;
    static constexpr size_t kChannels = ValueTraits<Value>::kChannels;
    static constexpr size_t kBrickValues = DensityField::kBrickVertices * kChannels;
    using FieldValue = Sample<Value>;

    template <class Stored>
    bool tryScan(RawArray<Stored>& values);
    /// Beside the lists of the source.
    void checkMemory(uint64_t wanted) const;
    template <class Stored>
    DensityField finish(RawArray<Stored>& values, const Int3& anchor);

    RegionSource<Value>& source_;
    uint64_t maxMemory_;
    std::string where_;
    RegionScan scan_;
    LeafTraits<Value> leaves_;
    RawArray<float> floats_;
    RawArray<uint16_t> halfs_;
    bool asHalfs_ = false;
};

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
    checkMemory(leafCount * (kBrickValues * sizeof(Stored) + LeafTraits<Value>::kBytes));
    values.resize(leafCount * kBrickValues);
    leaves_.resize(leafCount);
    scan_ = {};
    struct Inexact {};
    tbb::spin_mutex lock;
    const auto body = [&](const LeafBatch<Value>& batch) {
        RegionScan part;
        std::array<FieldValue, LeafBatch<Value>::kLeafVoxels> floats;
        for (size_t i = 0; i < batch.count; ++i) {
            const size_t leaf = batch.index(i);
            scanLeaf(batch.leaf(i), batch.mask(i), source_.leafOrigins()[leaf], part,
                     floats.data());
            leaves_.set(leaf, floats.data());
            const bool stored =
                leaves_.isConstant(leaf)
                    ? std::all_of(floats[0].begin(), floats[0].end(),
                                  [&](float v) { return isStorable(v, values.data()); })
                    : storeLeaf<Value>(floats, &values[leaf * kBrickValues]);
            if (!stored) {
                throw Inexact{};
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
            exact = exact && isStorable(v, values.data());
        }
    }
    return exact;
}

template <class Value>
const RegionScan& FieldBuilder<Value>::scan() {
    checkLeafCount(source_, where_);
    // Most volumes of floats are found to be no halfs by their first leaf.
    asHalfs_ = tryScan(halfs_);
    if (!asHalfs_) {
        halfs_.resize(0);
        tryScan(floats_);
    }
    return scan_;
}

template <class Value>
template <class Stored>
DensityField FieldBuilder<Value>::finish(RawArray<Stored>& values, const Int3& anchor) {
    BrickPlan<Value> plan(source_, leaves_, anchor, scan_.localBox(anchor));
    checkMemory(plan.slots() * kBrickValues * sizeof(Stored) + leaves_.bytes() +
                plan.table().bytes());
    values.resize(plan.slots() * kBrickValues);
    const auto& bricks = plan.bricks();
    parallelFor(bricks.size(), 64, [&](size_t i) {
        plan.complete(bricks[i], [&](size_t slot) { return &values[slot * kBrickValues]; });
    });
    // Close what leaves of one value have left.
    SparseTable table = std::move(plan.table());
    const std::vector<size_t> holes = plan.holes();
    if (!holes.empty()) {
        std::vector<Entry> moved(plan.slots() + 1);
        size_t next = 0;
        size_t hole = 0;
        for (size_t slot = 0; slot < plan.slots(); ++slot) {
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
        table = TableBuilder::mapped(table, [&](Entry entry) {
            return DensityField::isConstant(entry) ? entry : moved[entry];
        });
    }
    return {kChannels, std::move(table), plan.constants(), std::move(floats_), std::move(halfs_)};
}

template <class Value>
DensityField FieldBuilder<Value>::build(const Int3& anchor) {
    return asHalfs_ ? finish(halfs_, anchor) : finish(floats_, anchor);
}

}  // namespace trk
