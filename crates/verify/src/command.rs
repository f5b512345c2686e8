//! `planish verify`: checks whether a trajectory keeps the limits of a machine.

use std::{
    path::{Path, PathBuf},
    process::ExitCode,
};

use clap::{CommandFactory, Parser};
use planish_handoff::{
    Begin, Failure, Inputs, Manifest, Output, Status,
    flags::{AxesArgs, NearPathArgs, OutputArgs, TrajectoryArgs},
    kind, say, task, warn, with_flags,
};
use planish_types::{
    AxesMotion, Interpolation, Kinematics, TransformNumbers,
    outcome::{NoMore, settings::ProgramSettings},
};
use planish_verify::{AxesVerdict, Program, Verdict, VerifySettings, verify_axes, verify_on_axes};
use serde::Deserialize;

const EXAMPLES: &str = "Examples:\n\
    \x20 planish verify --trajectory out/trajectory --machine machine.json --out out/verdict\n\
    \x20 planish verify --axes out/axes --machine five-axis.json --out out/verdict";

/// Returns the law by which a controller runs the motion of this manifest. `None` if the motion is not a program that
/// `planish import program` read.
fn program_of(manifest: &Manifest) -> Option<Program> {
    let is_program = manifest.tool == "planish-import" && manifest.method == "program";
    if !is_program {
        return None;
    }
    match ProgramSettings::<NoMore>::deserialize(&manifest.settings) {
        Ok(ProgramSettings { controller, .. })
            if controller.model().interpolation == Interpolation::Linear =>
        {
            Some(Program::Lines)
        }
        _ => Some(Program::Cubics),
    }
}

/// Prove whether a trajectory keeps the limits of a machine; exit code 1 when it does not
///
/// The program judges the motion of the axes. If the machine file states how the part lies on them, the motion is
/// transformed there. A limit on jerk allows no step of the acceleration.
///
/// A controller's program that planish import program read is judged by another law. Its acceleration may step at a
/// node by the jerk limit times the time between the middles of the two segments. The jerk of a program of straight
/// lines (such as gcode) is not judged.
///
/// With --tool-path, the motion may not leave its path by more than a tolerance while the tool is on. Without it, the
/// verdict states the distance that the maker of the motion states.
///
/// A motion of all axes (--axes) is judged by the law of such a program: of cubics, or of lines if planish import program
/// read it from such lines.
#[derive(Parser)]
#[command(version, after_help = EXAMPLES)]
struct VerifyCli {
    /// Motion [trajectory artifact]
    #[arg(long, value_name = "DIR", required_unless_present = "axes", conflicts_with = "axes")]
    trajectory: Option<PathBuf>,
    /// Motion of all axes [axes artifact]
    #[arg(long, value_name = "DIR")]
    axes: Option<PathBuf>,
    #[command(flatten)]
    machine: AxesArgs,
    #[command(flatten)]
    near_path: NearPathArgs,
    /// Largest step in position that is taken for rounding, mm; of a rotary axis in degrees
    #[arg(long, value_name = "T", default_value_t = VerifySettings::default().position_step_mm)]
    position_step_mm: f64,
    /// Largest step in velocity that is taken for rounding, mm/s, of a rotary axis in deg/s; 1e-9 of
    /// the largest velocity is added
    #[arg(
        long,
        value_name = "T",
        default_value_t = VerifySettings::default().velocity_step_mm_per_s
    )]
    velocity_step_mm_per_s: f64,
    #[command(flatten)]
    output: OutputArgs,
}

/// The command `planish verify`.
pub const COMMAND: planish_handoff::Stage =
    planish_handoff::Stage { name: env!("CARGO_PKG_NAME"), main, definition: VerifyCli::command };

fn main() -> ExitCode {
    planish_handoff::program(|cli: &VerifyCli| match (&cli.axes, &cli.trajectory) {
        (Some(axes), _) => judge_axes(cli, axes),
        (None, Some(trajectory)) => judge_trajectory(cli, trajectory.clone()),
        (None, None) => Err(Failure::new("give --trajectory or --axes")),
    })
}

/// Checks a motion of all axes against the machine, and writes the verdict.
fn judge_axes(cli: &VerifyCli, axes: &Path) -> Result<Status, Failure> {
    let mut inputs = Inputs::new();
    let (motion, manifest): (AxesMotion, _) = inputs.read_with_manifest("axes", axes)?;
    let machine = cli.machine.read(axes, manifest.as_ref(), &mut inputs)?;
    warn_of_dry_run(motion.tool_on());
    let settings = VerifySettings {
        position_step_mm: cli.position_step_mm,
        velocity_step_mm_per_s: cli.velocity_step_mm_per_s,
        program: Some(manifest.as_ref().and_then(program_of).unwrap_or(Program::Cubics)),
    };
    let task = task!("verify-axes", settings);
    let mut output = match Output::directory(&cli.output, &kind::VERDICT).begin(&task, &inputs)? {
        Begin::Unchanged(status) => return Ok(status),
        Begin::Run(output) => output,
    };
    let verdict = AxesVerdict {
        machine: Some(machine.name().into()),
        ..verify_axes(&motion, &machine, &settings)?
    };
    let status = verdict.reason().map_or(Status::Done, Status::Negative);
    output.write_arrays(&kind::VERDICT, &[], &[], &verdict, &status)?;
    let peaks = verdict.axes.iter().map(|axis| {
        let v = axis.velocity.magnitude();
        let a = axis.acceleration.magnitude();
        format!("{} {v:.2} {u}/s, {a:.1} {u}/s^2", axis.name, u = axis.unit)
    });
    say(format!(
        "{}: velocity and acceleration up to {} in {} segments, limits {} -> {}",
        machine.name(),
        peaks.collect::<Vec<_>>().join("; "),
        verdict.segment_count,
        if verdict.limits_respected { "kept" } else { "exceeded" },
        cli.output.out.display()
    ));
    if settings.program == Some(Program::Lines)
        && machine.axes().iter().any(|a| a.max_jerk.is_some())
    {
        say(JERK_OF_LINES);
    }
    Ok(status)
}

