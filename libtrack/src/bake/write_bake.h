// SPDX-License-Identifier: Apache-2.0
// A bake as a sidecar.
#pragma once

#include "control/super_voxels.h"
#include "field/brick_pages.h"
#include "io/sidecar.h"

#include <cstdint>

namespace trk {

/// How large a sidecar of a density of `sourceBytes` as a file may be, pictures included.
uint64_t sidecarLimit(uint64_t sourceBytes, ControlKind kind);

/// What a sidecar of such a bake says of itself.
SidecarHeader sidecarHeader(const DensitySummary& source, BrickPages pages,
                            const BakedVolume& baked);

/// Writes a bake as a sidecar of at most `sidecarBytes`, for which its pictures become coarser
/// where they must. Does not commit.
SidecarHeader writeBake(const OutputFile& file, const DensitySummary& source, BrickPages pages,
                        BakedVolume& baked, uint64_t sidecarBytes);

}  // namespace trk
