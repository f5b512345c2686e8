//! What the `main` of every stage does: flags, inputs, skipping, messages, exit codes.
//!
//! ```no_run
//! use planish_handoff::{Begin, Failure, OutputArgs, Stage, Status, run};
//! use planish_types::Surface;
//! # fn parse() -> (OutputArgs, std::path::PathBuf) { unimplemented!() }
//! fn main() -> std::process::ExitCode {
//!     let (output, dir) = parse();
//!     run(|| {
//!         let mut stage = Stage::new("planish-example", "0.1.0", "copy", &output);
//!         let surface: Surface = stage.read("surface", &dir)?;
//!         if let Begin::Unchanged(status) = stage.begin(&[""], Surface::KIND)? {
//!             return Ok(status);
//!         }
//!         stage.write("", &surface, serde_json::json!({}), &Status::Done)?;
//!         Ok(Status::Done)
//!     })
//! }
//! # use planish_handoff::Artifact;
//! ```

use std::{
    cell::RefCell,
    collections::{BTreeMap, BTreeSet},
    fmt::Display,
    fs::{self, File},
    io::{ErrorKind, Write},
    panic,
    path::{Path, PathBuf},
    process::ExitCode,
    time::{Duration, Instant},
};

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use ndarray::{Array2, Ix2};
use planish_types::{Limits, MachineFile, text};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use crate::{
    HandoffError,
    artifact::{self, Ancestor, Artifact, InputRecord, MANIFEST, Manifest, Seal},
    kind::{Dtype, Kind},
    npy::{self, ArrayData},
    publish::{self, Staged},
};

/// Largest JSON file that is read (a machine, a recipe, what stands beside a program), bytes.
const LARGEST_JSON_BYTES: u64 = 1 << 24;

/// How often the progress on a terminal is drawn anew: the first time after this long.
const PROGRESS_PERIOD: Duration = Duration::from_millis(250);

/// Flags that every stage has.
#[derive(Clone, Debug, clap::Args)]
pub struct OutputArgs {
    /// Directory to write
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Replace an output that was made from other inputs or settings
    #[arg(long)]
    pub force: bool,
    /// Also write the seconds that the stage took, and the most memory that it held, to FILE, as JSON
    /// (kept out of the artifact, which is the same for the same command)
    #[arg(long, value_name = "FILE")]
    pub wall_time: Option<PathBuf>,
}

/// How a stage that ran ended.
#[derive(Clone, Debug, PartialEq)]
pub enum Status {
    /// Done; exit code 0.
    Done,
    /// Done, and the verdict is negative, for this reason; exit code 1.
    Negative(String),
}

/// Why a stage could not run; exit code 2.
#[derive(Debug)]
pub struct Failure(String);

impl Failure {
    /// A failure with this message.
    pub fn new(message: impl Into<String>) -> Self {
        Self(message.into())
    }
}

impl Display for Failure {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&self.0)
    }
}

/// Any error of a library becomes the one message that the user reads.
impl<E: std::error::Error> From<E> for Failure {
    fn from(error: E) -> Self {
        Self(error.to_string())
    }
}

/// Runs the body of a stage and turns its end into the exit code: 0 done, 1 done with a negative
/// verdict, 2 could not run.
pub fn run(body: impl FnOnce() -> Result<Status, Failure> + panic::UnwindSafe) -> ExitCode {
    publish::clean_up_on_signals();
    panic::set_hook(Box::new(|info| {
        complain(&format!("internal error: {info}; this is a defect of Planish, please report it"));
    }));
    let end = panic::catch_unwind(body);
    publish::wait_for_signal_under_way();
    match end {
        Ok(Ok(Status::Done)) => ExitCode::SUCCESS,
        Ok(Ok(Status::Negative(reason))) => {
            complain(&format!("verdict: {reason}"));
            ExitCode::from(1)
        }
        Ok(Err(failure)) => {
            complain(&format!("error: {failure}"));
            ExitCode::from(2)
        }
        Err(_) => ExitCode::from(2),
    }
}

