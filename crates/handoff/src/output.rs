//! Outputs of a command: artifact directories, and single files.
//!
//! All outputs of one run appear, whole, when the last of them has been written.

use std::{
    fs::{self, File},
    io::ErrorKind,
    path::{Path, PathBuf},
    sync::{Arc, Mutex, PoisonError},
    thread,
    time::{Duration, Instant, SystemTime},
};

use indicatif::{HumanDuration, ProgressBar, ProgressDrawTarget, ProgressStyle};
use planish_types::{
    outcome::{StageEnd, StageStatus, WallTime},
    progress,
};
use serde::Serialize;
use serde_json::{Value, json};

use crate::{
    HandoffError,
    arguments::as_command,
    artifact::{self, Artifact, Manifest},
    command_line,
    flags::OutputArgs,
    from_run::before_the_work,
    inputs::{Inputs, LARGEST_JSON_BYTES, is_same},
    kind::{Kind, MANIFEST},
    message::complain,
    npy::ArrayData,
    place::{is_within, obstacle, parent_of, plain, refuse_foreign_files, special_file},
    publish::{self, Staged},
    shell::{Failure, Status, say},
    telling,
};

/// Period at which the progress on a terminal is redrawn, and delay before it first appears.
/// Larger: the bar lags. Smaller: short stages flash a bar.
const PROGRESS_PERIOD: Duration = Duration::from_millis(250);

/// Number of steps of the progress bar. Larger: no visible change. Smaller: the bar moves in jumps,
/// and the remaining time is estimated later.
const PROGRESS_STEPS: u64 = 1000;

/// Running time after which a run prints its remaining time, when no terminal shows the bar. It prints again whenever
/// the running time has doubled. Larger: a long run is silent for longer. Smaller: short runs print it, too.
const FIRST_TOLD_AFTER: Duration = Duration::from_secs(20);

/// Description of the work of a run: the program, its method, and every setting with its resolved value. Together
/// with the hashes of the inputs, it decides whether an output is up to date.
#[derive(Clone, Debug)]
pub struct Task {
    tool: &'static str,
    tool_version: &'static str,
    method: String,
    settings: Value,
}

impl Task {
    /// Describes the work of version `tool_version` of the program `tool` by `method` with these `settings`. The
    /// macro [`task!`](crate::task) fills in the first two.
    pub fn new(
        tool: &'static str,
        tool_version: &'static str,
        method: &str,
        settings: impl Serialize,
    ) -> Self {
        let settings = serde_json::to_value(settings).expect("settings serialise to JSON");
        Self { tool, tool_version, method: method.into(), settings }
    }
}

/// `task!(method, settings)`: the [`Task`] of the package that calls the macro.
#[macro_export]
macro_rules! task {
    ($method:expr, $settings:expr) => {
        $crate::Task::new(env!("CARGO_PKG_NAME"), env!("CARGO_PKG_VERSION"), $method, $settings)
    };
}

/// Announced outputs of a run: artifact directories, and files beside them.
#[derive(Debug)]
pub struct Output {
    args: OutputArgs,
    directories: Vec<Directory>,
    files: Vec<(&'static str, PathBuf)>,
    /// Kind of the artifacts of which `--out` holds nothing but those of this run; `None` for other outputs.
    only: Option<&'static Kind>,
}

#[derive(Debug)]
struct Directory {
    /// Flag by which the user gave the path, such as `--out`.
    flag: &'static str,
    path: PathBuf,
    kind: &'static Kind,
}

/// Result of the check whether the outputs have to be made.
#[derive(Debug)]
pub enum Begin {
    /// The output exists and was made from the same inputs and settings. Its run ended with this status.
    Unchanged(Status),
    /// There is work to do; the writer writes the announced outputs.
    Run(Box<Writer>),
}

impl Begin {
    /// Returns the writer of the outputs; `None` if there is no work to do.
    pub fn writer(self) -> Option<Writer> {
        match self {
            Self::Unchanged(_) => None,
            Self::Run(writer) => Some(*writer),
        }
    }
}

impl Output {
    /// Announces one artifact of this kind as the output, in the directory `--out`. `args` are the flags of the output.
    pub fn directory(args: &OutputArgs, kind: &'static Kind) -> Self {
        Self::nothing(args).and_directory("--out", &args.out, kind)
    }

