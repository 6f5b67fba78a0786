// SPDX-License-Identifier: Apache-2.0
#include "active_grid.h"

#include "density_types.h"
#include "failure.h"
#include "field/sparse_table.h"
#include "hash.h"
#include "vdb_tree.h"

#include <tbb/spin_mutex.h>

#include <algorithm>
#include <cstring>
#include <string>
#include <unordered_map>

namespace trk {
namespace {

using Floats = ActiveLeaf::Floats;

Int3 plus(const Int3& a, const Int3& b) {
    return {{a[0] + b[0], a[1] + b[1], a[2] + b[2]}};
}

template <class Value>
Floats floatsOf(const Value& value) {
    Floats result{};
    const auto floats = toFloats(value);
    std::copy(floats.begin(), floats.end(), result.begin());
    return result;
}

/// Index of an equal leaf, or of a new one.
size_t addLeaf(ActiveLeaf&& leaf, uint64_t hash, std::unordered_multimap<uint64_t, size_t>& known,
               std::vector<ActiveLeaf>& leaves) {
    const auto [begin, end] = known.equal_range(hash);
    for (auto it = begin; it != end; ++it) {
        const ActiveLeaf& other = leaves[it->second];
        if (other.mask == leaf.mask && std::memcmp(other.values.data(), leaf.values.data(),
                                                   ActiveLeaf::kVoxels * sizeof(Floats)) == 0) {
            return it->second;
        }
    }
    known.emplace(hash, leaves.size());
    leaves.push_back(std::move(leaf));
    return leaves.size() - 1;
}

template <class Value>
ActiveGrid collect(VdbTree<Value>& tree, uint64_t maxMemory, const std::string& place) {
    ActiveGrid grid;
    grid.channels = ValueTraits<Value>::kChannels;
    std::vector<size_t> which(tree.leafCount());
    std::unordered_multimap<uint64_t, size_t> known;
    tbb::spin_mutex lock;
    tree.forEachBatch([&](const LeafBatch<Value>& batch) {
        for (size_t i = 0; i < batch.count; ++i) {
            ActiveLeaf leaf;
            std::copy_n(batch.mask(i), leaf.mask.size(), leaf.mask.begin());
            leaf.values.resize(ActiveLeaf::kVoxels);
            for (size_t v = 0; v < ActiveLeaf::kVoxels; ++v) {
                if (leaf.isActive(v)) {
                    leaf.values[v] = floatsOf(batch.leaf(i)[v]);
                }
            }
            const uint64_t hash =
                hashWords(leaf.values.data(), ActiveLeaf::kVoxels * sizeof(Floats) / 8,
                          hashWords(leaf.mask.data(), leaf.mask.size(), 0));
            const tbb::spin_mutex::scoped_lock guard(lock);
            which[batch.first + i] = addLeaf(std::move(leaf), hash, known, grid.leaves);
            const uint64_t held = grid.leaves.size() * ActiveLeaf::kVoxels * sizeof(Floats);
            if (maxMemory > 0 && held > maxMemory) {
                throw Error(TRK_ERROR_OUT_OF_MEMORY,
                            place + ": reading it takes more than maxMemory = " +
                                std::to_string(maxMemory) + " bytes");
            }
        }
    });
    for (size_t i = 0; i < which.size(); ++i) {
        const auto& o = tree.leafOrigins()[i];
        grid.places.emplace_back(Int3{{o[0], o[1], o[2]}}, which[i]);
    }
    for (const Tile<Value>& tile : tree.tiles()) {
        if (tile.active) {
            const Int3 lo{{tile.origin[0], tile.origin[1], tile.origin[2]}};
            const int64_t edge = int64_t{1} << tile.shift;
            grid.tiles.emplace_back(IntBox{lo, plus(lo, {{edge, edge, edge}})},
                                    floatsOf(tile.value));
        }
    }
    return grid;
}

}  // namespace

IntBox ActiveGrid::box() const {
    std::vector<IntBox> leafBoxes(leaves.size());
    for (size_t l = 0; l < leaves.size(); ++l) {
        for (size_t i = 0; i < ActiveLeaf::kVoxels; ++i) {
            if (leaves[l].isActive(i)) {
                const Int3 at = SparseTable::childOrigin({{0, 0, 0}}, 0, i);
                leafBoxes[l].add(at, {{at[0] + 1, at[1] + 1, at[2] + 1}});
            }
        }
    }
    IntBox all;
    for (const auto& [origin, leaf] : places) {
        if (!leafBoxes[leaf].empty()) {
            all.add(plus(origin, leafBoxes[leaf].lo), plus(origin, leafBoxes[leaf].hi));
        }
    }
    for (const auto& [tileBox, value] : tiles) {
        all.add(tileBox);
    }
    return all;
}

ActiveGrid readActiveGrid(VdbFile& file, const VdbEntry& entry, uint64_t maxMemory) {
    const std::string place = file.path() + ": grid " + entry.label();
    return withValueType(valueTypeName(entry.type), [&](auto zero) {
        VdbTree<decltype(zero)> tree(file, entry, maxMemory);
        if (!(tree.background() == zero)) {
            throw Error(TRK_ERROR_BAD_FILE, place + ": background is not 0");
        }
        return collect(tree, maxMemory, place);
    });
}

}  // namespace trk
