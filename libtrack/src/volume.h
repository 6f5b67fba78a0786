// SPDX-License-Identifier: Apache-2.0
// An opened volume: everything a query reads, immutable.
#pragma once

#include "extinction_field.h"
#include "math.h"
#include "super_voxels.h"

#include <cstddef>
#include <cstdint>
#include <string>

namespace trk {

/// Local space is index space relative to an anchor below every voxel that matters, so that local
/// coordinates are small and never negative. Multiples of 2^18 keep it aligned with every node of
/// the density's tree (4096 voxels) and of a tree of super-voxels (4096 x 64 voxels).
inline Int3 anchorFor(const IntBox& indexBox) {
    constexpr int64_t kStep = int64_t{1} << 18;
    Int3 anchor{{0, 0, 0}};
    if (!indexBox.empty()) {
        for (size_t a = 0; a < 3; ++a) {
            anchor[a] = indexBox.lo[a] & ~(kStep - 1);
        }
    }
    return anchor;
}

/// A grid's place in its file, as sidecars record it.
struct GridIdentity {
    std::string name;
    int index = 0;  ///< among the grids of equal name
};

struct Volume {
    AffineMap indexToWorld;
    AffineMap worldToIndex;
    Int3 anchor{{0, 0, 0}};
    float scale = 1;

    bool hasDensity = false;
    ExtinctionField field;  ///< density; extinction = scale x density

    bool hasSuperVoxels = false;
    SuperVoxels superVoxels;

    GridIdentity grid;
    std::string sidecarPath;  ///< the sidecar, or where it was looked for
    uint64_t activeVoxels = 0;

    size_t bytes() const { return sizeof(*this) + field.bytes() + superVoxels.bytes(); }

    /// Clips a world-space ray against a box of local space. False where nothing is left. The
    /// result starts at t = 0 inside the box; `lengthPerVoxel` is the world length of a voxel
    /// length.
    bool clip(const TrkRay& ray, const IntBox& box, LocalRay& local, double& lengthPerVoxel) const;
};

struct VolumeOptions {
    std::string gridName;
    bool gridNamed = false;
    float scale = 1;
    TrkChoice choice = TRK_CHOICE_ROBUST;
    TrkCheck check = TRK_CHECK_FULL;
    uint32_t repair = 0;
    uint64_t maxMemory = 0;
};

/// As trkOpenVolume: `vdbPath` may be NULL, `sidecarPath` NULL or empty. Throws Error.
Volume openVolume(const char* vdbPath, const char* sidecarPath, const VolumeOptions& options);

/// NAME.vdb -> NAME.track.vdb; any other name gets the ending appended.
std::string defaultSidecarPath(const std::string& vdbPath);

}  // namespace trk
