// SPDX-License-Identifier: Apache-2.0
// The method table: all that anything but a method's own kernel knows of it.
#pragma once

#include "track/track.h"

#include <array>
#include <cstddef>

namespace trk {

struct MethodTraits {
    TrkMethod method;
    const char* name;      ///< of the program's --method
    const char* constant;  ///< of the C API
    bool isRandom;         ///< another sample has another result; else it knows the optical depth
    bool isUnbiased;
    bool usesDensity;
    bool usesSuperVoxels;
    bool usesControl;   ///< as chosen or, where it is not random, as baked
    bool usesRate;      ///< of collisions that it tracks
    bool usesRoulette;  ///< has weights, by which a walk may end early; its rate needs no majorant
    bool hasFreePaths;

    bool usesChoice() const { return usesControl && isRandom; }
    bool hasLevels() const { return usesControl && !isRandom; }
    bool usesSteps() const { return isRandom && !usesRate; }
};

/// One row a method, in the order of their numbers.
inline constexpr std::array<MethodTraits, 7> kMethods{{
    // clang-format off
    //                                                    random unbiased density super-voxels control rate roulette free paths
    {TRK_METHOD_EXACT,    "exact",    "TRK_METHOD_EXACT",    false, true,  true,  false, false, false, false, false},
    {TRK_METHOD_RESIDUAL, "residual", "TRK_METHOD_RESIDUAL", true,  true,  true,  true,  true,  true,  true,  true},
    {TRK_METHOD_RATIO,    "ratio",    "TRK_METHOD_RATIO",    true,  true,  true,  true,  false, true,  true,  false},
    {TRK_METHOD_CONTROL,  "control",  "TRK_METHOD_CONTROL",  false, false, false, true,  true,  false, false, false},
    {TRK_METHOD_DELTA,    "delta",    "TRK_METHOD_DELTA",    true,  true,  true,  true,  false, true,  false, true},
    {TRK_METHOD_MARCH,    "march",    "TRK_METHOD_MARCH",    true,  false, true,  false, false, false, false, false},
    {TRK_METHOD_COMB,     "comb",     "TRK_METHOD_COMB",     true,  true,  true,  true,  false, false, true,  false},
    // clang-format on
}};

/// NULL where no method has this number.
inline const MethodTraits* findMethod(TrkMethod method) {
    for (const MethodTraits& traits : kMethods) {
        if (traits.method == method) {
            return &traits;
        }
    }
    return nullptr;
}
inline const MethodTraits& traitsOf(TrkMethod method) {
    return *findMethod(method);
}

}  // namespace trk
