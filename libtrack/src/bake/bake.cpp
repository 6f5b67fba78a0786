// SPDX-License-Identifier: Apache-2.0
#include "bake.h"

#include "control_fit.h"
#include "failure.h"
#include "field/table_builder.h"
#include "levels.h"
#include "moments.h"
#include "parallel.h"
#include "preview_scale.h"
#include "progress.h"

#include <algorithm>
#include <cmath>
#include <filesystem>
#include <limits>
#include <map>
#include <optional>
#include <unordered_map>
#include <vector>

namespace trk {
namespace {

class Baker {
  public:
    Baker(BrickPages& pages, const BakeOptions& options)
        : pages_(pages),
          field_(pages.field()),
          options_(options),
          kind_(options.kind),
          channels_(field_.channels()),
          size_(options.superVoxelSize),
          cube_(std::min(options.superVoxelSize, 8)) {
        while (1 << shift_ < size_) {
            ++shift_;
        }
    }

    BakedVolume bake() {
        planSuperVoxels();
        checkMemory();
        moments_.resize(jobs_.size() * channels_);
        corners_.resize(moments_.size());
        const auto bricksOf = [&](size_t i, const auto& f) {
            forEachCube(jobs_[i], [&](const Cube& cube) { f(cube.entry); });
        };
        withEdge(static_cast<size_t>(cube_), [&](auto edge) {
            pages_.forEach(jobs_.size(), kGrain, bricksOf, [&](size_t i) {
                if (i % 1024 == 0) {
                    Progress::poll(static_cast<double>(i) / static_cast<double>(jobs_.size()));
                }
                measure<decltype(edge)::value>(i);
            });
        });
        baked_.superVoxelShift = shift_;
        baked_.channels = channels_;
        baked_.kind = kind_;
        if (kind_ == ControlKind::kTrilinear) {
            fitCorners();
        } else {
            makeItems();
        }
        baked_.items.resize(itemJobs_.size() * channels_);
        parallelFor(itemJobs_.size(), kGrain, [&](size_t i) {
            for (size_t c = 0; c < channels_; ++c) {
                finish(i, c);
            }
        });
        if (kind_ != ControlKind::kConstant) {
            compareWithControl();
        }
        return std::move(baked_);
    }

    BakeEstimate estimate() {
        planSuperVoxels();
        return {jobs_.size(), ownBytes()};
    }

  private:
    using Entry = SparseTable::Entry;

    static constexpr size_t kGrain = 32;

    /// Which super-voxels there are, equal ones once: their places in `jobs_`, in `plan_` the index
    /// of each, plus one.
    void planSuperVoxels() {
        const Entry single = kind_ == ControlKind::kConstant ? 0 : SparseTable::kSingleFlag;
        const auto addJob = [&](const Int3& origin) {
            jobs_.push_back(origin);
            if (jobs_.size() % 4096 == 0) {
                Progress::poll();
            }
            return static_cast<Entry>(jobs_.size());
        };
        std::unordered_map<Entry, Entry> constants;
        plan_ = TableBuilder(shift_, field_.box())
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
                            known = known == SparseTable::kEmpty ? addJob(origin) : known;
                            return known;
                        },
                        [&](const Int3& origin) { return addJob(origin) | single; },
                        // The surface of a large tile repeats a handful of patterns of bricks. Of a
                        // lone small super-voxel, to look for it costs more than to bake it.
                        [&](const Int3& origin, int shift, SparseTable::Key& key) {
                            return (shift > shift_ || shift > DensityField::kBrickShift) &&
                                   field_.table().appendKey(origin, shift, key);
                        });
    }

    /// A cube of a super-voxel.
    struct Cube {
        Int3 offset;    ///< in the super-voxel
        Entry entry;    ///< of the field, there
        size_t vertex;  ///< its first one in that brick
    };

