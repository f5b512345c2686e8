//! Execution of the steps of a stage: every command is printed before it runs, and one place decides on exit codes.

use std::{
    env, ffi,
    fs::{self, File},
    io::{self, Read, Write},
    path::{Path, PathBuf},
    process::{Command as Process, ExitStatus, Stdio},
};

use planish_handoff::{Failure, Running, say, words};
use planish_pipeline::{
    scope::Scope,
    walk::{Command, Step, Walk},
};

use super::{
    claim::{Claim, Named, refuse_special},
    place::Place,
    program::{Answer, plan_of},
};

/// Artifacts without which a method or a dwell solver is left out of a comparison.
const LEFT_OUT: [&str; 2] = ["dwell", "trajectory"];
/// File with what an attempt says, in its directory.
const MESSAGE: &str = "message.txt";

/// Code of a process that a signal ended. No stage has it.
const KILLED: u8 = 128;

/// Destination of the messages of a run.
pub enum Said {
    /// The user's terminal.
    Shown,
    /// This file, which is shown if a command fails.
    Kept(File),
}

/// Exit code of a run, 0, 1 or 2, and what its names stand for at its end. The reason for a code above 0 was printed.
pub struct Ended<'a> {
    /// Exit code.
    pub code: u8,
    /// Names.
    pub scope: Scope<'a>,
}

/// Programs of Planish, and where they say what they do.
pub struct Programs {
    path: ffi::OsString,
    said: Said,
}

impl Programs {
    /// The programs of this place.
    pub fn new(place: &Place, said: Said) -> Result<Self, Failure> {
        let rest = env::var_os("PATH").unwrap_or_default();
        let folders = [place.programs.clone()].into_iter().chain(env::split_paths(&rest));
        let path = env::join_paths(folders).map_err(|e| {
            Failure::new(format!("{}: cannot be in the PATH: {e}", place.programs.display()))
        })?;
        Ok(Self { path, said })
    }

    /// Prints a command and runs it: its exit code, or 2 if a signal ended it.
    pub fn run(&self, command: &Command) -> Result<u8, Failure> {
        self.print(&command.line());
        let mut process = self.process(command);
        match &self.said {
            Said::Shown if command.is_quiet => drop(process.stdout(Stdio::null())),
            Said::Shown => {}
            Said::Kept(file) => drop(process.stdout(file.try_clone()?).stderr(file.try_clone()?)),
        }
        Ok(code(self.ended(command, ended(&mut process))?))
    }

    /// Runs a command whose messages go to a file.
    fn attempt(&self, command: &Command, message: &Path) -> Result<u8, Failure> {
        self.print(&format!("{} 2> {}", command.line(), words::quote(&message.to_string_lossy())));
        let mut process = self.process(command);
        refuse_special(message)?;
        let file = File::create(message)
            .map_err(|e| Failure::new(format!("{}: cannot write: {e}", message.display())))?;
        process.stderr(file);
        if let Said::Kept(file) = &self.said {
            process.stdout(file.try_clone()?);
        }
        Ok(code(self.ended(command, ended(&mut process))?))
    }

    /// Runs a command in silence: what it said, if it failed.
    fn refusal(&self, command: &Command) -> Result<Option<String>, Failure> {
        self.print(&command.line());
        let mut process = self.process(command);
        process.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::piped());
        let (status, said) = self.ended(command, heard(&mut process))?;
        let said = String::from_utf8_lossy(&said).trim().to_string();
        Ok((!status.success()).then_some(said))
    }

    fn process(&self, command: &Command) -> Process {
        let mut process = Process::new(&command.program);
        process.args(&command.arguments).env("PATH", &self.path);
        process
    }

    fn ended<T>(&self, command: &Command, ended: io::Result<T>) -> Result<T, Failure> {
        ended.map_err(|e| {
            Failure::new(format!(
                "cannot run {}: {e}; build the programs with just build",
                command.program
            ))
        })
    }

    /// Prints a line on standard error; a closed pipe is not an error.
    fn print(&self, line: &str) {
        let _ = match &self.said {
            Said::Shown => writeln!(io::stderr(), "{line}"),
            Said::Kept(file) => writeln!(&*file, "{line}"),
        };
    }

    fn say(&self, line: &str) {
        match &self.said {
            Said::Shown => say(line),
            Said::Kept(_) => self.print(line),
        }
    }
}

