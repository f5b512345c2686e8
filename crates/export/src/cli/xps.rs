//! `planish-export xps`.

use clap::Args;
use planish_export::Controller;
use planish_handoff::{Failure, Status};

use super::CommonArgs;

#[derive(Debug, Args)]
pub struct Xps {
    /// Clock, s: times are rounded to it [default: that of the machine's controller, else 1e-4]
    #[arg(long, value_name = "T", allow_negative_numbers = true)]
    tick_s: Option<f64>,
    #[command(flatten)]
    common: CommonArgs,
}

impl Xps {
    pub fn run(&self) -> Result<Status, Failure> {
        self.common.export(&Controller::Xps, self.tick_s)
    }
}
