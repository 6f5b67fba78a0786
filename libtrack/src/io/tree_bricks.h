// SPDX-License-Identifier: Apache-2.0
// The bricks of a grid in a file that are too many for memory: which there are, found in one pass
// over its leaves, and reading some of them again.
#pragma once

#include "brick_plan.h"
#include "field/brick_pages.h"
#include "field_builder.h"
#include "vdb_file.h"
#include "vdb_tree.h"

#include <tbb/spin_mutex.h>

#include <algorithm>
#include <array>
#include <memory>
#include <string>
#include <utility>
#include <vector>

namespace trk {

/// Looks at every leaf and tile of a source, and keeps nothing of their values but `leaves`, if it
/// is given.
template <class Value>
RegionScan scanRegions(RegionSource<Value>& source, LeafTraits<Value>* leaves) {
    RegionScan scan;
    tbb::spin_mutex lock;
    source.forEachBatch([&](const LeafBatch<Value>& batch) {
        RegionScan part;
        std::array<Sample<Value>, LeafBatch<Value>::kLeafVoxels> floats;
        for (size_t i = 0; i < batch.count; ++i) {
            const size_t leaf = batch.index(i);
            scanLeaf(batch.leaf(i), batch.mask(i), source.leafOrigins()[leaf], part, floats.data());
            if (leaves) {
                leaves->set(leaf, floats.data());
            }
        }
        const tbb::spin_mutex::scoped_lock guard(lock);
        scan.join(part);
    });
    for (const Tile<Value>& tile : source.tiles()) {
        scanTile(tile, scan);
    }
    return scan;
}

template <class Value>
class TreeBricks : public BrickLoader {
  public:
    /// Owns the file that the tree is read from. `leaves`: as scanRegions leaves them.
    TreeBricks(std::unique_ptr<VdbFile> file, std::unique_ptr<VdbTree<Value>> tree,
               LeafTraits<Value> leaves, const RegionScan& scan, const Int3& anchor)
        : file_(std::move(file)),
          tree_(std::move(tree)),
          leaves_(std::move(leaves)),
          plan_(*tree_, leaves_, anchor, scan.localBox(anchor)),
          brickOf_(plan_.slots()),
          pageSlot_(plan_.slots(), kNone) {
        for (size_t i = 0; i < plan_.bricks().size(); ++i) {
            brickOf_[plan_.bricks()[i].entry - 1] = static_cast<uint32_t>(i);
        }
    }

    /// The field without its bricks. To be called once.
    DensityField field() {
        return {kChannels, std::move(plan_.table()), plan_.constants(), {}, {}};
    }

    size_t bytes() const override { return bytesOf(*tree_, leaves_, plan_); }
    static uint64_t bytesOf(const VdbTree<Value>& tree, const LeafTraits<Value>& leaves,
                            const BrickPlan<Value>& plan) {
        return tree.listBytes() + leaves.bytes() + plan.bytes() +
               2 * plan.slots() * sizeof(uint32_t);
    }
    std::vector<Entry> bricks() const override {
        std::vector<Entry> all;
        for (const auto& brick : plan_.bricks()) {
            all.push_back(brick.entry);
        }
        std::sort(all.begin(), all.end());
        return all;
    }

    void begin() override {
        for (const uint32_t slot : wanted_) {
            pageSlot_[slot] = kNone;
        }
        wanted_.clear();
        wantedLeaves_.clear();
        wantedBricks_.clear();
    }
    void want(Entry entry) override {
        if (pageSlot_[entry - 1] != kNone && (pageSlot_[entry - 1] & kWhole) != 0) {
            return;
        }
        const auto& brick = plan_.bricks()[brickOf_[entry - 1]];
        for (const Entry corner : brick.corners) {
            if (BrickPlan<Value>::isLeaf(corner) && take(corner)) {
                wantedLeaves_.push_back(corner - 1);
            }
        }
        take(entry);
        pageSlot_[entry - 1] |= kWhole;
        wantedBricks_.push_back(entry);
    }
    size_t slots() const override { return wanted_.size(); }
    size_t slotOf(Entry entry) const override { return pageSlot_[entry - 1] & ~kWhole; }

    void load(RawArray<float>& page) override {
        if (page.size() < slots() * kBrickValues) {
            page.resize(0);  // rather than copy it
            page.resize(slots() * kBrickValues);
        }
        const auto brickAt = [&](size_t slot) {
            return page.data() + slotOf(static_cast<Entry>(slot + 1)) * kBrickValues;
        };
        std::sort(wantedLeaves_.begin(), wantedLeaves_.end());
        tree_->forEachBatchOf(wantedLeaves_, [&](const LeafBatch<Value>& batch) {
            std::array<Sample<Value>, LeafBatch<Value>::kLeafVoxels> floats;
            for (size_t i = 0; i < batch.count; ++i) {
                std::transform(batch.leaf(i), batch.leaf(i + 1), floats.begin(),
                               [](const Value& v) { return fieldValue(v); });
                storeLeaf<Value>(floats, brickAt(batch.index(i)));
            }
        });
        parallelFor(wantedBricks_.size(), 64, [&](size_t i) {
            plan_.complete(plan_.bricks()[brickOf_[wantedBricks_[i] - 1]], brickAt);
        });
    }

  private:
    static constexpr size_t kChannels = ValueTraits<Value>::kChannels;
    static constexpr size_t kBrickValues = DensityField::kBrickVertices * kChannels;
    static constexpr uint32_t kNone = 0xffffffffu;
    static constexpr uint32_t kWhole = 0x80000000u;  // a brick, not a leaf alone

    /// Gives it a slot of the page; false if it has one.
    bool take(Entry entry) {
        if (pageSlot_[entry - 1] != kNone) {
            return false;
        }
        pageSlot_[entry - 1] = static_cast<uint32_t>(wanted_.size());
        wanted_.push_back(entry - 1);
        return true;
    }

    std::unique_ptr<VdbFile> file_;
    std::unique_ptr<VdbTree<Value>> tree_;
    LeafTraits<Value> leaves_;
    BrickPlan<Value> plan_;
    std::vector<uint32_t> brickOf_;   // of a slot of the plan, which of its bricks
    std::vector<uint32_t> pageSlot_;  // and where the page has it
    std::vector<uint32_t> wanted_;    // slots of the plan that the page has
    std::vector<uint32_t> wantedLeaves_;
    std::vector<Entry> wantedBricks_;
};

}  // namespace trk
