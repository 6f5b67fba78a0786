/* SPDX-License-Identifier: Apache-2.0 */
/* libtrack: transmittance and free paths of straight rays through OpenVDB volumes. The whole C API,
 * valid C99. */
#ifndef TRACK_TRACK_H
#define TRACK_TRACK_H

#include <stddef.h>
#include <stdint.h>

#if defined(TRACK_STATIC)
#define TRK_API
#elif defined(_WIN32)
#ifdef TRACK_BUILD
#define TRK_API __declspec(dllexport)
#else
#define TRK_API __declspec(dllimport)
#endif
#else
#define TRK_API __attribute__((visibility("default")))
#endif

#ifdef __cplusplus
extern "C" {
#endif

/* ---- Version --------------------------------------------------------------------------------- */

/** Version of this header. */
#define TRK_VERSION_MAJOR 0
#define TRK_VERSION_MINOR 1
#define TRK_VERSION_PATCH 0

/** Version of the library at run time, "major.minor.patch". Static storage. */
TRK_API const char* trkGetVersion(void);

/* ---- Status ---------------------------------------------------------------------------------- */

typedef int32_t TrkStatus;
enum {
    TRK_OK = 0,
    TRK_ERROR_INVALID_ARGUMENT = 1, /**< an argument breaks its contract */
    TRK_ERROR_IO = 2,               /**< a file cannot be opened, read or written */
    TRK_ERROR_BAD_FILE = 3,         /**< not a VDB file, or a damaged or too new one */
    TRK_ERROR_GRID_NOT_FOUND = 4,   /**< no such grid, or several of that name */
    TRK_ERROR_UNSUPPORTED_GRID = 5, /**< a grid whose type, class or map cannot be a density */
    TRK_ERROR_BAD_DENSITY = 6,      /**< negative, NaN or infinite values, or a background not 0 */
    TRK_ERROR_SIDECAR_MISMATCH = 7, /**< the sidecar belongs to another density or version */
    TRK_ERROR_NO_SIDECAR = 8,       /**< the method needs a sidecar and the volume has none */
    TRK_ERROR_NO_DENSITY = 9,       /**< the method needs the density; only a sidecar is open */
    TRK_ERROR_OUT_OF_MEMORY = 10,   /**< no memory left, or more than maxMemory wanted */
    TRK_ERROR_UNKNOWN = 11,
    TRK_ERROR_CANCELLED = 12 /**< the caller's progress function said so */
};

/** "TRK_OK", "TRK_ERROR_IO", …; "TRK_ERROR_UNKNOWN" for any other number. Static storage. */
TRK_API const char* trkGetStatusName(TrkStatus status);

/** One line on what the last failing call *of this thread* found: file, grid, expected, found.
 * Empty before the first failure; a call that succeeds leaves it alone. Valid until this thread's
 * next failing call. */
TRK_API const char* trkGetLastErrorMessage(void);

/* ---- Types ----------------------------------------------------------------------------------- */

/* Every struct but TrkRay begins with its size as the caller's header knows it; the trkDefault…
 * functions set it. A newer library completes an older, smaller struct with 0, which is the default
 * of every field added after the first release. An older library takes a newer, larger struct where
 * all that it does not know is 0, and refuses it otherwise. TrkRay stays as it is. */

/** An opened volume. Any number of threads may query one; only closing and baking it
 *  must not run beside other calls on it. */
typedef struct TrkVolume TrkVolume;

/** The points origin + t direction, t in [tMin, tMax], in world space. The direction need not have
 *  unit length: optical depth is an integral over length, not over t. tMax may be infinite and tMin
 *  negative; tMin >= tMax is an empty interval, whose transmittance is 1. */
typedef struct TrkRay {
    float origin[3];
    float tMin;
    float direction[3];
    float tMax;
} TrkRay;

/** How transmittance is computed. Methods with "unbiased" have the exact value as their mean;
 * single estimates may then be negative or exceed 1, and are never clamped. */
typedef int32_t TrkMethod;
enum {
    TRK_METHOD_EXACT = 0,    /**< regular tracking: closed form per voxel cell, no noise, slowest */
    TRK_METHOD_RESIDUAL = 1, /**< residual ratio tracking, unbiased; needs a sidecar [Novak14] */
    TRK_METHOD_RATIO = 2,    /**< ratio tracking, unbiased; needs a sidecar [Novak14] */
    TRK_METHOD_CONTROL = 3,  /**< the baked control alone: biased, no noise, for level of detail */
    TRK_METHOD_DELTA = 4,    /**< delta tracking: unbiased, 0 or 1, most noise; needs a sidecar */
    TRK_METHOD_MARCH = 5,    /**< ray marching from a random offset: biased, noise where steps are
                                  long; the density alone */
    TRK_METHOD_COMB = 6 /**< unbiased ray marching: little noise, and fast where volumes are deep;
                             needs a sidecar [Kettunen21] */
};

/** The control of the residual method, chosen per super-voxel when a volume is opened. Sidecars
 * with trilinear or affine controls know robust and mean, which is the control as baked. */
typedef int32_t TrkChoice;
enum {
    TRK_CHOICE_ROBUST =
        0,               /**< near the mean in thin super-voxels, near the minimum in thick ones */
    TRK_CHOICE_MEAN = 1, /**< the mean: least variance where super-voxels are thin */
    TRK_CHOICE_MIN = 2,  /**< the minimum: at rate 1 on the majorant and without roulette, no
                              estimate is above the control's transmittance */
    TRK_CHOICE_MAX = 3   /**< the maximum. Experimental: there to compare with */
};

/** What the sampling rate of residual and ratio tracking is a multiple of, per super-voxel.
 *  Experimental: there to compare with, and may change before 1.0. */
typedef int32_t TrkRateBase;
enum {
    TRK_RATE_BASE_MAJORANT = 0, /**< a bound of |residual|: at rate 1 weights stay within 0 and 2 */
    TRK_RATE_BASE_RMS = 1 /**< the residual's root mean square, a quarter of the bound at least:
                               fewer look-ups, put where they lower variance most; weights may be
                               negative */
};

/** How the control of a bake varies within a super-voxel. */
typedef int32_t TrkControlKind;
enum {
    TRK_CONTROL_CONSTANT = 0,  /**< the mean */
    TRK_CONTROL_TRILINEAR = 1, /**< interpolated between corner values: continuous */
    TRK_CONTROL_AFFINE = 2     /**< the mean and a gradient */
};

/** Called during a long call, in the thread that made the call, ten times a second at most: `share`
 *  of the work is done, 0 to 1, never less than before. Answers 0 to go on; anything else ends the
 *  call with TRK_ERROR_CANCELLED, well within a second. It may use other volumes; it must not throw
 *  or jump out. */
typedef int32_t (*TrkProgress)(void* data, float share);

/** What opening a volume checks of its sidecar. */
typedef int32_t TrkCheck;
enum {
    TRK_CHECK_FULL = 0,    /**< the density's digest and the plausibility of every bound */
    TRK_CHECK_METADATA = 1 /**< names, versions and transforms only */
};

/** Bits of TrkVolumeOptions.repair: values to replace by 0 instead of refusing the grid. */
enum { TRK_REPAIR_DROP_NONFINITE = 1, TRK_REPAIR_CLAMP_NEGATIVE = 2 };

/* ---- Options --------------------------------------------------------------------------------- */

/** How to open a volume. Fill it with trkDefaultVolumeOptions(), then change what you need. */
typedef struct TrkVolumeOptions {
    size_t size;          /**< sizeof(TrkVolumeOptions) */
    const char* gridName; /**< NAME or NAME[i]; NULL: the only density-like grid, else "density" */
    float scale;          /**< extinction = scale x density, in 1/world unit; finite and >= 0 */
    float color[3];     /**< extinction of channel k = scale x color[k] x density; finite and >= 0.
                             Tints a density of one channel, which then has three unless all
                             agree; a channel of 0 has a transmittance of exactly 1 */
    TrkChoice choice;   /**< control of TRK_METHOD_RESIDUAL */
    uint32_t global;    /**< 1: random methods take the whole volume for one super-voxel, with a
                             constant control and bounds of its own, whatever was baked; 0: the
                             super-voxels as baked. Experimental: there to compare with */
    TrkCheck check;     /**< how far to distrust the sidecar */
    uint32_t repair;    /**< TRK_REPAIR_… bits; those the sidecar was baked with are added */
    int32_t threads;    /**< threads used for opening; 0: all */
    uint32_t noBake;    /**< 1: a density without a sidecar stays without super-voxels, and what
                             needs them fails with TRK_ERROR_NO_SIDECAR; 0: it gets a bake in
                             memory, of the default TrkBakeOptions, for a part of what reading it
                             takes */
    uint64_t maxMemory; /**< refuse to hold more bytes than this; 0: no limit */
    TrkProgress progress;    /**< or NULL */
    void* progressData;      /**< handed to it */
    const char* kernel;      /**< whose code queries of the volume run: "avx2", or "baseline", which
                                every processor has; NULL: the best of the processor, unless the
                                environment variable TRACK_KERNEL says "baseline". Results have the
                                same bits on one kernel, and differ in the last ones between two */
    uint32_t superVoxelSize; /**< larger super-voxels than were baked, made of those in
                                  milliseconds: up to 64 voxels; 0: as baked. A bake in memory gets
                                  this size. Not of a trilinear control */
    uint32_t reserved;       /**< 0 */
} TrkVolumeOptions;

static inline TrkVolumeOptions trkDefaultVolumeOptions(void) {
    TrkVolumeOptions options;
    options.size = sizeof(TrkVolumeOptions);
    options.gridName = NULL;
    options.scale = 1.0f;
    options.color[0] = options.color[1] = options.color[2] = 1.0f;
    options.choice = TRK_CHOICE_ROBUST;
    options.global = 0;
    options.check = TRK_CHECK_FULL;
    options.repair = 0;
    options.threads = 0;
    options.noBake = 0;
    options.maxMemory = 0;
    options.progress = NULL;
    options.progressData = NULL;
    options.kernel = NULL;
    options.superVoxelSize = 0;
    options.reserved = 0;
    return options;
}

/** What to bake. Fill it with trkDefaultBakeOptions(), then change what you need. */
typedef struct TrkBakeOptions {
    size_t size;             /**< sizeof(TrkBakeOptions) */
    uint32_t superVoxelSize; /**< edge in voxels: 4, 8, 16, 32 or 64 */
    TrkControlKind control;
    uint32_t levels;    /**< preview levels at most, each of super-voxels twice as large; 0 to 8 */
    uint32_t overwrite; /**< 1: replace a file that is there; 0: fail */
    int32_t threads;    /**< used for baking; 0: all */
    uint32_t reserved;  /**< 0 */
    uint64_t maxMemory; /**< refuse to hold more bytes than this, density included; 0: no limit */
    TrkProgress progress; /**< or NULL */
    void* progressData;   /**< handed to it */
} TrkBakeOptions;

static inline TrkBakeOptions trkDefaultBakeOptions(void) {
    TrkBakeOptions options;
    options.size = sizeof(TrkBakeOptions);
    options.superVoxelSize = 16;
    options.control = TRK_CONTROL_CONSTANT;
    options.levels = 4;
    options.overwrite = 0;
    options.threads = 0;
    options.reserved = 0;
    options.maxMemory = 0;
    options.progress = NULL;
    options.progressData = NULL;
    return options;
}

/** Type of the values of a density in memory. */
typedef int32_t TrkValueType;
enum {
    TRK_VALUE_FLOAT = 0,
    TRK_VALUE_DOUBLE = 1,
    TRK_VALUE_HALF = 2 /**< IEEE 754 binary16 */
};

/** A density in your memory: a dense array, or bricks of 8^3 voxels and tiles (what OpenVDB's trees
 *  are made of; track_openvdb.hpp fills this in from a grid), or both empty. Everywhere else it is
 *  0. All is copied; nothing is kept. Positions are integer index coordinates: voxel centres.
 *  Fill it with trkDefaultDensity(), then say what you have. */
typedef struct TrkDensity {
    size_t size;             /**< sizeof(TrkDensity) */
    const char* name;        /**< of the grid, for messages and sidecars; NULL: "density" */
    TrkValueType valueType;  /**< of all values */
    uint32_t channels;       /**< 1, or 3: one extinction a channel */
    double indexToWorld[12]; /**< world = first nine (rows) x index + last three */

    const void* values;    /**< dense: of the voxel at `origin`, or NULL */
    int32_t origin[3];     /**< dense: index coordinates of the first voxel */
    uint32_t reserved;     /**< 0 */
    uint64_t extent[3];    /**< dense: voxels along x, y, z */
    int64_t strides[3];    /**< dense: bytes from a voxel to the next along x, y, z; all 0: without
                                gaps, x fastest */
    int64_t channelStride; /**< dense: bytes from a channel to the next; 0: side by side */

    size_t brickCount;
    const int32_t* brickOrigins;    /**< x, y, z a brick: multiples of 8, no two alike */
    const void* const* brickValues; /**< of each brick, 512 voxels without gaps, z fastest,
                                         channels side by side */
    const uint64_t* brickMasks;     /**< of each brick 8 words, a bit a voxel, set where it is
                                         active; NULL: all are. Active or not, values count; a
                                         sidecar fits what has the same masks */

    size_t tileCount;
    const int32_t* tileOrigins; /**< x, y, z a tile: multiples of its size */
    const int32_t* tileSizes;   /**< edge in voxels: 8, 128 or 4096 */
    const void* tileValues;     /**< of each tile, `channels` values */
    const uint8_t* tileActive;  /**< of each tile 1 or 0; NULL: all are active */
} TrkDensity;

static inline TrkDensity trkDefaultDensity(void) {
    TrkDensity density;
    int i;
    density.size = sizeof(TrkDensity);
    density.name = NULL;
    density.valueType = TRK_VALUE_FLOAT;
    density.channels = 1;
    for (i = 0; i < 12; ++i) {
        density.indexToWorld[i] = i == 0 || i == 4 || i == 8 ? 1.0 : 0.0;
    }
    density.values = NULL;
    density.reserved = 0;
    for (i = 0; i < 3; ++i) {
        density.origin[i] = 0;
        density.extent[i] = 0;
        density.strides[i] = 0;
    }
    density.channelStride = 0;
    density.brickCount = 0;
    density.brickOrigins = NULL;
    density.brickValues = NULL;
    density.brickMasks = NULL;
    density.tileCount = 0;
    density.tileOrigins = NULL;
    density.tileSizes = NULL;
    density.tileValues = NULL;
    density.tileActive = NULL;
    return density;
}

/** Bits of TrkQuery.flags. */
enum {
    /** Integrate a super-voxel exactly where that is faster than tracking it. On by default.
        Without it, the time a ray takes goes with its optical depth; from a billion look-ups in one
        super-voxel on, that is integrated exactly all the same. */
    TRK_QUERY_EXACT_FALLBACK = 1,
    /** End a walk early, without bias, where its product of weights is clearly below 1/16 (below
        1/32, always): with probability product x 16 it goes on, and counts for 1/16. On by
        default. */
    TRK_QUERY_ROULETTE = 2
};

/** What to ask. Fill it with trkDefaultQuery(), then change what you need.
 *
 *  Random numbers follow from (seed, stream, ray id, sample) and nothing else: a result has the
 * same bits for single rays and batches, any number of threads, any split or order. So a call that
 *  repeats all four repeats its answer. Give every ray of a picture an id of its own, the same in
 *  every call about it (pixel x samples per pixel + sample), and every use of that ray's random
 *  numbers a stream of its own: each bounce, each light, each of several volumes. Estimates of
 *  different ids or streams are independent and may be multiplied; those of one id and stream agree
 *  with each other far too well. */
typedef struct TrkQuery {
    size_t size;          /**< sizeof(TrkQuery) */
    TrkMethod method;     /**< default TRK_METHOD_RESIDUAL; of trkIntegrateOpticalDepth, where the
                               query is NULL, TRK_METHOD_EXACT */
    uint32_t samples;     /**< estimates averaged per ray, >= 1; methods without noise ignore it */
    float rate;           /**< multiplies the sampling rate: more look-ups, less variance. > 0; any
                               is unbiased. Of delta and free paths it multiplies the majorant, and
                               must be >= 1 */
    TrkRateBase rateBase; /**< of residual and ratio. Experimental */
    float step;      /**< of TRK_METHOD_MARCH and TRK_METHOD_COMB: voxel lengths between look-ups;
                          >= 0.001 */
    uint32_t level;  /**< of TRK_METHOD_CONTROL: 0 the baked super-voxels, k 2^k larger ones */
    uint32_t flags;  /**< TRK_QUERY_… bits */
    int32_t threads; /**< 0: all, 1: the calling thread alone, n: at most n */
    uint64_t seed;   /**< of the random numbers */
    uint64_t stream; /**< see above */
    uint64_t firstRayId;    /**< ray i has id firstRayId + i, unless rayIds is given */
    const uint64_t* rayIds; /**< one id a ray, or NULL */
    size_t rayStride;       /**< bytes from one TrkRay to the next; 0: sizeof(TrkRay) */
    size_t resultStride;    /**< bytes from one ray's transmittance or optical depth to the next
                                 ray's; 0: those of its channels */
} TrkQuery;

static inline TrkQuery trkDefaultQuery(void) {
    TrkQuery query;
    query.size = sizeof(TrkQuery);
    query.method = TRK_METHOD_RESIDUAL;
    query.samples = 1;
    query.rate = 1.0f;
    query.rateBase = TRK_RATE_BASE_MAJORANT;
    query.step = 1.0f;
    query.level = 0;
    query.flags = (uint32_t)TRK_QUERY_EXACT_FALLBACK | (uint32_t)TRK_QUERY_ROULETTE;
    query.threads = 0;
    query.seed = 0;
    query.stream = 0;
    query.firstRayId = 0;
    query.rayIds = NULL;
    query.rayStride = 0;
    query.resultStride = 0;
    return query;
}

/** What answering each ray took, where you want to know: every member is an array of yours with one
 *  entry a ray, or NULL. Strides are bytes from one ray's entry to the next; 0: without gaps. Fill
 * it with trkDefaultStatistics(), then point at what you want. */
typedef struct TrkStatistics {
    size_t size;          /**< sizeof(TrkStatistics) */
    float* standardError; /**< of the mean, `channels` floats a ray. 0 where the result is known
                               exactly: by the exact method, or where a random one found nothing to
                               be random about. NaN where it is not known: of biased methods, of
                               one sample, and where all samples agree by chance */
    size_t standardErrorStride;
    uint64_t* lookups; /**< density values interpolated, over all samples */
    size_t lookupsStride;
    uint64_t* superVoxels; /**< occupied regions met, all samples: super-voxels, or for the exact
                                method bricks; equal neighbours may count as one; delta tracking in
                                colour walks, and counts, once a channel */
    size_t superVoxelsStride;
    float* exactShare; /**< part of the clipped length that was integrated exactly, 0 to 1 */
    size_t exactShareStride;
} TrkStatistics;

static inline TrkStatistics trkDefaultStatistics(void) {
    TrkStatistics statistics;
    statistics.size = sizeof(TrkStatistics);
    statistics.standardError = NULL;
    statistics.standardErrorStride = 0;
    statistics.lookups = NULL;
    statistics.lookupsStride = 0;
    statistics.superVoxels = NULL;
    statistics.superVoxelsStride = 0;
    statistics.exactShare = NULL;
    statistics.exactShareStride = 0;
    return statistics;
}

/** Random free paths: every member is an array of yours with one entry a ray, or NULL where you do
 *  not want it. Strides are bytes from one ray's entry to the next; 0: without gaps. Fill it with
 *  trkDefaultFreePaths(), then point at what you want.
 *
 *  For channel k with extinction mu_k and transmittance T_k along the ray, and any function f of t:
 *  E[weight[k] f(t), where t is finite] is the integral of T_k mu_k f over the ray, and
 * E[weight[k], where t is infinite] is the T_k of the whole ray. So a path tracer multiplies its
 * throughput by weight x albedo where the path collides, by weight where it escapes. Where
 *  volumes overlap, the nearest of their paths, if each was given a stream of its own, is one of
 * all together; its weight is the product of all their weights. */
typedef struct TrkFreePaths {
    size_t size; /**< sizeof(TrkFreePaths) */
    float* t;    /**< where it collides, in the ray's own parameter; +infinity: it escapes */
    size_t tStride;
    float* weight; /**< `channels` floats a ray; 1 in a grey volume. Of three, they sum to 3, so
                      that none is larger, and are not negative */
    size_t weightStride;
    float* extinction; /**< where it collides, in 1/world unit, `channels` floats a ray; 0 where it
                            escapes. Where NULL, decomposition tracking saves the look-up of
                            collisions with the control */
    size_t extinctionStride;
    uint32_t* lookups; /**< density values interpolated */
    size_t lookupsStride;
} TrkFreePaths;

static inline TrkFreePaths trkDefaultFreePaths(void) {
    TrkFreePaths paths;
    paths.size = sizeof(TrkFreePaths);
    paths.t = NULL;
    paths.tStride = 0;
    paths.weight = NULL;
    paths.weightStride = 0;
    paths.extinction = NULL;
    paths.extinctionStride = 0;
    paths.lookups = NULL;
    paths.lookupsStride = 0;
    return paths;
}

/** What a volume holds. Strings live as long as the volume. */
typedef struct TrkVolumeInfo {
    size_t size;              /**< set by the caller before the call: sizeof(TrkVolumeInfo) */
    double boundsMin[3];      /**< world-space box outside which the extinction is 0; */
    double boundsMax[3];      /**< min = max = 0 for an empty volume */
    double indexToWorld[12];  /**< world = first nine (rows) x index + last three */
    uint64_t activeVoxels;    /**< of the source grid; 0 where only a sidecar is open */
    uint64_t bytes;           /**< held by the volume */
    uint64_t superVoxelCount; /**< occupied ones; 0 where there is no sidecar */
    uint32_t channels;        /**< values per ray that queries write: 1 or 3 */
    uint32_t hasDensity;      /**< 1 where exact, residual and ratio have what they look up */
    uint32_t superVoxelSize;  /**< in voxels; 0 where there is no sidecar */
    uint32_t levels;          /**< preview levels above 0 */
    const char* gridName;     /**< of the source grid */
    const char* controlKind;  /**< "constant", "trilinear" or "affine"; "" without a sidecar */
    const char* storage;      /**< "float" or "half", "" where only a sidecar is open */
    const char* kernel;       /**< whose code queries run: see TrkVolumeOptions.kernel */
} TrkVolumeInfo;

/* ---- Volume ---------------------------------------------------------------------------------- */

/** Opens a volume into *volume (NULL on failure); close it with trkCloseVolume.
 *  vdbPath: the density, or NULL to open a sidecar alone (TRK_METHOD_CONTROL only).
 *  sidecarPath: a file written by `vdbtrack bake` or trkBakeVolume; NULL: NAME.track.vdb beside
 *  NAME.vdb if it exists; "": none. A sidecar that does not fit the density is an error, never
 *  ignored; a density without one is baked in memory, unless options->noBake says no.
 *  options: NULL for the defaults.
 *  Fails with INVALID_ARGUMENT, IO, BAD_FILE, GRID_NOT_FOUND, UNSUPPORTED_GRID, BAD_DENSITY,
 *  SIDECAR_MISMATCH, OUT_OF_MEMORY, CANCELLED. Runs on TBB, apart from the caller's own tasks:
 * cancelling those changes nothing here. Thread-safe. */
TRK_API TrkStatus trkOpenVolume(const char* vdbPath, const char* sidecarPath,
                                const TrkVolumeOptions* options, TrkVolume** volume);

/** Makes a volume of a density in memory, as trkOpenVolume would of a file with these voxels:
 * queries have the same bits. It is baked in memory, unless options->noBake says no; trkBakeVolume
 * bakes it otherwise. options: NULL for the defaults; gridName must be NULL, check is ignored.
 *  Fails with INVALID_ARGUMENT (a pointer, count, origin or map that cannot be), BAD_DENSITY,
 *  UNSUPPORTED_GRID (a map that is singular or not finite), OUT_OF_MEMORY, CANCELLED. Otherwise as
 *  trkOpenVolume. */
TRK_API TrkStatus trkMakeVolume(const TrkDensity* density, const TrkVolumeOptions* options,
                                TrkVolume** volume);

/** Bakes an open volume again, with other super-voxels or another control, and uses that from then
 *  on. The volume must have its density, and no other call may use it meanwhile: bake before the
 *  first query. options: NULL for the defaults. sidecarPath: where to write the bake, whole or not
 *  at all, for trkOpenVolume and everything that reads .vdb files; NULL: nowhere.
 *  Fails with INVALID_ARGUMENT, NO_DENSITY, IO, OUT_OF_MEMORY, CANCELLED; the volume is then as it
 *  was. Runs on TBB as trkOpenVolume does. */
TRK_API TrkStatus trkBakeVolume(TrkVolume* volume, const TrkBakeOptions* options,
                                const char* sidecarPath);

/** Releases a volume; NULL is allowed. No other call may use it any more. */
TRK_API void trkCloseVolume(TrkVolume* volume);

/** Fills *info, whose size the caller has set; members of a newer header become 0. Thread-safe. */
TRK_API TrkStatus trkGetVolumeInfo(const TrkVolume* volume, TrkVolumeInfo* info);

/* ---- Query ----------------------------------------------------------------------------------- */

/** Estimates the transmittance of rayCount rays. Where volumes overlap, the product of their
 *  transmittances is that of all together, if each was given a stream of its own.
 *  query: NULL for the defaults. rays: query->rayStride bytes apart.
 *  transmittance: room for `channels` floats a ray, query->resultStride bytes apart.
 *  statistics: where to put what it took, or NULL.
 *  A single ray takes no lock, allocation or task; a batch runs on TBB, apart from the caller's own
 *  tasks: cancelling those changes nothing here. Fails with INVALID_ARGUMENT (naming the first bad
 *  ray), NO_SIDECAR or NO_DENSITY before any result is written. Thread-safe. */
TRK_API TrkStatus trkEstimateTransmittance(const TrkVolume* volume, const TrkQuery* query,
                                           const TrkRay* rays, size_t rayCount,
                                           float* transmittance, const TrkStatistics* statistics);

/** Integrates the optical depth (the integral of extinction over length, without unit) of rayCount
 *  rays. query: NULL for TRK_METHOD_EXACT; query->method: TRK_METHOD_EXACT or TRK_METHOD_CONTROL.
 *  opticalDepth: room for `channels` doubles a ray, query->resultStride bytes apart. Otherwise as
 *  trkEstimateTransmittance. */
TRK_API TrkStatus trkIntegrateOpticalDepth(const TrkVolume* volume, const TrkQuery* query,
                                           const TrkRay* rays, size_t rayCount,
                                           double* opticalDepth);

/** Samples one free path for each of rayCount rays: where a photon collides, and with what weight.
 *  query->method: TRK_METHOD_RESIDUAL for decomposition tracking (default; the minimum of each
 *  super-voxel is a control whose collisions take no look-up) or TRK_METHOD_DELTA for delta
 * tracking. Both have the same distribution. In colour, one path serves all channels, with a weight
 * each (spectral tracking) [Kutz17]. query->samples must be 1; for several paths of a ray give
 * different streams or ray ids. A free path is independent of the transmittance estimates of the
 * same ray, stream and seed. paths: where to put the results; `t` must not be NULL. Otherwise as
 *  trkEstimateTransmittance. */
TRK_API TrkStatus trkSampleFreePath(const TrkVolume* volume, const TrkQuery* query,
                                    const TrkRay* rays, size_t rayCount, const TrkFreePaths* paths);

/** Interpolates the extinction at pointCount points of world space, in the calling thread.
 *  points: x, y, z, finite, pointStride bytes apart; 0: 3 floats. extinction: room for `channels`
 *  floats a point, extinctionStride bytes apart (0: without gaps), in 1/world unit; 0 outside the
 *  volume. Fails with INVALID_ARGUMENT (naming the first bad point) or NO_DENSITY before any result
 *  is written. Thread-safe. */
TRK_API TrkStatus trkSampleExtinction(const TrkVolume* volume, const float* points,
                                      size_t pointStride, size_t pointCount, float* extinction,
                                      size_t extinctionStride);

#ifdef __cplusplus
}
#endif

#endif /* TRACK_TRACK_H */
