// SPDX-License-Identifier: Apache-2.0
// vdbtrack info: what a .vdb file or a sidecar holds.
#include "command_line.h"

#include "bake/bake.h"
#include "failure.h"
#include "io/density.h"
#include "io/density_types.h"
#include "io/sidecar.h"
#include "io/sidecar_schema.h"
#include "io/vdb_file.h"
#include "kernel.h"

#include <nlohmann/json.hpp>

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <cstring>
#include <iostream>
#include <iterator>
#include <sstream>
#include <vector>

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

/// Source index to world space: three rows of the linear part, then the translation.
std::vector<double> mapOf(const trk::AffineMap& map) {
    std::vector<double> numbers;
    for (const auto& row : map.linear) {
        numbers.insert(numbers.end(), std::begin(row), std::end(row));
    }
    numbers.insert(numbers.end(), std::begin(map.translation), std::end(map.translation));
    return numbers;
}

/// NAME[i], which is of one grid alone.
std::string selectorOf(const trk::VdbEntry& entry) {
    return entry.name + "[" + std::to_string(entry.index) + "]";
}

/// What the voxels of a grid that can be baked say.
void addValues(const std::string& path, const trk::VdbEntry& entry, Json& json) {
    trk::DensityOptions options;
    options.gridNamed = true;
    options.gridName = selectorOf(entry);
    try {
        const trk::Density density = trk::loadDensity(path, options);
        json["active_voxels"] = density.summary.activeVoxels;
        json["min"] = density.summary.min;
        json["max"] = density.summary.max;
        addBounds(json, density.summary.indexToWorld, density.summary.anchor, density.field.box());
        json["openvdb_bytes"] = density.summary.gridBytes;
        json["brick_bytes"] = density.field.bytes();
        json["bricks"] = density.field.brickCount();
        json["kernel"] = trk::kernelName(trk::kDefaultKernel);
        json["brick_storage"] = density.field.isHalf() ? "half" : "float";
        json["can_be_baked"] = true;
    } catch (const trk::Error& e) {
        if (e.status() == TRK_ERROR_BAD_FILE) {  // not a kind of grid, but a damaged file
            throw;
        }
        const std::string where = path + ": grid " + entry.label() + ": ";
        std::string reason = e.what();
        if (reason.compare(0, where.size(), where) == 0) {
            reason.erase(0, where.size());
        }
        json["can_be_baked"] = false;
        json["reason"] = reason;
    }
}

/// What opening and baking a grid will need.
Json estimateOf(const std::string& path, const trk::VdbEntry& entry) {
    trk::DensityOptions options;
    options.gridNamed = true;
    options.gridName = selectorOf(entry);
    const trk::DensityEstimate estimate = trk::estimateDensity(path, options);
    const trk::BakeEstimate bake = trk::estimateBake(estimate.field, {});
    Json json;
    json["leaves"] = estimate.leaves;
    json["tiles"] = estimate.tiles;
    json["bricks"] = estimate.bricks;
    json["open_bytes"] = estimate.heldBytes;
    json["open_peak_bytes"] = estimate.peakBytes;
    json["super_voxels"] = bake.superVoxels;
    const uint64_t inMemory = std::max(estimate.peakBytes, estimate.heldBytes + bake.bytes);
    json["bake_bytes"] = inMemory;
    json["least_bake_bytes"] = std::min(inMemory, estimate.loaderBytes + bake.bytes);
    return json;
}

/// What is to be said of grids beside their headers.
struct Wanted {
    bool values = false;
    bool estimate = false;
};

/// One grid.
Json describeGrid(trk::VdbFile& file, const trk::VdbEntry& entry, const Wanted& wanted) {
    Json json;
    json["grid"] = entry.rawLabel();
    json["type"] = entry.type;
    json["stored_as_half"] = entry.half;
    json["compression"] = entry.compressionName();
    const trk::VdbGridHeader grid = file.readHeader(entry);
    json["class"] = grid.gridClass();
    const openvdb::Vec3d size = grid.transform->voxelSize();
    json["voxel_size"] = {size.x(), size.y(), size.z()};
    // Metadata may lie: these are what the file claims.
    const auto lo = grid.metadata.vec3i("file_bbox_min");
    const auto hi = grid.metadata.vec3i("file_bbox_max");
    const auto count = grid.metadata.int64("file_voxel_count");
    if (lo && hi) {
        json["claimed_index_box"] = {(*lo)[0], (*lo)[1], (*lo)[2], (*hi)[0], (*hi)[1], (*hi)[2]};
    }
    if (count) {
        json["claimed_active_voxels"] = *count;
    }
    const std::string where = file.path() + ": grid " + entry.label();
    json["can_be_baked"] = nullptr;  // unless its voxels are looked at
    try {
        json["index_to_world"] = mapOf(trk::affineMap(*grid.transform, where));
        trk::checkKind(entry.type, grid.gridClass(), where);
    } catch (const trk::Error& e) {
        json["can_be_baked"] = false;
        json["reason"] = std::string(e.what()).substr(where.size() + 2);
        return json;
    }
    if (wanted.estimate) {
        json["estimate"] = estimateOf(file.path(), entry);
    }
    if (wanted.values) {
        addValues(file.path(), entry, json);
    }
    return json;
}

