// SPDX-License-Identifier: Apache-2.0
// What each way of estimating transmittance costs and buys on a volume: time, look-ups, variance.
#pragma once

#include "bake/bake.h"
#include "io/density.h"
#include "track/track.h"
#include "volume.h"
#include "way.h"

#include <array>
#include <cstdint>
#include <functional>
#include <memory>
#include <vector>

namespace vdbtools {

/// A density that volumes of many extinctions are made over.
struct Source {
    trk::DensitySummary summary;
    std::shared_ptr<const trk::DensityField> field;
};

enum class RayKind {
    kCamera,    ///< coherent: a camera's, pixel after pixel
    kSecondary  ///< incoherent: from where camera rays collide, in all directions, in random order
};

/// Rays and the extinction they go through.
struct SweepSet {
    RayKind rays = RayKind::kCamera;
    bool coloured = false;
    double depth = 0;  ///< mean optical depth of the camera rays that was asked for; 0: scale 1
    float scale = 1;
    double meanDepth = 0;  ///< of these rays, over channels
    double meanTransmittance = 0;
    size_t rayCount = 0;  ///< all of them hit
};

/// Less than this is told apart by nobody.
inline constexpr double kLeastVariance = 0.001;

/// What one way did on one set. Per ray and estimate; variances and errors are means over rays and
/// channels.
struct SweepRow {
    size_t set = 0;
    Way way;
    double nanoseconds = 0;  ///< median over the rounds
    double spread = 0;       ///< middle half of the rounds' times, over the median
    double lookups = 0;
    double superVoxels = 0;
    double exactShare = 0;  ///< of the length, integrated exactly
    /// Of one estimate: measured, or predicted where that is more, as a formula knows of tails that
    /// a sample misses; for methods without noise 0.
    double variance = 0;
    /// By the formula of the method, which knows no roulette; NaN where there is none.
    double predictedVariance = 0;
    double bias = 0;  ///< mean estimate - exact
    double rmse = 0;  ///< of one estimate against the exact value
    /// Bias in standard errors, of the channel with the largest; NaN without noise, and where the
    /// row has not converged.
    double z = 0;
    /// Whether the sample shows its own mean and variance: in no channel does a single estimate
    /// make more than 5 % of the sum of estimates, or of squared errors, or the predicted variance
    /// more than twice the measured one, both plus kLeastVariance.
    bool converged = true;

    /// (elsewhere + variance) x time, in ns: what it costs a renderer that has variance `elsewhere`
    /// from other sources to get rid of both.
    double score(double elsewhere) const { return (elsewhere + rmse * rmse) * nanoseconds; }
};

struct SweepBake {
    int size = 0;
    trk::ControlKind kind = trk::ControlKind::kConstant;
    double seconds = 0;
    uint64_t superVoxels = 0;
    uint64_t sidecarBytes = 0;
    double residualShare = 0;  ///< root mean square of the residual over that of the density
};

struct SweepOptions {
    std::vector<double> depths{1, 10, 100, 0};  ///< as SweepSet::depth
    std::vector<RayKind> rays{RayKind::kCamera, RayKind::kSecondary};
    float scale = 1;                        ///< the volume's own
    std::array<float, 3> color{{1, 1, 1}};  ///< of the coloured sets
    bool grey = true;                       ///< sets without `color`
    bool coloured = true;                   ///< sets with it
    std::vector<Way> ways;
    uint32_t rounds = 64;  ///< estimates a ray and way
    size_t rayCount = 1000;
    uint64_t seed = 0;
};

struct Sweep {
    std::vector<SweepSet> sets;
    std::vector<SweepRow> rows;  ///< of a set, one a way, in the order of the options
    std::vector<SweepBake> bakes;
    double unscaledDepth = 0;  ///< mean optical depth of the camera rays at scale 1, untinted
    double zBound =
        0;  ///< largest |z| to expect of all unbiased rows that have one, at 1 % [Sidak67]
};

/// z beyond which one of `comparisons` true hypotheses falls with probability 0.01 [Sidak67].
double sidakBound(size_t comparisons);

/// Bakes in parallel, then measures in this thread, pinned to a processor: in every round each way
/// estimates every ray once, in an order of its own, so that what else the machine does hits all
/// alike. Numbers but times are the same in every run. `progress(fraction)` is called now and then.
/// Throws Error where the density is empty.
Sweep runSweep(const Source& source, const SweepOptions& options,
               const std::function<void(double)>& progress);

}  // namespace vdbtools
