//! Outputs of a command: whole or not at all, nothing lost, nothing done twice. The runs that are
//! killed are this test program itself, started again as [`child`].

use crate::support;

use std::{
    fs,
    os::unix::fs::symlink,
    path::{Path, PathBuf},
    process::{self, Child, Command, Stdio},
    sync::atomic::{AtomicBool, AtomicUsize, Ordering},
    thread,
    time::Duration,
};

use crate::support::{output, save_f8, surface, tif, write, write_bare};
use planish_handoff::{
    Artifact, Begin, HandoffError, Inputs, Output, OutputFile, Status, Task, Writer, artifact,
    flags::OutputArgs,
    kind::{self, Kind, MANIFEST},
    npy::ArrayData,
};
use planish_types::{DwellTime, Trajectory};
use serde_json::{Value, json};

/// One run of a command: it reads the input, begins the output with the settings, and writes.
struct Run {
    output: OutputArgs,
    input: PathBuf,
    setting: f64,
    status: Status,
}

impl Run {
    fn new(dir: &Path) -> Self {
        let input = dir.join("input");
        if !input.exists() {
            write_bare(&input, &dwell(1.0));
        }
        Self { output: output(&dir.join("out")), input, setting: 1.0, status: Status::Done }
    }

    fn out(mut self, out: impl Into<PathBuf>) -> Self {
        self.output.out = out.into();
        self
    }

    fn force(mut self) -> Self {
        self.output.force = true;
        self
    }

    fn setting(mut self, setting: f64) -> Self {
        self.setting = setting;
        self
    }

    fn negative(mut self, reason: &str) -> Self {
        self.status = Status::Negative(reason.into());
        self
    }

    fn task(&self) -> Task {
        Task::new("test", "0", "scale", json!({ "factor": self.setting }))
    }

    fn inputs(&self) -> Result<Inputs, HandoffError> {
        let mut inputs = Inputs::new();
        inputs.read::<DwellTime>("input", &self.input)?;
        Ok(inputs)
    }

    fn begin(&self) -> Result<Begin, HandoffError> {
        Output::directory(&self.output, DwellTime::KIND).begin(&self.task(), &self.inputs()?)
    }

    /// Begins a run with two directories in `--out`: a (dwell times) and b (a motion).
    fn begin_two(&self) -> Result<Begin, HandoffError> {
        let parts = [("a", DwellTime::KIND), ("b", Trajectory::KIND)];
        Output::directories(&self.output, parts).begin(&self.task(), &self.inputs()?)
    }

    /// Runs the command. Returns `None` if it wrote, and the status of an unchanged output
    /// otherwise.
    fn run(&self) -> Result<Option<Status>, HandoffError> {
        match self.begin()? {
            Begin::Unchanged(status) => Ok(Some(status)),
            Begin::Run(mut output) => {
                output.write(&dwell(self.setting), json!({}), &self.status)?;
                Ok(None)
            }
        }
    }

    fn refused(&self, expected: &str) {
        let message = self.run().unwrap_err().to_string();
        assert!(message.contains(expected), "no {expected:?} in: {message}");
    }
}

/// Returns the status of an output that exists already; panics if there is work to do.
fn unchanged(begin: Begin) -> Status {
    match begin {
        Begin::Unchanged(status) => status,
        Begin::Run(_) => panic!("there is work to do"),
    }
}

/// Returns the writer of a run; panics if there is no work to do.
fn writer(begin: Result<Begin, HandoffError>) -> Writer {
    begin.unwrap().writer().expect("there is work to do")
}

/// Writes an artifact of this kind, made from the inputs.
fn make(out: &Path, kind: &'static Kind, arrays: &[ArrayData], inputs: &Inputs, outcome: Value) {
    let task = Task::new("test", "0", "make", json!({}));
    let mut output = writer(Output::directory(&output(out), kind).begin(&task, inputs));
    output.write_arrays(kind, arrays, &[], outcome, &Status::Done).unwrap();
}

fn dwell(value: f64) -> DwellTime {
    DwellTime::new(vec![value; 4]).unwrap()
}

fn value_in(dir: &Path) -> f64 {
    artifact::read::<DwellTime>(dir).unwrap().value.dwell_s()[0]
}

/// Returns the names of the entries of a directory, sorted.
fn names(dir: &Path) -> Vec<String> {
    let names = fs::read_dir(dir).unwrap().map(|e| e.unwrap().file_name());
    let mut names: Vec<_> = names.map(|n| n.into_string().unwrap()).collect();
    names.sort();
    names
}

/// Returns the path and the content of everything under a directory; the content of a directory is empty.
fn snapshot(dir: &Path) -> Vec<(PathBuf, Vec<u8>)> {
    let mut files = Vec::new();
    for name in names(dir) {
        let path = dir.join(name);
        if path.is_dir() {
            files.push((path.clone(), Vec::new()));
            files.extend(snapshot(&path));
        } else {
            files.push((path.clone(), fs::read(&path).unwrap_or_default()));
        }
    }
    files
}

