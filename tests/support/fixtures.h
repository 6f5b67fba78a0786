// SPDX-License-Identifier: Apache-2.0
// Volumes the tests make, and where they put them.
#pragma once

#include "bake/bake.h"
#include "io/density.h"
#include "io/openvdb_grids.h"
#include "io/sidecar.h"
#include "measure/sweep.h"

#include <cstdint>
#include <functional>
#include <string>
#include <vector>

namespace fixtures {

/// Whether a sanitizer slows this build down and takes memory of its own.
#if defined(__has_feature)  // clang
#if __has_feature(address_sanitizer)
#define TRACK_SANITIZED 1
#endif
#endif
#if defined(__SANITIZE_ADDRESS__) || defined(TRACK_SANITIZED)
inline constexpr bool kSanitized = true;
#else
inline constexpr bool kSanitized = false;
#endif

/// A file name in this process's own temporary folder, which is removed at exit.
std::string path(const std::string& name);

/// The folder of real volumes, or "" where there is none (environment variable TRACK_TEST_DATA).
std::string dataFolder();

/// Skips the current test, visibly, without the real volumes.
#define TRACK_NEEDS_DATA()                                                 \
    if (fixtures::dataFolder().empty()) {                                  \
        GTEST_SKIP() << "TRACK_TEST_DATA names no folder of real volumes"; \
    }

/// A fog volume named "density" with the values of `f` (0 is inactive) over a box of index space.
openvdb::FloatGrid::Ptr makeGrid(const openvdb::CoordBBox& box,
                                 const std::function<float(const openvdb::Coord&)>& f);

/// The same of three channels, f answering them.
openvdb::Vec3SGrid::Ptr makeColorGrid(
    const openvdb::CoordBBox& box, const std::function<openvdb::Vec3f(const openvdb::Coord&)>& f);

/// A Gaussian blob with some texture on it, at the centre of an n^3 box.
openvdb::FloatGrid::Ptr makeBlob(int n);

/// Writes grids to path(name) and answers that path.
std::string write(const std::string& name, const openvdb::GridCPtrVec& grids);

/// The procedural cloud, or another kind, of n^3 voxels, made once per process.
std::string cloudFile(int n, const std::string& kind = "cloud");

trk::Density load(const std::string& path, const std::string& grid = "");

/// The same, to make many volumes over.
vdbtools::Source loadSource(const std::string& path);

/// What a benchmark runs on: the files of its command line, or the procedural cloud and smoke.
struct NamedVolume {
    std::string label;
    std::string vdb;
};
std::vector<NamedVolume> volumesOf(int argc, char** argv);

/// Bakes `vdb` to `sidecar` the way `vdbtrack bake` does.
void bake(const std::string& vdb, const std::string& sidecar, int size, int levels = 2,
          trk::ControlKind kind = trk::ControlKind::kConstant);

/// The options of such a bake.
trk::BakeOptions bakeOptions(int size, int levels,
                             trk::ControlKind kind = trk::ControlKind::kConstant);

}  // namespace fixtures
