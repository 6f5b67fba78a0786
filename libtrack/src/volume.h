// SPDX-License-Identifier: Apache-2.0
// An opened volume: everything a query reads, immutable.
#pragma once

#include "extinction_field.h"
#include "math.h"
#include "super_voxels.h"

#include <algorithm>
#include <array>
#include <cstddef>
#include <cstdint>
#include <string>
#include <vector>

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
    /// Extinction of a density of 1, per channel of the extinction: one or three. Three for
    /// densities of three channels, and for those of one with a tint.
    std::vector<double> scales{1.0};

    bool hasDensity = false;
    ExtinctionField field;  ///< density

    bool hasSuperVoxels = false;
    SuperVoxels superVoxels;

    GridIdentity grid;
    std::string sidecarPath;  ///< the sidecar, or where it was looked for
    uint64_t activeVoxels = 0;

    size_t channels() const { return scales.size(); }
    size_t bytes() const { return sizeof(*this) + field.bytes() + superVoxels.bytes(); }

    /// Clips a world-space ray against a box of local space. False where nothing is left. The
    /// result starts at t = 0 inside the box; `lengthPerVoxel` is the world length of a voxel
    /// length.
    bool clip(const TrkRay& ray, const IntBox& box, LocalRay& local, double& lengthPerVoxel) const;
};

/// The extinction of an opened volume, of C channels, from a density of F.
template <size_t F, size_t C>
class VolumeExtinction {
  public:
    static constexpr size_t kChannels = C;

    explicit VolumeExtinction(const Volume& volume) : field_(volume.field) {
        std::copy_n(volume.scales.begin(), C, scales_.begin());
    }

    std::array<double, C> extinction(const Vec3d& point) const {
        return scaled(field_.density<F>(point));
    }
    /// Over [t0, t1] of the ray, times the length of a voxel.
    std::array<double, C> integrate(const LocalRay& ray, double t0, double t1, uint64_t& lookups,
                                    uint64_t& regions) const {
        return scaled(field_.integrate<F>(ray, t0, t1, lookups, regions));
    }

  private:
    template <class T>
    std::array<double, C> scaled(const std::array<T, F>& density) const {
        std::array<double, C> result;
        for (size_t c = 0; c < C; ++c) {
            result[c] = scales_[c] * static_cast<double>(density[F == 1 ? 0 : c]);
        }
        return result;
    }

    const ExtinctionField& field_;
    std::array<double, C> scales_;
};

struct VolumeOptions {
    std::string gridName;
    bool gridNamed = false;
    float scale = 1;
    std::array<float, 3> color{{1, 1, 1}};
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
