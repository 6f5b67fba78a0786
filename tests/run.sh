#!/usr/bin/env bash
# Installs what is missing, builds, and runs all tests: in Release with warnings as errors, then with
# address and undefined-behaviour sanitizers; then damages files and fuzzes what reads them, for minutes.
# tests/run.sh release|dev runs one of the two alone.
set -euo pipefail
cd "$(dirname "$0")/.."

apps/install_packages.sh test

# Real volumes, where somebody has put them beside the project.
if [ -z "${TRACK_TEST_DATA:-}" ] && [ -d ../shared/data ]; then
    TRACK_TEST_DATA=$(realpath ../shared/data)
fi
export TRACK_TEST_DATA=${TRACK_TEST_DATA:-}
echo "Real volumes: ${TRACK_TEST_DATA:-none (their tests are skipped)}"

check_format() {
    local files
    mapfile -t files < <(git ls-files '*.h' '*.hpp' '*.c' '*.cpp' 2>/dev/null)
    if [ ${#files[@]} -gt 0 ]; then
        clang-format --dry-run -Werror "${files[@]}"
        echo "clang-format: ${#files[@]} files as they should be"
    fi
}

run_preset() {
    local preset=$1
    echo "== $preset =="
    cmake --preset "$preset" -DTRACK_WERROR=ON -DTRACK_BUILD_TESTS=ON \
        -DTRACK_BUILD_BENCH="$([ "$preset" = release ] && echo ON || echo OFF)" -DCMAKE_CXX_COMPILER_LAUNCHER=ccache \
        -DCMAKE_C_COMPILER_LAUNCHER=ccache >"build/configure-$preset.log" ||
        { cat "build/configure-$preset.log"; return 1; }
    cmake --build "build/$preset" >"build/build-$preset.log" 2>&1 ||
        { grep -E -A5 'error|warning' "build/build-$preset.log" | head -80; return 1; }
    ctest --preset "$preset" -j "$(nproc)"
}

mkdir -p build
# What one clone compiled serves the next.
export CCACHE_BASEDIR=$PWD CCACHE_NOHASHDIR=1
check_format
for preset in ${1:-release dev}; do
    run_preset "$preset"
done
if [ $# -eq 0 ]; then
    echo "== damaged files =="
    if [ -n "$TRACK_TEST_DATA" ]; then
        tests/corrupt.sh build/release "$TRACK_TEST_DATA" 5
    fi
    tests/fuzz.sh 60
fi
