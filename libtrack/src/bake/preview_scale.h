// SPDX-License-Identifier: Apache-2.0
// At which scale a volume shows well in a picture: a property of the volume alone.
#pragma once

#include "field/brick_pages.h"
#include "space/geometry.h"

namespace trk {

/// The scale (extinction over density) at which half of the axis-parallel lines through places of
/// the volume let more than 1 % of the light through, with two digits; 1 where that shows the
/// volume well, or it is empty. Neither super-voxels nor views matter.
double previewScale(BrickPages pages, const AffineMap& indexToWorld);

}  // namespace trk
