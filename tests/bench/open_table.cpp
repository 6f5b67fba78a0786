// SPDX-License-Identifier: Apache-2.0
// What opening and baking cost over OpenVDB's reading of the same file, as a Markdown table: of the
// files named as arguments, or of procedural volumes of about 17, 7 and 0.2 million voxels; then
// what a dense array in memory costs over bricks of a tree. All in one run, interleaved, medians of
// several rounds of wall time; files lie in the system's cache.
#include "bake/bake.h"
#include "bake/write_bake.h"
#include "support/fixtures.h"
#include "track/track.hpp"
#include "track/track_openvdb.hpp"

#include <malloc.h>
#include <openvdb/io/File.h>
#include <openvdb/tools/Dense.h>
#include <sys/wait.h>
#include <unistd.h>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdio>
#include <filesystem>
#include <fstream>
#include <functional>
#include <string>
#include <vector>

namespace {

double seconds(const std::function<void()>& body) {
    const auto start = std::chrono::steady_clock::now();
    body();
    return std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
}

/// The first float or vector grid of a file, as OpenVDB reads it, whole.
void readWithOpenVdb(const std::string& path) {
    openvdb::io::File file(path);
    file.open(/*delayLoad=*/false);
    const openvdb::GridBase::Ptr grid = file.readGrid(file.beginName().gridName());
    if (grid->activeVoxelCount() == 0) {
        std::printf("%s is empty\n", path.c_str());
    }
}

/// All that `vdbtrack bake` does.
void bakeWhole(const std::string& file, int size, trk::ControlKind kind) {
    const trk::Density density = fixtures::load(file);
    trk::BakeOptions options = fixtures::bakeOptions(size, 4, kind);
    options.sidecarBytes = trk::sidecarLimit(density.summary.fileBytes, kind);
    trk::BakedVolume baked = trk::bake(density.field, options);
    trk::OutputFile sidecar(fixtures::path("open_table.track.vdb"), true);
    trk::writeBake(sidecar, density.summary, density.field, baked, options.sidecarBytes);
    sidecar.commit();
}

/// Memory of this process in MB: "VmRSS" now, or "VmHWM" at most.
double megabytes(const std::string& key) {
    std::ifstream stream("/proc/self/status");
    for (std::string line; std::getline(stream, line);) {
        if (line.compare(0, key.size() + 1, key + ":") == 0) {
            return std::stod(line.substr(key.size() + 1)) / 1000;
        }
    }
    return 0;
}

/// Tells the resident memory of this process, which is fresh, for opening `path` without a bake: at
/// most while it did, after, and after giving back what the heap has to spare; without what it had
/// before.
void printMemory(const std::string& path, const std::string& small) {
    TrkVolumeOptions noBake = trkDefaultVolumeOptions();
    noBake.noBake = 1;
    track::Volume::open(small, "", noBake);  // threads and registries first
    malloc_trim(0);
    const double before = megabytes("VmRSS");
    std::ofstream("/proc/self/clear_refs") << 5;
    const track::Volume volume = track::Volume::open(path, "", noBake);
    const double peak = megabytes("VmHWM") - before;
    const double after = megabytes("VmRSS") - before;
    malloc_trim(0);
    const double trimmed = megabytes("VmRSS") - before;
    std::printf(" %.1f | %.1f (%.2f) | %.1f | %.1f |\n",
                static_cast<double>(volume.info().bytes) / 1e6, peak,
                1e6 * peak / static_cast<double>(volume.info().bytes), after, trimmed);
}

/// Medians of several rounds, in which the ways take turns.
std::vector<double> medians(const std::vector<std::function<void()>>& ways) {
    constexpr size_t kRounds = 9;
    std::vector<std::vector<double>> times(ways.size());
    for (size_t round = 0; round < kRounds; ++round) {
        for (size_t w = 0; w < ways.size(); ++w) {
            times[w].push_back(seconds(ways[w]));
        }
    }
    std::vector<double> result;
    for (std::vector<double>& way : times) {
        std::sort(way.begin(), way.end());
        result.push_back(way[kRounds / 2]);
    }
    return result;
}

/// A dense array of 256^3, x fastest, to a volume with a control, over bricks of the same voxels'
/// tree.
void printDense(const char* name, const openvdb::FloatGrid& grid) {
    constexpr int kEdge = 256;
    const openvdb::Coord origin = grid.evalActiveVoxelBoundingBox().min();
    openvdb::tools::Dense<float, openvdb::tools::LayoutXYZ> dense(
        openvdb::CoordBBox::createCube(origin, kEdge));
    openvdb::tools::copyToDense(grid, dense);
    TrkDensity density = trkDefaultDensity();
    density.values = dense.data();
    for (int a = 0; a < 3; ++a) {
        density.origin[a] = origin[a];
        density.extent[a] = kEdge;
    }
    TrkVolumeOptions noBake = trkDefaultVolumeOptions();
    noBake.noBake = 1;
    const std::vector<double> times = medians({[&] { track::makeVolume(grid, noBake); },
                                               [&] { track::Volume::make(density, noBake); },
                                               [&] { track::Volume::make(density); }});
    std::printf("| %s | %.4f | %.2f | %.2f |\n", name, times[0], times[1] / times[0],
                times[2] / times[0]);
}

}  // namespace

