// SPDX-License-Identifier: Apache-2.0
// That the library leaves its host alone, and the host the library: cancelled task groups, structs
// of other versions, identities of random numbers.
#include "track/track.hpp"

#include "support/fixtures.h"
#include "support/rays.h"

#include <gtest/gtest.h>
#include <immintrin.h>
#include <tbb/parallel_for.h>
#include <tbb/task_group.h>

#include <cstddef>
#include <cstring>
#include <string>
#include <vector>

namespace {

struct Files {
    std::string vdb = fixtures::cloudFile(64);
    std::string sidecar = fixtures::path("host.track.vdb");
    Files() { fixtures::bake(vdb, sidecar, 8); }
};

track::Volume openCloud(float scale = 3) {
    static const Files files;
    TrkVolumeOptions options = trkDefaultVolumeOptions();
    options.scale = scale;
    return track::Volume::open(files.vdb, files.sidecar.c_str(), options);
}

/// Calls body() in a task group that is cancelled already.
template <class Body>
void inCancelledGroup(const Body& body) {
    tbb::task_group_context context;
    tbb::parallel_for(
        0, 1,
        [&](int) {
            context.cancel_group_execution();
            body();
        },
        context);
}

TEST(Host, ACancelledTaskGroupDoesNotEndABatch) {
    const track::Volume volume = openCloud();
    const std::vector<TrkRay> all = rays::through(rays::boundsOf(volume.info()), 3000, 20, 1);
    const track::Query query(0, 0);
    std::vector<float> expected(all.size());
    volume.estimateTransmittance(query, all.data(), all.size(), expected.data());
    for (int i = 0; i < 200; ++i) {
        std::vector<float> found(all.size(), -7);
        std::vector<float> t(all.size(), -7);
        TrkFreePaths paths = trkDefaultFreePaths();
        paths.t = t.data();
        inCancelledGroup([&] {
            volume.estimateTransmittance(query, all.data(), all.size(), found.data());
            volume.sampleFreePath(query, all.data(), all.size(), paths);
        });
        ASSERT_EQ(found, expected);
        ASSERT_EQ(std::count(t.begin(), t.end(), -7.0f), 0);
    }
}

/// What an opened volume answers: by its density, its super-voxels, and its control.
std::vector<float> answers(const track::Volume& volume) {
    std::vector<float> result;
    for (const TrkMethod method : {TRK_METHOD_EXACT, TRK_METHOD_RESIDUAL, TRK_METHOD_CONTROL}) {
        const std::vector<TrkRay> all = rays::through(rays::boundsOf(volume.info()), 700, 20, 1);
        track::Query query(0, 0);
        query.method = method;
        std::vector<float> found(all.size(), -7);
        volume.estimateTransmittance(query, all.data(), all.size(), found.data());
        result.insert(result.end(), found.begin(), found.end());
    }
    return result;
}

// Of the sidecar too, whose grids OpenVDB's own loops go over.
TEST(Host, ACancelledTaskGroupDoesNotChangeWhatIsOpened) {
    const std::vector<float> expected = answers(openCloud());
    for (int i = 0; i < (fixtures::kSanitized ? 20 : 200); ++i) {
        std::vector<float> found;
        std::string error;
        inCancelledGroup([&] {
            try {
                found = answers(openCloud());
            } catch (const track::Error& e) {
                error = e.what();
            }
        });
        ASSERT_EQ(error, "");
        ASSERT_EQ(found, expected);
    }
}

/// A struct of a newer header.
template <class Struct>
struct Newer {
    Struct known;
    uint64_t later = 0;

