//! Settings of the tolerance analysis.

pub use planish_dwell::residual::Free;
use planish_types::{Invalid, budget};
use serde::Serialize;

/// Largest number of draws; more are refused. Larger: a mistyped number runs for days. Smaller: rare quantiles cannot
/// be drawn.
const MOST_DRAWS: usize = 100_000_000;
/// Largest number of simulated runs; more are refused. Larger: a mistyped number runs for days. Smaller: long checks
/// are refused.
const MOST_SIMULATED_RUNS: usize = 100_000;

/// Settings of the tolerance analysis.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct ToleranceSettings {
    /// Low-order terms of the map that are not part of the residual.
    pub free: Free,
    /// Number of runs that are drawn to first order, for the distribution.
    pub draws: usize,
    /// Number of runs that are simulated, to check the first order.
    pub simulated_runs: usize,
    /// True if errors change the TIF of the plan as sampled, with its noise and its border. False for the smoothed TIF
    /// of [`crate::tool`].
    pub tif_as_sampled: bool,
    /// Random seed.
    pub seed: u64,
}

impl Default for ToleranceSettings {
    fn default() -> Self {
        Self {
            free: Free::Piston,
            draws: 100_000,
            simulated_runs: 8,
            tif_as_sampled: false,
            seed: 1,
        }
    }
}

impl ToleranceSettings {
    /// Refuses fewer than 100 draws, and more draws or simulated runs than the limits or the memory allow.
    pub fn check(&self) -> Result<(), Invalid> {
        let draws = [("draws", self.draws, 100, MOST_DRAWS)];
        let runs = [("simulated_runs", self.simulated_runs, 0, MOST_SIMULATED_RUNS)];
        for (name, value, least, most) in draws.into_iter().chain(runs) {
            if !(least..=most).contains(&value) {
                let remedy = format!("give {least} to {most}");
                return Err(Invalid::whole(name, format!("is {value}"), remedy));
            }
        }
        budget::affordable("draws", self.draws as f64, size_of::<f64>(), "give fewer")?;
        Ok(())
    }
}
