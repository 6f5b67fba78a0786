// SPDX-License-Identifier: Apache-2.0
// What the options of vdbtrack query ask, checked against one another and the files they name.
#pragma once

#include "command_line.h"

#include "track/track.hpp"
#include "volume.h"

#include <string>

namespace apps {

/// The query that the options describe.
track::Query queryOf(const Arguments& arguments);

/// How to open the volume; strings live as long as `arguments`.
TrkVolumeOptions volumeOptionsOf(const Arguments& arguments);

/// What to open.
struct Inputs {
    std::string density;  ///< empty: the sidecar alone
    std::string sidecarPath;
    TrkVolumeOptions options;
    bool named = false;   ///< the sidecar must be there
    bool wanted = false;  ///< it is taken where it is

    /// As trkOpenVolume takes it.
    const char* sidecar() const { return named ? sidecarPath.c_str() : wanted ? nullptr : ""; }
};

/// The density with the sidecar that the method needs, or a sidecar alone.
Inputs inputsOf(const Arguments& arguments, const TrkQuery& query, const TrkVolumeOptions& options);

/// The volume as the library's inside knows it, which has formulas for its variance.
trk::Volume openInside(const Inputs& inputs);

}  // namespace apps
