// SPDX-License-Identifier: Apache-2.0
// vdbtrack query: transmittance of the rays of a CSV file.
#include "command_line.h"

#include "failure.h"
#include "io/output_file.h"
#include "io/sidecar.h"
#include "names.h"
#include "ray_file.h"
#include "track/track.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdio>
#include <filesystem>
#include <fstream>
#include <iostream>
#include <limits>
#include <sstream>

namespace apps {
namespace {

namespace po = boost::program_options;

const std::vector<std::string> kRateBases{"majorant", "rms"};

/// 9 significant digits; nothing for NaN.
std::string number(double value) {
    if (std::isnan(value)) {
        return {};
    }
    char text[32];
    std::snprintf(text, sizeof(text), "%.9g", value);
    return text;
}

/// "name" in grey; "name_r,name_g,name_b" in colour.
std::string columns(const std::string& name, size_t channels) {
    return channels == 1 ? name : name + "_r," + name + "_g," + name + "_b";
}

/// Each of `values` after a comma.
template <class T>
void addColumns(std::ostream& out, const T* values, size_t channels) {
    for (size_t c = 0; c < channels; ++c) {
        out << ',' << number(static_cast<double>(values[c]));
    }
}

/// Calls answer(begin, count) for chunks of rays, showing progress.
template <class Answer>
void forEachChunk(const Arguments& arguments, size_t rayCount, const Answer& answer) {
    constexpr size_t kChunk = 1 << 14;
    Progress progress(arguments, "tracing " + std::to_string(rayCount) + " rays");
    for (size_t begin = 0; begin < rayCount; begin += kChunk) {
        answer(begin, std::min(kChunk, rayCount - begin));
        progress.update(static_cast<double>(begin) / static_cast<double>(rayCount));
    }
}

std::string transmittances(const Arguments& arguments, const track::Volume& volume,
                           track::Query query, const std::vector<TrkRay>& rays) {
    const size_t channels = volume.info().channels;
    std::ostringstream out;
    out << "ray," << columns("transmittance", channels) << ',' << columns("stderr", channels) << ','
        << columns("optical_depth", channels) << ",lookups\n";
    const bool deterministic =
        query.method == TRK_METHOD_EXACT || query.method == TRK_METHOD_CONTROL;
    forEachChunk(arguments, rays.size(), [&](size_t begin, size_t count) {
        std::vector<float> transmittance(count * channels);
        track::Statistics statistics(count, channels);
        std::vector<double> depth(count * channels, std::numeric_limits<double>::quiet_NaN());
        query.firstRayId = begin;
        volume.estimateTransmittance(query, &rays[begin], count, transmittance.data(),
                                     statistics.view());
        if (deterministic) {
            volume.integrateOpticalDepth(query, &rays[begin], count, depth.data());
        }
        for (size_t i = 0; i < count; ++i) {
            out << begin + i;
            addColumns(out, &transmittance[i * channels], channels);
            addColumns(out, &statistics.standardError[i * channels], channels);
            addColumns(out, &depth[i * channels], channels);
            out << ',' << statistics.lookups[i] << '\n';
        }
    });
    return out.str();
}

std::string freePaths(const Arguments& arguments, const track::Volume& volume, track::Query query,
                      const std::vector<TrkRay>& rays) {
    const size_t channels = volume.info().channels;
    std::ostringstream out;
    out << "ray,t," << columns("weight", channels) << ',' << columns("extinction", channels)
        << ",lookups\n";
    forEachChunk(arguments, rays.size(), [&](size_t begin, size_t count) {
        track::FreePaths paths(count, channels);
        query.firstRayId = begin;
        volume.sampleFreePath(query, &rays[begin], count, paths.view());
        for (size_t i = 0; i < count; ++i) {
            out << begin + i << ',' << number(static_cast<double>(paths.t[i]));
            addColumns(out, &paths.weight[i * channels], channels);
            addColumns(out, &paths.extinction[i * channels], channels);
            out << ',' << paths.lookups[i] << '\n';
        }
    });
    return out.str();
}

/// The query that the options describe.
track::Query queryOf(const Arguments& arguments) {
    track::Query query(0, arguments.get<uint64_t>("stream"));
    const std::string method = arguments.text("method");
    query.method = choiceIndex("method", method, vdbtools::kMethodNames);
    const bool freePaths = arguments.flag("free-paths");
    const auto needs = [&](const char* option, bool holds, const char* what) {
        if (arguments.given(option) && !holds) {
            throw UsageError("--" + std::string(option) + ": of no use with " +
                             (freePaths ? "--free-paths" : "--method " + method) + "; " + what);
        }
    };
    const bool tracksRatios =
        !freePaths && (query.method == TRK_METHOD_RESIDUAL || query.method == TRK_METHOD_RATIO);
    needs("level", query.method == TRK_METHOD_CONTROL, "only control has levels");
    needs("step", query.method == TRK_METHOD_MARCH, "only march takes steps");
    needs("rate-base", tracksRatios, "only residual and ratio have one");
    needs("samples", !freePaths, "each ray of the file gets one path");
    const bool tracks = tracksRatios || freePaths || query.method == TRK_METHOD_DELTA;
    needs("rate", tracks, "only residual, ratio, delta and free paths have one");
    needs("global", tracks, "only residual, ratio, delta and free paths walk over super-voxels");
    needs("choice", query.method == TRK_METHOD_RESIDUAL && !freePaths, "only residual has one");
    needs("no-roulette", tracksRatios, "only residual and ratio have one");
    if (freePaths && query.method != TRK_METHOD_RESIDUAL && query.method != TRK_METHOD_DELTA) {
        throw UsageError(
            "--free-paths: expected --method residual (decomposition tracking) or "
            "delta, found " +
            method);
    }
    query.samples = freePaths ? 1u
                              : static_cast<uint32_t>(arguments.integer(
                                    "samples", 1, std::numeric_limits<int>::max()));
    query.rate = arguments.get<float>("rate");
    const bool needsMajorant = freePaths || query.method == TRK_METHOD_DELTA;
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
    query.flags &= arguments.flag("no-roulette") ? ~uint32_t{TRK_QUERY_ROULETTE} : ~uint32_t{0};
    query.level = static_cast<uint32_t>(arguments.integer("level", 0, 64));
    query.seed = arguments.get<uint64_t>("seed");
    return query;
}

/// How to open the volume; strings live as long as `arguments`.
TrkVolumeOptions volumeOptionsOf(const Arguments& arguments) {
    TrkVolumeOptions options = trkDefaultVolumeOptions();
    options.scale = nonNegative(arguments, "scale");
    const std::array<float, 3> color = colorOf(arguments);
    std::copy(color.begin(), color.end(), options.color);
    options.choice = choiceIndex("choice", arguments.text("choice"), vdbtools::kChoiceNames);
    options.global = arguments.flag("global") ? 1 : 0;
    options.repair = repairBits(arguments);
    options.gridName = arguments.has("grid") ? arguments.get<std::string>("grid").c_str() : nullptr;
    return options;
}

/// Opens the density with the sidecar that the method needs.
track::Volume openFor(const Arguments& arguments, const TrkQuery& query, TrkVolumeOptions options) {
    const std::string input = arguments.text("IN.vdb");
    const std::string sidecar = arguments.text("sidecar");
    // What needs no sidecar also must not fail over one that does not fit; but if the bake was
    // allowed to repair values, so is this.
    const bool densityAlone = query.method == TRK_METHOD_EXACT || query.method == TRK_METHOD_MARCH;
    const bool useSidecar = !densityAlone || arguments.has("sidecar");
    const std::string beside = trk::defaultSidecarPath(input);
    if (!useSidecar && std::filesystem::exists(beside) && trk::isSidecar(beside)) {
        options.repair |= trk::readSidecarHeader(beside).repair;
    }
    const std::string used = arguments.has("sidecar") ? sidecar : beside;
    if (useSidecar && std::filesystem::exists(used) && trk::isSidecar(used)) {
        const trk::SidecarHeader header = trk::readSidecarHeader(used);
        checkLevel(used, query.level, header);
        const bool constantOnly =
            options.choice == TRK_CHOICE_MIN || options.choice == TRK_CHOICE_MAX;
        if (constantOnly && options.global == 0 &&
            header.controlKind != trk::ControlKind::kConstant) {
            throw UsageError("--choice " + arguments.text("choice") + ": the control of " + used +
                             " is " + trk::controlName(header.controlKind) +
                             "; expected robust or mean, or --global");
        }
    }
    return track::Volume::open(input,
                               arguments.has("sidecar") ? sidecar.c_str()
                               : useSidecar             ? nullptr
                                                        : "",
                               options);
}

void run(const Command& command, const std::vector<std::string>& given) {
    po::options_description options("Options");
    options.add_options()("rays", po::value<std::string>(),
                          "CSV file: ox,oy,oz,dx,dy,dz[,tmin,tmax] a line, world space")(
        "sidecar", po::value<std::string>(), "default: IN.track.vdb, where it exists")(
        "method", po::value<std::string>()->default_value("residual"),
        "exact: no noise, no bias, slowest; residual: residual ratio tracking, least noise of the "
        "unbiased; ratio: ratio tracking; delta: delta tracking, 0 or 1; control: the control "
        "alone, biased, no noise; march: ray marching, biased")(
        "free-paths", po::bool_switch(),
        "sample where a photon collides instead, by --method residual (decomposition tracking) or "
        "delta: ray,t,weight,extinction,lookups, t = inf where it escapes")(
        "samples", po::value<int>()->default_value(16), "estimates averaged per ray")(
        "rate", po::value<float>()->default_value(1.0f, "1"),
        "multiplies the sampling rate of residual and ratio; of delta and free paths the majorant "
        "(>= 1)")("rate-base", po::value<std::string>()->default_value("majorant"),
                  "what the rate of residual and ratio is a multiple of, per super-voxel: majorant "
                  "or rms (of the residual)")("step", po::value<float>()->default_value(1.0f, "1"),
                                              "of march: voxels between look-ups")(
        "no-roulette", po::bool_switch(), "never end a walk early")(
        "choice", po::value<std::string>()->default_value("robust"),
        "control of the residual method: robust, mean, min or max (the last two only where it was "
        "baked constant)")("global", po::bool_switch(),
                           "take the whole volume for one super-voxel with a constant control: "
                           "for comparison")("level", po::value<int>()->default_value(0),
                                             "preview level of the control method")(
        "seed", po::value<uint64_t>()->default_value(0), "of the random numbers")(
        "stream", po::value<uint64_t>()->default_value(0), "independent random numbers")(
        "scale", po::value<float>()->default_value(1.0f, "1"), "extinction = scale x density")(
        "output,o", po::value<std::string>(), "CSV file to write; default: stdout")(
        "force", po::bool_switch(), "replace an existing file");
    addColorOption(options);
    addGridOptions(options);
    const Arguments arguments(command, given, options, {"IN.vdb"}, 1);
    if (!arguments.has("rays")) {
        throw UsageError("missing --rays RAYS.csv");
    }
    const track::Query query = queryOf(arguments);
    const TrkVolumeOptions volumeOptions = volumeOptionsOf(arguments);
    refuseInput(arguments.text("output"),
                {arguments.text("IN.vdb"), arguments.text("rays"), arguments.text("sidecar")});
    const std::vector<TrkRay> rays = readRays(arguments.text("rays"));
    const track::Volume volume = openFor(arguments, query, volumeOptions);
    const std::string csv = arguments.flag("free-paths")
                                ? freePaths(arguments, volume, query, rays)
                                : transmittances(arguments, volume, query, rays);
    if (!arguments.has("output")) {
        std::cout << csv;
        return;
    }
    trk::OutputFile file(arguments.text("output"), arguments.flag("force"));
    std::ofstream stream(file.path(), std::ios::binary);
    stream << csv;
    stream.close();
    if (!stream) {
        throw trk::Error(TRK_ERROR_IO, file.target() + ": cannot be written (disk full?)");
    }
    file.commit();
}

}  // namespace

const Command kQueryCommand{
    "query",
    "vdbtrack query IN.vdb --rays RAYS.csv [--sidecar S] [--grid NAME] [--method residual] "
    "[--free-paths] [--samples 16] [--rate 1] [--rate-base majorant] [--step 1] [--no-roulette] "
    "[--choice robust] [--global] [--level 0] [--seed 0] [--stream 0] [--scale 1] "
    "[--color 1,1,1] [-o OUT.csv] [--force]",
    "Prints the transmittance of rays: ray,transmittance,stderr,optical_depth,lookups; in colour "
    "with _r, _g, _b. With --free-paths, where photons collide.",
    run};

}  // namespace apps
