// SPDX-License-Identifier: Apache-2.0
#include "vdb_writer.h"

#include "../failure.h"

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
    void finish() { stream_.close(); }

  private:
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

void VdbWriter::finish() {
    writing([&] { archive_->finish(); });
}

}  // namespace trk
