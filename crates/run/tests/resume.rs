//! Interrupted runs on the coupon, through all programs: the rest by the time, the line and the log of an abort.
#![cfg(unix)]

use std::{fmt::Write, fs, path::Path, process::Output};

use planish_handoff::artifact::read;
use planish_testkit::program::{stage, text};
use planish_types::{Removal, Surface, Trajectory, outcome::abort::ResumeOutcome};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Largest residual of a part that is mended, over that of the undisturbed run: what `planish-run resume` states.
const MENDED: f64 = 1.05;

/// Runs `planish-run` with these arguments in the folder `dir`.
fn planish_run(dir: &Path, arguments: &str) -> Output {
    let mut command = stage("planish-run");
    command.current_dir(dir).args(arguments.split_whitespace()).output().unwrap()
}

/// Plans the coupon in the folder `dir`, with a program.
fn plan(dir: &Path) {
    let words = "run raster fixture=coupon plan_joint=no frames=0 export=csv program_of=pvt+refined out=run";
    let ended = planish_run(dir, words);
    assert_eq!(ended.status.code(), Some(0), "{}", text(&ended.stderr));
}

/// Plans the rest with these settings. Checks the exit code and the message by the outcome, and returns the outcome.
fn resume(dir: &Path, settings: &str) -> ResumeOutcome {
    let _ = fs::remove_dir_all(dir.join("rest"));
    let words = format!("resume run=run out=rest plan_joint=no {settings}");
    let ended = planish_run(dir, &words);
    let message = text(&ended.stdout) + &text(&ended.stderr);
    let file =
        fs::read_to_string(dir.join("rest/resume.json")).unwrap_or_else(|_| panic!("{message}"));
    let outcome: ResumeOutcome = serde_json::from_str(&file).unwrap();
    let best = outcome.ways.iter().find(|way| way.name == outcome.recommended).unwrap();
    let is_within = best.rms_nm <= MENDED * outcome.undisturbed_rms_nm;
    assert_eq!(outcome.is_mended, is_within, "{message}");
    assert_eq!(ended.status.code(), Some(if is_within { 0 } else { 1 }), "{message}");
    if !is_within {
        // The mark is named with its depth.
        assert!(best.mark.depth_nm > 0.0, "{message}");
        assert!(
            message.contains(&format!("its deepest mark is {:.3} nm", best.mark.depth_nm)),
            "{message}"
        );
    }
    outcome
}

/// Returns the residual of a way, nm RMS, from the arrays of the whole history: the map before the run, what the
/// executed motion removed, and what the rest removes.
fn rms_of_history(dir: &Path, plan: &str) -> f64 {
    let surface: Surface = read(&dir.join("run/surface")).unwrap().value;
    let executed: Removal = read(&dir.join("rest/removal")).unwrap().value;
    let rest: Removal = read(&dir.join(plan).join("removal")).unwrap().value;
    let left = surface.height_nm() - executed.removal_nm() - rest.removal_nm();
    Surface::new(*surface.grid(), left).unwrap().statistics().rms
}

#[test]
fn the_rest_of_an_interrupted_run_mends_the_part_or_names_the_mark() {
    let dir = tempfile::tempdir().unwrap();
    plan(dir.path());
    let motion: Trajectory =
        read(&dir.path().join("run/methods/pvt+refined/trajectory")).unwrap().value;
    let total_s = motion.total_time_s();
    let mut random = ChaCha8Rng::seed_from_u64(67);
    for _ in 0..3 {
        let abort_s = total_s * random.random_range(0.05..0.95);
        for tool_on_s in [0.0, 0.1, 1.0] {
            let settings =
                format!("plan=pvt+refined abort_s={abort_s} tool_on_s={tool_on_s} new_path=no");
            let outcome = resume(dir.path(), &settings);
            println!(
                "{abort_s:.2} s, tool on {tool_on_s} s: {:?}",
                outcome
                    .ways
                    .iter()
                    .map(|w| (w.rms_nm / outcome.undisturbed_rms_nm, w.time_s, w.mark))
                    .collect::<Vec<_>>()
            );
            let same = outcome.ways.iter().find(|way| way.name == "same-path").unwrap();
            // Rounding of sums of heights of 100 nm.
            assert!((rms_of_history(dir.path(), &same.plan) - same.rms_nm).abs() < 1e-9);
            // Regression bound: the closed loop ends at another plan, which left up to 1.063 times the residual. A tool
            // that stays on for 1 s removes up to 10 nm, which no plan fills.
            let ratio = same.rms_nm / outcome.undisturbed_rms_nm;
            assert!(
                !same.is_negative && (ratio < 1.1 || tool_on_s == 1.0),
                "{abort_s} s, tool on {tool_on_s} s: {ratio}"
            );
        }
    }
}

