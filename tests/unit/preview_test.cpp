// SPDX-License-Identifier: Apache-2.0
// Lit previews: what their layers mean, and that they come nearer as super-voxels shrink.
#include "failure.h"
#include "lit_preview.h"
#include "support/fixtures.h"
#include "track/track.h"
#include "transmittance.h"

#include <gtest/gtest.h>
#include <tbb/global_control.h>

#include <cmath>
#include <vector>

namespace {

using trk::ControlKind;
using vdbtools::LitPreview;
using vdbtools::Picture;

constexpr int kEdge = 48;

vdbtools::Camera cameraOn(const trk::Volume& volume) {
    vdbtools::WorldBox box;
    double lo[3];
    double hi[3];
    trk::worldBounds(volume.indexToWorld, volume.anchor, volume.field->box(), lo, hi);
    for (int a = 0; a < 3; ++a) {
        box.lo[a] = lo[a];
        box.hi[a] = hi[a];
    }
    vdbtools::Camera camera = vdbtools::namedView("iso");
    vdbtools::frameBox(camera, box, 1);
    return camera;
}

/// Transmittance of the camera's rays, one a pixel.
std::vector<float> transmittanceOf(const trk::Volume& volume, const vdbtools::Camera& camera,
                                   TrkMethod method) {
    std::vector<TrkRay> rays;
    for (int i = 0; i < kEdge * kEdge; ++i) {
        rays.push_back(camera.ray((i % kEdge + 0.5) / kEdge, (i / kEdge + 0.5) / kEdge, 1));
    }
    TrkQuery query = trkDefaultQuery();
    query.method = method;
    query.rayStride = sizeof(TrkRay);
    std::vector<float> result(rays.size() * volume.channels());
    trk::estimateTransmittance(volume, query, rays.data(), rays.size(),
                               {result.data(), volume.channels(), 0}, {});
    return result;
}

double rmse(const std::vector<float>& a, const std::vector<float>& b) {
    double squares = 0;
    for (size_t i = 0; i < a.size(); ++i) {
        squares += std::pow(static_cast<double>(a[i]) - static_cast<double>(b[i]), 2);
    }
    return std::sqrt(squares / static_cast<double>(a.size()));
}

TEST(Preview, ComesNearerToExactAsSuperVoxelsShrink) {
    const std::string vdb = fixtures::cloudFile(96);
    trk::VolumeOptions options;
    options.scale = 2;
    const trk::Volume exact = trk::openVolume(vdb.c_str(), "", options);
    const vdbtools::Camera camera = cameraOn(exact);
    const std::vector<float> expected = transmittanceOf(exact, camera, TRK_METHOD_EXACT);
    for (const ControlKind kind :
         {ControlKind::kConstant, ControlKind::kTrilinear, ControlKind::kAffine}) {
        double last[2] = {1, 1};
        for (const int size : {32, 16, 8, 4}) {
            const std::string sidecar = fixtures::path("nearer.track.vdb");
            fixtures::bake(vdb, sidecar, size, 0, kind);
            const trk::Volume control = trk::openVolume(nullptr, sidecar.c_str(), options);
            const LitPreview lit(sidecar, 0, 2, {{1, 1, 1}});
            const Picture picture = lit.draw(camera, kEdge, kEdge, [](double) {});
            const double found[2] = {
                rmse(transmittanceOf(control, camera, TRK_METHOD_CONTROL), expected),
                rmse(picture.transmittance[0], expected)};
            for (size_t i = 0; i < 2; ++i) {
                EXPECT_LT(found[i], 0.9 * last[i]) << trk::controlName(kind) << " " << size;
                last[i] = found[i];
            }
            if (kind == ControlKind::kTrilinear) {
                // Its corner values, read as a density, are that very control.
                EXPECT_LT(rmse(transmittanceOf(control, camera, TRK_METHOD_CONTROL),
                               picture.transmittance[0]),
                          1e-5);
            }
        }
        EXPECT_LT(last[0], 0.05);
        EXPECT_LT(last[1], 0.07);
    }
}

TEST(Preview, LayersMeanWhatTheirNamesSay) {
    // A box of density 1 from 0 to 64 along each axis; at scale 0.1 half the light is left after
    // ln 2 / 0.1 = 6.9 units.
    const auto grid = fixtures::makeGrid(openvdb::CoordBBox(openvdb::Coord(0), openvdb::Coord(64)),
                                         [](const openvdb::Coord&) { return 1.0f; });
    const std::string vdb = fixtures::write("box.vdb", {grid});
    const std::string sidecar = fixtures::path("box.track.vdb");
    fixtures::bake(vdb, sidecar, 4, 1);
    const vdbtools::Camera camera = vdbtools::cameraAt({{200, 32, 32}}, {{32, 32, 32}}, 1);
    const LitPreview lit(sidecar, 0, 0.1f, {{1, 1, 1}});
    const Picture picture = lit.draw(camera, 5, 5, [](double) {});
    const size_t middle = 12;
    EXPECT_NEAR(picture.transmittance[0][middle], std::exp(-6.5), 2e-5);
    // The box's face lies at x = 64; super-voxels of 4 soften it.
    EXPECT_NEAR(picture.halfDepth[middle], 200 - 64 + 6.93, 2);
    const vdbtools::Camera away = vdbtools::cameraAt({{200, 32, 32}}, {{400, 32, 32}}, 1);
    const Picture nothing = lit.draw(away, 5, 5, [](double) {});
    EXPECT_EQ(nothing.transmittance[0][middle], 1);
    EXPECT_TRUE(std::isinf(nothing.halfDepth[middle]));
    // The lit side is seen from the sun, the other from the ground.
    const auto brightness = [&](const trk::Vec3d& eye) {
        const Picture seen =
            lit.draw(vdbtools::cameraAt(eye, {{32, 32, 32}}, 1), 5, 5, [](double) {});
        return seen.beauty[0][middle];
    };
    EXPECT_GT(brightness({{-40, 180, 180}}), 2 * brightness({{90, -180, -180}}));
    EXPECT_GT(lit.bytes(), 0u);
}

TEST(Preview, ColourAndThreads) {
    const std::string vdb = fixtures::cloudFile(64, "color-cloud");
    const std::string sidecar = fixtures::path("colour-preview.track.vdb");
    fixtures::bake(vdb, sidecar, 4, 1);
    const trk::Volume volume = trk::openVolume(nullptr, sidecar.c_str(), {});
    vdbtools::Camera camera = vdbtools::cameraAt({{20, 20, 20}}, {{5, 4, 5}}, 30);
    const auto draw = [&] {
        return LitPreview(sidecar, 0, 5, {{1, 0, 0.2f}}).draw(camera, kEdge, kEdge, [](double) {});
    };
    const Picture picture = draw();
    double differences = 0;
    for (size_t i = 0; i < picture.halfDepth.size(); ++i) {
        EXPECT_EQ(picture.transmittance[1][i], 1);  // a channel of 0
        differences += std::fabs(static_cast<double>(picture.transmittance[0][i]) -
                                 static_cast<double>(picture.transmittance[2][i]));
    }
    EXPECT_GT(differences, 1);
    const tbb::global_control limit(tbb::global_control::max_allowed_parallelism, 1);
    const Picture again = draw();
    for (size_t c = 0; c < 3; ++c) {
        EXPECT_EQ(picture.beauty[c], again.beauty[c]);
    }
    EXPECT_EQ(picture.halfDepth, again.halfDepth);
}

TEST(Preview, EveryLevelDraws) {
    const std::string vdb = fixtures::cloudFile(96);
    const std::string sidecar = fixtures::path("levels-preview.track.vdb");
    fixtures::bake(vdb, sidecar, 4, 4);
    const vdbtools::Camera camera = vdbtools::cameraAt({{20, 12, 20}}, {{5, 4, 5}}, 30);
    for (const uint32_t level : {0u, 1u, 2u, 3u, 4u}) {
        const Picture picture =
            LitPreview(sidecar, level, 2, {{1, 1, 1}}).draw(camera, kEdge, kEdge, [](double) {});
        double passed = 0;
        for (const float t : picture.transmittance[0]) {
            passed += static_cast<double>(t) / (kEdge * kEdge);
        }
        EXPECT_GT(passed, 0.2);
        EXPECT_LT(passed, 0.99);
    }
    EXPECT_THROW(LitPreview(sidecar, 5, 2, {{1, 1, 1}}), trk::Error);
    EXPECT_THROW(LitPreview(vdb, 0, 2, {{1, 1, 1}}), trk::Error);
}

TEST(Camera, AnOrbitKeepsTheDistanceAndComesBack) {
    const trk::Vec3d centre{{1, 2, 3}};
    const vdbtools::Camera camera = vdbtools::cameraAt({{4, 6, -2}}, centre, 40);
    const vdbtools::Camera half = camera.orbited(centre, 3.14159265358979323846);
    EXPECT_NEAR(half.eye[0], -2, 1e-12);
    EXPECT_NEAR(half.eye[1], 6, 1e-12);
    EXPECT_NEAR(half.eye[2], 8, 1e-12);
    const TrkRay ray = half.ray(0.5, 0.5, 1);  // through the middle: at the centre
    const double distance = trk::length(centre - half.eye);
    for (int a = 0; a < 3; ++a) {
        EXPECT_NEAR(
            static_cast<double>(ray.origin[a]) + distance * static_cast<double>(ray.direction[a]),
            centre[a], 1e-5);
    }
}

}  // namespace
