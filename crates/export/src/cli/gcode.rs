//! `planish-export gcode`.

use clap::Args;
use planish_export::{Controller, gcode};
use planish_handoff::{Failure, Status};

use super::CommonArgs;

#[derive(Debug, Args)]
pub struct Gcode {
    /// Convention of the F word: inverse time of each line (G93), or units per minute (G94)
    #[arg(long, value_enum, default_value = "inverse-time")]
    f_word: gcode::Feed,
    /// Clock, s: times are rounded to it [default: that of the machine's controller, else 1e-6]
    #[arg(long, value_name = "T", allow_negative_numbers = true)]
    tick_s: Option<f64>,
    /// Largest distance of the path from the corners between lines, mm (G64 P); 0 for an exact path (G61) [default: the
    /// path deviation]
    #[arg(long, value_name = "P", allow_negative_numbers = true)]
    path_tolerance_mm: Option<f64>,
    #[command(flatten)]
    common: CommonArgs,
}

impl Gcode {
    pub fn run(&self) -> Result<Status, Failure> {
        let settings =
            gcode::Settings { feed: self.f_word, path_tolerance_mm: self.path_tolerance_mm };
        self.common.export(&Controller::Gcode(settings), self.tick_s)
    }
}
