//! Tests that need data or programs that not every machine has: each skipped test is named and counted.
//!
//! The test harness hides the output of a passing test, so the line goes to standard error past it. If the
//! environment variable `PLANISH_SKIPPED` names a file, the name of the test is appended there, for `just
//! test` to count.

use std::{
    env,
    fs::OpenOptions,
    io::{Write, stderr},
    path::PathBuf,
    thread,
};

/// Folder of the data that are not in the repository, from `PLANISH_REFERENCE`. Returns `None`, and the
/// test counts as skipped, if the variable is not set.
pub fn reference() -> Option<PathBuf> {
    let folder = env::var_os("PLANISH_REFERENCE").map(PathBuf::from);
    if folder.is_none() {
        skip("PLANISH_REFERENCE is not set");
    }
    folder
}

/// Names and counts the test of this thread as skipped, with the reason.
pub fn skip(reason: &str) {
    let package = env::var("CARGO_PKG_NAME").unwrap_or_default();
    let line = format!("{package}: {}", thread::current().name().unwrap_or("a test"));
    // One call each: tests of other threads and processes write too.
    stderr().write_all(format!("skipped: {line}: {reason}\n").as_bytes()).unwrap();
    if let Some(file) = env::var_os("PLANISH_SKIPPED") {
        let mut file = OpenOptions::new().create(true).append(true).open(file).unwrap();
        file.write_all(format!("{line}\n").as_bytes()).unwrap();
    }
}
