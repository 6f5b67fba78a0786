// SPDX-License-Identifier: Apache-2.0
// The tree of a grid as a .vdb file stores it, made from a sparse table without a tree in memory:
// work and memory go with what is occupied, where OpenVDB takes 300 kB for a single voxel.
#pragma once

#include "field/sparse_table.h"
#include "openvdb_grids.h"

#include <array>
#include <cstdint>
#include <string>
#include <vector>

namespace trk {

/// Where the items and tiles of a table lie in a grid of one voxel an item, as the nodes of a tree
/// hold them, in their order.
class TreeLayout {
  public:
    /// `toGrid`: from the table's space to the corner that the grid counts from.
    TreeLayout(const SparseTable& table, const Int3& toGrid);

    struct Piece {
        uint64_t root;    ///< which node of 4096^3, in order
        uint64_t within;  ///< slots in it, in the node of 128^3 below, and in the leaf
        int16_t shift;    ///< 0, 3, 7 or 12: voxels, or a tile
        int16_t run;      ///< of voxels: how many there are in a row along z
        SparseTable::Entry entry;
    };
    const std::vector<Piece>& pieces() const { return pieces_; }
    size_t roots() const { return roots_; }

  private:
    void add(const IntBox& box, int shift, SparseTable::Entry entry);
    void add(const Int3& lo, int shift, SparseTable::Entry entry);

    std::vector<Piece> pieces_;
    size_t roots_ = 0;
};

/// What lies between a grid's transform and its end.
struct EncodedTree {
    std::string topology;
    std::string buffers;
    uint64_t activeVoxels = 0;
    openvdb::CoordBBox box;  ///< of active voxels
    uint64_t openvdbBytes = 0;
};

/// A tree of active values over a background of 0, compressed with Blosc, active values only;
/// what is alike is a tile. `values`: of the table's items, by SparseTable::index of their entry.
template <class Value>
EncodedTree encodeTree(const TreeLayout& layout, const std::vector<Value>& values);

/// A leaf of 8^3 values whose mask says which are active; the others are 0.
struct LeafPlace {
    std::array<int32_t, 3> origin;
    std::array<uint64_t, 8> mask;
};

/// The same of a tree of leaves alone, given in the order of their nodes. Its buffers are empty:
/// whoever has the values makes them, one leaf after another, by encodeLeaf.
template <class Value>
EncodedTree encodeLeaves(const std::vector<LeafPlace>& leaves);

/// Appends a leaf's buffer. `values`: all 8^3, x slowest.
template <class Value>
void encodeLeaf(const LeafPlace& leaf, const Value* values, std::string& buffers);

/// The compression of an encoded tree, OpenVDB's COMPRESS_… bits.
constexpr uint32_t kEncodedCompression = 6;

}  // namespace trk
