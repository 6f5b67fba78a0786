// SPDX-License-Identifier: Apache-2.0
#include "sidecar.h"

#include "active_grid.h"
#include "density_types.h"
#include "failure.h"
#include "field/table_builder.h"
#include "hash.h"
#include "sidecar_header.h"
#include "sidecar_schema.h"
#include "vdb_file.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <type_traits>
#include <unordered_map>
#include <utility>
#include <vector>

namespace trk {

using namespace schema;

namespace {

const VdbEntry& findGrid(const VdbFile& file, const std::string& name) {
    for (const VdbEntry& entry : file.entries()) {
        if (entry.name == name) {
            return entry;
        }
    }
    badSidecar(file.path(), "grid " + name + " is missing; the file has " + file.listing());
}

class SidecarReader {
  public:
    SidecarReader(VdbFile& file, const SidecarHeader& header, TrkCheck check, SidecarParts parts,
                  uint64_t maxMemory)
        : file_(file),
          header_(header),
          check_(check),
          parts_(parts),
          maxMemory_(maxMemory),
          hasGradients_(parts == SidecarParts::kAll || header.controlKind == ControlKind::kAffine),
          prefix_(header.prefix),
          channels_(static_cast<size_t>(channelCount(header.valueType))),
          statistics_(statistics(header.controlKind)) {
        while (1 << shift_ < header.superVoxelSize) {
            ++shift_;
        }
    }

    void read(const Int3* anchor, Sidecar& sidecar) {
        BakedVolume& baked = sidecar.baked;
        baked.superVoxelShift = shift_;
        baked.channels = channels_;
        baked.kind = header_.controlKind;
        // Grids are read one by one and kept as tables, which share what repeats.
        for (const Statistic& statistic : statistics_) {
            readItems(header_.valueType, statistic.suffix, Values::kNotNegative, anchor, sidecar);
        }
        if (hasGradients_) {
            for (const std::string& suffix : gradientSuffixes(channels_)) {
                readItems(vectorType(header_.valueType), suffix, Values::kSigned, anchor, sidecar);
            }
        }
        for (const std::string& suffix : gradientSuffixes(channels_)) {
            findGrid(file_, prefix_ + suffix);
        }
        if (header_.previewSize > 0) {
            findGrid(file_, prefix_ + previewSuffix(header_.previewSize));
        }
        if (baked.kind == ControlKind::kTrilinear) {
            corners_ = readTable(kControlSuffix, shift_, 0, sidecar.anchor);
        }
        join(sidecar);
        tables_.clear();
        for (int level = 1; level <= header_.levels; ++level) {
            const int shift = shift_ + level;
            baked.levels.push_back(
                readTable(levelSuffix(level), shift, centreOffset(1 << shift), sidecar.anchor));
        }
        if (parts_ == SidecarParts::kAll && header_.previewSize > 0) {
            int shift = 0;
            while (1 << shift < header_.previewSize) {
                ++shift;
            }
            baked.previewSize = header_.previewSize;
            baked.preview = readTable(previewSuffix(header_.previewSize), shift,
                                      centreOffset(header_.previewSize), sidecar.anchor);
        }
    }

  private:
    enum class Values { kNotNegative, kSigned };

    /// Entries that make a super-voxel: of at most six statistics, three gradients and eight
    /// corners; an even number, to hash.
    using Entries = std::array<SparseTable::Entry, 18>;
    struct Hash {
        size_t operator()(const Entries& entries) const {
            return hashWords(entries.data(), entries.size() / 2, 0);
        }
    };

    /// Reads a grid of one value per super-voxel; all of them cover one box.
    void readItems(const std::string& valueType, const std::string& suffix, Values values,
                   const Int3* anchor, Sidecar& sidecar) {
        const PlacedGrid grid =
            readGrid(valueType, suffix, shift_, centreOffset(header_.superVoxelSize));
        if (tables_.empty()) {
            box_ = grid.support;
            sidecar.anchor = anchor ? *anchor : anchorFor(box_);
        }
        if (grid.support.lo != box_.lo || grid.support.hi != box_.hi) {
            badSidecar(file_.path(), "grid " + grid.name + " covers another box than " + prefix_ +
                                         statistics_[0].suffix);
        }
        tables_.push_back(makeTable(grid, shift_, sidecar.anchor, values));
    }

    /// A grid of values of the density's type, not negative.
    ValueTable readTable(const std::string& suffix, int shift, double offset,
                         const Int3& anchor) const {
        return makeTable(readGrid(header_.valueType, suffix, shift, offset), shift, anchor,
                         Values::kNotNegative);
    }

