// SPDX-License-Identifier: Apache-2.0
#include "sweep.h"

#include "bake/write_bake.h"
#include "estimate/ratio_tracking.h"
#include "failure.h"
#include "io/sidecar.h"
#include "parallel.h"
#include "predicted_variance.h"
#include "query/transmittance.h"
#include "sweep_rays.h"

#include <sched.h>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <filesystem>
#include <limits>
#include <map>
#include <numeric>
#include <random>
#include <tuple>
#include <utility>

namespace vdbtools {
namespace {

using trk::ControlKind;
using trk::Volume;

constexpr double kNaN = std::numeric_limits<double>::quiet_NaN();

/// Keeps this thread on the processor it runs on.
class Pinned {
  public:
    Pinned() {
        cpu_set_t one;
        CPU_ZERO(&one);
        const int processor = sched_getcpu();
        restore_ = processor >= 0 && sched_getaffinity(0, sizeof(before_), &before_) == 0;
        if (restore_) {
            CPU_SET(static_cast<size_t>(processor), &one);
            sched_setaffinity(0, sizeof(one), &one);
        }
    }
    ~Pinned() {
        if (restore_) {
            sched_setaffinity(0, sizeof(before_), &before_);
        }
    }
    Pinned(const Pinned&) = delete;
    Pinned& operator=(const Pinned&) = delete;

  private:
    cpu_set_t before_{};
    bool restore_ = false;
};

double secondsSince(std::chrono::steady_clock::time_point start) {
    return std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
}

double meanOf(const std::vector<double>& values) {
    return values.empty() ? 0
                          : std::accumulate(values.begin(), values.end(), 0.0) /
                                static_cast<double>(values.size());
}

/// Volumes over one density and one extinction, by what distinguishes their super-voxels.
class Volumes {
  public:
    using Bakes = std::map<std::pair<int, ControlKind>, trk::BakedVolume>;

    Volumes(const Volume& plain, const Bakes& bakes, trk::VolumeOptions options)
        : plain_(plain), bakes_(bakes), options_(std::move(options)) {}

    const Volume& of(const Way& way) {
        if (!way.usesSuperVoxels()) {
            return plain_;
        }
        // Ratio and delta tracking do not look at the control, nor the control method at the
        // choice.
        const TrkChoice choice = way.usesChoice() ? way.choice : TrkChoice{TRK_CHOICE_ROBUST};
        const auto key = std::make_tuple(way.size, way.kind, choice);
        const auto found = volumes_.find(key);
        if (found != volumes_.end()) {
            return found->second;
        }
        Volume volume = plain_;
        trk::VolumeOptions options = options_;
        options.choice = choice;
        options.global = way.size == Way::kWholeVolume;
        const auto bake = options.global ? bakes_.begin() : bakes_.find({way.size, way.kind});
        trk::addSuperVoxels(volume, bake->second, options, "bake");
        return volumes_.emplace(key, std::move(volume)).first->second;
    }

