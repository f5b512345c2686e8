#!/bin/sh
# What is here, and what of Planish needs it, in one screen: doctor.sh. Ends with 1 where something is missing without
# which nothing can be built or run; what is optional is named with the recipes that need it.
set -u
root=$(cd "$(dirname "$0")/.." && pwd -P)
missing=0

row() {
    printf '%-18s %-34.34s %s\n' "$1" "$2" "$3"
}

# program NAME PURPOSE: its version, or what cannot be done without it
program() {
    if command -v "$1" > /dev/null 2>&1; then
        version=$("$1" --version 2> /dev/null | head -n 1) || version=
        row "$1" "${version:-here}" "$2"
    else
        row "$1" missing "$2"
        return 1
    fi
}

row 'part' 'here' 'needed for'
row '----' '----' '----------'
stages=$(find "$root/target/release" -maxdepth 1 -name 'planish-*' -type f -perm -u+x 2> /dev/null | wc -l)
row Planish "$(git -C "$root" describe --always --dirty 2> /dev/null || echo 'no git')" "$((stages)) programs built in target/release"
program cargo 'building' || missing=1
program cc 'building' || missing=1
program just 'every recipe' || missing=1
wanted=$(sed -n 's/^rust-version = "\(.*\)"/\1/p' "$root/Cargo.toml")
have=$(rustc --version 2> /dev/null | cut -d ' ' -f 2)
if [ -n "$have" ] && [ "$(printf '%s\n%s\n' "$wanted" "$have" | sort -V | head -n 1)" = "$wanted" ]; then
    row rustc "$have" "building: $wanted or newer"
else
    row rustc "${have:-missing}" "building: $wanted or newer"
    missing=1
fi
row cores "$(nproc 2> /dev/null || getconf _NPROCESSORS_ONLN)" 'stages use all; RAYON_NUM_THREADS limits them'
row memory "$(awk '/^MemAvailable/ { printf "%.1f GiB available", $2 / 1048576 }' /proc/meminfo 2> /dev/null)" \
    'a stage refuses what needs more than its --memory-gib'
row 'disk' "$(df -Pk "$root" | awk 'NR == 2 { printf "%.1f GiB free", $4 / 1048576 }')" 'target: 1 GiB after just build, 2 GiB after just test'
row PLANISH_REFERENCE "$(if [ -d "${PLANISH_REFERENCE:-/nowhere}/nsls2-mirror" ]; then echo 'set'; else echo 'not set, or not the folder'; fi)" \
    'tests and tables of the reference mirror'
printf '\noptional:\n'
program python3 'just wheel, sweep, test-commands, test-interop, test-report, fuzz-binaries; your own stages' || :
program octave-cli 'just test-matlab (installed there on Debian, as root)' || :
program c++ 'just fuzz' || :
program chromium 'just test-report, docs (installed there on Debian, as root)' || :
program strace 'just test-faults (installed there on Debian, as root)' || :
program rs274 'just test-gcode against the interpreter of LinuxCNC' || :
exit "$missing"
