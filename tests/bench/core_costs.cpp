// SPDX-License-Identifier: Apache-2.0
#include "core_costs.h"

#include "core_clock.h"
#include "core_ways.h"
#include "track/track_openvdb.hpp"

#include <sched.h>

#include <cmath>
#include <cstddef>
#include <cstdio>
#include <filesystem>
#include <functional>
#include <map>
#include <string>
#include <utility>
#include <vector>

namespace {

/// Medians of `seconds()` around each of some bodies, which take turns.
std::vector<double> timesOf(const std::vector<std::function<void()>>& bodies, double (*seconds)()) {
    std::vector<std::vector<double>> times(bodies.size());
    for (uint64_t round = 0; round < kRounds; ++round) {
        for (size_t i = 0; i < bodies.size(); ++i) {
            const double start = seconds();
            bodies[i]();
            times[i].push_back(seconds() - start);
        }
    }
    std::vector<double> result;
    for (const std::vector<double>& t : times) {
        result.push_back(median(t));
    }
    return result;
}

}  // namespace

void printColour(const Set& set) {
    TrkVolumeOptions options = trkDefaultVolumeOptions();
    options.scale = set.scale;
    const track::Volume grey = track::makeVolume(*set.field.grid, options);
    const track::Volume vectors = track::makeVolume(*threeChannels(*set.field.grid), options);
    options.color[1] = 0.9f;
    options.color[2] = 0.8f;
    const track::Volume tinted = track::makeVolume(*set.field.grid, options);
    std::printf("| %s |", set.name.c_str());
    std::vector<float> out(3 * set.rays.size());
    for (const FixedWay& way : {kWays[5], kWays[0]}) {
        std::vector<std::function<void()>> bodies;
        for (const track::Volume* volume : {&grey, &tinted, &vectors}) {
            bodies.push_back([&, volume] {
                volume->estimateTransmittance(queryOf(way, 0), set.rays.data(), set.rays.size(),
                                              out.data());
            });
        }
        const std::vector<double> times = timesOf(bodies, threadSeconds);
        std::printf(" %.0f | %.2f | %.2f |", 1e9 * times[0] / static_cast<double>(set.rays.size()),
                    times[1] / times[0], times[2] / times[0]);
    }
    std::printf("\n");
    std::fflush(stdout);
}

void printCombs(const Set& set) {
    track::Volume volume = set.field.open(set.scale);
    volume.bake();
    std::printf("| %s |", set.name.c_str());
    std::vector<float> out(set.rays.size());
    const auto estimate = [&](TrkMethod method, float step, uint64_t seed) {
        track::Query query(seed, 0);
        query.method = method;
        query.step = step;
        query.threads = 1;
        volume.estimateTransmittance(query, set.rays.data(), set.rays.size(), out.data());
    };
    for (const float step : {1.0f, 2.0f, 4.0f}) {
        uint64_t seed = 0;
        double squares = 0;
        const std::vector<double> times =
            timesOf({[&] { estimate(TRK_METHOD_EXACT, 1, 0); },
                     [&] {
                         estimate(TRK_METHOD_COMB, step, seed++);
                         for (size_t i = 0; i < out.size(); ++i) {
                             const double error = static_cast<double>(out[i]) - set.exact[i];
                             squares += error * error;
                         }
                     }},
                    threadSeconds);
        std::printf(" %.2f | %.2g |", times[1] / times[0],
                    std::sqrt(squares / static_cast<double>(kRounds * out.size())));
    }
    std::printf("\n");
    std::fflush(stdout);
}

