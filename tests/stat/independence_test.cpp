// SPDX-License-Identifier: Apache-2.0
// That estimates of different streams may be multiplied, and those of one stream may not.
#include "track/track.hpp"

#include "support/fixtures.h"
#include "support/rays.h"

#include <gtest/gtest.h>

#include <cmath>
#include <cstdint>
#include <cstdio>
#include <string>
#include <vector>

namespace {

/// z of the mean product of two estimates against the product of the true means, over many ray ids.
struct Product {
    double z;
    double correlation;
};

Product productOf(const std::vector<float>& a, const std::vector<float>& b, double meanA,
                  double meanB) {
    double sum = 0;
    double squares = 0;
    double varianceA = 0;
    double varianceB = 0;
    const auto n = static_cast<double>(a.size());
    for (size_t i = 0; i < a.size(); ++i) {
        const double da = static_cast<double>(a[i]) - meanA;
        const double db = static_cast<double>(b[i]) - meanB;
        const double difference =
            static_cast<double>(a[i]) * static_cast<double>(b[i]) - meanA * meanB;
        sum += difference;
        squares += difference * difference;
        varianceA += da * da / n;
        varianceB += db * db / n;
    }
    double covariance = 0;
    for (size_t i = 0; i < a.size(); ++i) {
        covariance += (static_cast<double>(a[i]) - meanA) * (static_cast<double>(b[i]) - meanB) / n;
    }
    return {sum / std::sqrt(squares), covariance / std::sqrt(varianceA * varianceB)};
}

struct Cloud {
    std::string vdb = fixtures::cloudFile(96);
    std::string sidecar = fixtures::path("independence.track.vdb");
    Cloud() { fixtures::bake(vdb, sidecar, 16); }

