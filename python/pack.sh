#!/bin/sh
# Packs the file with all programs into a wheel in target/wheel: pack.sh FILE [MACHINE]. Without MACHINE the wheel is for
# machines like this one, or has the tag PLANISH_WHEEL_TAG. With x86_64 or aarch64 it has the tag manylinux_2_17, which
# auditwheel then checks.
set -eu
file=$1 machine=${2:-}
cd "$(dirname "$0")/.."
bin=target/wheel-python/bin
target=${machine:+$machine-unknown-linux-gnu}
python3 python/notices.py $target > target/wheel/THIRD-PARTY-NOTICES.txt
python3 python/sbom.py $target > target/wheel/planish.cdx.json
tag=${machine:+manylinux_2_17_$machine.manylinux2014_$machine}
tag=${tag:-${PLANISH_WHEEL_TAG:-}}
PLANISH_PROGRAMS_FILE=$PWD/$file PLANISH_WHEEL_TAG=$tag \
    $bin/python -m pip wheel --quiet --no-deps --no-build-isolation --wheel-dir target/wheel ./python
wheel=$(ls -t target/wheel/planish-*.whl | head -n 1)
if [ -n "$machine" ]; then
    $bin/auditwheel show "$wheel" > target/wheel/auditwheel.txt
    # The oldest C library 2.N that has the symbols that the programs name
    oldest=$(tr '\n' ' ' < target/wheel/auditwheel.txt |
        sed -n "s/.*following platform tag: *\"manylinux_2_\([0-9]*\)_$machine\".*/\1/p")
    if [ "${oldest:-99}" -gt 17 ]; then
        cat target/wheel/auditwheel.txt
        echo "error: $wheel: the programs need a newer C library than the tag says; build them by just wheels" >&2
        exit 1
    fi
fi
bytes=$(wc -c < "$wheel")
echo "$wheel: $((bytes / 1024 / 1024)).$((bytes * 10 / 1024 / 1024 % 10)) MiB"
