// SPDX-License-Identifier: Apache-2.0
// vdbtrack preview: pictures from a sidecar alone.
#include "command_line.h"

#include "failure.h"
#include "image.h"
#include "io/output_file.h"
#include "shot.h"
#include "track/track.hpp"
#include "view/lit_preview.h"

#include <unistd.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <filesystem>
#include <functional>
#include <iostream>
#include <memory>
#include <utility>

namespace apps {
namespace {

namespace po = boost::program_options;
using vdbtools::Camera;

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

/// As compositors want it: what the volume scatters, premultiplied; the sky is a layer of its own.
Image litImage(const Shot& shot, vdbtools::Picture picture) {
    Image image(picture.width, picture.height);
    std::vector<float>& alpha = image.add("A");
    for (size_t i = 0; i < alpha.size(); ++i) {
        alpha[i] = 1 - (picture.transmittance[0][i] + picture.transmittance[1][i] +
                        picture.transmittance[2][i]) /
                           3;
    }
    for (size_t c = 0; c < 3; ++c) {
        image.channels[kRgb[c]] = std::move(picture.light[c]);
        image.channels["transmittance." + kRgb[c]] = std::move(picture.transmittance[c]);
        if (!shot.sky) {
            continue;
        }
        std::vector<float>& sky = image.add("sky." + kRgb[c]);
        for (size_t i = 0; i < sky.size(); ++i) {
            const auto row = static_cast<double>(i / static_cast<size_t>(image.width));
            sky[i] = vdbtools::skyBehind((row + 0.5) / image.height)[c];
        }
    }
    image.channels["halfDepth.Z"] = std::move(picture.halfDepth);
    return image;
}

/// The same for eyes: in front of the sky, or with an alpha.
Image flattened(const Image& image, bool sky) {
    Image flat(image.width, image.height);
    const std::vector<float>& alpha = image.channels.at("A");
    for (const std::string& c : kRgb) {
        std::vector<float>& values = flat.add(c);
        const std::vector<float>& light = image.channels.at(c);
        const std::vector<float>& passed = image.channels.at("transmittance." + c);
        for (size_t i = 0; i < values.size(); ++i) {
            values[i] = sky            ? light[i] + passed[i] * image.channels.at("sky." + c)[i]
                        : alpha[i] > 0 ? light[i] / alpha[i]
                                       : 0;
        }
    }
    if (!sky) {
        flat.channels["A"] = alpha;
    }
    return flat;
}

/// The control's transmittance as it is: white where all light passes.
Image transmittanceImage(const Shot& shot, const track::Volume& volume, const Camera& camera,
                         const std::function<void(double)>& progress) {
    Image image(shot.width, shot.height);
    const std::vector<double> depth =
        controlDepth(volume, camera, shot.width, shot.height, shot.level.value_or(0), progress);
    const size_t channels = volume.info().channels;
    std::vector<float>& alpha = image.add("A");
    for (size_t c = 0; c < 3; ++c) {
        std::vector<float>& values = image.add(kRgb[c]);
        for (size_t i = 0; i < values.size(); ++i) {
            const double t =
                std::exp(-static_cast<double>(shot.scale) * depth[i * channels + c % channels]);
            values[i] = static_cast<float>(t);
            alpha[i] += static_cast<float>((1 - t) / 3);
        }
    }
    return image;
}

/// From world space to the camera's, and to the picture's: -1 to 1 from left to right, from bottom
/// to top and from near to far, after division by w. For row vectors, as OpenEXR has them.
CameraMatrices matricesOf(const Shot& shot, const Camera& camera) {
    CameraMatrices matrices;
    const trk::AffineMap map = camera.worldToCamera();
    const double width = camera.tangent * shot.aspect();
    const double distance = length(shot.centre - camera.eye);
    const double near = 0.01 * distance;
    const double far = 100 * distance;
    for (size_t in = 0; in < 4; ++in) {
        double c[4] = {0, 0, 0, in == 3 ? 1.0 : 0.0};
        for (size_t out = 0; out < 3; ++out) {
            c[out] = in < 3 ? map.linear[out][in] : map.translation[out];
        }
        const double ndc[4] = {c[0] / width, c[1] / camera.tangent,
                               (-(far + near) * c[2] - 2 * far * near * c[3]) / (far - near),
                               -c[2]};
        for (size_t out = 0; out < 4; ++out) {
            matrices.worldToCamera[in][out] = static_cast<float>(c[out]);
            matrices.worldToNdc[in][out] = static_cast<float>(ndc[out]);
        }
    }
    matrices.screenWindowWidth = static_cast<float>(2 * width);
    return matrices;
}

void writeImage(const Shot& shot, const Image& image, const Camera& camera,
                const std::string& gridName, const trk::OutputFile& file) {
    if (std::filesystem::path(shot.output).extension() == ".png") {
        writePng(shot.lit ? flattened(image, shot.sky) : image,
                 shot.lit ? Tone::kRolledOff : Tone::kLinear, file, shot.lit && !shot.sky);
        return;
    }
    writeExr(image, shot.half,
             {{"track:source", std::filesystem::path(shot.sidecar).filename().string()},
              {"track:grid", gridName},
              {"track:scale", formatNumber(shot.scale)},
              {"track:level", shot.level ? std::to_string(*shot.level) : "finest"},
              {"track:eye", formatVector(camera.eye)},
              {"track:forward", formatVector(camera.forward)},
              {"track:verticalFov",
               formatNumber(360 / 3.14159265358979323846 * std::atan(camera.tangent))},
              {"track:version", TRACK_VERSION}},
             matricesOf(shot, camera), file);
}

/// Frames what is drawn: `lit`, or where that is NULL the control of a level.
void frame(Shot& shot, const track::Volume& volume, const vdbtools::LitPreview* lit) {
    if (lit) {
        frameVolume(shot, lit->box(), [&](const Camera& camera, int width, int height) {
            return lit->hits(camera, width, height);
        });
        return;
    }
    const TrkVolumeInfo info = volume.info();
    vdbtools::WorldBox box;
    std::copy_n(info.boundsMin, 3, box.lo.x);
    std::copy_n(info.boundsMax, 3, box.hi.x);
    frameVolume(shot, box, [&](const Camera& camera, int width, int height) {
        const std::vector<double> depth =
            controlDepth(volume, camera, width, height, shot.level.value_or(0));
        std::vector<char> hits(depth.size() / info.channels);
        for (size_t i = 0; i < depth.size(); ++i) {
            hits[i / info.channels] = hits[i / info.channels] || depth[i] > 0;
        }
        return hits;
    });
}

/// The sidecar's header; of another file, an error that says which sidecar was meant.
trk::SidecarHeader headerOf(const std::string& path) {
    if (trk::isSidecar(path)) {
        return trk::readSidecarHeader(path);
    }
    const std::string sidecar = trk::defaultSidecarPath(path);
    throw trk::Error(TRK_ERROR_BAD_FILE,
                     path + ": is no sidecar; expected " + sidecar +
                         (std::filesystem::exists(sidecar)
                              ? ", which is beside it"
                              : ", which `vdbtrack bake " + shellWord(path) + "` makes"));
}

void run(const Command& command, const std::vector<std::string>& given) {
    po::options_description options("Options");
    options.add_options()(
        "output,o", po::value<std::string>(),
        "OUT.png (tone-mapped) or OUT.exr (linear: R,G,B,A premultiplied, and the "
        "layers sky, transmittance and halfDepth, the distance at which half the "
        "light is left); default: SIDECAR.png beside the sidecar")(
        "scale-from", po::value<std::string>(),
        "another sidecar whose scale to take, as for all frames of a sequence")(
        "force", po::bool_switch(), "replace existing files");
    addShotOptions(options);
    addColorOption(options);
    const Arguments arguments(command, given, options, {"SIDECAR"}, 1);
    Shot shot = parseShot(arguments);
    checkMemory(shot);
    if (arguments.has("scale") && arguments.has("scale-from")) {
        throw UsageError("--scale and --scale-from: expected one of them");
    }
    const trk::SidecarHeader header = headerOf(shot.sidecar);
    checkLevel(shot.sidecar, shot.level.value_or(0), header);
    std::string whose = "asked for";
    if (arguments.has("scale-from")) {
        shot.scale = static_cast<float>(headerOf(arguments.text("scale-from")).previewScale);
        if (track::Volume::open("", arguments.text("scale-from").c_str()).info().superVoxelCount ==
            0) {
            throw trk::Error(
                TRK_ERROR_INVALID_ARGUMENT,
                arguments.text("scale-from") +
                    ": is of an empty volume; expected one whose scale means something");
        }
        whose = "of " + arguments.text("scale-from");
    } else if (!arguments.has("scale")) {
        shot.scale = static_cast<float>(header.previewScale);
        whose = "of the sidecar";
    }

    TrkVolumeOptions volumeOptions = trkDefaultVolumeOptions();
    std::copy(shot.color.begin(), shot.color.end(), volumeOptions.color);
    const track::Volume volume = track::Volume::open("", shot.sidecar.c_str(), volumeOptions);
    const TrkVolumeInfo info = volume.info();
    const int frames = std::max(shot.frames, 1);
    for (int frame = 0; frame < frames; ++frame) {  // before any is written
        refuseInput(shot.nameOf(frame), {shot.sidecar, arguments.text("scale-from")});
        trk::OutputFile(shot.nameOf(frame), arguments.flag("force"));
    }
    std::unique_ptr<vdbtools::LitPreview> lit;
    if (shot.lit) {
        const Progress progress(arguments, "lighting " + shot.sidecar);
        lit = std::make_unique<vdbtools::LitPreview>(
            shot.sidecar,
            vdbtools::LitOptions{
                shot.level, shot.scale, shot.color, {shot.up, shot.azimuth, shot.elevation}});
    }
    if (!arguments.has("camera")) {
        frame(shot, volume, lit.get());
    }
    for (int frame = 0; frame < frames; ++frame) {
        const Camera camera = shot.cameraOf(frame);
        trk::OutputFile file(shot.nameOf(frame), arguments.flag("force"));
        Progress progress(arguments, "drawing " + shot.nameOf(frame));
        const auto update = [&](double fraction) { progress.update(fraction); };
        const Image image = shot.lit
                                ? litImage(shot, lit->draw(camera, shot.width, shot.height, update))
                                : transmittanceImage(shot, volume, camera, update);
        writeImage(shot, image, camera, info.gridName, file);
        file.commit();
    }
    if (!arguments.quiet()) {
        const bool fine = shot.lit && !shot.level && header.previewSize > 0;
        std::cerr << shot.nameOf(0) << (frames > 1 ? " to " + shot.nameOf(frames - 1) : "") << ": "
                  << shot.width << "x" << shot.height << ", scale " << formatNumber(shot.scale)
                  << " (" << whose << "), "
                  << (fine ? "means of " + std::to_string(header.previewSize) + "^3 voxels"
                           : "level " + std::to_string(shot.level.value_or(0)))
                  << (info.superVoxelCount == 0 ? "; the volume is empty" : "") << "\n";
    }
}

}  // namespace

const Command kPreviewCommand{
    "preview",
    "vdbtrack preview SIDECAR [-o OUT.png|OUT.exr] [--transmittance] [--resolution 512x512] "
    "[--level K] [--scale S | --scale-from SIDECAR] [--color 1,1,1] [--view front|side|top|iso | "
    "--camera ex,ey,ez,tx,ty,tz,fov] [--up y|z] [--light -29,41] [--no-sky] [--half] [--frames N "
    "[--first 1]] [--force]",
    "Draws the means that a sidecar holds, lit by a sun and a sky, without the density.", run};

}  // namespace apps
