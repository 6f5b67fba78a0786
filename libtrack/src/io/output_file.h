// SPDX-License-Identifier: Apache-2.0
// Files that appear whole or not at all.
#pragma once

#include <functional>
#include <string>

namespace trk {

/// A file being written. It has no name until commit(), so that neither an error nor a kill leaves
/// a part of it behind; where the file system cannot do that, it lies beside the target under a
/// temporary name, which the destructor and cleanUpOutputFiles() remove.
class OutputFile {
  public:
    /// Throws Error (IO): the folder is missing or read-only, the target is a directory, or it
    /// exists and `force` is false.
    OutputFile(std::string target, bool force);
    OutputFile(const OutputFile&) = delete;
    OutputFile& operator=(const OutputFile&) = delete;

    /// Path to open for writing until commit().
    const std::string& path() const { return path_; }
    const std::string& target() const { return target_; }

    /// Flushes to disk and gives the file its name. Throws Error (IO); the old file is then intact.
    void commit();

  private:
    /// Finds a free name beside the target; `create(name)` answers whether it made that file.
    void makeTemporaryName(const std::function<bool(const char*)>& create);

    /// Closed, and its temporary name removed, however the constructor ends.
    struct Resource {
        std::string temporaryName;  // empty while the file has none
        int descriptor = -1;

        ~Resource();
    };

    std::string target_;
    std::string path_;
    Resource resource_;
    bool force_;
};

/// A folder for output files, made where it was missing, and removed again, also by
/// cleanUpOutputFiles(), where nothing was put into it.
class OutputFolder {
  public:
    /// Throws Error (IO) where there is neither a folder nor a place to make one.
    explicit OutputFolder(std::string path);
    ~OutputFolder();
    OutputFolder(const OutputFolder&) = delete;
    OutputFolder& operator=(const OutputFolder&) = delete;

    std::string file(const std::string& name) const;

  private:
    std::string path_;
    bool made_ = false;
};

/// Where temporary files go: what TMPDIR names, or /tmp. Throws Error (IO) where that is no folder.
std::string temporaryFolder();

/// Removes temporary files, and empty folders, of this process (eight at a time).
/// Async-signal-safe: for handlers that end the process.
void cleanUpOutputFiles();

}  // namespace trk
