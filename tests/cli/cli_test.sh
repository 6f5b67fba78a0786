#!/usr/bin/env bash
# The program as its users meet it: cli_test.sh VDBTRACK CASE. Without a case, lists them.
set -uo pipefail

vdbtrack=${1:?usage: cli_test.sh VDBTRACK CASE}
data=${TRACK_TEST_DATA:-}
project=$(realpath "$(dirname "$0")/../..")
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work" || exit 1

failures=0
fail() {
    echo "FAILED: $*" >&2
    failures=$((failures + 1))
}

# expect CODE ARGUMENTS...: runs vdbtrack; stdout and stderr go to files of those names.
expect() {
    local code=$1
    shift
    "$vdbtrack" "$@" >stdout 2>stderr </dev/null
    local found=$?
    [ "$found" = "$code" ] || fail "vdbtrack $*: exit $found, expected $code: $(cat stderr)"
}
# One clear line on stderr that contains TEXT, and nothing on stdout.
one_line() {
    [ "$(wc -l <stderr)" = 1 ] || fail "expected one line on stderr, found: $(cat stderr)"
    grep -qF -- "$1" stderr || fail "expected \"$1\" in: $(cat stderr)"
    [ ! -s stdout ] || fail "data on stdout after an error: $(head -n 3 stdout)"
}
contains() {
    grep -qF -- "$2" "$1" || fail "expected \"$2\" in $1: $(head -n 5 "$1")"
}
exists() { [ -s "$1" ] || fail "$1 is missing or empty"; }
absent() { [ ! -e "$1" ] || fail "$1 exists"; }

small_cloud() { "$vdbtrack" make cloud.vdb --voxels 48 --quiet || fail "make"; }
baked_cloud() {
    small_cloud
    "$vdbtrack" bake cloud.vdb --size 8 --quiet || fail "bake"
}
some_rays() {
    cat >rays.csv <<'CSV'
# through the middle, along an axis, a miss, an interval
ox,oy,oz,dx,dy,dz,tmin,tmax
-5,4,5,1,0.02,0.01,0,inf
5,20,5,0,-1,0,0,1000
50,50,50,1,0,0,0,inf

5,4,5,1,0,0,0,0.5
CSV
}

# Both kernels, where the processor has them, agree but for last bits.
case_kernels() {
    baked_cloud
    some_rays
    local method
    TRACK_KERNEL=baseline "$vdbtrack" info --values cloud.vdb | grep -q 'kernel *baseline' || fail "info names no kernel"
    for method in exact residual ratio control; do
        for kernel in baseline best; do
            TRACK_KERNEL=$kernel "$vdbtrack" query cloud.vdb --rays rays.csv --method $method >$kernel.csv ||
                fail "query --method $method by the kernel $kernel"
        done
        "$vdbtrack" query cloud.vdb --rays rays.csv --method $method --kernel baseline | cmp - baseline.csv ||
            fail "--kernel and TRACK_KERNEL differ"
        paste -d, baseline.csv best.csv | awk -F, 'NR == 1 { next }
            { for (i = 1; i <= NF / 2; ++i) {
                  d = $i - $(i + NF / 2)
                  if (d * d > 1e-10) exit 1
              }
              ++rows }
            END { if (rows != 4) exit 1 }' || fail "kernels differ: $(paste -d, baseline.csv best.csv)"
    done
    expect 1 query cloud.vdb --rays rays.csv --kernel sse
    contains stderr 'kernel is "sse"; expected "baseline" or "avx2"'
}

case_help() {
    expect 0 --help
    contains stdout "vdbtrack bake IN.vdb"
    expect 0 --version
    contains stdout "vdbtrack 0."
    for command in make bake info verify query preview measure; do
        expect 0 "$command" --help
        contains stdout "usage: vdbtrack $command"
        [ ! -s stderr ] || fail "$command --help writes to stderr"
    done
    expect 0 bake --help
    contains stdout "(=16)"
}

case_usage() {
    small_cloud
    expect 2
    contains stderr "no command"
    expect 2 paint
    contains stderr 'unknown command "paint"'
    usage() {
        local text=$1
        shift
        expect 2 "$@"
        contains stderr "$text"
        contains stderr "usage: vdbtrack $1"
        [ ! -s stdout ] || fail "usage error with data on stdout"
    }
    usage "--wrong" bake cloud.vdb --wrong
    usage "missing argument IN.vdb" bake
    usage "too many arguments" bake a.vdb b.vdb
    usage "--size 12" bake cloud.vdb --size 12
    usage "--size 128" bake cloud.vdb --size 128
    usage "size" bake cloud.vdb --size big
    usage "--control cubic" bake cloud.vdb --control cubic
    usage "--levels 99" bake cloud.vdb --levels 99
    usage "--threads -1" bake cloud.vdb --threads -1
    usage "--kind fog" make x.vdb --kind fog
    usage "--voxels 3" make x.vdb --voxels 3
    usage "missing --rays" query cloud.vdb
    usage "--method magic" query cloud.vdb --rays r.csv --method magic
    usage "--choice best" query cloud.vdb --rays r.csv --method residual --choice best
    usage "--samples 0" query cloud.vdb --rays r.csv --method ratio --samples 0
    usage "--error" query cloud.vdb --rays r.csv --method ratio --error 0
    usage "--rate" query cloud.vdb --rays r.csv --method ratio --rate 0
    usage "--scale" query cloud.vdb --rays r.csv --scale -1
    usage "--scale" query cloud.vdb --rays r.csv --scale nan
    usage "--resolution 0x5" preview x --resolution 0x5
    usage "--resolution 70000x5" preview x --resolution 70000x5
    usage "--resolution 5" preview x --resolution 5
    usage "--up x" preview x --up x
    usage "--light 1" preview x --light 1
    usage "--light 0,95" preview x --light 0,95
    usage "--half: of no use for a PNG" preview x --half
    usage "--first: of no use without --frames" preview x --first 7
    usage "--no-sky: of no use with --transmittance" preview x --transmittance --no-sky
    usage "--scale and --scale-from" preview x --scale 2 --scale-from y
    usage "--view back" preview x --view back
    usage "--frames 0" preview x --frames 0
    usage "--color 1,2" preview x --color 1,2
    usage "--color 1,-2,3" query cloud.vdb --rays r.csv --color 1,-2,3
    usage "--color 1,x,3" query cloud.vdb --rays r.csv --color 1,x,3
    usage "--camera 1,2" preview x --camera 1,2
    usage ".png or .exr" preview x -o x.jpg
    absent cloud.track.vdb
    absent x.vdb
}

