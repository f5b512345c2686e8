//! Command line of the stage that runs, also where `planish` runs the stage as a subcommand.

use std::{env, ffi::OsString, sync::OnceLock};

/// Name of the program that contains all stages.
pub(crate) const PROGRAM: &str = "planish";

/// Name of the stage that runs pipelines. Its subcommands are also commands of `planish`, such as `planish show
/// raster`.
pub(crate) const RUNNER: &str = "planish-run";

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

/// Returns the stage program `name` as a user types it: `planish dwell` for `planish-dwell`. The subcommands of
/// `planish-run` follow `planish` itself.
pub fn as_command(name: &str) -> String {
    if name == RUNNER { PROGRAM.into() } else { name.replacen("planish-", "planish ", 1) }
}
