// SPDX-License-Identifier: Apache-2.0
// Exact optical depth against the slow reference, on every kind of map and ray.
#include "support/fixtures.h"
#include "support/rays.h"
#include "support/reference.h"
#include "track/track.hpp"

#include <gtest/gtest.h>

#include <string>
#include <vector>

namespace {

openvdb::FloatGrid::Ptr readGrid(const std::string& path) {
    openvdb::initialize();
    openvdb::io::File file(path);
    file.open();
    for (auto it = file.beginName(); it != file.endName(); ++it) {
        if (it.gridName() == "density" || it.gridName() == "voxel_fog_density") {
            return openvdb::gridPtrCast<openvdb::FloatGrid>(file.readGrid(it.gridName()));
        }
    }
    throw std::runtime_error("no density in " + path);
}

/// Random, axis-aligned and interior rays, and rays from 1e5 voxels away.
void expectExactAgrees(const std::string& path, size_t count) {
    const auto grid = readGrid(path);
    const reference::Field<openvdb::FloatGrid> field(*grid);
    const track::Volume volume = track::Volume::open(path, "");
    const rays::Box box = rays::boundsOf(volume.info());
    double size = 0;
    for (int a = 0; a < 3; ++a) {
        size = std::max(size, box.hi[a] - box.lo[a]);
    }
    const double voxel = std::cbrt(grid->transform().voxelVolume());
    std::vector<TrkRay> all;
    for (const auto& set :
         {rays::through(box, count, 2 * size, 1), rays::axisAligned(box, count, 2),
          rays::interior(box, count, 3), rays::through(box, count, 1e5 * voxel, 4)}) {
        all.insert(all.end(), set.begin(), set.end());
    }
    track::Query query(0, 0);
    query.method = TRK_METHOD_EXACT;
    std::vector<double> depth(all.size());
    volume.integrateOpticalDepth(query, all.data(), all.size(), depth.data());
    size_t hits = 0;
    for (size_t i = 0; i < all.size(); ++i) {
        const double expected = field.opticalDepth(all[i]);
        hits += expected > 0 ? 1 : 0;
        ASSERT_NEAR(depth[i], expected, 1e-5 * expected) << path << ": ray " << i;
    }
    EXPECT_GT(hits, all.size() / 8) << path;
}

openvdb::math::Transform::Ptr transformOf(const openvdb::Mat4d& matrix) {
    return openvdb::math::Transform::createLinearTransform(matrix);
}

TEST(Exact, AgreesWithTheReferenceOnEveryMap) {
    auto grid = fixtures::makeBlob(40);
    const auto diagonal = [](double x, double y, double z) {
        openvdb::Mat4d matrix = openvdb::Mat4d::identity();
        matrix.postScale(openvdb::Vec3d(x, y, z));
        return matrix;
    };
    openvdb::Mat4d anisotropic = diagonal(1, 10, 0.5);
    anisotropic.postTranslate(openvdb::Vec3d(-20, 5, 3));
    openvdb::Mat4d rotated = openvdb::Mat4d::identity();
    rotated.preRotate(openvdb::math::X_AXIS, 0.4);
    rotated.preRotate(openvdb::math::Z_AXIS, 1.1);
    rotated.postShear(openvdb::math::X_AXIS, openvdb::math::Y_AXIS, 0.6);
    rotated.postScale(openvdb::Vec3d(0.3, 0.2, 0.4));
    rotated.postTranslate(openvdb::Vec3d(1, -2, 3));
    const openvdb::Mat4d mirrored = diagonal(-1, 1, 1) * rotated;
    const openvdb::Mat4d tiny = diagonal(2e-5, 2e-5, 2e-5);
    const openvdb::Mat4d giant = diagonal(1e9, 1e9, 1e9);
    const openvdb::Mat4d thin = diagonal(1, 1e6, 1);
    int number = 0;
    for (const openvdb::Mat4d& matrix : {anisotropic, rotated, mirrored, tiny, giant, thin}) {
        grid->setTransform(transformOf(matrix));
        expectExactAgrees(fixtures::write("map" + std::to_string(number++) + ".vdb", {grid}), 150);
    }
}

TEST(Exact, AgreesWithTheReferenceOnHalfStorage) {
    auto grid = fixtures::makeBlob(40);
    grid->setSaveFloatAsHalf(true);
    expectExactAgrees(fixtures::write("half-exact.vdb", {grid}), 200);
}

TEST(Exact, AgreesWithTheReferenceWhereTilesMeetVoxels) {
    auto grid = fixtures::makeBlob(40);
    grid->tree().addTile(1, openvdb::Coord(16, 16, 16), 0.5f, true);
    grid->tree().addTile(1, openvdb::Coord(24, 16, 16), 0.25f, true);
    grid->tree().addTile(2, openvdb::Coord(128, 0, 0), 0.1f, true);
    expectExactAgrees(fixtures::write("tiles.vdb", {grid}), 300);
}

TEST(Exact, AgreesWithTheReferenceOnTheCloud) {
    expectExactAgrees(fixtures::cloudFile(96), 400);
}

TEST(Exact, AgreesWithTheReferenceOnRealVolumes) {
    TRACK_NEEDS_DATA();
    for (const char* name : {"wdas_cloud_sixteenth.vdb", "smoke1.vdb", "density_and_heat.vdb"}) {
        expectExactAgrees(fixtures::dataFolder() + "/" + name, 500);
    }
}

TEST(Exact, IndexOffsetsAndFarTranslationsKeepPrecision) {
    auto grid = fixtures::makeBlob(24);
    const track::Volume near = track::Volume::open(fixtures::write("near.vdb", {grid}), "");
    // The same voxels 1e8 index units away, with a transform that puts them back.
    auto far = openvdb::FloatGrid::create();
    const openvdb::Coord offset(100000000, -100000000, 100000000);
    for (auto it = grid->cbeginValueOn(); it; ++it) {
        far->tree().setValue(it.getCoord() + offset, *it);
    }
    far->setName("density");
    far->transform().preTranslate(-offset.asVec3d());
    const track::Volume away = track::Volume::open(fixtures::write("away.vdb", {far}), "");
    const auto all = rays::through(rays::boundsOf(near.info()), 200, 50, 9);
    track::Query query(0, 0);
    query.method = TRK_METHOD_EXACT;
    std::vector<double> a(all.size());
    std::vector<double> b(all.size());
    near.integrateOpticalDepth(query, all.data(), all.size(), a.data());
    away.integrateOpticalDepth(query, all.data(), all.size(), b.data());
    for (size_t i = 0; i < all.size(); ++i) {
        EXPECT_NEAR(a[i], b[i], 1e-5 * a[i] + 1e-7);
    }
}

TEST(Exact, AConstantTileCostsNothingAndIsExact) {
    openvdb::initialize();
    auto grid = openvdb::FloatGrid::create();
    grid->setName("density");
    grid->tree().addTile(3, openvdb::Coord(0, 0, 0), 0.25f, true);  // 4096^3
    const track::Volume volume = track::Volume::open(fixtures::write("tile.vdb", {grid}), "");
    const TrkRay ray{{-100, 1000.5f, 2000.25f}, 0, {1, 0, 0}, rays::kInfinity};
    track::Query query(0, 0);
    query.method = TRK_METHOD_EXACT;
    double depth = 0;
    volume.integrateOpticalDepth(query, &ray, 1, &depth);
    EXPECT_NEAR(depth, 0.25 * 4096, 1e-9);  // two ramps of half a voxel make up for the ends
    float transmittance = 0;
    track::Statistics statistics(1, 1);
    volume.estimateTransmittance(query, &ray, 1, &transmittance, statistics.view());
    EXPECT_LE(statistics.lookups[0], 40u);  // the two ramps alone
}

}  // namespace
