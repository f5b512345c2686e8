//! The program from its flags to its files and exit codes.
#![cfg(unix)]

use std::{
    fs,
    os::unix::process::ExitStatusExt,
    path::Path,
    process::{Command, Output, Stdio},
    thread,
    time::{Duration, Instant},
};

use serde_json::json;
use tempfile::TempDir;

const PROGRAM: &str = "planish-run";
/// Number of races between two starts in the same directory. Larger: a longer test. Smaller: a fault in the lock is
/// found less often. Each race is two processes of a few milliseconds.
const RACES: usize = 40;
/// Longest time that a test waits for a command. Larger: a failed test ends later. Smaller: a loaded machine fails
/// the test, because its commands take longer.
const PATIENCE: Duration = Duration::from_secs(60);

/// Creates a directory with a machine file, a recipe of the fixture `coupon` and a measured mirror.
fn bench() -> TempDir {
    let dir = tempfile::tempdir().unwrap();
    let axis = |name: &str| json!({"name": name, "max_velocity_mm_per_s": 10.0, "max_acceleration_mm_per_s2": 20.0});
    let axes = [axis("x"), axis("y")];
    let machine = json!({"name": "bench", "time_to_full_acceleration_s": 0, "axes": axes});
    fs::write(dir.path().join("machine.json"), machine.to_string()).unwrap();
    fs::create_dir(dir.path().join("fixtures")).unwrap();
    for name in ["coupon", "disk"] {
        fs::write(dir.path().join(format!("fixtures/{name}.json")), "{}").unwrap();
    }
    for name in ["mirror", "elsewhere/mirror", "tool"] {
        fs::create_dir_all(dir.path().join(name)).unwrap();
    }
    dir
}

const FIXTURE: [&str; 2] = ["--fixture", "fixtures/coupon.json"];
const MEASURED: [&str; 4] = ["--surface", "mirror", "--tif", "tool"];

/// Returns the command `planish-run start` for `command`, with the flags `mirror` and the output directory `out`.
fn start(dir: &Path, out: &str, mirror: &[&str], command: &[&str]) -> Command {
    let mut start = planish_testkit::program::stage(PROGRAM);
    start
        .current_dir(dir)
        .args(["start", "--out", out, "--pipeline", "raster", "--machine", "machine.json"])
        .args(mirror)
        .arg("--")
        .args(command)
        .stdout(Stdio::piped())
        .stderr(Stdio::piped());
    start
}

fn run(dir: &Path, out: &str, mirror: &[&str], command: &[&str]) -> Output {
    start(dir, out, mirror, command).output().unwrap()
}

fn message(output: &Output) -> String {
    String::from_utf8(output.stderr.clone()).unwrap()
}

/// Checks that the exit code is 2, and that the message is one line with all of `parts`.
#[track_caller]
fn refused(output: &Output, parts: &[&str]) {
    let text = message(output);
    assert_eq!(output.status.code(), Some(2), "{text}");
    assert_eq!(text.lines().count(), 1, "{text}");
    for part in parts {
        assert!(text.contains(part), "no {part:?} in {text}");
    }
}

/// Waits until the file or directory `path` exists.
fn wait_for(path: &Path) {
    let since = Instant::now();
    while !path.exists() {
        assert!(since.elapsed() < PATIENCE, "{} never came", path.display());
        thread::sleep(Duration::from_millis(5));
    }
}

/// Repeats a start until the directory is unlocked, because the processes of a killed command end a moment later.
fn wait_until_free(dir: &Path) {
    let since = Instant::now();
    while !run(dir, "out", &FIXTURE, &["true"]).status.success() {
        assert!(since.elapsed() < PATIENCE, "the directory is never free");
        thread::sleep(Duration::from_millis(5));
    }
}

#[test]
fn the_command_gets_its_arguments_and_its_exit_code_is_the_runs() {
    let dir = bench();
    let hostile = "it's; touch PWNED $(touch PWNED2) `ls`\n{{ x }} \"é\" *";
    let script = r#"printf '<%s>' "$@""#;
    let done = run(dir.path(), "a/out", &FIXTURE, &["sh", "-c", script, "sh", hostile, "-x", ""]);
    assert_eq!(done.status.code(), Some(0), "{}", message(&done));
    assert_eq!(String::from_utf8(done.stdout).unwrap(), format!("<{hostile}><-x><>"));
    let owner = fs::read_to_string(dir.path().join("a/out/run.json")).unwrap();
    let owner: serde_json::Value = serde_json::from_str(&owner).unwrap();
    assert_eq!(owner, json!({"pipeline": "raster", "mirror": {"fixture": "coupon"}}));
    assert!(!dir.path().join("PWNED").exists() && !dir.path().join("PWNED2").exists());
    for code in [1, 2, 7] {
        let ended = run(dir.path(), "a/out", &FIXTURE, &["sh", "-c", &format!("exit {code}")]);
        assert_eq!(ended.status.code(), Some(code));
    }
    refused(&run(dir.path(), "a/out", &FIXTURE, &["no-such-program"]), &["no-such-program"]);
}

