#!/bin/sh
# Every scheduler along three paths: compare.sh FIXTURE|all [NAME=VALUE...]. Each path is a run of its own in
# out/compare/FIXTURE/PATH, or in OUT/PATH where out=OUT is given; the report beside them holds all three. `all` does so for
# every mirror of fixtures/ but those in skip="NAME NAME", in out/compare/all/FIXTURE-PATH, with one report of all.
set -eu
root=$(cd "$(dirname "$0")/.." && pwd -P)
fixture=$1
shift
case $(pwd -P) in "$root") out=out ;; *) out=$root/out ;; esac
out=$out/compare/$(printf %s "$fixture" | tr -c 'A-Za-z0-9._+-' _)
paths="raster maze random-adaptive"
# `just` takes the last of several values of a setting.
tif= skip=
number=$#
while [ "$number" -gt 0 ]; do
    setting=$1
    shift
    number=$((number - 1))
    case $setting in
        out=*) out=${setting#out=} ;;
        skip=*) skip=${setting#skip=} && continue ;;
        tif=*) tif=${setting#tif=} ;;
    esac
    set -- "$@" "$setting"
done
case $out in -*) out=./$out ;; esac
case $tif in -*) tif=./$tif ;; esac
if [ -n "$skip" ] && [ "$fixture" != all ]; then
    echo "error: skip leaves out mirrors of \`all\`; leave it out for one mirror" >&2
    exit 2
fi

end=0
# One run: path, fixture, directory, settings.
run() {
    path=$1 mirror=$2 to=$3
    shift 3
    status=0
    "$root/pipelines/start.sh" compare "$path" "fixture=$mirror" "$@" "out=$to" || status=$?
    [ "$status" -le 1 ] || exit "$status"
    [ "$status" -eq 0 ] || end=1
}

# The report of the runs that follow the flags.
report() {
    PATH=$root/target/release:$PATH
    export PATH
    PS4=
    set -x
    planish-compare report "$@" --out "$out/report" --force || end=$?
    { set +x; } 2> /dev/null
    exit "$end"
}

if [ "$fixture" = all ]; then
    mirrors=
    for file in "$root"/fixtures/*.json; do
        mirror=$(basename "$file" .json)
        case " $skip " in *" $mirror "*) ;; *) mirrors="$mirrors $mirror" ;; esac
    done
    if [ -z "$mirrors" ]; then
        echo "error: skip leaves out every mirror of fixtures/" >&2
        exit 2
    fi
    for mirror in $mirrors; do
        for path in $paths; do
            run "$path" "$mirror" "$out/$mirror-$path" "$@"
        done
    done
    set --
    for mirror in $mirrors; do
        for path in $paths; do
            set -- "$@" "$out/$mirror-$path"
        done
    done
    report "$@" --pipeline compare
fi

for path in $paths; do
    run "$path" "$fixture" "$out/$path" "$@"
done
# The tool is the same along every path: that of the fixture, or the user's as it is or as it was imported.
if [ -z "$tif" ]; then
    tif=$out/raster/fixture/tif
elif [ -f "$tif" ]; then
    tif=$out/raster/import/tif
fi
report "$out/raster" "$out/maze" "$out/random-adaptive" --mirror="$fixture" --tif "$tif"