    /// Makes super-voxels of the tables of their statistics and shapes; equal ones are one.
    void join(Sidecar& sidecar) const {
        BakedVolume& baked = sidecar.baked;
        const bool trilinear = baked.kind == ControlKind::kTrilinear;
        std::unordered_map<Entries, SparseTable::Entry, Hash> known;
        TableBuilder::Sources sources;
        for (const ValueTable& table : tables_) {
            sources.push_back(&table.table);
        }
        baked.table =
            TableBuilder(shift_, toLocal(box_, sidecar.anchor))
                .fill(
                    sources,
                    [&](const Int3& local, int shift) -> std::optional<SparseTable::Entry> {
                        Entries entries{};
                        size_t empty = 0;
                        for (size_t i = 0; i < tables_.size(); ++i) {
                            const auto entry = tables_[i].table.uniformEntry(local, shift);
                            if (!entry) {
                                return std::nullopt;
                            }
                            entries[i] = *entry;
                            empty += *entry == SparseTable::kEmpty ? 1 : 0;
                        }
                        if (empty == tables_.size()) {
                            return SparseTable::kEmpty;
                        }
                        const Int3 at = gridIndex(local, shift_, sidecar.anchor);
                        if (empty > 0) {
                            badSidecar(file_.path(),
                                       "its grids are not active in the same super-voxels: see " +
                                           where(at));
                        }
                        const bool varies =
                            baked.kind != ControlKind::kConstant && !isHomogeneous(entries);
                        if (varies && shift > shift_) {
                            return std::nullopt;
                        }
                        for (size_t corner = 0; varies && trilinear && corner < 8; ++corner) {
                            const int64_t size = header_.superVoxelSize;
                            entries[tables_.size() + corner] =
                                corners_.table
                                    .find(local[0] + (corner & 4 ? size : 0),
                                          local[1] + (corner & 2 ? size : 0),
                                          local[2] + (corner & 1 ? size : 0))
                                    .entry;
                        }
                        const auto [it, isNew] = known.try_emplace(
                            entries, static_cast<SparseTable::Entry>(known.size() + 1) |
                                         (varies ? SparseTable::kSingleFlag : 0));
                        if (isNew) {
                            addItems(entries, varies, at, baked);
                        }
                        return it->second;
                    },
                    [](const Int3&) {
                        return SparseTable::kEmpty;
                    },  // a super-voxel is always uniform
                    [&](const Int3& local, int shift, SparseTable::Key& key) {
                        // Corners belong to neighbours too, which such a key does not know.
                        return !trilinear &&
                               std::all_of(tables_.begin(), tables_.end(),
                                           [&](const ValueTable& table) {
                                               return table.table.appendKey(local, shift, key);
                                           });
                    });
    }

    float valueOf(const ValueTable& table, SparseTable::Entry entry, size_t channel) const {
        return entry == SparseTable::kEmpty ? 0.0f
                                            : table.values[(entry - 1) * channels_ + channel];
    }

    BakedSuperVoxel itemOf(const Entries& entries, size_t channel) const {
        BakedSuperVoxel item;
        for (size_t i = 0; i < statistics_.size(); ++i) {
            item.*statistics_[i].value = valueOf(tables_[i], entries[i], channel);
        }
        if (header_.controlKind == ControlKind::kConstant) {
            item.deviation = item.rms;
        }
        return item;
    }

    bool isHomogeneous(const Entries& entries) const {
        bool homogeneous = true;
        for (size_t c = 0; c < channels_; ++c) {
            const BakedSuperVoxel item = itemOf(entries, c);
            homogeneous = homogeneous && item.min == item.max;
        }
        return homogeneous;
    }

    /// Adds a super-voxel: an item and a shape for each channel.
    void addItems(const Entries& entries, bool varies, const Int3& at, BakedVolume& baked) const {
        for (size_t c = 0; c < channels_; ++c) {
            const BakedSuperVoxel item = itemOf(entries, c);
            float gradient[3] = {0, 0, 0};
            if (hasGradients_) {
                const size_t table = statistics_.size() + c;
                if (entries[table] != SparseTable::kEmpty) {
                    std::copy_n(&tables_[table].values[(entries[table] - 1) * 3], 3, gradient);
                }
                baked.gradients.insert(baked.gradients.end(), gradient, gradient + 3);
            }
            if (baked.kind == ControlKind::kAffine) {
                const auto shape = constrainGradient(gradient, static_cast<double>(item.mean),
                                                     header_.superVoxelSize);
                for (const float g : shape) {
                    baked.shapes.push_back(varies ? g : 0.0f);
                }
            }
            for (size_t k = 0; k < 8 && baked.kind == ControlKind::kTrilinear; ++k) {
                baked.shapes.push_back(varies ? valueOf(corners_, entries[tables_.size() + k], c)
                                              : item.mean);
            }
            baked.items.push_back(item);
            if (item.min > item.max) {  // nothing could be tracked between them
                badSidecar(file_.path(), where(at) + " has a min above its max");
            }
            if (check_ == TRK_CHECK_FULL) {
                checkItem(item, baked.control(baked.items.size() - 1), at);
            }
        }
    }

