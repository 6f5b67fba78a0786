// SPDX-License-Identifier: Apache-2.0
#include "path_tracer.h"

#include "parallel.h"
#include "track/track.hpp"
#include "view/camera.h"

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cmath>
#include <limits>
#include <map>
#include <numeric>
#include <random>

namespace apps {
namespace {

constexpr uint32_t kChunk = 16;  // paths a pixel that go together

using trk::Vec3d;
using Color = std::array<double, 3>;

constexpr double kPi = 3.14159265358979323846;
constexpr double kAlbedo = 0.98;
constexpr double kAnisotropy = 0.4;  // Henyey-Greenstein's g
constexpr Vec3d kTowardsSun{{0.64, 0.64, -0.4252}};
constexpr Color kSun{{9.0, 8.4, 7.4}};  // irradiance

Color skyRadiance(const Vec3d& direction) {
    const double up = 0.5 + 0.5 * direction[1];
    return {{0.30 - 0.14 * up, 0.34 - 0.07 * up, 0.40 + 0.08 * up}};
}

double phase(double cosine) {
    const double g = kAnisotropy;
    const double d = 1 + g * g - 2 * g * cosine;
    return (1 - g * g) / (4 * kPi * d * std::sqrt(d));
}

Vec3d directionOf(const TrkRay& ray) {
    return {{static_cast<double>(ray.direction[0]), static_cast<double>(ray.direction[1]),
             static_cast<double>(ray.direction[2])}};
}

/// A direction in proportion to the phase function.
template <class Random>
Vec3d scatter(const Vec3d& forward, Random& random) {
    std::uniform_real_distribution<double> unit(0, 1);
    const double g = kAnisotropy;
    const double s = (1 - g * g) / (1 - g + 2 * g * unit(random));
    const double cosine = (1 + g * g - s * s) / (2 * g);
    const double sine = std::sqrt(std::max(0.0, 1 - cosine * cosine));
    const double angle = 2 * kPi * unit(random);
    const Vec3d other = std::fabs(forward[0]) < 0.7 ? Vec3d{{1, 0, 0}} : Vec3d{{0, 1, 0}};
    Vec3d side = cross(forward, other);
    side = (1 / length(side)) * side;
    const Vec3d third = cross(forward, side);
    return cosine * forward + (sine * std::cos(angle)) * side + (sine * std::sin(angle)) * third;
}

TrkRay rayFrom(const TrkRay& ray, float t, const Vec3d& direction) {
    TrkRay result{};
    for (int a = 0; a < 3; ++a) {
        result.origin[a] = ray.origin[a] + t * ray.direction[a];
        result.direction[a] = static_cast<float>(direction[a]);
    }
    result.tMax = std::numeric_limits<float>::infinity();
    return result;
}

struct Cost {
    uint64_t shadow = 0;
    uint64_t free = 0;
};

class PathTracer {
  public:
    PathTracer(const track::Volume& volume, const ScatterOptions& options)
        : volume_(volume), options_(options), channels_(volume.info().channels) {
        const TrkVolumeInfo info = volume.info();
        vdbtools::WorldBox box;
        for (int a = 0; a < 3; ++a) {
            box.lo[a] = info.boundsMin[a];
            box.hi[a] = info.boundsMax[a];
        }
        frameBox(camera_, box, 1);
        camera_.tangent *= 0.7;  // boxes are larger than what is in them
    }

