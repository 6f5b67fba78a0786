// SPDX-License-Identifier: Apache-2.0
#include "procedural.h"

#include "failure.h"
#include "io/density_types.h"
#include "io/tree_encoder.h"
#include "io/vdb_writer.h"
#include "parallel.h"
#include "space/geometry.h"

#include <algorithm>
#include <array>
#include <atomic>
#include <cmath>
#include <fstream>
#include <memory>
#include <random>
#include <string>
#include <vector>

namespace vdbtools {
namespace {

using trk::Vec3d;

constexpr double kBoxSize = 10;  // world units
constexpr double kLeast = 1e-3;  // thinner than this is nothing, as simulations store it

double smoothStep(double lo, double hi, double x) {
    const double t = std::min(std::max((x - lo) / (hi - lo), 0.0), 1.0);
    return t * t * (3 - 2 * t);
}

/// Gradient noise on the integer lattice with a quintic fade [Perlin 2002]; about -1 to 1.
class Noise {
  public:
    explicit Noise(uint64_t seed) {
        std::mt19937_64 random(seed);
        for (size_t i = 0; i < 256; ++i) {
            permutation_[i] = static_cast<uint8_t>(i);
        }
        for (size_t i = 255; i > 0; --i) {
            std::swap(permutation_[i], permutation_[random() % (i + 1)]);
        }
    }

    double operator()(const Vec3d& p) const {
        int cell[3];
        double f[3];
        double fade[3];
        for (int a = 0; a < 3; ++a) {
            const double floor = std::floor(p[a]);
            cell[a] = static_cast<int>(floor);
            f[a] = p[a] - floor;
            fade[a] = f[a] * f[a] * f[a] * (f[a] * (f[a] * 6 - 15) + 10);
        }
        double value = 0;
        for (int corner = 0; corner < 8; ++corner) {
            const int x = corner >> 2;
            const int y = corner >> 1 & 1;
            const int z = corner & 1;
            const double weight = (x ? fade[0] : 1 - fade[0]) * (y ? fade[1] : 1 - fade[1]) *
                                  (z ? fade[2] : 1 - fade[2]);
            value += weight *
                     gradient(cell[0] + x, cell[1] + y, cell[2] + z, f[0] - x, f[1] - y, f[2] - z);
        }
        return value;
    }

    /// Sum of octaves, each twice as fine and `gain` times as strong; about -1 to 1.
    double octaves(Vec3d p, int count, double gain) const {
        double sum = 0;
        double amplitude = 1;
        double total = 0;
        for (int i = 0; i < count; ++i) {
            sum += amplitude * (*this)(p);
            total += amplitude;
            amplitude *= gain;
            p = 2.03 * p + Vec3d{{17.1, 5.3, 29.7}};
        }
        return sum / total;
    }

    /// The same of 1 - |noise|, squared: creases between billows. 0 to 1.
    double billows(Vec3d p, int count, double gain) const {
        double sum = 0;
        double amplitude = 1;
        double total = 0;
        for (int i = 0; i < count; ++i) {
            const double n = 1 - std::fabs((*this)(p));
            sum += amplitude * n * n;
            total += amplitude;
            amplitude *= gain;
            p = 2.11 * p + Vec3d{{31.4, 15.9, 2.65}};
        }
        return sum / total;
    }

  private:
    double gradient(int x, int y, int z, double fx, double fy, double fz) const {
        const auto at = [&](int i) { return permutation_[static_cast<size_t>(i & 255)]; };
        const int hash = at(at(at(x) + y) + z) & 15;
        const double u = hash < 8 ? fx : fy;
        const double v = hash < 4 ? fy : hash == 12 || hash == 14 ? fx : fz;
        return (hash & 1 ? -u : u) + (hash & 2 ? -v : v);
    }

