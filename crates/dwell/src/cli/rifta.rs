//! `planish-dwell rifta`.

use clap::Args;
use planish_dwell::rifta;
use planish_handoff::{Failure, Status, flags::FloorArgs};

use super::{Ended, Given, solve};

#[derive(Args)]
pub struct Rifta {
    #[command(flatten)]
    given: Given,
    #[command(flatten)]
    least: FloorArgs,
    /// RMS that a smaller margin around the aperture may cost, nm
    #[arg(long, value_name = "NM", default_value_t = rifta::Settings::default().margin_tolerance_nm)]
    margin_tolerance_nm: f64,
    /// Fraction of the pixels that count as pits: the lowest ones, which do not decide the uniform part of the removal
    #[arg(long, value_name = "PART", default_value_t = rifta::Settings::default().pits)]
    pits: f64,
}

impl Rifta {
    pub fn run(&self) -> Result<Status, Failure> {
        let settings = rifta::Settings {
            margin_tolerance_nm: self.margin_tolerance_nm,
            pits: self.pits,
            ..rifta::Settings::default()
        };
        solve("rifta", &self.given, &self.least, settings, rifta::solve, |r, _| {
            let negative = r.negative();
            let words = format!(
                "gain capped at {:.1}, margin {:.2} mm, {:.4} nm RMS before the path",
                r.relative_gamma, r.margin_mm, r.map_rms_nm
            );
            Ended { end: r.end, negative, words }
        })
    }
}
