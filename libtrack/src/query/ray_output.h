// SPDX-License-Identifier: Apache-2.0
// What a query of transmittance writes for a ray: the mean of its estimates, how sure that is, and
// what it took.
#pragma once

#include "batch.h"
#include "estimate/tracking.h"
#include "methods.h"
#include "transmittance.h"
#include "volume.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <limits>

namespace trk {

/// Mean and standard error of the estimates of one ray, per channel. The error is NaN where it is
/// not known.
template <size_t C>
struct Estimate {
    std::array<double, C> mean;
    std::array<double, C> standardError;
};

/// The mean of several estimates of one ray.
template <size_t C>
class SampleMean {
  public:
    void add(const std::array<double, C>& estimate) {
        ++count_;
        for (size_t c = 0; c < C; ++c) {
            // Sums of squared deviations, updated without cancellation [Welford 1962].
            const double delta = estimate[c] - mean_[c];
            mean_[c] += delta / count_;
            squares_[c] += delta * (estimate[c] - mean_[c]);
        }
    }
    /// `isRandom`: another estimate might have been another one.
    Estimate<C> result(bool isRandom) const {
        Estimate<C> result{};
        result.mean = mean_;
        for (size_t c = 0; c < C; ++c) {
            // That random estimates agree says little: only a larger number of them would differ.
            result.standardError[c] = squares_[c] > 0
                                          ? std::sqrt(squares_[c] / (count_ * (count_ - 1)))
                                      : isRandom ? std::numeric_limits<double>::quiet_NaN()
                                                 : 0.0;
        }
        return result;
    }

  private:
    double count_ = 0;
    std::array<double, C> mean_{};
    std::array<double, C> squares_{};
};

inline float finiteFloat(double value) {
    constexpr double kLimit = static_cast<double>(std::numeric_limits<float>::max());
    return static_cast<float>(std::fmin(std::fmax(value, -kLimit), kLimit));
}

/// What is written for one ray.
template <class V>
class RayOutput {
  public:
    RayOutput(const Volume& volume, const TrkQuery& query, const Array<float>& transmittance,
              const StatisticsOutput& statistics)
        : volume_(volume), query_(query), transmittance_(transmittance), statistics_(statistics) {}

    /// `clippedLength`: voxel lengths within the volume; 0 where the ray misses it.
    void write(size_t ray, Estimate<V::kChannels> estimate, const PathCost& cost,
               double clippedLength, double samples) const {
        if (!traitsOf(query_.method).isUnbiased && clippedLength > 0) {
            estimate.standardError.fill(std::numeric_limits<double>::quiet_NaN());
        }
        for (size_t c = 0; c < V::kChannels; ++c) {
            if (volume_.scales[c] == 0) {  // exactly 1, whatever the other channels met
                estimate.standardError[c] = 0;
            }
        }
        std::transform(estimate.mean.begin(), estimate.mean.end(), transmittance_.at(ray),
                       finiteFloat);
        if (statistics_.standardError) {
            std::transform(estimate.standardError.begin(), estimate.standardError.end(),
                           statistics_.standardError.at(ray), roundedError);
        }
        if (statistics_.lookups) {
            *statistics_.lookups.at(ray) = cost.lookups;
        }
        if (statistics_.superVoxels) {
            *statistics_.superVoxels.at(ray) = cost.superVoxels;
        }
        if (statistics_.exactShare) {
            *statistics_.exactShare.at(ray) =
                clippedLength > 0 ? static_cast<float>(cost.exactLength / (samples * clippedLength))
                                  : 0.0f;
        }
    }
    /// Of a ray that misses the volume, whatever the method.
    void writeMiss(size_t ray) const {
        Estimate<V::kChannels> estimate{};
        estimate.mean.fill(1);
        write(ray, estimate, {}, 0, 1);
    }

  private:
    const Volume& volume_;
    const TrkQuery& query_;
    const Array<float>& transmittance_;
    const StatisticsOutput& statistics_;
};

}  // namespace trk
