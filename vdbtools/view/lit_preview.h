// SPDX-License-Identifier: Apache-2.0
// Lit pictures of a baked control: single scattering from a sun and a sky, no density needed.
#pragma once

#include "camera.h"
#include "light_table.h"
#include "volume.h"

#include <array>
#include <cstdint>
#include <functional>
#include <optional>
#include <string>
#include <vector>

namespace vdbtools {

/// What a camera sees, top row first, linear.
struct Picture {
    int width = 0;
    int height = 0;
    std::vector<float> light[3];          ///< that the volume scatters to the camera
    std::vector<float> transmittance[3];  ///< of the camera ray; equal where the volume is grey
    /// Distance from the camera at which half the light is left (the mean over channels); where
    /// more is left to the end, that of the volume's far side.
    std::vector<float> halfDepth;
};

/// The radiance of the sky that pictures have behind the volume, by the height in the picture: from
/// 0 (top) to 1. It tells little of its own.
std::array<float, 3> skyBehind(double y);

/// What is drawn, and how it is lit.
struct LitOptions {
    /// 0: the baked control, k: super-voxels 2^k times as large; nothing: the finest means the
    /// sidecar has.
    std::optional<uint32_t> level;
    float scale = 1;
    std::array<float, 3> color{{1, 1, 1}};
    Sun sun;
};

/// A level of a sidecar, lit. Control values are interpolated between the centres of super-voxels
/// (those of a trilinear control between its corners, which is what they mean), so that pictures
/// show no blocks: the interpolated extinction has the control's mass, and its optical depth is in
/// closed form too. Light that was scattered once is what is seen, isotropically and without
/// absorption.
class LitPreview {
  public:
    /// Reads the level's grid and computes the light that arrives inside, in parallel. Throws
    /// Error.
    LitPreview(const std::string& sidecarPath, const LitOptions& options);

    /// Draws in parallel; `progress(fraction)` is called now and then, from any thread.
    Picture draw(const Camera& camera, int width, int height,
                 const std::function<void(double)>& progress) const;

    /// World-space box of what is drawn.
    WorldBox box() const;

    /// Which pixels of a picture meet anything.
    std::vector<char> hits(const Camera& camera, int width, int height) const;

    size_t bytes() const { return volume_.bytes() + light_.bytes(); }

  private:
    void drawPixel(const TrkRay& ray, double farDepth, Picture& picture, size_t pixel) const;
    double farSide(const Camera& camera) const;

    trk::Volume volume_;  // the interpolated control, as if it were a density
    LightTable light_;
};

}  // namespace vdbtools
