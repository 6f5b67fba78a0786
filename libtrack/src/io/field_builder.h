// SPDX-License-Identifier: Apache-2.0
// From an OpenVDB tree to bricks: one scan of the leaves (checks, digest, extent), then bricks
// wherever a vertex is not constant. Work and memory go with the leaves, not with tiles or boxes.
#pragma once

#include "../extinction_field.h"
#include "../failure.h"
#include "../hash.h"
#include "../parallel.h"
#include "density_types.h"
#include "tree_regions.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <map>
#include <string>
#include <vector>

namespace trk {

struct BadValues {
    uint64_t count = 0;
    Int3 first{{0, 0, 0}};

    void add(uint64_t n, const Int3& at) {
        if (n > 0) {
            first = count == 0 ? at : std::min(first, at);
            count += n;
        }
    }
};

/// What one pass over a tree's leaves and tiles found.
struct TreeScan {
    BadValues negative;
    BadValues nonfinite;
    uint64_t digest = 0;
    uint64_t activeVoxels = 0;
    bool exactHalfs = true;
    bool any = false;  ///< min and max are of something
    float min = 0;
    float max = 0;
    IntBox box;  ///< index space; cells where the trilinear field may differ from 0

    void addRange(float lo, float hi) {
        min = any ? std::min(min, lo) : lo;
        max = any ? std::max(max, hi) : hi;
        any = true;
    }
    void join(const TreeScan& o) {
        negative.add(o.negative.count, o.negative.first);
        nonfinite.add(o.nonfinite.count, o.nonfinite.first);
        digest += o.digest;
        activeVoxels += o.activeVoxels;
        exactHalfs = exactHalfs && o.exactHalfs;
        if (o.any) {
            addRange(o.min, o.max);
        }
        if (!o.box.empty()) {
            box.add(o.box.lo, o.box.hi);
        }
    }
};

template <class TreeType>
class FieldBuilder {
  public:
    using Leaf = typename TreeType::LeafNodeType;
    using Value = typename TreeType::ValueType;
    using Entry = SparseTable::Entry;

    explicit FieldBuilder(const TreeType& tree) : tree_(tree) { scanTree(); }

    const TreeScan& scan() const { return scan_; }

    /// The field, in space relative to `anchor`; values that are negative or not finite count as 0.
    /// Throws OUT_OF_MEMORY where the bricks would take more than `maxMemory` bytes (0: no limit).
    ExtinctionField build(const Int3& anchor, uint64_t maxMemory, const std::string& where) const;

  private:
    static constexpr size_t kBrickVertices = ExtinctionField::kBrickVertices;
    static constexpr size_t kChannels = ValueTraits<Value>::kChannels;
    using Regions = TreeRegions<TreeType>;
    using FieldValue = Sample<Value>;
    using Vertices = std::array<FieldValue, kBrickVertices>;
    static_assert(sizeof(Vertices) == kBrickVertices * kChannels * sizeof(float));
    using CornerValues = std::array<FieldValue, 8>;

    struct Tile {
        openvdb::Coord origin;
        int shift;
        Value value;
        bool active;
    };

    /// A brick to fill: from the tree around `origin` (index space), or, where all eight regions it
    /// reaches into are tiles, from their values.
    struct Job {
        Int3 origin;
        bool fromTiles;
        CornerValues values;
    };

    /// What the recursion of build() works on.
    struct Plan {
        SparseTable table;
        std::vector<Job> jobs;
        std::vector<float> constants;
        std::map<FieldValue, Entry> constantEntries;
        std::map<std::pair<int, CornerValues>, Entry> shared;

