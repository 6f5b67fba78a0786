// SPDX-License-Identifier: Apache-2.0
#include "density.h"

#include "density_types.h"
#include "failure.h"
#include "field_builder.h"
#include "memory_source.h"
#include "tree_bricks.h"
#include "vdb_file.h"
#include "vdb_tree.h"

#include <algorithm>
#include <memory>
#include <sstream>
#include <utility>
#include <vector>

namespace trk {
namespace {

/// Whether a grid may be meant to be a density, by its class.
bool isCandidate(const VdbEntry& entry, const VdbGridHeader& header) {
    const std::string gridClass = header.gridClass();
    switch (channelCount(valueTypeName(entry.type))) {
        case 1:
            return gridClass == "fog volume" || gridClass == "unknown";
        case 3:
            return gridClass == "fog volume";
        default:
            return false;
    }
}

/// The grid asked for, or the only one that can be a density, else "density".
const VdbEntry& choose(VdbFile& file, const DensityOptions& options) {
    if (file.entries().empty()) {
        throw Error(TRK_ERROR_GRID_NOT_FOUND, file.path() + ": the file has no grids");
    }
    if (options.gridNamed) {
        return file.select(options.gridName);
    }
    std::vector<const VdbEntry*> candidates;
    bool hasDensity = false;
    for (const VdbEntry& entry : file.entries()) {
        if (isCandidate(entry, file.readHeader(entry))) {
            candidates.push_back(&entry);
            hasDensity = hasDensity || entry.name == "density";
        }
    }
    if (candidates.size() == 1) {
        return *candidates[0];
    }
    if (hasDensity) {
        return file.select("density");
    }
    if (candidates.empty() && file.entries().size() == 1) {
        return file.entries()[0];  // whose refusal says more than a list of one
    }
    for (const VdbEntry& entry : file.entries()) {
        if (file.readHeader(entry).metadata.text("track_format")) {
            throw Error(TRK_ERROR_GRID_NOT_FOUND,
                        file.path() + ": is a sidecar; expected the density it was baked from");
        }
    }
    throw Error(TRK_ERROR_GRID_NOT_FOUND,
                file.path() +
                    (candidates.empty() ? ": no grid can be a density"
                                        : ": several grids can be the density") +
                    "; choose one by name; the file has " + file.listing());
}

template <class Value>
void checkBackground(const Value& background, const std::string& where) {
    if (!(background == openvdb::zeroVal<Value>())) {
        std::ostringstream line;
        line << where << ": background is " << background
             << "; expected 0, or the extinction has no end";
        throw Error(TRK_ERROR_BAD_DENSITY, line.str());
    }
}

void checkValues(const RegionScan& scan, uint32_t repair, const std::string& where) {
    const auto refuse = [&](const BadValues& bad, const char* kind, const char* repairBit) {
        std::ostringstream line;
        line << where << ": " << bad.count << (bad.count == 1 ? " voxel is " : " voxels are ")
             << kind << ", the first at index (" << bad.first[0] << ", " << bad.first[1] << ", "
             << bad.first[2] << "); expected finite values >= 0 (" << repairBit << " makes them 0)";
        throw Error(TRK_ERROR_BAD_DENSITY, line.str());
    };
    if (scan.nonfinite.count > 0 && !(repair & TRK_REPAIR_DROP_NONFINITE)) {
        refuse(scan.nonfinite, "NaN or infinite as float", "TRK_REPAIR_DROP_NONFINITE");
    }
    if (scan.negative.count > 0 && !(repair & TRK_REPAIR_CLAMP_NEGATIVE)) {
        refuse(scan.negative, "negative", "TRK_REPAIR_CLAMP_NEGATIVE");
    }
}

/// What a pass over a source found, with the repairs allowed. Throws where it is no density.
DensitySummary summaryOf(const RegionScan& scan, uint32_t repair, const std::string& where) {
    checkValues(scan, repair, where);
    DensitySummary summary;
    summary.digest = scan.digest;
    summary.activeVoxels = scan.activeVoxels;
    summary.min = scan.min;
    summary.max = scan.max;
    summary.repair = repair;
    summary.dropped = scan.nonfinite.count;
    summary.clamped = scan.negative.count;
    summary.anchor = anchorFor(scan.box);
    return summary;
}

/// The field of a source, and what was found on the way.
template <class Value>
Density fromSource(RegionSource<Value>& source, uint32_t repair, uint64_t maxMemory,
                   const std::string& where) {
    checkBackground(source.background(), where);
    FieldBuilder<Value> builder(source, maxMemory, where);
    Density density;
    density.summary = summaryOf(builder.scan(), repair, where);
    density.field = builder.build(density.summary.anchor);
    return density;
}

template <class Value>
uint64_t brickBytes(bool half) {
    return DensityField::kBrickVertices * ValueTraits<Value>::kChannels *
           (half ? sizeof(uint16_t) : sizeof(float));
}

/// What a page takes at least: several super-voxels of 64^3.
constexpr uint64_t kLeastPage = uint64_t{12} << 20;

/// Whether the bricks of a tree, and a bake, may have no room.
template <class Value>
bool mayNotFit(const VdbTree<Value>& tree, uint64_t maxMemory) {
    const uint64_t brick = brickBytes<Value>(tree.isHalf());
    // Those beside leaves, and what is made of them.
    return maxMemory > 0 && tree.leafCount() * brick / 2 * 3 + tree.listBytes() > maxMemory;
}

template <class Value>
Density fromTree(std::unique_ptr<VdbFile> file, const VdbEntry& entry,
                 const DensityOptions& options, const std::string& where) {
    auto tree = std::make_unique<VdbTree<Value>>(*file, entry, options.maxMemory);
    const uint64_t gridBytes = tree->openvdbBytes();
    Density density;
    if (options.bricks == Bricks::kAll ||
        (options.bricks == Bricks::kAllThatFit && !mayNotFit(*tree, options.maxMemory))) {
        density = fromSource(*tree, options.repair, options.maxMemory, where);
    } else {
        checkBackground(tree->background(), where);
        checkLeafCount(*tree, where);
        LeafTraits<Value> leaves;
        const bool loads = options.bricks != Bricks::kNone;
        if (loads) {
            leaves.resize(tree->leafCount());
        }
        const RegionScan scan = scanRegions(*tree, loads ? &leaves : nullptr);
        density.summary = summaryOf(scan, options.repair, where);
        if (loads) {
            auto bricks = std::make_unique<TreeBricks<Value>>(
                std::move(file), std::move(tree), std::move(leaves), scan, density.summary.anchor);
            density.field = bricks->field();
            density.loader = std::move(bricks);
            density.pageBytes = std::max(options.maxMemory / 4, kLeastPage);
        }
    }
    density.summary.gridBytes = gridBytes;
    return density;
}

}  // namespace

void checkKind(const std::string& treeType, const std::string& gridClass,
               const std::string& where) {
    const auto refuse = [&](const std::string& found) {
        throw Error(
            TRK_ERROR_UNSUPPORTED_GRID,
            where + ": is " + found + "; expected a fog volume of float, double, vec3s or vec3d");
    };
    const std::string valueType = valueTypeName(treeType);
    if (valueType == "half") {
        refuse("of native halfs, which OpenVDB 13 writes (file version 225)");
    }
    if (channelCount(valueType) == 0 || treeType != treeTypeName(valueType)) {
        refuse("of type " + (channelCount(valueType) == 0 ? valueType : treeType));
    }
    if (gridClass == "level set") {
        refuse("a level set");
    }
    if (gridClass == "staggered") {
        refuse("staggered");
    }
}

Density loadDensity(const std::string& path, const DensityOptions& options) {
    auto file = std::make_unique<VdbFile>(path);
    const VdbEntry& chosen = choose(*file, options);
    const std::string where = path + ": grid " + chosen.label();
    const VdbGridHeader header = file->readHeader(chosen);
    checkKind(chosen.type, header.gridClass(), where);
    const AffineMap map = affineMap(*header.transform, where);
    const VdbEntry entry = chosen;  // a loader takes the file
    const uint64_t fileBytes = file->bytes();
    const int64_t fileModified = file->modified();
    const std::string valueType = valueTypeName(entry.type);
    Density density = withValueType(valueType, [&](auto zero) {
        return fromTree<decltype(zero)>(std::move(file), entry, options, where);
    });
    density.summary.path = path;
    density.summary.fileBytes = fileBytes;
    density.summary.fileModified = fileModified;
    density.summary.grid = {entry.name, entry.index};
    density.summary.label = entry.label();
    density.summary.valueType = valueType;
    density.summary.indexToWorld = map;
    return density;
}

DensityEstimate estimateDensity(const std::string& path, const DensityOptions& options) {
    VdbFile file(path);
    const VdbEntry& entry = choose(file, options);
    const std::string where = path + ": grid " + entry.label();
    checkKind(entry.type, file.readHeader(entry).gridClass(), where);
    DensityEstimate estimate;
    withValueType(valueTypeName(entry.type), [&](auto zero) {
        using Value = decltype(zero);
        const VdbTree<Value> tree(file, entry, options.maxMemory);
        checkLeafCount(tree, where);
        RegionScan scan;
        for (const auto& origin : tree.leafOrigins()) {
            addSupport(origin, 8, scan);
        }
        for (const Tile<Value>& tile : tree.tiles()) {
            scanTile(tile, scan);
        }
        LeafTraits<Value> varied;
        varied.resize(tree.leafCount());
        const Int3 anchor = anchorFor(scan.box);
        BrickPlan<Value> plan(tree, varied, anchor, scan.localBox(anchor));
        const uint64_t brick = brickBytes<Value>(tree.isHalf());
        estimate.leaves = tree.leafCount();
        estimate.tiles = tree.tiles().size();
        estimate.bricks = plan.bricks().size();
        estimate.heldBytes = estimate.bricks * brick + plan.table().bytes();
        estimate.peakBytes =
            estimate.bricks * brick + plan.bytes() + varied.bytes() + tree.listBytes();
        estimate.loaderBytes = TreeBricks<Value>::bytesOf(tree, varied, plan) + kLeastPage;
        estimate.field = {
            ValueTraits<Value>::kChannels, std::move(plan.table()), plan.constants(), {}, {}};
    });
    return estimate;
}

Density makeDensity(const TrkDensity& given, uint32_t repair, uint64_t maxMemory) {
    const std::string name = given.name ? given.name : "density";
    const std::string label = name.empty() ? "[0]" : name;
    const std::string where = "grid " + label + " in memory";
    AffineMap map;
    for (int row = 0; row < 3; ++row) {
        std::copy_n(given.indexToWorld + 3 * row, 3, map.linear[row]);
        map.translation[row] = given.indexToWorld[9 + row];
    }
    checkMap(map, where);
    const std::string component = given.valueType == TRK_VALUE_DOUBLE ? "double" : "float";
    const std::string valueType = given.channels == 1                   ? component
                                  : given.valueType == TRK_VALUE_DOUBLE ? "vec3d"
                                                                        : "vec3s";
    Density density = withValueType(valueType, [&](auto zero) {
        using Value = decltype(zero);
        const auto source = makeMemorySource<Value>(given, where);
        Density made = fromSource(*source, repair, maxMemory, where);
        made.summary.fileBytes =
            source->leafCount() * LeafBatch<Value>::kLeafVoxels * sizeof(Value);
        made.summary.gridBytes = made.summary.fileBytes;
        return made;
    });
    density.summary.path = where;
    density.summary.grid = {name, 0};
    density.summary.label = label;
    density.summary.valueType = valueType;
    density.summary.indexToWorld = map;
    return density;
}

}  // namespace trk
