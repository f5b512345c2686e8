#!/bin/sh
# A campaign on the virtual machine: plan, run, measure, reconcile, plan again; with learning, without, and on a machine
# that is known: campaign.sh [FIXTURE] [runs=3] [seed=1] [error_budget=FILE] [pipeline=raster] [least_gain_percent=5]
# [reconcile=FLAGS] [NAME=VALUE...]. The other settings are those of `just run`; a mirror of one's own is surface=DIR tif=DIR, two artifacts,
# and its map is taken for the mirror itself. Everything goes to out/campaign/MIRROR, or to OUT where out=OUT is given:
#
#   measured        the map before the first run
#   first           the first plan, which all chains run
#   learning/K      run K, and what it taught: measured, truth, reconciliation, tif, transform, error_budget.json, the next
#                   plan, tolerance, decision; from the second run on the motion that is commanded
#   without/K       run K without learning: measured, truth, the next plan
#   known/K         the same on a machine whose tool and place are those of the plan
#   alike           another mirror like the first, and its first run in each chain, after all that was learnt
#   report          the table as a page
set -eu
root=$(cd "$(dirname "$0")/.." && pwd -P)
. "$root/pipelines/several-runs.sh"

# The second call, which holds the directory
held=no
if [ "${1-}" = held ]; then
    held=yes
    shift
fi

if [ "$(pwd -P)" = "$root" ]; then here= ; else here=$root/; fi
fixture=coupon surface= tif= machine= out= error_budget=${here}fixtures/error-budgets/hidden.json
runs=3 seed=1 pipeline=raster least_gain_percent=5 specification= reconcile=
for word in "$@"; do
    case $word in
    fixture=*) fixture=${word#*=} ;;
    surface=*) surface=${word#*=} ;;
    tif=*) tif=${word#*=} ;;
    machine=*) machine=${word#*=} ;;
    out=*) out=${word#*=} ;;
    error_budget=*) error_budget=${word#*=} ;;
    runs=*) runs=${word#*=} ;;
    seed=*) seed=${word#*=} ;;
    pipeline=*) pipeline=${word#*=} ;;
    least_gain_percent=*) least_gain_percent=${word#*=} ;;
    reconcile=*) reconcile=${word#*=} ;;
    specification=*) specification=${word#*=} ;;
    export=*) refuse 'a campaign writes no programs; leave export out' ;;
    *=*) ;;
    *) fixture=$word ;;
    esac
done
case $runs in
[1-9] | [1-9][0-9]) ;;
*) refuse "runs is '$runs'; give 1 to 99" ;;
esac
find_pipeline "$pipeline"
for map in "$surface" "$tif"; do
    [ ! -f "$map" ] || refuse "$map is a file; read it with planish-import, and give the directory"
done

# The settings that are for the pipelines
remaining=$#
while [ "$remaining" -gt 0 ]; do
    word=$1
    shift
    remaining=$((remaining - 1))
    case $word in
    fixture=* | surface=* | tif=* | out=* | error_budget=* | runs=* | seed=* | pipeline=* | least_gain_percent=* | reconcile=*) ;;
    *=*) set -- "$@" "$word" ;;
    esac
done

if [ -z "$surface$tif" ]; then
    name=$fixture
else
    name_of_directory "$surface"
fi
[ -n "$out" ] || out=${here}out/campaign/$(printf %s "$name" | tr -c 'A-Za-z0-9._+-' _)
[ -n "$machine" ] || machine=$(just --justfile "$file" --working-directory . --evaluate machine)
paths_are_no_flags out surface tif error_budget machine
recipe=${here}fixtures/$fixture.json

if [ "$held" = no ]; then
    [ -f "$error_budget" ] || refuse "error_budget $error_budget is no file; give the errors of the virtual machine (docs/tolerance.md)"
    set -- "$root/pipelines/campaign.sh" held "$@" "fixture=$fixture" "runs=$runs" "seed=$seed" "error_budget=$error_budget" "out=$out" \
        "pipeline=$pipeline" "least_gain_percent=$least_gain_percent" "reconcile=$reconcile"
    set -- --out="$out" --pipeline=campaign --machine="$machine" --flags="reconcile=$reconcile" -- "$@"
    [ -n "$surface$tif" ] || exec planish-run start --fixture="$recipe" "$@"
    exec planish-run start ${surface:+"--surface=$surface"} ${tif:+"--tif=$tif"} "$@" "surface=$surface" "tif=$tif"
fi

log=$(mktemp) && trap 'rm -f "$log"' EXIT

# quiet COMMAND...: what it says is shown where it fails; exit code 1, a negative verdict, is a result.
quiet() {
    status=0
    "$@" > "$log" 2>&1 || status=$?
    [ "$status" -le 1 ] || {
        cat "$log" >&2
        exit "$status"
    }
}

