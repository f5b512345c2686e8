//! Runs of stages as processes of their own, several at the same time.

use std::{
    fs,
    io::{BufRead, BufReader},
    path::{Path, PathBuf},
    process::Stdio,
    sync::{
        Mutex,
        atomic::{AtomicUsize, Ordering},
    },
    thread,
    time::SystemTime,
};

use planish_handoff::{Failure, Running, as_command, stage_command};
use planish_sweep::plan::Step;

/// Result of the process of a stage.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum End {
    /// Done: exit code 0.
    Done,
    /// Done with a negative verdict: exit code 1, with the reason.
    Negative(String),
    /// Not able to run: exit code 2, with the message.
    Failed(String),
    /// Killed by a signal, or ended with a code that no stage has; the text describes which.
    Killed(String),
}

/// Starter of stages: the folder of their programs, and the directory in which they run.
#[derive(Clone, Debug)]
pub struct Stages {
    /// Folder of the programs, which is that of this program.
    programs: PathBuf,
    /// Directory of the sweep.
    dir: PathBuf,
}

impl Stages {
    /// Creates a starter for the programs in the folder of this program; they run in `dir`.
    ///
    /// # Errors
    /// Fails if the system does not tell where this program is.
    pub fn beside(dir: &Path) -> Result<Self, Failure> {
        let program = std::env::current_exe()
            .map_err(|e| Failure::new(format!("this program does not know where it is: {e}")))?;
        let programs = program.parent().unwrap_or(Path::new(".")).to_path_buf();
        Ok(Self { programs, dir: dir.into() })
    }

    /// Returns the build time of the newest of these programs and of this one; `None` if the system does not tell it.
    pub fn newest(&self, programs: &[&str]) -> Option<SystemTime> {
        let files = programs.iter().map(|name| self.programs.join(name));
        let files = files.chain(std::env::current_exe().ok());
        files.filter_map(|file| fs::metadata(file).ok()?.modified().ok()).max()
    }

    /// Runs a stage to its end, on one core. The stage is ended if this process ends.
    ///
    /// # Errors
    /// Fails if its program cannot be run.
    pub fn run(&self, step: &Step) -> Result<End, Failure> {
        let program = self.programs.join(&step.program);
        let cannot =
            |e: std::io::Error| Failure::new(format!("{}: cannot run: {e}", program.display()));
        let mut command = stage_command(&step.program, [self.programs.clone()]);
        command
            .args(&step.arguments)
            .current_dir(&self.dir)
            // One plan per core: threads within a stage would wait for each other.
            .env("RAYON_NUM_THREADS", "1")
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(Stdio::piped());
        let mut child = Running::start(&mut command).map_err(cannot)?;
        // Of all that it says the last line that is an end counts.
        let mut last_line = None;
        if let Some(stderr) = child.stderr() {
            for line in BufReader::new(stderr).split(b'\n').map_while(Result::ok) {
                let line = String::from_utf8_lossy(&line).into_owned();
                if ["error: ", "verdict: ", "internal error: "]
                    .iter()
                    .any(|start| line.starts_with(start))
                {
                    last_line = Some(line);
                }
            }
        }
        let status = child.wait().map_err(cannot)?;
        let message = last_line.as_deref().unwrap_or("it said nothing");
        let verdict = message.strip_prefix("verdict: ").unwrap_or(message);
        let error = message.strip_prefix("error: ").unwrap_or(message);
        Ok(match status.code() {
            Some(0) => End::Done,
            Some(1) => End::Negative(format!("{}: {verdict}", as_command(&step.program))),
            Some(2) => End::Failed(format!("{}: {error}", as_command(&step.program))),
            _ => End::Killed(format!("{}: {status}", as_command(&step.program))),
        })
    }

    /// Runs stages one after the other and stops at the first that failed or was killed. Returns the result of that
    /// one, otherwise the first negative verdict, otherwise `Done`.
    ///
    /// # Errors
    /// Fails if a program cannot be run.
    pub fn run_all(&self, steps: &[Step]) -> Result<End, Failure> {
        let mut end = End::Done;
        for step in steps {
            match self.run(step)? {
                End::Done => {}
                negative @ End::Negative(_) if end == End::Done => end = negative,
                End::Negative(_) => {}
                stop => return Ok(stop),
            }
        }
        Ok(end)
    }
}

/// Does `work` for every item in their order, for `at_once` of them at the same time. After the first error no
/// further item begins, but those under way are finished.
///
/// # Errors
/// Fails with the first error of the work.
pub fn each<T: Sync>(
    items: &[T],
    at_once: usize,
    work: impl Fn(&T) -> Result<(), Failure> + Sync,
) -> Result<(), Failure> {
    let next = AtomicUsize::new(0);
    let error = Mutex::new(None);
    thread::scope(|scope| {
        for _ in 0..at_once.min(items.len()) {
            scope.spawn(|| {
                while let Some(item) = items.get(next.fetch_add(1, Ordering::Relaxed)) {
                    if let Err(failure) = work(item) {
                        next.store(items.len(), Ordering::Relaxed);
                        error
                            .lock()
                            .expect("no worker panics with the lock")
                            .get_or_insert(failure);
                    }
                }
            });
        }
    });
    error.into_inner().expect("no worker panics with the lock").map_or(Ok(()), Err)
}

/// Returns the processor time of all stages that have ended, s; `None` if the system does not tell it (other than
/// Linux).
pub fn processor_s_of_stages() -> Option<f64> {
    let stat = fs::read_to_string("/proc/self/stat").ok()?;
    // After the name, which is in brackets and may hold anything: state is field 3, cutime and cstime are 16 and 17.
    let fields: Vec<&str> = stat.rsplit_once(')')?.1.split_whitespace().collect();
    let user: f64 = fields.get(16 - 3)?.parse().ok()?;
    let system: f64 = fields.get(17 - 3)?.parse().ok()?;
    // Linux tells these in 1/100 s on every machine.
    Some((user + system) / 100.0)
}
