// SPDX-License-Identifier: Apache-2.0
// Samples and rays that fly together, against each alone.
#include "query/flight.h"

#include "estimate/free_path.h"
#include "query/transmittance.h"
#include "query/variant.h"
#include "support/fixtures.h"
#include "support/rays.h"
#include "volume.h"

#include <gtest/gtest.h>

#include <array>
#include <cstddef>
#include <cstdint>
#include <random>
#include <string>
#include <vector>

namespace {

using trk::Control;
using trk::ControlKind;
using trk::Rng;
using trk::Volume;

Volume open(const std::string& vdb, ControlKind kind, float scale,
            const std::array<float, 3>& color) {
    const std::string sidecar = fixtures::path("flight.track.vdb");
    fixtures::bake(vdb, sidecar, 4, 0, kind);
    trk::VolumeOptions options;
    options.scale = scale;
    options.color = color;
    options.kernel = trk::Kernel::kBaseline;  // which is what this file is compiled for
    return trk::openVolume(vdb.c_str(), sidecar.c_str(), options);
}

/// Three channels that are not alike: holes, homogeneous blocks, and a gentle slope.
std::string coloured() {
    std::mt19937 random(5);
    std::uniform_real_distribution<float> noise(0, 1);
    return fixtures::write(
        "flight_rgb.vdb",
        {fixtures::makeColorGrid(
            openvdb::CoordBBox(0, 0, 0, 95, 95, 95), [&](const openvdb::Coord& p) {
                const float hole = noise(random) < 0.5f ? 0.0f : noise(random);
                const auto block = static_cast<float>((p[0] >> 3) + (p[1] >> 3) + (p[2] >> 3));
                return openvdb::Vec3f(hole, 0.02f * block, 0.002f * static_cast<float>(p[2]));
            })});
}

/// The mean of `samples` walks of one ray, each with a plan of its own.
template <class V>
trk::Estimate<V::kChannels> walkAlone(const Volume& volume, const TrkQuery& query,
                                      const trk::ClippedRay& clipped, uint64_t rayId,
                                      trk::PathCost& cost) {
    constexpr size_t C = V::kChannels;
    const trk::TrackingSettings settings = trk::trackingSettings(query, clipped.lengthPerVoxel);
    const typename V::Extinction field(volume);
    const typename V::Walk superVoxels(volume);
    trk::SampleMean<C> mean;
    for (uint32_t i = 0; i < query.samples; ++i) {
        Rng rng(query.seed, query.stream, rayId, i);
        if (query.method == TRK_METHOD_RESIDUAL) {
            mean.add(trk::trackTransmittance<Control::kChosen>(field, superVoxels, clipped.local,
                                                               settings, rng, cost));
        } else if constexpr (V::kKind == ControlKind::kConstant) {
            if (query.method == TRK_METHOD_RATIO) {
                mean.add(trk::trackTransmittance<Control::kNone>(field, superVoxels, clipped.local,
                                                                 settings, rng, cost));
            } else {
                trk::trackBinary(
                    field, superVoxels, clipped.local, settings, 1, [&](uint32_t) { return rng; },
                    cost, [&](const std::array<double, C>& passes) { mean.add(passes); });
            }
        }
    }
    return mean.result(cost.random);
}

template <class V>
void expectTheSame(const Volume& volume, TrkMethod method, size_t rayCount = 60) {
    constexpr size_t C = V::kChannels;
    rays::Box box{};
    trk::worldBounds(volume.indexToWorld, volume.anchor, volume.field->box(), box.lo, box.hi);
    const std::vector<TrkRay> rays = rays::through(box, rayCount, 20, 3);
    for (const uint32_t samples : {1u, 2u, 3u, 7u, 16u, 37u}) {
        TrkQuery query = trkDefaultQuery();
        query.rayStride = sizeof(TrkRay);
        query.method = method;
        query.samples = samples;
        query.seed = 9;
        query.threads = 1;
        std::vector<float> transmittance(C * rays.size());
        std::vector<uint64_t> lookups(rays.size());
        std::vector<uint64_t> crossings(rays.size());
        trk::StatisticsOutput statistics;
        statistics.lookups = {lookups.data(), 1, 0};
        statistics.superVoxels = {crossings.data(), 1, 0};
        trk::estimateTransmittance(volume, query, rays.data(), rays.size(),
                                   {transmittance.data(), C, 0}, statistics);
        size_t random = 0;
        for (size_t i = 0; i < rays.size(); ++i) {
            const auto clipped = volume.clip(rays[i], volume.field->box());
            if (!clipped) {
                continue;
            }
            trk::PathCost cost;
            const auto alone = walkAlone<V>(volume, query, *clipped, i, cost);
            for (size_t c = 0; c < C; ++c) {
                ASSERT_EQ(transmittance[C * i + c], trk::finiteFloat(alone.mean[c]))
                    << "ray " << i << ", channel " << c << ", " << samples << " samples";
            }
            ASSERT_EQ(lookups[i], cost.lookups);
            ASSERT_EQ(crossings[i], cost.superVoxels);
            random += cost.lookups > 0 ? 1 : 0;
        }
        EXPECT_GT(random, rays.size() / 4);
    }
}

TEST(Flight, SamplesThatShareAPlanAreThoseOfEachAlone) {
    constexpr ControlKind kConstant = ControlKind::kConstant;
    const std::string cloud = fixtures::cloudFile(40);
    const std::string rgb = coloured();
    for (const float scale : {0.2f, 20.0f}) {
        const Volume grey = open(cloud, kConstant, scale, {{1, 1, 1}});
        const Volume coloured = open(cloud, kConstant, scale, {{1, 0.5f, 0.1f}});
        for (const TrkMethod method : {TRK_METHOD_RESIDUAL, TRK_METHOD_RATIO, TRK_METHOD_DELTA}) {
            expectTheSame<trk::Variant<1, 1, kConstant>>(grey, method);
            expectTheSame<trk::Variant<1, 3, kConstant>>(coloured, method);
        }
        const Volume vectors = open(rgb, kConstant, scale, {{1, 1, 1}});
        for (const TrkMethod method : {TRK_METHOD_RESIDUAL, TRK_METHOD_RATIO, TRK_METHOD_DELTA}) {
            expectTheSame<trk::Variant<3, 3, kConstant>>(vectors, method, 300);
        }
        expectTheSame<trk::Variant<1, 1, ControlKind::kAffine>>(
            open(cloud, ControlKind::kAffine, scale, {{1, 1, 1}}), TRK_METHOD_RESIDUAL);
    }
}

}  // namespace
