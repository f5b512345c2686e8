//! Command line of the stage that runs.

use std::{env, ffi::OsString, sync::OnceLock};

static CHOSEN: OnceLock<Vec<OsString>> = OnceLock::new();

/// Keeps the command line of the stage that `planish` runs: its name as the user wrote it, then its arguments.
pub(crate) fn choose(words: Vec<OsString>) {
    CHOSEN.get_or_init(|| words);
}

/// Returns the command line of the stage that runs; that of the process where no stage was chosen.
pub(crate) fn arguments() -> Vec<OsString> {
    CHOSEN.get().cloned().unwrap_or_else(|| env::args_os().collect())
}
