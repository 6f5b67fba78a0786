// SPDX-License-Identifier: Apache-2.0
// vdbtrack query: transmittance of the rays of a CSV file, exact unless a random method is asked
// for.
#include "query_inputs.h"

#include "failure.h"
#include "io/output_file.h"
#include "measure/known_error.h"
#include "parallel.h"
#include "query/batch.h"
#include "query/methods.h"
#include "ray_file.h"
#include "track/track.hpp"

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <fstream>
#include <functional>
#include <iostream>
#include <limits>
#include <sstream>

namespace apps {
namespace {

namespace po = boost::program_options;

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

/// The answers to some rays, `channels` values each.
struct Answers {
    Answers(size_t count, size_t channels)
        : transmittance(count * channels),
          depth(count * channels, std::numeric_limits<double>::quiet_NaN()),
          statistics(count, channels),
          samples(count) {}

    std::vector<float> transmittance;
    std::vector<double> depth;  ///< NaN where the method has none
    track::Statistics statistics;
    std::vector<uint32_t> samples;  ///< 0 where it was integrated exactly
};

/// Rays whose standard error is not known, and how many of them nothing came through.
struct Unknown {
    size_t rays = 0;
    size_t dark = 0;
};

/// One line on stderr where --samples does not reach --error.
void noteMissed(size_t rays, double wanted) {
    if (rays > 0) {
        std::cerr << "vdbtrack: note: " << rays << (rays == 1 ? " ray does" : " rays do")
                  << " not reach --error " << static_cast<float>(wanted) << " within --samples\n";
    }
}

/// One line on stderr on the errors that are empty, and what can be said instead.
void noteUnknown(const Unknown& unknown, const TrkQuery& query) {
    if (unknown.rays == 0) {
        return;
    }
    std::cerr << "vdbtrack: note: " << unknown.rays
              << (unknown.rays == 1 ? " ray has" : " rays have") << " no standard error: ";
    const trk::MethodTraits& method = trk::traitsOf(query.method);
    if (!method.isUnbiased) {
        std::cerr << method.name << " is biased, by an amount that only --method exact tells\n";
        return;
    }
    if (query.samples == 1) {
        std::cerr << (method.usesRate ? "with --roulette, one sample shows none\n"
                                      : "one sample shows none\n");
        return;
    }
    std::cerr << "all " << query.samples << " samples agree";
    // Of estimates between 0 and 1, more than the share that is not 0 cannot get through.
    if (unknown.dark > 0 && method.usesRoulette && !method.usesControl && query.rate >= 1 &&
        query.rateBase == TRK_RATE_BASE_MAJORANT) {
        char bound[32];
        std::snprintf(bound, sizeof(bound), "%.2g", 1 - std::pow(0.05, 1.0 / query.samples));
        std::cerr << "; no sample got through " << unknown.dark << " of them: T < " << bound
                  << " at 95 %";
    }
    std::cerr << (method.usesRate ? "; without --roulette all have one\n" : "\n");
}

std::string table(const Arguments& arguments, size_t channels, const TrkQuery& query,
                  const std::vector<TrkRay>& rays,
                  const std::function<void(size_t begin, size_t count, Answers&)>& answer) {
    std::ostringstream out;
    const bool bySamples = arguments.has("error");
    out << "ray," << columns("transmittance", channels) << ',' << columns("stderr", channels) << ','
        << columns("optical_depth", channels) << ",lookups" << (bySamples ? ",samples\n" : "\n");
    Unknown unknown;
    const double wanted = bySamples ? static_cast<double>(arguments.get<float>("error")) : 0;
    size_t missed = 0;
    forEachChunk(arguments, rays.size(), [&](size_t begin, size_t count) {
        Answers answers(count, channels);
        answer(begin, count, answers);
        for (size_t i = 0; i < count; ++i) {
            const float* error = &answers.statistics.standardError[i * channels];
            const float* value = &answers.transmittance[i * channels];
            if (std::any_of(error, error + channels, [](float e) { return std::isnan(e); })) {
                ++unknown.rays;
                unknown.dark += *std::max_element(value, value + channels) == 0 ? 1 : 0;
            }
            missed += bySamples && static_cast<double>(*std::max_element(error, error + channels)) >
                                       wanted * (1 + 1e-6)
                          ? 1
                          : 0;
            out << begin + i;
            addColumns(out, value, channels);
            addColumns(out, error, channels);
            addColumns(out, &answers.depth[i * channels], channels);
            out << ',' << answers.statistics.lookups[i];
            if (bySamples) {
                out << ',' << answers.samples[i];
            }
            out << '\n';
        }
    });
    if (!arguments.quiet()) {
        noteUnknown(unknown, query);
        noteMissed(missed, wanted);
    }
    return out.str();
}

/// By the C API; standard errors are what the samples show.
std::string transmittances(const Arguments& arguments, const track::Volume& volume,
                           track::Query query, const std::vector<TrkRay>& rays) {
    const bool hasDepth = !trk::traitsOf(query.method).isRandom;
    return table(
        arguments, volume.info().channels, query, rays,
        [&](size_t begin, size_t count, Answers& answers) {
            query.firstRayId = begin;
            volume.estimateTransmittance(query, &rays[begin], count, answers.transmittance.data(),
                                         answers.statistics.view());
            if (hasDepth) {
                volume.integrateOpticalDepth(query, &rays[begin], count, answers.depth.data());
            }
        });
}

/// By a random method without roulette, whose standard errors are known.
std::string certainTransmittances(const Arguments& arguments, const trk::Volume& volume,
                                  const TrkQuery& query, const std::vector<TrkRay>& rays) {
    const size_t channels = volume.channels();
    const double wanted =
        arguments.has("error") ? static_cast<double>(arguments.get<float>("error")) : 0;
    return table(arguments, channels, query, rays,
                 [&](size_t begin, size_t count, Answers& answers) {
                     trk::parallelFor(count, 16, [&](size_t i) {
                         const auto estimate = vdbtools::estimateWithKnownError(
                             volume, query, rays[begin + i], begin + i, wanted);
                         const auto put = [&](const auto& from, auto& to) {
                             std::copy_n(from.begin(), channels,
                                         to.begin() + static_cast<std::ptrdiff_t>(i * channels));
                         };
                         put(estimate.transmittance, answers.transmittance);
                         put(estimate.standardError, answers.statistics.standardError);
                         put(estimate.opticalDepth, answers.depth);
                         answers.statistics.lookups[i] = estimate.lookups;
                         answers.samples[i] = estimate.samples;
                     });
                 });
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

std::string answerRays(const Arguments& arguments, const track::Query& query, const Inputs& inputs,
                       const std::vector<TrkRay>& rays) {
    const bool hasFormula = !arguments.flag("free-paths") && !arguments.flag("roulette") &&
                            trk::traitsOf(query.method).usesRate;
    if (hasFormula) {
        return certainTransmittances(arguments, openInside(inputs), query, rays);
    }
    const track::Volume volume =
        track::Volume::open(inputs.density, inputs.sidecar(), inputs.options);
    return arguments.flag("free-paths") ? freePaths(arguments, volume, query, rays)
                                        : transmittances(arguments, volume, query, rays);
}

void run(const Command& command, const std::vector<std::string>& given) {
    po::options_description options("Options");
    options.add_options()("rays", po::value<std::string>(),
                          "CSV file, or - for standard input: ox,oy,oz,dx,dy,dz[,tmin,tmax] a "
                          "line, world space; a header "
                          "may name the columns in another order")(
        "sidecar", po::value<std::string>(), "default: IN.track.vdb, where it exists")(
        "method", po::value<std::string>()->default_value("exact"),
        "exact: no noise, no bias; random and unbiased, as a renderer would ask: residual "
        "(residual "
        "ratio tracking, least noise), ratio (ratio tracking), delta (delta tracking, 0 or 1), "
        "comb "
        "(unbiased ray marching, next to exact, faster where volumes are deep); "
        "biased: control (the control alone, no noise), march (ray marching)")(
        "free-paths", po::bool_switch(),
        "sample where a photon collides instead, by --method residual (decomposition tracking, "
        "default "
        "here) or delta: ray,t,weight,extinction,lookups, t = inf where it escapes")(
        "samples", po::value<int>()->default_value(64),
        "of random methods: estimates averaged per ray; with --error at most (default then 2^20)")(
        "error", po::value<float>(),
        "of residual, ratio and delta: take as many samples of each ray as its standard error "
        "needs, "
        "found by formula before any is drawn, or integrate it exactly where that is cheaper (adds "
        "a column: samples, 0 for exact)")(
        "rate", po::value<float>()->default_value(1.0f, "1"),
        "multiplies the sampling rate of residual and ratio; of delta and free paths the majorant "
        "(>= 1)")("rate-base", po::value<std::string>()->default_value("majorant"),
                  "what the rate of residual and ratio is a multiple of, per super-voxel: majorant "
                  "or rms (of the residual)")("step", po::value<float>()->default_value(1.0f, "1"),
                                              "of march and comb: voxels between look-ups")(
        "roulette", po::bool_switch(),
        "end walks of residual, ratio and comb early, without bias, as renderers do: then standard "
        "errors, as those of comb always, "
        "are those that the samples show, and empty where they show none")(
        "choice", po::value<std::string>()->default_value("robust"),
        "control of the residual method: robust, mean, min or max (the last two only where it was "
        "baked constant)")("global", po::bool_switch(),
                           "take the whole volume for one super-voxel with a constant control: "
                           "for comparison")("level", po::value<int>()->default_value(0),
                                             "preview level of the control method")(
        "size", po::value<int>(),
        "larger super-voxels than were baked, made of those: up to 64; by default as baked")(
        "kernel", po::value<std::string>(),
        "baseline or avx2: whose code runs; by default the best of this processor")(
        "seed", po::value<uint64_t>()->default_value(0), "of the random numbers")(
        "stream", po::value<uint64_t>()->default_value(0), "independent random numbers")(
        "scale", po::value<float>()->default_value(1.0f, "1"), "extinction = scale x density")(
        "output,o", po::value<std::string>(), "CSV file to write; - or default: stdout")(
        "force", po::bool_switch(), "replace an existing file");
    addColorOption(options);
    addGridOptions(options);
    const Arguments arguments(command, given, options, {"IN.vdb"}, 1);
    if (!arguments.has("rays")) {
        throw UsageError("missing --rays RAYS.csv");
    }
    const track::Query query = queryOf(arguments);
    const TrkVolumeOptions volumeOptions = volumeOptionsOf(arguments);
    if (arguments.has("output") && arguments.text("output").empty()) {
        throw UsageError("-o: expected a name, or -");
    }
    const std::string output = arguments.text("output") == "-" ? "" : arguments.text("output");
    refuseInput(output,
                {arguments.text("IN.vdb"), arguments.text("rays"), arguments.text("sidecar"),
                 trk::defaultSidecarPath(arguments.text("IN.vdb"))});
    const std::vector<TrkRay> rays = readRays(arguments.text("rays"));
    if (rays.empty() && !arguments.quiet()) {
        std::cerr << "vdbtrack: note: " << arguments.text("rays") << ": no rays\n";
    }
    const std::string csv =
        answerRays(arguments, query, inputsOf(arguments, query, volumeOptions), rays);
    if (output.empty()) {
        std::cout << csv;
        return;
    }
    trk::OutputFile file(output, arguments.flag("force"));
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
    "vdbtrack query IN.vdb|SIDECAR --rays RAYS.csv [--sidecar S] [--grid NAME] [--method exact] "
    "[--free-paths] [--samples 64] [--error E] [--rate 1] [--rate-base majorant] [--step 1] "
    "[--roulette] "
    "[--choice robust] [--size N] [--global] [--level 0] [--seed 0] [--stream 0] [--scale 1] "
    "[--color 1,1,1] [-o OUT.csv] [--force]",
    "Prints the transmittance of rays: ray,transmittance,stderr,optical_depth,lookups; in colour "
    "with _r, _g, _b; empty where something is not known. With --free-paths, where photons "
    "collide.",
    run};

}  // namespace apps
