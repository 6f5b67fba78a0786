// SPDX-License-Identifier: Apache-2.0
// The voxels of a density as a proof looks them up: from the file, without bricks.
#pragma once

#include "field/sparse_table.h"
#include "field/table_builder.h"
#include "io/density_types.h"
#include "io/vdb_tree.h"
#include "space/geometry.h"

#include <algorithm>
#include <array>
#include <cstddef>
#include <cstdint>
#include <map>
#include <numeric>
#include <utility>
#include <vector>

namespace vdbtools {

using trk::Int3;
using trk::IntBox;
using trk::SparseTable;

/// The voxels of a source, repaired, as they are looked up to be compared: all of its leaves at
/// once, or those of a page. In index space, but for its table, which is in local space.
template <class Value>
class Voxels {
  public:
    using Sample = trk::Sample<Value>;
    static constexpr int kLeafShift = 3;

    /// `maxMemory`: what all may take, in bytes; 0: no limit.
    Voxels(trk::VdbTree<Value>& source, const Int3& anchor, uint64_t maxMemory)
        : source_(source), anchor_(anchor), pageLeaves_(source.leafCount()) {
        // The lists of leaves, their boxes and the table take most of the rest.
        if (maxMemory > 0) {
            constexpr uint64_t kLeast = 64;
            pageLeaves_ = std::min<size_t>(
                pageLeaves_, std::max(maxMemory / 4 / (kLeafVoxels * sizeof(Sample)), kLeast));
        }
        const bool all = pageLeaves_ == source.leafCount();
        leaves_.resize(all ? source.leafCount() * kLeafVoxels : 0);
        slotOf_.resize(source.leafCount());
        std::iota(slotOf_.begin(), slotOf_.end(), 0u);
        std::vector<char> occupied(source.leafCount());
        source.forEachBatch([&](const trk::LeafBatch<Value>& batch) {
            for (size_t i = 0; i < batch.count; ++i) {
                occupied[batch.index(i)] =
                    std::any_of(batch.leaf(i), batch.leaf(i + 1),
                                [](const Value& v) { return trk::fieldValue(v) != Sample{}; });
            }
            if (all) {
                take(batch);
            }
        });
        IntBox box;
        const auto add = [&](const std::array<int32_t, 3>& origin, int shift) {
            const Int3 lo{{origin[0] - anchor[0], origin[1] - anchor[1], origin[2] - anchor[2]}};
            const int64_t edge = int64_t{1} << shift;
            blocks_.push_back({lo, {{lo[0] + edge, lo[1] + edge, lo[2] + edge}}});
            box.add(blocks_.back().lo, blocks_.back().hi);
        };
        // What is 0 everywhere may lie where there is no local space.
        std::vector<trk::TableBuilder::Place> places;
        for (size_t i = 0; i < source.leafCount(); ++i) {
            if (occupied[i]) {
                add(source.leafOrigins()[i], kLeafShift);
                places.push_back(
                    {blocks_.back().lo, kLeafShift, static_cast<SparseTable::Entry>(i + 1)});
            }
        }
        std::vector<std::pair<IntBox, SparseTable::Entry>> tiles;
        for (const trk::Tile<Value>& tile : source.tiles()) {
            const Sample value = trk::fieldValue(tile.value);
            if (value != Sample{}) {
                add(tile.origin, tile.shift);
                tiles.emplace_back(blocks_.back(), constantEntry(value));
            }
        }
        trk::TableBuilder table(kLeafShift, box);
        for (const auto& [tileBox, entry] : tiles) {
            table.addBox(tileBox, entry, places);
        }
        table_ = table.assemble(std::move(places));
    }

    /// Calls body(begin, end) for parts of [0, count), in order, until it answers false, while the
    /// leaves are at hand that `leavesOf(i, f)` calls f(leaf) for.
    template <class LeavesOf, class Body>
    void forEachPage(size_t count, const LeavesOf& leavesOf, const Body& body) {
        if (pageLeaves_ == slotOf_.size()) {
            body(size_t{0}, count);
            return;
        }
        std::vector<uint32_t> wanted;
        for (size_t begin = 0; begin < count;) {
            std::fill(slotOf_.begin(), slotOf_.end(), kNowhere);
            wanted.clear();
            size_t end = begin;
            while (end < count && wanted.size() < pageLeaves_) {
                leavesOf(end++, [&](size_t leaf) {
                    if (slotOf_[leaf] == kNowhere) {
                        slotOf_[leaf] = static_cast<uint32_t>(wanted.size());
                        wanted.push_back(static_cast<uint32_t>(leaf));
                    }
                });
            }
            leaves_.resize(std::max(leaves_.size(), wanted.size() * kLeafVoxels));
            std::sort(wanted.begin(), wanted.end());
            source_.forEachBatchOf(wanted,
                                   [&](const trk::LeafBatch<Value>& batch) { take(batch); });
            if (!body(begin, end)) {
                return;
            }
            begin = end;
        }
    }

