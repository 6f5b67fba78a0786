// SPDX-License-Identifier: Apache-2.0
// Free paths, extinction at points, and the query fields of the random methods, through the C API.
#include "track/track.hpp"

#include "support/fixtures.h"
#include "support/rays.h"
#include "support/reference.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <cstring>
#include <limits>
#include <random>
#include <string>
#include <vector>

namespace {

const float kNan = std::numeric_limits<float>::quiet_NaN();

struct Cloud {
    std::string vdb = fixtures::cloudFile(64);
    std::string sidecar = fixtures::path("sampling.track.vdb");
    explicit Cloud(trk::ControlKind kind = trk::ControlKind::kConstant) {
        fixtures::bake(vdb, sidecar, 8, 2, kind);
    }
    track::Volume open(float scale = 3, bool global = false,
                       TrkChoice choice = TRK_CHOICE_ROBUST) const {
        TrkVolumeOptions options = trkDefaultVolumeOptions();
        options.scale = scale;
        options.global = global ? 1 : 0;
        options.choice = choice;
        return track::Volume::open(vdb, sidecar.c_str(), options);
    }
};

void expectRefused(TrkStatus status, TrkStatus expected, const std::string& text) {
    EXPECT_EQ(status, expected) << trkGetStatusName(status);
    EXPECT_NE(std::string(trkGetLastErrorMessage()).find(text), std::string::npos)
        << trkGetLastErrorMessage();
}

TEST(Sampling, RefusesBadQueriesBeforeWritingAnything) {
    const Cloud cloud;
    const track::Volume volume = cloud.open();
    std::vector<TrkRay> all = rays::through(rays::boundsOf(volume.info()), 10, 20, 1);
    track::FreePaths paths(10, 1);
    std::fill(paths.t.begin(), paths.t.end(), -7.0f);
    const TrkFreePaths view = paths.view();
    const auto refused = [&](const char* text, const auto& change) {
        track::Query query(0, 0);
        change(query);
        expectRefused(trkSampleFreePath(volume.handle(), &query, all.data(), all.size(), &view),
                      TRK_ERROR_INVALID_ARGUMENT, text);
        EXPECT_EQ(paths.t, std::vector<float>(10, -7.0f));
    };
    for (const TrkMethod method :
         {TRK_METHOD_EXACT, TRK_METHOD_RATIO, TRK_METHOD_CONTROL, TRK_METHOD_MARCH}) {
        refused("no free paths", [&](TrkQuery& q) { q.method = method; });
    }
    refused("samples is 2", [](TrkQuery& q) { q.samples = 2; });
    refused("majorant", [](TrkQuery& q) { q.rate = 0.99f; });
    refused("flags", [](TrkQuery& q) { q.flags = 8; });
    all[4].direction[1] = kNan;
    refused("ray 4", [](TrkQuery&) {});
    expectRefused(trkSampleFreePath(nullptr, nullptr, all.data(), 1, &view),
                  TRK_ERROR_INVALID_ARGUMENT, "volume is NULL");
    expectRefused(trkSampleFreePath(volume.handle(), nullptr, all.data(), 1, nullptr),
                  TRK_ERROR_INVALID_ARGUMENT, "NULL");
    TrkFreePaths without = view;
    without.t = nullptr;
    expectRefused(trkSampleFreePath(volume.handle(), nullptr, all.data(), 1, &without),
                  TRK_ERROR_INVALID_ARGUMENT, "TrkFreePaths.t is NULL");
    without = view;
    without.weightStride = 6;
    expectRefused(trkSampleFreePath(volume.handle(), nullptr, all.data(), 1, &without),
                  TRK_ERROR_INVALID_ARGUMENT, "weightStride");
    EXPECT_EQ(trkSampleFreePath(volume.handle(), nullptr, nullptr, 0, nullptr), TRK_OK);

    TrkVolumeOptions noBake = trkDefaultVolumeOptions();
    noBake.noBake = 1;
    const track::Volume bare = track::Volume::open(cloud.vdb, "", noBake);
    const track::Volume alone = track::Volume::open("", cloud.sidecar.c_str());
    expectRefused(trkSampleFreePath(bare.handle(), nullptr, all.data(), 1, &view),
                  TRK_ERROR_NO_SIDECAR, "sidecar");
    expectRefused(trkSampleFreePath(alone.handle(), nullptr, all.data(), 1, &view),
                  TRK_ERROR_NO_DENSITY, "density");

    const float points[6] = {0, 0, 0, 1, kNan, 1};
    float out[2] = {-7, -7};
    expectRefused(trkSampleExtinction(volume.handle(), points, 0, 2, out, 0),
                  TRK_ERROR_INVALID_ARGUMENT, "point 1");
    EXPECT_EQ(out[0], -7);
    expectRefused(trkSampleExtinction(volume.handle(), points, 10, 1, out, 0),
                  TRK_ERROR_INVALID_ARGUMENT, "pointStride");
    expectRefused(trkSampleExtinction(volume.handle(), nullptr, 0, 1, out, 0),
                  TRK_ERROR_INVALID_ARGUMENT, "NULL");
    expectRefused(trkSampleExtinction(nullptr, points, 0, 1, out, 0), TRK_ERROR_INVALID_ARGUMENT,
                  "volume is NULL");
    expectRefused(trkSampleExtinction(alone.handle(), points, 0, 1, out, 0), TRK_ERROR_NO_DENSITY,
                  "density");
    EXPECT_EQ(trkSampleExtinction(bare.handle(), points, 0, 1, out, 0), TRK_OK);
    EXPECT_EQ(trkSampleExtinction(volume.handle(), nullptr, 0, 0, nullptr, 0), TRK_OK);
}

TEST(Sampling, RefusesBadFieldsOfTheNewMethods) {
    const Cloud cloud;
    const track::Volume volume = cloud.open();
    const TrkRay ray{{0, 0, 0}, 0, {1, 1, 1}, 100};
    float out = -7;
    const auto refused = [&](const char* text, const auto& change) {
        track::Query query(0, 0);
        change(query);
        expectRefused(trkEstimateTransmittance(volume.handle(), &query, &ray, 1, &out, nullptr),
                      TRK_ERROR_INVALID_ARGUMENT, text);
        EXPECT_EQ(out, -7);
    };
    refused("rateBase", [](TrkQuery& q) { q.rateBase = 2; });
    refused("majorant", [](TrkQuery& q) {
        q.method = TRK_METHOD_DELTA;
        q.rate = 0.5f;
    });
    for (const float step : {0.0f, -1.0f, 1e-4f, kNan, rays::kInfinity}) {
        refused("step", [&](TrkQuery& q) { q.step = step; });
    }
    TrkVolumeOptions options = trkDefaultVolumeOptions();
    options.global = 2;
    TrkVolume* bad = nullptr;
    expectRefused(trkOpenVolume(cloud.vdb.c_str(), "", &options, &bad), TRK_ERROR_INVALID_ARGUMENT,
                  "global");
    double depth = 0;
    track::Query march(0, 0);
    march.method = TRK_METHOD_MARCH;
    expectRefused(trkIntegrateOpticalDepth(volume.handle(), &march, &ray, 1, &depth),
                  TRK_ERROR_INVALID_ARGUMENT, "random");
}

TEST(Sampling, PathsEndWhereTheRaySaysWithTheExtinctionThere) {
    const Cloud cloud;
    const track::Volume volume = cloud.open();
    std::vector<TrkRay> all = rays::through(rays::boundsOf(volume.info()), 2000, 20, 1);
    for (size_t i = 0; i < all.size(); ++i) {  // of any length, from anywhere, to anywhere
        for (float& d : all[i].direction) {
            d *= 0.25f * static_cast<float>(1 + i % 13);
        }
        all[i].tMin = i % 3 ? 0.0f : 10.0f;
        all[i].tMax = i % 4 ? rays::kInfinity : 12.0f;
    }
    for (const TrkMethod method : {TRK_METHOD_RESIDUAL, TRK_METHOD_DELTA}) {
        track::Query query(0, 0);
        query.method = method;
        track::FreePaths paths(all.size(), 1);
        volume.sampleFreePath(query, all.data(), all.size(), paths.view());
        size_t collided = 0;
        for (size_t i = 0; i < all.size(); ++i) {
            EXPECT_EQ(paths.weight[i], 1.0f);
            if (std::isinf(paths.t[i])) {
                EXPECT_EQ(paths.extinction[i], 0.0f);
                continue;
            }
            ++collided;
            ASSERT_GE(paths.t[i], all[i].tMin);
            ASSERT_LE(paths.t[i], all[i].tMax);
            float point[3];
            for (int a = 0; a < 3; ++a) {
                point[a] = all[i].origin[a] + paths.t[i] * all[i].direction[a];
            }
            float extinction = -1;
            volume.sampleExtinction(point, 1, &extinction);
            EXPECT_NEAR(paths.extinction[i], extinction, 1e-3f * (1 + extinction));
            EXPECT_GT(paths.lookups[i], 0u);
        }
        EXPECT_GT(collided, 300u);
        EXPECT_LT(collided, 1900u);
        // What is not wanted does not change the rest.
        std::vector<float> t(all.size());
        TrkFreePaths plain = trkDefaultFreePaths();
        plain.t = t.data();
        volume.sampleFreePath(query, all.data(), all.size(), plain);
        EXPECT_EQ(t, paths.t);
    }
}

TEST(Sampling, ParametersAreTheRaysOwn) {
    // Extinction 0.4 over x in [0, 63]: half of the photons go 1.733 far.
    const auto grid = fixtures::makeGrid(openvdb::CoordBBox(-8, -8, -8, 71, 71, 71),
                                         [](const openvdb::Coord&) { return 0.2f; });
    const std::string vdb = fixtures::write("slab.vdb", {grid});
    const std::string sidecar = fixtures::path("slab.track.vdb");
    fixtures::bake(vdb, sidecar, 8);
    TrkVolumeOptions options = trkDefaultVolumeOptions();
    options.scale = 2;
    const track::Volume volume = track::Volume::open(vdb, sidecar.c_str(), options);
    const float length = 2.5f;
    const std::vector<TrkRay> all(20000,
                                  {{-100, 30, 30}, 104 / length, {length, 0, 0}, rays::kInfinity});
    track::FreePaths paths(all.size(), 1);
    volume.sampleFreePath({0, 0}, all.data(), all.size(), paths.view());
    double near = 0;
    for (size_t i = 0; i < all.size(); ++i) {
        near += (paths.t[i] - 104 / length) * length < 1.7328680f ? 1 : 0;
        EXPECT_EQ(paths.extinction[i], 0.4f);
        EXPECT_EQ(paths.lookups[i], 0u);  // homogeneous
    }
    EXPECT_NEAR(near / 20000, 0.5, 5 * std::sqrt(0.25 / 20000));
}

/// The seed with which the first random word of the free path of ray 0, stream 0 is `word`: the
/// generator's steps undone. They are one to one.
uint64_t seedOfFirstWord(uint64_t word) {
    const auto unmix = [](uint64_t z) {
        const auto inverse = [](uint64_t odd) {
            uint64_t x = odd;  // right in 3 bits, and twice as many each time [Newton]
            for (int i = 0; i < 5; ++i) {
                x *= 2 - odd * x;
            }
            return x;
        };
        const auto unshift = [](uint64_t x, int n) { return x ^ x >> n ^ x >> 2 * n; };
        z = unshift(z, 31) * inverse(0x94d049bb133111ebu);
        z = unshift(z, 27) * inverse(0xbf58476d1ce4e5b9u);
        return unshift(z, 30) - 0x9e3779b97f4a7c15u;
    };
    uint64_t state = (unmix(word) - 0x9e3779b97f4a7c15u) ^ 0x2545f4914f6cdd1du;
    for (int i = 0; i < 4; ++i) {  // sample 0, ray id 0, stream 0, seed
        state = unmix(state);
    }
    return state;
}

/// The largest difference between the shares of `found` (sorted) below a point and a
/// distribution's.
template <class Distribution>
double farthest(const std::vector<double>& found, const Distribution& below) {
    double largest = 0;
    for (size_t i = 0; i < found.size(); ++i) {
        const double share = below(found[i]);
        const auto n = static_cast<double>(found.size());
        largest = std::max({largest, std::fabs(static_cast<double>(i) / n - share),
                            std::fabs(static_cast<double>(i + 1) / n - share)});
    }
    return largest;
}

// In thin haze, photons that do collide collide anywhere with equal probability.
TEST(Sampling, ThinHazeCollidesAnywhere) {
    const auto grid = fixtures::makeGrid(openvdb::CoordBBox(-8, -8, -8, 71, 71, 71),
                                         [](const openvdb::Coord&) { return 1.0f; });
    const std::string vdb = fixtures::write("haze.vdb", {grid});
    const std::string sidecar = fixtures::path("haze.track.vdb");
    fixtures::bake(vdb, sidecar, 8);
    const TrkRay ray{{0, 30, 30}, 0, {1, 0, 0}, 64};
    for (const double depth : {1e-4, 1e-6, 1e-8, 1e-10}) {
        TrkVolumeOptions options = trkDefaultVolumeOptions();
        options.scale = static_cast<float>(depth / 64);
        const track::Volume volume = track::Volume::open(vdb, sidecar.c_str(), options);
        // The first number of a path decides how far it goes. Paths that collide are too rare to be
        // met: so seeds are chosen for which they do, as evenly as words of random bits are.
        constexpr size_t kCount = 4000;
        std::vector<double> where;
        std::mt19937_64 random(7);
        std::uniform_real_distribution<double> unit(0, 1);
        for (size_t i = 0; i < kCount; ++i) {
            const double target = unit(random) * depth;  // P(X < x) = x here
            const auto bits = static_cast<uint64_t>(target * 0x1p64);
            const uint64_t seed = seedOfFirstWord(bits);
            track::Query query(0, 0);
            query.seed = seed;
            float t = -1;
            TrkFreePaths paths = trkDefaultFreePaths();
            paths.t = &t;
            volume.sampleFreePath(query, &ray, 1, paths);
            if (std::isfinite(t)) {
                where.push_back(static_cast<double>(t) / 64);
            }
        }
        EXPECT_GT(where.size(), kCount * 99 / 100) << depth;
        std::sort(where.begin(), where.end());
        EXPECT_LT(farthest(where, [](double x) { return x; }), 2.0 / std::sqrt(kCount)) << depth;
        EXPECT_EQ(std::unique(where.begin(), where.end()), where.end()) << depth;
    }
}

TEST(Sampling, ACollisionIsFiniteWhereTheParameterIsTooLarge) {
    const Cloud cloud;
    const track::Volume volume = cloud.open(1000);
    const TrkRay ray{{-10, 5, 5}, 0, {1e-38f, 0, 0}, rays::kInfinity};  // enters at t = 1e39
    track::FreePaths path(1, 1);
    volume.sampleFreePath({0, 0}, &ray, 1, path.view());
    EXPECT_EQ(path.t[0], std::numeric_limits<float>::max());
    EXPECT_GT(path.extinction[0], 0);
}

TEST(Sampling, MissesAndEmptyIntervalsEscape) {
    const Cloud cloud;
    const track::Volume volume = cloud.open(1000);
    const TrkRay all[] = {{{50, 50, 50}, 0, {0, 1, 0}, rays::kInfinity},
                          {{5, 5, 5}, 2, {1, 0, 0}, 1},
                          {{5, 5, 5}, 1, {1, 0, 0}, 1}};
    track::FreePaths paths(3, 1);
    volume.sampleFreePath({0, 0}, all, 3, paths.view());
    for (size_t i = 0; i < 3; ++i) {
        EXPECT_EQ(paths.t[i], rays::kInfinity);
        EXPECT_EQ(paths.weight[i], 1.0f);
        EXPECT_EQ(paths.extinction[i], 0.0f);
        EXPECT_EQ(paths.lookups[i], 0u);
    }
}

TEST(Sampling, SameBitsForThreadsSinglesAndSplits) {
    const std::string vdb = fixtures::cloudFile(64, "color-cloud");
    const std::string sidecar = fixtures::path("sampling-color.track.vdb");
    fixtures::bake(vdb, sidecar, 8);
    TrkVolumeOptions options = trkDefaultVolumeOptions();
    options.scale = 3;
    const track::Volume volume = track::Volume::open(vdb, sidecar.c_str(), options);
    const std::vector<TrkRay> all = rays::through(rays::boundsOf(volume.info()), 1000, 20, 1);
    for (const TrkMethod method : {TRK_METHOD_RESIDUAL, TRK_METHOD_DELTA}) {
        track::Query query(0, 0);
        query.method = method;
        track::FreePaths batch(all.size(), 3);
        volume.sampleFreePath(query, all.data(), all.size(), batch.view());
        // One by one, into records of the caller's own.
        struct Record {
            float t;
            float weight[3];
            float extinction[3];
            float other;
        };
        std::vector<Record> alone(all.size(), {0, {}, {}, 42});
        query.threads = 1;
        size_t coloured = 0;
        for (size_t i = 0; i < all.size(); ++i) {
            query.firstRayId = i;
            TrkFreePaths view = trkDefaultFreePaths();
            view.t = &alone[i].t;
            view.weight = alone[i].weight;
            view.extinction = alone[i].extinction;
            volume.sampleFreePath(query, &all[i], 1, view);
            EXPECT_EQ(alone[i].t, batch.t[i]);
            EXPECT_EQ(std::memcmp(alone[i].weight, &batch.weight[3 * i], 12), 0);
            EXPECT_EQ(std::memcmp(alone[i].extinction, &batch.extinction[3 * i], 12), 0);
            coloured += batch.weight[3 * i] != batch.weight[3 * i + 1] ? 1 : 0;
        }
        query.firstRayId = 0;
        std::vector<Record> strided(all.size(), {0, {}, {}, 42});
        TrkFreePaths view = trkDefaultFreePaths();
        view.t = &strided[0].t;
        view.weight = strided[0].weight;
        view.extinction = strided[0].extinction;
        view.tStride = view.weightStride = view.extinctionStride = sizeof(Record);
        volume.sampleFreePath(query, all.data(), all.size(), view);
        EXPECT_EQ(std::memcmp(strided.data(), alone.data(), all.size() * sizeof(Record)), 0);
        EXPECT_GT(coloured, 300u);
    }
}

template <class GridType>
void expectInterpolated(const std::string& name, const typename GridType::Ptr& grid,
                        const std::array<float, 3>& color, size_t channels) {
    const std::string vdb = fixtures::write(name, {grid});
    TrkVolumeOptions options = trkDefaultVolumeOptions();
    options.scale = 1.5f;
    std::copy(color.begin(), color.end(), options.color);
    const track::Volume volume = track::Volume::open(vdb, "", options);
    ASSERT_EQ(volume.info().channels, channels);
    const auto accessor = grid->getConstAccessor();
    std::mt19937_64 random(3);
    std::uniform_real_distribution<double> unit(-3, 40);
    size_t inside = 0;
    for (int i = 0; i < 2000; ++i) {
        const openvdb::Vec3d world =
            grid->indexToWorld(openvdb::Vec3d(unit(random), unit(random), unit(random)));
        const float point[3] = {static_cast<float>(world[0]), static_cast<float>(world[1]),
                                static_cast<float>(world[2])};
        float found[3] = {-1, -1, -1};
        volume.sampleExtinction(point, 1, found);
        const openvdb::Vec3d index =
            grid->worldToIndex(openvdb::Vec3d(point[0], point[1], point[2]));
        const openvdb::Coord cell = openvdb::Coord::floor(index);
        for (size_t c = 0; c < channels; ++c) {
            double expected = 0;
            for (int corner = 0; corner < 8; ++corner) {
                double weight = 1.5 * static_cast<double>(color[c]);
                openvdb::Coord at = cell;
                for (unsigned a = 0; a < 3; ++a) {
                    const double f = index[static_cast<int>(a)] - cell[a];
                    const bool upper = (corner >> a & 1) != 0;
                    weight *= upper ? f : 1 - f;
                    at[a] += upper ? 1 : 0;
                }
                if constexpr (std::is_same_v<GridType, openvdb::Vec3SGrid>) {
                    expected += weight * static_cast<double>(accessor.getValue(at)[int(c)]);
                } else {
                    expected += weight * static_cast<double>(accessor.getValue(at));
                }
            }
            ASSERT_NEAR(found[c], expected, 1e-5 * (1 + expected));
            inside += expected > 0 ? 1 : 0;
        }
    }
    EXPECT_GT(inside, 500u);
}

TEST(Sampling, ExtinctionIsTheTrilinearFieldUnderAnyMap) {
    auto blob = fixtures::makeBlob(36);
    openvdb::Mat4d map(2.0, 0.3, 0.0, 0.0, -0.2, 1.0, 0.1, 0.0, 0.0, 0.4, -0.5, 0.0, 11.0, -7.0,
                       3.0, 1.0);
    blob->setTransform(openvdb::math::Transform::createLinearTransform(map));
    expectInterpolated<openvdb::FloatGrid>("points.vdb", blob, {{1, 1, 1}}, 1);
    expectInterpolated<openvdb::FloatGrid>("points-tint.vdb", blob, {{1, 0.5f, 0}}, 3);
    const auto colour = fixtures::makeColorGrid(
        openvdb::CoordBBox(0, 0, 0, 35, 35, 35), [&](const openvdb::Coord& p) {
            const float v = blob->tree().getValue(p);
            return openvdb::Vec3f(v, v * v, v * static_cast<float>(p.x()) * 0.1f);
        });
    expectInterpolated<openvdb::Vec3SGrid>("points-colour.vdb", colour, {{1, 2, 0.5f}}, 3);
}

TEST(Sampling, ExtinctionOutsideIsZero) {
    const track::Volume volume = Cloud().open();
    const float points[] = {1e30f, 0, 0, 0, -1e30f, 0, 50, 50, 50};
    float out[3] = {-1, -1, -1};
    volume.sampleExtinction(points, 3, out);
    for (const float value : out) {
        EXPECT_EQ(value, 0.0f);
    }
    // Points need not lie side by side.
    struct Vertex {
        float position[3];
        float other[2];
    };
    const TrkVolumeInfo info = volume.info();
    Vertex vertices[2] = {};
    for (int a = 0; a < 3; ++a) {
        vertices[1].position[a] = static_cast<float>(0.5 * (info.boundsMin[a] + info.boundsMax[a]));
        vertices[0].position[a] = 1e6f;
    }
    EXPECT_EQ(trkSampleExtinction(volume.handle(), vertices[0].position, sizeof(Vertex), 2,
                                  vertices[0].other, sizeof(Vertex)),
              TRK_OK);
    EXPECT_EQ(vertices[0].other[0], 0.0f);
    EXPECT_GT(vertices[1].other[0], 0.0f);
    EXPECT_EQ(vertices[1].other[1], 0.0f);
}

TEST(Sampling, IsBoundedWhateverTheScale) {
    for (const char* kind : {"smoke", "color-cloud"}) {
        const std::string vdb = fixtures::cloudFile(64, kind);
        const std::string sidecar = fixtures::path("bounded.track.vdb");
        fixtures::bake(vdb, sidecar, 32);
        for (const float scale : {1e3f, 1e6f, 1e12f, 1e30f}) {
            TrkVolumeOptions options = trkDefaultVolumeOptions();
            options.scale = scale;
            options.color[1] = 1e-6f;  // nearly free beside the others
            const track::Volume volume = track::Volume::open(vdb, sidecar.c_str(), options);
            const std::vector<TrkRay> all =
                rays::through(rays::boundsOf(volume.info()), 500, 20, 1);
            track::Query query(0, 0);
            for (const TrkMethod method : {TRK_METHOD_RESIDUAL, TRK_METHOD_DELTA}) {
                query.method = method;
                track::FreePaths paths(all.size(), 3);
                volume.sampleFreePath(query, all.data(), all.size(), paths.view());
                for (size_t i = 0; i < all.size(); ++i) {
                    ASSERT_LT(paths.lookups[i], 2000u);
                    ASSERT_FALSE(std::isnan(paths.t[i]));
                }
                for (const float w : paths.weight) {
                    ASSERT_GE(w, 0);
                    ASSERT_LE(w, 3.0001f);
                }
                std::vector<float> transmittance(3 * all.size());
                track::Statistics statistics(all.size(), 3);
                volume.estimateTransmittance(query, all.data(), all.size(), transmittance.data(),
                                             statistics.view());
                for (size_t i = 0; i < all.size(); ++i) {
                    ASSERT_LT(statistics.lookups[i], 4000u);
                    ASSERT_GE(statistics.exactShare[i], 0);
                    ASSERT_LE(statistics.exactShare[i], 1.0001f);
                }
            }
        }
    }
}

// Steps of a walk that drown in what remains would never end it.
TEST(Sampling, EndsWithoutExactIntegrationToo) {
    const Cloud cloud;
    const track::Volume volume = cloud.open();
    const std::vector<TrkRay> all = rays::through(rays::boundsOf(volume.info()), 20, 20, 1);
    track::Query query(0, 0);
    query.flags = 0;
    query.rate = 3e38f;
    track::Query exact(0, 0);
    exact.method = TRK_METHOD_EXACT;
    std::vector<float> expected(all.size());
    volume.estimateTransmittance(exact, all.data(), all.size(), expected.data());
    for (const TrkMethod method : {TRK_METHOD_RESIDUAL, TRK_METHOD_RATIO}) {
        query.method = method;
        std::vector<float> transmittance(all.size());
        volume.estimateTransmittance(query, all.data(), all.size(), transmittance.data());
        for (size_t i = 0; i < all.size(); ++i) {
            EXPECT_NEAR(transmittance[i], expected[i], 1e-5f);
        }
    }
}

TEST(Global, IsOneSuperVoxelForEveryKindOfBake) {
    for (const trk::ControlKind kind :
         {trk::ControlKind::kConstant, trk::ControlKind::kAffine, trk::ControlKind::kTrilinear}) {
        const Cloud cloud(kind);
        constexpr float kScale = 0.5f;  // whose estimates have tame tails even so
        const TrkRay ray = rays::through(rays::boundsOf(cloud.open().info()), 1, 20, 4)[0];
        track::Query exact(0, 0);
        exact.method = TRK_METHOD_EXACT;
        float expected = 0;
        cloud.open(kScale).estimateTransmittance(exact, &ray, 1, &expected);
        track::Query control(0, 0);
        control.method = TRK_METHOD_CONTROL;
        float baked = 0;
        float global = 0;
        cloud.open().estimateTransmittance(control, &ray, 1, &baked);
        cloud.open(3, true).estimateTransmittance(control, &ray, 1, &global);
        EXPECT_EQ(baked, global);  // always the baked control
        for (const TrkChoice choice :
             {TRK_CHOICE_ROBUST, TRK_CHOICE_MEAN, TRK_CHOICE_MIN, TRK_CHOICE_MAX}) {
            const track::Volume volume = cloud.open(kScale, true, choice);
            track::Query query(0, 0);
            query.samples = 20000;
            query.flags = 0;
            float found = 0;
            track::Statistics statistics(1, 1);
            volume.estimateTransmittance(query, &ray, 1, &found, statistics.view());
            EXPECT_EQ(statistics.superVoxels[0], 20000u);
            EXPECT_NEAR(found, expected, 6 * statistics.standardError[0] + 1e-6f);
        }
    }
}

TEST(Query, MarchingNeedsNoSidecarAndItsStepIsTheKnob) {
    const Cloud cloud;
    const track::Volume bare = track::Volume::open(cloud.vdb, "");
    const std::vector<TrkRay> all = rays::through(rays::boundsOf(bare.info()), 300, 20, 4);
    track::Query query(0, 0);
    query.method = TRK_METHOD_EXACT;
    std::vector<float> exact(all.size());
    std::vector<float> found(all.size());
    track::Statistics statistics(all.size(), 1);
    bare.estimateTransmittance(query, all.data(), all.size(), exact.data());
    query.method = TRK_METHOD_MARCH;
    double errors[3];
    double lookups[3];
    for (size_t i = 0; i < 3; ++i) {
        query.step = i == 0 ? 0.25f : i == 1 ? 2.0f : 16.0f;
        bare.estimateTransmittance(query, all.data(), all.size(), found.data(), statistics.view());
        errors[i] = lookups[i] = 0;
        for (size_t k = 0; k < all.size(); ++k) {
            const auto error = static_cast<double>(found[k] - exact[k]);
            errors[i] += error * error;
            lookups[i] += static_cast<double>(statistics.lookups[k]);
        }
    }
    EXPECT_LT(4 * errors[0], errors[1]);
    EXPECT_LT(4 * errors[1], errors[2]);
    EXPECT_NEAR(lookups[0] / lookups[1], 8, 0.1);
    EXPECT_NEAR(lookups[1] / lookups[2], 8, 0.5);
}

TEST(Query, RateBaseAndRateSetTheLookups) {
    const Cloud cloud;
    const track::Volume volume = cloud.open();
    const std::vector<TrkRay> all = rays::through(rays::boundsOf(volume.info()), 2000, 20, 4);
    const auto lookups = [&](TrkRateBase base, float rate, TrkMethod method) {
        track::Query query(0, 0);
        query.method = method;
        query.rateBase = base;
        query.rate = rate;
        query.flags = 0;
        std::vector<float> found(all.size());
        track::Statistics statistics(all.size(), 1);
        volume.estimateTransmittance(query, all.data(), all.size(), found.data(),
                                     statistics.view());
        double sum = 0;
        for (const uint64_t n : statistics.lookups) {
            sum += static_cast<double>(n);
        }
        return sum;
    };
    for (const TrkMethod method : {TRK_METHOD_RESIDUAL, TRK_METHOD_RATIO}) {
        const double majorant = lookups(TRK_RATE_BASE_MAJORANT, 1, method);
        const double rms = lookups(TRK_RATE_BASE_RMS, 1, method);
        EXPECT_GT(rms, 0.25 * majorant);  // the floor of the rate
        EXPECT_LT(rms, 0.9 * majorant);
        EXPECT_NEAR(lookups(TRK_RATE_BASE_RMS, 3, method), 3 * rms, 0.1 * rms);
    }
}

}  // namespace
