// SPDX-License-Identifier: Apache-2.0
// Images of what a preview computed: EXR for data, PNG for eyes.
#pragma once

#include "io/output_file.h"

#include <array>
#include <cstddef>
#include <map>
#include <string>
#include <vector>

namespace apps {

/// Named float channels of one size, top row first, linear.
struct Image {
    int width = 0;
    int height = 0;
    std::map<std::string, std::vector<float>> channels;

    Image(int w, int h) : width(w), height(h) {}
    size_t pixelCount() const { return static_cast<size_t>(width) * static_cast<size_t>(height); }
    std::vector<float>& add(const std::string& name) {
        return channels[name] = std::vector<float>(pixelCount());
    }
};

/// Where a picture's camera stands: from world space to the camera's (x right, y up, looking along
/// -z), and to the picture's, for row vectors [in][out].
struct CameraMatrices {
    float worldToCamera[4][4];
    float worldToNdc[4][4];
    float screenWindowWidth;  ///< of the picture, one unit ahead
};

/// Writes every channel as 32-bit float, or, with `half`, all but depths (…Z) as 16-bit, with text
/// attributes and the standard ones of the camera. Does not commit. Throws trk::Error.
void writeExr(const Image& image, bool half, const std::map<std::string, std::string>& attributes,
              const CameraMatrices& matrices, const trk::OutputFile& file);

/// How a PNG shows linear values: as they are, or with the highlights rolled off.
enum class Tone { kLinear, kRolledOff };

/// Writes channels R, G, B, and with `alpha` A, sRGB encoded, 8 bit, dithered so that smooth
/// gradients show no bands. Does not commit. Throws trk::Error.
void writePng(const Image& image, Tone tone, const trk::OutputFile& file, bool alpha = false);

/// The same as a "data:" URI, for pages that hold their pictures.
std::string pngUri(const Image& image, Tone tone);

/// A colour, linear, for a number from 0 (black, over violet and orange) to 1 (pale yellow); what
/// is not finite is green. Lightness rises all the way.
std::array<float, 3> falseColor(float value);

}  // namespace apps