#[test]
fn an_output_is_replaced_only_by_force_and_not_made_twice() {
    let dir = tempfile::tempdir().unwrap();
    assert_eq!(Run::new(dir.path()).run().unwrap(), None);
    let before = snapshot(dir.path());
    assert_eq!(Run::new(dir.path()).run().unwrap(), Some(Status::Done));
    assert_eq!(Run::new(dir.path()).force().run().unwrap(), Some(Status::Done));
    Run::new(dir.path()).setting(2.0).refused("out: exists, made from other inputs or settings");
    Run::new(dir.path()).setting(2.0).refused("give --force to replace it, or another --out");
    assert_eq!(snapshot(dir.path()), before);
    assert_eq!(Run::new(dir.path()).setting(2.0).force().run().unwrap(), None);
    assert_eq!(value_in(&dir.path().join("out")), 2.0);
    assert_eq!(names(dir.path()), ["input", "out"]);
    assert_eq!(names(&dir.path().join("out")), ["dwell_s.npy", "manifest.json"]);
}

#[test]
fn the_key_follows_inputs_settings_method_and_version() {
    let dir = tempfile::tempdir().unwrap();
    let key = |run: Run, tool_version: &'static str, method: &str| {
        let task = Task::new("test", tool_version, method, json!({ "factor": run.setting }));
        let output = Output::directory(&run.output, DwellTime::KIND);
        if let Some(mut output) = output.begin(&task, &run.inputs().unwrap()).unwrap().writer() {
            output.write(&dwell(1.0), json!({}), &Status::Done).unwrap();
        }
        artifact::read_manifest(&run.output.out, DwellTime::KIND).unwrap().unwrap().key
    };
    let run = || Run::new(dir.path()).force();
    let first = key(run(), "0", "scale");
    assert_eq!(key(run(), "0", "scale"), first);
    // The places of inputs and outputs do not matter.
    fs::rename(dir.path().join("input"), dir.path().join("moved")).unwrap();
    let moved = Run { input: dir.path().join("moved"), ..run() };
    assert_eq!(key(moved.out(dir.path().join("elsewhere")), "0", "scale"), first);
    assert_ne!(key(run().setting(2.0), "0", "scale"), first);
    assert_ne!(key(run(), "1", "scale"), first);
    assert_ne!(key(run(), "0", "other"), first);
    save_f8(&dir.path().join("input"), "dwell_s", "(4,)", &[1.0, 1.0, 1.0, 1.5]);
    assert_ne!(key(run(), "0", "scale"), first);
}

#[test]
fn a_negative_verdict_stays_negative_when_nothing_is_done() {
    let dir = tempfile::tempdir().unwrap();
    let run = || Run::new(dir.path()).negative("limits exceeded");
    assert_eq!(run().run().unwrap(), None);
    assert_eq!(run().run().unwrap(), Some(run().status));

    // Of several parts one is enough.
    let run = Run::new(dir.path()).out(dir.path().join("parts"));
    let negative = Status::Negative("not converged".into());
    let mut output = writer(run.begin_two());
    output.write(&dwell(1.0), json!({}), &negative).unwrap();
    output.write(&support::trajectory(), json!({}), &Status::Done).unwrap();
    assert_eq!(unchanged(run.begin_two().unwrap()), negative);
    fs::remove_dir_all(dir.path().join("parts/b")).unwrap();
    writer(run.begin_two());
}

#[test]
fn a_report_with_a_reason_of_its_own_is_not_a_negative_verdict() {
    let dir = tempfile::tempdir().unwrap();
    let run = Run::new(dir.path());
    let outcome = json!({"reason": "of another kind"});
    writer(run.begin()).write(&dwell(1.0), outcome, &Status::Done).unwrap();
    assert_eq!(unchanged(run.begin().unwrap()), Status::Done);
}

#[test]
fn what_lacks_in_an_output_is_made_again_and_what_was_changed_is_kept() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("out");
    let run = || Run::new(dir.path());
    run().run().unwrap();
    let good = snapshot(dir.path());
    fs::remove_file(out.join("dwell_s.npy")).unwrap();
    assert_eq!(run().run().unwrap(), None);
    assert_eq!(snapshot(dir.path()), good);
    // An array of somebody else in place of ours, and an edited or a broken manifest, are not
    // replaced.
    let kept = |expected: &str| {
        let before = snapshot(dir.path());
        run().refused(expected);
        run().force().refused(expected);
        run().setting(2.0).force().refused(expected);
        assert_eq!(snapshot(dir.path()), before);
    };
    save_f8(&out, "dwell_s", "(4,)", &[9.0; 4]);
    kept("dwell_s.npy: is not what manifest.json says that Planish wrote; move it elsewhere");
    fs::remove_file(out.join("dwell_s.npy")).unwrap();
    run().run().unwrap();
    let manifest = fs::read_to_string(out.join(MANIFEST)).unwrap();
    fs::write(out.join(MANIFEST), manifest.replace("done", "fine")).unwrap();
    kept("manifest.json: was changed after it was written");
    fs::write(out.join(MANIFEST), &manifest[..manifest.len() / 2]).unwrap();
    kept("manifest.json: is not a manifest");
}

