// SPDX-License-Identifier: Apache-2.0
#include "output_file.h"

#include "../error.h"

#include <fcntl.h>
#include <sys/stat.h>
#include <unistd.h>

#include <cerrno>
#include <cstdio>
#include <cstring>
#include <filesystem>
#include <utility>

namespace trk {
namespace {

// What a signal handler removes: at most one temporary name at a time, in memory that never moves.
char temporaryPath[4096];
volatile bool haveTemporaryPath = false;

void rememberTemporary(const std::string& path) {
    haveTemporaryPath = false;
    if (path.size() < sizeof(temporaryPath)) {
        std::memcpy(temporaryPath, path.c_str(), path.size() + 1);
        haveTemporaryPath = true;
    }
}

[[noreturn]] void fail(const std::string& path, const std::string& what, int error) {
    throw Error(TRK_ERROR_IO, path + ": " + what + ": " + std::strerror(error));
}

}  // namespace

void cleanUpOutputFiles() {
    if (haveTemporaryPath) {
        unlink(temporaryPath);
    }
}

OutputFile::OutputFile(std::string target, bool force) : target_(std::move(target)), force_(force) {
    struct stat info {};
    if (stat(target_.c_str(), &info) == 0) {
        if (S_ISDIR(info.st_mode)) {
            throw Error(TRK_ERROR_IO, target_ + ": is a directory; expected a file name");
        }
        if (!force_) {
            throw Error(TRK_ERROR_IO, target_ + ": exists already; --force replaces it");
        }
    }
    std::string folder = std::filesystem::path(target_).parent_path().string();
    if (folder.empty()) {
        folder = ".";
    }
    descriptor_ = open(folder.c_str(), O_TMPFILE | O_WRONLY | O_CLOEXEC, 0666);
    if (descriptor_ >= 0) {
        path_ = "/proc/self/fd/" + std::to_string(descriptor_);
        return;
    }
    if (errno != EOPNOTSUPP && errno != EISDIR && errno != EINVAL) {
        fail(target_, "cannot be written", errno);
    }
    temporaryName_ = target_ + ".tmp" + std::to_string(getpid());
    descriptor_ = open(temporaryName_.c_str(), O_CREAT | O_EXCL | O_WRONLY | O_CLOEXEC, 0666);
    if (descriptor_ < 0) {
        const int error = errno;
        temporaryName_.clear();
        fail(target_, "cannot be written", error);
    }
    rememberTemporary(temporaryName_);
    path_ = temporaryName_;
}

OutputFile::~OutputFile() {
    if (!temporaryName_.empty()) {
        haveTemporaryPath = false;
        unlink(temporaryName_.c_str());
    }
    if (descriptor_ >= 0) {
        close(descriptor_);
    }
}

void OutputFile::commit() {
    if (fsync(descriptor_) != 0) {
        fail(target_, "cannot be flushed to disk", errno);
    }
    if (!force_) {
        // A hard link never replaces: of two writers, one fails.
        if (linkat(AT_FDCWD, path_.c_str(), AT_FDCWD, target_.c_str(), AT_SYMLINK_FOLLOW) != 0) {
            if (errno == EEXIST) {
                throw Error(
                    TRK_ERROR_IO,
                    target_ + ": was written by somebody else meanwhile; --force replaces it");
            }
            fail(target_, "cannot be written", errno);
        }
        return;
    }
    if (temporaryName_.empty()) {
        const std::string name = target_ + ".tmp" + std::to_string(getpid());
        rememberTemporary(name);
        if (linkat(AT_FDCWD, path_.c_str(), AT_FDCWD, name.c_str(), AT_SYMLINK_FOLLOW) != 0) {
            fail(target_, "cannot be written", errno);
        }
        temporaryName_ = name;
    }
    if (rename(temporaryName_.c_str(), target_.c_str()) != 0) {
        fail(target_, "cannot be replaced", errno);
    }
    haveTemporaryPath = false;
    temporaryName_.clear();
}

}  // namespace trk
