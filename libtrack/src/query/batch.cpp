// SPDX-License-Identifier: Apache-2.0
#include "batch.h"

#include "failure.h"

#include <cmath>
#include <string>

namespace trk {
namespace {

bool isValid(const TrkRay& ray) {
    bool finite = !std::isnan(ray.tMin) && !std::isnan(ray.tMax);
    bool zero = true;
    for (int a = 0; a < 3; ++a) {
        finite = finite && std::isfinite(ray.origin[a]) && std::isfinite(ray.direction[a]);
        zero = zero && ray.direction[a] == 0;
    }
    return finite && !zero;
}

}  // namespace

void checkRays(const TrkQuery& query, const TrkRay* rays, size_t rayCount) {
    for (size_t i = 0; i < rayCount; ++i) {
        if (!isValid(rayAt(query, rays, i))) {
            throw Error(TRK_ERROR_INVALID_ARGUMENT,
                        "ray " + std::to_string(i) +
                            ": expected a finite origin, a finite direction that is not zero, and "
                            "limits that are not NaN");
        }
    }
}

void requireDensity(const Volume& volume, const char* instead) {
    if (!volume.hasDensity()) {
        throw Error(TRK_ERROR_NO_DENSITY,
                    volume.sidecarPath +
                        ": opened without its density, which this looks up; open the density's "
                        ".vdb too" +
                        instead);
    }
}

void requireSuperVoxels(const Volume& volume, const char* instead) {
    if (!volume.hasSuperVoxels()) {
        throw Error(TRK_ERROR_NO_SIDECAR,
                    "grid " + volume.grid.name + ": this needs a sidecar, and none was found" +
                        (volume.sidecarPath.empty() ? "" : " at " + volume.sidecarPath) +
                        "; bake one" + instead);
    }
}

}  // namespace trk
