// SPDX-License-Identifier: Apache-2.0
#include "baselines.h"

#include <nanovdb/util/OpenToNanoVDB.h>
#include <nanovdb/util/SampleFromVoxels.h>
#include <openvdb/math/DDA.h>
#include <openvdb/math/Ray.h>
#include <openvdb/math/Stencils.h>
#include <openvdb/tools/Morphology.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <utility>
#include <vector>

namespace baselines {
namespace {

constexpr int kResolution = 64;
constexpr float kInfinity = std::numeric_limits<float>::infinity();

using Vec3f = std::array<float, 3>;

/// pcg32 [O'Neill 2014].
class Random {
  public:
    Random(uint64_t seed, uint64_t ray) : state_(seed * 0x9e3779b97f4a7c15u + ray) {
        next();
        state_ += ray * 0xbf58476d1ce4e5b9u;
        next();
    }
    float uniform() { return static_cast<float>(next() >> 8) * 0x1p-24f; }

  private:
    uint32_t next() {
        const uint64_t old = state_;
        state_ = old * 0x5851f42d4c957f2du + 0x14057b7ef767814fu;
        const auto shifted = static_cast<uint32_t>(((old >> 18) ^ old) >> 27);
        const auto turn = static_cast<uint32_t>(old >> 59);
        return shifted >> turn | shifted << (-turn & 31);
    }
    uint64_t state_;
};

/// The part of [tMin, tMax] in a box; whether there is any.
bool clip(const Vec3f& origin, const Vec3f& direction, const Vec3f& lo, const Vec3f& hi,
          float& tMin, float& tMax) {
    for (size_t a = 0; a < 3; ++a) {
        const float inverse = 1 / direction[a];
        float near = (lo[a] - origin[a]) * inverse;
        float far = (hi[a] - origin[a]) * inverse;
        if (near > far) {
            std::swap(near, far);
        }
        tMin = near > tMin ? near : tMin;
        tMax = far < tMax ? far : tMax;
    }
    return tMin < tMax;
}

}  // namespace

struct RatioTracking::Medium {
    nanovdb::GridHandle<> handle;
    const nanovdb::FloatGrid* grid = nullptr;
    float voxel = 1;  // edge, in world units
    Vec3f offset{};   // world position of voxel 0
    Vec3f lo{};       // index space
    Vec3f hi{};
    std::vector<float> majorants;  // of the density

