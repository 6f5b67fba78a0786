// SPDX-License-Identifier: Apache-2.0
// Coarser super-voxels from finer ones, without the density.
#pragma once

#include "control/baked_volume.h"

namespace trk {

/// The bake with super-voxels twice as large: bounds, means, deviations and gradients as a bake of
/// that size has them, within rounding; of an affine control a residual's root mean square as well,
/// and a bound of it that may be larger. The bake must have gradients, and a control that is
/// constant or affine. Means for pictures are left out.
BakedVolume coarser(const BakedVolume& finer);

}  // namespace trk
