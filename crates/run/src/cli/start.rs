//! `planish-run start`: a command as the only owner of the directory of a run.

use std::path::PathBuf;

use clap::Args;
use planish_handoff::{Failure, Status, warn, words};

use super::claim::Claim;

#[derive(Args)]
pub struct Start {
    /// Output directory of the run
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Name of the pipeline
    #[arg(long, value_name = "NAME")]
    pipeline: String,
    /// Mirror from a recipe [JSON]
    #[arg(long, value_name = "FILE", conflicts_with_all = ["surface", "tif"])]
    fixture: Option<PathBuf>,
    /// Map of the mirror as it was measured [surface artifact, or a file of an instrument]
    #[arg(long, value_name = "PATH")]
    surface: Option<PathBuf>,
    /// Tool influence function [tif artifact, or a file of an instrument]
    #[arg(long, value_name = "PATH")]
    tif: Option<PathBuf>,
    /// Machine and its limits [JSON]
    #[arg(long, value_name = "FILE")]
    machine: PathBuf,
    /// Command to run, with its arguments
    #[arg(last = true, required = true, value_name = "COMMAND")]
    command: Vec<String>,
}

impl Start {
    pub fn run(&self) -> Result<Status, Failure> {
        let claim = Claim {
            out: self.out.clone(),
            pipeline: self.pipeline.clone(),
            fixture: self.fixture.clone(),
            surface: self.surface.clone(),
            tif: self.tif.clone(),
            machine: self.machine.clone(),
        };
        let (lock, assumed) = claim.take(&words::join(&self.command))?;
        assumed.into_iter().for_each(warn);
        Err(become_command(&self.command, lock))
    }
}

/// Runs the command in place of this process, so that signals reach it and its exit code is that of the
/// run. Returns only if the command cannot be run.
#[cfg(unix)]
fn become_command(command: &[String], _lock: std::fs::File) -> Failure {
    use std::os::unix::process::CommandExt;
    let error = std::process::Command::new(&command[0]).args(&command[1..]).exec();
    Failure::new(format!("cannot run {}: {error}", command[0]))
}

/// Runs the command on systems on which no process can replace another: this process waits with the lock.
#[cfg(not(unix))]
fn become_command(command: &[String], lock: std::fs::File) -> Failure {
    let status = std::process::Command::new(&command[0]).args(&command[1..]).status();
    drop(lock);
    match status {
        Ok(status) => std::process::exit(status.code().unwrap_or(2)),
        Err(error) => Failure::new(format!("cannot run {}: {error}", command[0])),
    }
}
