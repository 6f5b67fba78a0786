// SPDX-License-Identifier: Apache-2.0
// Rays from CSV files.
#pragma once

#include "track/track.h"

#include <string>
#include <vector>

namespace apps {

/// The rays of a CSV file, or of standard input where `path` is "-". Its first line may name the
/// columns ox,oy,oz,dx,dy,dz[,tmin,tmax] in any order; without, they stand in this one. Blank
/// lines, lines that begin with # and a byte order mark are skipped; anything else that is no ray
/// throws trk::Error naming the line, and so does tmin > tmax.
std::vector<TrkRay> readRays(const std::string& path);

}  // namespace apps
