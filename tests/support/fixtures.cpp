// SPDX-License-Identifier: Apache-2.0
#include "fixtures.h"

#include "bake/bake.h"
#include "bake/write_bake.h"
#include "make/procedural.h"

#include <unistd.h>

#include <cmath>
#include <cstdlib>
#include <filesystem>
#include <memory>
#include <utility>

namespace fixtures {
namespace {

struct TemporaryFolder {
    std::filesystem::path path;

    TemporaryFolder()
        : path(std::filesystem::temp_directory_path() /
               ("track-test-" + std::to_string(getpid()))) {
        std::filesystem::create_directories(path);
    }
    ~TemporaryFolder() {
        std::error_code ignored;
        std::filesystem::remove_all(path, ignored);
    }
};

template <class GridType, class F>
typename GridType::Ptr makeTypedGrid(const openvdb::CoordBBox& box, const F& f) {
    openvdb::initialize();
    auto grid = GridType::create();
    auto accessor = grid->getAccessor();
    for (auto at = box.begin(); at; ++at) {
        const auto v = f(*at);
        if (v != openvdb::zeroVal<typename GridType::ValueType>()) {
            accessor.setValue(*at, v);
        }
    }
    grid->setName("density");
    grid->setGridClass(openvdb::GRID_FOG_VOLUME);
    return grid;
}

}  // namespace

std::string path(const std::string& name) {
    static const TemporaryFolder folder;
    return (folder.path / name).string();
}

std::string dataFolder() {
    const char* folder = std::getenv("TRACK_TEST_DATA");
    return folder && std::filesystem::is_directory(folder) ? folder : "";
}

openvdb::FloatGrid::Ptr makeGrid(const openvdb::CoordBBox& box,
                                 const std::function<float(const openvdb::Coord&)>& f) {
    return makeTypedGrid<openvdb::FloatGrid>(box, f);
}

openvdb::Vec3SGrid::Ptr makeColorGrid(
    const openvdb::CoordBBox& box, const std::function<openvdb::Vec3f(const openvdb::Coord&)>& f) {
    return makeTypedGrid<openvdb::Vec3SGrid>(box, f);
}

openvdb::FloatGrid::Ptr makeBlob(int n) {
    const double centre = 0.5 * (n - 1);
    return makeGrid(openvdb::CoordBBox(0, 0, 0, n - 1, n - 1, n - 1), [&](const openvdb::Coord& p) {
        const double x = (p.x() - centre) / n;
        const double y = (p.y() - centre) / n;
        const double z = (p.z() - centre) / n;
        const double r2 = x * x + y * y + z * z;
        const double texture =
            1 + 0.5 * std::sin(1.3 * p.x()) * std::sin(1.1 * p.y() + 0.7 * p.z());
        return r2 > 0.24 ? 0.0f : static_cast<float>(std::exp(-12 * r2) * texture);
    });
}

std::string write(const std::string& name, const openvdb::GridCPtrVec& grids) {
    openvdb::initialize();
    openvdb::io::File file(path(name));
    file.write(grids);
    return path(name);
}

std::string cloudFile(int n, const std::string& kind) {
    const std::string name = path(kind + std::to_string(n) + ".vdb");
    if (!std::filesystem::exists(name)) {
        vdbtools::ProceduralOptions options;
        options.voxels = n;
        options.kind = kind;
        trk::OutputFile file(name, false);
        vdbtools::writeProcedural(options, file, [](double) {});
        file.commit();
    }
    return name;
}

trk::Density load(const std::string& file, const std::string& grid) {
    trk::DensityOptions options;
    options.gridNamed = !grid.empty();
    options.gridName = grid;
    return trk::loadDensity(file, options);
}

vdbtools::Source loadSource(const std::string& path) {
    trk::Density density = load(path);
    vdbtools::Source source;
    source.summary = density.summary;
    source.field = std::make_shared<const trk::DensityField>(std::move(density.field));
    return source;
}

std::vector<NamedVolume> volumesOf(int argc, char** argv) {
    std::vector<NamedVolume> volumes;
    for (int i = 1; i < argc; ++i) {
        volumes.push_back({std::filesystem::path(argv[i]).stem().string(), argv[i]});
    }
    if (volumes.empty()) {
        volumes = {{"procedural cloud", cloudFile(256)},
                   {"procedural smoke", cloudFile(256, "smoke")}};
    }
    return volumes;
}

trk::BakeOptions bakeOptions(int size, int levels, trk::ControlKind kind) {
    trk::BakeOptions options;
    options.superVoxelSize = size;
    options.levels = levels;
    options.kind = kind;
    return options;
}

void bake(const std::string& vdb, const std::string& sidecar, int size, int levels,
          trk::ControlKind kind) {
    const trk::Density density = load(vdb);
    const trk::BakeOptions options = bakeOptions(size, levels, kind);
    trk::OutputFile file(sidecar, true);
    const trk::BakedVolume baked = trk::bake(density.field, options);
    trk::writeSidecar(file, trk::sidecarHeader(density.summary, density.field, baked), baked,
                      density.summary.anchor);
    file.commit();
}

}  // namespace fixtures
