// SPDX-License-Identifier: Apache-2.0
// Regular tracking: the optical depth in closed form, cell by cell.
#pragma once

#include "tracking.h"

#include <array>

namespace trk {

/// Optical depth of the whole ray, per channel. `lengthPerVoxel`: world length of one voxel length
/// along the ray.
template <class Field>
std::array<double, Field::kChannels> exactOpticalDepth(const Field& field, const LocalRay& ray,
                                                       double lengthPerVoxel, PathCost& cost) {
    cost.exactLength += ray.tEnd;
    auto depth = field.integrate(ray, 0, ray.tEnd, cost.lookups, cost.superVoxels);
    for (double& d : depth) {
        d *= lengthPerVoxel;
    }
    return depth;
}

}  // namespace trk
