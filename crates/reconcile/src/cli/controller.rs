//! The command `planish import controller`.

use std::path::PathBuf;

use clap::{Args, Subcommand};
use planish_handoff::{
    Failure, Inputs, Status, Subcommands,
    flags::{OutputFileArgs, TrajectoryArgs},
    say,
};
use planish_reconcile::controller::{Controller, Value, identify};
use planish_types::{Trajectory, text::significant};

/// The subcommand of `planish import` that identifies a controller, by the name that it has there.
#[derive(Debug, Subcommand)]
pub enum ImportNames {
    /// Lag, smoothing, corner speed and clock of a controller, from the log of a test motion, as an error budget
    Controller(ControllerArgs),
}

impl Subcommands for ImportNames {
    fn run(&self) -> Result<Status, Failure> {
        let Self::Controller(arguments) = self;
        arguments.run()
    }
}

#[derive(Debug, Args)]
pub struct ControllerArgs {
    #[command(flatten)]
    trajectory: TrajectoryArgs,
    /// Plan that was run: the commanded motion, from planish import program or a scheduler [trajectory artifact]
    #[arg(long, value_name = "DIR")]
    planned: PathBuf,
    #[command(flatten)]
    output: OutputFileArgs,
}

impl ControllerArgs {
    fn run(&self) -> Result<Status, Failure> {
        let mut inputs = Inputs::new();
        let log = self.trajectory.read(&mut inputs)?;
        let planned: Trajectory = inputs.read("planned", &self.planned)?;
        let file = self.output.begin(&inputs)?;
        let controller = identify(&log, &planned).map_err(Failure::with_flags)?;
        tell(&controller);
        let Some(budget) = controller.error_budget() else {
            return Err(Failure::new(
                "the log determines neither lag, smoothing nor corner speed, so there is nothing to write; record a \
                 motion with higher accelerations and with corners",
            ));
        };
        file.write(format!("{}\n", serde_json::to_string_pretty(&budget)?).as_bytes())?;
        say(format!("-> {}", self.output.out.display()));
        Ok(controller.drawback().map_or(Status::Done, Status::Negative))
    }
}

/// Prints what the log shows, a line for each property.
fn tell(controller: &Controller) {
    let line = |name: &str, value: Option<Value>, factor: f64, unit: &str| {
        let words = match value {
            Some(Value { value, standard_error }) => format!(
                "{} {unit} (standard error {})",
                significant(factor * value, 5),
                significant(factor * standard_error, 2)
            ),
            None => "not determined by this log".into(),
        };
        say(format!("{name}: {words}"));
    };
    line("the program begins after the first sample by", Some(controller.begins_s), 1.0, "s");
    line("lag of the axes (first order)", controller.lag_s, 1e3, "ms");
    line("smoothing (moving average)", controller.smoothing_s, 1e3, "ms");
    line("change of the velocity that passes a corner", controller.corner_mm_per_s, 1.0, "mm/s");
    line("acceleration beside a corner", controller.acceleration_mm_per_s2, 1.0, "mm/s^2");
    line("duration beyond that of the program", controller.clock, 1e6, "parts per million");
    say(format!(
        "the fit leaves {} um RMS per axis, the noise of the log is {} um; largest corner of the plan {} mm/s",
        significant(1e3 * controller.left_rms_mm, 4),
        significant(1e3 * controller.noise_mm, 4),
        significant(controller.largest_corner_mm_per_s, 4)
    ));
}
