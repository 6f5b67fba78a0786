// SPDX-License-Identifier: Apache-2.0
// The sidecar: what is written is read, and nothing that does not fit is accepted.
#include "io/sidecar.h"
#include "field/table_builder.h"

#include "bake/bake.h"
#include "bake/verify.h"
#include "bake/write_bake.h"
#include "failure.h"
#include "io/vdb_file.h"
#include "support/fixtures.h"

#include <gtest/gtest.h>

#include <cstdio>
#include <cstring>
#include <ctime>
#include <filesystem>
#include <functional>
#include <map>

namespace {

using openvdb::Coord;
using Grids = std::map<std::string, openvdb::GridBase::Ptr>;

struct Baked {
    std::string vdb;
    std::string sidecar;
    trk::Density density;
};

Baked makeBaked(const std::string& name, int size = 8) {
    auto grid = fixtures::makeBlob(45);
    grid->tree().addTile(1, Coord(16, 16, 16), 0.5f, true);
    grid->transform().postTranslate(openvdb::Vec3d(3, 4, 5));
    grid->transform().preScale(0.1);
    Baked baked;
    baked.vdb = fixtures::write(name + ".vdb", {grid});
    baked.sidecar = fixtures::path(name + ".track.vdb");
    fixtures::bake(baked.vdb, baked.sidecar, size);
    baked.density = fixtures::load(baked.vdb);
    return baked;
}

/// Rewrites a sidecar after `change` had its way with the grids.
std::string altered(const Baked& baked, const std::string& name,
                    const std::function<void(Grids&)>& change) {
    openvdb::io::File file(baked.sidecar);
    file.open();
    Grids grids;
    const openvdb::GridPtrVecPtr read = file.getGrids();
    for (const auto& grid : *read) {
        grids[grid->getName()] = grid;
    }
    change(grids);
    openvdb::GridCPtrVec all;
    for (const auto& [ignored, grid] : grids) {
        all.push_back(grid);
    }
    return fixtures::write(name, all);
}

openvdb::FloatGrid& floatGrid(Grids& grids, const std::string& name) {
    return *openvdb::gridPtrCast<openvdb::FloatGrid>(grids.at(name));
}

void expectRefused(const trk::DensitySummary& density, const std::string& sidecar, TrkStatus status,
                   const std::string& text) {
    try {
        trk::readSidecar(sidecar, &density, TRK_CHECK_FULL);
        ADD_FAILURE() << "accepted; expected: " << text;
    } catch (const trk::Error& e) {
        EXPECT_EQ(e.status(), status) << e.what();
        EXPECT_NE(std::string(e.what()).find(text), std::string::npos) << e.what();
        EXPECT_NE(std::string(e.what()).find(sidecar), std::string::npos) << e.what();
    }
}

TEST(Sidecar, ReadsBackWhatWasWritten) {
    for (const int size : {4, 16, 64}) {
        const Baked baked = makeBaked("roundtrip" + std::to_string(size), size);
        const trk::BakedVolume expected =
            trk::bake(baked.density.field, fixtures::bakeOptions(size, 2));
        const trk::Sidecar read =
            trk::readSidecar(baked.sidecar, &baked.density.summary, TRK_CHECK_FULL);
        EXPECT_EQ(read.header.superVoxelSize, size);
        EXPECT_EQ(read.header.digest, baked.density.summary.digest);
        EXPECT_EQ(read.baked.levels.size(), expected.levels.size());
        EXPECT_EQ(read.baked.levels.size(), size == 4 ? 2u : 0u);
        size_t compared = 0;
        expected.table.forEach([&](const trk::Int3& lo, int, trk::SparseTable::Entry entry) {
            const auto found = read.baked.table.find(lo[0], lo[1], lo[2]);
            ASSERT_NE(found.entry, trk::SparseTable::kEmpty);
            EXPECT_EQ(std::memcmp(&read.baked.items[found.entry - 1], &expected.items[entry - 1],
                                  sizeof(trk::BakedSuperVoxel)),
                      0);
            ++compared;
        });
        EXPECT_GT(compared, 0u);
        const trk::Sidecar alone = trk::readSidecar(baked.sidecar, nullptr, TRK_CHECK_FULL);
        for (int a = 0; a < 3; ++a) {
            EXPECT_NEAR(alone.header.indexToWorld.translation[a],
                        baked.density.summary.indexToWorld.translation[a], 1e-12);
            EXPECT_NEAR(alone.header.indexToWorld.linear[a][a], 0.1, 1e-15);
        }
    }
}

TEST(Sidecar, IsAPlainVdbWhoseGridsLieOverTheSource) {
    const Baked baked = makeBaked("plain", 8);
    openvdb::io::File file(baked.sidecar);
    file.open();
    for (const char* name : {"density_control", "density_majorant", "density_rms", "density_min",
                             "density_max", "density_gradient", "density_control_level_1"}) {
        ASSERT_TRUE(file.hasGrid(name)) << name;
        const auto grid = file.readGrid(name);
        EXPECT_EQ(grid->metaValue<std::string>("track_format"), "2.0");
        EXPECT_EQ(grid->metaValue<std::string>("track_source_grid"), "density");
        EXPECT_EQ(grid->metaValue<int32_t>("track_super_voxel_size"), 8);
    }
    const auto control = file.readGrid("density_control");
    // The volume begins at index -1, so that index 0 is at -16, a multiple of the coarsest
    // level's 16. Index i lies at source index 8 i + 4 - 16, in world space 0.1 (8 i - 12) + (3, 4,
    // 5).
    const openvdb::Vec3d world = control->indexToWorld(openvdb::Vec3d(2, 3, 4));
    EXPECT_NEAR(world.x(), 0.1 * 4 + 3, 1e-12);
    EXPECT_NEAR(world.z(), 0.1 * 20 + 5, 1e-12);
    const auto level = file.readGrid("density_control_level_1");
    EXPECT_NEAR(level->indexToWorld(openvdb::Vec3d(1, 0, 0)).x(), 0.1 * 8 + 3, 1e-12);
}

TEST(Sidecar, EmptyVolumesHaveSidecarsToo) {
    openvdb::initialize();
    auto grid = openvdb::FloatGrid::create();
    grid->setName("density");
    const std::string vdb = fixtures::write("nothing.vdb", {grid});
    const std::string sidecar = fixtures::path("nothing.track.vdb");
    fixtures::bake(vdb, sidecar, 16);
    const trk::Density density = fixtures::load(vdb);
    const trk::Sidecar read = trk::readSidecar(sidecar, &density.summary, TRK_CHECK_FULL);
    EXPECT_TRUE(read.baked.items.empty());
}

TEST(Sidecar, UnnamedAndDoubleSources) {
    openvdb::initialize();
    auto grid = openvdb::DoubleGrid::create();
    for (int i = 0; i < 30; ++i) {
        grid->tree().setValue(Coord(i, i, 3), 0.1 * i);
    }
    const std::string vdb = fixtures::write("nameless.vdb", {grid});
    const std::string sidecar = fixtures::path("nameless.track.vdb");
    fixtures::bake(vdb, sidecar, 4);
    const trk::Density density = fixtures::load(vdb);
    const trk::Sidecar read = trk::readSidecar(sidecar, &density.summary, TRK_CHECK_FULL);
    EXPECT_EQ(read.header.valueType, "double");
    EXPECT_TRUE(vdbtools::verify(density.summary, read).holds);
    openvdb::io::File file(sidecar);
    file.open();
    EXPECT_TRUE(file.readGrid("density_control")->isType<openvdb::DoubleGrid>());
}

TEST(Sidecar, RefusesAnotherDensityGridOrTransform) {
    const Baked baked = makeBaked("mismatch");
    trk::DensitySummary other = baked.density.summary;
    other.digest ^= 1;
    expectRefused(other, baked.sidecar, TRK_ERROR_SIDECAR_MISMATCH, "baked from other voxels");
    EXPECT_NO_THROW(trk::readSidecar(baked.sidecar, &other, TRK_CHECK_METADATA));
    other = baked.density.summary;
    other.grid.name = "heat";
    expectRefused(other, baked.sidecar, TRK_ERROR_SIDECAR_MISMATCH, "baked from grid \"density\"");
    other = baked.density.summary;
    other.indexToWorld.linear[1][1] *= 1.001;
    expectRefused(other, baked.sidecar, TRK_ERROR_SIDECAR_MISMATCH, "another transform");
    other = baked.density.summary;
    other.valueType = "double";
    expectRefused(other, baked.sidecar, TRK_ERROR_SIDECAR_MISMATCH, "baked from a float grid");
}

TEST(Sidecar, RefusesNewerFormatsAndForeignFiles) {
    const Baked baked = makeBaked("format");
    const auto withFormat = [&](const char* name, const char* format) {
        return altered(baked, name, [&](Grids& grids) {
            for (auto& [ignored, grid] : grids) {
                grid->insertMeta("track_format", openvdb::StringMetadata(format));
            }
        });
    };
    expectRefused(baked.density.summary, withFormat("newer.vdb", "3.0"), TRK_ERROR_SIDECAR_MISMATCH,
                  "format 3.0");
    expectRefused(baked.density.summary, withFormat("older.vdb", "1.0"), TRK_ERROR_SIDECAR_MISMATCH,
                  "bake again");
    EXPECT_NO_THROW(
        trk::readSidecar(withFormat("minor.vdb", "2.7"), &baked.density.summary, TRK_CHECK_FULL));
    expectRefused(baked.density.summary, withFormat("odd.vdb", "x"), TRK_ERROR_BAD_FILE,
                  "format is");
    expectRefused(baked.density.summary, baked.vdb, TRK_ERROR_BAD_FILE, "expected a sidecar");
    const std::string extra = altered(baked, "extra.vdb", [](Grids& grids) {
        auto grid = openvdb::FloatGrid::create();
        grid->setName("density_something_new");
        grids[grid->getName()] = grid;
    });
    EXPECT_NO_THROW(trk::readSidecar(extra, &baked.density.summary, TRK_CHECK_FULL));
}

TEST(Sidecar, RefusesMissingOrMixedGrids) {
    const Baked baked = makeBaked("missing");
    for (const char* name : {"density_control", "density_majorant", "density_rms", "density_min",
                             "density_max", "density_gradient", "density_control_level_1"}) {
        const std::string file =
            altered(baked, "missing-one.vdb", [&](Grids& grids) { grids.erase(name); });
        expectRefused(baked.density.summary, file, TRK_ERROR_BAD_FILE,
                      std::string(name) == "density_control" ? "" : name);
    }
    const std::string mixed = altered(baked, "mixed.vdb", [](Grids& grids) {
        grids["density_max"]->insertMeta("track_source_digest", openvdb::StringMetadata("0"));
    });
    expectRefused(baked.density.summary, mixed, TRK_ERROR_BAD_FILE, "another bake");
}

TEST(Sidecar, RefusesImplausibleBounds) {
    const Baked baked = makeBaked("bounds");
    const Coord at(4, 5, 5);
    const auto with = [&](const std::string& grid, float value) {
        return altered(baked, "bounds-changed.vdb", [&](Grids& grids) {
            floatGrid(grids, "density_" + grid).tree().setValue(at, value);
        });
    };
    const float nan = std::numeric_limits<float>::quiet_NaN();
    expectRefused(baked.density.summary, with("majorant", 0), TRK_ERROR_BAD_FILE,
                  "majorant 0 with an RMS above 0");
    expectRefused(baked.density.summary, with("majorant", 1e-5f), TRK_ERROR_BAD_FILE,
                  "does not bound");
    expectRefused(baked.density.summary, with("max", nan), TRK_ERROR_BAD_FILE, "NaN");
    expectRefused(baked.density.summary, with("min", -1), TRK_ERROR_BAD_FILE, "negative");
    expectRefused(baked.density.summary, with("control", 100), TRK_ERROR_BAD_FILE,
                  "between min and max");
    expectRefused(baked.density.summary, with("rms", 100), TRK_ERROR_BAD_FILE,
                  "RMS above its majorant");
    const std::string hole = altered(baked, "hole.vdb", [&](Grids& grids) {
        floatGrid(grids, "density_max").tree().setActiveState(at, false);
    });
    expectRefused(baked.density.summary, hole, TRK_ERROR_BAD_FILE, "not active in the same");
}

TEST(Sidecar, LevelsOfFarPartsAreReadWhole) {
    // Roots of a level's tree are larger than the anchor's step: regions straddle them.
    auto grid = fixtures::makeGrid(openvdb::CoordBBox(0, 0, 0, 19, 19, 19),
                                   [](const Coord&) { return 1.0f; });
    auto far = openvdb::FloatGrid::create();
    for (const int offset : {262300, 3200000}) {
        for (auto it = grid->cbeginValueOn(); it; ++it) {
            far->tree().setValue(it.getCoord() + Coord(offset), *it);
        }
    }
    far->setName("density");
    const std::string vdb = fixtures::write("far-levels.vdb", {far});
    const trk::Density density = fixtures::load(vdb);
    for (const int size : {4, 16, 64}) {
        const std::string sidecar = fixtures::path("far-levels.track.vdb");
        fixtures::bake(vdb, sidecar, size, 8);
        const trk::BakedVolume baked = trk::bake(density.field, fixtures::bakeOptions(size, 8));
        const trk::Sidecar read = trk::readSidecar(sidecar, &density.summary, TRK_CHECK_FULL);
        EXPECT_EQ(read.baked.table.occupiedItems(), baked.table.occupiedItems());
        ASSERT_EQ(read.baked.levels.size(), 8u);
        for (size_t level = 0; level < 8; ++level) {
            EXPECT_EQ(read.baked.levels[level].table.occupiedItems(),
                      baked.levels[level].table.occupiedItems())
                << "size " << size << " level " << level + 1;
        }
    }
}

/// A ball of n^3 voxels with some texture, at an offset.
openvdb::FloatGrid::Ptr ballAt(int n, const Coord& offset) {
    auto ball = openvdb::FloatGrid::create();
    ball->setName("density");
    const auto blob = fixtures::makeBlob(n);
    for (auto it = blob->cbeginValueOn(); it; ++it) {
        ball->tree().setValue(it.getCoord() + offset, *it);
    }
    return ball;
}

// OpenVDB's nodes have masks that it does not compress: a tree that straddles eight of them costs
// 0.7 MB.
TEST(Sidecar, OfASmallVolumeIsSmallWhereverThatLies) {
    std::vector<float> controls;
    for (const Coord& offset : {Coord(0), Coord(-10), Coord(4090, -4100, 65530),
                                Coord(-7, 100, 8185), Coord(2000000000, -2000000000, 5)}) {
        const std::string vdb = fixtures::write("ball.vdb", {ballAt(20, offset)});
        const trk::Density density = fixtures::load(vdb);
        trk::BakeOptions options = fixtures::bakeOptions(16, 4);
        options.sidecarBytes =
            trk::sidecarLimit(density.summary.fileBytes, trk::ControlKind::kConstant);
        const trk::BakedVolume baked = trk::bake(density.field, options);
        const std::string sidecar = fixtures::path("ball.track.vdb");
        trk::OutputFile file(sidecar, true);
        trk::writeSidecar(file, trk::sidecarHeader(density.summary, density.field, baked), baked,
                          density.summary.anchor);
        file.commit();
        EXPECT_LE(std::filesystem::file_size(sidecar), 100000u) << offset;
        EXPECT_GT(baked.previewSize, 0) << offset;
        const trk::Sidecar read =
            trk::readSidecar(sidecar, &density.summary, TRK_CHECK_FULL, trk::SidecarParts::kAll);
        EXPECT_TRUE(vdbtools::verify(density.summary, read).holds) << offset;
        EXPECT_EQ(read.baked.previewSize, baked.previewSize);
        EXPECT_EQ(read.baked.preview.table.occupiedItems(), baked.preview.table.occupiedItems());
        const trk::Sidecar alone = trk::readSidecar(sidecar, nullptr, TRK_CHECK_FULL);
        for (size_t a = 0; a < 3; ++a) {
            const int axis = static_cast<int>(a);
            EXPECT_NEAR(alone.header.indexToWorld.translation[axis], 0, 2e-6) << offset;
            EXPECT_LE(alone.header.origin[a], offset[static_cast<unsigned>(a)] - 1);
        }
    }
}

// OpenVDB's own way of making a map loses its scale where the translation is large.
TEST(Sidecar, FitsItsDensityAnywhereAndAtAnyVoxelSize) {
    for (const double voxel : {0.1, 0.3, 1e-3, 7e5}) {
        for (const int offset : {1000000, 50000000, 1000000000, 2147000000}) {
            const auto ball = ballAt(20, Coord(offset, -offset, 5));
            ball->setTransform(openvdb::math::Transform::createLinearTransform(voxel));
            const std::string vdb = fixtures::write("far-ball.vdb", {ball});
            const std::string sidecar = fixtures::path("far-ball.track.vdb");
            fixtures::bake(vdb, sidecar, 16, 2);
            const trk::Density density = fixtures::load(vdb);
            EXPECT_NO_THROW(trk::readSidecar(sidecar, &density.summary, TRK_CHECK_FULL))
                << voxel << " " << offset;
            const trk::Sidecar alone = trk::readSidecar(sidecar, nullptr, TRK_CHECK_FULL);
            for (int a = 0; a < 3; ++a) {
                EXPECT_EQ(alone.header.indexToWorld.linear[a][a], voxel);
                EXPECT_NEAR(alone.header.indexToWorld.translation[a], 0, 1e-6 * voxel);
            }
        }
    }
}

// Empty space costs nothing to read, wherever the grids' own corner lies.
TEST(Sidecar, OfVoxelsAtTheEndsOfTheWorldOpensInNoTime) {
    auto grid = openvdb::FloatGrid::create();
    grid->setName("density");
    for (const Coord& at : {Coord(-2000000000, 5, 1999999999), Coord(3), Coord(100000),
                            Coord(2000000000, -2000000000, 7)}) {
        grid->tree().setValue(at, 1.0f);
    }
    const std::string vdb = fixtures::write("ends.vdb", {grid});
    const std::string sidecar = fixtures::path("ends.track.vdb");
    fixtures::bake(vdb, sidecar, 16, 4);
    const trk::Density density = fixtures::load(vdb);
    const std::clock_t start = std::clock();
    const trk::Sidecar read = trk::readSidecar(sidecar, &density.summary, TRK_CHECK_FULL);
    std::printf("%.3f s\n", static_cast<double>(std::clock() - start) / CLOCKS_PER_SEC);
    EXPECT_EQ(read.baked.table.occupiedItems(),
              trk::bake(density.field, fixtures::bakeOptions(16, 4)).table.occupiedItems());
}

TEST(Sidecar, GradientsAreOfEveryKindAndReadBack) {
    const Baked baked = makeBaked("gradients", 8);
    for (const auto kind :
         {trk::ControlKind::kConstant, trk::ControlKind::kAffine, trk::ControlKind::kTrilinear}) {
        fixtures::bake(baked.vdb, baked.sidecar, 8, 2, kind);
        const trk::BakedVolume expected =
            trk::bake(baked.density.field, fixtures::bakeOptions(8, 2, kind));
        const trk::Sidecar read = trk::readSidecar(baked.sidecar, &baked.density.summary,
                                                   TRK_CHECK_FULL, trk::SidecarParts::kAll);
        size_t sloped = 0;
        expected.table.forEach([&](const trk::Int3& lo, int, trk::SparseTable::Entry entry) {
            const auto found = read.baked.table.find(lo[0], lo[1], lo[2]).entry;
            const size_t a = 3 * trk::SparseTable::index(entry);
            const size_t b = 3 * trk::SparseTable::index(found);
            for (size_t k = 0; k < 3; ++k) {
                EXPECT_EQ(read.baked.gradients[b + k], expected.gradients[a + k]);
                sloped += expected.gradients[a + k] != 0 ? 1 : 0;
            }
        });
        EXPECT_GT(sloped, 100u);
        EXPECT_TRUE(vdbtools::verify(baked.density.summary, read).holds);
        const std::string wrong = altered(baked, "wrong-gradient.vdb", [](Grids& grids) {
            const auto grid =
                openvdb::gridPtrCast<openvdb::Vec3SGrid>(grids.at("density_gradient"));
            auto it = grid->beginValueOn();
            while (it->x() == 0) {
                ++it;
            }
            it.setValue(openvdb::Vec3f(1.001f * it->x(), it->y(), it->z()));
        });
        const trk::Sidecar lie = trk::readSidecar(wrong, &baked.density.summary, TRK_CHECK_FULL,
                                                  trk::SidecarParts::kAll);
        EXPECT_NE(vdbtools::verify(baked.density.summary, lie).counterexample, "");
    }
}

// Of grids of one name, the sidecar of each bears its index.
TEST(Sidecar, OfOneOfSeveralGridsOfANameBearsItsIndex) {
    const std::string vdb =
        fixtures::write("twins.vdb", {fixtures::makeBlob(20), fixtures::makeBlob(30)});
    const trk::Density density = fixtures::load(vdb, "density[1]");
    const trk::BakedVolume baked = trk::bake(density.field, fixtures::bakeOptions(8, 1));
    const std::string sidecar = fixtures::path("twins.track.vdb");
    trk::OutputFile file(sidecar, true);
    trk::writeSidecar(file, trk::sidecarHeader(density.summary, density.field, baked), baked,
                      density.summary.anchor);
    file.commit();
    openvdb::io::File grids(sidecar);
    grids.open();
    EXPECT_TRUE(grids.hasGrid("density[1]_control"));
    EXPECT_EQ(trk::readSidecarHeader(sidecar).source.index, 1);
    EXPECT_TRUE(vdbtools::verify(density.summary,
                                 trk::readSidecar(sidecar, &density.summary, TRK_CHECK_FULL))
                    .holds);
}

TEST(Sidecar, RefusesGridsThatCoverDifferentBoxes) {
    const Baked baked = makeBaked("boxes");
    const std::string empty = altered(baked, "box-empty.vdb", [&](Grids& grids) {
        floatGrid(grids, "density_rms").tree().clear();
        floatGrid(grids, "density_control").tree().setValue(Coord(1000000), 1.0f);
    });
    expectRefused(baked.density.summary, empty, TRK_ERROR_BAD_FILE, "");
}

TEST(Verify, FindsAMissingHaloAroundATile) {
    openvdb::initialize();
    auto grid = openvdb::FloatGrid::create();
    grid->setName("density");
    grid->tree().addTile(2, Coord(0, 0, 0), 1.0f, true);
    const std::string vdb = fixtures::write("halo.vdb", {grid});
    const trk::Density density = fixtures::load(vdb);
    // A bake that takes the tile for constant up to its faces, where the field ramps down.
    trk::Sidecar wrong;
    wrong.anchor = density.summary.anchor;
    wrong.baked.superVoxelShift = 3;
    const int64_t lo = -density.summary.anchor[0];
    wrong.baked.table =
        trk::TableBuilder(3, {{{lo - 8, lo - 8, lo - 8}}, {{lo + 128, lo + 128, lo + 128}}})
            .fill(
                {}, [](const trk::Int3&, int) { return std::nullopt; },
                [](const trk::Int3&) { return 1u; });
    wrong.baked.items.push_back({1, 1, 1, 0, 0, 0});
    EXPECT_NE(vdbtools::verify(density.summary, wrong).counterexample, "");
    wrong.baked.table =
        trk::TableBuilder(3, {{{lo, lo, lo}}, {{lo + 128, lo + 128, lo + 128}}})
            .fill(
                {},
                [&](const trk::Int3& at, int) -> std::optional<trk::SparseTable::Entry> {
                    const bool in = at[0] >= lo && at[1] >= lo && at[2] >= lo;
                    return in ? 1u : 0u;
                },
                [](const trk::Int3&) { return 1u; });
    EXPECT_NE(vdbtools::verify(density.summary, wrong).counterexample.find("min 1"),
              std::string::npos);
}

TEST(Verify, ProvesAGoodBakeAndFindsEveryLie) {
    const Baked baked = makeBaked("verify", 8);
    trk::Sidecar sidecar = trk::readSidecar(baked.sidecar, &baked.density.summary, TRK_CHECK_FULL);
    EXPECT_TRUE(vdbtools::verify(baked.density.summary, sidecar).holds);
    const auto verifyChanged = [&](float trk::BakedSuperVoxel::*field, float factor) {
        // The widest super-voxel, so that every change below matters.
        trk::Sidecar changed;
        changed.header = sidecar.header;
        changed.anchor = sidecar.anchor;
        changed.baked.superVoxelShift = sidecar.baked.superVoxelShift;
        changed.baked.table = sidecar.baked.table;
        changed.baked.items = sidecar.baked.items;
        size_t widest = 0;
        for (size_t i = 0; i < changed.baked.items.size(); ++i) {
            const auto& item = changed.baked.items[i];
            const auto& best = changed.baked.items[widest];
            if (item.min > 0 && (best.min == 0 || item.rms > best.rms)) {
                widest = i;
            }
        }
        changed.baked.items[widest].*field *= factor;
        return vdbtools::verify(baked.density.summary, changed).counterexample;
    };
    using V = trk::BakedSuperVoxel;
    EXPECT_NE(verifyChanged(&V::min, 1.001f).find("min"), std::string::npos);
    EXPECT_NE(verifyChanged(&V::max, 0.999f).find("max"), std::string::npos);
    EXPECT_NE(verifyChanged(&V::majorant, 0.999f).find("majorant"), std::string::npos);
    EXPECT_NE(verifyChanged(&V::rms, 0.999f).find("RMS"), std::string::npos);
    EXPECT_NE(verifyChanged(&V::mean, 1.00001f), "");

    trk::SparseTable::Entry dropped = 0;
    trk::Sidecar holed;
    holed.header = sidecar.header;
    holed.anchor = sidecar.anchor;
    holed.baked.superVoxelShift = sidecar.baked.superVoxelShift;
    holed.baked.items = sidecar.baked.items;
    holed.baked.table =
        trk::TableBuilder::mapped(sidecar.baked.table, [&](trk::SparseTable::Entry e) {
            if (dropped == 0) {
                dropped = e;
            }
            return e == dropped ? trk::SparseTable::kEmpty : e;
        });
    EXPECT_NE(
        vdbtools::verify(baked.density.summary, holed).counterexample.find("not in the sidecar"),
        std::string::npos);
}

}  // namespace
