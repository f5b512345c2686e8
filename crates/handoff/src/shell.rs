//! Common frame of every program: it runs the work, prints messages, and returns the exit code.

use std::{
    fmt::Display,
    io::Write,
    panic::{self, AssertUnwindSafe},
    process::ExitCode,
};

use clap::Parser;

use crate::{
    command_line::{self, with_flags},
    message::{complain, without_commands},
    publish, system, telling,
};

/// Status of a stage that was able to run.
#[derive(Clone, Debug, PartialEq)]
pub enum Status {
    /// Done with a positive or no verdict; exit code 0.
    Done,
    /// Done, with a negative verdict for this reason; exit code 1.
    Negative(String),
}

/// Message that says why a stage could not run; exit code 2.
#[derive(Debug)]
pub struct Failure(String);

impl Failure {
    /// Creates a failure with this message.
    pub fn new(message: impl Into<String>) -> Self {
        Self(message.into())
    }

    /// Creates a failure from the error of a library. Settings that the message names become flags of the command
    /// line ([`with_flags`]).
    pub fn with_flags(error: impl std::error::Error) -> Self {
        Self(with_flags(&error.to_string()))
    }
}

impl Display for Failure {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&self.0)
    }
}

/// Makes a failure of any error of a library, with the message of that error.
impl<E: std::error::Error> From<E> for Failure {
    fn from(error: E) -> Self {
        Self(error.to_string())
    }
}

/// Runs a program: reads the flags, runs the body, and returns the exit code. 0: done. 1: done with
/// a negative verdict. 2: the stage could not run.
pub fn program<Flags: Parser>(body: impl FnOnce(&Flags) -> Result<Status, Failure>) -> ExitCode {
    let flags = command_line::parse();
    publish::clean_up_on_signals();
    system::fail_beyond_largest_file();
    panic::set_hook(Box::new(|info| {
        complain(&format!("internal error: {info}; this is a defect of Planish, please report it"));
    }));
    // After a panic of the body, its changed state is not used any more.
    let end = panic::catch_unwind(AssertUnwindSafe(|| body(&flags)));
    publish::wait_for_signal_under_way();
    let (code, message) = match end {
        Ok(Ok(Status::Done)) => (0, None),
        Ok(Ok(Status::Negative(reason))) => (1, Some(format!("verdict: {reason}"))),
        Ok(Err(failure)) => (2, Some(format!("error: {failure}"))),
        Err(_) => (2, None),
    };
    if let Some(message) = &message {
        complain(message);
    }
    telling::tell_end(code, message.as_deref());
    ExitCode::from(code)
}

/// Prints a warning on standard error; a closed pipe is not an error.
pub fn warn(message: impl Display) {
    complain(&format!("warning: {message}"));
}

/// Prints text on standard output, with control characters escaped; a closed pipe is not an error. With `--quiet` and
/// `--json` it prints nothing.
pub fn say(message: impl Display) {
    let text = without_commands(&message.to_string());
    if telling::tells_text() {
        let _ = writeln!(std::io::stdout(), "{text}");
    } else {
        telling::keep_text(&text);
    }
}
