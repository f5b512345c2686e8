//! `planish compare diff`.

use std::path::PathBuf;

use clap::Args;
use planish_compare::diff::{beyond, difference};
use planish_handoff::{Failure, Status, say};

use super::super::files;

#[derive(Args)]
pub struct Diff {
    /// First artifact, or directory of .npy files
    #[arg(value_name = "A")]
    a: PathBuf,
    /// Second artifact, or directory of .npy files
    #[arg(value_name = "B")]
    b: PathBuf,
    /// Largest absolute difference that is accepted, in the unit of each array
    #[arg(long, value_name = "T")]
    max_difference: f64,
}

impl Diff {
    pub fn run(&self) -> Result<Status, Failure> {
        let mut differences = Vec::new();
        for (name, [x, y]) in files::read_pair(&self.a, &self.b)? {
            let difference = difference(&x, &y)
                .map_err(|e| Failure::new(format!("{name}: {e}; nothing compared")))?;
            differences.push((name, difference));
        }
        let beyond = beyond(&differences, self.max_difference)?;
        for (name, difference) in &differences {
            say(difference.line(name));
        }
        Ok(beyond.map_or(Status::Done, Status::Negative))
    }
}
