// SPDX-License-Identifier: Apache-2.0
// What core_table compares on: procedural volumes, fields that are hard on estimators, rays.
#pragma once

#include "baselines.h"
#include "support/rays.h"
#include "track/track_openvdb.hpp"

#include <cstddef>
#include <memory>
#include <string>
#include <vector>

constexpr size_t kRays = 8192;  // of a set

/// A volume of `voxels` along an edge, from FOLDER or made into it.
openvdb::FloatGrid::Ptr procedural(const std::string& folder, const std::string& kind, int voxels);

/// Fields that are hard on estimators, of 96^3 voxels.
openvdb::FloatGrid::Ptr adversarial(const std::string& name);

/// The same density in three channels, each a little less.
openvdb::Vec3SGrid::Ptr threeChannels(const openvdb::FloatGrid& grey);

/// In the order of a picture's pixels.
std::vector<TrkRay> cameraRays(const rays::Box& box);

/// From points of the density in any direction, as a path tracer's shadow rays.
std::vector<TrkRay> secondaryRays(const track::Volume& volume, const rays::Box& box);

/// Along z, from outside, through random points.
std::vector<TrkRay> parallelRays(const rays::Box& box);

/// A grid and what is compared on it.
struct Field {
    std::string name;
    openvdb::FloatGrid::Ptr grid;
    std::unique_ptr<baselines::RatioTracking> ratioTracking;
    std::unique_ptr<baselines::Integration> integration;

    Field(std::string named, openvdb::FloatGrid::Ptr of)
        : name(std::move(named)),
          grid(std::move(of)),
          ratioTracking(std::make_unique<baselines::RatioTracking>(*grid)),
          integration(std::make_unique<baselines::Integration>(*grid)) {}

    track::Volume open(float scale) const {
        TrkVolumeOptions options = trkDefaultVolumeOptions();
        options.noBake = 1;
        options.scale = scale;
        return track::makeVolume(*grid, options);
    }
};

/// Rays of a field that hit, and the scale that gives them a mean optical depth.
struct Set {
    std::string name;
    const Field& field;
    std::vector<TrkRay> rays;
    std::vector<double> exact;  // transmittance
    float scale = 1;

    Set(std::string named, const Field& of, const std::vector<TrkRay>& from, double meanDepth);
};
