// SPDX-License-Identifier: Apache-2.0
#include "vdb_file.h"

#include "../failure.h"
#include "density_types.h"
#include "guarded_stream.h"

#include <openvdb/io/Archive.h>
#include <openvdb/io/GridDescriptor.h>
#include <openvdb/io/io.h>
#include <sys/stat.h>

#include <algorithm>
#include <cerrno>
#include <cstring>
#include <filesystem>
#include <istream>
#include <map>
#include <sstream>
#include <utility>

namespace trk {
namespace {

[[noreturn]] void badFile(const std::string& where, const std::string& what) {
    throw Error(TRK_ERROR_BAD_FILE, where + ": " + what);
}

/// Runs a reading step and says in one line what broke it.
template <class Body>
auto reading(const std::string& where, const Body& body) {
    try {
        return body();
    } catch (const Error&) {
        throw;
    } catch (const std::ios_base::failure&) {
        badFile(where, "the file ends early; expected more data (truncated or damaged)");
    } catch (const std::bad_alloc&) {
        throw Error(TRK_ERROR_OUT_OF_MEMORY,
                    where + ": asks for more memory than the machine has, or is damaged");
    } catch (const std::exception& e) {
        badFile(where, "damaged: " + firstLine(e));
    }
}

/// What a file that is not a VDB looks like, from its first bytes.
std::string guessFormat(const std::string& head) {
    const auto startsWith = [&](const char* magic, size_t size) {
        return head.size() >= size && std::memcmp(head.data(), magic, size) == 0;
    };
    if (head.empty()) {
        return "the file is empty";
    }
    if (startsWith("NanoVDB", 7) || startsWith("0BDVonaN", 8)) {
        return "it looks like a NanoVDB file; convert it with nanovdb_convert";
    }
    if (startsWith("\x76\x2f\x31\x01", 4)) {
        return "it looks like an OpenEXR image";
    }
    if (startsWith("\x89PNG", 4)) {
        return "it looks like a PNG image";
    }
    if (startsWith("\x1f\x8b", 2)) {
        return "it looks like a gzip archive; unpack it first";
    }
    if (startsWith("PK\x03\x04", 4)) {
        return "it looks like a zip archive; unpack it first";
    }
    for (const char c : head) {
        if (static_cast<unsigned char>(c) < 9) {
            return "its first bytes are not those of any format known here";
        }
    }
    return "it looks like text";
}

// Of OpenVDB 13. It added grids of native halfs; all others are as in 224.
constexpr uint32_t kNewestVersion = 225;
constexpr uint32_t kOldestVersion = openvdb::OPENVDB_FILE_VERSION_BOOST_UUID;
constexpr uint32_t kMaxName = 1u << 16;

}  // namespace

/// Gives access to the reading steps that OpenVDB keeps for its own file classes. The stream throws
/// on every short read.
class VdbFile::Archive : public openvdb::io::Archive {
  public:
    explicit Archive(const std::string& path) {
        std::error_code error;
        if (std::filesystem::is_directory(path, error)) {
            throw Error(TRK_ERROR_IO, path + ": is a directory; expected a .vdb file");
        }
        errno = 0;
        if (!buffer_.open(path, std::ios::in | std::ios::binary)) {
            throw Error(TRK_ERROR_IO, path + ": cannot be opened: " + std::strerror(errno));
        }
    }

    void readHead(const std::string& path, uint64_t bytes, VdbFileHeader& header,
                  std::vector<VdbEntry>& entries) {
        header.version = checkMagic(path);
        stream_.exceptions(std::ios::badbit | std::ios::failbit | std::ios::eofbit);
        readHeader(stream_);
        tagStream(false);
        openvdb::MetaMap fileMetadata;
        fileMetadata.readMeta(stream_);
        header.writtenBy =
            std::to_string(libraryVersion().first) + "." + std::to_string(libraryVersion().second);
        if (const auto creator = fileMetadata.getMetadata<openvdb::StringMetadata>("creator")) {
            header.creator = creator->value();
        }
        const int32_t count = readGridCount(stream_);
        if (count < 0) {
            badFile(path, "damaged: lists " + std::to_string(count) + " grids");
        }
        for (int32_t i = 0; i < count; ++i) {
            VdbEntry entry = readEntry();
            if (inputHasGridOffsets()) {
                int64_t offsets[3];  // grid, blocks, end
                stream_.read(reinterpret_cast<char*>(offsets), sizeof(offsets));
                // Each entry must lie behind the last, or a damaged directory could go round for
                // ever.
                if (offsets[0] < static_cast<int64_t>(stream_.tellg()) || offsets[2] < offsets[0]) {
                    badFile(path, "damaged: grid " + entry.name + " ends before it begins");
                }
                if (static_cast<uint64_t>(offsets[2]) > bytes) {
                    badFile(path, "the file ends early, before grid " + entry.name +
                                      " does (truncated or damaged)");
                }
                entry.position = offsets[0];
                stream_.seekg(offsets[0]);
                tagStream(entry.half);
                readGridCompression(stream_);
                entry.compression = openvdb::io::getDataCompression(stream_);
                stream_.seekg(offsets[2]);
            } else {
                int64_t offsets[3];
                stream_.read(reinterpret_cast<char*>(offsets), sizeof(offsets));
                entry.position = static_cast<int64_t>(stream_.tellg());
                entry.loaded = readGrid(entry, true, 0, path);
                entry.compression = openvdb::io::getDataCompression(stream_);
                if (!entry.loaded) {
                    badFile(path, "grid " + entry.name + " of unknown type " + entry.type +
                                      " in a file without offsets, which cannot be skipped");
                }
            }
            entries.push_back(std::move(entry));
        }
    }

