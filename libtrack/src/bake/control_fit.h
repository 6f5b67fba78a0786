// SPDX-License-Identifier: Apache-2.0
// Least-squares fits of a control to the density: gradients super-voxel by super-voxel, corner
// values over all of them together.
#pragma once

#include "space/geometry.h"

#include <array>
#include <cstddef>
#include <cstdint>
#include <functional>
#include <optional>
#include <unordered_map>
#include <vector>

namespace trk {

/// Sums over a super-voxel's vertices of weight x density x the hat function of each corner (x
/// slowest), over its number of cells. They add up to the mean, and say all of the density that a
/// fit of a multilinear control asks.
using CornerMoments = std::array<double, 8>;

/// Mean over the vertices of a super-voxel of (x - centre)^2, along an axis, in voxels: the
/// trapezoid rule of its integral.
inline double gradientSpread(double size) {
    return size * size / 12 + 1.0 / 6;
}

/// The gradient (density per voxel) that leaves the least squared residual around the mean.
std::array<float, 3> fitGradient(const CornerMoments& moments, int size);

/// Corner values of a continuous control over many super-voxels with the least squared residual,
/// each between 0 and twice the largest density of the super-voxels that touch it, which keep
/// the density's mass: that of every connected part of the fit by itself, as far as its corners
/// allow.
class CornerFit {
  public:
    struct Cell {
        Int3 at;  ///< in super-voxels
        const CornerMoments* moments;
        double max;  ///< of the density
    };

    /// The value of a corner that is given, or nothing for one that is to be fitted.
    using Given = std::function<std::optional<float>(const Int3& corner)>;

    /// Fits in parallel, with the same bits for any number of threads. `given` is asked once for
    /// each corner of the cells. `size`: of the super-voxels, in voxels.
    CornerFit(const std::vector<Cell>& cells, const Given& given, int size);

    /// The value of a corner of any of the cells.
    float value(const Int3& corner) const;

  private:
    struct Hash {
        size_t operator()(const Int3& p) const;
    };

    void multiply(const std::vector<double>& x, std::vector<double>& result) const;
    void solve(const std::vector<double>& right, std::vector<double>& x) const;
    void findParts();
    void fit(const std::vector<Cell>& cells);
    void keepMass(const std::vector<double>& mass);

    std::unordered_map<Int3, uint32_t, Hash> ids_;      // of corners
    std::vector<std::array<uint32_t, 8>> cornersOf_;    // of each cell
    std::array<std::vector<uint32_t>, 8> independent_;  // cells of which no two share a corner
    std::vector<double> values_;                        // of each corner
    std::vector<char> free_;                            // whether its value is to be found
    std::vector<double> caps_;                          // the largest it may have
    std::vector<uint32_t> partOf_;                      // of each cell; kNoPart without free corner
    size_t partCount_ = 0;
    double diagonal_ = 0;  // of the one-dimensional Gram matrix of the two hat functions,
    double coupling_ = 0;  // and beside it
};

}  // namespace trk
