// SPDX-License-Identifier: Apache-2.0
#include "levels.h"

#include "field/table_builder.h"
#include "hash.h"
#include "moments.h"
#include "parallel.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <cstring>
#include <map>
#include <optional>
#include <unordered_map>
#include <utility>

namespace trk {
namespace {

/// Means of the super-voxels twice as large as those of `finer`. `meanOf(index, channel)`.
template <class MeanOf>
ValueTable nextLevel(const SparseTable& finer, const IntBox& box, size_t channels,
                     const MeanOf& meanOf) {
    ValueTable level;
    const int shift = finer.itemShift() + 1;
    const int64_t half = int64_t{1} << finer.itemShift();
    using Mean = std::array<float, 3>;
    const auto hash = [](const Mean& mean) {
        uint64_t words[2] = {0, 0};
        std::memcpy(words, mean.data(), sizeof(mean));
        return hashWords(words, 2, 0);
    };
    std::unordered_map<Mean, SparseTable::Entry, decltype(hash)> known(64, hash);
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
    level.table =
        TableBuilder(shift, box)
            .fill(
                {&finer},
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
                        const auto entry = finer
                                               .find(origin[0] + (octant >> 2) * half,
                                                     origin[1] + (octant >> 1 & 1) * half,
                                                     origin[2] + (octant & 1) * half)
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
                    return regionShift > shift && finer.appendKey(origin, regionShift, key);
                });
    return level;
}

/// Means of the cubes of 2^shift cells of a field.
ValueTable meansOf(BrickPages& pages, int shift) {
    const DensityField& field = pages.field();
    if (shift > DensityField::kBrickShift) {
        const ValueTable finer = meansOf(pages, shift - 1);
        return nextLevel(finer.table, field.box(), field.channels(), [&](size_t item, size_t c) {
            return finer.values[item * field.channels() + c];
        });
    }
    const size_t channels = field.channels();
    const auto edge = static_cast<size_t>(1) << shift;
    const size_t perAxis = 8 / edge;
    const size_t cubes = perAxis * perAxis * perAxis;
    const std::vector<SparseTable::Entry> bricks = pages.bricks();
    std::vector<float> brickMeans((bricks.empty() ? 0 : bricks.back()) * cubes * channels);
    const auto bricksOf = [&](size_t i, const auto& f) { f(bricks[i]); };
    pages.forEach(bricks.size(), 32, bricksOf, [&](size_t i) {
        const size_t b = bricks[i] - 1;
        float buffer[DensityField::kBrickVertices];
        for (size_t c = 0; c < channels; ++c) {
            const float* brick = pages.brickChannel(bricks[i], c, buffer);
            withEdge(edge, [&](auto m) {
                for (size_t k = 0; k < cubes; ++k) {
                    const float* cube = cubeRow(brick, k / (perAxis * perAxis) * edge,
                                                k / perAxis % perAxis * edge) +
                                        k % perAxis * edge;
                    brickMeans[(b * cubes + k) * channels + c] =
                        static_cast<float>(cubeMean<decltype(m)::value>(cube));
                }
            });
        }
    });
    ValueTable means;
    const auto add = [&](const float* values) {
        if (std::all_of(values, values + channels, [](float v) { return v == 0; })) {
            return SparseTable::kEmpty;
        }
        means.values.insert(means.values.end(), values, values + channels);
        return static_cast<SparseTable::Entry>(means.values.size() / channels);
    };
    std::map<SparseTable::Entry, SparseTable::Entry> constants;
    means.table =
        TableBuilder(shift, field.box())
            .fill(
                {&field.table()},
                [&](const Int3& origin, int regionShift) -> std::optional<SparseTable::Entry> {
                    const auto entry = field.table().uniformEntry(origin, regionShift);
                    if (!entry || !DensityField::isConstant(*entry)) {
                        return std::nullopt;
                    }
                    const auto known = constants.find(*entry);
                    return known != constants.end()
                               ? known->second
                               : constants[*entry] = add(field.constant(*entry));
                },
                [&](const Int3& origin) {
                    const auto entry = field.table().find(origin[0], origin[1], origin[2]).entry;
                    const auto part = [&](size_t a) {
                        return static_cast<size_t>(origin[a] & 7) / edge;
                    };
                    const size_t k = (part(0) * perAxis + part(1)) * perAxis + part(2);
                    return add(&brickMeans[((entry - 1) * cubes + k) * channels]);
                },
                [&](const Int3& origin, int regionShift, SparseTable::Key& key) {
                    return regionShift > DensityField::kBrickShift &&
                           field.table().appendKey(origin, regionShift, key);
                });
    return means;
}

int64_t largestExtent(const IntBox& box) {
    int64_t extent = 0;
    for (size_t a = 0; a < 3; ++a) {
        extent = std::max(extent, box.hi[a] - box.lo[a]);
    }
    return extent;
}

/// Bytes of a sidecar without means for pictures: a grid's nodes, which VDB does not compress, and
/// its values, which compress little.
constexpr double kGridBytes = 10500;
double estimatedBytes(const BakedVolume& baked) {
    constexpr double kValue = 4.2;
    const double statistics = baked.kind == ControlKind::kConstant ? 5 : 7;
    const auto channels = static_cast<double>(baked.channels);
    const double grids = statistics + channels + static_cast<double>(baked.levels.size());
    return kGridBytes * grids + kValue * channels * (statistics + 3 + 0.15) *
                                    static_cast<double>(baked.items.size() / baked.channels);
}

}  // namespace

