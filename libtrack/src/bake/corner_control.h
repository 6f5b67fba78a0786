// SPDX-License-Identifier: Apache-2.0
// The trilinear control of a density: corner values that super-voxels share.
#pragma once

#include "control_fit.h"
#include "density_parts.h"

#include <cstddef>
#include <cstdint>
#include <optional>
#include <vector>

namespace trk {

/// Fitted over all super-voxels together, in every channel.
class CornerControl {
  public:
    /// `parts`: measured, and distinguished. It must live as long.
    explicit CornerControl(const DensityParts& parts);

    /// The value at a corner (x slowest) of the super-voxel at `origin`.
    float at(const Int3& origin, size_t corner, size_t channel) const;

  private:
    Int3 cornerOf(const Int3& origin, size_t corner) const;
    std::optional<float> given(const Int3& corner, size_t channel) const;
    CornerFit fit(size_t channel) const;

    const DensityParts& parts_;
    std::vector<CornerFit> fits_;  // of each channel
};

}  // namespace trk
