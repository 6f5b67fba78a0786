#!/usr/bin/env bash
# Damages real files and asks every command that reads them: never a signal, more than 10 s of
# processor time or 1.7 GB of address space, more than one line, a file left behind, or exit 0 with other values than OpenVDB
# reads of the same bytes. tests/corrupt.sh BUILD_FOLDER FOLDER_OF_VDB_FILES [VARIANTS a file, 200]
set -uo pipefail
build=$(realpath "$1")
data=$(realpath "$2")
count=${3:-200}
vdbtrack=$build/bin/vdbtrack
variant=$build/tests/variant
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work" || exit 1
printf '0,0,0,1,1,1\n' >rays.csv
failures=0
fail() {
    echo "corrupt.sh: $*"
    failures=$((failures + 1))
    cp bad.vdb "${TMPDIR:-/tmp}/corrupt-$failures.vdb" 2>/dev/null
}
# Threads reserve address space beside the gigabyte that a command may take.
limited() { (ulimit -t 10 -v 1700000; exec "$@" >out.txt 2>err.txt); }

runs=0
refused=0
for file in "$data"/*.vdb; do
    name=$(basename "$file")
    for ((seed = 0; seed < count; ++seed)); do
        "$variant" make "$file" "$((seed + count * ($(printf '%s' "$name" | cksum | cut -d' ' -f1) % 1000)))" bad.vdb
        rm -f ./*.track.vdb
        for command in "bake bad.vdb -o bad.track.vdb" "info bad.vdb --values" "query bad.vdb --rays rays.csv" \
            "verify bad.vdb" "preview bad.track.vdb -o bad.png --resolution 32x32 --force"; do
            # shellcheck disable=SC2086
            limited "$vdbtrack" $command --quiet
            status=$?
            runs=$((runs + 1))
            [ $status -gt 1 ] && fail "$name variant $seed: $command: exit $status: $(head -1 err.txt)"
            [ $status -eq 1 ] && refused=$((refused + 1)) && [ "$(wc -l <err.txt)" -ne 1 ] &&
                fail "$name variant $seed: $command: not one line: $(head -2 err.txt)"
            case $command in bake*)
                [ $status -ne 0 ] && [ -e bad.track.vdb ] && fail "$name variant $seed: left a sidecar behind" ;;
            esac
        done
        rm -f bad.png
        [ "$(find . -type f | wc -l)" -le 6 ] || fail "$name variant $seed: left $(find . -type f | tr '\n' ' ')"
        "$variant" same bad.vdb >same.txt 2>&1
        status=$?
        if [ $status -gt 1 ] || grep -q "is read otherwise" same.txt; then
            fail "$name variant $seed: $(head -1 same.txt) (exit $status)"
        fi
    done
done
echo "corrupt.sh: $runs runs, $refused refused, $failures failures"
[ "$failures" -eq 0 ]
