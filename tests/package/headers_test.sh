#!/usr/bin/env bash
# No header of ours hides one of the system's, the public ones compile without warnings in every standard
# that consumers use, and the library leaves its host's heap alone: headers_test.sh CXX SOURCE_DIR LIBRARY
set -uo pipefail
cxx=${1:?usage: headers_test.sh CXX SOURCE_DIR LIBRARY}
source=${2:?}
library=${3:?}
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
failures=0
fail() {
    echo "FAILED: $*" >&2
    failures=$((failures + 1))
}

ours=$(find "$source/libtrack" "$source/vdbtools" "$source/apps" -name '*.h' -o -name '*.hpp')
for name in $(for header in $ours; do basename "$header"; done | sort -u); do
    if echo "#include <$name>" | "$cxx" -E -x c++ - >/dev/null 2>&1; then
        fail "$name is also a header of the system"
    fi
done
# The negative control: the test would have seen the name that was wrong.
echo '#include <math.h>' | "$cxx" -E -x c++ - >/dev/null 2>&1 || fail "no system headers to compare with"

# Whoever has our sources on the include path still gets the standard's headers.
for name in assert ctype errno float limits locale math setjmp signal stdarg stddef stdio stdlib string time \
            error fcntl pthread sched semaphore unistd; do
    echo "#include <$name.h>"
done >"$work/standard.cpp"
cat >>"$work/standard.cpp" <<'CPP'
#include <algorithm>
#include <cmath>
#include <mutex>
#include <random>
#include <system_error>
#include <variant>
#include <vector>
int main() {
    error(0, 0, "%g", floor(std::sqrt(2.0)));
}
CPP
includes=$(find "$source/libtrack/src" "$source/vdbtools" "$source/apps" -type d -printf '-I%p ')
# shellcheck disable=SC2086
"$cxx" -std=c++17 $includes -fsyntax-only "$work/standard.cpp" || fail "the standard's headers are hidden"

cat >"$work/consumer.cpp" <<'CPP'
#include <track/track.hpp>
int main() {
    const track::Volume volume = track::Volume::open("cloud.vdb");
    track::Query query(16 * 1000 + 3, 1);
    track::Statistics statistics(1, volume.info().channels);
    track::FreePaths paths(1, volume.info().channels);
    TrkRay ray = {{0, 0, 0}, 0, {1, 0, 0}, 1};
    float transmittance = 0;
    volume.estimateTransmittance(query, &ray, 1, &transmittance, statistics.view());
    volume.sampleFreePath(query, &ray, 1, paths.view());
}
CPP
for standard in 17 20 23; do
    "$cxx" -std=c++$standard -Wall -Wextra -Wpedantic -Wshadow -Wconversion -Wsign-conversion -Wold-style-cast \
        -Werror -I"$source/libtrack/include" -fsyntax-only "$work/consumer.cpp" || fail "C++$standard"
done

# What feeds grids of OpenVDB, whose own headers do not compile without warnings.
cat >"$work/grids.cpp" <<'CPP'
#include <track/track_openvdb.hpp>
int main() {
    track::makeVolume(*openvdb::FloatGrid::create());
    track::makeVolume(*openvdb::Vec3DGrid::create());
}
CPP
"$cxx" -std=c++17 -Wall -Wextra -Wpedantic -Wshadow -Werror -isystem /usr/include/Imath \
    -I"$source/libtrack/include" -fsyntax-only "$work/grids.cpp" || fail "track_openvdb.hpp"

nm -D --undefined-only "$library" | grep -E 'malloc_trim|mallopt|setlocale|fesetround|sigaction' &&
    fail "the library changes what belongs to its host"
exit $((failures > 0))
