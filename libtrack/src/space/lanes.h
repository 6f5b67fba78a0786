// SPDX-License-Identifier: Apache-2.0
// Four or eight numbers at once, by the compiler's vector types: what the processor has of them.
// Vectors go by reference between functions: how they would be returned depends on the processor.
#pragma once

#include <cstddef>
#include <cstdint>
#include <cstring>

namespace trk {

using Float4 = float __attribute__((vector_size(16)));
using Float8 = float __attribute__((vector_size(32)));
using Double2 = double __attribute__((vector_size(16)));
using Double4 = double __attribute__((vector_size(32)));
using Int4 = int32_t __attribute__((vector_size(16)));

inline void load(const double* from, Double4& to) {
    std::memcpy(&to, from, sizeof(to));
}
inline void load(const int32_t* from, Double4& to) {
    Int4 integers;
    std::memcpy(&integers, from, sizeof(integers));
    to = __builtin_convertvector(integers, Double4);
}
inline void store(const Double4& from, double* to) {
    std::memcpy(to, &from, sizeof(from));
}

/// The lesser and the greater, of numbers or of lanes.
template <class Real>
void takeLesser(const Real& than, Real& value) {
    value = than < value ? than : value;
}
template <class Real>
void takeGreater(const Real& than, Real& value) {
    value = than > value ? than : value;
}

}  // namespace trk