#[test]
fn foreign_files_are_never_lost() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("out");
    let keep = |expected: &str| {
        let before = snapshot(dir.path());
        Run::new(dir.path()).setting(2.0).refused(expected);
        Run::new(dir.path()).setting(2.0).force().refused(expected);
        assert_eq!(snapshot(dir.path()), before);
    };
    Run::new(dir.path()).run().unwrap();
    fs::write(out.join("notes.txt"), "mine").unwrap();
    keep("out: holds notes.txt, which no dwell has; choose another --out");
    fs::remove_file(out.join("notes.txt")).unwrap();
    fs::create_dir(out.join("data")).unwrap();
    keep("holds data");
    fs::remove_dir(out.join("data")).unwrap();
    // A directory under the name of an array.
    fs::remove_file(out.join("dwell_s.npy")).unwrap();
    fs::create_dir(out.join("dwell_s.npy")).unwrap();
    fs::write(out.join("dwell_s.npy/mine"), "mine").unwrap();
    keep("holds dwell_s.npy, which no dwell has");
    fs::remove_dir_all(&out).unwrap();
    // An artifact of another kind.
    write(&out, &surface());
    keep("which no dwell has");
    fs::remove_dir_all(&out).unwrap();
    // Arrays of somebody else, without a manifest.
    write_bare(&out, &dwell(7.0));
    keep("out: holds dwell_s.npy and no manifest.json, so Planish did not write it");
    fs::remove_dir_all(&out).unwrap();
    // A kind without arrays has the same file names as any other of its sort.
    make(&out, &kind::VERDICT, &[], &Inputs::new(), json!({}));
    let before = snapshot(dir.path());
    let report = OutputArgs { force: true, ..output(&out) };
    let task = Task::new("test", "0", "report", json!({}));
    let error = Output::directory(&report, &kind::REPORT).begin(&task, &Inputs::new());
    assert!(error.unwrap_err().to_string().contains("holds a verdict, needs a report"));
    assert_eq!(snapshot(dir.path()), before);
}

#[test]
fn no_output_is_contains_or_lies_in_an_input() {
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| dir.path().join(name);
    fs::create_dir(at("raw")).unwrap();
    save_f8(&at("raw"), "height_nm", "(2, 2)", &[1.0; 4]);
    fs::write(at("machine.json"), "{}").unwrap();
    let before = snapshot(dir.path());
    let mut inputs = Inputs::new();
    inputs.read_map("file", &at("raw/height_nm.npy")).unwrap();
    inputs.read_json::<Value>("machine", &at("machine.json")).unwrap();
    let begin = |inputs: &Inputs, out: &str, kind: &'static Kind| {
        let task = Task::new("test", "0", "make", json!({}));
        Output::directory(&output(&at(out)), kind).begin(&task, inputs).unwrap_err()
    };
    let refused = |error: HandoffError, expected: &str| {
        assert!(error.to_string().contains(expected), "no {expected:?} in: {error}");
        assert_eq!(snapshot(dir.path()), before);
    };
    let error = begin(&inputs, "raw", &kind::SURFACE);
    refused(error, "raw: contains the input --file; choose another --out");
    let file = |path: &str| OutputFile::begin("--picture", &at(path), true, &inputs).unwrap_err();
    refused(file("raw/height_nm.npy"), "is the input --file; choose another --picture");
    refused(file("raw"), "raw: contains the input --file");
    refused(file("raw/../machine.json"), "is the input --machine");
    write_bare(&at("bare"), &dwell(1.0));
    let mut inputs = Inputs::new();
    inputs.read::<DwellTime>("input", &at("bare")).unwrap();
    let error = begin(&inputs, "bare/inside", DwellTime::KIND);
    assert!(error.to_string().contains("bare/inside: lies in the input --input"), "{error}");

    // --wall-time replaces a wall time and nothing else.
    let mut run = Run::new(dir.path());
    run.output.wall_time = Some(at("machine.json"));
    run.refused("machine.json: exists and holds no wall time");
    run.output.wall_time = Some(at("input/dwell_s.npy"));
    run.refused("lies in the input --input; choose another --wall-time");
    run.output.wall_time = Some(at("wall/time.json"));
    run.run().unwrap();
    let run = Run { setting: 2.0, ..run }.force();
    run.run().unwrap();
    assert!(fs::read_to_string(at("wall/time.json")).unwrap().contains("wall_s"));
    assert_eq!(fs::read_to_string(at("machine.json")).unwrap(), "{}");
}

