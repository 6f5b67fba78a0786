// SPDX-License-Identifier: Apache-2.0
// Loading: which grid, which refusals, which values.
#include "support/fixtures.h"

#include "failure.h"
#include "io/vdb_file.h"

#include <gtest/gtest.h>
#include <openvdb/io/Stream.h>

#include <cstring>
#include <filesystem>
#include <fstream>
#include <limits>
#include <random>

namespace {

using openvdb::Coord;
using openvdb::CoordBBox;

/// Status and message of the Error that loading throws; TRK_OK where it throws none.
std::pair<TrkStatus, std::string> failure(const std::string& path,
                                          const trk::DensityOptions& options) {
    try {
        trk::loadDensity(path, options);
        return {TRK_OK, ""};
    } catch (const trk::Error& e) {
        return {e.status(), e.what()};
    }
}

void expectFailure(const std::string& path, TrkStatus status, const std::string& text,
                   const std::string& grid = "") {
    trk::DensityOptions options;
    options.gridNamed = !grid.empty();
    options.gridName = grid;
    const auto [found, message] = failure(path, options);
    EXPECT_EQ(found, status) << message;
    EXPECT_NE(message.find(text), std::string::npos) << message;
    EXPECT_NE(message.find(path), std::string::npos) << message;
    EXPECT_EQ(message.find('\n'), std::string::npos) << message;
}

openvdb::FloatGrid::Ptr single(float value, const char* name = "density") {
    auto grid =
        fixtures::makeGrid(CoordBBox(0, 0, 0, 0, 0, 0), [&](const Coord&) { return value; });
    grid->setName(name);
    return grid;
}

float densityAt(const trk::Density& density, double x, double y, double z) {
    const auto& anchor = density.summary.anchor;
    return density.field.density<1>(
        {{x - static_cast<double>(anchor[0]), y - static_cast<double>(anchor[1]),
          z - static_cast<double>(anchor[2])}})[0];
}

TEST(LoadDensity, ChoosesTheOnlyCandidate) {
    auto fog = single(1, "smoke");
    auto levelSet = single(1, "surface");
    levelSet->setGridClass(openvdb::GRID_LEVEL_SET);
    auto mask = openvdb::BoolGrid::create();
    mask->setName("mask");
    const std::string path = fixtures::write("choose.vdb", {levelSet, mask, fog});
    EXPECT_EQ(fixtures::load(path).summary.grid.name, "smoke");
}

TEST(LoadDensity, PrefersDensityAmongSeveral) {
    const std::string path = fixtures::write("several.vdb", {single(1, "heat"), single(2)});
    EXPECT_EQ(fixtures::load(path).summary.grid.name, "density");
    EXPECT_EQ(fixtures::load(path, "heat").summary.max, 1.0f);
    const std::string other = fixtures::write("others.vdb", {single(1, "a"), single(2, "b")});
    expectFailure(other, TRK_ERROR_GRID_NOT_FOUND, "a, b");
    expectFailure(other, TRK_ERROR_GRID_NOT_FOUND, "no grid \"c\"", "c");
}

TEST(LoadDensity, TellsEqualNamesApartByIndex) {
    const std::string path = fixtures::write("equal.vdb", {single(1), single(2), single(3)});
    expectFailure(path, TRK_ERROR_GRID_NOT_FOUND, "density[0], density[1], density[2]");
    expectFailure(path, TRK_ERROR_GRID_NOT_FOUND, "3 grids named", "density");
    for (int i = 0; i < 3; ++i) {
        const trk::Density d = fixtures::load(path, "density[" + std::to_string(i) + "]");
        EXPECT_EQ(d.summary.grid.index, i);
        EXPECT_EQ(d.summary.max, static_cast<float>(i + 1));
    }
}

TEST(LoadDensity, OpensAnUnnamedGrid) {
    const std::string path = fixtures::write("unnamed.vdb", {single(4, "")});
    EXPECT_EQ(fixtures::load(path).summary.max, 4.0f);
    EXPECT_EQ(fixtures::load(path, "[0]").summary.max, 4.0f);
}

TEST(LoadDensity, SharedTreesAreFollowed) {
    auto first = single(5, "first");
    openvdb::FloatGrid::Ptr second = first->copy();  // shares the tree: an instance in the file
    second->setName("second");
    const std::string path = fixtures::write("instance.vdb", {first, second});
    EXPECT_EQ(fixtures::load(path, "second").summary.max, 5.0f);
}

TEST(LoadDensity, ReadsFilesWithoutOffsets) {
    std::ofstream stream(fixtures::path("stream.vdb"), std::ios::binary);
    openvdb::io::Stream(stream).write(openvdb::GridCPtrVec{single(1, "heat"), single(6)});
    stream.close();
    EXPECT_EQ(fixtures::load(fixtures::path("stream.vdb")).summary.max, 6.0f);
}

TEST(LoadDensity, RefusesWhatIsNoFogVolume) {
    auto levelSet = single(1);
    levelSet->setGridClass(openvdb::GRID_LEVEL_SET);
    expectFailure(fixtures::write("ls.vdb", {levelSet}), TRK_ERROR_UNSUPPORTED_GRID, "level set");
    auto staggered = openvdb::Vec3SGrid::create();
    staggered->setName("v");
    staggered->setGridClass(openvdb::GRID_STAGGERED);
    expectFailure(fixtures::write("staggered.vdb", {staggered}), TRK_ERROR_UNSUPPORTED_GRID,
                  "vec3s");
    auto ints = openvdb::Int32Grid::create();
    ints->setName("ids");
    expectFailure(fixtures::write("ints.vdb", {ints}), TRK_ERROR_UNSUPPORTED_GRID, "int32");
    auto frustum = single(1);
    frustum->setTransform(openvdb::math::Transform::createFrustumTransform(
        openvdb::BBoxd(openvdb::Vec3d(0), openvdb::Vec3d(10)), 0.5, 10, 1));
    expectFailure(fixtures::write("frustum.vdb", {frustum}), TRK_ERROR_UNSUPPORTED_GRID, "frustum");
    expectFailure(fixtures::write("none.vdb", {}), TRK_ERROR_GRID_NOT_FOUND, "no grids");
}

TEST(LoadDensity, RefusesAnUnregisteredTypeButOpensItsNeighbour) {
    openvdb::initialize();
    auto odd = openvdb::Int64Grid::create();
    odd->setName("odd");
    const std::string path = fixtures::write("odd.vdb", {odd, single(7)});
    openvdb::Int64Grid::unregisterGrid();  // as if a newer library had written the file
    EXPECT_EQ(fixtures::load(path, "density").summary.max, 7.0f);
    expectFailure(path, TRK_ERROR_UNSUPPORTED_GRID, "of type int64", "odd");
    openvdb::Int64Grid::registerGrid();
}

TEST(LoadDensity, RefusesBadValuesNamingCountAndFirstVoxel) {
    const CoordBBox box(0, 0, 0, 20, 9, 9);
    const auto withBad = [&](float bad) {
        return fixtures::makeGrid(box, [&](const Coord& p) {
            return p == Coord(3, 4, 5) || p == Coord(17, 0, 0) ? bad : 1.0f;
        });
    };
    const std::string negative = fixtures::write("negative.vdb", {withBad(-0.5f)});
    expectFailure(negative, TRK_ERROR_BAD_DENSITY,
                  "2 voxels are negative, the first at index (3, 4, 5)");
    for (const float bad :
         {std::numeric_limits<float>::quiet_NaN(), std::numeric_limits<float>::infinity()}) {
        expectFailure(fixtures::write("nan.vdb", {withBad(bad)}), TRK_ERROR_BAD_DENSITY,
                      "2 voxels are NaN or infinite");
    }
    auto background = openvdb::FloatGrid::create(1.0f);
    background->setName("density");
    expectFailure(fixtures::write("background.vdb", {background}), TRK_ERROR_BAD_DENSITY,
                  "background is 1");

    trk::DensityOptions repair;
    repair.repair = TRK_REPAIR_CLAMP_NEGATIVE;
    const trk::Density clamped = trk::loadDensity(negative, repair);
    EXPECT_EQ(clamped.summary.clamped, 2u);
    EXPECT_EQ(densityAt(clamped, 3, 4, 5), 0.0f);
    EXPECT_EQ(densityAt(clamped, 3, 4, 6), 1.0f);
}

TEST(LoadDensity, InactiveValuesAndTilesCount) {
    auto grid = single(1);
    grid->tree().setValueOff(Coord(1, 0, 0), 0.5f);
    grid->tree().addTile(1, Coord(16, 0, 0), 2.0f, false);
    const trk::Density d = fixtures::load(fixtures::write("inactive.vdb", {grid}));
    EXPECT_EQ(densityAt(d, 1, 0, 0), 0.5f);
    EXPECT_EQ(densityAt(d, 0.5, 0, 0), 0.75f);
    EXPECT_EQ(densityAt(d, 20, 3, 3), 2.0f);
    EXPECT_EQ(densityAt(d, 15.5, 3, 3), 1.0f);
}

TEST(LoadDensity, StoresHalfsOnlyWhereExact) {
    auto grid = fixtures::makeBlob(24);
    EXPECT_FALSE(fixtures::load(fixtures::write("float.vdb", {grid})).field.isHalf());
    grid->setSaveFloatAsHalf(true);
    const std::string path = fixtures::write("half.vdb", {grid});
    const trk::Density d = fixtures::load(path);
    EXPECT_TRUE(d.field.isHalf());
    openvdb::io::File file(path);
    file.open();
    auto read = openvdb::gridPtrCast<openvdb::FloatGrid>(file.readGrid("density"));
    for (auto it = read->cbeginValueOn(); it; ++it) {
        const Coord p = it.getCoord();
        ASSERT_EQ(densityAt(d, p.x(), p.y(), p.z()), *it);
    }
}

TEST(LoadDensity, DoubleGridsAreReadAsFloats) {
    openvdb::initialize();
    auto grid = openvdb::DoubleGrid::create();
    grid->setName("density");
    grid->tree().setValue(Coord(2, 3, 4), 0.1);
    const trk::Density d = fixtures::load(fixtures::write("double.vdb", {grid}));
    EXPECT_EQ(d.summary.valueType, "double");
    EXPECT_EQ(densityAt(d, 2, 3, 4), 0.1f);
    grid->tree().setValue(Coord(2, 3, 4), 1e300);
    expectFailure(fixtures::write("huge.vdb", {grid}), TRK_ERROR_BAD_DENSITY, "infinite");
}

TEST(LoadDensity, WorksAtTheLimitsOfIndices) {
    constexpr int32_t kMax = std::numeric_limits<int32_t>::max();
    constexpr int32_t kMin = std::numeric_limits<int32_t>::min();
    auto grid = single(0);
    grid->tree().setValue(Coord(kMax, kMax, kMax), 1.0f);
    grid->tree().setValue(Coord(kMin, kMin, kMin), 2.0f);
    const trk::Density d = fixtures::load(fixtures::write("limits.vdb", {grid}));
    EXPECT_EQ(densityAt(d, kMax, kMax, kMax), 1.0f);
    EXPECT_EQ(densityAt(d, kMax + 0.5, kMax, kMax), 0.5f);
    EXPECT_EQ(densityAt(d, kMin, kMin, kMin), 2.0f);
    EXPECT_EQ(densityAt(d, kMin - 0.5, kMin, kMin), 1.0f);
    EXPECT_LT(d.field.bytes(), 2000000u);
}

TEST(LoadDensity, DigestSeesEveryChange) {
    auto grid = fixtures::makeBlob(20);
    const auto digest = [&](const char* name) {
        return fixtures::load(fixtures::write(name, {grid})).summary.digest;
    };
    const uint64_t original = digest("digest.vdb");
    EXPECT_EQ(digest("again.vdb"), original);
    grid->tree().setActiveState(Coord(10, 10, 10), false);
    const uint64_t masked = digest("masked.vdb");
    EXPECT_NE(masked, original);
    grid->tree().setActiveState(Coord(10, 10, 10), true);
    grid->tree().setValue(Coord(10, 10, 10), 0.123f);
    EXPECT_NE(digest("changed.vdb"), original);
    grid->tree().addTile(1, Coord(1024, 0, 0), 1.0f, true);
    const uint64_t tiled = digest("tiled.vdb");
    grid->tree().addTile(1, Coord(1024, 0, 0), 1.0f, false);
    EXPECT_NE(digest("inactive-tile.vdb"), tiled);
}

TEST(LoadDensity, RefusesForeignAndDamagedFiles) {
    const auto writeBytes = [](const char* name, const std::string& bytes) {
        std::ofstream(fixtures::path(name), std::ios::binary) << bytes;
        return fixtures::path(name);
    };
    expectFailure(fixtures::path("missing.vdb"), TRK_ERROR_IO, "No such file");
    expectFailure(std::filesystem::path(fixtures::path("x")).parent_path().string(), TRK_ERROR_IO,
                  "directory");
    expectFailure(writeBytes("empty.vdb", ""), TRK_ERROR_BAD_FILE, "empty");
    expectFailure(writeBytes("text.vdb", "hello, I am a text file"), TRK_ERROR_BAD_FILE, "text");
    expectFailure(writeBytes("nano.vdb", "NanoVDB2 and so on"), TRK_ERROR_BAD_FILE, "NanoVDB");

    const std::string good = fixtures::write("good.vdb", {fixtures::makeBlob(40)});
    std::ifstream stream(good, std::ios::binary);
    const std::string bytes((std::istreambuf_iterator<char>(stream)),
                            std::istreambuf_iterator<char>());
    for (const size_t keep : {size_t{9}, size_t{30}, size_t{80}, size_t{150}, bytes.size() / 3,
                              bytes.size() / 2, bytes.size() - 1}) {
        expectFailure(writeBytes("short.vdb", bytes.substr(0, keep)), TRK_ERROR_BAD_FILE, "");
    }
    std::string newer = bytes;
    newer[8] = static_cast<char>(0xff);
    expectFailure(writeBytes("newer.vdb", newer), TRK_ERROR_BAD_FILE, "version");
}

std::string bytesOf(const std::string& path) {
    std::ifstream stream(path, std::ios::binary);
    return {std::istreambuf_iterator<char>(stream), std::istreambuf_iterator<char>()};
}

/// The file as if version `version`, of OpenVDB `major`, had been written. (No real writer's file
/// of version 225 was at hand; its floats, doubles and vectors are laid out as 224's.)
std::string asVersion(std::string bytes, uint32_t version, uint32_t major, const char* name) {
    std::memcpy(&bytes[8], &version, sizeof(version));
    std::memcpy(&bytes[12], &major, sizeof(major));
    std::ofstream(fixtures::path(name), std::ios::binary) << bytes;
    return fixtures::path(name);
}

/// The blob with noise that no codec compresses, so that its chunks are stored as they are.
std::string noisyFile(const char* name) {
    std::mt19937 random(5);
    auto grid = fixtures::makeBlob(40);
    for (auto it = grid->beginValueOn(); it; ++it) {
        it.setValue(static_cast<float>(random()) * 0x1p-32f);
    }
    return fixtures::write(name, {grid});
}

openvdb::Vec3SGrid::Ptr noisyColor() {
    std::mt19937 random(5);
    std::uniform_real_distribution<float> unit(0.1f, 1);
    return fixtures::makeColorGrid(CoordBBox(0, 0, 0, 20, 20, 20), [&](const Coord&) {
        return openvdb::Vec3f(unit(random), unit(random), unit(random));
    });
}

TEST(LoadDensity, SurvivesDamage) {
    auto halfColor = noisyColor();
    halfColor->setSaveFloatAsHalf(true);
    for (const std::string& good :
         {noisyFile("noisy.vdb"), fixtures::write("smooth.vdb", {fixtures::makeBlob(40)}),
          fixtures::write("noisy-color.vdb", {noisyColor()}),
          fixtures::write("noisy-half-color.vdb", {halfColor})}) {
        EXPECT_GT(fixtures::load(good).summary.max, 0.0f);
        std::ifstream stream(good, std::ios::binary);
        const std::string bytes((std::istreambuf_iterator<char>(stream)),
                                std::istreambuf_iterator<char>());
        std::mt19937 random(11);
        const auto place = [&] { return random() % bytes.size(); };
        int refused = 0;
        for (int i = 0; i < 300; ++i) {
            std::string damaged = bytes;
            switch (i % 4) {
                case 0:  // something missing: everything behind it is read as something else
                    damaged.erase(place(), size_t{1} << random() % 10);
                    break;
                case 1: {
                    const size_t at = place();
                    damaged.insert(at, damaged.substr(at, 1 + random() % 2000));
                    break;
                }
                case 2:
                    for (int k = 0; k < 8; ++k) {
                        damaged[place()] = static_cast<char>(random());
                    }
                    break;
                default:
                    damaged.resize(place());
                    break;
            }
            const std::string path = fixtures::path("damaged.vdb");
            std::ofstream(path, std::ios::binary) << damaged;
            const auto [status, message] = failure(path, {});
            refused += status == TRK_OK ? 0 : 1;
            EXPECT_NE(status, TRK_ERROR_UNKNOWN) << message;
            EXPECT_EQ(message.find('\n'), std::string::npos) << message;
        }
        EXPECT_GT(refused, 150);  // damage to a value alone cannot be told from another value
    }
}

TEST(LoadDensity, ADirectoryThatGoesRoundIsRefused) {
    const std::string good = fixtures::write("round.vdb", {single(1)});
    std::ifstream stream(good, std::ios::binary);
    std::string bytes((std::istreambuf_iterator<char>(stream)), std::istreambuf_iterator<char>());
    // The entry: name, type and parent, each with its length, then three offsets.
    const size_t name = bytes.find("density");
    ASSERT_NE(name, std::string::npos);
    const size_t offsets = bytes.find("Tree_float_5_4_3") + 16 + 4;
    const int64_t back = static_cast<int64_t>(name) - 4;
    std::memcpy(&bytes[offsets + 16], &back, sizeof(back));
    const int32_t count = std::numeric_limits<int32_t>::max();
    std::memcpy(&bytes[name - 8], &count, sizeof(count));
    const std::string path = fixtures::path("round-damaged.vdb");
    std::ofstream(path, std::ios::binary) << bytes;
    expectFailure(path, TRK_ERROR_BAD_FILE, "ends before it begins");
}

TEST(LoadDensity, HonoursTheMemoryCap) {
    trk::DensityOptions options;
    options.maxMemory = 10000;
    const auto [status, message] =
        failure(fixtures::write("capped.vdb", {fixtures::makeBlob(40)}), options);
    EXPECT_EQ(status, TRK_ERROR_OUT_OF_MEMORY);
    EXPECT_NE(message.find("10000"), std::string::npos);
}

TEST(LoadDensity, EmptyGridsAreEmptyFields) {
    auto grid = openvdb::FloatGrid::create();
    grid->setName("density");
    const trk::Density d = fixtures::load(fixtures::write("void.vdb", {grid}));
    EXPECT_TRUE(d.field.box().empty());
    EXPECT_EQ(densityAt(d, 0, 0, 0), 0.0f);
}

TEST(LoadDensity, ReadsFilesOfVersion225) {
    auto doubles = openvdb::DoubleGrid::create();
    doubles->setName("density");
    doubles->tree().setValueOn(Coord(1, 2, 3), 0.5);
    const openvdb::GridCPtrVec kinds[] = {{fixtures::makeBlob(40)}, {doubles}, {noisyColor()}};
    for (const openvdb::GridCPtrVec& grids : kinds) {
        const std::string old = fixtures::write("224.vdb", grids);
        testing::internal::CaptureStderr();
        const trk::Density expected = fixtures::load(old);
        const trk::Density found = fixtures::load(asVersion(bytesOf(old), 225, 13, "225.vdb"));
        EXPECT_EQ(testing::internal::GetCapturedStderr(), "");  // OpenVDB would warn
        EXPECT_EQ(found.summary.digest, expected.summary.digest);
        EXPECT_EQ(found.summary.activeVoxels, expected.summary.activeVoxels);
        EXPECT_EQ(found.field.brickCount(), expected.field.brickCount());
    }
    const std::string bytes = bytesOf(fixtures::write("224.vdb", {fixtures::makeBlob(40)}));
    expectFailure(asVersion(bytes, 226, 14, "226.vdb"), TRK_ERROR_BAD_FILE,
                  "version 226, written by OpenVDB 14.");
    std::string half = bytes;
    const std::string name("\x10\0\0\0Tree_float_5_4_3", 20);
    const std::string halfName("\x0f\0\0\0Tree_half_5_4_3", 19);
    const size_t at = half.find(name);
    half.replace(at, name.size(), halfName);
    for (size_t i = 0; i < 3; ++i) {  // the directory's offsets, behind an empty name of a parent
        int64_t offset;
        char* place = &half[at + halfName.size() + 4 + 8 * i];
        std::memcpy(&offset, place, sizeof(offset));
        --offset;
        std::memcpy(place, &offset, sizeof(offset));
    }
    expectFailure(asVersion(half, 225, 13, "half.vdb"), TRK_ERROR_UNSUPPORTED_GRID,
                  "native halfs, which OpenVDB 13 writes");
}

}  // namespace
