// SPDX-License-Identifier: Apache-2.0
// What a look at every leaf and tile of a density finds: values that are not fit, the digest, the
// extent.
#pragma once

#include "density_types.h"
#include "failure.h"
#include "hash.h"
#include "region_source.h"
#include "space/geometry.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <limits>
#include <string>

namespace trk {

struct BadValues {
    uint64_t count = 0;
    Int3 first{{0, 0, 0}};

    void add(uint64_t n, const Int3& at) {
        if (n > 0) {
            first = count == 0 ? at : std::min(first, at);
            count += n;
        }
    }
};

/// What one pass over a source's leaves and tiles found.
struct RegionScan {
    BadValues negative;
    BadValues nonfinite;
    uint64_t digest = 0;
    uint64_t activeVoxels = 0;
    bool any = false;  ///< min and max are of something
    float min = 0;
    float max = 0;
    IntBox box;  ///< index space; cells where the trilinear field may differ from 0

    /// The box in space relative to `anchor`.
    IntBox localBox(const Int3& anchor) const {
        IntBox local = box;
        for (size_t a = 0; a < 3; ++a) {
            local.lo[a] -= anchor[a];
            local.hi[a] -= anchor[a];
        }
        return local;
    }
    void addRange(float lo, float hi) {
        min = any ? std::min(min, lo) : lo;
        max = any ? std::max(max, hi) : hi;
        any = true;
    }
    void join(const RegionScan& o) {
        negative.add(o.negative.count, o.negative.first);
        nonfinite.add(o.nonfinite.count, o.nonfinite.first);
        digest += o.digest;
        activeVoxels += o.activeVoxels;
        if (o.any) {
            addRange(o.min, o.max);
        }
        if (!o.box.empty()) {
            box.add(o.box.lo, o.box.hi);
        }
    }
};

/// The cells that a region of `size`^3 voxels has an influence on.
inline void addSupport(const std::array<int32_t, 3>& o, int64_t size, RegionScan& scan) {
    scan.box.add({{int64_t{o[0]} - 1, int64_t{o[1]} - 1, int64_t{o[2]} - 1}},
                 {{o[0] + size, o[1] + size, o[2] + size}});
}

template <class Value>
void scanValue(const Value& value, const Int3& at, uint64_t count, RegionScan& scan) {
    const Sample<Value> floats = toFloats(value);
    // A double beyond float's range is infinite to the field.
    if (!std::all_of(floats.begin(), floats.end(), [](float v) { return std::isfinite(v); })) {
        scan.nonfinite.add(count, at);
    } else if (std::any_of(floats.begin(), floats.end(), [](float v) { return v < 0; })) {
        scan.negative.add(count, at);
    }
    for (const float f : fieldValue(value)) {
        scan.addRange(f, f);
    }
}

/// Adds a leaf, whose values as the field holds them go to `floats`.
template <class Value>
void scanLeaf(const Value* values, const uint64_t* mask, const std::array<int32_t, 3>& origin,
              RegionScan& scan, Sample<Value>* floats) {
    const int32_t key[4] = {origin[0], origin[1], origin[2], 0};
    scan.digest += hashWords(values, LeafBatch<Value>::kLeafVoxels * sizeof(Value) / 8,
                             hashWords(mask, 8, hashWords(key, 2, 0)));
    for (size_t w = 0; w < 8; ++w) {
        scan.activeVoxels += static_cast<uint64_t>(__builtin_popcountll(mask[w]));
    }
    // First branch-free over all, as nearly every leaf is fine; then, where not, voxel by voxel.
    constexpr size_t kLeafVoxels = LeafBatch<Value>::kLeafVoxels;
    constexpr size_t kCount = kLeafVoxels * ValueTraits<Value>::kChannels;
    const auto* components = ValueTraits<Value>::components(values);
    float* to = floats->data();
    bool fine = true;
    float lo = std::numeric_limits<float>::infinity();
    float hi = 0;
    for (size_t i = 0; i < kCount; ++i) {
        const auto v = static_cast<float>(components[i]);
        fine = fine & (v >= 0) & (v <= std::numeric_limits<float>::max());
        lo = std::min(lo, v);
        hi = std::max(hi, v);
        to[i] = v + 0.0f;  // without negative zeros
    }
    if (fine) {
        scan.addRange(lo + 0.0f, hi);
    } else {
        for (size_t i = 0; i < LeafBatch<Value>::kLeafVoxels; ++i) {
            const auto n = static_cast<int64_t>(i);
            scanValue(values[i],
                      {{origin[0] + (n >> 6), origin[1] + (n >> 3 & 7), origin[2] + (n & 7)}}, 1,
                      scan);
            floats[i] = fieldValue(values[i]);
        }
    }
    if (hi > 0 || !fine) {
        addSupport(origin, 8, scan);
    }
}

template <class Value>
void scanTile(const Tile<Value>& tile, RegionScan& scan) {
    const int64_t size = int64_t{1} << tile.shift;
    const auto voxels = static_cast<uint64_t>(size * size * size);
    const int32_t key[4] = {tile.origin[0], tile.origin[1], tile.origin[2], tile.shift};
    constexpr size_t kChannels = ValueTraits<Value>::kChannels;
    double value[kChannels + 1];
    for (size_t c = 0; c < kChannels; ++c) {
        value[c] = static_cast<double>(ValueTraits<Value>::components(&tile.value)[c]);
    }
    value[kChannels] = tile.active ? 1.0 : 0.0;
    scan.digest += hashWords(value, kChannels + 1, hashWords(key, 2, 1));
    scan.activeVoxels += tile.active ? voxels : 0;
    scanValue(tile.value, {{tile.origin[0], tile.origin[1], tile.origin[2]}}, voxels, scan);
    if (!(tile.value == Value{})) {
        addSupport(tile.origin, size, scan);
    }
}

/// Leaves are counted in 27 bits wherever bricks are.
template <class Value>
void checkLeafCount(const RegionSource<Value>& source, const std::string& where) {
    if (source.leafCount() >= size_t{1} << 27) {
        throw Error(TRK_ERROR_OUT_OF_MEMORY, where + ": has more than 2^27 leaves of 8^3 voxels");
    }
}

}  // namespace trk
