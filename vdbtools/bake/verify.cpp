// SPDX-License-Identifier: Apache-2.0
#include "verify.h"

#include "io/density_types.h"
#include "io/vdb_file.h"
#include "io/vdb_tree.h"
#include "parallel.h"
#include "voxels.h"

#include <algorithm>
#include <array>
#include <atomic>
#include <cmath>
#include <optional>
#include <set>
#include <sstream>
#include <utility>
#include <vector>

namespace vdbtools {
namespace {

using trk::BakedSuperVoxel;

std::ostream& operator<<(std::ostream& out, const Int3& p) {
    return out << "(" << p[0] << ", " << p[1] << ", " << p[2] << ")";
}

/// Everything in index space here; `table` alone is in local space.
template <class Value>
class Verifier {
  public:
    using Regions = Voxels<Value>;
    using Sample = trk::Sample<Value>;

    Verifier(Regions& regions, const trk::Sidecar& sidecar)
        : regions_(regions), sidecar_(sidecar), size_(sidecar.baked.superVoxelSize()) {}

    VerifyReport run() {
        VerifyReport report;
        std::vector<Place> places;
        sidecar_.baked.table.forEach([&](const Int3& local, int shift, SparseTable::Entry entry) {
            addPlaces(toIndex(local), shift, SparseTable::index(entry) * kChannels, places);
        });
        report.superVoxels = sidecar_.baked.table.occupiedItems();
        std::atomic<uint64_t> vertices{0};
        known_.clear();
        const auto leavesOf = [&](size_t i, const auto& f) { forEachLeaf(places[i], f); };
        const size_t badPlace = firstFailure(places.size(), leavesOf, [&](size_t i) {
            uint64_t count = 0;
            const std::string wrong = checkPlace(places[i], count);
            vertices += count;
            return !wrong.empty();
        });
        report.vertices = vertices;
        if (badPlace < places.size()) {
            uint64_t count = 0;
            report.counterexample = checkPlace(places[badPlace], count);
            return report;
        }
        const std::vector<IntBox> blocks = regions_.blocks();
        const auto leafOf = [&](size_t i, const auto& f) {
            regions_.forEachLeaf(blocks[i].lo, 0, f);
        };
        const size_t badBlock = firstFailure(
            blocks.size(), leafOf, [&](size_t i) { return !checkCoverage(blocks[i]).empty(); });
        if (badBlock < blocks.size()) {
            report.counterexample = checkCoverage(blocks[badBlock]);
            return report;
        }
        report.holds = true;
        return report;
    }

  private:
    struct Place {
        Int3 origin;
        int shift;
        size_t item;  // of its first channel, in the bake's items
    };

    static constexpr size_t kChannels = std::tuple_size_v<Sample>;

    /// A region of equal super-voxels is one place if they claim to be constant, else one each; of
    /// those that look alike and claim the same, on the surface of a tile, the first.
    void addPlaces(const Int3& origin, int shift, size_t item, std::vector<Place>& places) {
        if (shift == sidecar_.baked.superVoxelShift) {
            SparseTable::Key key{static_cast<SparseTable::Entry>(item)};
            if (!regions_.appendKey(origin, size_, key) || known_.insert(std::move(key)).second) {
                places.push_back({origin, shift, item});
            }
            return;
        }
        if (sidecar_.baked.isHomogeneous(item)) {
            places.push_back({origin, shift, item});
            return;
        }
        for (size_t c = 0; c < 512; ++c) {
            addPlaces(SparseTable::childOrigin(origin, shift - 3, c), shift - 3, item, places);
        }
    }

    Int3 toIndex(const Int3& local) const {
        return {{local[0] + sidecar_.anchor[0], local[1] + sidecar_.anchor[1],
                 local[2] + sidecar_.anchor[2]}};
    }

    /// Lowest i in [0, count) for which `fails(i)`, or count. What failed last is at hand still.
    template <class LeavesOf, class Fails>
    size_t firstFailure(size_t count, const LeavesOf& leavesOf, const Fails& fails) {
        std::atomic<size_t> first{count};
        regions_.forEachPage(count, leavesOf, [&](size_t pageBegin, size_t pageEnd) {
            trk::parallelRanges(pageEnd - pageBegin, 16, [&](size_t begin, size_t end) {
                for (size_t i = pageBegin + begin; i != pageBegin + end; ++i) {
                    if (i < first && fails(i)) {
                        size_t known = first;
                        while (i < known && !first.compare_exchange_weak(known, i)) {
                        }
                    }
                }
            });
            return first == count;
        });
        return first;
    }

