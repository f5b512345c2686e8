//! `planish-run best`: which plan of a run its report marks as the best, for a shell.

use std::path::PathBuf;

use clap::Args;
use planish_handoff::{Failure, Status, say};

use super::program::{Answer, plan_of};

#[derive(Args)]
pub struct Best {
    /// Directory of the run, with its report
    #[arg(long, value_name = "DIR")]
    run: PathBuf,
    /// Plan to be named where the report recommends none
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
