//! The host script of a Galil, run by Python against a simulated controller (`gclib.py`): it sends the lines of the
//! program and no other motion, keeps the buffer filled and never overfilled, and switches the tool.

use std::{fs, path::Path, process::Command};

use serde_json::{Value, json};

use crate::export_cli::Bench;

/// Time of a sample at TM 1000, s.
const SAMPLE_S: f64 = 1.0 / 1024.0;

/// Bench with programs of a Galil that has a prologue, an epilogue and outputs for the tool.
struct GalilBench {
    bench: Bench,
}

impl GalilBench {
    fn new() -> Self {
        let x = [1.0, 0.0, 300.0, -2000.0];
        let y = [-2.0, 0.0, 0.0, 0.0];
        let bench = Bench::new(&[0.0, 0.1, 3.1], &[[x, y], [[2.0, 0.0, 0.0, 0.0], y]], &[1, 1]);
        let axis = |axis: &str| json!({ "name": axis, "max_velocity_mm_per_s": 100, "max_acceleration_mm_per_s2": 1000 });
        let controller = json!({ "kind": "galil", "prologue": ["SHAB", "SB 3", "AI 1", "WT 250"], "epilogue": ["CB 3"],
                                 "tool_on": ["SB 1"], "tool_off": ["CB 1"] });
        let machine =
            json!({ "name": "bench", "axes": [axis("x"), axis("y")], "controller": controller });
        fs::write(bench.path("m.json"), machine.to_string()).unwrap();
        let library = Path::new(env!("CARGO_MANIFEST_DIR")).join("../export/tests/gclib.py");
        fs::copy(library, bench.path("gclib.py")).unwrap();
        Self { bench }
    }

    /// Writes the program `out` in segments of at most four samples, and the host script.
    fn export(&self, out: &str, more: &[&str]) {
        let (code, said) = self.try_export(out, more);
        assert_eq!(code, Some(0), "{said}");
    }

    fn try_export(&self, out: &str, more: &[&str]) -> (Option<i32>, String) {
        let output = planish_testkit::program::stage("planish-export")
            .current_dir(self.bench.path(""))
            .args(["galil", "--trajectory", "t", "--machine", "m.json", "--max-step-s", "0.004"])
            .args(["--host-script", "host.py", "--force", "--out", out])
            .args(more)
            .output()
            .unwrap();
        (output.status.code(), String::from_utf8_lossy(&output.stderr).into_owned())
    }

    /// Runs the host script on these programs; returns success, messages and the log of the simulated controller.
    fn run(&self, programs: &[&str], more: Value) -> (bool, String, Value) {
        let log = self.bench.path("log.json");
        let _ = fs::remove_file(&log);
        let mut settings = json!({ "log": log, "position": [10000, -20000], "sample_s": SAMPLE_S });
        settings.as_object_mut().unwrap().extend(more.as_object().unwrap().clone());
        let output = Command::new("python3")
            .current_dir(self.bench.path(""))
            .env("GALIL", settings.to_string())
            .args(["host.py", "192.168.0.7"])
            .args(programs)
            .output()
            .unwrap();
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        let log = fs::read(&log).map_or(Value::Null, |text| serde_json::from_slice(&text).unwrap());
        (output.status.success(), said, log)
    }

    /// Returns the lines of a program that are commands of the motion.
    fn lines(&self, program: &str) -> Vec<String> {
        let text = fs::read_to_string(self.bench.path(program)).unwrap();
        let motion = text.lines().filter(|line| line.starts_with("PV") || line.starts_with("BT"));
        motion.map(str::to_string).collect()
    }
}

fn has_python() -> bool {
    let found = Command::new("python3").arg("--version").output().is_ok_and(|o| o.status.success());
    if !found {
        println!("skipped: no python3");
    }
    found
}

/// Checks that the controller received exactly the program, within its buffer, and stands at its end.
fn is_run(log: &Value, lines: &[String]) {
    assert_eq!(log["faults"], json!([]), "{log}");
    assert_eq!(log["lines"], json!(lines));
    assert_eq!(log["fullest"], 255);
    assert_eq!(log["position"], json!([20000, -20000]));
}

