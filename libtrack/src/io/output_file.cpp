// SPDX-License-Identifier: Apache-2.0
#include "output_file.h"

#include "failure.h"

#include <fcntl.h>
#include <sys/stat.h>
#include <unistd.h>

#include <atomic>
#include <cerrno>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <filesystem>
#include <utility>

namespace trk {
namespace {

// What a signal handler removes: temporary names, in memory that never moves.
struct TemporaryName {
    char path[4096];
    std::atomic<bool> taken{false};
    std::atomic<bool> complete{false};
};
TemporaryName temporaryNames[8];

void rememberTemporary(const std::string& path) {
    for (TemporaryName& name : temporaryNames) {
        if (path.size() < sizeof(name.path) && !name.taken.exchange(true)) {
            std::memcpy(name.path, path.c_str(), path.size() + 1);
            name.complete = true;
            return;
        }
    }
}

void forgetTemporary(const std::string& path) {
    for (TemporaryName& name : temporaryNames) {
        if (name.complete && path == name.path) {
            name.complete = false;
            name.taken = false;
            return;
        }
    }
}

[[noreturn]] void fail(const std::string& path, const std::string& what, int error) {
    throw Error(TRK_ERROR_IO, path + ": " + what + ": " + std::strerror(error));
}

}  // namespace

void cleanUpOutputFiles() {
    for (const TemporaryName& name : temporaryNames) {
        if (name.complete) {
            unlink(name.path);
        }
    }
    for (const TemporaryName& name : temporaryNames) {
        if (name.complete) {
            rmdir(name.path);  // of a folder, where it is empty
        }
    }
}

OutputFolder::OutputFolder(std::string path) : path_(std::move(path)) {
    std::error_code error;
    made_ = std::filesystem::create_directory(path_, error);
    if (error || !std::filesystem::is_directory(path_)) {
        throw Error(TRK_ERROR_IO, path_ + ": expected a folder, or a place to make one: " +
                                      (error ? error.message() : "is a file"));
    }
    if (made_) {
        rememberTemporary(path_);
    }
}

OutputFolder::~OutputFolder() {
    if (made_) {
        forgetTemporary(path_);
        rmdir(path_.c_str());
    }
}

std::string OutputFolder::file(const std::string& name) const {
    return (std::filesystem::path(path_) / name).string();
}

std::string temporaryFolder() {
    std::error_code error;
    const std::filesystem::path folder = std::filesystem::temp_directory_path(error);
    if (error) {
        const char* named = std::getenv("TMPDIR");
        throw Error(TRK_ERROR_IO,
                    std::string(named ? named : "/tmp") +
                        ": expected a folder for temporary files (TMPDIR): " + error.message());
    }
    return folder.string();
}

OutputFile::OutputFile(std::string target, bool force) : target_(std::move(target)), force_(force) {
    if (target_.empty()) {
        throw Error(TRK_ERROR_IO, "the output has no name");
    }
    struct stat info = {};
    const bool replaces = stat(target_.c_str(), &info) == 0;
    if (!replaces && std::filesystem::is_symlink(target_)) {
        throw Error(TRK_ERROR_IO, target_ + ": is a link to a file that does not exist, " +
                                      std::filesystem::read_symlink(target_).string() +
                                      "; expected a file, or a link to one");
    }
    if (replaces) {
        if (S_ISDIR(info.st_mode)) {
            throw Error(TRK_ERROR_IO, target_ + ": is a directory; expected a file name");
        }
        if (!S_ISREG(info.st_mode)) {
            throw Error(
                TRK_ERROR_IO,
                target_ + ": is a device or pipe, which would be replaced; expected a file");
        }
        if (std::filesystem::is_symlink(target_)) {  // replace what it points to, not the link
            target_ = std::filesystem::canonical(target_).string();
        }
        if (!force_) {
            throw Error(TRK_ERROR_IO,
                        target_ + ": exists already, and replacing it was not asked for");
        }
    }
    std::string folder = std::filesystem::path(target_).parent_path().string();
    if (folder.empty()) {
        folder = ".";
    }
    resource_.descriptor = open(folder.c_str(), O_TMPFILE | O_WRONLY | O_CLOEXEC, 0666);
    if (resource_.descriptor >= 0) {
        path_ = "/proc/self/fd/" + std::to_string(resource_.descriptor);
    } else if (errno != EOPNOTSUPP && errno != EISDIR && errno != EINVAL) {
        fail(target_, "cannot be written", errno);
    } else {
        makeTemporaryName([&](const char* name) {
            resource_.descriptor = open(name, O_CREAT | O_EXCL | O_WRONLY | O_CLOEXEC, 0666);
            return resource_.descriptor >= 0;
        });
        path_ = resource_.temporaryName;
    }
    if (replaces && fchmod(resource_.descriptor, info.st_mode & 07777) != 0) {
        fail(target_, "cannot keep its permissions", errno);
    }
}

OutputFile::Resource::~Resource() {
    if (!temporaryName.empty()) {
        forgetTemporary(temporaryName);
        unlink(temporaryName.c_str());
    }
    if (descriptor >= 0) {
        close(descriptor);
    }
}

void OutputFile::makeTemporaryName(const std::function<bool(const char*)>& create) {
    for (int attempt = 0;; ++attempt) {  // a killed process of the same number may have left one
        const std::string name =
            target_ + ".tmp" + std::to_string(getpid()) + "-" + std::to_string(attempt);
        if (create(name.c_str())) {
            resource_.temporaryName = name;
            rememberTemporary(name);
            return;
        }
        if (errno != EEXIST || attempt > 1000) {
            fail(target_, "cannot be written", errno);
        }
    }
}

void OutputFile::commit() {
    if (fsync(resource_.descriptor) != 0) {
        fail(target_, "cannot be flushed to disk", errno);
    }
    const auto linkTo = [&](const char* name) {
        return linkat(AT_FDCWD, path_.c_str(), AT_FDCWD, name, AT_SYMLINK_FOLLOW) == 0;
    };
    const auto failIfTaken = [&] {
        if (errno == EEXIST) {
            throw Error(
                TRK_ERROR_IO,
                target_ +
                    ": was written by somebody else meanwhile, and replacing it was not asked for");
        }
    };
    if (resource_.temporaryName.empty()) {
        if (!force_ && linkTo(target_.c_str())) {  // never replaces: of two writers, one fails
            return;
        }
        if (!force_) {
            failIfTaken();
        }
        makeTemporaryName(linkTo);
    }
    if (!force_) {
        if (renameat2(AT_FDCWD, resource_.temporaryName.c_str(), AT_FDCWD, target_.c_str(),
                      RENAME_NOREPLACE) == 0) {
            forgetTemporary(resource_.temporaryName);
            resource_.temporaryName.clear();
            return;
        }
        failIfTaken();
        // A file system that cannot do either: the check of the constructor must do.
    }
    if (rename(resource_.temporaryName.c_str(), target_.c_str()) != 0) {
        fail(target_, force_ ? "cannot be replaced" : "cannot be written", errno);
    }
    forgetTemporary(resource_.temporaryName);
    resource_.temporaryName.clear();
}

}  // namespace trk
