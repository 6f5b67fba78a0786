// SPDX-License-Identifier: Apache-2.0
// The sidecar: a bake as an ordinary .vdb file. One schema for the writer and the reader, described
// in libtrack/docs/sidecar.md.
#pragma once

#include "control/super_voxels.h"
#include "density.h"
#include "output_file.h"

#include <cstdint>
#include <string>

namespace trk {

/// The metadata on every grid of a sidecar.
struct SidecarHeader {
    std::string format;  ///< "major.minor", of one that was read
    std::string toolVersion;
    std::string sourceFile;      ///< base name, informative
    uint64_t sourceBytes = 0;    ///< the source file's size, and when it was written,
    int64_t sourceModified = 0;  ///< in nanoseconds since 1970: to see quickly what is current
    GridIdentity source;
    std::string prefix;               ///< that the names of its grids begin with
    std::string valueType = "float";  ///< of the source grid and of the sidecar's statistics
    uint64_t digest = 0;
    AffineMap indexToWorld;  ///< the source's
    Int3 origin{{0, 0, 0}};  ///< source index of the corner that all grids count from
    int superVoxelSize = 16;
    ControlKind controlKind = ControlKind::kConstant;
    int levels = 0;
    int previewSize = 0;      ///< edge of the cubes whose means are there for pictures; 0: none
    double previewScale = 1;  ///< at which the volume shows well
    uint32_t repair = 0;      ///< TRK_REPAIR_… bits the bake was allowed
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
/// format of another major version than this build's. `source`: of the sidecars in the file, the
/// one baked from that grid; NULL, or where there is none, the first.
SidecarHeader readSidecarHeader(const std::string& path, const GridIdentity* source = nullptr);

/// How much of a bake is read: what queries need, or gradients and means for pictures too.
enum class SidecarParts { kQueries, kAll };

/// The bake, checked as far as `check` says, against `density` unless that is NULL (a sidecar
/// opened alone, whose anchor is then its own). Throws Error: OUT_OF_MEMORY where reading it would
/// take more than `maxMemory` bytes (0: no limit).
Sidecar readSidecar(const std::string& path, const DensitySummary* density, TrkCheck check,
                    SidecarParts parts = SidecarParts::kQueries, uint64_t maxMemory = 0);

/// Writes the grids one after another, so that only one is in memory at a time. Does not commit.
/// `header.origin` is chosen here.
void writeSidecar(const OutputFile& file, SidecarHeader header, const BakedVolume& baked,
                  const Int3& anchor);

}  // namespace trk