    /// Adds paths `first` to `first` + `count` of every pixel of a row to `sums`, by `method`.
    void traceRow(int y, uint64_t first, uint32_t count, TrkMethod method, uint64_t seed,
                  Color* sums, Cost& cost) const {
        const auto width = static_cast<size_t>(options_.width);
        std::vector<Path> paths(width * count);
        std::vector<TrkRay> rays(paths.size());
        std::vector<uint64_t> ids(paths.size());
        // What is not the library's random numbers: the same for all methods.
        std::mt19937_64 random(seed * 0x9e3779b97f4a7c15u + first * 8191 +
                               static_cast<uint64_t>(y));
        std::uniform_real_distribution<double> unit(0, 1);
        for (size_t i = 0; i < paths.size(); ++i) {
            paths[i].pixel = i / count;
            ids[i] = ((first + i % count) * static_cast<uint64_t>(options_.width) +
                      static_cast<uint64_t>(y)) *
                         width +
                     paths[i].pixel;
            rays[i] = camera_.ray(
                (static_cast<double>(paths[i].pixel) + unit(random)) / static_cast<double>(width),
                (y + unit(random)) / options_.width, 1);
        }
        for (uint64_t bounce = 1; bounce <= kBounces; ++bounce) {
            collide(paths, rays, ids, seed, bounce, sums, cost);
            // The sun, by a shadow ray.
            std::vector<TrkRay> towards;
            for (const TrkRay& ray : rays) {
                towards.push_back(rayFrom(ray, 0, kTowardsSun));
            }
            std::vector<float> light = shadow(towards, ids, method, seed, 2 * bounce, cost);
            for (size_t i = 0; i < paths.size(); ++i) {
                const double p = phase(dot(paths[i].incoming, kTowardsSun));
                add(paths[i], &light[i * channels_], p, kSun, sums);
            }
            for (size_t i = 0; i < paths.size(); ++i) {
                rays[i] = rayFrom(rays[i], 0, scatter(paths[i].incoming, random));
            }
            if (bounce == kBounces) {  // and the sky
                light = shadow(rays, ids, method, seed, 2 * bounce + 1, cost);
                for (size_t i = 0; i < paths.size(); ++i) {
                    add(paths[i], &light[i * channels_], 1, skyRadiance(directionOf(rays[i])),
                        sums);
                }
            }
        }
    }

    /// Which pixels show the volume: more than a hundredth of the light is held back in the middle
    /// of them.
    std::vector<char> shownPixels() const {
        std::vector<TrkRay> rays;
        for (int i = 0; i < options_.width * options_.width; ++i) {
            rays.push_back(camera_.ray((i % options_.width + 0.5) / options_.width,
                                       (i / options_.width + 0.5) / options_.width, 1));
        }
        track::Query query(0, 0);
        query.method = TRK_METHOD_EXACT;
        std::vector<float> light(rays.size() * channels_);
        volume_.estimateTransmittance(query, rays.data(), rays.size(), light.data());
        std::vector<char> shown;
        for (size_t i = 0; i < rays.size(); ++i) {
            const float* first = &light[i * channels_];
            shown.push_back(*std::min_element(first, first + channels_) < 0.99f ? 1 : 0);
        }
        return shown;
    }

  private:
    static constexpr uint64_t kBounces = 2;

    struct Path {
        size_t pixel = 0;
        Color throughput{{1, 1, 1}};
        Vec3d incoming;
    };

    void add(const Path& path, const float* light, double factor, const Color& radiance,
             Color* sums) const {
        for (size_t c = 0; c < 3; ++c) {
            sums[path.pixel][c] += path.throughput[c] * factor * radiance[c] *
                                   static_cast<double>(light[channels_ == 1 ? 0 : c]);
        }
    }

    track::Query queryFor(const std::vector<uint64_t>& ids, uint64_t seed, uint64_t stream) const {
        track::Query query = track::Query::ofRays(ids.data(), stream);
        query.seed = seed;
        query.threads = 1;
        return query;
    }

