#!/usr/bin/env bash
# Fuzzes the readers of densities and sidecars with libFuzzer (clang), under address and
# undefined-behaviour sanitizers, of the dev preset: tests/fuzz.sh [SECONDS each, 60]. What it finds
# lies in build/fuzz/found; the corpus grows in build/fuzz/corpus.
set -euo pipefail
cd "$(dirname "$0")/.."
seconds=${1:-60}

apps/install_packages.sh test
build() {
    cmake --preset "$1" -DCMAKE_CXX_COMPILER_LAUNCHER=ccache -DCMAKE_C_COMPILER_LAUNCHER=ccache >"build/configure-$1.log" || { cat "build/configure-$1.log"; exit 1; }
    cmake --build "build/$1" --target "${@:2}" >"build/build-$1.log" 2>&1 ||
        { grep -E -A5 'error' "build/build-$1.log" | head -80; exit 1; }
}
mkdir -p build
export CCACHE_BASEDIR=$PWD CCACHE_NOHASHDIR=1
build dev fuzz_density fuzz_sidecar make_corpus
mkdir -p build/fuzz/found
build/dev/tests/make_corpus build/fuzz/corpus
export ASAN_OPTIONS=allocator_may_return_null=1
for kind in density sidecar; do
    log=build/fuzz/$kind.log
    build/dev/tests/fuzz_$kind "build/fuzz/corpus/$kind" -max_total_time="$seconds" -timeout=10 \
        -rss_limit_mb=1024 -max_len=65536 -artifact_prefix=build/fuzz/found/$kind- -print_final_stats=1 >"$log" 2>&1 ||
        { tail -60 "$log"; echo "fuzz_$kind: failed"; exit 1; }
    echo "fuzz_$kind: $(grep -o 'number_of_executed_units: *[0-9]*' "$log" | grep -o '[0-9]*$') runs without a finding"
done
