//! `just run` and related commands as a user calls them. `just test-pipelines` runs this file: it needs
//! `just` and the release build. If `just` is not installed, the tests count as skipped.
#![cfg(unix)]

use std::{
    collections::BTreeSet,
    fs,
    path::Path,
    process::{Child, Command, Output, Stdio},
};

use planish_handoff::{
    kind::Dtype,
    npy::{self, ArrayData},
};
use planish_testkit::{hostile, skipped::skip, workspace};
use serde_json::{Value, json};
use tempfile::TempDir;

/// Number of races of two whole runs on one directory. Larger: more time; each run takes seconds. Smaller:
/// fewer chances to find a race. `crates/run/tests/cli.rs` has many races of short commands.
const RACES: usize = 3;

/// Settings of the smallest run: the coupon, no closed loop, no pictures of frames.
const QUICK_RUN: [&str; 3] = ["fixture=coupon", "refine=no", "frames=0"];

/// Returns true if `just` is installed; otherwise counts the test as skipped.
fn just_is_installed() -> bool {
    let there = Command::new("just").arg("--version").output().is_ok();
    if !there {
        skip("`just` is not installed (cargo install --locked --debug just)");
    }
    there
}

/// `just` with these arguments, called by a user who stands in `dir`.
fn just<S: AsRef<str>>(dir: &Path, arguments: &[S]) -> Command {
    let mut command = Command::new("just");
    command.current_dir(dir).arg("--justfile").arg(workspace().join("justfile"));
    command.args(arguments.iter().map(S::as_ref)).stdin(Stdio::null());
    command.stdout(Stdio::piped()).stderr(Stdio::piped());
    command
}

fn run<S: AsRef<str>>(dir: &Path, arguments: &[S]) -> Output {
    just(dir, arguments).output().unwrap()
}

fn text(output: &Output) -> String {
    let (out, err) = (&output.stdout, &output.stderr);
    format!("{}\n{}", String::from_utf8_lossy(out), String::from_utf8_lossy(err))
}

#[track_caller]
fn ended_with(output: &Output, code: i32) -> String {
    let text = text(output);
    assert_eq!(output.status.code(), Some(code), "{text}");
    text
}

/// Names of the entries of `dir`.
fn entries(dir: &Path) -> BTreeSet<String> {
    let entries = fs::read_dir(dir).unwrap();
    entries.map(|e| e.unwrap().file_name().into_string().unwrap()).collect()
}

fn manifest(artifact: &Path) -> Value {
    let text = fs::read_to_string(artifact.join("manifest.json"));
    serde_json::from_str(&text.unwrap_or_else(|e| panic!("{}: {e}", artifact.display()))).unwrap()
}

/// The names of the files in `folder` that end with `.extension`, without it.
fn stems(folder: &str, extension: &str) -> BTreeSet<String> {
    let names = entries(&workspace().join(folder)).into_iter();
    names.filter_map(|n| Some(n.strip_suffix(extension)?.strip_suffix('.')?.to_string())).collect()
}

/// A user's folder with a measured mirror in `mirror` and its tool in `tool`: bare arrays.
fn user(mirror: &str, tool: &str) -> TempDir {
    let dir = tempfile::tempdir().unwrap();
    let made = Command::new(workspace().join("target/release/planish-fixture"))
        .arg(workspace().join("fixtures/coupon.json"))
        .arg("--out")
        .arg(dir.path().join("made"))
        .output()
        .unwrap();
    assert!(made.status.success(), "{}", text(&made));
    for (part, name) in [("surface", mirror), ("tif", tool)] {
        let to = dir.path().join(name);
        fs::create_dir_all(to.parent().unwrap()).unwrap();
        fs::rename(dir.path().join("made").join(part), &to).unwrap();
        fs::remove_file(to.join("manifest.json")).unwrap();
    }
    fs::remove_dir_all(dir.path().join("made")).unwrap();
    fs::copy(workspace().join("fixtures/machines/ion-beam.json"), dir.path().join("machine.json"))
        .unwrap();
    dir
}

