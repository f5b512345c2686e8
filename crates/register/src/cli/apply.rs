//! `planish register apply`.

use std::path::{Path, PathBuf};

use clap::{ArgGroup, Args};
use planish_handoff::{
    Artifact, Begin, Failure, Inputs, Manifest, Output, Status,
    flags::{OutputArgs, path_distance_of},
    kind::MACHINE_FRAME,
    say, task,
};
use planish_register::fit::angle;
use planish_types::{ToolPath, Trajectory, Transform, TransformNumbers};
use serde_json::{Value, json};

use super::with_error;

#[derive(Debug, Args)]
#[command(group = ArgGroup::new("what").required(true))]
pub struct ApplyArgs {
    /// Transform from part to machine [transform artifact]
    #[arg(long, value_name = "DIR")]
    transform: PathBuf,
    /// Tool path to transform [tool_path artifact]
    #[arg(long, value_name = "DIR", group = "what")]
    tool_path: Option<PathBuf>,
    /// Motion to transform [trajectory artifact]
    #[arg(long, value_name = "DIR", group = "what")]
    trajectory: Option<PathBuf>,
    /// Transform from the machine to the part, for example the log of a run
    #[arg(long)]
    inverse: bool,
    #[command(flatten)]
    output: OutputArgs,
}

impl ApplyArgs {
    pub fn run(&self) -> Result<Status, Failure> {
        let mut inputs = Inputs::new();
        let mut transform: Transform = inputs.read("transform", &self.transform)?;
        if self.inverse {
            transform = transform.inverse()?;
        }
        match (&self.tool_path, &self.trajectory) {
            (Some(dir), _) => {
                let (path, _): (ToolPath, _) = self.read("tool-path", dir, &mut inputs)?;
                self.write(&inputs, &transform, |t| Ok(t.tool_path(&path)?), json!({}))
            }
            (None, Some(dir)) => {
                let (motion, made): (Trajectory, _) = self.read("trajectory", dir, &mut inputs)?;
                let outcome = match made.as_ref().and_then(path_distance_of) {
                    Some(distance) => {
                        let distance = distance.stretched_by(transform.largest_stretch());
                        json!({ "path_distance": distance })
                    }
                    None => json!({}),
                };
                self.write(&inputs, &transform, |t| Ok(t.trajectory(&motion)?), outcome)
            }
            (None, None) => Err(Failure::new("give --tool-path or --trajectory")),
        }
    }

    /// Reads the tool path or motion to transform. Without `--inverse`, refuses one that is in the coordinates of the
    /// machine already.
    fn read<T: Artifact>(
        &self,
        role: &str,
        dir: &Path,
        inputs: &mut Inputs,
    ) -> Result<(T, Option<Manifest>), Failure> {
        let (artifact, manifest) = inputs.read_with_manifest(role, dir)?;
        if !self.inverse && manifest.as_ref().is_some_and(|m| m.frame == MACHINE_FRAME) {
            return Err(Failure::new(format!(
                "{}: is in the coordinates of the machine already; give what lies on the part, or `--inverse` to take \
                 it back there",
                dir.display()
            )));
        }
        Ok((artifact, manifest))
    }

    /// Writes the artifact that `moved` returns for the transform, unless the output directory holds the same result
    /// already. `outcome` goes to its manifest.
    fn write<T: Artifact>(
        &self,
        inputs: &Inputs,
        transform: &Transform,
        moved: impl FnOnce(&Transform) -> Result<T, Failure>,
        outcome: Value,
    ) -> Result<Status, Failure> {
        let numbers = TransformNumbers::from(transform);
        let task = task!("apply", json!({ "inverse": self.inverse, "transform": numbers }));
        let mut output = match Output::directory(&self.output, T::KIND).begin(&task, inputs)? {
            Begin::Unchanged(status) => return Ok(status),
            Begin::Run(output) => output,
        };
        let moved = moved(transform)?;
        if !self.inverse {
            output.set_frame(MACHINE_FRAME);
        }
        output.write(&moved, outcome, &Status::Done)?;
        let [x, y] = transform.point([0.0, 0.0]);
        say(format!(
            "planish register: {}turned by {} degree, the origin to {x:.4}, {y:.4} mm -> {}",
            if transform.mirrors() { "turned over, " } else { "" },
            with_error(angle(transform), 5),
            self.output.out.display()
        ));
        Ok(Status::Done)
    }
}