    /// Of the jobs' moments, and of all that may be made of them.
    uint64_t ownBytes() const {
        constexpr uint64_t kFit = 250;  // of corners, a super-voxel
        const uint64_t fit = kind_ == ControlKind::kTrilinear ? kFit : 0;
        const uint64_t shape = (3 + shapeSize(kind_)) * sizeof(float);
        const uint64_t perChannel =
            sizeof(Moments) + sizeof(CornerMoments) + sizeof(BakedSuperVoxel) + shape + fit;
        return 2 * plan_.bytes() + jobs_.size() * (sizeof(Int3) + channels_ * perChannel);
    }
    void checkMemory() const {
        const uint64_t wanted = pages_.bytes() + ownBytes();
        if (options_.maxMemory > 0 && wanted > options_.maxMemory) {
            throw Error(TRK_ERROR_OUT_OF_MEMORY,
                        options_.where + ": baking " + std::to_string(jobs_.size()) +
                            " super-voxels of " + std::to_string(size_) + "^3 voxels needs " +
                            std::to_string(wanted) +
                            " bytes with their density, more than maxMemory = " +
                            std::to_string(options_.maxMemory));
        }
    }

    /// Calls body(cube) for every cube of a super-voxel: what of it lies in one brick.
    template <class Body>
    void forEachCube(const Int3& origin, const Body& body) const {
        constexpr auto kEdge = static_cast<int64_t>(DensityField::kBrickEdge);
        for (int64_t x = 0; x < size_; x += cube_) {
            for (int64_t y = 0; y < size_; y += cube_) {
                for (int64_t z = 0; z < size_; z += cube_) {
                    const Int3 at{{origin[0] + x, origin[1] + y, origin[2] + z}};
                    const int64_t vertex =
                        ((at[0] & 7) * kEdge + (at[1] & 7)) * kEdge + (at[2] & 7);
                    body(Cube{{{x, y, z}},
                              field_.table().find(at[0], at[1], at[2]).entry,
                              static_cast<size_t>(vertex)});
                }
            }
        }
    }

    /// The first vertex of a cube in one channel, as cubeRow wants it.
    const float* verticesOf(const Cube& cube, size_t channel,
                            float (&buffer)[DensityField::kBrickVertices]) const {
        if (DensityField::isConstant(cube.entry)) {
            std::fill(std::begin(buffer), std::end(buffer), field_.constant(cube.entry)[channel]);
            return buffer;
        }
        return pages_.brickChannel(cube.entry, channel, buffer) + cube.vertex;
    }

    /// Moments of a job, in every channel.
    template <size_t M>
    void measure(size_t job) {
        for (size_t c = 0; c < channels_; ++c) {
            Moments& all = moments_[job * channels_ + c];
            CornerMoments& corners = corners_[job * channels_ + c];
            double count = 0;
            forEachCube(jobs_[job], [&](const Cube& cube) {
                float buffer[DensityField::kBrickVertices];
                CornerMoments part;
                add(cubeMoments<M>(verticesOf(cube, c, buffer), part), count++, all);
                addCorners(part, cube.offset, corners);
            });
        }
    }

