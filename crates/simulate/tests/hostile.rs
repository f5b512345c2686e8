//! Counts that nobody means, degenerate maps and tools, mistaken units, through the binary.

use std::path::Path;

use planish_testkit::hostile::{COUNTS, every_value, inputs, integers, npy, survives};

const BINARY: &str = "planish-simulate";

/// Writes the arrays of a motion along ten lines, each at a constant velocity for `line_s` seconds, without turns
/// between them.
fn lines(dir: &Path, line_s: f64) {
    let motion = dir.join("trajectory");
    let at = |k: usize| [-2.0, 14.0 / line_s, 0.0, 0.0, k as f64 - 1.0, 0.0, 0.0, 0.0];
    let coefficients: Vec<f64> = (0..10).flat_map(at).collect();
    let breaks: Vec<f64> = (0..=10).map(|k| line_s * f64::from(k)).collect();
    npy(&motion, "break_time_s", &[11], &breaks);
    npy(&motion, "coefficient_mm", &[10, 2, 4], &coefficients);
    integers(&motion, "dwell_index", &(0..10).collect::<Vec<i64>>());
}

fn arguments(surface: &str, tif: &str) -> Vec<String> {
    let given = [("surface", surface), ("tif", tif), ("trajectory", "trajectory"), ("out", "out")];
    given.iter().map(|(flag, value)| format!("--{flag}={value}")).collect()
}

#[test]
fn no_count_no_map_and_no_tool_ends_in_a_panic() {
    let tmp = tempfile::tempdir().unwrap();
    let [maps, tifs, _] = inputs(tmp.path());
    lines(tmp.path(), 1.0);
    let all = arguments("surface", "tif");
    let all: Vec<&str> = all.iter().map(String::as_str).collect();
    every_value(BINARY, tmp.path(), &all, &["--frames"], &COUNTS, "out");
    let direct = [&all[..], &["--integral=direct"]].concat();
    every_value(BINARY, tmp.path(), &direct, &["--steps"], &COUNTS, "out");
    let with_map = maps.iter().map(|m| arguments(m, "tif"));
    let with_tif = tifs.iter().map(|t| arguments("surface", t));
    for all in with_map.chain(with_tif) {
        let all: Vec<&str> = all.iter().map(String::as_str).collect();
        survives(BINARY, tmp.path(), &all, "out");
        survives(BINARY, tmp.path(), &[&all[..], &["--memory-gib=0.001"]].concat(), "out");
    }
}

#[test]
fn a_tif_a_thousand_times_too_wide_is_refused() {
    let tmp = tempfile::tempdir().unwrap();
    inputs(tmp.path());
    lines(tmp.path(), 1.0);
    let all = arguments("surface", "tif-in-um");
    let all: Vec<&str> = all.iter().map(String::as_str).collect();
    let (code, said) = survives(BINARY, tmp.path(), &all, "out");
    assert_eq!(code, 2);
    assert!(said.contains("a TIF in um?"), "{said}");
}

#[test]
fn a_surface_made_worse_is_a_negative_verdict() {
    let tmp = tempfile::tempdir().unwrap();
    inputs(tmp.path());
    // Of a flat map nothing is known to be better than nothing.
    for (surface, line_s, code) in [("zero", 1.0, 0), ("surface", 100.0, 1)] {
        lines(tmp.path(), line_s);
        let all = arguments(surface, "tif");
        let all: Vec<&str> = all.iter().map(String::as_str).collect();
        let (got, said) = survives(BINARY, tmp.path(), &all, "out");
        assert_eq!(got, code, "{said}");
        assert_eq!(said.contains("makes the surface worse"), code == 1, "{said}");
    }
    // The manifest keeps what the report shows: the reason, and whether a mistake would explain it.
    let manifest = std::fs::read_to_string(tmp.path().join("out/manifest.json")).unwrap();
    for words in ["makes the surface worse", "no single factor"] {
        assert!(manifest.contains(words), "{manifest}");
    }
}
