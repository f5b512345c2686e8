//! A stage program starts `planish`, the program beside it: `planish-dwell ARGUMENTS` is `planish dwell ARGUMENTS`.
//!
//! Each of the stage programs links this crate alone, and it uses nothing but the standard library: such a program has
//! less than half of the size that it would have with `planish-handoff`.

use std::{
    env,
    ffi::OsStr,
    io::{self, Write},
    path::Path,
    process::{Command, ExitCode},
};

/// Name of the program that has all stages.
const PROGRAM: &str = "planish";

/// Starts the stage `name` of `planish`, which lies beside this program, with the arguments of this process, and
/// returns its exit code; 2 if it cannot be started.
pub fn launch(name: &str) -> ExitCode {
    let own = env::current_exe().unwrap_or_default();
    let planish = own.with_file_name(format!("{PROGRAM}{}", env::consts::EXE_SUFFIX));
    let is_run_by_cargo = env::var_os("CARGO_PKG_NAME").is_some_and(|package| package == name);
    let build = if is_run_by_cargo { build_by_cargo(&own) } else { Ok(()) };
    let error = match build {
        Ok(()) => become_program(&planish, name),
        Err(error) => error,
    };
    let _ = writeln!(
        io::stderr(),
        "error: {}: cannot run: {error}; `cargo build --release` makes it beside {name}",
        planish.display()
    );
    ExitCode::from(2)
}

/// Builds `planish` beside `own`, in the same profile: `cargo run -p planish-dwell` builds only the package that it
/// names.
fn build_by_cargo(own: &Path) -> io::Result<()> {
    let folder = own.parent().unwrap_or(Path::new("."));
    let profile = match folder.file_name().and_then(OsStr::to_str) {
        Some("debug") | None => "dev",
        Some(profile) => profile,
    };
    let cargo = env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
    let status = Command::new(cargo)
        .args(["build", "--quiet", "--package", PROGRAM, "--profile", profile, "--target-dir"])
        .arg(folder.parent().unwrap_or(folder))
        .status()?;
    if status.success() { Ok(()) } else { Err(io::Error::other("cargo could not build it")) }
}

/// Runs `planish` in place of this process, under the name `name`. Returns only if it cannot be run.
#[cfg(unix)]
fn become_program(planish: &Path, name: &str) -> io::Error {
    use std::os::unix::process::CommandExt;

    Command::new(planish).args(env::args_os().skip(1)).arg0(name).exec()
}

/// Runs `planish`, and ends with its exit code. Returns only if it cannot be run. The name of a process cannot be chosen
/// here: the first argument names the stage.
#[cfg(not(unix))]
fn become_program(planish: &Path, name: &str) -> io::Error {
    match Command::new(planish).arg(name).args(env::args_os().skip(1)).status() {
        Ok(status) => std::process::exit(status.code().unwrap_or(2)),
        Err(error) => error,
    }
}
