// SPDX-License-Identifier: Apache-2.0
// Densities too large for memory: baked and verified a page at a time, to the same bits.
#include "bake/bake.h"
#include "bake/verify.h"
#include "bake/write_bake.h"
#include "failure.h"
#include "field/table_builder.h"
#include "io/density.h"
#include "io/sidecar.h"

#include "support/fixtures.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cstring>
#include <filesystem>
#include <tuple>
#include <vector>

namespace {

using openvdb::Coord;
using trk::BakedVolume;
using trk::ControlKind;

/// Leaves and tiles of every size, some beside one another, some far away.
std::string tiledFile() {
    auto grid = fixtures::makeBlob(45);
    grid->tree().addTile(1, Coord(16, 16, 16), 0.5f, true);
    grid->tree().addTile(1, Coord(48, 16, 16), 0.5f, true);
    grid->tree().addTile(2, Coord(-128, 0, 0), 0.1f, true);
    grid->tree().addTile(2, Coord(8192, 0, 0), 0.3f, true);
    grid->tree().setValue(Coord(100000, -100000, 7), 2.0f);
    for (int i = 0; i < 4; ++i) {  // leaves of one value, and one that only begins so
        grid->fill(openvdb::CoordBBox(Coord(200, 8 * i, 0), Coord(207, 8 * i + 7, 7)), 0.25f, true);
    }
    grid->tree().setValue(Coord(207, 31, 7), 0.5f);
    return fixtures::write("paged-tiled.vdb", {grid});
}

trk::Density loadPaged(const std::string& vdb, uint64_t pageBytes) {
    trk::DensityOptions options;
    options.bricks = trk::Bricks::kLoader;
    trk::Density density = trk::loadDensity(vdb, options);
    density.pageBytes = pageBytes;
    return density;
}

/// Hands on to another loader, and counts.
class CountingLoader : public trk::BrickLoader {
  public:
    explicit CountingLoader(trk::BrickLoader& loader) : loader_(loader) {}
    size_t bytes() const override { return loader_.bytes(); }
    std::vector<Entry> bricks() const override { return loader_.bricks(); }
    void begin() override { loader_.begin(); }
    void want(Entry brick) override { loader_.want(brick); }
    size_t slots() const override { return loader_.slots(); }
    size_t slotOf(Entry brick) const override { return loader_.slotOf(brick); }
    void load(trk::RawArray<float>& page) override {
        ++pages;
        largest = std::max(largest, slots());
        all += slots();
        loader_.load(page);
    }

    size_t pages = 0;
    size_t largest = 0;  ///< in slots
    size_t all = 0;

