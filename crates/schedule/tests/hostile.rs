//! Tests of the binary with absurd flags, strange paths and dwell times, and of its exit codes.

use std::{fs, path::Path};

use planish_testkit::hostile::{FLOATS, every_value, inputs, npy, survives};
use serde_json::{Value, json};

const BINARY: &str = "planish-schedule";

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

/// The path is a closed line there and back whose last segment is the rounding of its closure. This segment has no
/// dwell time, or one that vanishes beside the others.
#[test]
fn the_rounding_of_a_closed_path_is_no_obstacle() {
    let tmp = tempfile::tempdir().unwrap();
    inputs(tmp.path());
    let (left, right, y) = (16.004_534_120_337_25, 43.642_998_834_2, 97.688_954_38);
    let n = 39;
    let mut points: Vec<[f64; 2]> =
        (0..n).map(|i| [if i % 2 == 0 { left } else { right }, y]).collect();
    for (off, last_s) in [(0.0, 0.0), (4e-15, 0.0), (4e-15, 1.3e-17), (-4e-15, 1e-300)] {
        points.truncate(n);
        points.push([left + off, y]);
        let centres = points.windows(2).map(|w| 0.5 * (w[0][0] + w[1][0]));
        let centres: Vec<f64> = centres.flat_map(|x| [x, y]).collect();
        let path = tmp.path().join("closed");
        npy(&path, "point_mm", &[n + 1, 2], points.as_flattened());
        npy(&path, "dwell_point_mm", &[n, 2], &centres);
        let mut times = vec![0.098_489_96; n];
        times[n - 1] = last_s;
        npy(&tmp.path().join("closed-dwell"), "dwell_s", &[n], &times);
        for scheduler in SCHEDULERS {
            let given = ["--tool-path=closed", "--dwell=closed-dwell", "--force"];
            let arguments = [scheduler, &given, &GIVEN[1..]].concat();
            let (code, said) = survives(BINARY, tmp.path(), &arguments, "out");
            // The published method stretches nothing: 27 mm in 0.1 s are beyond its limits. The ideals always are.
            let promised =
                !["pvt-as-published", "average-velocity", "position"].contains(&scheduler[0]);
            assert!(code == 0 || (code == 1 && !promised), "{scheduler:?} {off} {last_s}: {said}");
            assert!(manifest(tmp.path())["outcome"]["total_time_s"].as_f64().unwrap() < 600.0);
        }
    }
}

/// The limits are at the ends of the range that a machine file may state, and beyond.
#[test]
fn no_limit_ends_in_a_panic() {
    let tmp = tempfile::tempdir().unwrap();
    inputs(tmp.path());
    let limits = [1e-9, 1.0, 1e12];
    for (velocity, acceleration) in limits.into_iter().flat_map(|v| limits.map(|a| (v, a))) {
        for jerk in [None, Some(1e-9), Some(1e18)] {
            for turn_deg in [0.0, 1e-300, 45.0] {
                let axis = |name: &str| {
                    let mut axis = json!({
                        "name": name,
                        "max_velocity_mm_per_s": velocity,
                        "max_acceleration_mm_per_s2": acceleration,
                    });
                    if let Some(jerk) = jerk {
                        axis["max_jerk_mm_per_s3"] = json!(jerk);
                    }
                    axis
                };
                let axes = [axis("x"), axis("y")];
                let machine =
                    json!({"name": "m", "part_rotation_deg": turn_deg, "axes": axes}).to_string();
                fs::write(tmp.path().join("machine.json"), machine).unwrap();
                let schedulers = if turn_deg == 0.0 { &SCHEDULERS[..] } else { &SCHEDULERS[1..2] };
                for scheduler in schedulers {
                    let given = ["--dwell=dwell", "--force"];
                    survives(BINARY, tmp.path(), &[scheduler, &GIVEN[..], &given].concat(), "out");
                }
            }
        }
    }
    for limit in ["5e-324", "1e-308", "1e-10", "1e300"] {
        let axis = |name: &str| {
            format!(
                r#"{{"name":"{name}","max_velocity_mm_per_s":{limit},"max_acceleration_mm_per_s2":1}}"#
            )
        };
        let machine = format!(r#"{{"name":"m","axes":[{},{}]}}"#, axis("x"), axis("y"));
        fs::write(tmp.path().join("machine.json"), machine).unwrap();
        let arguments = [&["pvt", "--dwell=dwell", "--force"], &GIVEN[..]].concat();
        let (code, said) = survives(BINARY, tmp.path(), &arguments, "out");
        assert_eq!(code, 2);
        let problem = format!("machine.json: axes[0]: max_velocity_mm_per_s is {limit}; give mm/s");
        assert!(said.contains(&problem), "{said}");
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
    let (code, said) = survives(
        BINARY,
        tmp.path(),
        &[&spline[..], &["--dwell-density-out=dwell_density"]].concat(),
        "out",
    );
    assert!(code == 0, "{said}");
    for out in ["ticks.csv", "ticks.npy"] {
        let to = format!("--out={out}");
        let arguments = ["interpolate", "--dwell-density=dwell_density", &to];
        every_value(BINARY, tmp.path(), &arguments, &["--cycle-s"], &FLOATS, out);
        let (code, said) =
            survives(BINARY, tmp.path(), &[&arguments[..], &["--cycle-s=1e-9"]].concat(), out);
        assert_eq!(code, 2);
        assert!(said.contains("positions: would have") && said.contains("--cycle-s"), "{said}");
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
        assert_eq!(said.contains("jumps, which no machine can do"), ideal, "{said}");
        // The same run again does nothing, and ends the same.
        let again = planish_testkit::program::stage(BINARY)
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
