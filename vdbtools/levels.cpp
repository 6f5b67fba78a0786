// SPDX-License-Identifier: Apache-2.0
#include "levels.h"

#include <array>
#include <cstddef>
#include <map>
#include <optional>

namespace vdbtools {
namespace {

using trk::Int3;
using trk::SparseTable;
using trk::ValueTable;

/// Means of the super-voxels twice as large as those of `finer`. `meanOf(index, channel)`.
template <class MeanOf>
ValueTable nextLevel(const SparseTable& finer, const trk::IntBox& box, size_t channels,
                     const MeanOf& meanOf) {
    ValueTable level;
    const int shift = finer.itemShift() + 1;
    const int64_t half = int64_t{1} << finer.itemShift();
    level.table = SparseTable(shift, box);
    using Mean = std::array<float, 3>;
    std::map<Mean, SparseTable::Entry> known;
    const auto add = [&](const Mean& mean) {
        if (mean == Mean{}) {
            return SparseTable::kEmpty;
        }
        const auto [it, isNew] = known.try_emplace(
            mean, static_cast<SparseTable::Entry>(level.values.size() / channels + 1));
        if (isNew) {
            level.values.insert(level.values.end(), mean.begin(),
                                mean.begin() + static_cast<std::ptrdiff_t>(channels));
        }
        return it->second;
    };
    level.table.fill(
        [&](const Int3& origin, int regionShift) -> std::optional<SparseTable::Entry> {
            const auto entry = finer.uniformEntry(origin, regionShift);
            if (!entry) {
                return std::nullopt;
            }
            Mean mean{};
            for (size_t c = 0; c < channels && *entry != SparseTable::kEmpty; ++c) {
                mean[c] = meanOf(SparseTable::index(*entry), c);
            }
            return add(mean);
        },
        [&](const Int3& origin) {
            double sum[3] = {0, 0, 0};
            for (int64_t octant = 0; octant < 8; ++octant) {
                const auto entry =
                    finer
                        .find(origin[0] + (octant >> 2) * half,
                              origin[1] + (octant >> 1 & 1) * half, origin[2] + (octant & 1) * half)
                        .entry;
                for (size_t c = 0; c < channels && entry != SparseTable::kEmpty; ++c) {
                    sum[c] += static_cast<double>(meanOf(SparseTable::index(entry), c));
                }
            }
            Mean mean{};
            for (size_t c = 0; c < channels; ++c) {
                mean[c] = static_cast<float>(sum[c] / 8);
            }
            return add(mean);
        },
        [&](const Int3& origin, int regionShift, SparseTable::Key& key) {
            return finer.appendKey(origin, regionShift, key);
        });
    return level;
}

}  // namespace

void addLevels(trk::BakedVolume& baked, const trk::IntBox& box, int count) {
    const size_t channels = baked.channels;
    for (int i = 0; i < count; ++i) {
        if (i == 0) {
            baked.levels.push_back(nextLevel(
                baked.table, box, channels,
                [&](size_t item, size_t c) { return baked.items[item * channels + c].mean; }));
        } else {
            const ValueTable& finer = baked.levels.back();
            baked.levels.push_back(nextLevel(
                finer.table, box, channels,
                [&](size_t item, size_t c) { return finer.values[item * channels + c]; }));
        }
    }
}

}  // namespace vdbtools
