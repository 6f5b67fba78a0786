// SPDX-License-Identifier: Apache-2.0
// What every kind of density is to those who build a field from it: tiles, each of one value, and
// leaves of 8^3 values, which come by once.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <functional>
#include <vector>

namespace trk {

/// A region of 2^shift voxels of one value, in index space.
template <class Value>
struct Tile {
    std::array<int32_t, 3> origin;
    int shift;  ///< 3, 7 or 12, as OpenVDB's nodes are
    Value value;
    bool active;
};

/// Leaves one after another: of each the 8 words of its mask of active voxels, and its values.
template <class Value>
struct LeafBatch {
    static constexpr size_t kLeafVoxels = 512;  ///< x slowest

    size_t first;  ///< which of the source's leaves comes first
    size_t count;
    const uint64_t* masks;
    const Value* values;
    const uint32_t* some = nullptr;  ///< which leaves these are, where they do not follow `first`

    size_t index(size_t i) const { return some ? some[i] : first + i; }
    const uint64_t* mask(size_t i) const { return masks + 8 * i; }
    const Value* leaf(size_t i) const { return values + kLeafVoxels * i; }
};

/// Leaves and tiles are aligned to their size, disjoint, and in a fixed order; everywhere else is
/// 0. A new kind of density is a class derived from this one.
template <class Value>
class RegionSource {
  public:
    using Origin = std::array<int32_t, 3>;

    virtual ~RegionSource() = default;

    const Value& background() const { return background_; }
    /// Those that are active or not 0.
    const std::vector<Tile<Value>>& tiles() const { return tiles_; }
    size_t leafCount() const { return leafOrigins_.size(); }
    const std::vector<Origin>& leafOrigins() const { return leafOrigins_; }
    /// Memory that the lists of leaves and tiles take.
    virtual size_t listBytes() const {
        return leafOrigins_.size() * sizeof(Origin) + tiles_.size() * sizeof(Tile<Value>);
    }
    /// Whether the values are halfs, whatever type holds them.
    bool isHalf() const { return half_; }

    /// Calls body(batch) for all leaves, from several threads at once, each leaf once. May be
    /// called again. Throws Error, and what `body` throws.
    virtual void forEachBatch(const std::function<void(const LeafBatch<Value>&)>& body) = 0;

  protected:
    Value background_{};
    std::vector<Tile<Value>> tiles_;
    std::vector<Origin> leafOrigins_;
    bool half_ = false;
};

}  // namespace trk