    /// Calls f(leaf) for the leaves that a place is compared with.
    template <class F>
    void forEachLeaf(const Place& place, const F& f) const {
        const int64_t edge = int64_t{1} << place.shift;
        if (edge <= size_) {
            regions_.forEachLeaf(place.origin, edge, f);
            return;
        }
        forEachRegionAround(place, 3, [&](const Int3& at, int shift) {
            if (shift == 3) {
                regions_.forEachLeaf(at, 7, f);
            }
            return true;
        });
    }

    std::string checkPlace(const Place& place, uint64_t& vertices) const {
        const int64_t edge = int64_t{1} << place.shift;
        if (edge > size_) {
            return checkUniform(place, vertices);
        }
        const auto controls = controlsOf(place);
        double sum[kChannels] = {};
        double squares[kChannels] = {};
        double deviations[kChannels] = {};
        double slopes[kChannels][3] = {};  // first moments
        const auto weight = [&](int64_t i) { return i == 0 || i == edge ? 0.5 : 1.0; };
        for (int64_t x = 0; x <= edge; ++x) {
            for (int64_t y = 0; y <= edge; ++y) {
                for (int64_t z = 0; z <= edge; ++z) {
                    const Int3 at{{place.origin[0] + x, place.origin[1] + y, place.origin[2] + z}};
                    const Sample sample = regions_.at(at);
                    ++vertices;
                    const double w = weight(x) * weight(y) * weight(z);
                    for (size_t c = 0; c < kChannels; ++c) {
                        const double control = controls[c].at({{unit(x), unit(y), unit(z)}});
                        std::string wrong = checkVertex(place, c, at, sample[c], control);
                        if (!wrong.empty()) {
                            return wrong;
                        }
                        const auto v = static_cast<double>(sample[c]);
                        const double deviation =
                            v - static_cast<double>(sidecar_.baked.items[place.item + c].mean);
                        sum[c] += w * v;
                        squares[c] += w * (v - control) * (v - control);
                        deviations[c] += w * deviation * deviation;
                        slopes[c][0] += w * v * unit(x);
                        slopes[c][1] += w * v * unit(y);
                        slopes[c][2] += w * v * unit(z);
                    }
                }
            }
        }
        const auto cells = static_cast<double>(edge * edge * edge);
        for (size_t c = 0; c < kChannels; ++c) {
            std::string wrong = checkSums(place, c, sum[c] / cells, std::sqrt(squares[c] / cells),
                                          std::sqrt(deviations[c] / cells));
            if (wrong.empty()) {
                wrong = checkGradient(place, c, slopes[c]);
            }
            if (!wrong.empty()) {
                return wrong;
            }
        }
        return {};
    }

    /// `moments`: sums over the vertices of weight x density x place, the latter from -1/2 to 1/2.
    std::string checkGradient(const Place& place, size_t channel, const double* moments) const {
        if (sidecar_.baked.gradients.empty() || sidecar_.baked.isHomogeneous(place.item)) {
            return {};
        }
        const auto n = static_cast<double>(size_);
        const double spread = 1.0 / 12 + 1 / (6 * n * n);  // mean square of a place
        const BakedSuperVoxel& item = sidecar_.baked.items[place.item + channel];
        const double slack = 1e-5 * static_cast<double>(item.max) / n;
        for (size_t a = 0; a < 3 && item.min < item.max; ++a) {
            const auto claimed =
                static_cast<double>(sidecar_.baked.gradients[3 * (place.item + channel) + a]);
            const double found = moments[a] / (n * n * n) / spread / n;
            if (std::fabs(claimed - found) > 1e-5 * std::fabs(found) + slack) {
                std::ostringstream line;
                line << name(place, channel) << ": gradient " << claimed << " along axis " << a
                     << ", but it is " << found;
                return line.str();
            }
        }
        return {};
    }

    double unit(int64_t x) const {
        return static_cast<double>(x) / static_cast<double>(size_) - 0.5;
    }