  private:
    const Volume& plain_;
    const Bakes& bakes_;
    trk::VolumeOptions options_;
    std::map<std::tuple<int, ControlKind, TrkChoice>, Volume> volumes_;
};

/// Sums over the estimates of one way on one set.
struct Tally {
    std::vector<double> times;  ///< ns a ray, one a round
    struct Channel {
        double errors = 0;
        double squares = 0;  ///< of errors
        double largestSquare = 0;
        double sum = 0;
        double largest = 0;
    };
    std::array<Channel, 3> channels;
    uint64_t lookups = 0;
    uint64_t superVoxels = 0;
    double exactShare = 0;
};

TrkQuery queryOf(const Way& way, uint64_t seed, uint64_t stream) {
    TrkQuery query = trkDefaultQuery();
    query.method = way.method;
    query.threads = 1;
    query.rayStride = sizeof(TrkRay);
    query.seed = seed;
    query.stream = stream;
    if (way.traits().usesSteps()) {
        query.step = static_cast<float>(way.rate);
    } else {
        query.rate = static_cast<float>(way.rate);
    }
    return query;
}

double median(std::vector<double> values) {
    std::sort(values.begin(), values.end());
    const size_t n = values.size();
    return n == 0 ? 0 : 0.5 * (values[(n - 1) / 2] + values[n / 2]);
}

double spreadOf(std::vector<double> values) {
    std::sort(values.begin(), values.end());
    const size_t n = values.size();
    return n < 4 ? kNaN : (values[(3 * n) / 4] - values[n / 4]) / median(values);
}

/// Measures all ways on the rays of one set.
class SetRun {
  public:
    SetRun(size_t setIndex, const std::vector<TrkRay>& rays, const std::vector<double>& depths,
           size_t channels, const SweepOptions& options)
        : index_(setIndex),
          rays_(rays),
          channels_(channels),
          options_(options),
          exact_(depths.size()),
          estimates_(depths.size()),
          tallies_(options.ways.size()) {
        const auto rayCount = static_cast<double>(rays.size());
        for (size_t i = 0; i < depths.size(); ++i) {
            const double T = std::exp(-depths[i]);
            exact_[i] = T;
            transmittance_[i % channels] += T / rayCount;
            if (T < trk::kRouletteThreshold) {
                rouletteVariance_[i % channels] += (trk::kRouletteThreshold - T) * T / rayCount;
            }
        }
    }

    void round(uint32_t round, Volumes& volumes) {
        std::vector<size_t> order(options_.ways.size());
        std::iota(order.begin(), order.end(), size_t{0});
        std::shuffle(order.begin(), order.end(), std::mt19937_64(round));
        for (const size_t w : order) {
            const Way& way = options_.ways[w];
            const Volume& volume = volumes.of(way);
            TrkQuery query = queryOf(way, seedOf(w), round);
            Tally& tally = tallies_[w];
            if (round == 0) {
                count(volume, query, tally);
            }
            const auto start = std::chrono::steady_clock::now();
            trk::estimateTransmittance(volume, query, rays_.data(), rays_.size(), estimatesOut(),
                                       {});
            tally.times.push_back(1e9 * secondsSince(start) / static_cast<double>(rays_.size()));
            add(tally);
        }
    }

    void finish(Volumes& volumes, std::vector<SweepRow>& rows) const {
        for (size_t w = 0; w < options_.ways.size(); ++w) {
            rows.push_back(rowOf(w, volumes));
        }
    }

  private:
    uint64_t seedOf(size_t way) const {
        return options_.seed * 0x9e3779b97f4a7c15u + (index_ << 20) + way;
    }

    /// What the estimates spend, from a few that are not timed.
    void count(const Volume& volume, TrkQuery query, Tally& tally) {
        const size_t n = rays_.size();
        std::vector<uint64_t> lookups(n);
        std::vector<uint64_t> superVoxels(n);
        std::vector<float> exactShare(n);
        query.samples = kCounted;
        trk::estimateTransmittance(
            volume, query, rays_.data(), n, estimatesOut(),
            {{}, {lookups.data(), 1, 0}, {superVoxels.data(), 1, 0}, {exactShare.data(), 1, 0}});
        tally.lookups += std::accumulate(lookups.begin(), lookups.end(), uint64_t{0});
        tally.superVoxels += std::accumulate(superVoxels.begin(), superVoxels.end(), uint64_t{0});
        tally.exactShare += std::accumulate(exactShare.begin(), exactShare.end(), 0.0);
    }

    trk::Array<float> estimatesOut() { return {estimates_.data(), channels_, 0}; }

    void add(Tally& tally) {
        for (size_t i = 0; i < estimates_.size(); ++i) {
            const auto estimate = static_cast<double>(estimates_[i]);
            const double error = estimate - exact_[i];
            Tally::Channel& channel = tally.channels[i % channels_];
            channel.errors += error;
            channel.squares += error * error;
            channel.largestSquare = std::max(channel.largestSquare, error * error);
            channel.sum += estimate;
            channel.largest = std::max(channel.largest, std::fabs(estimate));
        }
    }

