// SPDX-License-Identifier: Apache-2.0
#include "known_error.h"

#include "predicted_variance.h"
#include "query/transmittance.h"

#include <algorithm>
#include <cmath>
#include <limits>

namespace vdbtools {
namespace {

/// How many samples are needed, or 0 where integrating exactly costs less.
uint32_t samplesFor(const trk::Volume& volume, const TrkQuery& query, const TrkRay& ray,
                    const std::array<double, 3>& variance, double wantedError) {
    const double most = *std::max_element(variance.begin(), variance.end());
    const double needed = std::max(1.0, std::ceil(most / (wantedError * wantedError)));
    const double samples = std::min(needed, static_cast<double>(query.samples));
    const PredictedCost cost = predictCost(volume, query, ray);
    return cost.exact <= samples * cost.estimate ? 0 : static_cast<uint32_t>(samples);
}

}  // namespace

KnownErrorEstimate estimateWithKnownError(const trk::Volume& volume, const TrkQuery& query,
                                          const TrkRay& ray, uint64_t rayId, double wantedError) {
    KnownErrorEstimate result;
    result.opticalDepth.fill(std::numeric_limits<double>::quiet_NaN());
    TrkQuery one = query;
    one.flags &= ~uint32_t{TRK_QUERY_ROULETTE};
    one.rayStride = sizeof(TrkRay);
    one.rayIds = nullptr;
    one.firstRayId = rayId;
    one.threads = 1;
    const auto variance = predictVariance(volume, one, ray);
    result.samples =
        wantedError > 0 ? samplesFor(volume, one, ray, variance, wantedError) : query.samples;
    const size_t channels = volume.channels();
    if (result.samples == 0) {
        one.method = TRK_METHOD_EXACT;
        trk::integrateOpticalDepth(volume, one, &ray, 1, {result.opticalDepth.data(), channels, 0});
    }
    one.samples = std::max(result.samples, 1u);
    trk::StatisticsOutput statistics;
    statistics.lookups = {&result.lookups, 1, 0};
    trk::estimateTransmittance(volume, one, &ray, 1, {result.transmittance.data(), channels, 0},
                               statistics);
    for (size_t c = 0; c < channels && result.samples > 0; ++c) {
        result.standardError[c] = trk::roundedError(std::sqrt(variance[c] / result.samples));
    }
    return result;
}

}  // namespace vdbtools
