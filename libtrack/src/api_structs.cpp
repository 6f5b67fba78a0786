// SPDX-License-Identifier: Apache-2.0
#include "api_structs.h"

#include "failure.h"
#include "kernel.h"
#include "query/methods.h"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>

namespace trk {

void refuse(const std::string& message) {
    throw Error(TRK_ERROR_INVALID_ARGUMENT, message);
}

namespace {

/// What the caller filled in, completed: of an older, smaller struct the rest is 0, the default of
/// fields added later; of a newer, larger one the rest must be. `firstSize`: of the first release.
template <class Struct>
Struct completed(const Struct& given, const char* what, size_t firstSize) {
    const size_t size = given.size;
    if (size < firstSize || size > kAbsurd) {
        refuse(std::string(what) + ".size is " + std::to_string(size) + "; expected " +
               std::to_string(sizeof(Struct)) + ", its sizeof");
    }
    const auto* bytes = reinterpret_cast<const unsigned char*>(&given);
    for (size_t i = sizeof(Struct); i < size; ++i) {
        if (bytes[i] != 0) {
            refuse(std::string(what) + " has a field that libtrack " TRACK_VERSION
                                       " does not know; expected it to be 0, its default");
        }
    }
    Struct result;
    std::memset(&result, 0, sizeof(result));
    std::memcpy(&result, &given, std::min(size, sizeof(result)));
    result.size = sizeof(result);
    return result;
}

// Where the structs of the first release, 0.1, end: their last fields. These never change, and none
// leaves padding at its end, which a field of a later release might take for itself.
constexpr size_t kFirstVolumeOptions = offsetof(TrkVolumeOptions, progressData) + sizeof(void*);
constexpr size_t kFirstQuery = offsetof(TrkQuery, resultStride) + sizeof(size_t);
static_assert(kFirstVolumeOptions % alignof(TrkVolumeOptions) == 0 &&
              kFirstQuery % alignof(TrkQuery) == 0);
constexpr size_t kFirstStatistics = offsetof(TrkStatistics, exactShareStride) + sizeof(size_t);
constexpr size_t kFirstFreePaths = offsetof(TrkFreePaths, lookupsStride) + sizeof(size_t);
constexpr size_t kFirstBakeOptions = offsetof(TrkBakeOptions, progressData) + sizeof(void*);
constexpr size_t kFirstDensity = offsetof(TrkDensity, tileActive) + sizeof(void*);

bool isSuperVoxelSize(uint32_t size) {
    return size >= 4 && size <= 64 && (size & (size - 1)) == 0;
}

void checkThreads(int32_t threads) {
    if (threads < 0) {
        refuse("threads is " + std::to_string(threads) + "; expected 0 (all) or more");
    }
}

}  // namespace

Kernel kernelOf(const TrkVolumeOptions& options) {
    if (!options.kernel) {
        return kDefaultKernel;
    }
    const bool isAvx2 = std::strcmp(options.kernel, kernelName(Kernel::kAvx2)) == 0;
    if (!isAvx2 && std::strcmp(options.kernel, kernelName(Kernel::kBaseline)) != 0) {
        refuse(std::string("kernel is \"") + options.kernel +
               "\"; expected \"baseline\" or \"avx2\"");
    }
    const Kernel kernel = isAvx2 ? Kernel::kAvx2 : Kernel::kBaseline;
    if (!hasKernel(kernel)) {
        refuse("kernel avx2: this processor or build has none; expected \"baseline\"");
    }
    return kernel;
}

TrkVolumeOptions checkedOptions(const TrkVolumeOptions* given) {
    const TrkVolumeOptions options =
        given ? completed(*given, "TrkVolumeOptions", kFirstVolumeOptions)
              : trkDefaultVolumeOptions();
    if (!(options.scale >= 0) || !std::isfinite(options.scale)) {
        refuse("scale is " + std::to_string(options.scale) + "; expected a finite number >= 0");
    }
    for (const float color : options.color) {
        if (!(color >= 0) || !std::isfinite(color)) {
            refuse("color is " + std::to_string(color) + "; expected finite numbers >= 0");
        }
    }
    if (options.choice < TRK_CHOICE_ROBUST || options.choice > TRK_CHOICE_MAX) {
        refuse("choice is " + std::to_string(options.choice) + "; expected a TRK_CHOICE_ constant");
    }
    if (options.global > 1) {
        refuse("global is " + std::to_string(options.global) + "; expected 0 or 1");
    }
    if (options.check != TRK_CHECK_FULL && options.check != TRK_CHECK_METADATA) {
        refuse("check is " + std::to_string(options.check) + "; expected a TRK_CHECK_ constant");
    }
    if ((options.repair & ~uint32_t{TRK_REPAIR_DROP_NONFINITE | TRK_REPAIR_CLAMP_NEGATIVE}) != 0) {
        refuse("repair has unknown bits; expected TRK_REPAIR_ constants");
    }
    checkThreads(options.threads);
    if (options.noBake > 1) {
        refuse("noBake is " + std::to_string(options.noBake) + "; expected 0 or 1");
    }
    kernelOf(options);
    const uint32_t size = options.superVoxelSize;
    if (size != 0 && !isSuperVoxelSize(size)) {
        refuse("superVoxelSize is " + std::to_string(size) +
               "; expected 4, 8, 16, 32 or 64, or 0: as baked");
    }
    if (options.reserved != 0) {
        refuse("reserved is " + std::to_string(options.reserved) + "; expected 0");
    }
    return options;
}

VolumeOptions volumeOptions(const TrkVolumeOptions& options) {
    VolumeOptions result;
    result.gridNamed = options.gridName != nullptr;
    result.gridName = options.gridName ? options.gridName : "";
    result.scale = options.scale;
    std::copy_n(options.color, 3, result.color.begin());
    result.choice = options.choice;
    result.global = options.global != 0;
    result.check = options.check;
    result.bakeMissing = options.noBake == 0;
    result.repair = options.repair;
    result.maxMemory = options.maxMemory;
    result.kernel = kernelOf(options);
    result.superVoxelSize = static_cast<int>(options.superVoxelSize);
    return result;
}

TrkBakeOptions checkedOptions(const TrkBakeOptions* given) {
    const TrkBakeOptions options =
        given ? completed(*given, "TrkBakeOptions", kFirstBakeOptions) : trkDefaultBakeOptions();
    const uint32_t size = options.superVoxelSize;
    if (!isSuperVoxelSize(size)) {
        refuse("superVoxelSize is " + std::to_string(size) + "; expected 4, 8, 16, 32 or 64");
    }
    if (options.control < TRK_CONTROL_CONSTANT || options.control > TRK_CONTROL_AFFINE) {
        refuse("control is " + std::to_string(options.control) +
               "; expected a TRK_CONTROL_ constant");
    }
    if (options.levels > 8) {
        refuse("levels is " + std::to_string(options.levels) + "; expected 0 to 8");
    }
    if (options.overwrite > 1) {
        refuse("overwrite is " + std::to_string(options.overwrite) + "; expected 0 or 1");
    }
    checkThreads(options.threads);
    if (options.reserved != 0) {
        refuse("reserved is " + std::to_string(options.reserved) + "; expected 0");
    }
    return options;
}

BakeOptions bakeOptions(const TrkBakeOptions& options) {
    BakeOptions result;
    result.superVoxelSize = static_cast<int>(options.superVoxelSize);
    result.kind = static_cast<ControlKind>(options.control);
    result.levels = static_cast<int>(options.levels);
    result.maxMemory = options.maxMemory;
    return result;
}

TrkDensity checkedDensity(const TrkDensity& given) {
    const TrkDensity density = completed(given, "TrkDensity", kFirstDensity);
    if (density.valueType < TRK_VALUE_FLOAT || density.valueType > TRK_VALUE_HALF) {
        refuse("valueType is " + std::to_string(density.valueType) +
               "; expected a TRK_VALUE_ constant");
    }
    if (density.channels != 1 && density.channels != 3) {
        refuse("channels is " + std::to_string(density.channels) + "; expected 1 or 3");
    }
    if (density.reserved != 0) {
        refuse("reserved is " + std::to_string(density.reserved) + "; expected 0");
    }
    bool empty = false;
    for (size_t a = 0; a < 3; ++a) {
        empty = empty || density.extent[a] == 0;
        // Voxels lie where an int32 can say, and so do those beside them.
        const uint64_t room = static_cast<uint64_t>(int64_t{INT32_MAX} - density.origin[a]);
        if (density.extent[a] > room) {
            refuse("origin " + std::to_string(density.origin[a]) + " and extent " +
                   std::to_string(density.extent[a]) +
                   " reach beyond index coordinate 2^31 - 2, the last there is");
        }
    }
    if (density.values && empty) {
        refuse("values is given, but no extent; expected voxels along x, y and z");
    }
    if (!density.values && !empty) {
        refuse("values is NULL; expected a dense array of the extent given");
    }
    if (density.values && (density.brickCount > 0 || density.tileCount > 0)) {
        refuse("a dense array and bricks or tiles are given; expected one or the other");
    }
    if (density.brickCount > 0 && (!density.brickOrigins || !density.brickValues)) {
        refuse("brickOrigins or brickValues is NULL; expected " +
               std::to_string(density.brickCount) + " bricks");
    }
    for (size_t i = 0; i < density.brickCount; ++i) {
        if (!density.brickValues[i]) {
            refuse("brickValues[" + std::to_string(i) + "] is NULL; expected 512 voxels");
        }
    }
    if (density.tileCount > 0 &&
        (!density.tileOrigins || !density.tileSizes || !density.tileValues)) {
        refuse("tileOrigins, tileSizes or tileValues is NULL; expected " +
               std::to_string(density.tileCount) + " tiles");
    }
    return density;
}

TrkQuery checkedQuery(const TrkQuery* given, TrkMethod byDefault) {
    TrkQuery query = given ? completed(*given, "TrkQuery", kFirstQuery) : trkDefaultQuery();
    if (!given) {
        query.method = byDefault;
    }
    const MethodTraits* method = findMethod(query.method);
    if (!method) {
        refuse("method is " + std::to_string(query.method) + "; expected a TRK_METHOD_ constant");
    }
    if (query.samples == 0) {
        refuse("samples is 0; expected at least 1");
    }
    if (!(query.rate > 0) || !std::isfinite(query.rate)) {
        refuse("rate is " + std::to_string(query.rate) + "; expected a finite number > 0");
    }
    if (method->usesRate && !method->usesRoulette && query.rate < 1) {
        refuse("rate is " + std::to_string(query.rate) +
               "; expected at least 1, as delta tracking needs a majorant");
    }
    if (query.rateBase != TRK_RATE_BASE_MAJORANT && query.rateBase != TRK_RATE_BASE_RMS) {
        refuse("rateBase is " + std::to_string(query.rateBase) +
               "; expected a TRK_RATE_BASE_ constant");
    }
    if (!(query.step >= 0.001f) || !std::isfinite(query.step)) {
        refuse("step is " + std::to_string(query.step) + "; expected a finite number >= 0.001");
    }
    constexpr uint32_t kFlags = uint32_t{TRK_QUERY_EXACT_FALLBACK} | uint32_t{TRK_QUERY_ROULETTE};
    if ((query.flags & ~kFlags) != 0) {
        refuse("flags has unknown bits; expected TRK_QUERY_ constants");
    }
    if (query.threads < 0) {
        refuse("threads is " + std::to_string(query.threads) + "; expected 0 (all) or more");
    }
    checkStride<TrkRay>("rayStride", query.rayStride, 1);
    if (query.rayStride == 0) {
        query.rayStride = sizeof(TrkRay);
    }
    return query;
}

StatisticsOutput checkedStatistics(const TrkStatistics* given, size_t channels) {
    if (!given) {
        return {};
    }
    const TrkStatistics s = completed(*given, "TrkStatistics", kFirstStatistics);
    return {arrayOf("standardErrorStride", s.standardError, channels, s.standardErrorStride),
            arrayOf("lookupsStride", s.lookups, 1, s.lookupsStride),
            arrayOf("superVoxelsStride", s.superVoxels, 1, s.superVoxelsStride),
            arrayOf("exactShareStride", s.exactShare, 1, s.exactShareStride)};
}

FreePathOutput checkedFreePaths(const TrkFreePaths& given, size_t channels) {
    const TrkFreePaths p = completed(given, "TrkFreePaths", kFirstFreePaths);
    return {arrayOf("tStride", p.t, 1, p.tStride),
            arrayOf("weightStride", p.weight, channels, p.weightStride),
            arrayOf("extinctionStride", p.extinction, channels, p.extinctionStride),
            arrayOf("lookupsStride", p.lookups, 1, p.lookupsStride)};
}

}  // namespace trk
