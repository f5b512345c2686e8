//! The binary from its flags to its files and exit codes.

use std::{fs, path::Path, process::Output};

use planish_testkit::program::text;
use planish_types::{ToolPath, Trajectory};
use serde_json::{Value, json};

fn verify(dir: &Path, more: &[&str]) -> Output {
    planish_testkit::program::stage("planish-verify")
        .current_dir(dir)
        .args(["--trajectory", "trajectory", "--machine", "machine.json", "--out", "verdict"])
        .args(more)
        .output()
        .unwrap()
}

/// Writes the inputs into `dir`: a bang-bang motion of 5 mm along x (peaks 10 mm/s, 20 mm/s^2), and a machine.
fn prepare(dir: &Path, max_velocity: f64) {
    let c = |x: [f64; 4]| [x, [0.0; 4]];
    let trajectory = Trajectory::new(
        vec![0.0, 0.5, 1.0],
        vec![c([0.0, 0.0, 10.0, 0.0]), c([2.5, 10.0, -10.0, 0.0])],
        vec![true; 2],
        vec![Some(0), Some(1)],
    )
    .unwrap();
    planish_handoff::save(&dir.join("trajectory"), &trajectory).unwrap();
    let axis = |name: &str| {
        json!({"name": name, "max_velocity_mm_per_s": max_velocity,
               "max_acceleration_mm_per_s2": 20.0})
    };
    let machine = json!({"name": "bench", "axes": [axis("x"), axis("y")]});
    fs::write(dir.join("machine.json"), machine.to_string()).unwrap();
}

fn outcome(dir: &Path) -> Value {
    let text = fs::read_to_string(dir.join("verdict/manifest.json")).unwrap();
    serde_json::from_str::<Value>(&text).unwrap()["outcome"].clone()
}

#[test]
fn a_kept_limit_is_exit_0_and_the_outcome_has_the_keys_that_others_read() {
    let dir = tempfile::tempdir().unwrap();
    prepare(dir.path(), 10.0);
    let run = verify(dir.path(), &[]);
    assert_eq!(run.status.code(), Some(0), "{}", text(&run.stderr));
    assert!(text(&run.stdout).contains("velocity up to 10.00, 0.00 mm/s"), "{run:?}");
    let outcome = outcome(dir.path());
    assert_eq!(outcome["status"], "done");
    assert_eq!(outcome["limits_respected"], true);
    assert_eq!(outcome["total_time_s"], 1.0);
    assert_eq!(outcome["max_velocity_mm_per_s"], json!([10.0, 0.0]));
    assert_eq!(outcome["max_acceleration_mm_per_s2"], json!([20.0, 0.0]));
    assert_eq!(outcome["max_position_step_mm"], json!([0.0, 0.0]));
    assert_eq!(outcome["max_velocity_step_mm_per_s"], json!([0.0, 0.0]));
    assert_eq!(outcome["max_acceleration_step_mm_per_s2"], json!([40.0, 0.0]));
    assert_eq!(outcome["axes"][0]["velocity_mm_per_s"]["max"]["time_s"], 0.5);

    let again = verify(dir.path(), &[]);
    assert_eq!(again.status.code(), Some(0));
    assert!(text(&again.stdout).contains("unchanged"));
}

#[test]
fn an_exceeded_limit_is_exit_1_every_time_and_says_which() {
    let dir = tempfile::tempdir().unwrap();
    prepare(dir.path(), 8.0);
    for run in [verify(dir.path(), &[]), verify(dir.path(), &[])] {
        assert_eq!(run.status.code(), Some(1));
        let message = text(&run.stderr);
        let expected = "verdict: x velocity reaches 10.000000 mm/s in segment 0 at 0.500000 s, \
                        1.250000 times the limit of 8 mm/s (segments that exceed it: 2)";
        assert_eq!(message.trim(), expected);
    }
    let outcome = outcome(dir.path());
    assert_eq!(
        (&outcome["status"], &outcome["limits_respected"]),
        (&json!("negative"), &json!(false))
    );
    assert_eq!(outcome["axes"][0]["velocity_mm_per_s"]["worst"][0]["dwell_index"], 0);
}

