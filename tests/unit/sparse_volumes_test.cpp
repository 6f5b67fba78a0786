// SPDX-License-Identifier: Apache-2.0
// Volumes whose box or tiles are enormous must cost what their leaves cost.
#include "bake/verify.h"
#include "support/fixtures.h"
#include "support/rays.h"
#include "track/track.hpp"

#include <gtest/gtest.h>

#include <cmath>
#include <cstdio>
#include <filesystem>
#include <fstream>
#include <random>
#include <string>

namespace {

/// A line of /proc/self/status, in kB: VmRSS (resident now) or VmHWM (its peak).
long statusKilobytes(const std::string& key) {
    std::ifstream stream("/proc/self/status");
    std::string line;
    while (std::getline(stream, line)) {
        if (line.compare(0, key.size() + 1, key + ":") == 0) {
            return std::stol(line.substr(key.size() + 1));
        }
    }
    return -1;
}

void resetPeak() {
    std::ofstream("/proc/self/clear_refs") << 5;
}

/// Bakes, opens and answers 1e5 rays; the peak of resident memory over all of it, in kB.
long peakOf(const std::string& vdb, const std::vector<TrkRay>& all, double& meanTransmittance) {
    const std::string sidecar = vdb + ".track.vdb";
    resetPeak();
    const long before = statusKilobytes("VmRSS");
    fixtures::bake(vdb, sidecar, 16, 4);
    const track::Volume volume = track::Volume::open(vdb, sidecar.c_str());
    std::vector<float> transmittance(all.size());
    track::Query query(0, 0);
    query.flags = TRK_QUERY_EXACT_FALLBACK;  // transmittances are below what roulette leaves
    volume.estimateTransmittance(query, all.data(), all.size(), transmittance.data());
    meanTransmittance = 0;
    for (const float t : transmittance) {
        meanTransmittance += static_cast<double>(t) / static_cast<double>(all.size());
    }
    const long peak = statusKilobytes("VmHWM") - before;
    std::printf("baked, opened and answered %zu rays in %ld kB more than before\n", all.size(),
                peak);
    return peak;
}

TEST(SparseVolumes, TwoPuffsFarApart) {
    auto grid = fixtures::makeBlob(32);
    const openvdb::Coord offset(100000, 100000, 100000);
    auto second = fixtures::makeBlob(32);
    for (auto it = second->cbeginValueOn(); it; ++it) {
        grid->tree().setValue(it.getCoord() + offset, *it);
    }
    const std::string vdb = fixtures::write("puffs.vdb", {grid});
    second.reset();
    grid.reset();
    // Along the diagonal, through both puffs.
    std::vector<TrkRay> all(100000);
    for (size_t i = 0; i < all.size(); ++i) {
        const float offsetX = static_cast<float>(i % 100) * 0.1f;
        all[i] = {{-10 + offsetX, -10, -10}, 0, {1, 1, 1}, rays::kInfinity};
    }
    double mean = 0;
    const long peak = peakOf(vdb, all, mean);
    EXPECT_GT(mean, 0);
    EXPECT_LT(mean, 0.5);
    if (!fixtures::kSanitized) {
        EXPECT_LT(peak, 64 * 1024);
    }
    const track::Volume volume = track::Volume::open(vdb, (vdb + ".track.vdb").c_str());
    track::Query query(0, 0);
    float transmittance = 0;
    track::Statistics statistics(1, 1);
    volume.estimateTransmittance(query, all.data(), 1, &transmittance, statistics.view());
    EXPECT_LT(statistics.superVoxels[0], 20u);
}

TEST(SparseVolumes, AHugeConstantTile) {
    openvdb::initialize();
    auto grid = openvdb::FloatGrid::create();
    grid->setName("density");
    grid->tree().addTile(3, openvdb::Coord(0, 0, 0), 0.001f, true);
    const std::string vdb = fixtures::write("hugetile.vdb", {grid});
    grid.reset();
    const rays::Box box{{0, 0, 0}, {4096, 4096, 4096}};
    double mean = 0;
    const long peak = peakOf(vdb, rays::through(box, 100000, 8000, 5), mean);
    EXPECT_GT(mean, 0.01);
    EXPECT_LT(mean, 0.9);
    if (!fixtures::kSanitized) {
        EXPECT_LT(peak, 64 * 1024);
    }
}

TEST(SparseVolumes, AnOpenedCloudStaysNearItsGridInMemory) {
    const std::string vdb = fixtures::cloudFile(256);
    // Without its bricks: once the heap has freed a large block, it keeps the next ones.
    trk::DensityOptions summaryAlone;
    summaryAlone.bricks = trk::Bricks::kNone;
    const uint64_t gridBytes = trk::loadDensity(vdb, summaryAlone).summary.gridBytes;
    // Threads, registries and caches first: they are not the volume's.
    track::Volume::open(fixtures::cloudFile(64), "");
    const long before = statusKilobytes("VmRSS");
    const track::Volume volume = track::Volume::open(vdb, "");
    const double resident = 1024.0 * static_cast<double>(statusKilobytes("VmRSS") - before);
    std::printf("grid %.3g bytes, volume %.3g, resident %.3g: %.2f x the grid\n",
                static_cast<double>(gridBytes), static_cast<double>(volume.info().bytes), resident,
                resident / static_cast<double>(gridBytes));
    EXPECT_LT(static_cast<double>(volume.info().bytes), 1.7 * static_cast<double>(gridBytes));
    if (!fixtures::kSanitized) {
        EXPECT_LT(resident, 1.7 * static_cast<double>(gridBytes));
    }
}

TEST(SparseVolumes, AThousandScatteredVoxels) {
    openvdb::initialize();
    size_t bytes[2];
    const int counts[2] = {100, 1000};
    for (int i = 0; i < 2; ++i) {
        auto grid = openvdb::FloatGrid::create();
        grid->setName("density");
        std::mt19937 random(7);
        std::uniform_int_distribution<int> place(-1000000000, 1000000000);
        for (int k = 0; k < counts[i]; ++k) {
            grid->tree().setValueOn(openvdb::Coord(place(random), place(random), place(random)),
                                    0.5f + 1e-4f * static_cast<float>(k));
        }
        const std::string vdb = fixtures::write("scattered.vdb", {grid});
        grid.reset();
        const std::string sidecar = fixtures::path("scattered.track.vdb");
        const trk::Density density = fixtures::load(vdb);
        bytes[i] = density.field.bytes();
        fixtures::bake(vdb, sidecar, 16, 4);
        // Each of its grids has masks of 9 kB a region of 4096^3, as the density's file has.
        EXPECT_LT(std::filesystem::file_size(sidecar), 11 * std::filesystem::file_size(vdb));
        const trk::Sidecar read = trk::readSidecar(sidecar, &density.summary, TRK_CHECK_FULL);
        const vdbtools::VerifyReport report = vdbtools::verify(density.summary, read);
        EXPECT_TRUE(report.holds) << report.counterexample;
        EXPECT_LT(report.vertices, 2u * 4913u * static_cast<unsigned>(counts[i]));
    }
    EXPECT_LT(bytes[1], 10000u * 1000u);
    EXPECT_LT(bytes[1], 10.5 * static_cast<double>(bytes[0]));
}

TEST(SparseVolumes, EqualTilesAreOne) {
    openvdb::initialize();
    auto grid = openvdb::FloatGrid::create();
    grid->setName("density");
    const int edge = fixtures::kSanitized ? 6 : 32;
    for (int i = 0; i < edge * edge * edge; ++i) {
        grid->tree().addTile(
            2, openvdb::Coord(128 * (i / (edge * edge)), 128 * (i / edge % edge), 128 * (i % edge)),
            0.01f, true);
    }
    const std::string vdb = fixtures::write("equaltiles.vdb", {grid});
    const std::string sidecar = fixtures::path("equaltiles.track.vdb");
    const trk::Density density = fixtures::load(vdb);
    EXPECT_LT(density.field.bytes(), 1000000u);
    EXPECT_LT(density.field.brickCount(), 30u);
    fixtures::bake(vdb, sidecar, 16);
    const trk::Sidecar read = trk::readSidecar(sidecar, &density.summary, TRK_CHECK_FULL);
    EXPECT_LT(read.baked.items.size(), 30u);
    const vdbtools::VerifyReport report = vdbtools::verify(density.summary, read);
    EXPECT_TRUE(report.holds) << report.counterexample;
    EXPECT_LT(report.vertices, 1000000u);
}

// Of what lies between two tiles there are three faces, three edges and a corner a tile, and as
// much again where the outermost tiles end.
TEST(SparseVolumes, DifferentTilesCostTheirSidesOnce) {
    openvdb::initialize();
    auto grid = openvdb::FloatGrid::create();
    grid->setName("density");
    const int edge = 4;
    const int tiles = edge * edge * edge;
    for (int i = 0; i < tiles; ++i) {
        grid->tree().addTile(
            2, openvdb::Coord(128 * (i / (edge * edge)), 128 * (i / edge % edge), 128 * (i % edge)),
            0.01f * static_cast<float>(i + 1), true);
    }
    const trk::Density density = fixtures::load(fixtures::write("differenttiles.vdb", {grid}));
    const int sides = (edge + 1) * (edge + 1) * (edge + 1) * 8;
    EXPECT_LT(density.field.brickCount(), static_cast<size_t>(sides));
    EXPECT_LT(trk::estimateBake(density.field, fixtures::bakeOptions(16, 4)).superVoxels,
              static_cast<uint64_t>(sides));
}

TEST(SparseVolumes, ALargeTileIsProvedToo) {
    openvdb::initialize();
    auto grid = openvdb::FloatGrid::create();
    grid->setName("density");
    grid->tree().addTile(2, openvdb::Coord(0, 0, 0), 0.5f, true);
    grid->tree().addTile(2, openvdb::Coord(128, 0, 0), 0.5f, true);
    grid->tree().addTile(2, openvdb::Coord(0, 128, 0), 0.25f, true);
    const std::string vdb = fixtures::write("tiles128.vdb", {grid});
    const std::string sidecar = fixtures::path("tiles128.track.vdb");
    fixtures::bake(vdb, sidecar, 4);
    const trk::Density density = fixtures::load(vdb);
    const trk::Sidecar read = trk::readSidecar(sidecar, &density.summary, TRK_CHECK_FULL);
    const vdbtools::VerifyReport report = vdbtools::verify(density.summary, read);
    EXPECT_TRUE(report.holds) << report.counterexample;
}

}  // namespace
