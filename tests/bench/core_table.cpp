// SPDX-License-Identifier: Apache-2.0
// What the tracking core takes, and what it gains over what renderers do today (baselines.h), all
// in one run on one pinned core: core_table FOLDER [FILTER]. Three procedural volumes, made into
// FOLDER where they are not there yet, camera and secondary rays, mean depths of 1, 10 and 100;
// then adversarial fields, and what colour, combs, samples, calls and two cores cost. FILTER: part
// of the names of the sets to run, as "large/camera/1". Writes FOLDER/core.csv, and Markdown tables
// to stdout.
//
// Contestants take turns; times are medians over rounds of this thread's CPU time, variances mean
// squared errors against exact integration, over rays that hit.
#include "baselines.h"
#include "core_clock.h"
#include "core_costs.h"
#include "core_sets.h"
#include "core_ways.h"
#include "support/rays.h"
#include "track/track_openvdb.hpp"

#include <sched.h>
#include <tbb/task_arena.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdio>
#include <cstring>
#include <functional>
#include <map>
#include <string>
#include <utility>
#include <vector>

namespace {

constexpr double kWanted[3] = {0.1, 0.01, 0.001};  // V0: what variance there is from elsewhere

constexpr const char* kDefaultWay = "constant 16";
constexpr const char* kBaselineRatio = "(a) NanoVDB ratio";
constexpr const char* kBaselineExact = "(b) OpenVDB HDDA";

struct Result {
    std::string name;
    std::vector<double> seconds;
    double misses = 0;  // of the cache, over all rounds
    double squares = 0;
    uint64_t lookups = 0;    // of one round
    uint64_t crossings = 0;  // the same
    double rays = 0;

