// SPDX-License-Identifier: Apache-2.0
// The values of a node of a .vdb file as they are stored: which of the inactive ones, masks, and
// one chunk that may be compressed. Everything is checked against what the node must hold before a
// byte of it is decoded.
#pragma once

#include "file_reader.h"

#include <zlib.h>

#include <cstddef>
#include <cstdint>
#include <memory>
#include <vector>

namespace trk {

/// OpenVDB's COMPRESS_… bits.
enum : uint32_t { kVdbZip = 1, kVdbActiveMask = 2, kVdbBlosc = 4, kVdbKnownCompression = 7 };

/// How the values of one grid are stored.
struct ValueFormat {
    uint32_t compression = 0;
    bool half = false;      ///< halfs in the chunks
    size_t valueBytes = 4;  ///< of a value, all channels
    size_t channels = 1;    ///< of a value
};

/// A node's values as they lie in the file: `bytes` of an owner's buffer, from `at` on.
struct PackedValues {
    size_t at = 0;           ///< of inactive values, then the selection mask, then the chunk
    size_t count = 0;        ///< values in the chunk
    int64_t chunkBytes = 0;  ///< compressed bytes, or minus the raw ones
    uint8_t kind = 0;        ///< OpenVDB's per-node flag, 0 to 6
};

/// Takes a node's values from the file to the end of `bytes`. `slots`: values of the node, of which
/// `active` are. Throws BAD_FILE.
PackedValues takeValues(FileReader& file, const ValueFormat& format, size_t slots, size_t active,
                        std::vector<char>& bytes);

/// Decodes chunks. One for each thread.
class ChunkDecoder {
  public:
    ChunkDecoder() = default;
    ~ChunkDecoder();
    ChunkDecoder(const ChunkDecoder&) = delete;
    ChunkDecoder& operator=(const ChunkDecoder&) = delete;

    /// Writes all `slots` values of a node to `out`, as OpenVDB would. `Value` is of
    /// format.valueBytes bytes. Throws BAD_FILE; `place` begins the message.
    template <class Value>
    void decode(const PackedValues& packed, const std::vector<char>& bytes,
                const ValueFormat& format, const uint64_t* mask, size_t slots,
                const Value& background, Value* out, const std::string& place);

  private:
    void unpackChunk(const char* chunk, int64_t chunkBytes, uint32_t compression, char* to,
                     size_t size, const std::string& place);

    std::unique_ptr<z_stream> zip_;
    std::vector<char> halfs_;
    std::vector<char> values_;
};

}  // namespace trk
