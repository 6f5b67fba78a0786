// SPDX-License-Identifier: Apache-2.0
// That the method table tells the truth: of every row, by the C API.
#include "query/methods.h"

#include "support/fixtures.h"
#include "support/rays.h"
#include "track/track.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <set>
#include <string>
#include <vector>

namespace {

constexpr size_t kRays = 40;

/// A cloud of 64^3 and rays through it.
struct Scene {
    std::string vdb = fixtures::cloudFile(64);
    std::string sidecar = fixtures::path("methods.track.vdb");
    track::Volume volume;
    std::vector<TrkRay> rays;

    Scene() : volume(open()), rays(rays::through(rays::boundsOf(volume.info()), kRays, 20, 1)) {}
    track::Volume open() const {
        fixtures::bake(vdb, sidecar, 8, 2);
        TrkVolumeOptions options = trkDefaultVolumeOptions();
        options.scale = 0.3f;
        return track::Volume::open(vdb, sidecar.c_str(), options);
    }
    std::vector<float> estimate(const track::Query& query) const {
        std::vector<float> result(rays.size());
        volume.estimateTransmittance(query, rays.data(), rays.size(), result.data());
        return result;
    }
};

track::Query queryOf(const trk::MethodTraits& method, uint64_t seed = 1) {
    track::Query query(seed, 0);
    query.method = method.method;
    return query;
}

TEST(Methods, HaveARowEachWithANumberAndANameOfItsOwn) {
    std::set<std::string> names;
    for (size_t i = 0; i < trk::kMethods.size(); ++i) {
        const trk::MethodTraits& method = trk::kMethods[i];
        EXPECT_EQ(method.method, static_cast<TrkMethod>(i));
        EXPECT_EQ(trk::findMethod(method.method), &method);
        names.insert(method.name);
        names.insert(method.constant);
    }
    EXPECT_EQ(names.size(), 2 * trk::kMethods.size());
    const auto next = static_cast<TrkMethod>(trk::kMethods.size());
    EXPECT_EQ(trk::findMethod(next), nullptr);
    const Scene scene;
    track::Query query(0, 0);
    query.method = next;
    EXPECT_THROW(scene.estimate(query), track::Error);
}

TEST(Methods, AreRandomAndBiasedAsTheTableSays) {
    const Scene scene;
    const std::vector<float> exact = scene.estimate(queryOf(trk::traitsOf(TRK_METHOD_EXACT)));
    for (const trk::MethodTraits& method : trk::kMethods) {
        SCOPED_TRACE(method.name);
        EXPECT_EQ(scene.estimate(queryOf(method, 1)) != scene.estimate(queryOf(method, 2)),
                  method.isRandom);
        track::Query many = queryOf(method);
        many.samples = 400;
        if (method.usesSteps()) {
            many.step = 12;
        }
        track::Statistics statistics(kRays, 1);
        std::vector<float> mean(kRays);
        scene.volume.estimateTransmittance(many, scene.rays.data(), kRays, mean.data(),
                                           statistics.view());
        // Every ray far from exact tells of bias; those near it, of nothing.
        size_t grey = 0;  // rays neither clear nor dark
        size_t far = 0;
        size_t unknown = 0;
        for (size_t i = 0; i < kRays; ++i) {
            if (exact[i] < 0.05f || exact[i] > 0.95f) {
                continue;
            }
            ++grey;
            const double error = static_cast<double>(statistics.standardError[i]);
            far +=
                std::fabs(static_cast<double>(mean[i] - exact[i])) > (error > 0 ? 5 * error : 0.0);
            unknown += std::isnan(statistics.standardError[i]);
        }
        EXPECT_GT(grey, kRays / 4);
        EXPECT_EQ(far > grey / 4, !method.isUnbiased) << far << " of " << grey;
        EXPECT_EQ(unknown > grey / 4, !method.isUnbiased) << unknown << " of " << grey;
    }
}

TEST(Methods, AnswerWhatTheTableSays) {
    const Scene scene;
    for (const trk::MethodTraits& method : trk::kMethods) {
        SCOPED_TRACE(method.name);
        const track::Query query = queryOf(method);
        std::vector<double> depth(kRays);
        const TrkStatus integrated = trkIntegrateOpticalDepth(
            scene.volume.handle(), &query, scene.rays.data(), kRays, depth.data());
        EXPECT_EQ(integrated == TRK_OK, !method.isRandom);
        track::FreePaths paths(kRays, 1);
        const TrkFreePaths view = paths.view();
        const TrkStatus sampled =
            trkSampleFreePath(scene.volume.handle(), &query, scene.rays.data(), kRays, &view);
        EXPECT_EQ(sampled == TRK_OK, method.hasFreePaths);
        track::Query slow = query;
        slow.rate = 0.5f;
        std::vector<float> result(kRays);
        const bool needsMajorant = method.usesRate && !method.usesRoulette;
        EXPECT_EQ(trkEstimateTransmittance(scene.volume.handle(), &slow, scene.rays.data(), kRays,
                                           result.data(), nullptr) == TRK_OK,
                  !needsMajorant);
        track::Query level = query;
        level.level = 1;
        EXPECT_EQ(scene.estimate(level) != scene.estimate(query), method.hasLevels());
    }
}

TEST(Methods, NeedTheFilesThatTheTableSays) {
    const Scene scene;
    TrkVolumeOptions options = trkDefaultVolumeOptions();
    options.noBake = 1;
    const track::Volume density = track::Volume::open(scene.vdb, "", options);
    const track::Volume sidecar = track::Volume::open("", scene.sidecar.c_str(), options);
    for (const trk::MethodTraits& method : trk::kMethods) {
        SCOPED_TRACE(method.name);
        const track::Query query = queryOf(method);
        std::vector<float> result(kRays);
        EXPECT_EQ(trkEstimateTransmittance(density.handle(), &query, scene.rays.data(), kRays,
                                           result.data(), nullptr),
                  method.usesSuperVoxels ? TRK_ERROR_NO_SIDECAR : TRK_OK);
        EXPECT_EQ(trkEstimateTransmittance(sidecar.handle(), &query, scene.rays.data(), kRays,
                                           result.data(), nullptr),
                  method.usesDensity ? TRK_ERROR_NO_DENSITY : TRK_OK);
    }
}

}  // namespace
