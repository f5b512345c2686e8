//! `planish-schedule program`: the NC program of a feed artifact.

use std::{
    io::{BufWriter, Write},
    path::{Path, PathBuf},
};

use clap::Args;
use planish_handoff::{Failure, Inputs, Status, flags::OutputFileArgs, say};
use planish_schedule::interpolator::{Record, linked_records, records};
use planish_types::{DwellDensity, Trajectory};

#[derive(Args)]
pub struct Program {
    /// Nodes of the dwell-time density [dwell_density artifact]
    #[arg(long, value_name = "DIR")]
    dwell_density: PathBuf,
    /// Motion that was scheduled with the dwell-time density: its run-up, lifts and brake go into the
    /// program [trajectory artifact]
    #[arg(long, value_name = "DIR")]
    trajectory: Option<PathBuf>,
    #[command(flatten)]
    output: OutputFileArgs,
}

/// First lines of a program.
const PROGRAM_HEAD: &str = "\
(Feed of planish-schedule: trigonometric spline of the dwell-time density along the path)
(X Y end point mm, I J corner of a blend mm, P Q densities at both ends s/mm, R S arc lengths mm)
(U V velocity mm/s at the end of a cubic, T its time s, K1 tool on, K0 tool off)
";

impl Program {
    pub fn run(&self) -> Result<Status, Failure> {
        let mut inputs = Inputs::new();
        let records = read_records(&mut inputs, &self.dwell_density, self.trajectory.as_deref())?;
        let output = self.output.begin(&inputs)?;
        let mut count = 0;
        output.write_by(|file| {
            let mut to = BufWriter::new(file);
            to.write_all(PROGRAM_HEAD.as_bytes())?;
            for (number, record) in records.iter().enumerate() {
                writeln!(to, "{}", record.to_line(number))?;
                count += 1;
            }
            Ok(to.flush()?)
        })?;
        say(format!("program: {count} records -> {}", self.output.out.display()));
        Ok(Status::Done)
    }
}

/// Records of a dwell-time density, with what lies outside of its passes if the trajectory is given.
pub(super) fn read_records(
    inputs: &mut Inputs,
    dwell_density: &Path,
    trajectory: Option<&Path>,
) -> Result<Vec<Record>, Failure> {
    let density: DwellDensity = inputs.read("dwell-density", dwell_density)?;
    let Some(dir) = trajectory else { return Ok(records(&density).collect()) };
    let trajectory: Trajectory = inputs.read("trajectory", dir)?;
    linked_records(&density, &trajectory).map_err(|e| {
        Failure::new(format!(
            "{}: {e}; give the one that {} was written with",
            dir.display(),
            dwell_density.display()
        ))
    })
}
