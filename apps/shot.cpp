// SPDX-License-Identifier: Apache-2.0
#include "shot.h"

#include <algorithm>
#include <charconv>
#include <cmath>
#include <cstdio>
#include <filesystem>
#include <sstream>
#include <tuple>
#include <utility>

namespace apps {
namespace {

namespace po = boost::program_options;
using trk::Vec3d;
using vdbtools::Camera;

constexpr double kPi = 3.14159265358979323846;
constexpr int kMaxFrames = 9999;

void parseResolution(const std::string& text, int& width, int& height) {
    char rest = 0;
    if (std::sscanf(text.c_str(), "%dx%d%c", &width, &height, &rest) != 2 || width < 1 ||
        height < 1 || width > 65536 || height > 65536) {
        throw UsageError("--resolution " + text + ": expected WIDTHxHEIGHT, each from 1 to 65536");
    }
}

/// The camera of --camera, and what it looks at.
std::pair<Camera, Vec3d> explicitCamera(const std::string& text, vdbtools::UpAxis up) {
    const std::vector<double> n = numberList("camera", text, 7);
    const Vec3d eye{{n[0], n[1], n[2]}};
    const Vec3d target{{n[3], n[4], n[5]}};
    if (!(length(target - eye) > 0) || !(n[6] > 0 && n[6] < 180)) {
        throw UsageError("--camera " + text +
                         ": expected ex,ey,ez,tx,ty,tz,fov with the eye away from the target and a "
                         "vertical field of view between 0 and 180 degrees");
    }
    return {vdbtools::cameraAt(eye, target, n[6], up), target};
}

/// The name of frame `number`: in place of #### or %04d in the file's name, or before its ending.
std::string frameName(const std::string& pattern, int number) {
    const size_t name = pattern.find_last_of('/') + 1;  // 0 where there is no folder
    const size_t hashes = pattern.find('#', name);
    const size_t percent = pattern.find("%0", name);
    const auto isDigitBeforeD = [&](size_t at) {
        return at + 1 < pattern.size() && pattern[at] >= '1' && pattern[at] <= '9' &&
               pattern[at + 1] == 'd';
    };
    size_t begin = std::string::npos;
    size_t end = 0;
    size_t digits = 4;
    if (hashes != std::string::npos) {
        begin = hashes;
        end = std::min(pattern.find_first_not_of('#', hashes), pattern.size());
        digits = end - begin;
    } else if (percent != std::string::npos && isDigitBeforeD(percent + 2)) {
        begin = percent;
        end = percent + 4;
        digits = static_cast<size_t>(pattern[percent + 2] - '0');
    }
    std::string text = std::to_string(number);
    text.insert(0, digits > text.size() ? digits - text.size() : 0, '0');
    if (begin == std::string::npos) {
        std::filesystem::path path(pattern);
        const std::string extension = path.extension().string();
        return path.replace_extension().string() + "." + text + extension;
    }
    return pattern.substr(0, begin) + text + pattern.substr(end);
}

constexpr int kSketchHeight = 96;
int sketchWidth(const Shot& shot) {
    return static_cast<int>(std::min(std::max(kSketchHeight * shot.aspect(), 32.0), 2048.0));
}

}  // namespace

Camera Shot::cameraOf(int frame) const {
    return frame == 0 ? camera : camera.orbited(up, centre, 2 * kPi * frame / frames);
}

std::string Shot::nameOf(int frame) const {
    return frames == 0 ? output : frameName(output, firstFrame + frame);
}

std::string formatNumber(float value) {
    char text[32];
    const auto end = std::to_chars(text, text + sizeof(text), value).ptr;
    return {text, end};
}

std::string formatNumber(double value) {
    std::ostringstream text;
    text.precision(9);
    text << value;
    return text.str();
}

std::string formatVector(const Vec3d& v) {
    return formatNumber(v[0]) + "," + formatNumber(v[1]) + "," + formatNumber(v[2]);
}

std::vector<double> controlDepth(const track::Volume& volume, const Camera& camera, int width,
                                 int height, uint32_t level,
                                 const std::function<void(double)>& progress) {
    TrkQuery query = trkDefaultQuery();
    query.method = TRK_METHOD_CONTROL;
    query.level = level;
    const size_t rowSize = static_cast<size_t>(width) * volume.info().channels;
    std::vector<double> depth(rowSize * static_cast<size_t>(height));
    std::vector<TrkRay> rays(static_cast<size_t>(width));
    const double aspect = static_cast<double>(width) / height;
    for (int row = 0; row < height; ++row) {
        for (int column = 0; column < width; ++column) {
            rays[static_cast<size_t>(column)] =
                camera.ray((column + 0.5) / width, (row + 0.5) / height, aspect);
        }
        volume.integrateOpticalDepth(query, rays.data(), rays.size(),
                                     &depth[static_cast<size_t>(row) * rowSize]);
        progress((row + 1.0) / height);
    }
    return depth;
}

void frameVolume(Shot& shot, const vdbtools::WorldBox& box, const Hits& hits) {
    shot.centre = box.centre();
    const int frames = std::max(shot.frames, 1);
    double distance = 0;
    for (int frame = 0; frame < frames; ++frame) {
        Camera camera = shot.cameraOf(frame);
        vdbtools::frameBox(camera, box, shot.aspect());
        distance = std::max(distance, length(camera.eye - shot.centre));
    }
    shot.camera.eye = shot.centre - distance * shot.camera.forward;
    const int width = sketchWidth(shot);
    double reach = 0;
    for (int frame = 0; frame < frames; ++frame) {
        const std::vector<char> hit = hits(shot.cameraOf(frame), width, kSketchHeight);
        for (size_t i = 0; i < hit.size(); ++i) {
            if (hit[i]) {
                const auto row = static_cast<double>(i / static_cast<size_t>(width));
                const auto column = static_cast<double>(i % static_cast<size_t>(width));
                reach = std::max(
                    {reach, std::fabs(2 * (column + 0.5) / width - 1) + 1.0 / width,
                     std::fabs(2 * (row + 0.5) / kSketchHeight - 1) + 1.0 / kSketchHeight});
            }
        }
    }
    if (reach > 0) {
        shot.camera.tangent *= std::min(1.0, 1.04 * reach);
    }
}

void addShotOptions(po::options_description& options) {
    options.add_options()(
        "transmittance", po::bool_switch(),
        "draw the control's transmittance as it is, blocks and all, instead of a lit picture")(
        "resolution", po::value<std::string>()->default_value("512x512"), "in pixels")(
        "level", po::value<int>(),
        "0: the baked super-voxels; k: super-voxels 2^k times as large, faster; default: the "
        "finest "
        "means the sidecar has, or with --transmittance 0")(
        "scale", po::value<float>(),
        "extinction = scale x density; default: track_preview_scale of the sidecar")(
        "view", po::value<std::string>()->default_value("iso"),
        "front, side, top or iso, framed on the volume")(
        "up", po::value<std::string>()->default_value("y"), "the axis that points up: y or z")(
        "camera", po::value<std::string>(),
        "ex,ey,ez,tx,ty,tz,fov: eye, target, vertical field of view in degrees")(
        "light", po::value<std::string>()->default_value("-29,41"),
        "azimuth,elevation of the sun in degrees: from the front towards +x, above the horizon")(
        "no-sky", po::bool_switch(),
        "nothing behind the volume: PNG with alpha, EXR without the layer sky")(
        "half", po::bool_switch(), "EXR colours and transmittance as 16-bit floats")(
        "frames", po::value<int>(),
        "turntable: that many pictures once around the volume, numbered in place of #### or %04d "
        "in "
        "OUT, or before its ending")("first", po::value<int>()->default_value(1),
                                     "number of the first frame");
}

Shot parseShot(const Arguments& arguments) {
    Shot shot;
    shot.sidecar = arguments.text("SIDECAR");
    parseResolution(arguments.text("resolution"), shot.width, shot.height);
    choiceIndex("view", arguments.text("view"), vdbtools::viewNames());
    shot.up = choiceIndex("up", arguments.text("up"), {"y", "z"}) == 0 ? vdbtools::UpAxis::kY
                                                                       : vdbtools::UpAxis::kZ;
    if (arguments.given("view") && arguments.has("camera")) {
        throw UsageError("--view and --camera: expected one of them");
    }
    if (arguments.has("camera")) {
        std::tie(shot.camera, shot.centre) = explicitCamera(arguments.text("camera"), shot.up);
    } else {
        shot.camera = vdbtools::namedView(arguments.text("view"), shot.up);
    }
    const std::vector<double> light = numberList("light", arguments.text("light"), 2);
    shot.azimuth = light[0];
    shot.elevation = light[1];
    if (std::fabs(shot.elevation) > 90) {
        throw UsageError("--light " + arguments.text("light") +
                         ": expected an elevation from -90 to 90 degrees");
    }
    if (arguments.has("level")) {
        shot.level = static_cast<uint32_t>(arguments.integer("level", 0, 64));
    }
    shot.frames = arguments.has("frames") ? arguments.integer("frames", 1, kMaxFrames) : 0;
    shot.firstFrame = arguments.integer("first", 0, 1000000000);
    if (arguments.given("first") && shot.frames == 0) {
        throw UsageError("--first: of no use without --frames");
    }
    shot.lit = !arguments.flag("transmittance");
    shot.sky = !arguments.flag("no-sky");
    shot.half = arguments.flag("half");
    for (const char* option : {"light", "no-sky"}) {
        if (!shot.lit &&
            (std::string(option) == "light" ? arguments.given(option) : arguments.flag(option))) {
            throw UsageError("--" + std::string(option) + ": of no use with --transmittance");
        }
    }
    shot.scale = arguments.has("scale") ? nonNegative(arguments, "scale") : 1.0f;
    shot.color = colorOf(arguments);
    shot.output = arguments.has("output")
                      ? arguments.text("output")
                      : std::filesystem::path(shot.sidecar).replace_extension(".png").string();
    const std::string extension = std::filesystem::path(shot.output).extension().string();
    if (extension != ".png" && extension != ".exr") {
        throw UsageError("-o " + shot.output + ": expected a name that ends in .png or .exr");
    }
    if (shot.half && extension != ".exr") {
        throw UsageError("--half: of no use for a PNG");
    }
    return shot;
}

}  // namespace apps
