// SPDX-License-Identifier: Apache-2.0
#include "extinction_field.h"

#include <utility>

namespace trk {

ExtinctionField::ExtinctionField(SparseTable table, std::vector<float> constants,
                                 std::vector<float> floats, std::vector<uint16_t> halfs)
    : table_(std::move(table)),
      constants_(std::move(constants)),
      floats_(std::move(floats)),
      halfs_(std::move(halfs)),
      box_(table_.occupiedBox()) {}

size_t ExtinctionField::bytes() const {
    return table_.bytes() + constants_.capacity() * sizeof(float) +
           floats_.capacity() * sizeof(float) + halfs_.capacity() * sizeof(uint16_t);
}

void ExtinctionField::copyBrick(Entry entry, float (&out)[kBrickVertices]) const {
    const size_t first = (entry - 1) * kBrickVertices;
    for (size_t i = 0; i < kBrickVertices; ++i) {
        out[i] = isHalf() ? decodeHalf(halfs_[first + i]) : floats_[first + i];
    }
}

template <class Stored>
double ExtinctionField::integrateBrick(const Stored* brick, const Int3& lo, const LocalRay& ray,
                                       double t0, double t1, uint64_t& lookups) {
    constexpr std::ptrdiff_t kStride[3] = {81, 9, 1};
    constexpr double kGauss = 0.57735026918962576451;  // 1/sqrt(3)
    double origin[3];
    double cellOrigin[3];  // of the current cell: integers, as doubles
    double planeStep[3];
    double tPlane[3];
    std::ptrdiff_t stride[3];
    const Stored* corner = brick;
    for (int a = 0; a < 3; ++a) {
        origin[a] = ray.origin[a] - static_cast<double>(lo[static_cast<size_t>(a)]);
        const bool backwards = ray.direction[a] < 0;
        const double start = origin[a] + t0 * ray.direction[a];
        const auto cell = std::min(std::max(static_cast<int>(start), 0), 7);
        cellOrigin[a] = cell;
        planeStep[a] = backwards ? -1 : 1;
        stride[a] = backwards ? -kStride[a] : kStride[a];
        corner += cell * kStride[a];
        tPlane[a] = (cell + (backwards ? 0 : 1) - origin[a]) * ray.inverse[a];
    }
    double sum = 0;
    double t = t0;
    for (;;) {
        int axis = tPlane[0] < tPlane[1] ? 0 : 1;
        axis = tPlane[2] < tPlane[axis] ? 2 : axis;
        const bool last = !(tPlane[axis] < t1);
        const double tExit = last ? t1 : std::max(t, tPlane[axis]);
        const double half = 0.5 * (tExit - t);
        const double middle = t + half;
        double centre[3];
        double offset[3];
        for (int a = 0; a < 3; ++a) {
            centre[a] = origin[a] - cellOrigin[a] + middle * ray.direction[a];
            offset[a] = half * kGauss * ray.direction[a];
        }
        // In double: near the far face of a cell next to empty space the value is the small
        // difference between 1 and the fraction.
        const Corners<double> corners(corner);
        sum += half * (interpolate<double>(corners, centre[0] - offset[0], centre[1] - offset[1],
                                           centre[2] - offset[2]) +
                       interpolate<double>(corners, centre[0] + offset[0], centre[1] + offset[1],
                                           centre[2] + offset[2]));
        lookups += 2;
        if (last) {
            return sum;
        }
        cellOrigin[axis] += planeStep[axis];
        if (cellOrigin[axis] < 0 || cellOrigin[axis] > 7) {
            return sum;
        }
        corner += stride[axis];
        const double plane = cellOrigin[axis] + (planeStep[axis] > 0 ? 1 : 0);
        tPlane[axis] = (plane - origin[axis]) * ray.inverse[axis];
        t = tExit;
    }
}

double ExtinctionField::integrate(const LocalRay& ray, double t0, double t1, uint64_t& lookups,
                                  uint64_t& regions) const {
    double sum = 0;
    table_.walk(ray, t0, t1, [&](Entry entry, const Int3& lo, int, double tEnter, double tExit) {
        ++regions;
        if (isConstant(entry)) {
            sum += constant(entry) * (tExit - tEnter);
        } else {
            const size_t first = (entry - 1) * kBrickVertices;
            sum += isHalf() ? integrateBrick(&halfs_[first], lo, ray, tEnter, tExit, lookups)
                            : integrateBrick(&floats_[first], lo, ray, tEnter, tExit, lookups);
        }
        return true;
    });
    return sum;
}

}  // namespace trk
