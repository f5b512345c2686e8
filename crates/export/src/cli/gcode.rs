//! `planish-export gcode`.

use clap::Args;
use planish_export::{Controller, gcode};
use planish_handoff::{Failure, Status};

use super::CommonArgs;

#[derive(Debug, Args)]
pub struct Gcode {
    /// What F is
    #[arg(long, value_enum, default_value = "inverse-time")]
    feed: gcode::Feed,
    /// What a time is rounded to, s
    #[arg(long, value_name = "T", default_value_t = 1e-6, allow_negative_numbers = true)]
    tick_s: f64,
    /// How far the path may leave the corners, mm; 0 for an exact path
    #[arg(long, value_name = "P", default_value_t = 0.001, allow_negative_numbers = true)]
    path_tolerance_mm: f64,
    #[command(flatten)]
    common: CommonArgs,
}

impl Gcode {
    pub fn run(&self) -> Result<Status, Failure> {
        let settings = gcode::Settings {
            feed: self.feed,
            tick_s: self.tick_s,
            path_tolerance_mm: self.path_tolerance_mm,
        };
        self.common.export(&Controller::Gcode(settings))
    }
}
