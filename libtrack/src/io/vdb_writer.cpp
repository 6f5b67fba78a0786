// SPDX-License-Identifier: Apache-2.0
#include "vdb_writer.h"

#include "failure.h"

#include <openvdb/io/Archive.h>
#include <openvdb/io/GridDescriptor.h>
#include <openvdb/io/io.h>

#include <cerrno>
#include <cstring>
#include <fstream>
#include <string>

namespace trk {

/// Gives access to the writing steps that OpenVDB keeps for its own file classes.
class VdbWriter::Archive : public openvdb::io::Archive {
  public:
    Archive(const std::string& path, int32_t gridCount) {
        stream_.exceptions(std::ios::badbit | std::ios::failbit);
        stream_.open(path, std::ios::binary);
        openvdb::io::setDataCompression(stream_, compression());
        openvdb::io::setWriteGridStatsMetadata(stream_, isGridStatsMetadataEnabled());
        writeHeader(stream_, /*seekable=*/true);
        openvdb::MetaMap metadata;
        metadata.insertMeta("creator", openvdb::StringMetadata("vdbtrack " TRACK_VERSION));
        metadata.writeMeta(stream_);
        stream_.write(reinterpret_cast<const char*>(&gridCount), sizeof(gridCount));
    }
    void add(const openvdb::GridBase::Ptr& grid) {
        openvdb::io::GridDescriptor descriptor(grid->getName(), grid->type());
        writeGrid(descriptor, grid, stream_, /*seekable=*/true);
        openvdb::io::setDataCompression(stream_, compression());
    }
    /// `writeBuffers(stream)` writes those that `tree` does not hold.
    template <class WriteBuffers>
    void add(const openvdb::GridBase::Ptr& grid, const EncodedTree& tree,
             const WriteBuffers& writeBuffers) {
        openvdb::io::GridDescriptor descriptor(grid->getName(), grid->type());
        descriptor.writeHeader(stream_);
        const auto offsets = stream_.tellp();
        descriptor.writeStreamPos(stream_);  // once more when they are known
        descriptor.setGridPos(stream_.tellp());
        const uint32_t compression = kEncodedCompression;
        stream_.write(reinterpret_cast<const char*>(&compression), sizeof(compression));

        const openvdb::CoordBBox box = tree.activeVoxels > 0 ? tree.box : openvdb::CoordBBox();
        const auto number = [](uint64_t x) {
            return openvdb::Int64Metadata(static_cast<int64_t>(x));
        };
        grid->insertMeta(openvdb::GridBase::META_FILE_BBOX_MIN,
                         openvdb::Vec3IMetadata(box.min().asVec3i()));
        grid->insertMeta(openvdb::GridBase::META_FILE_BBOX_MAX,
                         openvdb::Vec3IMetadata(box.max().asVec3i()));
        grid->insertMeta(openvdb::GridBase::META_FILE_VOXEL_COUNT, number(tree.activeVoxels));
        grid->insertMeta(openvdb::GridBase::META_FILE_MEM_BYTES, number(tree.openvdbBytes));
        grid->insertMeta(openvdb::GridBase::META_FILE_COMPRESSION,
                         openvdb::StringMetadata(openvdb::io::compressionToString(compression)));
        grid->writeMeta(stream_);
        grid->writeTransform(stream_);
        put(tree.topology);
        descriptor.setBlockPos(stream_.tellp());
        put(tree.buffers);
        writeBuffers(stream_);
        descriptor.setEndPos(stream_.tellp());
        stream_.seekp(offsets);
        descriptor.writeStreamPos(stream_);
        descriptor.seekToEnd(stream_);
    }
    void finish() { stream_.close(); }

  private:
    void put(const std::string& bytes) {
        stream_.write(bytes.data(), static_cast<std::streamsize>(bytes.size()));
    }

    std::ofstream stream_;
};

template <class Body>
void VdbWriter::writing(const Body& body) const {
    errno = 0;
    try {
        body();
    } catch (const std::ios_base::failure&) {
        throw Error(TRK_ERROR_IO, file_.target() + ": cannot be written: " +
                                      (errno ? std::strerror(errno) : "is the disk full?"));
    } catch (const openvdb::Exception& e) {
        throw Error(TRK_ERROR_IO, file_.target() + ": cannot be written: " + firstLine(e));
    }
}

VdbWriter::VdbWriter(const OutputFile& file, int32_t gridCount) : file_(file) {
    writing([&] { archive_ = std::make_unique<Archive>(file.path(), gridCount); });
}

VdbWriter::~VdbWriter() = default;

void VdbWriter::add(const openvdb::GridBase::Ptr& grid) {
    writing([&] { archive_->add(grid); });
}

void VdbWriter::add(const openvdb::GridBase::Ptr& grid, const EncodedTree& tree) {
    writing([&] { archive_->add(grid, tree, [](std::ostream&) {}); });
}

void VdbWriter::add(const openvdb::GridBase::Ptr& grid, const EncodedTree& tree,
                    const OutputFile& buffers) {
    writing([&] {
        std::ifstream from(buffers.path(), std::ios::binary);
        archive_->add(grid, tree, [&](std::ostream& to) {
            if (from.peek() != std::ifstream::traits_type::eof()) {
                to << from.rdbuf();
            }
        });
    });
}

void VdbWriter::finish() {
    writing([&] { archive_->finish(); });
}

}  // namespace trk
