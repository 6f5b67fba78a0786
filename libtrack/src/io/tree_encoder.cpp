// SPDX-License-Identifier: Apache-2.0
#include "tree_encoder.h"

#include "parallel.h"

#include <blosc.h>

#include <algorithm>
#include <array>
#include <cstring>
#include <optional>
#include <utility>

namespace trk {
namespace {

using Piece = TreeLayout::Piece;

// A piece's place: 20 bits an axis of the root's node, then slots of 15, 12 and 9 bits.
constexpr int kRootBits = 20;
constexpr int kUpperAt = 21;
constexpr int kLowerAt = 9;

uint64_t slot(const Int3& at, int shift, int log2Dim) {
    const int64_t last = (int64_t{1} << log2Dim) - 1;
    const auto axis = [&](size_t a) { return static_cast<uint64_t>(at[a] >> shift & last); };
    return axis(0) << 2 * log2Dim | axis(1) << log2Dim | axis(2);
}

Int3 originOf(const Piece& piece) {
    Int3 origin;
    for (size_t a = 0; a < 3; ++a) {
        const auto part = [&](int at, int log2Dim) {
            const uint64_t bits = piece.within >> at >> (2 - a) * static_cast<size_t>(log2Dim);
            return static_cast<int64_t>(bits & ((uint64_t{1} << log2Dim) - 1));
        };
        const uint64_t root = piece.root >> (2 - a) * kRootBits & ((1u << kRootBits) - 1);
        origin[a] = ((static_cast<int64_t>(root) - (1 << (kRootBits - 1))) << 12) +
                    (part(kUpperAt, 5) << 7) + (part(kLowerAt, 4) << 3) + part(0, 3);
    }
    return origin;
}

template <class T>
void put(std::string& out, const T& value) {
    out.append(reinterpret_cast<const char*>(&value), sizeof(value));
}

/// A chunk of values, compressed where that is shorter.
template <class Value>
void putChunk(std::string& out, const std::vector<Value>& values) {
    const size_t size = values.size() * sizeof(Value);
    const size_t at = out.size();
    out.resize(at + sizeof(int64_t) + size);
    int64_t stored = -static_cast<int64_t>(size);
    if (size > BLOSC_MAX_OVERHEAD) {
        // As OpenVDB does it, so that nobody reads anything unusual.
        const int bytes =
            blosc_compress_ctx(9, 1, sizeof(float), size, values.data(), &out[at + sizeof(int64_t)],
                               size, BLOSC_LZ4_COMPNAME, size, 1);
        stored = bytes > 0 ? bytes : stored;
    }
    std::memcpy(&out[at], &stored, sizeof(stored));
    if (stored > 0) {
        out.resize(at + sizeof(int64_t) + static_cast<size_t>(stored));
    } else if (size > 0) {
        std::memcpy(&out[at + sizeof(int64_t)], values.data(), size);
    }
}

/// The values of a node: all inactive ones are the background.
template <class Value>
void putValues(std::string& out, const std::vector<Value>& active) {
    out += '\0';
    putChunk(out, active);
}

template <class Value>
class Encoder {
  public:
    Encoder(const std::vector<Value>& values, EncodedTree& out) : values_(values), out_(out) {}

    void encode(const std::vector<Piece>& pieces) {
        encodeLeaves(pieces);
        uint32_t tiles = 0;
        uint32_t children = 0;
        std::string tileBytes;
        std::string childBytes;
        forEachGroup(
            pieces.data(), pieces.data() + pieces.size(), [](const Piece& p) { return p.root; },
            [&](const Piece* begin, const Piece* end) {
                std::string child;
                const auto tile = begin->shift == 12 ? std::optional<Value>(valueOf(*begin))
                                                     : encodeUpper(begin, end, child);
                std::string& to = tile ? tileBytes : childBytes;
                for (const int64_t x : originOf(*begin)) {
                    put(to, static_cast<int32_t>(x) & ~4095);
                }
                if (tile) {
                    put(to, *tile);
                    to += '\1';
                    ++tiles;
                } else {
                    to += child;
                    ++children;
                }
            });
        put(out_.topology, int32_t{1});  // buffers
        put(out_.topology, Value{});     // background
        put(out_.topology, tiles);
        put(out_.topology, children);
        out_.topology += tileBytes;
        out_.topology += childBytes;
        for (const Piece& piece : pieces) {
            const Int3 o = originOf(piece);
            const int32_t edge = 1 << piece.shift;
            const openvdb::Coord lo(static_cast<int32_t>(o[0]), static_cast<int32_t>(o[1]),
                                    static_cast<int32_t>(o[2]));
            const openvdb::Coord last = lo.offsetBy(edge - 1);
            out_.box.expand(openvdb::CoordBBox(lo, last.offsetBy(0, 0, piece.run - 1)));
            out_.activeVoxels += static_cast<uint64_t>(piece.run) << 3 * piece.shift;
        }
    }

