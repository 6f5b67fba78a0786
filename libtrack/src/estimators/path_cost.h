// SPDX-License-Identifier: Apache-2.0
// What an estimator spent on a ray.
#pragma once

#include <cstdint>

namespace trk {

struct PathCost {
    uint64_t lookups = 0;      ///< density values interpolated
    uint64_t superVoxels = 0;  ///< occupied regions met
    double exactLength = 0;    ///< voxel lengths integrated exactly
};

}  // namespace trk
