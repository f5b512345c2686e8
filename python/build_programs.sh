#!/bin/sh
# The programs of the wheel: build_programs.sh DIR, below which Cargo keeps them (DIR/release). They name no folder of the
# machine that they are built on: messages about defects would otherwise hold its user and its paths.
set -eu
root=$(cd "$(dirname "$0")/.." && pwd -P)
home=${CARGO_HOME:-$HOME/.cargo}
between=$(printf '\037') # of flags that may hold blanks
CARGO_ENCODED_RUSTFLAGS="--remap-path-prefix=$root=planish${between}--remap-path-prefix=$home=cargo"
# Code in C has its file names from another compiler, whose flags are separated by blanks.
case $root$home in *[!A-Za-z0-9/._+,@%:-]*) ;; *) CFLAGS="${CFLAGS:-} -ffile-prefix-map=$home=cargo -ffile-prefix-map=$root=planish" ;; esac
export CARGO_ENCODED_RUSTFLAGS CFLAGS="${CFLAGS:-}"
cargo build --quiet --release --locked --workspace --bins --manifest-path "$root/Cargo.toml" --target-dir "$1"