  private:
    const Value& valueOf(const Piece& piece) const {
        return values_[SparseTable::index(piece.entry)];
    }

    template <class Key, class F>
    static void forEachGroup(const Piece* begin, const Piece* end, const Key& key, const F& f) {
        while (begin != end) {
            const Piece* next = begin;
            while (next != end && key(*next) == key(*begin)) {
                ++next;
            }
            f(begin, next);
            begin = next;
        }
    }

    /// A node of 2^(3 log2Dim) slots, whose pieces are told apart by the bits from `at` on; of one
    /// slot's, `encodeChild(begin, end, out)` answers the value of a tile, or appends a child. A
    /// tile for the whole node where all is alike. Else its topology goes to `out`.
    template <class EncodeChild>
    std::optional<Value> encodeNode(const Piece* begin, const Piece* end, int log2Dim, int at,
                                    int tileShift, std::string& out,
                                    const EncodeChild& encodeChild) {
        const size_t slots = size_t{1} << 3 * log2Dim;
        std::vector<uint64_t> childMask(slots / 64);
        std::vector<uint64_t> activeMask(slots / 64);
        std::vector<Value> tiles;
        std::string children;
        forEachGroup(
            begin, end, [&](const Piece& p) { return p.within >> at; },
            [&](const Piece* first, const Piece* last) {
                const auto tile = first->shift == tileShift ? std::optional<Value>(valueOf(*first))
                                                            : encodeChild(first, last, children);
                const uint64_t i = first->within >> at & (slots - 1);
                (tile ? activeMask : childMask)[i >> 6] |= uint64_t{1} << (i & 63);
                if (tile) {
                    tiles.push_back(*tile);
                }
            });
        if (tiles.size() == slots && std::all_of(tiles.begin(), tiles.end(),
                                                 [&](const Value& v) { return v == tiles[0]; })) {
            return tiles[0];
        }
        const auto putMask = [&](const std::vector<uint64_t>& mask) {
            out.append(reinterpret_cast<const char*>(mask.data()), 8 * mask.size());
        };
        putMask(childMask);
        putMask(activeMask);
        putValues(out, tiles);
        out += children;
        return std::nullopt;
    }

    std::optional<Value> encodeUpper(const Piece* begin, const Piece* end, std::string& out) {
        const auto tile = encodeNode(begin, end, 5, kUpperAt, 7, out,
                                     [&](const Piece* first, const Piece* last, std::string& to) {
                                         return encodeLower(first, last, to);
                                     });
        using Upper = typename openvdb::tree::Tree4<Value, 5, 4, 3>::Type::RootNodeType;
        out_.openvdbBytes += tile ? 0 : sizeof(typename Upper::ChildNodeType);
        return tile;
    }
    std::optional<Value> encodeLower(const Piece* begin, const Piece* end, std::string& out) {
        const auto tile =
            encodeNode(begin, end, 4, kLowerAt, 3, out,
                       [&](const Piece*, const Piece*, std::string& to) { return encodeLeaf(to); });
        using Upper = typename openvdb::tree::Tree4<Value, 5, 4, 3>::Type::RootNodeType;
        out_.openvdbBytes += tile ? 0 : sizeof(typename Upper::ChildNodeType::ChildNodeType);
        return tile;
    }
    struct Leaf {
        const Piece* begin = nullptr;
        const Piece* end = nullptr;
        std::array<uint64_t, 8> mask{};
        bool isTile = false;
        std::string values;
    };

