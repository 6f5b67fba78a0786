// SPDX-License-Identifier: Apache-2.0
// Code for more than the least processor: what queries spend their time in is compiled once more
// for AVX2, and chosen at run time. Results have the same bits on one kernel; kernels differ in the
// last ones. What a bake computes has one kernel, and the same bits everywhere.
#pragma once

#include <cstdlib>
#include <cstring>

// A function with it takes in all it calls, and is compiled for AVX2 with them; nothing outside of
// it is. Clang has no flatten that goes all the way down, and Clang builds are for finding faults.
#if defined(__x86_64__) && defined(__GNUC__) && !defined(__clang__)
#define TRACK_AVX2 __attribute__((target("avx2,fma"), flatten))
#endif

// Of a function that is rare: it stays one of its own, which spares copies in all that call it.
#define TRACK_APART __attribute__((noinline))

namespace trk {

/// Whose code queries run.
enum class Kernel { kBaseline, kAvx2 };

inline const char* kernelName(Kernel kernel) {
    return kernel == Kernel::kAvx2 ? "avx2" : "baseline";
}

/// Whether it was compiled, and the processor has it.
inline bool hasKernel(Kernel kernel) {
#ifdef TRACK_AVX2
    __builtin_cpu_init();
    return kernel == Kernel::kBaseline ||
           (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma"));
#else
    return kernel == Kernel::kBaseline;
#endif
}

inline Kernel chooseKernel() {
    const char* wanted = std::getenv("TRACK_KERNEL");
    return hasKernel(Kernel::kAvx2) &&
                   !(wanted && std::strcmp(wanted, kernelName(Kernel::kBaseline)) == 0)
               ? Kernel::kAvx2
               : Kernel::kBaseline;
}

/// Of volumes that ask for none: the best there is, unless the environment variable TRACK_KERNEL
/// says "baseline". Decided when the library is loaded.
inline const Kernel kDefaultKernel = chooseKernel();

}  // namespace trk
