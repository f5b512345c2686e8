//! The binary from its flags to its files and exit codes.

mod example;

use std::{fs, path::Path, process::Output};

use example::{desired, raster, tif};
use planish_handoff::{
    kind::Dtype,
    npy::{self, ArrayData},
};
use planish_testkit::{
    program::{text, write},
    workspace,
};
use serde_json::{Value, json};

fn prepare(dir: &Path) {
    write(dir, "trajectory", &raster());
    write(dir, "tif", &tif());
    write(dir, "surface", &desired());
}

fn run_on(threads: &str, dir: &Path, process: &Value, more: &[&str]) -> Output {
    fs::write(dir.join("error_budget.json"), process.to_string()).unwrap();
    planish_testkit::program::stage("planish-tolerance")
        .current_dir(dir)
        .env("RAYON_NUM_THREADS", threads)
        .args(["--trajectory", "trajectory", "--tif", "tif", "--surface", "surface"])
        .args(["--error-budget", "error_budget.json", "--draws", "2000", "--simulated-runs", "2"])
        .args(if more.contains(&"--out") { &[][..] } else { &["--out", "out"] })
        .args(more)
        .output()
        .unwrap()
}

fn error(kind: &str, size: f64, unit: &str) -> Value {
    json!({ "kind": kind, "size": size, "unit": unit, "distribution": "normal", "note": "measured" })
}

fn outcome(dir: &Path) -> Value {
    let text = fs::read_to_string(dir.join("manifest.json")).unwrap();
    serde_json::from_str::<Value>(&text).unwrap()["outcome"].clone()
}

fn numbers(path: &Path) -> Vec<f64> {
    match npy::read(path, Dtype::F64).unwrap().array {
        ArrayData::F64(a) => a.iter().copied().collect(),
        other => panic!("{:?}", other.dtype()),
    }
}

fn ion_beam() -> Value {
    let file = workspace().join("fixtures/error-budgets/ion-beam.json");
    serde_json::from_str(&fs::read_to_string(file).unwrap()).unwrap()
}

#[test]
fn the_table_and_the_artifact_say_the_same() {
    let tmp = tempfile::tempdir().unwrap();
    prepare(tmp.path());
    let ended = run_on("2", tmp.path(), &ion_beam(), &[]);
    assert_eq!(ended.status.code(), Some(0), "{}", text(&ended.stderr));
    let said = text(&ended.stdout);
    let outcome = outcome(&tmp.path().join("out"));
    let errors = outcome["errors"].as_array().unwrap();
    assert_eq!(errors.len(), ion_beam()["errors"].as_array().unwrap().len());
    for error in errors {
        let line = said.lines().find(|l| l.starts_with(error["kind"].as_str().unwrap())).unwrap();
        let adds = format!("{:.4}", error["adds_rms_nm"].as_f64().unwrap());
        assert!(line.contains(&adds), "{line}: {adds}");
        assert!(error["note"].as_str().unwrap().starts_with("assumed"), "{error}");
    }
    let first = outcome["first"]["kind"].as_str().unwrap();
    assert!(said.contains(&format!("improve {first} first")), "{said}");
    // The distribution ascends, and its quantiles are those that are printed.
    let (part, rms) =
        (numbers(&tmp.path().join("out/part.npy")), numbers(&tmp.path().join("out/rms_nm.npy")));
    assert!(part.is_sorted() && rms.is_sorted() && part[190] == 0.95);
    let stated = outcome["residual"]["below_95_percent_nm"].as_f64().unwrap();
    // The same quantile: the parser of JSON may miss the last bit.
    assert!((rms[190] - stated).abs() < 1e-12, "{} {stated}", rms[190]);
    let deviation = numbers(&tmp.path().join("out/deviation_nm.npy"));
    for (v, z) in deviation.iter().zip(desired().height_nm()) {
        assert!(if z.is_nan() { v.is_nan() } else { *v > 0.0 }, "{v} {z}");
    }
}

#[test]
fn the_same_bytes_on_one_thread_and_on_two() {
    let tmp = tempfile::tempdir().unwrap();
    prepare(tmp.path());
    for (threads, out) in [("1", "one"), ("2", "two")] {
        let ended = run_on(threads, tmp.path(), &ion_beam(), &["--out", out]);
        assert_eq!(ended.status.code(), Some(0), "{}", text(&ended.stderr));
    }
    for file in ["part.npy", "rms_nm.npy", "deviation_nm.npy"] {
        let read = |out: &str| fs::read(tmp.path().join(out).join(file)).unwrap();
        assert!(read("one") == read("two"), "{file}");
    }
    assert_eq!(outcome(&tmp.path().join("one")), outcome(&tmp.path().join("two")));
}

