//! `planish-schedule program`: the NC program of a feed artifact.

use std::{
    io::{BufWriter, Write},
    path::PathBuf,
};

use clap::Args;
use planish_handoff::{Failure, Inputs, Status, flags::OutputFileArgs, say};
use planish_schedule::interpolator::records;
use planish_types::DwellDensity;

#[derive(Args)]
pub struct Program {
    /// Nodes of the dwell-time density [feed artifact]
    #[arg(long, value_name = "DIR")]
    feed: PathBuf,
    #[command(flatten)]
    output: OutputFileArgs,
}

/// First lines of a program.
const PROGRAM_HEAD: &str = "\
(Feed of planish-schedule: trigonometric spline of the dwell-time density along the path)
(X Y end point mm, I J corner of a blend mm, P Q densities at both ends s/mm, R S arc lengths mm)
";

impl Program {
    pub fn run(&self) -> Result<Status, Failure> {
        let mut inputs = Inputs::new();
        let density: DwellDensity = inputs.read("feed", &self.feed)?;
        let output = self.output.begin(&inputs)?;
        let mut count = 0;
        output.write_by(|file| {
            let mut to = BufWriter::new(file);
            to.write_all(PROGRAM_HEAD.as_bytes())?;
            for (number, record) in records(&density).enumerate() {
                writeln!(to, "{}", record.to_line(number))?;
                count += 1;
            }
            Ok(to.flush()?)
        })?;
        say(format!("program: {count} records -> {}", self.output.out.display()));
        Ok(Status::Done)
    }
}