/// Warns of a motion whose tool is off in every segment.
fn warn_of_dry_run(tool_on: &[bool]) {
    if !tool_on.contains(&true) {
        warn(
            "the tool is off in every segment: this is a verdict on a dry run, not on a program that removes",
        );
    }
}

/// Settings of a verdict, with the tolerance of the distance from the path if it is known.
#[derive(serde::Serialize)]
struct JudgedSettings {
    #[serde(flatten)]
    settings: VerifySettings,
    #[serde(skip_serializing_if = "Option::is_none")]
    max_path_distance_mm: Option<f64>,
}

/// Message about a program of straight lines on a machine whose axes have a limit on jerk.
const JERK_OF_LINES: &str = "the jerk limit is not judged: how the controller joins the straight lines of the program \
                             decides on the jerk";

/// Checks a motion in the plane of x and y against the machine, and writes the verdict.
fn judge_trajectory(cli: &VerifyCli, trajectory: PathBuf) -> Result<Status, Failure> {
    let mut inputs = Inputs::new();
    let on_axes = TrajectoryArgs { trajectory }.read_on_axes(&cli.machine, &mut inputs)?;
    let settings = VerifySettings {
        position_step_mm: cli.position_step_mm,
        velocity_step_mm_per_s: cli.velocity_step_mm_per_s,
        program: on_axes.manifest.as_ref().and_then(program_of),
    };
    let machine = &on_axes.machine;
    if *machine.kinematics() != Kinematics::Xy {
        let names: Vec<&str> = machine.axes().iter().map(|a| a.name).collect();
        warn(format!(
            "{} has the axes {}; this verdict is on the contact point along x and y only. Make the motion of the axes by \
             planish axes motion, and judge it by --axes",
            machine.name(),
            names.join(", ")
        ));
    }
    warn_of_dry_run(on_axes.motion.tool_on());
    let distance = cli.near_path.measure(&on_axes, &mut inputs)?;
    let tolerance_mm = distance.map(|distance| distance.tolerance_mm);
    let task = task!("verify", JudgedSettings { settings, max_path_distance_mm: tolerance_mm });
    let mut output = match Output::directory(&cli.output, &kind::VERDICT).begin(&task, &inputs)? {
        Begin::Unchanged(status) => return Ok(status),
        Begin::Run(output) => output,
    };

    let verdict = Verdict {
        machine: Some(machine.name().into()),
        part_to_axes: on_axes.part_to_axes.as_ref().map(TransformNumbers::from),
        ..verify_on_axes(&on_axes.motion, machine, &settings)?
    };
    let verdict = match distance {
        Some(distance) => verdict.with_path_distance(distance),
        None => verdict,
    };

    let status = match verdict.reason() {
        Some(reason) => Status::Negative(with_flags(&reason)),
        None => Status::Done,
    };
    output.write_arrays(&kind::VERDICT, &[], &[], &verdict, &status)?;
    let [vx, vy] = verdict.max_velocity_mm_per_s;
    let [ax, ay] = verdict.max_acceleration_mm_per_s2;
    say(format!(
        "{}: velocity up to {vx:.2}, {vy:.2} mm/s, acceleration up to {ax:.1}, {ay:.1} mm/s^2 \
         (x, y) in {} segments, limits {} -> {}",
        machine.name(),
        verdict.segment_count,
        if verdict.limits_respected { "kept" } else { "exceeded" },
        cli.output.out.display()
    ));
    say(match &distance {
        Some(distance) if cli.near_path.tool_path.is_none() => {
            format!("the maker of the motion states: {distance}")
        }
        Some(distance) if distance.by_dwell_points => format!("the motion is {distance}"),
        Some(distance) => format!("the motion is {distance}, by the nearest segment of the path"),
        None => "how far the motion leaves its path is not judged: give --tool-path".to_string(),
    });
    let limits_jerk = machine.limits().axes().iter().any(|a| a.max_jerk_mm_per_s3().is_some());
    let [x, y] = verdict.max_acceleration_step_mm_per_s2;
    match settings.program.filter(|_| limits_jerk) {
        None => {}
        Some(Program::Cubics) => say(format!(
            "a controller joins its cubics with steps of the acceleration: here up to {x:.1}, {y:.1} mm/s^2 (x, y), \
             and the jerk limit bounds each by the time between the middles of two segments"
        )),
        Some(Program::Lines) => say(JERK_OF_LINES),
    }
    Ok(status)
}
