//! `planish toolpath passes`.

use clap::Args;
use planish_handoff::{
    Artifact, Begin, Failure, Inputs, Output, Status,
    flags::{OutputArgs, PathArgs},
    say, task,
};
use planish_toolpath::{PassesSettings, passes};
use planish_types::ToolPath;
use serde_json::json;

#[derive(Debug, Args)]
pub struct PassesArgs {
    #[command(flatten)]
    path: PathArgs,
    /// Number of passes over the same path, 2 or more
    #[arg(long, value_name = "N")]
    passes: usize,
    /// Run every other pass backwards, so that a drift of the rate cancels; otherwise the tool is lifted
    /// back to the start
    #[arg(long = "return")]
    back: bool,
    #[command(flatten)]
    output: OutputArgs,
}

impl PassesArgs {
    pub fn run(&self) -> Result<Status, Failure> {
        let settings = PassesSettings { passes: self.passes, back: self.back };
        let mut inputs = Inputs::new();
        let path = self.path.read(&mut inputs)?;
        let output = Output::directory(&self.output, ToolPath::KIND);
        let mut output = match output.begin(&task!("passes", settings), &inputs)? {
            Begin::Unchanged(status) => return Ok(status),
            Begin::Run(output) => output,
        };
        let whole = passes(&path, &settings)?;
        let outcome = json!({ "points": whole.point_mm().len(), "segments_of_a_pass": path.len() });
        output.write(&whole, outcome, &Status::Done)?;
        say(format!(
            "planish toolpath: {} passes of {} segments, {} -> {}",
            self.passes,
            path.len(),
            if self.back { "there and back" } else { "all forwards" },
            self.output.out.display()
        ));
        Ok(Status::Done)
    }
}