Json describeSidecar(const std::string& path, bool values) {
    trk::Sidecar sidecar;
    if (values) {
        sidecar = trk::readSidecar(path, nullptr, TRK_CHECK_FULL);
    } else {
        sidecar.header = trk::readSidecarHeader(path);
    }
    const trk::SidecarHeader& header = sidecar.header;
    Json json;
    json["file"] = path;
    json["kind"] = "sidecar";
    json["format"] = header.format;
    json["tool_version"] = header.toolVersion;
    json["source_file"] = header.sourceFile;
    json["source_grid"] = header.source.name;
    json["source_index"] = header.source.index;
    json["source_digest"] = trk::schema::hexDigest(header.digest);
    json["source_bytes"] = header.sourceBytes;
    json["source_modified_ns"] = header.sourceModified;
    json["value_type"] = header.valueType;
    json["control"] = trk::controlName(header.controlKind);
    json["super_voxel_size"] = header.superVoxelSize;
    json["levels"] = header.levels;
    json["preview_size"] = header.previewSize;
    json["preview_scale"] = header.previewScale;
    json["voxel_size"] = {length(header.indexToWorld.column(0)),
                          length(header.indexToWorld.column(1)),
                          length(header.indexToWorld.column(2))};
    json["index_to_world"] = mapOf(header.indexToWorld);
    json["origin"] = header.origin;
    if (header.repair & TRK_REPAIR_DROP_NONFINITE) {
        json["dropped_nonfinite"] = header.dropped;
    }
    if (header.repair & TRK_REPAIR_CLAMP_NEGATIVE) {
        json["clamped_negative"] = header.clamped;
    }
    if (values) {
        const trk::ControlFit fit = trk::measureFit(sidecar.baked);
        json["channels"] = sidecar.baked.channels;
        json["super_voxels"] = sidecar.baked.table.occupiedItems();
        json["residual_rms"] = fit.residualRms;
        json["constant_residual_rms"] = fit.constantRms;
        json["field_rms"] = fit.fieldRms;
        json["control_mass_ratio"] = fit.massRatio;
        json["max_density"] = sidecar.baked.maxDensity();
        addBounds(json, header.indexToWorld, sidecar.anchor, sidecar.baked.table.occupiedBox());
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

/// Control characters would break the lines of a listing.
std::string printable(std::string text) {
    for (char& c : text) {
        c = static_cast<unsigned char>(c) < ' ' || c == 0x7f ? '?' : c;
    }
    return text;
}

/// The map's translation, and that it does more than scale, where it does.
std::string formatMap(const Json& map) {
    char text[96];
    std::snprintf(text, sizeof(text), "origin at (%.6g, %.6g, %.6g)", map[9].get<double>(),
                  map[10].get<double>(), map[11].get<double>());
    bool straight = true;
    for (size_t i = 0; i < 9; ++i) {
        straight = straight && (i % 4 == 0 || map[i].get<double>() == 0);
    }
    return text + std::string(straight ? "" : ", rotated or sheared");
}

void printRow(const char* name, const std::string& value) {
    std::cout << "  " << name << std::string(14 - std::min<size_t>(std::strlen(name), 13), ' ')
              << value << "\n";
}

void printGrid(const Json& grid) {
    std::cout << "\n" << printable(grid["grid"].get<std::string>()) << "\n";
    printRow("type", printable(grid["type"].get<std::string>()) +
                         (grid["stored_as_half"].get<bool>() ? ", half in the file" : ""));
    printRow("compression", grid["compression"].get<std::string>());
    if (grid.contains("class")) {
        printRow("class", grid["class"].get<std::string>());
        printRow("voxel size", formatSize(grid["voxel_size"]));
    }
    if (grid.contains("index_to_world")) {
        printRow("transform", formatMap(grid["index_to_world"]));
    }
    if (grid.contains("claimed_index_box")) {
        const Json& b = grid["claimed_index_box"];
        std::ostringstream box;
        box << "(" << b[0] << ", " << b[1] << ", " << b[2] << ") to (" << b[3] << ", " << b[4]
            << ", " << b[5] << ") in index space";
        if (b[0].get<int>() > b[3].get<int>()) {
            box.str("no box");
            box.seekp(0, std::ios::end);
        }
        if (grid.contains("claimed_active_voxels")) {
            box << ", " << grid["claimed_active_voxels"] << " active voxels";
        }
        printRow("claims", box.str());
    }
    if (grid.contains("active_voxels")) {
        std::ostringstream voxels;
        voxels << grid["active_voxels"] << " active, values " << grid["min"].get<float>() << " to "
               << grid["max"].get<float>();
        printRow("voxels", voxels.str());
        printRow("bounds", formatBounds(grid));
        printRow("memory", byteCount(grid["brick_bytes"]) + " as " +
                               grid["brick_storage"].get<std::string>() + " bricks, " +
                               byteCount(grid["openvdb_bytes"]) + " in OpenVDB");
        printRow("kernel", grid["kernel"].get<std::string>() + ", which queries run here");
    }
    if (grid.contains("estimate")) {
        const Json& e = grid["estimate"];
        printRow("structure", e["leaves"].dump() + " leaves and " + e["tiles"].dump() +
                                  " tiles; at most " + e["bricks"].dump() + " bricks");
        printRow("to open", "at most " + byteCount(e["open_bytes"]) + ", " +
                                byteCount(e["open_peak_bytes"]) + " meanwhile");
        const std::string paged = e["least_bake_bytes"] == e["bake_bytes"]
                                      ? ""
                                      : ", or more slowly with --max-memory of " +
                                            byteCount(e["least_bake_bytes"]) + " and more";
        printRow("to bake", "at most " + byteCount(e["bake_bytes"]) + paged + " (" +
                                e["super_voxels"].dump() + " super-voxels of 16^3, constant)");
    }
    printRow("bake", grid["can_be_baked"].is_null() ? "yes, if its values are fit"
                     : grid["can_be_baked"].get<bool>()
                         ? "yes"
                         : "no: " + printable(grid["reason"].get<std::string>()));
}

void printSidecar(const std::string& path, const Json& json) {
    const auto text = [&](const char* key) { return json[key].dump(); };
    std::cout << path << ": sidecar of grid \"" << printable(json["source_grid"].get<std::string>())
              << "\" of " << printable(json["source_file"].get<std::string>()) << "\n";
    printRow("format", json["format"].get<std::string>() + ", baked by vdbtrack " +
                           json["tool_version"].get<std::string>());
    printRow("source", "digest " + json["source_digest"].get<std::string>() + ", " +
                           byteCount(json["source_bytes"]));
    printRow("super-voxels", (json.contains("super_voxels") ? text("super_voxels") + " of " : "") +
                                 text("super_voxel_size") + "^3 voxels, values " +
                                 json["value_type"].get<std::string>());
    printRow("control", json["control"].get<std::string>());
    printRow("levels", text("levels"));
    printRow("pictures",
             (json["preview_size"] == 0 ? "by the control"
                                        : "by means of " + text("preview_size") + "^3 voxels") +
                 ", scale " + text("preview_scale"));
    printRow("voxel size", formatSize(json["voxel_size"]));
    printRow("transform", formatMap(json["index_to_world"]));
    printRow("repaired", formatRepairs(json));
    if (json.contains("super_voxels")) {
        printRow("channels", text("channels"));
        printRow("fit", formatFit(json));
        printRow("bounds", formatBounds(json));
        std::ostringstream density;
        density << "up to " << json["max_density"].get<float>();
        printRow("density", density.str());
    }
}

void run(const Command& command, const std::vector<std::string>& given) {
    po::options_description options("Options");
    options.add_options()("json", po::bool_switch(), "machine-readable")(
        "values", po::bool_switch(),
        "read the voxels too: how many, their range and bounds, memory, and how well a control "
        "fits")("estimate", po::bool_switch(),
                "tell, by its structure alone, what memory opening and baking a density will need");
    const Arguments arguments(command, given, options, {"FILE.vdb"}, 1);
    const std::string path = arguments.text("FILE.vdb");
    const Wanted wanted{arguments.flag("values"), arguments.flag("estimate")};
    Json json;
    if (trk::isSidecar(path)) {
        if (wanted.estimate) {
            throw UsageError("--estimate is of a density, and " + path + " is a sidecar");
        }
        json = describeSidecar(path, wanted.values);
    } else {
        trk::VdbFile file(path);
        json["file"] = path;
        json["kind"] = "density";
        json["version"] = file.header().version;
        json["written_by_openvdb"] = file.header().writtenBy;
        json["creator"] = file.header().creator;
        json["grids"] = Json::array();
        for (const trk::VdbEntry& entry : file.entries()) {
            json["grids"].push_back(describeGrid(file, entry, wanted));
        }
    }
    if (arguments.flag("json")) {
        std::cout << json.dump(2, ' ', false, Json::error_handler_t::replace) << "\n";
        return;
    }
    if (json["kind"] == "sidecar") {
        printSidecar(path, json);
        return;
    }
    const std::string creator = json["creator"];
    std::cout << path << ": " << json["grids"].size()
              << (json["grids"].size() == 1 ? " grid" : " grids") << ", VDB version "
              << json["version"] << ", written by OpenVDB "
              << json["written_by_openvdb"].get<std::string>()
              << (creator.empty() ? "" : ", " + printable(creator)) << "\n";
    for (const Json& grid : json["grids"]) {
        printGrid(grid);
    }
}

}  // namespace

const Command kInfoCommand{"info", "vdbtrack info FILE.vdb [--values] [--estimate] [--json]",
                           "Tells what a .vdb file or a sidecar holds: by its headers, or with "
                           "--values by its voxels too.",
                           run};

}  // namespace apps
