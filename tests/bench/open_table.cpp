// SPDX-License-Identifier: Apache-2.0
// What opening and baking cost over OpenVDB's reading of the same file, as a Markdown table: of the
// files named as arguments, or of procedural volumes of about 17, 7 and 0.2 million voxels. All in
// one run, interleaved, medians of several rounds of wall time; files lie in the system's cache.
#include "bake/bake.h"
#include "support/fixtures.h"
#include "track/track.hpp"

#include <malloc.h>
#include <openvdb/io/File.h>
#include <sys/wait.h>
#include <unistd.h>

#include <algorithm>
#include <chrono>
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
        const std::string sidecar = fixtures::path("open_table.track.vdb");
        const std::function<void()> ways[] = {
            [&] { readWithOpenVdb(file); },
            [&] { track::Volume::open(file, "", noBake); },
            [&] { track::Volume::open(file, ""); },
            [&] { fixtures::bake(file, sidecar, 16, 4); },
            [&] { fixtures::bake(file, sidecar, 4, 4, trk::ControlKind::kAffine); },
        };
        constexpr size_t kWays = 5;
        constexpr size_t kRounds = 9;
        std::vector<double> times[kWays];
        for (size_t round = 0; round < kRounds; ++round) {
            for (size_t w = 0; w < kWays; ++w) {
                times[w].push_back(seconds(ways[w]));
            }
        }
        const auto median = [&](size_t w) {
            std::sort(times[w].begin(), times[w].end());
            return times[w][kRounds / 2];
        };
        const double reference = median(0);
        std::printf("| %s | %.4f | %.2f | %.2f | %.2f | %.2f |",
                    std::filesystem::path(file).filename().c_str(), reference,
                    median(1) / reference, median(2) / reference, median(3) / reference,
                    median(4) / reference);
        std::fflush(stdout);
        const pid_t child = fork();
        if (child == 0) {  // a heap of its own
            execl("/proc/self/exe", argv[0], "--memory", file.c_str(),
                  fixtures::cloudFile(32).c_str(), static_cast<char*>(nullptr));
            _exit(1);
        }
        waitpid(child, nullptr, 0);
    }
    return 0;
}
