#!/usr/bin/env bash
# From nothing to a picture: installs what is missing, builds, and runs the main job on a procedural
# cloud, or on the density given: apps/demo.sh [FILE.vdb]
set -euo pipefail

if [ "${1:-}" = --help ] || [ "${1:-}" = -h ] || [ $# -gt 1 ]; then
    sed -n '2,3s/^# //p' "$0"
    exit $(($# > 1 ? 2 : 0))
fi
given=""
if [ $# -eq 1 ]; then
    if [ ! -r "$1" ]; then
        echo "demo.sh: $1: no such file, or not readable" >&2
        exit 1
    fi
    given=$(realpath "$1")
fi
cd "$(dirname "$0")/.."

apps/install_packages.sh
echo "Building (the first time, OpenVDB's headers make it take a minute or two) ..."
log=build/demo.log
mkdir -p build
if ! { cmake -S . -B build/demo -G Ninja -DCMAKE_BUILD_TYPE=Release -DTRACK_BUILD_TESTS=OFF &&
       cmake --build build/demo; } >"$log" 2>&1; then
    tail -n 30 "$log" >&2
    echo "demo.sh: the build failed; its output is in $log" >&2
    exit 1
fi
vdbtrack=build/demo/bin/vdbtrack

out=demo-output
mkdir -p "$out"
run() {
    echo
    echo "\$ vdbtrack $*"
    "$vdbtrack" "$@"
}
if [ -n "$given" ]; then
    name=$(basename "$given" .vdb)
    vdb=$given
else
    name=cloud
    vdb=$out/cloud.vdb
    run make "$vdb" --force
fi
sidecar=$out/$name.track.vdb
run bake "$vdb" -o "$sidecar" --force
run verify "$vdb" "$sidecar"
run info "$sidecar" --values
run preview "$sidecar" -o "$out/$name.png" --force
run preview "$sidecar" -o "$out/$name.exr" --force

# A few rays from the first corner of the volume's box to points of the opposite faces, at the scale of
# the pictures.
"$vdbtrack" info "$sidecar" --values --json >"$out/$name.json"
scale=$(sed -n 's/.*"preview_scale": \([^,]*\).*/\1/p' "$out/$name.json")
tr -d ' ,' <"$out/$name.json" | awk '
    /bounds_min|bounds_max/ { at = $0; n = 0; next }
    at != "" && n < 3 { v[at ~ /min/, n++] = $0 }
    END {
        print "ox,oy,oz,dx,dy,dz"
        for (i = 1; i <= 5; ++i) {
            f = i / 6
            printf "%.9g,%.9g,%.9g,%.9g,%.9g,%.9g\n", v[1, 0], v[1, 1], v[1, 2],
                v[0, 0] - v[1, 0], (v[0, 1] - v[1, 1]) * f, (v[0, 2] - v[1, 2]) * (1 - 0.5 * f)
        }
    }' >"$out/rays.csv"
for method in exact residual; do
    echo
    echo "\$ vdbtrack query $vdb --sidecar $sidecar --rays $out/rays.csv --method $method --scale $scale"
    "$vdbtrack" query "$vdb" --sidecar "$sidecar" --rays "$out/rays.csv" --method $method --scale "$scale" \
        -o "$out/$method.csv" --force
    cat "$out/$method.csv"
done
echo
echo "How far the estimates lie from the exact values, in their standard errors (|z| above 3 is rare):"
paste -d, "$out/exact.csv" "$out/residual.csv" | awk -F, 'NR > 1 {
    z = ($8 > 0) ? sprintf("%+.2f", ($7 - $2) / $8) : "- (both exact)"
    print "  ray " $1 ": z = " z }'

cat <<TEXT

Done. In $out:
  $name.png  the means that the sidecar holds, in sun and sky
  $name.exr  the same in float, with layers for transmittance and the depth at which half is left
  $name.track.vdb  the sidecar: an ordinary VDB with control and residual bounds
  rays.csv, exact.csv, residual.csv  the rays of the two tables above, and their answers

Next: look at $out/$name.png, then try
  $vdbtrack --help
  apps/demo.sh YOUR_OWN.vdb
  $vdbtrack preview $sidecar -o $out/turn.png --frames 24
  $vdbtrack measure $vdb -o $out/report      (what to bake for this volume, and why: two minutes)
TEXT
