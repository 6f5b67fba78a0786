// SPDX-License-Identifier: Apache-2.0
// measurements.csv and measurements.json.
#include "report.h"

#include "names.h"

#include <nlohmann/json.hpp>

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <sstream>

namespace apps {
namespace {

using nlohmann::ordered_json;
using vdbtools::SweepRow;
using vdbtools::SweepSet;
using vdbtools::Way;

/// NaN where the row does not rank, lest a script rank it.
double scoreOf(const SweepRow& row, const vdbtools::Accuracy& accuracy) {
    return row.converged ? row.score(accuracy.elsewhere) : std::nan("");
}

/// Not finite is null: in JSON there is no other way, and a CSV's field is then empty.
ordered_json number(double value) {
    return std::isfinite(value) ? ordered_json(value) : ordered_json(nullptr);
}

/// Named numbers and texts of a row, in the order of the CSV's columns: one list for both files.
ordered_json fieldsOf(const Report& report, const SweepRow& row) {
    const SweepSet& set = report.sweep.sets[row.set];
    const Way& way = row.way;
    ordered_json fields;
    fields["rays"] = set.rays == vdbtools::RayKind::kCamera ? "camera" : "secondary";
    fields["coloured"] = set.coloured;
    fields["depth"] = set.depth > 0 ? ordered_json(set.depth) : ordered_json("own");
    fields["method"] = way.traits().name;
    fields["control"] = way.usesControl() ? ordered_json(trk::controlName(way.kind)) : nullptr;
    fields["choice"] = way.usesChoice()
                           ? ordered_json(vdbtools::kChoiceNames[static_cast<size_t>(way.choice)])
                           : nullptr;
    fields["size"] = !way.usesSuperVoxels()          ? ordered_json(nullptr)
                     : way.size == Way::kWholeVolume ? ordered_json("all")
                                                     : ordered_json(way.size);
    fields["rate"] = way.traits().usesRate ? ordered_json(way.rate) : ordered_json(nullptr);
    fields["step"] = way.traits().usesSteps() ? ordered_json(way.rate) : ordered_json(nullptr);
    fields["time_ns"] = number(row.nanoseconds);
    fields["time_spread"] = number(row.spread);
    fields["lookups"] = number(row.lookups);
    fields["super_voxels"] = number(row.superVoxels);
    fields["exact_share"] = number(row.exactShare);
    fields["variance"] = number(row.variance);
    fields["variance_formula"] = number(row.predictedVariance);
    fields["bias"] = number(row.bias);
    fields["rmse"] = number(row.rmse);
    fields["z"] = number(row.z);
    fields["converged"] = row.converged;
    for (const vdbtools::Accuracy& accuracy : vdbtools::kAccuracies) {
        fields["score_" + std::string(accuracy.name)] = number(scoreOf(row, accuracy));
    }
    for (const auto& [method, name] : {std::make_pair(TrkMethod{TRK_METHOD_DELTA}, "delta"),
                                       std::make_pair(TrkMethod{TRK_METHOD_RATIO}, "ratio")}) {
        const SweepRow* base = vdbtools::baseline(report.sweep, row.set, method);
        for (const vdbtools::Accuracy& accuracy : vdbtools::kAccuracies) {
            fields[std::string("cost_over_") + name + "_" + accuracy.name] =
                base ? number(scoreOf(row, accuracy) / base->score(accuracy.elsewhere))
                     : ordered_json(nullptr);
        }
    }
    return fields;
}

std::string csvField(const ordered_json& value) {
    if (value.is_null()) {
        return "";
    }
    if (value.is_string()) {
        return value.get<std::string>();
    }
    if (value.is_number_float()) {
        char text[32];
        std::snprintf(text, sizeof(text), "%.6g", value.get<double>());
        return text;
    }
    return value.dump();
}

ordered_json scatteringJson(const Scattering& scattering) {
    ordered_json json;
    json["width"] = scattering.options.width;
    json["depth"] = scattering.options.depth;
    json["control"] = scattering.options.control;
    json["scale"] = scattering.options.scale;
    json["color"] = scattering.options.color;
    json["delta_samples"] = scattering.options.samples;
    json["reference_samples"] = scattering.referenceSamples;
    for (const ScatterMethod& m : scattering.methods) {
        ordered_json method;
        method["shadow_rays"] = trk::traitsOf(m.method).name;
        method["lookups"] = m.lookups;
        method["shadow_lookups"] = m.shadowLookups;
        method["time_ns"] = m.nanoseconds;
        method["time_spread"] = m.spread;
        for (const auto& [name, picture] : {std::make_pair("same_samples", &m.sameSamples),
                                            std::make_pair("equal_lookups", &m.equalLookups),
                                            std::make_pair("equal_time", &m.equalTime)}) {
            method[name] = {{"samples", picture->samples},
                            {"rmse", picture->rmse},
                            {"shadow_rmse", picture->shadowRmse}};
        }
        json["methods"].push_back(method);
    }
    return json;
}

ordered_json stripJson(const vdbtools::Strip& strip) {
    ordered_json json;
    json["size"] = strip.whole ? ordered_json("all") : ordered_json(strip.size);
    for (const vdbtools::StripRow& row : strip.rows) {
        double mean = 0;
        for (const float v : row.variance) {
            mean += static_cast<double>(v) / static_cast<double>(row.variance.size());
        }
        json["rows"].push_back({{"choice", vdbtools::kChoiceNames[static_cast<size_t>(row.choice)]},
                                {"variance", number(mean)}});
    }
    return json;
}

ordered_json setJson(const Report& report, size_t s) {
    const SweepSet& set = report.sweep.sets[s];
    ordered_json json;
    json["rays"] = set.rays == vdbtools::RayKind::kCamera ? "camera" : "secondary";
    json["coloured"] = set.coloured;
    json["depth"] = set.depth > 0 ? ordered_json(set.depth) : ordered_json("own");
    json["scale"] = set.scale;
    json["ray_count"] = set.rayCount;
    json["mean_depth"] = set.meanDepth;
    json["mean_transmittance"] = set.meanTransmittance;
    json["rows"] = ordered_json::array();
    const std::vector<const SweepRow*> front = vdbtools::paretoFront(report.sweep, s);
    for (const SweepRow& row : report.sweep.rows) {
        if (row.set == s) {
            ordered_json fields = fieldsOf(report, row);
            for (const char* key : {"rays", "coloured", "depth"}) {
                fields.erase(key);  // the set's
            }
            fields["way"] = vdbtools::nameOf(row.way);
            fields["unbiased"] = row.way.isUnbiased();
            fields["front"] = std::find(front.begin(), front.end(), &row) != front.end();
            json["rows"].push_back(fields);
        }
    }
    return json;
}

/// Why there is no advice.
std::string reasonForNoAdvice(const Report& report) {
    const std::vector<Way>& ways = report.options.ways;
    return std::any_of(ways.begin(), ways.end(), [](const Way& w) { return w.isUnbiased(); })
               ? "No way converged on all sets of rays: measure fewer depths, or more rounds or "
                 "rays."
               : "There is nothing to recommend: every method that was measured is biased.";
}

}  // namespace

std::string csvOf(const Report& report) {
    std::ostringstream out;
    bool first = true;
    for (const SweepRow& row : report.sweep.rows) {
        const ordered_json fields = fieldsOf(report, row);
        if (first) {
            const char* separator = "";
            for (const auto& [name, value] : fields.items()) {
                out << separator << name;
                separator = ",";
            }
            out << '\n';
            first = false;
        }
        const char* separator = "";
        for (const auto& [name, value] : fields.items()) {
            out << separator << csvField(value);
            separator = ",";
        }
        out << '\n';
    }
    return out.str();
}

ordered_json jsonOf(const Report& report) {
    ordered_json json;
    json["tool_version"] = TRACK_VERSION;
    json["input"] = report.input;
    json["grid"] = report.source.summary.grid.name;
    json["command"] = report.command;
    json["bake_command"] = report.bakeHead;
    json["active_voxels"] = report.source.summary.activeVoxels;
    json["box"] = ordered_json::array();
    const trk::IntBox& box = report.source.field->box();
    for (size_t axis = 0; axis < 3; ++axis) {
        json["box"].push_back(box.hi[axis] - box.lo[axis]);
    }
    json["seconds"] = report.seconds;
    json["rounds"] = report.options.rounds;
    json["seed"] = report.options.seed;
    json["color"] = report.options.color;
    json["z_bound"] = report.sweep.zBound;
    json["sets"] = ordered_json::array();
    for (size_t s = 0; s < report.sweep.sets.size(); ++s) {
        json["sets"].push_back(setJson(report, s));
    }
    json["bakes"] = ordered_json::array();
    for (const vdbtools::SweepBake& bake : report.sweep.bakes) {
        json["bakes"].push_back({{"size", bake.size},
                                 {"control", trk::controlName(bake.kind)},
                                 {"seconds", bake.seconds},
                                 {"super_voxels", bake.superVoxels},
                                 {"sidecar_bytes", bake.sidecarBytes},
                                 {"residual_share", number(bake.residualShare)}});
    }
    json["recommendation"] = ordered_json::array();
    for (const vdbtools::Advice& advice : report.advice) {
        json["recommendation"].push_back({{"accuracy", advice.accuracy.name},
                                          {"way", vdbtools::nameOf(advice.choice.way)},
                                          {"variance_elsewhere", advice.accuracy.elsewhere},
                                          {"bake", advice.bake},
                                          {"query", advice.query},
                                          {"cost_over_best", advice.choice.cost},
                                          {"why", advice.why}});
    }
    if (report.advice.empty()) {
        json["no_recommendation"] = reasonForNoAdvice(report);
    }
    json["strip_depth"] = report.stripDepth;
    json["strips"] = ordered_json::array();
    for (const vdbtools::Strip& strip : report.strips) {
        json["strips"].push_back(stripJson(strip));
    }
    if (report.scattering) {
        json["dual_scattering"] = scatteringJson(*report.scattering);
    }
    return json;
}

std::string textOf(const ordered_json& json, int indent) {
    // Names of files may be any bytes.
    return json.dump(indent, ' ', false, ordered_json::error_handler_t::replace);
}

std::string adviceText(const Report& report) {
    std::ostringstream out;
    if (report.advice.empty()) {
        out << reasonForNoAdvice(report) << "\n";
    }
    for (const vdbtools::Advice& advice : report.advice) {
        out << advice.accuracy.name << " accuracy: ";
        if (advice.bake.empty()) {
            out << "no bake; ";
        } else {
            out << report.bakeHead << " " << advice.bake << ", then ";
        }
        out << advice.query << "\n";
    }
    return out.str();
}

}  // namespace apps
