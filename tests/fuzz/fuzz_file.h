// SPDX-License-Identifier: Apache-2.0
// A fuzzer's bytes as a file that has no place on disk.
#pragma once

#include <sys/mman.h>
#include <tbb/task_arena.h>
#include <unistd.h>

#include <cstddef>
#include <cstdint>
#include <cstdlib>
#include <string>

#include "failure.h"

namespace fuzz {

constexpr uint64_t kMaxMemory = uint64_t{64} << 20;

/// Calls body(path of a file of these bytes) on one thread. Whatever the bytes are, the library may
/// throw an Error and nothing else.
template <class Body>
int run(const uint8_t* data, size_t size, const Body& body) {
    static const int kFile = memfd_create("fuzz", 0);
    if (kFile < 0 || ftruncate(kFile, 0) != 0 ||
        pwrite(kFile, data, size, 0) != static_cast<ssize_t>(size)) {
        std::abort();
    }
    static tbb::task_arena arena(1);
    arena.execute([&] {
        try {
            body("/proc/self/fd/" + std::to_string(kFile));
        } catch (const trk::Error&) {
        }
    });
    return 0;
}

}  // namespace fuzz