/// Runs a process to its end. It ends with this one.
fn ended(process: &mut Process) -> io::Result<ExitStatus> {
    Running::start(process)?.wait()
}

/// Runs a process to its end, and returns what it said on standard error too. It ends with this one.
fn heard(process: &mut Process) -> io::Result<(ExitStatus, Vec<u8>)> {
    let mut running = Running::start(process)?;
    let mut said = Vec::new();
    if let Some(mut stderr) = running.stderr() {
        stderr.read_to_end(&mut said)?;
    }
    Ok((running.wait()?, said))
}

/// Exit code of a process; [`KILLED`] if a signal ended it, which is no refusal.
fn code(status: ExitStatus) -> u8 {
    status.code().and_then(|code| u8::try_from(code).ok()).unwrap_or(KILLED)
}

/// Runs a stage of a pipeline as the only owner of its directory.
pub fn run<'a>(
    place: &Place,
    scope: Scope<'a>,
    stage: &str,
    said: Said,
) -> Result<Ended<'a>, Failure> {
    let text = |name: &str| scope.text(name).map_err(Failure::new);
    let path = |name: &str| {
        Ok::<_, Failure>(Some(text(name)?).filter(|t| !t.is_empty()).map(PathBuf::from))
    };
    let is_own = text("own")? == "yes";
    let claim = Claim {
        out: text("out")?.into(),
        pipeline: text("pipeline")?,
        fixture: path("recipe")?.filter(|_| !is_own),
        surface: path("surface")?.filter(|_| is_own),
        tif: path("tif")?.filter(|_| is_own),
        machine: text("machine")?.into(),
        named: Named::all(&scope)?,
    };
    let programs = Programs::new(place, said)?;
    let mut walk = Walk::new(scope, stage).map_err(Failure::new)?;
    let (_lock, assumed) = claim.take(&as_typed())?;
    assumed.iter().for_each(|text| programs.print(&format!("warning: {text}")));
    let mut last = 0;
    while let Some(step) = walk.step().map_err(Failure::new)? {
        last = match step {
            Step::Run(command) => match (programs.run(&command)?, command.may_be_negative) {
                (0, _) | (1, true) => 0,
                (1, false) => 1,
                _ => 2,
            },
            Step::Attempt(dir, command) => attempt(&programs, &mut walk, &dir, &command)?,
            Step::LeaveOut(dir, reason) => {
                fs::create_dir_all(&dir)?;
                let message = Path::new(&dir).join(MESSAGE);
                refuse_special(&message)?;
                fs::write(&message, format!("error: {reason}\n")).map_err(|e| {
                    Failure::new(format!("{}: cannot write: {e}", message.display()))
                })?;
                leave_out(&mut walk, Path::new(&dir))?;
                0
            }
            Step::Say(line) => {
                programs.say(&line);
                0
            }
            Step::Copy(from, to) => {
                copy(&programs, Path::new(&from), Path::new(&to))?;
                0
            }
            Step::Choose { to, otherwise, tried_by } => {
                let plan = choose(&programs, &walk.scope, &to, otherwise, tried_by.as_deref())?;
                walk.scope.set(&to, vec![plan]);
                0
            }
        };
        if last != 0 {
            break;
        }
    }
    Ok(Ended { code: last, scope: walk.scope })
}

/// Command line of this process.
pub fn as_typed() -> String {
    words::join(env::args_os().map(|word| word.to_string_lossy().into_owned()))
}

