// SPDX-License-Identifier: Apache-2.0
// Whether a grid of a file is read here as OpenVDB reads it, bit by bit.
#pragma once

#include "io/density_types.h"
#include "io/vdb_tree.h"

#include <openvdb/io/File.h>

#include <cstring>
#include <map>
#include <mutex>
#include <sstream>
#include <string>
#include <utility>

namespace fixtures {

/// What differs, in a line; empty where all is the same. `leaves`: how many were compared.
template <class GridType>
std::string differenceToOpenVdb(const std::string& path, const std::string& name, int index,
                                size_t& leaves) {
    using Value = typename GridType::ValueType;
    using Leaf = typename GridType::TreeType::LeafNodeType;
    using openvdb::Coord;
    openvdb::io::File reference(path);
    reference.open(/*delayLoad=*/false);
    typename GridType::ConstPtr grid;
    const openvdb::GridPtrVecPtr all = reference.getGrids();
    int seen = 0;
    for (const auto& candidate : *all) {
        if (candidate->getName() == name && seen++ == index) {
            grid = openvdb::gridConstPtrCast<GridType>(candidate);
        }
    }
    if (!grid) {
        return "OpenVDB finds no such grid";
    }
    trk::VdbFile file(path);
    const trk::VdbEntry& entry = file.select(name + "[" + std::to_string(index) + "]");
    const trk::VdbGridHeader header = file.readHeader(entry);
    trk::VdbTree<Value> tree(file, entry, 0);
    if (*header.transform != grid->constTransform() ||
        header.gridClass() != openvdb::GridBase::gridClassToString(grid->getGridClass()) ||
        entry.half != grid->saveFloatAsHalf() ||
        std::memcmp(&tree.background(), &grid->background(), sizeof(Value)) != 0 ||
        tree.leafCount() != grid->constTree().leafCount()) {
        return "transform, class, half flag, background or number of leaves";
    }
    std::string difference;
    std::mutex lock;
    leaves = 0;
    tree.forEachBatch([&](const trk::LeafBatch<Value>& batch) {
        for (size_t i = 0; i < batch.count; ++i) {
            const auto& o = tree.leafOrigins()[batch.first + i];
            const Leaf* leaf = grid->constTree().probeConstLeaf(Coord(o[0], o[1], o[2]));
            bool same =
                leaf && std::memcmp(batch.leaf(i), leaf->buffer().data(), 512 * sizeof(Value)) == 0;
            for (openvdb::Index w = 0; w < 8 && same; ++w) {
                same = batch.mask(i)[w] == leaf->valueMask().template getWord<uint64_t>(w);
            }
            const std::lock_guard<std::mutex> guard(lock);
            ++leaves;
            if (!same) {
                difference = "leaf at " + std::to_string(o[0]) + ", " + std::to_string(o[1]) +
                             ", " + std::to_string(o[2]);
            }
        }
    });
    std::map<std::pair<Coord, int>, const trk::Tile<Value>*> tiles;
    for (const trk::Tile<Value>& tile : tree.tiles()) {
        tiles[{Coord(tile.origin[0], tile.origin[1], tile.origin[2]), tile.shift}] = &tile;
    }
    size_t expected = 0;
    auto it = grid->cbeginValueAll();
    it.setMaxDepth(GridType::ValueAllCIter::LEAF_DEPTH - 1);
    for (; it; ++it) {
        if (!it.isValueOn() && it.getValue() == Value{}) {
            continue;
        }
        ++expected;
        const int shift = it.getDepth() == 0 ? 12 : it.getDepth() == 1 ? 7 : 3;
        openvdb::CoordBBox box;
        it.getBoundingBox(box);
        const auto found = tiles.find({box.min(), shift});
        const Value value = it.getValue();
        if (found == tiles.end() || found->second->active != it.isValueOn() ||
            std::memcmp(&found->second->value, &value, sizeof(Value)) != 0) {
            std::ostringstream line;
            line << "tile at " << box.min();
            difference = line.str();
        }
    }
    return tree.tiles().size() == expected ? difference : "number of tiles";
}

/// The same for a grid of any type that can be a density.
inline std::string differenceToOpenVdb(const std::string& path, const trk::VdbEntry& entry,
                                       size_t& leaves) {
    return trk::withValueType(trk::valueTypeName(entry.type), [&](auto zero) {
        using Tree = typename openvdb::tree::Tree4<decltype(zero), 5, 4, 3>::Type;
        return differenceToOpenVdb<openvdb::Grid<Tree>>(path, entry.name, entry.index, leaves);
    });
}

}  // namespace fixtures
