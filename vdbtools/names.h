// SPDX-License-Identifier: Apache-2.0
// What methods and choices are called on command lines and in reports; the index is the constant of
// track.h.
#pragma once

#include "query/methods.h"

#include <string>
#include <vector>

namespace vdbtools {

inline std::vector<std::string> methodNames() {
    std::vector<std::string> names;
    for (const trk::MethodTraits& method : trk::kMethods) {
        names.emplace_back(method.name);
    }
    return names;
}
inline const std::vector<std::string> kChoiceNames{"robust", "mean", "min", "max"};

}  // namespace vdbtools
