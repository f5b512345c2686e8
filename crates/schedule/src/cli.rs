//! Subcommands, one file each, and the code that all schedulers share.

mod abort;
mod average_velocity;
mod constant_acceleration;
mod interpolate;
mod position;
mod program;
mod pvt;
mod pvt_as_published;
mod stop_at_corners;
mod trig_spline;

use std::path::Path;

use clap::{Args, Subcommand};
use planish_handoff::{
    Artifact, Begin, Failure, Inputs, Output, Status,
    flags::{MachineArgs, OutputArgs, PathDistanceArgs, PlanArgs},
    say, task, with_flags,
};
use planish_schedule::{
    ScheduleError,
    claim::{Claim, broken_limits, drawback, measured_claim},
};
use planish_types::{
    DwellDensity, DwellTime, Limits, PathDistance, ToolPath, Trajectory, outcome::plan::PlanOutcome,
};
use serde::Serialize;
use serde_json::Value;

/// Commands. The hidden ones are baselines; the help lists them under a heading of their own.
#[derive(Subcommand)]
pub enum ScheduleCommand {
    /// Cubic segments through the control points at the dwell times, within the limits (PVT)
    Pvt(SchedulerCommand<pvt::Pvt>),
    /// PVT by the least squares of its publication; stretches nothing
    #[command(hide = true)]
    PvtAsPublished(SchedulerCommand<pvt_as_published::PvtAsPublished>),
    /// One constant acceleration, then constant velocity, per segment; no look-ahead
    ///
    /// Each axis keeps its velocity and acceleration limits by itself. It goes too far where the path changes
    /// direction, and comes back. A segment takes longer if a limit needs more time.
    ConstantAcceleration(SchedulerCommand<constant_acceleration::ConstantAcceleration>),
    /// Constant acceleration along the path with look-ahead, at rest in every corner
    ///
    /// The motion keeps all velocity and acceleration limits, and takes more time.
    StopAtCorners(SchedulerCommand<stop_at_corners::StopAtCorners>),
    /// Dwell-time density as a trigonometric spline along the path, raised until the limits are kept
    TrigSpline(SchedulerCommand<trig_spline::TrigSpline>),
    /// Constant velocity per segment; no machine can execute its velocity steps
    #[command(hide = true)]
    AverageVelocity(SchedulerCommand<average_velocity::AverageVelocity>),
    /// Rest at the dwell points; no machine can execute the jumps between them
    #[command(hide = true)]
    Position(SchedulerCommand<position::Position>),
    /// Reference positions at every tick of a controller, from a feed artifact or its NC program
    ///
    /// The file, .csv or .npy, has a row per tick: time_s, x_mm, y_mm, feed_mm_per_s, pass_idx.
    Interpolate(interpolate::Interpolate),
    /// NC program of a feed artifact: blocks of end point, densities and arc lengths
    Program(program::ProgramCommand),
    /// Motion that was executed when a run was interrupted: up to the abort, the stop, and the tool that stays on
    ///
    /// After the abort the axes slow down together, the fastest at its largest acceleration. planish resume runs
    /// this command.
    Abort(abort::Abort),
}

impl ScheduleCommand {
    pub fn run(&self) -> Result<Status, Failure> {
        match self {
            Self::Pvt(scheduler) => scheduler.run(),
            Self::PvtAsPublished(scheduler) => scheduler.run(),
            Self::ConstantAcceleration(scheduler) => scheduler.run(),
            Self::StopAtCorners(scheduler) => scheduler.run(),
            Self::TrigSpline(scheduler) => scheduler.run(),
            Self::AverageVelocity(scheduler) => scheduler.run(),
            Self::Position(scheduler) => scheduler.run(),
            Self::Interpolate(arguments) => arguments.run(),
            Self::Program(arguments) => arguments.run(),
            Self::Abort(arguments) => arguments.run(),
        }
    }
}

// A scheduler with the inputs and the output that all have. A doc comment would become a part of the help.
#[derive(Args)]
pub struct SchedulerCommand<S: Args> {
    #[command(flatten)]
    plan: PlanArgs,
    #[command(flatten)]
    machine: MachineArgs,
    #[command(flatten)]
    distance: PathDistanceArgs,
    #[command(flatten)]
    output: OutputArgs,
    #[command(flatten)]
    scheduler: S,
}

/// Settings of a scheduler for the manifest, with the tolerance of the path by which its motion is judged.
#[derive(Serialize)]
struct JudgedSettings<'a, S> {
    #[serde(flatten)]
    settings: &'a S,
    max_path_distance_mm: f64,
}

/// Settings of a scheduler that has no settings.
#[derive(Serialize)]
pub struct NoSettings {}

