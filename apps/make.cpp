// SPDX-License-Identifier: Apache-2.0
// vdbtrack make: procedural volumes.
#include "command_line.h"

#include "make/procedural.h"

#include <iostream>

namespace apps {
namespace {

namespace po = boost::program_options;

void run(const Command& command, const std::vector<std::string>& given) {
    po::options_description options("Options");
    options.add_options()(
        "kind", po::value<std::string>()->default_value("cloud"),
        "cloud (a cumulus), smoke (a thin plume) or color-cloud (a cumulus with three "
        "channels of different shapes)")("voxels", po::value<int>()->default_value(256),
                                         "along each edge of its box, 16 to 2048")(
        "seed", po::value<uint64_t>()->default_value(1), "another number, another volume")(
        "force", po::bool_switch(), "replace an existing file");
    const Arguments arguments(command, given, options, {"OUT.vdb"}, 1);

    vdbtools::ProceduralOptions make;
    make.kind = arguments.text("kind");
    choiceIndex("kind", make.kind, vdbtools::proceduralKinds());
    make.voxels = arguments.integer("voxels", 16, 2048);
    make.seed = arguments.get<uint64_t>("seed");
    trk::OutputFile file(arguments.text("OUT.vdb"), arguments.flag("force"));
    vdbtools::ProceduralSummary summary;
    {
        Progress progress(arguments, "making a " + make.kind);
        summary = vdbtools::writeProcedural(make, file, [&](double f) { progress.update(f); });
    }
    file.commit();
    if (!arguments.quiet()) {
        std::cerr << file.target() << ": " << make.kind << ", grid density, "
                  << summary.activeVoxels << " active voxels of size " << summary.voxelSize << "\n";
    }
}

}  // namespace

const Command kMakeCommand{
    "make",
    "vdbtrack make OUT.vdb [--kind cloud|smoke|color-cloud] [--voxels 256] [--seed 1] [--force]",
    "Makes a procedural volume that looks real.", run};

}  // namespace apps
