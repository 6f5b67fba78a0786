// SPDX-License-Identifier: Apache-2.0
// Densities of three channels: loading, baking, sidecars, proofs.
#include "bake/bake.h"
#include "bake/verify.h"
#include "failure.h"
#include "io/sidecar.h"
#include "support/fixtures.h"

#include <gtest/gtest.h>

#include <cmath>
#include <cstring>
#include <functional>
#include <limits>
#include <map>

namespace {

using openvdb::Coord;
using openvdb::CoordBBox;
using openvdb::Vec3f;
using trk::ControlKind;
using trk::SparseTable;

const std::vector<ControlKind> kKinds{ControlKind::kConstant, ControlKind::kTrilinear,
                                      ControlKind::kAffine};

/// Three channels of different shapes; the last is homogeneous in the middle.
openvdb::Vec3SGrid::Ptr makeColorBlob(int n) {
    const auto grey = fixtures::makeBlob(n);
    auto accessor = grey->getConstAccessor();
    return fixtures::makeColorGrid(CoordBBox(Coord(0), Coord(n - 1)), [&](const Coord& p) {
        const float a = accessor.getValue(p);
        const float b = accessor.getValue(Coord(p.y(), p.z(), p.x())) * 0.5f;
        return Vec3f(a, b, a > 0.1f ? 0.25f : 0.0f);
    });
}

void expectFailure(const std::string& path, TrkStatus status, const std::string& text) {
    try {
        trk::loadDensity(path, {});
        ADD_FAILURE() << "accepted; expected: " << text;
    } catch (const trk::Error& e) {
        EXPECT_EQ(e.status(), status) << e.what();
        EXPECT_NE(std::string(e.what()).find(text), std::string::npos) << e.what();
    }
}

TEST(Colour, VectorGridsAreLoadedChannelByChannel) {
    for (const bool half : {false, true}) {
        auto grid = makeColorBlob(40);
        grid->tree().addTile(1, Coord(64, 0, 0), Vec3f(0.5f, 0.25f, 1), true);
        grid->setSaveFloatAsHalf(half);
        const std::string path = fixtures::write("vectors.vdb", {grid});
        const trk::Density d = fixtures::load(path);
        EXPECT_EQ(d.summary.valueType, "vec3s");
        EXPECT_EQ(d.field.channels(), 3u);
        EXPECT_EQ(d.field.isHalf(), half);
        openvdb::io::File file(path);
        file.open();
        const auto read = openvdb::gridPtrCast<openvdb::Vec3SGrid>(file.readGrid("density"));
        auto accessor = read->getConstAccessor();
        for (const Coord& at :
             {Coord(20, 20, 20), Coord(7, 15, 20), Coord(16, 16, 16), Coord(67, 3, 3)}) {
            const auto found =
                d.field.density<3>({{static_cast<double>(at.x() - d.summary.anchor[0]),
                                     static_cast<double>(at.y() - d.summary.anchor[1]),
                                     static_cast<double>(at.z() - d.summary.anchor[2])}});
            for (int c = 0; c < 3; ++c) {
                EXPECT_EQ(found[static_cast<size_t>(c)], accessor.getValue(at)[c]);
            }
        }
    }
}

TEST(Colour, OnlyFogVectorsAreTakenForDensities) {
    auto color = makeColorBlob(10);
    auto velocity = makeColorBlob(10);
    velocity->setName("v");
    velocity->setGridClass(openvdb::GRID_UNKNOWN);
    EXPECT_EQ(fixtures::load(fixtures::write("v1.vdb", {velocity, color})).summary.grid.name,
              "density");
    EXPECT_EQ(fixtures::load(fixtures::write("v2.vdb", {velocity})).summary.grid.name, "v");
    auto other = makeColorBlob(10);
    other->setName("other");
    color->setName("dust");
    expectFailure(fixtures::write("v3.vdb", {velocity, other, color}), TRK_ERROR_GRID_NOT_FOUND,
                  "several grids can be the density");
}

TEST(Colour, RefusesWhatNoChannelMayHold) {
    const auto with = [](const char* name, const Vec3f& value) {
        auto grid = makeColorBlob(10);
        grid->tree().setValue(Coord(5, 4, 3), value);
        return fixtures::write(name, {grid});
    };
    const float nan = std::numeric_limits<float>::quiet_NaN();
    expectFailure(with("c1.vdb", Vec3f(1, nan, 1)), TRK_ERROR_BAD_DENSITY,
                  "1 voxel is NaN or infinite as float, the first at index (5, 4, 3)");
    expectFailure(with("c2.vdb", Vec3f(1, 1, -1)), TRK_ERROR_BAD_DENSITY, "negative");
    auto background = openvdb::Vec3SGrid::create(Vec3f(0, 0, 1));
    background->setName("density");
    background->setGridClass(openvdb::GRID_FOG_VOLUME);
    background->tree().setValue(Coord(0), Vec3f(1));
    expectFailure(fixtures::write("c3.vdb", {background}), TRK_ERROR_BAD_DENSITY, "background is");
    auto staggered = makeColorBlob(10);
    staggered->setGridClass(openvdb::GRID_STAGGERED);
    expectFailure(fixtures::write("c4.vdb", {staggered}), TRK_ERROR_UNSUPPORTED_GRID, "staggered");
    auto integers = openvdb::Vec3IGrid::create();
    integers->setName("density");
    expectFailure(fixtures::write("c5.vdb", {integers}), TRK_ERROR_UNSUPPORTED_GRID, "vec3i");
}

TEST(Colour, EachChannelIsBakedAsIfItWereAlone) {
    const auto color = makeColorBlob(45);
    const trk::Density d = fixtures::load(fixtures::write("color.vdb", {color}));
    for (const ControlKind kind : kKinds) {
        const auto options = fixtures::bakeOptions(8, 2, kind);
        const trk::BakedVolume all = trk::bake(d.field, options);
        ASSERT_EQ(all.channels, 3u);
        for (size_t c = 0; c < 3; ++c) {
            const auto grey = fixtures::makeGrid(
                CoordBBox(Coord(0), Coord(44)),
                [&](const Coord& p) { return color->tree().getValue(p)[static_cast<int>(c)]; });
            const trk::Density one = fixtures::load(fixtures::write("one.vdb", {grey}));
            const trk::BakedVolume alone = trk::bake(one.field, options);
            size_t compared = 0;
            alone.table.forEach([&](const trk::Int3& lo, int, SparseTable::Entry entry) {
                const auto found = all.table.find(lo[0], lo[1], lo[2]).entry;
                ASSERT_NE(found, SparseTable::kEmpty);
                const size_t i = SparseTable::index(found) * 3 + c;
                const size_t j = SparseTable::index(entry);
                EXPECT_EQ(std::memcmp(&all.items[i], &alone.items[j], sizeof(trk::BakedSuperVoxel)),
                          0);
                for (size_t k = 0; k < trk::shapeSize(kind); ++k) {
                    EXPECT_EQ(all.shape(i)[k], alone.shape(j)[k]);
                }
                ++compared;
            });
            EXPECT_GT(compared, 50u);
        }
    }
}

struct Sources {
    std::string name;
    openvdb::GridBase::Ptr grid;
};

std::vector<Sources> sources() {
    auto color = makeColorBlob(45);
    color->tree().addTile(1, Coord(64, 0, 0), Vec3f(0.5f, 0.25f, 1), true);
    auto doubles = openvdb::Vec3DGrid::create();
    for (auto it = color->cbeginValueOn(); it; ++it) {
        if (it.isVoxelValue()) {
            doubles->tree().setValue(it.getCoord(), openvdb::Vec3d(*it));
        }
    }
    doubles->setName("dust");
    return {{"grey", fixtures::makeBlob(45)}, {"color", color}, {"vec3d", doubles}};
}

TEST(Colour, EveryKindOfSidecarReadsBackAndIsProved) {
    for (const auto& [name, grid] : sources()) {
        const std::string vdb = fixtures::write(name + "-source.vdb", {grid});
        const trk::Density d = fixtures::load(vdb);
        for (const ControlKind kind : kKinds) {
            for (const int size : {4, 16}) {
                const std::string sidecar = fixtures::path("kinds.track.vdb");
                fixtures::bake(vdb, sidecar, size, 2, kind);
                const trk::BakedVolume expected =
                    trk::bake(d.field, fixtures::bakeOptions(size, 2, kind));
                const trk::Sidecar read = trk::readSidecar(sidecar, &d.summary, TRK_CHECK_FULL);
                EXPECT_EQ(read.baked.kind, kind);
                EXPECT_EQ(read.header.valueType, d.summary.valueType);
                const size_t channels = expected.channels;
                ASSERT_EQ(read.baked.channels, channels);
                EXPECT_EQ(read.baked.table.occupiedItems(), expected.table.occupiedItems());
                size_t compared = 0;
                expected.table.forEach([&](const trk::Int3& lo, int, SparseTable::Entry entry) {
                    const auto found = read.baked.table.find(lo[0], lo[1], lo[2]).entry;
                    ASSERT_NE(found, SparseTable::kEmpty);
                    EXPECT_EQ(found & SparseTable::kSingleFlag, entry & SparseTable::kSingleFlag);
                    for (size_t c = 0; c < channels; ++c) {
                        const size_t i = SparseTable::index(found) * channels + c;
                        const size_t j = SparseTable::index(entry) * channels + c;
                        EXPECT_EQ(std::memcmp(&read.baked.items[i], &expected.items[j],
                                              sizeof(trk::BakedSuperVoxel)),
                                  0);
                        for (size_t k = 0; k < trk::shapeSize(kind); ++k) {
                            EXPECT_EQ(read.baked.shape(i)[k], expected.shape(j)[k]);
                        }
                    }
                    ++compared;
                });
                EXPECT_GT(compared, 20u);
                const auto report = vdbtools::verify(d.summary, read);
                EXPECT_TRUE(report.holds) << report.counterexample;
                ASSERT_EQ(read.baked.levels.size(), expected.levels.size());
                for (size_t level = 0; level < read.baked.levels.size(); ++level) {
                    EXPECT_EQ(read.baked.levels[level].values.size() % channels, 0u);
                    EXPECT_EQ(read.baked.levels[level].table.occupiedItems(),
                              expected.levels[level].table.occupiedItems());
                }
                // Alone, it says the same of where it lies.
                const trk::Sidecar alone = trk::readSidecar(sidecar, nullptr, TRK_CHECK_FULL);
                EXPECT_EQ(alone.baked.table.occupiedItems(), expected.table.occupiedItems());
                EXPECT_NEAR(alone.header.indexToWorld.translation[0],
                            d.summary.indexToWorld.translation[0], 1e-9);
            }
        }
    }
}

TEST(Colour, VerifyFindsAControlThatIsNotWhatWasBounded) {
    for (const auto& [name, grid] : sources()) {
        const std::string vdb = fixtures::write(name + "-lies.vdb", {grid});
        const trk::Density d = fixtures::load(vdb);
        for (const ControlKind kind : {ControlKind::kTrilinear, ControlKind::kAffine}) {
            const std::string sidecar = fixtures::path("lies.track.vdb");
            fixtures::bake(vdb, sidecar, 8, 0, kind);
            trk::Sidecar wrong = trk::readSidecar(sidecar, &d.summary, TRK_CHECK_FULL);
            ASSERT_TRUE(vdbtools::verify(d.summary, wrong).holds);
            // The largest slope, in the last channel that has any.
            size_t largest = 0;
            for (size_t i = 0; i < wrong.baked.shapes.size(); ++i) {
                if (std::fabs(wrong.baked.shapes[i]) > std::fabs(wrong.baked.shapes[largest])) {
                    largest = i;
                }
            }
            wrong.baked.shapes[largest] *= 1.5f;
            const auto report = vdbtools::verify(d.summary, wrong);
            EXPECT_FALSE(report.holds);
            EXPECT_NE(report.counterexample.find("majorant"), std::string::npos)
                << report.counterexample;
            EXPECT_NE(report.counterexample.find("control there"), std::string::npos);
            if (wrong.baked.channels == 3) {
                EXPECT_NE(report.counterexample.find("channel"), std::string::npos);
            }
        }
    }
}

TEST(Colour, SidecarsWithBadShapesAreRefused) {
    using Grids = std::map<std::string, openvdb::GridBase::Ptr>;
    const std::string vdb = fixtures::write("shapes.vdb", {fixtures::makeBlob(45)});
    const trk::Density d = fixtures::load(vdb);
    const auto expectRefused = [&](ControlKind kind, const std::string& text,
                                   const std::function<void(Grids&)>& change) {
        const std::string sidecar = fixtures::path("shapes.track.vdb");
        fixtures::bake(vdb, sidecar, 8, 0, kind);
        openvdb::io::File file(sidecar);
        file.open();
        Grids grids;
        const openvdb::GridPtrVecPtr read = file.getGrids();
        for (const auto& grid : *read) {
            grids[grid->getName()] = grid;
        }
        file.close();
        change(grids);
        openvdb::GridCPtrVec all;
        for (const auto& [ignored, grid] : grids) {
            all.push_back(grid);
        }
        const std::string changed = fixtures::write("shapes-changed.vdb", all);
        try {
            trk::readSidecar(changed, &d.summary, TRK_CHECK_FULL);
            ADD_FAILURE() << "accepted; expected: " << text;
        } catch (const trk::Error& e) {
            EXPECT_NE(std::string(e.what()).find(text), std::string::npos) << e.what();
        }
    };
    const float nan = std::numeric_limits<float>::quiet_NaN();
    const Coord at(2, 3, 3);
    const auto scalar = [](Grids& grids, const char* name) -> openvdb::FloatTree& {
        return openvdb::gridPtrCast<openvdb::FloatGrid>(grids.at(name))->tree();
    };
    const auto gradient = [](Grids& grids) -> openvdb::Vec3STree& {
        return openvdb::gridPtrCast<openvdb::Vec3SGrid>(grids.at("density_gradient"))->tree();
    };
    expectRefused(ControlKind::kAffine, "density_gradient is missing",
                  [](Grids& grids) { grids.erase("density_gradient"); });
    expectRefused(ControlKind::kAffine, "NaN",
                  [&](Grids& grids) { gradient(grids).setValue(at, Vec3f(0, nan, 0)); });
    expectRefused(ControlKind::kAffine, "is of type", [&](Grids& grids) {
        auto grid = openvdb::FloatGrid::create();
        for (const auto& meta : {"track_format"}) {
            grid->insertMeta(meta, openvdb::StringMetadata("1.0"));
        }
        grid->setName("density_gradient");
        grids["density_gradient"] = grid;
    });
    expectRefused(ControlKind::kTrilinear, "density_mean is missing",
                  [](Grids& grids) { grids.erase("density_mean"); });
    expectRefused(ControlKind::kTrilinear, "negative",
                  [&](Grids& grids) { scalar(grids, "density_control").setValue(at, -1.0f); });
    expectRefused(ControlKind::kTrilinear, "does not bound",
                  [&](Grids& grids) { scalar(grids, "density_control").setValue(at, 100.0f); });
    expectRefused(ControlKind::kTrilinear, "reads constant, trilinear and affine",
                  [](Grids& grids) {
                      grids.at("density_control")
                          ->insertMeta("track_control", openvdb::StringMetadata("cubic"));
                  });
}

}  // namespace
