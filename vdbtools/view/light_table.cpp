// SPDX-License-Identifier: Apache-2.0
#include "light_table.h"

#include "field/density_field.h"
#include "field/table_builder.h"
#include "parallel.h"
#include "query/variant.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <optional>

namespace vdbtools {

using trk::DensityField;
using trk::Int3;
using trk::SparseTable;
using trk::Vec3d;

namespace {

using Color = std::array<double, 3>;

// A clear late afternoon. Radiances are relative; a white surface in the sun would be about 1.
constexpr Color kSun{{0.98, 0.89, 0.74}};  // already over 4 pi, the isotropic phase function
constexpr Color kZenith{{0.30, 0.48, 0.86}};
constexpr Color kHorizon{{0.62, 0.72, 0.84}};
constexpr Color kGround{{0.24, 0.21, 0.18}};
constexpr int kSkyDirections = 20;
constexpr int kSunDirections = 5;
constexpr double kSunRadius = 5;  // degrees
// In super-voxels. A place's own super-voxel is left out of its shadow: the light is tabulated
// where the interpolated control is largest, and would show the grid of those places as dark dots.
constexpr double kShadowStart = 1;
constexpr int kShadowSteps = 1;
constexpr double kShadowSpread = 1.5;
// Along the longest side of what is drawn, places of which the light is computed: light varies less
// than density, and a volume of more cells has cells the size of a pixel.
constexpr int64_t kMostPlaces = 128;

/// `height`: of a direction of unit length.
Color skyRadiance(double height) {
    Color radiance;
    for (size_t k = 0; k < 3; ++k) {
        radiance[k] =
            height < 0 ? kGround[k] : kHorizon[k] + (kZenith[k] - kHorizon[k]) * std::sqrt(height);
    }
    return radiance;
}

/// One of `count` directions spread evenly over the sphere.
Vec3d spreadDirection(int i, int count) {
    const double y = 1 - (2 * i + 1.0) / count;
    const double angle = 2.39996322972865332 * i;  // the golden angle
    const double r = std::sqrt(1 - y * y);
    return {{r * std::cos(angle), y, r * std::sin(angle)}};
}

/// Light from one direction.
struct Source {
    Vec3d towards;  ///< world space
    Vec3d offset;   ///< index space, of where its shadow is looked for
    Color radiance;
};

/// The sun, and the sky as directions spread evenly over the sphere.
std::vector<Source> makeSources(const Sun& sun) {
    constexpr double kDegree = 3.14159265358979323846 / 180;
    std::vector<Source> list;
    // A wide sun, as several directions, and each of all directions from a place of its own around
    // the one that light is computed for: from that alone, shadows would show the grid of those
    // places.
    const auto add = [&](const Vec3d& towards, const Vec3d& offset, Color radiance, int count) {
        for (double& c : radiance) {
            c /= count;
        }
        list.push_back({toWorld(sun.up, towards), kShadowSpread * offset, radiance});
    };
    for (int i = 0; i < kSunDirections; ++i) {
        const double turn = 2 * kDegree * 180 * i / kSunDirections;
        const double azimuth = kDegree * (sun.azimuth + kSunRadius * std::cos(turn));
        const double elevation = kDegree * (sun.elevation + kSunRadius * std::sin(turn));
        add({{std::cos(elevation) * std::sin(azimuth), std::sin(elevation),
              std::cos(elevation) * std::cos(azimuth)}},
            spreadDirection(i, kSunDirections), kSun, kSunDirections);
    }
    for (int i = 0; i < kSkyDirections; ++i) {
        const Vec3d towards = spreadDirection(i, kSkyDirections);
        add(towards, spreadDirection((7 * i) % kSkyDirections, kSkyDirections),
            skyRadiance(towards[1]), kSkyDirections);
    }
    return list;
}

/// All light that arrives at a place, through what of the volume is in its way.
Light lightArrivingAt(const Vec3d& local, const trk::Volume& volume,
                      const std::vector<Source>& sources) {
    Vec3d index = local;
    for (int a = 0; a < 3; ++a) {
        index[a] += static_cast<double>(volume.anchor[static_cast<size_t>(a)]);
    }
    Color sum{};
    trk::withVariant(volume, trk::ControlKind::kConstant, [&](auto variant) {
        using V = decltype(variant);
        const typename V::Extinction extinction(volume);
        for (const Source& source : sources) {
            const Vec3d world = volume.indexToWorld.point(index + source.offset);
            TrkRay ray;
            for (int a = 0; a < 3; ++a) {
                ray.origin[a] = static_cast<float>(world[a]);
                ray.direction[a] = static_cast<float>(source.towards[a]);
            }
            ray.tMin = 0;
            ray.tMax = std::numeric_limits<float>::infinity();
            std::array<double, V::kChannels> depth{};
            const auto clipped = volume.clip(ray, volume.field->box());
            for (int i = 0; clipped && i <= kShadowSteps; ++i) {
                const double from = kShadowStart + i;
                const double to = i < kShadowSteps ? std::min(from + 1, clipped->local.tEnd)
                                                   : clipped->local.tEnd;
                if (from < to) {
                    uint64_t ignored = 0;
                    const auto part =
                        extinction.integrate(clipped->local, from, to, ignored, ignored);
                    for (size_t c = 0; c < V::kChannels; ++c) {
                        depth[c] += (i + 1.0) / (kShadowSteps + 1) * part[c];
                    }
                }
            }
            const double lengthPerVoxel = clipped ? clipped->lengthPerVoxel : 0.0;
            for (size_t k = 0; k < 3; ++k) {
                sum[k] += source.radiance[k] * std::exp(-lengthPerVoxel * depth[k % V::kChannels]);
            }
        }
    });
    Light light;
    std::transform(sum.begin(), sum.end(), light.begin(),
                   [](double v) { return static_cast<float>(v); });
    return light;
}

/// Cells of a brick's edge between whose corners light is interpolated: all of them, unless there
/// would be too many.
int64_t lightCells(const trk::IntBox& box) {
    int64_t longest = 0;
    for (size_t a = 0; a < 3; ++a) {
        longest = std::max(longest, box.hi[a] - box.lo[a]);
    }
    int64_t cells = DensityField::kBrickSize;
    while (cells > 1 && longest * cells / DensityField::kBrickSize > kMostPlaces) {
        cells /= 2;
    }
    return cells;
}

/// Whether the light at a vertex of a brick is ever looked up: a cell beside it, `step` voxels
/// wide, holds something. In constant regions it always is.
bool isNeeded(const DensityField& field, SparseTable::Entry entry, const Int3& at, int64_t step) {
    if (DensityField::isConstant(entry)) {
        return true;
    }
    constexpr int64_t kEdge = DensityField::kBrickEdge;
    const auto lo = [&](size_t a) { return std::max<int64_t>(at[a] - step, 0); };
    const auto hi = [&](size_t a) { return std::min<int64_t>(at[a] + step, kEdge - 1); };
    for (int64_t x = lo(0); x <= hi(0); ++x) {
        for (int64_t y = lo(1); y <= hi(1); ++y) {
            for (int64_t z = lo(2); z <= hi(2); ++z) {
                for (size_t c = 0; c < field.channels(); ++c) {
                    const auto vertex = static_cast<size_t>((x * kEdge + y) * kEdge + z);
                    if (field.vertex(entry, vertex, c) > 0) {
                        return true;
                    }
                }
            }
        }
    }
    return false;
}

}  // namespace

LightTable::LightTable(const trk::Volume& volume, const Sun& sun) {
    const DensityField& field = *volume.field;
    const int64_t brickCells = lightCells(field.box());
    size_t places = 0;
    const auto add = [&](const Int3& origin, int shift, SparseTable::Entry entry) {
        const bool coarse = DensityField::isConstant(entry) && shift == DensityField::kBrickShift;
        const int64_t cells = coarse ? 1 : brickCells;
        regions_.push_back({origin, shift, entry, cells, places});
        places += static_cast<size_t>((cells + 1) * (cells + 1) * (cells + 1));
        return static_cast<SparseTable::Entry>(regions_.size());
    };
    table_ = trk::TableBuilder(DensityField::kBrickShift, field.box())
                 .fill(
                     {&field.table()},
                     [&](const Int3& origin, int shift) -> std::optional<SparseTable::Entry> {
                         const auto found = field.table().find(origin[0], origin[1], origin[2]);
                         if (found.shift < shift || !DensityField::isConstant(found.entry)) {
                             return std::nullopt;
                         }
                         return found.entry == SparseTable::kEmpty
                                    ? SparseTable::kEmpty
                                    : add(origin, shift, found.entry);
                     },
                     [&](const Int3& origin) {
                         const auto found = field.table().find(origin[0], origin[1], origin[2]);
                         return add(origin, DensityField::kBrickShift, found.entry);
                     });
    light_.resize(places);
    const std::vector<Source> sources = makeSources(sun);
    trk::parallelFor(regions_.size(), 1, [&](size_t r) {
        const Region& region = regions_[r];
        const int64_t edge = region.cells + 1;
        trk::parallelFor(static_cast<size_t>(edge * edge * edge), 1, [&](size_t k) {
            const auto i = static_cast<int64_t>(k);
            const Int3 at{{i / (edge * edge), i / edge % edge, i % edge}};
            const double spacing =
                std::ldexp(1.0, region.shift) / static_cast<double>(region.cells);
            const auto step = static_cast<int64_t>(spacing);  // of a brick
            if (!isNeeded(field, region.entry, {{step * at[0], step * at[1], step * at[2]}},
                          step)) {
                return;
            }
            Vec3d place;
            for (size_t a = 0; a < 3; ++a) {
                place[static_cast<int>(a)] =
                    static_cast<double>(region.lo[a]) + spacing * static_cast<double>(at[a]);
            }
            light_[region.first + k] = lightArrivingAt(place, volume, sources);
        });
    });
}

Light LightTable::at(const Vec3d& local) const {
    const auto entry = table_
                           .find(static_cast<int64_t>(local[0]), static_cast<int64_t>(local[1]),
                                 static_cast<int64_t>(local[2]))
                           .entry;
    if (entry == SparseTable::kEmpty) {
        return {};
    }
    const Region& region = regions_[SparseTable::index(entry)];
    const auto edge = static_cast<size_t>(region.cells + 1);
    const size_t stride[3] = {edge * edge, edge, 1};
    const double cellsPerVoxel = std::ldexp(static_cast<double>(region.cells), -region.shift);
    size_t first = region.first;
    float weight[3][2];
    for (size_t a = 0; a < 3; ++a) {
        const double x =
            (local[static_cast<int>(a)] - static_cast<double>(region.lo[a])) * cellsPerVoxel;
        const auto cell = std::min(static_cast<size_t>(std::max(x, 0.0)), edge - 2);
        first += cell * stride[a];
        weight[a][1] = static_cast<float>(x - static_cast<double>(cell));
        weight[a][0] = 1 - weight[a][1];
    }
    Light light{};
    for (size_t corner = 0; corner < 8; ++corner) {
        const size_t x = corner >> 2;
        const size_t y = corner >> 1 & 1;
        const size_t z = corner & 1;
        const float w = weight[0][x] * weight[1][y] * weight[2][z];
        const Light& there = light_[first + x * stride[0] + y * stride[1] + z * stride[2]];
        for (size_t k = 0; k < 3; ++k) {
            light[k] += w * there[k];
        }
    }
    return light;
}

}  // namespace vdbtools
