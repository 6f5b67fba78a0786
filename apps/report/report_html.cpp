// SPDX-License-Identifier: Apache-2.0
// The page of `vdbtrack measure`.
#include "names.h"
#include "page_style.h"
#include "plot.h"
#include "report.h"

#include "command_line.h"

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <functional>
#include <limits>
#include <sstream>

namespace apps {
namespace {

using vdbtools::RayKind;
using vdbtools::Sweep;
using vdbtools::SweepRow;
using vdbtools::SweepSet;
using vdbtools::Way;

std::string escaped(const std::string& text) {
    std::string result;
    for (const char c : text) {
        switch (c) {
            case '&':
                result += "&amp;";
                break;
            case '<':
                result += "&lt;";
                break;
            case '>':
                result += "&gt;";
                break;
            case '"':
                result += "&quot;";
                break;
            default:
                result += c;
        }
    }
    return result;
}

std::string format(const char* pattern, double value) {
    char text[48];
    std::snprintf(text, sizeof(text), pattern, value);
    return text;
}

/// Three digits; a dash for what is not there.
std::string digits(double value) {
    if (std::isnan(value)) {
        return "–";
    }
    if (std::isinf(value)) {
        return "∞";
    }
    return format(std::fabs(value) >= 100 && std::fabs(value) < 1e6 ? "%.0f" : "%.3g", value);
}

std::string cell(double value, const std::string& text) {
    return "<td data-v=\"" + format("%.9g", value) + "\">" + text + "</td>";
}
std::string cell(double value) {
    return cell(value, digits(value));
}

std::string nameOf(const SweepSet& set, const std::array<float, 3>& color) {
    std::string name = set.rays == RayKind::kCamera ? "Camera rays" : "Secondary rays";
    name += set.depth > 0 ? ", depth " + digits(set.depth)
                          : ", scale " + digits(static_cast<double>(set.scale));
    if (set.coloured && color == std::array<float, 3>{{1, 1, 1}}) {
        name += ", in colour";
    } else if (set.coloured) {
        name += ", colour " + digits(static_cast<double>(color[0])) + ", " +
                digits(static_cast<double>(color[1])) + ", " +
                digits(static_cast<double>(color[2]));
    }
    return name;
}

std::string captionOf(const SweepSet& set) {
    return std::to_string(set.rayCount) + " rays, mean optical depth " + digits(set.meanDepth) +
           ", mean transmittance " + digits(set.meanTransmittance);
}

struct Family {
    const char* title;
    const char* color;
    int marker;
    std::function<bool(const Way&)> holds;
};

const std::vector<Family>& families() {
    const auto residual = [](trk::ControlKind kind) {
        return [kind](const Way& w) { return w.method == TRK_METHOD_RESIDUAL && w.kind == kind; };
    };
    static const std::vector<Family> all{
        {"delta", "#444444", 2, [](const Way& w) { return w.method == TRK_METHOD_DELTA; }},
        {"ratio", "#1f77b4", 5, [](const Way& w) { return w.method == TRK_METHOD_RATIO; }},
        {"residual, constant", "#ff9f1c", 7, residual(trk::ControlKind::kConstant)},
        {"residual, affine", "#d62728", 9, residual(trk::ControlKind::kAffine)},
        {"residual, trilinear", "#9467bd", 13, residual(trk::ControlKind::kTrilinear)},
        {"control alone (biased)", "#2ca02c", 4,
         [](const Way& w) { return w.method == TRK_METHOD_CONTROL; }},
        {"march (biased)", "#8c564b", 6,
         [](const Way& w) { return w.method == TRK_METHOD_MARCH; }}};
    return all;
}

/// Below, an error is that of floats; it would stretch the axis.
constexpr double kNoError = 1e-7;

std::string plotOf(const Report& report, size_t s) {
    const Sweep& sweep = report.sweep;
    Plot plot;
    plot.name = "set" + std::to_string(s);
    plot.xLabel = "time a ray (ns)";
    plot.yLabel = "RMSE of one estimate";
    const auto pointOf = [](const SweepRow& row) {
        return PlotPoint{row.nanoseconds, row.rmse,
                         vdbtools::nameOf(row.way) + ": " + digits(row.nanoseconds) + " ns, RMSE " +
                             digits(row.rmse)};
    };
    PlotSeries front{"best unbiased", "#222222", 0, true, {}};
    for (const SweepRow* row : vdbtools::paretoFront(sweep, s)) {
        if (row->rmse > kNoError) {
            front.points.push_back(pointOf(*row));
        }
    }
    for (const SweepRow& row : sweep.rows) {
        if (row.set == s && row.way.method == TRK_METHOD_EXACT) {
            plot.verticalLine = row.nanoseconds;
            plot.lineLabel = "exact";
        }
    }
    for (const Family& family : families()) {
        PlotSeries series{family.title, family.color, family.marker, false, {}};
        for (const SweepRow& row : sweep.rows) {
            if (row.set == s && family.holds(row.way) && row.converged && row.rmse > kNoError) {
                series.points.push_back(pointOf(row));
            }
        }
        if (!series.points.empty()) {
            plot.series.push_back(std::move(series));
        }
    }
    if (plot.series.empty()) {
        return "<p>Nothing to plot: no way with an error converged here. Where transmittances are "
               "not "
               "all next to 0 or 1, more rounds or rays help.</p>";
    }
    if (!front.points.empty()) {
        const PlotPoint& p = front.points.front();
        plot.tradeConstant = p.x * p.y * p.y;
        plot.series.push_back(std::move(front));
    }
    return drawSvg(plot);
}

/// The best `most` rows of a set.
void addTable(std::ostream& out, const Report& report, size_t s, size_t most) {
    const Sweep& sweep = report.sweep;
    std::vector<const SweepRow*> rows;
    for (const SweepRow& row : sweep.rows) {
        if (row.set == s) {
            rows.push_back(&row);
        }
    }
    constexpr double kNormal = 0.01;
    const auto ranks = [](const SweepRow* r) { return r->converged && r->way.isUnbiased(); };
    std::stable_sort(rows.begin(), rows.end(), [&](const SweepRow* a, const SweepRow* b) {
        return ranks(a) != ranks(b) ? ranks(a) : a->score(kNormal) < b->score(kNormal);
    });
    const std::vector<const SweepRow*> front = vdbtools::paretoFront(sweep, s);
    const SweepRow* delta = vdbtools::baseline(sweep, s, TRK_METHOD_DELTA);
    const SweepRow* ratio = vdbtools::baseline(sweep, s, TRK_METHOD_RATIO);
    rows.resize(std::min(rows.size(), most));
    out << "<div class=\"scroll\"><table class=\"sort\"><thead><tr><th>way</th><th>time, ns</th>"
           "<th>±</th><th>look-ups</th><th>super-voxels</th><th>exact</th><th>variance</th>"
           "<th>RMSE</th><th>bias, z</th><th>rough</th><th>normal</th><th>tight</th>"
           "<th>of delta</th><th></th></tr></thead><tbody>\n";
    for (const SweepRow* row : rows) {
        const bool onFront = std::find(front.begin(), front.end(), row) != front.end();
        out << "<tr class=\""
            << (onFront      ? "front"
                : ranks(row) ? ""
                             : "off")
            << "\"><td>" << vdbtools::nameOf(row->way) << "</td>" << cell(row->nanoseconds)
            << cell(row->spread,
                    std::isnan(row->spread) ? "–" : format("%.0f %%", 50 * row->spread))
            << cell(row->lookups) << cell(row->superVoxels)
            << cell(row->exactShare, format("%.0f %%", 100 * row->exactShare))
            << cell(row->variance) << cell(row->rmse)
            << cell(row->z, std::isnan(row->z) ? "–" : format("%.2f", row->z));
        for (const vdbtools::Accuracy& a : vdbtools::kAccuracies) {
            const double cost = ratio ? row->score(a.elsewhere) / ratio->score(a.elsewhere) : NAN;
            out << (ranks(row) ? cell(cost) : cell(NAN, ""));
        }
        const double cost = delta ? row->score(kNormal) / delta->score(kNormal) : NAN;
        out << (ranks(row) ? cell(cost) : cell(NAN, "")) << "<td>"
            << (!row->converged          ? "not converged"
                : !row->way.isUnbiased() ? "biased"
                : onFront                ? "front"
                                         : "")
            << "</td></tr>\n";
    }
    out << "</tbody></table></div>\n";
}

Image falseColored(const std::vector<float>& values, int width,
                   const std::function<float(float)>& map) {
    Image image(width, width);
    std::vector<float>* channels[3] = {&image.add("R"), &image.add("G"), &image.add("B")};
    for (size_t i = 0; i < values.size(); ++i) {
        const auto color = falseColor(map(values[i]));
        for (size_t c = 0; c < 3; ++c) {
            (*channels[c])[i] = color[c];
        }
    }
    return image;
}

std::string imageTag(const Image& image, Tone tone, const std::string& alternative) {
    return "<img alt=\"" + escaped(alternative) + "\" src=\"" + pngUri(image, tone) + "\">";
}

/// A legend: the colours from 0 to 1 under their texts.
std::string scaleBar(const std::vector<std::string>& texts) {
    Image bar(128, 1);
    std::vector<float>* channels[3] = {&bar.add("R"), &bar.add("G"), &bar.add("B")};
    for (size_t i = 0; i < 128; ++i) {
        const auto color = falseColor(static_cast<float>(i) / 127);
        for (size_t c = 0; c < 3; ++c) {
            (*channels[c])[i] = color[c];
        }
    }
    std::string html = "<div class=\"bar\" style=\"background:url(" + pngUri(bar, Tone::kLinear) +
                       ") 0/100% 100%\"></div><div class=\"scale\">";
    for (const std::string& text : texts) {
        html += "<span>" + text + "</span>";
    }
    return html + "</div>";
}

void addStrips(std::ostream& out, const Report& report) {
    out << "<h2 id=\"strips\">What each choice of the control leaves to chance</h2>\n"
           "<p>The volume seen from a corner, grey, at a mean optical depth of "
        << digits(report.stripDepth)
        << ". An estimate is the product of the <i>control's</i> transmittance, which is known, "
           "and the <i>residual's</i>, which is estimated; here 16 estimates a pixel, without "
           "roulette and exact integration, which would hide the noise. Where the control is above "
           "the extinction, the residual's "
           "transmittance exceeds 1 and the noise grows. Green: not a number to show.</p>\n";
    const auto unit = [](float x) { return x; };
    const auto octaves = [](float x) { return x > 0 ? 0.5f + std::log2(x) / 6 : 0.0f; };
    const auto decades = [](float x) { return x > 0 ? 1 + std::log10(x) / 6 : 0.0f; };
    for (const vdbtools::Strip& strip : report.strips) {
        out << "<h3>"
            << (strip.whole ? "One control for the whole volume"
                            : "A constant control per super-voxel of " +
                                  std::to_string(strip.size) + " voxels")
            << "</h3>\n<div class=\"scroll\"><table class=\"strip\"><tr><th></th><th>control</th>"
               "<th>residual</th><th>product</th><th>variance</th></tr>\n";
        for (const vdbtools::StripRow& row : strip.rows) {
            const std::string& name = vdbtools::kChoiceNames[static_cast<size_t>(row.choice)];
            const auto picture = [&](const std::vector<float>& values,
                                     const std::function<float(float)>& map, const char* what) {
                out << "<td>"
                    << imageTag(falseColored(values, strip.width, map), Tone::kLinear,
                                name + ", " + what)
                    << "</td>";
            };
            double mean = 0;
            for (const float v : row.variance) {
                mean += static_cast<double>(v) / static_cast<double>(row.variance.size());
            }
            out << "<tr><td>" << name << "<br><span class=\"n\">" << digits(mean) << "</span></td>";
            picture(row.control, unit, "control");
            picture(row.residual, octaves, "residual");
            picture(row.product, unit, "product");
            picture(row.variance, decades, "variance");
            out << "</tr>\n";
        }
        out << "<tr><td></td><td>" << scaleBar({"0", "1"}) << "</td><td>"
            << scaleBar({"1/8", "1", "8"}) << "</td><td>" << scaleBar({"0", "1"}) << "</td><td>"
            << scaleBar({"1e-6", "1e-3", "1"})
            << "</td></tr></table></div>\n<p class=\"lead\">Under the names: the mean variance of "
               "one estimate, as far as 16 samples a pixel show it.</p>\n";
    }
}

void addBakes(std::ostream& out, const Report& report) {
    out << "<h2 id=\"bakes\">What a bake costs</h2>\n<table class=\"sort\"><thead><tr>"
           "<th>control</th><th>size</th><th>super-voxels</th><th>bake, ms</th><th>sidecar, "
           "kB</th><th>residual left, % of the density's RMS</th></tr></thead><tbody>\n";
    for (const vdbtools::SweepBake& b : report.sweep.bakes) {
        out << "<tr><td>" << trk::controlName(b.kind) << "</td>" << cell(b.size)
            << cell(static_cast<double>(b.superVoxels), std::to_string(b.superVoxels))
            << cell(1000 * b.seconds) << cell(static_cast<double>(b.sidecarBytes) / 1000)
            << cell(100 * b.residualShare) << "</tr>\n";
    }
    out << "</tbody></table>\n<p class=\"lead\">All threads; without reading the density and "
           "writing the sidecar, which has 4 preview levels.</p>\n";
}

void addScattering(std::ostream& out, const Scattering& scattering) {
    const ScatterOptions& o = scattering.options;
    out << "<h2 id=\"scattering\">Dual scattering</h2>\n<p>A path tracer on the C API: at most two "
           "bounces, a sun and a sky, albedo 0.98, Henyey-Greenstein with g = 0.4; colour "
        << digits(static_cast<double>(o.color[0])) << ", "
        << digits(static_cast<double>(o.color[1])) << ", "
        << digits(static_cast<double>(o.color[2])) << ", mean optical depth without it "
        << digits(o.depth) << "; super-voxels: " << o.control
        << ". Only the shadow rays differ; free paths and directions are the same. Delta tracking "
           "has "
        << o.samples
        << " paths a pixel; the others have as many as cost the same in look-ups of all rays, or "
           "in "
           "time. RMSE over the pixels that show the volume, against a picture of "
        << scattering.referenceSamples
        << " paths a pixel; in brackets what of it comes from the shadow rays: the RMSE against "
           "the "
           "same paths with exact ones.</p>\n<div class=\"scroll\"><table><thead><tr><th>shadow "
           "rays</th><th>look-ups a path</th><th>in shadow rays</th><th>ns a path</th><th>±</th>"
           "<th>same paths</th><th colspan=\"2\">equal look-ups: paths, RMSE</th><th "
           "colspan=\"2\">equal time: paths, RMSE</th></tr></thead><tbody>\n";
    const auto errors = [](const ScatterPicture& p) {
        return cell(p.rmse, digits(p.rmse) + " (" + digits(p.shadowRmse) + ")");
    };
    for (const ScatterMethod& m : scattering.methods) {
        out << "<tr><td>" << trk::traitsOf(m.method).name << "</td>" << cell(m.lookups)
            << cell(m.shadowLookups) << cell(m.nanoseconds)
            << cell(m.spread, format("%.0f %%", 50 * m.spread)) << errors(m.sameSamples)
            << cell(m.equalLookups.samples) << errors(m.equalLookups) << cell(m.equalTime.samples)
            << errors(m.equalTime) << "</tr>\n";
    }
    out << "</tbody></table></div>\n";
    const auto pictures = [&](const char* title, ScatterPicture ScatterMethod::*which) {
        out << "<h3>" << title << "</h3>\n<div class=\"pictures\">\n";
        for (const ScatterMethod& m : scattering.methods) {
            const ScatterPicture& p = m.*which;
            const std::string name = trk::traitsOf(m.method).name;
            out << "<figure>" << imageTag(p.image, Tone::kRolledOff, name) << "<figcaption>" << name
                << ", " << p.samples << " paths: RMSE " << digits(p.rmse)
                << "</figcaption></figure>\n";
        }
        out << "<figure>" << imageTag(scattering.reference, Tone::kRolledOff, "converged")
            << "<figcaption>converged, " << scattering.referenceSamples
            << " paths</figcaption></figure>\n</div>\n";
    };
    pictures("Equal look-ups", &ScatterMethod::equalLookups);
    pictures("Equal time", &ScatterMethod::equalTime);
}

void addAdvice(std::ostream& out, const Report& report) {
    out << "<h2 id=\"recommendation\">Recommendation</h2>\n";
    if (report.advice.empty()) {
        out << "<p>" << reasonForNoAdvice(report) << "</p>\n";
    }
    for (const vdbtools::Advice& a : report.advice) {
        std::string title = a.accuracy.name;
        title[0] = static_cast<char>(std::toupper(title[0]));
        out << "<div class=\"advice\"><h3>" << title
            << " accuracy: " << escaped(vdbtools::nameOf(a.choice.way))
            << "</h3>\n<p>For a renderer with a variance of " << digits(a.accuracy.elsewhere)
            << " from elsewhere. "
            << (a.bake.empty()
                    ? "No sidecar is needed; "
                    : "<code>" + escaped(report.bakeHead + " " + a.bake) + "</code>, then ")
            << "<code>" << a.query << "</code>.</p>\n<ul>";
        for (const std::string& sentence : a.why) {
            out << "<li>" << escaped(sentence) << "</li>\n";
        }
        out << "</ul></div>\n";
    }
}

}  // namespace

std::string htmlOf(const Report& report) {
    const Sweep& sweep = report.sweep;
    double largest = 0;
    size_t tested = 0;
    size_t unconverged = 0;
    for (const SweepRow& row : sweep.rows) {
        if (row.way.isUnbiased() && !std::isnan(row.z)) {
            largest = std::max(largest, std::fabs(row.z));
            ++tested;
        }
        unconverged += row.converged ? 0 : 1;
    }
    const trk::DensitySummary& summary = report.source.summary;
    const trk::IntBox& box = report.source.field->box();
    std::ostringstream out;
    out << "<!DOCTYPE html>\n<html lang=\"en\"><head><meta charset=\"utf-8\"><title>"
        << escaped(report.input)
        << ": transmittance, measured</title>\n<meta name=\"viewport\" "
           "content=\"width=device-width\"><style>"
        << kStyle << "</style></head><body>\n<h1>" << escaped(report.input)
        << ": what accuracy costs</h1>\n<p class=\"lead\">Grid "
        << escaped(summary.grid.name.empty() ? "(unnamed)" : summary.grid.name) << ", "
        << summary.activeVoxels << " active voxels in a box of " << box.hi[0] - box.lo[0] << " × "
        << box.hi[1] - box.lo[1] << " × " << box.hi[2] - box.lo[2] << ". vdbtrack " TRACK_VERSION
        << ", " << sweep.rows.size() << " rows in " << format("%.0f", report.seconds)
        << " s: <code>" << escaped(report.command) << "</code></p>\n";
    if (!report.advice.empty()) {
        out << "<p><b>In short:</b> ";
        const char* separator = "";
        for (const vdbtools::Advice& a : report.advice) {
            out << separator << "for " << a.accuracy.name << " accuracy "
                << escaped(vdbtools::nameOf(a.choice.way));
            separator = "; ";
        }
        out << ". <a href=\"#recommendation\">Why</a>.</p>\n";
    }
    if (tested > 0) {
        out << "<p>Every unbiased way that converged was checked against the exact value: "
            << tested << " rows, largest |z| " << format("%.2f", largest) << ", of which "
            << (largest < sweep.zBound ? "none" : "one or more") << " exceeds "
            << format("%.2f", sweep.zBound)
            << ", the bound for all of them together (Šidák, 1 %).</p>\n";
    }
    if (unconverged > 0) {
        out << "<p>" << unconverged
            << " rows are marked <i>not converged</i>: a single estimate carries more than 5 % of "
               "the sum, or the formula knows of variance that the sample does not show. They rank "
               "nowhere, and nothing is said of their bias.</p>\n";
    }

    out << "<h2 id=\"trade\">Time against error</h2>\n<p>One point a way: control, choice, size "
           "and "
           "rate are under the mouse. Left and low is good. Averaging samples moves a point along "
           "a "
           "pale line; the black steps are the ways that no other unbiased one beats in both. The "
           "dotted line is the exact method, without error. Time: median of "
        << report.options.rounds
        << " rounds over all rays, one pinned thread, ways interleaved.</p>\n";
    const auto plots = [&](bool coloured) {
        out << "<div class=\"plots\">\n";
        for (size_t s = 0; s < sweep.sets.size(); ++s) {
            if (sweep.sets[s].coloured == coloured) {
                out << "<figure><figcaption><b>" << nameOf(sweep.sets[s], report.options.color)
                    << "</b> · " << captionOf(sweep.sets[s]) << "</figcaption>" << plotOf(report, s)
                    << "</figure>\n";
            }
        }
        out << "</div>\n";
    };
    const bool hasGrey = std::any_of(sweep.sets.begin(), sweep.sets.end(),
                                     [](const SweepSet& s) { return !s.coloured; });
    const bool hasColour = std::any_of(sweep.sets.begin(), sweep.sets.end(),
                                       [](const SweepSet& s) { return s.coloured; });
    if (hasGrey) {
        plots(false);
    }
    if (hasColour) {
        out << "<details" << (hasGrey ? "" : " open") << "><summary>In colour</summary>\n";
        plots(true);
        out << "</details>\n";
    }
    if (!report.strips.empty()) {
        addStrips(out, report);
    }
    out << "<h2 id=\"tables\">Measurements</h2>\n<p>Per ray and estimate. <i>±</i>: half of the "
           "spread of the middle half of the times. <i>Exact</i>: the share of the length that was "
           "integrated exactly. <i>Rough, normal, tight</i>: cost over that of ratio tracking at "
           "the size nearest to 16, rate 1, where cost is (V0 + variance) × time and V0, the "
           "variance a renderer has from elsewhere, 0.1, 0.01 and 0.001; <i>of delta</i>: the "
           "normal one over delta "
           "tracking's. Below 1 is better. Bold: nothing unbiased is both faster and as good. A "
           "click "
           "on a heading sorts. The same numbers are in <code>measurements.csv</code> and "
           "<code>measurements.json</code>.</p>\n";
    for (size_t s = 0; s < sweep.sets.size(); ++s) {
        out << "<details" << (s < 2 ? " open" : "") << "><summary><b>"
            << nameOf(sweep.sets[s], report.options.color) << "</b> · " << captionOf(sweep.sets[s])
            << "</summary>\n";
        constexpr size_t kFirst = 10;
        addTable(out, report, s, kFirst);
        if (report.options.ways.size() > kFirst) {
            out << "<details><summary>All " << report.options.ways.size() << " ways</summary>\n";
            addTable(out, report, s, report.options.ways.size());
            out << "</details>\n";
        }
        out << "</details>\n";
    }
    addBakes(out, report);
    if (report.scattering) {
        addScattering(out, *report.scattering);
    }
    addAdvice(out, report);
    out << "<script>" << kScript << "</script></body></html>\n";
    return out.str();
}

}  // namespace apps
