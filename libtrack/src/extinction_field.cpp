// SPDX-License-Identifier: Apache-2.0
#include "extinction_field.h"

#include <utility>

namespace trk {

ExtinctionField::ExtinctionField(size_t channels, SparseTable table, std::vector<float> constants,
                                 std::vector<float> floats, std::vector<uint16_t> halfs)
    : channels_(channels),
      table_(std::move(table)),
      constants_(std::move(constants)),
      floats_(std::move(floats)),
      halfs_(std::move(halfs)),
      box_(table_.occupiedBox()) {}

size_t ExtinctionField::bytes() const {
    return table_.bytes() + constants_.capacity() * sizeof(float) +
           floats_.capacity() * sizeof(float) + halfs_.capacity() * sizeof(uint16_t);
}

template <size_t C, class Stored>
void ExtinctionField::integrateBrick(const Stored* brick, const Int3& lo, const LocalRay& ray,
                                     double t0, double t1, uint64_t& lookups,
                                     std::array<double, C>& sum) {
    constexpr std::ptrdiff_t kStride[3] = {81 * C, 9 * C, C};
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
        for (size_t c = 0; c < C; ++c) {
            const Corners<double, C> corners(corner + c);
            sum[c] +=
                half * (interpolate<double>(corners, centre[0] - offset[0], centre[1] - offset[1],
                                            centre[2] - offset[2]) +
                        interpolate<double>(corners, centre[0] + offset[0], centre[1] + offset[1],
                                            centre[2] + offset[2]));
        }
        lookups += 2;
        if (last) {
            return;
        }
        cellOrigin[axis] += planeStep[axis];
        if (cellOrigin[axis] < 0 || cellOrigin[axis] > 7) {
            return;
        }
        corner += stride[axis];
        const double plane = cellOrigin[axis] + (planeStep[axis] > 0 ? 1 : 0);
        tPlane[axis] = (plane - origin[axis]) * ray.inverse[axis];
        t = tExit;
    }
}

template <size_t C>
std::array<double, C> ExtinctionField::integrate(const LocalRay& ray, double t0, double t1,
                                                 uint64_t& lookups, uint64_t& regions) const {
    std::array<double, C> sum{};
    table_.walk(ray, t0, t1, [&](Entry entry, const Int3& lo, int, double tEnter, double tExit) {
        ++regions;
        if (isConstant(entry)) {
            for (size_t c = 0; c < C; ++c) {
                sum[c] += static_cast<double>(constant(entry)[c]) * (tExit - tEnter);
            }
            return true;
        }
        // Summed apart, so that it stays in registers.
        std::array<double, C> part{};
        const size_t first = (entry - 1) * kBrickVertices * C;
        if (isHalf()) {
            integrateBrick<C>(&halfs_[first], lo, ray, tEnter, tExit, lookups, part);
        } else {
            integrateBrick<C>(&floats_[first], lo, ray, tEnter, tExit, lookups, part);
        }
        for (size_t c = 0; c < C; ++c) {
            sum[c] += part[c];
        }
        return true;
    });
    return sum;
}

template std::array<double, 1> ExtinctionField::integrate<1>(const LocalRay&, double, double,
                                                             uint64_t&, uint64_t&) const;
template std::array<double, 3> ExtinctionField::integrate<3>(const LocalRay&, double, double,
                                                             uint64_t&, uint64_t&) const;

}  // namespace trk
