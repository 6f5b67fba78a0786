// SPDX-License-Identifier: Apache-2.0
// The ways that core_table compares.
#pragma once

#include "track/track.hpp"

#include <cstdint>

inline constexpr uint64_t kRounds = 7;
/// The fixed ways, never more: a best one chosen in hindsight gains by choice.
struct FixedWay {
    const char* name;
    TrkMethod method;
    int size = 16;
    TrkControlKind kind = TRK_CONTROL_CONSTANT;
    float rate = 1;
    TrkRateBase base = TRK_RATE_BASE_MAJORANT;
};
inline constexpr FixedWay kWays[16] = {
    {"exact", TRK_METHOD_EXACT},
    {"ratio 16", TRK_METHOD_RATIO},
    {"delta 16", TRK_METHOD_DELTA},
    {"constant 4", TRK_METHOD_RESIDUAL, 4},
    {"constant 8", TRK_METHOD_RESIDUAL, 8},
    {"constant 16", TRK_METHOD_RESIDUAL, 16},
    {"constant 32", TRK_METHOD_RESIDUAL, 32},
    {"affine 4", TRK_METHOD_RESIDUAL, 4, TRK_CONTROL_AFFINE},
    {"affine 8", TRK_METHOD_RESIDUAL, 8, TRK_CONTROL_AFFINE},
    {"affine 16", TRK_METHOD_RESIDUAL, 16, TRK_CONTROL_AFFINE},
    {"affine 32", TRK_METHOD_RESIDUAL, 32, TRK_CONTROL_AFFINE},
    {"constant 8 rate 4", TRK_METHOD_RESIDUAL, 8, TRK_CONTROL_CONSTANT, 4},
    {"affine 8 rate 4", TRK_METHOD_RESIDUAL, 8, TRK_CONTROL_AFFINE, 4},
    {"affine 4 rate 4", TRK_METHOD_RESIDUAL, 4, TRK_CONTROL_AFFINE, 4},
    {"constant 4 rms 2", TRK_METHOD_RESIDUAL, 4, TRK_CONTROL_CONSTANT, 2, TRK_RATE_BASE_RMS},
    {"affine 8 rms 2", TRK_METHOD_RESIDUAL, 8, TRK_CONTROL_AFFINE, 2, TRK_RATE_BASE_RMS}};

inline track::Query queryOf(const FixedWay& way, uint64_t seed) {
    track::Query query(0, 0);
    query.method = way.method;
    query.rate = way.rate;
    query.rateBase = way.base;
    query.seed = seed;
    query.threads = 1;
    return query;
}