    /// At a scale where segmentsOf's whole ray has this optical depth.
    track::Volume open(double depth) const;
};

constexpr size_t kCount = fixtures::kSanitized ? 40000 : 400000;

std::vector<float> estimate(const track::Volume& volume, const TrkRay& ray, TrkMethod method,
                            uint64_t stream) {
    const std::vector<TrkRay> rays(kCount, ray);
    track::Query query(0, 0);
    query.method = method;
    query.stream = stream;
    std::vector<float> result(kCount);
    volume.estimateTransmittance(query, rays.data(), kCount, result.data());
    return result;
}

double exact(const track::Volume& volume, const TrkRay& ray) {
    track::Query query(0, 0);
    query.method = TRK_METHOD_EXACT;
    double depth = 0;
    volume.integrateOpticalDepth(query, &ray, 1, &depth);
    return std::exp(-depth);
}

/// A ray through the middle, cut in two.
struct Segments {
    TrkRay first;
    TrkRay second;
};
Segments segmentsOf(const track::Volume& volume) {
    const rays::Box box = rays::boundsOf(volume.info());
    TrkRay ray{};
    for (size_t a = 0; a < 3; ++a) {
        ray.origin[a] = static_cast<float>(0.5 * (box.lo[a] + box.hi[a]));
    }
    ray.origin[0] = static_cast<float>(box.lo[0]);
    ray.direction[0] = static_cast<float>(box.hi[0] - box.lo[0]);
    ray.direction[1] = 0.1f;
    Segments result{ray, ray};
    result.first.tMin = 0;
    result.first.tMax = result.second.tMin = 0.5f;
    result.second.tMax = 1;
    return result;
}

track::Volume Cloud::open(double depth) const {
    TrkVolumeOptions options = trkDefaultVolumeOptions();
    const track::Volume unscaled = track::Volume::open(vdb, sidecar.c_str(), options);
    TrkRay ray = segmentsOf(unscaled).first;
    ray.tMax = 1;
    options.scale = static_cast<float>(depth / -std::log(exact(unscaled, ray)));
    return track::Volume::open(vdb, sidecar.c_str(), options);
}

/// Estimates a of the first and b of the second, with different streams and with the same.
template <class First, class Second>
void expectIndependentByStream(const std::string& what, double meanA, double meanB,
                               const First& first, const Second& second) {
    const std::vector<float> a = first(uint64_t{1});
    const Product different = productOf(a, second(uint64_t{2}), meanA, meanB);
    const Product same = productOf(a, second(uint64_t{1}), meanA, meanB);
    std::printf("%s: other stream z %.2f, correlation %.4f; same stream z %.1f, correlation %.3f\n",
                what.c_str(), different.z, different.correlation, same.z, same.correlation);
    EXPECT_GT(meanA, 0.01);
    EXPECT_LT(meanA, 0.99);
    EXPECT_LT(std::fabs(different.z), 3.5) << what;
    EXPECT_LT(std::fabs(different.correlation), 4 / std::sqrt(double(kCount))) << what;
    EXPECT_GT(std::fabs(same.correlation), 7 / std::sqrt(double(kCount))) << what;
    if (!fixtures::kSanitized) {
        EXPECT_GT(std::fabs(same.z), 4) << what;
    }
}

const std::pair<const char*, TrkMethod> kRandom[] = {
    {"delta", TRK_METHOD_DELTA}, {"ratio", TRK_METHOD_RATIO}, {"residual", TRK_METHOD_RESIDUAL}};

TEST(Independence, OfTwoVolumesWithOneSeedAndTheSameRays) {
    const Cloud cloud;
    const track::Volume a = cloud.open(1);
    const track::Volume b = cloud.open(1.5);  // as if it were another
    TrkRay ray = segmentsOf(a).first;
    ray.tMax = 1;
    for (const auto& [name, method] : kRandom) {
        const TrkMethod m = method;
        expectIndependentByStream(
            std::string("volumes, ") + name, exact(a, ray), exact(b, ray),
            [&](uint64_t stream) { return estimate(a, ray, m, stream); },
            [&](uint64_t stream) { return estimate(b, ray, m, stream); });
    }
}

TEST(Independence, OfTwoSegmentsOfOnePath) {
    const Cloud cloud;
    const track::Volume volume = cloud.open(2);
    const Segments s = segmentsOf(volume);
    for (const auto& [name, method] : kRandom) {
        const TrkMethod m = method;
        expectIndependentByStream(
            std::string("segments, ") + name, exact(volume, s.first), exact(volume, s.second),
            [&](uint64_t stream) { return estimate(volume, s.first, m, stream); },
            [&](uint64_t stream) { return estimate(volume, s.second, m, stream); });
    }
}

TEST(Independence, OfFreePathsAndTransmittanceEvenInOneStream) {
    const Cloud cloud;
    const track::Volume volume = cloud.open(1);
    TrkRay ray = segmentsOf(volume).first;
    ray.tMax = 1;
    const auto escapes = [&](uint64_t stream) {
        const std::vector<TrkRay> rays(kCount, ray);
        track::Query query(0, 0);
        query.method = TRK_METHOD_DELTA;
        query.stream = stream;
        track::FreePaths paths(kCount, 1);
        volume.sampleFreePath(query, rays.data(), kCount, paths.view());
        std::vector<float> result(kCount);
        for (size_t i = 0; i < kCount; ++i) {
            result[i] = std::isinf(paths.t[i]) ? 1.0f : 0.0f;
        }
        return result;
    };
    const double T = exact(volume, ray);
    const Product found = productOf(escapes(1), estimate(volume, ray, TRK_METHOD_DELTA, 1), T, T);
    std::printf("free path and transmittance, same stream: z %.2f\n", found.z);
    EXPECT_LT(std::fabs(found.z), 3.5);
    // And of itself, which is no news, the test would say no.
    const std::vector<float> once = escapes(1);
    EXPECT_GT(productOf(once, once, T, T).z, 10);
}

// Volumes that overlap: the nearest of their paths is a path of all together, its weight the
// product of theirs.
TEST(Independence, TheNearestOfFreePathsIsOneOfBothVolumes) {
    const std::string vdb = fixtures::cloudFile(64, "color-cloud");
    const std::string sidecar = fixtures::path("overlap.track.vdb");
    fixtures::bake(vdb, sidecar, 16);
    TrkVolumeOptions options = trkDefaultVolumeOptions();
    options.scale = 0.5f;
    const track::Volume first = track::Volume::open(vdb, sidecar.c_str(), options);
    options.scale = 0.8f;
    options.color[2] = 0.2f;
    const track::Volume second = track::Volume::open(vdb, sidecar.c_str(), options);
    const TrkVolumeInfo info = first.info();
    TrkRay ray{{}, 0, {1, 0.3f, 0.2f}, rays::kInfinity};
    for (int a = 0; a < 3; ++a) {
        ray.origin[a] = static_cast<float>(0.5 * (info.boundsMin[a] + info.boundsMax[a]));
    }
    const std::vector<TrkRay> rays(kCount, ray);
    track::FreePaths a(kCount, 3);
    track::FreePaths b(kCount, 3);
    first.sampleFreePath({0, 1}, rays.data(), kCount, a.view());
    second.sampleFreePath({0, 2}, rays.data(), kCount, b.view());
    const float middle = 0.5f * static_cast<float>(info.boundsMax[0] - info.boundsMin[0]) * 0.3f;
    TrkRay half = ray;
    half.tMax = middle;
    track::Query query(0, 0);
    query.method = TRK_METHOD_EXACT;
    float Ta[3];
    float Tb[3];
    first.estimateTransmittance(query, &half, 1, Ta);
    second.estimateTransmittance(query, &half, 1, Tb);
    for (size_t c = 0; c < 3; ++c) {
        double sum = 0;
        double squares = 0;
        double ofOneStream = 0;
        for (size_t i = 0; i < kCount; ++i) {
            const double weight =
                static_cast<double>(a.weight[3 * i + c]) * static_cast<double>(b.weight[3 * i + c]);
            const double x = std::min(a.t[i], b.t[i]) > middle ? weight : 0.0;
            sum += x;
            squares += x * x;
            ofOneStream += a.t[i] > middle ? std::pow(static_cast<double>(a.weight[3 * i + c]), 2)
                                           : 0.0;  // two volumes alike, one stream
        }
        const auto n = static_cast<double>(kCount);
        const double expected = static_cast<double>(Ta[c]) * static_cast<double>(Tb[c]);
        const double error = std::sqrt((squares / n - sum / n * sum / n) / n);
        EXPECT_LT(std::fabs(sum / n - expected), 4 * error) << c;
        EXPECT_GT(std::fabs(ofOneStream / n - static_cast<double>(Ta[c]) * Ta[c]), 8 * error) << c;
    }
}

}  // namespace
