// SPDX-License-Identifier: Apache-2.0
// Reading of .vdb files, distrustful: every short read, damaged chunk or newer version is an Error
// that names the file. OpenVDB's own reader goes on past the end of a truncated file.
#pragma once

#include "../geometry.h"
#include "openvdb_grids.h"

#include <cstdint>
#include <memory>
#include <string>
#include <vector>

namespace trk {

/// One grid as the file's directory lists it.
struct VdbEntry {
    std::string name;
    int index = 0;       ///< among the grids of that name, in file order
    int equalNames = 1;  ///< how many grids have that name
    std::string type;    ///< OpenVDB's, e.g. "Tree_float_5_4_3"
    std::string uniqueName;
    std::string parent;        ///< unique name of the grid whose tree this one shares; else empty
    bool half = false;         ///< values are halfs in the file
    uint32_t compression = 0;  ///< of its voxels, OpenVDB's COMPRESS_… bits
    int64_t position = 0;
    openvdb::GridBase::Ptr loaded;  ///< in files without offsets, which are read at once

    /// "density", or "density[1]" where the name alone is ambiguous or empty; fit for one line.
    std::string label() const;
    /// The same as it is, whatever damaged files name their grids.
    std::string rawLabel() const;
    /// "blosc, active values only", say.
    std::string compressionName() const;
};

/// What a file says of itself.
struct VdbFileHeader {
    uint32_t version = 0;   ///< of the format, 224 say
    std::string writtenBy;  ///< the OpenVDB, "10.0"
    std::string creator;    ///< the program, where it says so
};

/// An open .vdb file. Not thread-safe.
class VdbFile {
  public:
    /// Opens and reads the directory. Throws Error (IO or BAD_FILE).
    explicit VdbFile(const std::string& path);
    ~VdbFile();

    const std::string& path() const { return path_; }
    uint64_t bytes() const { return bytes_; }
    /// When it was written, in nanoseconds since 1970.
    int64_t modified() const { return modified_; }
    const VdbFileHeader& header() const { return header_; }
    const std::vector<VdbEntry>& entries() const { return entries_; }

    /// A grid without its voxels: metadata and transform. NULL for a type that is not registered.
    openvdb::GridBase::Ptr readMetadata(const VdbEntry& entry);
    /// A whole grid. Throws OUT_OF_MEMORY where its leaves alone would take more than `maxBytes`
    /// (0: no limit).
    openvdb::GridBase::Ptr read(const VdbEntry& entry, uint64_t maxBytes = 0);

    /// The entry of a selector NAME or NAME[i]. Throws GRID_NOT_FOUND, listing the grids.
    const VdbEntry& select(const std::string& selector) const;

    /// "density, heat, v[0], v[1]", for messages.
    std::string listing() const;

  private:
    class Archive;

    std::string path_;
    uint64_t bytes_ = 0;
    int64_t modified_ = 0;
    VdbFileHeader header_;
    std::vector<VdbEntry> entries_;
    std::unique_ptr<Archive> archive_;
};

/// The grid's map. Throws UNSUPPORTED_GRID for a frustum, a singular map or one with NaN; `where`
/// begins the message.
AffineMap affineMap(const openvdb::math::Transform& transform, const std::string& where);

/// An OpenVDB transform that does what `map` does.
openvdb::math::Transform::Ptr makeTransform(const AffineMap& map);

inline openvdb::Coord toCoord(const Int3& p) {
    return {static_cast<int32_t>(p[0]), static_cast<int32_t>(p[1]), static_cast<int32_t>(p[2])};
}
inline Int3 toInt3(const openvdb::Coord& c) {
    return {{c.x(), c.y(), c.z()}};
}

}  // namespace trk
