// SPDX-License-Identifier: Apache-2.0
// C++ over track.h: owners of its handles and arrays, exceptions for its statuses, nothing else.
#pragma once

#include "track/track.h"

#include <cstddef>
#include <cstdint>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

namespace track {

/// A failed call: its status and the line that says what was found.
class Error : public std::runtime_error {
  public:
    explicit Error(TrkStatus status)
        : std::runtime_error(trkGetLastErrorMessage()), status_(status) {}
    Error(TrkStatus status, const std::string& message)
        : std::runtime_error(message), status_(status) {}
    TrkStatus status() const noexcept { return status_; }

  private:
    TrkStatus status_;
};

/// A TrkQuery with the defaults, which cannot be made without saying whose random numbers it takes:
/// results of one ray id and stream repeat each other. See TrkQuery.
struct Query : TrkQuery {
    /// Ray i of a call has the id firstRayId + i.
    Query(uint64_t firstId, uint64_t ofStream) : TrkQuery(trkDefaultQuery()) {
        firstRayId = firstId;
        stream = ofStream;
    }
    /// One id for each ray of a call, which must outlive it.
    static Query ofRays(const uint64_t* ids, uint64_t ofStream) {
        Query query(0, ofStream);
        query.rayIds = ids;
        return query;
    }
};

/// Room for all statistics of a number of rays. `channels`: the volume's.
struct Statistics {
    Statistics(size_t rayCount, size_t channels)
        : standardError(rayCount * channels),
          lookups(rayCount),
          superVoxels(rayCount),
          exactShare(rayCount) {}

    std::vector<float> standardError;  ///< `channels` a ray
    std::vector<uint64_t> lookups;
    std::vector<uint64_t> superVoxels;
    std::vector<float> exactShare;

    TrkStatistics view() {
        TrkStatistics result = trkDefaultStatistics();
        result.standardError = standardError.data();
        result.lookups = lookups.data();
        result.superVoxels = superVoxels.data();
        result.exactShare = exactShare.data();
        return result;
    }
};

/// Room for a number of free paths. `channels`: the volume's.
struct FreePaths {
    FreePaths(size_t rayCount, size_t channels)
        : t(rayCount),
          weight(rayCount * channels),
          extinction(rayCount * channels),
          lookups(rayCount) {}

    std::vector<float> t;
    std::vector<float> weight;      ///< `channels` a ray
    std::vector<float> extinction;  ///< the same
    std::vector<uint32_t> lookups;

    TrkFreePaths view() {
        TrkFreePaths result = trkDefaultFreePaths();
        result.t = t.data();
        result.weight = weight.data();
        result.extinction = extinction.data();
        result.lookups = lookups.data();
        return result;
    }
};

/// Owns a TrkVolume. Queries are const and safe from any number of threads; bake is not.
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

    /// As trkMakeVolume. Throws Error.
    static Volume make(const TrkDensity& density,
                       const TrkVolumeOptions& options = trkDefaultVolumeOptions()) {
        Volume volume;
        check(trkMakeVolume(&density, &options, &volume.handle_));
        return volume;
    }

    /// As trkBakeVolume; an empty `sidecarPath` writes nothing. Throws Error.
    void bake(const TrkBakeOptions& options = trkDefaultBakeOptions(),
              const std::string& sidecarPath = "") {
        check(
            trkBakeVolume(handle_, &options, sidecarPath.empty() ? nullptr : sidecarPath.c_str()));
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
        TrkVolumeInfo result;
        result.size = sizeof(result);
        check(trkGetVolumeInfo(handle_, &result));
        return result;
    }

    /// As trkEstimateTransmittance: `channels` floats a ray. Throws Error.
    void estimateTransmittance(const Query& query, const TrkRay* rays, size_t rayCount,
                               float* transmittance) const {
        check(trkEstimateTransmittance(handle_, &query, rays, rayCount, transmittance, nullptr));
    }
    void estimateTransmittance(const Query& query, const TrkRay* rays, size_t rayCount,
                               float* transmittance, const TrkStatistics& statistics) const {
        check(
            trkEstimateTransmittance(handle_, &query, rays, rayCount, transmittance, &statistics));
    }

    /// As trkIntegrateOpticalDepth: `channels` doubles a ray. Throws Error.
    void integrateOpticalDepth(const TrkQuery& query, const TrkRay* rays, size_t rayCount,
                               double* opticalDepth) const {
        check(trkIntegrateOpticalDepth(handle_, &query, rays, rayCount, opticalDepth));
    }

    /// As trkSampleFreePath. Throws Error.
    void sampleFreePath(const Query& query, const TrkRay* rays, size_t rayCount,
                        const TrkFreePaths& paths) const {
        check(trkSampleFreePath(handle_, &query, rays, rayCount, &paths));
    }

    /// As trkSampleExtinction, of points x, y, z without gaps: `channels` floats a point. Throws
    /// Error.
    void sampleExtinction(const float* points, size_t pointCount, float* extinction) const {
        check(trkSampleExtinction(handle_, points, 0, pointCount, extinction, 0));
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
