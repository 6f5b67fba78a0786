// SPDX-License-Identifier: Apache-2.0
// Writes a small density and its sidecar for the C test: argument 1 is the density's path.
#include "support/fixtures.h"

#include "volume.h"

#include <filesystem>

int main(int argc, char** argv) {
    if (argc != 2) {
        return 2;
    }
    namespace fs = std::filesystem;
    fs::copy_file(fixtures::cloudFile(64), argv[1], fs::copy_options::overwrite_existing);
    fixtures::bake(argv[1], trk::defaultSidecarPath(argv[1]), 8);
    return 0;
}
