// SPDX-License-Identifier: Apache-2.0
// The tree of a grid in a .vdb file: its topology, checked node by node, and its leaves, one pass
// after another. Nothing of OpenVDB's is built for it.
#pragma once

#include "region_source.h"
#include "vdb_file.h"
#include "vdb_values.h"

#include <cstdint>
#include <string>
#include <vector>

namespace trk {

/// A grid of a file as a source of regions. `Value`: float, double, openvdb::Vec3f or Vec3d. The
/// file must live as long. Memory: 28 bytes a leaf and what tiles take; while leaves come by, a few
/// batches of them.
template <class Value>
class VdbTree : public RegionSource<Value> {
  public:
    /// Reads the topology. Throws Error: BAD_FILE where it breaks the format, OUT_OF_MEMORY where
    /// its leaves and tiles alone would take more than `maxMemory` bytes (0: no limit).
    VdbTree(VdbFile& file, const VdbEntry& entry, uint64_t maxMemory);

    using Body = std::function<void(const LeafBatch<Value>&)>;
    void forEachBatch(const Body& body) override;

    /// The same of some leaves alone, by their places among leafOrigins(), which rise. To be called
    /// after forEachBatch, which finds where they are.
    void forEachBatchOf(const std::vector<uint32_t>& leaves, const Body& body);

    size_t listBytes() const override {
        return RegionSource<Value>::listBytes() + 2 * maskHashes_.size() * sizeof(uint64_t);
    }

    /// What OpenVDB holds in memory for such a tree.
    uint64_t openvdbBytes() const;

  private:
    using Origin = typename RegionSource<Value>::Origin;

    /// Tables of a node while it is read.
    struct Node {
        std::vector<uint64_t> children;
        std::vector<uint64_t> active;
        std::vector<Value> values;
    };

    void readRoot();
    /// A node of 2^(3 log2Dim) slots of 2^childShift voxels each.
    void readInternal(const Origin& origin, int log2Dim, int childShift, Node& node);
    void readUpper(const Origin& origin);
    void addTile(const Origin& origin, int shift, const Value& value, bool active);
    void checkMemory() const;
    /// Calls body for `count` leaves, all or `some`; `find(leaf)` goes where the next one begins.
    template <class Find>
    void passOver(size_t count, const uint32_t* some, const Find& find, const Body& body);

    VdbFile& file_;
    std::string place_;
    ValueFormat format_;
    uint64_t end_ = 0;          // of the grid in the file
    uint64_t valuesStart_ = 0;  // where the leaves' values begin
    uint64_t maxMemory_ = 0;
    std::vector<uint64_t> maskHashes_;  // of the leaves' masks in the topology
    std::vector<uint64_t> positions_;   // of the leaves' values, once they came by
    uint64_t upperNodes_ = 0;
    uint64_t lowerNodes_ = 0;
    Node upper_;
    Node lower_;
    std::vector<char> bytes_;
    ChunkDecoder decoder_;
};

extern template class VdbTree<float>;
extern template class VdbTree<double>;
extern template class VdbTree<openvdb::Vec3f>;
extern template class VdbTree<openvdb::Vec3d>;

/// Steps over a tree of `type` by its structure, from the reader's place on, to its end. False for
/// types whose structure is not known here.
bool stepOverTree(FileReader& reader, const std::string& type, bool half, uint32_t compression);

}  // namespace trk
