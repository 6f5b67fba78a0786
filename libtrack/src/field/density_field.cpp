// SPDX-License-Identifier: Apache-2.0
#include "density_field.h"

#include "kernel.h"
#include "line_integral.h"
#include "line_samples.h"
#include "table_cursor.h"

#include <utility>

namespace trk {

DensityField::DensityField(size_t channels, SparseTable table, std::vector<float> constants,
                           RawArray<float> floats, RawArray<uint16_t> halfs)
    : channels_(channels),
      table_(std::move(table).flattened()),
      constants_(std::move(constants)),
      floats_(std::move(floats)),
      halfs_(std::move(halfs)),
      box_(table_.occupiedBox()) {}

size_t DensityField::bytes() const {
    return table_.bytes() + constants_.capacity() * sizeof(float) + floats_.bytes() +
           halfs_.bytes();
}

namespace {

template <size_t C, class Stored>
std::array<double, C> integrateLine(const DensityField& field, const Stored* bricks,
                                    const LocalRay& ray, double t0, double t1, uint64_t& lookups,
                                    uint64_t& regions) {
    LineIntegral<C, Stored> line(field.table(), bricks, ray);
    std::array<double, C> sum{};
    TableCursor cursor(field.table(), ray, t0, t1);
    uint64_t met = 0;
    while (const size_t count = cursor.refill()) {
        met += count;
        for (size_t i = 0; i < count;) {
            const double tEnter = cursor.tEnter(i);
            if (DensityField::isConstant(cursor.entry(i))) {
                const float* constant = field.constant(cursor.entry(i));
                for (size_t c = 0; c < C; ++c) {
                    sum[c] += static_cast<double>(constant[c]) * (cursor.tExit(i) - tEnter);
                }
                ++i;
                continue;
            }
            // Bricks one after another are one stretch.
            const Vec3d lo = cursor.lo(i);
            do {
                ++i;
            } while (i < count && !DensityField::isConstant(cursor.entry(i)) &&
                     cursor.tEnter(i) == cursor.tExit(i - 1));
            line.add(lo, tEnter, cursor.tExit(i - 1));
        }
    }
    const std::array<double, C> cells = line.sum();
    for (size_t c = 0; c < C; ++c) {
        sum[c] += cells[c];
    }
    regions += met;
    lookups += 2 * line.cellCount();
    return sum;
}

template <size_t C, class Stored>
uint64_t sampleLine(const DensityField& field, const Stored* bricks, const LocalRay& ray, double t0,
                    double t1, double points, const double* offsets, size_t combs,
                    std::array<double, C>* sums) {
    LineSamples<C, Stored> line(field, bricks, ray, t0, t1, points, offsets, combs, sums);
    line.add();
    return line.count();
}

#ifdef TRACK_AVX2
template <size_t C, class Stored>
TRACK_AVX2 uint64_t sampleLineAvx2(const DensityField& field, const Stored* bricks,
                                   const LocalRay& ray, double t0, double t1, double points,
                                   const double* offsets, size_t combs,
                                   std::array<double, C>* sums) {
    return sampleLine<C>(field, bricks, ray, t0, t1, points, offsets, combs, sums);
}
template <size_t C, class Stored>
TRACK_AVX2 std::array<double, C> integrateLineAvx2(const DensityField& field, const Stored* bricks,
                                                   const LocalRay& ray, double t0, double t1,
                                                   uint64_t& lookups, uint64_t& regions) {
    return integrateLine<C>(field, bricks, ray, t0, t1, lookups, regions);
}
#endif

}  // namespace

template <size_t C>
std::array<double, C> DensityField::integrate(const LocalRay& ray, double t0, double t1,
                                              Kernel kernel, uint64_t& lookups,
                                              uint64_t& regions) const {
    const auto run = [&](const auto* bricks) {
#ifdef TRACK_AVX2
        if (kernel == Kernel::kAvx2) {
            return integrateLineAvx2<C>(*this, bricks, ray, t0, t1, lookups, regions);
        }
#endif
        static_cast<void>(kernel);  // where there is but one
        return integrateLine<C>(*this, bricks, ray, t0, t1, lookups, regions);
    };
    return isHalf() ? run(halfs_.data()) : run(floats_.data());
}

template std::array<double, 1> DensityField::integrate<1>(const LocalRay&, double, double, Kernel,
                                                          uint64_t&, uint64_t&) const;
template std::array<double, 3> DensityField::integrate<3>(const LocalRay&, double, double, Kernel,
                                                          uint64_t&, uint64_t&) const;

template <size_t C>
uint64_t DensityField::addSamples(const LocalRay& ray, double t0, double t1, Kernel kernel,
                                  double points, const double* offsets, size_t combs,
                                  std::array<double, C>* sums) const {
    const auto run = [&](const auto* bricks) {
#ifdef TRACK_AVX2
        if (kernel == Kernel::kAvx2) {
            return sampleLineAvx2<C>(*this, bricks, ray, t0, t1, points, offsets, combs, sums);
        }
#endif
        static_cast<void>(kernel);
        return sampleLine<C>(*this, bricks, ray, t0, t1, points, offsets, combs, sums);
    };
    return isHalf() ? run(halfs_.data()) : run(floats_.data());
}

template uint64_t DensityField::addSamples<1>(const LocalRay&, double, double, Kernel, double,
                                              const double*, size_t, std::array<double, 1>*) const;
template uint64_t DensityField::addSamples<3>(const LocalRay&, double, double, Kernel, double,
                                              const double*, size_t, std::array<double, 3>*) const;

}  // namespace trk
