// SPDX-License-Identifier: Apache-2.0
// Lit previews: what their layers mean, and that they come nearer as super-voxels shrink.
#include "bake/preview_scale.h"
#include "bake/write_bake.h"
#include "failure.h"
#include "io/sidecar.h"
#include "query/transmittance.h"
#include "support/fixtures.h"
#include "track/track.h"
#include "view/lit_preview.h"

#include <gtest/gtest.h>
#include <tbb/global_control.h>

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <vector>

namespace {

using trk::ControlKind;
using vdbtools::LitPreview;
using vdbtools::Picture;

constexpr int kEdge = 48;

vdbtools::LitOptions litOptions(uint32_t level, float scale) {
    vdbtools::LitOptions options;
    options.level = level;
    options.scale = scale;
    return options;
}

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
            const LitPreview lit(sidecar, litOptions(0, 2));
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

TEST(Preview, LightIsNoFinerThanPicturesShow) {
    // Two solid bars of 64 and 160 super-voxels: places of light grow with a picture's pixels.
    size_t bytes[2] = {};
    float middle[2] = {};
    for (const int i : {0, 1}) {
        const int length = i == 0 ? 1024 : 2560;
        const auto grid = openvdb::FloatGrid::create();
        grid->fill(openvdb::CoordBBox(openvdb::Coord(0), openvdb::Coord(length - 1, 127, 127)), 1);
        grid->setName("density");
        const std::string vdb = fixtures::write("bar.vdb", {grid});
        const std::string sidecar = fixtures::path("bar.track.vdb");
        fixtures::bake(vdb, sidecar, 16, 0);
        const LitPreview lit(sidecar, litOptions(0, 0.02f));
        bytes[i] = lit.bytes();
        const vdbtools::Camera camera =
            vdbtools::cameraAt({{length / 2.0, 500, 500}}, {{length / 2.0, 64, 64}}, 1);
        middle[i] = lit.draw(camera, 5, 5, [](double) {}).light[0][12];
    }
    EXPECT_LT(static_cast<double>(bytes[1]), 1.3 * static_cast<double>(bytes[0]));
    EXPECT_NEAR(middle[1] / middle[0], 1, 0.02);
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
    const LitPreview lit(sidecar, litOptions(0, 0.1f));
    const Picture picture = lit.draw(camera, 5, 5, [](double) {});
    const size_t middle = 12;
    EXPECT_NEAR(picture.transmittance[0][middle], std::exp(-6.5), 2e-5);
    // The box's face lies at x = 64; super-voxels of 4 soften it.
    EXPECT_NEAR(picture.halfDepth[middle], 200 - 64 + 6.93, 2);
    const vdbtools::Camera away = vdbtools::cameraAt({{200, 32, 32}}, {{400, 32, 32}}, 1);
    const Picture nothing = lit.draw(away, 5, 5, [](double) {});
    EXPECT_EQ(nothing.transmittance[0][middle], 1);
    // Finite, as compositors ask: the far side of the volume.
    EXPECT_NEAR(nothing.halfDepth[middle], std::sqrt(202.0 * 202 + 2 * 34 * 34), 20);
    // The lit side is seen from the sun, the other from the ground.
    const auto brightness = [&](const trk::Vec3d& eye) {
        const Picture seen =
            lit.draw(vdbtools::cameraAt(eye, {{32, 32, 32}}, 1), 5, 5, [](double) {});
        return seen.light[0][middle];
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
        vdbtools::LitOptions options = litOptions(0, 5);
        options.color = {{1, 0, 0.2f}};
        return LitPreview(sidecar, options).draw(camera, kEdge, kEdge, [](double) {});
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
        EXPECT_EQ(picture.light[c], again.light[c]);
    }
    EXPECT_EQ(picture.halfDepth, again.halfDepth);
}

TEST(Preview, EveryLevelDraws) {
    const std::string vdb = fixtures::cloudFile(96);
    const std::string sidecar = fixtures::path("levels-preview.track.vdb");
    fixtures::bake(vdb, sidecar, 4, 4);
    const vdbtools::Camera camera = vdbtools::cameraAt({{20, 12, 20}}, {{5, 4, 5}}, 30);
    for (const uint32_t level : {0u, 1u, 2u, 3u}) {
        const Picture picture =
            LitPreview(sidecar, litOptions(level, 2)).draw(camera, kEdge, kEdge, [](double) {});
        double passed = 0;
        for (const float t : picture.transmittance[0]) {
            passed += static_cast<double>(t) / (kEdge * kEdge);
        }
        EXPECT_GT(passed, 0.2);
        EXPECT_LT(passed, 0.99);
    }
    EXPECT_THROW(LitPreview(sidecar, litOptions(4, 2)), trk::Error);
    EXPECT_THROW(LitPreview(vdb, litOptions(0, 2)), trk::Error);
}

/// The largest step between pixels that neither neighbour shares: of a notch, its height; of a
/// smooth picture, next to nothing.
double largestJump(const Picture& picture) {
    double largest = 0;
    const auto width = static_cast<size_t>(picture.width);
    for (const std::vector<float>& light : picture.light) {
        for (size_t i = 0; i + 2 * width < light.size(); ++i) {
            for (const size_t step : {size_t{1}, width}) {
                const auto at = [&](size_t k) { return static_cast<double>(light[i + k * step]); };
                largest = std::max(largest, std::fabs(at(0) - 2 * at(1) + at(2)));
            }
        }
    }
    return largest;
}

// Pixels are a fortieth of a super-voxel here, and the field that is drawn is continuous. (That
// light is scattered evenly over what a cell's ends suggest drew notches of 0.05 to 0.16.)
TEST(Preview, DrawsNoEdgesOfSuperVoxels) {
    struct Case {
        const char* volume;
        ControlKind kind;
    };
    for (const Case& c :
         {Case{"cloud", ControlKind::kConstant}, Case{"cloud", ControlKind::kTrilinear},
          Case{"smoke", ControlKind::kConstant}}) {
        const std::string sidecar = fixtures::path("smooth.track.vdb");
        fixtures::bake(fixtures::cloudFile(96, c.volume), sidecar, 16, 0, c.kind);
        const auto scale = static_cast<float>(3 * trk::readSidecarHeader(sidecar).previewScale);
        const LitPreview lit(sidecar, litOptions(0, scale));
        vdbtools::Camera camera = vdbtools::namedView("iso");
        vdbtools::frameBox(camera, lit.box(), 1);
        const double jump = largestJump(lit.draw(camera, 240, 240, [](double) {}));
        std::printf("%s, %s: largest jump %.4f\n", c.volume, trk::controlName(c.kind), jump);
        EXPECT_LT(jump, 0.03) << c.volume << " " << trk::controlName(c.kind);
    }
}

TEST(Preview, TheFinestMeansAreDrawnUnlessALevelIsAskedFor) {
    const trk::Density density = fixtures::load(fixtures::cloudFile(96));
    trk::BakeOptions options = fixtures::bakeOptions(32, 1);
    options.sidecarBytes = 1000000;
    const trk::BakedVolume baked = trk::bake(density.field, options);
    ASSERT_EQ(baked.previewSize, 1);
    const std::string sidecar = fixtures::path("finest.track.vdb");
    trk::OutputFile file(sidecar, true);
    trk::writeSidecar(file, trk::sidecarHeader(density.summary, density.field, baked), baked,
                      density.summary.anchor);
    file.commit();
    trk::VolumeOptions volumeOptions;
    volumeOptions.scale = 2;
    const trk::Volume exact = trk::openVolume(fixtures::cloudFile(96).c_str(), "", volumeOptions);
    const vdbtools::Camera camera = cameraOn(exact);
    const std::vector<float> expected = transmittanceOf(exact, camera, TRK_METHOD_EXACT);
    vdbtools::LitOptions lit = litOptions(0, 2);
    const double coarse =
        rmse(LitPreview(sidecar, lit).draw(camera, kEdge, kEdge, [](double) {}).transmittance[0],
             expected);
    lit.level.reset();
    const double fine =
        rmse(LitPreview(sidecar, lit).draw(camera, kEdge, kEdge, [](double) {}).transmittance[0],
             expected);
    EXPECT_LT(fine, 0.02);
    EXPECT_LT(10 * fine, coarse);
}

TEST(Preview, TheScaleIsThatOfTheVolumeAlone) {
    const std::string vdb = fixtures::cloudFile(96);
    double expected = 0;
    for (const int size : {4, 16, 64}) {
        for (const ControlKind kind : {ControlKind::kConstant, ControlKind::kAffine}) {
            const std::string sidecar = fixtures::path("scale.track.vdb");
            fixtures::bake(vdb, sidecar, size, 2, kind);
            const double scale = trk::readSidecarHeader(sidecar).previewScale;
            expected = expected == 0 ? scale : expected;
            EXPECT_EQ(scale, expected);
        }
    }
    // A density k times as large shows at a scale k times as small; one that shows well, at 1.
    const auto scaleOf = [](float factor) {
        const auto grid = fixtures::makeBlob(40);
        for (auto it = grid->beginValueOn(); it; ++it) {
            it.setValue(factor * *it);
        }
        const trk::Density d = fixtures::load(fixtures::write("scaled.vdb", {grid}));
        return trk::previewScale(d.field, d.summary.indexToWorld);
    };
    const double thin = scaleOf(1e-6f);
    EXPECT_NEAR(scaleOf(1e-3f) * 1000, thin, 0.06 * thin);
    EXPECT_EQ(scaleOf(static_cast<float>(1e-6 * thin)), 1);
    EXPECT_LT(scaleOf(1e6f), 1e-3);
}

TEST(Preview, TheSunIsWhereItIsSaidToBe) {
    auto ball = fixtures::makeBlob(40);
    const std::string sidecar = fixtures::path("sunlit.track.vdb");
    fixtures::bake(fixtures::write("sunlit.vdb", {ball}), sidecar, 4, 0);
    // The side that faces the sun is brighter than the one that does not, wherever up and sun are.
    for (const auto up : {vdbtools::UpAxis::kY, vdbtools::UpAxis::kZ}) {
        for (const double azimuth : {0.0, 90.0, 200.0}) {
            vdbtools::LitOptions options = litOptions(0, 5);
            options.sun.up = up;
            options.sun.azimuth = azimuth;
            options.sun.elevation = 20;
            const LitPreview lit(sidecar, options);
            const double a = azimuth * 3.14159265358979323846 / 180;
            const trk::Vec3d sun =
                vdbtools::toWorld(up, {{std::sin(a), std::tan(0.35), std::cos(a)}});
            const trk::Vec3d centre = lit.box().centre();
            const auto brightness = [&](double side) {
                const auto camera = vdbtools::cameraAt(centre + side * 100 * sun, centre, 10, up);
                return lit.draw(camera, 5, 5, [](double) {}).light[0][12];
            };
            EXPECT_GT(brightness(1), 2 * brightness(-1));
        }
    }
}

TEST(Camera, LooksAtTheFrontWithEitherAxisUp) {
    const vdbtools::Camera y = vdbtools::namedView("front");
    EXPECT_EQ(y.forward[2], -1);
    EXPECT_EQ(y.up[1], 1);
    const vdbtools::Camera z = vdbtools::namedView("front", vdbtools::UpAxis::kZ);
    EXPECT_EQ(z.forward[1], 1);
    EXPECT_EQ(z.up[2], 1);
    EXPECT_EQ(z.right[0], 1);
    for (const std::string& view : vdbtools::viewNames()) {
        const vdbtools::Camera camera = vdbtools::namedView(view, vdbtools::UpAxis::kZ);
        EXPECT_GE(camera.up[2], 0) << view;
    }
}

TEST(Camera, ItsMapTakesRaysToMinusZ) {
    const vdbtools::Camera camera = vdbtools::cameraAt({{4, 6, -2}}, {{1, 2, 3}}, 40);
    const trk::AffineMap map = camera.worldToCamera();
    for (const double x : {0.1, 0.5, 0.8}) {
        for (const double y : {0.2, 0.5, 0.9}) {
            const TrkRay ray = camera.ray(x, y, 1.5);
            trk::Vec3d p;
            for (int a = 0; a < 3; ++a) {
                p[a] =
                    static_cast<double>(ray.origin[a]) + 7 * static_cast<double>(ray.direction[a]);
            }
            const trk::Vec3d c = map.point(p);
            EXPECT_NEAR(c[0] / -c[2] / (camera.tangent * 1.5), 2 * x - 1, 1e-5);
            EXPECT_NEAR(c[1] / -c[2] / camera.tangent, 1 - 2 * y, 1e-5);
        }
    }
}

TEST(Camera, AnOrbitKeepsTheDistanceAndComesBack) {
    const trk::Vec3d centre{{1, 2, 3}};
    const vdbtools::Camera camera = vdbtools::cameraAt({{4, 6, -2}}, centre, 40);
    const vdbtools::Camera half =
        camera.orbited(vdbtools::UpAxis::kY, centre, 3.14159265358979323846);
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
