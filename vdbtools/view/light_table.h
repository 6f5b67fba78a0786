// SPDX-License-Identifier: Apache-2.0
// The light of a sun and a sky that arrives in a volume.
#pragma once

#include "camera.h"
#include "field/sparse_table.h"
#include "volume.h"

#include <array>
#include <cstddef>
#include <cstdint>
#include <vector>

namespace vdbtools {

/// Where the sun stands, in degrees: from the front towards +x, and above the horizon.
struct Sun {
    UpAxis up = UpAxis::kY;
    double azimuth = -29;
    double elevation = 41;
};

/// Radiance, linear, of red, green and blue.
using Light = std::array<float, 3>;

/// Light of a clear late afternoon, through what of a volume is in its way, where the volume holds
/// anything: tabulated at the corners of cells of its bricks, more coarsely in constant regions,
/// and interpolated between them.
class LightTable {
  public:
    /// Computes in parallel.
    LightTable(const trk::Volume& volume, const Sun& sun);

    /// At a place in the volume, in local space.
    Light at(const trk::Vec3d& local) const;

    size_t bytes() const {
        return table_.bytes() + regions_.capacity() * sizeof(Region) +
               light_.capacity() * sizeof(Light);
    }

  private:
    /// A brick of the field, or a constant region: light is tabulated at (cells + 1)^3 places.
    struct Region {
        trk::Int3 lo;
        int shift;
        trk::SparseTable::Entry entry;  // the field's
        int64_t cells;                  // an edge
        size_t first;                   // place, in light_; x slowest
    };

    trk::SparseTable table_;  // to regions_
    std::vector<Region> regions_;
    std::vector<Light> light_;  // what arrives at their places
};

}  // namespace vdbtools
