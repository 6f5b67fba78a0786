// SPDX-License-Identifier: Apache-2.0
// Where a photon collides: delta tracking and decomposition tracking, in grey and in colour, and
// the binary transmittance that delta tracking makes of it.
#pragma once

#include "plan.h"
#include "room.h"
#include "tracking.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <utility>

namespace trk {

/// A free path. For every channel c and function f, E[weight_c f(t), collided] is the integral of
/// T_c mu_c f over the ray, and E[weight_c, not collided] is T_c of the whole ray.
template <size_t C>
struct FreePath {
    FreePath() { weight.fill(1); }

    bool collided = false;
    double t = 0;  ///< where, in voxel lengths
    std::array<double, C> weight;
    std::array<double, C>
        extinction{};  ///< there, where that was wanted; 0 where it did not collide
};

namespace detail {

/// One channel of a field, and of super-voxels, as a grey one.
template <class Field>
struct OneChannelField {
    static constexpr size_t kChannels = 1;
    const Field& field;
    size_t channel;

    std::array<double, 1> extinction(const Vec3d& point) const {
        return {{field.extinction(point)[channel]}};
    }
    std::array<double, 1> integrate(const LocalRay& ray, double t0, double t1, uint64_t& lookups,
                                    uint64_t& regions) const {
        return {{field.integrate(ray, t0, t1, lookups, regions)[channel]}};
    }
    template <class Visit>
    void forEachCell(const LocalRay& ray, double t0, double t1, Visit&& visit) const {
        field.forEachCell(ray, t0, t1, [&](double tEnter, double tExit, const auto& depth) {
            return visit(tEnter, tExit, std::array<double, 1>{{depth[channel]}});
        });
    }
};
template <class SuperVoxels>
struct OneChannelWalk {
    static constexpr size_t kChannels = 1;
    static constexpr ControlKind kKind = ControlKind::kConstant;  // nobody looks at it
    const SuperVoxels& superVoxels;
    size_t channel;

