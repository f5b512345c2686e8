#!/bin/sh
# All plans of a sweep, and the best one: sweep.sh SWEEP.yaml [NAME=VALUE...]. Settings:
#   profile=local       local, slurm, or a directory with a config.yaml for Snakemake
#   out=DIR             where the plans go; out/sweeps/NAME without it
#   refine_front=no     yes: after the grid, plans between those of the front, until it moves by less than 1 %
#   retry=no            yes: plans that failed are tried again
#   at_once=N           stages that run at the same time in a job, instead of the profile's
#   plans_per_job=N     plans of a job, instead of the profile's
#   most_jobs=N         most jobs for the plans, instead of the profile's
#   snakemake=FLAGS     further flags of Snakemake, such as snakemake='--slurm-no-account'
set -eu
root=$(cd "$(dirname "$0")/.." && pwd -P)
programs=$root/target/release

refuse() {
    printf 'error: %s\n' "$1" >&2
    exit 2
}

[ $# -gt 0 ] || refuse 'no sweep; give the file of one, such as sweeps/small.yaml'
sweep=$1
shift
case $sweep in -*) sweep=./$sweep ;; esac
[ -f "$sweep" ] || refuse "$sweep is not there; give the file of a sweep, such as sweeps/small.yaml"
name=$(basename "$sweep")
name=${name%.*}
profile=local out= refine_front=no retry=no at_once= plans_per_job= most_jobs= flags=
seen=' '
for setting in "$@"; do
    value=${setting#*=}
    case $seen in *" ${setting%%=*} "*) refuse "${setting%%=*} is given twice; give it once" ;; esac
    seen="$seen${setting%%=*} "
    case $setting in
    profile=*) profile=$value ;;
    out=*) out=$value ;;
    refine_front=yes | refine_front=no) refine_front=$value ;;
    retry=yes | retry=no) retry=$value ;;
    at_once=[1-9]*) at_once=$value ;;
    plans_per_job=[1-9]*) plans_per_job=$value ;;
    most_jobs=[1-9]*) most_jobs=$value ;;
    snakemake=*) flags=$value ;;
    *) refuse "'$setting' is no setting of a sweep; there are profile=, out=, refine_front=yes, retry=yes, at_once=N, plans_per_job=N, most_jobs=N, snakemake=" ;;
    esac
done
for number in "$at_once" "$plans_per_job" "$most_jobs"; do
    case $number in *[!0-9]*) refuse "'$number' is no whole number" ;; esac
done
[ -n "$out" ] || out=out/sweeps/$name
case $out in -*) out=./$out ;; esac
case $profile in */*) ;; *) profile=$root/workflow/profiles/$profile ;; esac
[ -f "$profile/config.yaml" ] || refuse "$profile has no config.yaml; profile is local, slurm, or a directory with one"
profile=$(cd "$profile" && pwd -P)

# The workflow has a virtual environment of its own.
python=$root/target/snakemake/bin/python
if ! "$python" -c 'import snakemake' 2> /dev/null; then
    mkdir -p "$root/target"
    python3 -m venv "$(cd "$root/target" && pwd -P)/snakemake"
    "$python" -m pip install --quiet snakemake==9.27.1 snakemake-executor-plugin-slurm==2.8.0
fi

# What a cluster hands a job on to quotes no paths.
case $profile in
"$root/workflow/profiles/local") ;;
*)
    for path in "$root" "$(pwd -P)" "$out"; do
        case $path in
        *[!A-Za-z0-9/._+,@%=:-]*) refuse "the path '$path' holds a blank or a character that a shell reads; on a cluster give a folder of letters and digits" ;;
        esac
    done
    ;;
esac

# The reference mirror is data that this repository does not have.
if [ "$name" = reference ] && [ -n "${PLANISH_REFERENCE:-}" ]; then
    just --justfile "$root/justfile" reference-mirror "$root/out/reference-mirror"
fi
"$programs/planish-sweep" expand "$sweep" --out "$out"
at=$(cd "$out" && pwd -P)

config=
[ -z "$at_once" ] || config="at_once=$at_once"
[ -z "$plans_per_job" ] || config="$config plans_per_job=$plans_per_job"
[ -z "$most_jobs" ] || config="$config most_jobs=$most_jobs"
# Those of the profile are given once more, because the command line replaces them all.
given=$(sed -n 's/^ *- *\([a-z_]*=.*\)/\1/p' "$profile/config.yaml")
for setting in $given; do
    case " $config " in *" ${setting%%=*}="*) ;; *) config="$config $setting" ;; esac
done

# Nothing in the flags is a pattern of file names.
set -f
# shellcheck disable=SC2086  # the numbers and the flags are several words
workflow() {
    # By its module: the first line of the program names a path, which a shell takes apart.
    "$python" -m snakemake --snakefile "$root/workflow/Snakefile" --directory "$at" \
        --profile "$profile" --config $config $flags "$@" || exit 2
}

if [ "$retry" = yes ]; then
    workflow --forcerun paths plans
else
    workflow
fi
if [ "$refine_front" = yes ]; then
    while true; do
        code=0
        "$programs/planish-sweep" propose "$out" || code=$?
        # 1: the search is over.
        [ "$code" -le 1 ] || exit "$code"
        [ "$code" -eq 0 ] || break
        workflow
    done
fi
"$programs/planish-sweep" table "$out"
# From within, so that its manifest is the same wherever the sweep stands.
cd "$at"
code=0
"$programs/planish-compare" sweep table.json --out report --force || code=$?
printf 'in %s\n' "$out"
exit "$code"
