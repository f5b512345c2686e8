//! What surrounds the work of every program: messages and exit codes.

use std::{
    borrow::Cow,
    fmt::Display,
    io::Write,
    panic::{self, AssertUnwindSafe},
    process::ExitCode,
};

use clap::Parser;
use planish_types::text;

use crate::{
    command_line::{self, with_flags},
    publish,
};

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

    /// The error of a library, which names its settings, in the words of the command line: see
    /// [`with_flags`].
    pub fn with_flags(error: impl std::error::Error) -> Self {
        Self(with_flags(&error.to_string()))
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

/// What `main` of a program does: reads the flags, runs the body, and turns its end into the exit code: 0 done, 1 done
/// with a negative verdict, 2 could not run.
pub fn program<Flags: Parser>(body: impl FnOnce(&Flags) -> Result<Status, Failure>) -> ExitCode {
    let flags = command_line::parse();
    publish::clean_up_on_signals();
    panic::set_hook(Box::new(|info| {
        complain(&format!("internal error: {info}; this is a defect of Planish, please report it"));
    }));
    // Where the body panics, what it had changed is not looked at any more.
    let end = panic::catch_unwind(AssertUnwindSafe(|| body(&flags)));
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

/// A warning on standard error; a closed pipe is not an error.
pub fn warn(message: impl Display) {
    complain(&format!("warning: {message}"));
}

/// Most characters of a message. It begins with the file and the problem and ends with the remedy; what is longer repeats
/// a damaged value. Larger: such a value fills the screen; smaller: a list of settings would be cut.
const MOST_CHARACTERS: usize = 4000;

/// Characters of a longer message that are kept at its beginning and at its end.
const KEPT_CHARACTERS: [usize; 2] = [1200, 800];

/// Lines on standard error; a closed pipe is not an error.
pub(crate) fn complain(message: &str) {
    let _ = writeln!(std::io::stderr(), "{}", shortened(&without_commands(message)));
}

/// A message of at most [`MOST_CHARACTERS`]: of a longer one the middle is left out, and how much that is said.
pub(crate) fn shortened(message: &str) -> Cow<'_, str> {
    let count = message.chars().count();
    if count <= MOST_CHARACTERS {
        return Cow::Borrowed(message);
    }
    let [first, last] = KEPT_CHARACTERS;
    let left_out = count - first - last;
    let begin: String = message.chars().take(first).collect();
    let end: String = message.chars().skip(first + left_out).collect();
    Cow::Owned(format!("{begin} [... {left_out} characters are left out ...] {end}"))
}

/// Lines on standard output; a closed pipe is not an error.
pub fn say(message: impl Display) {
    let _ = writeln!(std::io::stdout(), "{}", without_commands(&message.to_string()));
}

/// The lines of `message` with what could command a terminal spelt out: names of files are in it.
fn without_commands(message: &str) -> String {
    message.split('\n').map(text::visible).collect::<Vec<_>>().join("\n")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_message_that_repeats_a_damaged_value_keeps_its_beginning_and_its_end() {
        let message =
            |length| format!("a.json: '{}' is no number; give one", "\u{e9}".repeat(length));
        let short = message(3000);
        assert_eq!(shortened(&short), short);
        let long = message(70_000);
        let cut = shortened(&long);
        assert!(cut.starts_with("a.json: '\u{e9}") && cut.ends_with("' is no number; give one"));
        assert!(cut.chars().count() < 2100, "{}", cut.chars().count());
        let left_out = long.chars().count() - 2000;
        assert!(cut.contains(&format!("[... {left_out} characters are left out ...]")), "{cut}");
    }
}