#[test]
fn a_machine_that_says_nothing_of_jerk_gets_a_limit_and_a_warning() {
    let dir = bench();
    let here = dir.path();
    let (file, copy) = (here.join("machine.json"), here.join("out/machine/machine.json"));
    // What it states is copied byte by byte, and nothing is said.
    let said = run(here, "out", &FIXTURE, &["true"]);
    assert_eq!((said.status.code(), message(&said).as_str()), (Some(0), ""));
    let stated = fs::read_to_string(&file).unwrap();
    assert_eq!(fs::read_to_string(&copy).unwrap(), stated);
    let mut silent: serde_json::Value = serde_json::from_str(&stated).unwrap();
    silent.as_object_mut().unwrap().remove("time_to_full_acceleration_s");
    silent["axes"][1]["max_jerk_mm_per_s3"] = json!(50.0);
    fs::write(&file, silent.to_string()).unwrap();
    let warned = run(here, "out", &FIXTURE, &["true"]);
    assert_eq!(warned.status.code(), Some(0));
    let text = message(&warned);
    assert_eq!(text.lines().count(), 1, "{text}");
    let parts = ["machine.json states no jerk limit of x, so this run assumes 0.1 s", "0 means no"];
    assert!(parts.iter().all(|part| text.contains(part)), "{text}");
    let assumed: serde_json::Value =
        serde_json::from_str(&fs::read_to_string(&copy).unwrap()).unwrap();
    assert_eq!(assumed["time_to_full_acceleration_s"], 0.1);
    assert_eq!(assumed["axes"][1]["max_jerk_mm_per_s3"], 50.0);
}

