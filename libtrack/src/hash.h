// SPDX-License-Identifier: Apache-2.0
// A fast hash of blocks of memory, for digests and for finding equal blocks.
#pragma once

#include <cstddef>
#include <cstdint>
#include <cstring>

namespace trk {

/// 64-bit hash of a block of words: four lanes of multiply and rotate (the construction of
/// xxHash64), so that it keeps up with memory.
inline uint64_t hashWords(const void* data, size_t wordCount, uint64_t seed) {
    constexpr uint64_t kP1 = 0x9e3779b185ebca87u;
    constexpr uint64_t kP2 = 0xc2b2ae3d27d4eb4fu;
    const auto rotate = [](uint64_t x, int n) { return x << n | x >> (64 - n); };
    uint64_t lane[4] = {seed + kP1 + kP2, seed + kP2, seed, seed - kP1};
    const auto* bytes = static_cast<const unsigned char*>(data);
    for (size_t i = 0; i < wordCount; ++i) {
        uint64_t word;
        std::memcpy(&word, bytes + 8 * i, 8);
        lane[i & 3] = rotate(lane[i & 3] + word * kP2, 31) * kP1;
    }
    uint64_t h = seed ^ wordCount;
    for (const uint64_t l : lane) {
        h = (h ^ (rotate(l * kP2, 31) * kP1)) * kP1 + kP2;
    }
    h ^= h >> 33;
    h *= kP2;
    h ^= h >> 29;
    return h;
}

}  // namespace trk
