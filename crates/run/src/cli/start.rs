//! `planish start`: runs a command while the directory of a run is locked for it.

use std::{path::PathBuf, process};

use clap::Args;
use planish_handoff::{Failure, Status, system, warn, words};

use super::claim::Claim;

#[derive(Args)]
pub struct StartCommand {
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

impl StartCommand {
    pub fn run(&self) -> Result<Status, Failure> {
        let claim = Claim {
            out: self.out.clone(),
            pipeline: self.pipeline.clone(),
            fixture: self.fixture.clone(),
            surface: self.surface.clone(),
            tif: self.tif.clone(),
            machine: self.machine.clone(),
            named: vec![],
        };
        let (lock, assumed) = claim.take(&words::join(&self.command))?;
        assumed.into_iter().for_each(warn);
        let mut process = process::Command::new(&self.command[0]);
        process.args(&self.command[1..]);
        let error = system::become_command(process, lock);
        Err(Failure::new(format!("cannot run {}: {error}", self.command[0])))
    }
}
