// SPDX-License-Identifier: Apache-2.0
// Which way of a sweep to use, and what to bake for it.
#pragma once

#include "sweep.h"

#include <optional>
#include <string>
#include <vector>

namespace vdbtools {

/// What a renderer asks for: the variance it has from elsewhere, below which less is no gain.
struct Accuracy {
    const char* name;
    double elsewhere;
};
inline constexpr Accuracy kAccuracies[] = {{"rough", 0.1}, {"normal", 0.01}, {"tight", 0.001}};

/// A way's cost over some sets: the geometric mean of SweepRow::score over the set's best.
struct Ranked {
    Way way;
    double cost = 1;
};

/// The unbiased ways that converged in all of `sets`, the cheapest first.
std::vector<Ranked> rank(const Sweep& sweep, const std::vector<size_t>& sets, double elsewhere);

/// The rows of a set that nothing else in it beats in both time and error, by time. Unbiased and
/// converged ones.
std::vector<const SweepRow*> paretoFront(const Sweep& sweep, size_t set);

/// The row of a way in a set, or NULL.
const SweepRow* findRow(const Sweep& sweep, size_t set, const Way& way);

/// What costs are told against: ratio or delta tracking at the super-voxel size that is nearest to
/// 16, rate 1, converged; NULL where the sweep has none.
const SweepRow* baseline(const Sweep& sweep, size_t set, TrkMethod method);

/// Advice for one accuracy. Ways that cost within 3 % of the cheapest count as equal: of these the
/// simplest is chosen.
struct Advice {
    Accuracy accuracy;
    Ranked choice;
    std::string bake;   ///< the options of `vdbtrack bake`, or empty where no sidecar is needed
    std::string query;  ///< the options of `vdbtrack query`
    std::vector<std::string> why;  ///< over all sets, depth by depth, and what the bake costs
};

/// For every accuracy that some way converged for in all sets.
std::vector<Advice> recommend(const Sweep& sweep);

}  // namespace vdbtools
