#!/usr/bin/env bash
# Coverage-guided fuzzing of every reader, one after the other: fuzz/run.sh EXECUTIONS SEED [READER...]
#
# Each starts from its corpus in fuzz/corpus and goes on from what earlier runs found in out/fuzz. Ends with 1
# when a reader panics, takes more than 10 s for one input, or more memory than 256 MiB (the readers' own budget
# is 64 MiB here); then the input is in out/fuzz, with the command that repeats it. With EXECUTIONS
# "minimise" nothing is fuzzed: the few inputs, old and found, that reach most of the code become the corpus.
set -uo pipefail
cd "$(dirname "$0")/.."
executions=$1 seed=$2
shift 2

# Instrumented crates are kept apart from the others by their profile, see fuzz/Cargo.toml. Its lock file follows
# the dependencies of the crates that it reads, so it is not insisted on.
CARGO_TARGET_DIR=target RUSTC_WRAPPER="$PWD/fuzz/instrument.sh" RUSTFLAGS= \
    cargo build --quiet --release --manifest-path fuzz/Cargo.toml || exit 2
program="$PWD/target/release/planish-fuzz"
if [ $# -eq 0 ]; then set -- fuzz/corpus/*; fi

if [ "$executions" = minimise ]; then
    for reader in "$@"; do
        name=$(basename "$reader")
        at=out/fuzz/$name
        rm -rf "$at/least" "$at/control"
        mkdir -p "$at/found" "$at/least"
        # Edges, not how often each was taken.
        PLANISH_READER=$name "$program" -set_cover_merge=1 -use_counters=0 -max_len=16384 -rss_limit_mb=256 \
            -merge_control_file="$at/control" "$at/least" "fuzz/corpus/$name" "$at/found" > "$at/log" 2>&1 || exit 2
        python3 fuzz/least.py "$at/control" "fuzz/corpus/$name"
    done
    exit 0
fi

printf '%-14s %12s %9s %9s %8s %8s %11s %9s\n' \
    reader executions 'exec/s' features inputs crashes 'slowest ms' 'peak MiB'
broken=0
for reader in "$@"; do
    name=$(basename "$reader")
    at=out/fuzz/$name
    mkdir -p "$at/found"
    started=$(date +%s.%N)
    # The address space bounds what is asked for and not touched; the allocator sets 1 GiB aside itself.
    (ulimit -v 3000000 && PLANISH_READER=$name RUST_BACKTRACE=0 exec "$program" -runs="$executions" \
        -seed="$seed" -timeout=10 -rss_limit_mb=256 -max_len=16384 -print_final_stats=1 -verbosity=1 \
        -artifact_prefix="$at/" "$at/found" "fuzz/corpus/$name") > "$at/log" 2>&1
    status=$?
    seconds=$(echo "$(date +%s.%N) $started" | awk '{ print $1 - $2 }')
    stat() { awk -v key="stat::$1:" '$1 == key { print $2 }' "$at/log" | tail -1; }
    done_=$(stat number_of_executed_units)
    features=$(grep -oE ' ft: [0-9]+' "$at/log" | tail -1 | grep -oE '[0-9]+')
    slowest=$(awk '$1 == "slowest" { print $2 }' "$at/log" | tail -1)
    printf '%-14s %12s %9.0f %9s %8s %8s %11s %9s\n' "$name" "${done_:-?}" \
        "$(echo "${done_:-0} $seconds" | awk '{ print $1 / $2 }')" "${features:-?}" \
        "$(ls "$at/found" | wc -l)" "$((status != 0))" "${slowest:-?}" "$(stat peak_rss_mb)"
    if [ "$status" -ne 0 ]; then
        broken=1
        grep -E 'panicked|^assertion|ERROR' -A1 "$at/log" | head -4
        input=$(grep -oE 'Test unit written to .*' "$at/log" | tail -1 | awk '{ print $5 }')
        echo "  again: PLANISH_READER=$name target/release/planish-fuzz ${input:-(see $at/log)}"
    fi
done
exit $broken
