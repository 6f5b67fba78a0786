// SPDX-License-Identifier: Apache-2.0
// vdbtrack preview: a picture from a sidecar alone.
#include "command_line.h"

#include "error.h"
#include "image.h"
#include "io/output_file.h"
#include "math.h"
#include "track/track.hpp"

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <filesystem>
#include <iostream>
#include <limits>
#include <sstream>

namespace apps {
namespace {

namespace po = boost::program_options;
using trk::Vec3d;

const std::vector<std::string> kViews{"front", "side", "top", "iso"};

struct Camera {
    Vec3d eye;
    Vec3d right;  // of unit length, like the other two
    Vec3d up;
    Vec3d forward;
    double tangent = 0.3;  // of half the vertical field of view
};

Vec3d normalized(const Vec3d& v) {
    return (1 / length(v)) * v;
}

Camera look(const Vec3d& forward, const Vec3d& roughlyUp) {
    Camera camera;
    camera.forward = normalized(forward);
    camera.right = normalized(cross(camera.forward, roughlyUp));
    camera.up = cross(camera.right, camera.forward);
    return camera;
}

/// y is up: front looks along -z, side along -x, top along -y.
Camera standardView(const std::string& view) {
    const Vec3d y{{0, 1, 0}};
    if (view == "front") {
        return look({{0, 0, -1}}, y);
    }
    if (view == "side") {
        return look({{-1, 0, 0}}, y);
    }
    if (view == "top") {
        return look({{0, -1, 0}}, {{0, 0, -1}});
    }
    return look({{-1, -0.62, -1}}, y);
}

/// Moves the camera back until the whole box is in the picture, with a margin.
void frame(Camera& camera, const TrkVolumeInfo& info, double aspect) {
    Vec3d centre;
    Vec3d half;
    for (int a = 0; a < 3; ++a) {
        centre[a] = 0.5 * (info.boundsMin[a] + info.boundsMax[a]);
        half[a] = 0.5 * (info.boundsMax[a] - info.boundsMin[a]);
    }
    constexpr double kMargin = 1.06;
    double distance = length(half) > 0 ? 0 : 1;
    for (int corner = 0; corner < 8; ++corner) {
        Vec3d p;
        for (int a = 0; a < 3; ++a) {
            p[a] = corner >> a & 1 ? half[a] : -half[a];
        }
        const double depth = -dot(p, camera.forward);
        const double x = std::fabs(dot(p, camera.right)) / (camera.tangent * aspect);
        const double y = std::fabs(dot(p, camera.up)) / camera.tangent;
        distance = std::max(distance, depth + kMargin * std::max(x, y));
    }
    camera.eye = centre - distance * camera.forward;
}

Camera explicitCamera(const std::string& text) {
    const std::vector<double> n = numberList("camera", text, 7);
    const Vec3d eye{{n[0], n[1], n[2]}};
    const Vec3d forward = Vec3d{{n[3], n[4], n[5]}} - eye;
    if (!(length(forward) > 0) || !(n[6] > 0 && n[6] < 180)) {
        throw UsageError("--camera " + text +
                         ": expected ex,ey,ez,tx,ty,tz,fov with the eye away from the target and a "
                         "vertical field of view between 0 and 180 degrees");
    }
    const Vec3d unit = normalized(forward);
    Camera camera = look(unit, std::fabs(unit[1]) > 0.999 ? Vec3d{{0, 0, -1}} : Vec3d{{0, 1, 0}});
    camera.eye = eye;
    camera.tangent = std::tan(n[6] * 3.14159265358979323846 / 360);
    return camera;
}

void parseResolution(const std::string& text, int& width, int& height) {
    char rest = 0;
    if (std::sscanf(text.c_str(), "%dx%d%c", &width, &height, &rest) != 2 || width < 1 ||
        height < 1 || width > 65536 || height > 65536) {
        throw UsageError("--resolution " + text + ": expected WIDTHxHEIGHT, each from 1 to 65536");
    }
}

std::string formatNumber(double value) {
    std::ostringstream text;
    text.precision(9);
    text << value;
    return text.str();
}

/// Optical depth of the baked control per pixel, at scale 1.
std::vector<double> renderDepth(const track::Volume& volume, const Camera& camera, int width,
                                int height, uint32_t level, Progress* progress) {
    TrkQuery query = trkDefaultQuery();
    query.method = TRK_METHOD_CONTROL;
    query.level = level;
    std::vector<double> depth(static_cast<size_t>(width) * static_cast<size_t>(height));
    std::vector<TrkRay> rays(static_cast<size_t>(width));
    const double aspect = static_cast<double>(width) / height;
    for (int row = 0; row < height; ++row) {
        for (int column = 0; column < width; ++column) {
            const double x = (2 * (column + 0.5) / width - 1) * camera.tangent * aspect;
            const double y = (1 - 2 * (row + 0.5) / height) * camera.tangent;
            const Vec3d d = normalized(camera.forward + x * camera.right + y * camera.up);
            TrkRay& ray = rays[static_cast<size_t>(column)];
            for (int a = 0; a < 3; ++a) {
                ray.origin[a] = static_cast<float>(camera.eye[a]);
                ray.direction[a] = static_cast<float>(d[a]);
            }
            ray.tMin = 0;
            ray.tMax = std::numeric_limits<float>::infinity();
        }
        volume.integrateOpticalDepth(query, rays.data(), rays.size(),
                                     &depth[static_cast<size_t>(row) * static_cast<size_t>(width)]);
        if (progress) {
            progress->update((row + 1.0) / height);
        }
    }
    return depth;
}

/// Narrows the field of view until what a small picture shows of the volume fills the frame: boxes
/// are mostly empty at their corners.
void zoom(Camera& camera, const track::Volume& volume, double aspect, uint32_t level) {
    constexpr int kHeight = 96;
    const int width = std::max(1, static_cast<int>(std::min(kHeight * aspect, 2048.0)));
    const std::vector<double> depth = renderDepth(volume, camera, width, kHeight, level, nullptr);
    double reach = 0;
    for (size_t i = 0; i < depth.size(); ++i) {
        if (depth[i] > 0) {
            const size_t whole = i / static_cast<size_t>(width);
            const auto row = static_cast<double>(whole);
            const auto column = static_cast<double>(i - whole * static_cast<size_t>(width));
            reach = std::max({reach, std::fabs(2 * (column + 0.5) / width - 1) + 1.0 / width,
                              std::fabs(2 * (row + 0.5) / kHeight - 1) + 1.0 / kHeight});
        }
    }
    if (reach > 0) {
        camera.tangent *= std::min(1.0, 1.04 * reach);
    }
}

/// The scale at which the median transmittance of the pixels that meet anything is 0.3.
double defaultScale(const std::vector<double>& depth) {
    std::vector<double> hits;
    std::copy_if(depth.begin(), depth.end(), std::back_inserter(hits),
                 [](double d) { return d > 0; });
    if (hits.empty()) {
        return 1;
    }
    const auto middle = hits.begin() + static_cast<std::ptrdiff_t>(hits.size() / 2);
    std::nth_element(hits.begin(), middle, hits.end());
    return -std::log(0.3) / *middle;
}

/// Transmittance over a sky: the volume only takes light away.
Image compose(const std::vector<double>& depth, double scale, int width, int height) {
    Image image(width, height);
    std::vector<float>& transmittance = image.add("transmittance");
    std::vector<float>& alpha = image.add("A");
    for (size_t i = 0; i < depth.size(); ++i) {
        const double t = std::exp(-scale * depth[i]);
        transmittance[i] = static_cast<float>(t);
        alpha[i] = static_cast<float>(1 - t);
    }
    const float zenith[3] = {0.20f, 0.42f, 0.86f};
    const float horizon[3] = {1.00f, 0.90f, 0.74f};
    const char* const names[] = {"R", "G", "B"};
    for (size_t c = 0; c < 3; ++c) {
        std::vector<float>& channel = image.add(names[c]);
        for (size_t i = 0; i < depth.size(); ++i) {
            const size_t row = i / static_cast<size_t>(width);
            const float down = (static_cast<float>(row) + 0.5f) / static_cast<float>(height);
            channel[i] = (zenith[c] + (horizon[c] - zenith[c]) * down * down) *
                         image.channels["transmittance"][i];
        }
    }
    return image;
}

void run(const Command& command, const std::vector<std::string>& given) {
    po::options_description options("Options");
    options.add_options()("output,o", po::value<std::string>(),
                          "OUT.png (tone-mapped) or OUT.exr (float channels R,G,B,A and "
                          "transmittance); default: SIDECAR.png beside the sidecar")(
        "resolution", po::value<std::string>()->default_value("512x512"), "in pixels")(
        "level", po::value<int>()->default_value(0),
        "0: the baked super-voxels; k: super-voxels 2^k times as large")(
        "scale", po::value<float>(),
        "extinction = scale x density; default: the median transmittance becomes 0.3")(
        "view", po::value<std::string>()->default_value("iso"),
        "front, side, top or iso, framed on the volume; y is up")(
        "camera", po::value<std::string>(),
        "ex,ey,ez,tx,ty,tz,fov: eye, target, vertical field of view in degrees")(
        "force", po::bool_switch(), "replace an existing file");
    const Arguments arguments(command, given, options, {"SIDECAR"}, 1);
    const std::string sidecar = arguments.text("SIDECAR");
    int width = 0;
    int height = 0;
    parseResolution(arguments.text("resolution"), width, height);
    choiceIndex("view", arguments.text("view"), kViews);
    if (arguments.given("view") && arguments.has("camera")) {
        throw UsageError("--view and --camera: expected one of them");
    }
    const int level = arguments.integer("level", 0, 64);
    Camera camera = arguments.has("camera") ? explicitCamera(arguments.text("camera"))
                                            : standardView(arguments.text("view"));
    double scale =
        arguments.has("scale") ? static_cast<double>(nonNegative(arguments, "scale")) : 0;
    const std::string output =
        arguments.has("output") ? arguments.text("output")
                                : std::filesystem::path(sidecar).replace_extension(".png").string();
    const std::string extension = std::filesystem::path(output).extension().string();
    if (extension != ".png" && extension != ".exr") {
        throw UsageError("-o " + output + ": expected a name that ends in .png or .exr");
    }

    refuseInput(output, {sidecar});
    const track::Volume volume = track::Volume::open("", sidecar.c_str());
    const TrkVolumeInfo info = volume.info();
    if (!arguments.has("camera")) {
        const double aspect = static_cast<double>(width) / height;
        frame(camera, info, aspect);
        zoom(camera, volume, aspect, static_cast<uint32_t>(level));
    }
    trk::OutputFile file(output, arguments.flag("force"));
    std::vector<double> depth;
    {
        Progress progress(arguments, "drawing " + output);
        depth = renderDepth(volume, camera, width, height, static_cast<uint32_t>(level), &progress);
    }
    if (!arguments.has("scale")) {
        scale = defaultScale(depth);
    }
    const bool hits = std::any_of(depth.begin(), depth.end(), [](double d) { return d > 0; });
    const Image image = compose(depth, scale, width, height);
    std::ostringstream eye;
    eye << formatNumber(camera.eye[0]) << "," << formatNumber(camera.eye[1]) << ","
        << formatNumber(camera.eye[2]);
    std::ostringstream forward;
    forward << formatNumber(camera.forward[0]) << "," << formatNumber(camera.forward[1]) << ","
            << formatNumber(camera.forward[2]);
    if (extension == ".png") {
        writePng(image, file);
    } else {
        writeExr(image,
                 {{"track:source", std::filesystem::path(sidecar).filename().string()},
                  {"track:grid", info.gridName},
                  {"track:scale", formatNumber(scale)},
                  {"track:level", std::to_string(level)},
                  {"track:view",
                   arguments.has("camera") ? std::string("camera") : arguments.text("view")},
                  {"track:eye", eye.str()},
                  {"track:forward", forward.str()},
                  {"track:verticalFov",
                   formatNumber(360 / 3.14159265358979323846 * std::atan(camera.tangent))},
                  {"track:version", TRACK_VERSION}},
                 file);
    }
    file.commit();
    if (!arguments.quiet()) {
        std::cerr << output << ": " << width << "x" << height << ", scale " << formatNumber(scale)
                  << (hits && !arguments.has("scale") ? " (median transmittance 0.3)" : "")
                  << (hits ? "" : " (the picture is empty)") << ", level " << level << "\n";
    }
}

}  // namespace

const Command kPreviewCommand{
    "preview",
    "vdbtrack preview SIDECAR [-o OUT.png|OUT.exr] [--resolution 512x512] [--level 0] [--scale S] "
    "[--view front|side|top|iso | --camera ex,ey,ez,tx,ty,tz,fov] [--force]",
    "Draws the transmittance of the baked control over a sky, without the density.", run};

}  // namespace apps
