// SPDX-License-Identifier: Apache-2.0
// Colour through the C API: channels, tints, equal channels, channels of 0.
#include "track/track.hpp"

#include "support/fixtures.h"
#include "support/rays.h"

#include <gtest/gtest.h>

#include <cmath>
#include <vector>

namespace {

using openvdb::Coord;
using openvdb::CoordBBox;
using openvdb::Vec3f;
using trk::ControlKind;

const std::vector<TrkMethod> kMethods{TRK_METHOD_EXACT, TRK_METHOD_RESIDUAL, TRK_METHOD_RATIO,
                                      TRK_METHOD_COMB, TRK_METHOD_CONTROL};

struct Files {
    std::string vdb;
    std::string sidecar;
};

/// A grid with its sidecar of size 8.
Files bakedFile(const std::string& name, const openvdb::GridBase::Ptr& grid, ControlKind kind) {
    Files files{fixtures::write(name + ".vdb", {grid}), fixtures::path(name + ".track.vdb")};
    fixtures::bake(files.vdb, files.sidecar, 8, 2, kind);
    return files;
}

track::Volume open(const Files& files, float scale, float r = 1, float g = 1, float b = 1) {
    TrkVolumeOptions options = trkDefaultVolumeOptions();
    options.scale = scale;
    options.color[0] = r;
    options.color[1] = g;
    options.color[2] = b;
    return track::Volume::open(files.vdb, files.sidecar.c_str(), options);
}

std::vector<float> estimate(const track::Volume& volume, const std::vector<TrkRay>& rays,
                            TrkMethod method, uint32_t flags = trkDefaultQuery().flags) {
    track::Query query(0, 0);
    query.method = method;
    query.flags = flags;
    query.samples = 3;
    std::vector<float> result(rays.size() * volume.info().channels);
    volume.estimateTransmittance(query, rays.data(), rays.size(), result.data());
    return result;
}

std::vector<TrkRay> someRays(const track::Volume& volume) {
    return rays::through(rays::boundsOf(volume.info()), 400, 60, 3);
}

TEST(Colour, ChannelsAreThoseOfDensityAndTint) {
    const Files grey = bakedFile("ch-grey", fixtures::makeBlob(40), ControlKind::kConstant);
    EXPECT_EQ(open(grey, 1).info().channels, 1u);
    EXPECT_EQ(open(grey, 1, 0.5f, 0.5f, 0.5f).info().channels, 1u);
    EXPECT_EQ(open(grey, 1, 1, 1, 0.5f).info().channels, 3u);
    TrkVolumeOptions options = trkDefaultVolumeOptions();
    options.color[2] = 2;
    EXPECT_EQ(track::Volume::open("", grey.sidecar.c_str(), options).info().channels, 3u);
    for (const float bad : {-1.0f, std::nanf(""), rays::kInfinity}) {
        options.color[1] = bad;
        TrkVolume* volume = nullptr;
        EXPECT_EQ(trkOpenVolume(grey.vdb.c_str(), "", &options, &volume),
                  TRK_ERROR_INVALID_ARGUMENT);
        EXPECT_NE(std::string(trkGetLastErrorMessage()).find("color"), std::string::npos);
    }
    options.color[1] = 3e38f;
    options.scale = 100;
    TrkVolume* volume = nullptr;
    EXPECT_EQ(trkOpenVolume(grey.vdb.c_str(), "", &options, &volume), TRK_ERROR_INVALID_ARGUMENT);
    EXPECT_NE(std::string(trkGetLastErrorMessage()).find("scale x color"), std::string::npos);
}

TEST(Colour, EqualChannelsHaveTheBitsOfGrey) {
    for (const ControlKind kind :
         {ControlKind::kConstant, ControlKind::kTrilinear, ControlKind::kAffine}) {
        const auto blob = fixtures::makeBlob(45);
        const auto equal = fixtures::makeColorGrid(
            CoordBBox(Coord(0), Coord(44)),
            [&](const Coord& p) { return Vec3f(blob->tree().getValue(p)); });
        const track::Volume grey = open(bakedFile("eq-grey", blob, kind), 0.3f);
        const track::Volume vectors = open(bakedFile("eq-vectors", equal, kind), 0.3f);
        // Twice a third channel of half: two that are equal, beside one that is not.
        const track::Volume tinted = open(bakedFile("eq-tint", blob, kind), 0.3f, 1, 1, 0.5f);
        const std::vector<TrkRay> rays = someRays(grey);
        for (const TrkMethod method : kMethods) {
            const std::vector<float> expected = estimate(grey, rays, method);
            const std::vector<float> found = estimate(vectors, rays, method);
            // Roulette goes by the channel that still matters most.
            const std::vector<float> whole = estimate(grey, rays, method, 0);
            const std::vector<float> tint = estimate(tinted, rays, method, 0);
            double noise = 0;
            for (size_t i = 0; i < rays.size(); ++i) {
                for (size_t c = 0; c < 3; ++c) {
                    ASSERT_EQ(found[3 * i + c], expected[i]) << trk::controlName(kind);
                }
                ASSERT_EQ(tint[3 * i], whole[i]);  // the densest channel sets the rate
                ASSERT_EQ(tint[3 * i + 1], whole[i]);
                noise += std::fabs(static_cast<double>(tint[3 * i + 2] - whole[i]));
            }
            EXPECT_GT(noise, 1);
        }
    }
}

TEST(Colour, ExactAndControlAreThoseOfEachChannelAlone) {
    const std::string vdb = fixtures::cloudFile(64, "color-cloud");
    openvdb::io::File file(vdb);
    file.open();
    const auto grid = openvdb::gridPtrCast<openvdb::Vec3SGrid>(file.readGrid("density"));
    for (const ControlKind kind :
         {ControlKind::kConstant, ControlKind::kTrilinear, ControlKind::kAffine}) {
        const Files color{vdb, fixtures::path("alone-color.track.vdb")};
        fixtures::bake(color.vdb, color.sidecar, 8, 2, kind);
        const track::Volume all = open(color, 2, 1, 0.5f, 3);
        const std::vector<TrkRay> rays = someRays(all);
        for (const TrkMethod method : {TRK_METHOD_EXACT, TRK_METHOD_CONTROL}) {
            for (const uint32_t level : {0u, 1u}) {
                track::Query query(0, 0);
                query.method = method;
                query.level = method == TRK_METHOD_CONTROL ? level : 0;
                std::vector<double> depth(3 * rays.size());
                all.integrateOpticalDepth(query, rays.data(), rays.size(), depth.data());
                double sum[3] = {0, 0, 0};
                for (int c = 0; c < 3; ++c) {
                    auto one = fixtures::makeGrid(CoordBBox(), [](const Coord&) { return 0.0f; });
                    for (auto it = grid->cbeginValueOn(); it; ++it) {
                        one->tree().setValue(it.getCoord(), (*it)[c]);
                    }
                    one->setTransform(grid->transform().copy());
                    const track::Volume alone =
                        open(bakedFile("alone-one", one, kind), c == 0   ? 2.0f
                                                                : c == 1 ? 1.0f
                                                                         : 6.0f);
                    std::vector<double> expected(rays.size());
                    alone.integrateOpticalDepth(query, rays.data(), rays.size(), expected.data());
                    for (size_t i = 0; i < rays.size(); ++i) {
                        const double found = depth[3 * i + static_cast<size_t>(c)];
                        ASSERT_NEAR(found, expected[i], 1e-6 * expected[i] + 1e-9);
                        sum[c] += found;
                    }
                }
                EXPECT_GT(std::fabs(sum[0] - sum[1] * 2), 1e-3 * sum[0]);
            }
        }
    }
}

TEST(Colour, AChannelOfZeroIsExactlyOne) {
    const auto oneEmpty = fixtures::makeColorGrid(
        CoordBBox(Coord(0), Coord(30)),
        [](const Coord& p) { return Vec3f(0.1f * static_cast<float>(p.x() % 5), 0, 0.3f); });
    for (const ControlKind kind :
         {ControlKind::kConstant, ControlKind::kTrilinear, ControlKind::kAffine}) {
        const track::Volume tinted =
            open(bakedFile("zero-tint", fixtures::makeBlob(40), kind), 0.4f, 1, 0, 3);
        const track::Volume vectors = open(bakedFile("zero-channel", oneEmpty, kind), 0.4f);
        const track::Volume both = open(bakedFile("zero-both", oneEmpty, kind), 0.4f, 0, 1, 1);
        for (const TrkMethod method : kMethods) {
            for (const track::Volume* volume : {&tinted, &vectors, &both}) {
                const std::vector<TrkRay> rays = someRays(*volume);
                const std::vector<float> found = estimate(*volume, rays, method);
                double others = 0;
                for (size_t i = 0; i < rays.size(); ++i) {
                    ASSERT_EQ(found[3 * i + 1], 1.0f);
                    ASSERT_TRUE(volume != &both || found[3 * i] == 1.0f);
                    others += static_cast<double>(1 - found[3 * i + 2]);
                }
                EXPECT_GT(others, 1);
            }
        }
    }
}

TEST(Colour, MinAndMaxNeedAConstantControl) {
    for (const ControlKind kind : {ControlKind::kTrilinear, ControlKind::kAffine}) {
        const Files files = bakedFile("choice", fixtures::makeBlob(40), kind);
        EXPECT_EQ(open(files, 1).info().controlKind, std::string(trk::controlName(kind)));
        for (const TrkChoice choice : {TRK_CHOICE_MIN, TRK_CHOICE_MAX}) {
            TrkVolumeOptions options = trkDefaultVolumeOptions();
            options.choice = choice;
            TrkVolume* volume = nullptr;
            EXPECT_EQ(trkOpenVolume(files.vdb.c_str(), files.sidecar.c_str(), &options, &volume),
                      TRK_ERROR_INVALID_ARGUMENT);
            EXPECT_NE(std::string(trkGetLastErrorMessage()).find(trk::controlName(kind)),
                      std::string::npos);
        }
    }
}

TEST(Colour, StatisticsHaveAnErrorPerChannel) {
    const Files files{fixtures::cloudFile(64, "color-cloud"), fixtures::path("error.track.vdb")};
    fixtures::bake(files.vdb, files.sidecar, 8, 0, ControlKind::kAffine);
    const track::Volume volume = open(files, 0.3f, 1, 1, 0);
    const std::vector<TrkRay> rays = someRays(volume);
    track::Query query(0, 0);
    query.samples = 64;
    std::vector<float> out(3 * rays.size());
    track::Statistics statistics(rays.size(), 3);
    volume.estimateTransmittance(query, rays.data(), rays.size(), out.data(), statistics.view());
    query.method = TRK_METHOD_EXACT;
    std::vector<float> exact(3 * rays.size());
    volume.estimateTransmittance(query, rays.data(), rays.size(), exact.data());
    size_t different = 0;
    for (size_t i = 0; i < rays.size(); ++i) {
        const float* error = &statistics.standardError[3 * i];
        EXPECT_EQ(error[2], 0.0f);  // a channel of extinction 0 is known
        EXPECT_EQ(out[3 * i + 2], 1.0f);
        different += error[0] != error[1] ? 1 : 0;
        for (size_t c = 0; c < 3; ++c) {
            const double allowed = std::isnan(error[c]) ? 0.0 : 7 * static_cast<double>(error[c]);
            EXPECT_NEAR(out[3 * i + c], exact[3 * i + c], allowed + 1e-3);
        }
    }
    EXPECT_GT(different, rays.size() / 10);
}

}  // namespace
