#!/bin/sh
# Slurm on this machine alone, for tests: slurm-here.sh start DIR, which prints the environment that its commands need,
# and slurm-here.sh stop DIR. Daemons, keys, logs and ports are its own, in DIR; a machine that has a Slurm already is
# left alone. Needs root, and Debian's slurm-wlm and munge.
set -eu
goal=$1 dir=$2
mkdir -p "$dir"
dir=$(cd "$dir" && pwd -P)
# A socket's path has at most 107 characters, so it cannot lie in DIR.
socket=/tmp/planish-munge.$(printf %s "$dir" | cksum | cut -d ' ' -f 1)

# Snakemake's jobs drop every variable that begins with SLURM_, and srun then looks here: where the daemon of a cluster
# without files of its own on the nodes keeps them.
found=/run/slurm/conf

if [ "$goal" = stop ]; then
    if [ -f "$dir/slurmctld.pid" ]; then
        # A job outlives the daemons.
        SLURM_CONF=$dir/slurm.conf timeout 10 scancel --user="$(id -un)" || true
        waited=0
        while [ -n "$(SLURM_CONF=$dir/slurm.conf timeout 10 squeue --noheader --states=running,completing || true)" ] &&
            [ $waited -lt 50 ]; do
            sleep 0.2
            waited=$((waited + 1))
        done
    fi
    [ "$(readlink "$found")" != "$dir" ] || rm -f "$found"
    for daemon in slurmd slurmctld munged; do
        [ -f "$dir/$daemon.pid" ] || continue
        pid=$(cat "$dir/$daemon.pid")
        # A number may be somebody else's by now.
        if [ "$(cat "/proc/$pid/comm" 2> /dev/null)" = "$daemon" ]; then
            kill "$pid"
            waited=0
            while [ -d "/proc/$pid" ] && [ $waited -lt 100 ]; do sleep 0.1; waited=$((waited + 1)); done
        fi
        rm -f "$dir/$daemon.pid"
    done
    rm -rf "$socket"
    exit
fi

for file in /etc/slurm/slurm.conf "$found/slurm.conf"; do
    if [ -e "$file" ]; then
        printf 'error: this machine has a Slurm: %s; use that one (just sweep SWEEP.yaml profile=slurm)\n' "$file" >&2
        exit 2
    fi
done
mkdir -p "$(dirname "$found")"
ln -sfn "$dir" "$found"
rm -rf "$dir/state" "$dir/spool" "$dir"/*.log
mkdir -p "$dir/state" "$dir/spool" "$socket"
chmod 755 "$socket"
(umask 077 && [ -s "$dir/munge.key" ] || dd if=/dev/urandom bs=1 count=1024 2> /dev/null > "$dir/munge.key")
host=$(hostname -s)
cores=$(nproc)
memory=$(($(sed -n 's/^MemTotal: *\([0-9]*\) kB/\1/p' /proc/meminfo) / 1024 * 9 / 10))
cat > "$dir/slurm.conf" << CONF
ClusterName=here
SlurmctldHost=$host(127.0.0.1)
SlurmctldPort=16817
SlurmdPort=16818
SlurmUser=root
AuthType=auth/munge
AuthInfo=socket=$socket/munge.socket
CryptoType=crypto/munge
StateSaveLocation=$dir/state
SlurmdSpoolDir=$dir/spool
SlurmctldPidFile=$dir/slurmctld.pid
SlurmdPidFile=$dir/slurmd.pid
SlurmctldLogFile=$dir/slurmctld.log
SlurmdLogFile=$dir/slurmd.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SchedulerType=sched/backfill
SelectType=select/cons_tres
SelectTypeParameters=CR_Core_Memory
ReturnToService=2
# Without a database of accounts a finished job is known only so long, s.
MinJobAge=600
AccountingStorageType=accounting_storage/none
JobAcctGatherType=jobacct_gather/none
MpiDefault=none
NodeName=$host NodeAddr=127.0.0.1 CPUs=$cores RealMemory=$memory State=UNKNOWN
PartitionName=here Nodes=$host Default=YES MaxTime=INFINITE State=UP
CONF
cat > "$dir/cgroup.conf" << CONF
CgroupPlugin=autodetect
IgnoreSystemd=yes
CONF
# munged refuses a key, a socket or a log in a folder that others may write to, which its own --force allows.
munged --force --key-file="$dir/munge.key" --socket="$socket/munge.socket" --pid-file="$dir/munged.pid" \
    --log-file="$dir/munged.log" --seed-file="$dir/munge.seed" > "$dir/munged.said" 2>&1
SLURM_CONF=$dir/slurm.conf
export SLURM_CONF
slurmctld
slurmd
waited=0
until sinfo --noheader --format=%t 2> /dev/null | grep -q idle; do
    waited=$((waited + 1))
    if [ $waited -gt 60 ]; then
        printf 'error: Slurm does not start; %s/*.log say why\n' "$dir" >&2
        exit 2
    fi
    sleep 0.5
done
printf 'SLURM_CONF=%s\n' "$SLURM_CONF"
