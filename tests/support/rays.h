// SPDX-License-Identifier: Apache-2.0
// Rays at a box: random, axis-aligned, from inside, from far away.
#pragma once

#include "track/track.h"

#include <array>
#include <cmath>
#include <limits>
#include <random>
#include <vector>

namespace rays {

constexpr float kInfinity = std::numeric_limits<float>::infinity();

struct Box {
    double lo[3];
    double hi[3];
};

inline Box boundsOf(const TrkVolumeInfo& info) {
    Box box{};
    for (int a = 0; a < 3; ++a) {
        box.lo[a] = info.boundsMin[a];
        box.hi[a] = info.boundsMax[a];
    }
    return box;
}

inline std::array<double, 3> unitVector(std::mt19937_64& random) {
    std::normal_distribution<double> normal;
    std::array<double, 3> v{};
    double length = 0;
    do {
        length = 0;
        for (double& x : v) {
            x = normal(random);
            length += x * x;
        }
    } while (length < 1e-6);
    for (double& x : v) {
        x /= std::sqrt(length);
    }
    return v;
}

/// Rays through random points of the box from `distance` (world units) away.
inline std::vector<TrkRay> through(const Box& box, size_t count, double distance, uint64_t seed) {
    std::mt19937_64 random(seed);
    std::uniform_real_distribution<double> unit(0, 1);
    std::vector<TrkRay> result(count);
    for (TrkRay& ray : result) {
        const auto d = unitVector(random);
        for (size_t a = 0; a < 3; ++a) {
            const double target = box.lo[a] + unit(random) * (box.hi[a] - box.lo[a]);
            ray.origin[a] = static_cast<float>(target - distance * d[a]);
            ray.direction[a] = static_cast<float>(d[a]);
        }
        ray.tMin = 0;
        ray.tMax = kInfinity;
    }
    return result;
}

/// Rays along an axis, half of them backwards, through random points of the box.
inline std::vector<TrkRay> axisAligned(const Box& box, size_t count, uint64_t seed) {
    std::vector<TrkRay> result = through(box, count, 0, seed);
    for (size_t i = 0; i < count; ++i) {
        const size_t axis = i % 3;
        for (size_t a = 0; a < 3; ++a) {
            result[i].direction[a] = a != axis ? (i & 8 ? -0.0f : 0.0f) : i & 1 ? -2.5f : 0.5f;
        }
        result[i].tMin = -kInfinity;
    }
    return result;
}

/// Rays that begin, and mostly end, inside the box.
inline std::vector<TrkRay> interior(const Box& box, size_t count, uint64_t seed) {
    std::vector<TrkRay> result = through(box, count, 0, seed);
    const float size = static_cast<float>(box.hi[0] - box.lo[0]);
    for (size_t i = 0; i < count; ++i) {
        result[i].tMax = size * 0.3f * (static_cast<float>(i % 7) + 0.1f) / 7;
    }
    return result;
}

}  // namespace rays
