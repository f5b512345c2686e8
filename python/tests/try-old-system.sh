#!/bin/sh
# Installs the wheel in WHEELS in Debian 11 (2021, C library 2.31, Python 3.9), and tries it there: try-old-system.sh WHEELS
# OUT. debootstrap makes that system in OUT, which this script made or which is absent. Needs root.
set -eu
wheels=$(cd "$1" && pwd -P)
here=$(cd "$(dirname "$0")" && pwd -P)
out=$2
if [ -e "$out" ] && [ ! -e "$out/made-by-try-old-system" ]; then
    echo "error: $out is there, and this script did not make it; give another directory" >&2
    exit 2
fi
mkdir -p "$out"
: > "$out/made-by-try-old-system"
cd "$out"
if [ ! -e system/usr/bin/python3 ]; then
    rm -rf system
    debootstrap --variant=minbase --include=python3,python3-venv bullseye system > debootstrap.log
fi
# What the wheel needs comes from here, because the old system has no network.
rm -rf system/try
mkdir system/try
python3 -m pip download --quiet --only-binary=:all: --python-version 3.9 --platform "manylinux2014_$(uname -m)" \
    --dest system/try/wheels "$wheels"/planish-*manylinux*"$(uname -m)".whl
cp "$here/try_wheel.py" "$here/mirror.py" system/try
cat > system/try/run.sh << 'END'
set -eu
cd /try
ldd --version | head -n 1
python3 -m venv environment
begun=$(date +%s)
environment/bin/pip install --quiet --no-index --find-links wheels planish
echo "installed in $(($(date +%s) - begun)) s"
mkdir work
cd work
env -i HOME="$PWD" PATH=/usr/bin:/bin ../environment/bin/planish doctor
env -i HOME="$PWD" PATH=/usr/bin:/bin ../environment/bin/python ../try_wheel.py
END
# The mount ends with its namespace.
unshare --mount sh -c 'mount -t proc proc system/proc && exec chroot system env -i HOME=/root PATH=/usr/bin:/bin sh /try/run.sh'