    /// Adds a cube to `count` others of equal size [Chan, Golub, LeVeque 1979].
    void add(const Moments& cube, double count, Moments& all) const {
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
    void addCorners(const CornerMoments& cube, const Int3& offset, CornerMoments& sum) const {
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
                sum[i] += scale * cube[k] * hat[0][i >> 2][k >> 2] *
                          hat[1][i >> 1 & 1][k >> 1 & 1] * hat[2][i & 1][k & 1];
            }
        }
    }

    const Moments& moments(size_t job, size_t channel) const {
        return moments_[job * channels_ + channel];
    }
    bool isEmpty(size_t job) const {
        bool empty = true;
        for (size_t c = 0; c < channels_; ++c) {
            empty = empty && !(moments(job, c).max > 0);
        }
        return empty;
    }
    bool isHomogeneous(size_t job) const {
        bool homogeneous = true;
        for (size_t c = 0; c < channels_; ++c) {
            homogeneous = homogeneous && moments(job, c).min == moments(job, c).max;
        }
        return homogeneous;
    }

    /// One item a job, with the job's own gradients where the control is affine.
    void makeItems() {
        std::vector<Entry> itemOf(jobs_.size(), SparseTable::kEmpty);
        for (size_t i = 0; i < jobs_.size(); ++i) {
            if (isEmpty(i)) {
                continue;
            }
            itemJobs_.push_back(i);
            itemOf[i] = static_cast<Entry>(itemJobs_.size());
            addGradients(i);
            if (kind_ == ControlKind::kAffine) {
                for (size_t c = 0; c < channels_; ++c) {
                    const auto gradient = constrainGradient(
                        &baked_.gradients[baked_.gradients.size() - 3 * (channels_ - c)],
                        static_cast<double>(meanOf(moments(i, c))), size_);
                    baked_.shapes.insert(baked_.shapes.end(), gradient.begin(), gradient.end());
                }
                itemOf[i] |= isHomogeneous(i) ? 0 : SparseTable::kSingleFlag;
            }
        }
        baked_.table = TableBuilder::mapped(
            plan_, [&](Entry entry) { return itemOf[SparseTable::index(entry)]; });
    }

    /// Of a job that becomes an item.
    void addGradients(size_t job) {
        if (!options_.gradients && kind_ != ControlKind::kAffine) {
            return;
        }
        for (size_t c = 0; c < channels_; ++c) {
            const Moments& m = moments(job, c);
            const auto gradient = m.min == m.max
                                      ? std::array<float, 3>{}
                                      : fitGradient(corners_[job * channels_ + c], size_);
            baked_.gradients.insert(baked_.gradients.end(), gradient.begin(), gradient.end());
        }
    }

    /// Corner values over all super-voxels together.
    void fitCorners() {
        std::vector<CornerFit> fits;
        for (size_t c = 0; c < channels_; ++c) {
            fits.push_back(fitChannel(c));
        }
        std::map<std::vector<float>, Entry> known;  // corners, and the job's index in two halves
        std::vector<float> shape(8 * channels_);
        const auto itemFor = [&](size_t job) {
            std::vector<float> key = shape;
            key.push_back(static_cast<float>(job >> 16));
            key.push_back(static_cast<float>(job & 0xffff));
            const auto [it, isNew] =
                known.try_emplace(std::move(key), static_cast<Entry>(itemJobs_.size() + 1));
            if (isNew) {
                itemJobs_.push_back(job);
                addGradients(job);
                baked_.shapes.insert(baked_.shapes.end(), shape.begin(), shape.end());
            }
            return it->second;
        };
        baked_.table =
            TableBuilder(shift_, field_.box())
                .fill(
                    {&plan_},
                    [&](const Int3& origin, int shift) -> std::optional<Entry> {
                        const auto entry = plan_.uniformEntry(origin, shift);
                        if (!entry) {
                            return std::nullopt;
                        }
                        if (*entry == SparseTable::kEmpty || isEmpty(SparseTable::index(*entry))) {
                            return SparseTable::kEmpty;
                        }
                        const size_t job = SparseTable::index(*entry);
                        const bool homogeneous = isHomogeneous(job);
                        if (!homogeneous && shift > shift_) {
                            return std::nullopt;
                        }
                        for (size_t i = 0; i < shape.size(); ++i) {
                            shape[i] = homogeneous ? moments(job, i / 8).min
                                                   : cornerValue(fits[i / 8],
                                                                 cornerOf(origin, i % 8), i / 8);
                        }
                        return itemFor(job) | (homogeneous ? 0 : SparseTable::kSingleFlag);
                    },
                    [](const Int3&) { return SparseTable::kEmpty; });  // an item is always uniform
    }

    /// A corner of the super-voxel at `origin`, counted in super-voxels.
    Int3 cornerOf(const Int3& origin, size_t corner) const {
        return {{(origin[0] >> shift_) + static_cast<int64_t>(corner >> 2),
                 (origin[1] >> shift_) + static_cast<int64_t>(corner >> 1 & 1),
                 (origin[2] >> shift_) + static_cast<int64_t>(corner & 1)}};
    }

    float cornerValue(const CornerFit& fit, const Int3& corner, size_t channel) const {
        const std::optional<float> given = givenCorner(corner, channel);
        return given ? *given : fit.value(corner);
    }

    /// The value of a corner that touches a homogeneous super-voxel (empty ones included): the
    /// density there, lest that super-voxel be given a residual. Nothing for a corner to be fitted.
    std::optional<float> givenCorner(const Int3& corner, size_t channel) const {
        for (int64_t cell = 0; cell < 8; ++cell) {
            const Int3 at{{(corner[0] - (cell >> 2)) * size_, (corner[1] - (cell >> 1 & 1)) * size_,
                           (corner[2] - (cell & 1)) * size_}};
            const Entry entry = plan_.find(at[0], at[1], at[2]).entry;
            if (entry == SparseTable::kEmpty) {
                return 0.0f;
            }
            const Moments& m = moments(SparseTable::index(entry), channel);
            if (m.min == m.max) {
                return m.min;
            }
        }
        return std::nullopt;
    }

    /// Only super-voxels with a corner to be fitted take part.
    CornerFit fitChannel(size_t channel) const {
        std::vector<CornerFit::Cell> cells;
        plan_.forEach([&](const Int3& lo, int shift, Entry entry) {
            const size_t job = SparseTable::index(entry);
            const Moments& m = moments(job, channel);
            bool fitted = false;
            for (size_t k = 0; k < 8 && shift == shift_ && m.min < m.max && !fitted; ++k) {
                fitted = !givenCorner(cornerOf(lo, k), channel);
            }
            if (fitted) {
                cells.push_back({cornerOf(lo, 0), &corners_[job * channels_ + channel],
                                 static_cast<double>(m.max)});
            }
        });
        return {cells, [&](const Int3& corner) { return givenCorner(corner, channel); }, size_};
    }

    static float meanOf(const Moments& m) {
        return std::min(std::max(static_cast<float>(m.mean), m.min), m.max);
    }

    void finish(size_t item, size_t channel) {
        const size_t job = itemJobs_[item];
        const Moments& m = moments(job, channel);
        BakedSuperVoxel& v = baked_.items[item * channels_ + channel];
        v.min = m.min;
        v.max = m.max;
        v.mean = meanOf(m);
        if (m.min == m.max) {
            return;
        }
        const auto mean = static_cast<double>(v.mean);
        const float reach =
            roundUp(std::max(mean - static_cast<double>(m.min), static_cast<double>(m.max) - mean));
        const double cells = std::pow(size_, 3);
        const double offset = mean - m.mean;  // the mean was rounded to float
        v.deviation = std::min(roundUp(std::sqrt(m.squares / cells + offset * offset)), reach);
        v.majorant = reach;
        v.rms = v.deviation;
    }

    /// What a control that is not constant leaves.
    void compareWithControl() {
        std::vector<size_t> items;  // with a residual, in the order of their jobs
        for (size_t i = 0; i < itemJobs_.size(); ++i) {
            if (!isHomogeneous(itemJobs_[i])) {
                items.push_back(i);
            }
        }
        std::sort(items.begin(), items.end(),
                  [&](size_t a, size_t b) { return itemJobs_[a] < itemJobs_[b]; });
        const auto originOf = [&](size_t i) { return jobs_[itemJobs_[items[i]]]; };
        const auto bricksOf = [&](size_t i, const auto& f) {
            forEachCube(originOf(i), [&](const Cube& cube) { f(cube.entry); });
        };
        pages_.forEach(items.size(), kGrain, bricksOf, [&](size_t i) {
            for (size_t c = 0; c < channels_; ++c) {
                const size_t item = items[i] * channels_ + c;
                if (baked_.items[item].min != baked_.items[item].max) {
                    compareWithControl(originOf(i), c, baked_.control(item), baked_.items[item]);
                }
            }
        });
    }

    /// Bound and RMS of what a control that is not constant leaves, vertex by vertex.
    void compareWithControl(const Int3& origin, size_t channel, const ControlPolynomial& control,
                            BakedSuperVoxel& v) const {
        ResidualMoments residual;
        withEdge(static_cast<size_t>(cube_), [&](auto edge) {
            constexpr size_t kEdge = decltype(edge)::value;
            forEachCube(origin, [&](const Cube& cube) {
                float buffer[DensityField::kBrickVertices];
                Vec3d start;
                for (int a = 0; a < 3; ++a) {
                    start[a] =
                        static_cast<double>(cube.offset[static_cast<size_t>(a)]) / size_ - 0.5;
                }
                addResidual<kEdge>(verticesOf(cube, channel, buffer), control, start, 1.0 / size_,
                                   residual);
            });
        });
        // Whoever evaluates the control again may round differently.
        const double rounding = 1e-15 * (static_cast<double>(v.max) + control.max());
        v.majorant = roundUp(residual.majorant + rounding);
        v.rms = std::min(roundUp(std::sqrt(residual.squares / std::pow(size_, 3)) + rounding),
                         v.majorant);
    }

    BrickPages& pages_;
    const DensityField& field_;
    BakeOptions options_;
    ControlKind kind_;
    size_t channels_;
    int size_;
    int cube_;
    int shift_ = 0;
    SparseTable plan_;
    std::vector<Int3> jobs_;        // origins, local
    std::vector<Moments> moments_;  // of each job and channel
    std::vector<CornerMoments> corners_;
    std::vector<size_t> itemJobs_;  // the job that each item of the bake is of
    BakedVolume baked_;
};

}  // namespace

