//! `planish-run best`: name of the plan that the report of a run recommends, for a shell.

use std::path::PathBuf;

use clap::Args;
use planish_handoff::{Failure, Status, say};

use super::program::{Answer, plan_of};

#[derive(Args)]
pub struct Best {
    /// Directory of the run, with its report
    #[arg(long, value_name = "DIR")]
    run: PathBuf,
    /// Name to print if the report recommends no plan
    #[arg(long, value_name = "NAME")]
    otherwise: String,
}

impl Best {
    pub fn run(&self) -> Result<Status, Failure> {
        let answer = Answer::read(&self.run)?;
        say(answer.method.as_deref().map_or(self.otherwise.as_str(), plan_of));
        Ok(Status::Done)
    }
}
