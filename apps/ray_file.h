// SPDX-License-Identifier: Apache-2.0
// Rays from CSV files.
#pragma once

#include "track/track.h"

#include <string>
#include <vector>

namespace apps {

/// The rays of a file with lines ox,oy,oz,dx,dy,dz[,tmin,tmax], where a header, empty lines and
/// lines that begin with # are skipped. Throws trk::Error naming the line.
std::vector<TrkRay> readRays(const std::string& path);

}  // namespace apps
