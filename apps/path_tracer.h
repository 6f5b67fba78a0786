// SPDX-License-Identifier: Apache-2.0
// A small volume path tracer on the C API alone: light that scattered once or twice in a volume, by
// delta, ratio and residual ratio tracking for the shadow rays [Novak14, Fig. 1].
#pragma once

#include "image.h"
#include "track/track.h"

#include <array>
#include <cstdint>
#include <functional>
#include <string>
#include <vector>

namespace apps {

struct ScatterOptions {
    std::string vdb;
    std::string sidecar;
    std::string grid;  ///< "": the default one
    uint32_t repair = 0;
    float scale = 1;
    std::array<float, 3> color{{1, 1, 1}};
    int width = 128;        ///< of the picture, and its height
    uint32_t samples = 64;  ///< paths a pixel of delta tracking, whose cost the others get
    uint64_t seed = 0;
    // For the reader only:
    double depth = 0;     ///< mean optical depth without the colour
    std::string control;  ///< what the sidecar holds
};

/// A picture of so many paths a pixel.
struct ScatterPicture {
    uint32_t samples = 0;
    double rmse = 0;  ///< against the converged picture, over what shows the volume, and channels
    double shadowRmse = 0;  ///< against the same paths with exact shadow rays
    Image image{0, 0};
};

/// What one method for shadow rays came to.
struct ScatterMethod {
    TrkMethod method = TRK_METHOD_DELTA;
    double shadowLookups = 0;  ///< a path
    double lookups = 0;        ///< a path: shadow rays and free paths
    double nanoseconds = 0;    ///< a path, median; one thread
    double spread = 0;         ///< middle half of the times, over the median
    ScatterPicture sameSamples;
    ScatterPicture equalLookups;
    ScatterPicture equalTime;
};

struct Scattering {
    ScatterOptions options;
    uint32_t referenceSamples = 0;
    Image reference{0, 0};
    std::vector<ScatterMethod> methods;
};

/// Renders in parallel; times in one thread, interleaved. The scene: the volume in a sun and a sky,
/// an albedo of 0.98, a Henyey-Greenstein phase function of g = 0.4, at most two bounces. Free
/// paths are the same for all methods. Throws track::Error.
Scattering renderScattering(const ScatterOptions& options,
                            const std::function<void(double)>& progress);

}  // namespace apps