/// Lines on standard error; a closed pipe is not an error.
fn complain(message: &str) {
    let _ = writeln!(std::io::stderr(), "{}", without_commands(message));
}

/// Lines on standard output; a closed pipe is not an error.
pub fn say(message: impl Display) {
    let _ = writeln!(std::io::stdout(), "{}", without_commands(&message.to_string()));
}

/// The lines of `message` with what could command a terminal spelt out: names of files are in it.
fn without_commands(message: &str) -> String {
    message.split('\n').map(text::visible).collect::<Vec<_>>().join("\n")
}

/// Whether there is work to do.
#[derive(Clone, Debug, PartialEq)]
pub enum Begin {
    /// The output is there already, made from the same inputs and settings, and ended like this.
    Unchanged(Status),
    /// Run.
    Run,
}

/// One run of a stage: collects what goes into the manifest.
#[derive(Debug)]
pub struct Stage {
    tool: &'static str,
    tool_version: &'static str,
    method: String,
    output: OutputArgs,
    settings: Value,
    inputs: Vec<InputRecord>,
    lineage: BTreeSet<Ancestor>,
    /// Directories that this run is to make, each with whether it was there when the run began, and
    /// those that are made and not shown yet: they appear together.
    parts: RefCell<BTreeMap<PathBuf, bool>>,
    staged: RefCell<Vec<Staged>>,
    started: Instant,
    progress: ProgressBar,
}

impl Stage {
    /// A run of `tool` (its version from `env!("CARGO_PKG_VERSION")`), subcommand `method`.
    pub fn new(
        tool: &'static str,
        tool_version: &'static str,
        method: &str,
        output: &OutputArgs,
    ) -> Self {
        Self {
            tool,
            tool_version,
            method: method.into(),
            output: output.clone(),
            settings: json!({}),
            inputs: Vec::new(),
            lineage: BTreeSet::new(),
            parts: RefCell::default(),
            staged: RefCell::default(),
            started: Instant::now(),
            progress: ProgressBar::hidden(),
        }
    }

    /// Records the resolved settings; part of what decides whether anything changed.
    pub fn settings(&mut self, settings: impl Serialize) {
        self.settings = serde_json::to_value(settings).expect("settings serialise to JSON");
    }

    /// Reads an input artifact given by the flag `--role`.
    pub fn read<T: Artifact>(&mut self, role: &str, dir: &Path) -> Result<T, HandoffError> {
        Ok(self.read_with_manifest(role, dir)?.0)
    }

    /// [`Self::read`], and the manifest where there is one.
    pub fn read_with_manifest<T: Artifact>(
        &mut self,
        role: &str,
        dir: &Path,
    ) -> Result<(T, Option<Manifest>), HandoffError> {
        let loaded = artifact::read::<T>(dir)?;
        if let Some(warning) = &loaded.warning {
            complain(&format!("warning: {warning}"));
        }
        self.lineage.extend(loaded.manifest.iter().flat_map(|m| m.lineage.clone()));
        self.record(role, dir, T::KIND.name, loaded.digest);
        Ok((loaded.value, loaded.manifest))
    }

    /// BLAKE3 of the content of the input that was read for this role.
    pub fn digest(&self, role: &str) -> Option<&str> {
        self.inputs.iter().find(|input| input.role == role).map(|input| input.blake3.as_str())
    }

    /// Reads the manifest of an artifact whose kind keeps everything in its outcome.
    pub fn read_manifest(
        &mut self,
        role: &str,
        dir: &Path,
        kind: &Kind,
    ) -> Result<Manifest, HandoffError> {
        publish::finish_interrupted(&publish::parent_of(dir));
        let (manifest, seal) = artifact::read_sealed_manifest(dir, kind)?.ok_or_else(|| {
            HandoffError::new(dir, format!("has no {MANIFEST}; give a {} directory", kind.name))
        })?;
        // Nothing but the seal says that the outcome is what the stage found.
        if seal != Seal::Whole {
            let problem = "has no seal: an older Planish wrote it; make it again";
            return Err(HandoffError::new(&dir.join(MANIFEST), problem));
        }
        let digest = blake3::hash(manifest.outcome.to_string().as_bytes()).to_string();
        self.lineage.extend(manifest.lineage.iter().cloned());
        self.record(role, dir, kind.name, digest);
        Ok(manifest)
    }