#[test]
fn what_is_no_process_is_refused_by_name() {
    let tmp = tempfile::tempdir().unwrap();
    prepare(tmp.path());
    let one = |error: Value| json!({ "name": "p", "errors": [error] });
    let with = |kind: &str, size: f64, unit: &str, key: &str, value: Value| {
        let mut e = error(kind, size, unit);
        e[key] = value;
        one(e)
    };
    let good = error("offset_x", 1.0, "um");
    let cases = [
        (
            one(error("offset_x", 1.0, "nm")),
            "errors[0]: the unit of offset_x is \"nm\"; give one of [\"mm\", \"um\"]",
        ),
        (
            one(error("rate_scale", 1.0, "mm")),
            "errors[0]: the unit of rate_scale is \"mm\"; give one of [\"%\", \"1\"]",
        ),
        (
            one(error("timing_jitter", -1.0, "ms")),
            "errors[0]: the size of timing_jitter is -1 ms; a standard deviation",
        ),
        (
            json!({ "name": "p", "errors": [good, error("rotation", -0.5, "deg")] }),
            "errors[1]: the size of rotation is -0.5 deg",
        ),
        (
            one(error("rate_scale", 60.0, "%")),
            "errors[0]: the size of rate_scale is 60 %; give at most 25 %",
        ),
        (
            one(error("offset_x", 50.0, "mm")),
            "errors[0]: offset_x of 50 mm moves the tool by 50 mm, and the TIF is 10 mm wide; give at most \
             10",
        ),
        (one(error("wobble", 1.0, "um")), "unknown variant `wobble`, expected one of `rate_scale`"),
        (
            with("offset_x", 1.0, "um", "sigma", json!(3)),
            "unknown field `sigma`, expected one of `kind`",
        ),
        (
            with("offset_x", 1.0, "um", "damping_ratio", json!(1)),
            "errors[0]: `damping_ratio` is given for offset_x; leave it out",
        ),
        (
            with("offset_x", 1.0, "um", "distribution", json!("cauchy")),
            "unknown variant `cauchy`, expected one of `normal`",
        ),
        (
            with("position_noise", 1.0, "um", "distribution", json!("fixed")),
            "errors[0]: the distribution of position_noise is \"fixed\"; give \"normal\"",
        ),
        (
            one(error("servo_first_order", 1.0, "ms")),
            "errors[0]: the distribution of servo_first_order is \"normal\"; give \"fixed\"",
        ),
        (
            with("servo_first_order", -1.0, "ms", "distribution", json!("fixed")),
            "errors[0]: the size of servo_first_order is -1 ms; axes are not ahead of their command",
        ),
        (one(error("rate_noise", 1.0, "%")), "errors[0]: rate_noise has no `correlation_s`"),
        (
            with("rate_noise", 1.0, "%", "correlation_s", json!(-20)),
            "errors[0]: `correlation_s` of rate_noise is -20; give",
        ),
        (
            one(json!({
                "kind": "servo_second_order", "size": 1, "unit": "ms", "distribution": "fixed",
                "note": "measured", "damping_ratio": 50
            })),
            "`damping_ratio` of servo_second_order is 50; give 0.005 to 2",
        ),
        (json!({ "name": "p", "errors": [] }), "errors: are none; give at least one error"),
        (json!({ "name": "p" }), "missing field `errors`"),
        (
            json!({ "name": "p", "errors": [error("offset_x", 1.0, "um")], "author": "me" }),
            "unknown field `author`",
        ),
        (
            one(json!({ "kind": "offset_x", "size": 1, "unit": "um", "distribution": "normal" })),
            "missing field `note`",
        ),
    ];
    for (process, message) in cases {
        let ended = run_on("2", tmp.path(), &process, &[]);
        let said = text(&ended.stderr);
        assert_eq!(ended.status.code(), Some(2), "{said}");
        assert!(said.contains(message), "{message}: {said}");
        assert!(said.contains("error_budget.json"), "{said}");
        assert!(!tmp.path().join("out").exists(), "{said}");
    }
}
