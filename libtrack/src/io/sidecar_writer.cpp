// SPDX-License-Identifier: Apache-2.0
#include "sidecar.h"
#include "sidecar_schema.h"
#include "vdb_file.h"
#include "vdb_writer.h"

#include <openvdb/tools/Prune.h>

#include <functional>

namespace trk {

using namespace schema;

namespace {

void addMetadata(openvdb::GridBase& grid, const SidecarHeader& header) {
    const auto text = [&](const char* name, const std::string& value) {
        grid.insertMeta(name, openvdb::StringMetadata(value));
    };
    const auto number = [&](const char* name, int32_t value) {
        grid.insertMeta(name, openvdb::Int32Metadata(value));
    };
    text("track_format", kFormat);
    text("track_tool_version", header.toolVersion);
    text("track_source_file", header.sourceFile);
    text("track_source_grid", header.source.name);
    number("track_source_index", header.source.index);
    text("track_source_digest", hexDigest(header.digest));
    number("track_super_voxel_size", header.superVoxelSize);
    text("track_control", header.controlKind);
    text("track_interpolation", kInterpolation);
    number("track_levels", header.levels);
    if (header.repair & TRK_REPAIR_DROP_NONFINITE) {
        grid.insertMeta("track_dropped_nonfinite",
                        openvdb::Int64Metadata(static_cast<int64_t>(header.dropped)));
    }
    if (header.repair & TRK_REPAIR_CLAMP_NEGATIVE) {
        grid.insertMeta("track_clamped_negative",
                        openvdb::Int64Metadata(static_cast<int64_t>(header.clamped)));
    }
}

template <class GridType>
openvdb::GridBase::Ptr makeGrid(const SparseTable& table, const Int3& anchor,
                                const std::function<float(size_t)>& valueOf) {
    using Value = typename GridType::ValueType;
    auto grid = GridType::create();
    auto accessor = grid->getAccessor();
    const int itemShift = table.itemShift();
    table.forEach([&](const Int3& lo, int shift, SparseTable::Entry entry) {
        Int3 at;
        for (size_t a = 0; a < 3; ++a) {
            at[a] = (anchor[a] + lo[a]) >> itemShift;
        }
        const auto value = static_cast<Value>(valueOf(entry - 1));
        if (shift == itemShift) {
            accessor.setValueOn(toCoord(at), value);
            return;
        }
        const int32_t size = 1 << (shift - itemShift);
        grid->sparseFill(openvdb::CoordBBox::createCube(toCoord(at), size), value, true);
    });
    openvdb::tools::prune(grid->tree());
    return grid;
}

openvdb::GridBase::Ptr makeGrid(const SidecarHeader& header, const SparseTable& table,
                                const Int3& anchor, const std::string& suffix,
                                const std::function<float(size_t)>& valueOf) {
    openvdb::GridBase::Ptr grid = header.valueType == "double"
                                      ? makeGrid<openvdb::DoubleGrid>(table, anchor, valueOf)
                                      : makeGrid<openvdb::FloatGrid>(table, anchor, valueOf);
    grid->setName(gridPrefix(header.source.name) + suffix);
    grid->setGridClass(openvdb::GRID_FOG_VOLUME);
    grid->setTransform(makeTransform(superVoxelMap(header.indexToWorld, 1 << table.itemShift())));
    addMetadata(*grid, header);
    return grid;
}

}  // namespace

void writeSidecar(const OutputFile& file, const SidecarHeader& header, const BakedVolume& baked,
                  const Int3& anchor) {
    openvdb::initialize();
    const auto levels = static_cast<int32_t>(baked.levels.size());
    VdbWriter writer(file, static_cast<int32_t>(std::size(kStatistics)) + levels);
    for (const Statistic& statistic : kStatistics) {
        writer.add(makeGrid(header, baked.table, anchor, statistic.suffix,
                            [&](size_t i) { return baked.items[i].*statistic.value; }));
    }
    for (int32_t level = 1; level <= levels; ++level) {
        const ScalarTable& means = baked.levels[static_cast<size_t>(level) - 1];
        writer.add(makeGrid(header, means.table, anchor, levelSuffix(level),
                            [&](size_t i) { return means.values[i]; }));
    }
    writer.finish();
}

}  // namespace trk
