#!/bin/sh
# The PVT motion of a run, as every controller will run it with counts of 0.1 and 1 um:
# quantisation.sh RUN TIF. A table of all methods is printed at the end.
set -eu
PATH="$(dirname "$0")/../target/release:$PATH"
run=$1 tif=$2 machine=${3:-fixtures/machines/ion-beam.json}
for count in 0.0001 0.001; do
    for controller in galil xps pmac gcode; do
        name="pvt+$controller-$(awk "BEGIN { print 1000 * $count }")um"
        program="$run/$name.program"
        planish-export "$controller" --trajectory "$run/methods/pvt/trajectory" --machine "$machine" --count-mm "$count" --out "$program" --force
        planish-import program "$program" --controller "$controller" --about "$program.json" --out "$run/methods/$name/trajectory" --force
        planish-simulate --trajectory "$run/methods/$name/trajectory" --tif "$tif" --surface "$run/surface" --out "$run/methods/$name/removal" --force
        planish-verify --trajectory "$run/methods/$name/trajectory" --machine "$machine" --out "$run/methods/$name/verdict" --force || [ $? -eq 1 ] || exit 2
    done
done
planish-compare report "$run" --pipeline raster --fixture mirror --out "$run/report" --force
