//! `planish dwell tikhonov-lsqr`.

use clap::Args;
use planish_dwell::tikhonov_lsqr::{self, TikhonovLsqrSettings};
use planish_handoff::{Failure, Status, flags::FloorArgs};

use super::{CommonArgs, Ended, solve};

#[derive(Args)]
pub struct TikhonovLsqr {
    #[command(flatten)]
    common: CommonArgs,
    #[command(flatten)]
    least: FloorArgs,
    /// Damping as a fraction of the largest singular value [default: 0.01]
    #[arg(long, value_name = "PART", group = "choice")]
    damping: Option<f64>,
    /// RMS of the noise of the map, nm: chooses the largest damping whose residual is at most that
    #[arg(long, value_name = "S", group = "choice")]
    noise_rms_nm: Option<f64>,
    /// Choose the damping at the corner of the L-curve
    #[arg(long, group = "choice")]
    l_curve: bool,
    /// Largest number of iterations of LSQR
    #[arg(long, value_name = "N", default_value_t = TikhonovLsqrSettings::default().max_iterations)]
    max_iterations: usize,
}

impl TikhonovLsqr {
    pub fn run(&self) -> Result<Status, Failure> {
        let defaults = TikhonovLsqrSettings::default();
        let damping = match (self.damping, self.noise_rms_nm, self.l_curve) {
            (Some(part), ..) => tikhonov_lsqr::Damping::Relative(part),
            (_, Some(noise), _) => tikhonov_lsqr::Damping::Discrepancy(noise),
            (.., true) => tikhonov_lsqr::Damping::LCurve,
            _ => defaults.damping,
        };
        let settings =
            TikhonovLsqrSettings { damping, max_iterations: self.max_iterations, ..defaults };
        let solver = tikhonov_lsqr::solve;
        solve("tikhonov-lsqr", &self.common, &self.least, settings, solver, |r, _| {
            let negative = r.negative();
            let words = format!(
                "damping {:.2e}, {} after {} steps, level {:.4} s, {} clipped",
                r.relative_damping, r.end, r.iterations, r.level_s, r.clipped
            );
            Ended { end: r.end, negative, words }
        })
    }
}