    /// Per channel, the mean over rays of the variance that a formula gives; NaN where none does.
    std::array<double, 3> predict(size_t w, Volumes& volumes) const {
        const Way& way = options_.ways[w];
        const auto n = static_cast<double>(rays_.size());
        std::array<double, 3> sum{};
        if (way.method == TRK_METHOD_DELTA) {
            for (size_t i = 0; i < exact_.size(); ++i) {
                sum[i % channels_] += exact_[i] * (1 - exact_[i]) / n;
            }
            return sum;
        }
        if (!way.traits().usesRate) {
            sum.fill(way.isRandom() ? kNaN : 0.0);
            return sum;
        }
        const Volume& volume = volumes.of(way);
        const TrkQuery query = queryOf(way, 0, 0);
        std::vector<std::array<double, 3>> variances(rays_.size());
        trk::parallelFor(rays_.size(), 1, [&](size_t i) {
            variances[i] = predictVariance(volume, query, rays_[i]);
        });
        for (const auto& v : variances) {
            for (size_t c = 0; c < channels_; ++c) {
                sum[c] += v[c] / n;
            }
        }
        return sum;
    }

    SweepRow rowOf(size_t w, Volumes& volumes) const {
        const Way& way = options_.ways[w];
        const Tally& tally = tallies_[w];
        const auto rayCount = static_cast<double>(rays_.size());
        const double estimates = rayCount * options_.rounds;
        const std::array<double, 3> predicted = predict(w, volumes);
        SweepRow row;
        row.set = index_;
        row.way = way;
        row.nanoseconds = median(tally.times);
        row.spread = spreadOf(tally.times);
        // Methods without noise take one sample, whatever is asked for.
        const double counted = rayCount * (way.isRandom() ? kCounted : 1);
        row.lookups = static_cast<double>(tally.lookups) / counted;
        row.superVoxels = static_cast<double>(tally.superVoxels) / counted;
        row.exactShare = tally.exactShare / rayCount;
        row.z = kNaN;
        double squares = 0;
        for (size_t c = 0; c < channels_; ++c) {
            const auto channels = static_cast<double>(channels_);
            squares += tally.channels[c].squares / (estimates * channels);
            row.bias += tally.channels[c].errors / (estimates * channels);
            row.predictedVariance += predicted[c] / channels;
            row.converged = row.converged && (!way.isRandom() || converged(w, c, predicted[c]));
        }
        for (size_t c = 0; c < channels_ && way.isRandom() && row.converged; ++c) {
            const double z = zOf(w, c, predicted[c]);
            row.z = std::isnan(row.z) || std::fabs(z) > std::fabs(row.z) ? z : row.z;
        }
        if (way.isUnbiased()) {
            row.variance = !way.isRandom() ? 0 : std::fmax(squares, row.predictedVariance);
            row.rmse = std::sqrt(row.variance);
        } else {
            // A biased method's errors are no noise: each ray's has a mean of its own.
            row.variance = way.isRandom() ? marchVariance(w, volumes) : 0;
            row.rmse = std::sqrt(squares);
        }
        return row;
    }

    /// As SweepRow::converged says, of one channel.
    bool converged(size_t w, size_t c, double predicted) const {
        constexpr double kMost = 0.05;
        const Tally::Channel& channel = tallies_[w].channels[c];
        const double estimates = static_cast<double>(rays_.size()) * options_.rounds;
        const double square = channel.squares / estimates + kLeastVariance;
        return (channel.sum > 0 || transmittance_[c] == 0) &&
               channel.largest <= kMost * channel.sum &&
               channel.largestSquare <= kMost * square * estimates &&
               !(predicted + kLeastVariance > 2 * square);
    }

