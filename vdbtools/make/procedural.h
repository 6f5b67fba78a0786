// SPDX-License-Identifier: Apache-2.0
// Volumes that look real, for demonstrations and tests: no file needed.
#pragma once

#include "io/output_file.h"

#include <cstdint>
#include <functional>
#include <string>
#include <vector>

namespace vdbtools {

/// "cloud": a cumulus, dense inside, crisp outside. "smoke": a thin rising plume. "color-cloud": a
/// cumulus whose three channels differ in shape.
const std::vector<std::string>& proceduralKinds();

struct ProceduralOptions {
    std::string kind = "cloud";
    int voxels = 256;  ///< along an edge of the box that holds it
    uint64_t seed = 1;
};

struct ProceduralSummary {
    uint64_t activeVoxels = 0;
    double voxelSize = 0;  ///< the box is 10 world units wide
};

/// Writes grid "density" (float or Vec3s, fog volume, values from 0 to 1) to `file`, without
/// committing it. `progress(fraction)` is called now and then. The same options give the same
/// voxels on any number of threads.
ProceduralSummary writeProcedural(const ProceduralOptions& options, const trk::OutputFile& file,
                                  const std::function<void(double)>& progress);

}  // namespace vdbtools
