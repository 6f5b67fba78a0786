// SPDX-License-Identifier: Apache-2.0
#include "density_field.h"

#include <utility>

namespace trk {

DensityField::DensityField(size_t channels, SparseTable table, std::vector<float> constants,
                           RawArray<float> floats, RawArray<uint16_t> halfs)
    : channels_(channels),
      table_(std::move(table)),
      constants_(std::move(constants)),
      floats_(std::move(floats)),
      halfs_(std::move(halfs)),
      box_(table_.occupiedBox()) {}

size_t DensityField::bytes() const {
    return table_.bytes() + constants_.capacity() * sizeof(float) + floats_.bytes() +
           halfs_.bytes();
}

template <size_t C>
std::array<double, C> DensityField::integrate(const LocalRay& ray, double t0, double t1,
                                              uint64_t& lookups, uint64_t& regions) const {
    std::array<double, C> sum{};
    table_.walk(ray, t0, t1, [&](Entry entry, const Int3& lo, int, double tEnter, double tExit) {
        ++regions;
        uint64_t cells = 0;
        const std::array<double, C> part = integrateRegion<C>(entry, lo, ray, tEnter, tExit, cells);
        lookups += 2 * cells;
        for (size_t c = 0; c < C; ++c) {
            sum[c] += part[c];
        }
        return true;
    });
    return sum;
}

template std::array<double, 1> DensityField::integrate<1>(const LocalRay&, double, double,
                                                          uint64_t&, uint64_t&) const;
template std::array<double, 3> DensityField::integrate<3>(const LocalRay&, double, double,
                                                          uint64_t&, uint64_t&) const;

}  // namespace trk