    openvdb::GridBase::Ptr readGrid(const VdbEntry& entry, bool withVoxels, uint64_t maxBytes,
                                    const std::string& path) {
        if (!openvdb::GridBase::isRegistered(entry.type)) {
            return nullptr;
        }
        openvdb::GridBase::Ptr grid = openvdb::GridBase::createGrid(entry.type);
        grid->setSaveFloatAsHalf(entry.half);
        stream_.clear();
        stream_.seekg(entry.position);
        tagStream(entry.half);
        readGridCompression(stream_);
        guard(entry);
        openvdb::io::setGridClass(stream_, openvdb::GRID_UNKNOWN);
        openvdb::io::setGridBackgroundValuePtr(stream_, nullptr);
        grid->readMeta(stream_);
        metadata_->gridMetadata() = static_cast<openvdb::MetaMap&>(*grid);
        openvdb::io::setGridClass(stream_, grid->getGridClass());
        grid->readTransform(stream_);
        if (!withVoxels || !entry.parent.empty()) {
            return grid;
        }
        grid->readTopology(stream_);
        const uint64_t leafBytes =
            grid->constBaseTree().leafCount() * 512 * valueBytes(valueTypeName(entry.type));
        if (maxBytes > 0 && leafBytes > maxBytes) {
            throw Error(
                TRK_ERROR_OUT_OF_MEMORY,
                path + ": grid " + entry.label() + " needs " + std::to_string(leafBytes) +
                    " bytes for its voxels, more than maxMemory = " + std::to_string(maxBytes));
        }
        grid->readBuffers(stream_);
        return grid;
    }

  private:
    /// The file's version, which this build reads.
    uint32_t checkMagic(const std::string& path) {
        std::string head(20, '\0');
        stream_.read(head.data(), static_cast<std::streamsize>(head.size()));
        head.resize(static_cast<size_t>(stream_.gcount()));
        if (stream_.bad()) {
            throw Error(TRK_ERROR_IO, path + ": cannot be read: " + std::strerror(errno));
        }
        const int64_t magic = openvdb::OPENVDB_MAGIC;
        if (head.size() < sizeof(magic) || std::memcmp(head.data(), &magic, sizeof(magic)) != 0) {
            badFile(path, "not a VDB file: " + guessFormat(head));
        }
        uint32_t version = 0;
        if (head.size() >= sizeof(magic) + sizeof(version)) {
            std::memcpy(&version, head.data() + sizeof(magic), sizeof(version));
        }
        // OpenVDB only warns of a newer version than its own, then parses on.
        if (version > kNewestVersion) {
            uint32_t writer[2] = {0, 0};
            std::memcpy(writer, head.data() + sizeof(magic) + sizeof(version),
                        std::min(sizeof(writer), head.size() - sizeof(magic) - sizeof(version)));
            badFile(path, "VDB file version " + std::to_string(version) + ", written by OpenVDB " +
                              std::to_string(writer[0]) + "." + std::to_string(writer[1]) +
                              "; this build reads up to " + std::to_string(kNewestVersion) +
                              " (OpenVDB 13); save it with an older OpenVDB");
        }
        if (version > openvdb::OPENVDB_FILE_VERSION) {
            buffer_.showVersion(openvdb::OPENVDB_FILE_VERSION);
        }
        if (version < kOldestVersion) {
            badFile(path, "VDB file version " + std::to_string(version) + "; expected at least " +
                              std::to_string(kOldestVersion));
        }
        stream_.clear();
        stream_.seekg(0);
        return version;
    }

