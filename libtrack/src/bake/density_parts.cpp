// SPDX-License-Identifier: Apache-2.0
#include "density_parts.h"

#include "field/table_builder.h"
#include "progress.h"

#include <optional>
#include <unordered_map>

namespace trk {

DensityParts::DensityParts(const DensityField& field, int size, bool distinguished)
    : field_(field),
      channels_(field.channels()),
      size_(size),
      cube_(std::min(size, static_cast<int>(DensityField::kBrickSize))) {
    int superVoxelShift = 0;
    while (1 << superVoxelShift < size_) {
        ++superVoxelShift;
    }
    const Entry single = distinguished ? SparseTable::kSingleFlag : 0;
    const auto addPart = [&](const Int3& origin) {
        origins_.push_back(origin);
        if (origins_.size() % 4096 == 0) {
            Progress::poll();
        }
        return static_cast<Entry>(origins_.size());
    };
    std::unordered_map<Entry, Entry> constants;
    table_ = TableBuilder(superVoxelShift, field_.box())
                 .fill(
                     {&field_.table()},
                     [&](const Int3& origin, int shift) -> std::optional<Entry> {
                         const auto entry = field_.table().uniformEntry(origin, shift);
                         if (!entry || !DensityField::isConstant(*entry)) {
                             return std::nullopt;
                         }
                         if (*entry == SparseTable::kEmpty) {
                             return SparseTable::kEmpty;
                         }
                         Entry& known = constants[*entry];
                         known = known == SparseTable::kEmpty ? addPart(origin) : known;
                         return known;
                     },
                     [&](const Int3& origin) { return addPart(origin) | single; },
                     // The surface of a large tile repeats a handful of patterns of bricks. Of a
                     // lone small super-voxel, to look for it costs more than to bake it.
                     [&](const Int3& origin, int shift, SparseTable::Key& key) {
                         return (shift > superVoxelShift || shift > DensityField::kBrickShift) &&
                                field_.table().appendKey(origin, shift, key);
                     });
}

void DensityParts::measure(BrickPages& pages) {
    moments_.resize(count() * channels_);
    corners_.resize(moments_.size());
    withEdge(static_cast<size_t>(cube_), [&](auto edge) {
        forEach(
            pages, count(), [](size_t i) { return i; },
            [&](size_t part) {
                if (part % 1024 == 0) {
                    Progress::poll(static_cast<double>(part) / static_cast<double>(count()));
                }
                measure<decltype(edge)::value>(pages, part);
            });
    });
}

template <size_t M>
void DensityParts::measure(const BrickPages& pages, size_t part) {
    for (size_t c = 0; c < channels_; ++c) {
        Moments& all = moments_[part * channels_ + c];
        CornerMoments& corners = corners_[part * channels_ + c];
        double count = 0;
        forEachCube(pages, part, c, [&](const Int3& offset, const float* vertices) {
            CornerMoments ofCube;
            add(cubeMoments<M>(vertices, ofCube), count++, all);
            addCorners(ofCube, offset, corners);
        });
    }
}

/// Adds a cube to `count` others of equal size [Chan, Golub, LeVeque 1979].
void DensityParts::add(const Moments& cube, double count, Moments& all) const {
    if (count == 0) {
        all = cube;
        return;
    }
    all.min = std::min(all.min, cube.min);
    all.max = std::max(all.max, cube.max);
    const double off = cube.mean - all.mean;
    const double cells = cube_ * cube_ * cube_;
    all.squares += cube.squares + cells * off * off * count / (count + 1);
    all.mean += off / (count + 1);
}

/// The super-voxel's hat functions are multilinear in each of its cubes too.
void DensityParts::addCorners(const CornerMoments& cube, const Int3& offset,
                              CornerMoments& sum) const {
    if (cube_ == size_) {
        sum = cube;
        return;
    }
    const double perAxis = static_cast<double>(size_) / cube_;
    const double scale = 1 / (perAxis * perAxis * perAxis);
    double hat[3][2][2];  // axis, corner of the super-voxel, corner of the cube
    for (size_t a = 0; a < 3; ++a) {
        for (size_t k = 0; k < 2; ++k) {
            const auto at = static_cast<double>(offset[a] + static_cast<int64_t>(k) * cube_);
            hat[a][1][k] = at / size_;
            hat[a][0][k] = 1 - hat[a][1][k];
        }
    }
    for (size_t i = 0; i < 8; ++i) {
        for (size_t k = 0; k < 8; ++k) {
            sum[i] += scale * cube[k] * hat[0][i >> 2][k >> 2] * hat[1][i >> 1 & 1][k >> 1 & 1] *
                      hat[2][i & 1][k & 1];
        }
    }
}

bool DensityParts::isEmpty(size_t part) const {
    bool empty = true;
    for (size_t c = 0; c < channels_; ++c) {
        empty = empty && !(moments(part, c).max > 0);
    }
    return empty;
}

bool DensityParts::isHomogeneous(size_t part) const {
    bool homogeneous = true;
    for (size_t c = 0; c < channels_; ++c) {
        homogeneous = homogeneous && moments(part, c).min == moments(part, c).max;
    }
    return homogeneous;
}

}  // namespace trk
