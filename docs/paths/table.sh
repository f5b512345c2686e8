#!/bin/sh
# Every path on the reference mirror at about the published number of dwell points (2678), least
# dwell time 0.1 s, unrefined and refined, and with motion and times as one problem: the tables of docs/paths.md and
# docs/schedulers.md. `just paths-table [MACHINE]` runs it.
set -e
machine=$1
: "${PLANISH_REFERENCE:?names the folder that holds nsls2-mirror/}"
mirror=$PLANISH_REFERENCE/nsls2-mirror
out=out/paths-table/$(basename "$machine" .json)
mkdir -p "$out/map" "$out/tif"
cp "$mirror/height_nm.npy" "$mirror/x_mm.npy" "$mirror/y_mm.npy" "$out/map/"
cp "$mirror/tif_nm_per_s.npy" "$out/tif/rate_nm_per_s.npy"
cp "$mirror/tif_x_mm.npy" "$out/tif/x_mm.npy"
cp "$mirror/tif_y_mm.npy" "$out/tif/y_mm.npy"

# Name, pipeline and its settings; the paths share 5 mm of overscan.
while read -r name pipeline settings; do
    eval "set -- $settings"
    just run "$pipeline" surface="$out/map" tif="$out/tif" overscan_mm=5 plan_joint=yes machine="$machine" \
        out="$out/$name" "$@" >"$out/$name.log" 2>&1 </dev/null && continue
    # A plan that is not proven to be the best ends with 1 and its verdict, and is in the table all the same.
    [ $? -eq 1 ] && grep -q '^verdict: ' "$out/$name.log" || { cat "$out/$name.log"; exit 1; }
done <<PATHS
raster raster
raster-angle raster scan=30
raster-one-direction raster variant=--one-directional
raster-bi-step raster variant='--line-order bi-step'
raster-random raster variant='--line-order random'
raster-adaptive raster variant='--pitch-range-mm 0.7 1.4'
maze maze
mesh-tree random-adaptive pitch_mm=1.13
tour random-adaptive pitch_mm=1.17 construction=tour rounding_passes=0
multi-pitch multi-pitch max_velocity_mm_per_s=6 step_mm=1 max_pitch_mm=1.6 min_dwell_s_per_mm=
PATHS

echo '| path | points | motion | raw RMS, nm | total time, s | largest acceleration x, y, mm/s^2 |'
echo '|---|---|---|---|---|---|'
for name in raster raster-angle raster-one-direction raster-bi-step raster-random raster-adaptive \
    maze mesh-tree tour multi-pitch; do
    points=$(jq .outcome.points "$out/$name/tool_path/manifest.json")
    jq -r --arg name "$name" --arg points "$points" '
        def shown($n): . * $n | round / $n;
        .methods as $m | ("pvt", "pvt+refined", "joint") as $k | $m[$k] | "| \($name) | \($points) | \($k)"
        + " | \(.rms_nm | shown(1e4)) | \(.total_time_s | shown(10))"
        + " | \(.max_acceleration_mm_per_s2 | map(shown(1)) | join(", ")) |"
    ' "$out/$name/report/summary.json"
done
