// SPDX-License-Identifier: Apache-2.0
#include "sparse_table.h"

#include <algorithm>
#include <cmath>
#include <utility>

namespace trk {
namespace {

IntBox moved(IntBox box, const Int3& by) {
    for (size_t a = 0; a < 3 && !box.empty(); ++a) {
        box.lo[a] += by[a];
        box.hi[a] += by[a];
    }
    return box;
}

}  // namespace

bool SparseTable::appendKey(const Int3& origin, int shift, Key& key) const {
    if (root_.empty()) {
        key.push_back(kEmpty);
        return true;
    }
    int part = itemShift_;
    while (part + 3 <= std::min(shift, rootShift_)) {
        part += 3;
    }
    const int64_t count = int64_t{1} << std::max(shift - part, 0);
    if (count > 8) {
        return false;
    }
    for (int64_t i = 0; i < count * count * count; ++i) {
        const Int3 at{{origin[0] + ((i / (count * count)) << part),
                       origin[1] + ((i / count % count) << part),
                       origin[2] + ((i % count) << part)}};
        const Found found = find(at[0], at[1], at[2], part);
        key.push_back(found.entry);
        if (shift < itemShift_) {  // a part of an item: which one matters
            const int64_t mask = (int64_t{1} << itemShift_) - 1;
            key.push_back(
                static_cast<Entry>((at[0] & mask) << 16 | (at[1] & mask) << 8 | (at[2] & mask)));
        }
    }
    return true;
}

SparseTable SparseTable::flattened() && {
    constexpr uint64_t kMostItems = 1 << 17;
    constexpr uint64_t kMostPerOccupied = 64;
    const int levels = depth();
    const auto items = static_cast<double>(root_.size()) * std::ldexp(1.0, 9 * levels);
    if (levels == 0 || items > static_cast<double>(kMostItems) ||
        items > static_cast<double>(kMostPerOccupied * occupiedItems())) {
        return std::move(*this);
    }
    SparseTable flat;
    flat.itemShift_ = flat.rootShift_ = itemShift_;
    for (size_t a = 0; a < 3; ++a) {
        flat.rootLo_[a] = rootLo_[a] << 3 * levels;
        flat.rootSize_[a] = rootSize_[a] << 3 * levels;
    }
    flat.root_.reserve(static_cast<size_t>(items));
    flat.forEachRootRegion([&](size_t, const Int3& origin) {
        flat.root_.push_back(find(origin[0], origin[1], origin[2]).entry);
    });
    return flat;
}

IntBox SparseTable::occupiedBox() const {
    std::unordered_map<Entry, Extent> known;
    IntBox box;
    forEachRootRegion([&](size_t i, const Int3& origin) {
        box.add(moved(extentOf(root_[i], rootShift_, known).box, origin));
    });
    return box;
}

uint64_t SparseTable::occupiedItems() const {
    std::unordered_map<Entry, Extent> known;
    uint64_t count = 0;
    for (const Entry entry : root_) {
        count += extentOf(entry, rootShift_, known).items;
    }
    return count;
}

std::optional<SparseTable::Entry> SparseTable::uniformEntry(const Int3& origin, int shift) const {
    if (root_.empty()) {
        return kEmpty;
    }
    const int64_t size = int64_t{1} << shift;
    const IntBox region{origin, {{origin[0] + size, origin[1] + size, origin[2] + size}}};
    if (shift <= rootShift_) {
        const Found found = find(origin[0], origin[1], origin[2], shift, kWhole);
        return uniformIn(found.entry, found.shift, region);
    }
    bool outside = false;
    for (size_t a = 0; a < 3; ++a) {
        outside = outside || region.lo[a] < rootLo_[a] << rootShift_ ||
                  region.hi[a] > (rootLo_[a] + rootSize_[a]) << rootShift_;
    }
    std::optional<Entry> all = outside ? std::optional<Entry>(kEmpty) : std::nullopt;
    bool same = true;
    forEachRootRegion(region, [&](size_t i, const Int3&) {
        same = same && (root_[i] & kNodeFlag) == 0 && (!all || *all == root_[i]);
        all = root_[i];
    });
    return same ? all : std::nullopt;
}

void SparseTable::markOccupied(const Int3& origin, int shift, Parts& parts) const {
    const int64_t size = int64_t{1} << shift;
    const IntBox region{origin, {{origin[0] + size, origin[1] + size, origin[2] + size}}};
    forEachRootRegion(region, [&](size_t i, const Int3& lo) {
        markEntry(root_[i], lo, rootShift_, region, shift - 3, parts);
    });
}

SparseTable::Extent SparseTable::extentOf(Entry entry, int shift,
                                          std::unordered_map<Entry, Extent>& known) const {
    Extent extent;
    if (entry == kEmpty) {
        return extent;
    }
    if ((entry & kNodeFlag) == 0) {
        const int64_t size = int64_t{1} << shift;
        extent.box.add({{0, 0, 0}}, {{size, size, size}});
        extent.items = uint64_t{1} << 3 * (shift - itemShift_);
        return extent;
    }
    if (const auto it = known.find(entry); it != known.end()) {
        return it->second;
    }
    const auto add = [&](size_t c, Entry e) {
        const Extent part = extentOf(e, shift - 3, known);
        extent.box.add(moved(part.box, childOrigin({{0, 0, 0}}, shift - 3, c)));
        extent.items += part.items;
    };
    if (entry & kLinkFlag) {
        const Link& link = links_[entry & kIndexMask];
        add(link.child, link.entry);
    } else {
        for (size_t c = 0; c < 512; ++c) {
            add(c, nodes_[entry & kIndexMask][c]);
        }
    }
    known.emplace(entry, extent);
    return extent;
}

void SparseTable::markEntry(Entry entry, const Int3& lo, int shift, const IntBox& region,
                            int partShift, Parts& parts) const {
    if (entry == kEmpty) {
        return;
    }
    if (shift <= partShift) {
        parts.set(childIndex((lo[0] - region.lo[0]) >> partShift,
                             (lo[1] - region.lo[1]) >> partShift,
                             (lo[2] - region.lo[2]) >> partShift));
        return;
    }
    if ((entry & kNodeFlag) == 0) {  // a tile: what it shares with the region
        IntBox box = region;
        for (size_t a = 0; a < 3; ++a) {
            box.lo[a] = std::max(box.lo[a], lo[a]);
            box.hi[a] = std::min(box.hi[a], lo[a] + (int64_t{1} << shift));
        }
        forEachChild(box, region.lo, partShift + 3, [&](size_t c, const Int3&) { parts.set(c); });
        return;
    }
    if (entry & kLinkFlag) {
        const Link& link = links_[entry & kIndexMask];
        const Int3 at = childOrigin(lo, shift - 3, link.child);
        bool meets = true;
        for (size_t a = 0; a < 3; ++a) {
            meets =
                meets && at[a] < region.hi[a] && at[a] + (int64_t{1} << (shift - 3)) > region.lo[a];
        }
        if (meets) {
            markEntry(link.entry, at, shift - 3, region, partShift, parts);
        }
        return;
    }
    const Node& node = nodes_[entry & kIndexMask];
    forEachChild(region, lo, shift, [&](size_t c, const Int3& at) {
        if (node[c] != kEmpty) {
            markEntry(node[c], at, shift - 3, region, partShift, parts);
        }
    });
}

std::optional<SparseTable::Entry> SparseTable::uniformIn(Entry entry, int shift,
                                                         const IntBox& region) const {
    if ((entry & kNodeFlag) == 0) {
        return entry;
    }
    std::optional<Entry> all;
    bool same = true;
    const Int3 lo{{region.lo[0] >> shift << shift, region.lo[1] >> shift << shift,
                   region.lo[2] >> shift << shift}};
    forEachChild(region, lo, shift, [&](size_t c, const Int3&) {
        const Entry e = child(entry, c);
        same = same && (e & kNodeFlag) == 0 && (!all || *all == e);
        all = e;
    });
    return same ? all : std::nullopt;
}

}  // namespace trk
