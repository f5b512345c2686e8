#!/bin/sh
# How the results of campaigns scatter: campaign-spread.sh [FIXTURE] [seeds=20] [NAME=VALUE...], with the settings of
# campaign.sh. Each campaign is in out/campaign-spread/MIRROR/SEED, or in OUT/SEED where out=OUT is given.
set -eu
root=$(cd "$(dirname "$0")/.." && pwd -P)
case $(pwd -P) in "$root") out=out ;; *) out=$root/out ;; esac
seeds=20 mirror=coupon own=
remaining=$#
while [ "$remaining" -gt 0 ]; do
    word=$1
    shift
    remaining=$((remaining - 1))
    case $word in
    seeds=*) seeds=${word#*=} && continue ;;
    out=*) own=${word#*=} && continue ;;
    seed=*)
        printf 'error: every campaign has a seed of its own; give seeds=N, how many\n' >&2
        exit 2
        ;;
    fixture=*) mirror=${word#*=} ;;
    surface=*) mirror=${word##*/} ;;
    *=*) ;;
    *) mirror=$word ;;
    esac
    set -- "$@" "$word"
done
case $seeds in
[1-9] | [1-9][0-9] | [1-9][0-9][0-9]) ;;
*)
    printf "error: seeds is '%s'; give 1 to 999\n" "$seeds" >&2
    exit 2
    ;;
esac
out=${own:-$out/campaign-spread/$(printf %s "$mirror" | tr -c 'A-Za-z0-9._+-' _)}
case $out in -*) out=./$out ;; esac
seed=1
while [ "$seed" -le "$seeds" ]; do
    "$root/pipelines/campaign.sh" "$@" "seed=$seed" "out=$out/$seed" > /dev/null
    seed=$((seed + 1))
done
set --
seed=1
while [ "$seed" -le "$seeds" ]; do
    set -- "$@" "$out/$seed/report"
    seed=$((seed + 1))
done
exec "$root/target/release/planish-campaign" spread "$@"
