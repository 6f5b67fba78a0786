// SPDX-License-Identifier: Apache-2.0
// What renderers do today, for core_table to compare with. Frozen: a change here makes earlier
// figures worthless. Densities of OpenVDB's standard float tree with voxels of one size, no
// rotation and extinction = scale x density.
#pragma once

#include "track/track.h"

#include <openvdb/openvdb.h>

#include <cstddef>
#include <cstdint>
#include <memory>

namespace baselines {

/// Ratio tracking as pbrt-v4's NanoVDB medium does it: a grid of 64^3 majorants over the bounds of
/// the density, whose bounds cover what interpolation reaches, crossed by a DDA in float; NanoVDB's
/// trilinear sampler (through an accessor a ray, which pbrt does without); below a weight of 0.05
/// an end with probability 0.75.
class RatioTracking {
  public:
    explicit RatioTracking(const openvdb::FloatGrid& grid);
    ~RatioTracking();

    /// One estimate a ray. `lookups`, `crossings`: added to.
    void transmittance(const TrkRay* rays, size_t count, float scale, uint64_t seed, float* result,
                       uint64_t& lookups, uint64_t& crossings) const;

  private:
    struct Medium;
    std::unique_ptr<const Medium> medium_;
};

/// Exact integration: OpenVDB's VolumeHDDA finds the leaves on the way, a DDA their cells, a
/// BoxStencil the corners, and two Gauss points integrate each cell's cubic.
class Integration {
  public:
    explicit Integration(const openvdb::FloatGrid& grid);
    ~Integration();

    /// `cells`: added to.
    void transmittance(const TrkRay* rays, size_t count, float scale, float* result,
                       uint64_t& cells) const;

  private:
    struct Topology;
    std::unique_ptr<const Topology> topology_;
};

}  // namespace baselines
