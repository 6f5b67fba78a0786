// SPDX-License-Identifier: Apache-2.0
#include "vdb_file.h"

#include "density_types.h"
#include "failure.h"
#include "vdb_tree.h"
#include "vdb_values.h"

#include <openvdb/io/io.h>

#include <algorithm>
#include <cmath>
#include <cstring>
#include <map>
#include <sstream>
#include <utility>

namespace trk {
namespace {

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

// Of OpenVDB 13. It added grids of native halfs; all others are as in 224. Below 222 nodes are laid
// out otherwise.
constexpr uint32_t kNewestVersion = 225;
constexpr uint32_t kOldestVersion = 222;
constexpr int64_t kMagic = 0x56444220;
constexpr size_t kUuidBytes = 36;
constexpr size_t kMaxName = size_t{1} << 16;

/// Bytes of a map of OpenVDB's, by its name; 0 for a name that is not known.
size_t mapBytes(const std::string& type) {
    static const std::map<std::string, size_t> kBytes = {{"AffineMap", 128},
                                                         {"UnitaryMap", 128},
                                                         {"ScaleMap", 120},
                                                         {"UniformScaleMap", 120},
                                                         {"TranslationMap", 24},
                                                         {"ScaleTranslateMap", 144},
                                                         {"UniformScaleTranslateMap", 144}};
    const auto it = kBytes.find(type);
    return it == kBytes.end() ? 0 : it->second;
}

/// Lets OpenVDB make a transform of the bytes of one.
openvdb::math::Transform::Ptr transformOf(const std::string& bytes) {
    std::istringstream stream(bytes, std::ios::binary);
    openvdb::io::setCurrentVersion(stream);
    openvdb::math::Transform::Ptr transform(new openvdb::math::Transform);
    transform->read(stream);
    return transform;
}

openvdb::math::Transform::Ptr readTransform(FileReader& reader) {
    std::ostringstream copy(std::ios::binary);
    const auto copyBytes = [&](size_t count) {
        std::string bytes(count, '\0');
        reader.read(bytes.data(), count);
        copy << bytes;
    };
    std::string type = reader.text(kMaxName, "the name of a map");
    openvdb::writeString(copy, type);
    if (type == "NonlinearFrustumMap") {  // a box, a taper, a depth and a map of its own
        copyBytes(64);
        type = reader.text(kMaxName, "the name of a map");
        openvdb::writeString(copy, type);
    }
    const size_t bytes = mapBytes(type);
    if (bytes == 0) {
        reader.refuse("a transform of unknown kind \"" + type + "\"");
    }
    copyBytes(bytes);
    try {
        return transformOf(copy.str());
    } catch (const openvdb::Exception& e) {  // OpenVDB's own limit: a determinant below 3e-15
        throw Error(TRK_ERROR_UNSUPPORTED_GRID,
                    reader.place() + ": has a transform that OpenVDB refuses: " + firstLine(e));
    }
}

}  // namespace

void VdbMetadata::read(FileReader& reader) {
    constexpr size_t kMaxItems = 1000;
    const auto isWanted = [](const std::string& name) {
        return name.rfind("track_", 0) == 0 || name.rfind("file_", 0) == 0 || name == "class" ||
               name == "creator" || name == "is_saved_as_half_float";
    };
    items_.clear();
    const auto count = reader.value<uint32_t>();
    for (uint32_t i = 0; i < count; ++i) {
        const std::string name = reader.text(kMaxName, "a name of metadata");
        Item item;
        item.type = reader.text(kMaxName, "a type of metadata");
        const auto bytes = reader.value<uint32_t>();
        reader.expect(bytes, "metadata");
        if (!isWanted(name) || bytes > kMaxName || items_.size() == kMaxItems) {
            reader.skip(bytes);
            continue;
        }
        item.bytes.resize(bytes);
        reader.read(item.bytes.data(), bytes);
        items_[name] = std::move(item);
    }
}

template <class T>
std::optional<T> VdbMetadata::value(const std::string& name, const char* type) const {
    const auto it = items_.find(name);
    if (it == items_.end() || it->second.type != type || it->second.bytes.size() != sizeof(T)) {
        return std::nullopt;
    }
    T result;
    std::memcpy(&result, it->second.bytes.data(), sizeof(T));
    return result;
}

std::optional<std::string> VdbMetadata::text(const std::string& name) const {
    const auto it = items_.find(name);
    return it == items_.end() || it->second.type != "string" ? std::nullopt
                                                             : std::optional(it->second.bytes);
}
std::optional<int32_t> VdbMetadata::int32(const std::string& name) const {
    return value<int32_t>(name, "int32");
}
std::optional<int64_t> VdbMetadata::int64(const std::string& name) const {
    return value<int64_t>(name, "int64");
}
std::optional<double> VdbMetadata::real(const std::string& name) const {
    return value<double>(name, "double");
}
std::optional<Vec3d> VdbMetadata::vec3d(const std::string& name) const {
    return value<Vec3d>(name, "vec3d");
}
std::optional<std::array<int32_t, 3>> VdbMetadata::vec3i(const std::string& name) const {
    return value<std::array<int32_t, 3>>(name, "vec3i");
}
bool VdbMetadata::flag(const std::string& name) const {
    return value<uint8_t>(name, "bool").value_or(0) != 0;
}

std::string VdbGridHeader::gridClass() const {
    return openvdb::GridBase::gridClassToString(
        openvdb::GridBase::stringToGridClass(metadata.text("class").value_or("")));
}

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
    const std::string codec = compression & kVdbBlosc ? "blosc"
                              : compression & kVdbZip ? "zip"
                                                      : "none";
    return compression & kVdbActiveMask ? codec + ", active values only" : codec;
}

