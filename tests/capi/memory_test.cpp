// SPDX-License-Identifier: Apache-2.0
// Densities that never were files, and bakes within the caller's process: the bits of the same from
// files; progress, cancelling, limits.
#include "track/track_openvdb.hpp"

#include "support/fixtures.h"
#include "support/rays.h"

#include <gtest/gtest.h>
#include <openvdb/io/File.h>
#include <openvdb/tools/Prune.h>

#include <algorithm>
#include <atomic>
#include <cstring>
#include <filesystem>
#include <functional>
#include <limits>
#include <thread>
#include <vector>

namespace {

using openvdb::Coord;
using openvdb::CoordBBox;

void expectRefused(TrkStatus status, TrkStatus expected, const std::string& text) {
    EXPECT_EQ(status, expected) << trkGetStatusName(status) << ": " << trkGetLastErrorMessage();
    EXPECT_NE(std::string(trkGetLastErrorMessage()).find(text), std::string::npos)
        << trkGetLastErrorMessage();
}

/// Answers of both volumes to every kind of question are of the same bits.
void expectSameBits(const track::Volume& a, const track::Volume& b) {
    const TrkVolumeInfo info = a.info();
    ASSERT_EQ(info.channels, b.info().channels);
    ASSERT_EQ(info.activeVoxels, b.info().activeVoxels);
    EXPECT_EQ(std::string(info.storage), b.info().storage);
    EXPECT_EQ(info.superVoxelSize, b.info().superVoxelSize);
    const rays::Box box = rays::boundsOf(info);
    std::vector<TrkRay> all = rays::through(box, 200, 1, 3);
    const std::vector<TrkRay> along = rays::axisAligned(box, 100, 4);
    all.insert(all.end(), along.begin(), along.end());
    const size_t count = all.size() * info.channels;
    double answered = 0;
    for (const TrkMethod method : {TRK_METHOD_EXACT, TRK_METHOD_RESIDUAL, TRK_METHOD_CONTROL}) {
        track::Query query(7, 1);
        query.method = method;
        std::vector<float> of[2] = {std::vector<float>(count), std::vector<float>(count)};
        a.estimateTransmittance(query, all.data(), all.size(), of[0].data());
        b.estimateTransmittance(query, all.data(), all.size(), of[1].data());
        EXPECT_EQ(std::memcmp(of[0].data(), of[1].data(), count * sizeof(float)), 0) << method;
        for (const float t : of[0]) {
            answered += std::fabs(1 - static_cast<double>(t));
        }
    }
    EXPECT_GT(answered, 1) << "the rays saw nothing";
}

/// A grid with leaves, tiles of two sizes, active zeros and inactive values, under a map with
/// rotation and shear.
template <class Grid>
typename Grid::Ptr makeGrid() {
    using Value = typename Grid::ValueType;
    auto grid = Grid::create();
    grid->setName("fog");
    const auto blob = fixtures::makeBlob(40);
    for (auto it = blob->cbeginValueOn(); it; ++it) {
        const Coord at = it.getCoord() - Coord(20, 5, -3);
        Value value(*it);
        if constexpr (std::is_class_v<Value>) {
            value[1] *= 0.5f;
            value[2] = 0.25f;
        }
        grid->tree().setValue(at, value);
    }
    grid->tree().fill(CoordBBox(Coord(128), Coord(255)), Value(0.125f), true);  // a tile of 128^3
    grid->tree().fill(CoordBBox(Coord(48, 0, 0), Coord(55, 7, 7)), Value(0.375f), true);
    grid->tree().setValueOff(Coord(-3, 8, 16), Value(0.5f));
    grid->tree().setValueOn(Coord(40, 40, 40), Value(0.0f));
    openvdb::tools::prune(grid->tree());
    openvdb::Mat4d matrix = openvdb::Mat4d::identity();
    matrix.preScale(openvdb::Vec3d(0.1, 0.2, 0.15));
    matrix.preRotate(openvdb::math::Z_AXIS, 0.4);
    matrix.preShear(openvdb::math::X_AXIS, openvdb::math::Y_AXIS, 0.2);
    matrix.postTranslate(openvdb::Vec3d(3, -2, 1));
    grid->setTransform(openvdb::math::Transform::createLinearTransform(matrix));
    grid->setGridClass(openvdb::GRID_FOG_VOLUME);
    return grid;
}

template <class Grid>
void expectAGridIsItsFile() {
    const auto grid = makeGrid<Grid>();
    EXPECT_GE(grid->tree().activeTileCount(), 2u);
    const std::string vdb = fixtures::write("grid.vdb", {grid});
    const track::Volume fromFile = track::Volume::open(vdb, "");
    track::Volume fromMemory = track::makeVolume(*grid);
    EXPECT_EQ(std::string(fromMemory.info().gridName), "fog");
    expectSameBits(fromFile, fromMemory);

    // The bake of one fits the other, and is what the program bakes of the file.
    const std::string sidecar = fixtures::path("grid.memory.track.vdb");
    std::filesystem::remove(sidecar);
    TrkBakeOptions options = trkDefaultBakeOptions();
    options.superVoxelSize = 8;
    options.control = TRK_CONTROL_AFFINE;
    fromMemory.bake(options, sidecar);
    EXPECT_EQ(fromMemory.info().superVoxelSize, 8u);
    expectSameBits(fromMemory, track::Volume::open(vdb, sidecar.c_str()));
    const std::string baked = fixtures::path("grid.file.track.vdb");
    fixtures::bake(vdb, baked, 8, 4, trk::ControlKind::kAffine);
    expectSameBits(fromMemory, track::Volume::open(vdb, baked.c_str()));
}

TEST(Memory, AGridOfFloatsIsItsFile) {
    expectAGridIsItsFile<openvdb::FloatGrid>();
}
TEST(Memory, AGridOfDoublesIsItsFile) {
    expectAGridIsItsFile<openvdb::DoubleGrid>();
}
TEST(Memory, AGridOfFloatVectorsIsItsFile) {
    expectAGridIsItsFile<openvdb::Vec3SGrid>();
}
TEST(Memory, AGridOfDoubleVectorsIsItsFile) {
    expectAGridIsItsFile<openvdb::Vec3DGrid>();
}

TEST(Memory, AnEmptyGridIsEmpty) {
    const auto grid = openvdb::FloatGrid::create();
    grid->setName("nothing");
    const track::Volume volume = track::makeVolume(*grid);
    EXPECT_EQ(volume.info().activeVoxels, 0u);
    const TrkRay ray{{0, 0, 0}, 0, {1, 0, 0}, 10};
    float transmittance = 0;
    volume.estimateTransmittance(track::Query(0, 0), &ray, 1, &transmittance);
    EXPECT_EQ(transmittance, 1);
}

TEST(Memory, GridsThatAreNoDensityAreRefused) {
    auto grid = fixtures::makeBlob(16);
    const auto expect = [&](TrkStatus status, const std::string& text) {
        try {
            track::makeVolume(*grid);
            ADD_FAILURE() << "was taken";
        } catch (const track::Error& e) {
            EXPECT_EQ(e.status(), status) << e.what();
            EXPECT_NE(std::string(e.what()).find(text), std::string::npos) << e.what();
        }
    };
    grid->setGridClass(openvdb::GRID_LEVEL_SET);
    expect(TRK_ERROR_UNSUPPORTED_GRID, "level set");
    grid->setGridClass(openvdb::GRID_FOG_VOLUME);
    grid->setTransform(openvdb::math::Transform::createFrustumTransform(
        openvdb::BBoxd(openvdb::Vec3d(0), openvdb::Vec3d(10)), 0.5, 10));
    expect(TRK_ERROR_UNSUPPORTED_GRID, "frustum");
    grid->setTransform(openvdb::math::Transform::createLinearTransform(1.0));
    grid->tree().setValue(Coord(3, 4, 5), -1.0f);
    expect(TRK_ERROR_BAD_DENSITY, "(3, 4, 5)");
    grid = openvdb::FloatGrid::create(0.5f);
    expect(TRK_ERROR_BAD_DENSITY, "background");
}

/// A dense array of n^3 voxels from `origin` on, and the grid of what is not 0 in it.
struct Dense {
    int n = 21;
    Coord origin{-5, 3, -9};
    openvdb::FloatGrid::Ptr grid;

