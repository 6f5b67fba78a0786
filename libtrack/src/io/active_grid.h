// SPDX-License-Identifier: Apache-2.0
// The active values of a grid of a sidecar, equal leaves once: the surface of a large tile is
// thousands of them.
#pragma once

#include "space/geometry.h"
#include "vdb_file.h"

#include <array>
#include <cstddef>
#include <cstdint>
#include <utility>
#include <vector>

namespace trk {

struct ActiveLeaf {
    static constexpr size_t kVoxels = 512;  ///< x slowest
    using Floats = std::array<float, 3>;    ///< of a value, as many as it has channels

    std::array<uint64_t, 8> mask;
    std::vector<Floats> values;

    bool isActive(size_t i) const { return (mask[i >> 6] >> (i & 63) & 1) != 0; }
};

/// In the grid's own index space.
struct ActiveGrid {
    size_t channels = 1;
    std::vector<ActiveLeaf> leaves;
    std::vector<std::pair<Int3, size_t>> places;  ///< origin of a leaf, and which one it is
    std::vector<std::pair<IntBox, ActiveLeaf::Floats>> tiles;

    /// Box of the active voxels.
    IntBox box() const;
};

/// Reads a grid of a type that a density can have. Throws Error: BAD_FILE for one that is damaged
/// or has another background than 0, OUT_OF_MEMORY where it would take more than `maxMemory` bytes
/// (0: no limit).
ActiveGrid readActiveGrid(VdbFile& file, const VdbEntry& entry, uint64_t maxMemory);

}  // namespace trk
