#!/bin/sh
# Tries planish.m with Octave, as it is used from MATLAB, and compares the bytes: try-matlab.sh PROGRAMS PYTHON OUT, with a
# Python that has NumPy. OUT is made by this script, or absent.
set -eu
programs=$(cd "$1" && pwd -P)
python=$2
here=$(cd "$(dirname "$0")" && pwd -P)
out=$3
if [ -e "$out" ] && [ ! -e "$out/made-by-try-matlab" ]; then
    echo "error: $out is there, and this script did not make it; give another directory" >&2
    exit 2
fi
case $python in /*) ;; *) python=$PWD/$python ;; esac
rm -rf "$out"
mkdir -p "$out/called" "$out/typed"
: > "$out/made-by-try-matlab"
cd "$out"
cat > called/machine.json << 'END'
{"name": "lab", "axes": [
    {"name": "x", "max_velocity_mm_per_s": 250, "max_acceleration_mm_per_s2": 2000},
    {"name": "y", "max_velocity_mm_per_s": 200, "max_acceleration_mm_per_s2": 2000}]}
END
(cd called && PLANISH_PROGRAMS=$programs octave-cli --no-gui --quiet --path "$here/../matlab" --path "$here" \
    --eval try_matlab)

# What it saved has the bytes that NumPy writes.
"$python" - called/mirror/*.npy called/tool/*.npy << 'END'
import io, pathlib, sys
import numpy as np
for name in sys.argv[1:]:
    written = io.BytesIO()
    np.save(written, np.load(name))
    assert written.getvalue() == pathlib.Path(name).read_bytes(), name
print(f"{len(sys.argv) - 1} arrays: the bytes of numpy.save")
END

# What it called writes the bytes of the command line.
cp -r called/mirror called/tool called/machine.json typed
cd typed
PATH=$programs:$PATH
planish-toolpath raster --surface=mirror --tif=tool --pitch-mm=2 --step-mm=0.8 --out=made/path
planish-dwell bounded-least-squares --surface=mirror --tif=tool --tool-path=made/path --min-dwell-s=0.02 --out=made/dwell
planish-schedule pvt --tool-path=made/path --dwell=made/dwell --machine=machine.json --out=made/trajectory
planish-verify --trajectory=made/trajectory --machine=machine.json --out=made/verdict
planish-surface prepare --surface=mirror --aperture-rectangle-mm -70 70 -18 18 --level=plane --mask-outliers \
    --feature-mm=4 --out=made/prepared
cd ..
diff -r called/made typed/made
echo "$(find typed/made -type f | wc -l) files: the bytes of the command line"
