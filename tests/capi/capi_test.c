/* SPDX-License-Identifier: Apache-2.0 */
/* Calls every exported function from C99. Argument 1: a density with a sidecar beside it. */
#include "track/track.h"

#include <math.h>
#include <stdio.h>
#include <string.h>

static int failures = 0;

static void expect(int condition, const char* what) {
    if (!condition) {
        fprintf(stderr, "capi_test: failed: %s (last error: %s)\n", what, trkGetLastErrorMessage());
        ++failures;
    }
}

int main(int argc, char** argv) {
    TrkVolumeOptions options = trkDefaultVolumeOptions();
    TrkQuery query = trkDefaultQuery();
    TrkVolume* volume = NULL;
    TrkVolumeInfo info;
    TrkRay ray = {{0.0f, 0.0f, 0.0f}, 0.0f, {1.0f, 0.0f, 0.0f}, INFINITY};
    TrkStatistics statistics = trkDefaultStatistics();
    TrkFreePaths paths = trkDefaultFreePaths();
    TrkBakeOptions bake = trkDefaultBakeOptions();
    TrkDensity density = trkDefaultDensity();
    const float values[8] = {1.0f, 2.0f, 3.0f, 4.0f, 5.0f, 6.0f, 7.0f, 8.0f};
    const float corner[3] = {1.0f, 1.0f, 1.0f};
    float transmittance = -1.0f;
    float standardError = -1.0f;
    float extinction = -1.0f;
    float t = -1.0f;
    float weight = -1.0f;
    double depth = -1.0;
    int a;

    if (argc != 2) {
        fprintf(stderr, "usage: capi_test DENSITY.vdb\n");
        return 2;
    }
    expect(strlen(trkGetVersion()) >= 5, "trkGetVersion");
    expect(strcmp(trkGetStatusName(TRK_OK), "TRK_OK") == 0, "trkGetStatusName(TRK_OK)");
    expect(strcmp(trkGetStatusName(TRK_ERROR_NO_SIDECAR), "TRK_ERROR_NO_SIDECAR") == 0,
           "trkGetStatusName(TRK_ERROR_NO_SIDECAR)");

    bake.superVoxelSize = 8;
    options.choice = TRK_CHOICE_MEAN;
    expect(trkOpenVolume(argv[1], NULL, &options, &volume) == TRK_OK, "trkOpenVolume");
    if (!volume) {
        return 1;
    }
    info.size = sizeof(info);
    expect(trkGetVolumeInfo(volume, &info) == TRK_OK, "trkGetVolumeInfo");
    expect(info.hasDensity == 1 && info.superVoxelSize > 0 && info.channels == 1, "info");

    for (a = 0; a < 3; ++a) {
        ray.origin[a] = (float)(0.5 * (info.boundsMin[a] + info.boundsMax[a]));
    }
    ray.tMin = -INFINITY;
    query.samples = 64;
    statistics.standardError = &standardError;
    expect(trkEstimateTransmittance(volume, &query, &ray, 1, &transmittance, &statistics) == TRK_OK,
           "trkEstimateTransmittance");
    query.method = TRK_METHOD_EXACT;
    expect(trkIntegrateOpticalDepth(volume, &query, &ray, 1, &depth) == TRK_OK,
           "trkIntegrateOpticalDepth");
    expect(depth > 0.0 && fabs(exp(-depth) - transmittance) < 6 * standardError + 1e-6,
           "the estimate is near the exact value");
    query = trkDefaultQuery();
    paths.t = &t;
    paths.weight = &weight;
    paths.extinction = &extinction;
    expect(trkSampleFreePath(volume, &query, &ray, 1, &paths) == TRK_OK, "trkSampleFreePath");
    expect(weight == 1.0f, "a grey volume's weight is 1");
    expect(isinf(t) ? extinction == 0.0f : extinction > 0.0f, "extinction where it collides");
    extinction = -1.0f;
    expect(
        trkSampleExtinction(volume, ray.origin, 0, 1, &extinction, 0) == TRK_OK && extinction > 0,
        "trkSampleExtinction");
    expect(trkBakeVolume(volume, &bake, NULL) == TRK_OK, "trkBakeVolume");
    expect(trkGetVolumeInfo(volume, &info) == TRK_OK && info.superVoxelSize == 8, "the new bake");
    trkCloseVolume(volume);
    trkCloseVolume(NULL);

    density.values = values;
    for (a = 0; a < 3; ++a) {
        density.extent[a] = 2;
    }
    expect(trkMakeVolume(&density, NULL, &volume) == TRK_OK, "trkMakeVolume");
    expect(trkSampleExtinction(volume, corner, 0, 1, &extinction, 0) == TRK_OK &&
               extinction == values[7],
           "the voxel at (1, 1, 1)");
    trkCloseVolume(volume);

    expect(trkOpenVolume("/no/such/file.vdb", NULL, NULL, &volume) == TRK_ERROR_IO, "missing file");
    expect(volume == NULL, "no volume after a failure");
    expect(strstr(trkGetLastErrorMessage(), "/no/such/file.vdb") != NULL, "trkGetLastErrorMessage");
    return failures == 0 ? 0 : 1;
}
