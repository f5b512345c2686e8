//! `planish-export pmac`.

use clap::Args;
use planish_export::{Controller, pmac};
use planish_handoff::{Failure, Status};

use super::CommonArgs;

#[derive(Debug, Args)]
pub struct Pmac {
    /// What a time is rounded to, s: 1 ms on a PMAC, down to 2.5e-7 on a Turbo PMAC
    #[arg(long, value_name = "T", default_value_t = 1e-3, allow_negative_numbers = true)]
    tick_s: f64,
    /// Unit of time of the velocities, s: Isx90 / 1000
    #[arg(long, value_name = "T", default_value_t = 1.0, allow_negative_numbers = true)]
    feedrate_time_unit_s: f64,
    /// M-variable that switches the tool, 1 for on [default: the program does not switch it]
    #[arg(long, value_name = "M")]
    tool_output: Option<u32>,
    #[command(flatten)]
    common: CommonArgs,
}

impl Pmac {
    pub fn run(&self) -> Result<Status, Failure> {
        let settings = pmac::Settings {
            tick_s: self.tick_s,
            feedrate_time_unit_s: self.feedrate_time_unit_s,
            tool_output: self.tool_output,
        };
        self.common.export(&Controller::Pmac(settings))
    }
}