    /// The error of a channel's mean, in standard errors.
    double zOf(size_t w, size_t c, double predicted) const {
        const Tally::Channel& channel = tallies_[w].channels[c];
        const auto rayCount = static_cast<double>(rays_.size());
        const double estimates = rayCount * options_.rounds;
        const bool roulette = options_.ways[w].traits().usesRoulette;
        const double variance = std::fmax(channel.squares / estimates,
                                          predicted + (roulette ? rouletteVariance_[c] : 0));
        // Results are floats, whose rounding repeats in every round.
        constexpr double kRounding = 3e-8;
        return channel.errors / estimates /
               std::sqrt(variance / estimates + kRounding * kRounding / rayCount);
    }

    /// The mean over rays of the variance around each ray's own mean, which is not the exact value.
    double marchVariance(size_t w, Volumes& volumes) const {
        constexpr uint32_t kSamples = 16;
        TrkQuery query = queryOf(options_.ways[w], seedOf(w), options_.rounds);
        std::vector<float> estimates(exact_.size());
        std::vector<double> means(exact_.size());
        std::vector<double> squares(exact_.size());
        for (uint32_t sample = 1; sample <= kSamples; ++sample) {
            query.stream = static_cast<uint64_t>(options_.rounds) + sample;
            trk::estimateTransmittance(volumes.of(options_.ways[w]), query, rays_.data(),
                                       rays_.size(), {estimates.data(), channels_, 0}, {});
            for (size_t i = 0; i < estimates.size(); ++i) {  // [Welford 1962]
                const double delta = static_cast<double>(estimates[i]) - means[i];
                means[i] += delta / sample;
                squares[i] += delta * (static_cast<double>(estimates[i]) - means[i]);
            }
        }
        return std::accumulate(squares.begin(), squares.end(), 0.0) / (kSamples - 1) /
               static_cast<double>(exact_.size());
    }

    static constexpr uint32_t kCounted = 4;

