//! `planish dwell non-negative-least-squares`.

use clap::Args;
use planish_dwell::baselines::non_negative_least_squares::{self, NonNegativeSettings};
use planish_handoff::{Failure, Status, flags::FloorArgs};

use super::{CommonArgs, Ended, solve};

#[derive(Args)]
pub struct NonNegativeLeastSquares {
    #[command(flatten)]
    common: CommonArgs,
    #[command(flatten)]
    least: FloorArgs,
    /// Tikhonov weight of the squared dwell time per area above its floor; the same at every pitch, pixel and tool
    #[arg(long, value_name = "A", default_value_t = NonNegativeSettings::default().tikhonov)]
    tikhonov: f64,
}

impl NonNegativeLeastSquares {
    pub fn run(&self) -> Result<Status, Failure> {
        let settings =
            NonNegativeSettings { tikhonov: self.tikhonov, ..NonNegativeSettings::default() };
        let solver = non_negative_least_squares::solve;
        solve("non-negative-least-squares", &self.common, &self.least, settings, solver, |r, _| {
            let moves = format!("a dwell time would still move by {:.1e} s", r.kkt_residual_s);
            let negative = r.negative();
            let words = format!("{} after {} changes, {moves}", r.end, r.iterations);
            Ended { end: r.end, negative, words }
        })
    }
}
