// SPDX-License-Identifier: Apache-2.0
// A file buffer for OpenVDB's reader that refuses the one kind of damage the reader takes to the
// heap.
#pragma once

#include <bitset>
#include <cstddef>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <fstream>
#include <limits>
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
    enum class Codec { kUnguarded, kZip, kBlosc };

    /// The values of a chunk.
    struct Values {
        size_t size = 0;               ///< bytes of one in the file
        bool half = false;             ///< made of halfs
        bool mayBeEightBytes = false;  ///< an inactive one is stored in as many as a size is
    };

    /// Before each grid. `codec`: of its chunks; kUnguarded where they have no size before them, or
    /// are of other values than a density's. `maskCompressed`: whether inactive values are left
    /// out.
    void beginGrid(Codec codec, const Values& values, bool maskCompressed) {
        codec_ = codec;
        values_ = values;
        maskCompressed_ = maskCompressed;
        afterMask_ = false;
        expected_ = chunkSize_ = kNothing;
    }

    /// Has whoever reads the file's version find `version`, if the file's is another.
    void showVersion(uint32_t version) { shownVersion_ = version; }

  protected:
    std::streamsize xsgetn(char* out, std::streamsize size) override {
        if (shownVersion_ != 0 && size == sizeof(shownVersion_) &&
            seekoff(0, std::ios::cur, std::ios::in) == kVersionPlace) {
            const std::streamsize got = std::filebuf::xsgetn(out, size);
            std::memcpy(out, &shownVersion_, static_cast<size_t>(got));
            shownVersion_ = 0;
            return got;
        }
        if (codec_ == Codec::kUnguarded) {
            return std::filebuf::xsgetn(out, size);
        }
        const bool isChunk = chunkSize_ != kNothing && size == std::abs(chunkSize_);
        if (isChunk && chunkSize_ < 0 && size != expected_) {
            refuse(size);
        }
        const std::streamsize got = std::filebuf::xsgetn(out, size);
        if (got == size) {
            if (!isChunk) {
                follow(out, size);
            } else {
                if (chunkSize_ > 0 && codec_ == Codec::kBlosc) {
                    checkBloscHeader(out, size);
                }
                expected_ = chunkSize_ = kNothing;
            }
        }
        return got;
    }

  private:
    static constexpr std::streamoff kVersionPlace = 8;  // behind the magic number
    static constexpr std::streamsize kNothing = std::numeric_limits<std::streamsize>::min();
    static constexpr char kAllValues = 6;  // OpenVDB's NO_MASK_AND_ALL_VALS

    [[noreturn]] void refuse(std::streamsize size) const {
        throw std::runtime_error("a chunk of " + std::to_string(size) + " bytes for values of " +
                                 std::to_string(expected_));
    }

    /// A Blosc chunk begins with its sizes, which its decoder believes.
    void checkBloscHeader(const char* bytes, std::streamsize size) const {
        uint32_t sizes[3] = {0, 0, 0};  // uncompressed, of a block, compressed
        if (size >= 16) {
            std::memcpy(sizes, bytes + 4, sizeof(sizes));
        }
        const bool blocks = expected_ == 0 || (sizes[1] > 0 && sizes[1] <= sizes[0]);
        if (sizes[0] != expected_ || sizes[2] != size || !blocks) {
            refuse(size);
        }
    }

    void follow(const char* bytes, std::streamsize size) {
        const bool isMask =
            size == 64 || size == 512 || size == 4096;  // of the three kinds of nodes
        if (isMask && expected_ == kNothing) {
            active_ = 0;
            for (std::streamsize i = 0; i < size; ++i) {
                active_ += std::bitset<8>(static_cast<unsigned char>(bytes[i])).count();
            }
            all_ = 8 * static_cast<size_t>(size);
            afterMask_ = true;
            return;
        }
        if (size == 1 && afterMask_) {
            const bool everything = !maskCompressed_ || bytes[0] == kAllValues;
            expected_ = static_cast<std::streamsize>((everything ? all_ : active_) * values_.size);
            if (expected_ == 0 && values_.half) {  // no halfs, no chunk; no floats, an empty one
                expected_ = kNothing;
            }
        } else if (size == 8 && expected_ != kNothing) {
            int64_t chunkSize;
            std::memcpy(&chunkSize, bytes, sizeof(chunkSize));
            // (Before a chunk of doubles, eight bytes may also be an inactive value.)
            if (!values_.mayBeEightBytes && chunkSize > expected_ + expected_ / 8 + 1024) {
                refuse(chunkSize);
            }
            chunkSize_ = chunkSize;
            if (chunkSize == 0) {
                expected_ = chunkSize_ = kNothing;
            }
        }
        afterMask_ = false;
    }

    uint32_t shownVersion_ = 0;
    Codec codec_ = Codec::kUnguarded;
    Values values_;
    bool maskCompressed_ = false;
    bool afterMask_ = false;
    size_t active_ = 0;  // values of the last mask, and all that it has room for
    size_t all_ = 0;
    std::streamsize expected_ = kNothing;   // bytes that the chunk to come must turn into
    std::streamsize chunkSize_ = kNothing;  // its bytes in the file; negative if not compressed
};

}  // namespace trk
