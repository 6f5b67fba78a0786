// SPDX-License-Identifier: Apache-2.0
// The bricks of a field for those who look at all of them, in an order of their own: all at hand,
// or of a field too large for memory read from its source again, a page at a time.
#pragma once

#include "density_field.h"
#include "parallel.h"
#include "raw_array.h"

#include <array>
#include <cstddef>
#include <cstdint>
#include <vector>

namespace trk {

/// Reads the bricks of a field, which holds none itself, from its source. The bricks of a page lie
/// in slots, as do leaves that they have a part of.
class BrickLoader {
  public:
    using Entry = SparseTable::Entry;

    virtual ~BrickLoader() = default;

    /// Memory beside the field and its page.
    virtual size_t bytes() const = 0;
    /// Every brick, once.
    virtual std::vector<Entry> bricks() const = 0;

    /// A new page, without any bricks.
    virtual void begin() = 0;
    /// Adds a brick to the page, unless it is there.
    virtual void want(Entry brick) = 0;
    /// What the page has so far.
    virtual size_t slots() const = 0;
    virtual size_t slotOf(Entry brick) const = 0;
    /// Reads the page, slot after slot as DensityField has its bricks. Throws Error.
    virtual void load(RawArray<float>& page) = 0;
};

class BrickPages {
  public:
    using Entry = SparseTable::Entry;

    /// Of a field that holds its bricks.
    BrickPages(const DensityField& field) : field_(field) {}
    /// Of one that does not; `pageBytes`: what a page may take;
    /// what one thing to be done needs, it gets.
    BrickPages(const DensityField& field, BrickLoader& loader, uint64_t pageBytes)
        : field_(field), loader_(&loader), mostSlots_(pageBytes / brickBytes()) {}

    const DensityField& field() const { return field_; }
    bool resident() const { return !loader_; }
    /// Memory of all there is, and of a page.
    uint64_t bytes() const {
        return field_.bytes() + (loader_ ? loader_->bytes() + mostSlots_ * brickBytes() : 0);
    }
    std::vector<Entry> bricks() const {
        if (loader_) {
            return loader_->bricks();
        }
        std::vector<Entry> all(field_.brickCount());
        for (size_t i = 0; i < all.size(); ++i) {
            all[i] = static_cast<Entry>(i + 1);
        }
        return all;
    }

    /// Calls body(i) for every i in [0, count), in parallel, while the bricks are at hand that
    /// `bricksOf(i, f)` calls f(entry) for, which may be constants too.
    template <class BricksOf, class Body>
    void forEach(size_t count, size_t grain, const BricksOf& bricksOf, const Body& body) {
        if (!loader_) {
            parallelFor(count, grain, body);
            return;
        }
        for (size_t begin = 0; begin < count;) {
            loader_->begin();
            size_t end = begin;
            do {
                bricksOf(end++, [&](Entry entry) {
                    if (!DensityField::isConstant(entry)) {
                        loader_->want(entry);
                    }
                });
            } while (end < count && loader_->slots() < mostSlots_);
            const auto share = [&](size_t i) {
                return static_cast<double>(i) / static_cast<double>(count);
            };
            const Progress::Stage stage(share(begin), share(end));
            loader_->load(page_);
            parallelFor(end - begin, grain, [&](size_t i) { body(begin + i); });
            begin = end;
        }
    }

    /// One channel of a brick that is at hand, as DensityField has it.
    const float* brickChannel(Entry brick, size_t channel,
                              float (&buffer)[DensityField::kBrickVertices]) const {
        if (!loader_) {
            return field_.brickChannel(brick, channel, buffer);
        }
        const float* from = pageBrick(brick);
        if (field_.channels() == 1) {
            return from;
        }
        for (size_t i = 0; i < DensityField::kBrickVertices; ++i) {
            buffer[i] = from[i * field_.channels() + channel];
        }
        return buffer;
    }

    /// The integral of the density over [t0, t1] of a ray, which lies in the region at `lo` that an
    /// entry stands for.
    template <size_t C>
    std::array<double, C> integrate(Entry entry, const Int3& lo, const LocalRay& ray, double t0,
                                    double t1) const {
        uint64_t cells = 0;
        return loader_ && !DensityField::isConstant(entry)
                   ? DensityField::integrateBrick<C>(pageBrick(entry), lo, ray, t0, t1, cells)
                   : field_.integrateRegion<C>(entry, lo, ray, t0, t1, cells);
    }

  private:
    size_t brickBytes() const {
        return DensityField::kBrickVertices * field_.channels() * sizeof(float);
    }
    const float* pageBrick(Entry brick) const {
        return page_.data() +
               loader_->slotOf(brick) * DensityField::kBrickVertices * field_.channels();
    }

    const DensityField& field_;
    BrickLoader* loader_ = nullptr;
    size_t mostSlots_ = 0;
    RawArray<float> page_;
};

}  // namespace trk