case_main_job() {
    expect 0 make cloud.vdb --voxels 64
    contains stderr "active voxels"
    exists cloud.vdb
    expect 0 bake cloud.vdb
    exists cloud.track.vdb
    expect 0 verify cloud.vdb
    contains stderr "all bounds hold"
    expect 0 info cloud.vdb
    contains stdout "VDB version 224, written by OpenVDB"
    contains stdout "bake          yes, if its values are fit"
    contains stdout "compression   "
    contains stdout "index space, "
    expect 0 info cloud.vdb --values
    contains stdout "bake          yes"
    contains stdout "bounds"
    expect 0 info cloud.vdb --estimate
    contains stdout "to bake       at most "
    expect 2 info cloud.track.vdb --estimate
    expect 0 info cloud.track.vdb
    contains stdout "16^3 voxels"
    contains stdout "format        2.0"
    contains stdout "digest "
    expect 0 preview cloud.track.vdb -o cloud.png --resolution 64x48
    contains stderr "(of the sidecar), means of"
    [ "$(head -c 4 cloud.png | tail -c 3)" = PNG ] || fail "cloud.png is no PNG"
    expect 0 preview cloud.track.vdb -o cloud.exr --level 0 --view top --scale 2
    [ "$(od -An -tx1 -N4 cloud.exr | tr -d ' ')" = 762f3101 ] || fail "cloud.exr is no EXR"
    for attribute in track:scale track:eye track:source transmittance.G halfDepth.Z sky.B worldToCamera worldToNDC; do
        grep -qa "$attribute" cloud.exr || fail "cloud.exr lacks $attribute"
    done
    expect 0 preview cloud.track.vdb
    exists cloud.track.png
    # A finer picture than its super-voxels of 16 allow: the sidecar has means for it.
    expect 0 preview cloud.track.vdb -o level.png --level 0
    contains stderr "level 0"
    cmp -s level.png cloud.track.png && fail "the finest means are not drawn"
    expect 0 preview cloud.track.vdb -o half.exr --half --no-sky --resolution 32x32
    grep -qa sky.B half.exr && fail "--no-sky draws a sky"
    expect 0 preview cloud.track.vdb -o alpha.png --no-sky --resolution 32x32
    [ "$(od -An -tu1 -j25 -N1 alpha.png | tr -d ' ')" = 6 ] || fail "a PNG without sky has no alpha"
    for options in "--up z" "--light 90,10" "--light 90,80"; do
        # shellcheck disable=SC2086
        expect 0 preview cloud.track.vdb -o other.png --resolution 64x48 --force $options
        cmp -s other.png cloud.png && fail "$options changes nothing"
    done
    # One scale for a sequence.
    "$vdbtrack" make other.vdb --kind smoke --voxels 32 --quiet
    expect 0 bake other.vdb
    contains stderr "grid density"
    contains stderr "preview scale"
    expect 0 preview other.track.vdb --scale-from cloud.track.vdb
    contains stderr "(of cloud.track.vdb)"
    some_rays
    expect 0 query cloud.vdb --rays rays.csv
    [ "$(wc -l <stdout)" = 5 ] || fail "expected a header and 4 rows"
}

case_colour() {
    expect 0 make color.vdb --kind color-cloud --voxels 48
    contains stderr "color-cloud"
    some_rays
    for control in constant trilinear affine; do
        expect 0 bake color.vdb --size 8 --control $control --force
        expect 0 verify color.vdb
        contains stderr "all bounds hold"
        expect 0 info color.track.vdb --values
        contains stdout "channels      3"
        contains stdout "control       $control"
        contains stdout "residual RMS"
        expect 0 query color.vdb --rays rays.csv --method exact --color 1,0.5,0
        header=ray,transmittance_r,transmittance_g,transmittance_b,stderr_r,stderr_g,stderr_b
        header=$header,optical_depth_r,optical_depth_g,optical_depth_b,lookups
        [ "$(head -n 1 stdout)" = "$header" ] || fail "header: $(head -n 1 stdout)"
        awk -F, 'NR > 1 && ($4 != 1 || NF != 11) { exit 1 }' stdout || fail "rows: $(cat stdout)"
        awk -F, 'NR == 2 && !($2 < 1 && $3 < 1 && $2 != $3) { exit 1 }' stdout ||
            fail "channels that should differ: $(cat stdout)"
        cp stdout exact.csv
        expect 0 query color.vdb --rays rays.csv --method residual --samples 4000 --color 1,0.5,0
        paste -d, exact.csv stdout | awk -F, 'NR > 1 {
            for (c = 2; c <= 4; ++c) {
                d = $c - $(c + 11); if (d < 0) d = -d
                if (d > 5 * $(c + 14) + 1e-6) { print; exit 1 }
            } }' >bad || fail "$control: $(cat bad)"
        expect 0 preview color.track.vdb -o color.png --resolution 32x32 --force
        expect 0 preview color.track.vdb --transmittance -o plain.png --resolution 32x32 --force
        cmp -s color.png plain.png && fail "--transmittance draws the lit picture"
    done
    small_cloud
    expect 0 bake cloud.vdb --size 8 --control affine
    expect 2 query cloud.vdb --rays rays.csv --method residual --choice max
    contains stderr "--choice max: the control of cloud.track.vdb is affine"
    expect 0 query cloud.vdb --rays rays.csv --color 2,2,2
    [ "$(head -n 1 stdout)" = "ray,transmittance,stderr,optical_depth,lookups" ] ||
        fail "a tint that is none: $(head -n 1 stdout)"
    expect 0 query cloud.vdb --rays rays.csv --color 2,2,1
    contains stdout "transmittance_b"
    # A volume so thin that every corner of a trilinear control lies beside nothing.
    expect 0 make thin.vdb --voxels 16
    expect 0 bake thin.vdb --size 64 --control trilinear
    contains stderr "keeps 0 % of the density's mass"
}

