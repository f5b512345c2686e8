//! The program from its flags to its files and exit codes.

use std::{fs, path::Path, process::Output};

use planish_testkit::{program::text, workspace};
use planish_types::Trajectory;
use serde_json::{Value, json};

fn axes(dir: &Path, arguments: &str) -> Output {
    planish_testkit::program::stage("planish-axes")
        .current_dir(dir)
        .args(arguments.split_whitespace())
        .output()
        .unwrap()
}

/// Writes the inputs into `dir`: a pass over 60 mm from rest to rest, a sphere, and a machine with five axes.
fn prepare(dir: &Path) {
    let h: f64 = 6.0;
    let cubic = |way: f64| [-0.5 * way, 0.0, 3.0 * way / (h * h), -2.0 * way / (h * h * h)];
    let plan =
        Trajectory::new(vec![0.0, h], vec![[cubic(60.0), cubic(10.0)]], vec![true], vec![Some(0)])
            .unwrap();
    planish_handoff::save(&dir.join("plan"), &plan).unwrap();
    fs::write(dir.join("sphere.json"), r#"{"kind": "sphere", "radius_mm": -100}"#).unwrap();
    let machine = workspace().join("fixtures/machines/bonnet-five-axis.json");
    let mut machine: Value = serde_json::from_slice(&fs::read(machine).unwrap()).unwrap();
    machine["time_to_full_acceleration_s"] = 0.into();
    fs::write(dir.join("machine.json"), machine.to_string()).unwrap();
}

fn outcome(dir: &Path) -> Value {
    let text = fs::read_to_string(dir.join("manifest.json")).unwrap();
    serde_json::from_str::<Value>(&text).unwrap()["outcome"].clone()
}

const MOTION: &str =
    "motion --trajectory plan --machine machine.json --form sphere.json --out axes";

#[test]
fn the_axes_of_a_sphere_and_their_contact_point_are_written() {
    let dir = tempfile::tempdir().unwrap();
    prepare(dir.path());
    let run = axes(dir.path(), MOTION);
    assert_eq!(run.status.code(), Some(0), "{}", text(&run.stderr));
    assert!(text(&run.stdout).contains("x, y, z, a, b in"), "{run:?}");
    let made = outcome(&dir.path().join("axes"));
    assert_eq!(made["axes"], json!(["x", "y", "z", "a", "b"]));
    assert_eq!(made["units"], json!(["mm", "mm", "mm", "deg", "deg"]));
    // The default of --contact-tolerance-um.
    assert!(made["contact_deviation_um"].as_f64().unwrap() <= 2.0, "{made}");
    assert_eq!((&made["planned_time_s"], &made["total_time_s"]), (&json!(6.0), &json!(6.0)));
    assert_eq!(made.get("slowed"), None);

    // A smaller tolerance gives more segments.
    let fine =
        axes(dir.path(), &MOTION.replace("--out axes", "--out fine --contact-tolerance-um 0.01"));
    assert_eq!(fine.status.code(), Some(0), "{}", text(&fine.stderr));
    let fine = outcome(&dir.path().join("fine"));
    assert!(fine["segment_count"].as_u64() > made["segment_count"].as_u64(), "{fine}");
    // The tolerance that the command asks for.
    assert!(fine["contact_deviation_um"].as_f64().unwrap() <= 0.01, "{fine}");

    let run = axes(
        dir.path(),
        "contact --axes axes --machine machine.json --form sphere.json --out executed",
    );
    assert_eq!(run.status.code(), Some(0), "{}", text(&run.stderr));
    let executed = outcome(&dir.path().join("executed"));
    assert_eq!(executed["total_time_s"], 6.0);
    // The executed contact point is found within 1e-3 um.
    assert!(executed["deviation_um"].as_f64().unwrap() <= 1e-3, "{executed}");
    assert!(text(&axes(dir.path(), MOTION).stdout).contains("unchanged"));
}

#[test]
fn a_slow_tilt_slows_the_motion_down_and_the_program_says_how_much() {
    let dir = tempfile::tempdir().unwrap();
    prepare(dir.path());
    let machine = fs::read_to_string(dir.path().join("machine.json")).unwrap();
    // The pass moves at 15.2 mm/s in its middle: 8.7 deg/s of the tilts.
    let slow = machine.replace("\"max_velocity_deg_per_s\":60", "\"max_velocity_deg_per_s\":4");
    assert_ne!(slow, machine);
    fs::write(dir.path().join("machine.json"), slow).unwrap();
    let run = axes(dir.path(), MOTION);
    assert_eq!(run.status.code(), Some(0), "{}", text(&run.stderr));
    assert!(text(&run.stdout).contains("the velocity of b would be"), "{}", text(&run.stdout));
    assert!(text(&run.stdout).contains("longer than planned"), "{}", text(&run.stdout));
    let made = outcome(&dir.path().join("axes"));
    let number = |key: &str| made[key].as_f64().unwrap();
    let added = number("total_time_s") - number("planned_time_s");
    // b turns by 34.9 degrees at 4 deg/s at most, in 8.7 s instead of 6. Sums of durations round: some hundred terms of
    // up to 10 s.
    assert!(added > 1.0 && (number("added_tool_on_time_s") - added).abs() < 1e-9, "{made}");
    assert_eq!(made["slowed"]["axis"], "b");
}

#[test]
fn bad_input_is_exit_2_with_one_message_and_writes_nothing() {
    let dir = tempfile::tempdir().unwrap();
    prepare(dir.path());
    let refused = |arguments: &str, words: &str| {
        let run = axes(dir.path(), arguments);
        assert_eq!(run.status.code(), Some(2), "{run:?}");
        let message = text(&run.stderr);
        assert!(message.contains(words), "{message:?} lacks {words:?}");
        assert!(!dir.path().join("axes").exists() && !dir.path().join("out").exists());
    };
    refused(
        &format!("{MOTION} --contact-tolerance-um -1"),
        "contact_tolerance_um: is -1; give um, from 0.001",
    );
    refused(&MOTION.replace("sphere.json", "nowhere.json"), "nowhere.json");
    let small = r#"{"kind": "sphere", "radius_mm": 20}"#;
    fs::write(dir.path().join("small.json"), small).unwrap();
    refused(
        &MOTION.replace("sphere.json", "small.json"),
        "where the form does not exist; give a form",
    );
    let machine = fs::read_to_string(dir.path().join("machine.json")).unwrap();
    fs::write(dir.path().join("machine.json"), machine.replace("xyz-tilts", "delta")).unwrap();
    refused(MOTION, "unknown variant `delta`");
    fs::write(dir.path().join("machine.json"), machine).unwrap();
    refused("contact --axes plan --machine machine.json --out out", "trajectory");
}
