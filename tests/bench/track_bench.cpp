// SPDX-License-Identifier: Apache-2.0
// Time per ray of every method, on the procedural cloud or the density in TRACK_BENCH_VOLUME, for
// camera rays (coherent) and rays from anywhere inside (incoherent), on one thread. Counters:
// density look-ups a ray, variance of one estimate. Compare rows of one run, not of two.
#include "bake/bake.h"
#include "io/density.h"
#include "support/fixtures.h"
#include "support/rays.h"
#include "track/track.hpp"

#include <benchmark/benchmark.h>

#include <cmath>
#include <cstdlib>
#include <map>
#include <memory>
#include <string>
#include <vector>

namespace {

std::string volumeFile() {
    const char* given = std::getenv("TRACK_BENCH_VOLUME");
    return given ? given : fixtures::cloudFile(256);
}

std::vector<TrkRay> cameraRays(const rays::Box& box) {
    constexpr int kSide = 128;
    double eye[3];
    double centre[3];
    for (int a = 0; a < 3; ++a) {
        centre[a] = 0.5 * (box.lo[a] + box.hi[a]);
        eye[a] = centre[a] + (a == 1 ? 1.2 : 2.0) * (box.hi[a] - box.lo[a]);
    }
    std::vector<TrkRay> result;
    for (int y = 0; y < kSide; ++y) {
        for (int x = 0; x < kSide; ++x) {
            const double target[3] = {
                centre[0] + (static_cast<double>(x) / kSide - 0.5) * (box.hi[0] - box.lo[0]),
                centre[1] + (static_cast<double>(y) / kSide - 0.5) * (box.hi[1] - box.lo[1]),
                centre[2]};
            TrkRay ray{};
            for (int a = 0; a < 3; ++a) {
                ray.origin[a] = static_cast<float>(eye[a]);
                ray.direction[a] = static_cast<float>(target[a] - eye[a]);
            }
            ray.tMax = rays::kInfinity;
            result.push_back(ray);
        }
    }
    return result;
}

struct Set {
    std::unique_ptr<track::Volume> volume;
    std::vector<TrkRay> rays;
    std::vector<float> exact;
};

track::Query singleThreaded(TrkMethod method) {
    track::Query query(0, 0);
    query.method = method;
    query.threads = 1;
    return query;
}

/// What is measured: a volume with super-voxels of `size`, scaled to a mean optical depth of the
/// rays that hit (in the first channel).
struct Case {
    int size = 16;
    int depth = 1;
    bool coherent = true;
    std::string colour = "grey";  // "tinted": the same volume; "vectors": the coloured cloud
    trk::ControlKind kind = trk::ControlKind::kConstant;