case_turntable() {
    baked_cloud
    expect 0 preview cloud.track.vdb -o turn.png --frames 3 --resolution 40x30
    for frame in 0001 0002 0003; do
        exists turn.$frame.png
    done
    absent turn.0004.png
    absent turn.png
    cmp -s turn.0001.png turn.0002.png && fail "the camera does not turn"
    expect 0 preview cloud.track.vdb -o 'a.##.exr' --frames 2 --resolution 8x8 --level 1
    exists a.01.exr
    exists a.02.exr
    expect 0 preview cloud.track.vdb -o 'b%03d.png' --frames 1 --resolution 8x8 --view side
    exists b001.png
    rm turn.0001.png turn.0003.png
    expect 1 preview cloud.track.vdb -o turn.png --frames 3 --resolution 40x30
    one_line "turn.0002.png: exists already"
    absent turn.0001.png
    for command in "preview cloud.track.vdb -o x.png" \
        "query cloud.vdb --rays rays.csv --method control"; do
        some_rays
        # shellcheck disable=SC2086
        expect 2 $command --level 5
        contains stderr "--level 5: expected 0 to 1, the levels of cloud.track.vdb"
    done
    absent x.png
    mkdir 'd#1'
    expect 0 preview cloud.track.vdb -o 'd#1/f.png' --frames 2 --resolution 8x8
    exists 'd#1/f.0002.png'
    expect 0 preview cloud.track.vdb -o away.png --resolution 8x8 --camera 20,20,20,40,40,40,30
    expect 0 preview cloud.track.vdb -o 'shot.####.png' --frames 2 --first 1001 --resolution 8x8
    exists shot.1001.png
    exists shot.1002.png
    expect 1 preview cloud.track.vdb -o huge.png --resolution 65536x65536
    one_line "huge.png: 65536x65536 pixels need"
    absent huge.png
}

case_kinds_and_seeds() {
    for kind in cloud smoke; do
        expect 0 make $kind.vdb --kind $kind --voxels 48
        expect 0 bake $kind.vdb --size 4
        expect 0 verify $kind.vdb
    done
    expect 0 make a.vdb --voxels 48 --seed 1 --threads 1
    expect 0 make b.vdb --voxels 48 --seed 1
    expect 0 make c.vdb --voxels 48 --seed 2
    # A sidecar fits any file with the same voxels, and no other.
    expect 0 bake a.vdb
    expect 0 verify b.vdb a.track.vdb
    expect 1 verify c.vdb a.track.vdb
    one_line "other voxels"
}

