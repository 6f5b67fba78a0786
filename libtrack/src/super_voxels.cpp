// SPDX-License-Identifier: Apache-2.0
#include "super_voxels.h"

#include <utility>

namespace trk {
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
    // [Novak14, Eq. 6]: about D S collisions are expected, each amplifies by at most
    // 1 + (control - min) / S; the formula caps their product at gamma = 2.
    const double range = max - min;
    if (range <= 0) {
        return mean;
    }
    const double control = min + range * std::expm1(std::log(2.0) / (diagonal * range));
    return std::min(std::max(control, min), mean);
}

SuperVoxels::SuperVoxels(BakedVolume baked, float scale, TrkChoice choice, double diagonal)
    : table_(std::move(baked.table)), levels_(std::move(baked.levels)) {
    const double superDiagonal = diagonal * baked.superVoxelSize();
    items_.reserve(baked.items.size());
    for (const BakedSuperVoxel& item : baked.items) {
        const double s = scale;
        const double min = s * static_cast<double>(item.min);
        const double max = s * static_cast<double>(item.max);
        const double mean = s * static_cast<double>(item.control);
        SuperVoxel v;
        v.mean = static_cast<float>(mean);
        v.max = roundUp(max);
        // A homogeneous super-voxel keeps its value to the bit, so that nothing is left to track.
        v.control = static_cast<float>(chooseControl(choice, min, mean, max, superDiagonal));
        const double control = v.control;
        v.bound = item.min == item.max ? 0.0f : roundUp(std::max(control - min, max - control));
        items_.push_back(v);
    }
    for (ScalarTable& level : levels_) {
        for (float& value : level.values) {
            value *= scale;
        }
    }
    boxes_.assign(1, table_.occupiedBox());
    for (const ScalarTable& level : levels_) {
        boxes_.push_back(level.table.occupiedBox());
    }
}

size_t SuperVoxels::bytes() const {
    size_t sum = table_.bytes() + items_.capacity() * sizeof(SuperVoxel);
    for (const ScalarTable& level : levels_) {
        sum += level.table.bytes() + level.values.capacity() * sizeof(float);
    }
    return sum;
}

double SuperVoxels::integrateControl(const LocalRay& ray, size_t level, uint64_t& regions) const {
    double sum = 0;
    const SparseTable& table = level == 0 ? table_ : levels_[level - 1].table;
    table.walk(ray, 0, ray.tEnd,
               [&](SparseTable::Entry entry, const Int3&, int, double tEnter, double tExit) {
                   ++regions;
                   const float mean =
                       level == 0 ? items_[entry - 1].mean : levels_[level - 1].values[entry - 1];
                   sum += static_cast<double>(mean) * (tExit - tEnter);
                   return true;
               });
    return sum;
}

}  // namespace trk
