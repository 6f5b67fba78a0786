// SPDX-License-Identifier: Apache-2.0
// A way to estimate transmittance: a method with all it depends on.
#pragma once

#include "control/control_shape.h"
#include "query/methods.h"
#include "track/track.h"

#include <string>
#include <vector>

namespace vdbtools {

/// A way to estimate. What a method has no use for is 0.
struct Way {
    TrkMethod method = TRK_METHOD_EXACT;
    trk::ControlKind kind = trk::ControlKind::kConstant;
    TrkChoice choice = TRK_CHOICE_ROBUST;
    int size = 0;     ///< of super-voxels, in voxels; kWholeVolume: one over everything
    double rate = 1;  ///< of residual, ratio and delta; of march and comb: voxels a step

    static constexpr int kWholeVolume = -1;

    const trk::MethodTraits& traits() const { return trk::traitsOf(method); }
    bool usesControl() const { return traits().usesControl; }
    bool usesChoice() const { return traits().usesChoice(); }
    bool usesSuperVoxels() const { return traits().usesSuperVoxels; }
    bool isUnbiased() const { return traits().isUnbiased; }
    bool isRandom() const { return traits().isRandom; }
};
bool operator==(const Way& a, const Way& b);

/// "residual, affine robust, size 8, rate 1".
std::string nameOf(const Way& way);

/// The ways that `vdbtrack measure` compares by default, from what may vary.
std::vector<Way> sweepWays(const std::vector<TrkMethod>& methods,
                           const std::vector<trk::ControlKind>& kinds,
                           const std::vector<TrkChoice>& choices, const std::vector<int>& sizes,
                           const std::vector<double>& rates);

}  // namespace vdbtools