#[test]
fn several_parts_appear_together_or_not_at_all() {
    let dir = tempfile::tempdir().unwrap();
    let mut output = writer(Run::new(dir.path()).begin_two());
    output.write(&dwell(1.0), json!({}), &Status::Done).unwrap();
    let out = dir.path().join("out");
    assert!(!out.join("a").exists(), "b is not written yet");
    output.write(&support::trajectory(), json!({}), &Status::Done).unwrap();
    assert_eq!(names(&out), ["a", "b"]);
    // A run that ends before its last part leaves nothing.
    let mut output = writer(Run::new(dir.path()).setting(2.0).force().begin_two());
    output.write(&dwell(2.0), json!({}), &Status::Done).unwrap();
    drop(output);
    assert_eq!((value_in(&out.join("a")), names(&out)), (1.0, vec!["a".into(), "b".into()]));
}

#[test]
fn a_file_beside_the_artifact_appears_with_it_and_is_made_again() {
    let dir = tempfile::tempdir().unwrap();
    let picture = dir.path().join("picture.svg");
    let begin = |run: &Run| {
        let output = Output::directory(&run.output, DwellTime::KIND);
        output.and_file("--picture", &picture).begin(&run.task(), &run.inputs().unwrap())
    };
    let make = |run: &Run| {
        let mut output = writer(begin(run));
        output.write_file(&picture, b"<svg/>").unwrap();
        assert!(!picture.exists(), "the artifact is not written yet");
        output.write(&dwell(run.setting), json!({}), &Status::Done).unwrap();
        assert!(picture.exists());
    };
    let run = Run::new(dir.path());
    make(&run);
    assert_eq!(unchanged(begin(&run).unwrap()), Status::Done);
    fs::remove_file(&picture).unwrap();
    make(&run);
    // Another artifact beside the same picture: neither is replaced without --force.
    let other = Run::new(dir.path()).out(dir.path().join("other"));
    let message = begin(&other).unwrap_err().to_string();
    assert!(
        message.contains("exists; give --force to replace it, or another --picture"),
        "{message}"
    );
    let inside = Output::directory(&run.output, DwellTime::KIND)
        .and_file("--picture", &run.output.out.join("picture.svg"))
        .begin(&run.task(), &run.inputs().unwrap());
    let message = inside.unwrap_err().to_string();
    assert!(message.contains("is in the output; give another --picture"), "{message}");
}

#[test]
fn two_artifacts_of_a_run_do_not_take_each_others_place() {
    let dir = tempfile::tempdir().unwrap();
    let run = Run::new(dir.path()).force();
    for (second, refused) in [("out", true), ("out/feed", true), (".", true), ("feed", false)] {
        let output = Output::directory(&run.output, DwellTime::KIND).and_directory(
            "--second",
            &dir.path().join(second),
            Trajectory::KIND,
        );
        let begin = output.begin(&run.task(), &run.inputs().unwrap());
        assert_eq!(begin.is_err(), refused, "{second}: {begin:?}");
        if let Err(error) = begin {
            assert!(error.to_string().contains("give another --second"), "{second}: {error}");
        }
    }
}

#[test]
fn inputs_that_do_not_belong_together_are_told() {
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| dir.path().join(name);
    for (name, value) in [("one", 1.0), ("two", 2.0)] {
        write_bare(&at(name), &dwell(value));
    }
    // "made" comes from "middle", which comes from "one": the lineage goes all the way back.
    let derive = |from: &str, to: &str, kind: &'static Kind| {
        let mut inputs = Inputs::new();
        match from {
            "one" => drop(inputs.read::<DwellTime>("dwell", &at(from)).unwrap()),
            _ => drop(inputs.read::<planish_types::ToolPath>("path", &at(from)).unwrap()),
        }
        let (path, trajectory) = (support::tool_path(), support::trajectory());
        let arrays = match kind.name {
            "tool_path" => path.to_arrays(),
            _ => trajectory.to_arrays(),
        };
        make(&at(to), kind, &arrays, &inputs, json!({}));
    };
    derive("one", "middle", &kind::TOOL_PATH);
    derive("middle", "made", &kind::TRAJECTORY);
    let check = |dwell_dir: &str| {
        let mut inputs = Inputs::new();
        let (_, manifest) =
            inputs.read_with_manifest::<Trajectory>("trajectory", &at("made")).unwrap();
        inputs.read::<DwellTime>("dwell", &at(dwell_dir)).unwrap();
        inputs.refuse_unrelated("trajectory", manifest.as_ref(), "dwell")
    };
    check("one").unwrap();
    let message = check("two").unwrap_err().to_string();
    assert!(message.contains("--trajectory was made from another dwell than --dwell"), "{message}");
    fs::remove_file(at("made").join(MANIFEST)).unwrap();
    check("two").unwrap();
}

