//! `planish schedule abort`: the motion that an abort leaves.

use std::path::PathBuf;

use clap::Args;
use planish_handoff::{
    Artifact, Begin, Failure, Inputs, Output, Status,
    flags::{MachineArgs, OutputArgs, TrajectoryArgs},
    say, task,
};
use planish_schedule::abort::{AbortSettings, aborted, with_dwell_points};
use planish_types::{Trajectory, outcome::abort::AbortOutcome};

/// Longest time between the beginnings of a log and of its plan, s. Larger: more places of the plan are tried, and on a
/// periodic path a wrong one. Smaller: logs are refused that were started long before the motion.
const MOST_OFFSET_S: f64 = 10.0;

#[derive(Args)]
pub struct Abort {
    #[command(flatten)]
    trajectory: TrajectoryArgs,
    /// Time of the abort since the start of the motion, s [default: the end of the motion, for a log]
    #[arg(
        long,
        value_name = "T",
        required_unless_present = "planned",
        allow_negative_numbers = true
    )]
    abort_s: Option<f64>,
    /// Time for which the tool removed after the abort, s
    #[arg(long, value_name = "T", default_value_t = 0.0, allow_negative_numbers = true)]
    tool_stays_on_s: f64,
    /// Plan that was run, if the motion is that of a log or of a program, which knows no dwell points [trajectory
    /// artifact]
    #[arg(long, value_name = "DIR")]
    planned: Option<PathBuf>,
    #[command(flatten)]
    machine: MachineArgs,
    #[command(flatten)]
    output: OutputArgs,
}

impl Abort {
    pub fn run(&self) -> Result<Status, Failure> {
        let settings =
            AbortSettings { abort_s: self.abort_s, tool_stays_on_s: self.tool_stays_on_s };
        let mut inputs = Inputs::new();
        let (mut motion, _) = self.trajectory.read_on_part(&mut inputs)?;
        let limits = self.machine.read(&mut inputs)?;
        let planned: Option<Trajectory> = match &self.planned {
            Some(dir) => Some(inputs.read("planned", dir)?),
            None => None,
        };
        let output = Output::directory(&self.output, Trajectory::KIND);
        let mut output = match output.begin(&task!("abort", settings), &inputs)? {
            Begin::Unchanged(status) => return Ok(status),
            Begin::Run(output) => output,
        };
        if let Some(plan) = &planned {
            motion = with_dwell_points(&motion, plan, MOST_OFFSET_S)?;
        }
        let executed = aborted(&motion, &settings, limits.max_acceleration_mm_per_s2())
            .map_err(Failure::with_flags)?;
        let last = executed.segment(executed.len() - 1);
        let outcome = AbortOutcome {
            executed_s: executed.total_time_s(),
            place_mm: last.position_mm(last.duration_s),
        };
        let [x, y] = outcome.place_mm;
        output.write(&executed, &outcome, &Status::Done)?;
        say(format!(
            "planish schedule: {:.4} s were executed; the machine stands at ({x:.4}, {y:.4}) mm -> {}",
            outcome.executed_s,
            self.output.out.display()
        ));
        Ok(Status::Done)
    }
}