#[test]
fn mistakes_are_found_before_anything_is_written() {
    let dir = bench();
    let here = dir.path();
    let none = ["--fixture", "fixtures/nosuch.json"];
    refused(&run(here, "out", &none, &["true"]), &["no fixture 'nosuch'", "coupon, disk"]);
    refused(&run(here, "out", &["--surface", "mirror"], &["true"]), &["without tif"]);
    refused(&run(here, "out", &["--tif", "tool"], &["true"]), &["without surface"]);
    refused(&run(here, "out", &[], &["true"]), &["no mirror"]);
    let absent = ["--surface", "nowhere", "--tif", "tool"];
    refused(&run(here, "out", &absent, &["true"]), &["surface nowhere: cannot read"]);
    fs::write(here.join("machine.json"), r#"{"name": "bench", "axes": []}"#).unwrap();
    refused(&run(here, "out", &FIXTURE, &["true"]), &["machine.json"]);
    fs::remove_file(here.join("machine.json")).unwrap();
    refused(&run(here, "out", &FIXTURE, &["true"]), &["machine.json", "cannot read"]);
    assert!(!here.join("out").exists());
}

#[test]
fn a_directory_with_other_content_is_left_as_it_is() {
    let dir = bench();
    fs::create_dir_all(dir.path().join("proj/surface")).unwrap();
    fs::write(dir.path().join("proj/surface/height_nm.npy"), "mine").unwrap();
    let ended = run(dir.path(), "proj", &FIXTURE, &["touch", "ran"]);
    refused(&ended, &["proj holds surface and no run.json", "give another out"]);
    assert_eq!(fs::read_dir(dir.path().join("proj")).unwrap().count(), 1, "a file was added");
    fs::write(dir.path().join("file"), "mine").unwrap();
    refused(&run(dir.path(), "file", &FIXTURE, &["touch", "ran"]), &["file"]);
    std::os::unix::fs::symlink("nowhere", dir.path().join("link")).unwrap();
    refused(&run(dir.path(), "link", &FIXTURE, &["touch", "ran"]), &["link"]);
    fs::create_dir(dir.path().join("strange")).unwrap();
    fs::write(dir.path().join("strange/run.json"), "{}").unwrap();
    refused(&run(dir.path(), "strange", &FIXTURE, &["touch", "ran"]), &["no run has written"]);
    assert!(!dir.path().join("ran").exists());
    // An empty one is nobody's.
    fs::create_dir(dir.path().join("empty")).unwrap();
    assert!(run(dir.path(), "empty", &FIXTURE, &["true"]).status.success());
}

#[test]
fn another_mirror_and_another_pipeline_are_refused() {
    let dir = bench();
    let here = dir.path();
    assert!(run(here, "out", &MEASURED, &["true"]).status.success());
    // The same by another spelling.
    let same = ["--surface", "elsewhere/../mirror/", "--tif", "./tool"];
    assert!(run(here, "out", &same, &["true"]).status.success());
    // The same file name elsewhere.
    let other = ["--surface", "elsewhere/mirror", "--tif", "tool"];
    let ended = run(here, "out", &other, &["touch", "ran"]);
    refused(&ended, &["out belongs to another run", "elsewhere/mirror", "give another out"]);
    refused(&run(here, "out", &FIXTURE, &["touch", "ran"]), &["fixture coupon"]);
    let maze = [&MEASURED[..], &["--out", "out"]].concat();
    let mut other = planish_testkit::program::stage(PROGRAM);
    other.current_dir(here).args(["start", "--pipeline", "maze", "--machine", "machine.json"]);
    let ended = other.args(maze).args(["--", "touch", "ran"]).output().unwrap();
    refused(&ended, &["pipeline raster", "pipeline maze"]);
    assert!(!here.join("ran").exists());
}

#[test]
fn no_output_is_contains_or_lies_inside_an_input() {
    let dir = bench();
    let here = dir.path();
    for (out, how) in [("mirror", "is"), ("mirror/a/b", "lies inside"), ("elsewhere", "contains")] {
        let surface = if out == "elsewhere" { "elsewhere/mirror" } else { "mirror" };
        let mirror = ["--surface", surface, "--tif", "tool"];
        refused(&run(here, out, &mirror, &["true"]), &[how, surface]);
    }
    refused(&run(here, "tool/out", &MEASURED, &["true"]), &["lies inside the tif"]);
    refused(&run(here, ".", &FIXTURE, &["true"]), &["contains the machine"]);
    assert_eq!(fs::read_dir(here.join("mirror")).unwrap().count(), 0);
}

#[test]
fn of_two_starts_at_once_one_runs_and_the_other_says_who() {
    let dir = bench();
    for race in 0..RACES {
        // The winner stays until the loser has ended.
        let out = format!("out-{race}");
        let script = format!("echo ran; until [ -e go-{race} ]; do sleep 0.01; done");
        let begin = || start(dir.path(), &out, &FIXTURE, &["sh", "-c", &script]).spawn().unwrap();
        let mut both = [begin(), begin()];
        let since = Instant::now();
        let loser = loop {
            let ended = both.iter_mut().position(|child| child.try_wait().unwrap().is_some());
            if let Some(index) = ended {
                break index;
            }
            assert!(since.elapsed() < PATIENCE, "race {race}: both run");
            thread::sleep(Duration::from_millis(1));
        };
        fs::write(dir.path().join(format!("go-{race}")), "").unwrap();
        let [a, b] = both.map(|child| child.wait_with_output().unwrap());
        let (winner, loser) = if loser == 0 { (b, a) } else { (a, b) };
        assert_eq!(winner.status.code(), Some(0), "race {race}: {}", message(&winner));
        assert_eq!(winner.stdout, b"ran\n");
        refused(&loser, &[&out, "is in use by", "give another out"]);
        assert!(loser.stdout.is_empty(), "race {race}: both ran");
    }
}

#[test]
fn the_holder_is_named_and_signals_reach_the_command() {
    for signal in ["INT", "TERM", "KILL"] {
        let dir = bench();
        let command = ["sh", "-c", "touch holding; exec sleep 600"];
        let stage = start(dir.path(), "out", &FIXTURE, &command).spawn().unwrap();
        wait_for(&dir.path().join("holding"));
        // The process that holds the directory is the command itself.
        let name = format!("process {} (sh -c 'touch holding; exec sleep 600')", stage.id());
        refused(&run(dir.path(), "out", &FIXTURE, &["true"]), &["out is in use by", &name]);
        kill(signal, stage.id());
        let ended = stage.wait_with_output().unwrap();
        assert_eq!(ended.status.code(), None, "{signal}: not ended by the signal");
        let next = run(dir.path(), "out", &FIXTURE, &["true"]);
        assert_eq!(next.status.code(), Some(0), "after {signal}: {}", message(&next));
    }
}

#[test]
fn a_stage_that_outlives_a_killed_run_keeps_the_directory_until_it_ends() {
    let dir = bench();
    let stage = "touch stage-runs; until [ -e go ]; do sleep 0.01; done";
    fs::write(dir.path().join("stage"), stage).unwrap();
    let stages = start(dir.path(), "out", &FIXTURE, &["sh", "-c", "sh ./stage; true"])
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    wait_for(&dir.path().join("stage-runs"));
    kill("KILL", stages.id());
    stages.wait_with_output().unwrap();
    refused(&run(dir.path(), "out", &FIXTURE, &["true"]), &["is in use"]);
    fs::write(dir.path().join("go"), "").unwrap();
    wait_until_free(dir.path());
}

fn kill(signal: &str, process: u32) {
    let status = Command::new("kill").args([&format!("-{signal}"), &process.to_string()]).status();
    assert!(status.unwrap().success());
}

#[test]
fn the_verdict_is_that_on_the_plan_and_on_what_it_is_made_of() {
    let dir = tempfile::tempdir().unwrap();
    let artifact = |path: &str, outcome: serde_json::Value| {
        let at = dir.path().join("run").join(path);
        fs::create_dir_all(&at).unwrap();
        let manifest = json!({
            "kind": "dwell", "version": 1, "tool": "planish-stage", "tool_version": "0", "method": "m",
            "command": "", "key": "", "frame": "", "settings": {}, "inputs": [], "outcome": outcome,
            "arrays": {},
        });
        fs::write(at.join("manifest.json"), manifest.to_string()).unwrap();
    };
    let verdict = |plans: &[&str]| {
        let mut command = planish_testkit::program::stage(PROGRAM);
        command.current_dir(dir.path()).args(["verdict", "--run", "run"]);
        command.args(plans.iter().map(|plan| format!("--plan={plan}"))).output().unwrap()
    };
    artifact("surface", json!({"status": "done"}));
    artifact("methods/pvt/verdict", json!({"status": "done"}));
    artifact("methods/ideal/verdict", json!({"status": "negative", "reason": "it jumps"}));
    fs::write(dir.path().join("run/run.lock"), "").unwrap();
    let ended = verdict(&["methods/pvt"]);
    assert_eq!((ended.status.code(), message(&ended).as_str()), (Some(0), ""));
    assert_eq!(verdict(&["methods/ideal"]).status.code(), Some(1));

    artifact("dwell", json!({"status": "negative", "reason": "not certified"}));
    let ended = verdict(&["methods/pvt"]);
    assert_eq!(ended.status.code(), Some(1));
    assert_eq!(message(&ended), "verdict: run/dwell (planish stage): not certified\n");
    let both = message(&verdict(&["methods/pvt", "methods/ideal"]));
    assert!(
        both.contains("not certified; run/methods/ideal/verdict (planish stage): it jumps"),
        "{both}"
    );
    refused(&verdict(&["methods/none"]), &["run/methods/none", "cannot read"]);
}

/// Checks that a run with other settings that is killed, and leaves its own artifacts beside older ones, has no
/// verdict. Otherwise the verdict would be that of another plan.
#[test]
fn a_run_that_was_ended_between_its_stages_has_no_verdict() {
    let dir = tempfile::tempdir().unwrap();
    let run = dir.path().join("run");
    // Each artifact has its content in its outcome, and names what it was made of by place and content.
    let content =
        |name: &str, version: u32| json!({"status": "done", "of": name, "version": version});
    let made = |name: &str, version: u32, machine: u32, from: &[(&str, u32)]| {
        let at = run.join(name);
        fs::create_dir_all(&at).unwrap();
        let mut inputs: Vec<_> = from
            .iter()
            .map(|(from, version)| {
                let hash = blake3::hash(content(from, *version).to_string().as_bytes());
                json!({"role": "r", "path": format!("elsewhere/{from}"), "kind": "verdict", "blake3": hash.to_string()})
            })
            .collect();
        inputs.push(json!({
            "role": "machine", "path": "m.json", "kind": "file", "blake3": machine.to_string(),
        }));
        let manifest = json!({
            "kind": "verdict", "version": 1, "tool": "planish-stage", "tool_version": "0", "method": "m",
            "command": format!("planish-stage --out elsewhere/{name} --force"), "key": "", "frame": "",
            "settings": {}, "inputs": inputs, "outcome": content(name, version), "arrays": {},
        });
        fs::write(at.join("manifest.json"), manifest.to_string()).unwrap();
    };
    let stages: [(&str, &[&str]); 7] = [
        ("surface", &[]),
        ("tool_path", &["surface"]),
        ("dwell", &["tool_path"]),
        ("methods/pvt/trajectory", &["tool_path", "dwell"]),
        ("methods/pvt/removal", &["methods/pvt/trajectory", "surface"]),
        ("methods/pvt/verdict", &["methods/pvt/trajectory"]),
        ("report", &["methods/pvt/removal", "methods/pvt/verdict"]),
    ];
    let make = |stages: &[(&str, &[&str])], version: u32, machine: u32| {
        for (name, from) in stages {
            let from: Vec<_> = from.iter().map(|from| (*from, version)).collect();
            made(name, version, machine, &from);
        }
    };
    let verdict = || {
        let mut command = planish_testkit::program::stage(PROGRAM);
        command.current_dir(dir.path()).args(["verdict", "--run", "run", "--plan=methods/pvt"]);
        command.output().unwrap()
    };
    make(&stages, 1, 1);
    assert_eq!(verdict().status.code(), Some(0), "{}", message(&verdict()));
    // A second run is ended after each of its stages; what another run leaves beside the plan is none of it.
    for done in 1..stages.len() {
        make(&stages, 1, 1);
        made("methods/old/trajectory", 0, 0, &[("dwell", 0)]);
        made("tolerance", 0, 0, &[("methods/old/trajectory", 7)]);
        make(&stages[..done], 2, 1);
        refused(&verdict(), &["run: ", "was made from another", "run the pipeline again"]);
    }
    make(&stages, 2, 1);
    assert_eq!(verdict().status.code(), Some(0), "{}", message(&verdict()));
    // The same arrays, judged by another machine.
    make(&stages[..5], 2, 2);
    refused(&verdict(), &["were made with different machine files", "left over from an older run"]);
    make(&stages, 2, 2);
    fs::remove_dir_all(run.join("methods/pvt/verdict")).unwrap();
    refused(&verdict(), &["report was made from methods/pvt/verdict, which is not there"]);
    fs::remove_dir_all(run.join("report")).unwrap();
    refused(&verdict(), &["methods/pvt has no verdict"]);
    make(&stages, 2, 2);
    fs::remove_dir_all(run.join("dwell")).unwrap();
    refused(&verdict(), &["methods/pvt/trajectory was made from dwell, which is not there"]);
}

#[test]
fn the_program_is_named_with_its_plan_and_the_plan_that_is_recommended() {
    let dir = tempfile::tempdir().unwrap();
    let said = |of: &str| {
        let flags = ["program", "--run", "run", "--of", of, "--controller", "galil"];
        let ended = planish_testkit::program::stage(PROGRAM)
            .current_dir(dir.path())
            .args(flags)
            .output()
            .unwrap();
        let text = [&ended.stdout[..], &ended.stderr[..]].concat();
        (ended.status.code(), String::from_utf8(text).unwrap())
    };
    let (code, text) = said("pvt");
    assert!(code == Some(2) && text.contains("run the report first"), "{text}");
    fs::create_dir_all(dir.path().join("run/report")).unwrap();
    let summary = |method: serde_json::Value| {
        let summary =
            json!({"answer": {"method": method, "why": "It is the least."}, "best": method});
        fs::write(dir.path().join("run/report/summary.json"), summary.to_string()).unwrap();
    };
    for best in ["pvt", "pvt+galil"] {
        summary(json!(best));
        let (code, text) = said("pvt");
        let expected = "the one that the report recommends: It is the least.";
        assert!(code == Some(0) && text.contains(expected), "{text}");
        assert!(text.contains("run/program.galil is of the plan pvt; pvt+galil is that"), "{text}");
    }
    summary(json!("joint"));
    let (code, text) = said("pvt");
    assert!(code == Some(0) && text.contains("give program_of=joint"), "{text}");
    summary(json!(null));
    assert!(said("pvt").1.contains("recommends no plan of this run: It is the least."));
}

/// Writes a script that can be run.
fn write_script(file: &Path, script: &str) {
    use std::os::unix::fs::PermissionsExt;
    fs::write(file, script).unwrap();
    fs::set_permissions(file, fs::Permissions::from_mode(0o755)).unwrap();
}

/// Creates programs that write their arguments to the file `log`, one line each, and end with the code in
/// `codes/PROGRAM`. In a rehearsal they write them to the file `rehearsed`, say which flags are settings, and end with
/// the code in `codes/PROGRAM.rehearsed`.
fn recorders(dir: &Path) -> std::path::PathBuf {
    let programs = dir.join("programs");
    fs::create_dir(&programs).unwrap();
    for name in [
        "fixture", "surface", "tool", "toolpath", "dwell", "schedule", "simulate", "verify",
        "compare", "run", "export", "import",
    ] {
        let script = "#!/bin/sh\nname=${0##*/}\n\
                      if [ -n \"$PLANISH_REHEARSAL\" ]; then\n\
                      echo \"$name $*\" >> rehearsed; echo \"$PLANISH_SETTINGS_OF_FLAGS\" >&2\n\
                      [ ! -f \"codes/$name.rehearsed\" ] || exit \"$(cat \"codes/$name.rehearsed\")\"\n\
                      exit 0; fi\nprintf '%s' \"$name\" >> log\nprintf '<%s>' \"$@\" >> log\necho >> log\n\
                      [ ! -f \"codes/$name\" ] || exit \"$(cat \"codes/$name\")\"\n";
        write_script(&programs.join(format!("planish-{name}")), script);
    }
    fs::create_dir(dir.join("codes")).unwrap();
    programs
}

/// Runs `planish-run` with the pipelines of this repository and the programs of [`recorders`]. Returns its output, and
/// the commands that it ran, one line each.
fn recorded(dir: &Path, arguments: &[&str]) -> (Output, Vec<String>) {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).ancestors().nth(2).unwrap();
    let mut command = planish_testkit::program::stage(PROGRAM);
    command.current_dir(dir).args(arguments);
    command.env("PLANISH_SHARE", root).env("PLANISH_PROGRAMS", dir.join("programs"));
    let ended = command.output().unwrap();
    let log = fs::read_to_string(dir.join("log")).unwrap_or_default();
    let _ = fs::remove_file(dir.join("log"));
    (ended, log.lines().map(String::from).collect())
}

