//! `planish-export galil`.

use clap::Args;
use planish_export::Controller;
use planish_handoff::{Failure, Status};

use super::CommonArgs;

#[derive(Debug, Args)]
pub struct Galil {
    /// Sample time of the controller, s; a segment has an even number of them [default: half the clock of the
    /// machine's controller, else 1/1024, that of TM 1000]
    #[arg(long, value_name = "T", allow_negative_numbers = true)]
    sample_s: Option<f64>,
    #[command(flatten)]
    common: CommonArgs,
}

impl Galil {
    pub fn run(&self) -> Result<Status, Failure> {
        self.common.export(&Controller::Galil, self.sample_s.map(|s| 2.0 * s))
    }
}