BakedVolume bake(BrickPages pages, const BakeOptions& options) {
    BakedVolume baked = Baker(pages, options).bake();
    addLevels(baked, pages.field().box(), options.levels);
    if (options.sidecarBytes > 0) {
        addPreview(baked, pages, options.sidecarBytes);
    }
    return baked;
}

BakeEstimate estimateBake(const DensityField& field, const BakeOptions& options) {
    BrickPages pages(field);
    return Baker(pages, options).estimate();
}

uint64_t sidecarLimit(uint64_t sourceBytes, ControlKind kind) {
    constexpr uint64_t kSmall = 4000000;
    constexpr uint64_t kLeast = 100000;
    // Controls that vary have more grids: no reason to have no picture.
    constexpr uint64_t kMoreGrids = 40000;
    return std::max(kLeast, sourceBytes / (sourceBytes < kSmall ? 5 : 10)) +
           (kind == ControlKind::kConstant ? 0 : kMoreGrids);
}

SidecarHeader sidecarHeader(const DensitySummary& source, BrickPages pages,
                            const BakedVolume& baked) {
    SidecarHeader header;
    header.toolVersion = TRACK_VERSION;
    header.sourceFile = std::filesystem::path(source.path).filename().string();
    header.source = source.grid;
    header.prefix = source.label;
    header.valueType = source.valueType;
    header.digest = source.digest;
    header.sourceBytes = source.fileBytes;
    header.sourceModified = source.fileModified;
    header.indexToWorld = source.indexToWorld;
    header.superVoxelSize = baked.superVoxelSize();
    header.levels = static_cast<int>(baked.levels.size());
    header.controlKind = baked.kind;
    header.previewSize = baked.previewSize;
    header.previewScale = previewScale(std::move(pages), source.indexToWorld);
    header.repair = source.repair;
    header.dropped = source.dropped;
    header.clamped = source.clamped;
    return header;
}

SidecarHeader writeBake(const OutputFile& file, const DensitySummary& source, BrickPages pages,
                        BakedVolume& baked, uint64_t sidecarBytes) {
    const DensityField& field = pages.field();
    const SidecarHeader header = sidecarHeader(source, std::move(pages), baked);
    writeSidecar(file, header, baked, source.anchor);
    // How well values compress was an estimate.
    while (baked.previewSize > 0 && std::filesystem::file_size(file.path()) > sidecarBytes) {
        coarsenPreview(baked, field);
        writeSidecar(file, header, baked, source.anchor);
    }
    return header;
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