    std::array<uint8_t, 256> permutation_{};
};

/// A density on the unit cube, y up, of one channel or three.
class Shape {
  public:
    virtual ~Shape() = default;
    virtual bool coloured() const { return false; }
    /// Whether the density is 0 within `radius` of `centre`; may answer false too often.
    virtual bool emptyAround(const Vec3d& centre, double radius) const = 0;
    virtual double density(const Vec3d& p, int channel) const = 0;
};

class Cloud : public Shape {
  public:
    explicit Cloud(uint64_t seed) : noise_(seed) {
        // Large balls along a flat base, smaller ones budding from the upper half of earlier ones.
        std::mt19937_64 random(seed * 7919 + 1);
        std::uniform_real_distribution<double> unit(0, 1);
        for (int i = 0; i < 7; ++i) {
            const double angle = 6.2831853 * (i + 0.6 * unit(random)) / 7;
            const double reach = 0.19 * std::sqrt(unit(random));
            const double radius = 0.11 + 0.055 * unit(random);
            balls_.push_back({{{0.5 + 1.15 * reach * std::cos(angle), 0.31 + 0.05 * unit(random),
                                0.5 + 0.85 * reach * std::sin(angle)}},
                              radius});
        }
        balls_.push_back({{{0.5, 0.42, 0.5}}, 0.17});
        for (int i = 0; i < 60; ++i) {
            const Ball parent = balls_[random() % balls_.size()];
            const double angle = 6.2831853 * unit(random);
            const double rise = 0.05 + 0.9 * unit(random);
            const double flat = std::sqrt(1 - rise * rise);
            const double radius = std::max(parent.radius * (0.45 + 0.3 * unit(random)), 0.035);
            const Vec3d direction{{flat * std::cos(angle), rise, flat * std::sin(angle)}};
            const Vec3d centre = parent.centre + 0.95 * parent.radius * direction;
            if (centre[1] + radius < 0.84 && std::fabs(centre[0] - 0.5) + radius < 0.4 &&
                std::fabs(centre[2] - 0.5) + radius < 0.4) {
                balls_.push_back({centre, radius});
            }
        }
    }

    bool emptyAround(const Vec3d& centre, double radius) const override {
        return std::none_of(balls_.begin(), balls_.end(), [&](const Ball& ball) {
            return length(centre - ball.centre) < ball.radius * kReach + radius + kWarp;
        });
    }

    double density(const Vec3d& p, int) const override { return densityOf(p, {}); }

    /// `variant`: where in the noise its detail and outline come from.
    double densityOf(const Vec3d& p, const Vec3d& variant) const {
        const Vec3d w = 5.0 * p + variant;
        const Vec3d low{{noise_(w), noise_(w + Vec3d{{40, 0, 0}}), noise_(w + Vec3d{{0, 40, 0}})}};
        const Vec3d q = p + 0.6 * kWarp * low;
        // Depth below the surface of the nearest ball, in radii; smaller balls keep finer detail.
        double depth = -1;
        for (const Ball& ball : balls_) {
            depth = std::max(depth, 1 - length(q - ball.centre) / ball.radius);
        }
        if (depth < 1 - kReach) {
            return 0;
        }
        const double detail = noise_.billows(9.0 * p + variant, 6, 0.55);
        const double base = smoothStep(0.24, 0.3, p[1] + 0.02 * low[0]);
        const double shaped = depth + 0.62 * (detail - 0.62) - 0.35 * (1 - base);
        return smoothStep(0.0, 0.16, shaped) * (0.55 + 0.45 * smoothStep(0.3, 0.8, detail));
    }

  private:
    struct Ball {
        Vec3d centre;
        double radius;
    };
    static constexpr double kReach = 1.25;  // radii that the detail adds at most
    static constexpr double kWarp = 0.03;

    Noise noise_;
    std::vector<Ball> balls_;
};

/// Three clouds of one skeleton, say droplets of three sizes: each has an outline and detail of its
/// own, and is denser in other parts.
class ColorCloud : public Shape {
  public:
    explicit ColorCloud(uint64_t seed) : cloud_(seed), noise_(seed * 31 + 7) {}

    bool coloured() const override { return true; }
    bool emptyAround(const Vec3d& centre, double radius) const override {
        return cloud_.emptyAround(centre, radius);
    }
    double density(const Vec3d& p, int channel) const override {
        const Vec3d variant{{61.0 * channel, 23.0 * channel, 0}};
        const double where = noise_.octaves(2.6 * p + variant, 2, 0.4);
        const double share = 0.15 + 0.85 * smoothStep(-0.22, 0.22, where);
        return share * cloud_.densityOf(p, variant);
    }

