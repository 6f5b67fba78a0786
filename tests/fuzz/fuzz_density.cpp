// SPDX-License-Identifier: Apache-2.0
// Any bytes, read as a density.
#include "fuzz_file.h"
#include "io/density.h"
#include "io/vdb_file.h"

#include <algorithm>

extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
    return fuzz::run(data, size, [](const std::string& path) {
        trk::DensityOptions options;
        options.maxMemory = fuzz::kMaxMemory;
        options.repair = TRK_REPAIR_CLAMP_NEGATIVE | TRK_REPAIR_DROP_NONFINITE;
        // By each name: a foreign grid must not keep another one from being read.
        const trk::VdbFile file(path);
        options.gridNamed = true;
        for (size_t i = 0; i < std::min<size_t>(file.entries().size(), 4); ++i) {
            const trk::VdbEntry& entry = file.entries()[i];
            options.gridName = entry.name + "[" + std::to_string(entry.index) + "]";
            try {
                trk::loadDensity(path, options);
            } catch (const trk::Error&) {
            }
        }
    });
}
