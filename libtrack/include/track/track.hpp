// SPDX-License-Identifier: Apache-2.0
// Move-only C++ wrapper over track.h, nothing else.
#pragma once

#include "track/track.h"

#include <stdexcept>
#include <string>
#include <utility>

namespace track {

/// A failed call: its status and the line of trkGetLastErrorMessage().
class Error : public std::runtime_error {
  public:
    explicit Error(TrkStatus status)
        : std::runtime_error(trkGetLastErrorMessage()), status_(status) {}
    TrkStatus status() const noexcept { return status_; }

  private:
    TrkStatus status_;
};

/// Owns a TrkVolume. Queries are const and safe from any number of threads.
class Volume {
  public:
    /// As trkOpenVolume; an empty `vdbPath` opens the sidecar alone. Throws Error.
    static Volume open(const std::string& vdbPath, const char* sidecarPath = nullptr,
                       const TrkVolumeOptions& options = trkDefaultVolumeOptions()) {
        Volume volume;
        check(trkOpenVolume(vdbPath.empty() ? nullptr : vdbPath.c_str(), sidecarPath, &options,
                            &volume.handle_));
        return volume;
    }

    Volume(Volume&& other) noexcept : handle_(std::exchange(other.handle_, nullptr)) {}
    Volume& operator=(Volume&& other) noexcept {
        std::swap(handle_, other.handle_);
        return *this;
    }
    Volume(const Volume&) = delete;
    Volume& operator=(const Volume&) = delete;
    ~Volume() { trkCloseVolume(handle_); }

    TrkVolume* handle() const noexcept { return handle_; }

    TrkVolumeInfo info() const {
        TrkVolumeInfo info;
        info.size = sizeof(info);
        check(trkGetVolumeInfo(handle_, &info));
        return info;
    }

    /// As trkEstimateTransmittance: `channels` floats a ray. Throws Error.
    void estimateTransmittance(const TrkQuery& query, const TrkRay* rays, size_t rayCount,
                               float* transmittance, TrkStatistics* statistics = nullptr) const {
        check(trkEstimateTransmittance(handle_, &query, rays, rayCount, transmittance, statistics));
    }

    /// As trkIntegrateOpticalDepth: `channels` doubles a ray. Throws Error.
    void integrateOpticalDepth(const TrkQuery& query, const TrkRay* rays, size_t rayCount,
                               double* opticalDepth) const {
        check(trkIntegrateOpticalDepth(handle_, &query, rays, rayCount, opticalDepth));
    }

    /// As trkSampleFreePath: one record a ray. Throws Error.
    void sampleFreePath(const TrkQuery& query, const TrkRay* rays, size_t rayCount,
                        TrkFreePath* results) const {
        check(trkSampleFreePath(handle_, &query, rays, rayCount, results));
    }

    /// As trkSampleExtinction, of points x, y, z without gaps: `channels` floats a point. Throws
    /// Error.
    void sampleExtinction(const float* points, size_t pointCount, float* extinction) const {
        check(trkSampleExtinction(handle_, points, 0, pointCount, extinction));
    }

  private:
    Volume() = default;
    static void check(TrkStatus status) {
        if (status != TRK_OK) {
            throw Error(status);
        }
    }

    TrkVolume* handle_ = nullptr;
};

}  // namespace track
