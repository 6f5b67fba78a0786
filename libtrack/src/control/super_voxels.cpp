// SPDX-License-Identifier: Apache-2.0
#include "super_voxels.h"

#include <cmath>
#include <limits>
#include <utility>

namespace trk {
namespace {

/// Of the bound. See rateAtLeast.
constexpr float kLeastRate = 0.25f;

/// By what part of the largest value around it a look-up may leave the range of its corners: three
/// interpolations in float, each of which rounds twice. Bounds cover what look-ups return.
constexpr double kLookupRounding = 4e-7;

/// How far a control may exceed the extinction. [Novak14, Eq. 6]: about D S collisions are
/// expected, each amplifies by at most 1 + (control - extinction) / S; the formula caps their
/// product at gamma = 2.
double allowedExcess(double range, double diagonal) {
    return range * std::expm1(std::log(2.0) / (diagonal * range));
}

/// A root mean square as a sampling rate: unbiased as long as it is above 0 wherever `bound` is,
/// and without weights that only a lucky sample would show.
float rateAtLeast(double rms, float bound) {
    const float least = bound > 0 ? std::numeric_limits<float>::denorm_min() : 0.0f;
    return std::max({static_cast<float>(rms), kLeastRate * bound, least});
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

double SuperVoxels::chooseControl(TrkChoice choice, double min, double mean, double max,
                                  double diagonal) {
    switch (choice) {
        case TRK_CHOICE_MIN:
            return min;
        case TRK_CHOICE_MAX:
            return max;
        case TRK_CHOICE_MEAN:
            return mean;
        default:
            break;
    }
    const double range = max - min;
    if (range <= 0) {
        return mean;
    }
    return std::min(std::max(min + allowedExcess(range, diagonal), min), mean);
}

double SuperVoxels::chooseShare(TrkChoice choice, double min, double max, double excess,
                                double diagonal) {
    const double range = max - min;
    if (choice == TRK_CHOICE_MEAN || range <= 0 || excess <= 0) {
        return 1;
    }
    // Where collisions are rare the formula allows more than the range; a constant control never
    // takes that, being the mean at most.
    return std::min(1.0, std::min(allowedExcess(range, diagonal), range) / excess);
}

SuperVoxels::SuperVoxels(BakedVolume baked, const std::vector<double>& scales, TrkChoice choice,
                         double diagonal)
    : table_(std::move(baked.table).flattened()),
      kind_(baked.kind),
      levels_(std::move(baked.levels)) {
    const size_t channels = scales.size();
    // A tinted volume has three channels of one item.
    const auto itemOf = [&](size_t i) { return baked.channels == channels ? i : i / channels; };
    const size_t count = baked.items.size() / baked.channels * channels;
    items_.reserve(count);
    ranges_.reserve(count);
    shapes_.reserve(kind_ == ControlKind::kConstant ? 0 : count * (1 + slopeSize(kind_)));
    for (size_t i = 0; i < count; ++i) {
        const BakedSuperVoxel& item = baked.items[itemOf(i)];
        const ControlPolynomial control = baked.control(itemOf(i));
        const double s = scales[i % channels];
        const double min = s * static_cast<double>(item.min);
        const double max = s * static_cast<double>(item.max);
        const double majorant = s * static_cast<double>(item.majorant);
        const double mean = s * static_cast<double>(item.mean);
        const double deviation = s * static_cast<double>(item.deviation);
        SuperVoxel v;
        ExtinctionRange range;
        v.baked = static_cast<float>(s * control.centre);
        const double lookupRounding = kLookupRounding * max;
        range.min = roundDown(std::max(min - lookupRounding, 0.0));
        range.max = roundUp(max + lookupRounding);
        double share = 1;
        double residualRms = 0;
        if (item.min == item.max) {
            // A homogeneous super-voxel keeps its value to the bit: nothing is left to track.
            v.baked = v.control = range.min = range.max = static_cast<float>(min);
            v.bound = 0;
        } else if (kind_ == ControlKind::kConstant) {
            v.control = static_cast<float>(chooseControl(choice, min, mean, max, diagonal));
            const auto chosen = static_cast<double>(v.control);
            v.bound = roundUp(std::max(chosen - min, max - chosen) + lookupRounding);
            residualRms = std::hypot(deviation, chosen - mean);
        } else {
            const double excess = std::min(majorant, s * control.max() - min);
            share = chooseShare(choice, min, max, excess, diagonal);
            v.control = static_cast<float>(min + share * (s * control.centre - min));
            // The coefficients of the control are floats too.
            const double rounding = lookupRounding + kLookupRounding * s * control.max();
            v.bound = roundUp(share * majorant + (1 - share) * (max - min) + rounding);
            // residual = share (extinction - baked control) + (1 - share) (extinction - min)
            residualRms = share * s * static_cast<double>(item.rms) +
                          (1 - share) * std::hypot(deviation, mean - min);
        }
        if (item.min != item.max &&
            range.min == range.max) {  // by rounding; it would say homogeneous
            range.max = std::nextafter(range.max, std::numeric_limits<float>::infinity());
        }
        v.residualRms = rateAtLeast(residualRms, v.bound);
        range.rms = rateAtLeast(std::hypot(deviation, mean), range.max);
        items_.push_back(v);
        ranges_.push_back(range);
        if (kind_ != ControlKind::kConstant) {
            shapes_.push_back(static_cast<float>(share));
            for (size_t k = 0; k < slopeSize(kind_); ++k) {
                const double slope = item.min == item.max ? 0 : s * control.slope[k];
                shapes_.push_back(static_cast<float>(slope));
            }
        }
    }
    for (ValueTable& level : levels_) {
        std::vector<float> extinctions(level.values.size() / baked.channels * channels);
        for (size_t i = 0; i < extinctions.size(); ++i) {
            extinctions[i] = static_cast<float>(scales[i % channels] *
                                                static_cast<double>(level.values[itemOf(i)]));
        }
        level.values = std::move(extinctions);
    }
    boxes_.assign(1, table_.occupiedBox());
    for (const ValueTable& level : levels_) {
        boxes_.push_back(level.table.occupiedBox());
    }
}

size_t SuperVoxels::bytes() const {
    size_t sum = table_.bytes() + items_.capacity() * sizeof(SuperVoxel) +
                 ranges_.capacity() * sizeof(ExtinctionRange) + shapes_.capacity() * sizeof(float);
    for (const ValueTable& level : levels_) {
        sum += level.table.bytes() + level.values.capacity() * sizeof(float);
    }
    return sum;
}

}  // namespace trk
