// SPDX-License-Identifier: Apache-2.0
#include "strips.h"

#include "estimate/plan.h"
#include "query/transmittance.h"
#include "query/variant.h"
#include "view/camera.h"

#include <array>
#include <cfloat>
#include <cmath>

namespace vdbtools {
namespace {

/// Transmittance of the chosen control along a ray, mean over channels.
double controlTransmittance(const trk::Volume& volume, const TrkRay& ray) {
    const auto clipped = volume.clip(ray, volume.field->box());
    if (!clipped) {
        return 1;
    }
    double sum = 0;
    trk::withVariant(volume, volume.tracked().kind(), [&](auto variant) {
        using V = decltype(variant);
        std::array<double, V::kChannels> depth{};
        trk::TrackingSettings settings;
        settings.lengthPerVoxel = clipped->lengthPerVoxel;
        trk::forEachStretch<trk::Control::kChosen>(typename V::Walk(volume), clipped->local,
                                                   settings, [&](const auto& plan, size_t i) {
                                                       for (size_t c = 0; c < V::kChannels; ++c) {
                                                           depth[c] += plan.depth(i, c);
                                                       }
                                                   });
        for (const double d : depth) {
            sum += std::exp(-d) / static_cast<double>(V::kChannels);
        }
    });
    return sum;
}

}  // namespace

Strip drawStrip(const Source& source, const trk::BakedVolume& baked, bool whole, float scale,
                int width, uint32_t samples) {
    Strip strip;
    strip.whole = whole;
    strip.size = baked.superVoxelSize();
    strip.width = width;
    const auto pixels = static_cast<size_t>(width) * static_cast<size_t>(width);
    for (const TrkChoice choice :
         {TRK_CHOICE_MIN, TRK_CHOICE_MEAN, TRK_CHOICE_MAX, TRK_CHOICE_ROBUST}) {
        trk::VolumeOptions options;
        options.scale = scale;
        options.choice = choice;
        options.global = whole;
        trk::Volume volume = trk::makeVolume(source.summary, source.field, options);
        trk::addSuperVoxels(volume, baked, options, "bake");
        Camera camera = namedView("iso");
        WorldBox box;
        trk::worldBounds(volume.indexToWorld, volume.anchor, volume.field->box(), box.lo.x,
                         box.hi.x);
        frameBox(camera, box, 1);
        std::vector<TrkRay> rays;
        for (size_t i = 0; i < pixels; ++i) {
            const auto n = static_cast<size_t>(width);
            rays.push_back(camera.ray((static_cast<double>(i % n) + 0.5) / width,
                                      (static_cast<double>(i / n) + 0.5) / width, 1));
        }
        TrkQuery query = trkDefaultQuery();
        query.rayStride = sizeof(TrkRay);
        query.samples = samples;
        query.flags = 0;
        const size_t channels = volume.channels();
        std::vector<float> estimates(pixels * channels);
        std::vector<float> errors(pixels * channels);
        trk::StatisticsOutput statistics;
        statistics.standardError = {errors.data(), channels, 0};
        trk::estimateTransmittance(volume, query, rays.data(), pixels,
                                   {estimates.data(), channels, 0}, statistics);
        StripRow row;
        row.choice = choice;
        for (size_t i = 0; i < pixels; ++i) {
            const double control = controlTransmittance(volume, rays[i]);
            double mean = 0;
            double variance = 0;
            for (size_t c = 0; c < channels; ++c) {
                const auto error = static_cast<double>(errors[i * channels + c]);
                mean += static_cast<double>(estimates[i * channels + c]);
                variance += std::isnan(error) ? 0 : error * error * samples;
            }
            mean /= static_cast<double>(channels);
            variance /= static_cast<double>(channels);
            row.control.push_back(static_cast<float>(control));
            const double residual = control > 0 ? mean / control : NAN;
            row.residual.push_back(std::fabs(residual) <= FLT_MAX ? static_cast<float>(residual)
                                                                  : NAN);
            row.product.push_back(static_cast<float>(mean));
            row.variance.push_back(static_cast<float>(variance));
        }
        strip.rows.push_back(std::move(row));
    }
    return strip;
}

}  // namespace vdbtools