        Entry constantEntry(const FieldValue& value) {
            if (value == FieldValue{}) {
                return SparseTable::kEmpty;
            }
            const size_t next = constants.size() / kChannels;
            const auto [it, isNew] = constantEntries.try_emplace(
                value, static_cast<Entry>(next) | ExtinctionField::kConstantFlag);
            if (isNew) {
                constants.insert(constants.end(), value.begin(), value.end());
            }
            return it->second;
        }
        Entry jobEntry(const Job& job) {
            jobs.push_back(job);
            return static_cast<Entry>(jobs.size());
        }
        /// Entry for a region whose own value and those of its seven upper neighbours are constant.
        /// Such regions look alike all over the surface of a tile, so they are built once.
        Entry sharedEntry(int shift, const CornerValues& values) {
            if (std::all_of(values.begin(), values.end(),
                            [&](const FieldValue& v) { return v == values[0]; })) {
                return constantEntry(values[0]);
            }
            const auto key = std::make_pair(shift, values);
            if (const auto it = shared.find(key); it != shared.end()) {
                return it->second;
            }
            Entry entry;
            if (shift == ExtinctionField::kBrickShift) {
                entry = jobEntry({Int3{{0, 0, 0}}, true, values});
            } else {
                SparseTable::Node node;
                for (size_t c = 0; c < node.size(); ++c) {
                    CornerValues child;
                    for (size_t corner = 0; corner < 8; ++corner) {
                        // The last child of an axis looks into the upper neighbour.
                        const size_t x = (c >> 6) + (corner >> 2) > 7 ? 4 : 0;
                        const size_t y = (c >> 3 & 7) + (corner >> 1 & 1) > 7 ? 2 : 0;
                        const size_t z = (c & 7) + (corner & 1) > 7 ? 1 : 0;
                        child[corner] = values[x + y + z];
                    }
                    node[c] = sharedEntry(shift - 3, child);
                }
                entry = table.addNode(node);
            }
            shared.emplace(key, entry);
            return entry;
        }
    };

    static void scanValue(const Value& value, const openvdb::Coord& at, uint64_t count,
                          TreeScan& scan) {
        const FieldValue floats = toFloats(value);
        const Int3 where{{at.x(), at.y(), at.z()}};
        // A double beyond float's range is infinite to the field.
        if (!std::all_of(floats.begin(), floats.end(), [](float v) { return std::isfinite(v); })) {
            scan.nonfinite.add(count, where);
        } else if (std::any_of(floats.begin(), floats.end(), [](float v) { return v < 0; })) {
            scan.negative.add(count, where);
        }
        for (const float f : fieldValue(value)) {
            scan.addRange(f, f);
            scan.exactHalfs = scan.exactHalfs && isExactHalf(f);
        }
    }

    static void addSupport(const openvdb::Coord& origin, int64_t size, TreeScan& scan) {
        const Int3 o{{origin.x(), origin.y(), origin.z()}};
        scan.box.add({{o[0] - 1, o[1] - 1, o[2] - 1}}, {{o[0] + size, o[1] + size, o[2] + size}});
    }

    static void scanLeaf(const Leaf& leaf, TreeScan& scan);
    static void scanTile(const Tile& tile, TreeScan& scan);
    void scanTree();

    static void gather(Regions& regions, const Job& job, Vertices& out);
    static void gatherCorner(const Leaf* leaf, const FieldValue& value, size_t corner,
                             Vertices& out);

