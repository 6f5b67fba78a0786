// SPDX-License-Identifier: Apache-2.0
// Reading of .vdb files: the values, masks, tiles, transforms and metadata that OpenVDB reads of
// the same bytes, and a refusal that names the place for every kind of structure that lies.
#include "failure.h"
#include "io/density_types.h"
#include "io/vdb_tree.h"
#include "support/fixtures.h"
#include "support/same_as_openvdb.h"

#include <gtest/gtest.h>
#include <openvdb/io/Stream.h>

#include <cstring>
#include <filesystem>
#include <fstream>
#include <limits>
#include <random>
#include <sstream>

namespace {

using openvdb::Coord;
using openvdb::CoordBBox;

std::string bytesOf(const std::string& path) {
    std::ifstream stream(path, std::ios::binary);
    return {std::istreambuf_iterator<char>(stream), std::istreambuf_iterator<char>()};
}

std::string writeBytes(const std::string& name, const std::string& bytes) {
    std::ofstream(fixtures::path(name), std::ios::binary) << bytes;
    return fixtures::path(name);
}

/// Writes grids with these compression flags, which OpenVDB takes off zip for fog volumes.
std::string writeCompressed(const std::string& name, const openvdb::GridCPtrVec& grids,
                            uint32_t compression) {
    openvdb::initialize();
    openvdb::io::File file(fixtures::path(name));
    file.setCompression(compression);
    file.write(grids);
    return fixtures::path(name);
}

/// A grid with leaves, tiles of three sizes, and inactive values of every kind that nodes have a
/// way to store: none, one, two, and all different.
template <class GridType>
typename GridType::Ptr makeMixed(unsigned seed) {
    using Value = typename GridType::ValueType;
    openvdb::initialize();
    auto grid = GridType::create();
    std::mt19937 random(seed);
    const auto value = [&] {
        const float v[3] = {static_cast<float>(random() % 1000) / 512,
                            static_cast<float>(random() % 7), static_cast<float>(random()) * 1e-9f};
        return trk::fromFloats<Value>(v);
    };
    auto& tree = grid->tree();
    for (int leaf = 0; leaf < 12; ++leaf) {
        const Coord origin(8 * (leaf * 37 % 41) - 64, 8 * (leaf * 11 % 13), 8 * leaf - 4096);
        const Value inactive[2] = {value(), value()};
        const Value same = value();
        for (int i = 0; i < 512; ++i) {
            const Coord at = origin.offsetBy(i >> 6, i >> 3 & 7, i & 7);
            const bool active = leaf % 4 == 3 || random() % 3 == 0;
            if (active) {
                tree.setValueOn(at, leaf == 5 ? same : value());
            } else if (leaf % 4 == 1) {
                tree.setValueOff(at, inactive[0]);
            } else if (leaf % 4 == 2) {
                tree.setValueOff(at, inactive[random() % 2]);
            } else if (leaf == 8) {
                tree.setValueOff(at, value());
            }
        }
    }
    tree.addTile(1, Coord(512, 8, 16), value(), true);
    tree.addTile(1, Coord(512, 16, 16), value(), false);
    tree.addTile(2, Coord(1024, 0, 128), value(), true);
    tree.addTile(3, Coord(8192, -4096, 0), value(), true);
    tree.addTile(3, Coord(8192, 0, 0), value(), false);
    grid->setName("density");
    grid->setTransform(openvdb::math::Transform::createLinearTransform(0.25));
    grid->insertMeta("track_text", openvdb::StringMetadata("a text"));
    grid->insertMeta("track_int", openvdb::Int32Metadata(-7));
    grid->insertMeta("track_long", openvdb::Int64Metadata(int64_t{1} << 40));
    grid->insertMeta("track_real", openvdb::DoubleMetadata(0.1));
    grid->insertMeta("track_vector", openvdb::Vec3DMetadata(openvdb::Vec3d(1, 2, 3)));
    grid->insertMeta("other", openvdb::StringMetadata(std::string(100000, 'x')));
    return grid;
}

/// Compares the first grid of a file with what OpenVDB reads; the number of leaves.
size_t compare(const std::string& path) {
    size_t leaves = 0;
    EXPECT_EQ(fixtures::differenceToOpenVdb(path, trk::VdbFile(path).entries()[0], leaves), "")
        << path;
    return leaves;
}

template <class GridType>
void compareEveryCodec(const char* type) {
    for (const uint32_t codec : {0u, 1u, 4u}) {
        for (const uint32_t activeOnly : {0u, 2u}) {
            for (const bool asHalf : {false, true}) {
                auto grid = makeMixed<GridType>(codec + activeOnly);
                grid->setSaveFloatAsHalf(asHalf);
                const std::string path =
                    writeCompressed(std::string(type) + "-codec.vdb", {grid}, codec | activeOnly);
                EXPECT_EQ(compare(path), grid->tree().leafCount());
                trk::VdbFile file(path);
                EXPECT_EQ(file.entries()[0].compression, codec | activeOnly);
                const trk::VdbMetadata metadata = file.readHeader(file.entries()[0]).metadata;
                EXPECT_EQ(metadata.text("track_text"), "a text");
                EXPECT_EQ(metadata.int32("track_int"), -7);
                EXPECT_EQ(metadata.int64("track_long"), int64_t{1} << 40);
                EXPECT_EQ(metadata.real("track_real"), 0.1);
                EXPECT_EQ((*metadata.vec3d("track_vector"))[2], 3);
                EXPECT_FALSE(metadata.text("track_int"));
                EXPECT_FALSE(metadata.text("absent"));
            }
        }
    }
}

TEST(VdbFile, ReadsFloatsOfEveryCodecAsOpenVdbDoes) {
    compareEveryCodec<openvdb::FloatGrid>("float");
}
TEST(VdbFile, ReadsDoublesOfEveryCodecAsOpenVdbDoes) {
    compareEveryCodec<openvdb::DoubleGrid>("double");
}
TEST(VdbFile, ReadsVectorsOfEveryCodecAsOpenVdbDoes) {
    compareEveryCodec<openvdb::Vec3SGrid>("vec3s");
    compareEveryCodec<openvdb::Vec3DGrid>("vec3d");
}

TEST(VdbFile, ReadsEveryVersionFrom222On) {
    const std::string bytes = bytesOf(
        writeCompressed("version.vdb", {makeMixed<openvdb::FloatGrid>(3)}, /*zip, active*/ 3));
    for (const uint32_t version : {222u, 223u, 224u}) {
        std::string changed = bytes;
        std::memcpy(&changed[8], &version, sizeof(version));
        EXPECT_GT(compare(writeBytes("versioned.vdb", changed)), 0u);
    }
}

TEST(VdbFile, ReadsRealFilesAsOpenVdbDoes) {
    TRACK_NEEDS_DATA();
    openvdb::initialize();
    size_t grids = 0;
    for (const auto& item : std::filesystem::directory_iterator(fixtures::dataFolder())) {
        if (item.path().extension() != ".vdb") {
            continue;
        }
        const std::string path = item.path().string();
        trk::VdbFile file(path);
        for (const trk::VdbEntry& entry : file.entries()) {
            if (trk::channelCount(trk::valueTypeName(entry.type)) == 0) {
                continue;
            }
            ++grids;
            size_t leaves = 0;
            EXPECT_EQ(fixtures::differenceToOpenVdb(path, entry, leaves), "")
                << path << " " << entry.label();
        }
    }
    EXPECT_GT(grids, 20u);
}

/// A file of one float grid, and where its parts lie.
struct Sample {
    std::string bytes;
    trk::VdbEntry entry;
    size_t tree = 0;

