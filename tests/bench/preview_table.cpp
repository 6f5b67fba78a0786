// SPDX-License-Identifier: Apache-2.0
// What previews of 512x512 cost and how near they come, as Markdown tables: for the procedural
// cloud of 256^3, or the densities named as arguments, at a scale where the median transmittance
// is 0.3. Each row runs in a process of its own, so that its peak memory is its own.
#include "support/fixtures.h"
#include "track/track.hpp"
#include "view/camera.h"
#include "view/lit_preview.h"

#include <sys/resource.h>
#include <sys/wait.h>
#include <unistd.h>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdio>
#include <filesystem>
#include <string>
#include <vector>

namespace {

using trk::ControlKind;

constexpr int kEdge = 512;

/// Runs `body` in a child process and answers its peak memory in MB.
template <class Body>
double inChild(const Body& body) {
    std::fflush(stdout);
    const pid_t child = fork();
    if (child == 0) {
        body();
        std::fflush(stdout);
        _exit(0);
    }
    rusage usage{};
    int status = 0;
    if (wait4(child, &status, 0, &usage) != child || status != 0) {
        std::fprintf(stderr, "preview_table: a row failed\n");
    }
    return static_cast<double>(usage.ru_maxrss) / 1000;
}

vdbtools::Camera cameraFor(const track::Volume& volume) {
    const TrkVolumeInfo info = volume.info();
    vdbtools::WorldBox box;
    for (int a = 0; a < 3; ++a) {
        box.lo[a] = info.boundsMin[a];
        box.hi[a] = info.boundsMax[a];
    }
    vdbtools::Camera camera = vdbtools::namedView("iso");
    vdbtools::frameBox(camera, box, 1);
    return camera;
}

std::vector<double> depths(const track::Volume& volume, const vdbtools::Camera& camera,
                           TrkMethod method, uint32_t level) {
    std::vector<TrkRay> rays;
    for (int row = 0; row < kEdge; ++row) {
        for (int column = 0; column < kEdge; ++column) {
            rays.push_back(camera.ray((column + 0.5) / kEdge, (row + 0.5) / kEdge, 1));
        }
    }
    track::Query query(0, 0);
    query.method = method;
    query.level = level;
    std::vector<double> result(rays.size());
    volume.integrateOpticalDepth(query, rays.data(), rays.size(), result.data());
    return result;
}

/// Root mean square of the difference in transmittance over pixels that meet the volume.
template <class TransmittanceAt>
double rmse(const std::vector<double>& exact, double scale, const TransmittanceAt& at) {
    double squares = 0;
    double count = 0;
    for (size_t i = 0; i < exact.size(); ++i) {
        if (exact[i] > 0) {
            const double error = at(i) - std::exp(-scale * exact[i]);
            squares += error * error;
            count += 1;
        }
    }
    return std::sqrt(squares / count);
}

void printRow(const std::string& vdb, int size, ControlKind kind, uint32_t level) {
    const std::string sidecar =
        fixtures::path("preview" + std::to_string(size) + trk::controlName(kind) + ".track.vdb");
    double scale = 0;
    double errors[2] = {0, 0};
    // What the row is compared with, and its errors, in another process than its costs.
    inChild([&] {
        fixtures::bake(vdb, sidecar, size, 4, kind);
        const track::Volume exact = track::Volume::open(vdb, "");
        const track::Volume control = track::Volume::open("", sidecar.c_str());
        const vdbtools::Camera camera = cameraFor(exact);
        const std::vector<double> depth = depths(exact, camera, TRK_METHOD_EXACT, 0);
        std::vector<double> hits;
        std::copy_if(depth.begin(), depth.end(), std::back_inserter(hits),
                     [](double d) { return d > 0; });
        std::nth_element(hits.begin(), hits.begin() + static_cast<std::ptrdiff_t>(hits.size() / 2),
                         hits.end());
        scale = -std::log(0.3) / hits[hits.size() / 2];
        const std::vector<double> plain = depths(control, camera, TRK_METHOD_CONTROL, level);
        errors[0] = rmse(depth, scale, [&](size_t i) { return std::exp(-scale * plain[i]); });
        vdbtools::LitOptions options;
        options.level = level;
        options.scale = static_cast<float>(scale);
        const vdbtools::LitPreview lit(sidecar, options);
        const vdbtools::Picture picture = lit.draw(camera, kEdge, kEdge, [](double) {});
        errors[1] = rmse(depth, scale, [&](size_t i) {
            return static_cast<double>(picture.transmittance[0][i]);
        });
        std::printf("| %s | %d | %u | %d | %.4f | %.4f |", trk::controlName(kind), size, level,
                    size << level, errors[0], errors[1]);
        std::FILE* file = std::fopen(fixtures::path("scale").c_str(), "w");
        std::fprintf(file, "%.9g", scale);
        std::fclose(file);
    });
    std::FILE* file = std::fopen(fixtures::path("scale").c_str(), "r");
    if (!file || std::fscanf(file, "%lf", &scale) != 1) {
        return;
    }
    std::fclose(file);
    const double memory = inChild([&] {
        const auto start = std::chrono::steady_clock::now();
        const track::Volume control = track::Volume::open("", sidecar.c_str());
        const vdbtools::Camera camera = cameraFor(control);
        vdbtools::LitOptions options;
        options.level = level;
        options.scale = static_cast<float>(scale);
        const vdbtools::LitPreview lit(sidecar, options);
        const vdbtools::Picture picture = lit.draw(camera, kEdge, kEdge, [](double) {});
        const std::chrono::duration<double> elapsed = std::chrono::steady_clock::now() - start;
        std::printf(" %.2f s | %.2f MB |", elapsed.count(), static_cast<double>(lit.bytes()) / 1e6);
    });
    std::printf(" %.0f MB |\n", memory);
    std::fflush(stdout);
}

void printVolume(const std::string& label, const std::string& vdb) {
    std::printf(
        "\n%s\n\n| control | size | level | voxels | RMSE, as baked | RMSE, interpolated | "
        "lit picture | volume and light | peak of the process |\n"
        "|---|---|---|---|---|---|---|---|---|\n",
        label.c_str());
    for (const int size : {32, 16, 8, 4}) {
        for (const ControlKind kind :
             {ControlKind::kConstant, ControlKind::kTrilinear, ControlKind::kAffine}) {
            printRow(vdb, size, kind, 0);
        }
    }
    for (const uint32_t level : {1u, 2u, 3u, 4u}) {
        printRow(vdb, 4, ControlKind::kConstant, level);
    }
}

}  // namespace

int main(int argc, char** argv) {
    fixtures::path("");  // the folder is this process's, not a child's
    if (argc == 1) {
        const std::string cloud = fixtures::path("cloud256.vdb");
        inChild([] { fixtures::cloudFile(256); });
        printVolume("procedural cloud", cloud);
    }
    for (int i = 1; i < argc; ++i) {
        printVolume(std::filesystem::path(argv[i]).filename().string(), argv[i]);
    }
    return 0;
}
