// SPDX-License-Identifier: Apache-2.0
#include "way.h"

#include "names.h"

#include <algorithm>
#include <cstdio>
#include <tuple>

namespace vdbtools {

using trk::ControlKind;

bool operator==(const Way& a, const Way& b) {
    return std::tie(a.method, a.kind, a.choice, a.size, a.rate) ==
           std::tie(b.method, b.kind, b.choice, b.size, b.rate);
}

std::string nameOf(const Way& way) {
    std::string name = way.traits().name;
    if (way.usesControl()) {
        name += std::string(", ") + trk::controlName(way.kind);
    }
    if (way.usesChoice()) {
        name += " " + kChoiceNames[static_cast<size_t>(way.choice)];
    }
    if (way.usesSuperVoxels()) {
        name +=
            way.size == Way::kWholeVolume ? ", whole volume" : ", size " + std::to_string(way.size);
    }
    char number[40] = "";
    if (way.traits().usesSteps()) {
        std::snprintf(number, sizeof(number), ", step %g", way.rate);
    } else if (way.isRandom()) {
        std::snprintf(number, sizeof(number), ", rate %g", way.rate);
    }
    return name + number;
}

std::vector<Way> sweepWays(const std::vector<TrkMethod>& methods,
                           const std::vector<ControlKind>& kinds,
                           const std::vector<TrkChoice>& choices, const std::vector<int>& sizes,
                           const std::vector<double>& rates) {
    const std::vector<double> steps{1, 4};
    std::vector<Way> ways;
    const auto add = [&](const Way& way) {
        if (std::find(ways.begin(), ways.end(), way) == ways.end()) {
            ways.push_back(way);
        }
    };
    for (const TrkMethod method : methods) {
        Way way;
        way.method = method;
        if (!way.usesSuperVoxels()) {
            for (const double step : steps) {
                way.rate = way.traits().usesSteps() ? step : 1;
                add(way);
            }
            continue;
        }
        for (const int size : sizes) {
            way.size = size;
            const bool whole = size == Way::kWholeVolume;
            for (const ControlKind kind : kinds) {
                // What is made of the whole volume is constant; ratio and delta have no control.
                const bool constant = whole || !way.usesControl();
                way.kind = constant ? ControlKind::kConstant : kind;
                if (!way.isRandom()) {
                    if (!whole) {
                        add(way);
                    }
                    continue;
                }
                for (const TrkChoice choice : choices) {
                    const bool constantOnly = choice == TRK_CHOICE_MIN || choice == TRK_CHOICE_MAX;
                    if (constantOnly && way.kind != ControlKind::kConstant) {
                        continue;
                    }
                    way.choice = way.usesControl() ? choice : TrkChoice{TRK_CHOICE_ROBUST};
                    for (const double rate : way.traits().usesSteps() ? steps : rates) {
                        // A looser majorant only costs delta tracking time.
                        way.rate = way.traits().usesRoulette ? rate : 1;
                        add(way);
                    }
                }
            }
        }
    }
    return ways;
}

}  // namespace vdbtools
