// SPDX-License-Identifier: Apache-2.0
// Writing of .vdb files, one grid at a time and with every short write noticed. OpenVDB's own
// writer wants all grids in memory at once, and reports success on a full disk.
#pragma once

#include "openvdb_grids.h"
#include "output_file.h"
#include "tree_encoder.h"

#include <cstdint>
#include <memory>

namespace trk {

/// Writes `gridCount` grids to an OutputFile, which it does not commit. Every function throws Error
/// (IO).
class VdbWriter {
  public:
    VdbWriter(const OutputFile& file, int32_t gridCount);
    ~VdbWriter();
    VdbWriter(const VdbWriter&) = delete;
    VdbWriter& operator=(const VdbWriter&) = delete;

    void add(const openvdb::GridBase::Ptr& grid);
    /// A grid whose tree was encoded; `grid` has none, and gets metadata that tells of this one.
    void add(const openvdb::GridBase::Ptr& grid, const EncodedTree& tree);
    /// The same, where the tree's buffers are in a file of their own.
    void add(const openvdb::GridBase::Ptr& grid, const EncodedTree& tree,
             const OutputFile& buffers);
    /// To be called after the last grid: what was written may still wait in buffers.
    void finish();

  private:
    class Archive;

    template <class Body>
    void writing(const Body& body) const;

    const OutputFile& file_;
    std::unique_ptr<Archive> archive_;
};

}  // namespace trk
