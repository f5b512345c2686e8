#!/bin/sh
# What the errors of a process add to the plans of several pipelines, and which of them bears the errors best:
# tolerance.sh [reference] [PIPELINE...] [error_budget=FILE] [NAME=VALUE...]. The plans are those of `just run`, with the
# same settings, each in a run of its own in out/tolerance/MIRROR/PIPELINE, or in OUT/PIPELINE where out=OUT is given.
# `reference` is the mirror in PLANISH_REFERENCE; its residuals are without their planes, as the published ones are,
# and its process is one of single errors unless another is given.
set -eu
root=$(cd "$(dirname "$0")/.." && pwd -P)
. "$root/pipelines/several-runs.sh"

case $(pwd -P) in "$root") out=out ;; *) out=$root/out ;; esac
home=$out/tolerance out= error_budget= pipelines= reference=no own_tif= own_surface= fixture=
settings=$(mktemp) && trap 'rm -f "$settings"' EXIT
for word in "$@"; do
    case $word in
    reference) reference=yes ;;
    error_budget=*) error_budget=${word#error_budget=} ;;
    out=*) out=${word#out=} ;;
    tif=*) own_tif=${word#tif=} ;;
    surface=*) own_surface=${word#surface=} ;;
    fixture=*) fixture=${word#fixture=} ;;
    *=*) ;;
    *)
        [ -f "$root/pipelines/$word.just" ] || refuse "'$word' is no pipeline and no setting; give raster, maze, NAME=VALUE"
        pipelines="$pipelines $word"
        ;;
    esac
done
# Another mirror is another run.
if [ "$reference" = yes ]; then
    name=reference
elif [ -n "$own_surface" ]; then
    name_of_directory "$own_surface"
else
    name=${fixture:-default}
fi
case $name in */* | .*) name=mirror ;; esac
[ -n "$out" ] || out=$home/$name
paths_are_no_flags out
[ -n "$pipelines" ] || pipelines='raster maze'
free=piston
if [ "$reference" = yes ]; then
    [ -n "${PLANISH_REFERENCE:-}" ] || refuse 'PLANISH_REFERENCE does not name the folder of the reference mirror'
    just --justfile "$root/justfile" reference-mirror "$(mkdir -p "$out" && cd "$out" && pwd -P)/mirror"
    free=plane
    [ -n "$error_budget" ] || error_budget=$root/fixtures/error-budgets/single-errors.json
fi
[ -n "$error_budget" ] || error_budget=$root/fixtures/error-budgets/ion-beam.json

# The settings that are for the pipelines, and the mirror
remaining=$#
while [ "$remaining" -gt 0 ]; do
    word=$1
    shift
    remaining=$((remaining - 1))
    case $word in error_budget=* | out=*) ;; *=*) set -- "$@" "$word" ;; esac
done
[ "$reference" = no ] || set -- "$@" "surface=$out/mirror/surface" "tif=$out/mirror/tif"

ranks=$settings
for pipeline in $pipelines; do
    at=$out/$pipeline
    status=0
    "$root/pipelines/start.sh" run "$pipeline" "$@" "out=$at" > "$settings.log" 2>&1 || status=$?
    if [ "$status" -gt 1 ]; then
        cat "$settings.log" >&2
        rm -f "$settings.log"
        exit "$status"
    fi
    rm -f "$settings.log"
    case $pipeline in bspline) plan=bspline ;; trig-spline) plan=trig-spline ;; *) plan=pvt+refined ;; esac
    [ -d "$at/methods/$plan/trajectory" ] || plan=pvt
    for tif in "$at/import/tif" "$at/fixture/tif" "$out/mirror/tif" "$own_tif"; do
        [ ! -d "$tif" ] || break
    done
    printf '\n%s: ' "$pipeline"
    planish-tolerance --trajectory "$at/methods/$plan/trajectory" --tif "$tif" --surface "$at/surface" \
        --error-budget "$error_budget" --free "$free" --out "$at/tolerance" --force
    below=$(sed -n 's/.*"below_95_percent_nm": *\([0-9.eE+-]*\).*/\1/p' "$at/tolerance/manifest.json")
    printf '%s %s\n' "$below" "$pipeline" >> "$ranks"
done
printf '\n95 %% of the runs are below\n'
sort -g "$ranks" | while read -r below pipeline; do printf '%10.4f nm  %s\n' "$below" "$pipeline"; done
