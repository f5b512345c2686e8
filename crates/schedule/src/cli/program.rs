//! `planish schedule program`: the NC program of a feed artifact.

use std::{
    io::{BufWriter, Write},
    path::{Path, PathBuf},
};

use clap::Args;
use planish_handoff::{Failure, Inputs, Status, flags::OutputFileArgs, say};
use planish_schedule::interpolator::{Record, linked_records, records};
use planish_types::{DwellDensity, Trajectory};

#[derive(Args)]
pub struct ProgramCommand {
    /// Nodes of the dwell-time density [dwell_density artifact]
    #[arg(long, value_name = "DIR")]
    dwell_density: PathBuf,
    /// Motion that was scheduled with the dwell-time density: its run-up, lifts and brake go into the
    /// program [trajectory artifact]
    #[arg(long, value_name = "DIR")]
    trajectory: Option<PathBuf>,
    /// Form of the part: a form file [JSON], or its height along z [surface artifact]; its height is Z, which is 0 without
    /// it
    #[arg(long, value_name = "PATH")]
    form: Option<PathBuf>,
    #[command(flatten)]
    output: OutputFileArgs,
}

/// Comment lines at the start of every program.
const PROGRAM_HEAD: &str = "\
(Feed of planish schedule: trigonometric spline of the dwell-time density along the path)
(X Y end point mm, I J corner of a blend mm, P Q densities at both ends s/mm, R S arc lengths mm)
(U V velocity mm/s at the end of a cubic, T its time s, K1 tool on, K0 tool off)
";

impl ProgramCommand {
    pub fn run(&self) -> Result<Status, Failure> {
        let mut inputs = Inputs::new();
        let records = read_records(&mut inputs, &self.dwell_density, self.trajectory.as_deref())?;
        let heights_mm = self.heights_mm(&records, &mut inputs)?;
        let output = self.output.begin(&inputs)?;
        let mut count = 0;
        output.write_by(|file| {
            let mut to = BufWriter::new(file);
            to.write_all(PROGRAM_HEAD.as_bytes())?;
            for (number, (record, z_mm)) in records.iter().zip(&heights_mm).enumerate() {
                writeln!(to, "{}", record.to_line(number, *z_mm))?;
                count += 1;
            }
            Ok(to.flush()?)
        })?;
        say(format!("program: {count} records -> {}", self.output.out.display()));
        Ok(Status::Done)
    }

    /// Returns the height of the part at the end of every record, mm; 0 without a form of the part.
    fn heights_mm(&self, records: &[Record], inputs: &mut Inputs) -> Result<Vec<f64>, Failure> {
        let Some(path) = &self.form else { return Ok(vec![0.0; records.len()]) };
        let form = inputs.read_form("form", path)?.form;
        let heights = records.iter().enumerate().map(|(number, record)| {
            let [x, y] = record.end_mm();
            // Never the other zero.
            form.sag_mm([x, y]).map(|z| z + 0.0).ok_or_else(|| {
                Failure::new(format!(
                    "{}: does not exist at {x:.4}, {y:.4} mm, where record {number} of the program ends; give a form that \
                     covers the whole path, with its overscan",
                    path.display()
                ))
            })
        });
        heights.collect()
    }
}

/// Returns the records of a dwell-time density. If the trajectory is given, they include run-up, lifts and brake.
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
