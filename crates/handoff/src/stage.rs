//! The program `planish`, which contains all stages: `planish dwell ARGUMENTS...` is `planish-dwell ARGUMENTS...`.
//!
//! Each stage program, such as `planish-dwell`, is a small file that starts `planish` beside it (`planish-launch`). So
//! the code that stages share is compiled and linked once, and users still run, replace and time one stage at a time.

use std::{
    env,
    ffi::{OsStr, OsString},
    path::{Path, PathBuf},
    process::{Command, ExitCode},
};

use crate::{
    Failure, Status,
    arguments::{self, PROGRAM, RUNNER, as_command},
    command_line,
    message::complain,
    say, telling,
};

/// A stage (one step of a pipeline, such as `planish-dwell`) as a command of `planish`.
#[derive(Clone, Copy)]
pub struct Stage {
    /// Name of the stage program, such as `planish-dwell`.
    pub name: &'static str,
    /// Runs the stage with the arguments of this process.
    pub main: fn() -> ExitCode,
    /// Returns the definition of the stage's command line.
    pub definition: fn() -> clap::Command,
}

impl Stage {
    /// Returns the word after `planish` that names the stage, such as `dwell`.
    pub fn word(&self) -> &'static str {
        self.name.strip_prefix("planish-").unwrap_or(self.name)
    }

    /// Returns true if `word` is a subcommand of the stage.
    fn has_subcommand(&self, word: &OsStr) -> bool {
        (self.definition)().get_subcommands().any(|command| word == command.get_name())
    }
}

/// Subcommands that can run without the stage that defines them. Another stage can offer them under a second name.
pub trait Subcommands: clap::Subcommand {
    /// Runs the subcommand that the command line names.
    ///
    /// # Errors
    /// Fails if the subcommand cannot run; the message is for the user.
    fn run(&self) -> Result<Status, Failure>;
}

/// Runs the stage that the name of this process or its first argument names, and returns its exit code. Without a stage
/// it prints help, version or completions, or refuses the command.
///
/// A subcommand of `planish-run`, such as `show`, needs no `run` before it. Where it is also the name of a stage, such
/// as `compare`, the word after it decides: a flag or a subcommand of the stage starts the stage.
pub fn start(stages: &[Stage]) -> ExitCode {
    let mut words: Vec<OsString> = env::args_os().collect();
    telling::move_flags_behind(&mut words);
    let name = words.first().and_then(|path| Path::new(path).file_stem()).map(OsStr::to_os_string);
    if let Some(stage) = stages.iter().find(|stage| name.as_deref() == Some(OsStr::new(stage.name)))
    {
        return run(stage, words);
    }
    let first = words.get(1).cloned().unwrap_or_default();
    let stage = stages.iter().find(|stage| first == stage.word() || first == stage.name);
    let runner = stages.iter().find(|stage| stage.name == RUNNER && stage.has_subcommand(&first));
    let next = words.get(2).map(OsString::as_os_str);
    match (stage, runner) {
        (Some(stage), runner)
            if runner.is_none() || (stage.name != RUNNER && takes_next_word(stage, next)) =>
        {
            words.remove(0);
            run(stage, words)
        }
        (_, Some(runner)) => run(runner, words),
        _ => overview(stages, &words),
    }
}

/// Returns true if `word`, which follows the name of a stage, is a flag or a subcommand of this stage, or is absent.
fn takes_next_word(stage: &Stage, word: Option<&OsStr>) -> bool {
    word.is_none_or(|word| word.as_encoded_bytes().starts_with(b"-") || stage.has_subcommand(word))
}

/// Runs a stage with the arguments in `words`, after the first one. Messages and help name it as a user types it.
fn run(stage: &Stage, mut words: Vec<OsString>) -> ExitCode {
    words[0] = as_command(stage.name).into();
    arguments::choose(words);
    (stage.main)()
}

/// Prints help, version, completions or the manual page of `planish` as a whole, or refuses an unknown command.
fn overview(stages: &[Stage], words: &[OsString]) -> ExitCode {
    let arguments = words.get(1..).unwrap_or_default();
    match command_line::generated(|| definition(stages), arguments) {
        Some(Ok(text)) => {
            say(String::from_utf8_lossy(&text).trim_end());
            ExitCode::SUCCESS
        }
        Some(Err(message)) => {
            complain(&format!("error: {message}"));
            ExitCode::from(2)
        }
        None => match definition(stages).try_get_matches_from(words) {
            Ok(_) => ExitCode::from(2),
            Err(error) => command_line::end(&error),
        },
    }
}

/// Returns the definition of the command line of `planish`: all stages, and the subcommands of the stage that runs
/// pipelines.
fn definition(stages: &[Stage]) -> clap::Command {
    let mut command = clap::Command::new(PROGRAM)
        .version(env!("CARGO_PKG_VERSION"))
        .about("Plan the finishing of precision optics")
        .long_about(
            "Plan the finishing of precision optics: tool path, dwell times, motion, controller program, and the \
             predicted surface. `planish run raster` runs every stage; each stage is a command of its own",
        )
        .subcommand_required(true)
        .arg_required_else_help(true)
        .after_help(command_line::ALSO);
    for stage in stages {
        command = command.subcommand((stage.definition)().name(stage.word()));
    }
    for pipelines in stages.iter().filter(|stage| stage.name == RUNNER) {
        for own in (pipelines.definition)().get_subcommands() {
            if stages.iter().all(|stage| stage.word() != own.get_name()) {
                command = command.subcommand(own.clone());
            }
        }
    }
    command
}

/// Returns the command that runs the stage program `name`. It is the file of this name in the first of `folders` that
/// has it, such as a script of the user. Otherwise it is this program with the name as its first argument, if it is
/// `planish` and the name begins with `planish-`. Otherwise the system looks for the name.
pub fn stage_command(name: &str, folders: impl IntoIterator<Item = PathBuf>) -> Command {
    let file = format!("{name}{}", env::consts::EXE_SUFFIX);
    if let Some(program) =
        folders.into_iter().map(|folder| folder.join(&file)).find(|f| f.is_file())
    {
        return Command::new(program);
    }
    match env::current_exe() {
        Ok(own) if name.starts_with("planish-") && own.file_stem() == Some(OsStr::new(PROGRAM)) => {
            let mut command = Command::new(own);
            command.arg(name);
            command
        }
        _ => Command::new(name),
    }
}
