// SPDX-License-Identifier: Apache-2.0
// Free paths, extinction at points, and the query fields of the random methods, through the C API.
#include "track/track.hpp"

#include "support/fixtures.h"
#include "support/rays.h"
#include "support/reference.h"

#include <gtest/gtest.h>

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
    std::vector<TrkFreePath> paths(10);
    std::memset(paths.data(), 0x5a, paths.size() * sizeof(TrkFreePath));
    const std::vector<TrkFreePath> untouched = paths;
    const auto refused = [&](const char* text, const auto& change) {
        TrkQuery query = trkDefaultQuery();
        change(query);
        expectRefused(
            trkSampleFreePath(volume.handle(), &query, all.data(), all.size(), paths.data()),
            TRK_ERROR_INVALID_ARGUMENT, text);
        EXPECT_EQ(std::memcmp(paths.data(), untouched.data(), 10 * sizeof(TrkFreePath)), 0);
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
    expectRefused(trkSampleFreePath(nullptr, nullptr, all.data(), 1, paths.data()),
                  TRK_ERROR_INVALID_ARGUMENT, "volume is NULL");
    expectRefused(trkSampleFreePath(volume.handle(), nullptr, all.data(), 1, nullptr),
                  TRK_ERROR_INVALID_ARGUMENT, "NULL");
    EXPECT_EQ(trkSampleFreePath(volume.handle(), nullptr, nullptr, 0, nullptr), TRK_OK);

    const track::Volume bare = track::Volume::open(cloud.vdb, "");
    const track::Volume alone = track::Volume::open("", cloud.sidecar.c_str());
    expectRefused(trkSampleFreePath(bare.handle(), nullptr, all.data(), 1, paths.data()),
                  TRK_ERROR_NO_SIDECAR, "vdbtrack bake");
    expectRefused(trkSampleFreePath(alone.handle(), nullptr, all.data(), 1, paths.data()),
                  TRK_ERROR_NO_DENSITY, "density");

    const float points[6] = {0, 0, 0, 1, kNan, 1};
    float out[2] = {-7, -7};
    expectRefused(trkSampleExtinction(volume.handle(), points, 0, 2, out),
                  TRK_ERROR_INVALID_ARGUMENT, "point 1");
    EXPECT_EQ(out[0], -7);
    expectRefused(trkSampleExtinction(volume.handle(), points, 10, 1, out),
                  TRK_ERROR_INVALID_ARGUMENT, "pointStride");
    expectRefused(trkSampleExtinction(volume.handle(), nullptr, 0, 1, out),
                  TRK_ERROR_INVALID_ARGUMENT, "NULL");
    expectRefused(trkSampleExtinction(nullptr, points, 0, 1, out), TRK_ERROR_INVALID_ARGUMENT,
                  "volume is NULL");
    expectRefused(trkSampleExtinction(alone.handle(), points, 0, 1, out), TRK_ERROR_NO_DENSITY,
                  "density");
    EXPECT_EQ(trkSampleExtinction(bare.handle(), points, 0, 1, out), TRK_OK);
    EXPECT_EQ(trkSampleExtinction(volume.handle(), nullptr, 0, 0, nullptr), TRK_OK);
}