#[test]
fn the_host_sends_the_program_and_keeps_the_buffer_filled() {
    if !has_python() {
        return;
    }
    let bench = GalilBench::new();
    bench.export("run.dmc", &[]);
    let lines = bench.lines("run.dmc");
    let segments = (lines.len() - 5) / 2;
    assert!(segments > 3 * 255, "{segments}");
    let (done, said, log) = bench.run(&["run.dmc"], json!({}));
    assert!(done, "{said}");
    is_run(&log, &lines);
    // Off first of all, on with BT, off as soon as the last segment has run; the prologue waits for its input.
    let commands = ["CB 1", "SHAB", "SB 3", "BTAB", "SB 1", "CB 1", "CB 3"];
    assert_eq!(log["commands"], json!(commands.to_vec()));
    assert_eq!(log["outputs"][2], json!(["SB 1", 0, true]));
    assert_eq!(log["outputs"][3], json!(["CB 1", segments, false]));
    assert!(log["time_s"].as_f64().unwrap() > 0.5 + 0.25 + 3.1, "{log}");

    bench.export("run.dry-run.dmc", &["--dry-run"]);
    let (done, said, log) = bench.run(&["run.dry-run.dmc"], json!({}));
    assert!(done, "{said}");
    is_run(&log, &lines);
    assert!(!log["commands"].as_array().unwrap().contains(&json!("SB 1")), "{log}");
}

#[test]
fn the_host_runs_parts_without_a_stop_and_the_rest_from_a_mark() {
    if !has_python() {
        return;
    }
    let bench = GalilBench::new();
    bench.export("run.dmc", &[]);
    bench.export("run.dmc", &["--parts", "3"]);
    let parts = [1, 2, 3].map(|k| format!("run.part-{k}-of-3.dmc"));
    let parts = parts.each_ref().map(String::as_str);
    let lines = bench.lines("run.dmc");
    assert_eq!(parts.iter().flat_map(|part| bench.lines(part)).collect::<Vec<_>>(), lines);
    let (done, said, log) = bench.run(&parts, json!({}));
    assert!(done, "{said}");
    is_run(&log, &lines);
    for (wrong, expected) in [
        (&[parts[0], parts[2], parts[1]][..], "is part 3 of 3; give all parts"),
        (&[parts[0], parts[1]], "is part 1 of 3; give all parts"),
        (&[parts[1]], "is part 2 of 3; give all parts"),
    ] {
        let (done, said, log) = bench.run(wrong, json!({}));
        assert!(!done && said.contains(expected) && said.contains("nothing was sent"), "{said}");
        assert!(log.is_null(), "{log}");
    }

    // In the middle of the first move: with a run-up, during which the tool is off.
    bench.export("rest.dmc", &["--from-mark", "13"]);
    let about: Value =
        serde_json::from_slice(&fs::read(bench.bench.path("rest.dmc.json")).unwrap()).unwrap();
    let run_up = about["excerpt"]["run_up_segments"].as_u64().unwrap();
    assert!(run_up >= 2);
    let start = (about["start_mm"][0].as_f64().unwrap() * 1e4).round() as i64;
    let (done, said, log) = bench.run(&["rest.dmc"], json!({ "position": [start, -20000] }));
    assert!(done, "{said}");
    is_run(&log, &bench.lines("rest.dmc"));
    // The host asks every 10 ms, in which up to three segments of 4 ms run, and its commands take some, too.
    let on = &log["outputs"][2];
    let segments = on[1].as_u64().unwrap();
    assert!(on[0] == "SB 1" && (run_up..run_up + 5).contains(&segments), "{run_up}: {log}");
}

#[test]
fn the_host_refuses_another_state_and_stops_when_it_is_too_slow() {
    if !has_python() {
        return;
    }
    let bench = GalilBench::new();
    bench.export("run.dmc", &[]);
    for (more, expected) in [
        (
            json!({ "position": [0, -20000] }),
            "axis A stands at 0 counts, the program begins at 10000",
        ),
        (json!({ "sample_s": 0.0005 }), "TM is 512, and the program is for TM 1000"),
    ] {
        let (done, said, log) = bench.run(&["run.dmc"], more);
        assert!(!done && said.contains(expected) && said.contains("nothing has moved"), "{said}");
        assert_eq!((&log["lines"], &log["commands"]), (&json!([]), &json!(["CB 1"])));
    }
    let text = fs::read_to_string(bench.bench.path("run.dmc")).unwrap();
    fs::write(bench.bench.path("run.dmc"), text.replacen("PVA=0,0,4", "PVA=1,0,4", 1)).unwrap();
    let (done, said, log) = bench.run(&["run.dmc"], json!({}));
    assert!(!done && said.contains("it was changed; export it again") && log.is_null(), "{said}");

    // 20 ms for a command, where a segment lasts 4 ms: the buffer runs empty, the tool goes off, and the mark is told.
    bench.export("run.dmc", &[]);
    let (done, said, log) = bench.run(&["run.dmc"], json!({ "latency_s": 0.02 }));
    assert!(!done && said.contains("the buffer ran empty"), "{said}");
    assert!(said.contains("stopped after ") && said.contains(" segments, mark "), "{said}");
    let commands = log["commands"].as_array().unwrap();
    assert_eq!(commands[commands.len() - 2..], [json!("CB 1"), json!("ST")]);
}
