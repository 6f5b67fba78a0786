// SPDX-License-Identifier: Apache-2.0
#include "lit_preview.h"

#include "failure.h"
#include "field/table_builder.h"
#include "io/sidecar.h"
#include "io/sidecar_schema.h"
#include "parallel.h"
#include "query/variant.h"

#include <algorithm>
#include <atomic>
#include <cmath>
#include <limits>
#include <utility>

namespace vdbtools {

using trk::DensityField;
using trk::Int3;
using trk::LocalRay;
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

trk::Volume openLevel(const std::string& path, const LitOptions& lit) {
    using namespace trk::schema;
    const trk::SidecarHeader header = trk::readSidecarHeader(path);
    if (lit.level && *lit.level > static_cast<uint32_t>(header.levels)) {
        throw trk::Error(TRK_ERROR_INVALID_ARGUMENT,
                         path + ": level " + std::to_string(*lit.level) + ": expected 0 to " +
                             std::to_string(header.levels) + ", the levels of this sidecar");
    }
    trk::VolumeOptions options;
    options.gridNamed = true;
    options.gridName =
        header.prefix + (lit.level.value_or(0) > 0 ? levelSuffix(static_cast<int>(*lit.level))
                         : !lit.level && header.previewSize > 0 ? previewSuffix(header.previewSize)
                                                                : kControlSuffix);
    options.scale = lit.scale;
    options.color = lit.color;
    return trk::openVolume(path.c_str(), "", options);
}

/// One of `count` directions spread evenly over the sphere.
Vec3d spreadDirection(int i, int count) {
    const double y = 1 - (2 * i + 1.0) / count;
    const double angle = 2.39996322972865332 * i;  // the golden angle
    const double r = std::sqrt(1 - y * y);
    return {{r * std::cos(angle), y, r * std::sin(angle)}};
}

/// In how many stretches a cell, or a constant region, is lit: more where much is absorbed, as most
/// of that is near where the ray enters, or where it is long.
int stretchCount(double length, double depth) {
    constexpr double kMost = 24;
    // In steps small enough that the change from one to the next is not seen.
    const double byDepth = depth < 0.02 ? 1 : depth < 0.3 ? 4 : 8;
    return static_cast<int>(std::min(std::max(byDepth, std::ceil(length - 1)), kMost));
}

/// How the depth grows along a line through a cell, where the density is a cubic in s from 0 to 1.
/// To take it for linear between its ends, which may be 0 both, draws the cells' edges.
class DepthInCell {
  public:
    template <class Density>
    explicit DepthInCell(const Density& at) {
        const double y[4] = {at(0), at(1.0 / 3), at(2.0 / 3), at(1)};
        // Coefficients of the cubic through four points at thirds, integrated term by term.
        term_[0] = y[0];
        term_[1] = (-5.5 * y[0] + 9 * y[1] - 4.5 * y[2] + y[3]) / 2;
        term_[2] = (9 * y[0] - 22.5 * y[1] + 18 * y[2] - 4.5 * y[3]) / 3;
        term_[3] = (-4.5 * y[0] + 13.5 * y[1] - 13.5 * y[2] + 4.5 * y[3]) / 4;
        whole_ = term_[0] + term_[1] + term_[2] + term_[3];
    }
    /// The part of the cell's depth that lies before s.
    double share(double s) const {
        const double depth = s * (term_[0] + s * (term_[1] + s * (term_[2] + s * term_[3])));
        return whole_ > 0 ? std::min(std::max(depth / whole_, 0.0), 1.0) : s;
    }

