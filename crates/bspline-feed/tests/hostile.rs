//! Flags that nobody means, degenerate maps and tools, mistaken units, through the binary.

use planish_testkit::hostile::{COUNTS, FLOATS, every_value, inputs, survives};

const BINARY: &str = "planish-bspline-feed";

fn arguments(surface: &str, tif: &str, path: &str) -> Vec<String> {
    let given =
        [("surface", surface), ("tif", tif), ("tool-path", path), ("machine", "machine.json")];
    let given = given.iter().map(|(flag, value)| format!("--{flag}={value}"));
    given.chain(["--out=out".to_string()]).collect()
}

/// Returns the arguments with a large relative gap, so that few steps suffice: the tests are about the flags, not about
/// convergence.
fn quick(all: &[String]) -> Vec<&str> {
    all.iter().map(String::as_str).chain(["--relative-gap=0.1"]).collect()
}

#[test]
fn no_flag_ends_in_a_panic_or_takes_all_memory() {
    let tmp = tempfile::tempdir().unwrap();
    inputs(tmp.path());
    let all = arguments("surface", "tif", "tool_path");
    let flags = ["--knot-spacing-mm", "--tikhonov", "--curvature-weight", "--fit-tolerance-mm"];
    every_value(BINARY, tmp.path(), &quick(&all), &flags, &FLOATS, "out");
    every_value(BINARY, tmp.path(), &quick(&all), &["--max-sweeps"], &COUNTS, "out");
    let plain: Vec<&str> = all.iter().map(String::as_str).collect();
    let loose: Vec<&str> = [&plain[..], &["--max-sweeps=2"]].concat();
    every_value(BINARY, tmp.path(), &loose, &["--relative-gap", "--pitch-mm"], &FLOATS, "out");
    let vrr: Vec<&str> = [&plain[..], &["--feed-source=vrr"]].concat();
    every_value(BINARY, tmp.path(), &vrr, &["--pitch-mm"], &FLOATS, "out");
    for spacing in ["1e-300", "1e-9", "1e-3"] {
        let set = format!("--knot-spacing-mm={spacing}");
        let (code, said) =
            survives(BINARY, tmp.path(), &[&plain[..], &[set.as_str()]].concat(), "out");
        assert_eq!(code, 2);
        assert!(
            said.contains("knot_spacing_mm: is") && said.contains("width of the TIF"),
            "{said}"
        );
    }
}

#[test]
fn no_map_no_tool_and_no_path_ends_in_a_panic() {
    let tmp = tempfile::tempdir().unwrap();
    let [maps, tifs, paths] = inputs(tmp.path());
    let with_map = maps.iter().map(|m| arguments(m, "tif", "tool_path"));
    let with_tif = tifs.iter().map(|t| arguments("surface", t, "tool_path"));
    let with_path = paths.iter().map(|p| arguments("surface", "tif", p));
    for all in with_map.chain(with_tif).chain(with_path) {
        survives(BINARY, tmp.path(), &quick(&all), "out");
    }
}

#[test]
fn mistaken_units_are_refused_by_name_and_a_limit_is_a_verdict() {
    let tmp = tempfile::tempdir().unwrap();
    inputs(tmp.path());
    for (surface, tif, path, said) in [
        ("surface", "tif", "path-in-um", "a path in um"),
        ("surface", "tif-from-zero", "tool_path", "coordinates of an array?"),
        ("marked", "tif", "tool_path", "a marker of invalid pixels?"),
    ] {
        let all = arguments(surface, tif, path);
        let (code, message) = survives(BINARY, tmp.path(), &quick(&all), "out");
        assert_eq!(code, 2, "{all:?}: {message}");
        assert!(message.contains(said), "{said}: {message}");
    }
    for (more, code, end) in [
        (&["--max-sweeps=1", "--relative-gap=1e-9"][..], 1, "sweep-limit"),
        (&["--relative-gap=0.1"], 0, "converged"),
        (&["--feed-source=vrr"], 0, "direct"),
    ] {
        let all = arguments("surface", "tif", "tool_path");
        let all: Vec<&str> = all.iter().map(String::as_str).chain(more.iter().copied()).collect();
        let (got, message) = survives(BINARY, tmp.path(), &all, "out");
        let text =
            std::fs::read_to_string(tmp.path().join("out/dwell_density/manifest.json")).unwrap();
        let manifest: serde_json::Value = serde_json::from_str(&text).unwrap();
        assert_eq!(manifest["outcome"]["end"], end, "{more:?}: {message}");
        assert_eq!(got, code, "{more:?}: {message}");
    }
}
