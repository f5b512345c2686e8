//! `planish axes motion`.

use std::path::PathBuf;

use clap::Args;
use planish_axes::{MotionReport, MotionSettings, motion};
use planish_handoff::{
    Begin, Failure, Inputs, Output, Status,
    flags::{MachineArgs, OutputArgs, TrajectoryArgs, path_distance_of},
    kind, say, task,
};

use planish_types::PathDistance;

use super::read_form;

#[derive(Args)]
pub struct MotionCommand {
    #[command(flatten)]
    trajectory: TrajectoryArgs,
    #[command(flatten)]
    machine: MachineArgs,
    /// Form of the part: a form file [JSON], or its height along z [surface artifact]; a plane without it
    #[arg(long, value_name = "PATH")]
    form: Option<PathBuf>,
    /// Largest distance of the executed contact point from the path, um
    #[arg(
        long,
        value_name = "D",
        default_value_t = MotionSettings::default().contact_tolerance_um,
        allow_negative_numbers = true
    )]
    contact_tolerance_um: f64,
    #[command(flatten)]
    output: OutputArgs,
}

impl MotionCommand {
    pub fn run(&self) -> Result<Status, Failure> {
        let mut inputs = Inputs::new();
        let (trajectory, made_by) = self.trajectory.read_on_part(&mut inputs)?;
        let machine = inputs.read_machine(&self.machine.machine)?;
        let form = read_form(self.form.as_ref(), &mut inputs)?;
        let settings = MotionSettings { contact_tolerance_um: self.contact_tolerance_um };
        let task = task!("motion", settings);
        let mut output = match Output::directory(&self.output, &kind::AXES).begin(&task, &inputs)? {
            Begin::Unchanged(status) => return Ok(status),
            Begin::Run(output) => output,
        };
        let (made, mut report) =
            motion(&trajectory, &machine, &form, &settings).map_err(Failure::with_flags)?;
        // The contact point leaves the path by what the plan does, and by what the axes add.
        let added_mm = 1e-3 * report.contact_deviation_um;
        if let Some(plan) = made_by.as_ref().and_then(path_distance_of) {
            let distance = PathDistance {
                tool_on_mm: plan.tool_on_mm + added_mm,
                tool_off_mm: plan.tool_off_mm + added_mm,
                ..plan
            };
            report.path_distance = Some(distance.judged_by(plan.tolerance_mm));
        }
        output.write(&made, &report, &Status::Done)?;
        say_report(&report, machine.name(), &self.output);
        Ok(Status::Done)
    }
}

fn say_report(report: &MotionReport, machine: &str, output: &OutputArgs) {
    say(format!(
        "{machine}: {} in {} segments, {:.4} s, contact point within {:.4} um of the path, tip of the tool \
         within {:.4} um of the surface -> {}",
        report.axes.join(", "),
        report.segment_count,
        report.total_time_s,
        report.contact_deviation_um,
        report.gap_um,
        output.out.display()
    ));
    if let Some(slowed) = &report.slowed {
        say(format!(
            "slowed down by up to {:.4}, because the {} of {} would be {:.4} times its limit at {:.4} s: the run takes \
             {:.4} s instead of {:.4} s, and the tool removes for {:.4} s longer than planned",
            slowed.largest_stretch,
            slowed.quantity,
            slowed.axis,
            slowed.ratio,
            slowed.time_s,
            report.total_time_s,
            report.planned_time_s,
            report.added_tool_on_time_s
        ));
    }
    if let Some(spindle) = report.spindle.as_ref().filter(|s| s.c_limit_radius_mm > 0.0) {
        say(format!(
            "c cannot follow within {:.4} mm of the centre of the spindle; the motion takes {:.4} s longer there",
            spindle.c_limit_radius_mm, spindle.added_time_within_s
        ));
    }
    if report.off_normal_deg > 1e-6 {
        say(format!(
            "the tool is up to {:.4} degrees off the normal of the part",
            report.off_normal_deg
        ));
    }
}