case_query_output() {
    baked_cloud
    some_rays
    expect 0 query cloud.vdb --rays rays.csv --method exact
    [ "$(head -n 1 stdout)" = "ray,transmittance,stderr,optical_depth,lookups" ] || fail "header"
    [ "$(sed -n 4p stdout)" = "2,1,0,0,0" ] || fail "a miss: $(sed -n 4p stdout)"
    awk -F, 'NR > 1 && ($2 < 0 || $2 > 1 || $3 != 0 || $4 < 0) { exit 1 }' stdout ||
        fail "exact rows: $(cat stdout)"
    cp stdout exact.csv
    for method in "residual --choice robust" "residual --choice mean" "residual --choice min" \
        "residual --choice max" "residual --rate-base rms --rate 3" "residual --roulette" \
        ratio "ratio --global" "residual --global" "ratio --rate-base rms --rate 2" \
        delta "delta --global --rate 2"; do
            # shellcheck disable=SC2086
            expect 0 query cloud.vdb --rays rays.csv --method $method --samples 4000
            # Within 5 standard errors of the exact value (a miss has an error of 0).
            paste -d, exact.csv stdout | awk -F, 'NR > 1 {
                d = $2 - $7; if (d < 0) d = -d
                if (d > 5 * $8 + 1e-6 || $9 != "") { print; exit 1 } }' >bad ||
                fail "$method: $(cat bad)"
    done
    expect 0 query cloud.vdb --rays rays.csv --method delta --samples 1
    awk -F, 'NR > 1 && $2 != 0 && $2 != 1 { exit 1 }' stdout || fail "delta: $(cat stdout)"
    # What is not known is empty, and said to be.
    expect 0 query cloud.vdb --rays rays.csv --method residual --roulette --samples 1
    awk -F, 'NR == 2 && ($3 != "" || $4 != "") { exit 1 }' stdout || fail "one sample: $(cat stdout)"
    contains stderr "have no standard error: with --roulette, one sample shows none"
    expect 0 query cloud.vdb --rays rays.csv --method ratio --roulette --samples 16 --scale 1000
    [ "$(sed -n 2p stdout | cut -d, -f2,3)" = "0," ] || fail "nothing came through: $(sed -n 2p stdout)"
    contains stderr "no sample got through"
    contains stderr "T < 0.17 at 95 %"
    for method in control march; do
        expect 0 query cloud.vdb --rays rays.csv --method $method
        awk -F, 'NR == 2 && $3 != "" { exit 1 }' stdout || fail "$method: $(cat stdout)"
        contains stderr "$method is biased"
        expect 0 query cloud.vdb --rays rays.csv --method $method --quiet
        [ ! -s stderr ] || fail "--quiet: $(cat stderr)"
    done
    expect 0 query cloud.vdb --rays rays.csv --method march --step 0.05
    paste -d, exact.csv stdout | awk -F, 'NR > 1 { d = $2 - $7; if (d < 0) d = -d
        if (d > 1e-3) { print; exit 1 } }' >bad || fail "march: $(cat bad)"
    expect 0 query cloud.vdb --rays rays.csv --method comb --step 1 --samples 256 --roulette
    paste -d, exact.csv stdout | awk -F, 'NR > 1 { d = $2 - $7; if (d < 0) d = -d
        if (d > 1e-2) { print; exit 1 } }' >bad || fail "comb: $(cat bad)"
    # Larger super-voxels of those in a sidecar, which are what larger ones of a bake are.
    expect 0 bake cloud.vdb --size 8 --control affine -o sized.track.vdb --force
    expect 0 query cloud.vdb --sidecar sized.track.vdb --size 16 --rays rays.csv --method residual
    awk -F, 'NR > 1 && $3 == "" { exit 1 }' stdout || fail "--size: $(cat stdout)"
    expect 1 query cloud.vdb --sidecar sized.track.vdb --size 4 --rays rays.csv --method residual
    contains stderr "super-voxels of 4 are smaller than those it was baked with; expected 8 or more"
    # Too deep for a float, and random: the error is not 0.
    expect 0 query cloud.vdb --rays rays.csv --method delta --scale 1000
    awk -F, 'NR == 2 && !($2 == 0 && $3 > 0) { exit 1 }' stdout || fail "deep: $(cat stdout)"
    # As many samples as an error needs, or none where exact integration is cheaper.
    expect 0 query cloud.vdb --rays rays.csv --method residual --error 0.2 --scale 0.3
    [ "$(head -n 1 stdout)" = "ray,transmittance,stderr,optical_depth,lookups,samples" ] || fail "header"
    awk -F, 'NR == 2 && !($3 > 0 && $3 <= 0.2 && $6 > 0) { exit 1 }' stdout || fail "--error: $(cat stdout)"
    expect 0 query cloud.vdb --rays rays.csv --method ratio --error 0.001 --samples 2 --scale 0.01
    contains stderr "not reach --error 0.001 within --samples"
    expect 0 query cloud.vdb --rays rays.csv --method residual --error 1e-5
    awk -F, 'NR == 2 && !($3 == 0 && $6 == 0 && $4 > 0) { exit 1 }' stdout || fail "exact: $(cat stdout)"
    expect 0 query cloud.vdb --rays rays.csv --method control --level 1
    # The sidecar alone knows its control.
    cp stdout level2.csv
    mv cloud.vdb away.vdb
    expect 0 query cloud.track.vdb --rays rays.csv --method control --level 1
    cmp -s stdout level2.csv || fail "the sidecar alone answers otherwise"
    expect 1 query cloud.track.vdb --rays rays.csv
    one_line "is a sidecar; expected the density"
    mv away.vdb cloud.vdb
    expect 0 query cloud.vdb --rays rays.csv --method residual -o out.csv
    [ ! -s stdout ] || fail "-o writes to stdout too"
    "$vdbtrack" query cloud.vdb --rays - --method residual -o - <rays.csv >stdout 2>stderr || fail "pipes"
    cmp -s stdout out.csv || fail "-o and stdout differ"
    expect 0 query cloud.vdb --rays rays.csv --method residual --threads 1
    cmp -s stdout out.csv || fail "one thread, other results"
    expect 0 query cloud.vdb --rays rays.csv --method residual --seed 7
    cmp -s stdout out.csv && fail "another seed, the same results"
    expect 0 query cloud.vdb --rays rays.csv --method residual --stream 7
    cmp -s stdout out.csv && fail "another stream, the same results"
    expect 0 query cloud.vdb --rays rays.csv --scale 0
    awk -F, 'NR > 1 && $2 != 1 { exit 1 }' stdout || fail "scale 0: $(cat stdout)"
}

case_free_paths() {
    baked_cloud
    some_rays
    for method in residual delta "residual --global"; do
        # shellcheck disable=SC2086
        expect 0 query cloud.vdb --rays rays.csv --free-paths --method $method --scale 2
        [ "$(head -n 1 stdout)" = "ray,t,weight,extinction,lookups" ] || fail "header"
        [ "$(sed -n 4p stdout)" = "2,inf,1,0,0" ] || fail "a miss: $(sed -n 4p stdout)"
        awk -F, 'NR > 1 && ($3 != 1 || ($2 == "inf") != ($4 == 0)) { exit 1 }' stdout ||
            fail "$method: $(cat stdout)"
    done
    expect 0 query cloud.vdb --rays rays.csv --free-paths --scale 1000
    awk -F, 'NR == 2 && ($2 == "inf" || $4 <= 0) { exit 1 }' stdout || fail "dense: $(cat stdout)"
    expect 0 query cloud.vdb --rays rays.csv --free-paths --color 1,2,0.5
    contains stdout "ray,t,weight_r,weight_g,weight_b,extinction_r,extinction_g,extinction_b,lookups"
    wrong() {
        local text=$1
        shift
        expect 2 query cloud.vdb --rays rays.csv "$@"
        contains stderr "$text"
    }
    wrong "--free-paths: expected --method residual" --free-paths --method ratio
    wrong "--samples: of no use with --free-paths" --free-paths --samples 4
    wrong "--rate: expected a finite number >= 1" --free-paths --rate 0.5
    wrong "--rate: expected a finite number >= 1" --method delta --rate 0.5
    wrong "--level: of no use with --method ratio" --method ratio --level 1
    wrong "--step: of no use with --method exact" --method exact --step 2
    wrong "--step: expected a finite number of voxels" --method march --step 0
    wrong "--samples: of no use with --method exact" --samples 4
    wrong "--seed: of no use with --method control" --method control --seed 4
    wrong "--error: of no use with --method march" --method march --error 0.1
    wrong "--error and --roulette" --method ratio --error 0.1 --roulette
    wrong "--rate-base: of no use with --method delta" --method delta --rate-base rms
    wrong "--rate: of no use with --method march" --method march --rate 2
    wrong "--global: of no use with --method control" --method control --global
    wrong "--choice: of no use with --method ratio" --method ratio --choice min
    wrong "--choice: of no use with --free-paths" --free-paths --choice mean
    wrong "--size: of no use with --method exact" --method exact --size 16
    wrong "--size: expected 4, 8, 16, 32 or 64" --method ratio --size 12
    wrong "--roulette: of no use with --method delta" --method delta --roulette
    wrong "rate-base" --method ratio --rate-base loudest
}