  private:
    Cloud cloud_;
    Noise noise_;
};

class Smoke : public Shape {
  public:
    explicit Smoke(uint64_t seed) : noise_(seed) {}

    bool emptyAround(const Vec3d& centre, double radius) const override {
        const double lo = std::max(centre[1] - radius, 0.0);
        const double hi = centre[1] + radius;
        const double x = centre[0] - 0.5;
        const double z = centre[2] - 0.5;
        return hi < 0.05 || lo > 0.97 ||
               std::sqrt(x * x + z * z) - radius > 1.6 * width(std::min(hi, 1.0)) + drift(hi);
    }

    double density(const Vec3d& p, int) const override {
        const double height = std::max(p[1], 0.0);
        // Rising air folds what it carries: warp the plume by noise that grows with height, twice.
        const Vec3d slow{{2.2 * p[0], 1.5 * p[1], 2.2 * p[2]}};
        const Vec3d sway = warp(slow, 2);
        Vec3d q = p + drift(height) * sway;
        q = q + 0.4 * drift(height) * warp(5.5 * q, 3);
        const double x = q[0] - 0.5;
        const double z = q[2] - 0.5;
        const double r = std::sqrt(x * x + z * z) / width(height);
        if (r > 1.3) {
            return 0;
        }
        // Thin folded sheets, where a warped noise crosses 0, in a faint haze; finer across the
        // plume than along it.
        const Vec3d stretched{{4.5 * q[0], 2.2 * q[1], 4.5 * q[2]}};
        const Vec3d folded = stretched + 0.55 * warp(2.0 * stretched, 3);
        const double crossing = std::fabs(noise_.octaves(folded, 3, 0.45));
        const double sheet = 1 - smoothStep(0.0, 0.055 + 0.05 * height, crossing);
        const double haze = smoothStep(0.35, 0.8, noise_.billows(3.0 * folded, 4, 0.5));
        const double body = 1 - smoothStep(0.35, 1.25, r);
        const double ends = smoothStep(0.05, 0.10, p[1]) * (1 - smoothStep(0.55, 0.95, p[1]));
        return ends * body * (0.75 * sheet * (0.4 + 0.6 * haze) + 0.05 * haze);
    }

  private:
    static double width(double height) { return 0.045 + 0.26 * std::pow(height, 1.2); }
    static double drift(double height) { return 0.02 + 0.16 * std::max(height, 0.0); }

    Vec3d warp(const Vec3d& p, int octaves) const {
        return {{noise_.octaves(p, octaves, 0.5),
                 0.5 * noise_.octaves(p + Vec3d{{51.7, 3.1, 9.2}}, octaves, 0.5),
                 noise_.octaves(p + Vec3d{{7.7, 61.3, 27.4}}, octaves, 0.5)}};
    }