    explicit Newer(const Struct& s) : known(s) { known.size = sizeof(*this); }
};

template <class Call>
void expectCompleted(const char* name, const Call& call) {
    call(0, TRK_OK);
    call(1, TRK_ERROR_INVALID_ARGUMENT);
    EXPECT_NE(std::string(trkGetLastErrorMessage()).find(name), std::string::npos)
        << trkGetLastErrorMessage();
}

TEST(Host, StructsOfNewerHeadersAreTakenWhereTheRestIsZero) {
    const track::Volume volume = openCloud();
    const TrkRay ray = rays::through(rays::boundsOf(volume.info()), 1, 20, 1)[0];
    expectCompleted("TrkQuery", [&](uint64_t later, TrkStatus expected) {
        Newer<TrkQuery> query(trkDefaultQuery());
        query.later = later;
        float out = -7;
        EXPECT_EQ(trkEstimateTransmittance(volume.handle(), &query.known, &ray, 1, &out, nullptr),
                  expected);
        EXPECT_EQ(out == -7, expected != TRK_OK);
    });
    expectCompleted("TrkStatistics", [&](uint64_t later, TrkStatus expected) {
        Newer<TrkStatistics> statistics(trkDefaultStatistics());
        statistics.later = later;
        float out = -7;
        EXPECT_EQ(
            trkEstimateTransmittance(volume.handle(), nullptr, &ray, 1, &out, &statistics.known),
            expected);
    });
    expectCompleted("TrkFreePaths", [&](uint64_t later, TrkStatus expected) {
        float t = 0;
        Newer<TrkFreePaths> paths(trkDefaultFreePaths());
        paths.known.t = &t;
        paths.later = later;
        EXPECT_EQ(trkSampleFreePath(volume.handle(), nullptr, &ray, 1, &paths.known), expected);
    });
    expectCompleted("TrkVolumeOptions", [&](uint64_t later, TrkStatus expected) {
        Newer<TrkVolumeOptions> options(trkDefaultVolumeOptions());
        options.later = later;
        TrkVolume* opened = nullptr;
        EXPECT_EQ(trkOpenVolume(fixtures::cloudFile(64).c_str(), "", &options.known, &opened),
                  expected);
        trkCloseVolume(opened);
    });
    Newer<TrkVolumeInfo> info{TrkVolumeInfo{}};
    info.later = 42;
    EXPECT_EQ(trkGetVolumeInfo(volume.handle(), &info.known), TRK_OK);
    EXPECT_EQ(info.later, 0u);
    EXPECT_EQ(info.known.superVoxelSize, 8u);
    EXPECT_EQ(info.known.size, sizeof(info));
}

TEST(Host, TheHeaderHasTheVersionOfTheLibrary) {
    EXPECT_EQ(std::to_string(TRK_VERSION_MAJOR) + "." + std::to_string(TRK_VERSION_MINOR) + "." +
                  std::to_string(TRK_VERSION_PATCH),
              trkGetVersion());
}

// Padding would hold what happened to lie there, and a field of a later release could fall into it.
TEST(Host, StructsAreFullOfFields) {
    EXPECT_EQ(sizeof(TrkVolumeOptions), offsetof(TrkVolumeOptions, reserved) + sizeof(uint32_t));
    EXPECT_EQ(sizeof(TrkBakeOptions), offsetof(TrkBakeOptions, progressData) + sizeof(void*));
    EXPECT_EQ(sizeof(TrkDensity), offsetof(TrkDensity, tileActive) + sizeof(void*));
    EXPECT_EQ(sizeof(TrkQuery), offsetof(TrkQuery, resultStride) + sizeof(size_t));
    EXPECT_EQ(offsetof(TrkQuery, seed), offsetof(TrkQuery, threads) + sizeof(int32_t));
    EXPECT_EQ(sizeof(TrkVolumeInfo), offsetof(TrkVolumeInfo, kernel) + sizeof(const char*));
    TrkVolumeOptions options = trkDefaultVolumeOptions();
    options.noBake = 2;
    TrkVolume* volume = nullptr;
    EXPECT_EQ(trkOpenVolume("x.vdb", "", &options, &volume), TRK_ERROR_INVALID_ARGUMENT);
}

TEST(Host, AVolumeHasSuperVoxelsOfTheSizeThatIsAskedFor) {
    const std::string vdb = fixtures::cloudFile(64);
    const std::string sidecar = fixtures::path("host_size.track.vdb");
    fixtures::bake(vdb, sidecar, 8);
    TrkVolumeOptions options = trkDefaultVolumeOptions();
    EXPECT_EQ(track::Volume::open(vdb, sidecar.c_str(), options).info().superVoxelSize, 8u);
    options.superVoxelSize = 32;
    EXPECT_EQ(track::Volume::open(vdb, sidecar.c_str(), options).info().superVoxelSize, 32u);
    EXPECT_EQ(track::Volume::open(vdb, "", options).info().superVoxelSize, 32u);
    EXPECT_EQ(track::Volume::open("", sidecar.c_str(), options).info().superVoxelSize, 32u);
    TrkVolume* volume = nullptr;
    for (const uint32_t size : {1u, 4u, 12u, 128u}) {
        options.superVoxelSize = size;
        EXPECT_EQ(trkOpenVolume(vdb.c_str(), sidecar.c_str(), &options, &volume),
                  TRK_ERROR_INVALID_ARGUMENT)
            << size;
        EXPECT_NE(std::string(trkGetLastErrorMessage()).find("expected"), std::string::npos);
    }
    options.superVoxelSize = 0;
    options.reserved = 1;
    EXPECT_EQ(trkOpenVolume(vdb.c_str(), sidecar.c_str(), &options, &volume),
              TRK_ERROR_INVALID_ARGUMENT);
}

TEST(Host, AVolumeRunsTheKernelThatIsAskedFor) {
    const std::string vdb = fixtures::cloudFile(64);
    TrkVolumeOptions options = trkDefaultVolumeOptions();
    options.kernel = "baseline";
    const track::Volume baseline = track::Volume::open(vdb, nullptr, options);
    EXPECT_STREQ(baseline.info().kernel, "baseline");
    options.kernel = nullptr;
    const track::Volume best = track::Volume::open(vdb, nullptr, options);
    options.kernel = best.info().kernel;
    EXPECT_STREQ(track::Volume::open(vdb, nullptr, options).info().kernel, best.info().kernel);
    options.kernel = "AVX2";
    TrkVolume* volume = nullptr;
    EXPECT_EQ(trkOpenVolume(vdb.c_str(), nullptr, &options, &volume), TRK_ERROR_INVALID_ARGUMENT);
    EXPECT_NE(std::string(trkGetLastErrorMessage()).find("kernel is \"AVX2\"; expected"),
              std::string::npos);
}

TEST(Host, StructsTooSmallToBeAnyAreRefused) {
    const track::Volume volume = openCloud();
    TrkVolumeInfo info = {};
    for (const size_t size : {size_t{0}, size_t{8}, sizeof(info) - 8, size_t{1} << 40}) {
        info.size = size;
        EXPECT_EQ(trkGetVolumeInfo(volume.handle(), &info), TRK_ERROR_INVALID_ARGUMENT);
        EXPECT_NE(std::string(trkGetLastErrorMessage()).find("TrkVolumeInfo.size"),
                  std::string::npos);
        EXPECT_EQ(info.boundsMax[0], 0);
    }
    TrkQuery query = trkDefaultQuery();
    const TrkRay ray{{0, 0, 0}, 0, {1, 0, 0}, 1};
    float out = -7;
    for (const size_t size : {size_t{0}, size_t{8}, sizeof(query) - 8, size_t{1} << 40}) {
        query.size = size;
        EXPECT_EQ(trkEstimateTransmittance(volume.handle(), &query, &ray, 1, &out, nullptr),
                  TRK_ERROR_INVALID_ARGUMENT);
        EXPECT_EQ(out, -7);
    }
}

TEST(Host, AQueryOfNullIsTheDefaultOfItsFunction) {
    const track::Volume volume = openCloud();
    const TrkRay ray = rays::through(rays::boundsOf(volume.info()), 1, 20, 3)[0];
    track::Query query(0, 0);
    float expected = -1;
    float found = -2;
    volume.estimateTransmittance(query, &ray, 1, &expected);
    EXPECT_EQ(trkEstimateTransmittance(volume.handle(), nullptr, &ray, 1, &found, nullptr), TRK_OK);
    EXPECT_EQ(found, expected);
    query.method = TRK_METHOD_EXACT;
    double expectedDepth = -1;
    double foundDepth = -2;
    volume.integrateOpticalDepth(query, &ray, 1, &expectedDepth);
    EXPECT_EQ(trkIntegrateOpticalDepth(volume.handle(), nullptr, &ray, 1, &foundDepth), TRK_OK);
    EXPECT_EQ(foundDepth, expectedDepth);
}

TEST(Host, ErrorsNameConstantsOfTheLibraryAndThePathThatIsMissing) {
    TrkVolume* volume = nullptr;
    const auto failing = [&](const char* vdb, const char* sidecar) {
        EXPECT_EQ(trkOpenVolume(vdb, sidecar, nullptr, &volume), TRK_ERROR_INVALID_ARGUMENT);
        return std::string(trkGetLastErrorMessage());
    };
    EXPECT_NE(failing("", nullptr).find("vdbPath is empty"), std::string::npos);
    EXPECT_NE(failing(nullptr, nullptr).find("vdbPath is NULL"), std::string::npos);
    EXPECT_NE(failing(nullptr, "").find("sidecarPath"), std::string::npos);

    auto grid = fixtures::makeBlob(8);
    grid->tree().setValueOn(openvdb::Coord(1, 2, 3), -1.0f);
    const std::string vdb = fixtures::write("negative.vdb", {grid});
    EXPECT_EQ(trkOpenVolume(vdb.c_str(), "", nullptr, &volume), TRK_ERROR_BAD_DENSITY);
    const std::string line = trkGetLastErrorMessage();
    EXPECT_NE(line.find("TRK_REPAIR_CLAMP_NEGATIVE"), std::string::npos) << line;
    EXPECT_EQ(line.find("--"), std::string::npos) << line;
}

TEST(Host, ResultsAndStatisticsMayBeStrided) {
    struct Pixel {
        double depth;
        float transmittance;
        float standardError;
        uint64_t lookups;
        uint64_t superVoxels;
        float exactShare;
        float other;
    };
    const track::Volume volume = openCloud();
    const std::vector<TrkRay> all = rays::through(rays::boundsOf(volume.info()), 50, 20, 1);
    track::Query query(0, 0);
    query.samples = 4;
    std::vector<float> dense(all.size());
    track::Statistics statistics(all.size(), 1);
    volume.estimateTransmittance(query, all.data(), all.size(), dense.data(), statistics.view());
    std::vector<Pixel> pixels(all.size(), {0, 0, 0, 0, 0, 0, 42});
    query.resultStride = sizeof(Pixel);
    TrkStatistics view = trkDefaultStatistics();
    view.standardError = &pixels[0].standardError;
    view.lookups = &pixels[0].lookups;
    view.superVoxels = &pixels[0].superVoxels;
    view.exactShare = &pixels[0].exactShare;
    view.standardErrorStride = view.lookupsStride = view.superVoxelsStride = view.exactShareStride =
        sizeof(Pixel);
    volume.estimateTransmittance(query, all.data(), all.size(), &pixels[0].transmittance, view);
    query.method = TRK_METHOD_EXACT;
    volume.integrateOpticalDepth(query, all.data(), all.size(), &pixels[0].depth);
    query.resultStride = 0;
    std::vector<double> depth(all.size());
    volume.integrateOpticalDepth(query, all.data(), all.size(), depth.data());
    for (size_t i = 0; i < all.size(); ++i) {
        EXPECT_EQ(pixels[i].transmittance, dense[i]);
        EXPECT_EQ(std::memcmp(&pixels[i].standardError, &statistics.standardError[i], 4), 0);
        EXPECT_EQ(pixels[i].lookups, statistics.lookups[i]);
        EXPECT_EQ(pixels[i].superVoxels, statistics.superVoxels[i]);
        EXPECT_EQ(pixels[i].exactShare, statistics.exactShare[i]);
        EXPECT_EQ(pixels[i].depth, depth[i]);
        EXPECT_EQ(pixels[i].other, 42);
    }
    query.resultStride = 6;
    EXPECT_EQ(
        trkEstimateTransmittance(volume.handle(), &query, all.data(), 1, dense.data(), nullptr),
        TRK_ERROR_INVALID_ARGUMENT);
}

// A host may flush denormals: no estimate becomes certain by that.
TEST(Host, NoErrorIsFlushedToZero) {
    const track::Volume volume = openCloud(30);
    const std::vector<TrkRay> all = rays::through(rays::boundsOf(volume.info()), 3000, 20, 1);
    track::Query exact(0, 0);
    exact.method = TRK_METHOD_EXACT;
    std::vector<float> expected(all.size());
    volume.estimateTransmittance(exact, all.data(), all.size(), expected.data());
    track::Query query(0, 0);
    query.method = TRK_METHOD_RATIO;
    query.samples = 16;
    query.flags = 0;
    query.threads = 1;
    std::vector<float> found(all.size());
    track::Statistics statistics(all.size(), 1);
    const unsigned mode = _mm_getcsr();
    _mm_setcsr(mode | 0x8040);  // flush to zero, denormals are zero
    volume.estimateTransmittance(query, all.data(), all.size(), found.data(), statistics.view());
    _mm_setcsr(mode);
    size_t tiny = 0;
    for (size_t i = 0; i < all.size(); ++i) {
        EXPECT_FALSE(statistics.standardError[i] == 0 && found[i] == 0 && expected[i] > 0) << i;
        tiny += expected[i] > 0 && expected[i] < 1e-30f ? 1 : 0;
    }
    EXPECT_GT(tiny, 10u);
}

// What the README shows: samples of a pixel, and pixels, have numbers of their own.
TEST(Host, CallsOfOneIdRepeatAndOfOthersDoNot) {
    const track::Volume volume = openCloud(0.5f);
    const TrkVolumeInfo info = volume.info();
    TrkRay ray{{}, 0, {1, 0.1f, 0.2f}, rays::kInfinity};  // from the middle
    for (int a = 0; a < 3; ++a) {
        ray.origin[a] = static_cast<float>(0.5 * (info.boundsMin[a] + info.boundsMax[a]));
    }
    const auto estimate = [&](uint64_t id, uint64_t stream) {
        track::Query query(id, stream);
        query.method = TRK_METHOD_RATIO;
        float out = 0;
        volume.estimateTransmittance(query, &ray, 1, &out);
        return out;
    };
    EXPECT_EQ(estimate(7, 1), estimate(7, 1));
    size_t repeated = 0;
    for (uint64_t i = 0; i < 100; ++i) {
        repeated += estimate(i, 0) == estimate(i + 1, 0) ? 1 : 0;
        repeated += estimate(7, i) == estimate(7, i + 1) ? 1 : 0;
    }
    EXPECT_LT(repeated, 100u);
}

}  // namespace
