// SPDX-License-Identifier: Apache-2.0
// vdbtrack measure: what each method, control, size and rate costs and buys on a volume.
#include "command_line.h"

#include "bake/write_bake.h"
#include "failure.h"
#include "io/density.h"
#include "io/output_file.h"
#include "names.h"
#include "report/report.h"

#include <algorithm>
#include <chrono>
#include <cmath>
#include <filesystem>
#include <fstream>
#include <iostream>
#include <memory>
#include <optional>

namespace apps {
namespace {

namespace po = boost::program_options;

const std::vector<std::string> kControlNames{"constant", "trilinear", "affine"};

/// "a, b,c" as parts.
std::vector<std::string> split(const std::string& text) {
    std::vector<std::string> parts(1);
    for (const char c : text) {
        if (c == ',') {
            parts.emplace_back();
        } else if (c != ' ') {
            parts.back() += c;
        }
    }
    return parts;
}

/// Names separated by commas, as indices into `names`.
std::vector<int> choiceList(const Arguments& arguments, const std::string& option,
                            const std::vector<std::string>& names) {
    std::vector<int> indices;
    for (const std::string& part : split(arguments.text(option))) {
        indices.push_back(choiceIndex(option, part, names));
    }
    return indices;
}

/// Positive numbers separated by commas, of which one may be `word`, which counts as `value`.
std::vector<double> positiveList(const Arguments& arguments, const std::string& option,
                                 const std::string& word, double value) {
    std::vector<double> numbers;
    for (const std::string& part : split(arguments.text(option))) {
        if (!word.empty() && part == word) {
            numbers.push_back(value);
            continue;
        }
        char* end = nullptr;
        const double number = std::strtod(part.c_str(), &end);
        const auto single = static_cast<float>(number);  // what the API takes
        if (part.empty() || *end != '\0' || !std::isfinite(single) || !(single > 0)) {
            throw UsageError("--" + option + " " + arguments.text(option) +
                             ": expected positive numbers separated by commas" +
                             (word.empty() ? "" : ", or " + word) + ", found \"" + part + "\"");
        }
        numbers.push_back(number);
    }
    return numbers;
}

vdbtools::SweepOptions sweepOptionsOf(const Arguments& arguments) {
    vdbtools::SweepOptions options;
    std::vector<trk::ControlKind> kinds;
    for (const int kind : choiceList(arguments, "control", kControlNames)) {
        kinds.push_back(static_cast<trk::ControlKind>(kind));
    }
    std::vector<int> sizes;
    for (const double size : positiveList(arguments, "size", "all", vdbtools::Way::kWholeVolume)) {
        const bool whole = size == vdbtools::Way::kWholeVolume;
        if (!whole && size != 4 && size != 8 && size != 16 && size != 32 && size != 64) {
            throw UsageError("--size " + arguments.text("size") +
                             ": expected some of 4, 8, 16, 32, 64 and all");
        }
        sizes.push_back(static_cast<int>(size));
    }
    options.ways =
        vdbtools::sweepWays(choiceList(arguments, "method", vdbtools::methodNames()), kinds,
                            choiceList(arguments, "choice", vdbtools::kChoiceNames), sizes,
                            positiveList(arguments, "rate", "", 0));
    if (options.ways.empty()) {
        throw UsageError(
            "nothing to measure: --choice min and max need --control constant, and --method "
            "control "
            "a --size other than all");
    }
    options.depths = positiveList(arguments, "depth", "own", 0);
    options.scale = nonNegative(arguments, "scale");
    if (options.scale == 0) {
        throw UsageError("--scale 0: expected a number > 0, or there is nothing to measure");
    }
    options.color = colorOf(arguments);
    if (options.color == std::array<float, 3>{{0, 0, 0}}) {
        throw UsageError("--color 0,0,0: expected some extinction, or there is nothing to measure");
    }
    options.rounds = static_cast<uint32_t>(arguments.integer("rounds", 4, 1000000));
    options.rayCount = static_cast<size_t>(arguments.integer("ray-count", 16, 10000000));
    options.seed = arguments.get<uint64_t>("seed");
    return options;
}

void write(const trk::OutputFile& file, const std::string& text) {
    std::ofstream stream(file.path(), std::ios::binary);
    stream << text;
    stream.close();
    if (!stream) {
        throw trk::Error(TRK_ERROR_IO, file.target() + ": cannot be written (disk full?)");
    }
}

/// The super-voxels to trace paths with: those of the residual way, `robust` at rate 1, that is
/// cheapest for normal accuracy on secondary rays, in colour where that was measured, or else the
/// default.
trk::BakeOptions bakeForScattering(const vdbtools::Sweep& sweep) {
    trk::BakeOptions options;
    options.levels = 0;
    const bool coloured = std::any_of(sweep.sets.begin(), sweep.sets.end(),
                                      [](const auto& set) { return set.coloured; });
    std::vector<size_t> sets;
    for (size_t s = 0; s < sweep.sets.size(); ++s) {
        if (sweep.sets[s].coloured == coloured &&
            sweep.sets[s].rays == vdbtools::RayKind::kSecondary) {
            sets.push_back(s);
        }
    }
    for (const vdbtools::Ranked& ranked : vdbtools::rank(sweep, sets, 0.01)) {
        const vdbtools::Way& way = ranked.way;
        if (way.usesChoice() && way.choice == TRK_CHOICE_ROBUST && way.size > 0 && way.rate == 1) {
            options.superVoxelSize = way.size;
            options.kind = way.kind;
            break;
        }
    }
    return options;
}

/// What --scatter… ask for, or nothing.
std::optional<ScatterOptions> scatterOptionsOf(const Arguments& arguments) {
    if (!arguments.has("scatter")) {
        for (const char* option : {"scatter-samples", "scatter-width"}) {
            if (arguments.given(option)) {
                throw UsageError("--" + std::string(option) + ": of no use without --scatter");
            }
        }
        return std::nullopt;
    }
    ScatterOptions options;
    options.depth = static_cast<double>(arguments.get<float>("scatter"));
    if (!(options.depth > 0 && std::isfinite(options.depth))) {
        throw UsageError("--scatter: expected a mean optical depth > 0");
    }
    options.samples = static_cast<uint32_t>(arguments.integer("scatter-samples", 1, 100000));
    options.width = arguments.integer("scatter-width", 16, 4096);
    return options;
}

void addScattering(const Arguments& arguments, const std::string& input, ScatterOptions options,
                   Report& report) {
    const Progress progress(arguments, "tracing paths through " + input);
    const vdbtools::Source& source = report.source;
    const trk::BakeOptions bakeOptions = bakeForScattering(report.sweep);
    // Has no name: it goes when this ends.
    const trk::OutputFile sidecar(trk::temporaryFolder() + "/scattering.track.vdb", true);
    const trk::BakedVolume baked = trk::bake(*source.field, bakeOptions);
    trk::writeSidecar(sidecar, trk::sidecarHeader(source.summary, *source.field, baked), baked,
                      source.summary.anchor);
    options.vdb = input;
    options.sidecar = sidecar.path();
    options.grid = arguments.text("grid");
    options.repair = source.summary.repair;
    options.scale = static_cast<float>(options.depth / report.sweep.unscaledDepth);
    options.color = report.options.color;
    options.seed = report.options.seed;
    options.control = std::string(trk::controlName(bakeOptions.kind)) + " robust, size " +
                      std::to_string(bakeOptions.superVoxelSize);
    report.scattering =
        renderScattering(options, [&](double fraction) { progress.update(fraction); });
}

void run(const Command& command, const std::vector<std::string>& given) {
    po::options_description options("Options");
    options.add_options()("output,o", po::value<std::string>(),
                          "folder for index.html, measurements.csv and measurements.json")(
        "method",
        po::value<std::string>()->default_value("exact,residual,ratio,control,delta,march"),
        "methods to compare")(
        "control", po::value<std::string>()->default_value("constant,affine,trilinear"),
        "kinds of control")("choice", po::value<std::string>()->default_value("robust,mean,min"),
                            "choices of the control: robust, mean, min, max")(
        "size", po::value<std::string>()->default_value("4,8,16,32,all"),
        "sizes of super-voxels; all: one over the whole volume")(
        "rate", po::value<std::string>()->default_value("1,4"),
        "rates of residual and ratio; delta always has 1, march and comb steps of 1 and 4")(
        "depth", po::value<std::string>()->default_value("1,10,100,own"),
        "mean optical depths of camera rays to scale the volume to, before the tint; own: "
        "--scale")("scale", po::value<float>()->default_value(1.0f, "1"),
                   "the volume's own: extinction = scale x density")(
        "ray-count", po::value<int>()->default_value(1000), "camera rays that hit, about")(
        "rounds", po::value<int>()->default_value(40),
        "estimates of each ray, of which each round times one")(
        "seed", po::value<uint64_t>()->default_value(0), "of the random numbers")(
        "scatter", po::value<float>(),
        "also render the volume with two bounces, at this mean optical depth (before the tint), to "
        "compare shadow rays")("scatter-samples", po::value<int>()->default_value(64),
                               "paths a pixel of delta tracking's picture")(
        "scatter-width", po::value<int>()->default_value(128), "pixels, and the height")(
        "force", po::bool_switch(), "replace an existing report");
    options.add_options()("color", po::value<std::string>()->default_value("1,0.6,0.3"),
                          "r,g,b: the tint of the coloured sets; 1,1,1: none");
    addGridOptions(options);
    const Arguments arguments(command, given, options, {"IN.vdb"}, 1);
    if (arguments.text("output").empty()) {
        throw UsageError("missing -o REPORT");
    }
    const std::string input = arguments.text("IN.vdb");
    Report report;
    report.options = sweepOptionsOf(arguments);
    const std::optional<ScatterOptions> scatter = scatterOptionsOf(arguments);

    const auto start = std::chrono::steady_clock::now();
    {
        const Progress progress(arguments, "reading " + input);
        trk::Density density = trk::loadDensity(input, densityOptionsOf(arguments));
        report.source.summary = density.summary;
        report.source.field = std::make_shared<const trk::DensityField>(std::move(density.field));
    }
    if (report.source.field->channels() == 3 && !arguments.given("color")) {
        report.options.color = {{1, 1, 1}};  // it has its own
    }
    const std::array<float, 3>& color = report.options.color;
    report.options.grey = report.source.field->channels() == 1;
    report.options.coloured = !report.options.grey || color != std::array<float, 3>{{1, 1, 1}};
    const trk::OutputFolder folder(arguments.text("output"));
    const bool force = arguments.flag("force");
    trk::OutputFile csv(folder.file("measurements.csv"), force);
    trk::OutputFile json(folder.file("measurements.json"), force);
    trk::OutputFile html(folder.file("index.html"), force);

    report.input = std::filesystem::path(input).filename().string();
    report.command = "vdbtrack measure";
    for (const std::string& part : given) {
        report.command += " " + shellWord(part);
    }
    report.bakeHead = "vdbtrack bake " + shellWord(input);
    if (arguments.has("grid")) {
        report.bakeHead += " --grid " + shellWord(arguments.text("grid"));
    }
    for (const char* repair : {"drop-nonfinite", "clamp-negative"}) {
        report.bakeHead += arguments.flag(repair) ? std::string(" --") + repair : "";
    }
    {
        Progress progress(arguments, "measuring " + input);
        report.sweep = vdbtools::runSweep(report.source, report.options,
                                          [&](double fraction) { progress.update(fraction); });
    }
    {
        const Progress progress(arguments, "drawing what controls leave");
        const vdbtools::SweepSet& first = report.sweep.sets.front();
        // Above, nothing is left to see.
        constexpr double kMostDepth = 10;
        const double unscaledDepth = report.sweep.unscaledDepth;
        report.stripDepth = std::min(kMostDepth, static_cast<double>(first.scale) * unscaledDepth);
        report.stripScale = static_cast<float>(report.stripDepth / unscaledDepth);
        trk::BakeOptions bakeOptions;
        bakeOptions.levels = 0;
        const trk::BakedVolume baked = trk::bake(*report.source.field, bakeOptions);
        for (const bool whole : {true, false}) {
            report.strips.push_back(
                vdbtools::drawStrip(report.source, baked, whole, report.stripScale, 112, 16));
        }
    }
    report.advice = vdbtools::recommend(report.sweep);
    if (scatter) {
        addScattering(arguments, input, *scatter, report);
    }
    report.seconds =
        std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
    write(csv, csvOf(report));
    write(json, textOf(jsonOf(report), 1) + "\n");
    write(html, htmlOf(report));
    csv.commit();
    json.commit();
    html.commit();
    if (!arguments.quiet()) {
        std::cerr << adviceText(report) << html.target() << ": " << report.sweep.rows.size()
                  << " rows in " << report.sweep.sets.size() << " sets\n";
    }
}

}  // namespace

const Command kMeasureCommand{
    "measure",
    "vdbtrack measure IN.vdb -o REPORT [--grid NAME] [--method LIST] [--control LIST] [--choice "
    "LIST] [--size LIST] [--rate LIST] [--depth 1,10,100,own] [--scale 1] [--color 1,0.6,0.3] "
    "[--ray-count 1000] [--rounds 40] [--seed 0] [--scatter DEPTH [--scatter-samples 64] "
    "[--scatter-width 128]] [--force]",
    "Measures what each way of estimating costs and buys on this volume: a page with plots, tables "
    "and a recommendation, CSV and JSON.",
    run};

}  // namespace apps
