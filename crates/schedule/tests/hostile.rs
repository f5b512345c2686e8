//! Flags that nobody means, strange paths and dwell times, through the binary; and the exit codes.

use std::{fs, path::Path};

use planish_testkit::hostile::{FLOATS, every_value, inputs, npy, survives};
use serde_json::Value;

const BINARY: &str = env!("CARGO_BIN_EXE_planish-schedule");

const SCHEDULERS: [&[&str]; 9] = [
    &["pvt", "--mode=smooth"],
    &["pvt", "--mode=monotone"],
    &["pvt-as-published"],
    &["pvt-as-published", "--rest-condition=as-printed"],
    &["constant-acceleration"],
    &["stop-at-corners"],
    &["trig-spline"],
    &["average-velocity"],
    &["position"],
];

const GIVEN: [&str; 3] = ["--tool-path=tool_path", "--machine=machine.json", "--out=out"];

fn manifest(dir: &Path) -> Value {
    serde_json::from_str(&fs::read_to_string(dir.join("out/manifest.json")).unwrap()).unwrap()
}

#[test]
fn no_path_and_no_dwell_time_ends_in_a_panic() {
    let tmp = tempfile::tempdir().unwrap();
    let [_, _, paths] = inputs(tmp.path());
    npy(&tmp.path().join("of-two"), "dwell_s", &[2], &[0.1; 2]);
    for (name, time) in [("zero", 0.0), ("long", 1e9), ("short", 1e-300), ("negative", -1.0)] {
        npy(&tmp.path().join(name), "dwell_s", &[194], &[time; 194]);
    }
    for scheduler in SCHEDULERS {
        for dwell in ["zero", "long", "short", "negative"] {
            let dwell = format!("--dwell={dwell}");
            let arguments = [scheduler, &GIVEN, &[dwell.as_str()]].concat();
            survives(BINARY, tmp.path(), &arguments, "out");
        }
        for path in &paths {
            let dwell = if *path == "path-wide" { "--dwell=of-two" } else { "--dwell=dwell" };
            let path = format!("--tool-path={path}");
            let arguments = [scheduler, &[path.as_str(), dwell], &GIVEN[1..]].concat();
            survives(BINARY, tmp.path(), &arguments, "out");
        }
    }
}

#[test]
fn what_does_not_converge_is_said_and_nothing_is_written() {
    let tmp = tempfile::tempdir().unwrap();
    inputs(tmp.path());
    let times: Vec<f64> = (0..194).map(|i| if i % 2 == 0 { 1e-100 } else { 0.2 }).collect();
    npy(&tmp.path().join("uneven"), "dwell_s", &[194], &times);
    let arguments = [&["pvt-as-published", "--dwell=uneven"], &GIVEN[..]].concat();
    let (code, said) = survives(BINARY, tmp.path(), &arguments, "out");
    assert_eq!(code, 2, "{said}");
    assert!(said.contains("has not converged: after 60 iterations"), "{said}");
    assert!(said.contains("its distance from the minimum, of which 1e-9 is allowed"), "{said}");
}

#[test]
fn no_flag_ends_in_a_panic_or_fills_the_disk() {
    let tmp = tempfile::tempdir().unwrap();
    inputs(tmp.path());
    let spline = [&["trig-spline", "--dwell=dwell"], &GIVEN[..]].concat();
    let flags = ["--corner-deviation-mm", "--fit-tolerance-mm"];
    every_value(BINARY, tmp.path(), &spline, &flags, &FLOATS, "out");
    let (code, said) =
        survives(BINARY, tmp.path(), &[&spline[..], &["--feed=feed"]].concat(), "out");
    assert!(code == 0, "{said}");
    for out in ["ticks.csv", "ticks.npy"] {
        let to = format!("--out={out}");
        let arguments = ["interpolate", "--feed=feed", &to];
        every_value(BINARY, tmp.path(), &arguments, &["--tick-s"], &FLOATS, out);
        let (code, said) =
            survives(BINARY, tmp.path(), &[&arguments[..], &["--tick-s=1e-9"]].concat(), out);
        assert_eq!(code, 2);
        assert!(said.contains("positions: would have") && said.contains("--tick-s"), "{said}");
    }
}

#[test]
fn a_limit_that_is_exceeded_is_a_negative_verdict() {
    let tmp = tempfile::tempdir().unwrap();
    inputs(tmp.path());
    for scheduler in SCHEDULERS {
        let arguments = [scheduler, &["--dwell=dwell"], &GIVEN].concat();
        let (code, said) = survives(BINARY, tmp.path(), &arguments, "out");
        let outcome = &manifest(tmp.path())["outcome"];
        let kept = outcome["claim"]["limits_respected"].as_bool().unwrap();
        assert_eq!(code, i32::from(!kept), "{scheduler:?}: {said}");
        assert_eq!(outcome["status"], if kept { "done" } else { "negative" }, "{scheduler:?}");
        let ideal = ["position", "average-velocity"].contains(&scheduler[0]);
        assert_eq!(said.contains("an ideal that no machine can do"), ideal, "{said}");
        // The same run again does nothing, and ends the same.
        let again = std::process::Command::new(BINARY)
            .current_dir(tmp.path())
            .args(&arguments)
            .output()
            .unwrap();
        assert_eq!(again.status.code(), Some(code), "{scheduler:?}");
    }
}

#[test]
fn a_run_of_months_is_a_negative_verdict() {
    let tmp = tempfile::tempdir().unwrap();
    inputs(tmp.path());
    npy(&tmp.path().join("dwell"), "dwell_s", &[194], &[5e4; 194]);
    let arguments = [&["pvt", "--dwell=dwell"], &GIVEN[..]].concat();
    let (code, said) = survives(BINARY, tmp.path(), &arguments, "out");
    assert_eq!(code, 1);
    assert!(said.contains("112 days, more than 30 days"), "{said}");
}

#[test]
fn the_mode_follows_the_machine_and_is_named() {
    let tmp = tempfile::tempdir().unwrap();
    inputs(tmp.path());
    let with_jerk = fs::read_to_string(tmp.path().join("machine.json")).unwrap().replace(
        "\"max_acceleration_mm_per_s2\": 1000",
        "\"max_acceleration_mm_per_s2\": 1000, \"max_jerk_mm_per_s3\": 2e6",
    );
    fs::write(tmp.path().join("jerk.json"), with_jerk).unwrap();
    for (machine, asked, taken, code) in [
        ("machine.json", None, "monotone", 0),
        ("machine.json", Some("--mode=smooth"), "smooth", 0),
        ("jerk.json", None, "smooth", 0),
        ("jerk.json", Some("--mode=auto"), "smooth", 0),
        ("jerk.json", Some("--mode=monotone"), "monotone", 1),
    ] {
        let machine = format!("--machine={machine}");
        let mut arguments =
            vec!["pvt", "--tool-path=tool_path", "--dwell=dwell", "--out=out", machine.as_str()];
        arguments.extend(asked);
        let (got, said) = survives(BINARY, tmp.path(), &arguments, "out");
        assert_eq!(got, code, "{arguments:?}: {said}");
        assert_eq!(manifest(tmp.path())["settings"]["mode"], taken, "{arguments:?}");
        assert_eq!(said.contains("--mode smooth keeps a limit on jerk"), code == 1, "{said}");
    }
}