  private:
    double term_[4];
    double whole_;
};

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

std::array<float, 3> skyBehind(double y) {
    std::array<float, 3> color{};
    for (size_t k = 0; k < 3; ++k) {
        const double top[3] = {0.10, 0.22, 0.48};
        const double bottom[3] = {0.42, 0.54, 0.68};
        color[k] = static_cast<float>(top[k] + (bottom[k] - top[k]) * y);
    }
    return color;
}

LitPreview::LitPreview(const std::string& sidecarPath, const LitOptions& options)
    : sources_(makeSources(options)), volume_(openLevel(sidecarPath, options)) {
    tabulateLight();
}

/// The sun, and the sky as directions spread evenly over the sphere.
std::vector<LitPreview::Source> LitPreview::makeSources(const LitOptions& options) {
    constexpr double kDegree = 3.14159265358979323846 / 180;
    std::vector<Source> list;
    // A wide sun, as several directions, and each of all directions from a place of its own around
    // the one that light is computed for: from that alone, shadows would show the grid of those
    // places.
    const auto add = [&](const Vec3d& towards, const Vec3d& offset, Color radiance, int count) {
        for (double& c : radiance) {
            c /= count;
        }
        list.push_back({toWorld(options.up, towards), kShadowSpread * offset, radiance});
    };
    for (int i = 0; i < kSunDirections; ++i) {
        const double turn = 2 * kDegree * 180 * i / kSunDirections;
        const double azimuth = kDegree * (options.azimuth + kSunRadius * std::cos(turn));
        const double elevation = kDegree * (options.elevation + kSunRadius * std::sin(turn));
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
LitPreview::Light LitPreview::computeLight(const Vec3d& local) const {
    Vec3d index = local;
    for (int a = 0; a < 3; ++a) {
        index[a] += static_cast<double>(volume_.anchor[static_cast<size_t>(a)]);
    }
    Color sum{};
    trk::withVariant(volume_, trk::ControlKind::kConstant, [&](auto variant) {
        using V = decltype(variant);
        const typename V::Extinction extinction(volume_);
        for (const Source& source : sources_) {
            const Vec3d world = volume_.indexToWorld.point(index + source.offset);
            TrkRay ray;
            for (int a = 0; a < 3; ++a) {
                ray.origin[a] = static_cast<float>(world[a]);
                ray.direction[a] = static_cast<float>(source.towards[a]);
            }
            ray.tMin = 0;
            ray.tMax = std::numeric_limits<float>::infinity();
            std::array<double, V::kChannels> depth{};
            const auto clipped = volume_.clip(ray, volume_.field->box());
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

/// Tabulates the light at the corners of a brick's cells, of those that hold anything, and more
/// coarsely in constant regions.
void LitPreview::tabulateLight() {
    const DensityField& field = *volume_.field;
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
            light_[region.first + k] = computeLight(place);
        });
    });
}

/// The tabulated light, interpolated.
LitPreview::Light LitPreview::lightAt(const Vec3d& local) const {
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

void LitPreview::drawPixel(const TrkRay& ray, double farDepth, Picture& picture,
                           size_t pixel) const {
    constexpr double kOpaque = 1e-5;
    Color radiance{};
    Color transmittance{{1, 1, 1}};
    double halfDepth = farDepth;
    trk::withVariant(volume_, trk::ControlKind::kConstant, [&](auto variant) {
        using V = decltype(variant);
        const auto clipped = volume_.clip(ray, volume_.field->box());
        if (!clipped) {
            return;
        }
        const LocalRay& local = clipped->local;
        const double lengthPerVoxel = clipped->lengthPerVoxel;
        // The clipped ray starts anew at the box.
        Vec3d entry = local.origin;
        for (int a = 0; a < 3; ++a) {
            entry[a] += static_cast<double>(volume_.anchor[static_cast<size_t>(a)]);
        }
        const Vec3d eye{{static_cast<double>(ray.origin[0]), static_cast<double>(ray.origin[1]),
                         static_cast<double>(ray.origin[2])}};
        const double start = length(volume_.indexToWorld.point(entry) - eye);
        const auto mean = [](const Color& c) { return (c[0] + c[1] + c[2]) / 3; };
        const auto densityAt = [&](const Vec3d& point) {
            double sum = 0;
            for (const float d : volume_.field->density<V::kDensityChannels>(point)) {
                sum += static_cast<double>(d);
            }
            return sum;
        };
        // One stretch in which light counts as constant.
        const auto addStretch = [&](double t0, double t1, const auto& passed) {
            const Light light = lightAt(local.at(0.5 * (t0 + t1)));
            const double before = mean(transmittance);
            for (size_t k = 0; k < 3; ++k) {
                const double p = passed[k % V::kChannels];
                radiance[k] += transmittance[k] * (1 - p) * static_cast<double>(light[k]);
                transmittance[k] *= p;
            }
            const double after = mean(transmittance);
            if (before > 0.5 && after <= 0.5) {
                const double within = std::log(before / 0.5) / std::log(before / after);
                halfDepth = start + lengthPerVoxel * (t0 + within * (t1 - t0));
            }
        };
        volume_.field->forEachCell<V::kDensityChannels>(
            local, 0, local.tEnd, [&](double t0, double t1, const auto& integral) {
                std::array<double, V::kChannels> depth;
                double most = 0;
                for (size_t c = 0; c < V::kChannels; ++c) {
                    depth[c] =
                        lengthPerVoxel * volume_.scales[c] * integral[c % V::kDensityChannels];
                    most = std::max(most, depth[c]);
                }
                if (most == 0) {
                    return true;
                }
                const auto count = stretchCount(t1 - t0, most);
                // Of one stretch, nobody asks where in it.
                const DepthInCell depthIn([&](double s) {
                    return count > 1 ? densityAt(local.at(t0 + s * (t1 - t0))) : 0.0;
                });
                double from = 0;  // shares of the length, and of the depth
                double depthFrom = 0;
                for (int i = 1; i <= count; ++i) {
                    const double to = static_cast<double>(i) / count;
                    const double depthTo = i == count ? 1 : depthIn.share(to);
                    std::array<double, V::kChannels> passed;
                    for (size_t c = 0; c < V::kChannels; ++c) {
                        passed[c] = std::exp(-depth[c] * std::max(depthTo - depthFrom, 0.0));
                    }
                    addStretch(t0 + from * (t1 - t0), t0 + to * (t1 - t0), passed);
                    from = to;
                    depthFrom = depthTo;
                }
                return std::max({transmittance[0], transmittance[1], transmittance[2]}) > kOpaque;
            });
    });
    for (size_t k = 0; k < 3; ++k) {
        picture.transmittance[k][pixel] = static_cast<float>(transmittance[k]);
        picture.light[k][pixel] = static_cast<float>(radiance[k]);
    }
    picture.halfDepth[pixel] = static_cast<float>(halfDepth);
}

WorldBox LitPreview::box() const {
    const DensityField& field = *volume_.field;
    trk::IntBox content;
    field.table().forEach([&](const Int3& lo, int shift, SparseTable::Entry entry) {
        const int64_t size = int64_t{1} << shift;
        if (DensityField::isConstant(entry)) {
            content.add(lo, {{lo[0] + size, lo[1] + size, lo[2] + size}});
            return;
        }
        constexpr auto kEdge = static_cast<size_t>(DensityField::kBrickEdge);
        for (size_t i = 0; i < DensityField::kBrickVertices; ++i) {
            for (size_t c = 0; c < field.channels(); ++c) {
                if (field.vertex(entry, i, c) > 0) {
                    const Int3 at{{lo[0] + static_cast<int64_t>(i / (kEdge * kEdge)),
                                   lo[1] + static_cast<int64_t>(i / kEdge % kEdge),
                                   lo[2] + static_cast<int64_t>(i % kEdge)}};
                    content.add({{at[0] - 1, at[1] - 1, at[2] - 1}},
                                {{at[0] + 1, at[1] + 1, at[2] + 1}});
                }
            }
        }
    });
    WorldBox result;
    trk::worldBounds(volume_.indexToWorld, volume_.anchor, content, result.lo.x, result.hi.x);
    return result;
}

std::vector<char> LitPreview::hits(const Camera& camera, int width, int height) const {
    std::vector<char> result(static_cast<size_t>(width) * static_cast<size_t>(height));
    const double aspect = static_cast<double>(width) / height;
    trk::parallelFor(result.size(), 64, [&](size_t i) {
        const auto row = static_cast<double>(i / static_cast<size_t>(width));
        const auto column = static_cast<double>(i % static_cast<size_t>(width));
        const auto clipped = volume_.clip(
            camera.ray((column + 0.5) / width, (row + 0.5) / height, aspect), volume_.field->box());
        trk::withVariant(volume_, trk::ControlKind::kConstant, [&](auto variant) {
            using V = decltype(variant);
            if (clipped) {
                uint64_t ignored = 0;
                for (const double depth : typename V::Extinction(volume_).integrate(
                         clipped->local, 0, clipped->local.tEnd, ignored, ignored)) {
                    result[i] = result[i] || clipped->lengthPerVoxel * depth > 1e-3;
                }
            }
        });
    });
    return result;
}

/// The distance of the farthest corner of the volume's box.
double LitPreview::farSide(const Camera& camera) const {
    const WorldBox content = box();
    double farthest = 0;
    for (int corner = 0; corner < 8; ++corner) {
        Vec3d p;
        for (int a = 0; a < 3; ++a) {
            p[a] = corner >> a & 1 ? content.hi[a] : content.lo[a];
        }
        farthest = std::max(farthest, length(p - camera.eye));
    }
    return farthest;
}

Picture LitPreview::draw(const Camera& camera, int width, int height,
                         const std::function<void(double)>& progress) const {
    Picture picture;
    picture.width = width;
    picture.height = height;
    const size_t pixels = static_cast<size_t>(width) * static_cast<size_t>(height);
    for (size_t k = 0; k < 3; ++k) {
        picture.light[k].resize(pixels);
        picture.transmittance[k].resize(pixels);
    }
    picture.halfDepth.resize(pixels);
    const double aspect = static_cast<double>(width) / height;
    const double farDepth = farSide(camera);
    std::atomic<int> done{0};
    trk::parallelFor(static_cast<size_t>(height), 4, [&](size_t i) {
        const int row = static_cast<int>(i);
        for (int column = 0; column < width; ++column) {
            drawPixel(camera.ray((column + 0.5) / width, (row + 0.5) / height, aspect), farDepth,
                      picture, i * static_cast<size_t>(width) + static_cast<size_t>(column));
        }
        progress(static_cast<double>(++done) / height);
    });
    return picture;
}

}  // namespace vdbtools
