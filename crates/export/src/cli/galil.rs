//! `planish-export galil`.

use clap::Args;
use planish_export::{Controller, galil};
use planish_handoff::{Failure, Status};

use super::CommonArgs;

#[derive(Debug, Args)]
pub struct Galil {
    /// Sample time, s: 1/1024 with the default TM 1000
    #[arg(long, value_name = "T", default_value_t = 1.0 / 1024.0, allow_negative_numbers = true)]
    sample_s: f64,
    #[command(flatten)]
    common: CommonArgs,
}

impl Galil {
    pub fn run(&self) -> Result<Status, Failure> {
        let settings = galil::Settings { sample_s: self.sample_s };
        self.common.export(&Controller::Galil(settings))
    }
}