VdbFile::VdbFile(const std::string& path) : reader_(path) {
    openvdb::initialize();
    readMagic();
    readDirectory();
    std::map<std::string, int> counts;
    for (VdbEntry& entry : entries_) {
        entry.index = counts[entry.name]++;
    }
    for (VdbEntry& entry : entries_) {
        entry.equalNames = counts[entry.name];
    }
    reader_.setPlace(path);
}

void VdbFile::readMagic() {
    std::string head(20, '\0');
    head.resize(static_cast<size_t>(std::min<uint64_t>(head.size(), reader_.bytes())));
    reader_.read(head.data(), head.size());
    if (head.size() < sizeof(kMagic) || std::memcmp(head.data(), &kMagic, sizeof(kMagic)) != 0) {
        throw Error(TRK_ERROR_BAD_FILE, path() + ": not a VDB file: " + guessFormat(head));
    }
    reader_.confine(sizeof(kMagic), reader_.bytes());
    header_.version = reader_.value<uint32_t>();
    const auto major = std::to_string(reader_.value<uint32_t>());
    header_.writtenBy = major + "." + std::to_string(reader_.value<uint32_t>());
    if (header_.version < kOldestVersion || header_.version > kNewestVersion) {
        throw Error(TRK_ERROR_BAD_FILE,
                    path() + ": VDB file version " + std::to_string(header_.version) +
                        ", written by OpenVDB " + header_.writtenBy + "; this build reads " +
                        std::to_string(kOldestVersion) + " to " + std::to_string(kNewestVersion) +
                        " (OpenVDB 13); save it with " +
                        (header_.version > kNewestVersion ? "an older" : "a newer") + " OpenVDB");
    }
}