    size_t index_;
    const std::vector<TrkRay>& rays_;
    size_t channels_;
    const SweepOptions& options_;
    std::vector<double> exact_;                 // transmittance
    std::array<double, 3> transmittance_{};     // mean, per channel
    std::array<double, 3> rouletteVariance_{};  // at most, of dim rays that are else exact
    std::vector<float> estimates_;
    std::vector<Tally> tallies_;
};

SweepBake bakeInto(Volumes::Bakes& bakes, const Source& source, int size, ControlKind kind) {
    trk::BakeOptions options;
    options.superVoxelSize = size;
    options.kind = kind;
    options.sidecarBytes = trk::sidecarLimit(source.summary.fileBytes, kind);
    const auto start = std::chrono::steady_clock::now();
    trk::BakedVolume& baked = bakes[{size, kind}] = trk::bake(*source.field, options);
    SweepBake result;
    result.seconds = secondsSince(start);
    result.size = size;
    result.kind = kind;
    result.superVoxels = static_cast<uint64_t>(baked.table.occupiedItems());
    const trk::ControlFit fit = trk::measureFit(baked);
    result.residualShare = fit.fieldRms > 0 ? fit.residualRms / fit.fieldRms : 0;
    // Never committed: it leaves nothing behind.
    const trk::OutputFile file(trk::temporaryFolder() + "/measured.track.vdb", true);
    trk::writeSidecar(file, trk::sidecarHeader(source.summary, *source.field, baked), baked,
                      source.summary.anchor);
    result.sidecarBytes = std::filesystem::file_size(file.path());
    baked.levels.clear();  // no way looks at these
    baked.gradients = {};
    baked.preview = {};
    return result;
}

}  // namespace

double sidakBound(size_t comparisons) {
    const double alpha =
        -std::expm1(std::log(0.99) / static_cast<double>(std::max(comparisons, size_t{1})));
    double lo = 0;
    double hi = 20;
    for (int i = 0; i < 100; ++i) {
        const double middle = 0.5 * (lo + hi);
        (std::erfc(middle / std::sqrt(2.0)) > alpha ? lo : hi) = middle;
    }
    return lo;
}

Sweep runSweep(const Source& source, const SweepOptions& options,
               const std::function<void(double)>& progress) {
    Sweep sweep;
    trk::VolumeOptions volumeOptions;
    const Volume unscaled = trk::makeVolume(source.summary, source.field, volumeOptions);
    const std::vector<TrkRay> camera = cameraRays(unscaled, options.rayCount, options.seed);
    if (camera.empty()) {
        throw trk::Error(TRK_ERROR_BAD_DENSITY, source.summary.path + ": grid " +
                                                    source.summary.grid.name +
                                                    ": expected some density, found none on " +
                                                    "any ray; there is nothing to measure");
    }
    sweep.unscaledDepth = meanOf(exactOpticalDepths(unscaled, camera));

    Volumes::Bakes bakes;
    for (const Way& way : options.ways) {
        if (way.size > 0 && bakes.find({way.size, way.kind}) == bakes.end()) {
            sweep.bakes.push_back(bakeInto(bakes, source, way.size, way.kind));
        }
    }
    if (bakes.empty()) {  // what covers the whole volume is made of a bake, of any size
        bakeInto(bakes, source, 16, ControlKind::kConstant);
    }

    std::vector<bool> colours;
    if (options.grey) {
        colours.push_back(false);
    }
    if (options.coloured) {
        colours.push_back(true);
    }
    const auto steps = static_cast<double>(options.depths.size() * colours.size() *
                                           options.rays.size() * options.rounds);
    double done = 0;
    size_t comparisons = 0;
    for (const bool coloured : colours) {
        for (const double depth : options.depths) {
            volumeOptions.scale =
                depth > 0 ? static_cast<float>(depth / sweep.unscaledDepth) : options.scale;
            volumeOptions.color = coloured ? options.color : std::array<float, 3>{{1, 1, 1}};
            const Volume plain = trk::makeVolume(source.summary, source.field, volumeOptions);
            Volumes volumes(plain, bakes, volumeOptions);
            for (const RayKind kind : options.rays) {
                SweepSet set;
                set.rays = kind;
                set.coloured = coloured;
                set.depth = depth;
                set.scale = volumeOptions.scale;
                const std::vector<TrkRay> rays =
                    kind == RayKind::kCamera ? camera
                                             : secondaryRays(plain, camera, options.seed + 1);
                if (rays.empty()) {
                    throw trk::Error(TRK_ERROR_BAD_DENSITY,
                                     source.summary.path +
                                         ": no secondary ray meets any density at scale " +
                                         std::to_string(set.scale));
                }
                const std::vector<double> depths = exactOpticalDepths(plain, rays);
                set.rayCount = rays.size();
                set.meanDepth = meanOf(depths);
                for (const double d : depths) {
                    set.meanTransmittance += std::exp(-d) / static_cast<double>(depths.size());
                }
                sweep.sets.push_back(set);
                SetRun run(sweep.sets.size() - 1, rays, depths, plain.channels(), options);
                for (const Way& way : options.ways) {
                    volumes.of(way);  // made before anything is timed
                }
                {
                    const Pinned pinned;
                    for (uint32_t round = 0; round < options.rounds; ++round) {
                        run.round(round, volumes);
                        progress(++done / steps);
                    }
                }
                const size_t first = sweep.rows.size();
                run.finish(volumes, sweep.rows);
                for (size_t r = first; r < sweep.rows.size(); ++r) {
                    const SweepRow& row = sweep.rows[r];
                    const bool tested = row.way.isUnbiased() && !std::isnan(row.z);
                    comparisons += tested ? plain.channels() : 0;
                }
            }
        }
    }
    sweep.zBound = sidakBound(comparisons);
    return sweep;
}

}  // namespace vdbtools
