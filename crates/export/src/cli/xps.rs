//! `planish-export xps`.

use clap::Args;
use planish_export::{Controller, xps};
use planish_handoff::{Failure, Status};

use super::CommonArgs;

#[derive(Debug, Args)]
pub struct Xps {
    /// What a time is rounded to, s
    #[arg(long, value_name = "T", default_value_t = 1e-4, allow_negative_numbers = true)]
    tick_s: f64,
    #[command(flatten)]
    common: CommonArgs,
}

impl Xps {
    pub fn run(&self) -> Result<Status, Failure> {
        let settings = xps::Settings { tick_s: self.tick_s };
        self.common.export(&Controller::Xps(settings))
    }
}