    double ns() const { return 1e9 * median(seconds) / rays; }
    double variance() const { return squares / (rays * static_cast<double>(kRounds)); }
    double score(double wanted) const { return (wanted + variance()) * ns(); }
    double perRay(uint64_t count) const { return static_cast<double>(count) / rays; }
};

using Results = std::map<std::string, Result>;

Results run(const Set& set, const CacheMisses& misses) {
    std::map<std::pair<int, TrkControlKind>, track::Volume> volumes;
    for (const FixedWay& way : kWays) {
        const std::pair key(way.size, way.kind);
        if (volumes.count(key) == 0) {
            track::Volume volume = set.field.open(set.scale);
            TrkBakeOptions options = trkDefaultBakeOptions();
            options.superVoxelSize = static_cast<uint32_t>(way.size);
            options.control = way.kind;
            volume.bake(options);
            volumes.emplace(key, std::move(volume));
        }
    }
    std::vector<float> out(set.rays.size());
    const size_t count = set.rays.size();
    struct Contestant {
        Result result;
        std::function<void(uint64_t round)> run;
    };
    std::vector<Contestant> contestants;
    const auto add = [&](const char* name, std::function<void(uint64_t)> body) {
        Contestant contestant;
        contestant.result.name = name;
        contestant.result.rays = static_cast<double>(count);
        contestant.run = std::move(body);
        contestants.push_back(std::move(contestant));
    };
    uint64_t lookups = 0;
    uint64_t crossings = 0;
    add(kBaselineRatio, [&](uint64_t round) {
        set.field.ratioTracking->transmittance(set.rays.data(), count, set.scale, round, out.data(),
                                               lookups, crossings);
    });
    add(kBaselineExact, [&](uint64_t) {
        uint64_t cells = 0;
        set.field.integration->transmittance(set.rays.data(), count, set.scale, out.data(), cells);
        lookups += 2 * cells;
    });
    for (const FixedWay& way : kWays) {
        const track::Volume& volume = volumes.at({way.size, way.kind});
        add(way.name, [&volume, &way, &set, &out, count](uint64_t round) {
            volume.estimateTransmittance(queryOf(way, round), set.rays.data(), count, out.data());
        });
    }
    for (uint64_t round = 0; round < kRounds; ++round) {
        for (Contestant& contestant : contestants) {
            Result& result = contestant.result;
            lookups = crossings = 0;
            const double missesBefore = misses.sofar();
            const double start = threadSeconds();
            contestant.run(round);
            result.seconds.push_back(threadSeconds() - start);
            result.misses += misses.sofar() - missesBefore;
            result.lookups = lookups;
            result.crossings = crossings;
            for (size_t i = 0; i < count; ++i) {
                const double error = static_cast<double>(out[i]) - set.exact[i];
                result.squares += error * error;
            }
        }
    }
    Results results;
    for (Contestant& contestant : contestants) {
        results[contestant.result.name] = std::move(contestant.result);
    }
    track::Statistics statistics(count, 1);
    for (const FixedWay& way : kWays) {
        volumes.at({way.size, way.kind})
            .estimateTransmittance(queryOf(way, 0), set.rays.data(), count, out.data(),
                                   statistics.view());
        Result& result = results[way.name];
        for (size_t i = 0; i < count; ++i) {
            result.lookups += statistics.lookups[i];
            result.crossings += statistics.superVoxels[i];
        }
    }
    // Whoever is exact must agree.
    for (const char* name : {kBaselineExact, "exact"}) {
        if (!(results[name].variance() < 1e-6)) {
            std::fprintf(stderr, "core_table: %s: the mean squared error of %s is %g\n",
                         set.name.c_str(), name, results[name].variance());
            std::exit(1);
        }
    }
    return results;
}

void writeCsv(std::FILE* csv, const std::string& set, const Results& results) {
    const Result& a = results.at(kBaselineRatio);
    for (const auto& [name, r] : results) {
        std::fprintf(csv, "%s,%s,%.1f,%.3f,%.2f,%.4g,", set.c_str(), name.c_str(), r.ns(),
                     r.perRay(r.lookups), r.perRay(r.crossings), r.variance());
        const double misses = r.misses / (r.rays * static_cast<double>(kRounds));
        if (!std::isnan(misses)) {
            std::fprintf(csv, "%.2f", misses);
        }
        for (const double wanted : kWanted) {
            std::fprintf(csv, ",%.3f", a.score(wanted) / r.score(wanted));
        }
        std::fprintf(csv, "\n");
    }
    std::fflush(csv);
}

/// Of the fixed ways, the one with the least score.
const Result& bestOf(const Results& results, double wanted) {
    const Result* best = nullptr;
    for (const FixedWay& way : kWays) {
        const Result& r = results.at(way.name);
        if (!best || r.score(wanted) < best->score(wanted)) {
            best = &r;
        }
    }
    return *best;
}

void printSet(const std::string& set, const Results& results) {
    const auto ns = [&](const char* name) { return results.at(name).ns(); };
    const Result& exact = results.at("exact");
    std::printf("| %s | %.0f | %.2f | %.2f | %.2f | %.1f |", set.c_str(), ns(kBaselineRatio),
                ns(kBaselineExact) / ns("exact"), ns(kDefaultWay) / ns(kBaselineRatio),
                ns("affine 4") / ns(kBaselineRatio),
                exact.ns() / (0.5 * exact.perRay(exact.lookups)));
    // From two rates over the same super-voxels, where roulette ends few walks.
    const Result& slow = results.at("constant 8 rate 4");
    const Result& walk = results.at("constant 8");
    if (set.substr(set.rfind('/')) == "/1") {
        const double lookup =
            (slow.ns() - walk.ns()) / (walk.perRay(slow.lookups) - walk.perRay(walk.lookups));
        std::printf(" %.0f | %.0f |",
                    (walk.ns() - lookup * walk.perRay(walk.lookups)) / walk.perRay(walk.crossings),
                    lookup);
    } else {
        std::printf(" | |");
    }
    for (const double wanted : kWanted) {
        const double reference = results.at(kBaselineRatio).score(wanted);
        const Result& best = bestOf(results, wanted);
        std::printf(" %.2f (%s), %.2f |", reference / best.score(wanted), best.name.c_str(),
                    reference / results.at(kDefaultWay).score(wanted));
    }
    std::printf("\n");
    std::fflush(stdout);
}

/// Medians over the sets, and the least.
void printSummary(const std::vector<Results>& all) {
    std::printf("\n| gain over (a), median of %zu sets (least) | V0 = 0.1 | 0.01 | 0.001 |\n",
                all.size());
    std::printf("|---|---|---|---|\n");
    const auto row = [&](const char* label, const auto& chosen) {
        std::printf("| %s |", label);
        for (const double wanted : kWanted) {
            std::vector<double> gains;
            for (const Results& results : all) {
                gains.push_back(results.at(kBaselineRatio).score(wanted) /
                                chosen(results, wanted).score(wanted));
            }
            std::printf(" %.2f (%.2f) |", median(gains),
                        *std::min_element(gains.begin(), gains.end()));
        }
        std::printf("\n");
    };
    row("best fixed way in hindsight", bestOf);
    row(kDefaultWay,
        [](const Results& results, double) -> const Result& { return results.at(kDefaultWay); });
}

}  // namespace

