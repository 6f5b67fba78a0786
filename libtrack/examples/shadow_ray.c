/* SPDX-License-Identifier: Apache-2.0 */
/* A shadow ray through a volume: shadow_ray DENSITY.vdb [SCALE] */
#include <track/track.h>

#include <math.h>
#include <stdio.h>
#include <stdlib.h>

int main(int argc, char** argv) {
    TrkVolumeOptions options = trkDefaultVolumeOptions();
    TrkQuery query = trkDefaultQuery();
    TrkVolume* volume = NULL;
    TrkVolumeInfo info;
    TrkStatistics statistics = trkDefaultStatistics();
    TrkRay ray;
    float transmittance = 0.0f;
    float standardError = 0.0f;
    uint64_t lookups = 0;
    int axis;

    if (argc < 2) {
        fprintf(stderr, "usage: shadow_ray DENSITY.vdb [SCALE]\n");
        return 2;
    }
    options.scale = argc > 2 ? (float)atof(argv[2]) : 1.0f;
    if (trkOpenVolume(argv[1], NULL, &options, &volume) != TRK_OK) {
        fprintf(stderr, "%s\n", trkGetLastErrorMessage());
        return 1;
    }
    info.size = sizeof(info);
    if (trkGetVolumeInfo(volume, &info) != TRK_OK) {
        fprintf(stderr, "%s\n", trkGetLastErrorMessage());
        trkCloseVolume(volume);
        return 1;
    }

    /* From the middle of the volume towards a sun that stands high. */
    for (axis = 0; axis < 3; ++axis) {
        ray.origin[axis] = (float)(0.5 * (info.boundsMin[axis] + info.boundsMax[axis]));
    }
    ray.direction[0] = 0.3f;
    ray.direction[1] = 1.0f;
    ray.direction[2] = 0.2f;
    ray.tMin = 0.0f;
    ray.tMax = INFINITY;

    query.method = info.superVoxelSize > 0 ? TRK_METHOD_RESIDUAL : TRK_METHOD_EXACT;
    query.samples = 64;
    /* A renderer gives every ray of a picture its own id, and every use of it a stream: this is
     * sample 3 of pixel 1000 of 16 samples each, its second bounce, light 1 of 4. */
    query.firstRayId = 1000 * 16 + 3;
    query.stream = 2 * 4 + 1;
    statistics.standardError = &standardError;
    statistics.lookups = &lookups;
    if (trkEstimateTransmittance(volume, &query, &ray, 1, &transmittance, &statistics) != TRK_OK) {
        fprintf(stderr, "%s\n", trkGetLastErrorMessage());
        trkCloseVolume(volume);
        return 1;
    }
    printf("transmittance %g, standard error %g, %llu density look-ups\n", (double)transmittance,
           (double)standardError, (unsigned long long)lookups);
    trkCloseVolume(volume);
    return 0;
}
