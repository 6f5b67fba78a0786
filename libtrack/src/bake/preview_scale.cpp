// SPDX-License-Identifier: Apache-2.0
#include "preview_scale.h"

#include "../parallel.h"

#include <algorithm>
#include <array>
#include <charconv>
#include <cmath>
#include <cstdio>
#include <cstring>
#include <vector>

namespace trk {
namespace {

/// Integral of the density (the mean over channels) along the line of an axis through a place,
/// times the length of a voxel along it.
double depthThrough(const ExtinctionField& field, const Vec3d& place, int axis, double voxel) {
    LocalRay ray;
    ray.origin = place;
    const IntBox& box = field.box();
    for (int a = 0; a < 3; ++a) {
        ray.direction[a] = a == axis ? 1 : 0;
        ray.inverse[a] = a == axis ? 1 : 1e300;
    }
    ray.origin[axis] = static_cast<double>(box.lo[static_cast<size_t>(axis)]);
    ray.tEnd = static_cast<double>(box.hi[static_cast<size_t>(axis)]) - ray.origin[axis];
    uint64_t ignored = 0;
    double sum = 0;
    if (field.channels() == 1) {
        sum = field.integrate<1>(ray, 0, ray.tEnd, ignored, ignored)[0];
    } else {
        for (const double d : field.integrate<3>(ray, 0, ray.tEnd, ignored, ignored)) {
            sum += d / 3;
        }
    }
    return sum * voxel;
}

/// The nearest number of two digits, as it is written.
double twoDigits(double value) {
    char text[32];
    std::snprintf(text, sizeof(text), "%.1e", value);
    double result = value;
    std::from_chars(text, text + std::strlen(text), result);
    return result;
}

}  // namespace

double previewScale(const ExtinctionField& field, const AffineMap& indexToWorld) {
    constexpr size_t kPlaces = 1024;
    size_t count = 0;
    field.table().forEach([&](const Int3&, int, SparseTable::Entry) { ++count; });
    const size_t step = std::max<size_t>(1, count / kPlaces);
    std::vector<Vec3d> centres;
    size_t i = 0;
    field.table().forEach([&](const Int3& lo, int shift, SparseTable::Entry) {
        if (i++ % step != step / 2) {
            return;
        }
        Vec3d centre;
        for (int a = 0; a < 3; ++a) {
            centre[a] = static_cast<double>(lo[static_cast<size_t>(a)]) + std::ldexp(0.5, shift);
        }
        centres.push_back(centre);
    });
    std::vector<double> depths(3 * centres.size());
    parallelFor(depths.size(), 16, [&](size_t k) {
        const int axis = static_cast<int>(k % 3);
        depths[k] = depthThrough(field, centres[k / 3], axis, length(indexToWorld.column(axis)));
    });
    depths.erase(std::remove_if(depths.begin(), depths.end(), [](double d) { return !(d > 0); }),
                 depths.end());
    if (depths.empty()) {
        return 1;
    }
    const auto middle = depths.begin() + static_cast<std::ptrdiff_t>(depths.size() / 2);
    std::nth_element(depths.begin(), middle, depths.end());
    constexpr double kShown = 4.6;  // -log(0.01)
    // From a veil to a solid body, the volume's own scale is what its maker meant.
    constexpr double kThinnest = 3;
    constexpr double kThickest = 12;
    if (*middle >= kThinnest && *middle <= kThickest) {
        return 1;
    }
    return std::min(twoDigits(kShown / *middle), 1e37);  // it becomes a float
}

}  // namespace trk