    /// Moves every path to where it collides; those that escape see the sky and are gone.
    void collide(std::vector<Path>& paths, std::vector<TrkRay>& rays, std::vector<uint64_t>& ids,
                 uint64_t seed, uint64_t bounce, Color* sums, Cost& cost) const {
        track::FreePaths found(rays.size(), channels_);
        TrkFreePaths wanted = found.view();
        wanted.extinction = nullptr;
        volume_.sampleFreePath(queryFor(ids, seed, 2 * bounce), rays.data(), rays.size(), wanted);
        size_t kept = 0;
        for (size_t i = 0; i < paths.size(); ++i) {
            const float t = found.t[i];
            cost.free += found.lookups[i];
            Path path = paths[i];
            path.incoming = directionOf(rays[i]);
            for (size_t c = 0; c < 3; ++c) {
                path.throughput[c] *=
                    static_cast<double>(found.weight[channels_ == 1 ? i : 3 * i + c]);
            }
            if (std::isinf(t)) {
                const float one[3] = {1, 1, 1};
                add(path, one, 1, skyRadiance(path.incoming), sums);
                continue;
            }
            for (double& throughput : path.throughput) {
                throughput *= kAlbedo;
            }
            rays[kept] = rayFrom(rays[i], t, path.incoming);
            ids[kept] = ids[i];
            paths[kept++] = path;
        }
        paths.resize(kept);
        rays.resize(kept);
        ids.resize(kept);
    }

    std::vector<float> shadow(const std::vector<TrkRay>& rays, const std::vector<uint64_t>& ids,
                              TrkMethod method, uint64_t seed, uint64_t stream, Cost& cost) const {
        track::Query query = queryFor(ids, seed, stream);
        query.method = method;
        std::vector<float> light(rays.size() * channels_);
        std::vector<uint64_t> lookups(rays.size());
        TrkStatistics statistics = trkDefaultStatistics();
        statistics.lookups = lookups.data();
        volume_.estimateTransmittance(query, rays.data(), rays.size(), light.data(), statistics);
        cost.shadow += std::accumulate(lookups.begin(), lookups.end(), uint64_t{0});
        return light;
    }

