// SPDX-License-Identifier: Apache-2.0
#include "file_reader.h"

#include "failure.h"

#include <fcntl.h>
#include <sys/stat.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <cstring>

namespace trk {
namespace {

constexpr size_t kWindow = size_t{1} << 18;

}  // namespace

FileReader::FileReader(const std::string& path) : path_(path), place_(path) {
    file_ = ::open(path.c_str(), O_RDONLY | O_CLOEXEC | O_NONBLOCK);
    if (file_ < 0) {
        throw Error(TRK_ERROR_IO, path + ": cannot be opened: " + std::strerror(errno));
    }
    struct stat info = {};
    fstat(file_, &info);  // of an open file; what fails is no regular file
    if (!S_ISREG(info.st_mode)) {
        ::close(file_);
        throw Error(TRK_ERROR_IO,
                    path + (S_ISDIR(info.st_mode) ? ": is a directory" : ": is no regular file") +
                        "; expected a .vdb file");
    }
    bytes_ = end_ = static_cast<uint64_t>(info.st_size);
    modified_ = int64_t{info.st_mtim.tv_sec} * 1000000000 + info.st_mtim.tv_nsec;
}

FileReader::~FileReader() {
    ::close(file_);
}

void FileReader::confine(uint64_t position, uint64_t end) {
    if (position > end || end > bytes_) {
        throw Error(TRK_ERROR_BAD_FILE, place_ + ": the file ends early, at byte " +
                                            std::to_string(bytes_) + " of " + std::to_string(end) +
                                            " (truncated or damaged)");
    }
    end_ = end;
    if (position >= windowStart_ && position <= windowStart_ + window_.size()) {
        next_ = static_cast<size_t>(position - windowStart_);
    } else {
        windowStart_ = position;
        next_ = 0;
        window_.clear();
    }
}

void FileReader::fill() {
    windowStart_ += next_;
    next_ = 0;
    window_.resize(static_cast<size_t>(std::min<uint64_t>(kWindow, bytes_ - windowStart_)));
    for (size_t got = 0; got < window_.size();) {
        const ssize_t n = ::pread(file_, window_.data() + got, window_.size() - got,
                                  static_cast<off_t>(windowStart_ + got));
        if (n < 0 && errno == EINTR) {
            continue;
        }
        if (n < 0) {
            throw Error(TRK_ERROR_IO, path_ + ": cannot be read: " + std::strerror(errno));
        }
        if (n == 0) {
            window_.resize(got);
            refuse("the file was cut short while it was read");
        }
        got += static_cast<size_t>(n);
    }
}

void FileReader::read(void* to, size_t bytes) {
    expect(bytes, "data");
    for (auto* out = static_cast<char*>(to); bytes > 0;) {
        if (next_ == window_.size()) {
            fill();
        }
        const size_t part = std::min(bytes, window_.size() - next_);
        std::memcpy(out, window_.data() + next_, part);
        next_ += part;
        out += part;
        bytes -= part;
    }
}

void FileReader::skip(uint64_t bytes) {
    expect(bytes, "data");
    confine(position() + bytes, end_);
}

std::string FileReader::text(size_t limit, const char* what) {
    const auto size = value<uint32_t>();
    if (size > limit) {
        refuse(std::string(what) + " of " + std::to_string(size) + " bytes; expected at most " +
               std::to_string(limit));
    }
    expect(size, what);
    std::string result(size, '\0');
    read(result.data(), size);
    return result;
}

void FileReader::refuse(const std::string& what) const {
    throw Error(TRK_ERROR_BAD_FILE,
                place_ + ": damaged at byte " + std::to_string(position()) + ": " + what);
}

void FileReader::expect(uint64_t bytes, const char* what) const {
    if (bytes > remaining()) {
        refuse((end_ == bytes_ ? "the file ends early: " : "the grid ends early: ") +
               std::to_string(bytes) + " bytes of " + what + " expected, " +
               std::to_string(remaining()) + " found");
    }
}

}  // namespace trk
