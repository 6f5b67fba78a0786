// SPDX-License-Identifier: Apache-2.0
#include "test_set.h"

#include "analytic.h"

#include "estimate/exact.h"
#include "estimate/free_path.h"
#include "estimate/plan.h"
#include "estimate/ratio_tracking.h"
#include "support/fixtures.h"
#include "support/rays.h"
#include "support/reference.h"

#include <algorithm>
#include <random>

namespace estimates {
namespace {

std::vector<PreparedRay> prepare(const trk::Volume& volume, size_t count) {
    rays::Box box{};
    for (int a = 0; a < 3; ++a) {
        const auto axis = static_cast<size_t>(a);
        box.lo[a] = 0.2 * static_cast<double>(volume.field->box().hi[axis]) +
                    0.8 * static_cast<double>(volume.field->box().lo[axis]);
        box.hi[a] = 0.8 * static_cast<double>(volume.field->box().hi[axis]) +
                    0.2 * static_cast<double>(volume.field->box().lo[axis]);
    }
    std::vector<PreparedRay> result;
    std::mt19937_64 random(99);
    std::uniform_real_distribution<double> unit(0, 1);
    while (result.size() < count) {
        const auto d = rays::unitVector(random);
        trk::Vec3d index;
        trk::Vec3d direction{{d[0], d[1], d[2]}};
        for (int a = 0; a < 3; ++a) {
            index[a] = box.lo[a] + unit(random) * (box.hi[a] - box.lo[a]) -
                       1000 * d[static_cast<size_t>(a)] +
                       static_cast<double>(volume.anchor[static_cast<size_t>(a)]);
        }
        const trk::Vec3d o = volume.indexToWorld.point(index);
        const trk::Vec3d v = volume.indexToWorld.vector(direction);
        TrkRay ray{};
        for (int a = 0; a < 3; ++a) {
            ray.origin[a] = static_cast<float>(o[a]);
            ray.direction[a] = static_cast<float>(v[a]);
        }
        ray.tMax = rays::kInfinity;
        const auto clipped = volume.clip(ray, volume.field->box());
        if (!clipped) {
            continue;
        }
        PreparedRay prepared{clipped->local, clipped->lengthPerVoxel, {}};
        prepared.exactDepth = Scene::exactDepthOf(volume, prepared);
        if (prepared.exactDepth[0] > 0) {
            result.push_back(prepared);
        }
    }
    return result;
}

template <class V, trk::Control kControl>
Moments momentsOf(const Scene& scene, const PreparedRay& ray, size_t channel) {
    const trk::TrackingSettings settings = scene.settings(ray);
    const typename V::Extinction field(scene.volume);
    const LocalRay& r = ray.local;
    const double unit = settings.lengthPerVoxel;
    const openvdb::Vec4d kPowers(1, 2, 3, 4);
    openvdb::Vec4d logMoments(0);  // of the powers 1 to 4
    Moments m;
    m.length = r.tEnd;
    trk::forEachStretch<kControl>(
        typename V::Walk(scene.volume), r, settings, [&](const auto& plan, size_t i) {
            const double rate = plan.rate(i) / unit;
            m.lookups += plan.collisions(i);
            if (!plan.isTracked(i, channel)) {
                logMoments -= plan.depth(i, channel) * kPowers;
                return;
            }
            logMoments +=
                unit * reference::integrateCells(
                           r.origin, r.direction, plan.tEnter(i), plan.tExit(i), [&](double t) {
                               const double control = plan.control(i, channel, r.at(t));
                               const double extinction = field.extinction(r.at(t))[channel];
                               const double w = 1 - (extinction - control) / rate;
                               const openvdb::Vec4d weights(w - 1, w * w - 1, w * w * w - 1,
                                                            w * w * w * w - 1);
                               return rate * weights - control * kPowers;
                           });
        });
    const double T = std::exp(logMoments[0]);
    const double m2 = std::exp(logMoments[1]);
    const double m3 = std::exp(logMoments[2]);
    const double m4 = std::exp(logMoments[3]);
    m.transmittance = T;
    m.variance = std::max(m2 - T * T, 0.0);
    m.third = m3 - 3 * T * m2 + 2 * T * T * T;
    m.fourth = m4 - 4 * T * m3 + 6 * T * T * m2 - 3 * T * T * T * T - 3 * m.variance * m.variance;
    return m;
}

/// Moments of a number that is 1 with probability T and else 0, T from the cells.
Moments binaryMoments(const Scene& scene, const PreparedRay& ray, size_t channel) {
    Moments m;
    const double T = std::exp(-Scene::exactDepthOf(scene.volume, ray)[channel]);
    m.length = ray.local.tEnd;
    m.transmittance = T;
    m.variance = T * (1 - T);
    m.third = m.variance * (1 - 2 * T);
    m.fourth = m.variance * (1 - 6 * m.variance);
    return m;
}

}  // namespace

Way wayNamed(const std::string& name) {
    for (const std::vector<Way>* ways : {&kWays, &kGlobalWays}) {
        for (const Way& way : *ways) {
            if (way.name == name) {
                return way;
            }
        }
    }
    ADD_FAILURE() << "no way is named " << name;
    return {};
}

Medium::Medium(std::string name, const std::string& vdb)
    : label(std::move(name)), source(fixtures::loadSource(vdb)) {}

const trk::BakedVolume& Medium::bake(int size, ControlKind kind) const {
    const auto found = bakes_.find({size, kind});
    return found != bakes_.end()
               ? found->second
               : bakes_
                     .emplace(std::make_pair(size, kind),
                              trk::bake(*source.field, fixtures::bakeOptions(size, 0, kind)))
                     .first->second;
}

Scene::Scene(const Medium& medium, int size, const Way& chosen, double meanDepth, size_t count,
             const std::array<float, 3>& color)
    : way(chosen), depth(meanDepth) {
    trk::VolumeOptions options;
    options.choice = way.choice;
    options.global = way.global;
    options.color = color;
    const vdbtools::Source& source = medium.source;
    rays = prepare(trk::makeVolume(source.summary, source.field, options), count);
    double sum = 0;
    for (const PreparedRay& ray : rays) {
        sum += ray.exactDepth[0];
    }
    options.scale = static_cast<float>(meanDepth * static_cast<double>(rays.size()) / sum);
    volume = trk::makeVolume(source.summary, source.field, options);
    trk::addSuperVoxels(volume, medium.bake(size, way.kind), options, medium.label);
    rays = prepare(volume, count);
}

std::array<double, 3> Scene::exactDepthOf(const trk::Volume& of, const PreparedRay& ray) {
    std::array<double, 3> result{};
    trk::withVariant(of, ControlKind::kConstant, [&](auto variant) {
        using V = decltype(variant);
        trk::PathCost cost;
        const auto exact =
            trk::exactOpticalDepth(typename V::Extinction(of), ray.local, ray.lengthPerVoxel, cost);
        std::copy(exact.begin(), exact.end(), result.begin());
    });
    return result;
}

trk::TrackingSettings Scene::settings(const PreparedRay& ray) const {
    trk::TrackingSettings s;
    s.lengthPerVoxel = ray.lengthPerVoxel;
    s.rateBase = way.rateBase;
    s.rate = way.rate;
    s.roulette = false;       // moments are known without
    s.exactFallback = false;  // where it sets in, nothing random is left to test
    return s;
}

std::array<double, 3> Scene::estimate(const PreparedRay& ray, const trk::TrackingSettings& s,
                                      trk::Rng& rng, trk::PathCost& cost) const {
    std::array<double, 3> result{};
    withFields([&](auto, const auto& field, const auto& superVoxels) {
        const auto estimate =
            way.method == TRK_METHOD_DELTA
                ? analytic::trackBinary(field, superVoxels, ray.local, s, rng, cost)
            : way.method == TRK_METHOD_RATIO ? trk::trackTransmittance<trk::Control::kNone>(
                                                   field, superVoxels, ray.local, s, rng, cost)
                                             : trk::trackTransmittance<trk::Control::kChosen>(
                                                   field, superVoxels, ray.local, s, rng, cost);
        std::copy(estimate.begin(), estimate.end(), result.begin());
    });
    return result;
}

Moments momentsOf(const Scene& scene, const PreparedRay& ray, size_t channel) {
    if (scene.way.method == TRK_METHOD_DELTA) {
        return binaryMoments(scene, ray, channel);
    }
    Moments m;
    scene.withFields([&](auto variant, const auto&, const auto&) {
        using V = decltype(variant);
        m = scene.way.method == TRK_METHOD_RESIDUAL
                ? momentsOf<V, trk::Control::kChosen>(scene, ray, channel)
                : momentsOf<V, trk::Control::kNone>(scene, ray, channel);
    });
    return m;
}

TestSet makeSet(const Scene& scene, uint64_t samples, size_t channel) {
    TestSet whole;
    whole.samples = samples;
    double length = 0;
    for (const PreparedRay& ray : scene.rays) {
        const Moments m = momentsOf(scene, ray, channel);
        length += m.length;
        whole.add(scene, ray, m, channel, 1);
    }
    whole.summarize();
    if (whole.isNormal()) {
        return whole;
    }
    constexpr double kTail = 30;
    TestSet cut;
    cut.samples = samples;
    cut.wholeKurtosis = whole.excessKurtosis;
    double tested = 0;
    for (PreparedRay ray : scene.rays) {
        for (Moments m = momentsOf(scene, ray, channel);; m = momentsOf(scene, ray, channel)) {
            // Below, moments are the rounding error of a difference: nothing random is left.
            if (m.variance < 1e-7 * m.transmittance * m.transmittance) {
                break;
            }
            if (m.fourth < kTail * static_cast<double>(samples) * m.variance * m.variance) {
                tested += m.length;
                cut.add(scene, ray, m, channel, 1 / std::sqrt(m.variance));
                break;
            }
            ray.local.tEnd *= 0.8;
        }
    }
    cut.testedShare = tested / length;
    cut.summarize();
    return cut;
}

}  // namespace estimates
