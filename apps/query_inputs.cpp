// SPDX-License-Identifier: Apache-2.0
#include "query_inputs.h"

#include "failure.h"
#include "io/sidecar.h"
#include "kernel.h"
#include "names.h"
#include "query/methods.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <filesystem>
#include <limits>
#include <vector>

namespace apps {
namespace {

const std::vector<std::string> kRateBases{"majorant", "rms"};

/// What a bake was allowed to repair, so is a query that needs none; but it must not fail over a
/// file that it does not need.
uint32_t repairBeside(const std::string& sidecar) {
    try {
        return std::filesystem::exists(sidecar) ? trk::readSidecarHeader(sidecar).repair : 0u;
    } catch (const trk::Error&) {
        return 0;
    }
}

}  // namespace

track::Query queryOf(const Arguments& arguments) {
    track::Query query(0, arguments.get<uint64_t>("stream"));
    const std::string method = arguments.text("method");
    const bool freePaths = arguments.flag("free-paths");
    query.method = freePaths && !arguments.given("method")
                       ? TRK_METHOD_RESIDUAL
                       : choiceIndex("method", method, vdbtools::methodNames());
    const auto needs = [&](const char* option, bool holds, const char* what) {
        if (arguments.given(option) && !holds) {
            throw UsageError("--" + std::string(option) + ": of no use with " +
                             (freePaths ? "--free-paths" : "--method " + method) + "; " + what);
        }
    };
    const trk::MethodTraits& traits = trk::traitsOf(query.method);
    const bool tracksRatios = !freePaths && traits.usesRate && traits.usesRoulette;
    const bool tracks = freePaths || traits.usesRate;
    const bool isRandom = freePaths || traits.isRandom;
    needs("level", traits.hasLevels(), "only control has levels");
    needs("step", traits.usesSteps(), "only march and comb take steps");
    needs("rate-base", tracksRatios, "only residual and ratio have one");
    needs("samples", isRandom && !freePaths,
          freePaths ? "each ray of the file gets one path" : "only random methods take samples");
    needs("error", tracks && !freePaths,
          freePaths ? "paths have no variance to choose by"
                    : "only residual, ratio and delta have a variance to choose by");
    needs("rate", tracks, "only residual, ratio, delta and free paths have one");
    needs("global", tracks || (traits.isRandom && traits.usesSuperVoxels),
          "only residual, ratio, delta, comb and free paths walk over super-voxels");
    needs("choice", traits.usesChoice() && !freePaths, "only residual has one");
    needs("size", traits.usesSuperVoxels || freePaths, "it uses no super-voxels");
    needs("roulette", !freePaths && traits.usesRoulette, "only residual, ratio and comb have one");
    needs("seed", isRandom, "nothing is random");
    needs("stream", isRandom, "nothing is random");
    if (arguments.flag("roulette") && arguments.has("error")) {
        throw UsageError(
            "--error and --roulette: expected one of them, as the variance that roulette "
            "adds has no formula");
    }
    if (arguments.has("error") && !(arguments.get<float>("error") > 0)) {
        throw UsageError("--error: expected a number > 0");
    }
    if (freePaths && !traits.hasFreePaths) {
        throw UsageError(
            "--free-paths: expected --method residual (decomposition tracking) or "
            "delta, found " +
            method);
    }
    const int samples = arguments.integer("samples", 1, std::numeric_limits<int>::max());
    constexpr int kMostForError = 1 << 20;
    query.samples = freePaths ? 1u
                    : arguments.has("error") && !arguments.given("samples")
                        ? static_cast<uint32_t>(kMostForError)
                        : static_cast<uint32_t>(samples);
    query.rate = arguments.get<float>("rate");
    const bool needsMajorant = freePaths || (traits.usesRate && !traits.usesRoulette);
    if (!(query.rate > 0) || !std::isfinite(query.rate) || (needsMajorant && query.rate < 1)) {
        throw UsageError(needsMajorant
                             ? "--rate: expected a finite number >= 1, as this needs a majorant"
                             : "--rate: expected a finite number > 0");
    }
    query.rateBase = choiceIndex("rate-base", arguments.text("rate-base"), kRateBases);
    query.step = arguments.get<float>("step");
    if (!(query.step >= 0.001f) || !std::isfinite(query.step)) {
        throw UsageError("--step: expected a finite number of voxels >= 0.001");
    }
    query.flags &= arguments.flag("roulette") ? ~uint32_t{0} : ~uint32_t{TRK_QUERY_ROULETTE};
    query.level = static_cast<uint32_t>(arguments.integer("level", 0, 64));
    query.seed = arguments.get<uint64_t>("seed");
    return query;
}

TrkVolumeOptions volumeOptionsOf(const Arguments& arguments) {
    TrkVolumeOptions options = trkDefaultVolumeOptions();
    options.scale = nonNegative(arguments, "scale");
    const std::array<float, 3> color = colorOf(arguments);
    std::copy(color.begin(), color.end(), options.color);
    options.choice = choiceIndex("choice", arguments.text("choice"), vdbtools::kChoiceNames);
    options.global = arguments.flag("global") ? 1 : 0;
    options.repair = repairBits(arguments);
    options.maxMemory = memoryLimit(arguments);
    options.gridName = arguments.has("grid") ? arguments.get<std::string>("grid").c_str() : nullptr;
    if (arguments.has("size")) {
        const int size = arguments.integer("size", 4, 64);
        if ((size & (size - 1)) != 0) {
            throw UsageError("--size: expected 4, 8, 16, 32 or 64");
        }
        options.superVoxelSize = static_cast<uint32_t>(size);
    }
    options.kernel =
        arguments.has("kernel") ? arguments.get<std::string>("kernel").c_str() : nullptr;
    return options;
}

Inputs inputsOf(const Arguments& arguments, const TrkQuery& query,
                const TrkVolumeOptions& options) {
    Inputs inputs{arguments.text("IN.vdb"), arguments.text("sidecar"), options};
    const bool densityAlone = !trk::traitsOf(query.method).usesSuperVoxels;
    if (std::filesystem::exists(inputs.density) && trk::isSidecar(inputs.density)) {
        if (trk::traitsOf(query.method).usesDensity) {
            throw trk::Error(TRK_ERROR_NO_DENSITY,
                             inputs.density +
                                 ": is a sidecar; expected the density it was baked "
                                 "from, or --method control");
        }
        if (arguments.has("sidecar")) {
            throw UsageError("--sidecar: of no use, as " + inputs.density + " is one");
        }
        inputs.sidecarPath = inputs.density;
        inputs.density.clear();
    } else if (!arguments.has("sidecar")) {
        inputs.sidecarPath = trk::defaultSidecarPath(inputs.density);
    }
    const bool useSidecar = !densityAlone || arguments.has("sidecar");
    inputs.options.noBake = densityAlone ? 1 : 0;
    if (!useSidecar) {
        inputs.options.repair |= repairBeside(inputs.sidecarPath);
    }
    if (useSidecar && std::filesystem::exists(inputs.sidecarPath) &&
        trk::isSidecar(inputs.sidecarPath)) {
        const trk::SidecarHeader header = trk::readSidecarHeader(inputs.sidecarPath);
        checkLevel(inputs.sidecarPath, query.level, header);
        const TrkChoice choice = inputs.options.choice;
        const bool constantOnly = choice == TRK_CHOICE_MIN || choice == TRK_CHOICE_MAX;
        if (constantOnly && inputs.options.global == 0 &&
            header.controlKind != trk::ControlKind::kConstant) {
            throw UsageError("--choice " + arguments.text("choice") + ": the control of " +
                             inputs.sidecarPath + " is " + trk::controlName(header.controlKind) +
                             "; expected robust or mean, or --global");
        }
    }
    inputs.named = inputs.density.empty() || arguments.has("sidecar");
    inputs.wanted = useSidecar;
    return inputs;
}

trk::Volume openInside(const Inputs& inputs) {
    trk::VolumeOptions options;
    options.gridNamed = inputs.options.gridName != nullptr;
    options.gridName = options.gridNamed ? inputs.options.gridName : "";
    options.scale = inputs.options.scale;
    std::copy_n(inputs.options.color, 3, options.color.begin());
    options.choice = inputs.options.choice;
    options.global = inputs.options.global != 0;
    options.repair = inputs.options.repair;
    options.maxMemory = inputs.options.maxMemory;
    options.superVoxelSize = static_cast<int>(inputs.options.superVoxelSize);
    if (inputs.options.kernel) {
        const std::string name = inputs.options.kernel;
        options.kernel = name == trk::kernelName(trk::Kernel::kAvx2) ? trk::Kernel::kAvx2
                                                                     : trk::Kernel::kBaseline;
    }
    options.bakeMissing = true;
    trk::Volume volume = trk::openVolume(inputs.density.c_str(), inputs.sidecar(), options);
    return volume;
}

}  // namespace apps
