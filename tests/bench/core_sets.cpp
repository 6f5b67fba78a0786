// SPDX-License-Identifier: Apache-2.0
#include "core_sets.h"

#include "make/procedural.h"
#include "support/fixtures.h"

#include <openvdb/tools/Dense.h>

#include <array>
#include <cmath>
#include <cstdint>
#include <filesystem>
#include <functional>
#include <random>
#include <utility>

/// A volume of `voxels` along an edge, from FOLDER or made into it.
openvdb::FloatGrid::Ptr procedural(const std::string& folder, const std::string& kind, int voxels) {
    const std::string path = folder + "/" + kind + std::to_string(voxels) + ".vdb";
    if (!std::filesystem::exists(path)) {
        vdbtools::ProceduralOptions options;
        options.kind = kind;
        options.voxels = voxels;
        trk::OutputFile file(path, false);
        vdbtools::writeProcedural(options, file, [](double) {});
        file.commit();
    }
    openvdb::io::File file(path);
    file.open(/*delayLoad=*/false);
    return openvdb::gridPtrCast<openvdb::FloatGrid>(file.readGrid("density"));
}

/// Fields that are hard on estimators, of 96^3 voxels.
openvdb::FloatGrid::Ptr adversarial(const std::string& name) {
    constexpr int kEdge = 96;
    const openvdb::CoordBBox box(0, 0, 0, kEdge - 1, kEdge - 1, kEdge - 1);
    if (name == "filaments") {
        openvdb::FloatGrid::Ptr grid = fixtures::makeGrid(box, [](const auto&) { return 0.0f; });
        std::mt19937_64 random(1);
        std::uniform_real_distribution<double> unit(0, kEdge);
        openvdb::FloatGrid::Accessor voxels = grid->getAccessor();
        for (int line = 0; line < 60; ++line) {
            const openvdb::Vec3d from(unit(random), unit(random), unit(random));
            const openvdb::Vec3d to(unit(random), unit(random), unit(random));
            for (int i = 0; i < 4 * kEdge; ++i) {
                const openvdb::Vec3d p = from + (to - from) * (i / (4.0 * kEdge));
                voxels.setValue(openvdb::Coord::floor(p), 1000.0f);
            }
        }
        return grid;
    }
    return fixtures::makeGrid(box, [&](const openvdb::Coord& p) {
        const openvdb::Vec3d fromCentre = p.asVec3d() - openvdb::Vec3d(0.5 * kEdge);
        if (name == "shells") {
            return std::fmod(fromCentre.length(), 12) < 1.5 && fromCentre.length() < 46 ? 100.0f
                                                                                        : 0.0f;
        }
        if (name == "pinholes") {  // along z
            return p.x() % 8 == 4 && p.y() % 8 == 4 ? 0.0f : 10.0f;
        }
        if (name == "slabs") {  // beside rays along z
            return p.x() / 2 % 2 == 0 ? 10.0f : 0.0f;
        }
        if (name == "checkerboard") {
            return (p.x() + p.y() + p.z()) % 2 == 0 ? 1e4f : 0.0f;
        }
        return p == openvdb::Coord(kEdge / 2) ? 1e6f : 0.0f;  // a voxel in nothing
    });
}

/// The same density in three channels, each a little less.
openvdb::Vec3SGrid::Ptr threeChannels(const openvdb::FloatGrid& grey) {
    openvdb::Vec3SGrid::Ptr grid = openvdb::Vec3SGrid::create();
    grid->setTree(std::make_shared<openvdb::Vec3STree>(grey.tree(), openvdb::Vec3f(0),
                                                       openvdb::TopologyCopy()));
    grid->setTransform(grey.transform().copy());
    grid->setName("density");
    auto from = grey.tree().cbeginLeaf();
    for (auto leaf = grid->tree().beginLeaf(); leaf; ++leaf, ++from) {
        for (openvdb::Index i = 0; i < 512; ++i) {
            const float value = from->getValue(i);
            leaf->setValueOnly(i, openvdb::Vec3f(value, 0.9f * value, 0.8f * value));
        }
    }
    return grid;
}

std::vector<TrkRay> cameraRays(const rays::Box& box) {
    constexpr int kSide = 160;
    std::vector<TrkRay> result;
    for (int y = 0; y < kSide; ++y) {
        for (int x = 0; x < kSide; ++x) {
            TrkRay ray{};
            const double at[3] = {(x + 0.5) / kSide, (y + 0.5) / kSide, 0.5};
            for (size_t a = 0; a < 3; ++a) {
                const double edge = box.hi[a] - box.lo[a];
                const double centre = 0.5 * (box.lo[a] + box.hi[a]);
                const double eye = centre + (a == 1 ? 1.2 : 2.0) * edge;
                ray.origin[a] = static_cast<float>(eye);
                ray.direction[a] = static_cast<float>(box.lo[a] + at[a] * edge - eye);
            }
            ray.tMax = rays::kInfinity;
            result.push_back(ray);
        }
    }
    return result;
}

/// From points of the density in any direction, as a path tracer's shadow rays.
std::vector<TrkRay> secondaryRays(const track::Volume& volume, const rays::Box& box) {
    std::mt19937_64 random(1);
    std::uniform_real_distribution<double> unit(0, 1);
    std::vector<TrkRay> result;
    while (result.size() < kRays) {
        TrkRay ray{};
        const auto direction = rays::unitVector(random);
        for (size_t a = 0; a < 3; ++a) {
            ray.origin[a] = static_cast<float>(box.lo[a] + unit(random) * (box.hi[a] - box.lo[a]));
            ray.direction[a] = static_cast<float>(direction[a]);
        }
        ray.tMax = rays::kInfinity;
        float extinction = 0;
        volume.sampleExtinction(ray.origin, 1, &extinction);
        if (extinction > 0) {
            result.push_back(ray);
        }
    }
    return result;
}

/// Along z, from outside, through random points.
std::vector<TrkRay> parallelRays(const rays::Box& box) {
    std::vector<TrkRay> result = rays::through(box, kRays, 0, 1);
    for (TrkRay& ray : result) {
        ray.origin[2] = static_cast<float>(box.lo[2] - 1);
        ray.direction[0] = ray.direction[1] = 0;
        ray.direction[2] = 1;
    }
    return result;
}

Set::Set(std::string named, const Field& of, const std::vector<TrkRay>& from, double meanDepth)
    : name(std::move(named)), field(of) {
    const track::Volume volume = field.open(1);
    std::vector<double> depths(from.size());
    track::Query query(0, 0);
    query.method = TRK_METHOD_EXACT;
    query.threads = 1;
    volume.integrateOpticalDepth(query, from.data(), from.size(), depths.data());
    double sum = 0;
    std::vector<double> kept;
    for (size_t i = 0; i < from.size() && rays.size() < kRays; ++i) {
        if (depths[i] > 0) {
            rays.push_back(from[i]);
            kept.push_back(depths[i]);
            sum += depths[i];
        }
    }
    scale = static_cast<float>(meanDepth * static_cast<double>(rays.size()) / sum);
    for (const double depth : kept) {
        exact.push_back(std::exp(-static_cast<double>(scale) * depth));
    }
}
