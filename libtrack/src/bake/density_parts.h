// SPDX-License-Identifier: Apache-2.0
// A density cut into super-voxels, equal ones counted once, with the moments of each: what a bake
// knows before it chooses a control.
#pragma once

#include "control_fit.h"
#include "field/brick_pages.h"
#include "field/density_field.h"
#include "field/sparse_table.h"
#include "moments.h"

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <vector>

namespace trk {

/// Parts: super-voxels that differ, or stand in different places of a control that varies with the
/// place.
class DensityParts {
  public:
    using Entry = SparseTable::Entry;

    /// Finds the parts, by the field's table alone. `distinguished`: parts that look alike, but are
    /// not homogeneous, are each one of its own. `size`: of super-voxels, in voxels.
    DensityParts(const DensityField& field, int size, bool distinguished);

    /// Moments of all parts, in parallel.
    void measure(BrickPages& pages);

    size_t count() const { return origins_.size(); }
    size_t channels() const { return channels_; }
    int size() const { return size_; }
    int shift() const { return table_.itemShift(); }
    /// Maps places to parts, by SparseTable::index.
    const SparseTable& table() const { return table_; }
    /// Local, of the first super-voxel that is this part.
    const Int3& origin(size_t part) const { return origins_[part]; }
    const Moments& moments(size_t part, size_t channel) const {
        return moments_[part * channels_ + channel];
    }
    const CornerMoments& corners(size_t part, size_t channel) const {
        return corners_[part * channels_ + channel];
    }
    bool isEmpty(size_t part) const;
    bool isHomogeneous(size_t part) const;
    /// Memory, once measured.
    uint64_t bytes() const {
        return table_.bytes() +
               count() * (sizeof(Int3) + channels_ * (sizeof(Moments) + sizeof(CornerMoments)));
    }

    /// Calls body(i) for every i in [0, count), in parallel, with the bricks of partOf(i) at hand.
    template <class PartOf, class Body>
    void forEach(BrickPages& pages, size_t count, const PartOf& partOf, const Body& body) const {
        constexpr size_t kGrain = 32;
        const auto bricksOf = [&](size_t i, const auto& f) {
            forEachCube(partOf(i), [&](const Cube& cube) { f(cube.entry); });
        };
        pages.forEach(count, kGrain, bricksOf, body);
    }

    /// The edge of the cubes a super-voxel consists of, in voxels.
    int cubeEdge() const { return cube_; }
    /// Calls body(offset, vertices) for every cube of a part whose bricks are at hand: what of it
    /// lies in one brick. `offset`: in the super-voxel; `vertices`: the first one, in a channel, as
    /// cubeRow wants it.
    template <class Body>
    void forEachCube(const BrickPages& pages, size_t part, size_t channel, const Body& body) const {
        forEachCube(part, [&](const Cube& cube) {
            float buffer[DensityField::kBrickVertices];
            body(cube.offset, verticesOf(pages, cube, channel, buffer));
        });
    }

  private:
    struct Cube {
        Int3 offset;    ///< in the super-voxel
        Entry entry;    ///< of the field, there
        size_t vertex;  ///< its first one in that brick
    };

    template <class Body>
    void forEachCube(size_t part, const Body& body) const {
        constexpr auto kEdge = static_cast<int64_t>(DensityField::kBrickEdge);
        const Int3& origin = origins_[part];
        for (int64_t x = 0; x < size_; x += cube_) {
            for (int64_t y = 0; y < size_; y += cube_) {
                for (int64_t z = 0; z < size_; z += cube_) {
                    const Int3 at{{origin[0] + x, origin[1] + y, origin[2] + z}};
                    const int64_t vertex =
                        ((at[0] & 7) * kEdge + (at[1] & 7)) * kEdge + (at[2] & 7);
                    body(Cube{{{x, y, z}},
                              field_.table().find(at[0], at[1], at[2]).entry,
                              static_cast<size_t>(vertex)});
                }
            }
        }
    }
    const float* verticesOf(const BrickPages& pages, const Cube& cube, size_t channel,
                            float (&buffer)[DensityField::kBrickVertices]) const {
        if (DensityField::isConstant(cube.entry)) {
            std::fill(std::begin(buffer), std::end(buffer), field_.constant(cube.entry)[channel]);
            return buffer;
        }
        return pages.brickChannel(cube.entry, channel, buffer) + cube.vertex;
    }
    template <size_t M>
    void measure(const BrickPages& pages, size_t part);
    void add(const Moments& cube, double count, Moments& all) const;
    void addCorners(const CornerMoments& cube, const Int3& offset, CornerMoments& sum) const;

    const DensityField& field_;
    size_t channels_;
    int size_;
    int cube_;
    SparseTable table_;
    std::vector<Int3> origins_;
    std::vector<Moments> moments_;  // of each part and channel
    std::vector<CornerMoments> corners_;
};

}  // namespace trk