case_bad_rays() {
    baked_cloud
    expect 1 query cloud.vdb --rays none.csv
    one_line "none.csv: cannot be opened"
    : >empty.csv
    expect 0 query cloud.vdb --rays empty.csv
    [ "$(cat stdout)" = "ray,transmittance,stderr,optical_depth,lookups" ] || fail "header alone"
    contains stderr "empty.csv: no rays"
    bad() {
        printf '%b' "$1" >bad.csv
        expect 1 query cloud.vdb --rays bad.csv
        one_line "$2"
    }
    bad '0,0,0,1,0,0\n0,0,0,1,0\n' "bad.csv: line 2: expected ox,oy,oz,dx,dy,dz[,tmin,tmax], found 5"
    bad 'a,b,c,d,e,f\n0,0,0,1,0,0\n' 'line 1: expected numbers, or a header'
    bad 'O,0,0,1,0,0\n0,0,0,1,0,0\n' 'line 1: expected numbers, or a header'
    bad 'ox,oy,oz,dx,dy,dx\n0,0,0,1,0,0\n' "line 1: expected every column once, found dx twice"
    bad 'ox,oy,oz,dx,dy\n0,0,0,1,0\n' "none named dz"
    bad 'ox,oy,oz,dx,dy,dz,tmin\n0,0,0,1,0,0,0\n' "none named tmax"
    bad 'ox,oy,oz,dx,dy,dz\nx,0,0,1,0,0\n' 'line 2: expected 6 numbers, as the header names, found "x,0,0,1,0,0"'
    bad 'ox,oy,oz,dx,dy,dzz\n0,0,0,1,0,0\n' 'found "dzz" in "ox,oy'
    expect 1 query cloud.vdb --rays .
    one_line ".: is a directory; expected a CSV file"
    # Neither an output over the sidecar that is found, nor exact for want of one that is none.
    expect 1 query cloud.vdb --rays crlf.csv -o cloud.track.vdb --force --method residual
    one_line "is an input"
    mv cloud.track.vdb kept
    echo junk >cloud.track.vdb
    printf -- '-5,4,5,1,0.02,0.01\n' >one.csv
    expect 0 query cloud.vdb --rays one.csv
    mv kept cloud.track.vdb
    bad 'ox,oy,oz,dx,dy,dz\n0,0,0,1,0,0,0,1\n' "found 8 numbers"
    bad '0,0,0,1,0,0,2,1\n' "line 1: expected tmin <= tmax, found tmin 2 and tmax 1"
    # A header's order counts.
    printf 'ox,oy,oz,dx,dy,dz\n-5,4,5,1,0.02,0.01\n' >straight.csv
    printf '# mine\ndx, dy,dz ,ox,oy,oz\r1,0.02,0.01,-5,4,5\r' >turned.csv
    expect 0 query cloud.vdb --rays straight.csv
    cp stdout straight.out
    expect 0 query cloud.vdb --rays turned.csv
    cmp -s stdout straight.out || fail "columns in another order: $(cat stdout)"
    bad '0,0,0,1,0,0,5\n' "found 7 numbers"
    bad '0,0,0,1,0,zero\n' "line 1"
    bad '0,0,0,1,0,0\n\n# fine\n0,0,0,0,0,0\n' "line 4: expected a finite origin"
    bad 'nan,0,0,1,0,0\n' "line 1: expected a finite origin"
    bad '0,0,0,1e39,0,0\n' "line 1: expected a finite origin"
    printf '0,5,5,1,0,1e-50\n' >tiny.csv
    expect 0 query cloud.vdb --rays tiny.csv
    expect 1 query cloud.vdb --rays tiny.csv -o tiny.csv --force
    one_line "is an input"
    printf '0,0,0,1,0,0\r\n 0 , 0,0, +1,0,0 \r\n' >crlf.csv
    expect 0 query cloud.vdb --rays crlf.csv
    [ "$(wc -l <stdout)" = 3 ] || fail "CRLF and spaces"
}