    /// Reads a JSON file given by the flag `--role`.
    pub fn read_json<T: serde::de::DeserializeOwned>(
        &mut self,
        role: &str,
        path: &Path,
    ) -> Result<T, HandoffError> {
        let bytes = artifact::read_file(path, LARGEST_JSON_BYTES)?;
        self.record(role, path, "file", blake3::hash(&bytes).to_string());
        serde_json::from_slice(&bytes).map_err(|e| HandoffError::new(path, format!("{e}")))
    }

    /// Reads a file of another program, given by the flag `--role`; at most `most` bytes of it.
    pub fn read_bytes(
        &mut self,
        role: &str,
        path: &Path,
        most: u64,
    ) -> Result<Vec<u8>, HandoffError> {
        let bytes = artifact::read_file(path, most)?;
        self.record(role, path, "file", blake3::hash(&bytes).to_string());
        Ok(bytes)
    }

    /// Notes a file, given by the flag `--role`, that the command reads by itself, line by line: it is
    /// not written to. For commands that write single files only, which have no manifest.
    pub fn note_file(&mut self, role: &str, path: &Path) -> Result<(), HandoffError> {
        if !fs::metadata(path).map_err(|e| HandoffError::io(path, "read", &e))?.is_file() {
            return Err(HandoffError::new(path, "is not a file; give a regular file"));
        }
        self.record(role, path, "file", String::new());
        Ok(())
    }

    /// Reads the machine file given by `--machine`.
    pub fn read_machine(&mut self, path: &Path) -> Result<Limits, HandoffError> {
        let file: MachineFile = self.read_json("machine", path)?;
        file.checked().map_err(|e| HandoffError::new(path, e.to_string()))
    }

    /// Reads one float map (ny, nx) from a `.npy` file given by the flag `--role`.
    pub fn read_map(&mut self, role: &str, path: &Path) -> Result<Array2<f64>, HandoffError> {
        let ArrayData::F64(a) = self.read_array(role, path, Dtype::F64)? else {
            unreachable!("read as F64")
        };
        a.into_dimensionality::<Ix2>().map_err(|_| {
            HandoffError::new(path, "is not a map; give an array with two axes (ny, nx)")
        })
    }

    /// Reads one mask (ny, nx) of 0 and 1 from a `.npy` file given by the flag `--role`.
    pub fn read_mask(&mut self, role: &str, path: &Path) -> Result<Array2<bool>, HandoffError> {
        let ArrayData::U8(a) = self.read_array(role, path, Dtype::U8)? else {
            unreachable!("read as U8")
        };
        a.into_dimensionality::<Ix2>().map(|a| a.mapv(|v| v != 0)).map_err(|_| {
            HandoffError::new(path, "is not a mask; give an array with two axes (ny, nx)")
        })
    }

    fn read_array(
        &mut self,
        role: &str,
        path: &Path,
        dtype: Dtype,
    ) -> Result<ArrayData, HandoffError> {
        let loaded = npy::read(path, dtype)?;
        if let Some(note) = loaded.note {
            complain(&format!("warning: {}: {note}", path.display()));
        }
        self.record(role, path, "file", loaded.blake3);
        Ok(loaded.array)
    }

    fn record(&mut self, role: &str, path: &Path, kind: &str, blake3: String) {
        let kind_or_role = if kind == "file" { role } else { kind };
        self.lineage.insert(Ancestor { kind: kind_or_role.into(), blake3: blake3.clone() });
        self.inputs.push(InputRecord {
            role: role.into(),
            path: path.display().to_string(),
            kind: kind.into(),
            blake3,
        });
    }

