//! `planish-export csv`.

use clap::Args;
use planish_export::{Controller, csv};
use planish_handoff::{Failure, Status};

use super::CommonArgs;

#[derive(Debug, Args)]
pub struct Csv {
    /// What a time is rounded to, s
    #[arg(long, value_name = "T", default_value_t = 1e-6, allow_negative_numbers = true)]
    tick_s: f64,
    #[command(flatten)]
    common: CommonArgs,
}

impl Csv {
    pub fn run(&self) -> Result<Status, Failure> {
        let settings = csv::Settings { tick_s: self.tick_s };
        self.common.export(&Controller::Csv(settings))
    }
}