void VdbFile::readDirectory() {
    const auto hasOffsets = reader_.value<uint8_t>();
    if (hasOffsets > 1) {
        reader_.refuse("a header whose flag of offsets is " + std::to_string(hasOffsets));
    }
    hasOffsets_ = hasOffsets == 1;
    reader_.skip(kUuidBytes);
    VdbMetadata metadata;
    metadata.read(reader_);
    header_.creator = metadata.text("creator").value_or("");
    const auto count = reader_.value<int32_t>();
    if (count < 0) {
        reader_.refuse("lists " + std::to_string(count) + " grids");
    }
    const uint64_t fileEnd = reader_.bytes();
    for (int32_t i = 0; i < count; ++i) {
        reader_.setPlace(path());
        VdbEntry entry = readEntry();
        const auto offsets = reader_.value<std::array<uint64_t, 3>>();
        const std::string name = path() + ": grid " + entry.label();
        reader_.setPlace(name);
        if (hasOffsets_) {
            // Each entry must lie behind the last, or a damaged directory could go round for ever.
            // One that shares a tree has no values of its own.
            const uint64_t blocks = entry.parent.empty() ? offsets[1] : offsets[0];
            if (offsets[0] < reader_.position() || blocks < offsets[0] || offsets[2] < blocks) {
                reader_.refuse("its entry in the directory says that it ends before it begins");
            }
            entry.position = offsets[0];
            entry.blocks = entry.parent.empty() ? offsets[1] : 0;
            entry.end = offsets[2];
            reader_.confine(entry.position, entry.end);
            readCompression(entry);
        } else {
            entry.position = reader_.position();
            entry.end = fileEnd;
            readCompression(entry);
            reader_.confine(readHeader(entry).tree, fileEnd);
            if (entry.parent.empty() &&
                !stepOverTree(reader_, entry.type, entry.half, entry.compression)) {
                reader_.refuse("is of type " + entry.type +
                               " in a file without offsets, where it cannot be stepped over; save "
                               "it as a file, not a stream");
            }
            entry.end = reader_.position();
        }
        reader_.confine(entry.end, fileEnd);
        entries_.push_back(std::move(entry));
    }
}

VdbEntry VdbFile::readEntry() {
    static const std::string kHalfSuffix = "_HalfFloat";
    constexpr char kSeparator = '\x1e';  // between a name and what makes it unique
    VdbEntry entry;
    entry.uniqueName = reader_.text(kMaxName, "a grid's name");
    entry.name = entry.uniqueName.substr(0, entry.uniqueName.find(kSeparator));
    entry.type = reader_.text(kMaxName, "a grid's type");
    if (entry.type.size() > kHalfSuffix.size() &&
        entry.type.compare(entry.type.size() - kHalfSuffix.size(), std::string::npos,
                           kHalfSuffix) == 0) {
        entry.half = true;
        entry.type.resize(entry.type.size() - kHalfSuffix.size());
    }
    entry.parent = reader_.text(kMaxName, "a grid's name");
    return entry;
}

void VdbFile::readCompression(VdbEntry& entry) {
    entry.compression = reader_.value<uint32_t>();
    if ((entry.compression & ~kVdbKnownCompression) != 0) {
        reader_.refuse("compressed in way " + std::to_string(entry.compression) +
                       "; this build knows zip (1), active values only (2) and blosc (4)");
    }
}

VdbGridHeader VdbFile::readHeader(const VdbEntry& entry) {
    reader_.setPlace(path() + ": grid " + entry.label());
    reader_.confine(entry.position + sizeof(uint32_t), entry.end);
    VdbGridHeader header;
    header.metadata.read(reader_);
    if (header.metadata.flag("is_saved_as_half_float") != entry.half) {
        reader_.refuse(entry.half ? "its type says that values are halfs, its metadata does not"
                                  : "its metadata says that values are halfs, its type does not");
    }
    header.transform = readTransform(reader_);
    header.tree = reader_.position();
    return header;
}

const VdbEntry& VdbFile::treeOwner(const VdbEntry& entry) const {
    if (entry.parent.empty()) {
        return entry;
    }
    for (const VdbEntry& other : entries_) {
        if (other.uniqueName == entry.parent && other.parent.empty() && other.type == entry.type) {
            return other;
        }
    }
    throw Error(TRK_ERROR_BAD_FILE,
                path() + ": grid " + entry.label() +
                    ": damaged: it shares the voxels of a grid that is not in the file");
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
                path() +
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

void checkMap(const AffineMap& map, const std::string& where) {
    const double shape = map.relativeDeterminant();
    bool finite = std::isfinite(shape);
    for (const double t : map.translation) {
        finite = finite && std::isfinite(t);
    }
    if (!finite || std::fabs(shape) < 1e-12) {
        throw Error(TRK_ERROR_UNSUPPORTED_GRID,
                    where + ": has a singular or infinite transform; expected an invertible one");
    }
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
    checkMap(map, where);
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
    std::ostringstream bytes(std::ios::binary);
    openvdb::writeString(bytes, base->type());
    base->write(bytes);
    return transformOf(bytes.str());
}

}  // namespace trk
