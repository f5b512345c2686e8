//! `planish dwell udo`.

use clap::Args;
use planish_dwell::udo::{self, UdoSettings};
use planish_handoff::{Failure, Status, flags::FloorArgs};

use super::{CommonArgs, Ended, solve};

#[derive(Args)]
pub struct Udo {
    #[command(flatten)]
    common: CommonArgs,
    #[command(flatten)]
    least: FloorArgs,
    /// Method to keep the dwell times above their floor
    #[arg(long, value_enum, default_value = "model")]
    floor: udo::Floor,
    /// Fraction of the best step that is taken from the second round on
    #[arg(long, value_name = "BETA", default_value_t = UdoSettings::default().step)]
    step: f64,
    /// RMS of the residual at which the solver ends, nm
    #[arg(long, value_name = "NM", default_value_t = UdoSettings::default().threshold_nm)]
    threshold_nm: f64,
    /// Largest number of iterations
    #[arg(long, value_name = "N", default_value_t = UdoSettings::default().max_iterations)]
    max_iterations: usize,
}

impl Udo {
    pub fn run(&self) -> Result<Status, Failure> {
        let settings = UdoSettings {
            floor: self.floor,
            step: self.step,
            threshold_nm: self.threshold_nm,
            max_iterations: self.max_iterations,
        };
        solve("udo", &self.common, &self.least, settings, udo::solve, |r, settings| {
            let negative = r.negative(settings);
            Ended {
                end: r.end,
                negative,
                words: format!("{} after {} rounds", r.end, r.iterations),
            }
        })
    }
}