#[test]
fn any_characters_of_a_path_reach_the_stages_and_nothing_evaluates_them() {
    if !just_is_installed() {
        return;
    }
    for hostile in [
        "it's; touch PWNED $(touch PWNED2)",
        "a b\tc",
        "\"double\" `touch PWNED`",
        "{{ out }} $HOME ~ * ? [a] \\",
        "line\nend; touch PWNED",
        "-o && touch PWNED #",
        "Größe 面 é",
        "--force",
        "%s'\"'\"'",
    ] {
        let dir = user(hostile, "tool");
        let before = entries(dir.path());
        let out = format!("{hostile}.out");
        let settings = [
            format!("surface={hostile}"),
            "tif=tool".into(),
            "machine=machine.json".into(),
            format!("out={out}"),
            "refine=no".into(),
            "frames=0".into(),
        ];
        let run = [vec!["run".to_string(), "raster".into()], settings.into()].concat();
        let output = just(dir.path(), &run).output().unwrap();
        ended_with(&output, 0);
        let mut after = before;
        after.insert(out.clone());
        assert_eq!(entries(dir.path()), after, "{hostile}");
        let report = manifest(&dir.path().join(&out).join("report"));
        assert_eq!(report["settings"]["fixture"], hostile, "{hostile}");
    }
}