    std::array<trk::ControlPolynomial, kChannels> controlsOf(const Place& place) const {
        std::array<trk::ControlPolynomial, kChannels> controls;
        for (size_t c = 0; c < kChannels; ++c) {
            controls[c] = sidecar_.baked.control(place.item + c);
        }
        return controls;
    }

    std::string checkSums(const Place& place, size_t channel, double mean, double rms,
                          double deviation) const {
        const BakedSuperVoxel& item = sidecar_.baked.items[place.item + channel];
        std::ostringstream line;
        // Float rounding, plus that of summing in another order than the bake.
        const auto exceeds = [&](double found, float claimed) {
            return found > static_cast<double>(claimed) * (1 + 1e-6) + 1e-7 * mean + 1e-38;
        };
        if (std::fabs(static_cast<double>(item.mean) - mean) > 1e-6 * mean + 1e-38) {
            line << name(place, channel) << ": mean " << item.mean << ", but it is " << mean;
        } else if (exceeds(rms, item.rms)) {
            line << name(place, channel) << ": RMS " << item.rms << ", but it is " << rms;
        } else if (exceeds(deviation, item.deviation)) {
            line << name(place, channel) << ": deviation " << item.deviation << ", but it is "
                 << deviation;
        }
        return line.str();
    }

    /// A place larger than a super-voxel claims one value everywhere, faces included.
    std::string checkUniform(const Place& place, uint64_t& vertices) const {
        const auto controls = controlsOf(place);
        std::string wrong;
        forEachRegionAround(place, 0, [&](const Int3& at, int) {
            ++vertices;
            const Sample sample = regions_.at(at);
            for (size_t c = 0; c < kChannels && wrong.empty(); ++c) {
                // Homogeneous: its control is its centre's everywhere.
                wrong = checkVertex(place, c, at, sample[c], controls[c].centre);
            }
            return wrong.empty();
        });
        return wrong;
    }

    /// Calls f(origin, shift) for every uniform region, or else one of 2^least voxels, that has a
    /// part in the closed box of a place, until it answers false.
    template <class F>
    void forEachRegionAround(const Place& place, int least, const F& f) const {
        const int64_t edge = int64_t{1} << place.shift;
        const IntBox closed{
            place.origin,
            {{place.origin[0] + edge + 1, place.origin[1] + edge + 1, place.origin[2] + edge + 1}}};
        // The place itself and the seven regions that its upper faces belong to.
        bool goOn = true;
        for (int corner = 0; corner < 8 && goOn; ++corner) {
            const Int3 origin{{place.origin[0] + (corner & 4 ? edge : 0),
                               place.origin[1] + (corner & 2 ? edge : 0),
                               place.origin[2] + (corner & 1 ? edge : 0)}};
            goOn = forEachRegion(origin, place.shift, least, closed, f);
        }
    }

    /// The same for an aligned region of 2^shift voxels, as far as it meets `box`.
    template <class F>
    bool forEachRegion(const Int3& origin, int shift, int least, const IntBox& box,
                       const F& f) const {
        const int64_t edge = int64_t{1} << shift;
        for (size_t a = 0; a < 3; ++a) {
            if (origin[a] >= box.hi[a] || origin[a] + edge <= box.lo[a]) {
                return true;
            }
        }
        if (shift <= least || (shift >= 3 && regions_.isUniform(origin, shift))) {
            return f(origin, shift);
        }
        for (int64_t octant = 0; octant < 8; ++octant) {
            const int64_t half = edge / 2;
            const Int3 part{{origin[0] + (octant >> 2) * half, origin[1] + (octant >> 1 & 1) * half,
                             origin[2] + (octant & 1) * half}};
            if (!forEachRegion(part, shift - 1, least, box, f)) {
                return false;
            }
        }
        return true;
    }

    std::string name(const Place& place, size_t channel) const {
        std::ostringstream text;
        text << "super-voxel "
             << Int3{{place.origin[0] / size_, place.origin[1] / size_, place.origin[2] / size_}};
        if (kChannels > 1) {
            text << " channel " << channel;
        }
        return text.str();
    }

