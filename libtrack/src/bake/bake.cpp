// SPDX-License-Identifier: Apache-2.0
#include "bake.h"

#include "control_fit.h"
#include "corner_control.h"
#include "density_parts.h"
#include "failure.h"
#include "field/table_builder.h"
#include "levels.h"
#include "moments.h"
#include "parallel.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <map>
#include <optional>
#include <string>
#include <vector>

namespace trk {
namespace {

uint64_t bytesOfBake(const DensityParts& parts, ControlKind kind) {
    constexpr uint64_t kFit = 250;  // of corners, a super-voxel
    const uint64_t fit = kind == ControlKind::kTrilinear ? kFit : 0;
    const uint64_t shape = (3 + shapeSize(kind)) * sizeof(float);
    const uint64_t perChannel = sizeof(BakedSuperVoxel) + shape + fit;
    return parts.bytes() + parts.table().bytes() + parts.count() * parts.channels() * perChannel;
}

float meanOf(const Moments& m) {
    return std::min(std::max(static_cast<float>(m.mean), m.min), m.max);
}

/// What a constant control leaves, and what of it holds for any control.
BakedSuperVoxel statisticsOf(const Moments& m, int size) {
    BakedSuperVoxel v{};
    v.min = m.min;
    v.max = m.max;
    v.mean = meanOf(m);
    if (m.min == m.max) {
        return v;
    }
    const auto mean = static_cast<double>(v.mean);
    const float reach =
        roundUp(std::max(mean - static_cast<double>(m.min), static_cast<double>(m.max) - mean));
    const double cells = std::pow(size, 3);
    const double offset = mean - m.mean;  // the mean was rounded to float
    v.deviation = std::min(roundUp(std::sqrt(m.squares / cells + offset * offset)), reach);
    v.majorant = reach;
    v.rms = v.deviation;
    return v;
}

/// Makes items of measured parts: a part that is not empty with its control.
class Baker {
  public:
    Baker(const DensityParts& parts, const IntBox& box, const BakeOptions& options)
        : parts_(parts), box_(box), options_(options), channels_(parts.channels()) {
        baked_.superVoxelShift = parts.shift();
        baked_.channels = channels_;
        baked_.kind = options.kind;
    }

    BakedVolume bake(BrickPages& pages) {
        if (options_.kind == ControlKind::kTrilinear) {
            addPlacedItems();
        } else {
            addItems();
        }
        baked_.items.resize(partOf_.size() * channels_);
        parallelFor(baked_.items.size(), 32, [&](size_t i) {
            baked_.items[i] =
                statisticsOf(parts_.moments(partOf_[i / channels_], i % channels_), parts_.size());
        });
        if (options_.kind != ControlKind::kConstant) {
            compareWithControl(pages);
        }
        return std::move(baked_);
    }

  private:
    using Entry = SparseTable::Entry;

    /// One item a part, with the part's own gradients where the control is affine.
    void addItems() {
        std::vector<Entry> itemOf(parts_.count(), SparseTable::kEmpty);
        for (size_t i = 0; i < parts_.count(); ++i) {
            if (!parts_.isEmpty(i)) {
                itemOf[i] = addItem(i);
                if (options_.kind == ControlKind::kAffine) {
                    addAffineShape(i);
                    itemOf[i] |= parts_.isHomogeneous(i) ? 0 : SparseTable::kSingleFlag;
                }
            }
        }
        baked_.table = TableBuilder::mapped(
            parts_.table(), [&](Entry entry) { return itemOf[SparseTable::index(entry)]; });
    }
    Entry addItem(size_t part) {
        partOf_.push_back(part);
        addGradients(part);
        return static_cast<Entry>(partOf_.size());
    }
    void addGradients(size_t part) {
        if (!options_.gradients && options_.kind != ControlKind::kAffine) {
            return;
        }
        for (size_t c = 0; c < channels_; ++c) {
            const Moments& m = parts_.moments(part, c);
            const auto gradient = m.min == m.max
                                      ? std::array<float, 3>{}
                                      : fitGradient(parts_.corners(part, c), parts_.size());
            baked_.gradients.insert(baked_.gradients.end(), gradient.begin(), gradient.end());
        }
    }
    /// Of the item that was added last.
    void addAffineShape(size_t part) {
        for (size_t c = 0; c < channels_; ++c) {
            const auto gradient = constrainGradient(
                &baked_.gradients[baked_.gradients.size() - 3 * (channels_ - c)],
                static_cast<double>(meanOf(parts_.moments(part, c))), parts_.size());
            baked_.shapes.insert(baked_.shapes.end(), gradient.begin(), gradient.end());
        }
    }

