//! `planish-schedule`: tool path and dwell times become a motion.

mod program;

use std::{path::PathBuf, process::ExitCode};

use clap::{Args, Parser, Subcommand, ValueEnum};
use planish_handoff::{
    Artifact, Begin, Failure, Inputs, Output, Status,
    flags::{MachineArgs, OutputArgs, PlanArgs},
    run, say, task,
};
use planish_schedule::{
    average_velocity, claim::Claim, constant_acceleration, position, pvt, pvt_seed,
    stop_at_corners, trig_spline,
};
use planish_types::{DwellDensity, DwellTime, Limits, ToolPath, Trajectory, plausible};
use serde_json::{Value, json};

#[global_allocator]
static ALLOCATOR: planish_handoff::Allocator = planish_handoff::Allocator;

const EXAMPLES: &str = "Examples:\n\
    \x20 planish-schedule pvt --tool-path out/tool_path --dwell out/dwell --machine machine.json --mode monotone --out out/trajectory";

/// Turn a tool path and dwell times into a motion that the machine can follow
#[derive(Parser)]
#[command(version, after_help = EXAMPLES)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    #[command(flatten)]
    Schedule(Scheduler),
    /// Reference positions at every tick of a controller, from a feed or its NC program
    ///
    /// The file, .csv or .npy, has a row per tick: time_s, x_mm, y_mm, feed_mm_per_s, pass_idx.
    Interpolate(program::Interpolate),
    /// Write a feed as an NC program: blocks of end point, densities and arc lengths
    Program(program::Program),
}

#[derive(Subcommand)]
enum Scheduler {
    /// Cubic segments through the control points at the dwell times, within the limits
    Pvt {
        #[command(flatten)]
        common: Common,
        /// What is solved for
        #[arg(long, value_enum, default_value = "hermite")]
        formulation: Formulation,
        /// Whether Eq. 16 rests at the start only, or as printed after the first segment too (seed)
        #[arg(long, value_enum)]
        eq_16: Option<pvt_seed::Eq16>,
        /// What the motion shall be like (hermite) [default: auto]
        #[arg(long, value_enum)]
        mode: Option<pvt::ModeChoice>,
        /// Refuse dwell times that the machine cannot follow instead of stretching them (hermite)
        #[arg(long)]
        no_stretch: bool,
    },
    /// One constant acceleration, then constant velocity, per segment; no look-ahead
    ConstantAcceleration {
        #[command(flatten)]
        common: Common,
        /// What happens where the path changes direction
        #[arg(long, value_enum, default_value = "overshoot")]
        corners: Corners,
    },
    /// Dwell-time density as a trigonometric spline along the path, lifted to the limits
    TrigSpline {
        #[command(flatten)]
        common: Common,
        /// How densities that the machine cannot follow are repaired
        #[arg(long, value_enum, default_value = "offset")]
        repair: trig_spline::Repair,
        /// Largest distance of the motion from a corner, mm
        #[arg(long, value_name = "MM", default_value_t = trig_spline::Settings::default().corner_deviation_mm)]
        corner_deviation_mm: f64,
        /// Largest error of the position where the motion is fitted by cubics, mm
        #[arg(long, value_name = "MM", default_value_t = trig_spline::Settings::default().fit_tolerance_mm)]
        fit_tolerance_mm: f64,
        /// Also write the nodes of the spline, for `interpolate` and `program` [feed artifact]
        #[arg(long, value_name = "DIR")]
        feed: Option<PathBuf>,
    },
    /// Constant velocity per segment: what a dwell solver believes; its velocity steps
    AverageVelocity {
        #[command(flatten)]
        common: Common,
    },
    /// Stand at the dwell points and jump between them: the ideal, no machine can do it
    Position {
        #[command(flatten)]
        common: Common,
    },
}

#[derive(Args)]
struct Common {
    #[command(flatten)]
    plan: PlanArgs,
    #[command(flatten)]
    machine: MachineArgs,
    #[command(flatten)]
    output: OutputArgs,
}

#[derive(Clone, Copy, PartialEq, ValueEnum)]
enum Formulation {
    /// Node velocities; positions and times exact, limits kept
    Hermite,
    /// The least squares of the source, with its defects reported; nothing is stretched
    Seed,
}

#[derive(Clone, Copy, ValueEnum)]
enum Corners {
    /// Each axis by itself, as in the source: it goes too far and comes back
    Overshoot,
    /// Along the path with look-ahead, at rest in every corner: within all limits, for more time
    Stop,
}

/// A scheduler with its resolved settings.
enum Method {
    Pvt(pvt::Settings),
    PvtSeed(pvt_seed::Eq16),
    ConstantAcceleration,
    StopAtCorners,
    TrigSpline(trig_spline::Settings),
    AverageVelocity,
    Position,
}

/// What a scheduler made.
struct Made {
    trajectory: Trajectory,
    density: Option<DwellDensity>,
    report: Value,
    /// For the line that the user reads.
    remark: String,
}

