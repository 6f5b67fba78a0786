// SPDX-License-Identifier: Apache-2.0
// A product of many weights that neither overflows nor underflows.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <limits>

namespace trk {

/// Holds value x 2^exponent. The weights' product and the control's optical depth can both be
/// extreme while what they make together is not, so the exponents meet before anything is rounded.
class ScaledProduct {
  public:
    static ScaledProduct zero() {
        ScaledProduct product;
        product.value_ = 0;
        return product;
    }

    void multiply(double weight) {
        value_ *= weight;
        const double magnitude = std::fabs(value_);
        if (magnitude > 0x1p500 || magnitude < 0x1p-500) {
            int exponent = 0;
            value_ = std::frexp(value_, &exponent);  // 0 stays 0
            exponent_ += exponent;
        }
    }

    bool isZero() const { return value_ == 0; }

    /// A number that the logarithm of |product| does not exceed, and not by more than ln 2 (unless
    /// the product is 0), for less than a logarithm.
    double logBound() const {
        uint64_t bits;
        std::memcpy(&bits, &value_, sizeof(bits));
        const auto exponent = static_cast<int64_t>(bits >> 52 & 0x7ff) - 1022;
        return static_cast<double>(exponent_ + exponent) * kLn2;
    }

    /// product x exp(-opticalDepth), saturated at the range of float instead of infinite.
    double timesExp(double opticalDepth) const {
        constexpr double kLimit = static_cast<double>(std::numeric_limits<float>::max());
        const double logScale = static_cast<double>(exponent_) * kLn2;
        // Beyond +-1400 the exponential decides alone: |value_| lies within 2^+-500.
        const double power = std::min(std::max(logScale - opticalDepth, -1400.0), 1400.0);
        const double root = std::exp(0.5 * power);
        return std::min(std::max(value_ * root * root, -kLimit), kLimit);
    }

  private:
    static constexpr double kLn2 = 0.69314718055994530942;

    double value_ = 1;
    int64_t exponent_ = 0;
};

}  // namespace trk
