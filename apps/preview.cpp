// SPDX-License-Identifier: Apache-2.0
// vdbtrack preview: pictures from a sidecar alone.
#include "command_line.h"

#include "camera.h"
#include "failure.h"
#include "image.h"
#include "io/output_file.h"
#include "lit_preview.h"
#include "track/track.hpp"

#include <unistd.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdio>
#include <filesystem>
#include <functional>
#include <iostream>
#include <memory>
#include <optional>
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

/// What to draw, from the command line.
struct Shot {
    std::string sidecar;
    std::string output;
    int width = 0;
    int height = 0;
    int frames = 0;  // 0: one picture, not numbered
    uint32_t level = 0;
    double scale = 0;
    std::array<float, 3> color{};
    bool lit = true;
    Camera camera;  // of the first frame
    Vec3d centre;   // that a turntable turns around

    double aspect() const { return static_cast<double>(width) / height; }
    Camera cameraOf(int frame) const {
        return frame == 0 ? camera : camera.orbited(centre, 2 * kPi * frame / frames);
    }
};

void parseResolution(const std::string& text, int& width, int& height) {
    char rest = 0;
    if (std::sscanf(text.c_str(), "%dx%d%c", &width, &height, &rest) != 2 || width < 1 ||
        height < 1 || width > 65536 || height > 65536) {
        throw UsageError("--resolution " + text + ": expected WIDTHxHEIGHT, each from 1 to 65536");
    }
}

