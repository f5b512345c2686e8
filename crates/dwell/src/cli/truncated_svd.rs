//! `planish dwell truncated-svd`.

use clap::Args;
use planish_dwell::baselines::truncated_svd::{self, TruncatedSvdSettings};
use planish_handoff::{Failure, Status, flags::FloorArgs};

use super::{CommonArgs, Ended, solve};

#[derive(Args)]
pub struct TruncatedSvd {
    #[command(flatten)]
    common: CommonArgs,
    #[command(flatten)]
    least: FloorArgs,
    /// Fraction of the largest singular value up to which singular values are left out
    #[arg(long, value_name = "PART", default_value_t = TruncatedSvdSettings::default().cut)]
    cut: f64,
    /// Largest number of iterations; each keeps a vector of the number of dwell points
    #[arg(long, value_name = "N", default_value_t = TruncatedSvdSettings::default().max_iterations)]
    max_iterations: usize,
}

impl TruncatedSvd {
    pub fn run(&self) -> Result<Status, Failure> {
        let settings = TruncatedSvdSettings {
            cut: self.cut,
            max_iterations: self.max_iterations,
            ..TruncatedSvdSettings::default()
        };
        let solver = truncated_svd::solve;
        solve("truncated-svd", &self.common, &self.least, settings, solver, |r, _| {
            let negative = r.negative();
            let words = format!(
                "rank {}, {} after {} steps, level {:.4} s, {} clipped",
                r.rank, r.end, r.steps, r.level_s, r.clipped
            );
            Ended { end: r.end, negative, words }
        })
    }
}