    /// Calls f(leaf) for the leaves that have voxels in a closed box of `edge` cells.
    template <class F>
    void forEachLeaf(const Int3& origin, int64_t edge, const F& f) const {
        forEachBlock(origin, edge, [&](SparseTable::Entry entry) {
            if (!isConstant(entry)) {
                f(entry - 1);
            }
            return true;
        });
    }

    /// The value of a voxel, whose leaf is at hand.
    Sample at(const Int3& p) const {
        const Int3 local{{p[0] - anchor_[0], p[1] - anchor_[1], p[2] - anchor_[2]}};
        return value(table_.find(local[0], local[1], local[2]).entry, local);
    }
    /// Whether a region is of one value, by its leaves and tiles; a leaf counts as several.
    bool isUniform(const Int3& origin, int shift) const {
        const auto entry = table_.uniformEntry(
            {{origin[0] - anchor_[0], origin[1] - anchor_[1], origin[2] - anchor_[2]}}, shift);
        return entry && isConstant(*entry);
    }
    /// Leaves and tiles that are not all 0.
    std::vector<IntBox> blocks() const {
        std::vector<IntBox> index = blocks_;
        for (IntBox& block : index) {
            for (size_t a = 0; a < 3; ++a) {
                block.lo[a] += anchor_[a];
                block.hi[a] += anchor_[a];
            }
        }
        return index;
    }
    /// Appends what the voxels of a closed box of `edge` cells follow from; false where leaves have
    /// a part in it.
    bool appendKey(const Int3& origin, int64_t edge, SparseTable::Key& key) const {
        for (size_t a = 0; a < 3; ++a) {
            key.push_back(static_cast<SparseTable::Entry>((origin[a] - anchor_[a]) & 7));
        }
        return forEachBlock(origin, edge, [&](SparseTable::Entry entry) {
            key.push_back(entry);
            return isConstant(entry);
        });
    }

  private:
    static constexpr size_t kLeafVoxels = trk::LeafBatch<Value>::kLeafVoxels;
    static constexpr SparseTable::Entry kConstantFlag = 0x40000000u;
    static constexpr uint32_t kNowhere = 0xffffffffu;

    /// Calls f(entry) for the aligned blocks of 8^3 voxels that have a part in a closed box of
    /// `edge` cells, until it answers false; whether it never did.
    template <class F>
    bool forEachBlock(const Int3& origin, int64_t edge, const F& f) const {
        Int3 lo;
        for (size_t a = 0; a < 3; ++a) {
            lo[a] = origin[a] - anchor_[a];
        }
        Int3 p;
        for (p[0] = lo[0] & ~int64_t{7}; p[0] <= lo[0] + edge; p[0] += 8) {
            for (p[1] = lo[1] & ~int64_t{7}; p[1] <= lo[1] + edge; p[1] += 8) {
                for (p[2] = lo[2] & ~int64_t{7}; p[2] <= lo[2] + edge; p[2] += 8) {
                    if (!f(table_.find(p[0], p[1], p[2]).entry)) {
                        return false;
                    }
                }
            }
        }
        return true;
    }

    void take(const trk::LeafBatch<Value>& batch) {
        for (size_t i = 0; i < batch.count; ++i) {
            const size_t at = slotOf_[batch.index(i)] * kLeafVoxels;
            std::transform(batch.leaf(i), batch.leaf(i + 1),
                           leaves_.begin() + static_cast<std::ptrdiff_t>(at),
                           [](const Value& v) { return trk::fieldValue(v); });
        }
    }

    static bool isConstant(SparseTable::Entry entry) {
        return entry == SparseTable::kEmpty || (entry & kConstantFlag) != 0;
    }
    SparseTable::Entry constantEntry(const Sample& value) {
        const auto [it, isNew] = known_.try_emplace(
            value, static_cast<SparseTable::Entry>(constants_.size()) | kConstantFlag);
        if (isNew) {
            constants_.push_back(value);
        }
        return it->second;
    }
    Sample value(SparseTable::Entry entry, const Int3& local) const {
        if (entry == SparseTable::kEmpty) {
            return {};
        }
        return isConstant(entry)
                   ? constants_[entry & ~kConstantFlag]
                   : leaves_[slotOf_[entry - 1] * kLeafVoxels +
                             static_cast<size_t>((local[0] & 7) << 6 | (local[1] & 7) << 3 |
                                                 (local[2] & 7))];
    }

    trk::VdbTree<Value>& source_;
    Int3 anchor_;
    size_t pageLeaves_;  // as many leaves, or as one place has, are at hand
    SparseTable table_;
    std::vector<IntBox> blocks_;  // local
    std::vector<Sample> constants_;
    std::map<Sample, SparseTable::Entry> known_;
    std::vector<Sample> leaves_;
    std::vector<uint32_t> slotOf_;  // where a leaf's values are among them
};

}  // namespace vdbtools
