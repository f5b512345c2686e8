//! `planish dwell feed-law`.

use clap::Args;
use planish_dwell::baselines::feed_law::{self, FeedLawSettings};
use planish_handoff::{Failure, Status, flags::FloorArgs};

use super::{CommonArgs, Ended, solve};

#[derive(Args)]
pub struct FeedLaw {
    #[command(flatten)]
    common: CommonArgs,
    #[command(flatten)]
    least: FloorArgs,
    /// Distance of neighbouring lines, mm [default: measured line by line, in every pass by itself]
    #[arg(long, value_name = "P", allow_negative_numbers = true)]
    pitch_mm: Option<f64>,
}

impl FeedLaw {
    pub fn run(&self) -> Result<Status, Failure> {
        let settings = FeedLawSettings { pitch_mm: self.pitch_mm };
        solve("feed-law", &self.common, &self.least, settings, feed_law::solve, |r, _| Ended {
            end: r.end,
            negative: None,
            words: format!(
                "{} lines, {:.4} to {:.4} mm apart, {} segments at the largest feed remove too much",
                r.lines, r.pitch_mm[0], r.pitch_mm[1], r.too_fast
            ),
        })
    }
}