    /// Refuses inputs that do not belong together: `made` (the manifest of the input `role`) was made
    /// from another artifact of the kind of the input `from` than that one. Arrays without a manifest
    /// say nothing of what they were made from, and pass.
    pub fn refuse_unrelated(
        &self,
        role: &str,
        made: Option<&Manifest>,
        from: &str,
    ) -> Result<(), HandoffError> {
        let Some(problem) = self.unrelated(role, made, from) else { return Ok(()) };
        let dir = self.inputs.iter().find(|i| i.role == role).map_or("", |i| &i.path);
        Err(HandoffError::new(
            Path::new(dir),
            format!(
                "{problem}; give the one it was made from, make it again, or remove its {MANIFEST} \
                 to use its arrays all the same"
            ),
        ))
    }

    /// The same as a warning, where another input makes sense: a plan on another map.
    pub fn warn_unrelated(&self, role: &str, made: Option<&Manifest>, from: &str) {
        if let Some(problem) = self.unrelated(role, made, from) {
            complain(&format!("warning: {problem}"));
        }
    }

    fn unrelated(&self, role: &str, made: Option<&Manifest>, from: &str) -> Option<String> {
        let from = self.inputs.iter().find(|i| i.role == from)?;
        let mut known = made?.lineage.iter().filter(|a| a.kind == from.kind).peekable();
        known.peek()?;
        if known.any(|a| a.blake3 == from.blake3) {
            return None;
        }
        let (kind, flag) = (&from.kind, &from.role);
        Some(format!("--{role} was made from another {kind} than --{flag} {}", from.path))
    }

    /// Call when all inputs and settings are known, before the work: refuses an output that may
    /// not be replaced, and says so when there is nothing to do. `parts` are the directories
    /// under `--out` that the stage writes, `""` for `--out` itself; they appear together, when the
    /// last of them has been written.
    pub fn begin(&self, parts: &[&str], kind: &Kind) -> Result<Begin, HandoffError> {
        self.begin_each(&parts.iter().map(|p| (*p, kind)).collect::<Vec<_>>())
    }

    /// [`Self::begin`] for parts of different kinds.
    pub fn begin_each(&self, parts: &[(&str, &Kind)]) -> Result<Begin, HandoffError> {
        self.check_wall_time(parts)?;
        let states = parts.iter().map(|(part, kind)| self.state_of(&self.directory(part), kind));
        let states = states.collect::<Result<Vec<_>, _>>()?;
        let unchanged: Option<Vec<Status>> = states.into_iter().collect();
        Ok(match unchanged {
            Some(each) => {
                let negative = each.into_iter().find(|status| *status != Status::Done);
                let status = negative.unwrap_or(Status::Done);
                say(format!(
                    "{}: {} unchanged, nothing to do",
                    self.tool,
                    self.output.out.display()
                ));
                Begin::Unchanged(status)
            }
            None => {
                let places = parts.iter().map(|(part, _)| self.directory(part));
                self.parts.replace(places.map(|place| (place.clone(), place.exists())).collect());
                self.show_progress();
                Begin::Run
            }
        })
    }

    /// On a terminal: what runs, and for how long; nothing in a pipe.
    fn show_progress(&self) {
        let style = "{spinner} {msg} {elapsed}";
        self.progress.set_style(ProgressStyle::with_template(style).expect("a valid template"));
        self.progress.set_message(format!("{} {}", self.tool, self.method));
        self.progress.reset();
        self.progress.set_draw_target(ProgressDrawTarget::stderr());
        self.progress.enable_steady_tick(PROGRESS_PERIOD);
    }

    /// Says that `done` of `total` parts of the work are done; on a terminal the progress becomes a
    /// bar.
    pub fn progress(&self, done: usize, total: usize) {
        if self.progress.length() != Some(total as u64) {
            let style = "{msg} {wide_bar} {pos}/{len} {elapsed}, {eta} left";
            self.progress.set_style(ProgressStyle::with_template(style).expect("a valid template"));
            self.progress.set_length(total as u64);
        }
        self.progress.set_position(done as u64);
    }

