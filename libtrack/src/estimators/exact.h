// SPDX-License-Identifier: Apache-2.0
// Regular tracking: the optical depth in closed form, cell by cell.
#pragma once

#include "../sparse_table.h"
#include "path_cost.h"

namespace trk {

/// Optical depth of the whole ray. `unit`: extinction x world length of a density of 1 over one
/// voxel length along this ray.
template <class Field>
double exactOpticalDepth(const Field& field, const LocalRay& ray, double unit, PathCost& cost) {
    cost.exactLength += ray.tEnd;
    return unit * field.integrate(ray, 0, ray.tEnd, cost.lookups, cost.superVoxels);
}

}  // namespace trk
