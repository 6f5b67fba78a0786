// SPDX-License-Identifier: Apache-2.0
// Controls that vary within a super-voxel: their fits, their closed forms, their bounds.
#include "bake/bake.h"
#include "bake/control_fit.h"
#include "control/control_choice.h"
#include "estimate/plan.h"
#include "query/variant.h"
#include "support/fixtures.h"
#include "support/rays.h"

#include <gtest/gtest.h>

#include <cmath>
#include <limits>
#include <map>
#include <random>
#include <vector>

namespace {

using openvdb::Coord;
using openvdb::CoordBBox;
using trk::BakedVolume;
using trk::ControlKind;
using trk::Int3;
using trk::SparseTable;
using trk::Vec3d;

const std::vector<ControlKind> kVarying{ControlKind::kTrilinear, ControlKind::kAffine};

/// The definition of corner moments: sums over vertices, weighed by the part inside.
template <class F>
trk::CornerMoments momentsOf(const Int3& cell, int size, const F& f) {
    trk::CornerMoments moments{};
    for (int i = 0; i < (size + 1) * (size + 1) * (size + 1); ++i) {
        const int at[3] = {i / ((size + 1) * (size + 1)), i / (size + 1) % (size + 1),
                           i % (size + 1)};
        double weight = 1;
        for (const int x : at) {
            weight *= x == 0 || x == size ? 0.5 : 1;
        }
        const double value = f(static_cast<double>(cell[0] * size + at[0]),
                               static_cast<double>(cell[1] * size + at[1]),
                               static_cast<double>(cell[2] * size + at[2]));
        for (size_t corner = 0; corner < 8; ++corner) {
            double hat = 1;
            for (size_t a = 0; a < 3; ++a) {
                const double x = static_cast<double>(at[a]) / size;
                hat *= corner >> (2 - a) & 1 ? x : 1 - x;
            }
            moments[corner] += weight * hat * value / std::pow(size, 3);
        }
    }
    return moments;
}

double ulps(double found, double expected) {
    const auto e = static_cast<float>(expected);
    const double ulp =
        static_cast<double>(std::nextafter(e, std::numeric_limits<float>::infinity())) -
        static_cast<double>(e);
    return std::fabs(found - expected) / ulp;
}

TEST(ControlFit, AnUnboundedRampLeavesAtMostEightUlp) {
    const auto ramp = [](double x, double y, double z) {
        return 0.5 + 0.003 * x + 0.011 * y - 0.0007 * z;
    };
    for (const int size : {4, 8, 16, 32}) {
        std::vector<Int3> places;
        for (int64_t i = 0; i < 125; ++i) {
            places.push_back({{i / 25, i / 5 % 5, i % 5}});
        }
        std::vector<trk::CornerMoments> moments;
        for (const Int3& place : places) {
            moments.push_back(momentsOf(place, size, ramp));
        }
        std::vector<trk::CornerFit::Cell> cells;
        for (size_t i = 0; i < places.size(); ++i) {
            cells.push_back({places[i], &moments[i], 1e30});
        }
        const trk::CornerFit fit(
            cells, [](const Int3&) { return std::nullopt; }, size);
        for (size_t i = 0; i < places.size(); ++i) {
            std::array<float, 8> corners{};
            for (size_t k = 0; k < 8; ++k) {
                corners[k] = fit.value({{places[i][0] + static_cast<int64_t>(k >> 2),
                                         places[i][1] + static_cast<int64_t>(k >> 1 & 1),
                                         places[i][2] + static_cast<int64_t>(k & 1)}});
            }
            const auto trilinear =
                trk::controlPolynomial(ControlKind::kTrilinear, 0, corners.data(), size);
            double mean = 0;
            for (const double m : moments[i]) {
                mean += m;
            }
            const auto gradient =
                trk::constrainGradient(trk::fitGradient(moments[i], size).data(), mean, size);
            const auto affine = trk::controlPolynomial(
                ControlKind::kAffine, static_cast<float>(mean), gradient.data(), size);
            for (int v = 0; v < 27; ++v) {
                const Vec3d u{{0.5 * (v / 9) - 0.5, 0.5 * (v / 3 % 3) - 0.5, 0.5 * (v % 3) - 0.5}};
                const auto place = [&](int a) {
                    return (static_cast<double>(places[i][static_cast<size_t>(a)]) + u[a] + 0.5) *
                           size;
                };
                const double expected = ramp(place(0), place(1), place(2));
                EXPECT_LE(ulps(trilinear.at(u), expected), 8);
                EXPECT_LE(ulps(affine.at(u), expected), 8);
            }
        }
    }
}

/// Residual RMS of a bake over the super-voxels that `inside(index)` names.
template <class Inside>
double residualRms(const BakedVolume& baked, const Int3& anchor, const Inside& inside) {
    double squares = 0;
    double count = 0;
    baked.table.forEach([&](const Int3& lo, int shift, SparseTable::Entry entry) {
        Int3 index;
        for (size_t a = 0; a < 3; ++a) {
            index[a] = (lo[a] + anchor[a]) >> baked.superVoxelShift;
        }
        if (inside(index)) {
            const double n = std::pow(8, shift - baked.superVoxelShift);
            const double rms = static_cast<double>(baked.items[SparseTable::index(entry)].rms);
            squares += n * rms * rms;
            count += n;
        }
    });
    EXPECT_GT(count, 0);
    return std::sqrt(squares / count);
}

TEST(ControlFit, TheInteriorOfABoundedRampFitsTenTimesBetter) {
    constexpr int kSize = 4;
    constexpr int kEdge = 17;  // super-voxels
    const auto grid =
        fixtures::makeGrid(CoordBBox(Coord(1), Coord(kSize * kEdge - 1)), [](const Coord& p) {
            return static_cast<float>(0.1 + 0.004 * p.x() + 0.002 * p.y() + 0.003 * p.z());
        });
    const trk::Density d = fixtures::load(fixtures::write("ramp.vdb", {grid}));
    // The fit rings where the ramp ends, and each super-voxel on the way in takes a quarter of it.
    const auto interior = [](const Int3& index) {
        return std::all_of(index.begin(), index.end(),
                           [](int64_t i) { return i >= 6 && i < kEdge - 6; });
    };
    const auto rmsOf = [&](ControlKind kind) {
        return residualRms(trk::bake(d.field, fixtures::bakeOptions(kSize, 0, kind)),
                           d.summary.anchor, interior);
    };
    const double constant = rmsOf(ControlKind::kConstant);
    EXPECT_GT(constant, 0.005);
    EXPECT_LE(rmsOf(ControlKind::kTrilinear), 0.1 * constant);
    EXPECT_LE(rmsOf(ControlKind::kAffine), 0.1 * constant);
}

TEST(ControlFit, AGaussianIsNeverFittedWorseThanByConstants) {
    for (const int size : {4, 8}) {
        const double sigma = 2 * size;
        const int reach = 8 * size;
        const auto grid =
            fixtures::makeGrid(CoordBBox(Coord(-reach), Coord(reach)), [&](const Coord& p) {
                const double r2 = p.x() * p.x() + p.y() * p.y() + p.z() * p.z();
                const double v = std::exp(-r2 / (2 * sigma * sigma));
                return v > 1e-3 ? static_cast<float>(v) : 0.0f;
            });
        const trk::Density d = fixtures::load(fixtures::write("gaussian.vdb", {grid}));
        for (const ControlKind kind : kVarying) {
            const trk::ControlFit fit =
                trk::measureFit(trk::bake(d.field, fixtures::bakeOptions(size, 0, kind)));
            EXPECT_LE(fit.residualRms, fit.constantRms) << size << trk::controlName(kind);
            EXPECT_NEAR(fit.massRatio, 1, 0.01);
        }
    }
}

/// Corner values by corner, and for each whether a super-voxel that touches it is empty.
TEST(ControlFit, TrilinearCornersAreContinuousNotNegativeAndZeroBesideNothing) {
    const trk::Density d = fixtures::load(fixtures::cloudFile(96));
    for (const int size : {4, 8, 16}) {
        const BakedVolume baked =
            trk::bake(d.field, fixtures::bakeOptions(size, 0, ControlKind::kTrilinear));
        std::map<Int3, float> values;
        baked.table.forEach([&](const Int3& lo, int shift, SparseTable::Entry entry) {
            for (int64_t corner = 0; corner < 8 && shift == baked.superVoxelShift; ++corner) {
                const Int3 at{{lo[0] + (corner >> 2) * size, lo[1] + (corner >> 1 & 1) * size,
                               lo[2] + (corner & 1) * size}};
                const float value =
                    baked.shape(SparseTable::index(entry))[static_cast<size_t>(corner)];
                EXPECT_GE(value, 0);
                EXPECT_EQ(values.try_emplace(at, value).first->second, value);
            }
        });
        size_t besideNothing = 0;
        for (const auto& [at, value] : values) {
            for (int64_t cell = 0; cell < 8; ++cell) {
                const auto entry =
                    baked.table
                        .find(at[0] - (cell >> 2), at[1] - (cell >> 1 & 1), at[2] - (cell & 1))
                        .entry;
                if (entry == SparseTable::kEmpty) {
                    ++besideNothing;
                    EXPECT_EQ(value, 0);
                }
            }
        }
        EXPECT_GT(besideNothing, 100u);
        EXPECT_NEAR(trk::measureFit(baked).massRatio, 1, 0.01);
    }
}

TEST(ControlFit, MassStaysWhereItWas) {
    // Thin sheets far from a ball: all their corners touch nothing, so a trilinear control loses
    // them, and the ball must not be given what they lose.
    auto grid = fixtures::makeBlob(48);
    for (int sheet = 1; sheet <= 12; ++sheet) {
        grid->fill(CoordBBox(Coord(400, 40 * sheet + 3, 0), Coord(463, 40 * sheet + 5, 63)), 5.0f);
    }
    grid->tree().voxelizeActiveTiles();
    const trk::Density d = fixtures::load(fixtures::write("sheets.vdb", {grid}));
    const BakedVolume baked =
        trk::bake(d.field, fixtures::bakeOptions(8, 0, ControlKind::kTrilinear));
    EXPECT_LT(trk::measureFit(baked).massRatio, 0.5);
    double mass[2] = {0, 0};
    baked.table.forEach([&](const Int3& lo, int, SparseTable::Entry entry) {
        const size_t item = SparseTable::index(entry);
        if (lo[0] + d.summary.anchor[0] < 200) {
            mass[0] += baked.control(item).centre;
            mass[1] += static_cast<double>(baked.items[item].mean);
        }
        for (int64_t corner = 0; corner < 8; ++corner) {
            float largest = 0;  // of the super-voxels around
            for (int64_t cell = 0; cell < 8; ++cell) {
                const auto other = baked.table
                                       .find(lo[0] + 8 * (corner >> 2) - (cell >> 2),
                                             lo[1] + 8 * (corner >> 1 & 1) - (cell >> 1 & 1),
                                             lo[2] + 8 * (corner & 1) - (cell & 1))
                                       .entry;
                if (other != SparseTable::kEmpty) {
                    largest = std::max(largest, baked.items[SparseTable::index(other)].max);
                }
            }
            EXPECT_LE(baked.shape(item)[corner], 2 * largest);
        }
    });
    EXPECT_NEAR(mass[0] / mass[1], 1, 0.01);
}

TEST(ControlFit, AffineControlsAreNotNegative) {
    const trk::Density d = fixtures::load(fixtures::cloudFile(96));
    for (const int size : {4, 16}) {
        const BakedVolume baked =
            trk::bake(d.field, fixtures::bakeOptions(size, 0, ControlKind::kAffine));
        size_t sloped = 0;
        size_t touching = 0;
        for (size_t i = 0; i < baked.items.size(); ++i) {
            const auto control = baked.control(i);
            const double mean = static_cast<double>(baked.items[i].mean);
            EXPECT_EQ(control.centre, mean);
            double least = mean;
            for (int corner = 0; corner < 8; ++corner) {
                least =
                    std::min(least, control.at({{corner & 4 ? 0.5 : -0.5, corner & 2 ? 0.5 : -0.5,
                                                 corner & 1 ? 0.5 : -0.5}}));
            }
            EXPECT_GE(least, -1e-7 * mean);
            sloped += least < mean ? 1 : 0;
            touching += least < 1e-6 * mean ? 1 : 0;
        }
        EXPECT_GT(sloped, baked.items.size() / 2);
        EXPECT_GT(touching, 0u);  // the constraint is met where it binds, not avoided
    }
}

trk::Volume openWith(const std::string& vdb, ControlKind kind, int size, TrkChoice choice,
                     float scale, const std::array<float, 3>& color = {{1, 1, 1}}) {
    const std::string sidecar = fixtures::path("control.track.vdb");
    fixtures::bake(vdb, sidecar, size, 2, kind);
    trk::VolumeOptions options;
    options.scale = scale;
    options.choice = choice;
    options.color = color;
    return trk::openVolume(vdb.c_str(), sidecar.c_str(), options);
}

std::vector<trk::LocalRay> localRays(const trk::Volume& volume, size_t count) {
    rays::Box box{};
    trk::worldBounds(volume.indexToWorld, volume.anchor, volume.field->box(), box.lo, box.hi);
    std::vector<trk::LocalRay> result;
    for (const TrkRay& ray : rays::through(box, count, 30, 5)) {
        if (const auto clipped = volume.clip(ray, volume.field->box())) {
            result.push_back(clipped->local);
        }
    }
    return result;
}

TEST(Control, ClosedFormsAreTheIntegralsOfWhatCollisionsSee) {
    const std::string vdb = fixtures::cloudFile(64, "color-cloud");
    for (const ControlKind kind : kVarying) {
        const trk::Volume volume = openWith(vdb, kind, 8, TRK_CHOICE_ROBUST, 40, {{1, 2, 0.5f}});
        trk::withVariant(volume, volume.superVoxels->kind(), [&](auto variant) {
            using V = decltype(variant);
            double largest = 0;
            double kept = 0;  // optical depth of the chosen control, less than the baked one's
            double baked = 0;
            for (const trk::LocalRay& ray : localRays(volume, 60)) {
                trk::forEachStretch<trk::Control::kChosen>(
                    typename V::Walk(volume), ray, {}, [&](const auto& plan, size_t i) {
                        const double t0 = plan.tEnter(i);
                        const double t1 = plan.tExit(i);
                        for (size_t c = 0; c < V::kChannels; ++c) {
                            double sum = 0;  // Simpson's rule: exact for cubics
                            for (const auto& [t, weight] :
                                 {std::pair{t0, 1.0 / 6}, std::pair{0.5 * (t0 + t1), 4.0 / 6},
                                  std::pair{t1, 1.0 / 6}}) {
                                sum += weight * (t1 - t0) * plan.control(i, c, ray.at(t));
                            }
                            EXPECT_NEAR(plan.depth(i, c), sum,
                                        1e-9 * plan.max(i, c) * (t1 - t0) + 1e-12);
                            largest = std::max(largest, sum);
                            kept += plan.depth(i, c);
                        }
                    });
                uint64_t ignored = 0;
                for (const double whole : V::integrateControl(volume, ray, 0, ignored)) {
                    baked += whole;
                }
            }
            EXPECT_GT(largest, 0);
            EXPECT_LT(kept, baked);
            EXPECT_GT(kept, 0);
        });
    }
}

TEST(Control, BoundsHoldForEveryChoiceKindAndChannel) {
    // A ramp that an affine control fits to the bit, but for the rounding of whoever evaluates it.
    const auto ramp = fixtures::makeGrid(CoordBBox(Coord(1), Coord(31)), [](const Coord& p) {
        return 0.25f + static_cast<float>(p.x() + 2 * p.y() + p.z()) / 64;
    });
    for (const std::string& file : {fixtures::cloudFile(64), fixtures::cloudFile(64, "color-cloud"),
                                    fixtures::write("dyadic.vdb", {ramp})}) {
        for (const ControlKind kind : kVarying) {
            for (const TrkChoice choice : {TRK_CHOICE_ROBUST, TRK_CHOICE_MEAN}) {
                const trk::Volume volume = openWith(file, kind, 8, choice, 20, {{1, 3, 0.25f}});
                trk::withVariant(volume, volume.superVoxels->kind(), [&](auto variant) {
                    using V = decltype(variant);
                    const typename V::Extinction field(volume);
                    for (const trk::LocalRay& ray : localRays(volume, 80)) {
                        trk::forEachStretch<trk::Control::kChosen>(
                            typename V::Walk(volume), ray, {}, [&](const auto& plan, size_t i) {
                                for (const double f : {0.01, 0.3, 0.5, 0.77, 0.99}) {
                                    const Vec3d p = ray.at(plan.tEnter(i) + f * plan.length(i));
                                    const auto extinction = field.extinction(p);
                                    for (size_t c = 0; c < V::kChannels; ++c) {
                                        const double residual =
                                            extinction[c] - plan.control(i, c, p);
                                        EXPECT_LE(std::fabs(residual), plan.bound(i, c));
                                    }
                                }
                            });
                    }
                });
            }
        }
    }
}

// Look-ups interpolate in float, and leave the range of their corners by its rounding.
TEST(Control, BoundsOfConstantControlsCoverWhatLookUpsReturn) {
    std::mt19937_64 random(11);
    std::uniform_real_distribution<float> value(1e-3f, 1.7f);
    // One largest value, looked up next to it from others: their difference has been rounded.
    const auto grid = fixtures::makeGrid(CoordBBox(Coord(0), Coord(47)), [&](const Coord&) {
        const float v = value(random);
        return v > 1 ? 1.7f : v;
    });
    const std::string vdb = fixtures::write("adversarial.vdb", {grid});
    const trk::Density density = fixtures::load(vdb);
    const trk::BakedVolume baked = trk::bake(density.field, fixtures::bakeOptions(4, 0));
    size_t outside = 0;  // of what was baked, which is of the corners
    for (const TrkChoice choice :
         {TRK_CHOICE_ROBUST, TRK_CHOICE_MEAN, TRK_CHOICE_MIN, TRK_CHOICE_MAX}) {
        const trk::Volume volume = openWith(vdb, ControlKind::kConstant, 4, choice, 1);
        using V = trk::Variant<1, 1, ControlKind::kConstant>;
        const V::Extinction field(volume);
        std::uniform_int_distribution<int> voxel(0, 46);
        std::uniform_int_distribution<int> bits(18, 40);
        for (int i = 0; i < 200000; ++i) {
            Vec3d p;
            for (int a = 0; a < 3; ++a) {
                p[a] = voxel(random) - static_cast<double>(volume.anchor[static_cast<size_t>(a)]) +
                       1 - std::ldexp(1.0, -bits(random));
            }
            const trk::LocalRay ray{p, {{1, 0, 0}}, {{1, 1e300, 1e300}}, 1e-9};
            const double mu = field.extinction(p)[0];
            size_t met = 0;
            trk::forEachStretch<trk::Control::kChosen>(
                V::Walk(volume), ray, {}, [&](const auto& plan, size_t k) {
                    if (met++ == 0) {
                        EXPECT_GE(mu, plan.min(k, 0));
                        EXPECT_LE(mu, plan.max(k, 0));
                        EXPECT_LE(std::fabs(mu - plan.control(k, 0, p)), plan.bound(k, 0));
                    }
                });
            const auto found = baked.table.find(
                static_cast<int64_t>(p[0]), static_cast<int64_t>(p[1]), static_cast<int64_t>(p[2]));
            const auto& item = baked.items[trk::SparseTable::index(found.entry)];
            outside +=
                mu < static_cast<double>(item.min) || mu > static_cast<double>(item.max) ? 1 : 0;
        }
    }
    EXPECT_GT(outside, 100u);
}

TEST(Control, RobustKeepsWhatIsThinAndTakesTheMinimumOfWhatIsThick) {
    const auto share = [](TrkChoice choice, double min, double max, double excess,
                          double diagonal) {
        double kept = 0;
        trk::ControlChoice{choice, diagonal}.takeShare(min, max, excess, kept);
        return kept;
    };
    // At most ln 2 collisions in which the control exceeds the extinction by all of the range.
    EXPECT_EQ(share(TRK_CHOICE_ROBUST, 0, 1, 0.8, 0.5), 1);
    EXPECT_LT(share(TRK_CHOICE_ROBUST, 0, 1, 0.8, 100), 0.01);
    EXPECT_EQ(share(TRK_CHOICE_MEAN, 0, 1, 0.8, 100), 1);
    EXPECT_EQ(share(TRK_CHOICE_ROBUST, 1, 1, 0, 100), 1);
    for (const double diagonal : {1e-12, 1.0, 1e12}) {
        const double kept = share(TRK_CHOICE_ROBUST, 0, 1e30, 1e20, diagonal);
        EXPECT_GE(kept, 0);
        EXPECT_LE(kept, 1);
    }
    // Where nothing is hit, the weight is exp(excess x length): never more than e, however far a
    // fit exceeds the density.
    for (const double diagonal : {1e-3, 0.1, 1.0, 10.0, 1e3}) {
        for (const double excess : {0.1, 1.0, 50.0, 1e6}) {
            const double kept = share(TRK_CHOICE_ROBUST, 0, 1, excess, diagonal);
            EXPECT_LE(diagonal * kept * excess, 1 + 1e-12);
        }
    }
}

TEST(Bake, VaryingControlsHaveTheSameBitsForTilesAndThreads) {
    auto grid = fixtures::makeBlob(45);
    grid->tree().addTile(1, Coord(16, 16, 16), 0.5f, true);
    grid->tree().addTile(2, Coord(-128, 0, 0), 0.1f, true);
    const trk::Density tiled = fixtures::load(fixtures::write("tiled-v.vdb", {grid}));
    grid->tree().voxelizeActiveTiles();
    const trk::Density filled = fixtures::load(fixtures::write("filled-v.vdb", {grid}));
    for (const ControlKind kind : kVarying) {
        for (const int size : {4, 8, 32}) {
            const auto options = fixtures::bakeOptions(size, 1, kind);
            const BakedVolume a = trk::bake(tiled.field, options);
            const BakedVolume b = trk::bake(filled.field, options);
            const Int3 shift{{tiled.summary.anchor[0] - filled.summary.anchor[0],
                              tiled.summary.anchor[1] - filled.summary.anchor[1],
                              tiled.summary.anchor[2] - filled.summary.anchor[2]}};
            ASSERT_EQ(a.table.occupiedItems(), b.table.occupiedItems());
            a.table.forEach([&](const Int3& lo, int, SparseTable::Entry entry) {
                const auto other =
                    b.table.find(lo[0] + shift[0], lo[1] + shift[1], lo[2] + shift[2]).entry;
                ASSERT_NE(other, SparseTable::kEmpty);
                const size_t i = SparseTable::index(entry);
                const size_t j = SparseTable::index(other);
                EXPECT_EQ(a.items[i].majorant, b.items[j].majorant);
                EXPECT_EQ(a.items[i].rms, b.items[j].rms);
                for (size_t k = 0; k < trk::shapeSize(kind); ++k) {
                    EXPECT_EQ(a.shape(i)[k], b.shape(j)[k]);
                }
            });
        }
    }
}

TEST(Bake, EqualSuperVoxelsThatVaryAreNotMergedIntoTiles) {
    // A pattern that repeats in every super-voxel: 512 equal ones make a node.
    const auto grid = fixtures::makeGrid(CoordBBox(Coord(0), Coord(127)), [](const Coord& p) {
        return 1.0f + 0.25f * static_cast<float>(p.x() & 3) + 0.01f * static_cast<float>(p.y() & 3);
    });
    const std::string vdb = fixtures::write("pattern.vdb", {grid});
    for (const ControlKind kind : kVarying) {
        const trk::Volume volume = openWith(vdb, kind, 4, TRK_CHOICE_MEAN, 1);
        trk::withVariant(volume, volume.superVoxels->kind(), [&](auto variant) {
            using V = decltype(variant);
            const typename V::Extinction field(volume);
            size_t met = 0;
            for (const trk::LocalRay& ray : localRays(volume, 50)) {
                trk::forEachStretch<trk::Control::kChosen>(
                    typename V::Walk(volume), ray, {}, [&](const auto& plan, size_t i) {
                        const Vec3d p = ray.at(0.5 * (plan.tEnter(i) + plan.tExit(i)));
                        const double residual = field.extinction(p)[0] - plan.control(i, 0, p);
                        EXPECT_LE(plan.length(i), 4 * std::sqrt(3) + 1e-9);
                        EXPECT_LE(std::fabs(residual), plan.bound(i, 0) + 1e-5);
                        ++met;
                    });
            }
            EXPECT_GT(met, 100u);
        });
    }
}

}  // namespace
