// SPDX-License-Identifier: Apache-2.0
// The only extern "C" file: validates, calls, and turns exceptions into statuses.
#include "track/track.h"

#include "api_structs.h"
#include "failure.h"
#include "kernel.h"
#include "parallel.h"
#include "progress.h"
#include "query/methods.h"
#include "query/sampling.h"
#include "query/transmittance.h"
#include "volume.h"

#include <tbb/task_arena.h>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstring>
#include <exception>
#include <filesystem>
#include <new>
#include <optional>
#include <string>
#include <utility>

struct TrkVolume {
    trk::Volume volume;
};

namespace {

using trk::refuse;

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

/// Refuses a query whose method is none of those wanted, which it names.
template <class Wanted>
void requireMethod(const TrkQuery& query, const char* fault, const Wanted& wanted) {
    if (wanted(trk::traitsOf(query.method))) {
        return;
    }
    std::string expected;
    for (const trk::MethodTraits& method : trk::kMethods) {
        if (wanted(method)) {
            expected += (expected.empty() ? "" : " or ") + std::string(method.constant);
        }
    }
    refuse("method " + std::to_string(query.method) + " " + fault + "; expected " + expected);
}

/// Runs `body` with as many threads (0: all), apart from the caller's own tasks, and tells
/// `progress`, which may be NULL.
template <class Body>
void runLong(int32_t threads, TrkProgress progress, void* data, const Body& body) {
    const auto alone = [&] {
        std::optional<trk::Progress> listener;
        if (progress) {
            listener.emplace(
                [&](double share) { return progress(data, static_cast<float>(share)) == 0; });
        }
        trk::inGroupOfItsOwn(body);
    };
    if (threads == 0) {
        tbb::this_task_arena::isolate(alone);
    } else {
        const int most = tbb::this_task_arena::max_concurrency();
        tbb::task_arena(std::min(threads, most)).execute(alone);
    }
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
        case TRK_ERROR_CANCELLED:
            return "TRK_ERROR_CANCELLED";
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
        const TrkVolumeOptions given = trk::checkedOptions(options);
        if (vdbPath && *vdbPath == '\0') {
            refuse("vdbPath is empty; expected the path of a density, or NULL for a sidecar alone");
        }
        if (!vdbPath && (!sidecarPath || *sidecarPath == '\0')) {
            refuse(
                "vdbPath is NULL, and sidecarPath names no sidecar either; expected the path of at "
                "least one");
        }
        const trk::VolumeOptions opened = trk::volumeOptions(given);
        runLong(given.threads, given.progress, given.progressData,
                [&] { *volume = new TrkVolume{trk::openVolume(vdbPath, sidecarPath, opened)}; });
    });
}

TrkStatus trkMakeVolume(const TrkDensity* density, const TrkVolumeOptions* options,
                        TrkVolume** volume) {
    return guard([&] {
        if (!volume) {
            refuse("volume is NULL; expected where to put the volume that is made");
        }
        *volume = nullptr;
        if (!density) {
            refuse("density is NULL");
        }
        const TrkVolumeOptions given = trk::checkedOptions(options);
        if (given.gridName) {
            refuse("gridName is given; expected NULL, as a density in memory is one grid");
        }
        const TrkDensity complete = trk::checkedDensity(*density);
        const trk::VolumeOptions made = trk::volumeOptions(given);
        runLong(given.threads, given.progress, given.progressData,
                [&] { *volume = new TrkVolume{trk::makeVolume(complete, made)}; });
    });
}

TrkStatus trkBakeVolume(TrkVolume* volume, const TrkBakeOptions* options, const char* sidecarPath) {
    return guard([&] {
        if (!volume) {
            refuse("volume is NULL");
        }
        if (sidecarPath && *sidecarPath == '\0') {
            refuse("sidecarPath is empty; expected the path of a file to write, or NULL for none");
        }
        const TrkBakeOptions given = trk::checkedOptions(options);
        const trk::BakeOptions bake = trk::bakeOptions(given);
        runLong(given.threads, given.progress, given.progressData,
                [&] { trk::bakeVolume(volume->volume, bake, sidecarPath, given.overwrite != 0); });
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
        if (size < trk::kFirstVolumeInfo || size > trk::kAbsurd) {
            refuse("TrkVolumeInfo.size is " + std::to_string(size) + "; expected " +
                   std::to_string(sizeof(TrkVolumeInfo)) + ", its sizeof, set before the call");
        }
        const trk::Volume& volume = handle->volume;
        TrkVolumeInfo result{};
        result.size = size;
        const trk::IntBox& box =
            volume.hasDensity() ? volume.field->box() : volume.superVoxels->box();
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
        result.kernel = trk::kernelName(volume.options.kernel);
        if (volume.hasSuperVoxels()) {
            result.superVoxelSize = static_cast<uint32_t>(volume.superVoxels->size());
            result.superVoxelCount = volume.superVoxels->count();
            result.levels = static_cast<uint32_t>(volume.superVoxels->levelCount());
            result.controlKind = trk::controlName(volume.superVoxels->kind());
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
        const TrkQuery complete = trk::checkedQuery(query, TRK_METHOD_RESIDUAL);
        if (rayCount == 0) {
            return;
        }
        const size_t channels = volume->volume.channels();
        trk::estimateTransmittance(
            volume->volume, complete, rays, rayCount,
            trk::arrayOf("resultStride", transmittance, channels, complete.resultStride),
            trk::checkedStatistics(statistics, channels));
    });
}

TrkStatus trkIntegrateOpticalDepth(const TrkVolume* volume, const TrkQuery* query,
                                   const TrkRay* rays, size_t rayCount, double* opticalDepth) {
    return guard([&] {
        checkPointers(volume, rays, rayCount, opticalDepth);
        const TrkQuery complete = trk::checkedQuery(query, TRK_METHOD_EXACT);
        requireMethod(complete, "is random and has no optical depth",
                      [](const trk::MethodTraits& method) { return !method.isRandom; });
        if (rayCount == 0) {
            return;
        }
        trk::integrateOpticalDepth(volume->volume, complete, rays, rayCount,
                                   trk::arrayOf("resultStride", opticalDepth,
                                                volume->volume.channels(), complete.resultStride));
    });
}

TrkStatus trkSampleFreePath(const TrkVolume* volume, const TrkQuery* query, const TrkRay* rays,
                            size_t rayCount, const TrkFreePaths* paths) {
    return guard([&] {
        checkPointers(volume, rays, rayCount, paths);
        const TrkQuery complete = trk::checkedQuery(query, TRK_METHOD_RESIDUAL);
        requireMethod(complete, "has no free paths",
                      [](const trk::MethodTraits& method) { return method.hasFreePaths; });
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
        const trk::FreePathOutput out = trk::checkedFreePaths(*paths, volume->volume.channels());
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
        trk::sampleExtinction(volume->volume, trk::arrayOf("pointStride", points, 3, pointStride),
                              pointCount,
                              trk::arrayOf("extinctionStride", extinction,
                                           volume->volume.channels(), extinctionStride));
    });
}
