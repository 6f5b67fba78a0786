// SPDX-License-Identifier: Apache-2.0
// vdbtrack query: transmittance of the rays of a CSV file.
#include "command_line.h"

#include "error.h"
#include "io/output_file.h"
#include "io/sidecar.h"
#include "track/track.hpp"

#include <algorithm>
#include <array>
#include <cerrno>
#include <charconv>
#include <cmath>
#include <cstdio>
#include <cstring>
#include <filesystem>
#include <fstream>
#include <iostream>
#include <limits>
#include <sstream>

namespace apps {
namespace {

namespace po = boost::program_options;

const std::vector<std::string> kMethods{"exact", "residual", "ratio", "control"};
const std::vector<std::string> kChoices{"robust", "mean", "min", "max"};

/// The numbers of one line, or none where a field is not a number.
std::vector<double> parseFields(const std::string& line) {
    std::vector<double> values;
    const char* at = line.data();
    const char* const end = at + line.size();
    const auto skipSpace = [&] {
        while (at != end && (*at == ' ' || *at == '\t')) {
            ++at;
        }
    };
    for (;;) {
        skipSpace();
        if (at != end && *at == '+') {
            ++at;
        }
        double value = 0;
        const auto [next, error] = std::from_chars(at, end, value);
        if (error != std::errc()) {
            return {};
        }
        values.push_back(value);
        at = next;
        skipSpace();
        if (at == end) {
            return values;
        }
        if (*at++ != ',') {
            return {};
        }
    }
}

std::vector<TrkRay> readRays(const std::string& path) {
    std::ifstream stream(path);
    if (!stream) {
        throw trk::Error(TRK_ERROR_IO, path + ": cannot be opened: " + std::strerror(errno));
    }
    std::vector<TrkRay> rays;
    std::string line;
    bool first = true;  // a header may stand before the first ray
    for (size_t number = 1; std::getline(stream, line); ++number) {
        if (number == 1 && line.compare(0, 3, "\xef\xbb\xbf") == 0) {
            line.erase(0, 3);  // a byte order mark, as spreadsheets write
        }
        if (!line.empty() && line.back() == '\r') {
            line.pop_back();
        }
        if (line.find_first_not_of(" \t") == std::string::npos || line[0] == '#') {
            continue;
        }
        const std::vector<double> v = parseFields(line);
        const bool letters = std::isalpha(static_cast<unsigned char>(line[0])) != 0 &&
                             line.find("inf") != 0 && line.find("nan") != 0;
        if (v.empty() && first && letters) {
            first = false;
            continue;
        }
        first = false;
        if (v.size() != 6 && v.size() != 8) {
            throw trk::Error(TRK_ERROR_INVALID_ARGUMENT,
                             path + ": line " + std::to_string(number) +
                                 ": expected ox,oy,oz,dx,dy,dz[,tmin,tmax], found " +
                                 (v.empty() ? "\"" + line.substr(0, 60) + "\""
                                            : std::to_string(v.size()) + " numbers"));
        }
        const auto narrow = [](double x) { return static_cast<float>(x); };
        const TrkRay ray{{narrow(v[0]), narrow(v[1]), narrow(v[2])},
                         v.size() == 8 ? narrow(v[6]) : 0,
                         {narrow(v[3]), narrow(v[4]), narrow(v[5])},
                         v.size() == 8 ? narrow(v[7]) : std::numeric_limits<float>::infinity()};
        bool finite = !std::isnan(ray.tMin) && !std::isnan(ray.tMax);
        bool zero = true;
        for (int a = 0; a < 3; ++a) {
            finite = finite && std::isfinite(ray.origin[a]) && std::isfinite(ray.direction[a]);
            zero = zero && ray.direction[a] == 0;
        }
        if (!finite || zero) {
            throw trk::Error(TRK_ERROR_INVALID_ARGUMENT,
                             path + ": line " + std::to_string(number) +
                                 ": expected a finite origin, a finite direction that is not zero "
                                 "as a float, and limits that are not NaN");
        }
        rays.push_back(ray);
    }
    if (stream.bad()) {
        throw trk::Error(TRK_ERROR_IO, path + ": cannot be read");
    }
    return rays;
}

/// 9 significant digits; nothing for NaN.
std::string number(double value) {
    if (std::isnan(value)) {
        return {};
    }
    char text[32];
    std::snprintf(text, sizeof(text), "%.9g", value);
    return text;
}

std::string header(size_t channels) {
    std::string text = "ray";
    for (const char* name : {"transmittance", "stderr", "optical_depth"}) {
        for (size_t c = 0; c < channels; ++c) {
            text += std::string(",") + name;
            if (channels > 1) {
                text += std::string("_") + "rgb"[c];
            }
        }
    }
    return text + ",lookups\n";
}

void run(const Command& command, const std::vector<std::string>& given) {
    po::options_description options("Options");
    options.add_options()("rays", po::value<std::string>(),
                          "CSV file: ox,oy,oz,dx,dy,dz[,tmin,tmax] a line, world space")(
        "sidecar", po::value<std::string>(), "default: IN.track.vdb, where it exists")(
        "method", po::value<std::string>()->default_value("residual"),
        "exact, residual, ratio or control")("samples", po::value<int>()->default_value(16),
                                             "estimates averaged per ray")(
        "rate", po::value<float>()->default_value(1.0f, "1"),
        "multiplies the sampling rate of residual and ratio")(
        "choice", po::value<std::string>()->default_value("robust"),
        "control of the residual method: robust, mean, min or max (the last two only where it was "
        "baked constant)")("level", po::value<int>()->default_value(0),
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
    TrkQuery query = trkDefaultQuery();
    query.method = choiceIndex("method", arguments.text("method"), kMethods);
    query.samples =
        static_cast<uint32_t>(arguments.integer("samples", 1, std::numeric_limits<int>::max()));
    query.rate = arguments.get<float>("rate");
    if (!(query.rate > 0) || !std::isfinite(query.rate)) {
        throw UsageError("--rate: expected a finite number > 0");
    }
    query.level = static_cast<uint32_t>(arguments.integer("level", 0, 64));
    query.seed = arguments.get<uint64_t>("seed");
    query.stream = arguments.get<uint64_t>("stream");
    TrkVolumeOptions volumeOptions = trkDefaultVolumeOptions();
    volumeOptions.scale = nonNegative(arguments, "scale");
    const std::array<float, 3> color = colorOf(arguments);
    std::copy(color.begin(), color.end(), volumeOptions.color);
    volumeOptions.choice = choiceIndex("choice", arguments.text("choice"), kChoices);
    volumeOptions.repair = repairBits(arguments);
    const std::string grid = arguments.text("grid");
    volumeOptions.gridName = arguments.has("grid") ? grid.c_str() : nullptr;

    const std::string input = arguments.text("IN.vdb");
    refuseInput(arguments.text("output"),
                {input, arguments.text("rays"), arguments.text("sidecar")});
    const std::vector<TrkRay> rays = readRays(arguments.text("rays"));
    const std::string sidecar = arguments.text("sidecar");
    // What needs no sidecar also must not fail over one that does not fit; but if the bake was
    // allowed to repair values, so is this.
    const bool useSidecar = query.method != TRK_METHOD_EXACT || arguments.has("sidecar");
    const std::string beside = trk::defaultSidecarPath(input);
    if (!useSidecar && std::filesystem::exists(beside) && trk::isSidecar(beside)) {
        volumeOptions.repair |= trk::readSidecarHeader(beside).repair;
    }
    const std::string used = arguments.has("sidecar") ? sidecar : beside;
    if (useSidecar && std::filesystem::exists(used) && trk::isSidecar(used)) {
        const trk::SidecarHeader header = trk::readSidecarHeader(used);
        checkLevel(used, query.level, header);
        const bool constantOnly =
            volumeOptions.choice == TRK_CHOICE_MIN || volumeOptions.choice == TRK_CHOICE_MAX;
        if (constantOnly && header.controlKind != trk::ControlKind::kConstant) {
            throw UsageError("--choice " + arguments.text("choice") + ": the control of " + used +
                             " is " + trk::controlName(header.controlKind) +
                             "; expected robust or mean");
        }
    }
    const track::Volume volume = track::Volume::open(input,
                                                     arguments.has("sidecar") ? sidecar.c_str()
                                                     : useSidecar             ? nullptr
                                                                              : "",
                                                     volumeOptions);

    std::ostringstream out;
    const size_t channels = volume.info().channels;
    out << header(channels);
    constexpr size_t kChunk = 1 << 14;
    const bool deterministic =
        query.method == TRK_METHOD_EXACT || query.method == TRK_METHOD_CONTROL;
    std::vector<float> transmittance(kChunk * channels);
    std::vector<TrkStatistics> statistics(kChunk);
    std::vector<double> depth(kChunk * channels, std::numeric_limits<double>::quiet_NaN());
    {
        Progress progress(arguments, "tracing " + std::to_string(rays.size()) + " rays");
        for (size_t begin = 0; begin < rays.size() || begin == 0; begin += kChunk) {
            const size_t count = std::min(kChunk, rays.size() - begin);
            query.firstRayId = begin;
            volume.estimateTransmittance(query, rays.data() + begin, count, transmittance.data(),
                                         statistics.data());
            if (deterministic) {
                volume.integrateOpticalDepth(query, rays.data() + begin, count, depth.data());
            }
            for (size_t i = 0; i < count; ++i) {
                out << begin + i;
                const auto addChannels = [&](const auto* values) {
                    for (size_t c = 0; c < channels; ++c) {
                        out << ',' << number(static_cast<double>(values[c]));
                    }
                };
                addChannels(&transmittance[i * channels]);
                addChannels(statistics[i].standardError);
                addChannels(&depth[i * channels]);
                out << ',' << statistics[i].lookups << '\n';
            }
            progress.update(static_cast<double>(begin + count) /
                            static_cast<double>(std::max<size_t>(rays.size(), 1)));
        }
    }
    if (!arguments.has("output")) {
        std::cout << out.str();
        return;
    }
    trk::OutputFile file(arguments.text("output"), arguments.flag("force"));
    std::ofstream stream(file.path(), std::ios::binary);
    stream << out.str();
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
    "[--samples 16] [--rate 1] [--choice robust] [--level 0] [--seed 0] [--stream 0] [--scale 1] "
    "[--color 1,1,1] [-o OUT.csv] [--force]",
    "Prints the transmittance of rays: ray,transmittance,stderr,optical_depth,lookups; in colour "
    "with _r, _g, _b.",
    run};

}  // namespace apps