    /// Announces several artifacts as the output. `parts` are the names of their directories in `--out`, and their
    /// kinds. `args` are the flags of the output.
    pub fn directories<const N: usize>(
        args: &OutputArgs,
        parts: [(&str, &'static Kind); N],
    ) -> Self {
        let mut output = Self::nothing(args);
        for (name, kind) in parts {
            output = output.and_directory("--out", &args.out.join(name), kind);
        }
        output
    }

    /// Announces several artifacts of one kind as the output, in the directories of these `names` in `--out`. They have
    /// to be written in this order, but for those that [`Writer::leave_out`] names. Artifacts of other names that the
    /// same method left in `--out` go away when the output appears. `args` are the flags of the output.
    pub fn of_one_kind(args: &OutputArgs, names: &[&str], kind: &'static Kind) -> Self {
        let mut output = Self { only: Some(kind), ..Self::nothing(args) };
        for name in names {
            output.directories.push(Directory {
                flag: "--out",
                path: plain(&args.out.join(name)),
                kind,
            });
        }
        output
    }

    fn nothing(args: &OutputArgs) -> Self {
        Self { args: args.clone(), directories: Vec::new(), files: Vec::new(), only: None }
    }

    /// Announces a further artifact, in the directory `path` that the user gave by `flag`.
    pub fn and_directory(mut self, flag: &'static str, path: &Path, kind: &'static Kind) -> Self {
        let is_new = self.directories.iter().all(|d| d.kind.name != kind.name);
        assert!(is_new, "a run writes one {} at most: its kind says where it goes", kind.name);
        self.directories.push(Directory { flag, path: plain(path), kind });
        self
    }

    /// Announces a further file at `path`, such as a picture of the artifact, that the user gave by `flag`.
    pub fn and_file(mut self, flag: &'static str, path: &Path) -> Self {
        self.files.push((flag, plain(path)));
        self
    }

    /// Checks the outputs. Call it before the work, when all inputs and settings are known. It refuses an output that
    /// must not be replaced, and tells the user if there is nothing to do. `task` describes the work.
    pub fn begin(self, task: &Task, inputs: &Inputs) -> Result<Begin, HandoffError> {
        before_the_work();
        self.check_wall_time(inputs)?;
        self.refuse_overlap_within()?;
        let key = key(task, inputs);
        let states = self.directories.iter().map(|d| self.state_of(d, &key, inputs));
        let states = states.collect::<Result<Vec<_>, _>>()?;
        let left_over = self.left_over(task, inputs)?;
        let unchanged: Option<Vec<Status>> = states.into_iter().collect();
        if let Some(each) = unchanged
            && left_over.is_empty()
            && self.files.iter().all(|(_, path)| path.exists())
        {
            let out = self.args.out.display();
            say(format!("{}: {out} unchanged, nothing to do", as_command(task.tool)));
            for Directory { path, kind, .. } in &self.directories {
                let outcome = artifact::read_manifest(path, kind)?.map(|manifest| manifest.outcome);
                telling::keep_output(path, kind.name, outcome.unwrap_or_default());
            }
            let negative = each.into_iter().find(|status| *status != Status::Done);
            return Ok(Begin::Unchanged(negative.unwrap_or(Status::Done)));
        }
        for (flag, path) in &self.files {
            check_file(flag, path, self.args.force, inputs)?;
        }
        let mut writer = self.writer(task, inputs);
        writer.left_over = left_over;
        Ok(Begin::Run(Box::new(writer)))
    }

    /// Returns the artifacts in `--out` that the same method left under other names than those of this run. Without
    /// `--force` they are an error.
    fn left_over(&self, task: &Task, inputs: &Inputs) -> Result<Vec<Directory>, HandoffError> {
        let Some(kind) = self.only else { return Ok(Vec::new()) };
        let Ok(entries) = fs::read_dir(&self.args.out) else { return Ok(Vec::new()) };
        let mut left_over = Vec::new();
        for path in entries.flatten().map(|entry| plain(&entry.path())) {
            let is_of_this_run = self.directories.iter().any(|d| is_same(&d.path, &path));
            if is_of_this_run
                || publish::is_temporary(&path.file_name().unwrap_or_default().to_string_lossy())
            {
                continue;
            }
            // Whatever is no artifact of this kind is not ours to remove.
            let Ok(Some(manifest)) = artifact::read_manifest(&path, kind) else { continue };
            if manifest.tool != task.tool || manifest.method != task.method {
                continue;
            }
            inputs.refuse_overlap("--out", &path)?;
            if !self.args.force {
                let problem = "is left over from a run with other names; give --force to remove it, or another --out";
                return Err(HandoffError::new(&path, problem));
            }
            left_over.push(Directory { flag: "--out", path, kind });
        }
        Ok(left_over)
    }

    /// Returns the status of the existing artifact if it is the one that this run would make; otherwise `None`. `key`
    /// is the key of the work. An artifact that must not be replaced is an error.
    fn state_of(
        &self,
        directory: &Directory,
        key: &str,
        inputs: &Inputs,
    ) -> Result<Option<Status>, HandoffError> {
        let Directory { flag, path: dir, kind } = directory;
        inputs.refuse_overlap(flag, dir)?;
        publish::remove_abandoned(&parent_of(dir));
        if !output_exists(flag, dir)? {
            return Ok(None);
        }
        if is_same(dir, Path::new(".")) {
            let problem = format!("is the current directory; give a new directory in it as {flag}");
            return Err(HandoffError::new(dir, problem));
        }
        refuse_foreign_files(dir, kind)?;
        let Some(manifest) = artifact::read_manifest(dir, kind)? else {
            return Ok(None); // an empty directory
        };
        let is_complete = artifact::is_complete(dir, &manifest)?;
        if manifest.key == key {
            let is_fresh = !older_than_this_program(&dir.join(MANIFEST));
            return Ok(if is_fresh && is_complete { Some(status_of(&manifest)) } else { None });
        }
        if self.args.force {
            return Ok(None);
        }
        let problem = format!(
            "exists, made from other inputs or settings; give --force to replace it, or another {flag}"
        );
        Err(HandoffError::new(dir, problem))
    }

    /// Refuses two outputs of which one would replace or contain the other.
    fn refuse_overlap_within(&self) -> Result<(), HandoffError> {
        for (i, one) in self.directories.iter().enumerate() {
            for other in &self.directories[..i] {
                if is_within(&one.path, &other.path) || is_within(&other.path, &one.path) {
                    let problem = format!(
                        "and {} are in each other's place; give another {}",
                        other.path.display(),
                        one.flag
                    );
                    return Err(HandoffError::new(&one.path, problem));
                }
            }
        }
        for (flag, file) in &self.files {
            if self.directories.iter().any(|d| is_within(file, &d.path)) {
                let problem = format!("is in the output; give another {flag}");
                return Err(HandoffError::new(file, problem));
            }
        }
        Ok(())
    }

    /// Refuses a `--wall-time` file that exists and holds something else, that lies in an output, or that is an input
    /// or lies in one.
    fn check_wall_time(&self, inputs: &Inputs) -> Result<(), HandoffError> {
        let Some(file) = &self.args.wall_time else { return Ok(()) };
        if self.directories.iter().any(|d| is_within(file, &d.path)) {
            return Err(HandoffError::new(file, "is in the output; give another --wall-time"));
        }
        inputs.refuse_overlap("--wall-time", file)?;
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

    /// Creates the writer of the announced outputs.
    fn writer(self, task: &Task, inputs: &Inputs) -> Writer {
        let were_there: Vec<bool> = self.directories.iter().map(|d| d.path.exists()).collect();
        Writer {
            manifest: Manifest {
                tool: task.tool.into(),
                tool_version: task.tool_version.into(),
                method: task.method.clone(),
                command: command_line::as_typed(task.tool),
                key: key(task, inputs),
                settings: task.settings.clone(),
                inputs: inputs.records.clone(),
                lineage: inputs.lineage.clone(),
                ..Manifest::default()
            },
            directories: self.directories.into_iter().zip(were_there).collect(),
            files: self.files.into_iter().map(|(_, path)| path).collect(),
            force: self.args.force,
            wall_time: self.args.wall_time,
            started: inputs.started,
            staged: Vec::new(),
            left_over: Vec::new(),
            frame: None,
            progress: shown_progress(format!("{} {}", as_command(task.tool), task.method)),
            rounds: watched_rounds(),
        }
    }
}

/// Returns the hash of the work and the hashes of its inputs. An existing output with the same key is the one that
/// this run would make.
fn key(task: &Task, inputs: &Inputs) -> String {
    let inputs: Vec<_> = inputs.records.iter().map(|i| (&i.role, &i.kind, &i.blake3)).collect();
    let key = json!([task.tool, task.tool_version, task.method, task.settings, inputs]);
    blake3::hash(key.to_string().as_bytes()).to_string()
}

/// Writer of the outputs that an [`Output`] announced, each once. All of them appear when the last
/// one is written, directories before files.
#[derive(Debug)]
pub struct Writer {
    /// Manifest with the fields that all artifacts of the run share.
    manifest: Manifest,
    /// Artifact directories that are not written yet. The flag of each is true if it existed when the run began.
    directories: Vec<(Directory, bool)>,
    files: Vec<PathBuf>,
    force: bool,
    wall_time: Option<PathBuf>,
    started: Instant,
    /// Outputs that are written to temporary places and not visible yet.
    staged: Vec<Staged>,
    /// Artifacts of an earlier run that go away when the outputs appear.
    left_over: Vec<Directory>,
    progress: ProgressBar,
    /// Duration of each round of the work (of an iterative method) that has ended, s.
    rounds: Arc<Mutex<Vec<f64>>>,
    /// Frame that the coordinates refer to, in words for the manifest; `None` if it is that of the kind.
    frame: Option<&'static str>,
}

impl Writer {
    /// Sets the frame of the coordinates of the artifacts of this run, if it is not that of their
    /// kind: machine coordinates, for example.
    pub fn set_frame(&mut self, frame: &'static str) {
        self.frame = Some(frame);
    }

    /// Does without the announced artifact in the directory of this name in `--out`. One that an earlier run left there
    /// goes away when the outputs appear.
    pub fn leave_out(&mut self, name: &str) {
        let has_name = |d: &Directory| d.path.file_name().is_some_and(|own| own == name);
        let index = self.directories.iter().position(|(d, _)| has_name(d));
        let index = index.unwrap_or_else(|| panic!("no {name} is to be written"));
        let (directory, was_there) = self.directories.remove(index);
        if was_there {
            self.left_over.push(directory);
        }
    }

    /// Returns the time of each round of the work so far, s ([`progress::round_ended`]); empty if it has no rounds.
    pub fn round_s(&self) -> Vec<f64> {
        self.rounds.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Writes `value` as the announced artifact of its kind, with the `outcome` and `status` of the stage in the
    /// manifest. Of several artifacts of this kind it is the next one.
    ///
    /// # Errors
    /// Fails if the disk refuses it, or if another program has meanwhile created something at the path.
    pub fn write<T: Artifact>(
        &mut self,
        value: &T,
        outcome: impl Serialize,
        status: &Status,
    ) -> Result<(), HandoffError> {
        self.write_arrays(T::KIND, &value.to_arrays(), &[], outcome, status)
    }

    /// Writes the announced artifact of this kind from its arrays, the next one if there are several. `beside` are the
    /// names and contents of further files in its directory.
    ///
    /// # Errors
    /// Fails if the disk refuses it, or if another program has meanwhile created something at the path.
    pub fn write_arrays(
        &mut self,
        kind: &'static Kind,
        arrays: &[ArrayData],
        beside: &[(&str, Vec<u8>)],
        outcome: impl Serialize,
        status: &Status,
    ) -> Result<(), HandoffError> {
        let index = self.directories.iter().position(|(d, _)| d.kind.name == kind.name);
        let index = index.unwrap_or_else(|| panic!("no {} is to be written", kind.name));
        for (name, _) in beside {
            assert!(kind.files.contains(name), "{name} is no file of a {}", kind.name);
        }
        let (directory, was_there) = &self.directories[index];
        let staged = Staged::directory(&directory.path, kind, self.force || *was_there)?;
        let dir = staged.path();
        let records = artifact::write_arrays(dir, kind, arrays)?;
        for (name, bytes) in beside {
            artifact::write_file(&dir.join(name), bytes)?;
        }
        let files =
            beside.iter().map(|(name, bytes)| (name.to_string(), blake3::hash(bytes).to_string()));
        let manifest = Manifest {
            kind: kind.name.into(),
            version: kind.version_of(arrays.len()),
            frame: self.frame.unwrap_or(kind.frame).into(),
            outcome: with_status(outcome, status),
            arrays: records,
            files: files.collect(),
            ..self.manifest.clone()
        };
        artifact::write_file(&dir.join(MANIFEST), manifest.to_text().as_bytes())?;
        telling::keep_output(&directory.path, kind.name, manifest.outcome);
        self.directories.remove(index);
        self.staged.push(staged);
        self.show_when_complete()
    }

    /// Writes the announced file `path`.
    ///
    /// # Errors
    /// Fails if the disk refuses it, or if another program has meanwhile created something at the path.
    pub fn write_file(&mut self, path: &Path, bytes: &[u8]) -> Result<(), HandoffError> {
        let index = self.files.iter().position(|p| p == path);
        let index = index.unwrap_or_else(|| panic!("no {} is to be written", path.display()));
        let mut staged = Staged::file(path, self.force)?;
        staged.write_all(bytes)?;
        telling::keep_output(path, "file", Value::Null);
        self.files.remove(index);
        self.staged.push(staged);
        self.show_when_complete()
    }

    /// Makes all outputs visible if the last one has been written.
    fn show_when_complete(&mut self) -> Result<(), HandoffError> {
        if !(self.directories.is_empty() && self.files.is_empty()) {
            return Ok(()); // more is to come
        }
        for Directory { path, kind, .. } in std::mem::take(&mut self.left_over) {
            self.staged.push(Staged::removal(&path, kind)?);
        }
        // A file says nothing of the run that made it. So it is the last: where it is, its artifact is the new one.
        self.staged.sort_by_key(Staged::is_file);
        publish::publish(std::mem::take(&mut self.staged))?;
        // The bar is removed first, so that later messages are not mixed with it.
        self.progress.finish_and_clear();
        self.write_wall_time()
    }

    fn write_wall_time(&self) -> Result<(), HandoffError> {
        let Some(path) = &self.wall_time else { return Ok(()) };
        let time = WallTime {
            wall_s: self.started.elapsed().as_secs_f64(),
            peak_memory_mb: peak_memory_mb(),
        };
        let text = serde_json::to_string(&time).expect("numbers serialise");
        show_file(path, true, format!("{text}\n").as_bytes())
    }
}

impl Drop for Writer {
    fn drop(&mut self) {
        self.progress.finish_and_clear();
    }
}

/// Starts the progress display on a terminal: the name of the work and its elapsed time. As soon as the work reports a
/// fraction, it adds a bar and the remaining time. In a pipe it prints the remaining time of a long run on a few lines
/// ([`FIRST_TOLD_AFTER`]). `message` is the name of the work.
fn shown_progress(message: String) -> ProgressBar {
    let style = |template| ProgressStyle::with_template(template).expect("a valid template");
    let bar = ProgressBar::hidden();
    bar.set_style(style("{spinner} {msg} {elapsed}"));
    bar.set_message(message.clone());
    bar.set_draw_target(ProgressDrawTarget::stderr());
    bar.enable_steady_tick(PROGRESS_PERIOD);
    let of_work = bar.clone();
    if bar.is_hidden() {
        tell_in_lines(message, &bar);
        return bar;
    }
    progress::watch(move |fraction| {
        let steps = (fraction * PROGRESS_STEPS as f64) as u64;
        if steps == 0 {
            return; // nothing to judge by how long the rest will take
        }
        if of_work.length().is_none() {
            of_work.set_style(style("{msg} {wide_bar} {percent} % {elapsed}, about {eta} left"));
            of_work.set_length(PROGRESS_STEPS);
        }
        of_work.set_position(steps);
    });
    bar
}

/// Prints lines with the remaining time of a long run, from a thread of its own, until `bar` is finished. The first
/// comes after [`FIRST_TOLD_AFTER`], each further one after twice the time of the one before.
fn tell_in_lines(message: String, bar: &ProgressBar) {
    let done = Arc::new(Mutex::new(0.0));
    let reported = done.clone();
    progress::watch(move |fraction| {
        *reported.lock().unwrap_or_else(PoisonError::into_inner) = fraction;
    });
    let bar = bar.downgrade();
    thread::spawn(move || {
        let mut due = FIRST_TOLD_AFTER;
        let mut slept = Duration::ZERO;
        loop {
            thread::sleep(due - slept);
            slept = due;
            if bar.upgrade().is_none_or(|bar| bar.is_finished()) {
                return;
            }
            let fraction = *done.lock().unwrap_or_else(PoisonError::into_inner);
            complain(&format!("{message}: {}", line_after(due, fraction)));
            due *= 2;
        }
    });
}

/// Returns the line that tells the progress of a run, which has worked for the time `after`. `fraction` of the work
/// is done. The rest takes
///
/// ```text
/// after (1 - fraction) / fraction
/// ```
///
/// if the work goes on as fast as before. It is not known while less than one step of the bar is done.
fn line_after(after: Duration, fraction: f64) -> String {
    let so_far = HumanDuration(after);
    if fraction * (PROGRESS_STEPS as f64) < 1.0 {
        return format!("{so_far} so far; its steps do not show yet how long it will take");
    }
    let rest = HumanDuration(after.mul_f64((1.0 - fraction.min(1.0)) / fraction));
    format!(
        "{so_far} so far, {:.0} % done; if it goes on like this, it takes about {rest} more",
        100.0 * fraction
    )
}

/// Returns a list that receives the time, s, of every round that ends from now on.
fn watched_rounds() -> Arc<Mutex<Vec<f64>>> {
    let rounds = Arc::new(Mutex::new(Vec::new()));
    let to = rounds.clone();
    let begun = Mutex::new(Instant::now());
    progress::watch_rounds(move || {
        let mut begun = begun.lock().unwrap_or_else(PoisonError::into_inner);
        let took = begun.elapsed();
        *begun += took;
        to.lock().unwrap_or_else(PoisonError::into_inner).push(took.as_secs_f64());
    });
    rounds
}

/// Writes `value` as the artifact `dir`, without inputs, and replaces an existing one. It is for
/// programs that make inputs of their own, such as tests.
///
/// # Errors
/// Fails if the disk refuses it, or if `dir` holds something else than an artifact of this kind.
pub fn save<T: Artifact>(dir: &Path, value: &T) -> Result<(), HandoffError> {
    let args = OutputArgs { out: dir.into(), force: true, wall_time: None };
    let task = crate::task!("save", json!({}));
    let mut writer = Output::directory(&args, T::KIND).writer(&task, &Inputs::new());
    writer.write(value, json!({}), &Status::Done)
}

/// Output of a command that is a single file without a manifest, checked and not written yet.
#[derive(Debug)]
pub struct OutputFile {
    path: PathBuf,
    force: bool,
}

impl OutputFile {
    /// Checks the file; call it before the work. It refuses `path`, given by `flag`, if it is an input, lies in one, is
    /// a directory, or cannot be made. It also refuses an existing file, unless `force` is true.
    pub fn begin(
        flag: &str,
        path: &Path,
        force: bool,
        inputs: &Inputs,
    ) -> Result<Self, HandoffError> {
        before_the_work();
        check_file(flag, path, force, inputs)?;
        Ok(Self { path: plain(path), force })
    }

    /// Writes `bytes` as the whole file.
    ///
    /// # Errors
    /// Fails if the disk refuses it, or if another program has meanwhile created something at the path.
    pub fn write(self, bytes: &[u8]) -> Result<(), HandoffError> {
        telling::keep_output(&self.path, "file", Value::Null);
        show_file(&self.path, self.force, bytes)
    }

    /// Writes a file that is too large for memory: `write` gets the open file.
    ///
    /// # Errors
    /// Fails if `write` fails, if the disk refuses it, or if another program has meanwhile created something at the
    /// path.
    pub fn write_by(
        self,
        write: impl FnOnce(&mut File) -> Result<(), Failure>,
    ) -> Result<(), Failure> {
        let mut staged = Staged::file(&self.path, self.force)?;
        write(staged.open_file())?;
        Ok(publish::publish(vec![staged])?)
    }

    /// Writes several files, given with their contents, which become visible together.
    ///
    /// # Errors
    /// Fails if the disk refuses one of them, or if another program has meanwhile created something at a path. None of
    /// the new files is then visible.
    pub fn write_together<'a>(
        files: impl IntoIterator<Item = (Self, &'a [u8])>,
    ) -> Result<(), HandoffError> {
        let mut all = Vec::new();
        for (file, bytes) in files {
            let mut staged = Staged::file(&file.path, file.force)?;
            staged.write_all(bytes)?;
            all.push(staged);
        }
        publish::publish(all)
    }
}

/// Refuses a path at which the file given by `flag` cannot be written, or would replace something that must stay.
/// `force` allows it to replace a regular file.
fn check_file(flag: &str, path: &Path, force: bool, inputs: &Inputs) -> Result<(), HandoffError> {
    let path = &*plain(path);
    inputs.refuse_overlap(flag, path)?;
    if path.is_dir() || path.file_name().is_none() {
        return Err(HandoffError::new(path, format!("is a directory; give a file as {flag}")));
    }
    if let Some(above) = obstacle(path) {
        let problem = format!("cannot be made: {} is not a directory", above.display());
        return Err(HandoffError::new(path, format!("{problem}; choose another {flag}")));
    }
    if let Some(problem) = special_file(path) {
        return Err(HandoffError::new(path, format!("{problem}; choose another {flag}")));
    }
    if fs::symlink_metadata(path).is_ok() && !force {
        let problem = format!("exists; give --force to replace it, or another {flag}");
        return Err(HandoffError::new(path, problem));
    }
    Ok(())
}

/// Writes `bytes` as a file and makes it visible. `replace` allows it to replace a regular file. `path` is the final
/// path.
fn show_file(path: &Path, replace: bool, bytes: &[u8]) -> Result<(), HandoffError> {
    let mut staged = Staged::file(path, replace)?;
    staged.write_all(bytes)?;
    publish::publish(vec![staged])
}

/// Returns the peak memory of this process, MiB; `None` if the system does not report it (other than Linux).
fn peak_memory_mb() -> Option<f64> {
    let status = fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"))?;
    let kilobytes: f64 = line.trim().strip_suffix("kB")?.trim().parse().ok()?;
    Some((kilobytes / 1024.0).round())
}

/// Returns true if the output directory exists. A path that is something else, or cannot be created, is an error.
/// `flag` gave it, for the message.
fn output_exists(flag: &str, dir: &Path) -> Result<bool, HandoffError> {
    let problem = match fs::metadata(dir) {
        Ok(m) if m.is_dir() => return Ok(true),
        Ok(m) if m.is_file() => "is a file".into(),
        Ok(_) => "is neither a file nor a directory".into(),
        Err(e) if e.kind() == ErrorKind::NotFound => {
            if fs::symlink_metadata(dir).is_ok() {
                "is a link to nothing".into()
            } else if dir.file_name().is_none() {
                "is not the name of a directory".into()
            } else if let Some(above) = obstacle(dir) {
                format!("cannot be made: {} is not a directory", above.display())
            } else {
                return Ok(false);
            }
        }
        Err(e) => format!("cannot be written: {e}"),
    };
    Err(HandoffError::new(dir, format!("{problem}; choose another {flag}")))
}

/// Returns true if the file was written before this program was built. A developer may change the
/// program without a change of its version.
fn older_than_this_program(file: &Path) -> bool {
    let program = std::env::current_exe().ok().and_then(|program| modified(&program));
    matches!((modified(file), program), (Some(f), Some(p)) if f < p)
}

/// Returns the time at which a file was last changed; `None` if the system does not tell it.
fn modified(path: &Path) -> Option<SystemTime> {
    fs::metadata(path).and_then(|metadata| metadata.modified()).ok()
}

/// Returns the outcome as a manifest stores it: the status of the stage, then the fields of `outcome`.
fn with_status(outcome: impl Serialize, status: &Status) -> Value {
    let end = match status {
        Status::Done => StageEnd { status: Some(StageStatus::Done), reason: None },
        Status::Negative(reason) => {
            StageEnd { status: Some(StageStatus::Negative), reason: Some(reason.clone()) }
        }
    };
    let mut whole = serde_json::to_value(end).expect("a status serialises");
    match serde_json::to_value(outcome).expect("an outcome serialises to JSON") {
        Value::Object(fields) => whole.as_object_mut().expect("a struct").extend(fields),
        Value::Null => {}
        other => panic!("an outcome is a JSON object, found {other}"),
    }
    whole
}

/// Returns the status of the run that wrote a manifest.
fn status_of(manifest: &Manifest) -> Status {
    match manifest.end() {
        StageEnd { status: Some(StageStatus::Negative), reason } => {
            Status::Negative(reason.unwrap_or_default())
        }
        _ => Status::Done,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_tell_the_rest() {
        let at = |seconds, fraction| line_after(Duration::from_secs(seconds), fraction);
        assert!(at(20, 1e-4).ends_with("its steps do not show yet how long it will take"));
        let line = at(40, 0.25);
        assert!(line.contains("25 % done"), "{line}");
        assert!(line.ends_with("takes about 2 minutes more"), "{line}"); // 40 s 0.75 / 0.25 = 120 s
        assert!(at(640, 1.0).ends_with("takes about 0 seconds more"));
        assert!(at(20, 0.94).ends_with("takes about 1 second more")); // 20 s 0.06 / 0.94 = 1.3 s
    }
}
