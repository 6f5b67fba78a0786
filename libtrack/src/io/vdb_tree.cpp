// SPDX-License-Identifier: Apache-2.0
#include "vdb_tree.h"

#include "density_types.h"
#include "failure.h"
#include "hash.h"
#include "progress.h"

#include <tbb/parallel_pipeline.h>
#include <tbb/task_arena.h>
#include <tbb/task_group.h>

#include <algorithm>
#include <memory>

namespace trk {
namespace {

constexpr int kUpperShift = 12;  // edges of the nodes, in voxels
constexpr int kLowerShift = 7;
constexpr int kLeafShift = 3;
constexpr int kUpperLog2 = kUpperShift - kLowerShift;
constexpr int kLowerLog2 = kLowerShift - kLeafShift;
constexpr size_t kLeafMaskBytes = 64;
constexpr size_t kUpperMaskBytes = size_t{1} << (3 * kUpperLog2 - 3);

/// Calls f(index) for every bit that is set.
template <class F>
void forEachBit(const std::vector<uint64_t>& words, const F& f) {
    for (size_t w = 0; w < words.size(); ++w) {
        for (uint64_t bits = words[w]; bits != 0; bits &= bits - 1) {
            f(64 * w + static_cast<size_t>(__builtin_ctzll(bits)));
        }
    }
}

size_t countBits(const std::vector<uint64_t>& words) {
    size_t count = 0;
    for (const uint64_t w : words) {
        count += static_cast<size_t>(__builtin_popcountll(w));
    }
    return count;
}

using Origin = std::array<int32_t, 3>;

Origin childOrigin(const Origin& origin, size_t i, int log2Dim, int childShift) {
    const size_t last = (size_t{1} << log2Dim) - 1;
    const auto at = [&](size_t n) { return static_cast<int32_t>((n & last) << childShift); };
    return {origin[0] + at(i >> 2 * log2Dim), origin[1] + at(i >> log2Dim), origin[2] + at(i)};
}

std::string text(const Origin& o) {
    return "(" + std::to_string(o[0]) + ", " + std::to_string(o[1]) + ", " + std::to_string(o[2]) +
           ")";
}

/// Reads the masks of a node, of children and of active values, which exclude each other.
void readMasks(FileReader& reader, int log2Dim, std::vector<uint64_t>& children,
               std::vector<uint64_t>& active) {
    children.resize(size_t{1} << (3 * log2Dim - 6));
    active.resize(children.size());
    reader.read(children.data(), 8 * children.size());
    reader.read(active.data(), 8 * active.size());
    for (size_t w = 0; w < children.size(); ++w) {
        if ((children[w] & active[w]) != 0) {
            reader.refuse("a node with a child where it has an active value");
        }
    }
}

/// Reads and checks the counts of a root: tiles, and children, with what they take at least.
std::array<uint32_t, 2> readRootCounts(FileReader& reader, size_t valueBytes) {
    const auto tiles = reader.value<uint32_t>();
    const auto children = reader.value<uint32_t>();
    reader.expect(uint64_t{tiles} * (13 + valueBytes), "root tiles");
    reader.expect(uint64_t{children} * (12 + 2 * kUpperMaskBytes), "root children");
    return {tiles, children};
}

Origin readRootOrigin(FileReader& reader, const Origin* last) {
    const auto origin = reader.value<Origin>();
    for (const int32_t x : origin) {
        if ((x & ((1 << kUpperShift) - 1)) != 0) {
            reader.refuse("a root node at " + text(origin) + "; expected multiples of 4096");
        }
    }
    if (last && !(*last < origin)) {
        reader.refuse("a root node at " + text(origin) + " behind one at " + text(*last));
    }
    return origin;
}

void readBufferCount(FileReader& reader) {
    const auto count = reader.value<int32_t>();
    if (count != 1) {
        reader.refuse("a tree of " + std::to_string(count) + " buffers; expected 1");
    }
}

}  // namespace

template <class Value>
VdbTree<Value>::VdbTree(VdbFile& file, const VdbEntry& entry, uint64_t maxMemory)
    : file_(file), place_(file.path() + ": grid " + entry.label()), maxMemory_(maxMemory) {
    const VdbEntry& owner = file.treeOwner(entry);
    const VdbGridHeader header = file.readHeader(owner);
    format_.compression = owner.compression;
    format_.half = owner.half;
    format_.channels = ValueTraits<Value>::kChannels;
    format_.valueBytes = sizeof(Value);
    this->half_ = owner.half;
    end_ = owner.end;
    file.reader().setPlace(place_);
    file.reader().confine(header.tree, end_);
    readRoot();
    valuesStart_ = file.reader().position();
    if (owner.blocks != 0 && valuesStart_ != owner.blocks) {
        file.reader().refuse("its topology ends here, but its values are said to begin at byte " +
                             std::to_string(owner.blocks));
    }
    upper_ = {};
    lower_ = {};
}

template <class Value>
void VdbTree<Value>::addTile(const Origin& origin, int shift, const Value& value, bool active) {
    if (active || !(value == Value{})) {
        this->tiles_.push_back({origin, shift, value, active});
    }
}

template <class Value>
void VdbTree<Value>::readInternal(const Origin& origin, int log2Dim, int childShift, Node& node) {
    FileReader& reader = file_.reader();
    readMasks(reader, log2Dim, node.children, node.active);
    bytes_.clear();
    const size_t slots = size_t{1} << 3 * log2Dim;
    const size_t active = countBits(node.active);
    const PackedValues packed = takeValues(reader, format_, slots, active, bytes_);
    // Nothing but a background of 0, as in most nodes of a sparse volume.
    if (packed.count == 0 && packed.kind <= 1 && this->background_ == Value{}) {
        return;
    }
    node.values.resize(slots);
    decoder_.decode(packed, bytes_, format_, node.active.data(), slots, this->background_,
                    node.values.data(), place_);
    for (size_t w = 0; w < node.children.size(); ++w) {
        for (uint64_t bits = ~node.children[w]; bits != 0; bits &= bits - 1) {
            const auto bit = static_cast<size_t>(__builtin_ctzll(bits));
            const size_t i = 64 * w + bit;
            addTile(childOrigin(origin, i, log2Dim, childShift), childShift, node.values[i],
                    (node.active[w] >> bit & 1) != 0);
        }
    }
}

template <class Value>
void VdbTree<Value>::readUpper(const Origin& origin) {
    FileReader& reader = file_.reader();
    ++upperNodes_;
    readInternal(origin, kUpperLog2, kLowerShift, upper_);
    checkMemory();
    forEachBit(upper_.children, [&](size_t i) {
        const Origin lower = childOrigin(origin, i, kUpperLog2, kLowerShift);
        ++lowerNodes_;
        Progress::poll();
        readInternal(lower, kLowerLog2, kLeafShift, lower_);
        forEachBit(lower_.children, [&](size_t j) {
            uint64_t mask[kLeafMaskBytes / 8];
            reader.read(mask, sizeof(mask));
            this->leafOrigins_.push_back(childOrigin(lower, j, kLowerLog2, kLeafShift));
            maskHashes_.push_back(hashWords(mask, 8, 0));
        });
        checkMemory();
    });
}

template <class Value>
void VdbTree<Value>::checkMemory() const {
    if (maxMemory_ > 0 && this->listBytes() > maxMemory_) {
        throw Error(TRK_ERROR_OUT_OF_MEMORY,
                    place_ + ": has more than " + std::to_string(this->leafOrigins_.size()) +
                        " leaves and " + std::to_string(this->tiles_.size()) +
                        " tiles, whose list alone takes more than maxMemory = " +
                        std::to_string(maxMemory_) + " bytes");
    }
}

template <class Value>
void VdbTree<Value>::readRoot() {
    FileReader& reader = file_.reader();
    readBufferCount(reader);
    this->background_ = reader.value<Value>();
    const auto [tiles, children] = readRootCounts(reader, sizeof(Value));
    std::vector<Origin> tileOrigins;
    for (uint32_t i = 0; i < tiles; ++i) {
        const Origin origin = readRootOrigin(reader, i == 0 ? nullptr : &tileOrigins.back());
        tileOrigins.push_back(origin);
        const auto value = reader.value<Value>();
        const auto active = reader.value<uint8_t>();
        if (active > 1) {
            reader.refuse("a root tile whose state is " + std::to_string(active));
        }
        addTile(origin, kUpperShift, value, active == 1);
        checkMemory();
    }
    Origin last{};
    for (uint32_t i = 0; i < children; ++i) {
        last = readRootOrigin(reader, i == 0 ? nullptr : &last);
        if (std::binary_search(tileOrigins.begin(), tileOrigins.end(), last)) {
            reader.refuse("a root node and a root tile, both at " + text(last));
        }
        readUpper(last);
    }
}

template <class Value>
void VdbTree<Value>::forEachBatch(const Body& body) {
    FileReader& reader = file_.reader();
    reader.setPlace(place_);
    reader.confine(valuesStart_, end_);
    positions_.resize(this->leafCount());
    passOver(
        this->leafCount(), nullptr, [&](size_t leaf) { positions_[leaf] = reader.position(); },
        body);
    if (reader.remaining() != 0) {
        reader.refuse("its leaves end here, but the grid is said to go on for " +
                      std::to_string(reader.remaining()) + " bytes");
    }
}

template <class Value>
void VdbTree<Value>::forEachBatchOf(const std::vector<uint32_t>& leaves, const Body& body) {
    FileReader& reader = file_.reader();
    reader.setPlace(place_);
    passOver(
        leaves.size(), leaves.data(), [&](size_t leaf) { reader.confine(positions_[leaf], end_); },
        body);
}

template <class Value>
template <class Find>
void VdbTree<Value>::passOver(size_t leafCount, const uint32_t* some, const Find& find,
                              const Body& body) {
    constexpr size_t kBatch = 64;
    struct Batch {
        size_t first = 0;
        std::vector<uint64_t> masks;
        std::vector<PackedValues> packed;
        std::vector<char> bytes;
    };
    FileReader& reader = file_.reader();
    size_t next = 0;
    const auto take = [&](tbb::flow_control& control) -> std::shared_ptr<Batch> {
        if (next == leafCount) {
            control.stop();
            return nullptr;
        }
        auto batch = std::make_shared<Batch>();
        batch->first = next;
        const size_t count = std::min(kBatch, leafCount - next);
        batch->masks.resize(8 * count);
        batch->bytes.reserve(count * (sizeof(Value) * 512 / 2));
        for (size_t i = 0; i < count; ++i, ++next) {
            const size_t at = some ? some[next] : next;
            find(at);
            uint64_t* mask = &batch->masks[8 * i];
            reader.read(mask, kLeafMaskBytes);
            if (hashWords(mask, 8, 0) != maskHashes_[at]) {
                reader.refuse("the mask of leaf " + text(this->leafOrigins_[at]) +
                              " is not that of the topology");
            }
            size_t active = 0;
            for (size_t w = 0; w < 8; ++w) {
                active += static_cast<size_t>(__builtin_popcountll(mask[w]));
            }
            batch->packed.push_back(
                takeValues(reader, format_, LeafBatch<Value>::kLeafVoxels, active, batch->bytes));
        }
        return batch;
    };
    struct Scratch {
        ChunkDecoder decoder;
        std::vector<Value> values;
    };
    // One a task at a time, wherever it runs: decoders are dear to make.
    std::vector<std::unique_ptr<Scratch>> idle;
    tbb::spin_mutex idleLock;
    const auto decode = [&](const std::shared_ptr<Batch>& batch) {
        std::unique_ptr<Scratch> scratch;
        {
            const tbb::spin_mutex::scoped_lock lock(idleLock);
            if (!idle.empty()) {
                scratch = std::move(idle.back());
                idle.pop_back();
            }
        }
        if (!scratch) {
            scratch = std::make_unique<Scratch>();
            scratch->values.resize(kBatch * LeafBatch<Value>::kLeafVoxels);
        }
        for (size_t i = 0; i < batch->packed.size(); ++i) {
            scratch->decoder.decode(batch->packed[i], batch->bytes, format_, &batch->masks[8 * i],
                                    LeafBatch<Value>::kLeafVoxels, this->background_,
                                    &scratch->values[i * LeafBatch<Value>::kLeafVoxels], place_);
        }
        body({batch->first, batch->packed.size(), batch->masks.data(), scratch->values.data(),
              some ? some + batch->first : nullptr});
        {
            const tbb::spin_mutex::scoped_lock lock(idleLock);
            idle.push_back(std::move(scratch));
        }
        Progress::poll(static_cast<double>(batch->first) / static_cast<double>(leafCount));
    };
    tbb::task_group_context context(tbb::task_group_context::isolated);
    const auto tokens = 2 * static_cast<size_t>(tbb::this_task_arena::max_concurrency());
    tbb::parallel_pipeline(
        tokens,
        tbb::make_filter<void, std::shared_ptr<Batch>>(tbb::filter_mode::serial_in_order, take) &
            tbb::make_filter<std::shared_ptr<Batch>, void>(tbb::filter_mode::parallel, decode),
        context);
}

template <class Value>
uint64_t VdbTree<Value>::openvdbBytes() const {
    using Tree = typename openvdb::tree::Tree4<Value, 5, 4, 3>::Type;
    using Leaf = typename Tree::LeafNodeType;
    using Upper = typename Tree::RootNodeType::ChildNodeType;
    return this->leafCount() * (sizeof(Leaf) + Leaf::SIZE * sizeof(Value)) +
           lowerNodes_ * sizeof(typename Upper::ChildNodeType) + upperNodes_ * sizeof(Upper) +
           sizeof(Tree);
}

template class VdbTree<float>;
template class VdbTree<double>;
template class VdbTree<openvdb::Vec3f>;
template class VdbTree<openvdb::Vec3d>;

bool stepOverTree(FileReader& reader, const std::string& type, bool half, uint32_t compression) {
    struct Kind {
        const char* name;
        size_t component;
        size_t channels;
        bool real;
    };
    static constexpr Kind kKinds[] = {{"float", 4, 1, true},  {"double", 8, 1, true},
                                      {"int32", 4, 1, false}, {"int64", 8, 1, false},
                                      {"bool", 1, 1, false},  {"vec3s", 4, 3, true},
                                      {"vec3d", 8, 3, true},  {"vec3i", 4, 3, false}};
    const std::string valueType = valueTypeName(type);
    const auto kind = std::find_if(std::begin(kKinds), std::end(kKinds),
                                   [&](const Kind& k) { return valueType == k.name; });
    if (kind == std::end(kKinds) || type != treeTypeName(valueType)) {
        return false;
    }
    ValueFormat format;
    format.compression = compression;
    format.half = half && kind->real;
    format.channels = kind->channels;
    format.valueBytes = kind->component * kind->channels;
    readBufferCount(reader);
    reader.skip(format.valueBytes);  // the background
    const auto [tiles, children] = readRootCounts(reader, format.valueBytes);
    reader.skip(uint64_t{tiles} * (13 + format.valueBytes));
    std::vector<uint64_t> upper;
    std::vector<uint64_t> lower;
    std::vector<uint64_t> active;
    std::vector<char> bytes;
    const auto node = [&](int log2Dim, std::vector<uint64_t>& childMask) {
        readMasks(reader, log2Dim, childMask, active);
        bytes.clear();
        takeValues(reader, format, size_t{1} << 3 * log2Dim, countBits(active), bytes);
    };
    uint64_t leaves = 0;
    Origin last{};
    for (uint32_t i = 0; i < children; ++i) {
        last = readRootOrigin(reader, i == 0 ? nullptr : &last);
        node(kUpperLog2, upper);
        forEachBit(upper, [&](size_t) {
            node(kLowerLog2, lower);
            const size_t count = countBits(lower);
            reader.skip(count * kLeafMaskBytes);
            leaves += count;
        });
    }
    active.resize(kLeafMaskBytes / 8);
    for (uint64_t i = 0; i < leaves; ++i) {
        reader.read(active.data(), kLeafMaskBytes);
        if (valueType == "bool") {  // an origin, and a mask for values
            reader.skip(12 + kLeafMaskBytes);
            continue;
        }
        bytes.clear();
        takeValues(reader, format, LeafBatch<float>::kLeafVoxels, countBits(active), bytes);
    }
    return true;
}

}  // namespace trk