#[test]
fn any_characters_of_a_setting_reach_one_flag() {
    if !just_is_installed() {
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let hostile = "1'; touch PWNED; $(touch PWNED) `touch PWNED` {{ out }}\n--help \"é\"";
    // Each of these is refused by the stage that gets it, which says the value.
    for (pipeline, setting) in [
        ("raster", "pitch_mm"),
        ("raster", "step_mm"),
        ("raster", "overscan_mm"),
        ("raster", "scan"),
        ("raster", "turn"),
        ("raster", "min_dwell_s"),
        ("raster", "min_dwell_s_per_mm"),
        ("raster", "mode"),
        ("maze", "seed"),
        ("maze", "tree"),
        ("maze", "corner_radius_mm"),
        ("random-adaptive", "contrast"),
        ("random-adaptive", "construction"),
        ("multi-pitch", "max_pitch_mm"),
        ("raster", "fixture"),
        ("raster", "machine"),
        ("raster", "refine"),
        ("raster", "export"),
        ("raster", "program_of"),
    ] {
        let given = format!("{setting}={hostile}");
        let output =
            run(dir.path(), &["run", pipeline, "fixture=coupon", "refine=no", "out=o", &given]);
        let text = ended_with(&output, 2);
        assert!(
            text.contains("$(touch PWNED) `touch PWNED` {{ out }}\n--help"),
            "{setting}: {text}"
        );
        let left: Vec<_> = entries(dir.path()).into_iter().filter(|name| name != "o").collect();
        assert!(left.is_empty(), "{setting}: {left:?}");
        let _ = fs::remove_dir_all(dir.path().join("o"));
    }
    // A number below zero is a number, not a flag.
    let text = ended_with(
        &run(dir.path(), &["run", "raster", "fixture=coupon", "out=o", "pitch_mm=-1"]),
        2,
    );
    assert!(text.contains("-1"), "{text}");
}

#[test]
fn flags_in_a_setting_are_taken_apart_as_by_a_shell() {
    if !just_is_installed() {
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let settings = [
        "run",
        "raster",
        "out=o",
        "prepare=--mask-outliers --feature-mm '4'",
        "variant=--line-order  bi-step\n",
    ];
    ended_with(&run(dir.path(), &[&settings[..], &QUICK_RUN].concat()), 0);
    let surface = manifest(&dir.path().join("o/surface"));
    assert!(
        surface["command"].as_str().unwrap().contains("--mask-outliers --feature-mm 4 "),
        "{surface}"
    );
    let path = manifest(&dir.path().join("o/tool_path"));
    assert!(path["command"].as_str().unwrap().contains("--line-order bi-step "), "{path}");
    // A word that a shell would evaluate is a word like any other.
    fs::write(dir.path().join("4"), "").unwrap();
    let settings = ["run", "raster", "out=o", "prepare=--feature-mm $(touch${IFS}PWNED) *"];
    let text = ended_with(&run(dir.path(), &[&settings[..], &QUICK_RUN].concat()), 2);
    assert!(text.contains("unexpected argument '*' found"), "{text}");
    assert_eq!(entries(dir.path()), ["4", "o"].map(String::from).into());
    let settings = ["run", "raster", "out=p", "prepare=--feature-mm '4"];
    let text = ended_with(&run(dir.path(), &[&settings[..], &QUICK_RUN].concat()), 2);
    assert!(text.contains("prepare=--feature-mm '4: the quotation mark"), "{text}");
    assert!(!dir.path().join("p").exists());
}

#[test]
fn what_the_terminal_shows_runs_again_when_it_is_copied() {
    if !just_is_installed() {
        return;
    }
    let dir = user("my mirror's", "tool");
    let settings = [
        "run",
        "raster",
        "surface=my mirror's",
        "tif=tool",
        "machine=machine.json",
        "out=its out",
        "refine=no",
        "export=galil",
    ];
    let first = ended_with(&run(dir.path(), &settings), 0);
    let shown: Vec<&str> = first
        .lines()
        .filter(|line| line.starts_with("planish ") && line.contains("--force"))
        .collect();
    assert!(shown.len() > 12, "{first}");
    // No line does nothing, and none is left out by a colon.
    for line in first.lines() {
        assert!(!line.trim_start().starts_with(':') && line.trim() != "true", "{line}");
    }
    let path = format!(
        "{}:{}",
        workspace().join("target/release").display(),
        std::env::var("PATH").unwrap()
    );
    for line in shown {
        let copied = Command::new("sh")
            .args(["-c", line])
            .current_dir(dir.path())
            .env("PATH", &path)
            .output();
        let copied = copied.unwrap();
        let text = text(&copied);
        // A negative verdict is a result.
        assert!(matches!(copied.status.code(), Some(0 | 1)), "{line}: {text}");
        // An export is written anew, with the same bytes.
        // The report that chooses the plan of a program is made before the one that recommends the program.
        let says_nothing = line.starts_with("planish export")
            || line.contains(" --quiet ")
            || line.contains("--program-row=");
        assert!(text.contains("unchanged") || says_nothing, "{line}: {text}");
    }
}

#[test]
fn a_mistake_names_what_there_is() {
    if !just_is_installed() {
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let pipelines: Vec<_> =
        stems("pipelines", "yaml").into_iter().filter(|p| p != "shared").collect();
    let fixtures: Vec<_> = stems("fixtures", "json").into_iter().collect();
    let text = ended_with(&run(dir.path(), &["run", "rastr"]), 2);
    assert!(text.contains("no pipeline 'rastr'") && text.contains(&pipelines.join(" ")), "{text}");
    let text = ended_with(&run(dir.path(), &["run", "../x; touch PWNED"]), 2);
    assert!(text.contains("no pipeline '../x; touch PWNED'"), "{text}");
    let text = ended_with(&run(dir.path(), &["run", "raster", "fixture=nosuch"]), 2);
    assert!(text.contains("no fixture 'nosuch'") && text.contains(&fixtures.join(", ")), "{text}");
    let text = ended_with(&run(dir.path(), &["run", "raster", "pitch=1"]), 2);
    assert!(text.contains("no setting 'pitch'") && text.contains(" pitch_mm "), "{text}");
    let text = ended_with(&run(dir.path(), &["run", "raster", "--dry-run"]), 2);
    assert!(text.contains("'--dry-run' is not a setting"), "{text}");
    let text = ended_with(&run(dir.path(), &["run", "bspline", "refine=yes"]), 2);
    assert!(text.contains("corrects no dwell times"), "{text}");
    // The machine file is read before anything else is done.
    fs::write(dir.path().join("m.json"), "{}").unwrap();
    let text = ended_with(&run(dir.path(), &["run", "raster", "machine=m.json", "out=o"]), 2);
    assert!(text.contains("m.json") && !text.contains("planish fixture"), "{text}");
    assert_eq!(entries(dir.path()), ["m.json".to_string()].into());

    let list = ended_with(&run(dir.path(), &["--list"]), 0);
    assert!(list.contains(&pipelines.join(", ")) && list.contains(&fixtures.join(", ")), "{list}");
}

/// Numbers of an array on the disk, and its shape.
fn numbers(dir: &Path, name: &str) -> (Vec<usize>, Vec<f64>) {
    let loaded = npy::read(&dir.join(format!("{name}.npy")), Dtype::F64).unwrap();
    let ArrayData::F64(array) = loaded.array else { panic!("{name} is read as f64") };
    (array.shape().to_vec(), array.iter().copied().collect())
}

/// Each of these mistakes took hours of machine time, or made nonsense, without a message before the plan.
#[test]
fn what_is_probably_a_mistake_is_said_before_the_plan() {
    if !just_is_installed() {
        return;
    }
    type Change = fn(&mut [f64], usize);
    let keep: Change = |_, _| {};
    let cases: [(Change, Change, f64, &str); 11] = [
        (keep, keep, 1.0, ""),
        (
            |z, nx| z.iter_mut().enumerate().for_each(|(i, z)| *z += 10.0 * (i % nx) as f64),
            keep,
            1.0,
            "% of the RMS is a plane",
        ),
        (|z, _| z[..2].fill(9999.0), keep, 1.0, "2 pixels lie up to 9950 nm beyond all others"),
        (|z, _| z[..40].fill(0.0), keep, 1.0, "pixels have exactly the height 0 nm"),
        (
            |z, nx| {
                let last = z.len() / nx - 1;
                let edge =
                    |i: usize| i % nx < 3 || i % nx + 3 >= nx || i / nx < 3 || i / nx + 3 > last;
                z.iter_mut().enumerate().filter(|(i, _)| edge(*i)).for_each(|(_, z)| *z = 0.0);
            },
            keep,
            1.0,
            "have exactly the height 0 nm",
        ),
        (|z, _| z.iter_mut().for_each(|z| *z *= 1e-3), keep, 1.0, "heights in um?"),
        (
            |z, nx| {
                z[5 * nx + 5] = 3000.0;
                z[9 * nx + 9] = -3000.0;
            },
            keep,
            1.0,
            "2 pixels lie up to",
        ),
        (keep, |r, _| r.iter_mut().for_each(|r| *r *= 1e-3), 1.0, "rates in um/s"),
        (keep, |r, _| r.iter_mut().for_each(|r| *r *= 60.0), 1.0, "rates in nm/min"),
        (keep, |r, _| r.iter_mut().for_each(|r| *r += 0.5), 1.0, "--subtract-border takes it off"),
        (keep, keep, 1e-3, "limits in m/s?"),
    ];
    for (heights, rates, limits, said) in cases {
        let dir = user("mirror", "tool");
        for (part, name, change) in
            [("mirror", "height_nm", heights), ("tool", "rate_nm_per_s", rates)]
        {
            let at = dir.path().join(part);
            let (shape, mut values) = numbers(&at, name);
            change(&mut values, shape[1]);
            fs::remove_file(at.join(format!("{name}.npy"))).unwrap();
            hostile::npy(&at, name, &shape, &values);
        }
        let machine = dir.path().join("machine.json");
        let mut file: Value = serde_json::from_slice(&fs::read(&machine).unwrap()).unwrap();
        for axis in file["axes"].as_array_mut().unwrap() {
            for key in ["max_velocity_mm_per_s", "max_acceleration_mm_per_s2"] {
                axis[key] = json!(limits * axis[key].as_f64().unwrap());
            }
        }
        fs::write(&machine, file.to_string()).unwrap();
        let settings = ["surface=mirror", "tif=tool", "machine=machine.json", "out=o"];
        let quick = ["refine=no", "frames=0", "plan_joint=no"];
        let ended = run(dir.path(), &[&["run", "raster"], &settings[..], &quick].concat());
        let err = String::from_utf8_lossy(&ended.stderr);
        let before_plan = err.split("planish-dwell").next().unwrap();
        let doubts: Vec<&str> =
            before_plan.lines().filter(|l| l.starts_with("warning: ") && l.contains('?')).collect();
        // Arrays without a manifest are said to be so once each.
        assert_eq!(err.matches("no manifest.json").count(), 2, "{err}");
        match said {
            "" => assert_eq!((doubts, ended.status.code()), (vec![], Some(0)), "{err}"),
            said => assert!(doubts.iter().any(|d| d.contains(said)), "no {said:?} in: {err}"),
        }
        // Where the path was refused there is the map alone.
        let kept: Vec<String> = ["o/surface", "o/tool_path"]
            .map(|at| dir.path().join(at))
            .iter()
            .filter(|at| at.exists())
            .map(|at| manifest(at)["outcome"].to_string().replace("\\\"", "\""))
            .collect();
        assert!(said.is_empty() || kept.iter().any(|k| k.contains(said)), "{kept:?}");
    }
}

#[test]
fn paths_begin_where_the_user_stands() {
    if !just_is_installed() {
        return;
    }
    let dir = user("sub/mirror", "sub/tool");
    let settings = [
        "run",
        "raster",
        "surface=mirror",
        "tif=tool",
        "machine=../machine.json",
        "out=../o",
        "refine=no",
        "frames=0",
    ];
    ended_with(&run(&dir.path().join("sub"), &settings), 0);
    assert!(dir.path().join("o/report/report.html").exists());
    let owner: Value =
        serde_json::from_str(&fs::read_to_string(dir.path().join("o/run.json")).unwrap()).unwrap();
    let here = dir.path().canonicalize().unwrap();
    let absolute = |part: &str| here.join("sub").join(part).display().to_string();
    let measured = json!({"surface": absolute("mirror"), "tif": absolute("tool")});
    assert_eq!(owner, json!({"pipeline": "raster", "mirror": {"measured": measured}}));
    assert_eq!(entries(dir.path()), ["machine.json", "o", "sub"].map(String::from).into());
}

#[test]
fn a_user_s_files_and_another_mirror_s_run_stay_as_they_are() {
    if !just_is_installed() {
        return;
    }
    let dir = user("proj/surface", "proj/tif");
    let before = fs::read(dir.path().join("proj/surface/height_nm.npy")).unwrap();
    let own = ["run", "raster", "surface=proj/surface", "tif=proj/tif", "refine=no", "frames=0"];
    let text = ended_with(&run(dir.path(), &[&own[..], &["out=proj"]].concat()), 2);
    assert!(text.contains("out proj contains the surface"), "{text}");
    let text = ended_with(&run(dir.path(), &["run", "raster", "fixture=coupon", "out=proj"]), 2);
    assert!(text.contains("proj holds surface and no run.json"), "{text}");
    assert_eq!(entries(&dir.path().join("proj")), ["surface", "tif"].map(String::from).into());
    assert_eq!(fs::read(dir.path().join("proj/surface/height_nm.npy")).unwrap(), before);

    // A refined result survives a run without the refinement; another mirror does not take its place.
    let refined = ["run", "raster", "fixture=coupon", "frames=0", "out=o"];
    ended_with(&run(dir.path(), &refined), 0);
    let dwell = dir.path().join("o/methods/pvt+refined/dwell/dwell_s.npy");
    let kept = fs::read(&dwell).unwrap();
    // Motion and times as one problem are what is to be run, and what a program is written of.
    let summary = fs::read(dir.path().join("o/report/summary.json")).unwrap();
    let summary: Value = serde_json::from_slice(&summary).unwrap();
    assert_eq!(summary["best"], "joint", "{}", summary["answer"]);
    let program = ["run", "raster", "fixture=coupon", "frames=0", "export=galil", "out=g"];
    let text = ended_with(&run(dir.path(), &program), 0);
    assert!(text.contains("--plan=methods/joint+galil"), "{text}");
    // The end of the run names the plan of the program, and that it is the one to run, with the reason.
    assert!(text.contains("program: g/program.galil is of the plan joint;"), "{text}");
    assert!(
        text.contains("program: the plan is the one that the report recommends: joint+galil"),
        "{text}"
    );
    let program = fs::read_to_string(dir.path().join("g/program.galil")).unwrap();
    assert!(program.contains("methods/joint/trajectory"), "{program}");
    // The plan that the report marks is exported, whatever it is: the program keeps the limits on every controller.
    for controller in ["gcode", "csv"] {
        let export = format!("export={controller}");
        let out = format!("out={controller}");
        let more = ["plan_joint=yes", export.as_str(), out.as_str(), "frames=0"];
        let text = ended_with(
            &run(dir.path(), &[&["run", "raster", "fixture=coupon"], &more[..]].concat()),
            0,
        );
        assert!(text.contains(&format!("program.{controller} is of the plan joint;")), "{text}");
        let tables = text.matches("raster, coupon: initial surface").count();
        assert_eq!(tables, 1, "the table stands there once: {text}");
        assert!(text.contains(&format!("recommends: joint+{controller}, because")), "{text}");
        assert!(!text.contains("is none for"), "{text}");
    }
    for (more, said) in [
        (
            &["program_of=joint", "plan_joint=no", "export=galil"][..],
            "program_of=joint is not planned here; give plan_joint=yes",
        ),
        (&["program_of=pvt+refined", "export=galil", "refine=no"], "give refine=yes"),
        (&["program_of=pvt"], "give a controller too (export=galil)"),
    ] {
        let text = ended_with(&run(dir.path(), &[&["run", "raster", "out=n"], more].concat()), 2);
        assert!(text.contains(said) && !text.contains("planish fixture"), "{text}");
    }
    ended_with(&run(dir.path(), &[&refined[..], &["refine=no"]].concat()), 0);
    assert_eq!(fs::read(&dwell).unwrap(), kept);
    let text = ended_with(&run(dir.path(), &[&own[..], &["out=o"]].concat()), 2);
    assert!(text.contains("o belongs to another run (pipeline raster, fixture coupon;"), "{text}");
    let text = ended_with(&run(dir.path(), &["run", "maze", "fixture=coupon", "out=o"]), 2);
    assert!(text.contains("this is pipeline maze"), "{text}");
}

#[test]
fn of_whole_runs_at_once_one_wins() {
    if !just_is_installed() {
        return;
    }
    for race in 0..RACES {
        let dir = tempfile::tempdir().unwrap();
        let begin = |pitch: &str| -> Child {
            let settings = [&["run", "raster", "out=o", pitch], &QUICK_RUN[..]].concat();
            just(dir.path(), &settings).spawn().unwrap()
        };
        let both =
            [begin("pitch_mm=1"), begin("pitch_mm=2")].map(|c| c.wait_with_output().unwrap());
        let mut codes: Vec<_> = both.iter().map(|output| output.status.code()).collect();
        let loser = both.iter().find(|output| output.status.code() == Some(2));
        codes.sort();
        assert_eq!(
            codes,
            [Some(0), Some(2)],
            "race {race}: {}\n{}",
            text(&both[0]),
            text(&both[1])
        );
        let loser = text(loser.unwrap());
        assert!(
            loser.contains("o is in use by process") && loser.contains("give another out"),
            "{loser}"
        );
    }
}

#[test]
fn a_negative_verdict_on_the_plan_ends_the_run_with_1_after_the_report() {
    if !just_is_installed() {
        return;
    }
    // The ideals keep no limits, and do not count.
    let dir = tempfile::tempdir().unwrap();
    let settings = [&["run", "raster", "out=o"], &QUICK_RUN[..]].concat();
    let text = ended_with(&run(dir.path(), &settings), 0);
    assert!(text.contains("verdict: x position steps by"), "position keeps no limits: {text}");

    // One sweep is too few for the deconvolution: its feed has not converged. It is judged all the same,
    // and the report is made.
    let settings = [
        "run",
        "bspline",
        "out=b",
        "fixture=coupon",
        "machine=machine.json",
        "pitch_mm=1",
        "step_mm=1",
        "deconvolution=--max-sweeps 1",
    ];
    let machine = workspace().join("fixtures/machines/ion-beam-no-jerk-limit.json");
    fs::copy(machine, dir.path().join("machine.json")).unwrap();
    for _ in 0..2 {
        let text = ended_with(&run(dir.path(), &settings), 1);
        assert!(text.contains("(planish bspline-feed): "), "{text}");
        assert!(text.contains("b/report/report.html"), "the report came first: {text}");
    }
}

#[test]
fn a_prediction_that_does_not_keep_the_specification_ends_the_run_with_1() {
    if !just_is_installed() {
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    // The coupon has 52 nm PV; what remains of it has 1 nm.
    for (nm, code) in [(10.0, 0), (0.1, 1)] {
        let limits = format!(
            r#"{{ "name": "flat", "limits": [ {{ "quantity": "height_pv", "at_most_nm": {nm} }} ] }}"#
        );
        fs::write(dir.path().join("limits of mine.json"), limits).unwrap();
        let settings = ["run", "raster", "specification=limits of mine.json", "out=out"];
        let said = ended_with(&run(dir.path(), &[&settings[..], &QUICK_RUN].concat()), code);
        assert!(said.contains("PV height after plane (nm)"), "{said}");
        assert_eq!(
            said.contains("out/specified/joint/specification (planish surface): 1 of 1"),
            code == 1
        );
        let before = manifest(&dir.path().join("out/specified/before/specification"));
        assert_eq!(before["outcome"]["status"], "negative");
    }
    // Without it the same run is judged by the machine alone.
    let plain = ["run", "raster", "out=out"];
    ended_with(&run(dir.path(), &[&plain[..], &QUICK_RUN].concat()), 0);
    let alone = ["run", "raster", "measured_after=out/surface", "out=out"];
    let said = ended_with(&run(dir.path(), &[&alone[..], &QUICK_RUN].concat()), 2);
    assert!(said.contains("give one too (specification=FILE)"), "{said}");
}

#[test]
fn a_campaign_and_the_next_run_of_a_lab_take_any_names_and_keep_to_their_directory() {
    if !just_is_installed() {
        return;
    }
    let hostile = "it's; touch PWNED $(touch PWNED2) {{ out }}\n\"é\"";
    let dir = user(hostile, "tool");
    let process = workspace().join("fixtures/error-budgets/hidden.json");
    fs::copy(process, dir.path().join("-hidden' errors.json")).unwrap();
    let before = entries(dir.path());
    let out = format!("-{hostile}.out");
    let settings = [
        format!("surface={hostile}"),
        "tif=tool".into(),
        "machine=machine.json".into(),
        "error_budget=-hidden' errors.json".into(),
        format!("out={out}"),
        "refine=no".into(),
        "runs=1".into(),
        "reconcile=--hold  'magnification'".into(),
    ];
    let campaign = [vec!["campaign".to_string()], settings.to_vec()].concat();
    let said = ended_with(&run(dir.path(), &campaign), 0);
    assert!(said.contains("another mirror like it"), "{said}");
    let own = dir.path().join(&out);
    assert_eq!(manifest(&own.join("report"))["settings"]["mirror"], hostile);
    let held = &manifest(&own.join("learning/1/reconciliation"))["settings"]["hold"];
    assert_eq!(*held, json!(["magnification"]));
    // The same campaign again makes the same page, and another mirror does not take its place.
    let page = fs::read(own.join("report/campaign.html")).unwrap();
    ended_with(&run(dir.path(), &campaign), 0);
    assert_eq!(fs::read(own.join("report/campaign.html")).unwrap(), page);
    let said = ended_with(&run(dir.path(), &["campaign", "coupon", &format!("out={out}")]), 2);
    assert!(said.contains("belongs to another run (pipeline campaign, surface"), "{said}");

    let next = [
        "next-run".to_string(),
        format!("before={out}/measured"),
        format!("after={out}/learning/1/measured"),
        format!("trajectory={out}/first/methods/pvt/trajectory"),
        "tif=tool".into(),
        "machine=machine.json".into(),
        // With what was learnt of that run the tool would be known better than as it is.
        "error_budget=-hidden' errors.json".into(),
        "refine=no".into(),
        "out=next $(touch PWNED)".into(),
    ];
    let said = ended_with(&run(dir.path(), &next), 0);
    assert!(said.contains("RUN AGAIN") || said.contains("STOP"), "{said}");
    let own = dir.path().join("next $(touch PWNED)");
    assert_eq!(
        manifest(&own.join("commanded"))["frame"],
        "machine coordinates; the last axis is [x, y]"
    );
    for part in ["reconciliation", "tif", "transform", "verdict", "tolerance", "decision"] {
        assert!(own.join(part).join("manifest.json").exists(), "{part}");
    }
    let mut after = before;
    after.extend([out, "next $(touch PWNED)".into()]);
    assert_eq!(entries(dir.path()), after);
}

#[test]
fn what_is_no_campaign_and_no_next_run_is_refused_and_nothing_is_written() {
    if !just_is_installed() {
        return;
    }
    let dir = user("mirror", "tool");
    let before = entries(dir.path());
    let maps = ["before=mirror", "after=mirror", "trajectory=mirror", "tif=tool"];
    for (words, message) in [
        (vec!["campaign", "nothing"], "no fixture 'nothing'"),
        (vec!["campaign", "runs=0"], "runs is '0'; give 1 to 99"),
        (vec!["campaign", "pipeline=shared"], "'shared' is no pipeline that plans a run"),
        (vec!["campaign", "error_budget=none.json"], "error_budget none.json is no file"),
        (vec!["campaign", "surface=machine.json", "tif=tool"], "read it with planish import"),
        (vec!["campaign", "surface=mirror"], "surface is given without tif"),
        (vec!["campaign", "reconcile=--hold 'x", "out=o"], "the quotation mark"),
        (vec!["campaign", "export=galil"], "leave export out"),
        (vec!["campaign-spread", "seeds=x"], "seeds is 'x'; give 1 to 999"),
        (vec!["next-run"], "before is not given"),
        (vec!["next-run", "mirror"], "'mirror' is no setting"),
        (vec!["next-run", "before=none"], "before none is not there"),
        ([&["next-run"], &maps[..], &["transform=none"]].concat(), "transform none is not there"),
        ([&["next-run"], &maps[..], &["surface=mirror"]].concat(), "leave surface out"),
        ([&["next-run"], &maps[..], &["out=mirror"]].concat(), "is the surface mirror"),
    ] {
        let said = ended_with(&run(dir.path(), &words), 2);
        assert!(said.contains(message), "{words:?}: {said}");
        // What holds a directory is there as soon as something ran in it.
        let left: Vec<_> = entries(dir.path()).difference(&before).cloned().collect();
        assert!(left.is_empty(), "{words:?}: {left:?}");
    }
}

#[test]
fn a_rate_that_depends_on_the_time_and_measured_spots_are_planned() {
    if !just_is_installed() {
        return;
    }
    let dir = user("mirror", "tool");
    fs::write(dir.path().join("warm-up.txt"), "0 1\n100 0.9\n").unwrap();
    let quick = ["machine=machine.json", "refine=no", "plan_joint=no", "frames=0"];
    for (method, flags) in
        [("time", "--table warm-up.txt"), ("tool-spots", "--by x --spot 0=tool --spot 20=tool")]
    {
        let own = [
            "surface=mirror".to_string(),
            "tif=tool".into(),
            format!("varying={method} {flags}"),
            format!("out={method}"),
        ];
        let words = ["run", "raster"].into_iter().chain(quick).map(String::from);
        let words: Vec<String> = words.chain(own).collect();
        ended_with(&run(dir.path(), &words), 0);
        let out = dir.path().join(method);
        // The second name of a command is a word of the setting, too.
        assert_eq!(manifest(&out.join("tool"))["method"], method.trim_start_matches("tool-"));
        let inputs = manifest(&out.join("methods/pvt/removal"))["inputs"].clone();
        let tif = inputs.as_array().unwrap().iter().find(|input| input["role"] == "tif").unwrap();
        assert_eq!(
            (&tif["kind"], &tif["path"]),
            (&json!("tool"), &json!(format!("{method}/tool")))
        );
    }
}

#[test]
fn what_a_controller_cannot_do_is_found_before_hours_of_planning() {
    if !just_is_installed() {
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    for (settings, said) in [
        (&["export=galil", "export_settings=--sample-s 1"][..], "export_settings=--sample-s: is 1"),
        (&["export=galil", "export_settings=--tick-s 1"], "argument 'export_settings=--tick-s'"),
        (
            &["export=pmac", "export_settings=--tool-output 99999"],
            "export_settings=--tool-output: is M99999",
        ),
        (&["error_budget=none.json"], "none.json"),
    ] {
        let words = [&["run", "raster", "fixture=coupon", "out=o"], settings].concat();
        let text = ended_with(&run(dir.path(), &words), 2);
        assert!(text.contains(said) && !text.contains("planish fixture"), "{settings:?}: {text}");
        assert!(entries(dir.path()).is_empty(), "{settings:?}");
    }
    // A path that lifts the tool is known before the dwell times are.
    let lifts = ["run", "multi-pitch", "fixture=coupon", "export=galil", "out=o"];
    let text = ended_with(&run(dir.path(), &lifts), 2);
    let remedy = "Give export_settings=--always-on";
    assert!(text.contains("a galil program cannot switch it") && text.contains(remedy), "{text}");
    assert!(text.contains("planish toolpath") && !text.contains("planish dwell "), "{text}");
}

#[test]
fn the_command_of_a_plan_of_a_sweep_makes_the_same_plan_again() {
    if !just_is_installed() {
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let fixtures = workspace().join("fixtures");
    let sweep = format!(
        "mirror: {{fixture: {0}/coupon.json}}\nmachine: {0}/machines/ion-beam.json\nreports: none\nplans:\n  \
         path: maze\n  pitch_mm: 2\n  seed: 3\n  method: [joint, pvt+refined]\n  time_weight_nm2_per_s: 1e-4\n",
        fixtures.display()
    );
    fs::write(dir.path().join("two.yaml"), sweep).unwrap();
    let planish = |arguments: &[&str]| {
        let program = workspace().join("target/release/planish-sweep");
        let output =
            Command::new(program).args(arguments).current_dir(dir.path()).output().unwrap();
        assert!(output.status.success(), "{arguments:?}: {}", text(&output));
        String::from_utf8(output.stdout).unwrap()
    };
    planish(&["expand", "two.yaml", "--out", "two"]);
    for layer in ["mirror", "paths", "plans"] {
        planish(&["run", "two", "--layer", layer, "--at-once", "2"]);
    }
    let plans = entries(&dir.path().join("two/plans"));
    assert_eq!(plans.len(), 2);
    for plan in plans {
        let command = planish(&["again", "two", &plan]);
        let words = command.trim_end().strip_prefix("planish ").unwrap().split(' ');
        let words: Vec<&str> = words.chain(["frames=0", "out=again"]).collect();
        let ended = run(dir.path(), &words);
        assert!(matches!(ended.status.code(), Some(0 | 1)), "{}", text(&ended));
        let method = if plan.contains("joint") { "joint" } else { "pvt+refined" };
        let motion =
            |run: &str| dir.path().join(run).join("methods").join(method).join("trajectory");
        for array in ["break_time_s.npy", "coefficient_mm.npy"] {
            let [swept, again] = [format!("two/plans/{plan}"), "again".into()]
                .map(|run| fs::read(motion(&run).join(array)).unwrap());
            assert!(swept == again, "{plan}: {array} differs from that of `{command}`");
        }
    }
}
