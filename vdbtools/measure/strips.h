// SPDX-License-Identifier: Apache-2.0
// What each choice of the control leaves to chance, as pictures of a camera's view.
#pragma once

#include "control/super_voxels.h"
#include "sweep.h"
#include "track/track.h"

#include <vector>

namespace vdbtools {

/// One choice of the control, pixel by pixel, top row first; means over the channels.
struct StripRow {
    TrkChoice choice = TRK_CHOICE_ROBUST;
    std::vector<float> control;   ///< transmittance of the chosen control
    std::vector<float> residual;  ///< mean of the estimates of the residual's transmittance
    std::vector<float> product;   ///< mean of the estimates: control x residual
    std::vector<float> variance;  ///< of one estimate
};

struct Strip {
    bool whole = false;  ///< one super-voxel over everything
    int size = 0;        ///< of super-voxels
    int width = 0;       ///< of each picture, and its height
    std::vector<StripRow> rows;
};

/// Draws the iso view by residual ratio tracking with the choices min, mean, max and robust of a
/// constant control, `samples` (>= 2) estimates a pixel, without roulette and exact integration,
/// which would hide what is shown. In parallel.
Strip drawStrip(const Source& source, const trk::BakedVolume& baked, bool whole, float scale,
                int width, uint32_t samples);

}  // namespace vdbtools