/// Settings of the quickest pipeline: no closed loop, no joint plan, no pictures.
const QUICK: [&str; 6] =
    ["run", "raster", "machine=machine.json", "refine=no", "plan_joint=no", "frames=0"];

#[test]
fn every_command_is_printed_as_it_runs_and_a_setting_is_one_argument() {
    let dir = bench();
    recorders(dir.path());
    let hostile = "it's; $(touch PWNED) `touch PWNED` {{ x }} *";
    fs::rename(dir.path().join("mirror"), dir.path().join(hostile)).unwrap();
    let settings = [format!("surface={hostile}"), "tif=tool".into(), format!("out={hostile}.out")];
    let settings: Vec<&str> = settings.iter().map(String::as_str).collect();
    let (ended, log) = recorded(dir.path(), &[&QUICK[..], &settings].concat());
    let text = message(&ended);
    assert_eq!(ended.status.code(), Some(0), "{text}");
    let first = format!(
        "planish-surface<prepare><--surface><{hostile}><--level><none><--out><{hostile}.out/import/surface><--force>"
    );
    assert_eq!(log[0], first);
    // What is printed runs again in a shell, with the same arguments.
    let printed: Vec<&str> = text.lines().filter(|line| line.starts_with("planish ")).collect();
    assert_eq!(printed.len(), log.len(), "{text}");
    // The one program, as a caller of the recorders.
    let planish = dir.path().join("programs/planish");
    let script = "#!/bin/sh\ncase $1 in verdict | program) ;; *) stage=$1; shift ;; esac\n\
                  exec planish-${stage:-run} \"$@\"\n";
    write_script(&planish, script);
    let path =
        format!("{}:{}", dir.path().join("programs").display(), std::env::var("PATH").unwrap());
    for (line, called) in printed.iter().zip(&log) {
        let copied = Command::new("sh")
            .args(["-c", line])
            .current_dir(dir.path())
            .env("PATH", &path)
            .status();
        assert!(copied.unwrap().success(), "{line}");
        assert_eq!(
            fs::read_to_string(dir.path().join("log")).unwrap().trim_end(),
            called,
            "{line}"
        );
        fs::remove_file(dir.path().join("log")).unwrap();
    }
    assert!(!dir.path().join("PWNED").exists());
}

