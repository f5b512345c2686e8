//! `planish-export csv`.

use clap::Args;
use planish_export::Controller;
use planish_handoff::{Failure, Status};

use super::CommonArgs;

#[derive(Debug, Args)]
pub struct Csv {
    /// Clock, s: times are rounded to it [default: that of the machine's controller, else 1e-6]
    #[arg(long, value_name = "T", allow_negative_numbers = true)]
    tick_s: Option<f64>,
    #[command(flatten)]
    common: CommonArgs,
}

impl Csv {
    pub fn run(&self) -> Result<Status, Failure> {
        self.common.export(&Controller::Csv, self.tick_s)
    }
}