    /// One item for each part and the corner values that it is given somewhere.
    void addPlacedItems() {
        const CornerControl control(parts_);
        std::map<std::vector<float>, Entry> known;  // corners, and the part in two halves
        std::vector<float> shape(8 * channels_);
        const auto itemFor = [&](size_t part) {
            std::vector<float> key = shape;
            key.push_back(static_cast<float>(part >> 16));
            key.push_back(static_cast<float>(part & 0xffff));
            const auto [it, isNew] = known.try_emplace(std::move(key), SparseTable::kEmpty);
            if (isNew) {
                it->second = addItem(part);
                baked_.shapes.insert(baked_.shapes.end(), shape.begin(), shape.end());
            }
            return it->second;
        };
        const SparseTable& places = parts_.table();
        baked_.table =
            TableBuilder(parts_.shift(), box_)
                .fill(
                    {&places},
                    [&](const Int3& origin, int shift) -> std::optional<Entry> {
                        const auto entry = places.uniformEntry(origin, shift);
                        if (!entry) {
                            return std::nullopt;
                        }
                        if (*entry == SparseTable::kEmpty ||
                            parts_.isEmpty(SparseTable::index(*entry))) {
                            return SparseTable::kEmpty;
                        }
                        const size_t part = SparseTable::index(*entry);
                        const bool homogeneous = parts_.isHomogeneous(part);
                        if (!homogeneous && shift > parts_.shift()) {
                            return std::nullopt;
                        }
                        for (size_t i = 0; i < shape.size(); ++i) {
                            shape[i] = homogeneous ? parts_.moments(part, i / 8).min
                                                   : control.at(origin, i % 8, i / 8);
                        }
                        return itemFor(part) | (homogeneous ? 0 : SparseTable::kSingleFlag);
                    },
                    [](const Int3&) { return SparseTable::kEmpty; });  // an item is always uniform
    }

    /// What a control that is not constant leaves.
    void compareWithControl(BrickPages& pages) {
        std::vector<size_t> items;  // with a residual, in the order of their parts
        for (size_t i = 0; i < partOf_.size(); ++i) {
            if (!parts_.isHomogeneous(partOf_[i])) {
                items.push_back(i);
            }
        }
        std::sort(items.begin(), items.end(),
                  [&](size_t a, size_t b) { return partOf_[a] < partOf_[b]; });
        parts_.forEach(
            pages, items.size(), [&](size_t i) { return partOf_[items[i]]; },
            [&](size_t i) {
                for (size_t c = 0; c < channels_; ++c) {
                    const size_t item = items[i] * channels_ + c;
                    if (baked_.items[item].min != baked_.items[item].max) {
                        compareWithControl(pages, partOf_[items[i]], c, baked_.control(item),
                                           baked_.items[item]);
                    }
                }
            });
    }

