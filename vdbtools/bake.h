// SPDX-License-Identifier: Apache-2.0
// Statistics, constant control and preview levels of a density: what a sidecar stores.
#pragma once

#include "extinction_field.h"
#include "super_voxels.h"

namespace vdbtools {

/// Bakes a field, in parallel. `superVoxelSize`: a power of two from 4 to 64, in voxels. `levels`:
/// preview levels, each of super-voxels twice as large. The result has the same bits for any number
/// of threads, and with or without tiles in the source.
trk::BakedVolume bake(const trk::ExtinctionField& field, int superVoxelSize, int levels);

}  // namespace vdbtools