fn main() -> ExitCode {
    let cli: Cli = planish_handoff::parse();
    run(|| match &cli.command {
        Command::Schedule(scheduler) => schedule(scheduler),
        Command::Interpolate(arguments) => program::interpolate(arguments),
        Command::Program(arguments) => program::write(arguments),
    })
}

impl Scheduler {
    fn common(&self) -> &Common {
        match self {
            Self::Pvt { common, .. }
            | Self::ConstantAcceleration { common, .. }
            | Self::TrigSpline { common, .. }
            | Self::AverageVelocity { common }
            | Self::Position { common } => common,
        }
    }

    fn name(&self) -> &'static str {
        match self {
            Self::Pvt { .. } => "pvt",
            Self::ConstantAcceleration { .. } => "constant-acceleration",
            Self::TrigSpline { .. } => "trig-spline",
            Self::AverageVelocity { .. } => "average-velocity",
            Self::Position { .. } => "position",
        }
    }

    fn method(&self, machine: &Limits) -> Result<Method, Failure> {
        Ok(match self {
            Self::Pvt { formulation: Formulation::Hermite, eq_16: Some(_), .. } => {
                let message = "--eq-16 belongs to --formulation seed: leave it out";
                return Err(Failure::new(message));
            }
            Self::Pvt { formulation: Formulation::Hermite, mode, no_stretch, .. } => {
                let mode = mode.unwrap_or_default().on(machine);
                Method::Pvt(pvt::Settings { mode, stretch: !no_stretch })
            }
            Self::Pvt { mode: None, no_stretch: false, eq_16, .. } => {
                Method::PvtSeed(eq_16.unwrap_or_default())
            }
            Self::Pvt { .. } => {
                let message = "--mode and --no-stretch belong to --formulation hermite; the seed \
                               formulation has neither: leave them out";
                return Err(Failure::new(message));
            }
            Self::ConstantAcceleration { corners: Corners::Overshoot, .. } => {
                Method::ConstantAcceleration
            }
            Self::ConstantAcceleration { corners: Corners::Stop, .. } => Method::StopAtCorners,
            Self::TrigSpline { repair, corner_deviation_mm, fit_tolerance_mm, .. } => {
                Method::TrigSpline(trig_spline::Settings {
                    repair: *repair,
                    corner_deviation_mm: *corner_deviation_mm,
                    fit_tolerance_mm: *fit_tolerance_mm,
                })
            }
            Self::AverageVelocity { .. } => Method::AverageVelocity,
            Self::Position { .. } => Method::Position,
        })
    }
}

