// SPDX-License-Identifier: Apache-2.0
#include "super_voxels.h"

#include <algorithm>
#include <limits>
#include <utility>

namespace trk {
namespace {

/// By what part of the largest value around it a look-up may leave the range of its corners: three
/// interpolations in float, each of which rounds twice. Bounds cover what look-ups return. That is
/// as much for a control, whose coefficients are floats.
constexpr double kLookupRounding = 4e-7;

float withinFloat(double value) {
    return std::min(roundUp(value), std::numeric_limits<float>::max());
}

}  // namespace

BakedVolume SuperVoxels::whole(const BakedVolume& baked, const IntBox& box) {
    BakedVolume result;
    result.channels = baked.channels;
    result.superVoxelShift = baked.superVoxelShift;
    int64_t extent = 0;
    double volume = 1;
    for (size_t a = 0; a < 3; ++a) {
        extent = std::max(extent, box.hi[a]);
        volume *= static_cast<double>(box.hi[a] - box.lo[a]);
    }
    while (result.superVoxelShift < 40 && int64_t{1} << result.superVoxelShift < extent) {
        ++result.superVoxelShift;
    }
    result.table = SparseTable::uniform(result.superVoxelShift, 1);
    std::vector<double> mass(baked.channels, 0.0);
    std::vector<double> squares(baked.channels, 0.0);
    std::vector<float> max(baked.channels, 0.0f);
    baked.table.forEach([&](const Int3&, int shift, SparseTable::Entry entry) {
        const double voxels = std::ldexp(1.0, 3 * shift);
        for (size_t c = 0; c < baked.channels; ++c) {
            const BakedSuperVoxel& item =
                baked.items[SparseTable::index(entry) * baked.channels + c];
            const auto mean = static_cast<double>(item.mean);
            const auto deviation = static_cast<double>(item.deviation);
            mass[c] += voxels * mean;
            squares[c] += voxels * (mean * mean + deviation * deviation);
            max[c] = std::max(max[c], item.max);
        }
    });
    for (size_t c = 0; c < baked.channels; ++c) {
        BakedSuperVoxel item;
        item.max = max[c];  // min stays 0: a continuous density that is 0 outside is 0 at the faces
        item.mean = max[c] > 0 ? std::min(static_cast<float>(mass[c] / volume), max[c]) : 0.0f;
        const auto mean = static_cast<double>(item.mean);
        const double square = squares[c] / volume - mean * (2 * mass[c] / volume - mean);
        item.deviation = max[c] > 0 ? roundUp(std::sqrt(std::max(square, 0.0))) : 0.0f;
        item.majorant = std::max(item.max - item.mean, item.mean);
        item.rms = item.deviation;
        result.items.push_back(item);
    }
    return result;
}

SuperVoxels::SuperVoxels(BakedVolume baked)
    : table_(std::move(baked.table).flattened()),
      channels_(baked.channels),
      kind_(baked.kind),
      levels_(std::move(baked.levels)) {
    const size_t slopes = slopeSize(kind_);
    items_.reserve(baked.items.size());
    shapes_.reserve(slopes == 0 ? 0 : baked.items.size() * (ControlShape::kHead + slopes));
    for (size_t i = 0; i < baked.items.size(); ++i) {
        const BakedSuperVoxel& item = baked.items[i];
        const bool isHomogeneous = item.min == item.max;
        const double rounding = isHomogeneous ? 0 : kLookupRounding * static_cast<double>(item.max);
        SuperVoxel v{item.min, item.max, item.mean, item.deviation};
        if (isHomogeneous) {
            // It keeps its value to the bit: nothing is left to track.
            v.mean = item.min;
            v.deviation = 0;
        } else {
            v.min = roundDown(std::max(static_cast<double>(item.min) - rounding, 0.0));
            v.max = withinFloat(static_cast<double>(item.max) + rounding);
        }
        items_.push_back(v);
        if (slopes == 0) {
            continue;
        }
        const ControlPolynomial control = baked.control(i);
        const double largest = control.max();
        shapes_.push_back(isHomogeneous ? item.min : static_cast<float>(control.centre));
        shapes_.push_back(isHomogeneous ? item.min : withinFloat(largest));
        shapes_.push_back(isHomogeneous ? 0
                                        : withinFloat(static_cast<double>(item.majorant) +
                                                      rounding + kLookupRounding * largest));
        shapes_.push_back(isHomogeneous ? 0 : item.rms);
        for (size_t k = 0; k < slopes; ++k) {
            shapes_.push_back(
                isHomogeneous ? 0
                              : static_cast<float>(control.slope[k] / ControlShape::kSlopeUnit));
        }
    }
    boxes_.assign(1, table_.occupiedBox());
    for (const ValueTable& level : levels_) {
        boxes_.push_back(level.table.occupiedBox());
    }
}

size_t SuperVoxels::bytes() const {
    size_t sum = table_.bytes() + items_.capacity() * sizeof(SuperVoxel) +
                 shapes_.capacity() * sizeof(float);
    for (const ValueTable& level : levels_) {
        sum += level.table.bytes() + level.values.capacity() * sizeof(float);
    }
    return sum;
}

}  // namespace trk