#[test]
fn a_verdict_that_was_edited_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("verdict");
    make(&out, &kind::VERDICT, &[], &Inputs::new(), json!({ "limits_respected": false }));
    let read = || Inputs::new().read_manifest("verdict", &out, &kind::VERDICT);
    read().unwrap();
    let text = fs::read_to_string(out.join(MANIFEST)).unwrap();
    fs::write(out.join(MANIFEST), text.replace("false", "true")).unwrap();
    let message = read().unwrap_err().to_string();
    assert!(message.contains("was changed after it was written"), "{message}");
    // A manifest without its seal is refused too.
    let (body, _) = text.rsplit_once(",\n  \"seal\"").unwrap();
    fs::write(out.join(MANIFEST), format!("{}\n}}\n", body.replace("false", "true"))).unwrap();
    let message = read().unwrap_err().to_string();
    assert!(message.contains("has no seal"), "{message}");
}

#[test]
fn a_file_that_appears_during_the_work_is_not_lost() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("out");
    Run::new(dir.path()).run().unwrap();
    let mut output = writer(Run::new(dir.path()).setting(2.0).force().begin());
    fs::write(out.join("notes.txt"), "mine").unwrap();
    let error = output.write(&dwell(2.0), json!({}), &Status::Done).unwrap_err();
    assert!(error.to_string().contains("holds notes.txt"), "{error}");
    assert_eq!(fs::read_to_string(out.join("notes.txt")).unwrap(), "mine");
    assert_eq!((value_in(&out), names(dir.path())), (1.0, vec!["input".into(), "out".into()]));
}

#[test]
fn an_output_that_another_run_made_meanwhile_is_replaced_only_by_force() {
    let dir = tempfile::tempdir().unwrap();
    let mut slow = writer(Run::new(dir.path()).setting(2.0).begin());
    Run::new(dir.path()).run().unwrap();
    let error = slow.write(&dwell(2.0), json!({}), &Status::Done).unwrap_err().to_string();
    assert!(error.contains("out: exists, made while this ran; give --force"), "{error}");
    assert_eq!((value_in(&dir.path().join("out")), names(dir.path()).len()), (1.0, 2));
}

#[test]
fn an_input_is_not_an_output() {
    let dir = tempfile::tempdir().unwrap();
    let before = {
        Run::new(dir.path());
        symlink("input", dir.path().join("link")).unwrap();
        snapshot(dir.path())
    };
    for out in ["input", "link", "input/../input"] {
        let run = Run::new(dir.path()).out(dir.path().join(out)).force();
        run.refused("is the input --input; choose another --out");
    }
    assert_eq!(snapshot(dir.path()), before);
}

/// Checks output paths that end with a dot or a slash, to which the system does not rename.
#[test]
fn an_output_that_does_not_exist_may_end_with_a_dot_or_a_slash() {
    for (out, made) in [
        ("new/.", "new"),
        ("new/", "new"),
        ("new//./", "new"),
        ("above/./new/.", "above/new"),
        ("gone/../new/.", "new"),
    ] {
        let dir = tempfile::tempdir().unwrap();
        let run = || Run::new(dir.path()).out(format!("{}/{out}", dir.path().display()));
        assert_eq!(run().run().unwrap(), None, "{out}");
        assert_eq!(value_in(&dir.path().join(made)), 1.0, "{out}");
        assert_eq!(run().run().unwrap(), Some(Status::Done), "{out}");
        let file = format!("{}/picture.svg/.", dir.path().display());
        let inputs = Inputs::new();
        let begun = OutputFile::begin("--picture", Path::new(&file), false, &inputs).unwrap();
        begun.write(b"svg").unwrap();
        assert_eq!(fs::read(dir.path().join("picture.svg")).unwrap(), b"svg");
        assert!(OutputFile::begin("--picture", Path::new(&file), false, &inputs).is_err());
    }
}

#[test]
fn an_output_that_cannot_be_is_refused_before_the_work() {
    let dir = tempfile::tempdir().unwrap();
    fs::write(dir.path().join("file"), "mine").unwrap();
    symlink("nowhere", dir.path().join("link")).unwrap();
    symlink("loop", dir.path().join("loop")).unwrap();
    Run::new(dir.path());
    let before = snapshot(dir.path());
    for (out, expected) in [
        ("file", "file: is a file; choose another --out"),
        ("file/below", "cannot be written: Not a directory"),
        ("link", "link: is a link to nothing; choose another --out"),
        ("link/below", "link is not a directory; choose another --out"),
        ("loop", "cannot be written: Too many levels of symbolic links"),
        ("loop/below/.", "cannot be written: Too many levels of symbolic links"),
        ("file/../new/.", "cannot be written: Not a directory"),
        (&"n".repeat(256), "cannot be written: File name too long"),
        (".", "contains the input --input"),
        ("new/..", "is not the name of a directory"),
    ] {
        let run = Run::new(dir.path()).out(dir.path().join(out)).force();
        let error = run.begin().unwrap_err().to_string();
        assert!(error.contains(expected), "{out}: {error}");
    }
    let empty = Run::new(dir.path()).out("").begin();
    assert!(empty.unwrap_err().to_string().contains("is not the name of a directory"));
    let parts = Run::new(dir.path()).out(dir.path().join("file"));
    let error = parts.begin_two().unwrap_err().to_string();
    assert!(error.contains("file/a: cannot be written: Not a directory"), "{error}");
    let mut wall = Run::new(dir.path());
    wall.output.wall_time = Some(dir.path().join("out/wall.json"));
    wall.refused("wall.json: is in the output; give another --wall-time");
    assert_eq!(snapshot(dir.path()), before);
}

