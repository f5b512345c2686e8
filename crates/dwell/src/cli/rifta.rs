//! `planish dwell rifta`.

use clap::Args;
use planish_dwell::rifta::{self, RiftaSettings};
use planish_handoff::{Failure, Status, flags::FloorArgs};

use super::{CommonArgs, Ended, solve};

#[derive(Args)]
pub struct Rifta {
    #[command(flatten)]
    common: CommonArgs,
    #[command(flatten)]
    least: FloorArgs,
    /// RMS that a smaller margin around the aperture may cost, nm
    #[arg(long, value_name = "NM", default_value_t = RiftaSettings::default().margin_tolerance_nm)]
    margin_tolerance_nm: f64,
    /// Fraction of the pixels that count as pits: the lowest ones, which do not decide the uniform part of the removal
    #[arg(long, value_name = "PART", default_value_t = RiftaSettings::default().pits)]
    pits: f64,
}

impl Rifta {
    pub fn run(&self) -> Result<Status, Failure> {
        let settings = RiftaSettings {
            margin_tolerance_nm: self.margin_tolerance_nm,
            pits: self.pits,
            ..RiftaSettings::default()
        };
        solve("rifta", &self.common, &self.least, settings, rifta::solve, |r, _| {
            let negative = r.negative();
            let words = format!(
                "gain capped at {:.1}, margin {:.2} mm, {:.4} nm RMS before the path",
                r.relative_gamma, r.margin_mm, r.map_rms_nm
            );
            Ended { end: r.end, negative, words }
        })
    }
}