/// The motion goes along x; the path lies 2 mm beside it, with points 2.5 mm apart: half of that is the tolerance. On a
/// machine that carries the part turned and shifted, the distance is the same.
#[test]
fn a_motion_beyond_the_tolerance_of_its_path_is_exit_1_on_any_machine() {
    let dir = tempfile::tempdir().unwrap();
    for turned in [false, true] {
        prepare(dir.path(), 10.0);
        if turned {
            let file = dir.path().join("machine.json");
            let mut machine: Value =
                serde_json::from_str(&fs::read_to_string(&file).unwrap()).unwrap();
            machine["part_rotation_deg"] = json!(30);
            machine["part_origin_mm"] = json!([100, -20]);
            fs::write(file, machine.to_string()).unwrap();
        }
        for (y_mm, code) in [(2.0, 1), (1.0, 0)] {
            let points = vec![[0.0, y_mm], [2.5, y_mm], [5.0, y_mm]];
            let path = ToolPath::through(points, vec![true; 2], vec![0; 2]).unwrap();
            let name = format!("path-{y_mm}");
            let _ = fs::remove_dir_all(dir.path().join(&name));
            planish_handoff::save(&dir.path().join(&name), &path).unwrap();
            let run = verify(dir.path(), &["--tool-path", &name, "--force"]);
            assert_eq!(run.status.code(), Some(code), "{run:?}");
            let distance = outcome(dir.path())["path_distance"].clone();
            let stated = distance["tool_on_mm"].as_f64().unwrap();
            // The gap of the search.
            assert!((stated - y_mm).abs() < 1e-6, "{distance}");
            let tolerance_mm = distance["tolerance_mm"].as_f64().unwrap();
            // Rounding of the rotation.
            assert!((tolerance_mm - 1.25).abs() < 1e-12, "{distance}");
            assert_eq!(distance["within"], json!(code == 0));
            assert_eq!(outcome(dir.path())["limits_respected"], json!(code == 0));
            if code == 1 {
                let message = text(&run.stderr);
                assert!(message.contains("leaves its path by 2.0000 mm, and the tolerance is 1.2500 mm (--max-path-distance-mm)"), "{message}");
                // The remedy that it names.
                let wider = ["--tool-path", &name, "--force", "--max-path-distance-mm", "2.1"];
                assert_eq!(verify(dir.path(), &wider).status.code(), Some(0));
            }
        }
    }
    let run = verify(dir.path(), &["--force"]);
    assert!(text(&run.stdout).contains("is not judged: give --tool-path"), "{run:?}");
    let run =
        verify(dir.path(), &["--tool-path", "path-1", "--force", "--max-path-distance-mm=-1"]);
    assert_eq!(run.status.code(), Some(2), "{run:?}");
}

#[test]
fn bad_input_is_exit_2_with_one_message_and_writes_nothing() {
    let dir = tempfile::tempdir().unwrap();
    prepare(dir.path(), 10.0);
    let refused = |more: &[&str], expected: &str| {
        let run = verify(dir.path(), more);
        assert_eq!(run.status.code(), Some(2), "{run:?}");
        let message = text(&run.stderr);
        assert!(message.contains(expected), "{message}");
        assert!(!dir.path().join("verdict").exists());
    };
    refused(&["--position-step-mm=-1"], "position_step_mm: is -1; a tolerance is");
    refused(&["--velocity-step-mm-per-s", "nan"], "velocity_step_mm_per_s: is NaN");
    refused(&["--trajectory", "nowhere"], "the argument '--trajectory <DIR>' cannot be used");
    let machine = fs::read_to_string(dir.path().join("machine.json")).unwrap();
    fs::write(dir.path().join("machine.json"), machine.replace("20.0", "-20.0")).unwrap();
    refused(&[], "max_acceleration_mm_per_s2 is -20");
    fs::write(dir.path().join("machine.json"), machine).unwrap();
    fs::remove_file(dir.path().join("trajectory/break_time_s.npy")).unwrap();
    refused(&[], "break_time_s.npy");
}
