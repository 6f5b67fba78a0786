// SPDX-License-Identifier: Apache-2.0
#include "volume.h"

#include "bake/bake.h"
#include "bake/coarser.h"
#include "bake/write_bake.h"
#include "failure.h"
#include "io/density.h"
#include "io/sidecar.h"
#include "progress.h"

#include <algorithm>
#include <cmath>
#include <filesystem>
#include <limits>
#include <sstream>
#include <system_error>
#include <utility>

namespace trk {
namespace {

/// Extinction of a density of 1 per channel; one channel where all agree.
std::vector<double> channelScales(const VolumeOptions& options, size_t densityChannels) {
    std::vector<double> scales;
    for (const float color : options.color) {
        scales.push_back(static_cast<double>(options.scale) * static_cast<double>(color));
    }
    if (densityChannels == 1 && scales[0] == scales[1] && scales[1] == scales[2]) {
        scales.resize(1);
    }
    return scales;
}

/// scale x color x density, or control, must stay within float, or every bound made of it is
/// infinite.
void checkScale(const std::vector<double>& scales, const char* what, double largest,
                const std::string& where) {
    const double scale = *std::max_element(scales.begin(), scales.end());
    if (scale * largest > static_cast<double>(std::numeric_limits<float>::max())) {
        std::ostringstream line;
        line << where << ": scale x color " << scale << " x " << what << " " << largest
             << " is more than a float holds; expected at most "
             << std::numeric_limits<float>::max();
        throw Error(TRK_ERROR_INVALID_ARGUMENT, line.str());
    }
}

void checkMemory(uint64_t wanted, uint64_t cap, const std::string& path) {
    if (cap > 0 && wanted > cap) {
        throw Error(TRK_ERROR_OUT_OF_MEMORY,
                    path + ": needs " + std::to_string(wanted) +
                        " bytes, more than maxMemory = " + std::to_string(cap));
    }
}

}  // namespace

std::optional<ClippedRay> Volume::clip(const TrkRay& ray, const IntBox& box) const {
    if (box.empty() || !(ray.tMin < ray.tMax)) {
        return std::nullopt;
    }
    ClippedRay clipped;
    LocalRay& local = clipped.local;
    const Vec3d worldOrigin{{static_cast<double>(ray.origin[0]), static_cast<double>(ray.origin[1]),
                             static_cast<double>(ray.origin[2])}};
    const Vec3d worldDirection{{static_cast<double>(ray.direction[0]),
                                static_cast<double>(ray.direction[1]),
                                static_cast<double>(ray.direction[2])}};
    const Vec3d indexDirection = worldToIndex.vector(worldDirection);
    const double voxelsPerT = length(indexDirection);
    const double tPerVoxel = 1 / voxelsPerT;
    Vec3d origin = worldToIndex.point(worldOrigin);
    double t0 = static_cast<double>(ray.tMin) * voxelsPerT;
    double t1 = static_cast<double>(ray.tMax) * voxelsPerT;
    for (int a = 0; a < 3; ++a) {
        const auto axis = static_cast<size_t>(a);
        origin[a] -= static_cast<double>(anchor[axis]);
        const double d = indexDirection[a] * tPerVoxel;
        local.direction[a] = d;
        const auto lo = static_cast<double>(box.lo[axis]);
        const auto hi = static_cast<double>(box.hi[axis]);
        // A component that cannot cross a voxel within any box counts as 0.
        if (std::fabs(d) < 1e-30) {
            local.direction[a] = 0;
            local.inverse[a] = 1e300;
            if (!(origin[a] >= lo && origin[a] <= hi)) {
                return std::nullopt;
            }
            continue;
        }
        local.inverse[a] = 1 / d;
        const double ta = (lo - origin[a]) * local.inverse[a];
        const double tb = (hi - origin[a]) * local.inverse[a];
        t0 = std::max(t0, std::min(ta, tb));
        t1 = std::min(t1, std::max(ta, tb));
    }
    if (!(t0 < t1)) {
        return std::nullopt;
    }
    for (int a = 0; a < 3; ++a) {
        const auto axis = static_cast<size_t>(a);
        local.origin[a] = std::min(
            std::max(origin[a] + t0 * local.direction[a], static_cast<double>(box.lo[axis])),
            static_cast<double>(box.hi[axis]));
    }
    local.tEnd = t1 - t0;
    clipped.lengthPerVoxel = length(worldDirection) * tPerVoxel;
    clipped.tStart = t0 * tPerVoxel;
    clipped.tPerVoxel = tPerVoxel;
    return clipped;
}

std::string defaultSidecarPath(const std::string& vdbPath) {
    std::filesystem::path path(vdbPath);
    if (path.extension() == ".vdb") {
        path.replace_extension();
    }
    return path.string() + ".track.vdb";
}

Volume makeVolume(const DensitySummary& summary, std::shared_ptr<const DensityField> field,
                  const VolumeOptions& options) {
    Volume volume;
    volume.options = options;
    volume.scales = channelScales(options, field->channels());
    checkScale(volume.scales, "density", static_cast<double>(summary.max), summary.path);
    volume.grid = summary.grid;
    volume.indexToWorld = summary.indexToWorld;
    volume.worldToIndex = summary.indexToWorld.inverse();
    volume.anchor = summary.anchor;
    volume.activeVoxels = summary.activeVoxels;
    volume.field = std::move(field);
    volume.density = std::make_shared<const DensitySummary>(summary);
    return volume;
}

void addSuperVoxels(Volume& volume, BakedVolume baked, const VolumeOptions& options,
                    const std::string& where) {
    if (options.superVoxelSize > 0 && options.superVoxelSize != baked.superVoxelSize()) {
        if (options.superVoxelSize < baked.superVoxelSize()) {
            throw Error(TRK_ERROR_INVALID_ARGUMENT,
                        where + ": super-voxels of " + std::to_string(options.superVoxelSize) +
                            " are smaller than those it was baked with; expected " +
                            std::to_string(baked.superVoxelSize()) + " or more");
        }
        if (baked.kind == ControlKind::kTrilinear) {
            throw Error(TRK_ERROR_INVALID_ARGUMENT,
                        where + ": super-voxels of " + std::to_string(options.superVoxelSize) +
                            " do not follow from a trilinear control; expected 0 or " +
                            std::to_string(baked.superVoxelSize()));
        }
        const uint64_t held = baked.items.size() * sizeof(BakedSuperVoxel) +
                              (baked.gradients.size() + baked.shapes.size()) * sizeof(float) +
                              baked.table.bytes();
        checkMemory(volume.bytes() + held + held / 8, options.maxMemory, where);
        while (baked.superVoxelSize() < options.superVoxelSize) {
            baked = coarser(baked);
        }
    }
    checkScale(volume.scales, "density", static_cast<double>(baked.maxDensity()), where);
    if (baked.kind != ControlKind::kConstant) {
        checkScale(volume.scales, "control (its value or slope)", baked.maxCoefficient(), where);
    }
    const bool constantOnly = options.choice == TRK_CHOICE_MIN || options.choice == TRK_CHOICE_MAX;
    if (options.global && volume.hasDensity()) {
        volume.globalSuperVoxel =
            std::make_shared<const SuperVoxels>(SuperVoxels::whole(baked, volume.field->box()));
    } else if (constantOnly && baked.kind != ControlKind::kConstant) {
        throw Error(TRK_ERROR_INVALID_ARGUMENT,
                    where + ": choice min and max are constant controls, and this sidecar's is " +
                        controlName(baked.kind) + "; expected robust or mean");
    }
    volume.superVoxels = std::make_shared<const SuperVoxels>(std::move(baked));
    Vec3d edges;
    for (int a = 0; a < 3; ++a) {
        const auto axis = static_cast<size_t>(a);
        edges[a] =
            volume.globalSuperVoxel
                ? static_cast<double>(volume.field->box().hi[axis] - volume.field->box().lo[axis])
                : static_cast<double>(volume.superVoxels->size());
    }
    volume.controlChoice = {options.choice, volume.indexToWorld.longestDiagonal(edges)};
}

void bakeInMemory(Volume& volume, const VolumeOptions& options) {
    const Progress::Stage stage(0.8, 1);
    BakeOptions bakeOptions;
    bakeOptions.maxMemory = options.maxMemory;
    bakeOptions.gradients = false;
    if (options.superVoxelSize > 0) {
        bakeOptions.superVoxelSize = options.superVoxelSize;
    }
    bakeOptions.where = volume.density->path;
    addSuperVoxels(volume, bake(*volume.field, bakeOptions), options, volume.density->path);
}

Volume openVolume(const char* vdbPath, const char* sidecarPath, const VolumeOptions& options) {
    const bool named = sidecarPath != nullptr && *sidecarPath != '\0';
    const bool wanted = sidecarPath == nullptr || named;
    std::string path;
    if (named) {
        path = sidecarPath;
    } else if (wanted && vdbPath != nullptr) {
        path = defaultSidecarPath(vdbPath);
    }
    if (vdbPath == nullptr && !named) {
        throw Error(TRK_ERROR_INVALID_ARGUMENT,
                    "neither a density nor a sidecar was named; expected at least one path");
    }
    std::error_code ignored;  // of a name too long, say: then it does not exist
    const bool haveSidecar = named || (wanted && std::filesystem::exists(path, ignored));

    Sidecar sidecar;
    if (haveSidecar) {
        sidecar.header = readSidecarHeader(path);
    }
    // Larger super-voxels follow from gradients, which those of an affine control come with.
    const auto partsOf = [&](const SidecarHeader& header) {
        return options.superVoxelSize > header.superVoxelSize &&
                       header.controlKind == ControlKind::kConstant
                   ? SidecarParts::kAll
                   : SidecarParts::kQueries;
    };
    Volume volume;
    if (vdbPath == nullptr) {
        sidecar =
            readSidecar(path, nullptr, options.check, partsOf(sidecar.header), options.maxMemory);
        volume.options = options;
        volume.grid = sidecar.header.source;
        if (options.gridNamed && options.gridName != volume.grid.name &&
            options.gridName != volume.grid.name + "[" + std::to_string(volume.grid.index) + "]") {
            throw Error(TRK_ERROR_GRID_NOT_FOUND, path + ": no grid \"" + options.gridName +
                                                      "\"; it was baked from grid " +
                                                      volume.grid.name);
        }
        volume.indexToWorld = sidecar.header.indexToWorld;
        volume.worldToIndex = volume.indexToWorld.inverse();
        volume.anchor = sidecar.anchor;
        volume.scales = channelScales(options, sidecar.baked.channels);
    } else {
        DensityOptions densityOptions;
        densityOptions.gridNamed = options.gridNamed;
        densityOptions.gridName = options.gridName;
        densityOptions.repair = options.repair | (haveSidecar ? sidecar.header.repair : 0u);
        densityOptions.maxMemory = options.maxMemory;
        Density density;
        {
            const Progress::Stage reading(0, 0.8);
            density = loadDensity(vdbPath, densityOptions);
        }
        volume =
            makeVolume(density.summary,
                       std::make_shared<const DensityField>(std::move(density.field)), options);
        if (haveSidecar) {
            const SidecarHeader header = readSidecarHeader(path, &density.summary.grid);
            sidecar = readSidecar(path, &density.summary, options.check, partsOf(header),
                                  options.maxMemory);
        }
    }
    volume.sidecarPath = path;
    if (haveSidecar) {
        addSuperVoxels(volume, std::move(sidecar.baked), options, path);
    } else if (options.bakeMissing) {
        bakeInMemory(volume, options);
    }
    checkMemory(volume.bytes(), options.maxMemory, vdbPath ? vdbPath : volume.sidecarPath);
    return volume;
}

Volume makeVolume(const TrkDensity& given, const VolumeOptions& options) {
    Volume volume;
    {
        const Progress::Stage reading(0, 0.8);
        Density density = makeDensity(given, options.repair, options.maxMemory);
        volume =
            makeVolume(density.summary,
                       std::make_shared<const DensityField>(std::move(density.field)), options);
    }
    if (options.bakeMissing) {
        bakeInMemory(volume, options);
    }
    checkMemory(volume.bytes(), options.maxMemory, volume.density->path);
    return volume;
}

void bakeVolume(Volume& volume, BakeOptions options, const char* path, bool overwrite) {
    if (!volume.hasDensity()) {
        throw Error(TRK_ERROR_NO_DENSITY, volume.sidecarPath +
                                              ": opened without its density, which a bake is of; "
                                              "open the density's .vdb");
    }
    std::optional<OutputFile> file;
    if (path) {
        file.emplace(path, overwrite);
        options.sidecarBytes = sidecarLimit(volume.density->fileBytes, options.kind);
    }
    options.gradients = path != nullptr;
    options.where = volume.density->path;
    Volume next = makeVolume(*volume.density, volume.field, volume.options);
    BakedVolume baked;
    {
        const Progress::Stage baking(0, path ? 0.7 : 1);
        baked = bake(*volume.field, options);
    }
    if (file) {
        const Progress::Stage writing(0.7, 1);
        writeBake(*file, *volume.density, *volume.field, baked, options.sidecarBytes);
        next.sidecarPath = path;
    }
    VolumeOptions asBaked = volume.options;
    asBaked.superVoxelSize = 0;
    addSuperVoxels(next, std::move(baked), asBaked, volume.density->path);
    checkMemory(next.bytes(), options.maxMemory, volume.density->path);
    if (file) {
        file->commit();
    }
    volume = std::move(next);
}

}  // namespace trk
