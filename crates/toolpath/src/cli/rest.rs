//! `planish toolpath rest`.

use clap::Args;
use planish_handoff::{
    Artifact, Begin, Failure, Inputs, Output, Status,
    flags::{OutputArgs, PathArgs, TrajectoryArgs},
    say, task,
};
use planish_toolpath::rest;
use planish_types::ToolPath;
use serde_json::json;

#[derive(Debug, Args)]
pub struct RestArgs {
    #[command(flatten)]
    path: PathArgs,
    #[command(flatten)]
    executed: TrajectoryArgs,
    #[command(flatten)]
    output: OutputArgs,
}

impl RestArgs {
    pub fn run(&self) -> Result<Status, Failure> {
        let mut inputs = Inputs::new();
        let (path, overscan_mm) = self.path.read_with_overscan(&mut inputs)?;
        let (executed, _) = self.executed.read_on_part(&mut inputs)?;
        let output = Output::directory(&self.output, ToolPath::KIND);
        let mut output =
            match output.begin(&task!("rest", json!({ "overscan_mm": overscan_mm })), &inputs)? {
                Begin::Unchanged(status) => return Ok(status),
                Begin::Run(output) => output,
            };
        let left = rest(&path, &executed).map_err(Failure::with_flags)?;
        output.write(&left, json!({ "points": left.point_mm().len() }), &Status::Done)?;
        say(format!(
            "planish toolpath: {} of {} segments are left -> {}",
            left.len(),
            path.len(),
            self.output.out.display()
        ));
        Ok(Status::Done)
    }
}
