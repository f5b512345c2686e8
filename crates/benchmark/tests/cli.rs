//! `planish-benchmark score` on submissions that are good and on those that are not.

use std::{f64::consts::TAU, fs, path::Path, process::Output};

use planish_benchmark::{Source, trajectory};
use planish_fixture::{Recipe, make};
use planish_handoff::save;
use planish_testkit::{
    program::{stage, text},
    workspace,
};
use serde_json::Value;

/// Returns rows of a motion along x and back over the coupon, in `seconds`, on the lines y = 3, 6 and 9 mm. The
/// velocity is that of a sine: at rest at both ends.
fn rows(seconds: f64) -> Vec<[f64; 5]> {
    let mut rows = vec![[0.0, 0.0, 3.0, 0.0, 0.0]];
    let pieces = (4.0 * seconds).ceil();
    for line in 0..3 {
        let y = 3.0 * f64::from(line + 1);
        let sign = if line % 2 == 0 { 1.0 } else { -1.0 };
        let from = if line % 2 == 0 { 0.0 } else { 20.0 };
        if line > 0 {
            let t = rows[rows.len() - 1][0];
            rows.push([t + 0.5, from, y, 0.0, 0.0]);
        }
        let start = rows[rows.len() - 1][0];
        for k in 1..=pieces as usize {
            let u = k as f64 / pieces;
            let x = from + sign * 20.0 * (u - (TAU * u).sin() / TAU);
            let v = if k == pieces as usize {
                0.0
            } else {
                sign * 20.0 / seconds * (1.0 - (TAU * u).cos())
            };
            rows.push([start + seconds * u, x, y, v, 0.0]);
        }
    }
    rows
}

fn submission(rows: &[[f64; 5]]) -> String {
    let lines = rows.iter().map(|r| format!("{},{},{},{},{}\n", r[0], r[1], r[2], r[3], r[4]));
    format!("t,x,y,vx,vy\n{}", lines.collect::<String>())
}

fn score(dir: &Path, submission: &str) -> Output {
    let file = dir.join("submission.csv");
    fs::write(&file, submission).unwrap();
    let problem = workspace().join("benchmark/problems/coupon-fluid-jet.json");
    stage("planish-benchmark").arg("score").args([problem, file]).output().unwrap()
}

/// Returns what the program says against a submission that it refuses.
fn refusal(dir: &Path, rows: &[[f64; 5]]) -> String {
    let output = score(dir, &submission(rows));
    assert_eq!(output.status.code(), Some(2), "{}", text(&output.stdout));
    assert!(output.stdout.is_empty(), "{}", text(&output.stdout));
    text(&output.stderr)
}

#[test]
fn a_motion_has_a_score_above_the_bound() {
    let tmp = tempfile::tempdir().unwrap();
    let output = score(tmp.path(), &submission(&rows(8.0)));
    assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
    let score: Value = serde_json::from_slice(&output.stdout).unwrap();
    let number = |name: &str| score[name].as_f64().unwrap_or_else(|| panic!("{name}: {score}"));
    assert_eq!(number("time_s"), 25.0);
    assert!(number("bound_rms_nm") < number("residual_rms_nm"), "{score}");
    // Rounding of a quotient.
    let excess = number("residual_rms_nm") / number("bound_rms_nm") - 1.0;
    assert!((number("excess") - excess).abs() < 1e-12 && excess > 0.0, "{score}");
    let excess = number("time_s") / number("bound_time_s") - 1.0;
    assert!((number("excess_time") - excess).abs() < 1e-12 && excess > 0.0, "{score}");
}

