// SPDX-License-Identifier: Apache-2.0
#include "coarser.h"

#include "control_fit.h"
#include "field/table_builder.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <limits>
#include <optional>

namespace trk {
namespace {

using Entry = SparseTable::Entry;

/// One channel of eight super-voxels that make one, x slowest; NULL where there is none.
struct Octants {
    std::array<const BakedSuperVoxel*, 8> items{};
    std::array<const float*, 8> gradients{};
    std::array<ControlPolynomial, 8> controls{};
    int size;  ///< of each, in voxels

    /// Where the middle of one is, from that of all, in voxels.
    double offset(size_t octant, size_t axis) const {
        return (octant >> (2 - axis) & 1 ? 0.5 : -0.5) * size;
    }
    double mean(size_t octant) const {
        return items[octant] ? static_cast<double>(items[octant]->mean) : 0.0;
    }
    double gradient(size_t octant, size_t axis) const {
        return items[octant] ? static_cast<double>(gradients[octant][axis]) : 0.0;
    }
};

/// What does not depend on the control. Sums over vertices add up, as each counts by its part in a
/// super-voxel.
BakedSuperVoxel statisticsOf(const Octants& octants) {
    BakedSuperVoxel v;
    v.min = std::numeric_limits<float>::infinity();
    double mean = 0;
    for (size_t i = 0; i < 8; ++i) {
        v.min = std::min(v.min, octants.items[i] ? octants.items[i]->min : 0.0f);
        v.max = std::max(v.max, octants.items[i] ? octants.items[i]->max : 0.0f);
        mean += octants.mean(i) / 8;
    }
    v.mean = std::min(std::max(static_cast<float>(mean), v.min), v.max);
    if (v.min == v.max) {
        return v;
    }
    double square = 0;
    for (size_t i = 0; i < 8; ++i) {
        const double deviation =
            octants.items[i] ? static_cast<double>(octants.items[i]->deviation) : 0.0;
        // Means are floats: so much more they may be off.
        const double off =
            std::fabs(octants.mean(i) - static_cast<double>(v.mean)) + 0x1p-24 * octants.mean(i);
        square += (deviation * deviation + off * off) / 8;
    }
    const double reach = std::max(static_cast<double>(v.mean) - static_cast<double>(v.min),
                                  static_cast<double>(v.max) - static_cast<double>(v.mean));
    v.majorant = roundUp(reach);
    v.deviation = std::min(roundUp(std::sqrt(square)), v.majorant);
    v.rms = v.deviation;
    return v;
}

/// The least-squares gradient: first moments add up, those about an octant's middle and those of
/// its mean about the middle of all.
std::array<float, 3> gradientOf(const Octants& octants) {
    std::array<float, 3> result{};
    for (size_t axis = 0; axis < 3; ++axis) {
        double moment = 0;
        for (size_t i = 0; i < 8; ++i) {
            moment += (octants.gradient(i, axis) * gradientSpread(octants.size) +
                       octants.mean(i) * octants.offset(i, axis)) /
                      8;
        }
        constexpr auto kLargest = static_cast<double>(std::numeric_limits<float>::max());
        const double gradient = moment / gradientSpread(2 * octants.size);
        result[axis] = static_cast<float>(std::min(std::max(gradient, -kLargest), kLargest));
    }
    return result;
}

/// What an affine control leaves, in each octant: of the density's own least-squares fit there, to
/// which what fits differ by is orthogonal, and the bound of what its control leaves and the two
/// controls differ by, or of what its bounds leave.
void setResidual(const Octants& octants, const ControlPolynomial& control, BakedSuperVoxel& v) {
    // Deviations are rounded up, and gradients to float: not more than that is left by a difference
    // of squares.
    constexpr double kRounding = 1e-6;
    double square = 0;
    double bound = 0;
    for (size_t i = 0; i < 8; ++i) {
        Vec3d middle;
        std::array<double, 3> slope{};  // of the control, a voxel
        for (size_t axis = 0; axis < 3; ++axis) {
            slope[axis] = control.slope[axis] / (2 * octants.size);
            middle[static_cast<int>(axis)] = octants.offset(i, axis) / (2 * octants.size);
        }
        const double there = control.at(middle);
        double fitted = 0;
        double differing = 0;
        double reach = 0;  // of the control in the octant
        double deviating = std::fabs(octants.controls[i].centre - there);
        for (size_t axis = 0; axis < 3; ++axis) {
            const double g = octants.gradient(i, axis);
            fitted += g * g;
            differing += (g - slope[axis]) * (g - slope[axis]);
            reach += 0.5 * octants.size * std::fabs(slope[axis]);
            deviating +=
                0.5 * std::fabs(octants.controls[i].slope[axis] - slope[axis] * octants.size);
        }
        const BakedSuperVoxel none;
        const BakedSuperVoxel& item = octants.items[i] ? *octants.items[i] : none;
        const double deviation = static_cast<double>(item.deviation);
        const double spread = gradientSpread(octants.size);
        const double own = deviation * deviation;
        const double off = std::fabs(octants.mean(i) - there) + 0x1p-24 * octants.mean(i);
        square += (std::max(own - fitted * spread, 0.0) + kRounding * own + off * off +
                   differing * spread) /
                  8;
        bound = std::max(bound, std::min(std::max(static_cast<double>(item.max) - (there - reach),
                                                  there + reach - static_cast<double>(item.min)),
                                         static_cast<double>(item.majorant) + deviating));
    }
    // Whoever evaluates the control again may round differently.
    const double rounding = 1e-14 * (static_cast<double>(v.max) + control.max());
    v.majorant = roundUp(bound + rounding);
    v.rms = std::min(roundUp(std::sqrt(square) + rounding), v.majorant);
}

class Coarsener {
  public:
    explicit Coarsener(const BakedVolume& finer) : finer_(finer) {
        baked_.superVoxelShift = finer.superVoxelShift + 1;
        baked_.channels = finer.channels;
        baked_.kind = finer.kind;
    }