    /// Attaches fresh stream metadata, which OpenVDB's reading steps consult and change per grid.
    void tagStream(bool half) {
        metadata_ = std::make_shared<openvdb::io::StreamMetadata>();
        metadata_->setHalfFloat(half);
        openvdb::io::setStreamMetadataPtr(stream_, metadata_, /*transfer=*/false);
        setFormatVersion(stream_);
        setLibraryVersion(stream_);
        setDataCompression(stream_);
    }

    std::string readName() {
        uint32_t size = 0;
        stream_.read(reinterpret_cast<char*>(&size), sizeof(size));
        if (size > kMaxName) {
            throw std::runtime_error("a grid name of " + std::to_string(size) + " bytes");
        }
        std::string name(size, '\0');
        stream_.read(name.data(), static_cast<std::streamsize>(size));
        return name;
    }

    VdbEntry readEntry() {
        static const std::string kHalfSuffix = "_HalfFloat";
        VdbEntry entry;
        entry.uniqueName = readName();
        entry.name = openvdb::io::GridDescriptor::stripSuffix(entry.uniqueName);
        entry.type = readName();
        if (entry.type.size() > kHalfSuffix.size() &&
            entry.type.compare(entry.type.size() - kHalfSuffix.size(), std::string::npos,
                               kHalfSuffix) == 0) {
            entry.half = true;
            entry.type.resize(entry.type.size() - kHalfSuffix.size());
        }
        entry.parent = readName();
        return entry;
    }

    /// Has the stream watch over the chunks of a grid, where it knows what they look like.
    void guard(const VdbEntry& entry) {
        using Codec = GuardedFileBuf::Codec;
        const std::string valueType = valueTypeName(entry.type);
        const auto channels = static_cast<size_t>(channelCount(valueType));
        const uint32_t flags = openvdb::io::getDataCompression(stream_);
        Codec codec = flags & openvdb::io::COMPRESS_BLOSC ? Codec::kBlosc
                      : flags & openvdb::io::COMPRESS_ZIP ? Codec::kZip
                                                          : Codec::kUnguarded;
        if (fileVersion() < openvdb::OPENVDB_FILE_VERSION_NODE_MASK_COMPRESSION || channels == 0) {
            codec = Codec::kUnguarded;
        }
        GuardedFileBuf::Values values;
        values.half = entry.half;
        values.size = entry.half ? 2 * channels : valueBytes(valueType);
        values.mayBeEightBytes = valueType == "double";
        buffer_.beginGrid(codec, values, (flags & openvdb::io::COMPRESS_ACTIVE_MASK) != 0);
    }