/// The camera of --camera, and what it looks at.
std::pair<Camera, Vec3d> explicitCamera(const std::string& text) {
    const std::vector<double> n = numberList("camera", text, 7);
    const Vec3d eye{{n[0], n[1], n[2]}};
    const Vec3d target{{n[3], n[4], n[5]}};
    if (!(length(target - eye) > 0) || !(n[6] > 0 && n[6] < 180)) {
        throw UsageError("--camera " + text +
                         ": expected ex,ey,ez,tx,ty,tz,fov with the eye away from the target and a "
                         "vertical field of view between 0 and 180 degrees");
    }
    return {vdbtools::cameraAt(eye, target, n[6]), target};
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

/// Optical depth of the control, per pixel and channel, at the volume's scale, row by row.
std::vector<double> controlDepth(
    const track::Volume& volume, const Camera& camera, int width, int height, uint32_t level,
    const std::function<void(double)>& progress = [](double) {}) {
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

constexpr int kSketchHeight = 96;
int sketchWidth(const Shot& shot) {
    return static_cast<int>(std::min(std::max(kSketchHeight * shot.aspect(), 32.0), 2048.0));
}

/// Frames the volume in all frames: moves the camera back until its box is seen whole, then narrows
/// the field of view until what small pictures show of it fills the frame, as boxes are mostly
/// empty at their corners.
void frameVolume(Shot& shot, const track::Volume& volume) {
    const TrkVolumeInfo info = volume.info();
    vdbtools::WorldBox box;
    for (int a = 0; a < 3; ++a) {
        box.lo[a] = info.boundsMin[a];
        box.hi[a] = info.boundsMax[a];
    }
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
        const std::vector<double> depth =
            controlDepth(volume, shot.cameraOf(frame), width, kSketchHeight, shot.level);
        for (size_t i = 0; i < depth.size(); ++i) {
            if (depth[i] > 0) {
                const size_t pixel = i / info.channels;
                const size_t whole = pixel / static_cast<size_t>(width);
                const auto row = static_cast<double>(whole);
                const auto column = static_cast<double>(pixel - whole * static_cast<size_t>(width));
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

/// The scale at which the median transmittance of what a small picture meets is `median`, or
/// nothing where that is empty.
std::optional<double> defaultScale(const Shot& shot, const track::Volume& volume, double median) {
    std::vector<double> hits;
    for (const double depth :
         controlDepth(volume, shot.camera, sketchWidth(shot), kSketchHeight, shot.level)) {
        if (depth > 0) {
            hits.push_back(depth);
        }
    }
    if (hits.empty()) {
        return std::nullopt;
    }
    const auto middle = hits.begin() + static_cast<std::ptrdiff_t>(hits.size() / 2);
    std::nth_element(hits.begin(), middle, hits.end());
    return std::min(-std::log(median) / *middle, 1e38);  // it becomes a float
}

/// Refuses pictures that this machine cannot hold, before the system kills whom it likes.
void checkMemory(const Shot& shot) {
    constexpr double kBytesPerPixel = 56;  // layers, and what writing them takes
    const double wanted = kBytesPerPixel * shot.width * shot.height;
    const double machine =
        static_cast<double>(sysconf(_SC_PHYS_PAGES)) * static_cast<double>(sysconf(_SC_PAGESIZE));
    if (wanted > machine) {
        throw trk::Error(TRK_ERROR_OUT_OF_MEMORY,
                         shot.output + ": " + std::to_string(shot.width) + "x" +
                             std::to_string(shot.height) + " pixels need " +
                             byteCount(static_cast<uint64_t>(wanted)) + ", and this machine has " +
                             byteCount(static_cast<uint64_t>(machine)));
    }
}

const std::array<std::string, 3> kRgb{"R", "G", "B"};

Image litImage(vdbtools::Picture picture) {
    Image image(picture.width, picture.height);
    std::vector<float>& alpha = image.add("A");
    for (size_t i = 0; i < alpha.size(); ++i) {
        alpha[i] = 1 - (picture.transmittance[0][i] + picture.transmittance[1][i] +
                        picture.transmittance[2][i]) /
                           3;
    }
    for (size_t c = 0; c < 3; ++c) {
        image.channels[kRgb[c]] = std::move(picture.beauty[c]);
        image.channels["transmittance." + kRgb[c]] = std::move(picture.transmittance[c]);
    }
    image.channels["halfDepth.Z"] = std::move(picture.halfDepth);
    return image;
}

/// The control's transmittance as it is: white where all light passes.
Image transmittanceImage(const Shot& shot, const track::Volume& volume, const Camera& camera,
                         const std::function<void(double)>& progress) {
    Image image(shot.width, shot.height);
    const std::vector<double> depth =
        controlDepth(volume, camera, shot.width, shot.height, shot.level, progress);
    const size_t channels = volume.info().channels;
    std::vector<float>& alpha = image.add("A");
    for (size_t c = 0; c < 3; ++c) {
        std::vector<float>& values = image.add(kRgb[c]);
        for (size_t i = 0; i < values.size(); ++i) {
            const double t = std::exp(-shot.scale * depth[i * channels + c % channels]);
            values[i] = static_cast<float>(t);
            alpha[i] += static_cast<float>((1 - t) / 3);
        }
    }
    return image;
}

void writeImage(const Shot& shot, const Image& image, const Camera& camera,
                const std::string& gridName, const trk::OutputFile& file) {
    if (std::filesystem::path(shot.output).extension() == ".png") {
        writePng(image, shot.lit ? Tone::kRolledOff : Tone::kLinear, file);
        return;
    }
    writeExr(image,
             {{"track:source", std::filesystem::path(shot.sidecar).filename().string()},
              {"track:grid", gridName},
              {"track:scale", formatNumber(shot.scale)},
              {"track:level", std::to_string(shot.level)},
              {"track:eye", formatVector(camera.eye)},
              {"track:forward", formatVector(camera.forward)},
              {"track:verticalFov", formatNumber(360 / kPi * std::atan(camera.tangent))},
              {"track:version", TRACK_VERSION}},
             file);
}

Shot parseShot(const Arguments& arguments) {
    Shot shot;
    shot.sidecar = arguments.text("SIDECAR");
    parseResolution(arguments.text("resolution"), shot.width, shot.height);
    choiceIndex("view", arguments.text("view"), vdbtools::viewNames());
    if (arguments.given("view") && arguments.has("camera")) {
        throw UsageError("--view and --camera: expected one of them");
    }
    if (arguments.has("camera")) {
        std::tie(shot.camera, shot.centre) = explicitCamera(arguments.text("camera"));
    } else {
        shot.camera = vdbtools::namedView(arguments.text("view"));
    }
    shot.level = static_cast<uint32_t>(arguments.integer("level", 0, 64));
    shot.frames = arguments.has("frames") ? arguments.integer("frames", 1, kMaxFrames) : 0;
    shot.lit = !arguments.flag("transmittance");
    shot.scale = arguments.has("scale") ? static_cast<double>(nonNegative(arguments, "scale")) : 0;
    shot.color = colorOf(arguments);
    shot.output = arguments.has("output")
                      ? arguments.text("output")
                      : std::filesystem::path(shot.sidecar).replace_extension(".png").string();
    const std::string extension = std::filesystem::path(shot.output).extension().string();
    if (extension != ".png" && extension != ".exr") {
        throw UsageError("-o " + shot.output + ": expected a name that ends in .png or .exr");
    }
    return shot;
}

void run(const Command& command, const std::vector<std::string>& given) {
    po::options_description options("Options");
    options.add_options()("output,o", po::value<std::string>(),
                          "OUT.png (tone-mapped) or OUT.exr (float: R,G,B,A and the layers "
                          "transmittance and halfDepth, the distance at which half the light is "
                          "left); default: SIDECAR.png beside the sidecar")(
        "transmittance", po::bool_switch(),
        "draw the control's transmittance as it is, blocks and all, instead of a lit picture")(
        "resolution", po::value<std::string>()->default_value("512x512"), "in pixels")(
        "level", po::value<int>()->default_value(0),
        "0: the baked super-voxels; k: super-voxels 2^k times as large, faster")(
        "scale", po::value<float>(),
        "extinction = scale x density; default: the median transmittance becomes 0.05, or 0.3 "
        "with --transmittance")("view", po::value<std::string>()->default_value("iso"),
                                "front, side, top or iso, framed on the volume; y is up")(
        "camera", po::value<std::string>(),
        "ex,ey,ez,tx,ty,tz,fov: eye, target, vertical field of view in degrees")(
        "frames", po::value<int>(),
        "turntable: that many pictures once around the volume, numbered in place of #### or %04d "
        "in "
        "OUT, or before its ending")("force", po::bool_switch(), "replace existing files");
    addColorOption(options);
    const Arguments arguments(command, given, options, {"SIDECAR"}, 1);
    Shot shot = parseShot(arguments);
    checkMemory(shot);
    checkLevel(shot.sidecar, shot.level, trk::readSidecarHeader(shot.sidecar));

    TrkVolumeOptions volumeOptions = trkDefaultVolumeOptions();
    std::copy(shot.color.begin(), shot.color.end(), volumeOptions.color);
    const track::Volume volume = track::Volume::open("", shot.sidecar.c_str(), volumeOptions);
    const TrkVolumeInfo info = volume.info();
    if (!arguments.has("camera")) {
        frameVolume(shot, volume);
    }
    const double median = shot.lit ? 0.05 : 0.3;
    std::string remark;
    if (!arguments.has("scale")) {
        const std::optional<double> scale = defaultScale(shot, volume, median);
        shot.scale = scale.value_or(1);
        remark = scale ? " (median transmittance " + formatNumber(median) + ")"
                 : info.superVoxelCount == 0 ? " (the volume is empty)"
                                             : " (nothing found to choose it by)";
    }
    const int frames = std::max(shot.frames, 1);
    const auto nameOf = [&](int frame) {
        return shot.frames == 0 ? shot.output : frameName(shot.output, frame + 1);
    };
    for (int frame = 0; frame < frames; ++frame) {  // before any is written
        refuseInput(nameOf(frame), {shot.sidecar});
        trk::OutputFile(nameOf(frame), arguments.flag("force"));
    }
    std::unique_ptr<vdbtools::LitPreview> lit;
    if (shot.lit) {
        const Progress progress(arguments, "lighting " + shot.sidecar);
        lit = std::make_unique<vdbtools::LitPreview>(shot.sidecar, shot.level,
                                                     static_cast<float>(shot.scale), shot.color);
    }
    for (int frame = 0; frame < frames; ++frame) {
        const Camera camera = shot.cameraOf(frame);
        trk::OutputFile file(nameOf(frame), arguments.flag("force"));
        Progress progress(arguments, "drawing " + nameOf(frame));
        const auto update = [&](double fraction) { progress.update(fraction); };
        const Image image = shot.lit ? litImage(lit->draw(camera, shot.width, shot.height, update))
                                     : transmittanceImage(shot, volume, camera, update);
        writeImage(shot, image, camera, info.gridName, file);
        file.commit();
    }
    if (!arguments.quiet()) {
        std::cerr << nameOf(0) << (frames > 1 ? " to " + nameOf(frames - 1) : "") << ": "
                  << shot.width << "x" << shot.height << ", scale " << formatNumber(shot.scale)
                  << remark << ", level " << shot.level << "\n";
    }
}

}  // namespace

const Command kPreviewCommand{
    "preview",
    "vdbtrack preview SIDECAR [-o OUT.png|OUT.exr] [--transmittance] [--resolution 512x512] "
    "[--level 0] [--scale S] [--color 1,1,1] [--view front|side|top|iso | --camera "
    "ex,ey,ez,tx,ty,tz,fov] [--frames N] [--force]",
    "Draws the baked control, lit by a sun and a sky, without the density.", run};

}  // namespace apps
