// SPDX-License-Identifier: Apache-2.0
// The C API's contract: refusals, independence of batches and threads, statistics.
#include "track/track.hpp"

#include "support/fixtures.h"
#include "support/rays.h"

#include <gtest/gtest.h>

#include <cmath>
#include <cstring>
#include <limits>
#include <thread>

namespace {

const float kNan = std::numeric_limits<float>::quiet_NaN();

struct Files {
    std::string vdb;
    std::string sidecar;
};

const Files& files() {
    static const Files result = [] {
        Files f{fixtures::cloudFile(64), fixtures::path("cloud64.track.vdb")};
        fixtures::bake(f.vdb, f.sidecar, 8);
        return f;
    }();
    return result;
}

track::Volume openCloud(float scale = 3) {
    TrkVolumeOptions options = trkDefaultVolumeOptions();
    options.scale = scale;
    return track::Volume::open(files().vdb, files().sidecar.c_str(), options);
}

std::vector<TrkRay> cloudRays(const track::Volume& volume, size_t count) {
    return rays::through(rays::boundsOf(volume.info()), count, 20, 11);
}

void expectRefused(TrkStatus status, TrkStatus expected, const std::string& text) {
    EXPECT_EQ(status, expected) << trkGetStatusName(status);
    EXPECT_NE(std::string(trkGetLastErrorMessage()).find(text), std::string::npos)
        << trkGetLastErrorMessage();
}

TEST(Api, RefusesBadOptions) {
    TrkVolume* volume = nullptr;
    const auto refused = [&](const char* text, const auto& change) {
        TrkVolumeOptions options = trkDefaultVolumeOptions();
        change(options);
        expectRefused(trkOpenVolume(files().vdb.c_str(), "", &options, &volume),
                      TRK_ERROR_INVALID_ARGUMENT, text);
        EXPECT_EQ(volume, nullptr);
    };
    refused("size", [](auto& o) { o.size = 3; });
    refused("scale", [](auto& o) { o.scale = -1; });
    refused("scale", [](auto& o) { o.scale = kNan; });
    refused("scale", [](auto& o) { o.scale = rays::kInfinity; });
    refused("choice", [](auto& o) { o.choice = 9; });
    refused("check", [](auto& o) { o.check = 2; });
    refused("repair", [](auto& o) { o.repair = 4; });
    refused("threads", [](auto& o) { o.threads = -1; });
    expectRefused(trkOpenVolume(nullptr, nullptr, nullptr, &volume), TRK_ERROR_INVALID_ARGUMENT,
                  "path");
    expectRefused(trkOpenVolume("x", nullptr, nullptr, nullptr), TRK_ERROR_INVALID_ARGUMENT,
                  "volume is NULL");
}

TEST(Api, RefusesAScaleThatOverflows) {
    auto grid = fixtures::makeGrid(openvdb::CoordBBox(0, 0, 0, 3, 3, 3),
                                   [](const openvdb::Coord&) { return 10.0f; });
    const std::string path = fixtures::write("ten.vdb", {grid});
    TrkVolumeOptions options = trkDefaultVolumeOptions();
    options.scale = 1e38f;
    TrkVolume* volume = nullptr;
    expectRefused(trkOpenVolume(path.c_str(), "", &options, &volume), TRK_ERROR_INVALID_ARGUMENT,
                  "scale");
    options.scale = 3e37f;
    EXPECT_EQ(trkOpenVolume(path.c_str(), "", &options, &volume), TRK_OK);
    const TrkRay ray{{-5, 1, 1}, 0, {1, 0, 0}, rays::kInfinity};
    track::Query query(0, 0);
    query.method = TRK_METHOD_EXACT;
    float transmittance = 1;
    EXPECT_EQ(trkEstimateTransmittance(volume, &query, &ray, 1, &transmittance, nullptr), TRK_OK);
    EXPECT_EQ(transmittance, 0.0f);
    trkCloseVolume(volume);
}

// The slopes of a control can be several times the largest density.
TEST(Api, RefusesAScaleThatOverflowsTheControl) {
    const std::string vdb = fixtures::cloudFile(64);
    const float most = 0.99f * std::numeric_limits<float>::max() / fixtures::load(vdb).summary.max;
    for (const trk::ControlKind kind :
         {trk::ControlKind::kConstant, trk::ControlKind::kTrilinear}) {
        const std::string sidecar = fixtures::path("slopes.track.vdb");
        fixtures::bake(vdb, sidecar, 16, 0, kind);
        TrkVolumeOptions options = trkDefaultVolumeOptions();
        TrkVolume* volume = nullptr;
        options.scale = most;
        const TrkStatus status = trkOpenVolume(vdb.c_str(), sidecar.c_str(), &options, &volume);
        if (kind == trk::ControlKind::kConstant) {
            EXPECT_EQ(status, TRK_OK);
        } else {
            expectRefused(status, TRK_ERROR_INVALID_ARGUMENT, "control");
            options.scale = most / 16;
            EXPECT_EQ(trkOpenVolume(vdb.c_str(), sidecar.c_str(), &options, &volume), TRK_OK);
        }
        trkCloseVolume(volume);
    }
}

TEST(Api, RefusesBadQueriesBeforeWritingAnything) {
    const track::Volume volume = openCloud();
    std::vector<TrkRay> all = cloudRays(volume, 10);
    std::vector<float> out(10, -7);
    const auto refused = [&](const char* text, const auto& change) {
        track::Query query(0, 0);
        change(query);
        expectRefused(trkEstimateTransmittance(volume.handle(), &query, all.data(), all.size(),
                                               out.data(), nullptr),
                      TRK_ERROR_INVALID_ARGUMENT, text);
        for (const float value : out) {
            EXPECT_EQ(value, -7);
        }
    };
    refused("size", [](auto& q) { q.size = 0; });
    refused("method", [](auto& q) { q.method = 17; });
    refused("samples", [](auto& q) { q.samples = 0; });
    refused("rate", [](auto& q) { q.rate = 0; });
    refused("rate", [](auto& q) { q.rate = -1; });
    refused("rate", [](auto& q) { q.rate = kNan; });
    refused("flags", [](auto& q) { q.flags = 64; });
    refused("rayStride", [](auto& q) { q.rayStride = 30; });
    refused("threads", [](auto& q) { q.threads = -2; });
    refused("level", [](auto& q) {
        q.method = TRK_METHOD_CONTROL;
        q.level = 3;
    });
    const TrkRay good = all[7];
    const auto badRay = [&](const auto& change) {
        all[7] = good;
        change(all[7]);
        refused("ray 7", [](auto&) {});
    };
    badRay([](TrkRay& r) { r.origin[1] = kNan; });
    badRay([](TrkRay& r) { r.origin[2] = rays::kInfinity; });
    badRay([](TrkRay& r) { r.direction[0] = rays::kInfinity; });
    badRay([](TrkRay& r) { r.direction[0] = r.direction[1] = r.direction[2] = -0.0f; });
    badRay([](TrkRay& r) { r.tMin = kNan; });
    badRay([](TrkRay& r) { r.tMax = kNan; });
    expectRefused(trkEstimateTransmittance(nullptr, nullptr, all.data(), 1, out.data(), nullptr),
                  TRK_ERROR_INVALID_ARGUMENT, "volume is NULL");
    expectRefused(
        trkEstimateTransmittance(volume.handle(), nullptr, nullptr, 1, out.data(), nullptr),
        TRK_ERROR_INVALID_ARGUMENT, "rays is NULL");
    expectRefused(
        trkEstimateTransmittance(volume.handle(), nullptr, all.data(), 1, nullptr, nullptr),
        TRK_ERROR_INVALID_ARGUMENT, "results is NULL");
    double depth = 0;
    const track::Query random(0, 0);
    expectRefused(trkIntegrateOpticalDepth(volume.handle(), &random, all.data(), 1, &depth),
                  TRK_ERROR_INVALID_ARGUMENT, "random");
    EXPECT_EQ(trkEstimateTransmittance(volume.handle(), nullptr, nullptr, 0, nullptr, nullptr),
              TRK_OK);
}

TEST(Api, SaysWhichFileAMethodLacks) {
    TrkVolumeOptions options = trkDefaultVolumeOptions();
    options.noBake = 1;
    const track::Volume bare = track::Volume::open(files().vdb, "", options);
    const track::Volume alone = track::Volume::open("", files().sidecar.c_str());
    const TrkRay ray{{0, 0, 0}, 0, {1, 1, 1}, 100};
    float out = -1;
    track::Query query(0, 0);
    for (const TrkMethod method : {TRK_METHOD_RESIDUAL, TRK_METHOD_RATIO, TRK_METHOD_CONTROL}) {
        query.method = method;
        expectRefused(trkEstimateTransmittance(bare.handle(), &query, &ray, 1, &out, nullptr),
                      TRK_ERROR_NO_SIDECAR, "sidecar");
    }
    for (const TrkMethod method : {TRK_METHOD_RESIDUAL, TRK_METHOD_RATIO, TRK_METHOD_EXACT}) {
        query.method = method;
        expectRefused(trkEstimateTransmittance(alone.handle(), &query, &ray, 1, &out, nullptr),
                      TRK_ERROR_NO_DENSITY, "density");
    }
    query.method = TRK_METHOD_CONTROL;
    EXPECT_EQ(trkEstimateTransmittance(alone.handle(), &query, &ray, 1, &out, nullptr), TRK_OK);
    query.method = TRK_METHOD_EXACT;
    EXPECT_EQ(trkEstimateTransmittance(bare.handle(), &query, &ray, 1, &out, nullptr), TRK_OK);
    EXPECT_GE(out, 0.0f);
}

TEST(Api, FindsTheSidecarBesideTheDensity) {
    const std::string vdb = fixtures::write("beside.vdb", {fixtures::makeBlob(24)});
    TrkVolumeOptions options = trkDefaultVolumeOptions();
    options.noBake = 1;
    EXPECT_EQ(track::Volume::open(vdb, nullptr, options).info().superVoxelSize, 0u);
    fixtures::bake(vdb, fixtures::path("beside.track.vdb"), 8);
    EXPECT_EQ(track::Volume::open(vdb, nullptr, options).info().superVoxelSize, 8u);
    // After the density changed, the sidecar is refused, unless it is not wanted.
    fixtures::write("beside.vdb", {fixtures::makeBlob(25)});
    EXPECT_THROW(track::Volume::open(vdb), track::Error);
    EXPECT_EQ(track::Volume::open(vdb, "", options).info().superVoxelSize, 0u);
}

TEST(Api, EmptyIntervalsAndMissesGiveOne) {
    const track::Volume volume = openCloud();
    const float big = 1e30f;
    const std::vector<TrkRay> all{
        {{5, 5, 5}, 1, {1, 0, 0}, 1},
        {{5, 5, 5}, 2, {1, 0, 0}, 1},
        {{50, 50, 50}, 0, {0, 1, 0}, rays::kInfinity},
        {{-5, 5, 5}, 0, {-1, 0, 0}, rays::kInfinity},
        {{5, 5, 5}, rays::kInfinity, {0, 1, 0}, rays::kInfinity},
        {{big, big, big}, 0, {0, 1, 0}, rays::kInfinity},
    };
    for (const TrkMethod method :
         {TRK_METHOD_EXACT, TRK_METHOD_RESIDUAL, TRK_METHOD_RATIO, TRK_METHOD_CONTROL}) {
        track::Query query(0, 0);
        query.method = method;
        std::vector<float> out(all.size());
        volume.estimateTransmittance(query, all.data(), all.size(), out.data());
        for (const float t : out) {
            EXPECT_EQ(t, 1.0f);
        }
    }
}

TEST(Api, IntervalsThatAbutMultiply) {
    const track::Volume volume = openCloud();
    track::Query query(0, 0);
    query.method = TRK_METHOD_EXACT;
    for (TrkRay ray : cloudRays(volume, 200)) {
        ray.tMin = -rays::kInfinity;
        double whole = 0;
        volume.integrateOpticalDepth(query, &ray, 1, &whole);
        TrkRay parts[3] = {ray, ray, ray};
        parts[0].tMax = parts[1].tMin = 19.5f;
        parts[1].tMax = parts[2].tMin = 21.0f;
        double sum[3];
        volume.integrateOpticalDepth(query, parts, 3, sum);
        // Cells are interpolated in float, at other points where an interval is another.
        EXPECT_NEAR(sum[0] + sum[1] + sum[2], whole, 2e-7 * whole + 1e-12);
        // Reversed, from the far end, with a direction that is not of unit length.
        TrkRay back = ray;
        for (int a = 0; a < 3; ++a) {
            back.direction[a] *= -3.0f;
        }
        double reversed = 0;
        volume.integrateOpticalDepth(query, &back, 1, &reversed);
        EXPECT_NEAR(reversed, whole, 1e-4 * whole + 1e-5);  // its components are rounded anew
    }
}

TEST(Api, SameBitsForSinglesBatchesThreadsAndSplits) {
    const track::Volume volume = openCloud();
    const std::vector<TrkRay> all = cloudRays(volume, 3000);
    for (const TrkMethod method : {TRK_METHOD_EXACT, TRK_METHOD_RESIDUAL, TRK_METHOD_RATIO}) {
        track::Query query(0, 0);
        query.method = method;
        query.samples = 3;
        query.seed = 5;
        query.stream = 6;
        query.firstRayId = 1000;
        std::vector<float> reference(all.size());
        track::Statistics statistics(all.size(), 1);
        volume.estimateTransmittance(query, all.data(), all.size(), reference.data(),
                                     statistics.view());
        const auto expectSame = [&](const std::vector<float>& out) {
            EXPECT_EQ(std::memcmp(out.data(), reference.data(), out.size() * sizeof(float)), 0);
        };
        std::vector<float> out(all.size());
        for (const int threads : {1, 2, 3}) {
            query.threads = threads;
            volume.estimateTransmittance(query, all.data(), all.size(), out.data());
            expectSame(out);
        }
        query.threads = 0;
        for (size_t begin = 0; begin < all.size();) {  // uneven parts
            const size_t count = std::min(all.size() - begin, 1 + begin % 701);
            query.firstRayId = 1000 + begin;
            volume.estimateTransmittance(query, &all[begin], count, &out[begin]);
            begin += count;
        }
        expectSame(out);
        std::vector<uint64_t> ids(all.size());
        std::vector<TrkRay> shuffled(all.size());
        for (size_t i = 0; i < all.size(); ++i) {
            const size_t j = (i * 1237) % all.size();
            ids[i] = 1000 + j;
            shuffled[i] = all[j];
        }
        query.rayIds = ids.data();
        std::vector<float> scattered(all.size());
        volume.estimateTransmittance(query, shuffled.data(), all.size(), scattered.data());
        for (size_t i = 0; i < all.size(); ++i) {
            out[(i * 1237) % all.size()] = scattered[i];
        }
        expectSame(out);
    }
}

TEST(Api, RaysMayBeStrided) {
    struct Payload {
        TrkRay ray;
        double other;
    };
    const track::Volume volume = openCloud();
    const std::vector<TrkRay> all = cloudRays(volume, 50);
    std::vector<Payload> payload;
    for (const TrkRay& ray : all) {
        payload.push_back({ray, 1});
    }
    track::Query query(0, 0);
    std::vector<float> dense(all.size());
    std::vector<float> strided(all.size());
    volume.estimateTransmittance(query, all.data(), all.size(), dense.data());
    query.rayStride = sizeof(Payload);
    volume.estimateTransmittance(query, &payload[0].ray, all.size(), strided.data());
    EXPECT_EQ(dense, strided);
}

TEST(Api, SeedAndStreamChangeEstimates) {
    const track::Volume volume = openCloud();
    const std::vector<TrkRay> all = cloudRays(volume, 200);
    const auto estimate = [&](uint64_t seed, uint64_t stream) {
        track::Query query(0, 0);
        query.method = TRK_METHOD_RATIO;
        query.seed = seed;
        query.stream = stream;
        std::vector<float> out(all.size());
        volume.estimateTransmittance(query, all.data(), all.size(), out.data());
        return out;
    };
    EXPECT_EQ(estimate(1, 2), estimate(1, 2));
    EXPECT_NE(estimate(1, 2), estimate(2, 2));
    EXPECT_NE(estimate(1, 2), estimate(1, 3));
}

TEST(Api, StatisticsTellWhatWasSpent) {
    const track::Volume volume = openCloud();
    const std::vector<TrkRay> all = cloudRays(volume, 500);
    std::vector<float> out(all.size());
    track::Statistics statistics(all.size(), 1);
    track::Query query(0, 0);
    query.method = TRK_METHOD_EXACT;
    volume.estimateTransmittance(query, all.data(), all.size(), out.data(), statistics.view());
    for (size_t i = 0; i < all.size(); ++i) {
        EXPECT_EQ(statistics.standardError[i], 0);
        if (statistics.lookups[i] > 0) {
            EXPECT_EQ(statistics.exactShare[i], 1.0f);
        }
    }
    query.method = TRK_METHOD_RATIO;
    volume.estimateTransmittance(query, all.data(), all.size(), out.data(), statistics.view());
    for (size_t i = 0; i < all.size(); ++i) {
        // One random estimate shows no error; of what looked nothing up, there is none.
        const float e = statistics.standardError[i];
        EXPECT_TRUE(statistics.lookups[i] > 0 ? std::isnan(e) : std::isnan(e) || e == 0) << i;
        EXPECT_TRUE(statistics.superVoxels[i] > 0 || e == 0) << i;
    }
    query.samples = 64;
    volume.estimateTransmittance(query, all.data(), all.size(), out.data(), statistics.view());
    uint64_t lookups = 0;
    double error = 0;
    for (size_t i = 0; i < all.size(); ++i) {
        lookups += statistics.lookups[i];
        const float e = statistics.standardError[i];
        error += std::isnan(e) ? 0 : static_cast<double>(e);
    }
    EXPECT_GT(lookups, all.size());
    EXPECT_GT(error, 0);
}

// Depths of 1e-22 change no random distance, and yet another sample might have collided.
TEST(Api, TheThinnestDensitiesHaveNoErrorThatIsKnown) {
    const track::Volume volume = openCloud(1e-24f);
    const std::vector<TrkRay> all = cloudRays(volume, 100);
    std::vector<float> out(all.size());
    track::Statistics statistics(all.size(), 1);
    for (const TrkMethod method :
         {TRK_METHOD_RATIO, TRK_METHOD_RESIDUAL, TRK_METHOD_DELTA, TRK_METHOD_COMB}) {
        track::Query query(0, 0);
        query.method = method;
        query.samples = 4;
        volume.estimateTransmittance(query, all.data(), all.size(), out.data(), statistics.view());
        for (size_t i = 0; i < all.size(); ++i) {
            EXPECT_EQ(out[i], 1);
            EXPECT_EQ(std::isnan(statistics.standardError[i]), statistics.superVoxels[i] > 0) << i;
        }
    }
}

TEST(Api, ConcurrentQueriesAgree) {
    const track::Volume volume = openCloud();
    const std::vector<TrkRay> all = cloudRays(volume, 2000);
    const track::Query query(0, 0);
    std::vector<float> reference(all.size());
    volume.estimateTransmittance(query, all.data(), all.size(), reference.data());
    std::vector<std::vector<float>> results(4, std::vector<float>(all.size()));
    std::vector<std::thread> threads;
    for (auto& result : results) {
        threads.emplace_back([&] {
            for (size_t i = 0; i < all.size(); ++i) {
                track::Query one = query;
                one.firstRayId = i;
                volume.estimateTransmittance(one, &all[i], 1, &result[i]);
            }
        });
    }
    for (std::thread& thread : threads) {
        thread.join();
    }
    for (const auto& result : results) {
        EXPECT_EQ(result, reference);
    }
}

TEST(Api, AnyNumberOfThreadsIsAllowed) {
    TrkVolumeOptions options = trkDefaultVolumeOptions();
    options.threads = 1000000;
    const track::Volume volume = track::Volume::open(files().vdb, "", options);
    track::Query query(0, 0);
    query.method = TRK_METHOD_EXACT;
    query.threads = 1000000;
    const std::vector<TrkRay> all = cloudRays(volume, 100);
    std::vector<float> out(all.size());
    testing::internal::CaptureStderr();
    volume.estimateTransmittance(query, all.data(), all.size(), out.data());
    EXPECT_EQ(testing::internal::GetCapturedStderr(), "");
}

TEST(Api, ErrorsBelongToTheirThread) {
    TrkVolume* volume = nullptr;
    trkOpenVolume("/first", "", nullptr, &volume);
    std::thread([&] {
        EXPECT_STREQ(trkGetLastErrorMessage(), "");
        TrkVolume* other = nullptr;
        trkOpenVolume("/second", "", nullptr, &other);
    }).join();
    EXPECT_NE(std::string(trkGetLastErrorMessage()).find("/first"), std::string::npos);
}

TEST(Api, ExtremeScalesStayFinite) {
    for (const float scale : {0.0f, 1e-38f, 1e-10f, 1e5f, 1e20f, 1e37f}) {
        const track::Volume volume = openCloud(scale);
        const std::vector<TrkRay> all = cloudRays(volume, 200);
        for (const TrkMethod method :
             {TRK_METHOD_EXACT, TRK_METHOD_RESIDUAL, TRK_METHOD_RATIO, TRK_METHOD_CONTROL}) {
            track::Query query(0, 0);
            query.method = method;
            query.samples = 2;
            std::vector<float> out(all.size());
            track::Statistics statistics(all.size(), 1);
            volume.estimateTransmittance(query, all.data(), all.size(), out.data(),
                                         statistics.view());
            for (size_t i = 0; i < all.size(); ++i) {
                ASSERT_TRUE(std::isfinite(out[i])) << scale << " " << method;
                ASSERT_LT(statistics.lookups[i], 10000u);  // the fallback bounds the cost
                if (scale == 0.0f) {
                    ASSERT_EQ(out[i], 1.0f);
                }
            }
        }
    }
}

}  // namespace
