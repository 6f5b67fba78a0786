// SPDX-License-Identifier: Apache-2.0
// Any bytes, opened as a sidecar alone.
#include "fuzz_file.h"
#include "io/sidecar.h"

extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
    return fuzz::run(data, size, [](const std::string& path) {
        trk::readSidecar(path, nullptr, TRK_CHECK_FULL, trk::SidecarParts::kAll, fuzz::kMaxMemory);
    });
}
