// SPDX-License-Identifier: Apache-2.0
// The one exception of the library: a status of the C API and the line its user reads.
#pragma once

#include "track/track.h"

#include <stdexcept>
#include <string>

namespace trk {

class Error : public std::runtime_error {
  public:
    Error(TrkStatus status, const std::string& message)
        : std::runtime_error(oneLine(message)), status_(status) {}
    TrkStatus status() const noexcept { return status_; }

  private:
    /// Messages quote what files say of themselves, and damaged ones say anything.
    static std::string oneLine(std::string text) {
        for (char& c : text) {
            c = static_cast<unsigned char>(c) < ' ' || c == 0x7f ? '?' : c;
        }
        return text;
    }

    TrkStatus status_;
};

/// First line of an exception's message: errors are one line.
inline std::string firstLine(const std::exception& e) {
    const std::string text = e.what();
    return text.substr(0, text.find('\n'));
}

}  // namespace trk
