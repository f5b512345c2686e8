//! `planish-export pmac`.

use clap::Args;
use planish_export::{Controller, pmac};
use planish_handoff::{Failure, Status};

use super::CommonArgs;

#[derive(Debug, Args)]
pub struct Pmac {
    /// Clock, s: times are rounded to it [default: that of the machine's controller, else 1 ms, which every PMAC has;
    /// a Turbo PMAC goes down to 2.5e-7]
    #[arg(long, value_name = "T", allow_negative_numbers = true)]
    tick_s: Option<f64>,
    /// Unit of time of the velocities of a PMAC, s: Isx90 / 1000
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
            feedrate_time_unit_s: self.feedrate_time_unit_s,
            tool_output: self.tool_output,
        };
        self.common.export(&Controller::Pmac(settings), self.tick_s)
    }
}