    /// How the artifact in `dir` ended when it is what this run would make, else `None`; an error
    /// when something there may not be replaced.
    fn state_of(&self, dir: &Path, kind: &Kind) -> Result<Option<Status>, HandoffError> {
        self.refuse_overlap("--out", dir)?;
        let parent = publish::parent_of(dir);
        publish::finish_interrupted(&parent);
        publish::remove_abandoned(&parent);
        if !output_exists(dir)? {
            return Ok(None);
        }
        if is_same(dir, Path::new(".")) {
            return Err(HandoffError::new(
                dir,
                "is the current directory; give a new directory in it as --out",
            ));
        }
        artifact::refuse_foreign_files(dir, kind)?;
        let Some(manifest) = artifact::read_manifest(dir, kind)? else {
            return Ok(None); // an empty directory
        };
        let is_complete = artifact::is_complete(dir, &manifest)?;
        if manifest.key == self.key() {
            let fresh = !older_than_this_program(&dir.join(MANIFEST));
            return Ok((fresh && is_complete).then(|| status_of(&manifest)));
        }
        if self.output.force {
            return Ok(None);
        }
        Err(HandoffError::new(
            dir,
            "exists, made from other inputs or settings; give --force to replace it, or another --out",
        ))
    }

    /// Refuses a file for `--wall-time` that would be lost or in the way of the output.
    fn check_wall_time(&self, parts: &[(&str, &Kind)]) -> Result<(), HandoffError> {
        let Some(file) = &self.output.wall_time else { return Ok(()) };
        if parts.iter().any(|(part, _)| is_within(file, &self.directory(part))) {
            return Err(HandoffError::new(file, "is in the output; give another --wall-time"));
        }
        self.refuse_overlap("--wall-time", file)?;
        if fs::symlink_metadata(file).is_err() {
            return Ok(());
        }
        let text = artifact::read_text(file, LARGEST_JSON_BYTES).unwrap_or_default();
        match serde_json::from_str::<WallTime>(&text) {
            Ok(_) => Ok(()),
            Err(_) => Err(HandoffError::new(
                file,
                "exists and holds no wall time, so Planish did not write it; give another --wall-time",
            )),
        }
    }

    /// Refuses to write what is an input, contains one, or lies in one.
    fn refuse_overlap(&self, flag: &str, path: &Path) -> Result<(), HandoffError> {
        for input in &self.inputs {
            let at = Path::new(&input.path);
            let how = match (is_within(path, at), is_within(at, path)) {
                (true, true) => "is",
                (true, false) => "lies in",
                (false, true) => "contains",
                (false, false) => continue,
            };
            let problem = format!("{how} the input --{}; choose another {flag}", input.role);
            return Err(HandoffError::new(path, problem));
        }
        Ok(())
    }

    /// Call before the work of a command that writes single files: refuses `path`, given by `flag`,
    /// where it is an input or a directory, or exists and `force` does not say to replace it.
    pub fn begin_file(&self, flag: &str, path: &Path, force: bool) -> Result<(), HandoffError> {
        self.refuse_overlap(flag, path)?;
        if path.is_dir() || path.file_name().is_none() {
            return Err(HandoffError::new(path, format!("is a directory; give a file as {flag}")));
        }
        if fs::symlink_metadata(path).is_ok() && !force {
            let problem = format!("exists; give --force to replace it, or another {flag}");
            return Err(HandoffError::new(path, problem));
        }
        Ok(())
    }

    /// A file beside the output (a picture of it), which appears together with what is written last.
    pub fn stage_file(&self, path: &Path, bytes: &[u8], force: bool) -> Result<(), HandoffError> {
        let mut staged = Staged::file(path, force)?;
        staged.write_all(bytes)?;
        self.staged.borrow_mut().push(staged);
        Ok(())
    }

