// SPDX-License-Identifier: Apache-2.0
// Four or eight numbers at once, by the compiler's vector types: what the processor has of them.
// Vectors go by reference between functions: how they would be returned depends on the processor.
#pragma once

#include <cstddef>
#include <cstdint>

namespace trk {

using Float4 = float __attribute__((vector_size(16)));
using Float8 = float __attribute__((vector_size(32)));
using Double2 = double __attribute__((vector_size(16)));
using Double4 = double __attribute__((vector_size(32)));
using Int4 = int32_t __attribute__((vector_size(16)));

}  // namespace trk
