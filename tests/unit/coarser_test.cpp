// SPDX-License-Identifier: Apache-2.0
// Super-voxels made of smaller ones, against a bake of their own size, super-voxel by super-voxel.
#include "bake/coarser.h"

#include "bake/bake.h"
#include "bake/write_bake.h"
#include "failure.h"
#include "io/output_file.h"
#include "io/sidecar.h"
#include "support/fixtures.h"
#include "volume.h"

#include <gtest/gtest.h>
#include <openvdb/openvdb.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <random>
#include <string>

namespace {

using trk::BakedSuperVoxel;
using trk::BakedVolume;
using trk::ControlKind;
using trk::SparseTable;

/// The mean over super-voxels, and channels, of how a bound compares with the least one there is.
double expectTheSame(const BakedVolume& found, const BakedVolume& direct) {
    EXPECT_EQ(found.superVoxelSize(), direct.superVoxelSize());
    EXPECT_EQ(found.table.occupiedItems(), direct.table.occupiedItems());
    double looser = 0;
    double count = 0;
    direct.table.forEach([&](const trk::Int3& lo, int shift, SparseTable::Entry entry) {
        const auto there = found.table.find(lo[0], lo[1], lo[2]);
        ASSERT_NE(there.entry, SparseTable::kEmpty);
        EXPECT_GE(there.shift, direct.superVoxelShift);
        EXPECT_GE(shift, direct.superVoxelShift);
        for (size_t c = 0; c < direct.channels; ++c) {
            const size_t i = SparseTable::index(there.entry) * direct.channels + c;
            const size_t k = SparseTable::index(entry) * direct.channels + c;
            const BakedSuperVoxel& a = found.items[i];
            const BakedSuperVoxel& b = direct.items[k];
            const auto d = [](float value) { return static_cast<double>(value); };
            const double unit = d(b.max);
            EXPECT_EQ(a.min, b.min);
            EXPECT_EQ(a.max, b.max);
            EXPECT_NEAR(d(a.mean), d(b.mean), 1e-6 * unit);
            EXPECT_NEAR(d(a.deviation), d(b.deviation), 1e-4 * d(b.deviation) + 2e-6 * unit);
            for (size_t axis = 0; axis < 3; ++axis) {
                EXPECT_NEAR(d(found.gradients[3 * i + axis]), d(direct.gradients[3 * k + axis]),
                            2e-6 * unit);
            }
            // The bounds of a bake are least ones: none may be below, but for rounding.
            EXPECT_GE(d(a.majorant), d(b.majorant) - 3e-6 * unit);
            EXPECT_GE(d(a.rms), d(b.rms) - 3e-6 * unit);
            EXPECT_NEAR(d(a.rms), d(b.rms), 2e-3 * unit);
            if (b.majorant > 0) {
                looser += d(a.majorant) / d(b.majorant);
                ++count;
            } else {
                EXPECT_EQ(a.majorant, 0);
                EXPECT_EQ(a.rms, 0);
            }
        }
    });
    return count > 0 ? looser / count : 1;
}

/// All sizes above 4 of a density.
void expectAllSizes(const std::string& name, const trk::DensityField& field) {
    for (const ControlKind kind : {ControlKind::kConstant, ControlKind::kAffine}) {
        BakedVolume found = trk::bake(field, fixtures::bakeOptions(4, 0, kind));
        for (const int size : {8, 16, 32, 64}) {
            SCOPED_TRACE(name + ", " + trk::controlName(kind) + ", size " + std::to_string(size));
            found = trk::coarser(found);
            const double looser =
                expectTheSame(found, trk::bake(field, fixtures::bakeOptions(size, 0, kind)));
            std::printf("%s, %s, size %d: bounds %.3f of the least ones\n", name.c_str(),
                        trk::controlName(kind), size, looser);
            EXPECT_LT(looser, kind == ControlKind::kConstant ? 1.0001 : 3);
        }
    }
}

openvdb::GridBase::Ptr noise(const openvdb::CoordBBox& box) {
    std::mt19937 random(2);
    std::uniform_real_distribution<float> unit(0, 1);
    return fixtures::makeGrid(box, [&](const openvdb::Coord&) {
        const float value = unit(random);
        return value < 0.3f ? 0.0f : value;
    });
}

TEST(Coarser, IsWhatABakeOfThatSizeSays) {
    openvdb::initialize();
    expectAllSizes("cloud", fixtures::load(fixtures::cloudFile(64)).field);
    expectAllSizes(
        "noise", fixtures::load(fixtures::write("coarser_noise.vdb",
                                                {noise(openvdb::CoordBBox(-7, 3, 11, 40, 29, 51))}))
                     .field);
    const auto tiles = fixtures::makeBlob(40);
    tiles->tree().addTile(1, openvdb::Coord(64, 0, 0), 0.25f, true);
    tiles->tree().addTile(2, openvdb::Coord(128, 0, 0), 0.5f, true);
    expectAllSizes("tiles", fixtures::load(fixtures::write("coarser_tiles.vdb", {tiles})).field);
    expectAllSizes("three channels",
                   fixtures::load(fixtures::write("coarser_rgb.vdb",
                                                  {fixtures::makeColorGrid(
                                                      openvdb::CoordBBox(0, 0, 0, 39, 39, 39),
                                                      [](const openvdb::Coord& p) {
                                                          const auto x = static_cast<float>(p[0]);
                                                          return openvdb::Vec3f(
                                                              x, p[1] < 20 ? 0.0f : 1.0f,
                                                              static_cast<float>(p[2] % 3));
                                                      })}))
                       .field);
}

// Which of them is coarsened, and from which numbers, is that of the density.
TEST(Coarser, OpensTheSidecarOfItsGridFromAFileOfSeveral) {
    openvdb::initialize();
    const auto a = fixtures::makeBlob(40);
    a->setName("a");
    const auto b = fixtures::makeBlob(48);
    b->setName("b");
    const std::string vdb = fixtures::write("coarser_two.vdb", {a, b});
    openvdb::GridCPtrVec all;
    for (const std::string name : {"a", "b"}) {
        const trk::Density density = fixtures::load(vdb, name);
        const int size = name == "a" ? 32 : 4;
        const trk::BakedVolume baked = trk::bake(density.field, fixtures::bakeOptions(size, 0));
        const std::string path = fixtures::path("coarser_" + name + ".track.vdb");
        trk::OutputFile file(path, true);
        trk::writeSidecar(file, trk::sidecarHeader(density.summary, density.field, baked), baked,
                          density.summary.anchor);
        file.commit();
        openvdb::io::File from(path);
        from.open(false);
        const openvdb::GridPtrVecPtr grids = from.getGrids();
        all.insert(all.end(), grids->begin(), grids->end());
    }
    const std::string both = fixtures::write("coarser_both.track.vdb", all);
    trk::VolumeOptions options;
    options.gridNamed = true;
    options.gridName = "b";
    options.superVoxelSize = 16;
    EXPECT_EQ(trk::openVolume(vdb.c_str(), both.c_str(), options).superVoxels->size(), 16);
}

TEST(Coarser, OpensASidecarAtEverySizeFromTheBakedOne) {
    const std::string vdb = fixtures::cloudFile(64);
    for (const ControlKind kind :
         {ControlKind::kConstant, ControlKind::kAffine, ControlKind::kTrilinear}) {
        const std::string sidecar = fixtures::path("coarser.track.vdb");
        fixtures::bake(vdb, sidecar, 8, 2, kind);
        for (const int size : {0, 4, 8, 16, 64}) {
            trk::VolumeOptions options;
            options.superVoxelSize = size;
            const auto open = [&] {
                return trk::openVolume(vdb.c_str(), sidecar.c_str(), options).superVoxels->size();
            };
            if (size == 4 || (kind == ControlKind::kTrilinear && size > 8)) {
                try {
                    open();
                    ADD_FAILURE() << size;
                } catch (const trk::Error& e) {
                    EXPECT_EQ(e.status(), TRK_ERROR_INVALID_ARGUMENT);
                    EXPECT_NE(std::string(e.what()).find("expected"), std::string::npos);
                }
            } else {
                EXPECT_EQ(open(), size == 0 ? 8 : size);
            }
        }
    }
    trk::VolumeOptions inMemory;
    inMemory.superVoxelSize = 32;
    inMemory.bakeMissing = true;
    EXPECT_EQ(trk::openVolume(vdb.c_str(), "", inMemory).superVoxels->size(), 32);
}

}  // namespace
