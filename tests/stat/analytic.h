// SPDX-License-Identifier: Apache-2.0
// Media whose every integral is known, for the estimators: no VDB, no bake.
#pragma once

#include "control/super_voxels.h"
#include "estimate/rng.h"
#include "estimate/tracking.h"

#include <array>
#include <cstdint>

namespace analytic {

using trk::LocalRay;
using trk::SuperVoxel;
using trk::Vec3d;

/// Extinction from `first` at x = 0, linearly to `last` at x = length.
struct Ramp {
    static constexpr size_t kChannels = 1;
    double first;
    double last;
    double length;

    std::array<double, 1> extinction(const Vec3d& point) const {
        return {{first + (last - first) * point[0] / length}};
    }
    std::array<double, 1> integrate(const LocalRay&, double t0, double t1, uint64_t&,
                                    uint64_t&) const {
        return {{(t1 - t0) * extinction({{0.5 * (t0 + t1), 0, 0}})[0]}};
    }
    template <class Visit>
    void forEachCell(const LocalRay& ray, double t0, double t1, Visit&& visit) const {
        uint64_t ignored = 0;
        visit(t0, t1, integrate(ray, t0, t1, ignored, ignored));
    }
    template <class Visit>
    void forEachRegion(const LocalRay&, double t0, double t1, Visit&& visit) const {
        visit(static_cast<const std::array<double, 1>*>(nullptr), t0, t1);
    }
    double depth() const { return 0.5 * length * (first + last); }
    /// Integral of (extinction - control)^2.
    double squares(double control) const {
        const double a = first - control;
        const double b = last - control;
        return length * (a * a + a * b + b * b) / 3;
    }
    LocalRay ray() const { return {{{0, 0, 0}}, {{1, 0, 0}}, {{1, 1e300, 1e300}}, length}; }
};

/// One super-voxel over everything.
struct Everywhere {
    SuperVoxel item;
    trk::ExtinctionRange range;

    template <class Visit>
    void walk(const LocalRay& ray, double, double, Visit&& visit) const {
        const trk::Int3 anywhere{{0, 0, 0}};
        visit(trk::SuperVoxelView<1, trk::ControlKind::kConstant>(&item, &range, nullptr, anywhere,
                                                                  1),
              0.0, ray.tEnd);
    }
};

struct Measured {
    double mean = 0;
    double variance = 0;
    double lookups = 0;  ///< a sample
};

/// Of `samples` estimates, each what `estimate(rng, cost)` answers.
template <class Estimate>
Measured measure(uint64_t samples, const Estimate& estimate) {
    double sum = 0;
    double squares = 0;
    trk::PathCost cost;
    for (uint64_t i = 0; i < samples; ++i) {
        trk::Rng rng(5, 6, 7, i);
        const double value = estimate(rng, cost);
        sum += value;
        squares += value * value;
    }
    const auto n = static_cast<double>(samples);
    return {sum / n, squares / n - sum / n * (sum / n), static_cast<double>(cost.lookups) / n};
}

}  // namespace analytic