    /// All leaves, in parallel: compressing them takes most of the time.
    void encodeLeaves(const std::vector<Piece>& pieces) {
        forEachGroup(
            pieces.data(), pieces.data() + pieces.size(),
            [](const Piece& p) { return std::make_pair(p.root, p.within >> kLowerAt); },
            [&](const Piece* begin, const Piece* end) {
                if (begin->shift == 0) {
                    Leaf& leaf = leaves_.emplace_back();
                    leaf.begin = begin;
                    leaf.end = end;
                }
            });
        parallelFor(leaves_.size(), 16, [&](size_t i) {
            Leaf& leaf = leaves_[i];
            std::vector<Value> active;
            bool same = true;
            for (const Piece* p = leaf.begin; p != leaf.end; ++p) {
                const uint64_t at = p->within & 511;
                leaf.mask[at >> 6] |= ((uint64_t{1} << p->run) - 1) << (at & 63);
                active.insert(active.end(), static_cast<size_t>(p->run), valueOf(*p));
                same = same && active.back() == active.front();
            }
            leaf.isTile = same && active.size() == 512;
            if (!leaf.isTile) {
                putValues(leaf.values, active);
                leaf.values.shrink_to_fit();  // it was as long as what it was made of
            }
        });
    }

    /// The next of them.
    std::optional<Value> encodeLeaf(std::string& out) {
        const Leaf& leaf = leaves_[nextLeaf_++];
        if (leaf.isTile) {
            return valueOf(*leaf.begin);
        }
        put(out, leaf.mask);
        put(out_.buffers, leaf.mask);
        out_.buffers += leaf.values;
        out_.openvdbBytes += 512 * sizeof(Value) + 96;
        return std::nullopt;
    }

