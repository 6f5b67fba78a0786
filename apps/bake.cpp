// SPDX-License-Identifier: Apache-2.0
// vdbtrack bake: density in, sidecar out.
#include "command_line.h"

#include "bake/bake.h"
#include "bake/write_bake.h"
#include "io/density.h"
#include "io/sidecar.h"

#include <chrono>
#include <cmath>
#include <cstdio>
#include <filesystem>
#include <iostream>

namespace apps {
namespace {

namespace po = boost::program_options;

/// Says where a control that varies is worse than the constant one would be.
void warnOfBadFit(const std::string& output, const trk::BakedVolume& baked) {
    const trk::ControlFit fit = trk::measureFit(baked);
    char text[160] = "";
    if (std::fabs(fit.massRatio - 1) > 0.01) {
        std::snprintf(text, sizeof(text),
                      "keeps %.3g %% of the density's mass, as it is 0 beside empty super-voxels",
                      100 * fit.massRatio);
    } else if (fit.residualRms > fit.constantRms) {
        std::snprintf(text, sizeof(text), "leaves a residual RMS of %.3g, a constant one %.3g",
                      fit.residualRms, fit.constantRms);
    }
    if (*text) {
        std::cerr << "vdbtrack: warning: " << output << ": the " << trk::controlName(baked.kind)
                  << " control " << text << "; prefer --control affine, or a smaller --size\n";
    }
}

void run(const Command& command, const std::vector<std::string>& given) {
    po::options_description options("Options");
    options.add_options()("output,o", po::value<std::string>(),
                          "sidecar to write; default: IN.track.vdb")(
        "size", po::value<int>()->default_value(16),
        "edge of a super-voxel in voxels: 4, 8, 16, 32 or 64")(
        "control", po::value<std::string>()->default_value("constant"),
        "control extinction of a super-voxel: constant (its mean), affine (mean and gradient) or "
        "trilinear (interpolated between corners, continuous)")(
        "levels", po::value<int>()->default_value(4),
        "preview levels at most, 0 to 8, each of super-voxels twice as large, until four an axis "
        "hold "
        "everything")("force", po::bool_switch(), "replace an existing sidecar");
    addGridOptions(options);
    const Arguments arguments(command, given, options, {"IN.vdb"}, 1);

    const std::string input = arguments.text("IN.vdb");
    const int size = arguments.get<int>("size");
    if (size < 4 || size > 64 || (size & (size - 1)) != 0) {
        throw UsageError("--size " + std::to_string(size) + ": expected 4, 8, 16, 32 or 64");
    }
    trk::BakeOptions bakeOptions;
    bakeOptions.superVoxelSize = size;
    bakeOptions.kind = static_cast<trk::ControlKind>(
        choiceIndex("control", arguments.text("control"), {"constant", "trilinear", "affine"}));
    const int levels = arguments.integer("levels", 0, 8);
    bakeOptions.levels = levels;
    const std::string output =
        arguments.has("output") ? arguments.text("output") : trk::defaultSidecarPath(input);
    refuseInput(output, {input});

    const auto start = std::chrono::steady_clock::now();
    const auto seconds = [&] {
        return std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
    };
    trk::Density density;
    {
        const Progress progress(arguments, "reading " + input);
        trk::DensityOptions densityOptions = densityOptionsOf(arguments);
        densityOptions.bricks = trk::Bricks::kAllThatFit;
        density = trk::loadDensity(input, densityOptions);
    }
    const double readTime = seconds();
    trk::OutputFile file(output, arguments.flag("force"));
    const trk::DensitySummary& summary = density.summary;
    trk::BakedVolume baked;
    trk::SidecarHeader header;
    {
        const Progress progress(arguments, "baking " + input);
        bakeOptions.sidecarBytes = trk::sidecarLimit(summary.fileBytes, bakeOptions.kind);
        bakeOptions.maxMemory = memoryLimit(arguments);
        bakeOptions.where = input;
        baked = trk::bake(density.pages(), bakeOptions);
    }
    const double bakeTime = seconds() - readTime;
    {
        const Progress progress(arguments, "writing " + output);
        header = trk::writeBake(file, summary, density.pages(), baked, bakeOptions.sidecarBytes);
        file.commit();
    }
    if (baked.items.empty() && !arguments.quiet()) {
        std::cerr << "vdbtrack: warning: " << input << ": grid " << summary.label
                  << " is empty; its sidecar holds nothing and its transmittance is 1\n";
    }
    if (!arguments.quiet()) {
        warnOfBadFit(output, baked);
    }
    if (!arguments.quiet()) {
        std::cerr << output << ": grid " << summary.label << ", " << baked.table.occupiedItems()
                  << " super-voxels of " << size << "^3 voxels, " << baked.levels.size()
                  << (baked.levels.size() == 1 ? " level, " : " levels, ") << "preview scale "
                  << header.previewScale << ", " << byteCount(std::filesystem::file_size(output));
        if (summary.dropped + summary.clamped > 0) {
            std::cerr << "; " << summary.dropped << " values that were not finite and "
                      << summary.clamped << " negative ones read as 0";
        }
        char times[96];
        std::snprintf(times, sizeof(times), " (read %.3g s, baked %.3g s, wrote %.3g s)\n",
                      readTime, bakeTime, seconds() - readTime - bakeTime);
        std::cerr << times;
    }
}

}  // namespace

const Command kBakeCommand{"bake",
                           "vdbtrack bake IN.vdb [-o OUT.track.vdb] [--grid NAME] [--size 16] "
                           "[--control constant|affine|trilinear] "
                           "[--levels 4] [--force]",
                           "Bakes control extinction and bounds of the residual into a sidecar.",
                           run};

}  // namespace apps
