// SPDX-License-Identifier: Apache-2.0
// Baked statistics against brute force; tiles, threads and sizes that must not matter.
#include "bake/bake.h"

#include "support/fixtures.h"

#include <gtest/gtest.h>
#include <tbb/global_control.h>

#include <cmath>
#include <cstring>
#include <map>

namespace {

using openvdb::Coord;
using trk::BakedSuperVoxel;
using trk::BakedVolume;
using trk::Int3;

/// Every occupied super-voxel by its index in index space.
std::map<Int3, BakedSuperVoxel> byIndex(const BakedVolume& baked, const Int3& anchor) {
    std::map<Int3, BakedSuperVoxel> result;
    const int64_t size = baked.superVoxelSize();
    baked.table.forEach([&](const Int3& lo, int shift, trk::SparseTable::Entry entry) {
        const int64_t count = (int64_t{1} << shift) / size;
        for (int64_t x = 0; x < count; ++x) {
            for (int64_t y = 0; y < count; ++y) {
                for (int64_t z = 0; z < count; ++z) {
                    const Int3 index{{(lo[0] + anchor[0]) / size + x,
                                      (lo[1] + anchor[1]) / size + y,
                                      (lo[2] + anchor[2]) / size + z}};
                    EXPECT_EQ(index[0] * size - anchor[0] - x * size, lo[0]);
                    result[index] = baked.items[entry - 1];
                }
            }
        }
    });
    return result;
}

bool sameBits(const BakedSuperVoxel& a, const BakedSuperVoxel& b) {
    return std::memcmp(&a, &b, sizeof(a)) == 0;
}

void expectSameBits(const BakedVolume& a, const Int3& anchorA, const BakedVolume& b,
                    const Int3& anchorB) {
    const auto left = byIndex(a, anchorA);
    const auto right = byIndex(b, anchorB);
    ASSERT_EQ(left.size(), right.size());
    for (const auto& [index, item] : left) {
        const auto other = right.find(index);
        ASSERT_NE(other, right.end());
        ASSERT_TRUE(sameBits(item, other->second));
    }
    ASSERT_EQ(a.levels.size(), b.levels.size());
    for (size_t i = 0; i < a.levels.size(); ++i) {
        EXPECT_EQ(a.levels[i].values, b.levels[i].values);
    }
}

/// The definition, vertex by vertex.
BakedSuperVoxel bruteForce(const openvdb::FloatGrid& grid, const Int3& index, int size) {
    auto accessor = grid.getConstAccessor();
    double sum = 0;
    double lo = 1e300;
    double hi = 0;
    std::vector<std::pair<double, double>> weighted;
    for (int x = 0; x <= size; ++x) {
        for (int y = 0; y <= size; ++y) {
            for (int z = 0; z <= size; ++z) {
                const double v = static_cast<double>(accessor.getValue(Coord(
                    static_cast<int>(index[0]) * size + x, static_cast<int>(index[1]) * size + y,
                    static_cast<int>(index[2]) * size + z)));
                double w = 1;
                for (const int i : {x, y, z}) {
                    w *= i == 0 || i == size ? 0.5 : 1;
                }
                weighted.emplace_back(v, w);
                sum += v * w;
                lo = std::min(lo, v);
                hi = std::max(hi, v);
            }
        }
    }
    const double cells = std::pow(size, 3);
    const double mean = sum / cells;
    double squares = 0;
    for (const auto& [v, w] : weighted) {
        squares += w * (v - mean) * (v - mean);
    }
    BakedSuperVoxel result;
    result.min = static_cast<float>(lo);
    result.max = static_cast<float>(hi);
    result.mean = static_cast<float>(mean);
    result.majorant = static_cast<float>(std::max(mean - lo, hi - mean));
    result.rms = static_cast<float>(std::sqrt(squares / cells));
    return result;
}

class BakeSizes : public testing::TestWithParam<int> {};

TEST_P(BakeSizes, StatisticsMatchTheirDefinition) {
    const int size = GetParam();
    auto grid = fixtures::makeBlob(45);
    grid->tree().addTile(1, Coord(16, 16, 16), 0.5f, true);
    grid->tree().addTile(1, Coord(-64, -64, -64), 0.75f, true);
    grid->tree().addTile(2, Coord(-256, 0, 0), 0.1f, true);
    const trk::Density d =
        fixtures::load(fixtures::write("stats" + std::to_string(size) + ".vdb", {grid}));
    const BakedVolume baked = trk::bake(d.field, fixtures::bakeOptions(size, 3));
    const auto items = byIndex(baked, d.summary.anchor);
    ASSERT_GT(items.size(), 8u);
    for (const auto& [index, item] : items) {
        const BakedSuperVoxel expected = bruteForce(*grid, index, size);
        EXPECT_EQ(item.min, expected.min);
        EXPECT_EQ(item.max, expected.max);
        EXPECT_GT(item.max, 0.0f);
        EXPECT_FLOAT_EQ(item.mean, expected.mean);
        EXPECT_NEAR(item.rms, expected.rms,
                    1e-6 * static_cast<double>(expected.mean + expected.rms) + 1e-12);
        // Outward: bounds of the float control, not of the mean before rounding.
        EXPECT_GE(static_cast<double>(item.majorant),
                  std::max(static_cast<double>(item.mean) - static_cast<double>(expected.min),
                           static_cast<double>(expected.max) - static_cast<double>(item.mean)));
        EXPECT_FLOAT_EQ(item.majorant, expected.majorant);
        EXPECT_LE(item.rms, item.majorant);
        if (item.min == item.max) {
            EXPECT_EQ(item.mean, item.min);
            EXPECT_EQ(item.majorant, 0.0f);
            EXPECT_EQ(item.rms, 0.0f);
        }
    }
    // Nothing that is not 0 is left out.
    for (auto it = grid->cbeginValueOn(); it; ++it) {
        if (!it.isVoxelValue()) {
            continue;
        }
        for (int corner = 0; corner < 8; ++corner) {
            Int3 index;
            for (size_t a = 0; a < 3; ++a) {
                const int64_t cell = it.getCoord()[a] - (corner >> a & 1);
                index[a] = (cell - ((cell % size) + size) % size) / size;
            }
            ASSERT_EQ(items.count(index), 1u);
        }
    }
}

TEST_P(BakeSizes, LevelsKeepTheMass) {
    const int size = GetParam();
    const trk::Density d = fixtures::load(fixtures::cloudFile(64));
    const BakedVolume baked = trk::bake(d.field, fixtures::bakeOptions(size, 3));
    const auto mass = [](const trk::SparseTable& table, const auto& valueOf) {
        double sum = 0;
        table.forEach([&](const Int3&, int shift, trk::SparseTable::Entry entry) {
            sum += std::pow(2.0, 3.0 * shift) * static_cast<double>(valueOf(entry - 1));
        });
        return sum;
    };
    const double total = mass(baked.table, [&](size_t i) { return baked.items[i].mean; });
    double voxels = 0;
    openvdb::io::File file(fixtures::cloudFile(64));
    file.open();
    const auto grid = openvdb::gridPtrCast<openvdb::FloatGrid>(file.readGrid("density"));
    for (auto it = grid->cbeginValueAll(); it; ++it) {
        voxels += static_cast<double>(*it);
    }
    EXPECT_NEAR(total, voxels, 1e-6 * voxels);
    ASSERT_EQ(baked.levels.size(), GetParam() == 4 ? 2u : GetParam() == 8 ? 1u : 0u);
    for (const trk::ValueTable& level : baked.levels) {
        EXPECT_NEAR(mass(level.table, [&](size_t i) { return level.values[i]; }), total,
                    1e-6 * total);
    }
}

INSTANTIATE_TEST_SUITE_P(Sizes, BakeSizes, testing::Values(4, 8, 16, 32, 64));

TEST(Bake, SameBitsWithAndWithoutTiles) {
    auto grid = fixtures::makeBlob(45);
    grid->tree().addTile(1, Coord(16, 16, 16), 0.5f, true);
    grid->tree().addTile(2, Coord(-128, 0, 0), 0.1f, true);
    const trk::Density tiled = fixtures::load(fixtures::write("tiled.vdb", {grid}));
    grid->tree().voxelizeActiveTiles();
    const trk::Density filled = fixtures::load(fixtures::write("filled.vdb", {grid}));
    EXPECT_NE(tiled.summary.digest, filled.summary.digest);
    for (const int size : {4, 8, 16, 32, 64}) {
        expectSameBits(trk::bake(tiled.field, fixtures::bakeOptions(size, 2)), tiled.summary.anchor,
                       trk::bake(filled.field, fixtures::bakeOptions(size, 2)),
                       filled.summary.anchor);
    }
}

TEST(Bake, SameBitsForAnyNumberOfThreads) {
    const trk::Density d = fixtures::load(fixtures::cloudFile(96));
    const BakedVolume all = trk::bake(d.field, fixtures::bakeOptions(8, 3));
    const tbb::global_control limit(tbb::global_control::max_allowed_parallelism, 1);
    const trk::Density again = fixtures::load(fixtures::cloudFile(96));
    EXPECT_EQ(again.summary.digest, d.summary.digest);
    expectSameBits(all, d.summary.anchor, trk::bake(again.field, fixtures::bakeOptions(8, 3)),
                   d.summary.anchor);
}

TEST(Bake, RealTiledAndFilledCloudsAgree) {
    TRACK_NEEDS_DATA();
    const std::string base = fixtures::dataFolder() + "/wdas_cloud_sixteenth";
    const trk::Density tiled = fixtures::load(base + ".vdb");
    const trk::Density filled = fixtures::load(base + "_filled.vdb");
    for (const int size : {4, 8, 16, 32, 64}) {
        expectSameBits(trk::bake(tiled.field, fixtures::bakeOptions(size, 4)), tiled.summary.anchor,
                       trk::bake(filled.field, fixtures::bakeOptions(size, 4)),
                       filled.summary.anchor);
    }
}

}  // namespace