#[test]
fn a_negative_verdict_lets_a_run_go_on_and_a_refusal_ends_it() {
    let dir = bench();
    recorders(dir.path());
    let settings = [&QUICK[..], &["fixture=coupon", "out=o"]].concat();
    let (ended, whole) = recorded(dir.path(), &settings);
    assert_eq!(ended.status.code(), Some(0), "{}", message(&ended));
    for (program, own, code, commands) in [
        ("planish-verify", "1", 0, whole.len()),
        ("planish-toolpath", "1", 1, 3),
        ("planish-dwell", "2", 2, 4),
        ("planish-simulate", "7", 2, 6),
        ("planish-run", "1", 1, whole.len()),
    ] {
        fs::write(dir.path().join("codes").join(program), own).unwrap();
        let (ended, log) = recorded(dir.path(), &settings);
        assert_eq!((ended.status.code(), log.len()), (Some(code), commands), "{program}: {log:?}");
        fs::remove_file(dir.path().join("codes").join(program)).unwrap();
    }
    // One stage, with the same settings.
    let stage = [
        "stage",
        "raster",
        "path",
        "machine=machine.json",
        "fixture=coupon",
        "out=o",
        "pitch_mm=2",
    ];
    let (ended, log) = recorded(dir.path(), &stage);
    assert_eq!(ended.status.code(), Some(0), "{}", message(&ended));
    assert!(
        log.len() == 1 && log[0].contains("<raster>") && log[0].contains("<--pitch-mm=2>"),
        "{log:?}"
    );
}

#[test]
fn a_signal_to_the_run_alone_ends_its_stage_and_frees_the_directory() {
    for (signal, number) in [("TERM", 15), ("INT", 2), ("HUP", 1)] {
        let dir = bench();
        let programs = recorders(dir.path());
        let settings = [&QUICK[..], &["fixture=coupon", "out=o"]].concat();
        // A stage that would go on for ten minutes.
        let stage = programs.join("planish-toolpath");
        fs::write(&stage, "#!/bin/sh\n[ -z \"$PLANISH_REHEARSAL\" ] || exit 0\necho $$ > stage.new\nmv stage.new stage\nexec sleep 600\n")
            .unwrap();
        let root = Path::new(env!("CARGO_MANIFEST_DIR")).ancestors().nth(2).unwrap();
        let mut command = planish_testkit::program::stage(PROGRAM);
        command.current_dir(dir.path()).args(&settings);
        command.env("PLANISH_SHARE", root).env("PLANISH_PROGRAMS", &programs);
        let run = command.stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
        wait_for(&dir.path().join("stage"));
        let of_stage = fs::read_to_string(dir.path().join("stage")).unwrap();
        kill(signal, run.id());
        let ended = run.wait_with_output().unwrap();
        assert_eq!(ended.status.signal(), Some(number), "{signal}: {:?}", ended.status);
        let alive =
            Command::new("kill").args(["-0", of_stage.trim()]).stderr(Stdio::null()).status();
        assert!(!alive.unwrap().success(), "{signal}: the stage goes on");
        // No command of the stages that follow has run, and another run may have the directory.
        let log = fs::read_to_string(dir.path().join("log")).unwrap();
        assert!(!log.contains("planish-dwell"), "{log}");
        let next = ["--fixture", "fixtures/coupon.json"];
        let next = start(dir.path(), "o", &next, &["true"]).output().unwrap();
        assert_eq!(next.status.code(), Some(0), "after {signal}: {}", message(&next));
    }
}

