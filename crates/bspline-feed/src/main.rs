//! `planish-bspline-feed`: desired removal, TIF and tool path become a feed profile and its motion.

use std::process::ExitCode;

use clap::Parser;
use planish_bspline_feed::{
    Settings,
    deconvolution::Refinement,
    plan,
    plan::{Method, Piston},
};
use planish_handoff::{
    Artifact, Begin, Failure, Inputs, Output, Status,
    flags::{MachineArgs, MirrorArgs, OutputArgs, PathArgs},
    run, say, task,
};
use planish_types::{
    DwellDensity, End, Trajectory,
    plausible::{self, Rms},
};
use serde_json::json;

#[global_allocator]
static ALLOCATOR: planish_handoff::Allocator = planish_handoff::Allocator;

const EXAMPLES: &str = "Examples:\n\
    \x20 planish-bspline-feed --surface out/surface --tif tool --tool-path out/tool_path --machine machine.json --out out/bspline";

/// Find the feed along every pass of a path, as a B-spline, and the motion that runs it
///
/// The path is of straight passes that turn outside the clear aperture.
#[derive(Parser)]
#[command(version, after_help = EXAMPLES)]
struct Cli {
    #[command(flatten)]
    mirror: MirrorArgs,
    #[command(flatten)]
    path: PathArgs,
    #[command(flatten)]
    machine: MachineArgs,
    /// Where the feed comes from
    #[arg(long, value_enum, default_value = "deconvolution")]
    method: Method,
    /// How the acceleration limit is kept
    #[arg(long, value_enum, default_value = "convex-concave")]
    refinement: Refinement,
    /// Distance of the knots, mm [default: a quarter of the TIF's width]
    #[arg(long, value_name = "L")]
    knot_spacing_mm: Option<f64>,
    /// Distance of neighbouring passes for the VRR feed, mm [default: measured]
    #[arg(long, value_name = "P")]
    pitch_mm: Option<f64>,
    /// What the uniform part of the desired removal means
    #[arg(long, value_enum, default_value = "keep")]
    piston: Piston,
    /// Weight of the distance to the least dwell density, relative to the strongest column
    #[arg(long, value_name = "A", default_value_t = Settings::default().tikhonov)]
    tikhonov: f64,
    /// Weight of the second differences of the control values along a pass, likewise
    #[arg(long, value_name = "B", default_value_t = Settings::default().smoothness)]
    smoothness: f64,
    /// End when a sweep over the lines lowers the objective by less than this part
    #[arg(long, value_name = "R", default_value_t = Settings::default().tolerance)]
    tolerance: f64,
    /// Most sweeps over the lines
    #[arg(long, value_name = "N", default_value_t = Settings::default().max_sweeps)]
    max_sweeps: usize,
    /// Largest distance of the motion from the feed profile at equal times, mm
    #[arg(long, value_name = "E", default_value_t = Settings::default().fit_tolerance_mm)]
    fit_tolerance_mm: f64,
    #[command(flatten)]
    output: OutputArgs,
}

fn main() -> ExitCode {
    let cli: Cli = planish_handoff::parse();
    run(|| feed(&cli))
}

fn feed(cli: &Cli) -> Result<Status, Failure> {
    let settings = Settings {
        method: cli.method,
        refinement: cli.refinement,
        knot_spacing_mm: cli.knot_spacing_mm,
        pitch_mm: cli.pitch_mm,
        piston: cli.piston,
        tikhonov: cli.tikhonov,
        smoothness: cli.smoothness,
        tolerance: cli.tolerance,
        max_sweeps: cli.max_sweeps,
        fit_tolerance_mm: cli.fit_tolerance_mm,
    };
    let method = match cli.method {
        Method::Deconvolution => "bspline",
        Method::Vrr => "vrr",
    };
    let mut inputs = Inputs::new();
    let (surface, tif) = cli.mirror.read(&mut inputs)?;
    let path = cli.path.read(&mut inputs)?;
    let machine = cli.machine.read(&mut inputs)?;
    let task = task!(method, settings);
    let parts = [("feed", DwellDensity::KIND), ("trajectory", Trajectory::KIND)];
    let mut output = match Output::directories(&cli.output, parts).begin(&task, &inputs)? {
        Begin::Unchanged(status) => return Ok(status),
        Begin::Run(output) => output,
    };

    plausible::check_path(&surface, &tif, &path)?;
    let plan = plan(&surface, &tif, &path, &machine, &settings)?;

    let r = &plan.report;
    let total_time_s = plan.trajectory.total_time_s();
    let drawback = match (r.model_rms_nm, r.model_rms_detilted_nm) {
        (Some(rms_nm), Some(detilted_nm)) => {
            plausible::drawback(Rms::of(&surface), Rms { rms_nm, detilted_nm }, total_time_s)
        }
        _ => plausible::too_long(total_time_s),
    };
    let unfinished = match r.end {
        End::SweepLimit => Some(format!(
            "not converged: after {} sweeps the objective still falls by more than {} of itself; \
             raise --max-sweeps or --tolerance",
            r.sweeps, cli.tolerance
        )),
        End::LinkLimit => Some(
            "not converged: what the turn-arounds remove still changes from round to round; give the \
             path more overscan, so that they lie off the part"
                .to_string(),
        ),
        _ => None,
    };
    let status = unfinished.or(drawback).map_or(Status::Done, Status::Negative);
    let outcome = json!({
        "end": r.end,
        "total_time_s": total_time_s,
        "between_nodes": "cubic B-spline per pass, on the knots whose Greville abscissae the nodes are",
        "report": r,
    });
    output.write(&plan.density, outcome.clone(), &status)?;
    output.write(&plan.trajectory, outcome, &status)?;
    let rms =
        r.model_rms_nm.map_or(String::new(), |rms| format!(", {rms:.4} nm RMS in its own model"));
    say(format!(
        "{method}: {} passes, {} control values, {:.3} s{rms}; {:.1} % of the feed and {:.1} % of the \
         acceleration limit used; {} turn-arounds and {} lifts as links of {:.3} s; {} sweeps -> {}",
        r.passes,
        r.control_values,
        plan.trajectory.total_time_s(),
        100.0 * r.feed_use,
        100.0 * r.acceleration_use,
        r.links.turn_arounds,
        r.links.lifts,
        r.links.total_time_s,
        r.sweeps,
        cli.output.out.display()
    ));
    Ok(status)
}