    const std::vector<Value>& values_;
    EncodedTree& out_;
    std::vector<Leaf> leaves_;
    size_t nextLeaf_ = 0;
};

}  // namespace

TreeLayout::TreeLayout(const SparseTable& table, const Int3& toGrid) {
    const int itemShift = table.itemShift();
    table.forEach([&](const Int3& lo, int shift, SparseTable::Entry entry) {
        Int3 at;
        for (size_t a = 0; a < 3; ++a) {
            at[a] = (toGrid[a] + lo[a]) >> itemShift;
        }
        const int64_t edge = int64_t{1} << (shift - itemShift);
        add({at, {{at[0] + edge, at[1] + edge, at[2] + edge}}}, 12, entry);
    });
    std::sort(pieces_.begin(), pieces_.end(), [](const Piece& a, const Piece& b) {
        return a.root != b.root ? a.root < b.root : a.within < b.within;
    });
    for (size_t i = 0; i < pieces_.size(); ++i) {
        roots_ += i == 0 || pieces_[i].root != pieces_[i - 1].root ? 1 : 0;
    }
}

/// Divides a box into the largest aligned cubes, of at most 2^shift, that nodes have slots for.
void TreeLayout::add(const IntBox& box, int shift, SparseTable::Entry entry) {
    const int64_t size = int64_t{1} << shift;
    Int3 lo;
    for (lo[0] = box.lo[0] & -size; lo[0] < box.hi[0]; lo[0] += size) {
        for (lo[1] = box.lo[1] & -size; lo[1] < box.hi[1]; lo[1] += size) {
            for (lo[2] = box.lo[2] & -size; lo[2] < box.hi[2]; lo[2] += size) {
                IntBox part;
                bool whole = true;
                for (size_t a = 0; a < 3; ++a) {
                    part.lo[a] = std::max(lo[a], box.lo[a]);
                    part.hi[a] = std::min(lo[a] + size, box.hi[a]);
                    whole = whole && part.hi[a] - part.lo[a] == size;
                }
                if (whole) {
                    add(lo, shift, entry);
                } else {
                    add(part, shift == 12 ? 7 : shift == 7 ? 3 : 0, entry);
                }
            }
        }
    }
}

void TreeLayout::add(const Int3& lo, int shift, SparseTable::Entry entry) {
    uint64_t root = 0;
    for (const int64_t x : lo) {
        root = root << kRootBits | static_cast<uint64_t>((x >> 12) + (1 << (kRootBits - 1)));
    }
    const uint64_t within =
        slot(lo, 7, 5) << kUpperAt | slot(lo, 3, 4) << kLowerAt | slot(lo, 0, 3);
    // The surface of a tile is leaves of rows that are alike.
    if (shift == 0 && !pieces_.empty() && (within & 7) != 0) {
        Piece& last = pieces_.back();
        if (last.shift == 0 && last.root == root && last.entry == entry &&
            last.within + static_cast<uint64_t>(last.run) == within) {
            ++last.run;
            return;
        }
    }
    pieces_.push_back({root, within, static_cast<int16_t>(shift), 1, entry});
}

template <class Value>
EncodedTree encodeTree(const TreeLayout& layout, const std::vector<Value>& values) {
    EncodedTree tree;
    Encoder<Value>(values, tree).encode(layout.pieces());
    return tree;
}

template <class Value>
void encodeLeaf(const LeafPlace& leaf, const Value* values, std::string& buffers) {
    std::vector<Value> active;
    for (size_t i = 0; i < 512; ++i) {
        if ((leaf.mask[i >> 6] >> (i & 63) & 1) != 0) {
            active.push_back(values[i]);
        }
    }
    put(buffers, leaf.mask);
    putValues(buffers, active);
}

template <class Value>
EncodedTree encodeLeaves(const std::vector<LeafPlace>& leaves) {
    using Tree = typename openvdb::tree::Tree4<Value, 5, 4, 3>::Type;
    using Upper = typename Tree::RootNodeType::ChildNodeType;
    EncodedTree tree;
    const auto nodeOf = [](const LeafPlace& leaf, int shift) {
        std::array<int32_t, 3> node = leaf.origin;
        for (int32_t& x : node) {
            x &= -(int32_t{1} << shift);
        }
        return node;
    };
    // A node's masks, its values, of which it has none, and what its children are.
    const auto putNode = [](const std::vector<uint64_t>& children, const std::string& below,
                            std::string& out) {
        out.append(reinterpret_cast<const char*>(children.data()), 8 * children.size());
        out.append(8 * children.size(), '\0');
        putValues(out, std::vector<Value>());
        out += below;
    };
    const auto forEachNode = [&](size_t begin, size_t end, int shift, const auto& body) {
        for (size_t first = begin; first < end;) {
            size_t last = first;
            while (last < end && nodeOf(leaves[last], shift) == nodeOf(leaves[first], shift)) {
                ++last;
            }
            body(first, last);
            first = last;
        }
    };
    const auto mark = [](std::vector<uint64_t>& children, uint64_t slot) {
        children[slot >> 6] |= uint64_t{1} << (slot & 63);
    };
    uint32_t roots = 0;
    std::string below;
    forEachNode(0, leaves.size(), 12, [&](size_t rootBegin, size_t rootEnd) {
        ++roots;
        put(below, nodeOf(leaves[rootBegin], 12));
        std::vector<uint64_t> lowers(512);
        std::string lowerBytes;
        forEachNode(rootBegin, rootEnd, 7, [&](size_t begin, size_t end) {
            std::vector<uint64_t> mask(64);
            std::string leafBytes;
            for (size_t i = begin; i < end; ++i) {
                const LeafPlace& leaf = leaves[i];
                const Int3 at{{leaf.origin[0], leaf.origin[1], leaf.origin[2]}};
                mark(mask, slot(at, 3, 4));
                put(leafBytes, leaf.mask);
                const openvdb::Coord origin(leaf.origin[0], leaf.origin[1], leaf.origin[2]);
                for (uint32_t v = 0; v < 512; ++v) {
                    if ((leaf.mask[v >> 6] >> (v & 63) & 1) != 0) {
                        tree.box.expand(origin.offsetBy(static_cast<int>(v >> 6),
                                                        static_cast<int>(v >> 3 & 7),
                                                        static_cast<int>(v & 7)));
                        ++tree.activeVoxels;
                    }
                }
            }
            const auto lower = nodeOf(leaves[begin], 7);
            mark(lowers, slot({{lower[0], lower[1], lower[2]}}, 7, 5));
            putNode(mask, leafBytes, lowerBytes);
            tree.openvdbBytes += sizeof(typename Upper::ChildNodeType);
        });
        putNode(lowers, lowerBytes, below);
        tree.openvdbBytes += sizeof(Upper);
    });
    tree.openvdbBytes += leaves.size() * (512 * sizeof(Value) + 96);
    put(tree.topology, int32_t{1});  // buffers
    put(tree.topology, Value{});     // background
    put(tree.topology, uint32_t{0});
    put(tree.topology, roots);
    tree.topology += below;
    return tree;
}

template EncodedTree encodeLeaves<float>(const std::vector<LeafPlace>&);
template EncodedTree encodeLeaves<openvdb::Vec3f>(const std::vector<LeafPlace>&);
template void encodeLeaf(const LeafPlace&, const float*, std::string&);
template void encodeLeaf(const LeafPlace&, const openvdb::Vec3f*, std::string&);

template EncodedTree encodeTree(const TreeLayout&, const std::vector<float>&);
template EncodedTree encodeTree(const TreeLayout&, const std::vector<double>&);
template EncodedTree encodeTree(const TreeLayout&, const std::vector<openvdb::Vec3f>&);
template EncodedTree encodeTree(const TreeLayout&, const std::vector<openvdb::Vec3d>&);

}  // namespace trk
