// SPDX-License-Identifier: Apache-2.0
// Preview levels: means of super-voxels 2, 4, … times as large.
#pragma once

#include "super_voxels.h"

namespace vdbtools {

/// Adds `count` levels to a bake of a field that lies in `box` (cells).
void addLevels(trk::BakedVolume& baked, const trk::IntBox& box, int count);

}  // namespace vdbtools
