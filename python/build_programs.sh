#!/bin/sh
# The program of the wheel, which holds all others: build_programs.sh DIR [SYSTEM]. Cargo keeps its files below DIR.
# Without SYSTEM it is for machines like this one: DIR/release/planish. With one, such as
# x86_64-unknown-linux-gnu.2.17, it is for that system from that version of its C library on:
# DIR/x86_64-unknown-linux-gnu/release/planish. cargo-zigbuild makes that one. The program names no folder of the
# machine that builds it: messages about defects would otherwise hold the name of its user.
set -eu
root=$(cd "$(dirname "$0")/.." && pwd -P)
home=${CARGO_HOME:-$HOME/.cargo}
between=$(printf '\037') # of flags that may hold blanks
CARGO_ENCODED_RUSTFLAGS="--remap-path-prefix=$root=planish${between}--remap-path-prefix=$home=cargo"
# Code in C has its file names from another compiler, whose flags are separated by blanks.
case $root$home in *[!A-Za-z0-9/._+,@%:-]*) ;; *) CFLAGS="${CFLAGS:-} -ffile-prefix-map=$home=cargo -ffile-prefix-map=$root=planish" ;; esac
export CARGO_ENCODED_RUSTFLAGS CFLAGS="${CFLAGS:-}" CARGO_PROFILE_RELEASE_STRIP=symbols
dir=$1
if [ $# -eq 1 ]; then
    set -- build
else
    set -- zigbuild --target "$2"
fi
cargo "$@" --quiet --release --locked --manifest-path "$root/Cargo.toml" --target-dir "$dir" \
    --package planish