impl Method {
    /// The mode of a PVT motion, which may be one that was not asked for by name.
    fn mode(&self) -> Option<&'static str> {
        match self {
            Self::Pvt(pvt::Settings { mode: pvt::Mode::Smooth, .. }) => Some("smooth"),
            Self::Pvt(pvt::Settings { mode: pvt::Mode::Monotone, .. }) => Some("monotone"),
            _ => None,
        }
    }

    /// The verdict: what the motion claims of itself, and why that is so where it is a matter of the
    /// method.
    fn status(&self, claim: &Claim, total_time_s: f64) -> Status {
        if claim.limits_respected {
            return plausible::too_long(total_time_s).map_or(Status::Done, Status::Negative);
        }
        let why = match self {
            Self::Position | Self::AverageVelocity => "; it is an ideal that no machine can do",
            Self::Pvt(pvt::Settings { mode: pvt::Mode::Monotone, .. })
                if claim.jerk == Some(false) =>
            {
                "; --mode smooth keeps a limit on jerk"
            }
            _ => "",
        };
        let broken = claim.broken().join(", ");
        Status::Negative(format!("a limit of the machine is exceeded: {broken}{why}"))
    }

    fn settings(&self) -> Value {
        match self {
            Self::Pvt(s) => {
                json!({ "formulation": "hermite", "mode": s.mode, "stretch": s.stretch })
            }
            Self::PvtSeed(eq_16) => json!({ "formulation": "seed", "eq_16": eq_16 }),
            Self::TrigSpline(s) => json!(s),
            Self::ConstantAcceleration => json!({ "corners": "overshoot" }),
            Self::StopAtCorners => json!({ "corners": "stop" }),
            Self::AverageVelocity | Self::Position => json!({}),
        }
    }

    fn run(&self, path: &ToolPath, dwell: &DwellTime, machine: &Limits) -> Result<Made, Failure> {
        let micron = 1e3;
        Ok(match self {
            Self::Pvt(settings) => {
                let s = pvt::schedule(path, dwell, machine, settings)?;
                let remark = format!(
                    "; {} segments stretched by {:.4} s with the tool on, {:.4} s lifted",
                    s.report.stretched.len(),
                    s.report.added_tool_on_s,
                    s.report.added_tool_off_s
                );
                Made { trajectory: s.trajectory, density: None, report: json!(s.report), remark }
            }
            Self::PvtSeed(eq_16) => {
                let s = pvt_seed::schedule(path, dwell, machine, *eq_16)?;
                let (r, [x, y]) = (&s.report, s.report.largest_position_error_mm);
                let [vx, vy] = r.largest_resting_velocity_mm_per_s;
                let remark = format!(
                    "; its least squares miss positions by up to {:.1} and {:.1} um, its resting \
                     axes move at up to {vx:.3} and {vy:.3} mm/s",
                    x * micron,
                    y * micron
                );
                Made { trajectory: s.trajectory, density: None, report: json!(s.report), remark }
            }
            Self::ConstantAcceleration => {
                let s = constant_acceleration::schedule(path, dwell, machine)?;
                let r = &s.report;
                let remark = format!(
                    "; overshoot beyond 1 nm in {} x and {} y segments, up to {:.1} and {:.1} um; \
                     {} segments late by {:.4} s",
                    r.overshoot_segments[0],
                    r.overshoot_segments[1],
                    r.largest_overshoot_mm[0] * micron,
                    r.largest_overshoot_mm[1] * micron,
                    r.late_segments,
                    r.added_s
                );
                Made { trajectory: s.trajectory, density: None, report: json!(s.report), remark }
            }
            Self::StopAtCorners => {
                let s = stop_at_corners::schedule(path, dwell, machine)?;
                let r = &s.report;
                let remark = format!(
                    "; at rest in {} corners; {} segments late by {:.4} s, {} lifts by {:.4} s",
                    r.stops, r.late_segments, r.added_s, r.lifts, r.added_lifted_s
                );
                Made { trajectory: s.trajectory, density: None, report: json!(s.report), remark }
            }
            Self::TrigSpline(settings) => {
                let s = trig_spline::schedule(path, dwell, machine, settings)?;
                let r = &s.report;
                let offset = r.feed_offset_s_per_mm + r.acceleration_offset_s_per_mm;
                let remark = format!(
                    "; offset {offset:.6} s/mm adds {:.3} s; {} of {} corners slowed, adding \
                     {:.3} s; {} links take {:.3} s",
                    r.offset_added_s,
                    r.slowed_corners,
                    r.corners,
                    r.corner_added_s,
                    r.links,
                    r.link_s
                );
                Made {
                    trajectory: s.trajectory,
                    density: s.density,
                    report: json!(s.report),
                    remark,
                }
            }
            Self::AverageVelocity => {
                let s = average_velocity::schedule(path, dwell, machine)?;
                let [x, y] = s.report.largest_velocity_step_mm_per_s;
                let remark = format!("; velocity steps of up to {x:.3} and {y:.3} mm/s");
                Made { trajectory: s.trajectory, density: None, report: json!(s.report), remark }
            }
            Self::Position => {
                let trajectory = position::schedule(path, dwell)?;
                let remark = "; jumps between the points".into();
                Made { trajectory, density: None, report: json!({}), remark }
            }
        })
    }
}

fn schedule(scheduler: &Scheduler) -> Result<Status, Failure> {
    let common = scheduler.common();
    let name = scheduler.name();
    let mut inputs = Inputs::new();
    let (path, dwell) = common.plan.read(&mut inputs)?;
    let machine = common.machine.read(&mut inputs)?;
    let method = scheduler.method(&machine)?;
    let task = task!(name, method.settings());
    let feed_dir = match scheduler {
        Scheduler::TrigSpline { feed, .. } => feed.as_ref(),
        _ => None,
    };
    let mut output = Output::directory(&common.output, Trajectory::KIND);
    if let Some(dir) = feed_dir {
        output = output.and_directory("--feed", dir, DwellDensity::KIND);
    }
    let mut output = match output.begin(&task, &inputs)? {
        Begin::Unchanged(status) => return Ok(status),
        Begin::Run(output) => output,
    };

    let made = method.run(&path, &dwell, &machine)?;
    let claim = Claim::of(&made.trajectory, &machine);
    let status = method.status(&claim, made.trajectory.total_time_s());
    let outcome = json!({
        "dwell_s": dwell.total_s(),
        "total_time_s": made.trajectory.total_time_s(),
        "claim": claim,
        "report": made.report,
    });
    if feed_dir.is_some() {
        let density = made.density.as_ref().ok_or_else(|| {
            Failure::new("--feed: the path has no length, so there is no feed; leave --feed out")
        })?;
        output.write(density, json!({ "report": made.report }), &status)?;
    }
    output.write(&made.trajectory, outcome, &status)?;
    say(format!(
        "{}{}: {} segments, {:.3} s (dwell {:.3} s){}{} -> {}",
        name,
        method.mode().map_or(String::new(), |mode| format!(" ({mode})")),
        made.trajectory.len(),
        made.trajectory.total_time_s(),
        dwell.total_s(),
        made.remark,
        claim.broken().iter().map(|b| format!("; {b}")).collect::<String>(),
        common.output.out.display()
    ));
    Ok(status)
}
