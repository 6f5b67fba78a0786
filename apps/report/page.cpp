// SPDX-License-Identifier: Apache-2.0
// The page of `vdbtrack measure`: the report's JSON with pictures, in the text of apps/report/page,
// whose script draws it.
#include "names.h"
#include "page_text.h"
#include "report.h"

#include <cmath>
#include <functional>

namespace apps {
namespace {

using nlohmann::ordered_json;

std::string falseColored(const std::vector<float>& values, int width, int height,
                         const std::function<float(float)>& map) {
    Image image(width, height);
    std::vector<float>* channels[3] = {&image.add("R"), &image.add("G"), &image.add("B")};
    for (size_t i = 0; i < values.size(); ++i) {
        const auto color = falseColor(map(values[i]));
        for (size_t c = 0; c < 3; ++c) {
            (*channels[c])[i] = color[c];
        }
    }
    return pngUri(image, Tone::kLinear);
}

float unit(float x) {
    return x;
}
/// 0 at 1/8, 1 at 8.
float octaves(float x) {
    return x > 0 ? 0.5f + std::log2(x) / 6 : 0.0f;
}
/// 0 at 1e-6, 1 at 1.
float decades(float x) {
    return x > 0 ? 1 + std::log10(x) / 6 : 0.0f;
}

ordered_json picturesOf(const vdbtools::StripRow& row, int width) {
    ordered_json pictures;
    pictures["control"] = falseColored(row.control, width, width, unit);
    pictures["residual"] = falseColored(row.residual, width, width, octaves);
    pictures["product"] = falseColored(row.product, width, width, unit);
    pictures["variance"] = falseColored(row.variance, width, width, decades);
    return pictures;
}

/// Adds to the report's JSON what only the page shows.
void addPictures(const Report& report, ordered_json& json) {
    std::vector<float> ramp(128);
    for (size_t i = 0; i < ramp.size(); ++i) {
        ramp[i] = static_cast<float>(i) / static_cast<float>(ramp.size() - 1);
    }
    json["scale_bar"] = falseColored(ramp, static_cast<int>(ramp.size()), 1, unit);
    for (size_t s = 0; s < report.strips.size(); ++s) {
        const vdbtools::Strip& strip = report.strips[s];
        for (size_t r = 0; r < strip.rows.size(); ++r) {
            json["strips"][s]["rows"][r]["pictures"] = picturesOf(strip.rows[r], strip.width);
        }
    }
    if (report.scattering) {
        ordered_json& scene = json["dual_scattering"];
        scene["reference_picture"] = pngUri(report.scattering->reference, Tone::kRolledOff);
        for (size_t m = 0; m < report.scattering->methods.size(); ++m) {
            const ScatterMethod& method = report.scattering->methods[m];
            for (const auto& [name, picture] :
                 {std::make_pair("equal_lookups", &method.equalLookups),
                  std::make_pair("equal_time", &method.equalTime)}) {
                scene["methods"][m][name]["picture"] = pngUri(picture->image, Tone::kRolledOff);
            }
        }
    }
}

}  // namespace

std::string htmlOf(const Report& report) {
    ordered_json json = jsonOf(report);
    addPictures(report, json);
    std::string page = kPageHead;
    for (const char c : textOf(json, -1)) {
        if (c == '<') {
            page += "\\u003c";  // nothing in a string may end the element
        } else {
            page += c;
        }
    }
    return page + kPageTail;
}

}  // namespace apps
