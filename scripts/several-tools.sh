#!/bin/sh
# Plans tools of 16, 8 and 4 mm for the measured map of 60 x 60 mm in PLANISH_REFERENCE, together and each alone: residual,
# time, proven gap and wall time (docs/several-tools.md). The argument is a directory for its files.
set -eu
out=$1
map=$PLANISH_REFERENCE/instruments/initial_map.mat
mkdir -p "$out"
planish import surface "$map" --unit m --coordinate-unit m --out "$out/imported" --force > /dev/null
planish surface prepare --surface "$out/imported" --level piston --out "$out/surface" --force > /dev/null
# Half of the size, sigma (the width at half the peak over 2.3548) and pitch of each, mm.
for tool in "16 24 6.7946 4" "8 12 3.3973 2" "4 6 1.6986 1"; do
    set -- $tool
    cat > "$out/tool-$1.json" <<RECIPE
{ "name": "tool-$1", "doc": "A Gaussian tool.", "seed": 1, "pixels": [21, 21], "width_mm": 20.0,
  "aperture": "rectangle", "legendre": [ { "order": [2, 0], "amplitude_nm": 1.0 } ], "noise_rms_nm": 0.0,
  "tif": { "peak_nm_per_s": 20.0, "half_size_mm": $2, "shape": { "gaussian": { "sigma_mm": $3 } } } }
RECIPE
    planish fixture "$out/tool-$1.json" --out "$out/tool-$1" --force > /dev/null
    planish toolpath raster --surface "$out/surface" --tif "$out/tool-$1/tif" --pitch-mm "$4" --step-mm "$4" \
        --out "$out/path-$1" --force > /dev/null
done
for tools in "16" "8" "4" "16 8 4"; do
    name=$(echo "$tools" | tr ' ' '-')
    comma=
    {
        printf '{ "tools": ['
        for mm in $tools; do
            printf '%s\n  { "name": "tool-%s", "tif": "tool-%s/tif", "tool_path": "path-%s", "time_weight_nm2_per_s": 0.003 }' \
                "$comma" "$mm" "$mm" "$mm"
            comma=,
        done
        printf ' ] }\n'
    } > "$out/rack-$name.json"
    planish dwell several-tools --surface "$out/surface" --rack "$out/rack-$name.json" --out "$out/plan-$name" \
        --wall-time "$out/time-$name.json" --force
    cat "$out/time-$name.json"
    echo
done
