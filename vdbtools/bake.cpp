// SPDX-License-Identifier: Apache-2.0
#include "bake.h"

#include <tbb/blocked_range.h>
#include <tbb/parallel_for.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <optional>
#include <unordered_map>
#include <vector>

namespace vdbtools {
namespace {

using trk::BakedSuperVoxel;
using trk::BakedVolume;
using trk::ExtinctionField;
using trk::Int3;
using trk::roundUp;
using trk::ScalarTable;
using trk::SparseTable;

constexpr float kInfinity = std::numeric_limits<float>::infinity();

/// Statistics of a cube of M^3 cells over its (M+1)^3 vertices. `mean` and `squares` (the sum of
/// squared deviations from it) weigh a vertex by the part of it inside the cube, so that cubes side
/// by side add up without counting a shared face twice.
struct Moments {
    float min = 0;
    float max = 0;
    double mean = 0;
    double squares = 0;
};

Moments constantMoments(float value) {
    return {value, value, static_cast<double>(value), 0};
}

/// Moments of one cube of `size`^3 cells of a brick. Two passes over values that are in L1:
/// deviations from the mean do not cancel, and a cube of equal values has a mean of that very
/// value.
Moments cubeMoments(const float* first, size_t size) {
    constexpr size_t kEdge = ExtinctionField::kBrickEdge;
    const auto weight = [size](size_t i) { return i == 0 || i == size ? 0.5 : 1.0; };
    const auto weighted = [&](const auto& term) {
        double sum = 0;
        for (size_t x = 0; x <= size; ++x) {
            double plane = 0;
            for (size_t y = 0; y <= size; ++y) {
                const float* row = first + (x * kEdge + y) * kEdge;
                double line = 0.5 * (term(row[0]) + term(row[size]));
                for (size_t z = 1; z < size; ++z) {
                    line += term(row[z]);
                }
                plane += weight(y) * line;
            }
            sum += weight(x) * plane;
        }
        return sum;
    };
    Moments m;
    m.min = m.max = first[0];
    for (size_t x = 0; x <= size; ++x) {
        for (size_t y = 0; y <= size; ++y) {
            const float* row = first + (x * kEdge + y) * kEdge;
            for (size_t z = 0; z <= size; ++z) {
                m.min = std::min(m.min, row[z]);
                m.max = std::max(m.max, row[z]);
            }
        }
    }
    m.mean = weighted([](float v) { return static_cast<double>(v); }) /
             static_cast<double>(size * size * size);
    m.squares = m.min == m.max ? 0 : weighted([&](float v) {
        const double d = static_cast<double>(v) - m.mean;
        return d * d;
    });
    return m;
}

class Baker {
  public:
    Baker(const ExtinctionField& field, int superVoxelSize)
        : field_(field), size_(superVoxelSize), cube_(std::min(superVoxelSize, 8)) {
        while (1 << shift_ < superVoxelSize) {
            ++shift_;
        }
        computeCubes();
    }

    BakedVolume bake() {
        BakedVolume baked;
        baked.superVoxelShift = shift_;
        SparseTable plan(shift_, field_.box());
        std::vector<Int3> jobs;
        const auto addJob = [&](const Int3& origin) {
            jobs.push_back(origin);
            return static_cast<SparseTable::Entry>(jobs.size());
        };
        std::unordered_map<SparseTable::Entry, SparseTable::Entry> constants;
        plan.fill(
            [&](const Int3& origin, int shift) -> std::optional<SparseTable::Entry> {
                const auto entry = field_.table().uniformEntry(origin, shift);
                if (!entry || !ExtinctionField::isConstant(*entry)) {
                    return std::nullopt;
                }
                if (*entry == SparseTable::kEmpty) {
                    return SparseTable::kEmpty;
                }
                SparseTable::Entry& known = constants[*entry];
                known = known == SparseTable::kEmpty ? addJob(origin) : known;
                return known;
            },
            addJob,
            // The surface of a large tile repeats a handful of patterns of bricks.
            [&](const Int3& origin, int shift, SparseTable::Key& key) {
                return field_.table().appendKey(origin, shift, key);
            });
        std::vector<BakedSuperVoxel> results(jobs.size());
        tbb::parallel_for(tbb::blocked_range<size_t>(0, jobs.size(), 32),
                          [&](const tbb::blocked_range<size_t>& range) {
                              for (size_t i = range.begin(); i != range.end(); ++i) {
                                  results[i] = superVoxel(jobs[i]);
                              }
                          });
        std::vector<SparseTable::Entry> itemOf(jobs.size(), SparseTable::kEmpty);
        for (size_t i = 0; i < jobs.size(); ++i) {
            if (results[i].max > 0) {
                baked.items.push_back(results[i]);
                itemOf[i] = static_cast<SparseTable::Entry>(baked.items.size());
            }
        }
        baked.table = plan.mapped([&](SparseTable::Entry entry) { return itemOf[entry - 1]; });
        return baked;
    }

  private:
    /// Moments of every cube of every brick: each vertex is read once, whatever shares its brick.
    void computeCubes() {
        const size_t perAxis = static_cast<size_t>(8 / cube_);
        const size_t cubesPerBrick = perAxis * perAxis * perAxis;
        cubes_.resize(field_.brickCount() * cubesPerBrick);
        tbb::parallel_for(tbb::blocked_range<size_t>(0, field_.brickCount(), 64),
                          [&](const tbb::blocked_range<size_t>& range) {
                              float vertices[ExtinctionField::kBrickVertices];
                              for (size_t b = range.begin(); b != range.end(); ++b) {
                                  field_.copyBrick(static_cast<SparseTable::Entry>(b + 1),
                                                   vertices);
                                  for (size_t c = 0; c < cubesPerBrick; ++c) {
                                      const auto edge = static_cast<size_t>(cube_);
                                      const size_t x = c / (perAxis * perAxis) * edge;
                                      const size_t y = c / perAxis % perAxis * edge;
                                      const size_t z = c % perAxis * edge;
                                      cubes_[b * cubesPerBrick + c] =
                                          cubeMoments(vertices +
                                                          (x * ExtinctionField::kBrickEdge + y) *
                                                              ExtinctionField::kBrickEdge +
                                                          z,
                                                      edge);
                                  }
                              }
                          });
    }

