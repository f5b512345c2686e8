#!/bin/sh
# Every scheduler along three paths: compare.sh FIXTURE [NAME=VALUE...]. Each path is a run of its own in
# out/compare/FIXTURE/PATH, or in OUT/PATH where out=OUT is given; the report beside them holds all three.
set -eu
root=$(cd "$(dirname "$0")/.." && pwd -P)
fixture=$1
shift
case $(pwd -P) in "$root") out=out ;; *) out=$root/out ;; esac
out=$out/compare/$(printf %s "$fixture" | tr -c 'A-Za-z0-9._+-' _)
# `just` takes the last of several values of a setting.
tif=
for setting in "$@"; do
    case $setting in
        out=*) out=${setting#out=} ;;
        tif=*) tif=${setting#tif=} ;;
    esac
done
case $out in -*) out=./$out ;; esac
case $tif in -*) tif=./$tif ;; esac

end=0
for path in raster maze random-adaptive; do
    status=0
    "$root/pipelines/start.sh" compare "$path" "fixture=$fixture" "$@" "out=$out/$path" || status=$?
    [ "$status" -le 1 ] || exit "$status"
    [ "$status" -eq 0 ] || end=1
done
# The tool is the same along every path: that of the fixture, or the user's as it is or as it was imported.
if [ -z "$tif" ]; then
    tif=$out/raster/fixture/tif
elif [ -f "$tif" ]; then
    tif=$out/raster/import/tif
fi
PATH=$root/target/release:$PATH
export PATH
PS4=
set -x
planish-compare report "$out/raster" "$out/maze" "$out/random-adaptive" --mirror="$fixture" --tif "$tif" --out "$out/report" --force
{ set +x; } 2> /dev/null
exit "$end"