    const track::Volume& volume_;
    const ScatterOptions& options_;
    size_t channels_;
    vdbtools::Camera camera_ = vdbtools::namedView("iso");
};

Image render(const PathTracer& tracer, const ScatterOptions& options, TrkMethod method,
             uint32_t samples, uint64_t seed, const std::function<void(double)>& progress) {
    Image image(options.width, options.width);
    std::vector<float>* channels[3] = {&image.add("R"), &image.add("G"), &image.add("B")};
    std::vector<Color> sums(image.pixelCount());
    std::atomic<int> done{0};
    trk::parallelFor(static_cast<size_t>(options.width), 1, [&](size_t i) {
        const int y = static_cast<int>(i);
        Cost cost;
        Color* row = &sums[i * static_cast<size_t>(options.width)];
        for (uint32_t first = 0; first < samples; first += kChunk) {
            tracer.traceRow(y, first, std::min(kChunk, samples - first), method, seed, row, cost);
        }
        progress(static_cast<double>(++done) / options.width);
    });
    for (size_t i = 0; i < sums.size(); ++i) {
        for (size_t c = 0; c < 3; ++c) {
            (*channels[c])[i] = static_cast<float>(sums[i][c] / samples);
        }
    }
    return image;
}

/// Over the pixels where `shown` is not 0.
double rmseOf(const Image& image, const Image& reference, const std::vector<char>& shown) {
    double sum = 0;
    size_t count = 0;
    for (const char* name : {"R", "G", "B"}) {
        const std::vector<float>& a = image.channels.at(name);
        const std::vector<float>& b = reference.channels.at(name);
        for (size_t i = 0; i < a.size(); ++i) {
            if (shown[i] != 0) {
                const double d = static_cast<double>(a[i]) - static_cast<double>(b[i]);
                sum += d * d;
                ++count;
            }
        }
    }
    return count == 0 ? 0 : std::sqrt(sum / static_cast<double>(count));
}

/// Look-ups and time a path, from rows spread over the picture.
void measureCosts(const PathTracer& tracer, const ScatterOptions& options,
                  std::vector<ScatterMethod>& methods) {
    constexpr int kRounds = 15;
    std::vector<std::vector<double>> times(methods.size());
    std::vector<Cost> costs(methods.size());
    std::vector<Color> ignored(static_cast<size_t>(options.width));
    const int step = std::max(1, options.width / 16);
    double paths = 0;
    for (int round = 0; round < kRounds; ++round) {
        for (size_t m = 0; m < methods.size(); ++m) {
            paths = 0;
            const auto start = std::chrono::steady_clock::now();
            for (int y = step / 2; y < options.width; y += step) {
                tracer.traceRow(y, 0, 4, methods[m].method,
                                options.seed + 77 + static_cast<uint64_t>(round), ignored.data(),
                                costs[m]);
                paths += 4.0 * options.width;
            }
            const std::chrono::duration<double> elapsed = std::chrono::steady_clock::now() - start;
            times[m].push_back(1e9 * elapsed.count() / paths);
        }
    }
    for (size_t m = 0; m < methods.size(); ++m) {
        std::sort(times[m].begin(), times[m].end());
        methods[m].nanoseconds = times[m][kRounds / 2];
        methods[m].spread =
            (times[m][3 * kRounds / 4] - times[m][kRounds / 4]) / methods[m].nanoseconds;
        methods[m].shadowLookups = static_cast<double>(costs[m].shadow) / (kRounds * paths);
        methods[m].lookups =
            methods[m].shadowLookups + static_cast<double>(costs[m].free) / (kRounds * paths);
    }
}

}  // namespace

Scattering renderScattering(const ScatterOptions& options,
                            const std::function<void(double)>& progress) {
    TrkVolumeOptions volumeOptions = trkDefaultVolumeOptions();
    volumeOptions.gridName = options.grid.empty() ? nullptr : options.grid.c_str();
    volumeOptions.scale = options.scale;
    volumeOptions.repair = options.repair;
    std::copy(options.color.begin(), options.color.end(), volumeOptions.color);
    const track::Volume volume =
        track::Volume::open(options.vdb, options.sidecar.c_str(), volumeOptions);
    const PathTracer tracer(volume, options);

    Scattering result;
    result.options = options;
    for (const TrkMethod method : {TRK_METHOD_DELTA, TRK_METHOD_RATIO, TRK_METHOD_RESIDUAL}) {
        ScatterMethod m;
        m.method = method;
        result.methods.push_back(std::move(m));
    }
    measureCosts(tracer, options, result.methods);
    // So many paths that what noise is left in it does not matter: an RMSE of a ninth or so of
    // those that are compared with it.
    result.referenceSamples = 64 * options.samples;
    result.reference = render(tracer, options, TRK_METHOD_RESIDUAL, result.referenceSamples,
                              options.seed + 1000, [&](double f) { progress(0.85 * f); });
    const std::vector<char> shown = tracer.shownPixels();
    std::map<uint32_t, Image> exact;  // by paths a pixel
    const ScatterMethod delta = result.methods.front();
    for (size_t m = 0; m < result.methods.size(); ++m) {
        ScatterMethod& method = result.methods[m];
        const auto picture = [&](double samples) {
            ScatterPicture p;
            p.samples = static_cast<uint32_t>(std::max(1.0, std::round(samples)));
            const auto draw = [&](TrkMethod by) {
                return render(tracer, options, by, p.samples, options.seed + 1, [](double) {});
            };
            p.image = draw(method.method);
            p.rmse = rmseOf(p.image, result.reference, shown);
            if (exact.find(p.samples) == exact.end()) {
                exact.emplace(p.samples, draw(TRK_METHOD_EXACT));
            }
            p.shadowRmse = rmseOf(p.image, exact.at(p.samples), shown);
            return p;
        };
        method.sameSamples = picture(options.samples);
        method.equalLookups = picture(options.samples * delta.lookups / method.lookups);
        method.equalTime = picture(options.samples * delta.nanoseconds / method.nanoseconds);
        progress(0.85 +
                 0.15 * static_cast<double>(m + 1) / static_cast<double>(result.methods.size()));
    }
    return result;
}

}  // namespace apps
