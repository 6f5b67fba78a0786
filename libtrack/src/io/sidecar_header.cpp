// SPDX-License-Identifier: Apache-2.0
#include "sidecar_header.h"

#include "density_types.h"
#include "failure.h"
#include "sidecar_schema.h"

#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <limits>

namespace trk {

using namespace schema;

namespace {

int metaNumber(const VdbMetadata& metadata, const char* name, const std::string& where) {
    const auto number = metadata.int32(name);
    if (!number) {
        badSidecar(where, std::string("no metadata ") + name + "; not a sidecar of this tool");
    }
    return *number;
}

bool hasSuffix(const std::string& name, const std::string& suffix) {
    return name.size() > suffix.size() &&
           name.compare(name.size() - suffix.size(), suffix.size(), suffix) == 0;
}

/// The grid whose name ends in _control, of the sidecar of `source` where the file has several;
/// others are found from its prefix.
const VdbEntry* findControl(VdbFile& file, const GridIdentity* source) {
    const VdbEntry* first = nullptr;
    for (const VdbEntry& entry : file.entries()) {
        if (!hasSuffix(entry.name, kControlSuffix)) {
            continue;
        }
        first = first ? first : &entry;
        if (!source) {
            break;
        }
        const VdbMetadata metadata = file.readHeader(entry).metadata;
        if (metadata.text("track_source_grid") == source->name &&
            metadata.int32("track_source_index") == source->index) {
            return &entry;
        }
    }
    return first;
}

std::string label(const GridIdentity& grid) {
    return "\"" + grid.name + "\"[" + std::to_string(grid.index) + "]";
}

}  // namespace

void badSidecar(const std::string& where, const std::string& what) {
    throw Error(TRK_ERROR_BAD_FILE, where + ": " + what);
}

std::string metaText(const VdbMetadata& metadata, const char* name, const std::string& where) {
    const auto text = metadata.text(name);
    if (!text) {
        badSidecar(where, std::string("no metadata ") + name + "; not a sidecar of this tool");
    }
    return *text;
}

void checkFormat(const VdbMetadata& metadata, const std::string& where) {
    const std::string format = metaText(metadata, "track_format", where);
    const int major = std::atoi(format.c_str());
    if (major < 1) {
        badSidecar(where, "sidecar format is \"" + format + "\"; expected " + kFormat);
    }
    if (major != kFormatMajor) {
        throw Error(TRK_ERROR_SIDECAR_MISMATCH,
                    where + ": sidecar format " + format + "; this build reads " + kFormat +
                        "; bake again" + (major > kFormatMajor ? ", or use a newer version" : ""));
    }
}

SidecarHeader readHeader(VdbFile& file, const GridIdentity* source) {
    const VdbEntry* control = findControl(file, source);
    if (!control) {
        badSidecar(file.path(),
                   "no grid …_control; expected a sidecar; the file has " + file.listing());
    }
    const std::string where = file.path() + ": grid " + control->name;
    const VdbGridHeader grid = file.readHeader(*control);
    const VdbMetadata& metadata = grid.metadata;
    checkFormat(metadata, where);
    SidecarHeader header;
    header.prefix = control->name.substr(0, control->name.size() - std::strlen(kControlSuffix));
    header.format = metaText(metadata, "track_format", where);
    header.toolVersion = metaText(metadata, "track_tool_version", where);
    header.sourceFile = metaText(metadata, "track_source_file", where);
    header.source.name = metaText(metadata, "track_source_grid", where);
    header.source.index = metaNumber(metadata, "track_source_index", where);
    header.digest =
        std::strtoull(metaText(metadata, "track_source_digest", where).c_str(), nullptr, 16);
    header.superVoxelSize = metaNumber(metadata, "track_super_voxel_size", where);
    header.levels = metaNumber(metadata, "track_levels", where);
    header.previewSize = metaNumber(metadata, "track_preview_size", where);
    header.previewScale = metadata.real("track_preview_scale").value_or(1);
    const auto origin = metadata.vec3d("track_origin");
    header.sourceBytes = static_cast<uint64_t>(metadata.int64("track_source_bytes").value_or(0));
    header.sourceModified = metadata.int64("track_source_modified").value_or(0);
    header.valueType = valueTypeName(control->type);
    const int size = header.superVoxelSize;
    if (size < 4 || size > 64 || (size & (size - 1)) != 0) {
        badSidecar(where, "super-voxel size " + std::to_string(size) +
                              "; expected a power of two from 4 to 64");
    }
    if (header.levels < 0 || header.levels > 8) {
        badSidecar(where, std::to_string(header.levels) + " levels; expected 0 to 8");
    }
    const int preview = header.previewSize;
    if (preview < 0 || preview >= size || (preview & (preview - 1)) != 0) {
        badSidecar(where, "cubes of " + std::to_string(preview) +
                              " voxels for pictures; expected a power of two below the "
                              "super-voxels' " +
                              std::to_string(size) + ", or 0");
    }
    if (!(header.previewScale >= 0) || !std::isfinite(header.previewScale)) {
        badSidecar(where, "a scale for pictures of " + std::to_string(header.previewScale) +
                              "; expected a finite number >= 0");
    }
    for (int a = 0; a < 3; ++a) {
        const double x = origin ? (*origin)[a] : std::numeric_limits<double>::quiet_NaN();
        if (!(std::fabs(x) < 0x1p33) || x != std::floor(x) ||
            (static_cast<int64_t>(x) & (size - 1)) != 0) {
            badSidecar(where,
                       "no metadata track_origin that is a multiple of the super-voxels' size");
        }
        header.origin[static_cast<size_t>(a)] = static_cast<int64_t>(x);
    }
    const std::string kind = metaText(metadata, "track_control", where);
    const std::string interpolation = metaText(metadata, "track_interpolation", where);
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
    if (channelCount(header.valueType) == 0 || control->type != treeTypeName(header.valueType)) {
        badSidecar(where,
                   "is of type " + header.valueType + "; expected float, double, vec3s or vec3d");
    }
    if (const auto dropped = metadata.int64("track_dropped_nonfinite")) {
        header.repair |= TRK_REPAIR_DROP_NONFINITE;
        header.dropped = static_cast<uint64_t>(*dropped);
    }
    if (const auto clamped = metadata.int64("track_clamped_negative")) {
        header.repair |= TRK_REPAIR_CLAMP_NEGATIVE;
        header.clamped = static_cast<uint64_t>(*clamped);
    }
    const bool atCorners = header.controlKind == ControlKind::kTrilinear;
    header.indexToWorld = sourceMap(affineMap(*grid.transform, where), header.origin, size,
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
    const VdbEntry* control = findControl(file, nullptr);
    return control && file.readHeader(*control).metadata.text("track_format");
}

SidecarHeader readSidecarHeader(const std::string& path, const GridIdentity* source) {
    VdbFile file(path);
    return readHeader(file, source);
}

}  // namespace trk
