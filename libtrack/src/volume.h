// SPDX-License-Identifier: Apache-2.0
// An opened volume: everything a query reads, immutable.
#pragma once

#include "control/control_choice.h"
#include "control/super_voxels.h"
#include "field/density_field.h"
#include "kernel.h"
#include "space/geometry.h"

#include <algorithm>
#include <array>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <optional>
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

struct BakeOptions;
struct DensitySummary;

/// A grid's place in its file, as sidecars record it.
struct GridIdentity {
    std::string name;
    int index = 0;  ///< among the grids of equal name
};

/// The part of a world-space ray that lies in a box, in local space. `local` starts at t = 0.
struct ClippedRay {
    LocalRay local;
    double lengthPerVoxel = 1;  ///< world length of a voxel length along the ray
    double tStart = 0;          ///< the world-space ray's own parameter at local t = 0
    double tPerVoxel = 1;
};

struct VolumeOptions {
    std::string gridName;
    bool gridNamed = false;
    float scale = 1;
    std::array<float, 3> color{{1, 1, 1}};
    TrkChoice choice = TRK_CHOICE_ROBUST;
    bool global = false;
    TrkCheck check = TRK_CHECK_FULL;
    bool bakeMissing = false;  ///< where there is no sidecar, bake in memory
    uint32_t repair = 0;
    uint64_t maxMemory = 0;
    Kernel kernel = kDefaultKernel;
    int superVoxelSize = 0;  ///< that queries use, made of those baked; 0: as baked
};

struct Volume {
    VolumeOptions options;  ///< it was opened with
    AffineMap indexToWorld;
    AffineMap worldToIndex;
    Int3 anchor{{0, 0, 0}};
    /// Extinction of a density of 1, per channel of the extinction: one or three. Three for
    /// densities of three channels, and for those of one with a tint.
    std::vector<double> scales{1.0};

    /// The density, which several volumes may share, and what is known of its grid; NULL where only
    /// a sidecar is open.
    std::shared_ptr<const DensityField> field;
    std::shared_ptr<const DensitySummary> density;

    /// What was baked, which several volumes may share; NULL where nothing was.
    std::shared_ptr<const SuperVoxels> superVoxels;
    /// One over everything, where that was asked for.
    std::shared_ptr<const SuperVoxels> globalSuperVoxel;
    ControlChoice controlChoice;  ///< of those that are tracked

    GridIdentity grid;
    std::string sidecarPath;  ///< the sidecar, or where it was looked for
    uint64_t activeVoxels = 0;

    bool hasDensity() const { return field != nullptr; }
    bool hasSuperVoxels() const { return superVoxels != nullptr; }
    size_t channels() const { return scales.size(); }
    size_t densityChannels() const {
        return hasDensity() ? field->channels() : superVoxels->channels();
    }
    /// What the random methods walk over; control and levels are those of `superVoxels`.
    const SuperVoxels& tracked() const {
        return globalSuperVoxel ? *globalSuperVoxel : *superVoxels;
    }
    size_t bytes() const {
        return sizeof(*this) + (field ? field->bytes() : 0) +
               (superVoxels ? superVoxels->bytes() : 0) +
               (globalSuperVoxel ? globalSuperVoxel->bytes() : 0);
    }

    /// Clips a world-space ray against a box of local space. Nothing where nothing is left.
    std::optional<ClippedRay> clip(const TrkRay& ray, const IntBox& box) const;
};

/// The extinction of an opened volume, of C channels, from a density of F.
template <size_t F, size_t C>
class VolumeExtinction {
  public:
    static constexpr size_t kChannels = C;

    explicit VolumeExtinction(const Volume& volume)
        : field_(*volume.field), kernel_(volume.options.kernel) {
        std::copy_n(volume.scales.begin(), C, scales_.begin());
    }

    std::array<double, C> extinction(const Vec3d& point) const {
        return scaled(field_.density<F>(point));
    }
    /// As DensityField's.
    void prefetchEntry(const Vec3d& point) const { field_.prefetchEntry(point); }
    void prefetchBrick(const Vec3d& point) const { field_.prefetchBrick(point); }
    /// Over [t0, t1] of the ray, times the length of a voxel.
    std::array<double, C> integrate(const LocalRay& ray, double t0, double t1, uint64_t& lookups,
                                    uint64_t& regions) const {
        return scaled(field_.integrate<F>(ray, t0, t1, kernel_, lookups, regions));
    }
    /// Adds the extinction at the points of some combs in [t0, t1), `points` each, to `sums`; how
    /// many points that are. See DensityField.
    uint64_t addSamples(const LocalRay& ray, double t0, double t1, double points,
                        const double* offsets, size_t combs, std::array<double, C>* sums) const {
        std::array<double, F> densities[DensityField::kMostCombs];
        std::fill_n(densities, combs, std::array<double, F>{});
        const uint64_t count =
            field_.addSamples<F>(ray, t0, t1, kernel_, points, offsets, combs, densities);
        for (size_t c = 0; c < C; ++c) {
            for (size_t j = 0; j < combs; ++j) {
                sums[j][c] += scales_[c] * densities[j][F == 1 ? 0 : c];
            }
        }
        return count;
    }
    /// Calls `visit(t0, t1, depth)` for every cell and constant region on the way, until it answers
    /// false. `depth`: integral of the extinction, times the length of a voxel.
    template <class Visit>
    void forEachCell(const LocalRay& ray, double t0, double t1, Visit&& visit) const {
        field_.forEachCell<F>(ray, t0, t1, [&](double tEnter, double tExit, const auto& depth) {
            return visit(tEnter, tExit, scaled(depth));
        });
    }
    /// Calls `visit(constant, t0, t1)` for every brick and constant region on the way, until it
    /// answers false. `constant`: the extinction in a constant region, NULL in a brick.
    template <class Visit>
    void forEachRegion(const LocalRay& ray, double t0, double t1, Visit&& visit) const {
        field_.table().walk(
            ray, t0, t1,
            [&](SparseTable::Entry entry, const Int3&, int, double tEnter, double tExit) {
                if (!DensityField::isConstant(entry)) {
                    return visit(static_cast<const std::array<double, C>*>(nullptr), tEnter, tExit);
                }
                std::array<float, F> density;
                std::copy_n(field_.constant(entry), F, density.begin());
                const std::array<double, C> constant = scaled(density);
                return visit(&constant, tEnter, tExit);
            });
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

    const DensityField& field_;
    Kernel kernel_;
    std::array<double, C> scales_;
};

/// A volume of a density in memory, without super-voxels. Throws Error where the options' scale is
/// too large for it.
Volume makeVolume(const DensitySummary& summary, std::shared_ptr<const DensityField> field,
                  const VolumeOptions& options);

/// Gives a volume the super-voxels of a bake. `where` names the bake in errors. Throws Error.
void addSuperVoxels(Volume& volume, BakedVolume baked, const VolumeOptions& options,
                    const std::string& where);

/// As trkOpenVolume: `vdbPath` may be NULL, `sidecarPath` NULL or empty. Throws Error.
Volume openVolume(const char* vdbPath, const char* sidecarPath, const VolumeOptions& options);

/// As trkMakeVolume. Throws Error.
Volume makeVolume(const TrkDensity& density, const VolumeOptions& options);

/// As trkBakeVolume: `path` may be NULL. Throws Error, and the volume is as it was.
void bakeVolume(Volume& volume, BakeOptions options, const char* path, bool overwrite);

/// NAME.vdb -> NAME.track.vdb; any other name gets the ending appended.
std::string defaultSidecarPath(const std::string& vdbPath);

}  // namespace trk