    GuardedFileBuf buffer_;
    std::istream stream_{&buffer_};
    openvdb::io::StreamMetadata::Ptr metadata_;
};

std::string VdbEntry::rawLabel() const {
    return name.empty() || equalNames > 1 ? name + "[" + std::to_string(index) + "]" : name;
}

std::string VdbEntry::label() const {
    std::string text = rawLabel();
    for (char& c : text) {  // damaged files have names that would break the one line of an error
        c = static_cast<unsigned char>(c) < ' ' || c == 0x7f ? '?' : c;
    }
    return text;
}

std::string VdbEntry::compressionName() const {
    const std::string codec = compression & openvdb::io::COMPRESS_BLOSC ? "blosc"
                              : compression & openvdb::io::COMPRESS_ZIP ? "zip"
                                                                        : "none";
    return compression & openvdb::io::COMPRESS_ACTIVE_MASK ? codec + ", active values only" : codec;
}

VdbFile::VdbFile(const std::string& path) : path_(path) {
    openvdb::initialize();
    archive_ = std::make_unique<Archive>(path);
    struct stat info = {};
    if (stat(path.c_str(), &info) == 0) {
        bytes_ = static_cast<uint64_t>(info.st_size);
        modified_ = int64_t{info.st_mtim.tv_sec} * 1000000000 + info.st_mtim.tv_nsec;
    }
    reading(path, [&] { archive_->readHead(path, bytes_, header_, entries_); });
    std::map<std::string, int> counts;
    for (VdbEntry& entry : entries_) {
        entry.index = counts[entry.name]++;
    }
    for (VdbEntry& entry : entries_) {
        entry.equalNames = counts[entry.name];
    }
}

VdbFile::~VdbFile() = default;

openvdb::GridBase::Ptr VdbFile::readMetadata(const VdbEntry& entry) {
    if (entry.loaded) {
        return entry.loaded;
    }
    return reading(path_ + ": grid " + entry.label(),
                   [&] { return archive_->readGrid(entry, false, 0, path_); });
}

openvdb::GridBase::Ptr VdbFile::read(const VdbEntry& entry, uint64_t maxBytes) {
    const std::string where = path_ + ": grid " + entry.label();
    openvdb::GridBase::Ptr grid = entry.loaded;
    if (!grid) {
        grid = reading(where, [&] { return archive_->readGrid(entry, true, maxBytes, path_); });
    }
    if (!grid || entry.parent.empty()) {
        return grid;
    }
    for (const VdbEntry& other : entries_) {
        if (other.uniqueName == entry.parent && other.parent.empty() && other.type == entry.type) {
            grid->setTree(read(other, maxBytes)->baseTreePtr());
            return grid;
        }
    }
    badFile(where, "damaged: it shares the voxels of a grid that is not in the file");
}

const VdbEntry& VdbFile::select(const std::string& selector) const {
    const VdbEntry* found = nullptr;
    int matches = 0;
    for (const VdbEntry& entry : entries_) {
        if (selector == entry.name) {
            found = found ? found : &entry;
            ++matches;
        } else if (selector == entry.name + "[" + std::to_string(entry.index) + "]") {
            return entry;
        }
    }
    if (matches == 1) {
        return *found;
    }
    throw Error(TRK_ERROR_GRID_NOT_FOUND,
                path_ +
                    (matches == 0 ? ": no grid \"" + selector + "\""
                                  : ": " + std::to_string(matches) + " grids named \"" + selector +
                                        "\"; choose one by its index") +
                    "; the file has " + listing());
}

std::string VdbFile::listing() const {
    std::string list;
    for (const VdbEntry& entry : entries_) {
        list += (list.empty() ? "" : ", ") + entry.label();
    }
    return list.empty() ? "no grids" : list;
}

AffineMap affineMap(const openvdb::math::Transform& transform, const std::string& where) {
    if (!transform.isLinear()) {
        throw Error(
            TRK_ERROR_UNSUPPORTED_GRID,
            where + ": has a frustum transform; expected an affine one (resample it first)");
    }
    openvdb::Mat4d matrix;
    try {
        matrix = transform.baseMap()->getAffineMap()->getMat4();
    } catch (const openvdb::Exception& e) {  // OpenVDB's own limit: a determinant below 3e-15
        throw Error(TRK_ERROR_UNSUPPORTED_GRID,
                    where + ": has a transform that OpenVDB refuses: " + firstLine(e));
    }
    AffineMap map;  // OpenVDB multiplies row vectors from the left
    for (int row = 0; row < 3; ++row) {
        for (int column = 0; column < 3; ++column) {
            map.linear[row][column] = matrix(column, row);
        }
        map.translation[row] = matrix(3, row);
    }
    const double shape = map.relativeDeterminant();
    bool finite = std::isfinite(shape);
    for (const double t : map.translation) {
        finite = finite && std::isfinite(t);
    }
    if (!finite || std::fabs(shape) < 1e-12) {
        throw Error(TRK_ERROR_UNSUPPORTED_GRID,
                    where + ": has a singular or infinite transform; expected an invertible one");
    }
    return map;
}

openvdb::math::Transform::Ptr makeTransform(const AffineMap& map) {
    openvdb::Mat4d matrix = openvdb::Mat4d::identity();
    for (int row = 0; row < 3; ++row) {
        for (int column = 0; column < 3; ++column) {
            matrix(column, row) = map.linear[row][column];
        }
        matrix(3, row) = map.translation[row];
    }
    const auto& m = map.linear;
    const bool straight = m[0][1] == 0 && m[0][2] == 0 && m[1][0] == 0 && m[1][2] == 0 &&
                          m[2][0] == 0 && m[2][1] == 0;
    openvdb::math::MapBase::Ptr base;
    if (straight) {
        base.reset(new openvdb::math::ScaleTranslateMap(
            openvdb::Vec3d(m[0][0], m[1][1], m[2][2]),
            openvdb::Vec3d(map.translation[0], map.translation[1], map.translation[2])));
    } else {
        base.reset(new openvdb::math::AffineMap(matrix));
    }
    // Every constructor of a Transform finds the scale of a map without rotation as the difference
    // of two points, and loses it where the translation is large. Reading one takes it as it is.
    std::stringstream stream(std::ios::in | std::ios::out | std::ios::binary);
    openvdb::io::setCurrentVersion(stream);
    openvdb::writeString(stream, base->type());
    base->write(stream);
    openvdb::math::Transform::Ptr transform(new openvdb::math::Transform);
    transform->read(stream);
    return transform;
}

}  // namespace trk
