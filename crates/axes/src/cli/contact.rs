//! `planish axes contact`.

use std::path::PathBuf;

use clap::Args;
use planish_axes::contact;
use planish_handoff::{
    Begin, Failure, Inputs, Output, Status,
    flags::{MachineArgs, OutputArgs},
    kind, say, task,
};
use planish_types::AxesMotion;

use super::read_form;

#[derive(Args)]
pub struct Contact {
    /// Motion of all axes [axes artifact]
    #[arg(long, value_name = "DIR")]
    axes: PathBuf,
    #[command(flatten)]
    machine: MachineArgs,
    /// Form of the part: a form file [JSON], or its height along z [surface artifact]; a plane without it
    #[arg(long, value_name = "PATH")]
    form: Option<PathBuf>,
    #[command(flatten)]
    output: OutputArgs,
}

impl Contact {
    pub fn run(&self) -> Result<Status, Failure> {
        let mut inputs = Inputs::new();
        let (motion, manifest): (AxesMotion, _) = inputs.read_with_manifest("axes", &self.axes)?;
        let machine = inputs.read_machine(&self.machine.machine)?;
        if let Some(problem) = inputs.made_for_another_machine(manifest.as_ref()) {
            let problem = format!(
                "{}: {problem}; give the machine file that it was made for",
                self.axes.display()
            );
            return Err(Failure::new(problem));
        }
        let form = read_form(self.form.as_ref(), &mut inputs)?;
        let task = task!("contact", serde_json::json!({}));
        let output = Output::directory(&self.output, &kind::TRAJECTORY);
        let mut output = match output.begin(&task, &inputs)? {
            Begin::Unchanged(status) => return Ok(status),
            Begin::Run(output) => output,
        };
        let (executed, report) = contact(&motion, &machine, &form)?;
        output.write(&executed, serde_json::to_value(&report)?, &Status::Done)?;
        say(format!(
            "{}: executed contact point in {} segments, {:.4} s, cubics within {:.2e} um of it -> {}",
            machine.name(),
            report.segment_count,
            report.total_time_s,
            report.deviation_um,
            self.output.out.display()
        ));
        Ok(Status::Done)
    }
}
