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
run bake "$vdb" -o "$sidecar" --size 4 --force
run verify "$vdb" "$sidecar"
run info "$sidecar"
scale=$(run preview "$sidecar" -o "$out/$name.png" --force 2>&1 | tee /dev/stderr |
        sed -n 's/.*, scale \([^ ,]*\).*/\1/p')
run preview "$sidecar" -o "$out/$name.exr" --scale "$scale" --force

# A few rays from the first corner of the volume's box to points of the opposite faces.
"$vdbtrack" info "$sidecar" --json | tr -d ' ,' | awk '
    /bounds_min|bounds_max/ { at = $0; n = 0; next }
    at != "" && n < 3 { v[at ~ /min/, n++] = $0 }
    END {
        print "# ox,oy,oz,dx,dy,dz"
        for (i = 1; i <= 5; ++i) {
            f = i / 6
            printf "%.9g,%.9g,%.9g,%.9g,%.9g,%.9g\n", v[1, 0], v[1, 1], v[1, 2],
                v[0, 0] - v[1, 0], (v[0, 1] - v[1, 1]) * f, (v[0, 2] - v[1, 2]) * (1 - 0.5 * f)
        }
    }' >"$out/rays.csv"
for method in exact residual; do
    run query "$vdb" --sidecar "$sidecar" --rays "$out/rays.csv" --method $method --scale "$scale"
done

cat <<TEXT

Done. In $out:
  $name.png  the baked control in sun and sky
  $name.exr  the same in float, with layers for transmittance and the depth at which half is left
  $name.track.vdb  the sidecar: an ordinary VDB with control and residual bounds
  rays.csv  the rays of the two tables above

Next: look at $out/$name.png, then try
  $vdbtrack --help
  apps/demo.sh YOUR_OWN.vdb
  $vdbtrack preview $sidecar -o $out/turn.png --frames 24
  $vdbtrack measure $vdb -o $out/report      (what to bake for this volume, and why: two minutes)
TEXT
