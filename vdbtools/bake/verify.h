// SPDX-License-Identifier: Apache-2.0
// Proof of a sidecar's bounds, voxel by voxel, from the source's tree alone.
#pragma once

#include "io/density.h"
#include "io/sidecar.h"

#include <cstdint>
#include <string>

namespace vdbtools {

struct VerifyReport {
    bool holds = false;
    std::string counterexample;  ///< the first, where the bounds do not hold
    uint64_t superVoxels = 0;    ///< occupied
    uint64_t vertices = 0;       ///< compared with bounds
};

/// Checks, against the voxels of `density` read again through OpenVDB, that for every super-voxel
/// min <= density <= max and |density - control| <= majorant on its (N+1)^3 vertices (which bound
/// the trilinear field), that its control is the mean and its RMS not too small, and that every
/// voxel that is not 0 lies in occupied super-voxels only. `maxMemory`: in bytes; where the voxels
/// need more they are read part by part, and again; 0: no limit. Throws Error where a file cannot
/// be read.
VerifyReport verify(const trk::DensitySummary& density, const trk::Sidecar& sidecar,
                    uint64_t maxMemory = 0);

}  // namespace vdbtools