int main(int argc, char** argv) {
    if (argc < 2 || argc > 3) {
        std::fprintf(stderr, "usage: core_table FOLDER [FILTER]\n");
        return 2;
    }
    const std::string folder = argv[1];
    const std::string filter = argc > 2 ? argv[2] : "";
    openvdb::initialize();
    std::FILE* csv = std::fopen((folder + "/core.csv").c_str(), "w");
    if (!csv) {
        std::perror((folder + "/core.csv").c_str());
        return 1;
    }
    struct Source {
        const char* name;
        const char* kind;
        int voxels;
    };
    constexpr Source kSources[] = {
        {"large", "cloud", 675}, {"small", "cloud", 165}, {"smoke", "smoke", 390}};
    std::map<std::string, Field> fields;
    // Threads of the machine make the volumes; then one core does everything.
    for (const Source& source : kSources) {
        if (std::string(source.name).find(filter.substr(0, filter.find('/'))) == 0) {
            fields.try_emplace(source.name, source.name,
                               procedural(folder, source.kind, source.voxels));
        }
    }
    tbb::this_task_arena::max_concurrency();  // which is all cores, if asked for in time
    cpu_set_t pinned;
    CPU_ZERO(&pinned);
    CPU_SET(static_cast<size_t>(sched_getcpu()), &pinned);
    sched_setaffinity(0, sizeof(pinned), &pinned);
    const CacheMisses misses;
    std::fprintf(csv,
                 "set,way,ns_per_ray,lookups_per_ray,crossings_per_ray,variance,"
                 "cache_misses_per_ray,gain_0.1,gain_0.01,gain_0.001\n");

    std::vector<Set> sets;
    for (const auto& [name, field] : fields) {
        const track::Volume volume = field.open(1);
        const rays::Box box = rays::boundsOf(volume.info());
        std::printf("%s: %.1f million active voxels\n", name.c_str(),
                    1e-6 * static_cast<double>(volume.info().activeVoxels));
        for (const char* kind : {"camera", "secondary"}) {
            const std::vector<TrkRay> from =
                kind == std::string("camera") ? cameraRays(box) : secondaryRays(volume, box);
            for (const int depth : {1, 10, 100}) {
                const std::string set = name + "/" + kind + "/" + std::to_string(depth);
                if (set.find(filter) != std::string::npos) {
                    sets.emplace_back(set, field, from, depth);
                }
            }
        }
    }
    constexpr const char* kHead =
        "| set | (a), ns a ray | exact over (b), times as fast | constant 16 over (a), time | "
        "affine 4 over (a), time | ns a cell | ns a crossing | ns a look-up | best gain over (a) "
        "(way), the default's: V0 = 0.1 | 0.01 | 0.001 |\n|---|---|---|---|---|---|---|---|---|---|"
        "---|\n";
    std::printf("\n%s", kHead);
    std::vector<Results> all;
    for (const Set& set : sets) {
        all.push_back(run(set, misses));
        writeCsv(csv, set.name, all.back());
        printSet(set.name, all.back());
    }
    if (!all.empty()) {
        printSummary(all);
    }

    std::printf("\n%s", kHead);
    for (const char* name : {"shells", "pinholes", "slabs", "filaments", "checkerboard", "voxel"}) {
        const std::string set = std::string("adversarial/") + name;
        if (set.find(filter) == std::string::npos) {
            continue;
        }
        const Field field(name, adversarial(name));
        const rays::Box box = rays::boundsOf(field.open(1).info());
        const std::string label = name;
        // What lies along z is met along z; a single voxel is hit by no chance.
        std::vector<TrkRay> from = label == "pinholes" || label == "slabs"
                                       ? parallelRays(box)
                                       : rays::through(box, 2 * kRays, 200, 1);
        for (const int depth : {1, 10}) {
            const Set hard(set + "/" + std::to_string(depth), field, from, depth);
            const Results results = run(hard, misses);
            writeCsv(csv, hard.name, results);
            printSet(hard.name, results);
        }
    }

    std::printf(
        "\n| set | constant 16 in grey, ns a ray | tint over grey | three channels over "
        "grey | exact in grey, ns a ray | tint | three channels |\n"
        "|---|---|---|---|---|---|---|\n");
    for (const Set& set : sets) {
        if (set.name.find("/1") == set.name.size() - 2) {
            printColour(set);
        }
    }
    std::printf(
        "\n| set | comb of step 1 over exact, time | RMS error | step 2 | | step 4 | |\n"
        "|---|---|---|---|---|---|---|\n");
    for (const Set& set : sets) {
        printCombs(set);
    }
    std::printf(
        "\n| set | constant 16, one sample, ns a ray | a sample of sixteen over it | affine 4 | | "
        "ratio 16 | | delta 16 | |\n"
        "|---|---|---|---|---|---|---|---|---|\n");
    for (const Set& set : sets) {
        printSamples(set);
    }
    std::printf(
        "\n| set | (a), ns a ray | constant 16 in a batch, ns a ray | ray by ray over "
        "batch | a ray that misses, ns | over (a) | two cores over one |\n"
        "|---|---|---|---|---|---|---|\n");
    for (const Set& set : sets) {
        if (set.name.find("/1") == set.name.size() - 2) {
            printCalls(set);
        }
    }
    std::fclose(csv);
    return 0;
}
