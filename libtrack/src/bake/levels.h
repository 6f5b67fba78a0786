// SPDX-License-Identifier: Apache-2.0
// Means for pictures: preview levels of super-voxels 2, 4, … times as large, and cubes smaller than
// super-voxels.
#pragma once

#include "control/super_voxels.h"
#include "field/brick_pages.h"
#include "field/density_field.h"

#include <cstdint>

namespace trk {

/// Adds levels to a bake of a field that lies in `box` (cells): `count`, or fewer where four
/// super-voxels an axis hold everything: coarser ones save a ray nothing.
void addLevels(BakedVolume& baked, const IntBox& box, int count);

/// Adds means of cubes smaller than super-voxels, where the latter are too large for a picture: as
/// fine as shows in one of 512 pixels, and as keeps the whole bake as a file within `sidecarBytes`,
/// by estimate.
void addPreview(BakedVolume& baked, BrickPages& pages, uint64_t sidecarBytes);

/// Makes the cubes for pictures twice as large, or where they would be as large as super-voxels
/// drops them.
void coarsenPreview(BakedVolume& baked, const DensityField& field);

}  // namespace trk
