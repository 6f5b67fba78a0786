// SPDX-License-Identifier: Apache-2.0
// How much of a super-voxel's extinction is integrated analytically [Novak14, Eq. 6].
#pragma once

#include "space/lanes.h"
#include "track/track.h"

namespace trk {

/// Which control is taken out of a super-voxel. Everything here is extinction: the formula is not
/// linear in a volume's scale, so it is used where the scale is known, when a ray is planned. Real:
/// double, or Double4 for four super-voxels at once.
struct ControlChoice {
    TrkChoice choice = TRK_CHOICE_ROBUST;
    double diagonal = 1;  ///< world length of a super-voxel's longest diagonal

    /// How far a control may exceed the extinction: about D S collisions are expected, each
    /// amplifies by at most 1 + (control - extinction) / S; what they amplify together is capped at
    /// gamma = 2, by range (2^(1 / (D S)) - 1) with S = range. Never more than the range.
    template <class Real>
    void allowExcess(const Real& range, Real& excess) const {
        const Real one = Real{} + 1.0;
        Real x = one / (diagonal * range);
        takeLesser(one, x);
        // 2^x - 1 for x in [0, 1], to 1e-7 of itself.
        excess = range * x *
                 (0.69314718055994531 +
                  x * (0.24022650695910071 +
                       x * (0.055504108664821580 +
                            x * (0.0096181291076284772 +
                                 x * (0.0013333558146428443 +
                                      x * (0.00015403530393381609 + x * 1.66835899e-05))))));
    }

    /// The constant control, of statistics of the extinction.
    template <class Real>
    void takeConstant(const Real& min, const Real& mean, const Real& max, Real& control) const {
        switch (choice) {
            case TRK_CHOICE_MIN:
                control = min;
                return;
            case TRK_CHOICE_MAX:
                control = max;
                return;
            case TRK_CHOICE_MEAN:
                control = mean;
                return;
            default:
                break;
        }
        allowExcess(Real(max - min), control);
        control = min + control;
        takeLesser(mean, control);
        takeGreater(min, control);
    }

    /// The share a of a control that is not constant which `choice` (robust or mean) keeps: the
    /// chosen control is min + a (control - min). `excess`: a bound of control - extinction.
    template <class Real>
    void takeShare(const Real& min, const Real& max, const Real& excess, Real& share) const {
        const Real one = Real{} + 1.0;
        share = one;
        if (choice == TRK_CHOICE_MEAN) {
            return;
        }
        Real allowed;
        allowExcess(Real(max - min), allowed);
        share = max > min ? allowed / excess : one;
        share = excess > 0 ? share : one;
        takeLesser(one, share);
    }
};

}  // namespace trk