#[test]
fn of_several_motions_each_has_its_score_or_the_reason_why_it_has_none() {
    let tmp = tempfile::tempdir().unwrap();
    let file = |name: &str, seconds: f64| {
        let path = tmp.path().join(name);
        fs::write(&path, submission(&rows(seconds))).unwrap();
        path
    };
    // Passes of 20 mm in 0.05 s need 160 times the largest acceleration.
    let [slow, slower, fast] =
        [file("slow.csv", 8.0), file("slower.csv", 8.05), file("fast.csv", 0.05)];
    let problem = workspace().join("benchmark/problems/coupon-fluid-jet.json");
    let output =
        stage("planish-benchmark").arg("score").args([&problem, &slow, &slower, &fast]).output();
    let output = output.unwrap();
    assert_eq!(output.status.code(), Some(1), "{}", text(&output.stderr));
    let rows: Value = serde_json::from_slice(&output.stdout).unwrap();
    let refused = rows[2]["refused"].as_str().unwrap();
    assert!(refused.contains("breaks a limit"), "{refused}");
    let alone = score(tmp.path(), &fs::read_to_string(&slower).unwrap());
    let alone: Value = serde_json::from_slice(&alone.stdout).unwrap();
    for key in ["residual_rms_nm", "residual_pv_nm", "with_errors", "slope_rms_nrad"] {
        assert_eq!(rows[1][key], alone[key], "{key}");
    }
    // Times 0.6 % apart share a bound: its tangent is below the bound of the second time, by the second order.
    let [tangent, own] = [&rows[1], &alone].map(|row| row["bound_rms_nm"].as_f64().unwrap());
    assert!(tangent <= own * (1.0 + 2e-3) && tangent >= own * (1.0 - 5e-3), "{tangent} {own}");
}

/// A motion with three times the rate of the tool was scored 19 % below the bound.
#[test]
fn a_motion_with_another_rate_than_the_tool_is_refused() {
    let tmp = tempfile::tempdir().unwrap();
    let motion = trajectory(&submission(&rows(8.0))).unwrap();
    let mut rates = vec![1.0; motion.len()];
    rates[1] = 3.0;
    let folder = tmp.path().join("motion");
    save(&folder, &motion.with_rate_factor(rates).unwrap()).unwrap();
    let problem = workspace().join("benchmark/problems/coupon-fluid-jet.json");
    let output =
        stage("planish-benchmark").arg("score").args([&problem, &folder]).output().unwrap();
    assert_eq!(output.status.code(), Some(2), "{}", text(&output.stdout));
    let message = text(&output.stderr);
    assert!(message.contains("rate_factor[1]") && message.contains("is 3"), "{message}");
}

#[test]
fn a_measured_part_that_is_missing_or_another_one_is_refused() {
    let tmp = tempfile::tempdir().unwrap();
    fs::write(tmp.path().join("motion.csv"), submission(&rows(8.0))).unwrap();
    let problem = |folder: &str| {
        let fixtures = workspace().join("fixtures");
        let measured = format!(
            r#"{{ "folder": "{folder}", "surface_blake3": "{0:064}", "tif_blake3": "{0:064}" }}"#,
            1
        );
        let content = format!(
            r#"{{ "name": "p", "doc": "d", "measured": {measured},
                  "machine": "{0}/machines/fluid-jet.json", "error_budget": "{0}/error-budgets/fluid-jet.json" }}"#,
            fixtures.display()
        );
        fs::write(tmp.path().join("problem.json"), content).unwrap();
        let arguments = ["problem.json", "motion.csv"].map(|name| tmp.path().join(name));
        let output = stage("planish-benchmark").arg("score").args(arguments).output().unwrap();
        assert_eq!(output.status.code(), Some(2), "{}", text(&output.stdout));
        text(&output.stderr)
    };
    let message = problem("nowhere");
    assert!(message.contains("nowhere") && message.contains("measured.py"), "{message}");
    let recipe = workspace().join("fixtures/coupon.json");
    let mut program = stage("planish-fixture");
    program.arg(recipe).arg("--out").arg(tmp.path().join("part"));
    assert!(program.output().unwrap().status.success());
    let message = problem("part");
    assert!(message.contains("part/surface: has the content"), "{message}");
}

