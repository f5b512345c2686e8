//! `planish sweep`: all plans of a sweep, by the workflow of a clone.

use std::process::Command;

use clap::Args;
use planish_handoff::{Failure, Running, Status};

use super::{place::Installation, run::end};

#[derive(Args)]
pub struct Sweep {
    /// File of the sweep, such as sweeps/small.yaml, and settings NAME=VALUE
    #[arg(
        required = true,
        value_name = "WORD",
        trailing_var_arg = true,
        allow_hyphen_values = true
    )]
    words: Vec<String>,
}

impl Sweep {
    pub fn run(&self) -> Result<Status, Failure> {
        let script = Installation::find()?.workflow();
        if !script.is_file() {
            return Err(Failure::new(format!(
                "{}: is missing; a sweep needs a clone of the repository",
                script.display()
            )));
        }
        let status = Running::start(Command::new("sh").arg(script).args(&self.words))?.wait()?;
        end(status.code().and_then(|code| u8::try_from(code).ok()).unwrap_or(2))
    }
}
