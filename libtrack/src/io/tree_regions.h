// SPDX-License-Identifier: Apache-2.0
// Questions about whole regions of an OpenVDB tree, answered from its nodes, in 64-bit coordinates.
#pragma once

#include "../geometry.h"
#include "openvdb_grids.h"

#include <openvdb/tree/ValueAccessor.h>

#include <algorithm>
#include <cstdint>
#include <limits>
#include <optional>
#include <type_traits>
#include <vector>

namespace trk {

/// Caches its way through the tree: one for each thread.
template <class TreeType>
class TreeRegions {
  public:
    using Leaf = typename TreeType::LeafNodeType;
    using Value = typename TreeType::ValueType;

    struct Region {
        Value value;
        bool active;
    };

    explicit TreeRegions(const TreeType& tree) : tree_(tree), accessor_(tree) {
        for (auto it = tree.root().cbeginChildAll(); it; ++it) {
            Value value = tree.background();
            if (it.probeChild(value) || !(value == tree.background()) || it.isValueOn()) {
                const openvdb::Coord o = it.getCoord();
                rootOrigins_.push_back({{o.x(), o.y(), o.z()}});
            }
        }
    }

    /// NULL where a tile or nothing is.
    const Leaf* leaf(const Int3& at) {
        return inRange(at) ? accessor_.probeConstLeaf(coord(at)) : nullptr;
    }
    Value value(const Int3& at) {
        return inRange(at) ? accessor_.getValue(coord(at)) : tree_.background();
    }

    /// Value and state of the region of 2^shift voxels at `origin`, if it is known to be the same
    /// everywhere: no node divides it into different ones. A leaf counts as divided, and so does a
    /// region that meets one; a single voxel never is.
    std::optional<Region> uniform(const Int3& origin, int shift) {
        const Region nothing{tree_.background(), false};
        if (shift > kUpperShift) {  // may meet several of the root's regions: uniform only if empty
            const int64_t size = int64_t{1} << shift;
            const int64_t rootSize = int64_t{1} << kUpperShift;
            const auto meets = [&](const Int3& o) {
                bool result = true;
                for (size_t a = 0; a < 3; ++a) {
                    result = result && o[a] < origin[a] + size && o[a] + rootSize > origin[a];
                }
                return result;
            };
            return std::any_of(rootOrigins_.begin(), rootOrigins_.end(), meets)
                       ? std::nullopt
                       : std::optional<Region>(nothing);
        }
        const int64_t mask = (int64_t{1} << shift) - 1;
        if (((origin[0] | origin[1] | origin[2]) & mask) != 0) {
            return uniformAcross(origin, shift);
        }
        if (!inRange(origin)) {  // all of it is, as the limits are multiples of 4096
            return nothing;
        }
        const openvdb::Coord at = coord(origin);
        const auto* upper = accessor_.template probeConstNode<Upper>(at);
        if (upper) {
            if (shift == kUpperShift) {
                return std::nullopt;
            }
            if (shift >= kLowerShift) {
                return uniformTiles(*upper, at, shift, kLowerShift);
            }
            if (const auto* lower = accessor_.template probeConstNode<Lower>(at)) {
                if (shift >= kLeafShift) {
                    return uniformTiles(*lower, at, shift, kLeafShift);
                }
            }
        }
        Region region{};
        region.active = accessor_.probeValue(at, region.value);
        return region;
    }

  private:
    using Upper = typename TreeType::RootNodeType::ChildNodeType;  // 4096^3 voxels
    using Lower = typename Upper::ChildNodeType;                   // 128^3 voxels
    static constexpr int kUpperShift = 12;
    static constexpr int kLowerShift = 7;
    static constexpr int kLeafShift = 3;