    std::string label() const {
        return "/size" + std::to_string(size) + "/depth" + std::to_string(depth) +
               (coherent ? "/camera" : "/inside") + (colour == "grey" ? "" : "/" + colour) +
               (kind == trk::ControlKind::kConstant ? "" : std::string("/") + controlName(kind));
    }
};

Set& makeSet(const Case& c) {
    static std::map<std::string, Set> sets;
    Set& set = sets[c.label()];
    if (set.volume) {
        return set;
    }
    const std::string vdb =
        c.colour == "vectors" ? fixtures::cloudFile(256, "color-cloud") : volumeFile();
    const std::string sidecar = fixtures::path("bench.track.vdb");
    fixtures::bake(vdb, sidecar, c.size, 2, c.kind);
    TrkVolumeOptions options = trkDefaultVolumeOptions();
    options.color[1] = c.colour == "tinted" ? 0.5f : 1.0f;
    const track::Volume unscaled = track::Volume::open(vdb, "", options);
    const rays::Box box = rays::boundsOf(unscaled.info());
    set.rays = c.coherent ? cameraRays(box) : rays::through(box, 16384, 0, 1);
    const track::Query query = singleThreaded(TRK_METHOD_EXACT);
    const size_t channels = unscaled.info().channels;
    std::vector<double> depths(channels * set.rays.size());
    unscaled.integrateOpticalDepth(query, set.rays.data(), set.rays.size(), depths.data());
    double sum = 0;
    double hits = 0;
    for (size_t i = 0; i < depths.size(); i += channels) {
        sum += depths[i];
        hits += depths[i] > 0 ? 1 : 0;
    }
    options.scale = static_cast<float>(c.depth * hits / sum);
    set.volume =
        std::make_unique<track::Volume>(track::Volume::open(vdb, sidecar.c_str(), options));
    set.exact.resize(channels * set.rays.size());
    set.volume->estimateTransmittance(query, set.rays.data(), set.rays.size(), set.exact.data());
    return set;
}

void estimate(benchmark::State& state, TrkMethod method, const Case& measured) {
    Set& set = makeSet(measured);
    track::Query query = singleThreaded(method);
    std::vector<float> out(set.exact.size());
    track::Statistics statistics(set.rays.size(), out.size() / set.rays.size());
    double squares = 0;
    double lookups = 0;
    for (auto ignored : state) {
        ++query.seed;
        set.volume->estimateTransmittance(query, set.rays.data(), set.rays.size(), out.data(),
                                          statistics.view());
        state.PauseTiming();
        for (size_t i = 0; i < out.size(); ++i) {
            const double error = static_cast<double>(out[i]) - static_cast<double>(set.exact[i]);
            squares += error * error;
        }
        for (const uint64_t n : statistics.lookups) {
            lookups += static_cast<double>(n);
        }
        state.ResumeTiming();
    }
    const double rays = static_cast<double>(set.rays.size() * state.iterations());
    state.counters["s/ray"] =
        benchmark::Counter(rays, benchmark::Counter::kIsRate | benchmark::Counter::kInvert);
    state.counters["lookups"] = lookups / rays;
    state.counters["mse"] = squares / static_cast<double>(out.size() * state.iterations());
}

/// Free paths by decomposition or delta tracking; look-ups as counter.
void samplePaths(benchmark::State& state, TrkMethod method, const Case& measured) {
    Set& set = makeSet(measured);
    track::Query query = singleThreaded(method);
    track::FreePaths out(set.rays.size(), set.exact.size() / set.rays.size());
    double lookups = 0;
    for (auto ignored : state) {
        ++query.seed;
        set.volume->sampleFreePath(query, set.rays.data(), set.rays.size(), out.view());
        state.PauseTiming();
        for (const uint32_t n : out.lookups) {
            lookups += n;
        }
        state.ResumeTiming();
    }
    const double rays = static_cast<double>(set.rays.size() * state.iterations());
    state.counters["s/ray"] =
        benchmark::Counter(rays, benchmark::Counter::kIsRate | benchmark::Counter::kInvert);
    state.counters["lookups"] = lookups / rays;
}

void bakeStatistics(benchmark::State& state) {
    const trk::Density density = fixtures::load(volumeFile());
    for (auto ignored : state) {
        benchmark::DoNotOptimize(
            trk::bake(density.field, fixtures::bakeOptions(static_cast<int>(state.range(0)), 4)));
    }
}

void loadDensity(benchmark::State& state) {
    const std::string vdb = volumeFile();
    for (auto ignored : state) {
        benchmark::DoNotOptimize(fixtures::load(vdb));
    }
}

}  // namespace

int main(int argc, char** argv) {
    const std::pair<const char*, TrkMethod> methods[] = {
        {"exact", TRK_METHOD_EXACT}, {"residual", TRK_METHOD_RESIDUAL},
        {"ratio", TRK_METHOD_RATIO}, {"control", TRK_METHOD_CONTROL},
        {"delta", TRK_METHOD_DELTA}, {"march", TRK_METHOD_MARCH}};
    std::vector<Case> cases;
    for (const bool coherent : {true, false}) {
        for (const int depth : {1, 10}) {
            for (const int size : {8, 16}) {
                cases.push_back({size, depth, coherent});
            }
        }
    }
    for (const char* colour : {"tinted", "vectors"}) {
        cases.push_back({16, 1, true, colour});
    }
    for (const trk::ControlKind kind : {trk::ControlKind::kTrilinear, trk::ControlKind::kAffine}) {
        cases.push_back({16, 1, true, "grey", kind});
    }
    for (const Case& c : cases) {
        for (const auto& [name, method] : methods) {
            const TrkMethod m = method;
            benchmark::RegisterBenchmark((name + c.label()).c_str(), [=](benchmark::State& state) {
                estimate(state, m, c);
            })->Unit(benchmark::kMillisecond);
        }
    }
    for (const auto& [name, method] : {std::pair{"freepath/decomposition", TRK_METHOD_RESIDUAL},
                                       std::pair{"freepath/delta", TRK_METHOD_DELTA}}) {
        for (const int depth : {1, 10}) {
            const TrkMethod m = method;
            const Case c{16, depth, false};
            benchmark::RegisterBenchmark((name + c.label()).c_str(), [=](benchmark::State& state) {
                samplePaths(state, m, c);
            })->Unit(benchmark::kMillisecond);
        }
    }
    benchmark::RegisterBenchmark("load", loadDensity)->Unit(benchmark::kMillisecond);
    benchmark::RegisterBenchmark("bake", bakeStatistics)
        ->Arg(4)
        ->Arg(16)
        ->Unit(benchmark::kMillisecond);
    benchmark::Initialize(&argc, argv);
    benchmark::RunSpecifiedBenchmarks();
    return 0;
}