    BakedVolume coarsen() {
        const SparseTable& table = finer_.table;
        const int shift = baked_.superVoxelShift;
        baked_.table =
            TableBuilder(shift, table.occupiedBox())
                .fill(
                    {&table},
                    [&](const Int3& origin, int regionShift) -> std::optional<Entry> {
                        const auto entry = table.uniformEntry(origin, regionShift);
                        if (!entry || *entry == SparseTable::kEmpty) {
                            return entry;
                        }
                        if (!finer_.isHomogeneous(SparseTable::index(*entry) * finer_.channels)) {
                            return std::nullopt;
                        }
                        std::array<Entry, 8> octants{};
                        octants.fill(*entry);
                        return add(octants);
                    },
                    [&](const Int3& origin) {
                        std::array<Entry, 8> octants{};
                        for (int64_t i = 0; i < 8; ++i) {
                            const int64_t half = finer_.superVoxelSize();
                            octants[static_cast<size_t>(i)] =
                                table
                                    .find(origin[0] + (i >> 2) * half,
                                          origin[1] + (i >> 1 & 1) * half,
                                          origin[2] + (i & 1) * half)
                                    .entry;
                        }
                        return add(octants);
                    },
                    [&](const Int3& origin, int regionShift, SparseTable::Key& key) {
                        return regionShift > shift && table.appendKey(origin, regionShift, key);
                    });
        if (!finer_.levels.empty()) {
            baked_.levels.assign(finer_.levels.begin() + 1, finer_.levels.end());
        }
        return std::move(baked_);
    }

  private:
    Entry add(const std::array<Entry, 8>& entries) {
        if (entries == std::array<Entry, 8>{}) {
            return SparseTable::kEmpty;
        }
        bool isHomogeneous = true;
        for (size_t c = 0; c < finer_.channels; ++c) {
            const Octants octants = octantsOf(entries, c);
            BakedSuperVoxel v = statisticsOf(octants);
            const auto gradient = v.min == v.max ? std::array<float, 3>{} : gradientOf(octants);
            baked_.gradients.insert(baked_.gradients.end(), gradient.begin(), gradient.end());
            if (baked_.kind == ControlKind::kAffine) {
                const auto shape = constrainGradient(gradient.data(), static_cast<double>(v.mean),
                                                     baked_.superVoxelSize());
                baked_.shapes.insert(baked_.shapes.end(), shape.begin(), shape.end());
                if (v.min < v.max) {
                    const float* stored = baked_.shapes.data() + (baked_.shapes.size() - 3);
                    setResidual(
                        octants,
                        controlPolynomial(baked_.kind, v.mean, stored, baked_.superVoxelSize()), v);
                }
            }
            isHomogeneous = isHomogeneous && v.min == v.max;
            baked_.items.push_back(v);
        }
        const auto entry = static_cast<Entry>(baked_.items.size() / baked_.channels);
        return baked_.kind == ControlKind::kConstant || isHomogeneous
                   ? entry
                   : entry | SparseTable::kSingleFlag;
    }
    Octants octantsOf(const std::array<Entry, 8>& entries, size_t channel) const {
        Octants octants;
        octants.size = finer_.superVoxelSize();
        for (size_t i = 0; i < 8; ++i) {
            if (entries[i] != SparseTable::kEmpty) {
                const size_t item = SparseTable::index(entries[i]) * finer_.channels + channel;
                octants.items[i] = &finer_.items[item];
                octants.gradients[i] = &finer_.gradients[3 * item];
                octants.controls[i] = finer_.control(item);
            }
        }
        return octants;
    }

    const BakedVolume& finer_;
    BakedVolume baked_;
};

}  // namespace

BakedVolume coarser(const BakedVolume& finer) {
    return Coarsener(finer).coarsen();
}

}  // namespace trk