    std::string checkVertex(const Place& place, size_t channel, const Int3& at, float v,
                            double control) const {
        const BakedSuperVoxel& item = sidecar_.baked.items[place.item + channel];
        const char* bound = nullptr;
        float value = 0;
        const double residual = static_cast<double>(v) - control;
        if (v < item.min) {
            bound = "min";
            value = item.min;
        } else if (v > item.max) {
            bound = "max";
            value = item.max;
        } else if (std::fabs(residual) > static_cast<double>(item.majorant)) {
            bound = "majorant";
            value = item.majorant;
        }
        if (!bound) {
            return {};
        }
        std::ostringstream line;
        line.precision(9);
        line << name(place, channel) << ": " << bound << " " << value << ", but voxel " << at
             << " is " << v;
        if (sidecar_.baked.kind != trk::ControlKind::kConstant) {
            line << " and the control there " << control;
        }
        return line.str();
    }

    static float largest(const Sample& sample) {
        return *std::max_element(sample.begin(), sample.end());
    }

    /// Every super-voxel that a voxel above 0 belongs to must be occupied.
    std::string checkCoverage(const IntBox& block) const {
        const int64_t edge = block.hi[0] - block.lo[0];
        std::ostringstream line;
        const auto report = [&](const Int3& superVoxel, const Int3& at, float v) {
            line << "super-voxel " << superVoxel << ": not in the sidecar, but its voxel " << at
                 << " is " << v;
        };
        if (edge > 8) {  // a tile
            const float v = largest(regions_.at(block.lo));
            IntBox touched;
            for (size_t a = 0; a < 3; ++a) {
                touched.lo[a] = (block.lo[a] - 1 - sidecar_.anchor[a]) & ~(size_ - 1);
                touched.hi[a] = block.hi[a] - sidecar_.anchor[a];
            }
            const auto empty = v > 0 ? firstEmpty(touched) : std::nullopt;
            if (empty) {
                const Int3 at = toIndex(*empty);
                report({{at[0] / size_, at[1] / size_, at[2] / size_}}, block.lo, v);
            }
            return line.str();
        }
        for (int64_t i = 0; i < 512; ++i) {
            const Int3 at{
                {block.lo[0] + (i >> 6), block.lo[1] + (i >> 3 & 7), block.lo[2] + (i & 7)}};
            const float v = largest(regions_.at(at));
            for (int corner = 0; v > 0 && corner < 8; ++corner) {
                Int3 cell = at;
                for (size_t a = 0; a < 3; ++a) {
                    cell[a] -= (corner >> a & 1) + sidecar_.anchor[a];
                }
                if (sidecar_.baked.table.find(cell[0], cell[1], cell[2]).entry ==
                    SparseTable::kEmpty) {
                    const Int3 global = toIndex(cell);
                    const int64_t n = size_;
                    const auto down = [n](int64_t x) { return (x - (x % n + n) % n) / n; };
                    report({{down(global[0]), down(global[1]), down(global[2])}}, at, v);
                    return line.str();
                }
            }
        }
        return {};
    }

    /// A place in `box` (local) where the table is empty, found by its regions.
    std::optional<Int3> firstEmpty(const IntBox& box) const {
        for (Int3 at = box.lo; at[0] < box.hi[0]; at[0] += size_) {
            for (at[1] = box.lo[1]; at[1] < box.hi[1]; at[1] += size_) {
                for (at[2] = box.lo[2]; at[2] < box.hi[2];) {
                    const auto found = sidecar_.baked.table.find(at[0], at[1], at[2]);
                    if (found.entry == SparseTable::kEmpty) {
                        return at;
                    }
                    const int64_t edge = int64_t{1} << found.shift;
                    at[2] = (at[2] / edge + 1) * edge;
                }
            }
        }
        return std::nullopt;
    }

    Regions& regions_;
    const trk::Sidecar& sidecar_;
    int64_t size_;
    std::set<SparseTable::Key> known_;  // places that others look like, while they are listed
};

}  // namespace

VerifyReport verify(const trk::DensitySummary& density, const trk::Sidecar& sidecar,
                    uint64_t maxMemory) {
    trk::VdbFile file(density.path);
    const trk::VdbEntry& entry =
        file.select(density.grid.name + "[" + std::to_string(density.grid.index) + "]");
    VerifyReport report;
    trk::withValueType(density.valueType, [&](auto zero) {
        using Value = decltype(zero);
        trk::VdbTree<Value> tree(file, entry, maxMemory);
        Voxels<Value> voxels(tree, density.anchor, maxMemory);
        report = Verifier<Value>(voxels, sidecar).run();
    });
    return report;
}

}  // namespace vdbtools
