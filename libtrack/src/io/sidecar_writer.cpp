// SPDX-License-Identifier: Apache-2.0
#include "density_types.h"
#include "sidecar.h"
#include "sidecar_schema.h"
#include "vdb_file.h"
#include "vdb_writer.h"

#include <openvdb/tools/Prune.h>

#include <array>
#include <functional>
#include <string>
#include <utility>
#include <vector>

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
    grid.insertMeta("track_source_bytes",
                    openvdb::Int64Metadata(static_cast<int64_t>(header.sourceBytes)));
    grid.insertMeta("track_source_modified", openvdb::Int64Metadata(header.sourceModified));
    grid.insertMeta("track_origin",
                    openvdb::Vec3DMetadata(openvdb::Vec3d(static_cast<double>(header.origin[0]),
                                                          static_cast<double>(header.origin[1]),
                                                          static_cast<double>(header.origin[2]))));
    number("track_super_voxel_size", header.superVoxelSize);
    text("track_control", controlName(header.controlKind));
    text("track_interpolation", kInterpolation);
    number("track_levels", header.levels);
    number("track_preview_size", header.previewSize);
    grid.insertMeta("track_preview_scale", openvdb::DoubleMetadata(header.previewScale));
    if (header.repair & TRK_REPAIR_DROP_NONFINITE) {
        grid.insertMeta("track_dropped_nonfinite",
                        openvdb::Int64Metadata(static_cast<int64_t>(header.dropped)));
    }
    if (header.repair & TRK_REPAIR_CLAMP_NEGATIVE) {
        grid.insertMeta("track_clamped_negative",
                        openvdb::Int64Metadata(static_cast<int64_t>(header.clamped)));
    }
}

/// The values of an item of a table, as many as the grid's values have channels.
using ValuesOf = std::function<const float*(size_t item)>;

/// Index of an item's place in a grid of super-voxels. `toGrid`: from local space to the corner
/// that the grids count from.
Int3 gridIndex(const Int3& local, const Int3& toGrid, int itemShift) {
    return {{(toGrid[0] + local[0]) >> itemShift, (toGrid[1] + local[1]) >> itemShift,
             (toGrid[2] + local[2]) >> itemShift}};
}

/// Sets the corner values of every occupied item and tile that are not 0; neighbours agree.
template <class GridType>
void fillCorners(GridType& grid, const BakedVolume& baked, const Int3& toGrid) {
    using Value = typename GridType::ValueType;
    auto accessor = grid.getAccessor();
    const int itemShift = baked.table.itemShift();
    baked.table.forEach([&](const Int3& lo, int shift, SparseTable::Entry entry) {
        const openvdb::Coord at = toCoord(gridIndex(lo, toGrid, itemShift));
        const size_t item = SparseTable::index(entry) * baked.channels;
        for (size_t corner = 0; corner < 8; ++corner) {
            float floats[3];
            for (size_t c = 0; c < baked.channels; ++c) {
                floats[c] = baked.shape(item + c)[corner];
            }
            const auto value = fromFloats<Value>(floats);
            if (shift > itemShift) {  // homogeneous: every corner has this value
                const int32_t size = 1 << (shift - itemShift);
                grid.sparseFill(openvdb::CoordBBox::createCube(at, size + 1), value, true);
                break;
            }
            if (!(value == openvdb::zeroVal<Value>())) {
                accessor.setValueOn(
                    at.offsetBy(static_cast<int>(corner >> 2), static_cast<int>(corner >> 1 & 1),
                                static_cast<int>(corner & 1)),
                    value);
            }
        }
    });
}

/// Writes the grids of one sidecar.
class SidecarGrids {
  public:
    SidecarGrids(VdbWriter& writer, const SidecarHeader& header, const Int3& toGrid)
        : writer_(writer), header_(header), toGrid_(toGrid) {}

    /// A grid without voxels.
    openvdb::GridBase::Ptr describe(const std::string& valueType, const std::string& suffix,
                                    int size, double offset) const {
        openvdb::GridBase::Ptr grid = openvdb::GridBase::createGrid(treeTypeName(valueType));
        grid->setName(gridPrefix(header_.prefix) + suffix);
        grid->setGridClass(openvdb::GRID_FOG_VOLUME);
        grid->setTransform(
            makeTransform(superVoxelMap(header_.indexToWorld, header_.origin, size, offset)));
        addMetadata(*grid, header_);
        return grid;
    }

