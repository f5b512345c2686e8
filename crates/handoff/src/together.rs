//! Several programs in one file, as the wheel has them: `FILE NAME ARGUMENTS...` is the program `NAME ARGUMENTS...`.
//!
//! Each program has the name, the help and the manifests that it has as a file of its own. The code that all
//! programs share is in the file once.

use std::{ffi::OsString, process::ExitCode, sync::OnceLock};

use crate::message::complain;

/// Name of the program that runs, if it was chosen from several.
static CHOSEN: OnceLock<&'static str> = OnceLock::new();

/// The `main` of a program.
pub type Main = fn() -> ExitCode;

/// Runs the program that the first argument names, with the arguments after it.
pub fn together(programs: &[(&'static str, Main)]) -> ExitCode {
    let first = std::env::args_os().nth(1).unwrap_or_default();
    let Some((name, main)) = programs.iter().find(|(name, _)| first == *name) else {
        let names: Vec<_> = programs.iter().map(|(name, _)| *name).collect();
        complain(&format!(
            "error: the first argument is '{}', which is no program; give one of {}",
            first.display(),
            names.join(", ")
        ));
        return ExitCode::from(2);
    };
    CHOSEN.get_or_init(|| name);
    main()
}

/// Name of the program that runs, if it was chosen from several.
pub(crate) fn chosen() -> Option<&'static str> {
    CHOSEN.get().copied()
}

/// Command line of the program: its name, and its arguments.
pub(crate) fn command_line() -> Vec<OsString> {
    // The name of a chosen program is the second word.
    std::env::args_os().skip(usize::from(chosen().is_some())).collect()
}
