// SPDX-License-Identifier: Apache-2.0
// What a .vdb file says of itself: header, directory, and each grid's metadata and transform. Read
// with distrust, by the format's structure: lengths are checked against what is left of the file
// before memory is taken for them, and what is not known is an Error that names file and byte.
#pragma once

#include "file_reader.h"
#include "openvdb_grids.h"
#include "space/geometry.h"

#include <cstdint>
#include <map>
#include <optional>
#include <string>
#include <vector>

namespace trk {

/// Metadata of a file or a grid: the pieces that this library asks for, others are stepped over.
class VdbMetadata {
  public:
    void read(FileReader& reader);

    /// Nothing where there is none of that name and type.
    std::optional<std::string> text(const std::string& name) const;
    std::optional<int32_t> int32(const std::string& name) const;
    std::optional<int64_t> int64(const std::string& name) const;
    std::optional<double> real(const std::string& name) const;
    std::optional<Vec3d> vec3d(const std::string& name) const;
    std::optional<std::array<int32_t, 3>> vec3i(const std::string& name) const;
    bool flag(const std::string& name) const;  ///< false where there is none

  private:
    struct Item {
        std::string type;  // OpenVDB's name for it
        std::string bytes;
    };
    template <class T>
    std::optional<T> value(const std::string& name, const char* type) const;

    std::map<std::string, Item> items_;
};

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
    uint64_t position = 0;     ///< of its header in the file
    uint64_t blocks = 0;       ///< of its leaves' values; 0 where the file does not say
    uint64_t end = 0;

    /// "density", or "density[1]" where the name alone is ambiguous or empty; fit for one line.
    std::string label() const;
    /// The same as it is, whatever damaged files name their grids.
    std::string rawLabel() const;
    /// "blosc, active values only", say.
    std::string compressionName() const;
};

/// A grid without its voxels.
struct VdbGridHeader {
    VdbMetadata metadata;
    openvdb::math::Transform::Ptr transform;
    uint64_t tree = 0;  ///< where its tree begins in the file

    /// "fog volume", "level set", "staggered" or "unknown".
    std::string gridClass() const;
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

    const std::string& path() const { return reader_.path(); }
    uint64_t bytes() const { return reader_.bytes(); }
    /// When it was written, in nanoseconds since 1970.
    int64_t modified() const { return reader_.modified(); }
    const VdbFileHeader& header() const { return header_; }
    const std::vector<VdbEntry>& entries() const { return entries_; }

    /// Metadata and transform of a grid of any type. Throws Error.
    VdbGridHeader readHeader(const VdbEntry& entry);
    /// The grid whose tree `entry` has: itself, or the one that it shares. Throws BAD_FILE.
    const VdbEntry& treeOwner(const VdbEntry& entry) const;

    /// The entry of a selector NAME or NAME[i]. Throws GRID_NOT_FOUND, listing the grids.
    const VdbEntry& select(const std::string& selector) const;

    /// "density, heat, v[0], v[1]", for messages.
    std::string listing() const;

    FileReader& reader() { return reader_; }

  private:
    void readMagic();
    void readDirectory();
    VdbEntry readEntry();
    void readCompression(VdbEntry& entry);

    FileReader reader_;
    VdbFileHeader header_;
    bool hasOffsets_ = true;
    std::vector<VdbEntry> entries_;
};

/// The grid's map. Throws UNSUPPORTED_GRID for a frustum, a singular map or one with NaN; `where`
/// begins the message.
AffineMap affineMap(const openvdb::math::Transform& transform, const std::string& where);

/// Throws UNSUPPORTED_GRID for a map that is singular or has NaN or infinities.
void checkMap(const AffineMap& map, const std::string& where);

/// An OpenVDB transform that does what `map` does.
openvdb::math::Transform::Ptr makeTransform(const AffineMap& map);

inline openvdb::Coord toCoord(const Int3& p) {
    return {static_cast<int32_t>(p[0]), static_cast<int32_t>(p[1]), static_cast<int32_t>(p[2])};
}
inline Int3 toInt3(const openvdb::Coord& c) {
    return {{c.x(), c.y(), c.z()}};
}

}  // namespace trk