    /// Bound and RMS of what a control that is not constant leaves, vertex by vertex.
    void compareWithControl(const BrickPages& pages, size_t part, size_t channel,
                            const ControlPolynomial& control, BakedSuperVoxel& v) const {
        const double size = parts_.size();
        ResidualMoments residual;
        withEdge(static_cast<size_t>(parts_.cubeEdge()), [&](auto edge) {
            parts_.forEachCube(pages, part, channel, [&](const Int3& offset, const float* cube) {
                Vec3d start;
                for (size_t a = 0; a < 3; ++a) {
                    start[static_cast<int>(a)] = static_cast<double>(offset[a]) / size - 0.5;
                }
                addResidual<decltype(edge)::value>(cube, control, start, 1.0 / size, residual);
            });
        });
        // Whoever evaluates the control again may round differently.
        const double rounding = 1e-15 * (static_cast<double>(v.max) + control.max());
        v.majorant = roundUp(residual.majorant + rounding);
        v.rms = std::min(roundUp(std::sqrt(residual.squares / std::pow(size, 3)) + rounding),
                         v.majorant);
    }

    const DensityParts& parts_;
    IntBox box_;
    const BakeOptions& options_;
    size_t channels_;
    std::vector<size_t> partOf_;  // the part that each item of the bake is of
    BakedVolume baked_;
};

DensityParts partsOf(const DensityField& field, const BakeOptions& options) {
    return {field, options.superVoxelSize, options.kind != ControlKind::kConstant};
}

/// All but levels and pictures.
BakedVolume bakeItems(BrickPages& pages, const BakeOptions& options) {
    DensityParts parts = partsOf(pages.field(), options);
    const uint64_t wanted = pages.bytes() + bytesOfBake(parts, options.kind);
    if (options.maxMemory > 0 && wanted > options.maxMemory) {
        throw Error(TRK_ERROR_OUT_OF_MEMORY,
                    options.where + ": baking " + std::to_string(parts.count()) +
                        " super-voxels of " + std::to_string(parts.size()) + "^3 voxels needs " +
                        std::to_string(wanted) +
                        " bytes with their density, more than maxMemory = " +
                        std::to_string(options.maxMemory));
    }
    parts.measure(pages);
    return Baker(parts, pages.field().box(), options).bake(pages);
}

}  // namespace

BakedVolume bake(BrickPages pages, const BakeOptions& options) {
    BakedVolume baked = bakeItems(pages, options);
    addLevels(baked, pages.field().box(), options.levels);
    if (options.sidecarBytes > 0) {
        addPreview(baked, pages, options.sidecarBytes);
    }
    return baked;
}

BakeEstimate estimateBake(const DensityField& field, const BakeOptions& options) {
    const DensityParts parts = partsOf(field, options);
    return {parts.count(), bytesOfBake(parts, options.kind)};
}

ControlFit measureFit(const BakedVolume& baked) {
    double count = 0;
    double squares[3] = {0, 0, 0};  // of residual, deviation, density
    double mass[2] = {0, 0};        // of control, density
    baked.table.forEach([&](const Int3&, int shift, SparseTable::Entry entry) {
        const double n = std::pow(8.0, shift - baked.superVoxelShift);  // super-voxels
        for (size_t c = 0; c < baked.channels; ++c) {
            const size_t item = SparseTable::index(entry) * baked.channels + c;
            const BakedSuperVoxel& v = baked.items[item];
            const auto square = [](float x) {
                return static_cast<double>(x) * static_cast<double>(x);
            };
            count += n;
            squares[0] += n * square(v.rms);
            squares[1] += n * square(v.deviation);
            squares[2] += n * (square(v.deviation) + square(v.mean));
            mass[0] += n * baked.control(item).centre;  // the mean of any multilinear control
            mass[1] += n * static_cast<double>(v.mean);
        }
    });
    ControlFit fit;
    if (count > 0) {
        fit.residualRms = std::sqrt(squares[0] / count);
        fit.constantRms = std::sqrt(squares[1] / count);
        fit.fieldRms = std::sqrt(squares[2] / count);
        fit.massRatio = mass[0] / mass[1];
    }
    return fit;
}

}  // namespace trk