    const TreeType& tree_;
    std::vector<const Leaf*> leaves_;
    std::vector<Tile> tiles_;
    TreeScan scan_;
};

template <class TreeType>
void FieldBuilder<TreeType>::scanLeaf(const Leaf& leaf, TreeScan& scan) {
    const Value* values = leaf.buffer().data();
    const openvdb::Coord origin = leaf.origin();
    uint64_t mask[8];
    for (openvdb::Index w = 0; w < 8; ++w) {
        mask[w] = leaf.valueMask().template getWord<uint64_t>(w);
    }
    const int32_t key[4] = {origin.x(), origin.y(), origin.z(), 0};
    scan.digest +=
        hashWords(values, Leaf::SIZE * sizeof(Value) / 8, hashWords(mask, 8, hashWords(key, 2, 0)));
    scan.activeVoxels += leaf.onVoxelCount();

    // First branch-free over all, as nearly every leaf is fine; then, where not, voxel by voxel.
    constexpr size_t kCount = Leaf::SIZE * kChannels;
    const auto* components = ValueTraits<Value>::components(values);
    bool fine = true;
    auto lo = static_cast<float>(components[0]);
    float hi = lo;
    for (size_t i = 0; i < kCount; ++i) {
        const auto v = static_cast<float>(components[i]);
        fine = fine & (v >= 0) & (v <= std::numeric_limits<float>::max());
        lo = std::min(lo, v);
        hi = std::max(hi, v);
    }
    if (fine) {
        scan.addRange(lo, hi);
        for (size_t i = 0; i < kCount && scan.exactHalfs; ++i) {
            scan.exactHalfs = isExactHalf(static_cast<float>(components[i]));
        }
    } else {
        for (openvdb::Index i = 0; i < Leaf::SIZE; ++i) {
            scanValue(values[i], leaf.offsetToGlobalCoord(i), 1, scan);
        }
    }
    if (hi > 0 || !fine) {
        addSupport(origin, Leaf::DIM, scan);
    }
}

template <class TreeType>
void FieldBuilder<TreeType>::scanTile(const Tile& tile, TreeScan& scan) {
    const int64_t size = int64_t{1} << tile.shift;
    const auto voxels = static_cast<uint64_t>(size * size * size);
    const int32_t key[4] = {tile.origin.x(), tile.origin.y(), tile.origin.z(), tile.shift};
    double value[kChannels + 1];
    for (size_t c = 0; c < kChannels; ++c) {
        value[c] = static_cast<double>(ValueTraits<Value>::components(&tile.value)[c]);
    }
    value[kChannels] = tile.active ? 1.0 : 0.0;
    scan.digest += hashWords(value, kChannels + 1, hashWords(key, 2, 1));
    scan.activeVoxels += tile.active ? voxels : 0;
    scanValue(tile.value, tile.origin, voxels, scan);
    if (!(tile.value == openvdb::zeroVal<Value>())) {
        addSupport(tile.origin, size, scan);
    }
}

template <class TreeType>
void FieldBuilder<TreeType>::scanTree() {
    const auto addTile = [&](const openvdb::Coord& origin, int shift, const Value& value,
                             bool active) {
        if (active || !(value == openvdb::zeroVal<Value>())) {
            tiles_.push_back({origin, shift, value, active});
        }
    };
    for (auto root = tree_.root().cbeginChildAll(); root; ++root) {
        Value value{};
        const auto* upper = root.probeChild(value);
        if (!upper) {
            addTile(root.getCoord(), 12, value, root.isValueOn());
            continue;
        }
        for (auto u = upper->cbeginChildAll(); u; ++u) {
            const auto* lower = u.probeChild(value);
            if (!lower) {
                addTile(u.getCoord(), 7, value, u.isValueOn());
                continue;
            }
            for (auto l = lower->cbeginChildAll(); l; ++l) {
                if (const Leaf* leaf = l.probeChild(value)) {
                    leaves_.push_back(leaf);
                } else {
                    addTile(l.getCoord(), 3, value, l.isValueOn());
                }
            }
        }
    }
    scan_ = parallelSum<TreeScan>(leaves_.size(), 64,
                                  [&](size_t i, TreeScan& part) { scanLeaf(*leaves_[i], part); });
    for (const Tile& tile : tiles_) {
        scanTile(tile, scan_);
    }
}

template <class TreeType>
void FieldBuilder<TreeType>::gatherCorner(const Leaf* leaf, const FieldValue& value, size_t corner,
                                          Vertices& out) {
    // The brick's own region gives 8 vertices an axis, an upper neighbour the one of the apron.
    const size_t nx = corner & 4 ? 1 : 8;
    const size_t ny = corner & 2 ? 1 : 8;
    const size_t nz = corner & 1 ? 1 : 8;
    const size_t first =
        (corner & 4 ? 8 * 81 : 0) + (corner & 2 ? 8 * 9 : 0) + (corner & 1 ? 8 : 0);
    const Value* values = leaf ? leaf->buffer().data() : nullptr;
    for (size_t x = 0; x < nx; ++x) {
        for (size_t y = 0; y < ny; ++y) {
            FieldValue* row = &out[first + x * 81 + y * 9];
            for (size_t z = 0; z < nz; ++z) {
                row[z] = values ? fieldValue(values[x << 6 | y << 3 | z]) : value;
            }
        }
    }
}

template <class TreeType>
void FieldBuilder<TreeType>::gather(Regions& regions, const Job& job, Vertices& out) {
    for (size_t corner = 0; corner < 8; ++corner) {
        if (job.fromTiles) {
            gatherCorner(nullptr, job.values[corner], corner, out);
            continue;
        }
        const Int3 at{{job.origin[0] + (corner & 4 ? 8 : 0), job.origin[1] + (corner & 2 ? 8 : 0),
                       job.origin[2] + (corner & 1 ? 8 : 0)}};
        const Leaf* leaf = regions.leaf(at);
        gatherCorner(leaf, leaf ? FieldValue{} : fieldValue(regions.value(at)), corner, out);
    }
}

template <class TreeType>
ExtinctionField FieldBuilder<TreeType>::build(const Int3& anchor, uint64_t maxMemory,
                                              const std::string& where) const {
    Plan plan;
    IntBox box;
    if (!scan_.box.empty()) {
        for (size_t a = 0; a < 3; ++a) {
            box.lo[a] = scan_.box.lo[a] - anchor[a];
            box.hi[a] = scan_.box.hi[a] - anchor[a];
        }
    }
    plan.table = SparseTable(ExtinctionField::kBrickShift, box);
    Regions regions(tree_);
    plan.table.fill(
        [&](const Int3& local, int shift) -> std::optional<Entry> {
            CornerValues values{};
            const int64_t size = int64_t{1} << shift;
            for (size_t corner = 0; corner < 8; ++corner) {
                const Int3 at{{anchor[0] + local[0] + (corner & 4 ? size : 0),
                               anchor[1] + local[1] + (corner & 2 ? size : 0),
                               anchor[2] + local[2] + (corner & 1 ? size : 0)}};
                const auto region = regions.uniform(at, shift);
                if (!region) {
                    return std::nullopt;
                }
                values[corner] = fieldValue(region->value);
            }
            return plan.sharedEntry(shift, values);
        },
        [&](const Int3& local) {
            return plan.jobEntry(
                {{{anchor[0] + local[0], anchor[1] + local[1], anchor[2] + local[2]}}, false, {}});
        });

    // First pass: which bricks are constant after all. Second: fill the others, exactly allocated.
    const size_t jobCount = plan.jobs.size();
    const auto forEachJob = [&](const auto& body) {
        parallelRanges(jobCount, 64, [&](size_t begin, size_t end) {
            Regions local(tree_);
            Vertices vertices;
            for (size_t i = begin; i != end; ++i) {
                gather(local, plan.jobs[i], vertices);
                body(i, vertices);
            }
        });
    };
    FieldValue notConstant;
    notConstant.fill(-1);
    std::vector<FieldValue> constantOf(jobCount);
    forEachJob([&](size_t i, const Vertices& vertices) {
        const bool same = std::all_of(vertices.begin(), vertices.end(),
                                      [&](const FieldValue& v) { return v == vertices[0]; });
        constantOf[i] = same ? vertices[0] : notConstant;
    });
    std::vector<Entry> entryOf(jobCount);
    size_t brickCount = 0;
    for (size_t i = 0; i < jobCount; ++i) {
        entryOf[i] = constantOf[i] == notConstant ? static_cast<Entry>(++brickCount)
                                                  : plan.constantEntry(constantOf[i]);
    }
    const size_t valueCount = brickCount * kBrickVertices * kChannels;
    const uint64_t wanted = valueCount * (scan_.exactHalfs ? 2 : 4);
    if (maxMemory > 0 && wanted > maxMemory) {
        throw Error(TRK_ERROR_OUT_OF_MEMORY, where + ": needs " + std::to_string(wanted) +
                                                 " bytes for its bricks, more than maxMemory = " +
                                                 std::to_string(maxMemory));
    }
    if (brickCount >= ExtinctionField::kConstantFlag) {
        throw Error(TRK_ERROR_OUT_OF_MEMORY, where + ": has more than 2^30 bricks of 8^3 voxels");
    }
    std::vector<float> floats(scan_.exactHalfs ? 0 : valueCount);
    std::vector<uint16_t> halfs(scan_.exactHalfs ? valueCount : 0);
    forEachJob([&](size_t i, const Vertices& vertices) {
        if (constantOf[i] != notConstant) {
            return;
        }
        const float* from = vertices.front().data();
        constexpr size_t kValues = kBrickVertices * kChannels;
        const size_t to = (entryOf[i] - 1) * kValues;
        if (scan_.exactHalfs) {
            std::transform(from, from + kValues, &halfs[to], encodeHalf);
        } else {
            std::copy(from, from + kValues, &floats[to]);
        }
    });
    SparseTable table = plan.table.mapped([&](Entry entry) {
        return entry & ExtinctionField::kConstantFlag ? entry : entryOf[entry - 1];
    });
    return {kChannels, std::move(table), std::move(plan.constants), std::move(floats),
            std::move(halfs)};
}

}  // namespace trk
