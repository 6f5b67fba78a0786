// SPDX-License-Identifier: Apache-2.0
// vdbtrack verify: proves a sidecar's bounds voxel by voxel.
#include "command_line.h"

#include "bake/verify.h"
#include "failure.h"
#include "io/density.h"
#include "io/sidecar.h"

#include <filesystem>
#include <iostream>

namespace apps {
namespace {

namespace po = boost::program_options;

void run(const Command& command, const std::vector<std::string>& given) {
    po::options_description options("Options");
    addGridOptions(options);
    const Arguments arguments(command, given, options, {"IN.vdb", "SIDECAR"}, 1);
    const std::string input = arguments.text("IN.vdb");
    const std::string path =
        arguments.has("SIDECAR") ? arguments.text("SIDECAR") : trk::defaultSidecarPath(input);
    const Progress progress(arguments, "verifying " + path);
    trk::DensityOptions densityOptions = densityOptionsOf(arguments);
    densityOptions.bricks = trk::Bricks::kNone;
    if (std::filesystem::exists(input)) {  // else that is what to say first
        densityOptions.repair |= trk::readSidecarHeader(path).repair;
    }
    const trk::DensitySummary summary = trk::loadDensity(input, densityOptions).summary;
    const trk::Sidecar sidecar = trk::readSidecar(
        path, &summary, TRK_CHECK_FULL, trk::SidecarParts::kAll, densityOptions.maxMemory);
    const vdbtools::VerifyReport report =
        vdbtools::verify(summary, sidecar, densityOptions.maxMemory);
    if (!report.holds) {
        throw trk::Error(TRK_ERROR_SIDECAR_MISMATCH, path + ": " + report.counterexample);
    }
    if (!arguments.quiet()) {
        std::cerr << path << ": all bounds hold (" << report.superVoxels << " super-voxels, "
                  << report.vertices << " vertices compared)\n";
    }
}

}  // namespace

const Command kVerifyCommand{"verify", "vdbtrack verify IN.vdb [SIDECAR] [--grid NAME]",
                             "Proves every bound of a sidecar voxel by voxel; exit 1 and the first "
                             "counterexample otherwise.",
                             run};

}  // namespace apps
