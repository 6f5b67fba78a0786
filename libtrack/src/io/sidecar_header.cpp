// SPDX-License-Identifier: Apache-2.0
#include "sidecar_header.h"

#include "../failure.h"
#include "density_types.h"
#include "sidecar_schema.h"

#include <cstdio>
#include <cstdlib>

namespace trk {

using namespace schema;

namespace {

int metaNumber(const openvdb::GridBase& grid, const char* name, const std::string& where) {
    const auto meta = grid.getMetadata<openvdb::Int32Metadata>(name);
    if (!meta) {
        badSidecar(where, std::string("no metadata ") + name + "; not a sidecar of this tool");
    }
    return meta->value();
}

/// The grid whose name ends in _control; others are found from its prefix.
const VdbEntry* findControl(const VdbFile& file) {
    const std::string suffix = kControlSuffix;
    for (const VdbEntry& entry : file.entries()) {
        if (entry.name.size() > suffix.size() &&
            entry.name.compare(entry.name.size() - suffix.size(), suffix.size(), suffix) == 0) {
            return &entry;
        }
    }
    return nullptr;
}

std::string label(const GridIdentity& grid) {
    return "\"" + grid.name + "\"[" + std::to_string(grid.index) + "]";
}

}  // namespace

void badSidecar(const std::string& where, const std::string& what) {
    throw Error(TRK_ERROR_BAD_FILE, where + ": " + what);
}

std::string metaText(const openvdb::GridBase& grid, const char* name, const std::string& where) {
    const auto meta = grid.getMetadata<openvdb::StringMetadata>(name);
    if (!meta) {
        badSidecar(where, std::string("no metadata ") + name + "; not a sidecar of this tool");
    }
    return meta->value();
}

void checkFormat(const openvdb::GridBase& grid, const std::string& where) {
    const std::string format = metaText(grid, "track_format", where);
    const int major = std::atoi(format.c_str());
    if (major > kFormatMajor) {
        throw Error(TRK_ERROR_SIDECAR_MISMATCH, where + ": sidecar format " + format +
                                                    "; this build reads up to " + kFormat +
                                                    "; bake again, or use a newer vdbtrack");
    }
    if (major < 1) {
        badSidecar(where, "sidecar format is \"" + format + "\"; expected " + kFormat);
    }
}

SidecarHeader readHeader(VdbFile& file) {
    const VdbEntry* control = findControl(file);
    if (!control) {
        badSidecar(file.path(),
                   "no grid …_control; expected a sidecar; the file has " + file.listing());
    }
    const std::string where = file.path() + ": grid " + control->name;
    const openvdb::GridBase::Ptr grid = file.readMetadata(*control);
    if (!grid) {
        badSidecar(where, "has the unknown type " + control->type);
    }
    checkFormat(*grid, where);
    SidecarHeader header;
    header.toolVersion = metaText(*grid, "track_tool_version", where);
    header.sourceFile = metaText(*grid, "track_source_file", where);
    header.source.name = metaText(*grid, "track_source_grid", where);
    header.source.index = metaNumber(*grid, "track_source_index", where);
    header.digest =
        std::strtoull(metaText(*grid, "track_source_digest", where).c_str(), nullptr, 16);
    header.superVoxelSize = metaNumber(*grid, "track_super_voxel_size", where);
    header.levels = metaNumber(*grid, "track_levels", where);
    header.valueType = grid->valueType();
    const int size = header.superVoxelSize;
    if (size < 4 || size > 64 || (size & (size - 1)) != 0) {
        badSidecar(where, "super-voxel size " + std::to_string(size) +
                              "; expected a power of two from 4 to 64");
    }
    if (header.levels < 0 || header.levels > 8) {
        badSidecar(where, std::to_string(header.levels) + " levels; expected 0 to 8");
    }
    const std::string kind = metaText(*grid, "track_control", where);
    const std::string interpolation = metaText(*grid, "track_interpolation", where);
    bool known = false;
    for (const ControlKind k :
         {ControlKind::kConstant, ControlKind::kTrilinear, ControlKind::kAffine}) {
        if (kind == controlName(k)) {
            header.controlKind = k;
            known = true;
        }
    }
    if (!known || interpolation != kInterpolation) {
        throw Error(TRK_ERROR_SIDECAR_MISMATCH,
                    where + ": control \"" + kind + "\" of interpolation \"" + interpolation +
                        "\"; this build reads constant, trilinear and affine controls of "
                        "trilinear fields");
    }
    if (channelCount(header.valueType) == 0) {
        badSidecar(where,
                   "is of type " + header.valueType + "; expected float, double, vec3s or vec3d");
    }
    if (const auto meta = grid->getMetadata<openvdb::Int64Metadata>("track_dropped_nonfinite")) {
        header.repair |= TRK_REPAIR_DROP_NONFINITE;
        header.dropped = static_cast<uint64_t>(meta->value());
    }
    if (const auto meta = grid->getMetadata<openvdb::Int64Metadata>("track_clamped_negative")) {
        header.repair |= TRK_REPAIR_CLAMP_NEGATIVE;
        header.clamped = static_cast<uint64_t>(meta->value());
    }
    const bool atCorners = header.controlKind == ControlKind::kTrilinear;
    header.indexToWorld = sourceMap(affineMap(grid->constTransform(), where), size,
                                    atCorners ? 0 : centreOffset(size));
    return header;
}

void checkAgainst(const SidecarHeader& header, const DensitySummary& density, TrkCheck check,
                  const std::string& path) {
    const auto mismatch = [&](const std::string& sidecarHas, const std::string& densityHas) {
        throw Error(TRK_ERROR_SIDECAR_MISMATCH, path + ": " + sidecarHas + ", but " + density.path +
                                                    " " + densityHas +
                                                    "; bake it again, or name the right sidecar");
    };
    if (header.source.name != density.grid.name || header.source.index != density.grid.index) {
        mismatch("baked from grid " + label(header.source),
                 "was opened at grid " + label(density.grid));
    }
    if (header.valueType != density.valueType) {
        mismatch("baked from a " + header.valueType + " grid",
                 "holds a " + density.valueType + " grid");
    }
    if (!sameMap(density.indexToWorld, header.indexToWorld)) {
        const auto describe = [](const AffineMap& map) {
            char text[160];
            std::snprintf(text, sizeof(text), "voxels of %g x %g x %g at (%g, %g, %g)",
                          length(map.column(0)), length(map.column(1)), length(map.column(2)),
                          map.translation[0], map.translation[1], map.translation[2]);
            return std::string(text);
        };
        mismatch("baked with another transform (" + describe(header.indexToWorld) + ")",
                 "has " + describe(density.indexToWorld));
    }
    if (check == TRK_CHECK_FULL && header.digest != density.digest) {
        mismatch("baked from other voxels (digest " + hexDigest(header.digest) + ")",
                 "has digest " + hexDigest(density.digest));
    }
}

bool isSidecar(const std::string& path) {
    VdbFile file(path);
    const VdbEntry* control = findControl(file);
    const openvdb::GridBase::Ptr grid = control ? file.readMetadata(*control) : nullptr;
    return grid && grid->getMetadata<openvdb::StringMetadata>("track_format");
}

SidecarHeader readSidecarHeader(const std::string& path) {
    VdbFile file(path);
    return readHeader(file);
}

}  // namespace trk
