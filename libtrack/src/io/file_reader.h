// SPDX-License-Identifier: Apache-2.0
// Bytes of a file one after another, none of them trusted: no read goes beyond the file, or beyond
// the part of it that the reader was confined to.
#pragma once

#include <cstddef>
#include <cstdint>
#include <string>
#include <vector>

namespace trk {

/// Not thread-safe. Copies nothing of the file but a window of a fixed size.
class FileReader {
  public:
    /// Opens a regular file. Throws Error (IO).
    explicit FileReader(const std::string& path);
    ~FileReader();
    FileReader(const FileReader&) = delete;
    FileReader& operator=(const FileReader&) = delete;

    const std::string& path() const { return path_; }
    uint64_t bytes() const { return bytes_; }
    /// When it was written, in nanoseconds since 1970.
    int64_t modified() const { return modified_; }

    uint64_t position() const { return windowStart_ + next_; }
    uint64_t remaining() const { return end_ - position(); }

    /// What is being read, "FILE: grid density", say: errors begin with it.
    void setPlace(std::string place) { place_ = std::move(place); }
    const std::string& place() const { return place_; }

    /// Goes to `position`; nothing from `end` on is read. Both must lie in the file.
    void confine(uint64_t position, uint64_t end);

    void read(void* to, size_t bytes);
    void skip(uint64_t bytes);
    template <class T>
    T value() {
        T result;
        read(&result, sizeof(result));
        return result;
    }
    /// A text with its length in front. `what` names it where it is longer than `limit`.
    std::string text(size_t limit, const char* what);

    /// Throws BAD_FILE: the place, the byte, and what is wrong there.
    [[noreturn]] void refuse(const std::string& what) const;
    /// As refuse, unless so many bytes are left. To be asked before memory is taken for them.
    void expect(uint64_t bytes, const char* what) const;

  private:
    void fill();

    std::string path_;
    std::string place_;
    int file_ = -1;
    uint64_t bytes_ = 0;
    int64_t modified_ = 0;
    uint64_t end_ = 0;
    uint64_t windowStart_ = 0;
    size_t next_ = 0;  // in the window
    std::vector<char> window_;
};

}  // namespace trk
