// SPDX-License-Identifier: Apache-2.0
#include "corner_control.h"

namespace trk {

CornerControl::CornerControl(const DensityParts& parts) : parts_(parts) {
    for (size_t c = 0; c < parts.channels(); ++c) {
        fits_.push_back(fit(c));
    }
}

float CornerControl::at(const Int3& origin, size_t corner, size_t channel) const {
    const Int3 place = cornerOf(origin, corner);
    const std::optional<float> known = given(place, channel);
    return known ? *known : fits_[channel].value(place);
}

/// A corner of the super-voxel at `origin`, counted in super-voxels.
Int3 CornerControl::cornerOf(const Int3& origin, size_t corner) const {
    const int shift = parts_.shift();
    return {{(origin[0] >> shift) + static_cast<int64_t>(corner >> 2),
             (origin[1] >> shift) + static_cast<int64_t>(corner >> 1 & 1),
             (origin[2] >> shift) + static_cast<int64_t>(corner & 1)}};
}

/// The value of a corner that touches a homogeneous super-voxel (empty ones included): the density
/// there, lest that super-voxel be given a residual. Nothing for a corner to be fitted.
std::optional<float> CornerControl::given(const Int3& corner, size_t channel) const {
    const int size = parts_.size();
    for (int64_t cell = 0; cell < 8; ++cell) {
        const Int3 at{{(corner[0] - (cell >> 2)) * size, (corner[1] - (cell >> 1 & 1)) * size,
                       (corner[2] - (cell & 1)) * size}};
        const SparseTable::Entry entry = parts_.table().find(at[0], at[1], at[2]).entry;
        if (entry == SparseTable::kEmpty) {
            return 0.0f;
        }
        const Moments& m = parts_.moments(SparseTable::index(entry), channel);
        if (m.min == m.max) {
            return m.min;
        }
    }
    return std::nullopt;
}

/// Only super-voxels with a corner to be fitted take part.
CornerFit CornerControl::fit(size_t channel) const {
    std::vector<CornerFit::Cell> cells;
    parts_.table().forEach([&](const Int3& lo, int shift, SparseTable::Entry entry) {
        const size_t part = SparseTable::index(entry);
        const Moments& m = parts_.moments(part, channel);
        bool fitted = false;
        for (size_t k = 0; k < 8 && shift == parts_.shift() && m.min < m.max && !fitted; ++k) {
            fitted = !given(cornerOf(lo, k), channel);
        }
        if (fitted) {
            cells.push_back(
                {cornerOf(lo, 0), &parts_.corners(part, channel), static_cast<double>(m.max)});
        }
    });
    return {cells, [&](const Int3& corner) { return given(corner, channel); }, parts_.size()};
}

}  // namespace trk
