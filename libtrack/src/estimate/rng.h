// SPDX-License-Identifier: Apache-2.0
// Random numbers that depend on nothing but who asks: (seed, stream, ray id, sample, purpose).
#pragma once

#include <cmath>
#include <cstdint>

namespace trk {

/// What random numbers are for. A free path and the transmittance of the same ray are independent.
enum class Purpose : uint64_t { kTransmittance, kFreePath };

/// SplitMix64 [Steele, Lea, Flood 2014] started at a hash of its owner: one addition and one mixing
/// a number, no state shared between rays, threads or calls.
class Rng {
  public:
    Rng(uint64_t seed, uint64_t stream, uint64_t rayId, uint64_t sample,
        Purpose purpose = Purpose::kTransmittance)
        : state_(mix(mix(mix(mix(seed) + stream) + rayId) + sample) ^
                 static_cast<uint64_t>(purpose) * 0x2545f4914f6cdd1du) {}

    uint64_t next() {
        state_ += 0x9e3779b97f4a7c15u;
        return mix(state_);
    }

    /// Uniformly distributed in [0, 1).
    double uniform() { return static_cast<double>(next() >> 11) * 0x1p-53; }

    /// Exponentially distributed with mean 1. P(X < x) is right to a part in 30,000 for every x
    /// down to 2^-63, below which only the least value lies, 2^-65; so is P(X > x) up to 44.
    double exponential() { return exponentialOf(next()); }

    /// -log(1 - v) for v = (bits + 1/2) 2^-64, which grows with `bits`. In float, except where v or
    /// 1 - v is below 2^-10: next to 1 a float knows no differences below 2^-25, and thin haze
    /// would scatter where the ray enters it.
    static double exponentialOf(uint64_t bits) {
        constexpr uint64_t kRare = uint64_t{1} << 54;
        if (bits + kRare < 2 * kRare) {
            return rareExponentialOf(bits);
        }
        const auto u = (static_cast<float>(static_cast<uint32_t>(~bits >> 32)) + 0.5f) * 0x1p-32f;
        return static_cast<double>(-std::log(u));
    }

  private:
    static double rareExponentialOf(uint64_t bits) {
        const bool large = bits >> 63 != 0;
        const double v = (static_cast<double>(large ? ~bits : bits) + 0.5) * 0x1p-64;
        return large ? -std::log(v) : -std::log1p(-v);
    }

    static uint64_t mix(uint64_t z) {
        z += 0x9e3779b97f4a7c15u;
        z = (z ^ (z >> 30)) * 0xbf58476d1ce4e5b9u;
        z = (z ^ (z >> 27)) * 0x94d049bb133111ebu;
        return z ^ (z >> 31);
    }

    uint64_t state_;
};

}  // namespace trk
