//! Flags that nobody means, degenerate maps and tools, through the binary.

use std::{fs, path::Path};

use planish_testkit::{
    hostile::{COUNTS, every_value, inputs, integers, npy, survives},
    workspace,
};

const BINARY: &str = "planish-tolerance";

/// Writes the arrays of a motion along ten lines, each at a constant velocity for `line_s` seconds, without turns
/// between them. All lengths are multiplied by `scale`.
fn lines(dir: &Path, name: &str, line_s: f64, scale: f64) {
    let motion = dir.join(name);
    let at = |k: usize| {
        let y = scale * (k as f64 - 1.0);
        [-2.0 * scale, scale * 14.0 / line_s, 0.0, 0.0, y, 0.0, 0.0, 0.0]
    };
    let coefficients: Vec<f64> = (0..10).flat_map(at).collect();
    let breaks: Vec<f64> = (0..=10).map(|k| line_s * f64::from(k)).collect();
    npy(&motion, "break_time_s", &[11], &breaks);
    npy(&motion, "coefficient_mm", &[10, 2, 4], &coefficients);
    integers(&motion, "dwell_index", &(0..10).collect::<Vec<i64>>());
}

fn arguments(surface: &str, tif: &str, trajectory: &str) -> Vec<String> {
    let given = [
        ("surface", surface),
        ("tif", tif),
        ("trajectory", trajectory),
        ("error-budget", "error_budget.json"),
        ("draws", "200"),
        ("simulated-runs", "1"),
        ("out", "out"),
    ];
    given.iter().map(|(flag, value)| format!("--{flag}={value}")).collect()
}

#[test]
fn no_count_no_map_no_tool_and_no_motion_ends_in_a_panic() {
    let tmp = tempfile::tempdir().unwrap();
    let [maps, tifs, _] = inputs(tmp.path());
    fs::copy(
        workspace().join("fixtures/error-budgets/fluid-jet.json"),
        tmp.path().join("error_budget.json"),
    )
    .unwrap();
    lines(tmp.path(), "trajectory", 1.0, 1.0);
    lines(tmp.path(), "in-um", 1.0, 1e3);
    lines(tmp.path(), "far", 1.0, 1e6);
    lines(tmp.path(), "short", 1e-6, 1.0);
    lines(tmp.path(), "long", 1e8, 1.0);
    let given = arguments("surface", "tif", "trajectory");
    for flag in ["--draws", "--simulated-runs", "--seed"] {
        let others = given.iter().filter(|a| !a.starts_with(flag));
        let others: Vec<&str> = others.map(String::as_str).collect();
        every_value(BINARY, tmp.path(), &others, &[flag], &COUNTS, "out");
    }
    let with_map = maps.iter().map(|m| arguments(m, "tif", "trajectory"));
    let with_tif = tifs.iter().map(|t| arguments("surface", t, "trajectory"));
    let motions = ["in-um", "far", "short", "long"];
    let with_motion = motions.iter().map(|t| arguments("surface", "tif", t));
    for all in with_map.chain(with_tif).chain(with_motion) {
        let all: Vec<&str> = all.iter().map(String::as_str).collect();
        survives(BINARY, tmp.path(), &all, "out");
        survives(BINARY, tmp.path(), &[&all[..], &["--memory-gib=0.001"]].concat(), "out");
    }
}