    explicit Sample(uint32_t compression, bool asHalf = false) {
        auto grid = fixtures::makeBlob(20);
        grid->setGridClass(openvdb::GRID_UNKNOWN);  // which may be zipped
        grid->setSaveFloatAsHalf(asHalf);
        const std::string path = writeCompressed("sample.vdb", {grid}, compression);
        bytes = bytesOf(path);
        trk::VdbFile file(path);
        entry = file.entries()[0];
        tree = file.readHeader(entry).tree;
    }

    template <class T>
    std::string with(size_t at, const T& value) const {
        std::string changed = bytes;
        std::memcpy(&changed[at], &value, sizeof(value));
        return changed;
    }
};

void expectRefused(const std::string& bytes, const std::string& text) {
    const std::string path = writeBytes("lies.vdb", bytes);
    try {
        fixtures::load(path, "density");
        ADD_FAILURE() << "accepted; expected: " << text;
    } catch (const trk::Error& e) {
        EXPECT_EQ(e.status(), TRK_ERROR_BAD_FILE) << e.what();
        EXPECT_NE(std::string(e.what()).find(text), std::string::npos) << e.what();
        EXPECT_EQ(std::string(e.what()).rfind(path, 0), 0u) << e.what();
    }
}

// Of the tree of a sample: buffers, background, counts of root tiles and children, the origin of
// the first child, its masks, and how its values are stored.
constexpr size_t kTiles = 8;
constexpr size_t kChildren = 12;
constexpr size_t kOrigin = 16;
constexpr size_t kChildMask = 28;
constexpr size_t kActiveMask = kChildMask + 4096;
constexpr size_t kKind = kActiveMask + 4096;

TEST(VdbFile, RefusesATreeThatLies) {
    const Sample s(2);
    const auto lies = [&](size_t at, auto value, const char* text) {
        expectRefused(s.with(s.tree + at, value), text);
    };
    lies(0, int32_t{2}, "a tree of 2 buffers");
    lies(kTiles, uint32_t{0x7fffffff}, "root tiles expected");
    lies(kChildren, uint32_t{0x7fffffff}, "root children expected");
    lies(kChildren, uint32_t{2}, "root");
    lies(kChildren, uint32_t{0}, "its topology ends here");
    lies(kOrigin, int32_t{8}, "expected multiples of 4096");
    lies(kActiveMask, uint64_t{0xffffffffffffffff}, "a child where it has an active value");
    lies(kKind, uint8_t{7}, "stored in way 7");
    expectRefused(s.with(s.entry.position, uint32_t{8}), "compressed in way 8");
}

TEST(VdbFile, RefusesLeavesThatLie) {
    for (const uint32_t compression : {2u, 3u, 6u}) {
        const Sample s(compression);
        const size_t leaf = s.entry.blocks;
        uint64_t mask;
        std::memcpy(&mask, &s.bytes[leaf], sizeof(mask));
        expectRefused(s.with(leaf, mask ^ 1), "is not that of the topology");
        expectRefused(s.with(leaf + 64, uint8_t{200}), "stored in way 200");
        expectRefused(s.with(leaf + 64, uint8_t{6}), compression == 2 ? "" : "chunk");
        if (compression == 2) {
            continue;
        }
        for (const int64_t size : {int64_t{-8}, int64_t{1} << 40, int64_t{100000},
                                   std::numeric_limits<int64_t>::min()}) {
            expectRefused(s.with(leaf + 65, size), "a chunk of");
        }
        expectRefused(s.with(leaf + 65, int64_t{1}), "");
    }
    // A Blosc chunk whose own header asks for more than the node has room for.
    const Sample s(6);
    expectRefused(s.with(s.entry.blocks + 65 + 8 + 4, uint32_t{1 << 30}), "a Blosc chunk");
}

TEST(VdbFile, RefusesTypesAndHalfFlagsThatDisagree) {
    const std::string flag = "is_saved_as_half_float";
    for (const bool asHalf : {false, true}) {
        const Sample s(6, asHalf);
        const size_t at = s.bytes.find(flag);
        ASSERT_NE(at, std::string::npos);
        // Its name, then its type "bool" and its size, each with four bytes in front, then it.
        expectRefused(s.with(at + flag.size() + 8 + 4, static_cast<uint8_t>(!asHalf)), "its type");
    }
}

TEST(VdbFile, RefusesMetadataLongerThanTheFile) {
    const Sample s(6);
    expectRefused(s.with(s.entry.position + 4, uint32_t{0xffffffff}), "");
    expectRefused(s.with(s.entry.position + 8, uint32_t{0xfffffff0}), "a name of metadata");
    const std::string name = "file_compression";
    const size_t at = s.bytes.find(name) + name.size() + 4 + 6;  // behind "string"
    expectRefused(s.with(at, uint32_t{0xfffffff0}), "bytes of metadata expected");
}

TEST(VdbFile, RefusesADirectoryThatLies) {
    const Sample s(6);
    const size_t offsets = s.bytes.find("Tree_float_5_4_3") + 16 + 4;
    expectRefused(s.with(offsets, uint64_t{0}), "ends before it begins");
    expectRefused(s.with(offsets + 8, s.entry.blocks - 1), "its values are said to begin");
    expectRefused(s.with(offsets + 16, s.entry.end + 1000), "the file ends early");
    expectRefused(s.with(offsets + 16, s.entry.end - 1), "the grid ends early");
    std::string longer = s.with(offsets + 16, s.entry.end + 4) + "rest";
    expectRefused(longer, "is said to go on for 4 bytes");
    expectRefused(s.with(8, uint32_t{221}), "version 221, written by OpenVDB");
    expectRefused(s.with(20, uint8_t{3}), "flag of offsets");
}

TEST(VdbFile, RefusesEveryChangedBitOfAZipChunk) {
    const Sample s(3);
    std::mt19937 random(3);
    const size_t first = s.entry.blocks + 65 + 8;
    int64_t size;
    std::memcpy(&size, &s.bytes[first - 8], sizeof(size));
    ASSERT_GT(size, 100);
    for (int i = 0; i < 200; ++i) {
        std::string changed = s.bytes;
        changed[first + random() % static_cast<size_t>(size)] ^= static_cast<char>(1u << i % 8);
        expectRefused(changed, "a zip chunk");
    }
}

TEST(VdbFile, TakesAnInactiveValueForNoSize) {
    // The bits of the second inactive value of this double are those of a chunk size of 8.
    openvdb::initialize();
    auto grid = openvdb::DoubleGrid::create();
    double eight;
    const uint64_t bits = 8;
    std::memcpy(&eight, &bits, sizeof(eight));
    grid->tree().setValueOn(Coord(0, 0, 0), 1.0);
    for (int i = 1; i < 512; ++i) {
        grid->tree().setValueOff(Coord(i >> 6, i >> 3 & 7, i & 7), i % 2 ? eight : 0.5);
    }
    grid->setName("density");
    for (const uint32_t compression : {3u, 6u}) {
        EXPECT_EQ(compare(writeCompressed("eight.vdb", {grid}, compression)), 1u);
    }
}

TEST(VdbFile, StepsOverForeignGridsInStreams) {
    openvdb::initialize();
    const auto foreign = [](auto grid, auto value) -> openvdb::GridBase::Ptr {
        for (int i = 0; i < 600; i += 7) {
            grid->tree().setValueOn(Coord(i, i % 13, -i), value);
        }
        grid->setName("foreign");
        return grid;
    };
    for (const openvdb::GridBase::Ptr& other :
         {foreign(openvdb::Int32Grid::create(), 5), foreign(openvdb::Int64Grid::create(), 5),
          foreign(openvdb::BoolGrid::create(), true),
          foreign(openvdb::Vec3IGrid::create(), openvdb::Vec3i(1, 2, 3)),
          foreign(openvdb::DoubleGrid::create(), 0.5)}) {
        std::ostringstream stream(std::ios::binary);
        openvdb::io::Stream(stream).write(
            openvdb::GridCPtrVec{other, makeMixed<openvdb::FloatGrid>(1)});
        const std::string path = writeBytes("stream.vdb", stream.str());
        EXPECT_EQ(fixtures::load(path, "density").summary.digest,
                  fixtures::load(fixtures::write("same.vdb", {makeMixed<openvdb::FloatGrid>(1)}))
                      .summary.digest)
            << other->type();
        const std::string bytes = stream.str();
        for (size_t part = 1; part < 20; ++part) {
            expectRefused(bytes.substr(0, bytes.size() * part / 20), "");
        }
    }
    auto points = openvdb::MaskGrid::create();
    points->setName("mask");
    points->tree().setValueOn(Coord(0, 0, 0));
    std::ostringstream stream(std::ios::binary);
    openvdb::io::Stream(stream).write(
        openvdb::GridCPtrVec{points, makeMixed<openvdb::FloatGrid>(1)});
    expectRefused(stream.str(), "in a file without offsets");
}

}  // namespace
