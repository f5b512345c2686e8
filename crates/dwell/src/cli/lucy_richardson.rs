//! `planish dwell lucy-richardson`.

use clap::Args;
use planish_dwell::lucy_richardson::{self, LucyRichardsonSettings};
use planish_handoff::{Failure, Status, flags::FloorArgs};

use super::{CommonArgs, Ended, solve};

#[derive(Args)]
pub struct LucyRichardson {
    #[command(flatten)]
    common: CommonArgs,
    #[command(flatten)]
    least: FloorArgs,
    /// Unknowns: dwell times of the path, or a map of dwell times
    #[arg(long, value_enum, default_value = "path")]
    unknowns: lucy_richardson::Unknowns,
    /// Weight of the total variation, useful from 0 to 0.02
    #[arg(long, value_name = "MU", default_value_t = LucyRichardsonSettings::default().total_variation)]
    total_variation: f64,
    /// Removal at the lowest pixel, as a fraction of the PV of the desired removal
    #[arg(long, value_name = "PART", default_value_t = LucyRichardsonSettings::default().margin)]
    margin: f64,
    /// Fraction of the pixels that count as pits: the lowest ones, which may be cut off as pits
    #[arg(long, value_name = "PART", default_value_t = LucyRichardsonSettings::default().pits)]
    pits: f64,
    /// Smallest decrease of the RMS in ten iterations, as a fraction of it; the solver ends after a smaller one
    #[arg(long, value_name = "PART", default_value_t = LucyRichardsonSettings::default().min_decrease)]
    min_decrease: f64,
    /// Largest number of iterations; if it is given, stopping there is not reported as a failure [default: 300, and a
    /// negative verdict if the RMS does not settle]
    #[arg(long, value_name = "N")]
    max_iterations: Option<usize>,
    /// Start every step from a point extrapolated along the last two: fewer steps
    #[arg(long)]
    accelerated: bool,
    /// Side of the squares on which the map is solved, pixels [default: 1; from a million pixels on, the largest that
    /// the TIF allows]
    #[arg(long, value_name = "K")]
    pixels_per_cell: Option<usize>,
}

impl LucyRichardson {
    pub fn run(&self) -> Result<Status, Failure> {
        let settings = LucyRichardsonSettings {
            unknowns: self.unknowns,
            total_variation: self.total_variation,
            margin: self.margin,
            pits: self.pits,
            min_decrease: self.min_decrease,
            max_iterations: self
                .max_iterations
                .unwrap_or(LucyRichardsonSettings::default().max_iterations),
            stop_at_max: self.max_iterations.is_some(),
            accelerated: self.accelerated,
            pixels_per_cell: self.pixels_per_cell,
        };
        let solver = lucy_richardson::solve;
        solve("lucy-richardson", &self.common, &self.least, settings, solver, |r, settings| {
            let clipped = match r.clipped_tif_samples {
                0 => String::new(),
                n => format!(", {n} negative samples of the TIF taken as 0"),
            };
            let cells = match r.pixels_per_cell {
                1 => String::new(),
                k => format!(" on cells of {k} x {k} pixels"),
            };
            let negative = r.negative(settings);
            Ended {
                end: r.end,
                negative,
                words: format!("{} after {} steps{cells}{clipped}", r.end, r.iterations),
            }
        })
    }
}
