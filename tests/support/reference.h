// SPDX-License-Identifier: Apache-2.0
// Slow, independent answers in double precision, straight from an OpenVDB grid: no brick, no table,
// no walk of the library is involved.
#pragma once

#include "io/openvdb_grids.h"
#include "track/track.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

namespace reference {

/// A ray in index space, in double, over the part where the grid's trilinear field is not 0.
struct IndexRay {
    openvdb::Vec3d origin;
    openvdb::Vec3d direction;
    double lengthPerT = 0;  ///< in world units
    double t0 = 0;
    double t1 = 0;

    bool hits() const { return t0 < t1; }
    openvdb::Vec3d at(double t) const { return origin + t * direction; }
};

/// Integral of g(t) over [t0, t1] of origin + t direction, by 4-point Gauss between consecutive
/// integer planes: exact where g is a polynomial of degree 7 in each cell. g may answer a vector.
template <class Vector, class G>
auto integrateCells(const Vector& origin, const Vector& direction, double t0, double t1,
                    const G& g) {
    std::vector<double> cuts{t0, t1};
    for (int a = 0; a < 3; ++a) {
        const double x0 = origin[a] + t0 * direction[a];
        const double x1 = origin[a] + t1 * direction[a];
        for (double plane = std::ceil(std::min(x0, x1)); plane <= std::max(x0, x1); plane += 1) {
            const double t = (plane - origin[a]) / direction[a];
            if (t > t0 && t < t1) {
                cuts.push_back(t);
            }
        }
    }
    std::sort(cuts.begin(), cuts.end());
    const double nodes[4] = {-0.86113631159405257522, -0.33998104358485626480,
                             0.33998104358485626480, 0.86113631159405257522};
    const double weights[4] = {0.34785484513745385737, 0.65214515486254614263,
                               0.65214515486254614263, 0.34785484513745385737};
    decltype(g(t0)) sum{};
    for (size_t i = 1; i < cuts.size(); ++i) {
        const double half = 0.5 * (cuts[i] - cuts[i - 1]);
        const double middle = 0.5 * (cuts[i] + cuts[i - 1]);
        for (int k = 0; k < 4; ++k) {
            sum += (half * weights[k]) * g(middle + half * nodes[k]);
        }
    }
    return sum;
}

template <class GridType>
class Field {
  public:
    explicit Field(const GridType& grid) : grid_(grid), accessor_(grid.getConstAccessor()) {
        box_ = grid.evalActiveVoxelBoundingBox();
    }

    IndexRay clip(const TrkRay& ray) const {
        IndexRay r;
        const openvdb::Vec3d o(ray.origin[0], ray.origin[1], ray.origin[2]);
        const openvdb::Vec3d d(ray.direction[0], ray.direction[1], ray.direction[2]);
        r.origin = grid_.worldToIndex(o);
        // worldToIndex of a far point and a near one would cancel; the map's linear part does not.
        r.direction = grid_.transform().baseMap()->applyInverseJacobian(d);
        r.lengthPerT = d.length();
        r.t0 = ray.tMin;
        r.t1 = ray.tMax;
        for (int a = 0; a < 3; ++a) {
            const double lo = box_.min()[static_cast<unsigned>(a)] - 1.0;
            const double hi = box_.max()[static_cast<unsigned>(a)] + 1.0;
            if (r.direction[a] == 0) {
                if (r.origin[a] < lo || r.origin[a] > hi) {
                    r.t1 = -std::numeric_limits<double>::infinity();
                }
                continue;
            }
            const double ta = (lo - r.origin[a]) / r.direction[a];
            const double tb = (hi - r.origin[a]) / r.direction[a];
            r.t0 = std::max(r.t0, std::min(ta, tb));
            r.t1 = std::min(r.t1, std::max(ta, tb));
        }
        return r;
    }

    /// Trilinear, all in double.
    double density(const openvdb::Vec3d& p) const {
        const openvdb::Coord cell = openvdb::Coord::floor(p);
        double sum = 0;
        for (int corner = 0; corner < 8; ++corner) {
            double weight = 1;
            openvdb::Coord at = cell;
            for (unsigned a = 0; a < 3; ++a) {
                const double f = p[static_cast<int>(a)] - cell[a];
                const bool upper = (corner >> a & 1) != 0;
                weight *= upper ? f : 1 - f;
                at[a] += upper ? 1 : 0;
            }
            sum += weight * static_cast<double>(accessor_.getValue(at));
        }
        return sum;
    }

    double opticalDepth(const TrkRay& ray) const {
        const IndexRay r = clip(ray);
        const auto f = [&](double t) { return density(r.at(t)); };
        return r.hits() ? r.lengthPerT * integrateCells(r.origin, r.direction, r.t0, r.t1, f) : 0;
    }

  private:
    const GridType& grid_;
    mutable typename GridType::ConstAccessor accessor_;
    openvdb::CoordBBox box_;
};

}  // namespace reference
