// SPDX-License-Identifier: Apache-2.0
#include "sweep_rays.h"

#include "field/density_field.h"
#include "query/transmittance.h"
#include "view/camera.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <random>

namespace vdbtools {
namespace {

using trk::Volume;

/// Rays through the cells of an n x n grid of pixels, one somewhere in each, row by row.
std::vector<TrkRay> pixelRays(const Camera& camera, size_t n, uint64_t seed) {
    std::mt19937_64 random(seed);
    std::uniform_real_distribution<double> unit(0, 1);
    std::vector<TrkRay> rays;
    rays.reserve(n * n);
    for (size_t i = 0; i < n * n; ++i) {
        const double x = static_cast<double>(i % n) + unit(random);
        const double y = static_cast<double>(i / n) + unit(random);
        rays.push_back(camera.ray(x / static_cast<double>(n), y / static_cast<double>(n), 1));
    }
    return rays;
}

std::vector<TrkRay> thoseThatHit(const Volume& volume, const std::vector<TrkRay>& rays) {
    const std::vector<double> depths = exactOpticalDepths(volume, rays);
    const size_t channels = volume.channels();
    std::vector<TrkRay> hits;
    for (size_t i = 0; i < rays.size(); ++i) {
        const auto* depth = &depths[i * channels];
        if (std::any_of(depth, depth + channels, [](double d) { return d > 0; })) {
            hits.push_back(rays[i]);
        }
    }
    return hits;
}

}  // namespace

std::vector<double> exactOpticalDepths(const Volume& volume, const std::vector<TrkRay>& rays) {
    std::vector<double> depths(rays.size() * volume.channels());
    TrkQuery query = trkDefaultQuery();
    query.method = TRK_METHOD_EXACT;
    query.rayStride = sizeof(TrkRay);
    trk::integrateOpticalDepth(volume, query, rays.data(), rays.size(),
                               {depths.data(), volume.channels(), 0});
    return depths;
}

std::vector<TrkRay> cameraRays(const Volume& volume, size_t count, uint64_t seed) {
    Camera camera = namedView("iso");
    WorldBox box;
    trk::worldBounds(volume.indexToWorld, volume.anchor, volume.field->box(), box.lo.x, box.hi.x);
    frameBox(camera, box, 1);
    // How many pixels it takes depends on how much of the picture is hit. Where that is next to
    // nothing, fewer rays must do.
    auto n = static_cast<size_t>(std::ceil(std::sqrt(2 * static_cast<double>(count))));
    const size_t most = std::max(n, size_t{2048});
    std::vector<TrkRay> rays = thoseThatHit(volume, pixelRays(camera, n, seed));
    while (n < most && rays.size() < count / 4) {
        n = std::min(2 * n, most);
        rays = thoseThatHit(volume, pixelRays(camera, n, seed));
    }
    if (rays.empty()) {
        return rays;
    }
    const double share = static_cast<double>(rays.size()) / static_cast<double>(n * n);
    n = std::min(most,
                 static_cast<size_t>(std::ceil(std::sqrt(static_cast<double>(count) / share))));
    return thoseThatHit(volume, pixelRays(camera, n, seed));
}

std::vector<TrkRay> secondaryRays(const Volume& volume, const std::vector<TrkRay>& rays,
                                  uint64_t seed) {
    std::mt19937_64 random(seed);
    std::uniform_real_distribution<double> unit(0, 1);
    std::normal_distribution<double> normal;
    const std::vector<double> depths = exactOpticalDepths(volume, rays);
    const size_t channels = volume.channels();
    std::vector<TrkRay> result;
    for (size_t i = 0; i < rays.size(); ++i) {
        const auto clipped = volume.clip(rays[i], volume.field->box());
        if (!clipped) {
            continue;
        }
        // A collision of the densest channel, given that there is one: the optical depth it lies
        // at, then where that is.
        const double* own = depths.data() + i * channels;
        const double* densest = std::max_element(own, own + channels);
        const double target = -std::log1p(unit(random) * std::expm1(-*densest));
        TrkRay ray = rays[i];
        double lo = clipped->tStart;
        double hi = clipped->tStart + clipped->tPerVoxel * clipped->local.tEnd;
        TrkQuery query = trkDefaultQuery();
        query.method = TRK_METHOD_EXACT;
        query.threads = 1;
        query.rayStride = sizeof(TrkRay);
        for (int k = 0; k < 40; ++k) {
            const double middle = 0.5 * (lo + hi);
            ray.tMax = static_cast<float>(middle);
            double found[3];
            trk::integrateOpticalDepth(volume, query, &ray, 1, {found, channels, 0});
            (found[densest - own] < target ? lo : hi) = middle;
        }
        TrkRay secondary{};
        trk::Vec3d direction;
        do {
            direction = {{normal(random), normal(random), normal(random)}};
        } while (length(direction) < 1e-3);
        for (int a = 0; a < 3; ++a) {
            secondary.origin[a] = ray.origin[a] + static_cast<float>(lo) * ray.direction[a];
            secondary.direction[a] = static_cast<float>(direction[a] / length(direction));
        }
        secondary.tMax = std::numeric_limits<float>::infinity();
        result.push_back(secondary);
    }
    result = thoseThatHit(volume, result);
    std::shuffle(result.begin(), result.end(), random);
    return result;
}

}  // namespace vdbtools
