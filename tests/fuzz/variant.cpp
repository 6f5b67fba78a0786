// SPDX-License-Identifier: Apache-2.0
// Variants of files for tests/corrupt.sh:
//   variant make IN SEED OUT   writes IN with something missing, repeated or changed
//   variant same FILE          whether every density that is read is what OpenVDB reads; else exit
//   1
#include "failure.h"
#include "io/density.h"
#include "support/same_as_openvdb.h"

#include <algorithm>
#include <cstdio>
#include <cstdlib>
#include <fstream>
#include <iterator>
#include <random>
#include <string>

namespace {

int make(const std::string& in, unsigned seed, const std::string& out) {
    std::ifstream stream(in, std::ios::binary);
    std::string bytes{std::istreambuf_iterator<char>(stream), std::istreambuf_iterator<char>()};
    std::mt19937_64 random(seed);
    // Half of the places are among the first bytes, where the structure is dense.
    const auto place = [&]() -> size_t {
        const size_t range = random() % 2 ? bytes.size() : std::min<size_t>(bytes.size(), 4000);
        return range == 0 ? 0 : random() % range;
    };
    switch (seed % 5) {
        case 0:
            bytes.resize(place());
            break;
        case 1:
            bytes.erase(place(), size_t{1} << random() % 12);
            break;
        case 2: {
            const size_t at = place();
            bytes.insert(at, bytes.substr(at, 1 + random() % 3000));
            break;
        }
        case 3:
            for (size_t k = 0; k < 8 && !bytes.empty(); ++k) {
                bytes[place()] = static_cast<char>(random());
            }
            break;
        default:
            if (!bytes.empty()) {
                bytes[place()] ^= static_cast<char>(1u << random() % 8);
            }
    }
    std::ofstream(out, std::ios::binary) << bytes;
    return 0;
}

int same(const std::string& path) {
    trk::VdbFile file(path);
    for (const trk::VdbEntry& entry : file.entries()) {
        trk::DensityOptions options;
        options.gridNamed = true;
        options.gridName = entry.name + "[" + std::to_string(entry.index) + "]";
        try {
            trk::loadDensity(path, options);
        } catch (const trk::Error&) {
            continue;
        }
        size_t leaves = 0;
        const std::string difference = fixtures::differenceToOpenVdb(path, entry, leaves);
        if (!difference.empty()) {
            std::printf("%s: grid %s: is read otherwise than by OpenVDB: %s\n", path.c_str(),
                        entry.label().c_str(), difference.c_str());
            return 1;
        }
    }
    return 0;
}

}  // namespace

int main(int argc, char** argv) {
    openvdb::initialize();
    const std::string mode = argc > 1 ? argv[1] : "";
    try {
        if (mode == "make" && argc == 5) {
            return make(argv[2], static_cast<unsigned>(std::strtoul(argv[3], nullptr, 10)),
                        argv[4]);
        }
        if (mode == "same" && argc == 3) {
            return same(argv[2]);
        }
    } catch (const std::exception& e) {
        std::printf("%s\n", e.what());
        return 1;
    }
    std::fprintf(stderr, "usage: variant make IN SEED OUT | variant same FILE\n");
    return 2;
}
