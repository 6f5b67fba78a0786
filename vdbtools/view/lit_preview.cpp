// SPDX-License-Identifier: Apache-2.0
#include "lit_preview.h"

#include "failure.h"
#include "io/sidecar.h"
#include "io/sidecar_schema.h"
#include "parallel.h"
#include "query/variant.h"

#include <algorithm>
#include <atomic>
#include <cmath>

namespace vdbtools {

using trk::DensityField;
using trk::Int3;
using trk::LocalRay;
using trk::SparseTable;
using trk::Vec3d;

namespace {

using Color = std::array<double, 3>;

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

/// What a camera ray gathers, stretch by stretch: in each, light counts as constant.
class GatheredLight {
  public:
    /// `start`: where the local ray begins, from the camera; `lengthPerVoxel`: of its t.
    /// `farDepth`: see Picture::halfDepth.
    GatheredLight(double start, double lengthPerVoxel, double farDepth)
        : start_(start), lengthPerVoxel_(lengthPerVoxel), halfDepth_(farDepth) {}

    /// `passed`: the transmittance of the stretch, of one channel or three.
    template <size_t C>
    void addStretch(double t0, double t1, const std::array<double, C>& passed, const Light& light) {
        const double before = mean();
        for (size_t k = 0; k < 3; ++k) {
            const double p = passed[k % C];
            radiance_[k] += transmittance_[k] * (1 - p) * static_cast<double>(light[k]);
            transmittance_[k] *= p;
        }
        const double after = mean();
        if (before > 0.5 && after <= 0.5) {
            const double within = std::log(before / 0.5) / std::log(before / after);
            halfDepth_ = start_ + lengthPerVoxel_ * (t0 + within * (t1 - t0));
        }
    }
    /// Whether what lies behind can still be seen.
    bool isOpen() const {
        constexpr double kOpaque = 1e-5;
        return std::max({transmittance_[0], transmittance_[1], transmittance_[2]}) > kOpaque;
    }
    void write(Picture& picture, size_t pixel) const {
        for (size_t k = 0; k < 3; ++k) {
            picture.transmittance[k][pixel] = static_cast<float>(transmittance_[k]);
            picture.light[k][pixel] = static_cast<float>(radiance_[k]);
        }
        picture.halfDepth[pixel] = static_cast<float>(halfDepth_);
    }

  private:
    double mean() const { return (transmittance_[0] + transmittance_[1] + transmittance_[2]) / 3; }

    double start_;
    double lengthPerVoxel_;
    double halfDepth_;
    Color radiance_{};
    Color transmittance_{{1, 1, 1}};
};

/// Of a cell, or a constant region, whose optical depths are not all 0: as many stretches as it
/// takes. `densityAt(t)`: the density along the ray, whatever its unit.
template <size_t C, class DensityAt>
void gatherCell(double t0, double t1, const std::array<double, C>& depth,
                const DensityAt& densityAt, const LocalRay& ray, const LightTable& light,
                GatheredLight& gathered) {
    const int count = stretchCount(t1 - t0, *std::max_element(depth.begin(), depth.end()));
    const auto place = [&](double share) { return t0 + share * (t1 - t0); };
    // Of one stretch, nobody asks where in it.
    const DepthInCell depthIn([&](double s) { return count > 1 ? densityAt(place(s)) : 0.0; });
    double from = 0;  // shares of the length, and of the depth
    double depthFrom = 0;
    for (int i = 1; i <= count; ++i) {
        const double to = static_cast<double>(i) / count;
        const double depthTo = i == count ? 1 : depthIn.share(to);
        std::array<double, C> passed;
        for (size_t c = 0; c < C; ++c) {
            passed[c] = std::exp(-depth[c] * std::max(depthTo - depthFrom, 0.0));
        }
        const double start = place(from);
        const double end = place(to);
        gathered.addStretch(start, end, passed, light.at(ray.at(0.5 * (start + end))));
        from = to;
        depthFrom = depthTo;
    }
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
    : volume_(openLevel(sidecarPath, options)), light_(volume_, options.sun) {}

void LitPreview::drawPixel(const TrkRay& ray, double farDepth, Picture& picture,
                           size_t pixel) const {
    trk::withVariant(volume_, trk::ControlKind::kConstant, [&](auto variant) {
        using V = decltype(variant);
        const auto clipped = volume_.clip(ray, volume_.field->box());
        if (!clipped) {
            GatheredLight(0, 0, farDepth).write(picture, pixel);
            return;
        }
        const LocalRay& local = clipped->local;
        // The clipped ray starts anew at the box.
        Vec3d entry = local.origin;
        for (int a = 0; a < 3; ++a) {
            entry[a] += static_cast<double>(volume_.anchor[static_cast<size_t>(a)]);
        }
        const Vec3d eye{{static_cast<double>(ray.origin[0]), static_cast<double>(ray.origin[1]),
                         static_cast<double>(ray.origin[2])}};
        GatheredLight gathered(length(volume_.indexToWorld.point(entry) - eye),
                               clipped->lengthPerVoxel, farDepth);
        const auto densityAt = [&](double t) {
            double sum = 0;
            for (const float d : volume_.field->density<V::kDensityChannels>(local.at(t))) {
                sum += static_cast<double>(d);
            }
            return sum;
        };
        volume_.field->forEachCell<V::kDensityChannels>(
            local, 0, local.tEnd, [&](double t0, double t1, const auto& integral) {
                std::array<double, V::kChannels> depth;
                bool isEmpty = true;
                for (size_t c = 0; c < V::kChannels; ++c) {
                    depth[c] = clipped->lengthPerVoxel * volume_.scales[c] *
                               integral[c % V::kDensityChannels];
                    isEmpty = isEmpty && depth[c] <= 0;
                }
                if (!isEmpty) {
                    gatherCell(t0, t1, depth, densityAt, local, light_, gathered);
                }
                return isEmpty || gathered.isOpen();
            });
        gathered.write(picture, pixel);
    });
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
