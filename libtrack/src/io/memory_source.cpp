// SPDX-License-Identifier: Apache-2.0
#include "memory_source.h"

#include "density_types.h"
#include "failure.h"
#include "field/density_field.h"
#include "parallel.h"

#include <tbb/parallel_sort.h>

#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstring>
#include <limits>
#include <utility>
#include <vector>

namespace trk {
namespace {

constexpr size_t kLeafVoxels = LeafBatch<float>::kLeafVoxels;
constexpr size_t kBatch = 16;  // leaves: their values stay in the cache

size_t componentBytes(TrkValueType type) {
    return type == TRK_VALUE_HALF ? 2 : type == TRK_VALUE_FLOAT ? 4 : 8;
}

/// An IEEE half as a float, whatever it is.
float anyHalf(uint16_t half) {
    const auto size = static_cast<uint16_t>(half & 0x7fff);
    const float value = size < 0x7c00   ? decodeHalf(size)
                        : size > 0x7c00 ? std::numeric_limits<float>::quiet_NaN()
                                        : std::numeric_limits<float>::infinity();
    return half & 0x8000 ? -value : value;
}

/// A component, wherever it lies: the caller's arrays may be aligned for nothing.
template <class Component>
Component load(const char* at, TrkValueType type) {
    if (type == TRK_VALUE_HALF) {
        uint16_t half;
        std::memcpy(&half, at, sizeof(half));
        return static_cast<Component>(anyHalf(half));
    }
    Component value;  // float or double, as the source was chosen by it
    std::memcpy(&value, at, sizeof(value));
    return value;
}

std::string text(const std::array<int32_t, 3>& o) {
    return "(" + std::to_string(o[0]) + ", " + std::to_string(o[1]) + ", " + std::to_string(o[2]) +
           ")";
}

/// A dense array as leaves: those in which anything is not 0.
template <class Value>
class DenseSource : public RegionSource<Value> {
  public:
    explicit DenseSource(const TrkDensity& density) : density_(density) {
        const size_t component = componentBytes(density.valueType);
        channelStride_ =
            density.channelStride != 0 ? density.channelStride : static_cast<int64_t>(component);
        auto next = static_cast<int64_t>(component * kChannels);
        const bool packed = std::all_of(density.strides, density.strides + 3,
                                        [](int64_t stride) { return stride == 0; });
        for (size_t a = 0; a < 3; ++a) {
            lo_[a] = density.origin[a];
            hi_[a] = lo_[a] + static_cast<int64_t>(density.extent[a]);
            strides_[a] = packed ? next : density.strides[a];
            next *= static_cast<int64_t>(density.extent[a]);
        }
        this->half_ = density.valueType == TRK_VALUE_HALF;
        findLeaves();
    }

    void forEachBatch(const std::function<void(const LeafBatch<Value>&)>& body) override {
        parallelRanges(this->leafCount(), kBatch, [&](size_t begin, size_t end) {
            std::vector<Value> values(kBatch * kLeafVoxels);
            std::vector<uint64_t> masks(8 * kBatch);
            for (size_t first = begin; first < end; first += kBatch) {
                const size_t count = std::min(kBatch, end - first);
                for (size_t i = 0; i < count; ++i) {
                    Value* leaf = &values[i * kLeafVoxels];
                    readLeaf(this->leafOrigins_[first + i], leaf);
                    for (size_t w = 0; w < 8; ++w) {
                        uint64_t word = 0;
                        for (size_t bit = 0; bit < 64; ++bit) {
                            word |= static_cast<uint64_t>(!(leaf[64 * w + bit] == Value{})) << bit;
                        }
                        masks[8 * i + w] = word;
                    }
                }
                body({first, count, masks.data(), values.data()});
                Progress::poll(static_cast<double>(first) / static_cast<double>(this->leafCount()));
            }
        });
    }

  private:
    static constexpr size_t kChannels = ValueTraits<Value>::kChannels;
    using Component = typename ValueTraits<Value>::Component;
    using Origin = typename RegionSource<Value>::Origin;