    Noise noise_;
};

std::unique_ptr<Shape> makeShape(const ProceduralOptions& options) {
    if (options.kind == "smoke") {
        return std::make_unique<Smoke>(options.seed);
    }
    if (options.kind == "color-cloud") {
        return std::make_unique<ColorCloud>(options.seed);
    }
    return std::make_unique<Cloud>(options.seed);
}

/// One leaf of a shape: its mask and its buffer as the file has them. No active voxel, no buffer.
template <class Value>
void makeLeaf(const Shape& shape, int voxels, trk::LeafPlace& leaf, std::string& buffer) {
    const double voxel = 1.0 / voxels;  // in the unit cube
    const auto centreOf = [&](size_t axis, double at) { return (leaf.origin[axis] + at) * voxel; };
    leaf.mask = {};
    if (shape.emptyAround({{centreOf(0, 4), centreOf(1, 4), centreOf(2, 4)}}, 7 * voxel)) {
        return;
    }
    std::array<Value, 512> values;
    values.fill(openvdb::zeroVal<Value>());
    for (size_t i = 0; i < values.size(); ++i) {
        const size_t at[3] = {i >> 6, i >> 3 & 7, i & 7};
        Vec3d p;
        bool inside = true;
        for (size_t a = 0; a < 3; ++a) {
            inside = inside && leaf.origin[a] + static_cast<int>(at[a]) < voxels;
            p[static_cast<int>(a)] = centreOf(a, static_cast<double>(at[a]) + 0.5);
        }
        trk::Sample<Value> sample{};
        bool any = false;
        for (size_t c = 0; c < sample.size() && inside; ++c) {
            const double d = shape.density(p, static_cast<int>(c));
            sample[c] = d > kLeast ? static_cast<float>(d) : 0.0f;
            any = any || d > kLeast;
        }
        if (any) {
            values[i] = trk::fromFloats<Value>(sample.data());
            leaf.mask[i >> 6] |= uint64_t{1} << (i & 63);
        }
    }
    if (leaf.mask != decltype(leaf.mask){}) {
        trk::encodeLeaf(leaf, values.data(), buffer);
    }
}

/// The shape's leaves, node of 16^3 after node, as a file has them: their values go to `buffers`,
/// which is written and not committed, so that no more than one node is in memory.
template <class Value>
std::vector<trk::LeafPlace> makeLeaves(const Shape& shape, int voxels,
                                       const trk::OutputFile& buffers,
                                       const std::function<void(double)>& progress) {
    constexpr int32_t kLeaf = 8;
    constexpr int32_t kNode = 128;
    constexpr size_t kPerNode = 16 * 16 * 16;
    std::vector<trk::LeafPlace> all;
    std::ofstream out(buffers.path(), std::ios::binary);
    const auto nodes = static_cast<size_t>((voxels + kNode - 1) / kNode);
    std::atomic<size_t> done{0};
    for (size_t n = 0; n < nodes * nodes * nodes; ++n) {
        std::vector<trk::LeafPlace> leaves(kPerNode);
        std::vector<std::string> buffer(kPerNode);
        trk::parallelFor(kPerNode, 4, [&](size_t i) {
            const size_t node[3] = {n / (nodes * nodes), n / nodes % nodes, n % nodes};
            const size_t leaf[3] = {i >> 8, i >> 4 & 15, i & 15};
            bool inside = true;
            for (size_t a = 0; a < 3; ++a) {
                leaves[i].origin[a] =
                    kNode * static_cast<int32_t>(node[a]) + kLeaf * static_cast<int32_t>(leaf[a]);
                inside = inside && leaves[i].origin[a] < voxels;
            }
            if (inside) {
                makeLeaf<Value>(shape, voxels, leaves[i], buffer[i]);
            }
            progress(static_cast<double>(++done) /
                     static_cast<double>(nodes * nodes * nodes * kPerNode));
        });
        for (size_t i = 0; i < kPerNode; ++i) {
            if (!buffer[i].empty()) {
                all.push_back(leaves[i]);
                out.write(buffer[i].data(), static_cast<std::streamsize>(buffer[i].size()));
            }
        }
    }
    out.close();
    if (!out) {
        throw trk::Error(TRK_ERROR_IO, buffers.target() + ": cannot be written: is the disk full?");
    }
    return all;
}

}  // namespace

const std::vector<std::string>& proceduralKinds() {
    static const std::vector<std::string> kinds{"cloud", "smoke", "color-cloud"};
    return kinds;
}

ProceduralSummary writeProcedural(const ProceduralOptions& options, const trk::OutputFile& file,
                                  const std::function<void(double)>& progress) {
    openvdb::initialize();
    const std::unique_ptr<Shape> shape = makeShape(options);
    ProceduralSummary summary;
    summary.voxelSize = kBoxSize / options.voxels;
    const auto write = [&](const openvdb::GridBase::Ptr& grid, auto zero) {
        using Value = decltype(zero);
        // Of the file's own name, which it never gets.
        const trk::OutputFile buffers(file.target(), true);
        const trk::EncodedTree tree =
            trk::encodeLeaves<Value>(makeLeaves<Value>(*shape, options.voxels, buffers, progress));
        summary.activeVoxels = tree.activeVoxels;
        grid->setName("density");
        grid->setGridClass(openvdb::GRID_FOG_VOLUME);
        grid->setTransform(openvdb::math::Transform::createLinearTransform(summary.voxelSize));
        trk::VdbWriter writer(file, 1);
        writer.add(grid, tree, buffers);
        writer.finish();
    };
    if (shape->coloured()) {
        write(openvdb::Vec3SGrid::create(), openvdb::Vec3f(0));
    } else {
        write(openvdb::FloatGrid::create(), 0.0f);
    }
    return summary;
}

}  // namespace vdbtools
