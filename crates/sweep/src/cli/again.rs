//! `planish sweep again`.

use std::path::PathBuf;

use clap::Args;
use planish_handoff::{Failure, Status, say};

use super::super::files::{again, read_sweep};

#[derive(Args)]
pub struct Again {
    /// Directory of the sweep
    dir: PathBuf,
    /// Plan, as the table names it
    plan: String,
}

impl Again {
    pub fn run(&self) -> Result<Status, Failure> {
        let sweep = read_sweep(&self.dir)?;
        let Some(plan) = sweep.plans().find(|plan| plan.id == self.plan) else {
            let problem = format!("no plan '{}'; give one that its table names", self.plan);
            return Err(Failure::new(format!("{}: {problem}", self.dir.display())));
        };
        say(again(&sweep, plan));
        Ok(Status::Done)
    }
}
