// SPDX-License-Identifier: Apache-2.0
// The structs that callers of the C API fill in: completed where they are of an older header,
// refused where a number breaks its contract.
#pragma once

#include "bake/bake.h"
#include "query/sampling.h"
#include "query/transmittance.h"
#include "track/track.h"
#include "volume.h"

#include <cstddef>
#include <string>

namespace trk {

/// Throws Error (INVALID_ARGUMENT).
[[noreturn]] void refuse(const std::string& message);

/// No struct will ever be as large.
constexpr size_t kAbsurd = 1 << 16;

// Where the structs of the first release, 0.1, end: their last fields. These never change, and none
// leaves padding at its end, which a field of a later release might take for itself.
constexpr size_t kFirstVolumeInfo = offsetof(TrkVolumeInfo, kernel) + sizeof(const char*);

/// A stride of 0 or of whole, properly aligned entries.
template <class T>
void checkStride(const char* name, size_t stride, size_t width) {
    if (stride != 0 && (stride < width * sizeof(T) || stride % alignof(T) != 0)) {
        refuse(std::string(name) + " is " + std::to_string(stride) +
               "; expected 0, or a multiple of " + std::to_string(alignof(T)) + " from " +
               std::to_string(width * sizeof(T)) + " on");
    }
}

template <class T>
Array<T> arrayOf(const char* strideName, T* first, size_t width, size_t stride) {
    checkStride<T>(strideName, stride, width);
    return {first, width, stride};
}

/// Each completed and checked; NULL: the defaults. Throw Error (INVALID_ARGUMENT).
TrkVolumeOptions checkedOptions(const TrkVolumeOptions* given);
TrkBakeOptions checkedOptions(const TrkBakeOptions* given);
TrkDensity checkedDensity(const TrkDensity& given);
/// `method`: of the function, where no query is given.
TrkQuery checkedQuery(const TrkQuery* given, TrkMethod method);
/// `channels`: of the volume.
StatisticsOutput checkedStatistics(const TrkStatistics* given, size_t channels);
FreePathOutput checkedFreePaths(const TrkFreePaths& given, size_t channels);

/// What the library's inside makes of options that were checked.
VolumeOptions volumeOptions(const TrkVolumeOptions& options);
BakeOptions bakeOptions(const TrkBakeOptions& options);

}  // namespace trk