    /// The part of a leaf that the array covers.
    IntBox covered(const Origin& origin) const {
        IntBox box;
        for (size_t a = 0; a < 3; ++a) {
            box.lo[a] = std::max<int64_t>(origin[a], lo_[a]);
            box.hi[a] = std::min<int64_t>(int64_t{origin[a]} + 8, hi_[a]);
        }
        return box;
    }
    const char* at(const Int3& p) const {
        int64_t offset = 0;
        for (size_t a = 0; a < 3; ++a) {
            offset += (p[a] - lo_[a]) * strides_[a];
        }
        return static_cast<const char*>(density_.values) + offset;
    }

    /// The axis of x and z along which voxels lie closer.
    size_t innerAxis() const { return std::abs(strides_[0]) < std::abs(strides_[2]) ? 0 : 2; }

    /// Calls f(voxel in the leaf, where its first component lies) for what the array covers, along
    /// the array's own rows.
    template <class F>
    void forEachVoxel(const Origin& origin, const F& f) const {
        const IntBox box = covered(origin);
        const size_t inner = innerAxis();
        const size_t outer = 2 - inner;
        Int3 p;
        for (p[outer] = box.lo[outer]; p[outer] < box.hi[outer]; ++p[outer]) {
            for (p[1] = box.lo[1]; p[1] < box.hi[1]; ++p[1]) {
                p[inner] = box.lo[inner];
                const char* from = at(p);
                auto voxel = static_cast<size_t>((p[0] - origin[0]) * 64 + (p[1] - origin[1]) * 8 +
                                                 p[2] - origin[2]);
                for (; p[inner] < box.hi[inner]; ++p[inner]) {
                    f(voxel, from);
                    voxel += inner == 0 ? 64 : 1;
                    from += strides_[inner];
                }
            }
        }
    }

    /// Whether any of `count` components, `stride` bytes apart, is not 0. By their bits, so that a
    /// row is read as fast as memory is.
    template <class Bits>
    static bool anySet(const char* from, int64_t stride, int64_t count) {
        Bits all = 0;
        const auto add = [&](int64_t step) {
            for (int64_t i = 0; i < count; ++i) {
                Bits bits;
                std::memcpy(&bits, from + i * step, sizeof(bits));
                all = static_cast<Bits>(all | bits);
            }
        };
        constexpr auto kNext = static_cast<int64_t>(sizeof(Bits));
        stride == kNext ? add(kNext) : add(stride);
        return static_cast<Bits>(all << 1) != 0;  // -0 is 0
    }
    /// The same of `count` voxels along an axis.
    bool anySet(const char* from, size_t axis, int64_t count) const {
        const size_t component = componentBytes(density_.valueType);
        const auto width = static_cast<int64_t>(component);
        constexpr auto kAll = static_cast<int64_t>(kChannels);
        const bool packed = channelStride_ == width && strides_[axis] == kAll * width;
        bool any = false;
        for (int64_t c = 0; c < (packed ? 1 : kAll); ++c) {
            const char* first = from + c * channelStride_;
            const int64_t stride = packed ? width : strides_[axis];
            const int64_t n = packed ? kAll * count : count;
            any = any || (component == 2   ? anySet<uint16_t>(first, stride, n)
                          : component == 4 ? anySet<uint32_t>(first, stride, n)
                                           : anySet<uint64_t>(first, stride, n));
        }
        return any;
    }