void addLevels(BakedVolume& baked, const IntBox& box, int count) {
    const size_t channels = baked.channels;
    for (int i = 0; i < count; ++i) {
        const SparseTable& finer = i == 0 ? baked.table : baked.levels.back().table;
        const int64_t size = int64_t{1} << finer.itemShift();
        if (largestExtent(finer.occupiedBox()) <= 4 * size) {
            return;
        }
        baked.levels.push_back(nextLevel(finer, box, channels, [&](size_t item, size_t c) {
            return i == 0 ? baked.items[item * channels + c].mean
                          : baked.levels[static_cast<size_t>(i) - 1].values[item * channels + c];
        }));
    }
}

void addPreview(BakedVolume& baked, BrickPages& pages, uint64_t sidecarBytes) {
    const DensityField& field = pages.field();
    const auto brickCount = static_cast<double>(pages.bricks().size());
    constexpr int64_t kFinest =
        160;                       // cubes along the longest edge: about three pixels of 512 each
    constexpr double kCube = 3.9;  // bytes a channel, of values and their nodes
    const double room = static_cast<double>(sidecarBytes) - estimatedBytes(baked) - kGridBytes;
    const auto bytesOf = [&](double cubes) {
        return kCube * cubes * static_cast<double>(field.channels());
    };
    const int64_t extent = largestExtent(field.box());
    for (int shift = 0; shift < baked.superVoxelShift; ++shift) {
        // Bricks may hold much emptiness, but not so much.
        const double most = brickCount * std::pow(8.0, DensityField::kBrickShift - shift);
        if (extent >> shift > kFinest || bytesOf(most / 4) > room) {
            continue;
        }
        ValueTable means = meansOf(pages, shift);
        if (bytesOf(static_cast<double>(means.table.occupiedItems())) <= room) {
            baked.previewSize = 1 << shift;
            baked.preview = std::move(means);
            return;
        }
    }
}

void coarsenPreview(BakedVolume& baked, const DensityField& field) {
    baked.previewSize *= 2;
    if (baked.previewSize >= baked.superVoxelSize()) {
        baked.previewSize = 0;
        baked.preview = {};
        return;
    }
    const ValueTable& finer = baked.preview;
    baked.preview =
        nextLevel(finer.table, field.box(), field.channels(),
                  [&](size_t item, size_t c) { return finer.values[item * field.channels() + c]; });
}

}  // namespace trk
