//! The command line of `planish bspline-feed`, and the run from its flags to its files.

use clap::Args;
use planish_bspline_feed::{
    FeedSettings,
    deconvolution::Refinement,
    plan,
    plan::{FeedSource, Piston, width_mm},
};
use planish_handoff::{
    Artifact, Begin, Failure, Inputs, Output, Status,
    flags::{MachineArgs, MirrorArgs, OutputArgs, PathArgs},
    say, task, warn,
};
use planish_types::{DwellDensity, PathDistance, Trajectory, outcome::plan::PlanOutcome};

/// Distance by which turn-arounds may extend beyond the ends of the lines, in widths of the TIF. The usual overscan is
/// half the size of the tool, which is more. Larger: turn-arounds leave the overscan. Smaller: plans whose passes end
/// fast are reported as leaving the path. The allowed distance from the path is at least this.
const RUN_OUT_OVER_TIF_WIDTH: f64 = 0.5;

#[derive(Args)]
pub struct Feed {
    #[command(flatten)]
    mirror: MirrorArgs,
    #[command(flatten)]
    path: PathArgs,
    #[command(flatten)]
    machine: MachineArgs,
    /// Source of the feed
    #[arg(long, value_enum, default_value = "deconvolution")]
    feed_source: FeedSource,
    /// Method to keep the acceleration limit
    #[arg(long, value_enum, default_value = "convex-concave")]
    refinement: Refinement,
    /// Distance of the knots, mm [default: a quarter of the TIF's width]
    #[arg(long, value_name = "L")]
    knot_spacing_mm: Option<f64>,
    /// Distance of neighbouring lines, mm, for the VRR feed [default: measured]
    #[arg(long, value_name = "P")]
    pitch_mm: Option<f64>,
    /// Treatment of the uniform part of the desired removal
    #[arg(long, value_enum, default_value = "keep")]
    piston: Piston,
    /// Tikhonov weight of the squared distance to the least dwell density, relative to the strongest column
    #[arg(long, value_name = "A", default_value_t = FeedSettings::default().tikhonov)]
    tikhonov: f64,
    /// Weight of the second differences of the control values along a pass, relative to the strongest column
    #[arg(long, value_name = "B", default_value_t = FeedSettings::default().curvature_weight)]
    curvature_weight: f64,
    /// Relative duality gap at which the solver ends; with knot removal, relative decrease of the objective in a sweep
    #[arg(long, value_name = "R", default_value_t = FeedSettings::default().relative_gap)]
    relative_gap: f64,
    /// Largest number of steps of the interior point method; with knot removal, of sweeps over the lines
    #[arg(long, value_name = "N", default_value_t = FeedSettings::default().max_sweeps)]
    max_sweeps: usize,
    /// Largest error of the position in the fit of the motion by cubics, mm
    #[arg(long, value_name = "E", default_value_t = FeedSettings::default().fit_tolerance_mm)]
    fit_tolerance_mm: f64,
    #[command(flatten)]
    output: OutputArgs,
}

impl Feed {
    pub fn run(&self) -> Result<Status, Failure> {
        let settings = FeedSettings {
            method: self.feed_source,
            refinement: self.refinement,
            knot_spacing_mm: self.knot_spacing_mm,
            pitch_mm: self.pitch_mm,
            piston: self.piston,
            tikhonov: self.tikhonov,
            curvature_weight: self.curvature_weight,
            relative_gap: self.relative_gap,
            max_sweeps: self.max_sweeps,
            fit_tolerance_mm: self.fit_tolerance_mm,
        };
        let method = self.feed_source.name();
        let mut inputs = Inputs::new();
        let (surface, tif) = self.mirror.read(&mut inputs)?;
        let path = self.path.read(&mut inputs)?;
        let machine = self.machine.read(&mut inputs)?;
        let task = task!(method, settings);
        let parts = [("dwell_density", DwellDensity::KIND), ("trajectory", Trajectory::KIND)];
        let mut output = match Output::directories(&self.output, parts).begin(&task, &inputs)? {
            Begin::Unchanged(status) => return Ok(status),
            Begin::Run(output) => output,
        };

        let plan = plan(&surface, &tif, &path, &machine, &settings).map_err(Failure::with_flags)?;

        let r = &plan.report;
        let total_time_s = plan.trajectory.total_time_s();
        let run_out_mm = RUN_OUT_OVER_TIF_WIDTH * width_mm(&tif);
        let tolerance_mm = path.tolerance_mm(None)?.max(run_out_mm);
        let distance = PathDistance::new(&plan.trajectory, &path, Some(tolerance_mm))?;
        let excess = distance.excess().map(|excess| {
            format!("{excess}; plan by planish refine, whose scheduler pvt stays within it")
        });
        let status = plan
            .drawback(&surface, &settings)
            .or(excess)
            .map_or(Status::Done, |text| Status::Negative(planish_handoff::with_flags(&text)));
        let between_nodes =
            "cubic B-spline per pass, on the knots whose Greville abscissae the nodes are";
        let outcome = PlanOutcome {
            end: Some(r.end.into()),
            total_time_s: Some(total_time_s),
            path_distance: Some(distance),
            between_nodes: Some(between_nodes.into()),
            report: Some(r),
            ..PlanOutcome::default()
        };
        output.write(&plan.density, &outcome, &status)?;
        output.write(&plan.trajectory, outcome, &status)?;
        if let Some(warning) = r.tif_lattice.and_then(|lattice| lattice.warning()) {
            warn(warning);
        }
        let rms = r
            .model_rms_nm
            .map_or(String::new(), |rms| format!(", {rms:.4} nm RMS in its own model"));
        let gap = r.proven.gap.map_or(String::new(), |gap| {
            let covered = r.proven.gap_covers.as_deref().unwrap_or_default();
            format!("; proven within {:.2} % of the least objective of {covered}", 100.0 * gap)
        });
        say(format!(
            "{method}: {} passes, {} control values, {:.3} s{rms}{gap}; {:.1} % of the feed and {:.1} % of the \
             acceleration limit used; {} turn-arounds and {} lifts as links of {:.3} s; {} steps; {distance} -> {}",
            r.passes,
            r.control_values,
            total_time_s,
            100.0 * r.feed_use,
            100.0 * r.acceleration_use,
            r.links.turn_arounds,
            r.links.lifts,
            r.links.total_time_s,
            r.sweeps,
            self.output.out.display()
        ));
        Ok(status)
    }
}
