// SPDX-License-Identifier: Apache-2.0
// The only extern "C" file: validates, calls, and turns exceptions into statuses.
#include "track/track.h"

#include "failure.h"
#include "parallel.h"
#include "sampling.h"
#include "transmittance.h"
#include "volume.h"

#include <tbb/task_arena.h>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstring>
#include <exception>
#include <filesystem>
#include <new>
#include <string>
#include <utility>

struct TrkVolume {
    trk::Volume volume;
};

namespace {

thread_local std::string lastError;

TrkStatus fail(TrkStatus status, const char* message) noexcept {
    try {
        lastError = message;
    } catch (...) {
        lastError.clear();  // no memory for the message; the status still tells
    }
    return status;
}

/// Runs `body`; no exception leaves.
template <class Body>
TrkStatus guard(const Body& body) noexcept {
    try {
        body();
        return TRK_OK;
    } catch (const trk::Error& e) {
        return fail(e.status(), e.what());
    } catch (const std::bad_alloc&) {
        return fail(TRK_ERROR_OUT_OF_MEMORY, "the machine has no memory left for this call");
    } catch (const std::filesystem::filesystem_error& e) {
        return fail(TRK_ERROR_IO, e.what());
    } catch (const std::exception& e) {
        return fail(TRK_ERROR_UNKNOWN, e.what());
    } catch (...) {
        return fail(TRK_ERROR_UNKNOWN, "an exception that is not a std::exception");
    }
}

[[noreturn]] void refuse(const std::string& message) {
    throw trk::Error(TRK_ERROR_INVALID_ARGUMENT, message);
}

/// No struct will ever be as large.
constexpr size_t kAbsurd = 1 << 16;

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
constexpr size_t kFirstVolumeOptions = offsetof(TrkVolumeOptions, maxMemory) + sizeof(uint64_t);
constexpr size_t kFirstQuery = offsetof(TrkQuery, resultStride) + sizeof(size_t);
static_assert(kFirstVolumeOptions % alignof(TrkVolumeOptions) == 0 &&
              kFirstQuery % alignof(TrkQuery) == 0);
constexpr size_t kFirstStatistics = offsetof(TrkStatistics, exactShareStride) + sizeof(size_t);
constexpr size_t kFirstFreePaths = offsetof(TrkFreePaths, lookupsStride) + sizeof(size_t);
constexpr size_t kFirstVolumeInfo = offsetof(TrkVolumeInfo, storage) + sizeof(const char*);

trk::VolumeOptions checked(const TrkVolumeOptions& options) {
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
    if (options.threads < 0) {
        refuse("threads is " + std::to_string(options.threads) + "; expected 0 (all) or more");
    }
    if (options.reserved != 0) {
        refuse("reserved is " + std::to_string(options.reserved) + "; expected 0");
    }
    trk::VolumeOptions result;
    result.gridNamed = options.gridName != nullptr;
    result.gridName = options.gridName ? options.gridName : "";
    result.scale = options.scale;
    std::copy_n(options.color, 3, result.color.begin());
    result.choice = options.choice;
    result.global = options.global != 0;
    result.check = options.check;
    result.repair = options.repair;
    result.maxMemory = options.maxMemory;
    return result;
}

/// A stride of 0 or of whole, properly aligned entries.
template <class T>
void checkStride(const char* name, size_t stride, size_t width) {
    if (stride != 0 && (stride < width * sizeof(T) || stride % alignof(T) != 0)) {
        refuse(std::string(name) + " is " + std::to_string(stride) +
               "; expected 0, or a multiple of " + std::to_string(alignof(T)) + " from " +
               std::to_string(width * sizeof(T)) + " on");
    }
}

/// `method`: of the function, where no query is given.
TrkQuery checked(const TrkQuery* given, TrkMethod method) {
    TrkQuery query = given ? completed(*given, "TrkQuery", kFirstQuery) : trkDefaultQuery();
    if (!given) {
        query.method = method;
    }
    if (query.method < TRK_METHOD_EXACT || query.method > TRK_METHOD_MARCH) {
        refuse("method is " + std::to_string(query.method) + "; expected a TRK_METHOD_ constant");
    }
    if (query.samples == 0) {
        refuse("samples is 0; expected at least 1");
    }
    if (!(query.rate > 0) || !std::isfinite(query.rate)) {
        refuse("rate is " + std::to_string(query.rate) + "; expected a finite number > 0");
    }
    if (query.method == TRK_METHOD_DELTA && query.rate < 1) {
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

template <class T>
trk::Array<T> arrayOf(const char* strideName, T* first, size_t width, size_t stride) {
    checkStride<T>(strideName, stride, width);
    return {first, width, stride};
}

trk::StatisticsOutput checked(const TrkStatistics* given, size_t channels) {
    if (!given) {
        return {};
    }
    const TrkStatistics s = completed(*given, "TrkStatistics", kFirstStatistics);
    return {arrayOf("standardErrorStride", s.standardError, channels, s.standardErrorStride),
            arrayOf("lookupsStride", s.lookups, 1, s.lookupsStride),
            arrayOf("superVoxelsStride", s.superVoxels, 1, s.superVoxelsStride),
            arrayOf("exactShareStride", s.exactShare, 1, s.exactShareStride)};
}

trk::FreePathOutput checked(const TrkFreePaths& given, size_t channels) {
    const TrkFreePaths p = completed(given, "TrkFreePaths", kFirstFreePaths);
    return {arrayOf("tStride", p.t, 1, p.tStride),
            arrayOf("weightStride", p.weight, channels, p.weightStride),
            arrayOf("extinctionStride", p.extinction, channels, p.extinctionStride),
            arrayOf("lookupsStride", p.lookups, 1, p.lookupsStride)};
}

void checkPointers(const TrkVolume* volume, const void* rays, size_t rayCount,
                   const void* results) {
    if (!volume) {
        refuse("volume is NULL");
    }
    if (rayCount > 0 && !rays) {
        refuse("rays is NULL; expected " + std::to_string(rayCount) + " rays");
    }
    if (rayCount > 0 && !results) {
        refuse("where to put the results is NULL; expected room for " + std::to_string(rayCount) +
               " rays");
    }
}

}  // namespace

const char* trkGetVersion(void) {
    return TRACK_VERSION;
}

const char* trkGetLastErrorMessage(void) {
    return lastError.c_str();
}

const char* trkGetStatusName(TrkStatus status) {
    switch (status) {
        case TRK_OK:
            return "TRK_OK";
        case TRK_ERROR_INVALID_ARGUMENT:
            return "TRK_ERROR_INVALID_ARGUMENT";
        case TRK_ERROR_IO:
            return "TRK_ERROR_IO";
        case TRK_ERROR_BAD_FILE:
            return "TRK_ERROR_BAD_FILE";
        case TRK_ERROR_GRID_NOT_FOUND:
            return "TRK_ERROR_GRID_NOT_FOUND";
        case TRK_ERROR_UNSUPPORTED_GRID:
            return "TRK_ERROR_UNSUPPORTED_GRID";
        case TRK_ERROR_BAD_DENSITY:
            return "TRK_ERROR_BAD_DENSITY";
        case TRK_ERROR_SIDECAR_MISMATCH:
            return "TRK_ERROR_SIDECAR_MISMATCH";
        case TRK_ERROR_NO_SIDECAR:
            return "TRK_ERROR_NO_SIDECAR";
        case TRK_ERROR_NO_DENSITY:
            return "TRK_ERROR_NO_DENSITY";
        case TRK_ERROR_OUT_OF_MEMORY:
            return "TRK_ERROR_OUT_OF_MEMORY";
        default:
            return "TRK_ERROR_UNKNOWN";
    }
}

TrkStatus trkOpenVolume(const char* vdbPath, const char* sidecarPath,
                        const TrkVolumeOptions* options, TrkVolume** volume) {
    return guard([&] {
        if (!volume) {
            refuse("volume is NULL; expected where to put the opened volume");
        }
        *volume = nullptr;
        const TrkVolumeOptions given =
            options ? completed(*options, "TrkVolumeOptions", kFirstVolumeOptions)
                    : trkDefaultVolumeOptions();
        if (vdbPath && *vdbPath == '\0') {
            refuse("vdbPath is empty; expected the path of a density, or NULL for a sidecar alone");
        }
        if (!vdbPath && (!sidecarPath || *sidecarPath == '\0')) {
            refuse(
                "vdbPath is NULL, and sidecarPath names no sidecar either; expected the path of at "
                "least one");
        }
        const trk::VolumeOptions opened = checked(given);
        const auto open = [&] {
            trk::inGroupOfItsOwn(
                [&] { *volume = new TrkVolume{trk::openVolume(vdbPath, sidecarPath, opened)}; });
        };
        if (given.threads == 0) {
            tbb::this_task_arena::isolate(open);
        } else {
            const int most = tbb::this_task_arena::max_concurrency();
            tbb::task_arena(std::min(given.threads, most)).execute(open);
        }
    });
}

void trkCloseVolume(TrkVolume* volume) {
    delete volume;
}

TrkStatus trkGetVolumeInfo(const TrkVolume* handle, TrkVolumeInfo* info) {
    return guard([&] {
        if (!handle || !info) {
            refuse("volume or info is NULL");
        }
        const size_t size = info->size;
        if (size < kFirstVolumeInfo || size > kAbsurd) {
            refuse("TrkVolumeInfo.size is " + std::to_string(size) + "; expected " +
                   std::to_string(sizeof(TrkVolumeInfo)) + ", its sizeof, set before the call");
        }
        const trk::Volume& volume = handle->volume;
        TrkVolumeInfo result{};
        result.size = size;
        const trk::IntBox& box =
            volume.hasDensity() ? volume.field->box() : volume.superVoxels.box();
        trk::worldBounds(volume.indexToWorld, volume.anchor, box, result.boundsMin,
                         result.boundsMax);
        for (int row = 0; row < 3; ++row) {
            for (int column = 0; column < 3; ++column) {
                result.indexToWorld[3 * row + column] = volume.indexToWorld.linear[row][column];
            }
            result.indexToWorld[9 + row] = volume.indexToWorld.translation[row];
        }
        result.activeVoxels = volume.activeVoxels;
        result.bytes = volume.bytes();
        result.channels = static_cast<uint32_t>(volume.channels());
        result.hasDensity = volume.hasDensity() ? 1 : 0;
        result.gridName = volume.grid.name.c_str();
        result.controlKind = "";
        result.storage = !volume.hasDensity() ? "" : volume.field->isHalf() ? "half" : "float";
        if (volume.hasSuperVoxels) {
            result.superVoxelSize = static_cast<uint32_t>(volume.superVoxels.size());
            result.superVoxelCount = volume.superVoxels.count();
            result.levels = static_cast<uint32_t>(volume.superVoxels.levelCount());
            result.controlKind = trk::controlName(volume.superVoxels.kind());
        }
        std::memcpy(info, &result, std::min(size, sizeof(result)));
        if (size > sizeof(result)) {  // what a newer header adds
            std::memset(reinterpret_cast<unsigned char*>(info) + sizeof(result), 0,
                        size - sizeof(result));
        }
    });
}

TrkStatus trkEstimateTransmittance(const TrkVolume* volume, const TrkQuery* query,
                                   const TrkRay* rays, size_t rayCount, float* transmittance,
                                   const TrkStatistics* statistics) {
    return guard([&] {
        checkPointers(volume, rays, rayCount, transmittance);
        const TrkQuery complete = checked(query, TRK_METHOD_RESIDUAL);
        if (rayCount == 0) {
            return;
        }
        const size_t channels = volume->volume.channels();
        trk::estimateTransmittance(
            volume->volume, complete, rays, rayCount,
            arrayOf("resultStride", transmittance, channels, complete.resultStride),
            checked(statistics, channels));
    });
}

TrkStatus trkIntegrateOpticalDepth(const TrkVolume* volume, const TrkQuery* query,
                                   const TrkRay* rays, size_t rayCount, double* opticalDepth) {
    return guard([&] {
        checkPointers(volume, rays, rayCount, opticalDepth);
        const TrkQuery complete = checked(query, TRK_METHOD_EXACT);
        if (complete.method != TRK_METHOD_EXACT && complete.method != TRK_METHOD_CONTROL) {
            refuse("method " + std::to_string(complete.method) +
                   " is random and has no optical depth; expected TRK_METHOD_EXACT or "
                   "TRK_METHOD_CONTROL");
        }
        if (rayCount == 0) {
            return;
        }
        trk::integrateOpticalDepth(volume->volume, complete, rays, rayCount,
                                   arrayOf("resultStride", opticalDepth, volume->volume.channels(),
                                           complete.resultStride));
    });
}

TrkStatus trkSampleFreePath(const TrkVolume* volume, const TrkQuery* query, const TrkRay* rays,
                            size_t rayCount, const TrkFreePaths* paths) {
    return guard([&] {
        checkPointers(volume, rays, rayCount, paths);
        const TrkQuery complete = checked(query, TRK_METHOD_RESIDUAL);
        if (complete.method != TRK_METHOD_RESIDUAL && complete.method != TRK_METHOD_DELTA) {
            refuse("method " + std::to_string(complete.method) +
                   " has no free paths; expected TRK_METHOD_RESIDUAL or TRK_METHOD_DELTA");
        }
        if (complete.rate < 1) {
            refuse("rate is " + std::to_string(complete.rate) +
                   "; expected at least 1, as free paths need a majorant");
        }
        if (complete.samples != 1) {
            refuse("samples is " + std::to_string(complete.samples) +
                   "; expected 1: give other streams or ray ids for more paths of a ray");
        }
        if (rayCount == 0) {
            return;
        }
        const trk::FreePathOutput out = checked(*paths, volume->volume.channels());
        if (!out.t) {
            refuse("TrkFreePaths.t is NULL; expected room for " + std::to_string(rayCount) +
                   " floats");
        }
        trk::sampleFreePaths(volume->volume, complete, rays, rayCount, out);
    });
}

TrkStatus trkSampleExtinction(const TrkVolume* volume, const float* points, size_t pointStride,
                              size_t pointCount, float* extinction, size_t extinctionStride) {
    return guard([&] {
        if (!volume) {
            refuse("volume is NULL");
        }
        if (pointCount > 0 && (!points || !extinction)) {
            refuse("points or extinction is NULL; expected " + std::to_string(pointCount) +
                   " points");
        }
        trk::sampleExtinction(
            volume->volume, arrayOf("pointStride", points, 3, pointStride), pointCount,
            arrayOf("extinctionStride", extinction, volume->volume.channels(), extinctionStride));
    });
}
