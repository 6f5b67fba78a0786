// SPDX-License-Identifier: Apache-2.0
// Ray marching: equidistant look-ups with one random offset. Biased.
#pragma once

#include "tracking.h"

#include <array>
#include <cmath>
#include <cstddef>

namespace trk {

/// An unbiased estimate of the optical depth of the whole ray, per channel: the mean of look-ups
/// `step` voxel lengths apart, all shifted by one random part of a step. exp(-it) is then biased
/// upwards [Jensen], by about half its variance. Regions of constant density are integrated as
/// such.
template <class Field, class Random>
std::array<double, Field::kChannels> marchOpticalDepth(const Field& field, const LocalRay& ray,
                                                       double lengthPerVoxel, double step,
                                                       Random& random, PathCost& cost) {
    constexpr size_t C = Field::kChannels;
    std::array<double, C> sum{};
    const double offset = random.uniform();
    cost.random = true;
    double next = 0;  // index of the next look-up
    field.forEachRegion(ray, 0, ray.tEnd, [&](const auto* constant, double tEnter, double tExit) {
        ++cost.superVoxels;
        next = std::fmax(next, std::ceil(tEnter / step - offset));
        if (constant) {
            for (size_t c = 0; c < C; ++c) {
                sum[c] += (*constant)[c] * (tExit - tEnter);
            }
            cost.exactLength += tExit - tEnter;
            return true;
        }
        for (double t = (next + offset) * step; t < tExit; t = (++next + offset) * step) {
            const auto extinction = field.extinction(ray.at(t));
            for (size_t c = 0; c < C; ++c) {
                sum[c] += extinction[c] * step;
            }
            ++cost.lookups;
        }
        return true;
    });
    for (double& depth : sum) {
        depth *= lengthPerVoxel;
    }
    return sum;
}

}  // namespace trk
