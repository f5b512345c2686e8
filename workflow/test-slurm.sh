#!/bin/sh
# A sweep on this machine, and the same through Slurm's sbatch on this machine: are they the same, byte by byte?
# test-slurm.sh [SWEEP.yaml [NAME=VALUE...]]: the small one without it; the settings are for the run through Slurm.
# What is there of a former test is made again. Needs root; Debian's slurm-wlm and munge are installed where missing.
set -eu
root=$(cd "$(dirname "$0")/.." && pwd -P)
cd "$root"
sweep=${1:-sweeps/small.yaml}
[ $# -eq 0 ] || shift
flags='--slurm-status-command squeue --slurm-no-account'
# Further flags of Snakemake are added to those.
for setting in "$@"; do
    shift
    case $setting in
    snakemake=*) flags="$flags ${setting#*=}" ;;
    *) set -- "$@" "$setting" ;;
    esac
done
name=$(basename "$sweep" .yaml)
at=out/test-slurm/$name

command -v slurmctld slurmd munged sbatch > /dev/null ||
    (apt-get update -qq && DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends slurm-wlm munge)
workflow/slurm-here.sh stop target/slurm-test
rm -rf "$at"
mkdir -p "$at"

seconds() { date +%s.%N; }
timed() {
    begun=$(seconds)
    code=0
    "$@" || code=$?
    [ "$code" -le 1 ] || exit "$code"
    took=$(echo "$begun $(seconds)" | awk '{ printf "%.1f", $2 - $1 }')
}

timed workflow/sweep.sh "$sweep" out="$at/local"
local_s=$took
trap 'workflow/slurm-here.sh stop target/slurm-test' EXIT
SLURM_CONF=$(workflow/slurm-here.sh start target/slurm-test | sed -n 's/^SLURM_CONF=//p')
export SLURM_CONF
timed workflow/sweep.sh "$sweep" profile=slurm out="$at/slurm" \
    snakemake="$flags" "$@"
slurm_s=$took
submitted=$(grep -c '_slurm_rpc_submit_batch_job: JobId=' target/slurm-test/slurmctld.log || true)

# What differs by its nature is left out: which jobs there were, what they took, and the engine's own notes.
for part in inputs mirror surface paths dwell plans report sweep.json table.json; do
    if [ -e "$at/local/$part" ] || [ -e "$at/slurm/$part" ]; then
        diff -r --no-dereference "$at/local/$part" "$at/slurm/$part"
    fi
done
rows=$(find "$at/slurm/plans" -name row.json | wc -l)
# On one node the jobs run one after the other; what is left is the workflow's.
cat "$at"/slurm/done/*.took.json | sed -n 's/.*"wall_s": *\([0-9.eE+-]*\).*/\1/p' | awk \
    -v head="$name: $rows plans, the same bytes; $local_s s here, $slurm_s s through Slurm in $submitted submissions" \
    -v all="$slurm_s" '{ work += $1 } END { printf "%s; its jobs worked for %.1f s, the workflow added %.1f s (%.1f %%)\n", head, work, all - work, 100 * (all - work) / work }'