    double scale(size_t) const { return superVoxels.scale(channel); }
    const ControlChoice& choice() const { return superVoxels.choice(); }
    using Whole = decltype(std::declval<const SuperVoxels&>().cursor(
        std::declval<const LocalRay&>(), 0.0, 0.0));
    struct Cursor : Whole {  // an aggregate: what it is made of is made in place
        size_t channel;
        const SuperVoxel& record(size_t i, size_t) const { return Whole::record(i, channel); }
    };
    Cursor cursor(const LocalRay& ray, double t0, double t1) const {
        return {superVoxels.cursor(ray, t0, t1), channel};
    }
};

/// Regular tracking over [t0, t1]: the collision, if there is one, at the point where the optical
/// depth reaches an exponential number. In colour, that of one channel, chosen in proportion to the
/// weights, which then become those of the mixture of all channels.
template <class Field, class Random>
void sampleExactly(const Field& field, const LocalRay& ray, double t0, double t1,
                   double lengthPerVoxel, Random& random, PathCost& cost,
                   FreePath<Field::kChannels>& path) {
    constexpr size_t C = Field::kChannels;
    std::array<double, C> share{{1}};  // of the mixture
    size_t chosen = 0;
    if constexpr (C > 1) {
        double sum = 0;
        for (const double w : path.weight) {
            sum += w;
        }
        double u = random.uniform() * sum;
        for (size_t c = 0; c < C; ++c) {
            share[c] = path.weight[c] / sum;
        }
        while (chosen + 1 < C && u >= path.weight[chosen]) {
            u -= path.weight[chosen++];
        }
    }
    const double target = random.exponential() / lengthPerVoxel;
    std::array<double, C> depth{};
    std::array<double, C> arrival{};  // in proportion to the extinction at the collision
    double tEnd = t1;
    field.forEachCell(ray, t0, t1, [&](double tEnter, double tExit, const auto& cell) {
        cost.lookups += 2;
        if (depth[chosen] + cell[chosen] <= target) {
            for (size_t c = 0; c < C; ++c) {
                depth[c] += cell[c];
            }
            return true;
        }
        // Newton's method on a function that only grows, kept inside by bisection.
        double lo = tEnter;
        double hi = tExit;
        double t = tEnter + (tExit - tEnter) * (target - depth[chosen]) / cell[chosen];
        std::array<double, C> part{};
        for (int i = 0; i < 60 && hi - lo > 1e-15 * tExit; ++i) {
            part = {};
            field.forEachCell(ray, tEnter, t, [&](double, double, const auto& piece) {
                cost.lookups += 2;
                for (size_t c = 0; c < C; ++c) {
                    part[c] += piece[c];
                }
                return true;
            });
            const double missing = target - depth[chosen] - part[chosen];
            (missing > 0 ? lo : hi) = t;
            const double slope = field.extinction(ray.at(t))[chosen];
            ++cost.lookups;
            const double next = t + missing / slope;
            if (std::fabs(missing) <= 1e-12 * target || next == t) {
                break;
            }
            t = next > lo && next < hi ? next : 0.5 * (lo + hi);
        }
        // Where the extinction is huge, t is too coarse for the depth; the weights need not be.
        const std::array<double, C>& passed = part[chosen] > 0 ? part : cell;
        const double ratio = (target - depth[chosen]) / passed[chosen];
        for (size_t c = 0; c < C; ++c) {
            depth[c] += ratio * passed[c];
        }
        arrival = passed;
        path.collided = true;
        tEnd = t;
        return false;
    });
    cost.exactLength += tEnd - t0;
    path.t = tEnd;
    if (path.collided) {
        path.extinction = field.extinction(ray.at(tEnd));
        ++cost.lookups;
        if (path.extinction[chosen] > 0) {  // not where t is too coarse to leave what is empty
            arrival = path.extinction;
        }
    }
    if constexpr (C > 1) {
        // Relative to the chosen channel, lest all underflow.
        std::array<double, C> density;
        double mixture = 0;
        for (size_t c = 0; c < C; ++c) {
            density[c] = std::exp(lengthPerVoxel * (depth[chosen] - depth[c])) *
                         (path.collided ? arrival[c] : 1.0);
            mixture += share[c] * density[c];
        }
        for (size_t c = 0; c < C && mixture > 0; ++c) {
            path.weight[c] *= density[c] / mixture;
        }
    }
}

}  // namespace detail

/// Free paths go by the bounds of what they sample: collisions are a share of it, whatever was
/// asked for.
inline TrackingSettings freePathSettings(TrackingSettings settings) {
    settings.rateBase = RateBase::kMajorant;
    return settings;
}

/// A free path, through a plan that walks of the same ray may share. With one for
/// Control::kMinimum, the minimum of each super-voxel is a control whose collisions need no
/// look-up, and only the rest is tracked [Kutz17]; with one for kNone, it is delta tracking
/// [Woodcock65]. Homogeneous super-voxels need no look-up in either. The plan must be made by
/// freePathSettings.
///
/// In grey and at rate 1, both take the same decisions from the same random numbers: what
/// decomposition saves is the look-up where a collision is the control's, if the extinction there
/// is not wanted.
///
/// Tentative collisions come at a rate that covers every channel. In grey they are real with
/// probability extinction / rate, and the weight stays 1. In colour they are real with the
/// probability that the channels have together, each by its weight so far, and the weights make up
/// for the difference (spectral tracking); their sum is kept, so none exceeds C [Kutz17].
template <class Field, class Plan, class Random>
class FreePathWalk {
  public:
    static constexpr size_t C = Field::kChannels;

    FreePathWalk(const Field& field, const Plan& plan, const LocalRay& ray,
                 const TrackingSettings& settings, Random& random, PathCost& cost)
        : field_(field),
          plan_(plan),
          ray_(ray),
          settings_(settings),
          random_(random),
          cost_(cost),
          distance_(random.exponential()) {}

