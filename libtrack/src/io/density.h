// SPDX-License-Identifier: Apache-2.0
// The one loader, for baking and for queries: a grid of a .vdb file becomes an extinction field.
#pragma once

#include "field/brick_pages.h"
#include "field/density_field.h"
#include "space/geometry.h"
#include "volume.h"

#include <cstdint>
#include <memory>
#include <string>

namespace trk {

/// What is held of a density's bricks once it is loaded.
enum class Bricks {
    kAll,
    kAllThatFit,  ///< all, or where maxMemory has no room for them a loader
    kLoader,      ///< a loader
    kNone,        ///< nothing but the summary
};

struct DensityOptions {
    bool gridNamed = false;
    std::string gridName;    ///< NAME or NAME[i], where gridNamed
    uint32_t repair = 0;     ///< TRK_REPAIR_… bits
    uint64_t maxMemory = 0;  ///< 0: no limit
    Bricks bricks = Bricks::kAll;
};

/// What is known of a source grid besides its values.
struct DensitySummary {
    std::string path;          ///< or what stands for it, of a density in memory
    uint64_t fileBytes = 0;    ///< the file's size, or of what is in memory,
                               ///< and when it was written,
    int64_t fileModified = 0;  ///< in nanoseconds since 1970
    GridIdentity grid;
    std::string label;      ///< NAME, or NAME[i] where that alone is ambiguous or empty
    std::string valueType;  ///< "float", "double", "vec3s" or "vec3d"
    AffineMap indexToWorld;
    Int3 anchor{{0, 0, 0}};
    uint64_t digest = 0;  ///< of origins, levels, masks and values as stored, before any repair
    uint64_t activeVoxels = 0;
    uint64_t gridBytes = 0;  ///< what OpenVDB held for the grid
    float min = 0;           ///< smallest and largest value in leaves and tiles
    float max = 0;
    uint32_t repair = 0;  ///< the repairs allowed
    uint64_t dropped = 0;
    uint64_t clamped = 0;
};

struct Density {
    DensitySummary summary;
    DensityField field;                   ///< in local space: index space minus summary.anchor
    std::unique_ptr<BrickLoader> loader;  ///< of the field's bricks, where it holds none

    uint64_t pageBytes = 0;  ///< and of a page of them

    BrickPages pages() const {
        return loader ? BrickPages(field, *loader, pageBytes) : BrickPages(field);
    }
};

/// Loads, checks and converts a grid, in parallel. Without a name: the only grid that could be a
/// density (scalars of class fog volume or unknown, vectors of class fog volume: others may be
/// velocities), else "density". Throws Error.
Density loadDensity(const std::string& path, const DensityOptions& options);

/// What opening a grid and baking it will need, by its structure alone. Bricks are counted as if no
/// leaf had any part of one value: there may be fewer.
struct DensityEstimate {
    uint64_t leaves = 0;
    uint64_t tiles = 0;
    uint64_t bricks = 0;       ///< at most
    uint64_t heldBytes = 0;    ///< by the field; half of it where a file of floats has halfs alone
    uint64_t peakBytes = 0;    ///< while it is loaded
    uint64_t loaderBytes = 0;  ///< without bricks and with a page, at least
    DensityField field;        ///< of as many bricks, without them
};
/// Reads the grid's structure. Throws Error.
DensityEstimate estimateDensity(const std::string& path, const DensityOptions& options);

/// As loadDensity, of a density in memory, whose numbers were found to be in range.
Density makeDensity(const TrkDensity& given, uint32_t repair, uint64_t maxMemory);

}  // namespace trk
