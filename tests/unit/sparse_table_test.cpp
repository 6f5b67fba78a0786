// SPDX-License-Identifier: Apache-2.0
#include "field/table_builder.h"
#include "field/table_cursor.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <map>
#include <random>
#include <set>
#include <vector>

namespace {

using trk::Int3;
using trk::IntBox;
using trk::LocalRay;
using trk::SparseTable;
using trk::TableBuilder;
using trk::Vec3d;

IntBox cube(int64_t size) {
    return {{{0, 0, 0}}, {{size, size, size}}};
}

/// A table of items of 8^3 voxels, occupied by a hash of the position.
SparseTable randomTable(int64_t size) {
    return TableBuilder(3, cube(size))
        .fill(
            {}, [](const Int3&, int) { return std::nullopt; },
            [](const Int3& at) {
                const auto hash =
                    static_cast<uint64_t>(at[0] * 73856093 ^ at[1] * 19349663 ^ at[2] * 83492791);
                return hash % 3 == 0 ? static_cast<SparseTable::Entry>(1 + hash % 1000)
                                     : SparseTable::kEmpty;
            });
}

LocalRay makeRay(const Vec3d& origin, const Vec3d& direction, double tEnd) {
    LocalRay ray;
    const double norm = length(direction);
    ray.origin = origin;
    for (int a = 0; a < 3; ++a) {
        ray.direction[a] = direction[a] / norm;
        ray.inverse[a] = direction[a] == 0 ? 1e300 : 1 / ray.direction[a];
    }
    ray.tEnd = tEnd;
    return ray;
}

struct Segment {
    SparseTable::Entry entry;
    Int3 lo;
    int shift;
    double t0;
    double t1;
};

std::vector<Segment> segments(const SparseTable& table, const LocalRay& ray) {
    std::vector<Segment> result;
    table.walk(ray, 0, ray.tEnd,
               [&](SparseTable::Entry entry, const Int3& lo, int shift, double t0, double t1) {
                   result.push_back({entry, lo, shift, t0, t1});
                   return true;
               });
    return result;
}

TEST(SparseTable, FindsWhatWasFilled) {
    const SparseTable table = randomTable(200);
    size_t occupied = 0;
    table.forEach([&](const Int3& lo, int shift, SparseTable::Entry entry) {
        ++occupied;
        EXPECT_EQ(shift, 3);
        const auto found = table.find(lo[0] + 7, lo[1], lo[2] + 3);
        EXPECT_EQ(found.entry, entry);
    });
    EXPECT_GT(occupied, 1000u);
    EXPECT_EQ(table.find(-1, 0, 0).entry, SparseTable::kEmpty);
    EXPECT_EQ(table.find(0, 1 << 20, 0).entry, SparseTable::kEmpty);
}

TEST(SparseTable, FullTableCoversTheWholeInterval) {
    const SparseTable table =
        TableBuilder(3, cube(256))
            .fill(
                {}, [](const Int3&, int) { return std::nullopt; },
                [](const Int3& at) { return static_cast<SparseTable::Entry>(1 + at[0]); });
    std::mt19937_64 random(7);
    std::uniform_real_distribution<double> unit(0, 1);
    std::vector<LocalRay> rays;
    for (int i = 0; i < 300; ++i) {
        const Vec3d a{{256 * unit(random), 256 * unit(random), 256 * unit(random)}};
        const Vec3d b{{256 * unit(random), 256 * unit(random), 256 * unit(random)}};
        rays.push_back(makeRay(a, b - a, length(b - a)));
    }
    // Along faces, edges and through corners; zero and negative zero components; backwards.
    rays.push_back(makeRay({{0, 64, 64}}, {{1, 0, -0.0}}, 256));
    rays.push_back(makeRay({{256, 8, 8}}, {{-1, -0.0, 0}}, 256));
    rays.push_back(makeRay({{0, 0, 0}}, {{1, 1, 1}}, 256 * std::sqrt(3.0)));
    rays.push_back(makeRay({{256, 256, 256}}, {{-1, -1, -1}}, 256 * std::sqrt(3.0)));
    rays.push_back(makeRay({{0, 256, 128}}, {{1, -1, 0}}, 256 * std::sqrt(2.0)));
    rays.push_back(makeRay({{3, 3, 3}}, {{1, 1e-12, -1e-12}}, 200));
    for (const LocalRay& ray : rays) {
        const auto met = segments(table, ray);
        ASSERT_FALSE(met.empty());
        EXPECT_EQ(met.front().t0, 0);
        for (size_t i = 0; i < met.size(); ++i) {
            EXPECT_LT(met[i].t0, met[i].t1);
            if (i > 0) {
                EXPECT_EQ(met[i].t0, met[i - 1].t1);  // to the bit: abutting, no gap
            }
            const Vec3d middle = ray.at(0.5 * (met[i].t0 + met[i].t1));
            for (int a = 0; a < 3; ++a) {
                EXPECT_GE(middle[a], static_cast<double>(met[i].lo[static_cast<size_t>(a)]) - 1e-9);
                EXPECT_LE(middle[a],
                          static_cast<double>(met[i].lo[static_cast<size_t>(a)] + 8) + 1e-9);
            }
        }
        EXPECT_NEAR(met.back().t1, ray.tEnd, 1e-9);
    }
}

/// Nodes below nodes, links, tiles and empty regions of all sizes: items at random, in clusters and
/// alone, and boxes.
SparseTable deepTable(int64_t size, uint64_t seed) {
    TableBuilder table(3, cube(size));
    std::mt19937_64 random(seed);
    std::uniform_int_distribution<int64_t> place(0, size / 8 - 1);
    std::set<Int3> items;
    for (int cluster = 0; cluster < 40; ++cluster) {
        const Int3 at{{place(random), place(random), place(random)}};
        const int count = cluster % 2 == 0 ? 1 : 400;
        for (int i = 0; i < count; ++i) {
            Int3 item = at;
            for (int64_t& x : item) {
                x = std::min(x + static_cast<int64_t>(random() % 16), size / 8 - 1);
            }
            items.insert(item);
        }
    }
    std::vector<TableBuilder::Place> places;
    const IntBox box{{{size / 2, size / 4, 64}}, {{size / 2 + 1032, size / 4 + 512, 1064}}};
    table.addBox(box, 7, places);
    for (const Int3& item : items) {
        const Int3 lo{{8 * item[0], 8 * item[1], 8 * item[2]}};
        bool inside = true;
        for (size_t a = 0; a < 3; ++a) {
            inside = inside && lo[a] >= box.lo[a] && lo[a] < box.hi[a];
        }
        if (!inside) {
            places.push_back({lo, 3, static_cast<SparseTable::Entry>(1 + random() % 1000)});
        }
    }
    return table.assemble(places);
}

TEST(SparseTable, AWalkMeetsJustWhatIsFoundPointByPoint) {
    std::mt19937_64 random(5);
    for (const int64_t size : {256, 2048, 40000}) {
        const SparseTable table = deepTable(size, static_cast<uint64_t>(size));
        std::vector<Vec3d> targets;
        table.forEach([&](const Int3& lo, int, SparseTable::Entry) {
            targets.push_back({{static_cast<double>(lo[0]) + 4, static_cast<double>(lo[1]) + 4,
                                static_cast<double>(lo[2]) + 4}});
        });
        std::uniform_real_distribution<double> unit(0, static_cast<double>(size));
        size_t met = 0;
        for (int i = 0; i < 400; ++i) {
            // Through something, from the box's edge or from inside; every fourth along an axis.
            const Vec3d b = targets[random() % targets.size()];
            Vec3d a{{unit(random), unit(random), unit(random)}};
            if (i % 4 == 0) {
                a = b;
                a[i / 4 % 3] = i % 8 == 0 ? 0 : static_cast<double>(size);
            }
            const LocalRay ray = makeRay(a, b - a, 1.01 * length(b - a));
            const auto crossed = segments(table, ray);
            ASSERT_FALSE(crossed.empty());
            const auto find = [&](double t) {
                const Vec3d p = ray.at(t);
                return table.find(static_cast<int64_t>(std::floor(p[0])),
                                  static_cast<int64_t>(std::floor(p[1])),
                                  static_cast<int64_t>(std::floor(p[2])));
            };
            double last = 0;
            for (const Segment& s : crossed) {
                ASSERT_LE(last, s.t0);
                ASSERT_LT(s.t0, s.t1);
                if (s.t1 - s.t0 > 1e-9) {
                    const auto found = find(0.5 * (s.t0 + s.t1));
                    ASSERT_EQ(found.entry, s.entry);
                    ASSERT_EQ(found.shift, s.shift);
                }
                if (s.t0 - last > 1e-9) {
                    ASSERT_EQ(find(0.5 * (s.t0 + last)).entry, SparseTable::kEmpty);
                }
                last = s.t1;
                ++met;
            }
            if (ray.tEnd - last > 1e-9) {
                ASSERT_EQ(find(0.5 * (ray.tEnd + last)).entry, SparseTable::kEmpty);
            }
            for (int k = 0; k < 200; ++k) {  // what is found between is met
                const double t = ray.tEnd * (k + 0.5) / 200;
                const bool inside = std::any_of(
                    crossed.begin(), crossed.end(),
                    [&](const Segment& s) { return s.t0 - 1e-9 <= t && t <= s.t1 + 1e-9; });
                ASSERT_TRUE(inside || find(t).entry == SparseTable::kEmpty);
            }
        }
        EXPECT_GT(met, 2000u);
    }
}

TEST(SparseTable, FlattenedTablesAreWalkedAlike) {
    const SparseTable table = randomTable(200);
    const SparseTable flat = SparseTable(table).flattened();
    EXPECT_GT(table.depth(), 0);
    EXPECT_EQ(flat.depth(), 0);
    EXPECT_EQ(flat.occupiedItems(), table.occupiedItems());
    std::mt19937_64 random(11);
    std::uniform_real_distribution<double> unit(0, 200);
    size_t met = 0;
    for (int i = 0; i < 200; ++i) {
        const Vec3d a{{unit(random), unit(random), unit(random)}};
        const Vec3d b{{unit(random), unit(random), unit(random)}};
        const LocalRay ray = makeRay(a, b - a, length(b - a));
        const auto ofTable = segments(table, ray);
        const auto ofFlat = segments(flat, ray);
        ASSERT_EQ(ofFlat.size(), ofTable.size());
        for (size_t k = 0; k < ofFlat.size(); ++k, ++met) {
            ASSERT_EQ(ofFlat[k].entry, ofTable[k].entry);
            ASSERT_EQ(ofFlat[k].lo, ofTable[k].lo);
            ASSERT_NEAR(ofFlat[k].t0, ofTable[k].t0, 1e-10);
            ASSERT_NEAR(ofFlat[k].t1, ofTable[k].t1, 1e-10);
        }
    }
    EXPECT_GT(met, 1000u);
    // Where little of the box is occupied, that is not worth it.
    const SparseTable corners =
        TableBuilder(3, cube(256)).assemble({{{{0, 0, 0}}, 3, 1}, {{{248, 248, 248}}, 3, 2}});
    const SparseTable same = SparseTable(corners).flattened();
    EXPECT_EQ(same.depth(), corners.depth());
    EXPECT_EQ(same.find(250, 250, 250).entry, 2u);
}

TEST(SparseTable, WalkMeetsWhatDenseSamplingMeets) {
    const SparseTable table = randomTable(256);
    std::mt19937_64 random(3);
    std::uniform_real_distribution<double> unit(0, 256);
    for (int i = 0; i < 100; ++i) {
        const Vec3d a{{unit(random), unit(random), unit(random)}};
        const Vec3d b{{unit(random), unit(random), unit(random)}};
        const LocalRay ray = makeRay(a, b - a, length(b - a));
        double walked = 0;
        for (const Segment& s : segments(table, ray)) {
            walked += s.entry * (s.t1 - s.t0);
        }
        constexpr int kSteps = 20000;
        double sampled = 0;
        for (int k = 0; k < kSteps; ++k) {
            const Vec3d p = ray.at((k + 0.5) / kSteps * ray.tEnd);
            sampled += table
                           .find(static_cast<int64_t>(p[0]), static_cast<int64_t>(p[1]),
                                 static_cast<int64_t>(p[2]))
                           .entry;
        }
        sampled *= ray.tEnd / kSteps;
        EXPECT_NEAR(walked, sampled, 0.01 * sampled + 500 * ray.tEnd / kSteps * 30);
    }
}

TEST(SparseTable, CrossesAHugeGapInAFewSteps) {
    constexpr int64_t kFar = int64_t{1} << 31;
    int asked = 0;
    const SparseTable table =
        TableBuilder(3, cube(kFar + 8))
            .fill(
                {},
                [&](const Int3& at, int shift) -> std::optional<SparseTable::Entry> {
                    ++asked;
                    const int64_t size = int64_t{1} << shift;
                    const bool near = at[0] == 0 && at[1] == 0 && at[2] == 0;
                    const bool far = at[0] <= kFar && at[0] + size > kFar && at[1] <= kFar &&
                                     at[1] + size > kFar && at[2] <= kFar && at[2] + size > kFar;
                    return near || far ? std::nullopt : std::optional(SparseTable::kEmpty);
                },
                [](const Int3& at) { return at[0] == 0 ? 1u : 2u; });
    EXPECT_LT(asked, 100000);
    EXPECT_LT(table.bytes(), 500000u);
    const double half = 0.5 * std::sqrt(3.0);
    const auto met = segments(
        table, makeRay({{0, 0, 0}}, {{1, 1, 1}}, static_cast<double>(kFar) * 2 * half + 8));
    ASSERT_EQ(met.size(), 2u);
    EXPECT_EQ(met[0].entry, 1u);
    EXPECT_EQ(met[1].entry, 2u);
    EXPECT_NEAR(met[0].t1 - met[0].t0, 8 * std::sqrt(3.0), 1e-6);
}

/// Work and memory per lone item, of `count` that lie scattered over 2^31 voxels an axis.
struct Effort {
    double asked;  // questions that a derived table asks
    double given;  // regions of the table made from it by corners
    double bytes;
};
Effort effortOf(size_t count) {
    constexpr int64_t kWide = int64_t{1} << 31;
    std::mt19937_64 random(5);
    std::vector<TableBuilder::Place> places;
    for (size_t i = 0; i < count; ++i) {
        Int3 lo;
        for (int64_t& x : lo) {
            x = static_cast<int64_t>(random() % kWide) & ~int64_t{7};
        }
        places.push_back({lo, 3, static_cast<SparseTable::Entry>(i + 1)});
    }
    const SparseTable table = TableBuilder(3, cube(kWide)).assemble(places);
    for (const auto& place : places) {
        EXPECT_EQ(table.find(place.lo[0], place.lo[1], place.lo[2]).entry, place.entry);
    }
    EXPECT_EQ(table.occupiedItems(), count);
    const auto n = static_cast<double>(count);
    Effort effort{0, 0, static_cast<double>(table.bytes()) / n};
    const SparseTable coarse =
        TableBuilder(4, cube(kWide))
            .fill(
                {&table},
                [&](const Int3& at, int shift) {
                    ++effort.asked;
                    const auto entry = table.uniformEntry(at, shift);
                    return entry && *entry == SparseTable::kEmpty ? entry : std::nullopt;
                },
                [](const Int3&) { return 7u; });
    EXPECT_EQ(coarse.occupiedItems(), count);
    const SparseTable neighbours =
        TableBuilder(3, cube(kWide))
            .fillFrom(table, [&](const TableBuilder::Corners& corners, int) {
                ++effort.given;
                return std::optional(corners[0]);
            });
    EXPECT_EQ(neighbours.occupiedItems(), count);
    effort.asked /= n;
    effort.given /= n;
    return effort;
}

TEST(SparseTable, WorkGoesWithContentHoweverScattered) {
    for (const size_t count : {100u, 1000u, 10000u}) {
        const Effort effort = effortOf(count);
        // Of each level of the tree a few, and 32^3 regions of the root.
        EXPECT_LT(effort.asked, 50 + 70000.0 / static_cast<double>(count)) << count;
        EXPECT_LT(effort.given, 100) << count;
        EXPECT_LT(effort.bytes, 200 + 140000.0 / static_cast<double>(count) + 2100) << count;
    }
}

TEST(SparseTable, MappingCollapsesWhatBecameUniform) {
    const SparseTable table = randomTable(64);
    const SparseTable collapsed =
        TableBuilder::mapped(table, [](SparseTable::Entry) { return SparseTable::kEmpty; });
    size_t occupied = 0;
    collapsed.forEach([&](const Int3&, int, SparseTable::Entry) { ++occupied; });
    EXPECT_EQ(occupied, 0u);
    EXPECT_LT(collapsed.bytes(), table.bytes());
    EXPECT_TRUE(collapsed.uniformEntry({{0, 0, 0}}, 6).has_value());
    EXPECT_FALSE(table.uniformEntry({{0, 0, 0}}, 6).has_value());
}

}  // namespace