#[test]
fn a_wrong_setting_is_named_with_the_remedy_and_nothing_runs() {
    let dir = bench();
    recorders(dir.path());
    for (arguments, said) in [
        (&["run", "rastr"][..], "no pipeline 'rastr'; there are: bspline compare-dwell line maze"),
        (
            &["run", "raster", "pitch=1"],
            "raster has no setting 'pitch'; there are: bound date error_budget",
        ),
        (&["run", "raster", "--dry-run"], "'--dry-run' is not a setting; write NAME=VALUE"),
        (&["run", "raster", "pitch_mm=-1"], "pitch_mm is '-1'; give a number above 0"),
        (&["run", "raster", "passes=0"], "passes is '0'; give a whole number from 1 to 99"),
        (
            &["run", "raster", "export=x"],
            "export is 'x'; give galil, xps, xps-pt, pmac, gcode, csv, ros, aerotech, automation1, sinumerik, \
             sinumerik-poly, twincat or zaber, or nothing",
        ),
        (&["run", "raster", "prepare=--a 'b"], "prepare=--a 'b: the quotation mark ' at byte 4"),
        (&["run", "bspline", "refine=yes"], "the pipeline bspline corrects no dwell times"),
        (&["run", "raster", "program_of=pvt"], "give a controller too (export=galil)"),
        (&["run", "raster", "machine=none.json"], "none.json: cannot read"),
        (
            &["stage", "raster", "pth", "machine=machine.json"],
            "raster has no stage 'pth'; there are:",
        ),
        (&["campaign", "runs=0"], "runs is '0'; give 1 to 99"),
        (&["next-run", "before=none"], "before none is not there"),
        (&["compare", "coupon", "skip=x"], "leave it out for one mirror"),
        (&["compare", "all", "surface=mirror"], "leave surface and tif out, or all"),
        (&["tolerance", "foo"], "'foo' is no pipeline and no setting"),
        (
            &["run", "raster", "pitch_mm=2", "pitch_mm=3"],
            "pitch_mm is given twice, as '2' and as '3'",
        ),
        (&["stage", "raster", "path", "out=a", "out=a"], "out is given twice, as 'a' and as 'a'"),
        (&["compare", "coupon", "pitch_mm=2", "pitch_mm=3"], "pitch_mm is given twice"),
        (&["compare", "coupon", "disk"], "'disk' is one word too many beside 'coupon'"),
        (&["compare", "coupon", "fixture=disk"], "'coupon' is one word too many beside 'disk'"),
        (&["compare", "coupon", "export=galil"], "a comparison writes no programs"),
        (&["tolerance", "raster", "out=a", "out=b"], "out is given twice, as 'a' and as 'b'"),
        (&["campaign", "coupon", "seed=1", "seed=2"], "seed is given twice, as '1' and as '2'"),
        (&["campaign", "coupon", "disk"], "'disk' is one word too many beside 'coupon'"),
        (&["campaign-spread", "seeds=1", "seeds=2"], "seeds is given twice, as '1' and as '2'"),
        (&["next-run", "tif=a", "tif=b"], "tif is given twice, as 'a' and as 'b'"),
    ] {
        let (ended, log) = recorded(dir.path(), arguments);
        refused(&ended, &[said]);
        assert!(log.is_empty() && !dir.path().join("out").exists(), "{arguments:?}");
    }
}

#[test]
fn a_program_for_an_own_part_needs_a_machine_that_somebody_named() {
    let dir = bench();
    recorders(dir.path());
    let own = ["surface=mirror", "tif=tool"];
    let quick = ["refine=no", "plan_joint=no", "frames=0", "out=o"];
    let remedy = "Give machine=FILE with the limits of your machine";
    for pipeline in
        ["raster", "maze", "spiral", "multi-pitch", "random-adaptive", "bspline", "trig-spline"]
    {
        let settings = [&["run", pipeline, "export=galil", "out=o"], &own[..]].concat();
        let (ended, log) = recorded(dir.path(), &settings);
        refused(&ended, &["export=galil writes a program for the machine", remedy]);
        assert!(log.is_empty() && !dir.path().join("o").exists(), "{pipeline}");
    }
    let line = ["run", "line", "export=galil", "profile=mirror", "tif=tool", "out=o"];
    refused(&recorded(dir.path(), &line).0, &[remedy]);
    // A form or a tool of the user is his own part, too, on a mirror of the fixtures.
    for own in ["form=machine.json", "varying=tool-time --table x"] {
        let settings = ["run", "raster", "fixture=coupon", "export=galil", "out=o", own];
        refused(&recorded(dir.path(), &settings).0, &[remedy]);
    }
    // Without a program, the run says which machine it took: at its start, in its last line, and in the report.
    let settings = [&["run", "raster"], &own[..], &quick].concat();
    let (ended, log) = recorded(dir.path(), &settings);
    let text = message(&ended);
    assert_eq!(ended.status.code(), Some(0), "{text}");
    let warning =
        "warning: no machine was named, so this is planned for ion-beam, a machine of the fixtures";
    let lines: Vec<&str> = text.lines().filter(|line| !line.starts_with("planish ")).collect();
    assert!(lines[0].starts_with(warning) && lines[lines.len() - 1].starts_with(warning), "{text}");
    let report = log.iter().find(|line| line.starts_with("planish-compare<report>")).unwrap();
    assert!(report.contains("<--assumed-machine=ion-beam>"), "{report}");
    // With a machine of the user, and on a mirror of the fixtures, nothing is said.
    for named in [&["machine=machine.json"][..], &["fixture=coupon"]] {
        let own = if named[0].starts_with("machine") { &own[..] } else { &[] };
        let settings =
            [&["run", "raster"], named, own, &quick[..3], &["out=p", "export=csv"]].concat();
        let (ended, log) = recorded(dir.path(), &settings);
        assert!(!message(&ended).contains("no machine was named"), "{}", message(&ended));
        assert!(log.iter().all(|line| !line.contains("assumed-machine")), "{log:?}");
        fs::remove_dir_all(dir.path().join("p")).unwrap();
    }
}