void printSamples(const Set& set) {
    std::map<TrkControlKind, track::Volume> volumes;
    for (const TrkControlKind kind : {TRK_CONTROL_CONSTANT, TRK_CONTROL_AFFINE}) {
        track::Volume volume = set.field.open(set.scale);
        TrkBakeOptions bake = trkDefaultBakeOptions();
        bake.superVoxelSize = kind == TRK_CONTROL_AFFINE ? 4 : 16;
        bake.control = kind;
        volume.bake(bake);
        volumes.emplace(kind, std::move(volume));
    }
    std::printf("| %s |", set.name.c_str());
    std::vector<float> out(set.rays.size());
    constexpr uint32_t kSamples = 16;
    for (const FixedWay& way : {kWays[5], kWays[7], kWays[1], kWays[2]}) {
        const auto estimate = [&](uint32_t samples) {
            track::Query query = queryOf(way, 0);
            query.samples = samples;
            volumes.at(way.kind).estimateTransmittance(query, set.rays.data(), set.rays.size(),
                                                       out.data());
        };
        const std::vector<double> times =
            timesOf({[&] { estimate(1); }, [&] { estimate(kSamples); }}, threadSeconds);
        std::printf(" %.0f | %.2f |", 1e9 * times[0] / static_cast<double>(set.rays.size()),
                    times[1] / (kSamples * times[0]));
    }
    std::printf("\n");
    std::fflush(stdout);
}

void printCalls(const Set& set) {
    TrkVolumeOptions options = trkDefaultVolumeOptions();
    options.scale = set.scale;
    const track::Volume volume = track::makeVolume(*set.field.grid, options);
    const FixedWay& way = kWays[5];
    std::vector<TrkRay> away = set.rays;
    for (TrkRay& ray : away) {
        for (int a = 0; a < 3; ++a) {
            ray.origin[a] += 1000;  // the procedural volumes are 10 wide
            ray.direction[a] = std::fabs(ray.direction[a]);
        }
    }
    std::vector<float> out(set.rays.size());
    const auto single = [&](const std::vector<TrkRay>& from) {
        track::Query query = queryOf(way, 0);
        for (size_t i = 0; i < from.size(); ++i) {
            query.firstRayId = i;
            volume.estimateTransmittance(query, &from[i], 1, &out[i]);
        }
    };
    const auto batch = [&](const std::vector<TrkRay>& from) {
        volume.estimateTransmittance(queryOf(way, 0), from.data(), from.size(), out.data());
    };
    uint64_t ignored = 0;
    const std::vector<double> times = timesOf(
        {[&] {
             set.field.ratioTracking->transmittance(set.rays.data(), set.rays.size(), set.scale, 0,
                                                    out.data(), ignored, ignored);
         },
         [&] { batch(set.rays); }, [&] { single(set.rays); }, [&] { single(away); }},
        threadSeconds);
    std::vector<TrkRay> many;
    while (many.size() < 100000) {
        many.insert(many.end(), set.rays.begin(), set.rays.end());
    }
    many.resize(100000);
    std::vector<float> results(many.size());
    const auto onThreads = [&](int threads) {
        track::Query query = queryOf(way, 0);
        query.threads = threads;
        volume.estimateTransmittance(query, many.data(), many.size(), results.data());
    };
    cpu_set_t all;
    CPU_ZERO(&all);
    cpu_set_t pinned;
    sched_getaffinity(0, sizeof(pinned), &pinned);
    for (int cpu = 0; cpu < CPU_SETSIZE; ++cpu) {
        CPU_SET(cpu, &all);
    }
    onThreads(2);
    // TBB's threads are pinned where they were started by one that was.
    for (const auto& thread : std::filesystem::directory_iterator("/proc/self/task")) {
        sched_setaffinity(std::stoi(thread.path().filename()), sizeof(all), &all);
    }
    const std::vector<double> walls =
        timesOf({[&] { onThreads(1); }, [&] { onThreads(2); }}, wallSeconds);
    sched_setaffinity(0, sizeof(pinned), &pinned);
    const auto ns = [&](double seconds) {
        return 1e9 * seconds / static_cast<double>(set.rays.size());
    };
    std::printf("| %s | %.0f | %.0f | %.2f | %.0f | %.3f | %.2f |\n", set.name.c_str(),
                ns(times[0]), ns(times[1]), times[2] / times[1], ns(times[3]), times[3] / times[0],
                walls[0] / walls[1]);
    std::fflush(stdout);
}