    /// Along the array's own rows, so that each is read once, in order.
    void findLeaves() {
        Int3 first;
        Int3 count;
        for (size_t a = 0; a < 3; ++a) {
            first[a] = lo_[a] & ~int64_t{7};
            count[a] = (hi_[a] - first[a] + 7) >> 3;
        }
        const size_t inner = innerAxis();
        const size_t outer = 2 - inner;
        const std::array<int64_t, 3> places{{count[1] * count[2], count[2], 1}};
        std::vector<char> occupied(static_cast<size_t>(count[0] * count[1] * count[2]));
        parallelFor(static_cast<size_t>(count[outer] * count[1]), 1, [&](size_t band) {
            Int3 leaf{{0, static_cast<int64_t>(band) % count[1], 0}};
            leaf[outer] = static_cast<int64_t>(band) / count[1];
            const auto rows = [&](size_t a) {
                return std::pair(std::max(first[a] + 8 * leaf[a], lo_[a]),
                                 std::min(first[a] + 8 * leaf[a] + 8, hi_[a]));
            };
            char* found =
                &occupied[static_cast<size_t>(leaf[outer] * places[outer] + leaf[1] * places[1])];
            Int3 p;
            for (p[outer] = rows(outer).first; p[outer] < rows(outer).second; ++p[outer]) {
                for (p[1] = rows(1).first; p[1] < rows(1).second; ++p[1]) {
                    for (int64_t k = 0; k < count[inner]; ++k) {
                        char& here = found[k * places[inner]];
                        p[inner] = std::max(first[inner] + 8 * k, lo_[inner]);
                        const int64_t end = std::min(first[inner] + 8 * k + 8, hi_[inner]);
                        here = here || anySet(at(p), inner, end - p[inner]);
                    }
                }
            }
        });
        for (size_t i = 0; i < occupied.size(); ++i) {
            if (occupied[i]) {
                const auto n = static_cast<int64_t>(i);
                this->leafOrigins_.push_back(
                    Origin{{static_cast<int32_t>(first[0] + 8 * (n / places[0])),
                            static_cast<int32_t>(first[1] + 8 * (n / places[1] % count[1])),
                            static_cast<int32_t>(first[2] + 8 * (n % count[2]))}});
            }
        }
    }

    void readLeaf(const Origin& origin, Value* leaf) const {
        const IntBox box = covered(origin);
        bool whole = true;
        for (size_t a = 0; a < 3; ++a) {
            whole = whole && box.hi[a] - box.lo[a] == 8;
        }
        if (!whole) {
            std::fill_n(leaf, kLeafVoxels, Value{});
        }
        Component* components = ValueTraits<Value>::components(leaf);
        const TrkValueType type = density_.valueType;
        forEachVoxel(origin, [&](size_t voxel, const char* from) {
            for (size_t c = 0; c < kChannels; ++c) {
                components[voxel * kChannels + c] =
                    load<Component>(from + static_cast<int64_t>(c) * channelStride_, type);
            }
        });
    }

    const TrkDensity& density_;
    Int3 lo_{{0, 0, 0}};  // index space; `hi_` is outside
    Int3 hi_{{0, 0, 0}};
    std::array<int64_t, 3> strides_{};
    int64_t channelStride_ = 0;
};

/// Bricks and tiles, as they come.
template <class Value>
class BrickSource : public RegionSource<Value> {
  public:
    BrickSource(const TrkDensity& density, const std::string& where) : density_(density) {
        this->half_ = density.valueType == TRK_VALUE_HALF;
        this->leafOrigins_.resize(density.brickCount);
        parallelFor(density.brickCount, 4096, [&](size_t i) {
            std::copy_n(density.brickOrigins + 3 * i, 3, this->leafOrigins_[i].begin());
        });
        const size_t component = componentBytes(density.valueType);
        const auto* values = static_cast<const char*>(density.tileValues);
        for (size_t i = 0; i < density.tileCount; ++i) {
            Tile<Value> tile{};
            std::copy_n(density.tileOrigins + 3 * i, 3, tile.origin.begin());
            tile.shift = shiftOf(density.tileSizes[i]);
            if (tile.shift == 0) {
                refuse(where, "tile " + std::to_string(i) + " has size " +
                                  std::to_string(density.tileSizes[i]) +
                                  "; expected 8, 128 or 4096");
            }
            Component* components = ValueTraits<Value>::components(&tile.value);
            for (size_t c = 0; c < kChannels; ++c) {
                components[c] =
                    load<Component>(values + (i * kChannels + c) * component, density.valueType);
            }
            tile.active = !density.tileActive || density.tileActive[i] != 0;
            all_.push_back(tile);
            if (tile.active || !(tile.value == Value{})) {
                this->tiles_.push_back(tile);
            }
        }
        checkPlaces(where);
        all_ = {};
    }

    void forEachBatch(const std::function<void(const LeafBatch<Value>&)>& body) override {
        parallelRanges(this->leafCount(), kBatch, [&](size_t begin, size_t end) {
            std::vector<Value> values(kBatch * kLeafVoxels);
            const std::vector<uint64_t> active(8 * kBatch, ~uint64_t{0});
            for (size_t first = begin; first < end; first += kBatch) {
                const size_t count = std::min(kBatch, end - first);
                for (size_t i = 0; i < count; ++i) {
                    readBrick(density_.brickValues[first + i], &values[i * kLeafVoxels]);
                }
                body({first, count,
                      density_.brickMasks ? density_.brickMasks + 8 * first : active.data(),
                      values.data()});
                Progress::poll(static_cast<double>(first) / static_cast<double>(this->leafCount()));
            }
        });
    }