#[test]
fn a_mistake_in_a_late_stage_is_found_before_the_run_and_names_the_setting() {
    let dir = bench();
    recorders(dir.path());
    fs::write(dir.path().join("codes/planish-export.rehearsed"), "2").unwrap();
    let own =
        ["fixture=coupon", "out=o", "export=galil", "export_settings=--always-on --count-mm=1"];
    let (ended, log) = recorded(dir.path(), &[&QUICK[..], &own].concat());
    let text = message(&ended);
    assert_eq!(ended.status.code(), Some(2), "{text}");
    // The stub says what it was told of its flags.
    for line in [
        "--always-on\texport_settings=--always-on",
        "--count-mm\texport_settings=--count-mm",
        "--machine\tmachine",
        "--out\tout",
        "\texport_settings",
    ] {
        assert!(text.lines().any(|found| found == line), "no {line:?} in {text}");
    }
    assert!(log.is_empty() && !dir.path().join("o").exists(), "{log:?}");
    let rehearsed = fs::read_to_string(dir.path().join("rehearsed")).unwrap();
    assert!(
        rehearsed.contains("planish-export galil") && rehearsed.contains("--machine machine.json")
    );
    // One that passes is tried again when mirror, tool and tool path are there, and then the run begins.
    fs::remove_file(dir.path().join("codes/planish-export.rehearsed")).unwrap();
    fs::remove_file(dir.path().join("rehearsed")).unwrap();
    let (ended, _) = recorded(dir.path(), &[&QUICK[..], &own].concat());
    let rehearsed = fs::read_to_string(dir.path().join("rehearsed")).unwrap();
    assert_eq!(rehearsed.matches("planish-export galil").count(), 2, "{rehearsed}");
    assert!(message(&ended).contains("planish dwell bounded-least-squares"));
}

/// Checks that a pipe in place of the report is refused; to read it would never end.
#[cfg(unix)]
#[test]
fn a_pipe_in_the_place_of_the_report_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    fs::create_dir_all(dir.path().join("run/report")).unwrap();
    let pipe = dir.path().join("run/report/summary.json");
    assert!(Command::new("mkfifo").arg(&pipe).status().unwrap().success());
    let flags = ["program", "--run", "run", "--of", "pvt", "--controller", "galil"];
    let mut program = planish_testkit::program::stage(PROGRAM);
    program.current_dir(dir.path()).args(flags).stderr(Stdio::piped());
    let mut child = program.spawn().unwrap();
    let ends = (0..200).find_map(|_| {
        thread::sleep(Duration::from_millis(50));
        child.try_wait().unwrap()
    });
    if ends.is_none() {
        child.kill().unwrap();
    }
    let said = message(&child.wait_with_output().unwrap());
    assert!(ends.is_some_and(|s| s.code() == Some(2)) && said.contains("is not a file"), "{said}");
}

