// SPDX-License-Identifier: Apache-2.0
#include "lit_preview.h"

#include "error.h"
#include "io/sidecar.h"
#include "io/sidecar_schema.h"
#include "variant.h"

#include <tbb/blocked_range.h>
#include <tbb/parallel_for.h>

#include <algorithm>
#include <atomic>
#include <cmath>
#include <limits>
#include <utility>

namespace vdbtools {

using trk::ExtinctionField;
using trk::Int3;
using trk::LocalRay;
using trk::SparseTable;
using trk::Vec3d;

namespace {

using Color = std::array<double, 3>;

// A clear late afternoon. Radiances are relative; a white surface in the sun would be about 1.
constexpr double kTowardsSun[3] = {-0.36, 0.66, 0.66};
constexpr Color kSun{{0.98, 0.89, 0.74}};  // already over 4 pi, the isotropic phase function
constexpr Color kZenith{{0.30, 0.48, 0.86}};
constexpr Color kHorizon{{0.62, 0.72, 0.84}};
constexpr Color kGround{{0.24, 0.21, 0.18}};
constexpr int kSkyDirections = 20;
// In super-voxels. A place's own super-voxel is left out of its shadow: the light is tabulated
// where the interpolated control is largest, and would show the grid of those places as dark dots.
constexpr double kShadowStart = 1;
constexpr float kNoLight = -1;  // of places where light is not tabulated

Color skyRadiance(const Vec3d& direction) {
    const double height = direction[1];
    Color radiance;
    for (size_t k = 0; k < 3; ++k) {
        radiance[k] =
            height < 0 ? kGround[k] : kHorizon[k] + (kZenith[k] - kHorizon[k]) * std::sqrt(height);
    }
    return radiance;
}

/// Light from one direction.
struct Source {
    Vec3d towards;
    Color radiance;
};

/// The sun, and the sky as directions spread evenly over the sphere.
std::vector<Source> makeSources() {
    std::vector<Source> sources;
    const Vec3d sun{{kTowardsSun[0], kTowardsSun[1], kTowardsSun[2]}};
    sources.push_back({(1 / length(sun)) * sun, kSun});
    for (int i = 0; i < kSkyDirections; ++i) {
        const double y = 1 - (2 * i + 1.0) / kSkyDirections;
        const double angle = 2.39996322972865332 * i;  // the golden angle
        const double r = std::sqrt(1 - y * y);
        const Vec3d towards{{r * std::cos(angle), y, r * std::sin(angle)}};
        Color radiance = skyRadiance(towards);
        for (double& c : radiance) {
            c /= kSkyDirections;
        }
        sources.push_back({towards, radiance});
    }
    return sources;
}

const std::vector<Source>& sources() {
    static const std::vector<Source> list = makeSources();
    return list;
}

/// What is behind the volume, by the height in the picture: a sky that tells little of its own.
Color backdrop(double y) {
    Color color;
    for (size_t k = 0; k < 3; ++k) {
        const double top[3] = {0.10, 0.22, 0.48};
        const double bottom[3] = {0.42, 0.54, 0.68};
        color[k] = top[k] + (bottom[k] - top[k]) * y;
    }
    return color;
}

trk::VolumeOptions volumeOptions(const trk::SidecarHeader& header, uint32_t level, float scale,
                                 const std::array<float, 3>& color) {
    using namespace trk::schema;
    trk::VolumeOptions options;
    options.gridNamed = true;
    options.gridName = gridPrefix(header.source.name) +
                       (level == 0 ? kControlSuffix : levelSuffix(static_cast<int>(level)));
    options.scale = scale;
    options.color = color;
    return options;
}

trk::Volume openLevel(const std::string& path, uint32_t level, float scale,
                      const std::array<float, 3>& color) {
    const trk::SidecarHeader header = trk::readSidecarHeader(path);
    if (level > static_cast<uint32_t>(header.levels)) {
        throw trk::Error(TRK_ERROR_INVALID_ARGUMENT,
                         path + ": level " + std::to_string(level) + ": expected 0 to " +
                             std::to_string(header.levels) + ", the levels of this sidecar");
    }
    return trk::openVolume(path.c_str(), "", volumeOptions(header, level, scale, color));
}

}  // namespace

LitPreview::LitPreview(const std::string& sidecarPath, uint32_t level, float scale,
                       const std::array<float, 3>& color)
    : volume_(openLevel(sidecarPath, level, scale, color)) {
    computeLight();
}

/// All light that arrives at a place, through what of the volume is in its way.
LitPreview::Light LitPreview::lightAt(const Vec3d& local) const {
    Vec3d index = local;
    for (int a = 0; a < 3; ++a) {
        index[a] += static_cast<double>(volume_.anchor[static_cast<size_t>(a)]);
    }
    const Vec3d world = volume_.indexToWorld.point(index);
    Color sum{};
    trk::withVariant(volume_, false, [&](auto variant) {
        using V = decltype(variant);
        const typename V::Extinction extinction(volume_);
        for (const Source& source : sources()) {
            TrkRay ray;
            for (int a = 0; a < 3; ++a) {
                ray.origin[a] = static_cast<float>(world[a]);
                ray.direction[a] = static_cast<float>(source.towards[a]);
            }
            ray.tMin = 0;
            ray.tMax = std::numeric_limits<float>::infinity();
            LocalRay clipped;
            double lengthPerVoxel = 0;
            std::array<double, V::kChannels> depth{};
            if (volume_.clip(ray, volume_.field.box(), clipped, lengthPerVoxel) &&
                clipped.tEnd > kShadowStart) {
                uint64_t ignored = 0;
                depth = extinction.integrate(clipped, kShadowStart, clipped.tEnd, ignored, ignored);
            }
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

/// Tabulates the light at the corners of every cell that holds anything.
void LitPreview::computeLight() {
    constexpr size_t kEdge = ExtinctionField::kBrickEdge;
    constexpr size_t kVertices = ExtinctionField::kBrickVertices;
    const ExtinctionField& field = volume_.field;
    // A table like the field's, but bricks that stand in several places are lit apart.
    std::vector<Int3> bricks;
    SparseTable table(ExtinctionField::kBrickShift, field.box());
    table.fill(
        [&](const Int3& origin, int shift) -> std::optional<SparseTable::Entry> {
            const auto found = field.table().find(origin[0], origin[1], origin[2]);
            if (found.shift < shift || !ExtinctionField::isConstant(found.entry)) {
                return std::nullopt;
            }
            return found.entry == SparseTable::kEmpty ? SparseTable::kEmpty
                                                      : ExtinctionField::kConstantFlag;
        },
        [&](const Int3& origin) {
            bricks.push_back(origin);
            return static_cast<SparseTable::Entry>(bricks.size());
        });
    std::vector<size_t> needed;  // vertices of all bricks, counted through
    for (size_t b = 0; b < bricks.size(); ++b) {
        const Int3& lo = bricks[b];
        const SparseTable::Entry entry = field.table().find(lo[0], lo[1], lo[2]).entry;
        std::array<char, kVertices> marks{};
        for (size_t cell = 0; cell < 512; ++cell) {
            const size_t first = ((cell >> 6) * kEdge + (cell >> 3 & 7)) * kEdge + (cell & 7);
            constexpr size_t kCorners[] = {0, 1, 9, 10, 81, 82, 90, 91};
            bool occupied = false;
            for (const size_t corner : kCorners) {
                for (size_t c = 0; c < field.channels(); ++c) {
                    occupied = occupied || field.vertex(entry, first + corner, c) > 0;
                }
            }
            for (const size_t corner : kCorners) {
                marks[first + corner] = occupied ? 1 : marks[first + corner];
            }
        }
        for (size_t i = 0; i < kVertices; ++i) {
            if (marks[i]) {
                needed.push_back(b * kVertices + i);
            }
        }
    }
    std::vector<float> light(bricks.size() * kVertices * 3, 0.0f);
    tbb::parallel_for(tbb::blocked_range<size_t>(0, needed.size(), 16), [&](const auto& range) {
        for (size_t n = range.begin(); n != range.end(); ++n) {
            const Int3& lo = bricks[needed[n] / kVertices];
            const size_t i = needed[n] % kVertices;
            const Light value =
                lightAt({{static_cast<double>(lo[0]) + static_cast<double>(i / 81),
                          static_cast<double>(lo[1]) + static_cast<double>(i / 9 % 9),
                          static_cast<double>(lo[2]) + static_cast<double>(i % 9)}});
            std::copy(value.begin(), value.end(), &light[needed[n] * 3]);
        }
    });
    light_ =
        ExtinctionField(3, std::move(table), std::vector<float>(3, kNoLight), std::move(light), {});
}

void LitPreview::drawPixel(const TrkRay& ray, Picture& picture, size_t pixel) const {
    constexpr double kOpaque = 1e-5;
    Color radiance{};
    Color transmittance{{1, 1, 1}};
    double halfDepth = std::numeric_limits<double>::infinity();
    trk::withVariant(volume_, false, [&](auto variant) {
        using V = decltype(variant);
        LocalRay local;
        double lengthPerVoxel = 0;
        if (!volume_.clip(ray, volume_.field.box(), local, lengthPerVoxel)) {
            return;
        }
        // The clipped ray starts anew at the box.
        Vec3d entry = local.origin;
        for (int a = 0; a < 3; ++a) {
            entry[a] += static_cast<double>(volume_.anchor[static_cast<size_t>(a)]);
        }
        const Vec3d eye{{static_cast<double>(ray.origin[0]), static_cast<double>(ray.origin[1]),
                         static_cast<double>(ray.origin[2])}};
        const double start = length(volume_.indexToWorld.point(entry) - eye);
        const auto mean = [](const Color& c) { return (c[0] + c[1] + c[2]) / 3; };
        volume_.field.forEachCell<V::kDensityChannels>(
            local, 0, local.tEnd, [&](double t0, double t1, const auto& depth) {
                // Large constant regions in pieces of a voxel, as light varies in them.
                const int pieces = std::max(1, static_cast<int>(std::ceil(t1 - t0 - 1)));
                const double unit = lengthPerVoxel / pieces;
                std::array<double, V::kChannels> passed;
                double least = 1;
                for (size_t c = 0; c < V::kChannels; ++c) {
                    passed[c] =
                        std::exp(-unit * volume_.scales[c] * depth[c % V::kDensityChannels]);
                    least = std::min(least, passed[c]);
                }
                for (int i = 0; least < 1 && i < pieces; ++i) {
                    const double t = t0 + (t1 - t0) * (i + 0.5) / pieces;
                    Light light = light_.density<3>(local.at(t));
                    if (light[0] == kNoLight) {
                        light = lightAt(local.at(t));
                    }
                    const double before = mean(transmittance);
                    for (size_t k = 0; k < 3; ++k) {
                        const double p = passed[k % V::kChannels];
                        radiance[k] += transmittance[k] * (1 - p) * static_cast<double>(light[k]);
                        transmittance[k] *= p;
                    }
                    const double after = mean(transmittance);
                    if (before > 0.5 && after <= 0.5) {
                        const double within = std::log(before / 0.5) / std::log(before / after);
                        halfDepth =
                            start + lengthPerVoxel * (t + (within - 0.5) * (t1 - t0) / pieces);
                    }
                }
                return std::max({transmittance[0], transmittance[1], transmittance[2]}) > kOpaque;
            });
    });
    const size_t row = pixel / static_cast<size_t>(picture.width);
    const Color behind = backdrop((static_cast<double>(row) + 0.5) / picture.height);
    for (size_t k = 0; k < 3; ++k) {
        picture.transmittance[k][pixel] = static_cast<float>(transmittance[k]);
        picture.beauty[k][pixel] = static_cast<float>(radiance[k] + transmittance[k] * behind[k]);
    }
    picture.halfDepth[pixel] = static_cast<float>(halfDepth);
}

Picture LitPreview::draw(const Camera& camera, int width, int height,
                         const std::function<void(double)>& progress) const {
    Picture picture;
    picture.width = width;
    picture.height = height;
    const size_t pixels = static_cast<size_t>(width) * static_cast<size_t>(height);
    for (size_t k = 0; k < 3; ++k) {
        picture.beauty[k].resize(pixels);
        picture.transmittance[k].resize(pixels);
    }
    picture.halfDepth.resize(pixels);
    const double aspect = static_cast<double>(width) / height;
    std::atomic<int> done{0};
    tbb::parallel_for(tbb::blocked_range<int>(0, height, 4), [&](const auto& range) {
        for (int row = range.begin(); row != range.end(); ++row) {
            for (int column = 0; column < width; ++column) {
                drawPixel(camera.ray((column + 0.5) / width, (row + 0.5) / height, aspect), picture,
                          static_cast<size_t>(row) * static_cast<size_t>(width) +
                              static_cast<size_t>(column));
            }
            progress(static_cast<double>(++done) / height);
        }
    });
    return picture;
}

}  // namespace vdbtools
