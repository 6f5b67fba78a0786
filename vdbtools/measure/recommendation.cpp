// SPDX-License-Identifier: Apache-2.0
#include "recommendation.h"

#include "names.h"

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <limits>
#include <map>
#include <numeric>
#include <tuple>

namespace vdbtools {
namespace {

/// Less is simpler: no bake, a smaller sidecar, defaults (which `--global` is not).
auto complexity(const Way& way) {
    const bool control = way.usesChoice();
    const int kind = !control                                  ? 0
                     : way.kind == trk::ControlKind::kConstant ? 0
                     : way.kind == trk::ControlKind::kAffine   ? 1
                                                               : 2;
    return std::make_tuple(way.usesSuperVoxels() ? 1 : 0, kind, -way.size, way.rate == 1 ? 0 : 1,
                           way.choice == TRK_CHOICE_ROBUST ? 0 : 1, way.method);
}

/// "1.23", with three digits.
std::string digits(double value) {
    char text[32];
    std::snprintf(text, sizeof(text), value >= 100 ? "%.0f" : "%.3g", value);
    return text;
}

std::string microseconds(double nanoseconds) {
    return digits(nanoseconds / 1000) + " µs";
}

std::string depthName(const SweepSet& set) {
    return set.depth > 0 ? "a mean depth of " + digits(set.depth)
                         : "the volume's own scale (" + digits(set.scale) + ")";
}

/// Geometric mean over sets of a way's score over the baseline's; NaN where there is none.
double costOver(const Sweep& sweep, const std::vector<size_t>& sets, const Way& way,
                TrkMethod method, double elsewhere) {
    double sum = 0;
    for (const size_t set : sets) {
        const SweepRow* base = baseline(sweep, set, method);
        const SweepRow* row = findRow(sweep, set, way);
        if (!base || !row) {
            return std::numeric_limits<double>::quiet_NaN();
        }
        sum += std::log(row->score(elsewhere) / base->score(elsewhere));
    }
    return std::exp(sum / static_cast<double>(sets.size()));
}

/// " at size 16" where that is what all sets' baselines have.
std::string sizeOfBaselines(const Sweep& sweep, const std::vector<size_t>& sets, TrkMethod method) {
    const int size = baseline(sweep, sets.front(), method)->way.size;
    const bool same = std::all_of(sets.begin(), sets.end(), [&](size_t set) {
        return baseline(sweep, set, method)->way.size == size;
    });
    return same && size > 0 ? " at size " + std::to_string(size) : "";
}

/// The simplest of those that cost about as little as the first.
const Ranked& simplest(const std::vector<Ranked>& ranked) {
    constexpr double kEqual = 1.03;
    const Ranked* best = &ranked.front();
    for (const Ranked& r : ranked) {
        if (r.cost <= kEqual * ranked.front().cost && complexity(r.way) < complexity(best->way)) {
            best = &r;
        }
    }
    return *best;
}

std::string bakeOptionsOf(const Way& way) {
    if (!way.usesSuperVoxels()) {
        return "";
    }
    const bool control = way.usesChoice();
    const int size = way.size > 0 ? way.size : 16;
    return "--size " + std::to_string(size) + " --control " +
           (control ? trk::controlName(way.kind) : "constant");
}

std::string queryOptionsOf(const Way& way) {
    std::string options = std::string("--method ") + way.traits().name;
    if (way.usesChoice() && way.choice != TRK_CHOICE_ROBUST) {
        options += " --choice " + kChoiceNames[static_cast<size_t>(way.choice)];
    }
    if (way.size == Way::kWholeVolume) {
        options += " --global";
    }
    if (way.rate != 1) {
        char rate[32];
        std::snprintf(rate, sizeof(rate), "%.9g", way.rate);
        options += (way.traits().usesSteps() ? " --step " : " --rate ") + std::string(rate);
    }
    return options;
}

/// What the chosen way does depth by depth, and where another one is clearly better.
std::vector<std::string> byDepth(const Sweep& sweep, const Way& way, double elsewhere) {
    std::vector<std::pair<double, std::vector<size_t>>> depths;
    for (size_t s = 0; s < sweep.sets.size(); ++s) {
        const double depth = sweep.sets[s].depth;
        if (depths.empty() || std::none_of(depths.begin(), depths.end(),
                                           [&](const auto& d) { return d.first == depth; })) {
            depths.push_back({depth, {}});
        }
        for (auto& d : depths) {
            if (d.first == depth) {
                d.second.push_back(s);
            }
        }
    }
    std::vector<std::string> sentences;
    for (const auto& [depth, sets] : depths) {
        const SweepRow* row = findRow(sweep, sets.front(), way);
        const std::vector<Ranked> ranked = rank(sweep, sets, elsewhere);
        const auto own = std::find_if(ranked.begin(), ranked.end(),
                                      [&](const Ranked& r) { return r.way == way; });
        if (!row || own == ranked.end()) {
            continue;
        }
        std::string text =
            "At " + depthName(sweep.sets[sets.front()]) + " it takes " +
            microseconds(row->nanoseconds) + " a " +
            (sweep.sets[sets.front()].rays == RayKind::kCamera ? "camera" : "secondary") + " ray";
        if (row->variance > 0) {
            text += ", with " + digits(row->lookups) + " look-ups and a standard deviation of " +
                    digits(std::sqrt(row->variance));
        }
        const Ranked& best = simplest(ranked);
        constexpr double kClear = 1.15;
        if (own->cost > kClear * best.cost) {
            text += "; over all its " + std::to_string(sets.size()) + " sets of rays, " +
                    nameOf(best.way) + " costs " + digits(best.cost / own->cost) + " times as much";
        }
        sentences.push_back(text + ".");
    }
    return sentences;
}

}  // namespace

const SweepRow* findRow(const Sweep& sweep, size_t set, const Way& way) {
    for (const SweepRow& row : sweep.rows) {
        if (row.set == set && row.way == way) {
            return &row;
        }
    }
    return nullptr;
}

const SweepRow* baseline(const Sweep& sweep, size_t set, TrkMethod method) {
    const auto distance = [](const SweepRow& row) {
        return row.way.size > 0 ? std::fabs(std::log2(row.way.size / 16.0)) : 100.0;
    };
    const SweepRow* best = nullptr;
    for (const SweepRow& row : sweep.rows) {
        if (row.set == set && row.way.method == method && row.way.rate == 1 && row.converged &&
            (!best || distance(row) < distance(*best))) {
            best = &row;
        }
    }
    return best;
}

std::vector<Ranked> rank(const Sweep& sweep, const std::vector<size_t>& sets, double elsewhere) {
    struct Sum {
        Way way;
        double logs = 0;
        size_t sets = 0;
    };
    std::vector<Sum> sums;
    for (const size_t set : sets) {
        double best = std::numeric_limits<double>::infinity();
        std::vector<const SweepRow*> rows;
        for (const SweepRow& row : sweep.rows) {
            if (row.set == set && row.way.isUnbiased() && row.converged) {
                rows.push_back(&row);
                best = std::min(best, row.score(elsewhere));
            }
        }
        for (const SweepRow* row : rows) {
            auto sum = std::find_if(sums.begin(), sums.end(),
                                    [&](const Sum& s) { return s.way == row->way; });
            if (sum == sums.end()) {
                sums.push_back({row->way});
                sum = sums.end() - 1;
            }
            sum->logs += std::log(row->score(elsewhere) / best);
            ++sum->sets;
        }
    }
    std::vector<Ranked> ranked;
    for (const Sum& sum : sums) {
        if (sum.sets == sets.size()) {
            ranked.push_back({sum.way, std::exp(sum.logs / static_cast<double>(sets.size()))});
        }
    }
    std::stable_sort(ranked.begin(), ranked.end(),
                     [](const Ranked& a, const Ranked& b) { return a.cost < b.cost; });
    return ranked;
}

std::vector<const SweepRow*> paretoFront(const Sweep& sweep, size_t set) {
    std::vector<const SweepRow*> rows;
    for (const SweepRow& row : sweep.rows) {
        if (row.set == set && row.way.isUnbiased() && row.converged) {
            rows.push_back(&row);
        }
    }
    std::stable_sort(rows.begin(), rows.end(), [](const SweepRow* a, const SweepRow* b) {
        return std::tie(a->nanoseconds, a->rmse) < std::tie(b->nanoseconds, b->rmse);
    });
    std::vector<const SweepRow*> front;
    for (const SweepRow* row : rows) {
        if (front.empty() || row->rmse < front.back()->rmse) {
            front.push_back(row);
        }
    }
    return front;
}

std::vector<Advice> recommend(const Sweep& sweep) {
    std::vector<size_t> all(sweep.sets.size());
    std::iota(all.begin(), all.end(), size_t{0});
    std::vector<Advice> result;
    for (const Accuracy& accuracy : kAccuracies) {
        const std::vector<Ranked> ranked = rank(sweep, all, accuracy.elsewhere);
        if (ranked.empty()) {
            continue;
        }
        Advice advice{accuracy, simplest(ranked), "", "", {}};
        const Way& way = advice.choice.way;
        advice.bake = bakeOptionsOf(way);
        advice.query = queryOptionsOf(way);
        std::string overall = "Over all " + std::to_string(all.size()) + " sets of rays it costs " +
                              digits(advice.choice.cost) +
                              " times what each set's own best does (geometric mean)";
        std::string against;
        for (const auto& [method, name] : {std::make_pair(TrkMethod{TRK_METHOD_RATIO}, "ratio"),
                                           std::make_pair(TrkMethod{TRK_METHOD_DELTA}, "delta")}) {
            const double cost = costOver(sweep, all, way, method, accuracy.elsewhere);
            const SweepRow* base = baseline(sweep, 0, method);
            if (!std::isnan(cost) && !(base->way == way)) {
                against += (against.empty() ? ", " : " and ") + digits(cost) + " of " + name +
                           " tracking's" + sizeOfBaselines(sweep, all, method);
            }
        }
        overall += against + ".";
        const Ranked& cheapest = ranked.front();
        if (!(cheapest.way == way)) {
            overall += " The cheapest, " + nameOf(cheapest.way) + ", costs " +
                       digits(cheapest.cost / advice.choice.cost) +
                       " times as much, which is no difference: this is the simpler one.";
        } else if (ranked.size() > 1) {
            overall += " Next comes " + nameOf(ranked[1].way) + ", at " +
                       digits(ranked[1].cost / cheapest.cost) + " times that.";
        }
        advice.why = byDepth(sweep, way, accuracy.elsewhere);
        advice.why.insert(advice.why.begin(), overall);
        for (const SweepBake& bake : sweep.bakes) {
            if (bake.size == way.size && bake.kind == way.kind && way.usesSuperVoxels()) {
                advice.why.push_back(
                    "The bake takes " + digits(1000 * bake.seconds) + " ms, its sidecar " +
                    digits(static_cast<double>(bake.sidecarBytes) / 1000) + " kB.");
            }
        }
        result.push_back(std::move(advice));
    }
    return result;
}

}  // namespace vdbtools