    /// The same for a region that is not aligned with nodes of its size: whether all the tiles that
    /// it meets agree, and no leaf is among them. Only where there are nodes are their parts looked
    /// at.
    std::optional<Region> uniformAcross(const Int3& origin, int shift) {
        Int3 end;
        for (size_t a = 0; a < 3; ++a) {
            end[a] = origin[a] + (int64_t{1} << shift);
        }
        std::optional<Region> expected;
        const auto agrees = [&](const Region& found) {
            const bool same =
                !expected || (found.value == expected->value && found.active == expected->active);
            expected = found;
            return same;
        };
        const auto inLower = [&](const Lower& lower, const Int3& lo, const Int3& hi) {
            return forEachBlock(lo, hi, kLeafShift, [&](const Int3& at, const Int3&) {
                const auto tile = uniformTiles(lower, coord(at), kLeafShift, kLeafShift);
                return tile && agrees(*tile);
            });
        };
        const auto inUpper = [&](const Upper& upper, const Int3& lo, const Int3& hi) {
            return forEachBlock(lo, hi, kLowerShift, [&](const Int3& at, const Int3& blockEnd) {
                if (const auto tile = uniformTiles(upper, coord(at), kLowerShift, kLowerShift)) {
                    return agrees(*tile);
                }
                return inLower(*accessor_.template probeConstNode<Lower>(coord(at)), at, blockEnd);
            });
        };
        const bool uniform =
            forEachBlock(origin, end, kUpperShift, [&](const Int3& at, const Int3& blockEnd) {
                if (!inRange(at)) {
                    return agrees({tree_.background(), false});
                }
                if (const auto* upper = accessor_.template probeConstNode<Upper>(coord(at))) {
                    return inUpper(*upper, at, blockEnd);
                }
                Region region{};
                region.active = accessor_.probeValue(coord(at), region.value);
                return agrees(region);
            });
        return uniform ? expected : std::nullopt;
    }

    /// Calls f(first place, end) for the part of the box in every aligned block of 2^shift, until
    /// it answers false; whether it never did.
    template <class F>
    static bool forEachBlock(const Int3& lo, const Int3& hi, int shift, const F& f) {
        const int64_t size = int64_t{1} << shift;
        const auto next = [size](int64_t x) { return (x & ~(size - 1)) + size; };
        Int3 at;
        for (at[0] = lo[0]; at[0] < hi[0]; at[0] = next(at[0])) {
            for (at[1] = lo[1]; at[1] < hi[1]; at[1] = next(at[1])) {
                for (at[2] = lo[2]; at[2] < hi[2]; at[2] = next(at[2])) {
                    Int3 end;
                    for (size_t a = 0; a < 3; ++a) {
                        end[a] = std::min(next(at[a]), hi[a]);
                    }
                    if (!f(at, end)) {
                        return false;
                    }
                }
            }
        }
        return true;
    }

    static bool inRange(const Int3& p) {
        return std::all_of(p.begin(), p.end(), [](int64_t x) {
            return x >= std::numeric_limits<int32_t>::min() &&
                   x <= std::numeric_limits<int32_t>::max();
        });
    }
    static openvdb::Coord coord(const Int3& p) {
        return {static_cast<int32_t>(p[0]), static_cast<int32_t>(p[1]), static_cast<int32_t>(p[2])};
    }

    template <class NodeType>
    static std::optional<Region> uniformTiles(const NodeType& node, const openvdb::Coord& at,
                                              int shift, int childShift) {
        const auto tile = [&](openvdb::Index n) -> std::optional<Region> {
            if (node.isChildMaskOn(n)) {
                return std::nullopt;
            }
            return Region{node.getTable()[n].getValue(), node.isValueMaskOn(n)};
        };
        const auto expected = tile(NodeType::coordToOffset(at));
        const int32_t count = 1 << (shift - childShift);
        for (int32_t i = 0; expected && i < count * count * count; ++i) {
            const int32_t x = i / (count * count);
            const int32_t y = i / count % count;
            const int32_t z = i % count;
            const auto found = tile(NodeType::coordToOffset(
                at.offsetBy(x << childShift, y << childShift, z << childShift)));
            if (!found || !(found->value == expected->value) || found->active != expected->active) {
                return std::nullopt;
            }
        }
        return expected;
    }

    const TreeType& tree_;
    openvdb::tree::ValueAccessor<const TreeType, /*IsSafe=*/false> accessor_;
    std::vector<Int3> rootOrigins_;
};

}  // namespace trk
