# What the scripts that make several runs have in common. They set `root`, the directory of the repository, and read this.
PATH=$root/target/release:$PATH
export PATH

refuse() {
    printf 'error: %s\n' "$1" >&2
    exit 2
}

# find_pipeline NAME: `file`, the justfile of a pipeline that plans a run
find_pipeline() {
    file=$root/pipelines/$1.just
    case $1 in
    stages | compare-dwell | */*) file= ;;
    esac
    [ -f "$file" ] || refuse "'$1' is no pipeline that plans a run; give raster, maze, spiral"
}

# name_of_directory PATH: `name`, the last part of its absolute path
name_of_directory() {
    case $1 in
    /*) name=$1 ;;
    *) name=$(pwd -P)/$1 ;;
    esac
    name=${name%/}
    name=${name##*/}
}

# paths_are_no_flags VARIABLE...: a path that begins with a hyphen gets its directory
paths_are_no_flags() {
    for variable in "$@"; do
        eval "case \$$variable in -*) $variable=./\$$variable ;; esac"
    done
}

# learn COMMAND FLAGS...: what a run taught, called by COMMAND, with the flags in the setting `reconcile` taken apart as a
# shell would do it
learn() {
    caller=$1
    shift
    words=$(planish-run words -- "$reconcile")
    eval "set -- \"\$@\" $words"
    "$caller" planish-reconcile "$@"
}