    /// Through what the plan has crossed; whether the path goes on behind it.
    bool pass() {
        double distance = distance_;
        const size_t count = plan_.count();
        size_t i = 0;
        bool isRandom = false;
        bool goesOn = true;
        for (; i < count && goesOn; ++i) {
            double controlRate = 0;
            for (size_t c = 0; c < C; ++c) {
                controlRate = std::max(controlRate, plan_.control(i, c, ray_.origin));
            }
            const double collisions =
                plan_.collisions(i) + controlRate * settings_.lengthPerVoxel * plan_.length(i);
            isRandom = isRandom || collisions > 0;
            if (distance >= collisions) {
                distance -= collisions;
            } else {
                distance_ = distance;
                goesOn = track(i, controlRate, collisions);
                distance = distance_;
            }
        }
        distance_ = distance;
        cost_.superVoxels += i;
        cost_.random = cost_.random || isRandom;
        return goesOn;
    }
    const FreePath<C>& path() const { return path_; }

  private:
    /// Tracks a stretch, where `remaining` is what the rate makes of its length; whether the path
    /// goes on.
    bool track(size_t i, double controlRate, double remaining) {
        const double tExit = plan_.tExit(i);
        const double residualRate = plan_.rate(i) / settings_.lengthPerVoxel;
        const double rate = controlRate + residualRate;
        const double ratePerVoxel = rate * settings_.lengthPerVoxel;
        std::array<double, C> control;
        for (size_t c = 0; c < C; ++c) {
            control[c] = plan_.control(i, c, ray_.origin);  // the same everywhere
        }
        // Where a ray meets little of what the rate covers, null collisions would never end. After
        // as many as integrating exactly takes, that is what is done with the rest: having come so
        // far, how to go on is free.
        double budget = MostLookups(ray_, settings_)(plan_.length(i));
        while (distance_ < remaining) {
            remaining -= distance_;
            distance_ = random_.exponential();
            path_.t = tExit - remaining / ratePerVoxel;
            const double u = residualRate > 0 ? random_.uniform() * rate : 0.0;
            const bool ofControl = u < controlRate;
            std::array<double, C> extinction = control;
            if (!ofControl) {
                extinction = field_.extinction(ray_.at(path_.t));
                ++cost_.lookups;
            }
            if constexpr (C == 1) {
                path_.collided = ofControl || u - controlRate < extinction[0] - control[0];
            } else {
                collideInColour(extinction, control, ofControl,
                                ofControl ? controlRate : residualRate);
            }
            if (path_.collided) {
                if (ofControl && residualRate > 0 && settings_.wantsExtinction) {
                    extinction = field_.extinction(ray_.at(path_.t));
                    ++cost_.lookups;
                }
                path_.extinction = extinction;
                return false;
            }
            if (--budget < 0) {
                detail::sampleExactly(field_, ray_, path_.t, tExit, settings_.lengthPerVoxel,
                                      random_, cost_, path_);
                return !path_.collided;
            }
        }
        distance_ -= remaining;
        return true;
    }
    /// Whether a collision is real, and what that makes of the weights. `part`: the rate of those
    /// of its kind, of the control or of the residual.
    void collideInColour(const std::array<double, C>& extinction,
                         const std::array<double, C>& control, bool ofControl, double part) {
        std::array<double, C> real;
        double realSum = 0;
        double sum = 0;
        for (size_t c = 0; c < C; ++c) {
            // Rounding may leave less than nothing, or more than everything.
            real[c] =
                ofControl ? control[c] : std::fmin(std::fmax(extinction[c] - control[c], 0), part);
            realSum += path_.weight[c] * real[c];
            sum += path_.weight[c] * part;
        }
        const double probability = realSum / sum;
        path_.collided = random_.uniform() < probability;
        for (size_t c = 0; c < C; ++c) {
            path_.weight[c] *= path_.collided ? real[c] / (part * probability)
                                              : (part - real[c]) / (part * (1 - probability));
        }
    }

