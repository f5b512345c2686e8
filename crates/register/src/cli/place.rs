//! `planish register place`.

use clap::Args;
use planish_handoff::{
    Artifact, Begin, Failure, Inputs, Output, Status,
    flags::{MachineArgs, OutputArgs},
    say, task,
};
use planish_types::{Transform, TransformNumbers};
use serde_json::json;

#[derive(Debug, Args)]
pub struct PlaceArgs {
    #[command(flatten)]
    machine: MachineArgs,
    #[command(flatten)]
    output: OutputArgs,
}

/// Identity transform, of axes that read the coordinates of the part.
const SAME: TransformNumbers =
    TransformNumbers { matrix: [[1.0, 0.0], [0.0, 1.0]], centre_mm: [0.0; 2], image_mm: [0.0; 2] };

impl PlaceArgs {
    pub fn run(&self) -> Result<Status, Failure> {
        let mut inputs = Inputs::new();
        let machine = inputs.read_machine(&self.machine.machine)?;
        let output = Output::directory(&self.output, Transform::KIND);
        let mut output = match output.begin(&task!("place", json!({})), &inputs)? {
            Begin::Unchanged(status) => return Ok(status),
            Begin::Run(output) => output,
        };
        let transform = match machine.part_to_axes() {
            Some(transform) => transform.clone(),
            None => SAME.checked()?,
        };
        output.write(&transform, json!({}), &Status::Done)?;
        let [[xx, xy], [yx, yy]] = *transform.matrix();
        let [x, y] = transform.image_mm();
        say(format!(
            "planish register: the axes read x = {xx} x + {xy} y + {x} mm, y = {yx} x + {yy} y + {y} mm \
             of the part -> {}",
            self.output.out.display()
        ));
        Ok(Status::Done)
    }
}
