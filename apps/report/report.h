// SPDX-License-Identifier: Apache-2.0
// What `vdbtrack measure` writes: measurements.csv, measurements.json and a page to read. The keys
// are described in libtrack/docs/measure.md.
#pragma once

#include "measure/recommendation.h"
#include "measure/strips.h"
#include "measure/sweep.h"
#include "path_tracer.h"

#include <nlohmann/json.hpp>

#include <optional>
#include <string>
#include <vector>

namespace apps {

struct Report {
    std::string input;     ///< base name
    std::string command;   ///< that makes it again
    std::string bakeHead;  ///< the command that bakes what was measured, before its bake options
    vdbtools::Source source;
    vdbtools::SweepOptions options;
    vdbtools::Sweep sweep;
    std::vector<vdbtools::Strip> strips;
    float stripScale = 1;
    double stripDepth = 0;
    std::vector<vdbtools::Advice> advice;
    std::optional<Scattering> scattering;
    double seconds = 0;  ///< the whole run
};

/// One line a measured row.
std::string csvOf(const Report& report);
nlohmann::ordered_json jsonOf(const Report& report);
/// UTF-8, indented by so many spaces; -1: on one line.
std::string textOf(const nlohmann::ordered_json& json, int indent);
/// A page without any other file: it holds the JSON, pictures, and a script that draws them.
std::string htmlOf(const Report& report);

/// The advice for a terminal, or why there is none.
std::string adviceText(const Report& report);

}  // namespace apps
