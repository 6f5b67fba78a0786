// SPDX-License-Identifier: Apache-2.0
// The path tracer of `vdbtrack measure --scatter`: three ways of shadow rays, one picture.
#include "path_tracer.h"

#include "support/fixtures.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <string>

namespace {

using apps::Image;
using apps::Scattering;

apps::ScatterOptions smallScene(float scale) {
    apps::ScatterOptions options;
    options.vdb = fixtures::cloudFile(48);
    options.sidecar = fixtures::path("scatter.track.vdb");
    fixtures::bake(options.vdb, options.sidecar, 8, 0);
    options.scale = scale;
    options.color = {{1, 0.6f, 0.3f}};
    options.width = 24;
    options.samples = fixtures::kSanitized ? 4 : 16;
    return options;
}

Scattering render(const apps::ScatterOptions& options) {
    return apps::renderScattering(options, [](double) {});
}

/// The mean difference of two pictures in its standard errors, from how it varies over pixels.
double zOf(const Image& a, const Image& b) {
    double sum = 0;
    double squares = 0;
    double count = 0;
    for (size_t i = 0; i < a.pixelCount(); ++i) {
        double d = 0;
        for (const char* name : {"R", "G", "B"}) {
            d += static_cast<double>(a.channels.at(name)[i]) -
                 static_cast<double>(b.channels.at(name)[i]);
        }
        sum += d;
        squares += d * d;
        ++count;
    }
    return sum / std::sqrt(std::max(squares - sum * sum / count, 1e-30));
}

TEST(PathTracer, AllShadowRaysMakeOnePicture) {
    const Scattering scattering = render(smallScene(2));
    ASSERT_EQ(scattering.methods.size(), 3u);
    for (const apps::ScatterMethod& m : scattering.methods) {
        for (const apps::ScatterPicture* p : {&m.sameSamples, &m.equalLookups}) {
            EXPECT_LT(std::fabs(zOf(p->image, scattering.reference)), 4) << m.method;
            EXPECT_GT(p->rmse, p->shadowRmse) << m.method;
        }
    }
    // Less noise in the shadow rays, in the order of the methods.
    EXPECT_LT(scattering.methods[1].sameSamples.shadowRmse,
              scattering.methods[0].sameSamples.shadowRmse);
    EXPECT_LT(scattering.methods[2].sameSamples.shadowRmse,
              scattering.methods[1].sameSamples.shadowRmse);
    EXPECT_LT(scattering.methods[2].sameSamples.rmse, scattering.methods[0].sameSamples.rmse);
    // A volume with 1.3 times the extinction is another picture.
    const Scattering denser = render(smallScene(2.6f));
    EXPECT_GT(std::fabs(zOf(denser.reference, scattering.reference)), 6);
}

TEST(PathTracer, ThroughNothingIsTheSky) {
    const Scattering nothing = render(smallScene(0));
    for (const apps::ScatterMethod& m : nothing.methods) {
        EXPECT_EQ(m.shadowLookups, 0);
    }
    const std::vector<float>& blue = nothing.reference.channels.at("B");
    EXPECT_GT(*std::min_element(blue.begin(), blue.end()), 0.4f);
    EXPECT_LT(*std::max_element(blue.begin(), blue.end()), 0.48f);
}

TEST(PathTracer, ABadFileIsAnErrorWithItsName) {
    apps::ScatterOptions options = smallScene(1);
    options.vdb = "missing.vdb";
    try {
        render(options);
        FAIL() << "expected an error";
    } catch (const std::exception& e) {
        EXPECT_NE(std::string(e.what()).find("missing.vdb"), std::string::npos);
    }
}

}  // namespace