    /// A grid of values per super-voxel, which is made and written by the next flush().
    void add(const std::string& valueType, const std::string& suffix, const SparseTable& table,
             size_t items, ValuesOf valuesOf, bool isSigned = false) {
        const int size = 1 << table.itemShift();
        Pending pending;
        pending.grid = describe(valueType, suffix, size, centreOffset(size));
        if (isSigned) {
            pending.grid->setGridClass(openvdb::GRID_UNKNOWN);  // no density
        }
        pending.valueType = valueType;
        pending.table = &table;
        pending.items = items;
        pending.valuesOf = std::move(valuesOf);
        pending_.push_back(std::move(pending));
    }

    /// Writes what was added, in its order, one grid in memory at a time.
    void flush() {
        for (size_t i = 0; i < pending_.size();) {
            // Grids of one table lie one after another and share its layout.
            const SparseTable* table = pending_[i].table;
            const TreeLayout layout(*table, toGrid_);
            for (; i < pending_.size() && pending_[i].table == table; ++i) {
                writer_.add(pending_[i].grid, encode(pending_[i], layout));
            }
        }
        pending_.clear();
    }

  private:
    struct Pending {
        openvdb::GridBase::Ptr grid;
        std::string valueType;
        const SparseTable* table = nullptr;
        size_t items = 0;
        ValuesOf valuesOf;
    };

    static EncodedTree encode(const Pending& pending, const TreeLayout& layout) {
        return withValueType(pending.valueType, [&](auto zero) {
            using Value = decltype(zero);
            std::vector<Value> values(pending.items);
            for (size_t i = 0; i < pending.items; ++i) {
                values[i] = fromFloats<Value>(pending.valuesOf(i));
            }
            return encodeTree(layout, values);
        });
    }

    VdbWriter& writer_;
    const SidecarHeader& header_;
    Int3 toGrid_;
    std::vector<Pending> pending_;
};

}  // namespace

void writeSidecar(const OutputFile& file, SidecarHeader header, const BakedVolume& baked,
                  const Int3& anchor) {
    openvdb::initialize();
    const size_t channels = baked.channels;
    const std::vector<Statistic> list = statistics(baked.kind);
    const std::vector<std::string> gradients = gradientSuffixes(channels);
    const size_t corners = baked.kind == ControlKind::kTrilinear ? 1 : 0;
    const size_t previews = baked.previewSize > 0 ? 1 : 0;
    header.levels = static_cast<int>(baked.levels.size());
    header.previewSize = baked.previewSize;
    IntBox box = baked.table.occupiedBox();
    for (size_t a = 0; a < 3 && !box.empty(); ++a) {
        box.lo[a] += anchor[a];
        box.hi[a] += anchor[a];
    }
    header.origin = originOf(box, baked.superVoxelSize() << header.levels);
    VdbWriter writer(file, static_cast<int32_t>(list.size() + gradients.size() + corners +
                                                baked.levels.size() + previews));
    Int3 toGrid{{0, 0, 0}};
    for (size_t a = 0; a < 3; ++a) {
        toGrid[a] = anchor[a] - header.origin[a];
    }
    SidecarGrids grids(writer, header, toGrid);
    if (corners > 0) {
        const openvdb::GridBase::Ptr grid =
            grids.describe(header.valueType, kControlSuffix, baked.superVoxelSize(), 0);
        grid->apply<DensityGrids>([&](auto& typed) {
            fillCorners(typed, baked, toGrid);
            openvdb::tools::prune(typed.tree());
        });
        writer.add(grid);
    }
    const size_t items = baked.items.size() / channels;
    for (const Statistic& statistic : list) {
        grids.add(header.valueType, statistic.suffix, baked.table, items,
                  [&baked, statistic, channels, values = std::array<float, 3>{}](size_t i) mutable {
                      for (size_t c = 0; c < channels; ++c) {
                          values[c] = baked.items[i * channels + c].*statistic.value;
                      }
                      return values.data();
                  });
    }
    for (size_t c = 0; c < gradients.size(); ++c) {
        grids.add(
            vectorType(header.valueType), gradients[c], baked.table, items,
            [&baked, channels, c](size_t i) { return &baked.gradients[3 * (i * channels + c)]; },
            /*isSigned=*/true);
    }
    const auto addMeans = [&](const std::string& suffix, const ValueTable& means) {
        grids.add(header.valueType, suffix, means.table, means.values.size() / channels,
                  [&means, channels](size_t i) { return &means.values[i * channels]; });
    };
    for (size_t level = 1; level <= baked.levels.size(); ++level) {
        addMeans(levelSuffix(static_cast<int>(level)), baked.levels[level - 1]);
    }
    if (previews > 0) {
        addMeans(previewSuffix(baked.previewSize), baked.preview);
    }
    grids.flush();
    writer.finish();
}

}  // namespace trk