    Moments cubeAt(int64_t x, int64_t y, int64_t z) const {
        const SparseTable::Entry entry = field_.table().find(x, y, z).entry;
        if (ExtinctionField::isConstant(entry)) {
            return constantMoments(field_.constant(entry));
        }
        const int64_t perAxis = 8 / cube_;
        const int64_t within =
            ((x & 7) / cube_ * perAxis + (y & 7) / cube_) * perAxis + (z & 7) / cube_;
        return cubes_[(entry - 1) * static_cast<size_t>(perAxis * perAxis * perAxis) +
                      static_cast<size_t>(within)];
    }

    BakedSuperVoxel superVoxel(const Int3& origin) const {
        const int64_t count = size_ / cube_;
        const auto n = static_cast<double>(count * count * count);
        const auto forEachCube = [&](const auto& body) {
            for (int64_t x = 0; x < count; ++x) {
                for (int64_t y = 0; y < count; ++y) {
                    for (int64_t z = 0; z < count; ++z) {
                        body(cubeAt(origin[0] + x * cube_, origin[1] + y * cube_,
                                    origin[2] + z * cube_));
                    }
                }
            }
        };
        Moments all;
        all.min = kInfinity;
        forEachCube([&](const Moments& m) {
            all.min = std::min(all.min, m.min);
            all.max = std::max(all.max, m.max);
            all.mean += m.mean;
        });
        all.mean /= n;
        const auto cells = static_cast<double>(cube_ * cube_ * cube_);
        forEachCube([&](const Moments& m) {  // [Chan, Golub, LeVeque 1979]
            all.squares += m.squares + cells * (m.mean - all.mean) * (m.mean - all.mean);
        });
        if (all.min == all.max) {
            all = constantMoments(all.min);
        }
        return finish(all);
    }

    BakedSuperVoxel finish(const Moments& m) const {
        BakedSuperVoxel v;
        v.min = m.min;
        v.max = m.max;
        v.control = std::min(std::max(static_cast<float>(m.mean), m.min), m.max);
        const auto control = static_cast<double>(v.control);
        v.majorant = roundUp(
            std::max(control - static_cast<double>(m.min), static_cast<double>(m.max) - control));
        const double cells = static_cast<double>(size_) * size_ * size_;
        const double offset = control - m.mean;  // the control is the mean rounded to float
        v.rms = m.min == m.max
                    ? 0.0f
                    : std::min(roundUp(std::sqrt(m.squares / cells + offset * offset)), v.majorant);
        return v;
    }

    const ExtinctionField& field_;
    int size_;
    int cube_;
    int shift_ = 0;
    std::vector<Moments> cubes_;
};

/// Means of the super-voxels twice as large as those of `finer`.
template <class MeanOf>
ScalarTable nextLevel(const SparseTable& finer, const trk::IntBox& box, const MeanOf& meanOf) {
    ScalarTable level;
    const int shift = finer.itemShift() + 1;
    const int64_t half = int64_t{1} << finer.itemShift();
    level.table = SparseTable(shift, box);
    std::unordered_map<float, SparseTable::Entry> known;
    const auto add = [&](float mean) {
        if (mean == 0) {
            return SparseTable::kEmpty;
        }
        const auto [it, isNew] =
            known.try_emplace(mean, static_cast<SparseTable::Entry>(level.values.size() + 1));
        if (isNew) {
            level.values.push_back(mean);
        }
        return it->second;
    };
    level.table.fill(
        [&](const Int3& origin, int regionShift) -> std::optional<SparseTable::Entry> {
            const auto entry = finer.uniformEntry(origin, regionShift);
            if (!entry) {
                return std::nullopt;
            }
            return *entry == SparseTable::kEmpty ? SparseTable::kEmpty : add(meanOf(*entry));
        },
        [&](const Int3& origin) {
            double sum = 0;
            for (int64_t octant = 0; octant < 8; ++octant) {
                const auto entry =
                    finer
                        .find(origin[0] + (octant >> 2) * half,
                              origin[1] + (octant >> 1 & 1) * half, origin[2] + (octant & 1) * half)
                        .entry;
                sum += entry == SparseTable::kEmpty ? 0 : static_cast<double>(meanOf(entry));
            }
            return add(static_cast<float>(sum / 8));
        },
        [&](const Int3& origin, int regionShift, SparseTable::Key& key) {
            return finer.appendKey(origin, regionShift, key);
        });
    return level;
}

}  // namespace

BakedVolume bake(const ExtinctionField& field, int superVoxelSize, int levels) {
    BakedVolume baked = Baker(field, superVoxelSize).bake();
    for (int i = 0; i < levels; ++i) {
        if (i == 0) {
            baked.levels.push_back(nextLevel(baked.table, field.box(), [&](SparseTable::Entry e) {
                return baked.items[e - 1].control;
            }));
        } else {
            const ScalarTable& finer = baked.levels.back();
            baked.levels.push_back(nextLevel(finer.table, field.box(), [&](SparseTable::Entry e) {
                return finer.values[e - 1];
            }));
        }
    }
    return baked;
}

}  // namespace vdbtools