/// Checks that `--force` replaces no pipe, no device, and no link that leads to itself.
#[test]
fn what_is_no_regular_file_is_never_replaced() {
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| dir.path().join(name);
    assert!(Command::new("mkfifo").arg(at("pipe")).status().unwrap().success());
    let _socket = std::os::unix::net::UnixListener::bind(at("socket")).unwrap();
    symlink("/dev/null", at("device")).unwrap();
    symlink("pipe", at("to-pipe")).unwrap();
    symlink("loop", at("loop")).unwrap();
    symlink("nowhere", at("lost")).unwrap();
    fs::write(at("mine"), "old").unwrap();
    symlink("mine", at("to-mine")).unwrap();
    let kinds = |names: &[&str]| -> Vec<_> {
        names.iter().map(|name| fs::symlink_metadata(at(name)).unwrap().file_type()).collect()
    };
    let special = ["pipe", "socket", "device", "to-pipe", "loop", "lost"];
    let before = kinds(&special);
    let inputs = Inputs::new();
    for name in special {
        let file = OutputFile::begin("--out", &at(name), true, &inputs);
        let message = file.unwrap_err().to_string();
        assert!(message.contains(name) && message.ends_with("; choose another --out"), "{message}");
        let mut run = Run::new(dir.path()).force();
        let output = Output::directory(&run.output, DwellTime::KIND);
        let begun = output.and_file("--picture", &at(name)).begin(&run.task(), &inputs);
        assert!(begun.unwrap_err().to_string().ends_with("; choose another --picture"));
        run.output.wall_time = Some(at(name));
        run.refused("give another --wall-time");
        assert!(Run::new(dir.path()).out(at(name)).force().begin().is_err(), "{name}");
    }
    // In the place of an array, which would be read for ever
    Run::new(dir.path()).run().unwrap();
    fs::remove_file(at("out/dwell_s.npy")).unwrap();
    fs::rename(at("pipe"), at("out/dwell_s.npy")).unwrap();
    Run::new(dir.path()).force().refused("dwell_s.npy: is not a regular file");
    fs::rename(at("out/dwell_s.npy"), at("pipe")).unwrap();
    assert_eq!(kinds(&special), before);
    // A link to a regular file stays a link.
    OutputFile::begin("--out", &at("to-mine"), true, &inputs).unwrap().write(b"new").unwrap();
    assert!(at("to-mine").is_symlink());
    assert_eq!(fs::read(at("mine")).unwrap(), b"new");
}

/// Checks inputs and outputs whose names are not UTF-8.
#[test]
fn names_that_are_not_utf_8_are_names() {
    use std::os::unix::ffi::OsStrExt;
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path().join(std::ffi::OsStr::from_bytes(b"M\xfcller"));
    fs::create_dir(&dir).unwrap();
    let run = || Run::new(&dir);
    let mut output = writer(run().begin_two());
    output.write(&dwell(1.0), json!({}), &Status::Done).unwrap();
    output.write(&support::trajectory(), json!({}), &Status::Done).unwrap();
    assert_eq!(value_in(&dir.join("out/a")), 1.0);
    run().out(dir.join("input")).force().refused("is the input --input");
    run().out(dir.join("input/below")).refused("lies in the input --input");
    assert_eq!(names(&dir), ["input", "out"]);
}

#[test]
fn a_link_to_the_output_stays_a_link() {
    let dir = tempfile::tempdir().unwrap();
    let real = dir.path().join("elsewhere/real");
    fs::create_dir_all(&real).unwrap();
    symlink("elsewhere/real", dir.path().join("out")).unwrap();
    for setting in [1.0, 2.0] {
        Run::new(dir.path()).setting(setting).force().run().unwrap();
        assert!(dir.path().join("out").is_symlink());
        assert_eq!(value_in(&real), setting);
        assert_eq!(names(&dir.path().join("elsewhere")), ["real"]);
    }
}

#[test]
fn a_link_in_the_output_is_removed_but_not_what_it_points_to() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("out");
    Run::new(dir.path()).run().unwrap();
    fs::rename(out.join("dwell_s.npy"), dir.path().join("mine.npy")).unwrap();
    symlink("../mine.npy", out.join("dwell_s.npy")).unwrap();
    let mine = fs::read(dir.path().join("mine.npy")).unwrap();
    Run::new(dir.path()).setting(2.0).force().run().unwrap();
    assert!(!out.join("dwell_s.npy").is_symlink());
    assert_eq!(fs::read(dir.path().join("mine.npy")).unwrap(), mine);
}