case_bad_files() {
    baked_cloud
    some_rays
    for command in "bake" "info" "verify" "query --rays rays.csv" "preview"; do
        # shellcheck disable=SC2086
        expect 1 $command missing.vdb
        one_line "missing.vdb"
    done
    for limit in "" 0 12Q M 1.5G 99999999999999999999 17179869184G; do
        expect 2 bake cloud.vdb --force --max-memory "$limit"
    done
    expect 1 bake cloud.vdb --force --max-memory 100K
    one_line "more than --max-memory = 102400"
    expect 1 bake cloud.vdb --force --size 4 --max-memory 150K
    one_line "cloud.vdb: baking 360 super-voxels of 4^3 voxels needs"
    expect 1 query cloud.vdb --rays rays.csv --max-memory 100K
    one_line "more than --max-memory"
    expect 1 verify cloud.vdb --max-memory 100K
    one_line "more than --max-memory"
    expect 0 bake cloud.vdb --force --max-memory 1G
    # Without a sidecar, one is baked in memory.
    mv cloud.track.vdb elsewhere.track.vdb
    expect 0 query cloud.vdb --rays rays.csv --method residual --seed 3
    cp stdout in_memory.csv
    mv elsewhere.track.vdb cloud.track.vdb
    expect 0 query cloud.vdb --rays rays.csv --method residual --seed 3
    cmp -s stdout in_memory.csv || fail "a bake in memory answers otherwise"
    expect 1 bake "$work"
    one_line "is a directory"
    : >zero.vdb
    expect 1 bake zero.vdb
    one_line "zero.vdb: not a VDB file: the file is empty"
    echo "just text, nothing else" >text.vdb
    expect 1 bake text.vdb
    one_line "looks like text"
    size=$(stat -c %s cloud.vdb)
    for part in 5 40 60 80 95; do
        head -c $((size * part / 100)) cloud.vdb >cut.vdb
        expect 1 bake cut.vdb
        one_line "cut.vdb"
        absent cut.track.vdb
        expect 1 info cut.vdb
        one_line "cut.vdb"
    done
    head -c $(($(stat -c %s cloud.track.vdb) / 2)) cloud.track.vdb >cut.track.vdb
    expect 1 preview cut.track.vdb
    one_line "cut.track.vdb"
    expect 1 preview cloud.vdb
    one_line "cloud.vdb: is no sidecar; expected cloud.track.vdb, which is beside it"
    expect 1 bake cloud.vdb --grid heat -o heat.track.vdb
    one_line 'no grid "heat"; the file has density'
    absent heat.track.vdb
    rm cloud.track.vdb
    expect 1 verify cloud.vdb
    one_line "cloud.track.vdb"
    expect 0 query cloud.vdb --rays rays.csv
    expect 1 verify cloud.vdb
    one_line "cloud.track.vdb"
}

case_outputs() {
    baked_cloud
    cp cloud.track.vdb before.track.vdb
    expect 1 bake cloud.vdb
    one_line "--force"
    cmp -s cloud.track.vdb before.track.vdb || fail "refused, yet changed"
    expect 0 bake cloud.vdb --force
    expect 1 bake cloud.vdb -o cloud.vdb --force
    one_line "is an input"
    expect 1 bake cloud.vdb -o no/such/folder.vdb
    one_line "no/such/folder.vdb"
    expect 1 make cloud.vdb
    one_line "exists already"
    expect 0 preview cloud.track.vdb -o p.png --resolution 16x16
    expect 1 preview cloud.track.vdb -o p.png --resolution 16x16
    one_line "exists already"
    mkdir folder
    expect 1 bake cloud.vdb -o folder
    one_line "is a directory"
    mkfifo pipe
    expect 1 bake cloud.vdb -o pipe --force
    one_line "is a device or pipe"
    if [ "$(id -u)" -ne 0 ]; then
        chmod a-w folder
        expect 1 bake cloud.vdb -o folder/x.vdb
        one_line "Permission denied"
    fi
    mkdir "with spaces äöü"
    cp cloud.vdb "with spaces äöü/wölkchen 1.vdb"
    expect 0 bake "with spaces äöü/wölkchen 1.vdb"
    exists "with spaces äöü/wölkchen 1.track.vdb"
    some_rays
    if [ -w /dev/full ]; then
        "$vdbtrack" query cloud.vdb --rays rays.csv >/dev/full 2>stderr
        [ $? = 1 ] || fail "a full stdout must fail"
        contains stderr "standard output"
    fi
    [ -z "$(find . -name '*.tmp*')" ] || fail "temporary files left: $(find . -name '*.tmp*')"
}

case_full_disk() {
    small_cloud
    # A file size limit acts like a full disk.
    (
        ulimit -f 8
        trap '' XFSZ
        "$vdbtrack" bake cloud.vdb --size 4 -o full.track.vdb >stdout 2>stderr
        [ $? = 1 ] || exit 1
    ) || fail "bake on a full disk: $(cat stderr)"
    one_line "full.track.vdb: cannot be written"
    absent full.track.vdb
    (
        ulimit -f 8
        trap '' XFSZ
        "$vdbtrack" make full.vdb --voxels 64 >stdout 2>stderr
        [ $? = 1 ] || exit 1
    ) || fail "make on a full disk: $(cat stderr)"
    one_line "full.vdb: cannot be written"
    absent full.vdb
}

case_signals() {
    "$vdbtrack" make old.vdb --voxels 16 -q
    cp old.vdb copy.vdb
    for signal in INT TERM; do
        # A shell's background jobs ignore SIGINT, and so would the program.
        env --default-signal=INT,TERM "$vdbtrack" make old.vdb --voxels 512 --force -q &
        pid=$!
        sleep 0.3
        kill -$signal $pid 2>/dev/null || fail "too fast to be interrupted"
        wait $pid
        found=$?
        [ $found = $((128 + $(kill -l $signal))) ] || fail "exit $found after SIG$signal"
        cmp -s old.vdb copy.vdb || fail "the old file changed"
    done
    [ "$(find . -name 'old*' | wc -l)" = 1 ] || fail "left behind: $(ls)"
    (trap '' HUP; exec "$vdbtrack" make nohup.vdb --voxels 128 -q) &
    pid=$!
    sleep 0.1
    kill -HUP $pid 2>/dev/null
    wait $pid || fail "a program started by nohup ended on SIGHUP"
}