# plan RUN SURFACE TIF SETTINGS...: the pipeline in RUN for a map and a tool. Nearly all the time of a campaign is spent
# here: a terminal is told how many plans are made, and how long the others will take.
begun=$(date +%s) plans=$((3 * runs + 1)) made=0
plan() {
    plan_at=$1 plan_map=$2 plan_tool=$3
    shift 3
    quiet "$root/pipelines/start.sh" run "$pipeline" frames=0 plan_joint=no "$@" "surface=$plan_map" "tif=$plan_tool" "out=$plan_at"
    made=$((made + 1)) took=$(($(date +%s) - begun))
    [ ! -t 2 ] || printf 'plan %s of %s after %s s, about %s s left\n' \
        "$made" "$plans" "$took" $((took * (plans - made) / made)) >&2
}

# machine_runs AT K MEASURED MOTION FLAGS...: run K of the virtual machine, which has the true tool
machine_runs() {
    run_at=$1 run_number=$2 run_map=$3 run_motion=$4
    shift 4
    quiet planish-simulate --trajectory "$run_motion" --tif "$tif" --surface "$run_map" --error-budget "$error_budget" \
        --seed="$seed" --run-number="$run_number" "$@" --measured-out "$run_at/measured" --out "$run_at/truth" --force
}

if [ -z "$surface$tif" ]; then
    quiet planish-fixture "$recipe" --out "$out/fixture" --force
    surface=$out/fixture/surface tif=$out/fixture/tif
fi
quiet planish-campaign measure --surface "$surface" --error-budget "$error_budget" --seed="$seed" --out "$out/measured" --force
plan "$out/first" "$out/measured" "$tif" "$@"
# The method of a run that is to be executed, as pipelines/stages.just has it
planned=$(just --justfile "$file" --working-directory . --evaluate plan_joint=no "$@" planned)

for chain in without known; do
    map=$out/measured run=$out/first flag=
    [ "$chain" = without ] || flag=--known
    k=1
    while [ "$k" -le "$runs" ]; do
        at=$out/$chain/$k
        machine_runs "$at" "$k" "$map" "$run/methods/$planned/trajectory" $flag
        map=$at/measured run=$at/plan
        [ "$k" -eq "$runs" ] || plan "$run" "$map" "$tif" "$@"
        k=$((k + 1))
    done
done

map=$out/measured run=$out/first tool=$tif knowledge=$error_budget
k=1
while [ "$k" -le "$runs" ]; do
    at=$out/learning/$k
    motion=$run/methods/$planned/trajectory
    commanded=$motion
    # The plan goes to where the part lies by what was learnt so far.
    place=
    if [ "$k" -gt 1 ]; then
        place=$out/learning/$((k - 1))/transform
        commanded=$at/commanded
        quiet planish-register apply --transform "$place" --trajectory "$motion" --out "$commanded" --force
    fi
    machine_runs "$at" "$k" "$map" "$commanded"
    learn quiet --before "$map" --after "$at/measured" --trajectory "$motion" --tif "$tool" \
        --error-budget "$knowledge" ${place:+--transform "$place"} --out "$at/reconciliation" --corrected-tif "$at/tif" \
        --corrected-transform "$at/transform" --learnt-error-budget "$at/error_budget.json" --force
    map=$at/measured run=$at/plan tool=$at/tif knowledge=$at/error_budget.json
    plan "$run" "$map" "$tool" "$@"
    quiet planish-tolerance --trajectory "$run/methods/$planned/trajectory" --tif "$tool" --surface "$run/surface" \
        --error-budget "$knowledge" --out "$at/tolerance" --force
    judged_now= judged_next=
    if [ -n "$specification" ]; then
        judged_now=$run/specified/before/specification judged_next=$run/specified/$planned/specification
    fi
    quiet planish-campaign decide --surface "$run/surface" --trajectory "$run/methods/$planned/trajectory" \
        --tolerance "$at/tolerance" --least-gain-percent="$least_gain_percent" \
        ${judged_now:+--specified-now "$judged_now"} ${judged_next:+--specified-next "$judged_next"} \
        --out "$at/decision" --force
    k=$((k + 1))
done

quiet planish-campaign measure --surface "$surface" --error-budget "$error_budget" --seed="$seed" --run-number="$k" \
    --out "$out/alike/measured" --force
motion=methods/$planned/trajectory
plan "$out/alike/first" "$out/alike/measured" "$tif" "$@"
machine_runs "$out/alike/without" "$k" "$out/alike/measured" "$out/alike/first/$motion"
machine_runs "$out/alike/known" "$k" "$out/alike/measured" "$out/alike/first/$motion" --known
plan "$out/alike/plan-after-$runs" "$out/alike/measured" "$tool" "$@"
quiet planish-register apply --transform "$out/learning/$runs/transform" --trajectory "$out/alike/plan-after-$runs/$motion" \
    --out "$out/alike/commanded" --force
machine_runs "$out/alike/learning" "$k" "$out/alike/measured" "$out/alike/commanded"

planish-campaign report "$out" --surface "$surface" --runs="$runs" --mirror="$name" --out "$out/report" --force
