#!/bin/sh
# The compiler, for `just fuzz`: it instruments the readers and what they read with, so that libFuzzer sees
# which branches an input takes, and leaves everything else as it is. All of this is stable Rust.
rustc=$1
shift
case " $* " in
*" --crate-name planish_fuzz "* | *" --crate-name planish_import "* | *" --crate-name planish_handoff "* | \
    *" --crate-name planish_types "* | *" --crate-name hdf5_reader "* | *" --crate-name hdf5_core "* | \
    *" --crate-name flate2 "* | *" --crate-name miniz_oxide "* | *" --crate-name serde_json "* | \
    *" --crate-name ndarray_npy "* | *" --crate-name py_literal "* | *" --crate-name roxmltree "*)
    exec "$rustc" "$@" -Cpasses=sancov-module -Cllvm-args=-sanitizer-coverage-level=4 \
        -Cllvm-args=-sanitizer-coverage-inline-8bit-counters -Cllvm-args=-sanitizer-coverage-pc-table \
        -Cllvm-args=-sanitizer-coverage-trace-compares
    ;;
*) exec "$rustc" "$@" ;;
esac