  private:
    trk::BrickLoader& loader_;
};

using Item = std::tuple<trk::Int3, int, trk::SparseTable::Entry>;
std::vector<Item> itemsOf(const trk::SparseTable& table) {
    std::vector<Item> items;
    table.forEach([&](const trk::Int3& lo, int shift, trk::SparseTable::Entry entry) {
        items.emplace_back(lo, shift, entry);
    });
    return items;
}

void expectSameBits(const BakedVolume& a, const BakedVolume& b) {
    EXPECT_EQ(itemsOf(a.table), itemsOf(b.table));
    ASSERT_EQ(a.items.size(), b.items.size());
    EXPECT_EQ(std::memcmp(a.items.data(), b.items.data(), a.items.size() * sizeof(a.items[0])), 0);
    EXPECT_EQ(a.shapes, b.shapes);
    EXPECT_EQ(a.gradients, b.gradients);
    ASSERT_EQ(a.levels.size(), b.levels.size());
    for (size_t i = 0; i < a.levels.size(); ++i) {
        EXPECT_EQ(itemsOf(a.levels[i].table), itemsOf(b.levels[i].table));
        EXPECT_EQ(a.levels[i].values, b.levels[i].values);
    }
    EXPECT_EQ(a.previewSize, b.previewSize);
    EXPECT_EQ(itemsOf(a.preview.table).size(), itemsOf(b.preview.table).size());
    EXPECT_EQ(a.preview.values, b.preview.values);
}

TEST(PagedBake, HasTheBitsOfOneInMemory) {
    size_t pictures = 0;
    for (const std::string& vdb :
         {tiledFile(), fixtures::cloudFile(96), fixtures::cloudFile(64, "color-cloud")}) {
        const trk::Density resident = fixtures::load(vdb);
        const trk::Density paged = loadPaged(vdb, 0);
        EXPECT_EQ(paged.summary.digest, resident.summary.digest);
        EXPECT_EQ(paged.summary.anchor, resident.summary.anchor);
        EXPECT_EQ(paged.summary.min, resident.summary.min);
        EXPECT_EQ(paged.summary.max, resident.summary.max);
        EXPECT_EQ(paged.summary.gridBytes, resident.summary.gridBytes);
        const size_t bricks = paged.loader->bricks().size();
        EXPECT_EQ(bricks, resident.field.brickCount());
        const uint64_t brickBytes = 729 * sizeof(float) * resident.field.channels();
        for (const int size : {4, 16, 64}) {
            for (const ControlKind kind :
                 {ControlKind::kConstant, ControlKind::kAffine, ControlKind::kTrilinear}) {
                trk::BakeOptions options = fixtures::bakeOptions(size, 3, kind);
                options.sidecarBytes = 1000000;  // so that there are pictures
                CountingLoader loader(*paged.loader);
                constexpr size_t kPage = 100;
                const BakedVolume expected = trk::bake(resident.field, options);
                expectSameBits(trk::bake({paged.field, loader, kPage * brickBytes}, options),
                               expected);
                pictures += expected.previewSize > 0 ? 1 : 0;
                // What the last super-voxel of a page needs comes on top.
                const auto edge = static_cast<size_t>(std::max(1, size / 8));
                EXPECT_LT(loader.largest,
                          kPage + edge * edge * edge + (edge + 1) * (edge + 1) * (edge + 1));
                EXPECT_GE(loader.pages, 2u);
                EXPECT_EQ(
                    trk::sidecarHeader(paged.summary, {paged.field, loader, kPage * brickBytes},
                                       expected)
                        .previewScale,
                    trk::sidecarHeader(resident.summary, resident.field, expected).previewScale);
            }
        }
    }
    EXPECT_GT(pictures, 4u);
}

// The halo of a page is its surface.
TEST(PagedBake, ReadsLittleTwice) {
    const trk::Density paged = loadPaged(fixtures::cloudFile(128), 0);
    CountingLoader loader(*paged.loader);
    const size_t bricks = loader.bricks().size();
    trk::bake({paged.field, loader, bricks / 4 * 729 * sizeof(float)},
              fixtures::bakeOptions(16, 0));
    EXPECT_GE(loader.pages, 4u);
    EXPECT_LT(loader.all, 2 * bricks);
}

TEST(PagedBake, RepairsAsTheOneInMemory) {
    auto grid = fixtures::makeBlob(40);
    grid->tree().setValue(Coord(0, 0, 0), -1.0f);
    grid->tree().setValue(Coord(3, 5, 7), std::numeric_limits<float>::infinity());
    const std::string vdb = fixtures::write("paged-repaired.vdb", {grid});
    trk::DensityOptions options;
    options.repair = TRK_REPAIR_CLAMP_NEGATIVE | TRK_REPAIR_DROP_NONFINITE;
    const trk::Density resident = trk::loadDensity(vdb, options);
    options.bricks = trk::Bricks::kLoader;
    const trk::Density paged = trk::loadDensity(vdb, options);
    EXPECT_EQ(paged.summary.clamped, 1u);
    EXPECT_EQ(paged.summary.dropped, 1u);
    expectSameBits(trk::bake(paged.pages(), fixtures::bakeOptions(8, 1)),
                   trk::bake(resident.field, fixtures::bakeOptions(8, 1)));
    options.repair = 0;
    EXPECT_THROW(trk::loadDensity(vdb, options), trk::Error);
}

TEST(PagedBake, IsChosenWhereBricksMayNotFit) {
    const std::string vdb = fixtures::cloudFile(96);
    trk::DensityOptions options;
    options.bricks = trk::Bricks::kAllThatFit;
    EXPECT_FALSE(trk::loadDensity(vdb, options).loader);
    const uint64_t bytes = fixtures::load(vdb).field.bytes();
    options.maxMemory = 2 * bytes;
    EXPECT_FALSE(trk::loadDensity(vdb, options).loader);
    options.maxMemory = bytes / 4;
    const trk::Density density = trk::loadDensity(vdb, options);
    EXPECT_TRUE(density.loader);
    EXPECT_EQ(density.field.brickCount(), 0u);
    trk::BakeOptions bake = fixtures::bakeOptions(16, 2);
    bake.maxMemory = bytes / 4;
    try {  // a page has at least 12 MB
        trk::bake(density.pages(), bake);
        ADD_FAILURE() << "baked";
    } catch (const trk::Error& e) {
        EXPECT_EQ(e.status(), TRK_ERROR_OUT_OF_MEMORY);
    }
    options.bricks = trk::Bricks::kAll;
    EXPECT_THROW(trk::loadDensity(vdb, options), trk::Error);
}

TEST(PagedBake, RefusesAFileThatWasCutMeanwhile) {
    const std::string vdb = fixtures::path("cut-meanwhile.vdb");
    std::filesystem::copy_file(fixtures::cloudFile(128), vdb);
    const trk::Density paged = loadPaged(vdb, 100 * 729 * sizeof(float));
    std::filesystem::resize_file(vdb, std::filesystem::file_size(vdb) / 2);
    try {
        trk::bake(paged.pages(), fixtures::bakeOptions(8, 1));
        ADD_FAILURE() << "baked";
    } catch (const trk::Error& e) {
        EXPECT_EQ(e.status(), TRK_ERROR_BAD_FILE);
        EXPECT_NE(std::string(e.what()).find(vdb), std::string::npos);
    }
}

TEST(PagedVerify, ProvesAndFindsTheSame) {
    for (const std::string& vdb : {tiledFile(), fixtures::cloudFile(96)}) {
        const std::string path = fixtures::path("paged-verify.track.vdb");
        fixtures::bake(vdb, path, 8, 1, ControlKind::kAffine);
        trk::DensityOptions options;
        options.bricks = trk::Bricks::kNone;
        const trk::DensitySummary summary = trk::loadDensity(vdb, options).summary;
        trk::Sidecar sidecar =
            trk::readSidecar(path, &summary, TRK_CHECK_FULL, trk::SidecarParts::kAll);
        constexpr uint64_t kSmall = 100000;  // pages of 64 leaves
        const auto same = [&] {
            const vdbtools::VerifyReport all = vdbtools::verify(summary, sidecar);
            const vdbtools::VerifyReport pages = vdbtools::verify(summary, sidecar, kSmall);
            EXPECT_EQ(pages.holds, all.holds);
            EXPECT_EQ(pages.counterexample, all.counterexample);
            return pages;
        };
        const vdbtools::VerifyReport good = same();
        EXPECT_TRUE(good.holds) << good.counterexample;
        EXPECT_EQ(good.vertices, vdbtools::verify(summary, sidecar).vertices);
        for (const size_t part : {1u, 2u, 3u}) {  // of four
            const trk::BakedVolume baked = sidecar.baked;
            for (size_t i = sidecar.baked.items.size() * part / 4; i < baked.items.size(); ++i) {
                sidecar.baked.items[i].max *= 0.999f;
            }
            EXPECT_FALSE(same().holds);
            sidecar.baked.items = baked.items;
            const auto first = static_cast<trk::SparseTable::Entry>(baked.items.size() * part / 4);
            sidecar.baked.table =
                trk::TableBuilder::mapped(baked.table, [&](trk::SparseTable::Entry e) {
                    return trk::SparseTable::index(e) >= first ? trk::SparseTable::kEmpty : e;
                });
            EXPECT_NE(same().counterexample.find("not in the sidecar"), std::string::npos);
            sidecar.baked.table =
                trk::TableBuilder::mapped(baked.table, [](trk::SparseTable::Entry e) { return e; });
        }
    }
}

}  // namespace