    const Field& field_;
    const Plan& plan_;
    const LocalRay& ray_;
    const TrackingSettings& settings_;
    Random& random_;
    PathCost& cost_;
    FreePath<C> path_;
    double distance_;  // to the next collision, in units of the rate; see RatioWalk
};

/// A free path of one ray, by decomposition tracking or delta tracking.
template <bool kDecompose, class Field, class SuperVoxels, class Random>
FreePath<Field::kChannels> sampleFreePath(const Field& field, const SuperVoxels& superVoxels,
                                          const LocalRay& ray, const TrackingSettings& settings,
                                          Random& random, PathCost& cost) {
    const TrackingSettings bounded = freePathSettings(settings);
    Plan<kDecompose ? Control::kMinimum : Control::kNone, SuperVoxels> plan(superVoxels, ray,
                                                                            bounded);
    FreePathWalk walk(field, std::as_const(plan), ray, bounded, random, cost);
    while (plan.next() > 0 && walk.pass()) {
    }
    return walk.path();
}

namespace detail {

/// How many of a ray's photons go through a plan together.
inline constexpr size_t kPhotons = 16;

/// Whether the photons of `count` random numbers pass.
template <class Field, class SuperVoxels, class Random>
void trackPhotons(const Field& field, const SuperVoxels& superVoxels, const LocalRay& ray,
                  const TrackingSettings& settings, Room<Random>* randoms, size_t count,
                  PathCost& cost, std::array<double, Field::kChannels>* passes) {
    constexpr size_t C = Field::kChannels;
    if constexpr (C == 1) {
        using RayPlan = Plan<Control::kNone, SuperVoxels>;
        RayPlan plan(superVoxels, ray, settings);
        Room<FreePathWalk<Field, RayPlan, Random>> walks[kPhotons];
        size_t flying[kPhotons];
        for (size_t i = 0; i < count; ++i) {
            walks[i].emplace(field, plan, ray, settings, randoms[i].object, cost);
            flying[i] = i;
        }
        for (size_t left = count; left > 0 && plan.next() > 0;) {
            size_t kept = 0;
            for (size_t k = 0; k < left; ++k) {
                flying[kept] = flying[k];
                kept += walks[flying[k]].object.pass() ? 1 : 0;
            }
            left = kept;
        }
        for (size_t i = 0; i < count; ++i) {
            passes[i][0] = walks[i].object.path().collided ? 0.0 : 1.0;
        }
    } else {
        const double exactBefore = cost.exactLength;
        for (size_t c = 0; c < C; ++c) {
            const OneChannelField<Field> oneField{field, c};
            const OneChannelWalk<SuperVoxels> oneWalk{superVoxels, c};
            std::array<double, 1> ofChannel[kPhotons];
            trackPhotons(oneField, oneWalk, ray, settings, randoms, count, cost, ofChannel);
            for (size_t i = 0; i < count; ++i) {
                passes[i][c] = ofChannel[i][0];
            }
        }
        cost.exactLength =
            exactBefore + (cost.exactLength - exactBefore) / static_cast<double>(C);  // of a walk
    }
}

}  // namespace detail

/// `samples` estimates of the transmittance of the whole ray by delta tracking, per channel:
/// whether a photon passes, 1 or 0. Each channel takes walks of its own. `randomOf(sample)`: the
/// random numbers of one; take(passes) is called for each, in order.
template <class Field, class SuperVoxels, class RandomOf, class Take>
void trackBinary(const Field& field, const SuperVoxels& superVoxels, const LocalRay& ray,
                 const TrackingSettings& settings, uint32_t samples, const RandomOf& randomOf,
                 PathCost& cost, const Take& take) {
    const TrackingSettings bounded = freePathSettings(settings);
    Room<decltype(randomOf(0))> randoms[detail::kPhotons];
    std::array<double, Field::kChannels> passes[detail::kPhotons];
    for (uint32_t first = 0; first < samples;) {
        const uint32_t count = std::min(samples - first, uint32_t{detail::kPhotons});
        for (uint32_t i = 0; i < count; ++i) {
            randoms[i].emplace(randomOf(first + i));
        }
        detail::trackPhotons(field, superVoxels, ray, bounded, randoms, count, cost, passes);
        std::for_each_n(passes, count, take);
        first += count;
    }
}

}  // namespace trk