# Where no thread can be started, --threads 1 needs none. (OpenVDB's logging library starts its own when
# the program is loaded: the limit is the least at which that succeeds.)
case_no_threads() {
    [ "$(id -u)" = 0 ] || exit 77  # for a user of their own, without other processes
    small_cloud
    local user=54321
    chmod 755 "$work"
    limited() { setpriv --reuid=$user --regid=$user --clear-groups prlimit --nproc="$limit" "$vdbtrack" "$@"; }
    limit=1
    until limited --version >/dev/null 2>&1; do
        limit=$((limit + 1))
        [ $limit -lt 64 ] || exit 77
    done
    chown -R $user "$work"
    for command in "bake cloud.vdb --size 8" "verify cloud.vdb" "info cloud.vdb" "preview cloud.track.vdb"; do
        # shellcheck disable=SC2086
        limited $command --threads 1 >stdout 2>stderr || fail "$command with $limit threads: exit $?, $(cat stderr)"
    done
    exists cloud.track.vdb
}

case_two_bakes_at_once() {
    small_cloud
    for i in 1 2 3 4; do
        "$vdbtrack" bake cloud.vdb --size 4 --force -q &
    done
    wait
    expect 0 verify cloud.vdb
}

case_json() {
    baked_cloud
    expect 0 info cloud.vdb --json
    contains stdout '"can_be_baked": null'
    contains stdout '"claimed_active_voxels"'
    grep -q brick_bytes stdout && fail "voxels are read unasked"
    expect 0 info cloud.vdb --json --values
    contains stdout '"active_voxels"'
    contains stdout '"can_be_baked": true'
    contains stdout '"bounds_min"'
    expect 0 info cloud.vdb --json --estimate
    contains stdout '"least_bake_bytes"'
    expect 0 info cloud.track.vdb --json
    contains stdout '"super_voxel_size": 8'
    contains stdout '"source_digest"'
    expect 0 info cloud.track.vdb --json --values
    contains stdout '"residual_rms"'
    # A name with control characters: in a listing they are replaced, in JSON they survive.
    printf 'de\tsit' >name
    LC_ALL=C sed "s/density/$(cat name)y/" cloud.vdb >odd.vdb  # as long as before
    expect 0 info odd.vdb --json
    contains stdout '"de\tsity"'
    expect 0 info odd.vdb
    contains stdout 'de?sity'
}

# apps/demo.sh with the program built already: what it prints, and that a log given to it is kept.
case_demo() {
    mkdir -p demo/apps demo/build/demo/bin tools
    cp "$project/apps/demo.sh" demo/apps
    printf '#!/bin/sh\n' | tee tools/cmake demo/apps/install_packages.sh >/dev/null
    chmod +x tools/cmake demo/apps/install_packages.sh
    ln -s "$vdbtrack" demo/build/demo/bin/vdbtrack
    small_cloud
    echo "the log so far" >log
    PATH=$work/tools:$PATH demo/apps/demo.sh cloud.vdb >>log 2>&1 || fail "demo: $(cat log)"
    [ "$(head -n 1 log)" = "the log so far" ] || fail "the log was cut: $(head -n 3 log)"
    [ "$(grep -c 'ray [0-4]: z = ' log)" = 5 ] && [ "$(grep -cE ': z = [+-][0-9]' log)" -ge 3 ] ||
        fail "z of five rays, of which the first may miss: $(cat log)"
    awk '/: z = / && ($5 + 0 > 4 || $5 + 0 < -4) { exit 1 }' log || fail "tables disagree: $(cat log)"
    exists demo/demo-output/cloud.png
    [ "$(find demo -maxdepth 1 | sort | xargs)" = "demo demo/apps demo/build demo/demo-output" ] ||
        fail "left behind: $(ls demo)"
}

