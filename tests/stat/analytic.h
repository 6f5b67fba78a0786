// SPDX-License-Identifier: Apache-2.0
// Media whose every integral is known, for the estimators: no VDB, no bake.
#pragma once

#include "control/control_choice.h"
#include "control/super_voxels.h"
#include "estimate/free_path.h"
#include "estimate/rng.h"
#include "estimate/tracking.h"

#include <array>
#include <cmath>
#include <cstdint>
#include <utility>

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
    uint64_t addSamples(const LocalRay& ray, double t0, double t1, double points,
                        const double* offsets, size_t combs, std::array<double, 1>* sums) const {
        for (size_t j = 0; j < combs; ++j) {
            for (double k = 0; k < points; ++k) {
                sums[j][0] += extinction(ray.at(t0 + (k + offsets[j]) * (t1 - t0) / points))[0];
            }
        }
        return static_cast<uint64_t>(points) * combs;
    }
    void prefetchEntry(const Vec3d&) const {}
    void prefetchBrick(const Vec3d&) const {}
    double depth() const { return 0.5 * length * (first + last); }
    /// Integral of (extinction - control)^2.
    double squares(double control) const {
        const double a = first - control;
        const double b = last - control;
        return length * (a * a + a * b + b * b) / 3;
    }
    LocalRay ray() const { return {{{0, 0, 0}}, {{1, 0, 0}}, {{1, 1e300, 1e300}}, length}; }
};

/// One super-voxel over everything, whose control is its mean.
struct Everywhere {
    static constexpr size_t kChannels = 1;
    static constexpr trk::ControlKind kKind = trk::ControlKind::kConstant;

    SuperVoxel item;

    double scale(size_t) const { return 1; }
    const trk::ControlChoice& choice() const { return mean; }

    /// As trk::SuperVoxelCursor.
    class Cursor {
      public:
        static constexpr size_t kMost = 4;

        Cursor(const Everywhere& everywhere, double t1) : everywhere_(everywhere), t1_(t1) {}
        size_t refill() { return std::exchange(done_, true) ? 0 : 1; }
        double tEnter(size_t) const { return 0; }
        double tExit(size_t) const { return t1_; }
        const SuperVoxel& record(size_t, size_t) const { return everywhere_.item; }

      private:
        const Everywhere& everywhere_;
        double t1_;
        bool done_ = false;
    };
    Cursor cursor(const LocalRay&, double, double t1) const { return {*this, t1}; }

    trk::ControlChoice mean{TRK_CHOICE_MEAN, 1};
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

/// One estimate by delta tracking, with random numbers that go on.
template <class Field, class SuperVoxels>
std::array<double, Field::kChannels> trackBinary(const Field& field, const SuperVoxels& superVoxels,
                                                 const LocalRay& ray,
                                                 const trk::TrackingSettings& settings,
                                                 trk::Rng& rng, trk::PathCost& cost) {
    struct Random {
        trk::Rng& rng;
        double uniform() { return rng.uniform(); }
        double exponential() { return rng.exponential(); }
    };
    std::array<double, Field::kChannels> result{};
    trk::trackBinary(
        field, superVoxels, ray, settings, 1, [&](uint32_t) { return Random{rng}; }, cost,
        [&](const auto& passes) { result = passes; });
    return result;
}

}  // namespace analytic