TEST(Sampling, RefusesBadFieldsOfTheNewMethods) {
    const Cloud cloud;
    const track::Volume volume = cloud.open();
    const TrkRay ray{{0, 0, 0}, 0, {1, 1, 1}, 100};
    float out = -7;
    const auto refused = [&](const char* text, const auto& change) {
        TrkQuery query = trkDefaultQuery();
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
    TrkQuery march = trkDefaultQuery();
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
        TrkQuery query = trkDefaultQuery();
        query.method = method;
        std::vector<TrkFreePath> paths(all.size());
        volume.sampleFreePath(query, all.data(), all.size(), paths.data());
        size_t collided = 0;
        for (size_t i = 0; i < all.size(); ++i) {
            const TrkFreePath& p = paths[i];
            EXPECT_EQ(p.weight[0], 1.0f);
            EXPECT_EQ(p.weight[2], 1.0f);
            if (std::isinf(p.t)) {
                EXPECT_EQ(p.extinction[0], 0.0f);
                continue;
            }
            ++collided;
            ASSERT_GE(p.t, all[i].tMin);
            ASSERT_LE(p.t, all[i].tMax);
            float point[3];
            for (int a = 0; a < 3; ++a) {
                point[a] = all[i].origin[a] + p.t * all[i].direction[a];
            }
            float extinction = -1;
            volume.sampleExtinction(point, 1, &extinction);
            EXPECT_NEAR(p.extinction[0], extinction, 1e-3f * (1 + extinction));
            EXPECT_EQ(p.extinction[1], p.extinction[0]);
            EXPECT_GT(p.lookups, 0u);
        }
        EXPECT_GT(collided, 300u);
        EXPECT_LT(collided, 1900u);
        query.flags &= ~uint32_t{TRK_QUERY_EXTINCTION};
        std::vector<TrkFreePath> plain(all.size());
        volume.sampleFreePath(query, all.data(), all.size(), plain.data());
        for (size_t i = 0; i < all.size(); ++i) {
            EXPECT_EQ(plain[i].t, paths[i].t);
            EXPECT_EQ(plain[i].extinction[0], 0.0f);
        }
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
    std::vector<TrkFreePath> paths(all.size());
    volume.sampleFreePath(trkDefaultQuery(), all.data(), all.size(), paths.data());
    double near = 0;
    for (const TrkFreePath& p : paths) {
        near += (p.t - 104 / length) * length < 1.7328680f ? 1 : 0;
        EXPECT_EQ(p.extinction[0], 0.4f);
        EXPECT_EQ(p.lookups, 0u);  // homogeneous
    }
    EXPECT_NEAR(near / 20000, 0.5, 5 * std::sqrt(0.25 / 20000));
}

TEST(Sampling, ACollisionIsFiniteWhereTheParameterIsTooLarge) {
    const Cloud cloud;
    const track::Volume volume = cloud.open(1000);
    const TrkRay ray{{-10, 5, 5}, 0, {1e-38f, 0, 0}, rays::kInfinity};  // enters at t = 1e39
    TrkFreePath path;
    volume.sampleFreePath(trkDefaultQuery(), &ray, 1, &path);
    EXPECT_EQ(path.t, std::numeric_limits<float>::max());
    EXPECT_GT(path.extinction[0], 0);
}

TEST(Sampling, MissesAndEmptyIntervalsEscape) {
    const Cloud cloud;
    const track::Volume volume = cloud.open(1000);
    const TrkRay all[] = {{{50, 50, 50}, 0, {0, 1, 0}, rays::kInfinity},
                          {{5, 5, 5}, 2, {1, 0, 0}, 1},
                          {{5, 5, 5}, 1, {1, 0, 0}, 1}};
    TrkFreePath paths[3];
    volume.sampleFreePath(trkDefaultQuery(), all, 3, paths);
    for (const TrkFreePath& p : paths) {
        EXPECT_EQ(p.t, rays::kInfinity);
        EXPECT_EQ(p.weight[1], 1.0f);
        EXPECT_EQ(p.extinction[0], 0.0f);
        EXPECT_EQ(p.lookups, 0u);
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
        TrkQuery query = trkDefaultQuery();
        query.method = method;
        std::vector<TrkFreePath> batch(all.size());
        std::vector<TrkFreePath> alone(all.size());
        volume.sampleFreePath(query, all.data(), all.size(), batch.data());
        query.threads = 1;
        size_t coloured = 0;
        for (size_t i = 0; i < all.size(); ++i) {
            query.firstRayId = i;
            volume.sampleFreePath(query, &all[i], 1, &alone[i]);
            coloured += batch[i].weight[0] != batch[i].weight[1] ? 1 : 0;
        }
        EXPECT_EQ(std::memcmp(batch.data(), alone.data(), all.size() * sizeof(TrkFreePath)), 0);
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
                for (int a = 0; a < 3; ++a) {
                    const double f = index[a] - cell[a];
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
    EXPECT_EQ(trkSampleExtinction(volume.handle(), vertices[0].position, sizeof(Vertex), 2, out),
              TRK_OK);
    EXPECT_EQ(out[0], 0.0f);
    EXPECT_GT(out[1], 0.0f);
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
            TrkQuery query = trkDefaultQuery();
            for (const TrkMethod method : {TRK_METHOD_RESIDUAL, TRK_METHOD_DELTA}) {
                query.method = method;
                std::vector<TrkFreePath> paths(all.size());
                volume.sampleFreePath(query, all.data(), all.size(), paths.data());
                for (const TrkFreePath& p : paths) {
                    ASSERT_LT(p.lookups, 2000u);
                    for (const float w : p.weight) {
                        ASSERT_GE(w, 0);
                        ASSERT_LE(w, 3.0001f);
                    }
                    ASSERT_FALSE(std::isnan(p.t));
                }
                std::vector<float> transmittance(3 * all.size());
                std::vector<TrkStatistics> statistics(all.size());
                volume.estimateTransmittance(query, all.data(), all.size(), transmittance.data(),
                                             statistics.data());
                for (const TrkStatistics& s : statistics) {
                    ASSERT_LT(s.lookups, 4000u);
                    ASSERT_GE(s.exactShare, 0);
                    ASSERT_LE(s.exactShare, 1.0001f);
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
    TrkQuery query = trkDefaultQuery();
    query.flags = 0;
    query.rate = 3e38f;
    TrkQuery exact = trkDefaultQuery();
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
        const TrkRay ray = rays::through(rays::boundsOf(cloud.open().info()), 1, 20, 4)[0];
        TrkQuery exact = trkDefaultQuery();
        exact.method = TRK_METHOD_EXACT;
        float expected = 0;
        cloud.open().estimateTransmittance(exact, &ray, 1, &expected);
        TrkQuery control = trkDefaultQuery();
        control.method = TRK_METHOD_CONTROL;
        float baked = 0;
        float global = 0;
        cloud.open().estimateTransmittance(control, &ray, 1, &baked);
        cloud.open(3, true).estimateTransmittance(control, &ray, 1, &global);
        EXPECT_EQ(baked, global);  // always the baked control
        for (const TrkChoice choice :
             {TRK_CHOICE_ROBUST, TRK_CHOICE_MEAN, TRK_CHOICE_MIN, TRK_CHOICE_MAX}) {
            const track::Volume volume = cloud.open(3, true, choice);
            TrkQuery query = trkDefaultQuery();
            query.samples = 20000;
            query.flags = 0;
            float found = 0;
            TrkStatistics statistics;
            volume.estimateTransmittance(query, &ray, 1, &found, &statistics);
            EXPECT_EQ(statistics.superVoxels, 20000u);
            EXPECT_NEAR(found, expected, 6 * statistics.standardError[0] + 1e-6f);
        }
    }
}

TEST(Query, MarchingNeedsNoSidecarAndItsStepIsTheKnob) {
    const Cloud cloud;
    const track::Volume bare = track::Volume::open(cloud.vdb, "");
    const std::vector<TrkRay> all = rays::through(rays::boundsOf(bare.info()), 300, 20, 4);
    TrkQuery query = trkDefaultQuery();
    query.method = TRK_METHOD_EXACT;
    std::vector<float> exact(all.size());
    std::vector<float> found(all.size());
    std::vector<TrkStatistics> statistics(all.size());
    bare.estimateTransmittance(query, all.data(), all.size(), exact.data());
    query.method = TRK_METHOD_MARCH;
    double errors[3];
    double lookups[3];
    for (size_t i = 0; i < 3; ++i) {
        query.step = i == 0 ? 0.25f : i == 1 ? 2.0f : 16.0f;
        bare.estimateTransmittance(query, all.data(), all.size(), found.data(), statistics.data());
        errors[i] = lookups[i] = 0;
        for (size_t k = 0; k < all.size(); ++k) {
            const auto error = static_cast<double>(found[k] - exact[k]);
            errors[i] += error * error;
            lookups[i] += static_cast<double>(statistics[k].lookups);
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
        TrkQuery query = trkDefaultQuery();
        query.method = method;
        query.rateBase = base;
        query.rate = rate;
        query.flags = 0;
        std::vector<float> found(all.size());
        std::vector<TrkStatistics> statistics(all.size());
        volume.estimateTransmittance(query, all.data(), all.size(), found.data(),
                                     statistics.data());
        double sum = 0;
        for (const TrkStatistics& s : statistics) {
            sum += static_cast<double>(s.lookups);
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
