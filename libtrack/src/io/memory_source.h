// SPDX-License-Identifier: Apache-2.0
// Densities in the caller's memory as sources of regions: dense arrays, and bricks with tiles.
#pragma once

#include "region_source.h"
#include "track/track.h"

#include <memory>
#include <string>

namespace trk {

/// The source for a density whose values are, as the field sees them, of type `Value`: float (also
/// for halfs), double, openvdb::Vec3f or Vec3d. `density`, whose numbers were found to be in range
/// (see api_structs.h), must live as long. Throws Error (INVALID_ARGUMENT) where regions are not
/// aligned or overlap; `where` begins the message.
template <class Value>
std::unique_ptr<RegionSource<Value>> makeMemorySource(const TrkDensity& density,
                                                      const std::string& where);

}  // namespace trk