/// Runs a command that may refuse: its message then stands in the place of what it makes.
fn attempt(
    programs: &Programs,
    walk: &mut Walk,
    dir: &str,
    command: &Command,
) -> Result<u8, Failure> {
    let dir = Path::new(dir);
    fs::create_dir_all(dir)?;
    let message = dir.join(MESSAGE);
    let code = programs.attempt(command, &message)?;
    if code == 2 {
        return leave_out(walk, dir).map(|()| 0);
    }
    // Warnings, the reason of a negative verdict, or of a program that broke.
    let said = fs::read(&message)?;
    String::from_utf8_lossy(&said).lines().for_each(|line| programs.print(line));
    Ok(if code > 1 { 2 } else { 0 })
}

/// Ends the stage. The result of an earlier run in this directory is not that of this one.
fn leave_out(walk: &mut Walk, dir: &Path) -> Result<(), Failure> {
    for made in LEFT_OUT {
        forget(&dir.join(made))?;
    }
    walk.leave();
    Ok(())
}

/// Name of the plan that the report of the run recommends, if there is one and a trial of its commands does not refuse it.
fn choose(
    programs: &Programs,
    scope: &Scope,
    to: &str,
    otherwise: String,
    tried_by: Option<&str>,
) -> Result<String, Failure> {
    let out = scope.text("out").map_err(Failure::new)?;
    let Some(best) = Answer::read(Path::new(&out))?.method else { return Ok(otherwise) };
    let best = plan_of(&best).to_string();
    let Some(stage) = tried_by.filter(|_| best != otherwise) else { return Ok(best) };
    let mut trial = scope.clone();
    trial.set(to, vec![best.clone()]);
    for command in Walk::commands(trial, stage).map_err(Failure::new)? {
        if let Some(refused) = programs.refusal(&command)? {
            let export = scope.text("export").map_err(Failure::new)?;
            let refused = refused.trim_start_matches("error: ");
            programs.print(&format!(
                "the plan marked as the best, {best}, is none for {export}: {refused}"
            ));
            return Ok(otherwise);
        }
    }
    Ok(best)
}

/// Copies the files of an artifact in place of those of an earlier one.
fn copy(programs: &Programs, from: &Path, to: &Path) -> Result<(), Failure> {
    programs.print(&format!(
        "cp {}/*.* {}",
        words::quote(&from.to_string_lossy()),
        words::quote(&to.to_string_lossy())
    ));
    let unreadable = |e: io::Error| {
        Failure::new(format!(
            "path {}: cannot be copied: {e}; give the directory of a tool path",
            from.display()
        ))
    };
    let (real_from, real_to) = (from.canonicalize(), to.canonicalize());
    if let (Ok(real_from), Ok(real_to)) = (real_from, real_to)
        && (real_from.starts_with(&real_to) || real_to.starts_with(&real_from))
    {
        return Err(Failure::new(format!(
            "path {}: is where the run copies it, {}; give another out",
            from.display(),
            to.display()
        )));
    }
    let entries =
        fs::read_dir(from).and_then(Iterator::collect::<io::Result<Vec<_>>>).map_err(unreadable)?;
    forget(to)?;
    fs::create_dir_all(to)?;
    for entry in
        entries.iter().map(fs::DirEntry::path).filter(|p| p.is_file() && p.extension().is_some())
    {
        fs::copy(&entry, to.join(entry.file_name().unwrap_or_default())).map_err(unreadable)?;
    }
    Ok(())
}

/// Removes an artifact of an earlier run: its manifest and its arrays, and the directory if nothing else is in it.
fn forget(artifact: &Path) -> Result<(), Failure> {
    let Ok(entries) = fs::read_dir(artifact) else { return Ok(()) };
    for path in entries.flatten().map(|entry| entry.path()) {
        let is_array = path.extension().is_some_and(|e| e == "npy");
        if is_array || path.file_name().is_some_and(|name| name == "manifest.json") {
            fs::remove_file(path)?;
        }
    }
    let _ = fs::remove_dir(artifact);
    Ok(())
}
