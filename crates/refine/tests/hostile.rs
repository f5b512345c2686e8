//! Tests of the binary with absurd flags, degenerate maps and tools, and mistaken units.

use std::time::Duration;

use planish_schedule::SCHEDULERS;
use planish_testkit::{
    hostile::{COUNTS, FLOATS, every_value, inputs, survives},
    program::{run_within, text},
};

const BINARY: &str = "planish-refine";

fn arguments(surface: &str, tif: &str, path: &str) -> Vec<String> {
    let given =
        [("surface", surface), ("tif", tif), ("tool-path", path), ("machine", "machine.json")];
    let given = given.iter().map(|(flag, value)| format!("--{flag}={value}"));
    given.chain(["--out=out".to_string()]).collect()
}

#[test]
fn no_flag_ends_in_a_panic_or_takes_all_memory() {
    let tmp = tempfile::tempdir().unwrap();
    inputs(tmp.path());
    let all = arguments("surface", "tif", "tool_path");
    let all: Vec<&str> = all.iter().map(String::as_str).collect();
    let flags = [
        "--min-dwell-s",
        "--min-dwell-s-per-mm",
        "--tikhonov",
        "--slope-weight",
        "--time-weight-nm2-per-s",
        "--noise-rms-nm",
    ];
    let short = [&all[..], &["--max-rounds=1"]].concat();
    every_value(BINARY, tmp.path(), &short, &flags, &FLOATS, "out");
    every_value(BINARY, tmp.path(), &all, &["--max-rounds"], &COUNTS, "out");
    let pareto = [&["pareto"], &short[..]].concat();
    every_value(BINARY, tmp.path(), &pareto, &["--prices"], &COUNTS, "out");
    let one = [&pareto[..], &["--prices=1"]].concat();
    every_value(BINARY, tmp.path(), &one, &["--min-dwell-s-per-mm"], &FLOATS, "out");
    let (code, said) =
        survives(BINARY, tmp.path(), &[&pareto[..], &["--prices=1000000000"]].concat(), "out");
    assert_eq!(code, 2);
    assert!(said.contains("prices: is 1000000000; give at most 1000"), "{said}");
}

#[test]
fn no_map_no_tool_and_no_path_ends_in_a_panic() {
    let tmp = tempfile::tempdir().unwrap();
    let [maps, tifs, paths] = inputs(tmp.path());
    let with_map = maps.iter().map(|m| arguments(m, "tif", "tool_path"));
    let with_tif = tifs.iter().map(|t| arguments("surface", t, "tool_path"));
    let with_path = paths.iter().map(|p| arguments("surface", "tif", p));
    for all in with_map.chain(with_tif).chain(with_path) {
        let all: Vec<&str> = all.iter().map(String::as_str).chain(["--max-rounds=1"]).collect();
        survives(BINARY, tmp.path(), &all, "out");
    }
}

#[test]
fn a_number_of_rounds_that_the_user_gives_is_an_end() {
    let tmp = tempfile::tempdir().unwrap();
    inputs(tmp.path());
    let all = arguments("surface", "tif", "tool_path");
    let all: Vec<&str> = all.iter().map(String::as_str).chain(["--max-rounds=1"]).collect();
    let (code, said) = survives(BINARY, tmp.path(), &all, "out");
    let text = std::fs::read_to_string(tmp.path().join("out/dwell/manifest.json")).unwrap();
    let manifest: serde_json::Value = serde_json::from_str(&text).unwrap();
    assert_eq!((code, &manifest["outcome"]["end"]), (0, &"round-limit".into()), "{said}");
    assert_eq!(manifest["settings"]["scheduler"]["pvt"], "monotone");
}

#[test]
fn every_scheduler_of_the_table_can_be_chosen_and_no_other() {
    let tmp = tempfile::tempdir().unwrap();
    inputs(tmp.path());
    let all = arguments("surface", "tif", "tool_path");
    let all: Vec<&str> = all.iter().map(String::as_str).collect();
    let choose = |scheduler: &str, more: &[&str]| {
        let scheduler = format!("--scheduler={scheduler}");
        let given = [&all[..], &["--max-rounds=2", &scheduler], more].concat();
        survives(BINARY, tmp.path(), &given, "out")
    };
    let settings_of = |part: &str| -> serde_json::Value {
        let file = tmp.path().join("out").join(part).join("manifest.json");
        serde_json::from_str(&std::fs::read_to_string(file).unwrap()).unwrap()
    };
    for named in &SCHEDULERS {
        let (code, said) = choose(named.name, &[]);
        // A scheduler that cuts corners says how far it leaves the path.
        assert!(code == 0 || said.contains("leaves its path by"), "{}: {said}", named.name);
        for part in ["dwell", "trajectory", "iterations"] {
            assert_eq!(settings_of(part)["method"], named.name);
        }
    }
    for repair in ["offset", "local"] {
        let (code, said) = choose("trig-spline", &["--repair", repair]);
        assert_eq!(code, 0, "{said}");
        assert_eq!(settings_of("trajectory")["settings"]["scheduler"]["trig-spline"], repair);
    }
    for unknown in ["position", "pvt-as-published", "average-velocity", "PVT", ""] {
        let (code, said) = choose(unknown, &[]);
        let names_all = SCHEDULERS.iter().all(|named| said.contains(named.name));
        assert!(code == 2 && names_all, "{unknown}: {code} {said}");
    }
    for (scheduler, flag) in [("pvt", "--repair=local"), ("stop-at-corners", "--mode=smooth")] {
        let (code, said) = choose(scheduler, &[flag]);
        let (flag, _) = flag.split_once('=').unwrap();
        assert!(code == 2 && said.contains(&format!("leave {flag} out")), "{code} {said}");
    }
    // A limit that no step of the acceleration keeps.
    let file = tmp.path().join("machine.json");
    let mut machine: serde_json::Value =
        serde_json::from_str(&std::fs::read_to_string(&file).unwrap()).unwrap();
    for axis in machine["axes"].as_array_mut().unwrap() {
        axis["max_jerk_mm_per_s3"] = 1e4.into();
    }
    std::fs::write(&file, machine.to_string()).unwrap();
    let (code, said) = choose("stop-at-corners", &[]);
    assert!(code == 1 && said.contains("in the best one x acceleration steps"), "{code} {said}");
}

#[test]
fn every_round_says_what_it_cost() {
    let tmp = tempfile::tempdir().unwrap();
    inputs(tmp.path());
    let mut command = planish_testkit::program::stage(BINARY);
    command.current_dir(tmp.path()).args(arguments("surface", "tif", "tool_path"));
    let ended = run_within(command.arg("--max-rounds=1"), Duration::from_secs(100));
    let said = text(&ended.stdout);
    let costs: Vec<f64> = said
        .lines()
        .filter(|line| line.starts_with("round "))
        .filter_map(|line| line.split_once(", computed in ")?.1.split(' ').next()?.parse().ok())
        .collect();
    // The plan before, and its correction.
    assert!(costs.len() == 2 && costs.iter().all(|cost_s| *cost_s >= 0.0), "{said}");
}