  private:
    static constexpr size_t kChannels = ValueTraits<Value>::kChannels;
    using Component = typename ValueTraits<Value>::Component;
    using Origin = typename RegionSource<Value>::Origin;

    [[noreturn]] static void refuse(const std::string& where, const std::string& what) {
        throw Error(TRK_ERROR_INVALID_ARGUMENT, where + ": " + what);
    }
    static int shiftOf(int32_t size) {
        return size == 8 ? 3 : size == 128 ? 7 : size == 4096 ? 12 : 0;
    }

    void readBrick(const void* from, Value* leaf) const {
        Component* components = ValueTraits<Value>::components(leaf);
        constexpr size_t kCount = kLeafVoxels * kChannels;
        if (density_.valueType != TRK_VALUE_HALF) {
            std::memcpy(static_cast<void*>(components), from, kCount * sizeof(Component));
            return;
        }
        for (size_t i = 0; i < kCount; ++i) {
            components[i] = load<Component>(static_cast<const char*>(from) + 2 * i, TRK_VALUE_HALF);
        }
    }

    /// Every place aligned to its size, none within another.
    void checkPlaces(const std::string& where) const {
        const auto check = [&](const Origin& o, int shift, const char* what) {
            for (const int32_t x : o) {
                if ((x & ((1 << shift) - 1)) != 0) {
                    refuse(where, std::string("the origin ") + text(o) + " of a " + what +
                                      " is not a multiple of " + std::to_string(1 << shift));
                }
            }
        };
        for (const Origin& origin : this->leafOrigins_) {
            check(origin, 3, "brick");
        }
        // Sorted by size: a smaller place lies within a larger one if that begins where it, rounded
        // down, does.
        std::vector<Origin> places[3] = {this->leafOrigins_, {}, {}};
        for (const Tile<Value>& tile : all_) {
            check(tile.origin, tile.shift, "tile");
            places[tile.shift == 3 ? 0 : tile.shift == 7 ? 1 : 2].push_back(tile.origin);
        }
        constexpr int32_t kSizes[3] = {8, 128, 4096};
        for (std::vector<Origin>& level : places) {
            tbb::parallel_sort(level.begin(), level.end());
            const auto twice = std::adjacent_find(level.begin(), level.end());
            if (twice != level.end()) {
                refuse(where, "two bricks or tiles at " + text(*twice));
            }
        }
        for (size_t large = 1; large < 3; ++large) {
            for (size_t small = 0; small < large && !places[large].empty(); ++small) {
                for (const Origin& origin : places[small]) {
                    Origin down = origin;
                    for (int32_t& x : down) {
                        x &= ~(kSizes[large] - 1);
                    }
                    if (std::binary_search(places[large].begin(), places[large].end(), down)) {
                        refuse(where, "the brick or tile at " + text(origin) +
                                          " lies in the tile of " + std::to_string(kSizes[large]) +
                                          "^3 at " + text(down));
                    }
                }
            }
        }
    }

    const TrkDensity& density_;
    std::vector<Tile<Value>> all_;  // also those that say nothing
};

}  // namespace

template <class Value>
std::unique_ptr<RegionSource<Value>> makeMemorySource(const TrkDensity& density,
                                                      const std::string& where) {
    if (density.values) {
        return std::make_unique<DenseSource<Value>>(density);
    }
    return std::make_unique<BrickSource<Value>>(density, where);
}

template std::unique_ptr<RegionSource<float>> makeMemorySource(const TrkDensity&,
                                                               const std::string&);
template std::unique_ptr<RegionSource<double>> makeMemorySource(const TrkDensity&,
                                                                const std::string&);
template std::unique_ptr<RegionSource<openvdb::Vec3f>> makeMemorySource(const TrkDensity&,
                                                                        const std::string&);
template std::unique_ptr<RegionSource<openvdb::Vec3d>> makeMemorySource(const TrkDensity&,
                                                                        const std::string&);

}  // namespace trk
