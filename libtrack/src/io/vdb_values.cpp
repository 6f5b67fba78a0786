// SPDX-License-Identifier: Apache-2.0
#include "vdb_values.h"

#include "density_types.h"
#include "failure.h"

#include <blosc.h>

#include <algorithm>
#include <cstring>
#include <string>

namespace trk {
namespace {

// OpenVDB's per-node flag: what is said of inactive values.
enum : uint8_t {
    kOnlyBackground = 0,
    kMinusBackground = 1,
    kOneInactive = 2,
    kMaskOfSigns = 3,
    kMaskAndOneInactive = 4,
    kMaskAndTwoInactive = 5,
    kAllValues = 6
};

size_t inactiveCount(uint8_t kind) {
    return kind == kMaskAndTwoInactive ? 2 : kind == kOneInactive || kind == kMaskAndOneInactive;
}
bool hasSelection(uint8_t kind) {
    return kind >= kMaskOfSigns && kind <= kMaskAndTwoInactive;
}

[[noreturn]] void badChunk(const std::string& place, const std::string& what) {
    throw Error(TRK_ERROR_BAD_FILE, place + ": damaged: " + what);
}

/// A Blosc chunk begins with its sizes, which its decoder believes.
bool isBloscChunk(const char* chunk, uint64_t chunkBytes, uint64_t size) {
    uint32_t sizes[3];  // uncompressed, of a block, compressed
    if (chunkBytes < BLOSC_MIN_HEADER_LENGTH) {
        return false;
    }
    std::memcpy(sizes, chunk + 4, sizeof(sizes));
    return sizes[0] == size && sizes[2] == chunkBytes &&
           (size == 0 || (sizes[1] > 0 && sizes[1] <= size));
}

}  // namespace

PackedValues takeValues(FileReader& file, const ValueFormat& format, size_t slots, size_t active,
                        std::vector<char>& bytes) {
    PackedValues packed;
    packed.at = bytes.size();
    packed.kind = file.value<uint8_t>();
    if (packed.kind > kAllValues) {
        file.refuse("a node whose values are stored in way " + std::to_string(packed.kind) +
                    "; expected 0 to 6");
    }
    const bool onlyActive = (format.compression & kVdbActiveMask) != 0 && packed.kind != kAllValues;
    packed.count = onlyActive ? active : slots;
    const size_t head = inactiveCount(packed.kind) * format.valueBytes +
                        (hasSelection(packed.kind) ? slots / 8 : 0);
    const size_t size = packed.count * (format.half ? 2 * format.channels : format.valueBytes);
    size_t stored = size;
    const auto take = [&](size_t count) {
        const size_t at = bytes.size();
        bytes.resize(at + count);
        file.read(bytes.data() + at, count);
    };
    take(head);
    if (format.half && packed.count == 0) {  // no halfs, no chunk; no floats, an empty one
        return packed;
    }
    if (format.compression & (kVdbZip | kVdbBlosc)) {
        packed.chunkBytes = file.value<int64_t>();
        const int64_t most = static_cast<int64_t>(size + size / 8 + 1024);
        if (packed.chunkBytes > most ||
            (packed.chunkBytes <= 0 && packed.chunkBytes != -static_cast<int64_t>(size))) {
            file.refuse("a chunk of " + std::to_string(packed.chunkBytes) +
                        " bytes for values of " + std::to_string(size));
        }
        stored = packed.chunkBytes > 0 ? static_cast<size_t>(packed.chunkBytes) : size;
    } else {
        packed.chunkBytes = -static_cast<int64_t>(size);
    }
    file.expect(stored, "values");
    take(stored);
    if (packed.chunkBytes > 0 && (format.compression & kVdbBlosc) != 0 &&
        !isBloscChunk(&bytes[bytes.size() - stored], stored, size)) {
        file.refuse("a Blosc chunk of " + std::to_string(stored) +
                    " bytes that does not hold the expected " + std::to_string(size));
    }
    return packed;
}

ChunkDecoder::~ChunkDecoder() {
    if (zip_) {
        inflateEnd(zip_.get());
    }
}

void ChunkDecoder::unpackChunk(const char* chunk, int64_t chunkBytes, uint32_t compression,
                               char* to, size_t size, const std::string& place) {
    if (chunkBytes <= 0) {
        std::copy_n(chunk, size, to);
        return;
    }
    if (compression & kVdbBlosc) {
        const int got = size == 0 ? 0 : blosc_decompress_ctx(chunk, to, size, 1);
        if (got < 0 || static_cast<size_t>(got) != size) {
            badChunk(place, "a Blosc chunk that cannot be decoded");
        }
        return;
    }
    if (!zip_) {
        auto zip = std::make_unique<z_stream>();
        if (inflateInit(zip.get()) != Z_OK) {
            throw std::bad_alloc();
        }
        zip_ = std::move(zip);
    }
    inflateReset(zip_.get());
    unsigned char spare = 0;  // an empty chunk is decoded too, for its checksum
    zip_->next_in = reinterpret_cast<Bytef*>(const_cast<char*>(chunk));
    zip_->avail_in = static_cast<uInt>(chunkBytes);
    zip_->next_out = size == 0 ? &spare : reinterpret_cast<Bytef*>(to);
    zip_->avail_out = static_cast<uInt>(size);
    const int status = inflate(zip_.get(), Z_FINISH);
    if (status != Z_STREAM_END || zip_->avail_out != 0 || zip_->avail_in != 0) {
        badChunk(place, std::string("a zip chunk ") +
                            (zip_->msg ? zip_->msg : "that does not hold what it should"));
    }
}

template <class Value>
void ChunkDecoder::decode(const PackedValues& packed, const std::vector<char>& bytes,
                          const ValueFormat& format, const uint64_t* mask, size_t slots,
                          const Value& background, Value* out, const std::string& place) {
    static_assert(std::is_trivially_copyable_v<Value>);
    const char* from = bytes.data() + packed.at;
    Value inactive[2] = {packed.kind == kOnlyBackground ? background : -background, background};
    for (size_t i = 0; i < inactiveCount(packed.kind); ++i, from += sizeof(Value)) {
        std::memcpy(static_cast<void*>(&inactive[i]), from, sizeof(Value));
    }
    const char* selection = nullptr;
    if (hasSelection(packed.kind)) {
        selection = from;
        from += slots / 8;
    }
    const bool all = packed.count == slots;
    Value* to = out;
    if (!all) {
        values_.resize(packed.count * sizeof(Value));
        to = reinterpret_cast<Value*>(values_.data());
    }
    if (!format.half) {
        unpackChunk(from, packed.chunkBytes, format.compression, reinterpret_cast<char*>(to),
                    packed.count * sizeof(Value), place);
    } else if (packed.count > 0) {
        using Component = typename ValueTraits<Value>::Component;
        const size_t count = packed.count * ValueTraits<Value>::kChannels;
        halfs_.resize(2 * count);
        unpackChunk(from, packed.chunkBytes, format.compression, halfs_.data(), 2 * count, place);
        const auto* halfs = reinterpret_cast<const openvdb::math::half*>(halfs_.data());
        auto* components = reinterpret_cast<Component*>(to);
        for (size_t i = 0; i < count; ++i) {
            components[i] = static_cast<Component>(static_cast<float>(halfs[i]));
        }
    }
    if (all) {
        return;
    }
    for (size_t w = 0; w < slots / 64; ++w, out += 64) {
        uint64_t second = 0;  // which of the two inactive values
        if (selection) {
            std::memcpy(&second, selection + 8 * w, sizeof(second));
        }
        if (mask[w] == ~uint64_t{0}) {
            std::copy_n(to, 64, out);
            to += 64;
            continue;
        }
        for (size_t i = 0; i < 64; ++i) {
            out[i] = mask[w] >> i & 1 ? *to++ : inactive[second >> i & 1];
        }
    }
}

template void ChunkDecoder::decode(const PackedValues&, const std::vector<char>&,
                                   const ValueFormat&, const uint64_t*, size_t, const float&,
                                   float*, const std::string&);
template void ChunkDecoder::decode(const PackedValues&, const std::vector<char>&,
                                   const ValueFormat&, const uint64_t*, size_t, const double&,
                                   double*, const std::string&);
template void ChunkDecoder::decode(const PackedValues&, const std::vector<char>&,
                                   const ValueFormat&, const uint64_t*, size_t,
                                   const openvdb::Vec3f&, openvdb::Vec3f*, const std::string&);
template void ChunkDecoder::decode(const PackedValues&, const std::vector<char>&,
                                   const ValueFormat&, const uint64_t*, size_t,
                                   const openvdb::Vec3d&, openvdb::Vec3d*, const std::string&);

}  // namespace trk