/// Result of a scheduler for the command line.
pub struct Made {
    trajectory: Trajectory,
    /// Nodes of the dwell-time density; `None` if the scheduler has no density.
    density: Option<DwellDensity>,
    report: Value,
    /// Text that follows the counts in the line that the program prints.
    remark: String,
}

/// Subcommand that makes a motion.
pub trait MotionCommand {
    /// Name of the method in the manifest, equal to the name of the subcommand.
    const METHOD: &'static str;

    /// Settings for the manifest, with all defaults resolved for this machine and path.
    type SchedulerSettings: Serialize;

    fn settings(&self, machine: &Limits, max_path_distance_mm: f64) -> Self::SchedulerSettings;

    /// Returns the name of the kind of motion; `None` if the method has one kind only.
    fn kind(_: &Self::SchedulerSettings) -> Option<&'static str> {
        None
    }

    /// Returns the output directory for the nodes of the dwell-time density; `None` without `--dwell-density-out`.
    fn dwell_density(&self) -> Option<&Path> {
        None
    }

    fn make(
        path: &ToolPath,
        dwell: &DwellTime,
        machine: &Limits,
        settings: &Self::SchedulerSettings,
    ) -> Result<Made, ScheduleError>;

    /// Returns advice for the user if a limit is exceeded; `None` if there is none.
    fn advice(_: &Self::SchedulerSettings, _: &Claim) -> Option<String> {
        None
    }
}

impl<S: MotionCommand + Args> SchedulerCommand<S> {
    fn run(&self) -> Result<Status, Failure> {
        let scheduler = &self.scheduler;
        let mut inputs = Inputs::new();
        let (path, dwell, overscan_mm) = self.plan.read(&mut inputs)?;
        let machine = self.machine.read(&mut inputs)?;
        let tolerance_mm =
            self.distance.tolerance_mm(&path, overscan_mm).map_err(Failure::with_flags)?;
        let settings = scheduler.settings(&machine, tolerance_mm);
        let task = task!(
            S::METHOD,
            JudgedSettings { settings: &settings, max_path_distance_mm: tolerance_mm }
        );
        let mut output = Output::directory(&self.output, Trajectory::KIND);
        if let Some(dir) = scheduler.dwell_density() {
            output = output.and_directory("--dwell-density-out", dir, DwellDensity::KIND);
        }
        let mut output = match output.begin(&task, &inputs)? {
            Begin::Unchanged(status) => return Ok(status),
            Begin::Run(output) => output,
        };

        let made = S::make(&path, &dwell, &machine, &settings)?;
        let claim = measured_claim(&made.trajectory, &machine);
        let total_time_s = made.trajectory.total_time_s();
        let distance = PathDistance::new(&made.trajectory, &path, Some(tolerance_mm))?;
        let drawback = drawback(&claim, total_time_s, S::advice(&settings, &claim).as_deref());
        let drawbacks: Vec<String> =
            drawback.into_iter().chain(distance.excess().map(nearer)).collect();
        let status = if drawbacks.is_empty() {
            Status::Done
        } else {
            Status::Negative(drawbacks.join("; "))
        };
        let outcome = PlanOutcome {
            dwell_s: Some(dwell.total_s()),
            total_time_s: Some(total_time_s),
            claim: Some(claim),
            path_distance: Some(distance),
            report: Some(&made.report),
            ..PlanOutcome::default()
        };
        if scheduler.dwell_density().is_some() {
            let density = made.density.as_ref().ok_or_else(|| {
                Failure::new(
                        "--dwell-density-out: the path has no length, so there is no dwell-time density; omit the \
                         flag",
                    )
            })?;
            let outcome = PlanOutcome { report: Some(&made.report), ..PlanOutcome::default() };
            output.write(density, outcome, &status)?;
        }
        output.write(&made.trajectory, outcome, &status)?;
        say(format!(
            "{}{}: {} segments, {:.3} s (dwell {:.3} s){}; {distance}{} -> {}",
            S::METHOD,
            S::kind(&settings).map_or(String::new(), |kind| format!(" ({kind})")),
            made.trajectory.len(),
            total_time_s,
            dwell.total_s(),
            made.remark,
            broken_limits(&claim).iter().map(|b| format!("; {b}")).collect::<String>(),
            self.output.out.display()
        ));
        Ok(status)
    }
}

/// Returns the message about a motion that is too far from its path, with the remedy.
fn nearer(excess: String) -> String {
    with_flags(&format!(
        "{excess}. planish schedule pvt stays within it; or give a larger tolerance that is harmless on this part"
    ))
}

fn micron(mm: f64) -> f64 {
    1e3 * mm
}
