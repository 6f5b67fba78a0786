// SPDX-License-Identifier: Apache-2.0
// What writer and reader of a sidecar share: names of grids and where their values live,
// transforms.
#pragma once

#include "../math.h"
#include "../super_voxels.h"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <string>

namespace trk::schema {

constexpr int kFormatMajor = 1;
constexpr const char* kFormat = "1.0";
constexpr const char* kInterpolation = "trilinear";

/// The grids of statistics, in the order written, and where their values live.
struct Statistic {
    const char* suffix;
    float BakedSuperVoxel::*value;
};
constexpr Statistic kStatistics[] = {
    {"_control", &BakedSuperVoxel::control}, {"_majorant", &BakedSuperVoxel::majorant},
    {"_rms", &BakedSuperVoxel::rms},         {"_min", &BakedSuperVoxel::min},
    {"_max", &BakedSuperVoxel::max},
};

inline std::string gridPrefix(const std::string& source) {
    return source.empty() ? "density" : source;
}

inline std::string levelSuffix(int level) {
    return "_control_level_" + std::to_string(level);
}

inline std::string hexDigest(uint64_t digest) {
    char text[17];
    std::snprintf(text, sizeof(text), "%016llx", static_cast<unsigned long long>(digest));
    return text;
}

/// Index i of a grid of super-voxels of `size` lies at source index size i + size / 2.
inline AffineMap superVoxelMap(const AffineMap& source, int size) {
    AffineMap map = source;
    const double centre = size / 2.0;
    const Vec3d shift = source.vector({{centre, centre, centre}});
    for (int row = 0; row < 3; ++row) {
        for (int column = 0; column < 3; ++column) {
            map.linear[row][column] *= size;
        }
        map.translation[row] += shift[row];
    }
    return map;
}

inline AffineMap sourceMap(const AffineMap& superVoxels, int size) {
    AffineMap map = superVoxels;
    for (auto& row : map.linear) {
        for (double& value : row) {
            value /= size;
        }
    }
    const double centre = size / 2.0;
    const Vec3d shift = map.vector({{centre, centre, centre}});
    for (int row = 0; row < 3; ++row) {
        map.translation[row] -= shift[row];
    }
    return map;
}

/// Equal up to the rounding of a few operations, measured where the volume is.
inline bool sameMap(const AffineMap& a, const AffineMap& b) {
    for (int row = 0; row < 3; ++row) {
        double size = 0;
        for (int column = 0; column < 3; ++column) {
            size = std::max(size, std::fabs(a.linear[row][column]));
        }
        for (int column = 0; column < 3; ++column) {
            if (std::fabs(a.linear[row][column] - b.linear[row][column]) > 1e-9 * size) {
                return false;
            }
        }
        const double offset = std::fabs(a.translation[row]);
        if (std::fabs(a.translation[row] - b.translation[row]) > 1e-6 * size + 1e-12 * offset) {
            return false;
        }
    }
    return true;
}

}  // namespace trk::schema
