//! `planish sweep resources`.

use std::path::PathBuf;

use clap::Args;
use planish_handoff::{Failure, Status, say};
use planish_sweep::batch::resources;

use super::super::files::read_sweep;
use super::run::{Job, read_size};

#[derive(Args)]
pub struct Resources {
    /// Directory of the sweep, whose mirror is made
    dir: PathBuf,
    #[command(flatten)]
    job: Job,
    /// Stages that run at the same time, each on one core
    #[arg(long, value_name = "N", default_value_t = 1)]
    at_once: usize,
}

impl Resources {
    pub fn run(&self) -> Result<Status, Failure> {
        let sweep = read_sweep(&self.dir)?;
        let size = read_size(&sweep, &self.dir)?;
        let plans = self.job.plans(&sweep, &size)?;
        say(serde_json::to_string(&resources(&plans, &size, self.at_once.max(1)))?);
        Ok(Status::Done)
    }
}
