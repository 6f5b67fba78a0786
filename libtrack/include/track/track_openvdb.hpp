// SPDX-License-Identifier: Apache-2.0
// Volumes of OpenVDB grids in memory, of whatever version of OpenVDB you compile with: only plain
// arrays reach the library, and no object of OpenVDB's does.
#pragma once

#include "track/track.hpp"

#include <openvdb/openvdb.h>

#include <cstdint>
#include <string>
#include <type_traits>
#include <vector>

namespace track {
namespace openvdb_internal {

template <class Value>
struct Values;
template <>
struct Values<float> {
    static constexpr TrkValueType kType = TRK_VALUE_FLOAT;
    static constexpr uint32_t kChannels = 1;
};
template <>
struct Values<double> {
    static constexpr TrkValueType kType = TRK_VALUE_DOUBLE;
    static constexpr uint32_t kChannels = 1;
};
template <>
struct Values<openvdb::Vec3f> {
    static constexpr TrkValueType kType = TRK_VALUE_FLOAT;
    static constexpr uint32_t kChannels = 3;
};
template <>
struct Values<openvdb::Vec3d> {
    static constexpr TrkValueType kType = TRK_VALUE_DOUBLE;
    static constexpr uint32_t kChannels = 3;
};

}  // namespace openvdb_internal

/// A volume of a grid of float, double, Vec3f or Vec3d, of the tree that files have, as a file with
/// that grid would give it: a sidecar that is baked of one fits the other. The grid is copied, and
/// must not change meanwhile. As trkMakeVolume; throws Error, also with UNSUPPORTED_GRID for level
/// sets, staggered grids and frusta, and BAD_DENSITY for a background that is not 0.
template <class Grid>
Volume makeVolume(const Grid& grid, const TrkVolumeOptions& options = trkDefaultVolumeOptions()) {
    using Value = typename Grid::ValueType;
    using Tree = typename Grid::TreeType;
    using Leaf = typename Tree::LeafNodeType;
    static_assert(std::is_same_v<Tree, typename openvdb::tree::Tree4<Value, 5, 4, 3>::Type>,
                  "expected a grid of OpenVDB's standard tree");

    const std::string name = grid.getName();
    const std::string where = "grid " + name + ": ";
    const openvdb::GridClass kind = grid.getGridClass();
    if (kind == openvdb::GRID_LEVEL_SET || kind == openvdb::GRID_STAGGERED) {
        throw Error(TRK_ERROR_UNSUPPORTED_GRID, where + "is a " +
                                                    openvdb::GridBase::gridClassToString(kind) +
                                                    "; expected a fog volume");
    }
    if (!(grid.background() == openvdb::zeroVal<Value>())) {
        throw Error(TRK_ERROR_BAD_DENSITY, where + "the background is not 0");
    }
    if (!grid.transform().isLinear()) {
        throw Error(TRK_ERROR_UNSUPPORTED_GRID,
                    where + "has a frustum transform; expected an affine one");
    }

    TrkDensity density = trkDefaultDensity();
    density.name = name.c_str();
    density.valueType = openvdb_internal::Values<Value>::kType;
    density.channels = openvdb_internal::Values<Value>::kChannels;
    openvdb::Mat4d matrix;
    try {
        matrix = grid.transform().baseMap()->getAffineMap()->getMat4();
    } catch (const openvdb::Exception& e) {
        throw Error(TRK_ERROR_UNSUPPORTED_GRID, where + e.what());
    }
    for (int row = 0; row < 3; ++row) {  // OpenVDB multiplies row vectors from the left
        for (int column = 0; column < 3; ++column) {
            density.indexToWorld[3 * row + column] = matrix(column, row);
        }
        density.indexToWorld[9 + row] = matrix(3, row);
    }

    const Tree& tree = grid.tree();
    std::vector<int32_t> brickOrigins;
    std::vector<const void*> brickValues;
    std::vector<uint64_t> brickMasks;
    for (auto leaf = tree.cbeginLeaf(); leaf; ++leaf) {
        for (openvdb::Index a = 0; a < 3; ++a) {
            brickOrigins.push_back(leaf->origin()[a]);
        }
        brickValues.push_back(leaf->buffer().data());
        for (openvdb::Index word = 0; word < Leaf::NodeMaskType::WORD_COUNT; ++word) {
            brickMasks.push_back(leaf->getValueMask().template getWord<uint64_t>(word));
        }
    }
    std::vector<int32_t> tileOrigins;
    std::vector<int32_t> tileSizes;
    std::vector<Value> tileValues;
    std::vector<uint8_t> tileActive;
    auto tile = tree.cbeginValueAll();
    tile.setMaxDepth(tile.getLeafDepth() - 1);
    for (; tile; ++tile) {
        if (!tile.isValueOn() && *tile == openvdb::zeroVal<Value>()) {
            continue;
        }
        openvdb::CoordBBox box;
        tile.getBoundingBox(box);
        for (openvdb::Index a = 0; a < 3; ++a) {
            tileOrigins.push_back(box.min()[a]);
        }
        tileSizes.push_back(box.dim()[0]);
        tileValues.push_back(*tile);
        tileActive.push_back(tile.isValueOn() ? 1 : 0);
    }
    density.brickCount = brickValues.size();
    density.brickOrigins = brickOrigins.data();
    density.brickValues = brickValues.data();
    density.brickMasks = brickMasks.data();
    density.tileCount = tileSizes.size();
    density.tileOrigins = tileOrigins.data();
    density.tileSizes = tileSizes.data();
    density.tileValues = tileValues.data();
    density.tileActive = tileActive.data();
    return Volume::make(density, options);
}

}  // namespace track
