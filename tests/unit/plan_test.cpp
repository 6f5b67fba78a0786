// SPDX-License-Identifier: Apache-2.0
// What a plan says of a ray, against the field.
#include "estimate/plan.h"

#include "query/variant.h"
#include "support/fixtures.h"
#include "support/rays.h"
#include "volume.h"

#include <gtest/gtest.h>

#include <cmath>
#include <cstddef>
#include <cstdint>
#include <string>
#include <vector>

namespace {

using trk::Control;
using trk::ControlKind;
using trk::LocalRay;
using trk::Volume;

Volume open(const std::string& vdb, ControlKind kind, float scale,
            TrkChoice choice = TRK_CHOICE_ROBUST) {
    const std::string sidecar = fixtures::path("plan.track.vdb");
    fixtures::bake(vdb, sidecar, 8, 2, kind);
    trk::VolumeOptions options;
    options.scale = scale;
    options.choice = choice;
    return trk::openVolume(vdb.c_str(), sidecar.c_str(), options);
}

std::vector<LocalRay> raysThrough(const Volume& volume) {
    rays::Box box{};
    trk::worldBounds(volume.indexToWorld, volume.anchor, volume.field->box(), box.lo, box.hi);
    std::vector<LocalRay> result;
    for (const TrkRay& ray : rays::through(box, 100, 30, 5)) {
        if (const auto clipped = volume.clip(ray, volume.field->box())) {
            result.push_back(clipped->local);
        }
    }
    return result;
}

/// How far what a plan counts on goes beyond what is there: the largest of ahead x factor over the
/// optical depth from a stretch to the end of its window. At most 1, if all is well.
template <Control kControl, class V>
double largestAhead(const Volume& volume, double factor) {
    const typename V::Walk superVoxels(volume);
    const typename V::Extinction field(volume);
    double largest = 0;
    for (const bool exactFallback : {true, false}) {
        trk::TrackingSettings settings;
        settings.exactFallback = exactFallback;
        for (const LocalRay& ray : raysThrough(volume)) {
            trk::Plan<kControl, typename V::Walk> plan(superVoxels, ray, settings);
            while (plan.next() > 0) {
                double depth = 0;
                for (size_t i = plan.count(); i-- > 0;) {
                    uint64_t ignored = 0;
                    depth +=
                        field.integrate(ray, plan.tEnter(i), plan.tExit(i), ignored, ignored)[0];
                    EXPECT_GE(plan.ahead(i, 0), 0);
                    if (plan.ahead(i, 0) > 0) {
                        largest = std::max(largest, factor * plan.ahead(i, 0) / depth);
                    }
                }
            }
        }
    }
    return largest;
}

TEST(Plan, CountsOnNoMoreThanIsAhead) {
    for (const ControlKind kind :
         {ControlKind::kConstant, ControlKind::kAffine, ControlKind::kTrilinear}) {
        // Little more than the minimum everywhere, so that what is counted on matters.
        const auto grid = fixtures::makeGrid({openvdb::Coord(0), openvdb::Coord(47)},
                                             [](const openvdb::Coord& p) {
                                                 const int wave = (p.x() + 2 * p.y() + p.z()) % 16;
                                                 return 1 + 0.01f * static_cast<float>(wave);
                                             });
        const Volume volume = open(fixtures::write("plan.vdb", {grid}), kind, 2);
        trk::withVariant(volume, kind, [&](auto variant) {
            using V = decltype(variant);
            if constexpr (V::kChannels == 1) {
                const double ratio = largestAhead<Control::kNone, V>(volume, 1);
                const double residual = largestAhead<Control::kChosen, V>(volume, 1);
                EXPECT_LE(ratio, 1 + 1e-6);  // cells are interpolated in float
                EXPECT_LE(residual, 1 + 1e-6);
                EXPECT_GT((largestAhead<Control::kNone, V>(volume, 1.4)), 1);
                EXPECT_GT((largestAhead<Control::kChosen, V>(volume, 1.4)), 1);
            }
        });
    }
}

TEST(Plan, StretchesFollowOneAnotherAndAreTreatedByTheirCost) {
    const Volume volume = open(fixtures::cloudFile(64), ControlKind::kConstant, 2);
    using V = trk::Variant<1, 1, ControlKind::kConstant>;
    size_t exact = 0;
    size_t tracked = 0;
    for (const LocalRay& ray : raysThrough(volume)) {
        const trk::TrackingSettings settings;
        const trk::MostLookups most(ray, settings);
        double last = 0;
        trk::forEachStretch<Control::kChosen>(
            V::Walk(volume), ray, settings, [&](const auto& plan, size_t i) {
                EXPECT_GE(plan.tEnter(i), last);
                EXPECT_GT(plan.tExit(i), plan.tEnter(i));
                last = plan.tExit(i);
                EXPECT_EQ(plan.isExact(i), plan.collisions(i) > most(plan.length(i)));
                EXPECT_NEAR(plan.collisions(i), plan.rate(i) * plan.length(i),
                            1e-12 * plan.collisions(i));
                ++(plan.isExact(i) ? exact : tracked);
            });
        EXPECT_LE(last, ray.tEnd);
    }
    EXPECT_GT(exact, 20u);
    EXPECT_GT(tracked, 20u);
}

TEST(Plan, VolumesOfOneBakeDifferByWhatIsAddedWhenPlanning) {
    const Volume one = open(fixtures::cloudFile(64), ControlKind::kAffine, 1, TRK_CHOICE_MEAN);
    Volume three = one;
    three.scales = {3};
    EXPECT_EQ(one.superVoxels.get(), three.superVoxels.get());
    using V = trk::Variant<1, 1, ControlKind::kAffine>;
    const V::Walk walk(three);
    for (const LocalRay& ray : raysThrough(one)) {
        const trk::TrackingSettings settings;
        trk::Plan<Control::kChosen, V::Walk> scaled(walk, ray, settings);
        trk::forEachStretch<Control::kChosen>(
            V::Walk(one), ray, settings, [&](const auto& plan, size_t i) {
                if (i == 0) {
                    ASSERT_EQ(scaled.next(), plan.count());
                }
                EXPECT_NEAR(scaled.bound(i, 0), 3 * plan.bound(i, 0), 1e-12 * scaled.bound(i, 0));
                EXPECT_NEAR(scaled.depth(i, 0), 3 * plan.depth(i, 0), 1e-9 * scaled.max(i, 0));
                EXPECT_NEAR(scaled.collisions(i), 3 * plan.collisions(i),
                            1e-9 * scaled.collisions(i));
            });
    }
}

}  // namespace
