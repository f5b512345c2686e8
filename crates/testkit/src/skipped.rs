//! Tests that need what not every machine has: each that is skipped says so, and is counted.
//!
//! The test harness keeps what a passing test prints to itself, so the line goes to standard error past it;
//! and where the environment variable `PLANISH_SKIPPED` names a file the name of the test is appended there,
//! for `just test` to count.

use std::{
    env,
    fs::OpenOptions,
    io::{Write, stderr},
    path::PathBuf,
    thread,
};

/// The folder of the data that are not in the repository, named by `PLANISH_REFERENCE`; `None`, and the
/// test that asks counts as skipped, where it is not set.
pub fn reference() -> Option<PathBuf> {
    let folder = env::var_os("PLANISH_REFERENCE").map(PathBuf::from);
    if folder.is_none() {
        skip("PLANISH_REFERENCE is not set");
    }
    folder
}

/// Says and counts that the test of this thread is skipped, and why.
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
