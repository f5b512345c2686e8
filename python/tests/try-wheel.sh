#!/bin/sh
# Installs the wheel for this machine that is in WHEELS as a new user would, and tries it: try-wheel.sh WHEELS OUT. The
# environment is made in OUT, which this script made or which is absent; the PATH has no Rust toolchain and no clone.
set -eu
wheels=$(cd "$1" && pwd -P)
here=$(cd "$(dirname "$0")" && pwd -P)
out=$2
if [ -e "$out" ] && [ ! -e "$out/made-by-try-wheel" ]; then
    echo "error: $out is there, and this script did not make it; give another directory" >&2
    exit 2
fi
rm -rf "$out"
mkdir -p "$out"
: > "$out/made-by-try-wheel"
cd "$out"
begun=$(date +%s)
python3 -m venv environment
environment/bin/pip install --quiet "$wheels"/planish-*"$(uname -m)".whl
echo "installed in $(($(date +%s) - begun)) s"
env -i HOME="$PWD" PATH=/usr/bin:/bin environment/bin/python "$here/try_wheel.py"
"$here/try-module.sh" environment/bin/python .