    /// Index, in the grids of super-voxels of 2^shift, of a place of local space.
    Int3 gridIndex(const Int3& local, int shift, const Int3& anchor) const {
        const Int3& origin = header_.origin;
        return {{(anchor[0] + local[0] - origin[0]) >> shift,
                 (anchor[1] + local[1] - origin[1]) >> shift,
                 (anchor[2] + local[2] - origin[2]) >> shift}};
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

    struct PlacedGrid {
        std::string name;
        IntBox support;  // in the source's index space
        ActiveGrid grid;
    };

    PlacedGrid readGrid(const std::string& valueType, const std::string& suffix, int shift,
                        double offset) const {
        const std::string name = prefix_ + suffix;
        const VdbEntry& entry = findGrid(file_, name);
        const std::string place = file_.path() + ": grid " + name;
        if (entry.type != treeTypeName(valueType)) {
            badSidecar(place, "is of type " + entry.type + "; expected " + treeTypeName(valueType));
        }
        const VdbGridHeader header = file_.readHeader(entry);
        checkFormat(header.metadata, place);
        if (metaText(header.metadata, "track_source_digest", place) != hexDigest(header_.digest)) {
            badSidecar(place, "comes from another bake than the file's other grids");
        }
        const AffineMap expected =
            superVoxelMap(header_.indexToWorld, header_.origin, 1 << shift, offset);
        if (!sameMap(expected, affineMap(*header.transform, place))) {
            badSidecar(place, "does not lie over the file's control grid: its transform differs");
        }
        PlacedGrid placed{name, {}, readActiveGrid(file_, entry, maxMemory_)};
        const IntBox box = placed.grid.box();
        for (size_t a = 0; a < 3 && !box.empty(); ++a) {
            placed.support.lo[a] = (box.lo[a] << shift) + header_.origin[a];
            placed.support.hi[a] = (box.hi[a] << shift) + header_.origin[a];
        }
        return placed;
    }

    /// Gives every value of a table an entry; equal ones have one.
    class ValueEntries {
      public:
        ValueEntries(size_t channels, std::vector<float>& values)
            : channels_(channels), values_(values) {}

        SparseTable::Entry of(const ActiveLeaf::Floats& value) {
            if (last_ == SparseTable::kEmpty || value != lastValue_) {
                const auto [it, isNew] = known_.try_emplace(
                    value, static_cast<SparseTable::Entry>(values_.size() / channels_ + 1));
                if (isNew) {
                    values_.insert(values_.end(), value.begin(),
                                   value.begin() + static_cast<std::ptrdiff_t>(channels_));
                }
                last_ = it->second;
                lastValue_ = value;
            }
            return last_;
        }

      private:
        struct FloatsHash {
            size_t operator()(const ActiveLeaf::Floats& floats) const {
                uint64_t words[2] = {0, 0};
                std::memcpy(words, floats.data(), sizeof(floats));
                return hashWords(words, 2, 0);
            }
        };
        size_t channels_;
        std::vector<float>& values_;
        std::unordered_map<ActiveLeaf::Floats, SparseTable::Entry, FloatsHash> known_;
        SparseTable::Entry last_ = SparseTable::kEmpty;
        ActiveLeaf::Floats lastValue_{};
    };

    /// The active values of a grid, as a table over local space.
    ValueTable makeTable(const PlacedGrid& placed, int shift, const Int3& anchor,
                         Values values) const {
        checkAnchor(placed.support, anchor, placed.name);
        const ActiveGrid& grid = placed.grid;
        ValueTable result;
        TableBuilder table(shift, toLocal(placed.support, anchor));
        ValueEntries entries(grid.channels, result.values);
        const auto entryOf = [&](const ActiveLeaf::Floats& value, const Int3& at) {
            for (size_t c = 0; c < grid.channels; ++c) {
                if (!std::isfinite(value[c]) || (values == Values::kNotNegative && value[c] < 0)) {
                    badSidecar(file_.path(), "grid " + placed.name + ": " + where(at) +
                                                 " is negative, NaN or infinite");
                }
            }
            return entries.of(value);
        };
        const auto local = [&](const Int3& at) {
            Int3 place{};
            for (size_t a = 0; a < 3; ++a) {
                place[a] = (at[a] << shift) + header_.origin[a] - anchor[a];
            }
            return place;
        };
        // Equal leaves become one node, where the table's nodes lie as the grid's leaves do.
        const int64_t offLeaf =
            (local({{0, 0, 0}})[0] | local({{0, 0, 0}})[1] | local({{0, 0, 0}})[2]) &
            ((int64_t{8} << shift) - 1);
        std::vector<SparseTable::Node> nodes(grid.leaves.size());
        std::vector<SparseTable::Entry> nodeEntries(grid.leaves.size());
        std::vector<TableBuilder::Place> places;
        std::vector<bool> made(grid.leaves.size());
        for (const auto& [origin, l] : grid.places) {
            const ActiveLeaf& leaf = grid.leaves[l];
            SparseTable::Node& node = nodes[l];
            if (!made[l]) {
                for (size_t i = 0; i < ActiveLeaf::kVoxels; ++i) {
                    node[i] = leaf.isActive(i)
                                  ? entryOf(leaf.values[i], SparseTable::childOrigin(origin, 0, i))
                                  : SparseTable::kEmpty;
                }
                nodeEntries[l] = offLeaf == 0 ? table.addNode(node) : SparseTable::kEmpty;
                made[l] = true;
            }
            if (nodeEntries[l] != SparseTable::kEmpty) {
                places.push_back({local(origin), shift + 3, nodeEntries[l]});
                continue;
            }
            for (size_t i = 0; i < ActiveLeaf::kVoxels; ++i) {
                if (node[i] != SparseTable::kEmpty) {
                    places.push_back(
                        {local(SparseTable::childOrigin(origin, 0, i)), shift, node[i]});
                }
            }
        }
        for (const auto& [box, value] : grid.tiles) {
            table.addBox({local(box.lo), local(box.hi)}, entryOf(value, box.lo), places);
        }
        result.table = table.assemble(std::move(places));
        return result;
    }

    void checkItem(const BakedSuperVoxel& v, const ControlPolynomial& control,
                   const Int3& at) const {
        const double slack = 1 + 1e-6;
        const auto min = static_cast<double>(v.min);
        const auto max = static_cast<double>(v.max);
        const auto mean = static_cast<double>(v.mean);
        // A control may reach beyond the density by its majorant; a constant one is the mean, whose
        // majorant must reach both bounds.
        const double majorant = static_cast<double>(v.majorant) * slack;
        const bool constant = header_.controlKind == ControlKind::kConstant;
        const char* wrong = nullptr;
        if ((v.rms > 0 || v.min < v.max) && v.majorant == 0) {
            wrong =
                v.rms > 0 ? "majorant 0 with an RMS above 0" : "majorant 0 with bounds that differ";
        } else if (v.min > v.max || mean * slack < min || mean > max * slack) {
            wrong = constant ? "a control that is not between min and max"
                             : "a mean that is not between min and max";
        } else if ((constant && majorant < std::max(mean - min, max - mean)) ||
                   control.max() > (max + majorant) * slack) {
            wrong = "a majorant that does not bound the residual";
        } else if (static_cast<double>(v.rms) > majorant) {
            wrong = "an RMS above its majorant";
        }
        if (wrong) {
            char text[160];
            std::snprintf(text, sizeof(text), " (%s %g, majorant %g, rms %g, min %g, max %g)",
                          constant ? "control" : "mean", mean, static_cast<double>(v.majorant),
                          static_cast<double>(v.rms), min, max);
            badSidecar(file_.path(), where(at) + " has " + wrong + text);
        }
    }

    VdbFile& file_;
    const SidecarHeader& header_;
    TrkCheck check_;
    SidecarParts parts_;
    uint64_t maxMemory_;
    bool hasGradients_;
    std::string prefix_;
    size_t channels_;
    std::vector<Statistic> statistics_;
    int shift_ = 0;
    IntBox box_;                      // index space
    std::vector<ValueTable> tables_;  // of statistics, then of gradients
    ValueTable corners_;
};

}  // namespace

Sidecar readSidecar(const std::string& path, const DensitySummary* density, TrkCheck check,
                    SidecarParts parts, uint64_t maxMemory) {
    VdbFile file(path);
    Sidecar sidecar;
    sidecar.header = readHeader(file, density ? &density->grid : nullptr);
    if (density) {
        checkAgainst(sidecar.header, *density, check, path);
    }
    const Int3* anchor = density ? &density->anchor : nullptr;
    SidecarReader(file, sidecar.header, check, parts, maxMemory).read(anchor, sidecar);
    return sidecar;
}

}  // namespace trk