case_real_volumes() {
    [ -n "$data" ] || exit 77
    try() { # FILE CODE TEXT
        expect "$2" bake "$data/$1" -o out.track.vdb --force
        contains stderr "$3"
        [ "$2" = 0 ] || one_line "$3"
        if [ "$2" = 0 ]; then
            expect 0 verify "$data/$1" out.track.vdb
            expect 0 preview out.track.vdb -o out.png --force --resolution 32x32
        fi
        rm -f out.track.vdb
    }
    try wdas_cloud_sixteenth.vdb 0 "super-voxels"
    try smoke1.vdb 0 "super-voxels"
    try density_and_heat.vdb 0 "super-voxels"
    try torus.vdb 0 "super-voxels"
    try sphere.vdb 0 "super-voxels"
    try disney_fog_and_distance.vdb 0 "super-voxels"
    try smoke_000002.vdb 0 "super-voxels"
    try smoke_000001.vdb 0 "is empty"
    try bad_bbox_bomb.vdb 0 "is empty"
    try bad_bbox_empty.vdb 0 "is empty"
    try bad_bbox_overflow.vdb 0 "is empty"
    try three_grids_same_name.vdb 1 "density[0], density[1], density[2]"
    try cube_levelset.vdb 1 "level set"
    try unnamed_levelset.vdb 1 "level set"
    try pointgrid.vdb 1 "ptdataidx32"
    try sphere_points.vdb 1 "ptdataidx32"
    try box_background_one.vdb 1 "background is 1"
    try sphere_cd.vdb 1 "background is"
    try smoke_blosc.nvdb 1 "NanoVDB"
    expect 0 bake "$data/three_grids_same_name.vdb" --grid 'density[1]' -o one.track.vdb
    expect 0 verify "$data/three_grids_same_name.vdb" one.track.vdb --grid 'density[1]'
    expect 1 verify "$data/three_grids_same_name.vdb" one.track.vdb --grid 'density[2]'
    one_line 'density"[1]'
    for file in "$data"/*.vdb; do
        expect 0 info "$file"
        expect 0 info "$file" --values
    done
}

# What the page of a report draws, where there is an interpreter to run it.
draws() {
    if command -v node >/dev/null; then
        node "$project/tests/cli/page_test.js" "$1/index.html" >drawn 2>&1 || fail "the page of $1: $(cat drawn)"
    fi
}

case_measure() {
    small_cloud
    local quick="--rounds 6 --ray-count 100 --size 8,all --depth 2,own"
    # shellcheck disable=SC2086
    expect 0 measure cloud.vdb -o report $quick --scatter 2 --scatter-samples 2 --scatter-width 24
    [ ! -s stdout ] || fail "data on stdout"
    contains stderr "normal accuracy: "
    [ "$(ls report)" = "$(printf 'index.html\nmeasurements.csv\nmeasurements.json')" ] ||
        fail "files: $(ls -a report)"
    # A page of its own: pictures inside, nothing to load.
    contains report/index.html "data:image/png;base64,"
    grep -qE 'src="?https?:|href="?http|url\(http' report/index.html && fail "the page loads something"
    draws report
    # 4 kinds of sets at 2 depths; every line has as many fields as the header; unbiased rows have
    # errors, and no more than their bound.
    awk -F, 'NR == 1 { n = NF; next }
        { ++rows; sets[$1 $2 $3] = 1 }
        NF != n { print "line " NR ": " NF " fields"; exit 1 }
        $4 == "residual" && ($10 <= 0 || $15 == "" || $19 * $19 > 36) { print; exit 1 }
        END { for (s in sets) ++k; if (k != 8 || rows % 8 != 0) { print k " sets, " rows " rows"; exit 1 } }' \
        report/measurements.csv || fail "measurements.csv"
    for key in z_bound mean_depth time_ns sidecar_bytes recommendation shadow_rmse; do
        contains report/measurements.json "\"$key\""
    done
    expect 1 measure cloud.vdb -o report --quiet
    one_line "report/measurements.csv: exists"
    # shellcheck disable=SC2086
    expect 0 measure cloud.vdb -o report $quick --force --quiet --method exact,ratio
    [ ! -s stderr ] || fail "--quiet writes: $(cat stderr)"
    # Where only exact integration survives, pictures are drawn at less depth. And a name need not be
    # UTF-8.
    cp cloud.vdb $'caf\xe9.vdb'
    expect 0 measure $'caf\xe9.vdb' -o deep --depth 1e6 --rounds 4 --ray-count 50 --method exact,residual --size 8
    contains deep/measurements.json '"strip_depth": 10.0'
    draws deep

    # What it recommends can be pasted: quoted, and of the grid that was measured.
    mkdir -p "my clouds"
    cp cloud.vdb "my clouds/it's one.vdb"
    expect 0 measure "my clouds/it's one.vdb" -o "its report" --grid density --rounds 8 --ray-count 100 --depth 1 \
        --size 8 --method delta --color 1,1,1
    grep -o "vdbtrack bake .*, then" stderr | sed -n '1s/, then//p' >paste
    contains paste "--grid density --size 8"
    (eval "$(sed "s|^vdbtrack|\"$vdbtrack\"|" paste) --quiet") || fail "does not run: $(cat paste)"
    [ -f "my clouds/it's one.track.vdb" ] || fail "no sidecar after $(cat paste)"
    # Nothing to recommend, and why.
    expect 0 measure cloud.vdb -o biased --rounds 4 --ray-count 20 --depth 1 --size 8 --method march --color 1,1,1
    contains stderr "every method that was measured is biased"
    contains biased/index.html "every method that was measured is biased"
    draws biased
    # A signal leaves nothing, not even the folder.
    "$vdbtrack" measure cloud.vdb -o cut --rounds 100000 --depth 1 2>/dev/null &
    local measuring=$!
    for _ in $(seq 200); do
        [ -d cut ] && break
        sleep 0.05
    done
    [ -d cut ] || fail "no folder while measuring"
    kill -TERM $measuring
    local status=0
    wait $measuring || status=$?
    [ $status = 143 ] || fail "exit $status on SIGTERM"
    absent cut
    TMPDIR=/nonexistent expect 1 measure cloud.vdb -o other --depth 1 --size 8
    one_line "/nonexistent: expected a folder for temporary files (TMPDIR)"
    absent other

    expect 1 measure cloud.vdb -o nowhere/report
    one_line "nowhere/report"
    expect 1 measure missing.vdb -o other
    one_line "missing.vdb"
    expect 2 measure cloud.vdb
    contains stderr "missing -o REPORT"
    for wrong in "--size 5" "--size 8,,4" "--method magic" "--rate 0" "--depth deep" "--rounds 1" \
        "--choice min --control affine --method residual --size 8" "--scatter 0" "--rate 1e-50" \
        "--scatter 2 --scatter-width 8" "--scatter-samples 4" "--color 0,0,0"; do
        # shellcheck disable=SC2086
        expect 2 measure cloud.vdb -o other $wrong
        contains stderr "usage: vdbtrack measure"
    done
    absent other
}

case_vdb_print() {
    command -v vdb_print >/dev/null || exit 77
    baked_cloud
    vdb_print -l cloud.track.vdb >printed 2>&1 || fail "vdb_print: $(cat printed)"
    for text in density_control density_majorant density_rms density_min density_max \
        density_control_level_1 "track_super_voxel_size: 8" "track_source_grid: density"; do
        contains printed "$text"
    done
    expect 0 bake cloud.vdb --size 8 --control affine --force
    vdb_print -l cloud.track.vdb >printed 2>&1 || fail "vdb_print: $(cat printed)"
    contains printed density_gradient
    contains printed density_deviation
}

if [ $# -lt 2 ]; then
    declare -F | sed -n 's/^declare -f case_//p'
    exit 0
fi
"case_$2"
exit $((failures > 0))
