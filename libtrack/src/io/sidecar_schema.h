// SPDX-License-Identifier: Apache-2.0
// What writer and reader of a sidecar share: names of grids and where their values live,
// transforms.
#pragma once

#include "control/super_voxels.h"
#include "space/geometry.h"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <string>
#include <vector>

namespace trk::schema {

constexpr int kFormatMajor = 2;
constexpr const char* kFormat = "2.0";
constexpr const char* kInterpolation = "trilinear";

constexpr const char* kControlSuffix = "_control";

/// A grid of statistics, and where its values live.
struct Statistic {
    const char* suffix;
    float BakedSuperVoxel::*value;
};

/// The grids of statistics of a kind of control, in the order written. The mean is the control,
/// except where that is trilinear: then G_control holds corner values, and is no statistic.
inline std::vector<Statistic> statistics(ControlKind kind) {
    const bool trilinear = kind == ControlKind::kTrilinear;
    std::vector<Statistic> list{{trilinear ? "_mean" : kControlSuffix, &BakedSuperVoxel::mean},
                                {"_majorant", &BakedSuperVoxel::majorant},
                                {"_rms", &BakedSuperVoxel::rms},
                                {"_min", &BakedSuperVoxel::min},
                                {"_max", &BakedSuperVoxel::max}};
    if (kind != ControlKind::kConstant) {
        list.push_back({"_deviation", &BakedSuperVoxel::deviation});
    }
    return list;
}

/// The grids of gradients: one a channel of the source.
inline std::vector<std::string> gradientSuffixes(size_t channels) {
    const std::string name = "_gradient";
    return channels == 1 ? std::vector<std::string>{name}
                         : std::vector<std::string>{name + "_r", name + "_g", name + "_b"};
}

/// The type of vectors of the components of `valueType`.
inline std::string vectorType(const std::string& valueType) {
    return valueType == "double" || valueType == "vec3d" ? "vec3d" : "vec3s";
}

/// That the grids of a sidecar begin with: the source's name, with its index where that is one of
/// several of that name; "density" for one without.
inline std::string gridPrefix(const std::string& label) {
    return label == "[0]"                     ? "density"
           : label.empty() || label[0] == '[' ? "density" + label
                                              : label;
}

inline std::string levelSuffix(int level) {
    return "_control_level_" + std::to_string(level);
}

inline std::string previewSuffix(int size) {
    return "_preview_" + std::to_string(size);
}

inline std::string hexDigest(uint64_t digest) {
    char text[17];
    std::snprintf(text, sizeof(text), "%016llx", static_cast<unsigned long long>(digest));
    return text;
}

/// The corner that the grids of a bake count from: that of `box` (index space), rounded down to a
/// multiple of the coarsest level's super-voxels.
inline Int3 originOf(const IntBox& box, int coarsestSize) {
    Int3 origin{{0, 0, 0}};
    if (!box.empty()) {
        for (size_t a = 0; a < 3; ++a) {
            origin[a] = box.lo[a] & ~(int64_t{coarsestSize} - 1);
        }
    }
    return origin;
}

/// Where index i of a grid of super-voxels of `size` lies in source index space: origin + size i +
/// offset. Values of super-voxels lie at their centres, those of corners at the corners.
inline double centreOffset(int size) {
    return size / 2.0;
}

inline Vec3d placeOfFirst(const Int3& origin, double offset) {
    return {{static_cast<double>(origin[0]) + offset, static_cast<double>(origin[1]) + offset,
             static_cast<double>(origin[2]) + offset}};
}

inline AffineMap superVoxelMap(const AffineMap& source, const Int3& origin, int size,
                               double offset) {
    AffineMap map = source;
    const Vec3d shift = source.vector(placeOfFirst(origin, offset));
    for (int row = 0; row < 3; ++row) {
        for (int column = 0; column < 3; ++column) {
            map.linear[row][column] *= size;
        }
        map.translation[row] += shift[row];
    }
    return map;
}

inline AffineMap sourceMap(const AffineMap& superVoxels, const Int3& origin, int size,
                           double offset) {
    AffineMap map = superVoxels;
    for (auto& row : map.linear) {
        for (double& value : row) {
            value /= size;
        }
    }
    const Vec3d shift = map.vector(placeOfFirst(origin, offset));
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
