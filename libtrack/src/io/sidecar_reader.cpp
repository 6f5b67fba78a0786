// SPDX-License-Identifier: Apache-2.0
#include "sidecar.h"

#include "../error.h"
#include "../hash.h"
#include "sidecar_schema.h"
#include "tree_regions.h"
#include "vdb_file.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <unordered_map>
#include <utility>
#include <vector>

namespace trk {

using namespace schema;

namespace {

[[noreturn]] void badSidecar(const std::string& where, const std::string& what) {
    throw Error(TRK_ERROR_BAD_FILE, where + ": " + what);
}

std::string metaText(const openvdb::GridBase& grid, const char* name, const std::string& where) {
    const auto meta = grid.getMetadata<openvdb::StringMetadata>(name);
    if (!meta) {
        badSidecar(where, std::string("no metadata ") + name + "; not a sidecar of this tool");
    }
    return meta->value();
}

int metaNumber(const openvdb::GridBase& grid, const char* name, const std::string& where) {
    const auto meta = grid.getMetadata<openvdb::Int32Metadata>(name);
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

/// The grid whose name ends in _control; others are found from its prefix.
const VdbEntry* findControl(const VdbFile& file) {
    const std::string suffix = kStatistics[0].suffix;
    for (const VdbEntry& entry : file.entries()) {
        if (entry.name.size() > suffix.size() &&
            entry.name.compare(entry.name.size() - suffix.size(), suffix.size(), suffix) == 0) {
            return &entry;
        }
    }
    return nullptr;
}

SidecarHeader readHeader(VdbFile& file) {
    const VdbEntry* control = findControl(file);
    if (!control) {
        badSidecar(file.path(),
                   "no grid …_control; expected a sidecar made by `vdbtrack bake`; the "
                   "file has " +
                       file.listing());
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
    header.controlKind = metaText(*grid, "track_control", where);
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
    const std::string interpolation = metaText(*grid, "track_interpolation", where);
    if (header.controlKind != "constant" || interpolation != kInterpolation) {
        throw Error(TRK_ERROR_SIDECAR_MISMATCH,
                    where + ": control \"" + header.controlKind + "\" of interpolation \"" +
                        interpolation +
                        "\"; this build reads constant controls of trilinear fields");
    }
    if (const auto meta = grid->getMetadata<openvdb::Int64Metadata>("track_dropped_nonfinite")) {
        header.repair |= TRK_REPAIR_DROP_NONFINITE;
        header.dropped = static_cast<uint64_t>(meta->value());
    }
    if (const auto meta = grid->getMetadata<openvdb::Int64Metadata>("track_clamped_negative")) {
        header.repair |= TRK_REPAIR_CLAMP_NEGATIVE;
        header.clamped = static_cast<uint64_t>(meta->value());
    }
    header.indexToWorld = sourceMap(affineMap(grid->constTransform(), where), size);
    return header;
}

std::string label(const GridIdentity& grid) {
    return "\"" + grid.name + "\"[" + std::to_string(grid.index) + "]";
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

const VdbEntry& findGrid(const VdbFile& file, const std::string& name) {
    for (const VdbEntry& entry : file.entries()) {
        if (entry.name == name) {
            return entry;
        }
    }
    badSidecar(file.path(), "grid " + name + " is missing; the file has " + file.listing());
}

template <class TreeType>
class SidecarReader {
  public:
    using GridType = openvdb::Grid<TreeType>;
    using Regions = TreeRegions<TreeType>;
    using Entries = std::array<SparseTable::Entry, 6>;  // one a statistic; an even number, to hash

    SidecarReader(VdbFile& file, const SidecarHeader& header, TrkCheck check)
        : file_(file), header_(header), check_(check) {}

    void read(const Int3* anchor, Sidecar& sidecar) {
        const std::string prefix = gridPrefix(header_.source.name);
        int shift = 0;
        while (1 << shift < header_.superVoxelSize) {
            ++shift;
        }
        BakedVolume& baked = sidecar.baked;
        baked.superVoxelShift = shift;

        // Grids are read one by one and kept as tables, which share what repeats.
        std::vector<ScalarTable> tables;
        for (const Statistic& statistic : kStatistics) {
            const auto grid = readGrid(prefix + statistic.suffix, shift);
            const IntBox support = supportBox(grid->tree(), shift);
            if (tables.empty()) {
                box_ = support;
                sidecar.anchor = anchor ? *anchor : anchorFor(box_);
            }
            if (support.lo != box_.lo || support.hi != box_.hi) {
                badSidecar(file_.path(), "grid " + grid->getName() + " covers another box than " +
                                             prefix + kStatistics[0].suffix);
            }
            checkAnchor(support, sidecar.anchor, grid->getName());
            tables.push_back(makeTable(*grid, shift, sidecar.anchor));
        }
        join(tables, sidecar);
        tables.clear();
        for (int level = 1; level <= header_.levels; ++level) {
            const auto grid = readGrid(prefix + levelSuffix(level), shift + level);
            checkAnchor(supportBox(grid->tree(), shift + level), sidecar.anchor, grid->getName());
            baked.levels.push_back(makeTable(*grid, shift + level, sidecar.anchor));
        }
    }

  private:
    /// Makes super-voxels of the tables of their statistics; equal super-voxels are one item.
    void join(const std::vector<ScalarTable>& tables, Sidecar& sidecar) const {
        struct Hash {
            size_t operator()(const Entries& entries) const {
                return hashWords(entries.data(), entries.size() / 2, 0);
            }
        };
        BakedVolume& baked = sidecar.baked;
        std::unordered_map<Entries, SparseTable::Entry, Hash> known;
        baked.table = SparseTable(baked.superVoxelShift, toLocal(box_, sidecar.anchor));
        const auto itemOf = [&](const Entries& entries, const Int3& local) {
            const auto [it, isNew] =
                known.try_emplace(entries, static_cast<SparseTable::Entry>(known.size() + 1));
            if (isNew) {
                BakedSuperVoxel item;
                for (size_t i = 0; i < tables.size(); ++i) {
                    item.*kStatistics[i].value = tables[i].values[entries[i] - 1];
                }
                if (check_ == TRK_CHECK_FULL) {
                    checkItem(item, superVoxel(local, baked.superVoxelShift, sidecar.anchor));
                }
                baked.items.push_back(item);
            }
            return it->second;
        };
        baked.table.fill(
            [&](const Int3& local, int shift) -> std::optional<SparseTable::Entry> {
                Entries entries{};
                size_t empty = 0;
                for (size_t i = 0; i < tables.size(); ++i) {
                    const auto entry = tables[i].table.uniformEntry(local, shift);
                    if (!entry) {
                        return std::nullopt;
                    }
                    entries[i] = *entry;
                    empty += *entry == SparseTable::kEmpty ? 1 : 0;
                }
                if (empty == tables.size()) {
                    return SparseTable::kEmpty;
                }
                if (empty > 0) {
                    badSidecar(file_.path(),
                               "its grids are not active in the same super-voxels: see " +
                                   where(superVoxel(local, baked.superVoxelShift, sidecar.anchor)));
                }
                return itemOf(entries, local);
            },
            [](const Int3&) { return SparseTable::kEmpty; },  // a super-voxel is always uniform
            [&](const Int3& local, int shift, SparseTable::Key& key) {
                return std::all_of(tables.begin(), tables.end(), [&](const ScalarTable& table) {
                    return table.table.appendKey(local, shift, key);
                });
            });
    }

    /// Index of the super-voxel at a place of local space.
    static Int3 superVoxel(const Int3& local, int shift, const Int3& anchor) {
        return {{(anchor[0] + local[0]) >> shift, (anchor[1] + local[1]) >> shift,
                 (anchor[2] + local[2]) >> shift}};
    }

    /// Local space has no negative coordinates; a grid that would need them belongs to another
    /// density.
    void checkAnchor(const IntBox& support, const Int3& anchor, const std::string& name) const {
        for (size_t a = 0; a < 3 && !support.empty(); ++a) {
            if (support.lo[a] < anchor[a]) {
                badSidecar(file_.path(), "grid " + name + " reaches outside the density's box");
            }
        }
    }

    static IntBox toLocal(IntBox box, const Int3& anchor) {
        for (size_t a = 0; a < 3 && !box.empty(); ++a) {
            box.lo[a] -= anchor[a];
            box.hi[a] -= anchor[a];
        }
        return box;
    }

    static std::string where(const Int3& at) {
        return "super-voxel (" + std::to_string(at[0]) + ", " + std::to_string(at[1]) + ", " +
               std::to_string(at[2]) + ")";
    }

    typename GridType::Ptr readGrid(const std::string& name, int shift) {
        const VdbEntry& entry = findGrid(file_, name);
        const std::string place = file_.path() + ": grid " + name;
        if (entry.type != TreeType::treeType()) {
            badSidecar(place, "is of type " + entry.type + "; expected " + TreeType::treeType());
        }
        auto grid = openvdb::gridPtrCast<GridType>(file_.read(entry));
        checkFormat(*grid, place);
        if (metaText(*grid, "track_source_digest", place) != hexDigest(header_.digest)) {
            badSidecar(place, "comes from another bake than the file's other grids");
        }
        const AffineMap expected = superVoxelMap(header_.indexToWorld, 1 << shift);
        if (!sameMap(expected, affineMap(grid->constTransform(), place))) {
            badSidecar(place, "does not lie over the file's control grid: its transform differs");
        }
        if (!(grid->background() == 0)) {
            badSidecar(place, "background is not 0");
        }
        return grid;
    }

    static IntBox supportBox(const TreeType& tree, int shift) {
        IntBox box;
        openvdb::CoordBBox active;
        if (tree.evalActiveVoxelBoundingBox(active)) {
            const int64_t size = int64_t{1} << shift;
            Int3 lo = toInt3(active.min());
            Int3 hi = toInt3(active.max());
            for (size_t a = 0; a < 3; ++a) {
                lo[a] *= size;
                hi[a] = (hi[a] + 1) * size;
            }
            box.add(lo, hi);
        }
        return box;
    }

    /// The active values of a grid, as a table over local space.
    ScalarTable makeTable(const GridType& grid, int shift, const Int3& anchor) const {
        ScalarTable result;
        std::unordered_map<float, SparseTable::Entry> known;
        SparseTable::Entry last = SparseTable::kEmpty;
        result.table = SparseTable(shift, toLocal(supportBox(grid.tree(), shift), anchor));
        Regions regions(grid.tree());
        result.table.fill(
            [&](const Int3& local, int regionShift) -> std::optional<SparseTable::Entry> {
                const Int3 at = superVoxel(local, shift, anchor);
                const auto region = regions.uniform(at, regionShift - shift);
                if (!region) {
                    return std::nullopt;
                }
                if (!region->active) {
                    return SparseTable::kEmpty;
                }
                const auto value = static_cast<float>(region->value);
                if (!(value >= 0) || !std::isfinite(value)) {
                    badSidecar(file_.path(), "grid " + grid.getName() + ": " + where(at) +
                                                 " is negative, NaN or infinite");
                }
                if (last == SparseTable::kEmpty || value != result.values[last - 1]) {
                    const auto [it, isNew] = known.try_emplace(
                        value, static_cast<SparseTable::Entry>(result.values.size() + 1));
                    if (isNew) {
                        result.values.push_back(value);
                    }
                    last = it->second;
                }
                return last;
            },
            [](const Int3&) { return SparseTable::kEmpty; });  // a super-voxel is always uniform
        return result;
    }

    void checkItem(const BakedSuperVoxel& v, const Int3& at) const {
        const double slack = 1 + 1e-6;
        const double control = static_cast<double>(v.control);
        const double needed =
            std::max(control - static_cast<double>(v.min), static_cast<double>(v.max) - control);
        const char* wrong = nullptr;
        if (v.rms > 0 && v.majorant == 0) {
            wrong = "majorant 0 with an RMS above 0";
        } else if (v.min > v.max || v.control * slack < static_cast<double>(v.min) ||
                   control > static_cast<double>(v.max) * slack) {
            wrong = "a control that is not between min and max";
        } else if (static_cast<double>(v.majorant) * slack < needed) {
            wrong = "a majorant that does not bound the residual";
        } else if (static_cast<double>(v.rms) > static_cast<double>(v.majorant) * slack) {
            wrong = "an RMS above its majorant";
        }
        if (wrong) {
            char text[160];
            std::snprintf(text, sizeof(text), " (control %g, majorant %g, rms %g, min %g, max %g)",
                          control, static_cast<double>(v.majorant), static_cast<double>(v.rms),
                          static_cast<double>(v.min), static_cast<double>(v.max));
            badSidecar(file_.path(), where(at) + " has " + wrong + text);
        }
    }

    VdbFile& file_;
    const SidecarHeader& header_;
    TrkCheck check_;
    IntBox box_;  // index space
};

}  // namespace

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

Sidecar readSidecar(const std::string& path, const DensitySummary* density, TrkCheck check) {
    VdbFile file(path);
    Sidecar sidecar;
    sidecar.header = readHeader(file);
    if (density) {
        checkAgainst(sidecar.header, *density, check, path);
    }
    const Int3* anchor = density ? &density->anchor : nullptr;
    if (sidecar.header.valueType == "double") {
        SidecarReader<openvdb::DoubleTree>(file, sidecar.header, check).read(anchor, sidecar);
    } else {
        SidecarReader<openvdb::FloatTree>(file, sidecar.header, check).read(anchor, sidecar);
    }
    return sidecar;
}

}  // namespace trk