#[test]
fn names_up_to_the_length_of_the_file_system_are_written() {
    let dir = tempfile::tempdir().unwrap();
    for out in ["n".repeat(255), "a b 'c' \u{fc}/deep/er".into(), "slash/".into()] {
        for setting in [1.0, 2.0] {
            let out = dir.path().join(&out);
            Run::new(dir.path()).out(&out).setting(setting).force().run().unwrap();
            assert_eq!(value_in(&out), setting);
        }
    }
}

#[test]
fn what_a_killed_run_left_behind_is_removed_by_the_next() {
    let dir = tempfile::tempdir().unwrap();
    // A container gives every run the same process id.
    let left = dir.path().join(format!(".planish-{}-0.tmp", process::id()));
    fs::create_dir(&left).unwrap();
    fs::write(left.join("dwell_s.npy"), "half").unwrap();
    Run::new(dir.path()).run().unwrap();
    assert_eq!(value_in(&dir.path().join("out")), 1.0);
    assert_eq!(names(dir.path()), ["input", "out"]);
}

#[test]
fn beside_files_are_hashed_made_again_when_missing_and_kept_when_changed() {
    let dir = tempfile::tempdir().unwrap();
    let args = output(&dir.path().join("report"));
    let task = Task::new("test", "0", "report", json!({}));
    let begin = || Output::directory(&args, &kind::REPORT).begin(&task, &Inputs::new());
    let beside = [("summary.json", b"{}\n".to_vec())];
    let mut report = writer(begin());
    report.write_arrays(&kind::REPORT, &[], &beside, json!({}), &Status::Done).unwrap();
    assert_eq!(unchanged(begin().unwrap()), Status::Done);
    let summary = dir.path().join("report/summary.json");
    fs::remove_file(&summary).unwrap();
    writer(begin());
    fs::write(&summary, "{ }\n").unwrap();
    let message = begin().unwrap_err().to_string();
    assert!(message.contains("summary.json: is not what manifest.json says"), "{message}");
}

// ---- processes of their own ------------------------------------------------------------------

/// Number of values in the artifact that a child writes. Smaller: writing is too fast to be
/// interrupted. Larger: a slower test.
const LONG: usize = 40_000;

/// Program of the child processes, not a test. A test starts this program again with
/// `PLANISH_CHILD` set.
///
/// `once`: writes the value `PLANISH_VALUE` to `--out`; `forever`: writes 1, 2, 3, ... again and
/// again.
#[test]
fn child() {
    let Ok(mode) = std::env::var("PLANISH_CHILD") else { return };
    let out = PathBuf::from(std::env::var_os("PLANISH_OUT").unwrap());
    let write = |value: f64| {
        let args = OutputArgs { force: true, ..output(&out) };
        let task = Task::new("test", "0", "write", json!({ "value": value }));
        let output = Output::directory(&args, DwellTime::KIND);
        if let Begin::Run(mut output) = output.begin(&task, &Inputs::new())? {
            let long = DwellTime::new(vec![value; LONG]).unwrap();
            output.write(&long, json!({ "value": value }), &Status::Done)?;
        }
        Ok::<(), HandoffError>(())
    };
    match mode.as_str() {
        "once" => {
            if let Err(e) = write(std::env::var("PLANISH_VALUE").unwrap().parse().unwrap()) {
                eprintln!("error: {e}");
                process::exit(2);
            }
        }
        _ => {
            let mut value = 0.0;
            loop {
                value += 1.0;
                write(value).unwrap();
            }
        }
    }
}

fn child_command(shell: &str, directory: &Path, mode: &str, out: &str, value: f64) -> Command {
    let mut command = Command::new("sh");
    command
        .args(["-c", &format!("{shell} exec \"$0\" \"$@\"")])
        .arg(std::env::current_exe().unwrap())
        .args(["--exact", "writing::child", "--nocapture"])
        .current_dir(directory)
        .env("PLANISH_CHILD", mode)
        .env("PLANISH_OUT", out)
        .env("PLANISH_VALUE", value.to_string())
        .stdout(Stdio::null());
    command
}

fn write_once(shell: &str, directory: &Path, out: &str, value: f64) -> process::Output {
    child_command(shell, directory, "once", out, value).output().unwrap()
}

fn write_forever(directory: &Path) -> Child {
    child_command("", directory, "forever", "out", 0.0).stderr(Stdio::null()).spawn().unwrap()
}

/// Returns the value of an artifact. Asserts that its arrays and its manifest are whole and of one run.
fn whole(out: &Path) -> f64 {
    let loaded = artifact::read::<DwellTime>(out).unwrap();
    let (values, manifest) = (loaded.value.dwell_s(), loaded.manifest.unwrap());
    assert_eq!(values.len(), LONG);
    assert!(values.iter().all(|v| *v == values[0]));
    assert_eq!(manifest.outcome["value"], values[0]);
    assert_eq!(manifest.settings["value"], values[0]);
    values[0]
}

