// SPDX-License-Identifier: Apache-2.0
#include "write_bake.h"

#include "levels.h"
#include "preview_scale.h"

#include <algorithm>
#include <filesystem>
#include <utility>

namespace trk {

uint64_t sidecarLimit(uint64_t sourceBytes, ControlKind kind) {
    constexpr uint64_t kSmall = 4000000;
    constexpr uint64_t kLeast = 100000;
    // Controls that vary have more grids: no reason to have no picture.
    constexpr uint64_t kMoreGrids = 40000;
    return std::max(kLeast, sourceBytes / (sourceBytes < kSmall ? 5 : 10)) +
           (kind == ControlKind::kConstant ? 0 : kMoreGrids);
}

SidecarHeader sidecarHeader(const DensitySummary& source, BrickPages pages,
                            const BakedVolume& baked) {
    SidecarHeader header;
    header.toolVersion = TRACK_VERSION;
    header.sourceFile = std::filesystem::path(source.path).filename().string();
    header.source = source.grid;
    header.prefix = source.label;
    header.valueType = source.valueType;
    header.digest = source.digest;
    header.sourceBytes = source.fileBytes;
    header.sourceModified = source.fileModified;
    header.indexToWorld = source.indexToWorld;
    header.superVoxelSize = baked.superVoxelSize();
    header.levels = static_cast<int>(baked.levels.size());
    header.controlKind = baked.kind;
    header.previewSize = baked.previewSize;
    header.previewScale = previewScale(std::move(pages), source.indexToWorld);
    header.repair = source.repair;
    header.dropped = source.dropped;
    header.clamped = source.clamped;
    return header;
}

SidecarHeader writeBake(const OutputFile& file, const DensitySummary& source, BrickPages pages,
                        BakedVolume& baked, uint64_t sidecarBytes) {
    const DensityField& field = pages.field();
    const SidecarHeader header = sidecarHeader(source, std::move(pages), baked);
    writeSidecar(file, header, baked, source.anchor);
    // How well values compress was an estimate.
    while (baked.previewSize > 0 && std::filesystem::file_size(file.path()) > sidecarBytes) {
        coarsenPreview(baked, field);
        writeSidecar(file, header, baked, source.anchor);
    }
    return header;
}

}  // namespace trk
