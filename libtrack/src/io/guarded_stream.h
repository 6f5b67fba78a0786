// SPDX-License-Identifier: Apache-2.0
// A file buffer for OpenVDB's reader that refuses the one kind of damage the reader takes to the
// heap.
#pragma once

#include <bitset>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <fstream>
#include <stdexcept>
#include <string>

namespace trk {

/// OpenVDB stores a chunk of values that did not compress as its negated size and its bytes, and
/// (version 10 at least) reads that many bytes into the destination before comparing the size with
/// what the destination holds: a damaged size overwrites the heap. This buffer follows the reads
/// that precede a chunk (the node's value mask, one byte on how inactive values are stored, the
/// size) and lets the chunk pass only if it has the size that mask and byte announce.
class GuardedFileBuf : public std::filebuf {
  public:
    /// Before each grid. `valueSize`: bytes of a value in the file, 0 where that is not known, and
    /// nothing is guarded. `maskCompressed`: whether inactive values are left out. `blosc`: whether
    /// chunks are compressed by Blosc.
    void beginGrid(size_t valueSize, bool maskCompressed, bool blosc) {
        valueSize_ = valueSize;
        maskCompressed_ = maskCompressed;
        blosc_ = blosc;
        expected_ = rawSize_ = bloscSize_ = kNothing;
    }

  protected:
    std::streamsize xsgetn(char* out, std::streamsize size) override {
        if (expected_ != kNothing && rawSize_ != kNothing && size == rawSize_) {
            const std::streamsize expected = expected_;
            expected_ = kNothing;
            if (size != expected) {
                throw std::runtime_error("a chunk of " + std::to_string(size) +
                                         " bytes, expected " + std::to_string(expected));
            }
        }
        const bool blosc = blosc_ && expected_ != kNothing && size == bloscSize_;
        const std::streamsize got = std::filebuf::xsgetn(out, size);
        if (blosc && got == size) {
            checkBloscHeader(out, size);
        }
        if (got == size) {
            follow(out, size);
        }
        return got;
    }

  private:
    static constexpr std::streamsize kNothing = -1;
    static constexpr char kAllValues = 6;  // OpenVDB's NO_MASK_AND_ALL_VALS

    /// A Blosc chunk begins with its sizes, which its decoder believes.
    void checkBloscHeader(const char* bytes, std::streamsize size) {
        uint32_t sizes[3] = {0, 0, 0};  // uncompressed, of a block, compressed
        if (size >= 16) {
            std::memcpy(sizes, bytes + 4, sizeof(sizes));
        }
        const std::streamsize expected = expected_;
        expected_ = kNothing;
        const bool blocks = expected == 0 || (sizes[1] > 0 && sizes[1] <= sizes[0]);
        if (sizes[0] != expected || sizes[2] != size || !blocks) {
            throw std::runtime_error("a Blosc chunk that does not hold the " +
                                     std::to_string(expected) + " bytes announced");
        }
    }

    void follow(const char* bytes, std::streamsize size) {
        rawSize_ = bloscSize_ = kNothing;
        if (size == 64 || size == 512 || size == 4096) {  // the masks of the three kinds of nodes
            active_ = 0;
            for (std::streamsize i = 0; i < size; ++i) {
                active_ += std::bitset<8>(static_cast<unsigned char>(bytes[i])).count();
            }
            all_ = 8 * static_cast<size_t>(size);
            afterMask_ = true;
            return;
        }
        if (size == 1 && afterMask_ && valueSize_ > 0) {
            const bool everything = !maskCompressed_ || bytes[0] == kAllValues;
            expected_ = static_cast<std::streamsize>((everything ? all_ : active_) * valueSize_);
        } else if (size == 8) {
            int64_t chunkSize;
            std::memcpy(&chunkSize, bytes, sizeof(chunkSize));
            rawSize_ = chunkSize < 0 ? -chunkSize : kNothing;
            bloscSize_ = chunkSize > 0 ? chunkSize : kNothing;
        }
        afterMask_ = false;
    }

    size_t valueSize_ = 0;
    bool maskCompressed_ = false;
    bool blosc_ = false;
    bool afterMask_ = false;
    size_t active_ = 0;  // values of the last mask, and all that it has room for
    size_t all_ = 0;
    std::streamsize expected_ = kNothing;   // bytes of the chunk to come, if it is not compressed
    std::streamsize rawSize_ = kNothing;    // bytes the last read says it has, not compressed
    std::streamsize bloscSize_ = kNothing;  // or compressed
};

}  // namespace trk
