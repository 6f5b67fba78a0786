// SPDX-License-Identifier: Apache-2.0
// vdbtrack info: what a .vdb file or a sidecar holds.
#include "command_line.h"

#include "bake.h"
#include "failure.h"
#include "io/density.h"
#include "io/sidecar.h"
#include "io/vdb_file.h"

#include <nlohmann/json.hpp>

#include <cmath>
#include <cstdio>
#include <iostream>

namespace apps {
namespace {

namespace po = boost::program_options;
using Json = nlohmann::ordered_json;

void addBounds(Json& json, const trk::AffineMap& map, const trk::Int3& anchor,
               const trk::IntBox& box) {
    double lo[3];
    double hi[3];
    trk::worldBounds(map, anchor, box, lo, hi);
    json["bounds_min"] = lo;
    json["bounds_max"] = hi;
}

/// One grid: what its metadata says and, for a grid that can be baked, what its voxels say.
Json describeGrid(trk::VdbFile& file, const trk::VdbEntry& entry) {
    Json json;
    json["grid"] = entry.label();
    json["type"] = entry.type;
    const openvdb::GridBase::Ptr grid = file.readMetadata(entry);
    if (!grid) {
        json["can_be_baked"] = false;
        json["reason"] = "unknown type";
        return json;
    }
    json["class"] = openvdb::GridBase::gridClassToString(grid->getGridClass());
    const openvdb::Vec3d size = grid->voxelSize();
    json["voxel_size"] = {size.x(), size.y(), size.z()};
    json["stored_as_half"] = entry.half;
    trk::DensityOptions options;
    options.gridNamed = true;
    options.gridName = entry.name + "[" + std::to_string(entry.index) + "]";
    try {
        const trk::Density density = trk::loadDensity(file.path(), options);
        json["active_voxels"] = density.summary.activeVoxels;
        json["min"] = density.summary.min;
        json["max"] = density.summary.max;
        addBounds(json, density.summary.indexToWorld, density.summary.anchor, density.field.box());
        json["openvdb_bytes"] = density.summary.gridBytes;
        json["brick_bytes"] = density.field.bytes();
        json["bricks"] = density.field.brickCount();
        json["brick_storage"] = density.field.isHalf() ? "half" : "float";
        json["can_be_baked"] = true;
    } catch (const trk::Error& e) {
        if (e.status() == TRK_ERROR_BAD_FILE) {  // not a kind of grid, but a damaged file
            throw;
        }
        const std::string where = file.path() + ": grid " + entry.label() + ": ";
        std::string reason = e.what();
        if (reason.compare(0, where.size(), where) == 0) {
            reason.erase(0, where.size());
        }
        json["can_be_baked"] = false;
        json["reason"] = reason;
    }
    return json;
}

Json describeSidecar(const std::string& path) {
    const trk::Sidecar sidecar = trk::readSidecar(path, nullptr, TRK_CHECK_FULL);
    const trk::SidecarHeader& header = sidecar.header;
    Json json;
    json["file"] = path;
    json["kind"] = "sidecar";
    json["source_file"] = header.sourceFile;
    json["source_grid"] = header.source.name;
    json["source_index"] = header.source.index;
    json["tool_version"] = header.toolVersion;
    json["channels"] = sidecar.baked.channels;
    json["control"] = trk::controlName(header.controlKind);
    const vdbtools::ControlFit fit = vdbtools::measureFit(sidecar.baked);
    json["residual_rms"] = fit.residualRms;
    json["constant_residual_rms"] = fit.constantRms;
    json["field_rms"] = fit.fieldRms;
    json["control_mass_ratio"] = fit.massRatio;
    json["super_voxel_size"] = header.superVoxelSize;
    json["super_voxels"] = sidecar.baked.table.occupiedItems();
    json["levels"] = header.levels;
    json["voxel_size"] = {length(header.indexToWorld.column(0)),
                          length(header.indexToWorld.column(1)),
                          length(header.indexToWorld.column(2))};
    addBounds(json, header.indexToWorld, sidecar.anchor, sidecar.baked.table.occupiedBox());
    json["max_density"] = sidecar.baked.maxDensity();
    if (header.repair & TRK_REPAIR_DROP_NONFINITE) {
        json["dropped_nonfinite"] = header.dropped;
    }
    if (header.repair & TRK_REPAIR_CLAMP_NEGATIVE) {
        json["clamped_negative"] = header.clamped;
    }
    return json;
}

std::string formatBounds(const Json& json) {
    char text[160];
    const Json& lo = json["bounds_min"];
    const Json& hi = json["bounds_max"];
    std::snprintf(text, sizeof(text), "(%.6g, %.6g, %.6g) to (%.6g, %.6g, %.6g)",
                  lo[0].get<double>(), lo[1].get<double>(), lo[2].get<double>(),
                  hi[0].get<double>(), hi[1].get<double>(), hi[2].get<double>());
    return text;
}

std::string formatRepairs(const Json& json) {
    std::string text;
    if (json.contains("dropped_nonfinite")) {
        text += std::to_string(json["dropped_nonfinite"].get<uint64_t>()) +
                " values that were not finite read as 0 ";
    }
    if (json.contains("clamped_negative")) {
        text +=
            std::to_string(json["clamped_negative"].get<uint64_t>()) + " negative values read as 0";
    }
    return text.empty() ? "nothing" : text;
}

/// What the control leaves of the density, in numbers.
std::string formatFit(const Json& json) {
    const double residual = json["residual_rms"];
    const double field = json["field_rms"];
    const double constant = json["constant_residual_rms"];
    if (field == 0) {
        return "nothing to fit";
    }
    char text[160];
    std::snprintf(text, sizeof(text), "residual RMS %.4g, %.3g %% of the density's %.4g", residual,
                  100 * residual / field, field);
    std::string line = text;
    if (json["control"] != "constant" && constant > 0) {
        std::snprintf(text, sizeof(text), "; a constant control leaves %.3g %%; mass kept %.4g %%",
                      100 * constant / field, 100 * json["control_mass_ratio"].get<double>());
        line += text;
    }
    return line;
}

/// 3 numbers as "a x b x c", or once where they agree.
std::string formatSize(const Json& size) {
    char text[96];
    const double x = size[0];
    const double y = size[1];
    const double z = size[2];
    if (x == y && y == z) {
        std::snprintf(text, sizeof(text), "%.6g", x);
    } else {
        std::snprintf(text, sizeof(text), "%.6g x %.6g x %.6g", x, y, z);
    }
    return text;
}

void printGrid(const Json& grid) {
    std::cout << "\n"
              << grid["grid"].get<std::string>() << "\n  type        "
              << grid["type"].get<std::string>()
              << (grid.value("stored_as_half", false) ? ", half in the file" : "") << "\n";
    if (grid.contains("class")) {
        std::cout << "  class       " << grid["class"].get<std::string>() << "\n  voxel size  "
                  << formatSize(grid["voxel_size"]) << "\n";
    }
    if (!grid["can_be_baked"].get<bool>()) {
        std::cout << "  bake        no: " << grid["reason"].get<std::string>() << "\n";
        return;
    }
    std::cout << "  voxels      " << grid["active_voxels"] << " active, values "
              << grid["min"].get<float>() << " to " << grid["max"].get<float>()
              << "\n  memory      " << byteCount(grid["brick_bytes"]) << " as "
              << grid["brick_storage"].get<std::string>() << " bricks, "
              << byteCount(grid["openvdb_bytes"]) << " in OpenVDB\n  bake        yes\n";
}

void run(const Command& command, const std::vector<std::string>& given) {
    po::options_description options("Options");
    options.add_options()("json", po::bool_switch(), "machine-readable");
    const Arguments arguments(command, given, options, {"FILE.vdb"}, 1);
    const std::string path = arguments.text("FILE.vdb");
    if (trk::isSidecar(path)) {
        const Json json = describeSidecar(path);
        if (arguments.flag("json")) {
            std::cout << json.dump(2, ' ', false, Json::error_handler_t::replace) << "\n";
            return;
        }
        std::cout << path << ": sidecar of grid \"" << json["source_grid"].get<std::string>()
                  << "\" of " << json["source_file"].get<std::string>() << "\n"
                  << "  super-voxels  " << json["super_voxels"] << " of "
                  << json["super_voxel_size"] << "^3 voxels\n"
                  << "  channels      " << json["channels"] << "\n"
                  << "  control       " << json["control"].get<std::string>() << "\n"
                  << "  fit           " << formatFit(json) << "\n"
                  << "  levels        " << json["levels"] << "\n"
                  << "  voxel size    " << formatSize(json["voxel_size"]) << "\n"
                  << "  bounds        " << formatBounds(json) << "\n"
                  << "  density       up to " << json["max_density"].get<float>() << "\n"
                  << "  repaired      " << formatRepairs(json) << "\n"
                  << "  baked by      vdbtrack " << json["tool_version"].get<std::string>() << "\n";
        return;
    }
    trk::VdbFile file(path);
    Json json;
    json["file"] = path;
    json["kind"] = "density";
    json["grids"] = Json::array();
    for (const trk::VdbEntry& entry : file.entries()) {
        json["grids"].push_back(describeGrid(file, entry));
    }
    if (arguments.flag("json")) {
        std::cout << json.dump(2, ' ', false, Json::error_handler_t::replace) << "\n";
        return;
    }
    std::cout << path << ": " << file.entries().size()
              << (file.entries().size() == 1 ? " grid\n" : " grids\n");
    for (const Json& grid : json["grids"]) {
        printGrid(grid);
    }
}

}  // namespace

const Command kInfoCommand{"info", "vdbtrack info FILE.vdb [--json]",
                           "Tells what a .vdb file or a sidecar holds.", run};

}  // namespace apps
