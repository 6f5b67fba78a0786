// SPDX-License-Identifier: Apache-2.0
// From what a volume is to code made for it: channels and kind of control at compile time, so that
// a grey volume with a constant control pays for neither.
#pragma once

#include "control/super_voxels.h"
#include "volume.h"

#include <algorithm>
#include <array>
#include <cstddef>
#include <cstdint>
#include <type_traits>

namespace trk {

/// What a query is made for at compile time: a density of F channels, an extinction of C, a control
/// of kind K.
template <size_t F, size_t C, ControlKind K>
struct Variant {
    static constexpr size_t kDensityChannels = F;
    static constexpr size_t kChannels = C;
    static constexpr ControlKind kKind = K;
    using Extinction = VolumeExtinction<F, C>;

    /// The volume's super-voxels as plans are made of them.
    class Walk {
      public:
        static constexpr size_t kChannels = C;
        static constexpr ControlKind kKind = K;

        /// By the super-voxels that random methods walk.
        explicit Walk(const Volume& volume)
            : superVoxels_(volume.tracked()), choice_(volume.controlChoice) {
            std::copy_n(volume.scales.begin(), C, scales_.begin());
        }
        double scale(size_t channel) const { return scales_[channel]; }
        const ControlChoice& choice() const { return choice_; }

        SuperVoxelCursor<F, K> cursor(const LocalRay& ray, double t0, double t1) const {
            return {superVoxels_, ray, t0, t1};
        }

      private:
        const SuperVoxels& superVoxels_;
        ControlChoice choice_;
        std::array<double, C> scales_;
    };
    /// Integral of the baked control extinction of a level over the ray, times the length of a
    /// voxel.
    static std::array<double, C> integrateControl(const Volume& volume, const LocalRay& ray,
                                                  size_t level, uint64_t& regions) {
        const auto density = volume.superVoxels->integrateControl<F, K>(ray, level, regions);
        std::array<double, C> result;
        for (size_t c = 0; c < C; ++c) {
            result[c] = volume.scales[c] * density[F == 1 ? 0 : c];
        }
        return result;
    }
};

/// Calls body(Variant) for what the volume is. `kind`: that of the super-voxels to be walked, or
/// kConstant where nobody looks at their control.
template <class Body>
void withVariant(const Volume& volume, ControlKind kind, const Body& body) {
    const auto withKind = [&](auto f, auto c) {
        constexpr size_t F = decltype(f)::value;
        constexpr size_t C = decltype(c)::value;
        switch (kind) {
            case ControlKind::kConstant:
                return body(Variant<F, C, ControlKind::kConstant>());
            case ControlKind::kTrilinear:
                return body(Variant<F, C, ControlKind::kTrilinear>());
            case ControlKind::kAffine:
                return body(Variant<F, C, ControlKind::kAffine>());
        }
    };
    constexpr std::integral_constant<size_t, 1> kOne;
    constexpr std::integral_constant<size_t, 3> kThree;
    if (volume.channels() == 1) {
        withKind(kOne, kOne);
    } else if (volume.densityChannels() == 1) {
        withKind(kOne, kThree);
    } else {
        withKind(kThree, kThree);
    }
}

}  // namespace trk
