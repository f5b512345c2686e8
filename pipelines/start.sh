#!/bin/sh
# What `just run` and its relatives do: start.sh GOAL PIPELINE [NAME=VALUE...]. The goal is run or compare
# (recipes of stages.just), or show, which prints its settings. The settings pass through here and `just`
# as arguments, whatever they hold.
set -eu
root=$(cd "$(dirname "$0")/.." && pwd -P)

refuse() {
    printf 'error: %s\n' "$1" >&2
    exit 2
}

goal=$1 name=$2
shift 2

pipelines=
for file in "$root"/pipelines/*.just; do
    file=${file##*/}
    [ "$file" = stages.just ] || pipelines="$pipelines ${file%.just}"
done
case "$pipelines " in
*" $name "*) ;;
*) refuse "no pipeline '$name'; there are:$pipelines" ;;
esac
file=$root/pipelines/$name.just

if [ "$goal" = show ]; then
    just --justfile "$file" --working-directory . --evaluate |
        awk -v name="$name" -f "$root/pipelines/show.awk" - "$file" "$root/pipelines/stages.just"
    printf '\nGiven as NAME=VALUE: just run %s NAME=VALUE... The commands of each step: pipelines/%s.just and stages.just.\n' \
        "$name" "$name"
    exit
fi

settings=" $(just --justfile "$file" --variables) "
for setting in "$@"; do
    case $setting in
    *=*) ;;
    *) refuse "'$setting' is not a setting; write NAME=VALUE (just show $name lists them)" ;;
    esac
    case $settings in
    *" ${setting%%=*} "*) ;;
    *) refuse "$name has no setting '${setting%%=*}'; there are:$settings" ;;
    esac
done
exec just --justfile "$file" --working-directory . "$@" "$goal" "$@"
