// SPDX-License-Identifier: Apache-2.0
#include "control_fit.h"

#include "hash.h"
#include "parallel.h"

#include <algorithm>
#include <cmath>
#include <functional>
#include <limits>
#include <numeric>

namespace trk {

namespace {

constexpr uint32_t kNoPart = 0xffffffffu;

// Beside super-voxels whose corners are 0, a fit that keeps the mass must exceed the density: by
// about a half where that is a plane. Beyond twice it, mass is better lost.
constexpr double kOvershoot = 2;
constexpr auto kLargest = static_cast<double>(std::numeric_limits<float>::max());

}  // namespace

std::array<float, 3> fitGradient(const CornerMoments& moments, int size) {
    const double n = size;
    const double spread = gradientSpread(n);
    std::array<float, 3> gradient{};
    for (size_t axis = 0; axis < 3; ++axis) {
        double difference = 0;
        for (size_t corner = 0; corner < 8; ++corner) {
            difference += (corner >> (2 - axis) & 1 ? 1 : -1) * moments[corner];
        }
        gradient[axis] = static_cast<float>(
            std::min(std::max(0.5 * n * difference / spread, -kLargest), kLargest));
    }
    return gradient;
}

size_t CornerFit::Hash::operator()(const Int3& p) const {
    return hashWords(p.data(), p.size(), 0);
}

CornerFit::CornerFit(const std::vector<Cell>& cells, const Given& given, int size) {
    for (int i = 0; i <= size; ++i) {
        const double hat = static_cast<double>(i) / size;
        const double weight = i == 0 || i == size ? 0.5 : 1;
        diagonal_ += weight * hat * hat / size;
        coupling_ += weight * hat * (1 - hat) / size;
    }
    cornersOf_.reserve(cells.size());
    for (const Cell& cell : cells) {
        std::array<uint32_t, 8> corners{};
        for (size_t k = 0; k < 8; ++k) {
            const auto bit = [k](int shift) { return static_cast<int64_t>(k >> shift & 1); };
            const Int3 at{{cell.at[0] + bit(2), cell.at[1] + bit(1), cell.at[2] + bit(0)}};
            const auto [it, isNew] = ids_.try_emplace(at, static_cast<uint32_t>(ids_.size()));
            if (isNew) {
                const std::optional<float> value = given(at);
                values_.push_back(value ? static_cast<double>(*value) : 0);
                free_.push_back(value ? 0 : 1);
                caps_.push_back(0);
            }
            corners[k] = it->second;
            const double cap = std::min(kOvershoot * cell.max, kLargest);
            caps_[it->second] = std::max(caps_[it->second], cap);
        }
        const auto parity =
            static_cast<size_t>((cell.at[0] & 1) << 2 | (cell.at[1] & 1) << 1 | (cell.at[2] & 1));
        independent_[parity].push_back(static_cast<uint32_t>(cornersOf_.size()));
        cornersOf_.push_back(corners);
    }
    findParts();
    fit(cells);
}

float CornerFit::value(const Int3& corner) const {
    return static_cast<float>(values_[ids_.at(corner)]);
}

/// Cells that share free corners, directly or over others, are one part.
void CornerFit::findParts() {
    std::vector<uint32_t> leader(values_.size());
    std::iota(leader.begin(), leader.end(), 0u);
    const auto find = [&](uint32_t corner) {
        while (leader[corner] != corner) {
            corner = leader[corner] = leader[leader[corner]];
        }
        return corner;
    };
    constexpr uint32_t kNone = 0xffffffffu;
    std::vector<uint32_t> anyFree(cornersOf_.size(), kNone);
    for (size_t i = 0; i < cornersOf_.size(); ++i) {
        for (const uint32_t corner : cornersOf_[i]) {
            if (free_[corner]) {
                anyFree[i] = anyFree[i] == kNone ? corner : anyFree[i];
                leader[find(corner)] = find(anyFree[i]);
            }
        }
    }
    std::vector<uint32_t> partOfLeader(values_.size(), kNoPart);
    for (const uint32_t corner : anyFree) {
        uint32_t part = kNoPart;
        if (corner != kNone) {
            uint32_t& known = partOfLeader[find(corner)];
            known = known == kNoPart ? static_cast<uint32_t>(partCount_++) : known;
            part = known;
        }
        partOf_.push_back(part);
    }
}

/// The Gram matrix of all corners' hat functions times x: in each cell, a product of three
/// one-dimensional ones.
void CornerFit::multiply(const std::vector<double>& x, std::vector<double>& result) const {
    std::fill(result.begin(), result.end(), 0.0);
    for (const std::vector<uint32_t>& cells : independent_) {
        parallelFor(cells.size(), 1024, [&](size_t i) {
            const std::array<uint32_t, 8>& corners = cornersOf_[cells[i]];
            double v[8];
            for (size_t k = 0; k < 8; ++k) {
                v[k] = x[corners[k]];
            }
            for (const size_t stride : {4u, 2u, 1u}) {
                for (size_t k = 0; k < 8; ++k) {
                    if ((k & stride) == 0) {
                        const double a = v[k];
                        const double b = v[k + stride];
                        v[k] = diagonal_ * a + coupling_ * b;
                        v[k + stride] = coupling_ * a + diagonal_ * b;
                    }
                }
            }
            for (size_t k = 0; k < 8; ++k) {
                result[corners[k]] += v[k];
            }
        });
    }
}

/// Conjugate gradients on the free corners, from x on. Each has eight cells around it, unless a
/// test says otherwise: the condition number is then at most 27.
void CornerFit::solve(const std::vector<double>& right, std::vector<double>& x) const {
    constexpr int kMaxSteps = 200;
    constexpr double kTolerance = 1e-11;  // values end as floats
    const size_t n = x.size();
    const auto dot = [&](const std::vector<double>& a, const std::vector<double>& b) {
        double sum = 0;
        for (size_t i = 0; i < n; ++i) {
            sum += free_[i] ? a[i] * b[i] : 0;
        }
        return sum;
    };
    std::vector<double> product(n);
    std::vector<double> residual(n);
    multiply(x, product);
    for (size_t i = 0; i < n; ++i) {
        residual[i] = free_[i] ? right[i] - product[i] : 0;
    }
    std::vector<double> direction = residual;
    double squares = dot(residual, residual);
    const double goal = kTolerance * kTolerance * dot(right, right);
    for (int step = 0; step < kMaxSteps && squares > goal; ++step) {
        multiply(direction, product);
        const double length = squares / dot(direction, product);
        for (size_t i = 0; i < n; ++i) {
            if (free_[i]) {
                x[i] += length * direction[i];
                residual[i] -= length * product[i];
            }
        }
        const double next = dot(residual, residual);
        const double keep = next / squares;
        squares = next;
        for (size_t i = 0; i < n; ++i) {
            direction[i] = free_[i] ? residual[i] + keep * direction[i] : 0;
        }
    }
}

void CornerFit::fit(const std::vector<Cell>& cells) {
    const size_t n = values_.size();
    std::vector<double> right(n, 0);
    std::vector<double> mass(cells.size(), 0);  // per super-voxel, as is every mass here
    for (size_t i = 0; i < cells.size(); ++i) {
        for (size_t k = 0; k < 8; ++k) {
            right[cornersOf_[i][k]] += (*cells[i].moments)[k];
            mass[i] += (*cells[i].moments)[k];
        }
    }
    // Corners that come out beyond their limits are held at them, and the others fitted again.
    constexpr int kMaxRounds = 12;
    for (int round = 0; round < kMaxRounds; ++round) {
        solve(right, values_);
        keepMass(mass);
        bool held = false;
        for (size_t i = 0; i < n; ++i) {
            const double limited = std::min(std::max(values_[i], 0.0), caps_[i]);
            if (free_[i] && values_[i] != limited) {
                values_[i] = limited;
                free_[i] = 0;
                held = true;
            }
        }
        if (!held) {
            break;
        }
    }
}

/// Least squares alone would add mass: beside empty super-voxels, where corners are 0, the next
/// ones overshoot. Each part's mass is corrected where single super-voxels' masses are off, and not
/// where the fit is good.
void CornerFit::keepMass(const std::vector<double>& mass) {
    const size_t n = values_.size();
    std::vector<double> weight(n, 0);
    std::vector<double> excess(partCount_, 0);
    for (size_t i = 0; i < mass.size(); ++i) {
        if (partOf_[i] == kNoPart) {
            continue;
        }
        double fitted = 0;
        for (const uint32_t corner : cornersOf_[i]) {
            fitted += 0.125 * values_[corner];
        }
        excess[partOf_[i]] += fitted - mass[i];
        for (const uint32_t corner : cornersOf_[i]) {
            weight[corner] += std::fabs(fitted - mass[i]);
        }
    }
    std::vector<double> direction(n, 0);
    solve(weight, direction);
    std::vector<double> response(partCount_, 0);
    std::vector<uint32_t> partOfCorner(n, kNoPart);
    for (size_t i = 0; i < mass.size(); ++i) {
        for (const uint32_t corner : cornersOf_[i]) {
            if (free_[corner]) {
                response[partOf_[i]] += 0.125 * direction[corner];
                partOfCorner[corner] = partOf_[i];
            }
        }
    }
    for (size_t i = 0; i < n; ++i) {
        const uint32_t part = partOfCorner[i];
        if (part != kNoPart && response[part] > 0) {
            values_[i] -= excess[part] / response[part] * direction[i];
        }
    }
}

}  // namespace trk