/// Checks that no setting may name an input inside the output directory, where a stage could delete it.
#[test]
fn no_setting_names_an_input_inside_of_the_output() {
    let dir = bench();
    recorders(dir.path());
    let at = |name: &str| dir.path().join(name);
    fs::create_dir_all(at("o/tool_path")).unwrap();
    fs::write(at("o/run.json"), r#"{"pipeline":"compare-dwell","mirror":{"fixture":"coupon"}}"#)
        .unwrap();
    for file in ["point_mm.npy", "manifest.json", "x.json"] {
        fs::write(at("o/tool_path").join(file), file).unwrap();
    }
    std::os::unix::fs::symlink("o/tool_path", at("link")).unwrap();
    fs::create_dir(at("elsewhere/path")).unwrap();
    std::os::unix::fs::symlink("../elsewhere/path", at("o/outside")).unwrap();
    let quick = ["machine=machine.json", "fixture=coupon", "out=o"];
    for (pipeline, setting) in [
        ("compare-dwell", "path=o/tool_path"),
        ("compare-dwell", "path=link"),
        ("compare-dwell", "path=elsewhere/../o/./tool_path/"),
        ("compare-dwell", "path=o/outside"),
        ("compare-dwell", "path=o/none"),
        ("compare-dwell", "machine=o/tool_path/x.json"),
        ("compare-dwell", "prepare=--level plane --reference link/x.json"),
        ("compare-dwell", "prepare=--reference=o/tool_path/x.json"),
        ("raster", "specification=o/tool_path/x.json"),
        ("raster", "error_budget=link/x.json"),
        ("raster", "form=o/tool_path"),
        ("raster", "varying=tool-rate --map 'o/tool_path'"),
    ] {
        let (ended, log) =
            recorded(dir.path(), &[&["run", pipeline], &quick[..], &[setting]].concat());
        let said = message(&ended);
        assert_eq!(ended.status.code(), Some(2), "{setting}: {said}");
        assert!(log.is_empty(), "{setting}: {log:?}");
        if setting != "machine=o/tool_path/x.json" {
            assert!(
                said.contains("out o") && said.contains("give another out"),
                "{setting}: {said}"
            );
        }
    }
    for file in ["point_mm.npy", "manifest.json", "x.json"] {
        assert_eq!(fs::read_to_string(at("o/tool_path").join(file)).unwrap(), file);
    }
    // A word of a flag that names nothing inside, and the time of a stage, which is an output
    fs::create_dir(at("o/wall")).unwrap();
    let prepare = "prepare=--level plane --wall-time o/wall";
    let (ended, log) =
        recorded(dir.path(), &[&["run", "compare-dwell"], &quick[..], &[prepare]].concat());
    assert!(!log.is_empty(), "{}", message(&ended));
}

/// Checks that a tool path is read where it is, and that a link to it in the directory of the run remains.
#[test]
fn a_path_that_the_output_leads_to_is_not_touched() {
    let dir = bench();
    recorders(dir.path());
    fs::create_dir_all(dir.path().join("o")).unwrap();
    fs::create_dir(dir.path().join("path")).unwrap();
    fs::write(dir.path().join("path/point_mm.npy"), "mine").unwrap();
    std::os::unix::fs::symlink("../path", dir.path().join("o/tool_path")).unwrap();
    fs::write(
        dir.path().join("o/run.json"),
        r#"{"pipeline":"compare-dwell","mirror":{"fixture":"coupon"}}"#,
    )
    .unwrap();
    let settings =
        ["run", "compare-dwell", "fixture=coupon", "machine=machine.json", "path=path", "out=o"];
    let (ended, log) = recorded(dir.path(), &settings);
    assert_eq!(ended.status.code(), Some(0), "{}", message(&ended));
    assert!(log.iter().all(|line| !line.starts_with("planish-toolpath")), "{log:?}");
    let reads = |program: &str| {
        let mut lines = log.iter().filter(|line| line.starts_with(program));
        lines.all(|line| line.contains("<--tool-path><path>"))
    };
    assert!(reads("planish-dwell") && reads("planish-schedule") && reads("planish-compare"));
    assert_eq!(fs::read_to_string(dir.path().join("path/point_mm.npy")).unwrap(), "mine");
}

#[test]
fn a_solver_that_is_left_out_has_no_command() {
    let dir = bench();
    recorders(dir.path());
    let settings = [
        "run",
        "compare-dwell",
        "fixture=coupon",
        "machine=machine.json",
        "skip=nnls udo",
        "out=o",
    ];
    let (ended, log) = recorded(dir.path(), &settings);
    assert_eq!(ended.status.code(), Some(0), "{}", message(&ended));
    let has = |words: &str| log.iter().any(|line| line.contains(words));
    assert!(!has("o/solvers/nnls/") && !has("o/solvers/udo/") && has("o/solvers/udo-shift/"));
    assert!(has("<--skip=nnls udo>"), "{log:?}");
}

#[test]
fn the_page_of_a_comparison_has_the_name_of_the_part_that_was_given() {
    let dir = bench();
    recorders(dir.path());
    let own = ["compare", "surface=mirror", "tif=tool", "machine=machine.json", "part_name=M1"];
    for (words, name) in [(&own[..], "mirror"), (&["compare", "coupon", own[3]], "coupon")] {
        let (ended, log) = recorded(dir.path(), words);
        assert_eq!(ended.status.code(), Some(0), "{}", message(&ended));
        let page = log.last().unwrap();
        for word in [format!("<--mirror={name}>"), format!("<out/compare/{name}/report>")] {
            assert!(page.contains(&word), "{page}");
        }
        assert_eq!(page.contains("<--part-name=M1>"), name == "mirror", "{page}");
    }
}

#[test]
fn a_link_or_a_pipe_is_not_written_in_the_directory_of_a_run() {
    let dir = bench();
    fs::write(dir.path().join("mine"), "mine").unwrap();
    fs::create_dir(dir.path().join("o")).unwrap();
    std::os::unix::fs::symlink("../mine", dir.path().join("o/run.lock")).unwrap();
    refused(&run(dir.path(), "o", &FIXTURE, &["true"]), &["o/run.lock is not a regular file"]);
    assert_eq!(fs::read_to_string(dir.path().join("mine")).unwrap(), "mine");
}

/// Checks that a stage that runs itself without end is refused, and that a word of earlier pipelines is refused with
/// its replacement.
#[test]
fn a_pipeline_that_cannot_run_is_refused_before_it_begins() {
    let dir = bench();
    let pipelines = dir.path().join("pipelines");
    fs::create_dir(&pipelines).unwrap();
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).ancestors().nth(2).unwrap();
    fs::copy(root.join("pipelines/shared.yaml"), pipelines.join("shared.yaml")).unwrap();
    for (run, complaint) in [
        ("[path, end, run]", "mine.yaml: stage run: it runs itself without end (run -> run)"),
        ("[path, say it]", "mine.yaml: stage run: 'say it': pipelines have no 'say' any more"),
        ("[path when scan in mode]", "mine.yaml: line 4: run: 'scan in mode' is no condition"),
    ] {
        let text = format!("title: T\nstages:\n  path: []\n  run: {run}\n");
        fs::write(pipelines.join("mine.yaml"), text).unwrap();
        let mut command = planish_testkit::program::stage(PROGRAM);
        command.current_dir(dir.path()).env("PLANISH_SHARE", dir.path());
        command.args(["run", "mine", "fixture=coupon", "machine=machine.json", "out=o"]);
        refused(&command.output().unwrap(), &[complaint]);
        assert!(!dir.path().join("o").exists());
    }
}
