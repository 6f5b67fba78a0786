// SPDX-License-Identifier: Apache-2.0
// Combs of look-ups along a line, against the same look-ups one by one.
#include "field/density_field.h"
#include "space/local_ray.h"
#include "support/fixtures.h"

#include <gtest/gtest.h>

#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <random>
#include <string>

namespace {

trk::LocalRay randomRay(const trk::IntBox& box, std::mt19937& random) {
    std::uniform_real_distribution<double> unit(0, 1);
    trk::LocalRay ray{};
    trk::Vec3d to;
    for (int a = 0; a < 3; ++a) {
        const auto axis = static_cast<size_t>(a);
        const auto at = [&](double share) {
            return static_cast<double>(box.lo[axis]) +
                   share * static_cast<double>(box.hi[axis] - box.lo[axis]);
        };
        ray.origin[a] = at(unit(random));
        to[a] = at(unit(random));
    }
    // One in three along an axis, at whole coordinates: where cells and bricks meet.
    const int axis = static_cast<int>(random() % 9);
    for (int a = 0; a < 3 && axis < 3; ++a) {
        ray.origin[a] = std::round(ray.origin[a]);
        to[a] = a == axis ? to[a] : ray.origin[a];
    }
    ray.direction = to - ray.origin;
    ray.tEnd = length(ray.direction);
    for (int a = 0; a < 3; ++a) {
        ray.direction[a] /= ray.tEnd;
        ray.inverse[a] = ray.direction[a] == 0 ? 1e300 : 1 / ray.direction[a];
    }
    return ray;
}

template <size_t C>
void expectTheSame(const trk::DensityField& field) {
    std::mt19937 random(3);
    std::uniform_real_distribution<double> unit(0, 1);
    size_t looked = 0;
    for (int i = 0; i < 500; ++i) {
        const trk::LocalRay ray = randomRay(field.box(), random);
        const double points = std::ceil(ray.tEnd * std::exp2(3 - 6 * unit(random)));
        const double offsets[3] = {unit(random), unit(random), 0};
        for (const trk::Kernel kernel : {trk::Kernel::kBaseline, trk::Kernel::kAvx2}) {
            if (!trk::hasKernel(kernel)) {
                continue;
            }
            std::array<double, C> sums[3] = {};
            const uint64_t count =
                field.addSamples<C>(ray, 0, ray.tEnd, kernel, points, offsets, 3, sums);
            std::array<double, C> expected[3] = {};
            for (size_t j = 0; j < 3; ++j) {
                for (double k = 0; k < points; ++k) {
                    const auto density =
                        field.density<C>(ray.at((k + offsets[j]) * (ray.tEnd / points)));
                    for (size_t c = 0; c < C; ++c) {
                        expected[j][c] += static_cast<double>(density[c]);
                    }
                }
                for (size_t c = 0; c < C; ++c) {
                    EXPECT_NEAR(sums[j][c], expected[j][c], 4e-6 * (1 + expected[j][c]));
                }
            }
            EXPECT_LE(static_cast<double>(count), 3 * points);
            looked += count;
        }
    }
    EXPECT_GT(looked, 10000u);
}

TEST(LineSamples, AreTheDensityAtTheirPoints) {
    openvdb::initialize();
    const auto load = [](const openvdb::GridBase::Ptr& grid, const char* name) {
        return fixtures::load(fixtures::write(name, {grid}));
    };
    const auto blob = fixtures::makeBlob(50);
    blob->tree().addTile(1, openvdb::Coord(64, 0, 0), 0.25f, true);
    const trk::Density floats = load(blob, "line_floats.vdb");
    EXPECT_FALSE(floats.field.isHalf());
    expectTheSame<1>(floats.field);
    const trk::Density halfs =
        load(fixtures::makeGrid(openvdb::CoordBBox(0, 0, 0, 40, 40, 40),
                                [](const openvdb::Coord& p) {
                                    return static_cast<float>((p[0] * p[1] + p[2]) % 17) * 0.125f;
                                }),
             "line_halfs.vdb");
    EXPECT_TRUE(halfs.field.isHalf());
    expectTheSame<1>(halfs.field);
    expectTheSame<3>(load(fixtures::makeColorGrid(openvdb::CoordBBox(0, 0, 0, 40, 40, 40),
                                                  [](const openvdb::Coord& p) {
                                                      const auto x = static_cast<float>(p[0]);
                                                      return openvdb::Vec3f(
                                                          x, 0.1f * x * x,
                                                          static_cast<float>(p[1] + p[2]));
                                                  }),
                          "line_colours.vdb")
                         .field);
}

}  // namespace
