#!/bin/sh
# Are the results still the same, byte for byte? same-bytes.sh REVISION
#
# Every pipeline runs on small fixtures twice: as the revision has it, in a clone under
# target/same-bytes, and as it stands here. Printed is the SHA-256 of every `.npy` and of every program for
# a controller, with the path it has in its run; then what differs. Manifests, pages and pictures are not
# compared: their keys and words may change without the numbers. The exit code is 1 when anything differs.
set -eu
root=$(cd "$(dirname "$0")/.." && pwd -P)
revision=$1
work=$root/target/same-bytes
copy=$work/revision

# One run per line: what `just` is called with, `out=` apart. Together they reach every stage, every kind of
# path, every solver, every scheduler, every controller, and the settings that change the mathematics.
runs='
run raster fixture=coupon export=galil
run raster fixture=coupon pitch_mm=0.5 step_mm=0.5 min_dwell_s_per_mm=0.05
run raster fixture=coupon mode=smooth export=pmac
run raster fixture=coupon-noise refine=no export=gcode prepare="--mask-outliers --feature-mm 4 --fill"
run raster fixture=coupon machine=fixtures/machines/fluid-jet.json export=xps
run raster fixture=coupon-ring export=csv frames=0 prepare="--level zernike --level-order 4"
run maze fixture=coupon corner_radius_mm=0.5 tree=wilson
run maze fixture=coupon-mixture
run random-adaptive fixture=coupon
run spiral fixture=coupon
run multi-pitch fixture=coupon classes=3 max_velocity_mm_per_s=5
run trig-spline fixture=coupon
run bspline fixture=coupon machine=fixtures/machines/ion-beam-no-jerk-limit.json pitch_mm=1 step_mm=0.5
compare-dwell coupon
compare coupon
'

# Runs the pipelines of the repository in $1 and writes the list of hashes to $2.
list() {
    (
        cd "$1"
        rm -rf out/same-bytes
        just build
        number=0
        printf '%s\n' "$runs" | while IFS= read -r run; do
            [ -n "$run" ] || continue
            number=$((number + 1))
            status=0
            eval "just $run out=out/same-bytes/$number" > "$work/run.log" 2>&1 < /dev/null || status=$?
            # 1 is a negative verdict, and as such a result.
            if [ "$status" -gt 1 ]; then
                cat "$work/run.log" >&2
                echo "error: just $run ended with $status in $1" >&2
                exit 2
            fi
        done
        cd out/same-bytes
        find . -type f \( -name '*.npy' -o -name 'program.*' ! -name '*.json' \) | LC_ALL=C sort | xargs sha256sum
    ) > "$2"
}

mkdir -p "$work"
[ -d "$copy" ] || git clone --quiet --no-checkout "$root" "$copy"
git -C "$copy" fetch --quiet origin
git -C "$copy" checkout --quiet --detach "$(git -C "$root" rev-parse --verify "$revision^{commit}")"
list "$copy" "$work/before"
list "$root" "$work/after"
cat "$work/after"
if diff "$work/before" "$work/after" > "$work/difference"; then
    echo "the same $(wc -l < "$work/after") files as at $revision"
else
    cat "$work/difference"
    echo "different from $revision: the lines above, < there and > here"
    exit 1
fi
