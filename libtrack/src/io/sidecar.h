// SPDX-License-Identifier: Apache-2.0
// The sidecar: a bake as an ordinary .vdb file. One schema for the writer and the reader, described
// in libtrack/docs/sidecar.md.
#pragma once

#include "../super_voxels.h"
#include "density.h"
#include "output_file.h"

#include <cstdint>
#include <string>

namespace trk {

/// The metadata on every grid of a sidecar.
struct SidecarHeader {
    std::string toolVersion;
    std::string sourceFile;  ///< base name, informative
    GridIdentity source;
    std::string valueType = "float";  ///< of the source grid and of the sidecar's statistics
    uint64_t digest = 0;
    AffineMap indexToWorld;  ///< the source's
    int superVoxelSize = 16;
    ControlKind controlKind = ControlKind::kConstant;
    int levels = 0;
    uint32_t repair = 0;  ///< TRK_REPAIR_… bits the bake was allowed
    uint64_t dropped = 0;
    uint64_t clamped = 0;
};

struct Sidecar {
    SidecarHeader header;
    BakedVolume baked;
    Int3 anchor{{0, 0, 0}};
};

/// Whether any grid of the file carries a sidecar's metadata. Throws Error where it is no VDB.
bool isSidecar(const std::string& path);

/// Metadata only. Throws Error: BAD_FILE for a file that is no sidecar, SIDECAR_MISMATCH for a
/// format newer than this build's.
SidecarHeader readSidecarHeader(const std::string& path);

/// The whole bake, checked as far as `check` says, against `density` unless that is NULL (a sidecar
/// opened alone, whose anchor is then its own).
Sidecar readSidecar(const std::string& path, const DensitySummary* density, TrkCheck check);

/// Writes the grids one after another, so that only one is in memory at a time. Does not commit.
void writeSidecar(const OutputFile& file, const SidecarHeader& header, const BakedVolume& baked,
                  const Int3& anchor);

}  // namespace trk
