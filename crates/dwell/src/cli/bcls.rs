//! `planish dwell bcls`.

use clap::Args;
use planish_dwell::{
    baselines::bcls::{self, BclsSettings},
    bounded_least_squares,
    problem::rms_before,
};
use planish_handoff::{
    Artifact, Begin, Failure, Inputs, Output, Status, flags::MachineArgs, say, task,
};
use planish_types::{DwellTime, outcome::plan::PlanOutcome, plausible};
use serde::Serialize;

use super::{CommonArgs, Nouns, status, warn_of};

#[derive(Args)]
pub struct Bcls {
    #[command(flatten)]
    common: CommonArgs,
    #[command(flatten)]
    machine: MachineArgs,
    /// Least feed as a fraction of the largest reachable feed on a segment; 0 for none
    #[arg(long, value_name = "ETA", default_value_t = BclsSettings::default().least_feed)]
    least_feed: f64,
    /// Tikhonov weight of the squared dwell time per area above its floor; the same at every pitch, pixel and tool
    #[arg(long, value_name = "A", default_value_t = BclsSettings::default().tikhonov)]
    tikhonov: f64,
}

/// Outcome in the manifest.
#[derive(Serialize)]
struct BclsOutcome<'a> {
    #[serde(flatten)]
    plan: PlanOutcome<&'a bounded_least_squares::BoundedReport>,
    bounds: &'a bcls::BclsReport,
}

impl Bcls {
    pub fn run(&self) -> Result<Status, Failure> {
        let settings = BclsSettings {
            columns: self.common.columns,
            least_feed: self.least_feed,
            tikhonov: self.tikhonov,
        };
        let task = task!("bcls", settings);
        let mut inputs = Inputs::new();
        let Nouns { desired, tif, path, weight } = self.common.read(&mut inputs)?;
        let machine = self.machine.read(&mut inputs)?;
        let mut output =
            match Output::directory(&self.common.output, DwellTime::KIND).begin(&task, &inputs)? {
                Begin::Unchanged(status) => return Ok(status),
                Begin::Run(output) => output,
            };
        plausible::check_path(&desired, &tif, &path)?;
        let bounded = bcls::solve(&desired, &tif, &path, weight.as_ref(), &machine, &settings)
            .map_err(Failure::with_flags)?;
        let (r, bounds) = (&bounded.solution.report, &bounded.report);
        let status = status(r.negative(rms_before(&desired, weight.as_ref())));
        let dwell = &bounded.solution.dwell;
        let plan =
            PlanOutcome { end: Some(r.end.into()), report: Some(r), ..PlanOutcome::default() };
        output.write(dwell, BclsOutcome { plan, bounds }, &status)?;
        warn_of(r.tif_lattice);
        say(format!(
            "bcls: {} dwell times, {:.2} s, {:.4} nm RMS in its own model; {} {} after {} iterations; pitch \
             limit {:.4} mm, {} of the segments are shorter, feeds up to {:.2} mm/s; {} at the least dwell \
             time, {} at the largest -> {}",
            dwell.dwell_s().len(),
            r.total_time_s,
            r.model_rms_nm,
            r.algorithm,
            r.end,
            r.iterations,
            bounds.pitch_limit_mm,
            bounds.below_pitch_limit,
            bounds.reachable_mm_per_s[1],
            r.at_lower_bound,
            r.at_upper_bound,
            self.common.output.out.display()
        ));
        Ok(status)
    }
}
