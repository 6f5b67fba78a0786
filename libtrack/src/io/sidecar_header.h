// SPDX-License-Identifier: Apache-2.0
// The metadata of a sidecar: reading it, and comparing it with a density.
#pragma once

#include "density.h"
#include "sidecar.h"
#include "vdb_file.h"

#include <string>

namespace trk {

/// Throws BAD_FILE.
[[noreturn]] void badSidecar(const std::string& where, const std::string& what);

/// Text metadata of a grid. `where` begins the message if there is none.
std::string metaText(const VdbMetadata& metadata, const char* name, const std::string& where);

/// Throws where a grid's format is none, or newer than this build's.
void checkFormat(const VdbMetadata& metadata, const std::string& where);

/// As readSidecarHeader.
SidecarHeader readHeader(VdbFile& file, const GridIdentity* source);

/// Throws SIDECAR_MISMATCH where the density is not the one that was baked.
void checkAgainst(const SidecarHeader& header, const DensitySummary& density, TrkCheck check,
                  const std::string& path);

}  // namespace trk
