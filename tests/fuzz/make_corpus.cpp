// SPDX-License-Identifier: Apache-2.0
// Writes what the fuzzers start from: small densities of every type, codec and kind of node, and
// their sidecars. make_corpus FOLDER writes FOLDER/density and FOLDER/sidecar.
#include "io/density_types.h"
#include "support/fixtures.h"

#include <openvdb/io/Stream.h>

#include <cstdio>
#include <filesystem>
#include <fstream>
#include <random>

namespace {

using openvdb::Coord;

template <class GridType>
openvdb::GridBase::Ptr makeSmall(unsigned seed) {
    using Value = typename GridType::ValueType;
    auto grid = GridType::create();
    std::mt19937 random(seed);
    const auto value = [&] {
        const float v[3] = {static_cast<float>(random() % 64) / 16,
                            static_cast<float>(random() % 5), static_cast<float>(random()) * 1e-9f};
        return trk::fromFloats<Value>(v);
    };
    const Value inactive[2] = {value(), value()};
    for (int i = 0; i < 512; ++i) {
        const Coord at(i >> 6, i >> 3 & 7, i & 7);
        if (i % 5 == 0) {
            grid->tree().setValueOn(at, value());
        } else {
            grid->tree().setValueOff(at, inactive[seed % 2 ? 0 : i % 2]);
        }
        grid->tree().setValueOn(at.offsetBy(8, 0, 0), value());
    }
    grid->tree().addTile(1, Coord(64, 0, 0), value(), true);
    if (seed % 3 == 0) {
        grid->tree().addTile(2, Coord(256, 0, 0), value(), true);
        grid->tree().addTile(3, Coord(4096, 0, 0), value(), seed % 2 == 0);
    }
    grid->setName("density");
    return grid;
}

}  // namespace

int main(int argc, char** argv) {
    if (argc != 2) {
        std::fprintf(stderr, "usage: make_corpus FOLDER\n");
        return 2;
    }
    openvdb::initialize();
    const std::filesystem::path folder = argv[1];
    std::filesystem::create_directories(folder / "density");
    std::filesystem::create_directories(folder / "sidecar");
    int count = 0;
    const auto nameOf = [&] { return (folder / "density" / std::to_string(count++)).string(); };
    for (unsigned seed = 0; seed < 4; ++seed) {
        for (const uint32_t compression : {0u, 2u, 3u, 6u}) {
            for (const bool asHalf : {false, true}) {
                for (const openvdb::GridBase::Ptr& grid :
                     {makeSmall<openvdb::FloatGrid>(seed), makeSmall<openvdb::DoubleGrid>(seed),
                      makeSmall<openvdb::Vec3SGrid>(seed), makeSmall<openvdb::Vec3DGrid>(seed)}) {
                    grid->setSaveFloatAsHalf(asHalf);
                    openvdb::io::File file(nameOf());
                    file.setCompression(compression);
                    file.write(openvdb::GridCPtrVec{grid});
                }
            }
        }
    }
    auto ints = openvdb::Int32Grid::create();
    ints->setName("ids");
    ints->tree().setValueOn(Coord(0, 0, 0), 3);
    std::ofstream stream(nameOf(), std::ios::binary);
    openvdb::io::Stream(stream).write(openvdb::GridCPtrVec{ints, makeSmall<openvdb::FloatGrid>(1)});
    stream.close();
    const auto first = openvdb::gridPtrCast<openvdb::FloatGrid>(makeSmall<openvdb::FloatGrid>(0));
    const openvdb::FloatGrid::Ptr second = first->copy();
    second->setName("instance");
    openvdb::io::File(nameOf()).write(openvdb::GridCPtrVec{first, second});

    const std::string vdb = fixtures::write("corpus.vdb", {makeSmall<openvdb::FloatGrid>(2)});
    const std::string color = fixtures::write("color.vdb", {makeSmall<openvdb::Vec3SGrid>(2)});
    for (const trk::ControlKind kind :
         {trk::ControlKind::kConstant, trk::ControlKind::kAffine, trk::ControlKind::kTrilinear}) {
        for (const std::string& source : {vdb, color}) {
            fixtures::bake(source, (folder / "sidecar" / std::to_string(count++)).string(), 4, 2,
                           kind);
        }
    }
    return 0;
}
