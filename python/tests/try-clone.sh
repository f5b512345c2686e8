#!/bin/sh
# What a new user does in a clone, with the times: README's first command, then a mirror made with NumPy, from its arrays to
# a Galil and a G-code program in the machine's own axes: try-clone.sh REPOSITORY PYTHON OUT. Cargo's registry is at hand;
# nothing else is: every program is built. OUT is made by this script, or absent.
set -eu
repository=$(cd "$1" && pwd -P)
python=$2
out=$3
case $python in /*) ;; *) python=$PWD/$python ;; esac
if [ -e "$out" ] && [ ! -e "$out/made-by-try-clone" ]; then
    echo "error: $out is there, and this script did not make it; give another directory" >&2
    exit 2
fi
rm -rf "$out"
mkdir -p "$out/lab"
: > "$out/made-by-try-clone"
cd "$out"
git clone --quiet "$repository" clone
unset CARGO_TARGET_DIR PLANISH_PROGRAMS

build=$(grep -o 'cargo build [a-z -]*--bins' clone/README.md)
first=$(grep -m 1 '^planish run raster$' clone/README.md)
begun=$(date +%s)
(cd clone && PATH="$PWD/target/release:$PATH" sh -c "$build && $first") > first-command 2>&1 || { tail -n 20 first-command >&2; exit 1; }
tail -n 12 first-command
times > processor-time
echo "first command: $(($(date +%s) - begun)) s, processor time (user, system) $(sed -n 2p processor-time); $(du -sm clone/target | cut -f 1) MB in target"

cd lab
begun=$(date +%s)
"$python" "$repository/python/tests/mirror.py" write
../clone/target/release/planish run raster surface=mirror tif=tool machine=machine.json pitch_mm=2 step_mm=2 \
    export=galil out=plan > run 2>&1 || { tail -n 20 run >&2; exit 1; }
grep '^program: ' run
# The plan that the program is of
motion=plan/methods/$(sed -n 's/^program: .* is of the plan \([^;]*\);.*/\1/p' run)/trajectory
../clone/target/release/planish-export gcode --trajectory "$motion" --machine plan/machine/machine.json --out program.ngc
"$python" "$repository/python/tests/mirror.py" check "$motion" plan/program.galil program.ngc
echo "a mirror of one's own: from its arrays to both programs in $(($(date +%s) - begun)) s"