    /// Writes single files, which appear together.
    pub fn write_single_files(
        &self,
        files: &[(&Path, &[u8])],
        force: bool,
    ) -> Result<(), HandoffError> {
        let stage = |(path, bytes): &(&Path, &[u8])| {
            let mut staged = Staged::file(path, force)?;
            staged.write_all(bytes).map(|()| staged)
        };
        publish::publish(files.iter().map(stage).collect::<Result<_, _>>()?)
    }

    /// Writes a single file that is too large to be held in memory.
    pub fn write_single_file(
        &self,
        path: &Path,
        force: bool,
        write: impl FnOnce(&mut File) -> Result<(), Failure>,
    ) -> Result<(), Failure> {
        let mut staged = Staged::file(path, force)?;
        write(staged.open_file())?;
        Ok(publish::publish(vec![staged])?)
    }

    /// Writes `value` as the artifact `part` of this stage's output.
    pub fn write<T: Artifact>(
        &self,
        part: &str,
        value: &T,
        outcome: Value,
        status: &Status,
    ) -> Result<(), HandoffError> {
        self.write_files(part, T::KIND, &value.to_arrays(), &[], outcome, status)
    }

    /// Writes an artifact from its arrays and the files beside them.
    pub fn write_files(
        &self,
        part: &str,
        kind: &'static Kind,
        arrays: &[ArrayData],
        beside: &[(&str, Vec<u8>)],
        outcome: Value,
        status: &Status,
    ) -> Result<(), HandoffError> {
        let place = self.directory(part);
        let was_there = self.parts.borrow().get(&place).copied().unwrap_or(true);
        let staged = Staged::directory(&place, kind, self.output.force || was_there)?;
        let dir = staged.path();
        let records = artifact::write_arrays(dir, kind, arrays)?;
        for (name, bytes) in beside {
            artifact::write_file(&dir.join(name), bytes)?;
        }
        let hashed =
            |(name, bytes): &(&str, Vec<u8>)| (name.to_string(), blake3::hash(bytes).to_string());
        let manifest = Manifest {
            kind: kind.name.into(),
            version: kind.version,
            tool: self.tool.into(),
            tool_version: self.tool_version.into(),
            method: self.method.clone(),
            command: command_line(self.tool),
            key: self.key(),
            frame: kind.frame.into(),
            settings: self.settings.clone(),
            inputs: self.inputs.clone(),
            lineage: self.lineage.clone(),
            outcome: with_status(outcome, status),
            arrays: records,
            files: beside.iter().map(hashed).collect(),
        };
        artifact::write_file(&dir.join(MANIFEST), manifest.to_text().as_bytes())?;
        self.staged.borrow_mut().push(staged);
        self.parts.borrow_mut().remove(&place);
        if !self.parts.borrow().is_empty() {
            return Ok(()); // more is to come
        }
        publish::publish(self.staged.take())?;
        // What is said from now on is not mixed with it.
        self.progress.finish_and_clear();
        self.write_wall_time()
    }

    /// The directory of a part of the output.
    fn directory(&self, part: &str) -> PathBuf {
        if part.is_empty() { self.output.out.clone() } else { self.output.out.join(part) }
    }

    /// Decides whether an existing output is what this run would make.
    fn key(&self) -> String {
        let inputs: Vec<_> = self.inputs.iter().map(|i| (&i.role, &i.kind, &i.blake3)).collect();
        let key = json!([self.tool, self.tool_version, self.method, self.settings, inputs]);
        blake3::hash(key.to_string().as_bytes()).to_string()
    }

    fn write_wall_time(&self) -> Result<(), HandoffError> {
        let Some(path) = &self.output.wall_time else { return Ok(()) };
        let time = WallTime {
            wall_s: self.started.elapsed().as_secs_f64(),
            peak_memory_mb: peak_memory_mb(),
        };
        let text = serde_json::to_string(&time).expect("numbers serialise");
        self.write_single_files(&[(path.as_path(), format!("{text}\n").as_bytes())], true)
    }
}