#[test]
fn the_same_command_writes_the_same_bytes_into_the_current_directory() {
    let (a, b) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    for dir in [&a, &b] {
        let run = write_once("", dir.path(), "out", 3.0);
        assert!(run.status.success(), "{run:?}");
        assert_eq!(whole(&dir.path().join("out")), 3.0);
        assert_eq!(names(dir.path()), ["out"]);
    }
    for file in ["dwell_s.npy", MANIFEST] {
        let bytes = |dir: &Path| fs::read(dir.join("out").join(file)).unwrap();
        assert_eq!(bytes(a.path()), bytes(b.path()), "{file}");
    }
    let manifest = fs::read_to_string(a.path().join("out").join(MANIFEST)).unwrap();
    assert!(manifest.ends_with("}\n"));
    assert!(!manifest.contains(a.path().to_str().unwrap()));
}

#[test]
fn the_directory_in_which_the_user_stands_is_not_replaced() {
    let dir = tempfile::tempdir().unwrap();
    let run = write_once("", dir.path(), ".", 1.0);
    let message = String::from_utf8(run.stderr).unwrap();
    assert_eq!(run.status.code(), Some(2), "{message}");
    assert!(message.contains("is the current directory; give a new directory in it"), "{message}");
    assert!(names(dir.path()).is_empty());
}

#[test]
fn a_write_that_fails_half_way_leaves_the_old_artifact_whole() {
    let dir = tempfile::tempdir().unwrap();
    // Files of at most 16 KiB: the array of 320 kB fails in the middle, as on a full disk.
    let full_disk = "trap '' XFSZ; ulimit -f 32;";
    let refuse = |expected: &str| {
        let run = write_once(full_disk, dir.path(), "out", 2.0);
        let message = String::from_utf8(run.stderr).unwrap();
        assert_eq!(run.status.code(), Some(2), "{message}");
        assert!(message.contains(expected), "{message}");
    };
    refuse("dwell_s.npy: cannot write: File too large");
    assert!(names(dir.path()).is_empty(), "{:?}", names(dir.path()));
    assert!(write_once("", dir.path(), "out", 1.0).status.success());
    refuse("dwell_s.npy: cannot write: File too large");
    assert_eq!(names(dir.path()), ["out"]);
    assert_eq!(whole(&dir.path().join("out")), 1.0);
}

#[test]
fn an_unwritable_place_is_said_so() {
    let dir = tempfile::tempdir().unwrap();
    let run = write_once("", dir.path(), "/proc/planish/out", 1.0);
    let message = String::from_utf8(run.stderr).unwrap();
    assert_eq!(run.status.code(), Some(2), "{message}");
    assert!(message.contains("/proc/planish: cannot create"), "{message}");
}

#[test]
fn killed_writers_leave_a_whole_artifact_at_every_moment() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("out");
    assert!(write_once("", dir.path(), "out", 0.5).status.success());
    let (stop, reads, changes) = (AtomicBool::new(false), AtomicUsize::new(0), AtomicUsize::new(0));
    thread::scope(|scope| {
        scope.spawn(|| {
            let mut last = 0.5;
            while !stop.load(Ordering::Relaxed) {
                let value = whole(&out);
                reads.fetch_add(1, Ordering::Relaxed);
                changes.fetch_add(usize::from(value != last), Ordering::Relaxed);
                last = value;
            }
        });
        // Until enough has been seen; a busy machine takes more rounds.
        let seen = || changes.load(Ordering::Relaxed);
        for round in (0..600_u64).take_while(|round| *round < 40 || seen() <= 10) {
            // Two writers at once in every second round.
            let mut children: Vec<Child> =
                (0..1 + round % 2).map(|_| write_forever(dir.path())).collect();
            // From before the first write to some writes later.
            thread::sleep(Duration::from_micros(2_000 + 977 * (round % 80)));
            for child in &mut children {
                child.kill().unwrap();
                child.wait().unwrap();
            }
        }
        stop.store(true, Ordering::Relaxed);
    });
    whole(&out);
    let (reads, changes) = (reads.into_inner(), changes.into_inner());
    eprintln!("{reads} reads, {changes} changes seen");
    assert!(reads > 50 && changes > 10, "{reads} reads, {changes} changes: too slow to prove much");
    // Only the artifact and the remains of killed writers are left.
    let left = names(dir.path());
    assert!(left.iter().all(|n| n == "out" || n.starts_with(".planish-")), "{left:?}");
    // These remains do not disturb the next run.
    assert!(write_once("", dir.path(), "out", 0.25).status.success());
    assert_eq!(whole(&out), 0.25);
    assert_eq!(names(dir.path()), ["out"]);
}

#[test]
fn a_tif_and_a_surface_do_not_take_each_others_place() {
    let dir = tempfile::tempdir().unwrap();
    write(dir.path().join("a").as_path(), &tif());
    let task = Task::new("test", "0", "make", json!({}));
    let output = Output::directory(&output(&dir.path().join("a")), &kind::SURFACE);
    let error = output.begin(&task, &Inputs::new()).unwrap_err().to_string();
    assert!(error.contains("holds rate_nm_per_s.npy, which no surface has"), "{error}");
}