    Dense() {
        const auto blob = fixtures::makeBlob(n);
        grid = fixtures::makeGrid(CoordBBox(origin, origin + Coord(n - 1)), [&](const Coord& c) {
            // What a half can hold exactly.
            return std::floor(64 * blob->tree().getValue(c - origin)) / 64;
        });
    }
    float at(int x, int y, int z) const { return grid->tree().getValue(origin + Coord(x, y, z)); }
    TrkDensity density() const {
        TrkDensity d = trkDefaultDensity();
        for (unsigned a = 0; a < 3; ++a) {
            d.origin[a] = origin[a];
            d.extent[a] = static_cast<uint64_t>(n);
        }
        return d;
    }
    size_t count() const { return static_cast<size_t>(n * n * n); }
};

TEST(Memory, DenseArraysAreTheirFileWhateverTheirTypeAndOrder) {
    const Dense dense;
    const track::Volume file = track::Volume::open(fixtures::write("dense.vdb", {dense.grid}), "");
    const auto n = static_cast<size_t>(dense.n);

    std::vector<float> xFastest(dense.count());
    std::vector<double> zFastest(dense.count());
    std::vector<uint16_t> halfs(dense.count());
    std::vector<float> padded(2 * dense.count() + 1, -7.0f);  // every other one, backwards along y
    for (size_t z = 0; z < n; ++z) {
        for (size_t y = 0; y < n; ++y) {
            for (size_t x = 0; x < n; ++x) {
                const float value =
                    dense.at(static_cast<int>(x), static_cast<int>(y), static_cast<int>(z));
                xFastest[(z * n + y) * n + x] = value;
                zFastest[(x * n + y) * n + z] = static_cast<double>(value);
                halfs[(z * n + y) * n + x] = openvdb::math::half(value).bits();
                padded[2 * ((z * n + (n - 1 - y)) * n + x)] = value;
            }
        }
    }
    TrkDensity d = dense.density();
    d.values = xFastest.data();
    expectSameBits(file, track::Volume::make(d));

    d.values = halfs.data();
    d.valueType = TRK_VALUE_HALF;
    expectSameBits(file, track::Volume::make(d));

    d.values = zFastest.data();
    d.valueType = TRK_VALUE_DOUBLE;
    const auto step = static_cast<int64_t>(sizeof(double));
    const auto edge = static_cast<int64_t>(n);
    d.strides[0] = step * edge * edge;
    d.strides[1] = step * edge;
    d.strides[2] = step;
    expectSameBits(file, track::Volume::make(d));

    d.values = &padded[2 * (n - 1) * n];
    d.valueType = TRK_VALUE_FLOAT;
    d.strides[0] = 8;
    d.strides[1] = -8 * edge;
    d.strides[2] = 8 * edge * edge;
    expectSameBits(file, track::Volume::make(d));
}

TEST(Memory, DenseArraysOfThreeChannels) {
    const Dense dense;
    const auto vectors = fixtures::makeColorGrid(
        CoordBBox(dense.origin, dense.origin + Coord(dense.n - 1)), [&](const Coord& c) {
            const float v = dense.grid->tree().getValue(c);
            return openvdb::Vec3f(v, 0.5f * v, 0.0f);
        });
    const track::Volume file = track::Volume::open(fixtures::write("dense3.vdb", {vectors}), "");
    std::vector<float> together;
    std::vector<float> planes(3 * dense.count());
    for (int z = 0; z < dense.n; ++z) {
        for (int y = 0; y < dense.n; ++y) {
            for (int x = 0; x < dense.n; ++x) {
                const float v = dense.at(x, y, z);
                const size_t i = together.size() / 3;
                together.insert(together.end(), {v, 0.5f * v, 0.0f});
                planes[i] = v;
                planes[dense.count() + i] = 0.5f * v;
            }
        }
    }
    TrkDensity d = dense.density();
    d.channels = 3;
    d.values = together.data();
    expectSameBits(file, track::Volume::make(d));
    d.values = planes.data();
    d.channelStride = static_cast<int64_t>(dense.count() * sizeof(float));
    d.strides[0] = sizeof(float);
    d.strides[1] = d.strides[0] * dense.n;
    d.strides[2] = d.strides[1] * dense.n;
    expectSameBits(file, track::Volume::make(d));
}

TEST(Memory, WhatCannotBeIsRefused) {
    TrkVolume* volume = nullptr;
    const std::vector<float> values(4096, 1.0f);
    const auto refused = [&](const TrkDensity& d, TrkStatus status, const std::string& text) {
        expectRefused(trkMakeVolume(&d, nullptr, &volume), status, text);
        EXPECT_EQ(volume, nullptr);
    };
    const auto with = [&](const std::function<void(TrkDensity&)>& change) {
        TrkDensity d = trkDefaultDensity();
        d.values = values.data();
        d.extent[0] = d.extent[1] = d.extent[2] = 16;
        change(d);
        return d;
    };
    expectRefused(trkMakeVolume(nullptr, nullptr, &volume), TRK_ERROR_INVALID_ARGUMENT, "density");
    constexpr TrkStatus kInvalid = TRK_ERROR_INVALID_ARGUMENT;
    refused(with([](TrkDensity& d) { d.size = 8; }), kInvalid, "TrkDensity.size");
    refused(with([](TrkDensity& d) { d.channels = 2; }), kInvalid, "channels is 2");
    refused(with([](TrkDensity& d) { d.valueType = 9; }), kInvalid, "valueType is 9");
    refused(with([](TrkDensity& d) { d.values = nullptr; }), kInvalid, "values is NULL");
    refused(with([](TrkDensity& d) { d.extent[1] = 0; }), kInvalid, "no extent");
    refused(with([](TrkDensity& d) { d.origin[2] = 2147483640; }), kInvalid, "2^31");
    refused(with([](TrkDensity& d) { d.tileCount = 1; }), kInvalid, "one or the other");
    refused(with([](TrkDensity& d) { d.indexToWorld[4] = 0; }), TRK_ERROR_UNSUPPORTED_GRID,
            "singular");
    std::vector<float> bad = values;
    bad[17] = std::numeric_limits<float>::quiet_NaN();
    refused(with([&](TrkDensity& d) { d.values = bad.data(); }), TRK_ERROR_BAD_DENSITY,
            "(1, 1, 0)");

    const void* bricks[2] = {values.data(), values.data()};
    int32_t origins[6] = {0, 0, 0, 8, 0, 0};
    const int32_t tileOrigins[3] = {0, 0, 0};
    int32_t size = 128;
    TrkDensity d = trkDefaultDensity();
    d.brickCount = 2;
    d.brickOrigins = origins;
    d.brickValues = bricks;
    EXPECT_EQ(trkMakeVolume(&d, nullptr, &volume), TRK_OK) << trkGetLastErrorMessage();
    trkCloseVolume(volume);
    origins[3] = 4;
    refused(d, kInvalid, "not a multiple of 8");
    origins[3] = 0;
    refused(d, kInvalid, "two bricks");
    origins[3] = 8;
    d.tileCount = 1;
    d.tileOrigins = tileOrigins;
    d.tileSizes = &size;
    d.tileValues = values.data();
    refused(d, kInvalid, "lies in the tile");
    size = 64;
    refused(d, kInvalid, "size 64");
    bricks[1] = nullptr;
    d.tileCount = 0;
    refused(d, kInvalid, "brickValues[1]");
}

// ---- Bakes within the process ------------------------------------------------------------------

TEST(Memory, ADensityWithoutASidecarIsBakedAsTheProgramDoes) {
    const std::string vdb = fixtures::cloudFile(64);
    const std::string sidecar = fixtures::path("default.track.vdb");
    fixtures::bake(vdb, sidecar, 16, 4);
    expectSameBits(track::Volume::open(vdb, ""), track::Volume::open(vdb, sidecar.c_str()));
}

TEST(Memory, ABakeThatFailsLeavesVolumeAndFileAsTheyWere) {
    track::Volume volume = track::Volume::open(fixtures::cloudFile(64), "");
    const track::Volume same = track::Volume::open(fixtures::cloudFile(64), "");
    TrkBakeOptions options = trkDefaultBakeOptions();
    options.superVoxelSize = 12;
    expectRefused(trkBakeVolume(volume.handle(), &options, nullptr), TRK_ERROR_INVALID_ARGUMENT,
                  "superVoxelSize is 12");
    options.superVoxelSize = 4;
    options.maxMemory = volume.info().bytes;
    expectRefused(trkBakeVolume(volume.handle(), &options, nullptr), TRK_ERROR_OUT_OF_MEMORY,
                  "maxMemory");
    options.maxMemory = 0;
    expectRefused(trkBakeVolume(volume.handle(), &options, "/no/such/folder/x.track.vdb"),
                  TRK_ERROR_IO, "/no/such/folder");
    const std::string there = fixtures::write("there.vdb", {fixtures::makeBlob(8)});
    const auto bytes = std::filesystem::file_size(there);
    expectRefused(trkBakeVolume(volume.handle(), &options, there.c_str()), TRK_ERROR_IO,
                  "there.vdb");
    EXPECT_EQ(std::filesystem::file_size(there), bytes);
    expectSameBits(volume, same);
    const track::Volume alone = [&] {
        options.overwrite = 1;
        volume.bake(options, there);
        return track::Volume::open("", there.c_str());
    }();
    EXPECT_EQ(volume.info().superVoxelSize, 4u);
    EXPECT_EQ(alone.info().superVoxelSize, 4u);
    expectRefused(trkBakeVolume(alone.handle(), nullptr, nullptr), TRK_ERROR_NO_DENSITY, "density");
}

struct Told {
    std::thread::id thread = std::this_thread::get_id();
    std::vector<float> shares;
    bool elsewhere = false;
    size_t cancelAfter = std::numeric_limits<size_t>::max();
};

int32_t tell(void* data, float share) {
    auto& told = *static_cast<Told*>(data);
    told.elsewhere = told.elsewhere || std::this_thread::get_id() != told.thread;
    told.shares.push_back(share);
    return told.shares.size() >= told.cancelAfter ? 1 : 0;
}

TEST(Memory, ProgressIsToldInTheCallersThreadAndCancels) {
    const std::string vdb = fixtures::cloudFile(200);
    for (const int32_t threads : {0, 1, 2}) {
        Told told;
        TrkVolumeOptions options = trkDefaultVolumeOptions();
        options.progress = tell;
        options.progressData = &told;
        options.threads = threads;
        track::Volume volume = track::Volume::open(vdb, "", options);
        ASSERT_FALSE(told.shares.empty());
        EXPECT_FALSE(told.elsewhere);
        EXPECT_TRUE(std::is_sorted(told.shares.begin(), told.shares.end()));
        EXPECT_LE(told.shares.back(), 1.0f);

        told = {};
        told.cancelAfter = 1;
        TrkVolume* none = nullptr;
        expectRefused(trkOpenVolume(vdb.c_str(), "", &options, &none), TRK_ERROR_CANCELLED,
                      "cancelled");
        EXPECT_EQ(none, nullptr);

        told = {};
        told.cancelAfter = 1;
        TrkBakeOptions bake = trkDefaultBakeOptions();
        bake.superVoxelSize = 4;
        bake.progress = tell;
        bake.progressData = &told;
        bake.threads = threads;
        const std::string sidecar = fixtures::path("cancelled.track.vdb");
        expectRefused(trkBakeVolume(volume.handle(), &bake, sidecar.c_str()), TRK_ERROR_CANCELLED,
                      "cancelled");
        EXPECT_FALSE(std::filesystem::exists(sidecar));
        EXPECT_EQ(volume.info().superVoxelSize, 16u);
        EXPECT_FALSE(told.elsewhere);
    }
}

TEST(Memory, MaxMemoryHoldsForDensitiesInMemory) {
    const std::vector<float> values(64 * 64 * 64, 0.5f);
    std::vector<float> varied = values;
    for (size_t i = 0; i < varied.size(); ++i) {
        varied[i] += static_cast<float>(i % 7) * 0.1f;
    }
    TrkDensity d = trkDefaultDensity();
    d.values = varied.data();
    d.extent[0] = d.extent[1] = d.extent[2] = 64;
    TrkVolumeOptions options = trkDefaultVolumeOptions();
    const uint64_t bytes = track::Volume::make(d, options).info().bytes;
    options.maxMemory = 2 * bytes;
    EXPECT_LE(track::Volume::make(d, options).info().bytes, 2 * bytes);
    options.maxMemory = bytes / 2;
    TrkVolume* volume = nullptr;
    expectRefused(trkMakeVolume(&d, &options, &volume), TRK_ERROR_OUT_OF_MEMORY, "maxMemory");
}

}  // namespace