/// What `--wall-time` writes.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct WallTime {
    wall_s: f64,
    peak_memory_mb: Option<f64>,
}

/// Whether two paths lead to the same file or directory.
fn is_same(a: &Path, b: &Path) -> bool {
    matches!((a.canonicalize(), b.canonicalize()), (Ok(a), Ok(b)) if a == b)
}

/// Whether `path` is `dir` or leads into it, links followed as far as they exist.
fn is_within(path: &Path, dir: &Path) -> bool {
    resolved(path).starts_with(resolved(dir))
}

/// The path without links and `..`; what does not exist yet is appended as it is.
fn resolved(path: &Path) -> PathBuf {
    if let Ok(whole) = path.canonicalize() {
        return whole;
    }
    match path.file_name() {
        Some(name) => resolved(&publish::parent_of(path)).join(name),
        None => std::path::absolute(Path::new(".").join(path)).unwrap_or_else(|_| path.into()),
    }
}

impl Drop for Stage {
    fn drop(&mut self) {
        self.progress.finish_and_clear();
    }
}

/// The most memory that this process has held, in 2^20 bytes, where the system tells (Linux).
fn peak_memory_mb() -> Option<f64> {
    let status = fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"))?;
    let kilobytes: f64 = line.trim().strip_suffix("kB")?.trim().parse().ok()?;
    Some((kilobytes / 1024.0).round())
}

/// Whether the output directory is there; an error when it is something else or cannot be.
fn output_exists(dir: &Path) -> Result<bool, HandoffError> {
    let problem = match fs::metadata(dir) {
        Ok(m) if m.is_dir() => return Ok(true),
        Ok(_) => "is a file".into(),
        Err(e) if e.kind() == ErrorKind::NotFound => {
            if fs::symlink_metadata(dir).is_ok() {
                "is a link to nothing".into()
            } else if dir.file_name().is_none() {
                "is not the name of a directory".into()
            } else {
                return Ok(false);
            }
        }
        Err(e) => format!("cannot be written: {e}"),
    };
    Err(HandoffError::new(dir, format!("{problem}; choose another --out")))
}

/// Whether the file was written before this program was built: a developer changed the program,
/// and its version does not say so.
fn older_than_this_program(file: &Path) -> bool {
    let modified = |path: &Path| fs::metadata(path).and_then(|m| m.modified()).ok();
    let program = std::env::current_exe().ok().and_then(|p| modified(&p));
    matches!((modified(file), program), (Some(f), Some(p)) if f < p)
}

fn with_status(outcome: Value, status: &Status) -> Value {
    let mut map = serde_json::Map::new();
    match status {
        Status::Done => map.insert("status".into(), "done".into()),
        Status::Negative(reason) => {
            map.insert("status".into(), "negative".into());
            map.insert("reason".into(), reason.as_str().into())
        }
    };
    match outcome {
        Value::Object(fields) => map.extend(fields),
        Value::Null => {}
        other => panic!("an outcome is a JSON object, found {other}"),
    }
    map.into()
}

fn status_of(manifest: &Manifest) -> Status {
    let text = |key| manifest.outcome.get(key).and_then(Value::as_str).unwrap_or_default();
    match text("status") {
        "negative" => Status::Negative(text("reason").into()),
        _ => Status::Done,
    }
}

/// The command line, quoted for a shell, under the plain name of the program.
fn command_line(tool: &str) -> String {
    let plain = |c: char| c.is_ascii_alphanumeric() || "-_./=:,+@%".contains(c);
    let quote = |a: String| match a.is_empty() || !a.chars().all(plain) {
        true => format!("'{}'", a.replace('\'', r"'\''")),
        false => a,
    };
    let arguments = std::env::args_os().skip(1).map(|a| quote(a.to_string_lossy().into_owned()));
    std::iter::once(tool.to_string()).chain(arguments).collect::<Vec<_>>().join(" ")
}