#[test]
fn a_motion_that_breaks_a_limit_by_a_millionth_is_refused_with_place_and_value() {
    let tmp = tempfile::tempdir().unwrap();
    // From rest with the acceleration a along x, and to rest again; the limit is 2000 mm/s^2.
    let pulse = |a: f64| {
        let h = 0.005;
        let end = [2.0 * h, 5.0 + a * h * h, 5.0, 0.0, 0.0];
        vec![[0.0, 5.0, 5.0, 0.0, 0.0], [h, 5.0 + 0.5 * a * h * h, 5.0, a * h, 0.0], end]
    };
    let file = tmp.path().join("pulse.csv");
    let run = |a: f64| {
        fs::write(&file, submission(&pulse(a))).unwrap();
        let problem = workspace().join("benchmark/problems/coupon-ion-beam-no-jerk-limit.json");
        stage("planish-benchmark").arg("score").args([&problem, &file]).output().unwrap()
    };
    let at_limit = run(2000.0);
    assert_eq!(at_limit.status.code(), Some(0), "{}", text(&at_limit.stderr));
    let above = run(2000.0 * (1.0 + 1e-6));
    assert_eq!(above.status.code(), Some(2), "{}", text(&above.stdout));
    let message = text(&above.stderr);
    for part in ["breaks a limit", "acceleration", "2000", "segment"] {
        assert!(message.contains(part), "{part}: {message}");
    }
}

#[test]
fn jumps_gaps_and_numbers_that_are_none_are_refused_with_place_and_value() {
    let tmp = tempfile::tempdir().unwrap();
    let good = rows(8.0);
    let with = |k: usize, column: usize, value: f64| {
        let mut rows = good.clone();
        rows[k][column] = value;
        rows
    };
    let jump = with(5, 0, good[4][0]);
    let mut gap = good.clone();
    gap.drain(10..20);
    let cases = [
        (with(7, 1, f64::NAN), "line[9]", "x = \"NaN\""),
        (with(7, 4, f64::INFINITY), "line[9]", "vy = \"inf\""),
        (jump, "line[7]", "the motion jumps by"),
        (gap, "line[12]", "gap in time"),
        (with(3, 0, 0.0), "line[5]", "after"),
        (with(0, 0, 0.1), "line[2]", "starts at 0.1 s"),
        (with(0, 3, 1.0), "breaks a limit", "0 s"),
        (good[..1].to_vec(), "rows", "are 1"),
    ];
    for (rows, place, value) in cases {
        let message = refusal(tmp.path(), &rows);
        assert!(message.contains("submission.csv"), "{message}");
        assert!(message.contains(place) && message.contains(value), "{place} {value}: {message}");
    }
    let output = score(tmp.path(), "time,x\n0,1\n");
    assert_eq!(output.status.code(), Some(2));
    assert!(text(&output.stderr).contains("t,x,y,vx,vy"), "{}", text(&output.stderr));
}

#[test]
fn every_problem_names_files_that_exist() {
    let folder = workspace().join("benchmark/problems");
    let mut count = 0;
    for entry in fs::read_dir(&folder).unwrap() {
        let path = entry.unwrap().path();
        let problem: planish_benchmark::Problem =
            serde_json::from_str(&fs::read_to_string(&path).unwrap()).unwrap();
        assert_eq!(path.file_stem().unwrap().to_str(), Some(problem.name.as_str()));
        for file in [&problem.machine, &problem.error_budget] {
            assert!(folder.join(file).is_file(), "{}: {file}", path.display());
        }
        match problem.source().unwrap() {
            Source::Recipe(recipe_file) => {
                let text = fs::read_to_string(folder.join(recipe_file)).unwrap();
                let recipe: Recipe = serde_json::from_str(&text).unwrap();
                // Those of `fixtures` are made elsewhere, and used by ten times as many tests.
                if recipe_file.starts_with("../recipes") {
                    make(&recipe).unwrap_or_else(|e| panic!("{}: {e}", recipe.name));
                }
            }
            Source::Measured(part) => {
                assert_eq!([part.surface_blake3.len(), part.tif_blake3.len()], [64, 64]);
            }
        }
        count += 1;
    }
    assert!(count >= 80, "{count}");
}
