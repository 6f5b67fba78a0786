// SPDX-License-Identifier: Apache-2.0
// What methods and choices are called on command lines and in reports; the index is the constant of
// track.h.
#pragma once

#include <string>
#include <vector>

namespace vdbtools {

inline const std::vector<std::string> kMethodNames{"exact",   "residual", "ratio",
                                                   "control", "delta",    "march"};
inline const std::vector<std::string> kChoiceNames{"robust", "mean", "min", "max"};

}  // namespace vdbtools