    float transmittance(const TrkRay& ray, float scale, Random random, uint64_t& lookups,
                        uint64_t& crossings) const {
        // To index space; t keeps its meaning.
        Vec3f origin;
        Vec3f direction;
        float squares = 0;
        for (size_t a = 0; a < 3; ++a) {
            origin[a] = (ray.origin[a] - offset[a]) / voxel;
            direction[a] = ray.direction[a] / voxel;
            squares += ray.direction[a] * ray.direction[a];
        }
        float t = ray.tMin;
        float tEnd = ray.tMax;
        if (!clip(origin, direction, lo, hi, t, tEnd)) {
            return 1;
        }
        const float sigma = scale * std::sqrt(squares);  // per t, of a density of 1
        // The DDA, in units of the grid of majorants.
        std::array<int, 3> cell{};
        std::array<int, 3> step{};
        std::array<int, 3> limit{};
        Vec3f next;
        Vec3f delta;
        for (size_t a = 0; a < 3; ++a) {
            const float edge = (hi[a] - lo[a]) / kResolution;
            const float at = (origin[a] + t * direction[a] - lo[a]) / edge;
            const float speed = direction[a] / edge;
            cell[a] = std::min(std::max(static_cast<int>(at), 0), kResolution - 1);
            const bool forwards = speed >= 0;
            step[a] = forwards ? 1 : -1;
            limit[a] = forwards ? kResolution : -1;
            delta[a] = speed == 0 ? kInfinity : 1 / std::fabs(speed);
            next[a] = speed == 0
                          ? kInfinity
                          : t + (static_cast<float>(cell[a] + (forwards ? 1 : 0)) - at) / speed;
        }
        auto accessor = grid->getAccessor();
        const auto sampler = nanovdb::createSampler<1, decltype(accessor), false>(accessor);
        float weight = 1;
        while (t < tEnd) {
            const size_t axis =
                next[0] < next[1] ? (next[0] < next[2] ? 0 : 2) : (next[1] < next[2] ? 1 : 2);
            const float tExit = std::min(next[axis], tEnd);
            const float majorant =
                sigma * majorants[static_cast<size_t>(
                            (cell[0] * kResolution + cell[1]) * kResolution + cell[2])];
            ++crossings;
            while (majorant > 0) {
                t -= std::log(1 - random.uniform()) / majorant;
                if (!(t < tExit)) {
                    break;
                }
                ++lookups;
                const float density = sampler(nanovdb::Vec3f(origin[0] + t * direction[0],
                                                             origin[1] + t * direction[1],
                                                             origin[2] + t * direction[2]));
                weight *= std::max(0.0f, 1 - sigma * density / majorant);
                if (weight < 0.05f) {
                    constexpr float kEnd = 0.75f;
                    if (random.uniform() < kEnd) {
                        return 0;
                    }
                    weight /= 1 - kEnd;
                }
            }
            t = tExit;
            cell[axis] += step[axis];
            if (cell[axis] == limit[axis]) {
                break;
            }
            next[axis] += delta[axis];
        }
        return weight;
    }
};

RatioTracking::RatioTracking(const openvdb::FloatGrid& grid) {
    auto medium = std::make_unique<Medium>();
    medium->handle = nanovdb::openToNanoVDB(grid);
    medium->grid = medium->handle.grid<float>();
    medium->voxel = static_cast<float>(grid.voxelSize()[0]);
    const openvdb::Vec3d zero = grid.indexToWorld(openvdb::Vec3d(0, 0, 0));
    const openvdb::CoordBBox box = grid.evalActiveVoxelBoundingBox();
    for (int a = 0; a < 3; ++a) {
        const auto axis = static_cast<size_t>(a);
        medium->offset[axis] = static_cast<float>(zero[a]);
        medium->lo[axis] = static_cast<float>(box.min()[a] - 1);
        medium->hi[axis] = static_cast<float>(box.max()[a] + 1);
    }
    // The largest vertex among the corners of every voxel cell that a cell of majorants touches.
    medium->majorants.resize(size_t{kResolution} * kResolution * kResolution);
    const auto range = [&](size_t axis, int64_t cell) {
        const double lo = static_cast<double>(medium->lo[axis]);
        const double edge = (static_cast<double>(medium->hi[axis]) - lo) / kResolution;
        return std::pair{
            static_cast<int>(std::floor(lo + static_cast<double>(cell) * edge - 1e-3)),
            static_cast<int>(std::floor(lo + static_cast<double>(cell + 1) * edge + 1e-3)) + 1};
    };
    auto accessor = medium->grid->getAccessor();
    size_t i = 0;
    for (int x = 0; x < kResolution; ++x) {
        for (int y = 0; y < kResolution; ++y) {
            for (int z = 0; z < kResolution; ++z, ++i) {
                float most = 0;
                for (int vx = range(0, x).first; vx <= range(0, x).second; ++vx) {
                    for (int vy = range(1, y).first; vy <= range(1, y).second; ++vy) {
                        for (int vz = range(2, z).first; vz <= range(2, z).second; ++vz) {
                            most = std::max(most, accessor.getValue({vx, vy, vz}));
                        }
                    }
                }
                medium->majorants[i] = most;
            }
        }
    }
    medium_ = std::move(medium);
}

RatioTracking::~RatioTracking() = default;

void RatioTracking::transmittance(const TrkRay* rays, size_t count, float scale, uint64_t seed,
                                  float* result, uint64_t& lookups, uint64_t& crossings) const {
    for (size_t i = 0; i < count; ++i) {
        result[i] = medium_->transmittance(rays[i], scale, Random(seed, i), lookups, crossings);
    }
}

struct Integration::Topology {
    const openvdb::FloatGrid& grid;
    openvdb::BoolTree tree;  // what interpolation reaches
    openvdb::CoordBBox box;
};

Integration::Integration(const openvdb::FloatGrid& grid) {
    openvdb::BoolTree tree(grid.tree(), false, openvdb::TopologyCopy());
    openvdb::tools::dilateActiveValues(tree, 1, openvdb::tools::NN_FACE_EDGE_VERTEX,
                                       openvdb::tools::EXPAND_TILES);
    openvdb::CoordBBox box;
    tree.root().evalActiveBoundingBox(box, false);
    box.max().offset(1);
    topology_ = std::make_unique<const Topology>(Topology{grid, std::move(tree), box});
}

Integration::~Integration() = default;

void Integration::transmittance(const TrkRay* rays, size_t count, float scale, float* result,
                                uint64_t& cells) const {
    using Ray = openvdb::math::Ray<double>;
    using Root = openvdb::BoolTree::RootNodeType;
    const Topology& topology = *topology_;
    openvdb::tree::ValueAccessor<const openvdb::BoolTree> accessor(topology.tree);
    openvdb::math::BoxStencil<openvdb::FloatGrid> stencil(topology.grid);
    openvdb::math::VolumeHDDA<openvdb::BoolTree, Ray, Root::ChildNodeType::LEVEL> leaves;
    const double voxel = topology.grid.voxelSize()[0];
    constexpr double kGauss = 0.57735026918962576451;  // 1/sqrt(3)
    for (size_t i = 0; i < count; ++i) {
        const TrkRay& from = rays[i];
        const openvdb::Vec3d direction(from.direction);
        const double length = direction.length();
        // In index space its direction has unit length, and times count voxels.
        Ray ray =
            Ray(openvdb::Vec3d(from.origin), direction / length,
                static_cast<double>(from.tMin) * length, static_cast<double>(from.tMax) * length)
                .worldToIndex(topology.grid);
        double depth = 0;
        if (ray.clip(topology.box)) {
            const double tEnd = ray.t1();
            for (;;) {
                const Ray::TimeSpan span = leaves.march(ray, accessor);
                if (!span.valid()) {
                    break;
                }
                openvdb::math::DDA<Ray> dda(ray, span.t0, span.t1);
                do {
                    const double t0 = dda.time();
                    const double t1 = dda.next();
                    const double half = 0.5 * (t1 - t0);
                    const double offset = half * kGauss;
                    stencil.moveTo(dda.voxel());
                    depth +=
                        half * static_cast<double>(stencil.interpolation(ray(t0 + half - offset)) +
                                                   stencil.interpolation(ray(t0 + half + offset)));
                    ++cells;
                } while (dda.step());
                ray.setTimes(span.t1 + openvdb::math::Delta<double>::value(), tEnd);
            }
        }
        result[i] = static_cast<float>(std::exp(-static_cast<double>(scale) * voxel * depth));
    }
}

}  // namespace baselines
