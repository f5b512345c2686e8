//! Command line of the stage that runs, also where `planish` runs the stage as a subcommand.

use std::{env, ffi::OsString, sync::OnceLock};

static CHOSEN: OnceLock<Vec<OsString>> = OnceLock::new();

/// Keeps the command line of the stage that `planish` runs: the words that name it, such as `planish dwell`, then its
/// arguments. Only the first call counts.
pub(crate) fn choose(words: Vec<OsString>) {
    CHOSEN.get_or_init(|| words);
}

/// Returns the command line of the stage that runs. It is that of the process if `planish` did not choose a stage.
pub(crate) fn arguments() -> Vec<OsString> {
    CHOSEN.get().cloned().unwrap_or_else(|| env::args_os().collect())
}
