//! Absurd numbers in flags, degenerate maps and tools, and mistaken units, through the binary.

use planish_testkit::hostile::{COUNTS, FLOATS, every_value, inputs, survives};

const BINARY: &str = "planish-dwell";

/// Cases: a solver, its flags that take a number, and its flags that take a count.
const CASES: [(&str, &[&str], &[&str]); 9] = [
    (
        "bounded-least-squares",
        &[
            "--min-dwell-s",
            "--min-dwell-s-per-mm",
            "--max-dwell-s",
            "--max-dwell-s-per-mm",
            "--time-weight-nm2-per-s",
            "--huber-nm",
            "--noise-rms-nm",
            "--tikhonov",
            "--slope-weight",
        ],
        &[],
    ),
    (
        "lucy-richardson",
        &["--min-dwell-s", "--total-variation", "--margin", "--pits", "--min-decrease"],
        &["--max-iterations"],
    ),
    ("rifta", &["--min-dwell-s", "--margin-tolerance-nm", "--pits"], &[]),
    ("udo", &["--min-dwell-s", "--step", "--threshold-nm"], &["--max-iterations"]),
    ("tikhonov-lsqr", &["--min-dwell-s", "--damping", "--noise-rms-nm"], &["--max-iterations"]),
    ("truncated-svd", &["--min-dwell-s", "--cut"], &["--max-iterations"]),
    ("non-negative-least-squares", &["--min-dwell-s", "--tikhonov"], &[]),
    ("bcls", &["--least-feed", "--tikhonov"], &[]),
    ("feed-law", &["--min-dwell-s", "--min-dwell-s-per-mm", "--pitch-mm"], &[]),
];

fn arguments(solver: &'static str, surface: &str, tif: &str, path: &str) -> Vec<String> {
    let mut all = vec![
        solver.to_string(),
        format!("--surface={surface}"),
        format!("--tif={tif}"),
        format!("--tool-path={path}"),
        "--out=out".to_string(),
    ];
    all.extend((solver == "bcls").then(|| "--machine=machine.json".to_string()));
    all
}

#[test]
fn no_flag_of_a_solver_ends_in_a_panic() {
    let tmp = tempfile::tempdir().unwrap();
    inputs(tmp.path());
    for (solver, flags, counts) in CASES {
        let all = arguments(solver, "surface", "tif", "tool_path");
        let all: Vec<&str> = all.iter().map(String::as_str).collect();
        every_value(BINARY, tmp.path(), &all, flags, &FLOATS, "out");
        every_value(BINARY, tmp.path(), &all, counts, &COUNTS, "out");
        if solver == "lucy-richardson" {
            let map = [&all[..], &["--unknowns=map"]].concat();
            every_value(BINARY, tmp.path(), &map, &["--pixels-per-cell"], &COUNTS, "out");
        }
    }
}

#[test]
fn no_map_no_tool_and_no_path_ends_in_a_panic() {
    let tmp = tempfile::tempdir().unwrap();
    let [maps, tifs, paths] = inputs(tmp.path());
    for (solver, ..) in CASES {
        let with_map = maps.iter().map(|m| arguments(solver, m, "tif", "tool_path"));
        let with_tif = tifs.iter().map(|t| arguments(solver, "surface", t, "tool_path"));
        let with_path = paths.iter().map(|p| arguments(solver, "surface", "tif", p));
        for all in with_map.chain(with_tif).chain(with_path) {
            let all: Vec<&str> = all.iter().map(String::as_str).collect();
            survives(BINARY, tmp.path(), &all, "out");
        }
    }
}

#[test]
fn mistaken_units_are_refused_by_name() {
    let tmp = tempfile::tempdir().unwrap();
    inputs(tmp.path());
    for (surface, tif, path, said) in [
        ("surface", "tif", "path-in-um", "a path in um"),
        ("surface", "tif-from-zero", "tool_path", "coordinates of an array?"),
        ("surface", "tif-in-m-per-s", "tool_path", "rates in m/s"),
        ("marked", "tif", "tool_path", "a marker of invalid pixels?"),
        ("in-metres", "tif", "tool_path", "heights in metres?"),
    ] {
        let all = arguments("bounded-least-squares", surface, tif, path);
        let all: Vec<&str> = all.iter().map(String::as_str).collect();
        let (code, message) = survives(BINARY, tmp.path(), &all, "out");
        assert_eq!(code, 2, "{all:?}: {message}");
        assert!(message.contains(said), "{said}: {message}");
    }
}

#[test]
fn a_floor_that_makes_the_surface_worse_and_a_run_of_months_are_negative() {
    let tmp = tempfile::tempdir().unwrap();
    inputs(tmp.path());
    let all = arguments("bounded-least-squares", "surface", "tif", "tool_path");
    let all: Vec<&str> = all.iter().map(String::as_str).collect();
    for (more, said) in
        [("--min-dwell-s=1e4", "makes the surface worse"), ("--min-dwell-s=1e5", "30 days")]
    {
        // A path that reaches everything alike adds nothing but what the floor leaves at the edges.
        let (code, message) = survives(BINARY, tmp.path(), &[&all[..], &[more]].concat(), "out");
        assert_eq!(code, 1, "{message}");
        assert!(message.contains(said) || message.contains("makes the surface worse"), "{message}");
    }
}

/// Returns the reason for which the solver ended, and the status, as the manifest states them.
fn end(dir: &std::path::Path) -> (String, serde_json::Value) {
    let text = std::fs::read_to_string(dir.join("out/manifest.json")).unwrap();
    let manifest: serde_json::Value = serde_json::from_str(&text).unwrap();
    let outcome = &manifest["outcome"];
    (outcome["end"].as_str().unwrap_or_default().to_string(), outcome["status"].clone())
}

#[test]
fn a_limit_that_the_user_gives_is_an_end_and_one_that_he_does_not_is_a_verdict() {
    let tmp = tempfile::tempdir().unwrap();
    inputs(tmp.path());
    for (solver, more, code, said) in [
        (
            "lucy-richardson",
            &["--min-decrease=1e-9", "--total-variation=0"][..],
            1,
            "iteration-limit",
        ),
        ("lucy-richardson", &["--max-iterations=5"], 0, "steps-done"),
        ("lucy-richardson", &["--min-decrease=0.5"], 0, "settled"),
        ("udo", &["--max-iterations=2"], 0, "rounds-done"),
        ("udo", &["--threshold-nm=1e-9", "--max-iterations=3"], 1, "iteration-limit"),
        ("tikhonov-lsqr", &["--max-iterations=2"], 1, "iteration-limit"),
        ("truncated-svd", &["--max-iterations=2"], 1, "step-limit"),
        ("rifta", &[], 0, "settled"),
        ("bounded-least-squares", &[], 0, "optimal"),
        ("bcls", &[], 0, "optimal"),
        ("non-negative-least-squares", &[], 0, "optimal"),
    ] {
        let all = arguments(solver, "surface", "tif", "tool_path");
        let all: Vec<&str> = all.iter().map(String::as_str).chain(more.iter().copied()).collect();
        let (got, message) = survives(BINARY, tmp.path(), &all, "out");
        let (end, status) = end(tmp.path());
        assert_eq!((got, end.as_str()), (code, said), "{solver} {more:?}: {message}");
        assert_eq!(status, ["done", "negative"][code as usize], "{solver} {more:?}");
    }
}
