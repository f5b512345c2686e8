#!/bin/sh
# The pictures of docs/gallery.md: every path and every method on the coupon, each run in out/gallery/RUN.
set -eu
cd "$(dirname "$0")/.."
pictures=docs/gallery
mkdir -p $pictures out/gallery

# made STAGE RUN PIPELINE [NAME=VALUE...]. Exit code 1, a negative verdict, is a result.
made() {
    stage=$1 name=$2 pipeline=$3
    shift 3
    target/release/planish-run stage "$pipeline" "$stage" "$@" fixture=coupon frames=0 "out=out/gallery/$name" \
        > "out/gallery/$name.log" 2>&1 || [ $? -eq 1 ]
}

# draw RUN METHOD NAME: before, path and after of a method of a run, to docs/gallery/NAME.png
draw() {
    target/release/planish-compare figures "out/gallery/$1" --method "$2" --format png --dpi 110 \
        --out "out/gallery/figures/$3" --force > out/gallery/drawn.log
    cp "out/gallery/figures/$3/overview.png" "$pictures/$3.png"
}

made run raster raster
made run raster-angle raster scan=30
made run maze maze
made run random-adaptive random-adaptive
made run multi-pitch multi-pitch
made run spiral spiral pitch_mm=1
made compare schedulers raster
made run bspline bspline pitch_mm=1 step_mm=1 machine=fixtures/machines/ion-beam-no-jerk-limit.json

for path in raster raster-angle maze random-adaptive multi-pitch spiral; do
    draw $path pvt+refined path-$path
done
for method in position average-velocity constant-acceleration stop-at-corners pvt pvt+smooth pvt-as-published \
    trig-spline trig-spline+local; do
    draw schedulers $method "method-$(echo $method | tr + -)"
done
draw raster pvt+refined method-pvt-refined
draw raster joint method-joint
draw bspline bspline method-bspline
