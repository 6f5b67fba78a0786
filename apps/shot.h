// SPDX-License-Identifier: Apache-2.0
// What a preview draws: the picture asked for, its camera and the numbers of its frames.
#pragma once

#include "command_line.h"
#include "track/track.hpp"
#include "view/camera.h"

#include <array>
#include <cstdint>
#include <functional>
#include <optional>
#include <string>
#include <vector>

namespace apps {

/// What to draw, from the command line.
struct Shot {
    std::string sidecar;
    std::string output;
    int width = 0;
    int height = 0;
    int frames = 0;                 ///< 0: one picture, not numbered
    int firstFrame = 1;             ///< its number
    std::optional<uint32_t> level;  ///< nothing: the finest means there are
    float scale = 1;
    std::array<float, 3> color{};
    bool lit = true;
    bool sky = true;    ///< behind the volume; without, pictures have an alpha
    bool half = false;  ///< EXR colours
    vdbtools::UpAxis up = vdbtools::UpAxis::kY;
    double azimuth = 0;  ///< of the sun, in degrees
    double elevation = 0;
    vdbtools::Camera camera;  ///< of the first frame
    trk::Vec3d centre;        ///< that a turntable turns around

    double aspect() const { return static_cast<double>(width) / height; }
    vdbtools::Camera cameraOf(int frame) const;
    /// The file of a frame, counted from 0: its number in place of #### or %04d in the output's
    /// name, or before its ending.
    std::string nameOf(int frame) const;
};

/// The options that say what to draw. Of the scale, only what --scale says.
void addShotOptions(boost::program_options::options_description& options);
Shot parseShot(const Arguments& arguments);

/// Which pixels of a picture of that size meet anything.
using Hits =
    std::function<std::vector<char>(const vdbtools::Camera& camera, int width, int height)>;

/// Frames what lies in `box` in all frames: moves the camera back until the box is seen whole, then
/// narrows the field of view until what small pictures show fills the frame, as boxes are mostly
/// empty at their corners.
void frameVolume(Shot& shot, const vdbtools::WorldBox& box, const Hits& hits);

/// Optical depth of the control, per pixel and channel, at the volume's scale, row by row.
std::vector<double> controlDepth(
    const track::Volume& volume, const vdbtools::Camera& camera, int width, int height,
    uint32_t level, const std::function<void(double)>& progress = [](double) {});

/// The fewest digits that say which float it is; 9, several with commas.
std::string formatNumber(float value);
std::string formatNumber(double value);
std::string formatVector(const trk::Vec3d& v);

}  // namespace apps
