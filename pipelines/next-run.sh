#!/bin/sh
# From the maps before and after a run to the next one: next-run.sh before=DIR after=DIR trajectory=DIR tif=DIR
# [transform=DIR] [error_budget=FILE] [machine=FILE] [pipeline=raster] [least_gain_percent=5] [reconcile=FLAGS] [NAME=VALUE...]. The maps, the
# motion (planned or traced, in the coordinates of the part) and the tool are artifacts; transform is what took the plan
# to the machine in that run (what the machine file says when empty), error_budget the errors that are known beforehand (docs/campaign.md). The other settings are those
# of `just run`. Everything goes to out/next-run/MAP, or to OUT where out=OUT is given:
#
#   reconciliation  what the run taught
#   tif, transform, error_budget.json    tool, place and errors of the next run
#   plan            the next plan, in the coordinates of the part
#   commanded       its motion in those of the machine, and verdict on it
#   tolerance       what it is expected to leave
#   decision        run again, or stop
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
before= after= trajectory= tif= transform= error_budget= machine= out= specification= pipeline=raster least_gain_percent=5
reconcile=
for word in "$@"; do
    case $word in
    before=*) before=${word#*=} ;;
    after=*) after=${word#*=} ;;
    trajectory=*) trajectory=${word#*=} ;;
    tif=*) tif=${word#*=} ;;
    transform=*) transform=${word#*=} ;;
    error_budget=*) error_budget=${word#*=} ;;
    machine=*) machine=${word#*=} ;;
    out=*) out=${word#*=} ;;
    specification=*) specification=${word#*=} ;;
    pipeline=*) pipeline=${word#*=} ;;
    least_gain_percent=*) least_gain_percent=${word#*=} ;;
    reconcile=*) reconcile=${word#*=} ;;
    surface=* | fixture=*) refuse "the map of the next plan is after=DIR; leave ${word%%=*} out" ;;
    export=*) refuse 'the program is that of the commanded motion; leave export out, and give planish-export OUT/commanded' ;;
    *=*) ;;
    *) refuse "'$word' is no setting; give before=DIR after=DIR trajectory=DIR tif=DIR" ;;
    esac
done
for given in "before=$before" "after=$after" "trajectory=$trajectory" "tif=$tif"; do
    value=${given#*=}
    [ -n "$value" ] || refuse "${given%%=*} is not given; give before=DIR after=DIR trajectory=DIR tif=DIR"
    [ ! -f "$value" ] || refuse "${given%%=*} $value is a file; read it with planish-import, and give the directory"
    [ -d "$value" ] || refuse "${given%%=*} $value is not there; give a directory"
done
[ -z "$transform" ] || [ -d "$transform" ] || refuse "transform $transform is not there; give a directory"
[ -z "$error_budget" ] || [ -f "$error_budget" ] || refuse "error_budget $error_budget is no file; give the errors that are known beforehand"
find_pipeline "$pipeline"

# The settings that are for the pipeline
remaining=$#
while [ "$remaining" -gt 0 ]; do
    word=$1
    shift
    remaining=$((remaining - 1))
    case $word in
    before=* | after=* | trajectory=* | tif=* | transform=* | error_budget=* | out=* | pipeline=* | least_gain_percent=*) ;;
    reconcile=*) ;;
    *) set -- "$@" "$word" ;;
    esac
done

name_of_directory "$after"
[ -n "$out" ] || out=${here}out/next-run/$(printf %s "$name" | tr -c 'A-Za-z0-9._+-' _)
[ -n "$machine" ] || machine=$(just --justfile "$file" --working-directory . --evaluate machine)
paths_are_no_flags out before after trajectory tif transform error_budget machine

if [ "$held" = no ]; then
    exec planish-run start --out="$out" --pipeline=next-run --surface="$after" --tif="$tif" --machine="$machine" \
        --flags="reconcile=$reconcile" -- "$root/pipelines/next-run.sh" held "$@" "before=$before" "after=$after" \
        "trajectory=$trajectory" "tif=$tif" "transform=$transform" "error_budget=$error_budget" "out=$out" "pipeline=$pipeline" \
        "least_gain_percent=$least_gain_percent" "reconcile=$reconcile"
fi

log=$(mktemp) && trap 'rm -f "$log"' EXIT

# go_on COMMAND...: exit code 1, a negative verdict, is a result: `verdict` ends the line with 1.
go_on() {
    status=0
    "$@" || status=$?
    [ "$status" -le 1 ] || exit "$status"
}

# Where the part lay, when nobody measured it: as the machine file says
if [ -z "$transform" ]; then
    planish-register place --machine "$out/machine/${machine##*/}" --out "$out/place" --force
    transform=$out/place
fi

learn go_on --before "$before" --after "$after" --trajectory "$trajectory" --tif "$tif" \
    ${error_budget:+--error-budget "$error_budget"} ${transform:+--transform "$transform"} --out "$out/reconciliation" \
    --corrected-tif "$out/tif" --corrected-transform "$out/transform" --learnt-error-budget "$out/error_budget.json" --force

# The next plan, whose pages and tables are its own
status=0
"$root/pipelines/start.sh" run "$pipeline" frames=0 plan_joint=no "$@" "surface=$after" "tif=$out/tif" "out=$out/plan" > "$log" 2>&1 ||
    status=$?
[ "$status" -le 1 ] || {
    cat "$log" >&2
    exit "$status"
}
# The method of a run that is to be executed, as pipelines/stages.just has it
planned=$(just --justfile "$file" --working-directory . --evaluate plan_joint=no "$@" planned)
motion=$out/plan/methods/$planned/trajectory

go_on planish-register apply --transform "$out/transform" --trajectory "$motion" --out "$out/commanded" --force
go_on planish-verify --trajectory "$out/commanded" --machine "$out/machine/${machine##*/}" --out "$out/verdict" --force
go_on planish-tolerance --trajectory "$motion" --tif "$out/tif" --surface "$out/plan/surface" \
    --error-budget "$out/error_budget.json" --out "$out/tolerance" --force
judged_now= judged_next=
if [ -n "$specification" ]; then
    judged_now=$out/plan/specified/before/specification judged_next=$out/plan/specified/$planned/specification
fi
printf '\n'
go_on planish-campaign decide --surface "$out/plan/surface" --trajectory "$motion" --tolerance "$out/tolerance" \
    --least-gain-percent="$least_gain_percent" ${judged_now:+--specified-now "$judged_now"} \
    ${judged_next:+--specified-next "$judged_next"} --out "$out/decision" --force
printf 'the plan: %s\nits motion on the machine: %s\n' "$out/plan/report/report.html" "$out/commanded"
planish-run verdict --run "$out" --plan plan --plan "plan/methods/$planned"