int main(int argc, char** argv) {
    if (argc == 4 && std::string(argv[1]) == "--memory") {
        printMemory(argv[2], argv[3]);
        return 0;
    }
    openvdb::initialize();
    TrkVolumeOptions noBake = trkDefaultVolumeOptions();
    noBake.noBake = 1;
    std::vector<std::string> files(argv + 1, argv + argc);
    if (files.empty()) {
        files = {fixtures::cloudFile(640), fixtures::cloudFile(420, "smoke"),
                 fixtures::cloudFile(150)};
    }
    std::printf(
        "| volume | OpenVDB reads, s | opened | opened, baked in memory | baked 16 constant | "
        "baked 4 affine | holds, MB | "
        "peak | resident | trimmed |\n|---|---|---|---|---|---|---|---|---|---|\n");
    for (const std::string& file : files) {
        const std::vector<double> times = medians({
            [&] { readWithOpenVdb(file); },
            [&] { track::Volume::open(file, "", noBake); },
            [&] { track::Volume::open(file, ""); },
            [&] { bakeWhole(file, 16, trk::ControlKind::kConstant); },
            [&] { bakeWhole(file, 4, trk::ControlKind::kAffine); },
        });
        std::printf("| %s | %.4f |", std::filesystem::path(file).filename().c_str(), times[0]);
        for (size_t w = 1; w < times.size(); ++w) {
            std::printf(" %.2f |", times[w] / times[0]);
        }
        std::fflush(stdout);
        const pid_t child = fork();
        if (child == 0) {  // a heap of its own
            execl("/proc/self/exe", argv[0], "--memory", file.c_str(),
                  fixtures::cloudFile(32).c_str(), static_cast<char*>(nullptr));
            _exit(1);
        }
        waitpid(child, nullptr, 0);
    }
    std::printf(
        "\n| of 256^3 in memory | bricks of a tree, s | dense array | dense array, baked |\n"
        "|---|---|---|---|\n");
    openvdb::io::File file(fixtures::cloudFile(256));
    file.open(/*delayLoad=*/false);
    printDense("a cloud", *openvdb::gridPtrCast<openvdb::FloatGrid>(
                              file.readGrid(file.beginName().gridName())));
    printDense("density everywhere",
               *fixtures::makeGrid(
                   openvdb::CoordBBox::createCube({0, 0, 0}, 256), [](const openvdb::Coord& p) {
                       return 2 + std::sin(0.1f * static_cast<float>(p.x() + p.y() * p.z()));
                   }));
    return 0;
}