#[test]
fn line_and_log_of_an_abort_say_what_its_time_says() {
    let dir = tempfile::tempdir().unwrap();
    plan(dir.path());
    let program = fs::read_to_string(dir.path().join("run/program.csv")).unwrap();
    let lines: Vec<&str> = program.lines().collect();
    let line = lines.len() / 2;
    let time_s = |line: usize| lines[line - 1].split(',').next().unwrap().parse::<f64>().unwrap();
    let middle_s = 0.5 * (time_s(line) + time_s(line + 1));
    let by_line = resume(dir.path(), &format!("abort_line={line} new_path=no"));
    let by_time =
        resume(dir.path(), &format!("plan=pvt+refined+csv abort_s={middle_s} new_path=no"));
    // Six decimals of a second in the marks, and a stop of some tenths of a second.
    assert!((by_line.executed.executed_s - by_time.executed.executed_s).abs() < 1e-5);
    let expected = by_time.ways[1].rms_nm;
    assert!((by_line.ways[1].rms_nm / expected - 1.0).abs() < 1e-3, "{by_line:?}\n{by_time:?}");

    // The log of the executed motion at 200 Hz, with noise of 0.1 um, begins 0.3 s after the motion.
    let executed: Trajectory = read(&dir.path().join("rest/executed")).unwrap().value;
    let mut random = ChaCha8Rng::seed_from_u64(5);
    let mut log = String::from("time_s,x_mm,y_mm,tool_on\n");
    for (k, segment) in executed.segments().enumerate() {
        let mut time_s = (segment.start_s.max(0.3) * 200.0).ceil() / 200.0;
        while time_s < executed.break_time_s()[k + 1] {
            let p = segment.position_mm(time_s - segment.start_s);
            let p = p.map(|p| p + 1e-4 * random.random_range(-1.7..1.7));
            writeln!(log, "{time_s},{},{},{}", p[0], p[1], u8::from(segment.tool_on)).unwrap();
            time_s += 1.0 / 200.0;
        }
    }
    fs::write(dir.path().join("log.csv"), log).unwrap();
    let settings = "plan=pvt+refined log=log.csv trace=--tool-on=tool_on new_path=no";
    let by_log = resume(dir.path(), settings);
    let [place, expected_place] = [&by_log, &by_time].map(|outcome| outcome.executed.place_mm);
    // Noise of the velocity at the end, 0.05 mm/s, over the time of the stop.
    assert!((0..2).all(|k| (place[k] - expected_place[k]).abs() < 0.02), "{place:?}");
    // What was removed in the first 0.3 s of the motion is not in the log.
    assert!(by_log.ways[1].rms_nm < MENDED * by_log.undisturbed_rms_nm, "{by_log:?}");
}

#[test]
fn a_new_path_is_compared_and_an_abort_at_the_end_leaves_nothing_to_do() {
    let dir = tempfile::tempdir().unwrap();
    plan(dir.path());
    let both = resume(dir.path(), "plan=pvt+refined abort_s=120 tool_on_s=0.1");
    let names: Vec<&str> = both.ways.iter().map(|way| way.name.as_str()).collect();
    assert_eq!(names, ["stop", "same-path", "new-path"]);
    // The new path goes over what is done, too.
    assert!(both.ways[1].time_s < both.ways[2].time_s && both.recommended == "same-path");

    let motion: Trajectory =
        read(&dir.path().join("run/methods/pvt+refined/trajectory")).unwrap().value;
    let settings = format!("plan=pvt+refined abort_s={} new_path=no", motion.total_time_s());
    let end = resume(dir.path(), &settings);
    assert_eq!((end.ways.len(), end.recommended.as_str(), end.is_mended), (1, "stop", true));
    assert!((end.ways[0].rms_nm / end.undisturbed_rms_nm - 1.0).abs() < 1e-6, "{end:?}");
}

#[test]
fn what_is_no_interrupted_run_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    fs::create_dir_all(dir.path().join("run/methods")).unwrap();
    let owner = r#"{ "pipeline": "raster", "mirror": { "fixture": "coupon" } }"#;
    fs::write(dir.path().join("run/run.json"), owner).unwrap();
    for (settings, part) in [
        ("abort_s=3", "run is not given"),
        ("run=none abort_s=3", "run none is not there"),
        ("run=run", "give one of abort_s=T"),
        ("run=run abort_s=3 log=l.csv", "give one of abort_s=T"),
        ("run=run abort_s=3", "report/summary.json: cannot be read"),
        ("run=run plan=pvt abort_line=9", "run has none; give abort_s=T"),
        ("run=run plan=pvt abort_s=3", "plan run/methods/pvt/trajectory is not there"),
        ("run=run abort_s=3 surface=s", "leave surface out"),
        ("mirror", "'mirror' is no setting"),
    ] {
        let ended = planish_run(dir.path(), &format!("resume {settings} out=rest"));
        let message = text(&ended.stderr);
        assert_eq!(ended.status.code(), Some(2), "{settings}: {message}");
        assert!(message.contains(part), "{settings}: {message}");
        assert!(!dir.path().join("rest").exists(), "{settings}");
    }
}
