// SPDX-License-Identifier: Apache-2.0
// Statistics, control and preview levels of a density: what a sidecar stores. write_bake.h writes
// one.
#pragma once

#include "control/super_voxels.h"
#include "field/brick_pages.h"
#include "field/density_field.h"

#include <cstdint>
#include <string>

namespace trk {

struct BakeOptions {
    int superVoxelSize = 16;  ///< a power of two from 4 to 64, in voxels
    int levels = 4;           ///< preview levels at most, each of super-voxels twice as large
    ControlKind kind = ControlKind::kConstant;
    /// What the sidecar may take as a file, which decides how fine the means for pictures are; 0:
    /// none are made.
    uint64_t sidecarBytes = 0;
    /// Whether coarser super-voxels are to follow from the bake, by its gradients: a sidecar's
    /// business.
    bool gradients = true;
    std::string where;       ///< begins messages
    uint64_t maxMemory = 0;  ///< what field and bake may take together, in bytes; 0: no limit
};

/// Bakes a field, in parallel. The result has the same bits for any number of threads, with or
/// without tiles in the source, and whether the field holds its bricks. Throws Error: OUT_OF_MEMORY
/// beyond maxMemory.
BakedVolume bake(BrickPages pages, const BakeOptions& options);

/// What a bake takes beside its density, in bytes, by the field's table alone, for so many
/// super-voxels.
struct BakeEstimate {
    uint64_t superVoxels = 0;  ///< that are not alike
    uint64_t bytes = 0;
};
BakeEstimate estimateBake(const DensityField& field, const BakeOptions& options);

/// How well a bake's control fits, over all occupied super-voxels and channels.
struct ControlFit {
    double residualRms = 0;  ///< root mean square of density - control (an upper bound)
    double constantRms = 0;  ///< what a constant control would leave
    double fieldRms = 0;     ///< of the density itself
    double massRatio = 1;    ///< the control's mass over the density's
};
ControlFit measureFit(const BakedVolume& baked);

}  // namespace trk
