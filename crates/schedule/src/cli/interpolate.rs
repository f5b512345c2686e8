//! `planish schedule interpolate`: positions from a dwell-time density or its NC program.

use std::{
    ffi::OsStr,
    fs::{self, File},
    io::{BufRead, BufReader, BufWriter, Read, Seek, SeekFrom, Write},
    path::{Path, PathBuf},
};

use clap::Args;
use planish_handoff::{Failure, Inputs, Status, flags::OutputFileArgs, say, with_flags};
use planish_schedule::interpolator::{Interpolator, Record, Reference};
use planish_types::budget;

use super::program::read_records;

#[derive(Args)]
pub struct Interpolate {
    /// Nodes of the dwell-time density [dwell_density artifact]
    #[arg(long, value_name = "DIR", required_unless_present = "program")]
    dwell_density: Option<PathBuf>,
    /// NC program, read block by block, in place of a dwell-time density artifact
    #[arg(long, value_name = "FILE", conflicts_with = "dwell_density")]
    program: Option<PathBuf>,
    /// Motion that was scheduled with the dwell-time density: its run-up, lifts and brake are
    /// interpolated too [trajectory artifact]
    #[arg(long, value_name = "DIR", conflicts_with = "program")]
    trajectory: Option<PathBuf>,
    /// Interpolation cycle, s: the time between two positions
    #[arg(long, value_name = "S", default_value_t = 0.001)]
    cycle_s: f64,
    #[command(flatten)]
    output: OutputFileArgs,
}

impl Interpolate {
    pub fn run(&self) -> Result<Status, Failure> {
        let mut interpolator =
            Interpolator::new(self.cycle_s).map_err(|e| Failure::new(format!("--cycle-s: {e}")))?;
        let table = Table::from_path(&self.output.out)?;
        let mut inputs = Inputs::new();
        let source = match (&self.program, &self.dwell_density) {
            (Some(program), _) => {
                inputs.record_file("program", program)?;
                Source::Program(program)
            }
            (None, Some(dir)) => {
                Source::Records(read_records(&mut inputs, dir, self.trajectory.as_deref())?, dir)
            }
            (None, None) => unreachable!("clap asks for one of them"),
        };
        let output = self.output.begin(&inputs)?;
        refuse_too_many(&source, self.cycle_s, table)?;
        let mut count = 0_u64;
        let mut end_s = 0.0;
        output.write_by(|file| {
            let mut to = BufWriter::new(file);
            table.begin(&mut to)?;
            let mut failed = None;
            let mut emit = |r: Reference| {
                count += 1;
                end_s = r.time_s;
                if failed.is_none() {
                    failed = table.row(&mut to, &r).err();
                }
            };
            source.for_each_record(|record| interpolator.push(record, &mut emit))?;
            interpolator.finish().into_iter().for_each(&mut emit);
            if let Some(e) = failed {
                return Err(e.into());
            }
            if count == 0 {
                return Err(Failure::new("the program moves nothing; give one with blocks"));
            }
            table.end(to, count)
        })?;
        say(format!(
            "interpolate: {count} positions, {end_s:.6} s -> {}",
            self.output.out.display()
        ));
        Ok(Status::Done)
    }
}

/// Source of the program records: read from artifacts, or from the text of a program.
enum Source<'a> {
    Records(Vec<Record>, &'a Path),
    Program(&'a Path),
}

impl Source<'_> {
    /// Calls `push` with every record, in order of the program.
    fn for_each_record(
        &self,
        mut push: impl FnMut(&Record) -> Result<(), String>,
    ) -> Result<(), Failure> {
        match self {
            Self::Program(path) => for_each_line(path, push),
            Self::Records(records, dir) => {
                for record in records {
                    push(record).map_err(|e| {
                        Failure::new(with_flags(&format!("{}: {e}", dir.display())))
                    })?;
                }
                Ok(())
            }
        }
    }
}

/// Returns an error if the output file would be too large. It runs the program without writing, because the duration of
/// the program decides the size of the file.
fn refuse_too_many(source: &Source, tick_s: f64, table: Table) -> Result<(), Failure> {
    let mut whole = Interpolator::new(f64::MAX).map_err(Failure::new)?;
    source.for_each_record(|record| whole.push(record, |_| ()))?;
    let count = whole.duration_s() / tick_s + 1.0;
    let remedy = format!(
        "the file would have {count:.3e} positions in {:.3} s at a --cycle-s of {tick_s}: give a longer \
         one",
        whole.duration_s(),
    );
    budget::affordable("positions", count, table.bytes_per_row(), &remedy)?;
    Ok(())
}

/// Length of a line of a program above which the command refuses it, bytes. Larger: a file without line ends takes more
/// memory. Smaller: valid lines are refused. A block of ten words of 30 digits has 300 bytes.
const LONGEST_LINE: u64 = 1000;

/// Reads a program line by line and calls `push` with every record.
fn for_each_line(
    path: &Path,
    mut push: impl FnMut(&Record) -> Result<(), String>,
) -> Result<(), Failure> {
    let unreadable =
        |e: std::io::Error| Failure::new(format!("{}: cannot read: {e}", path.display()));
    // The file is read twice, so it must not be a pipe.
    if !fs::metadata(path).map_err(unreadable)?.is_file() {
        return Err(Failure::new(format!("{}: is no file; give a program", path.display())));
    }
    let mut file = BufReader::new(File::open(path).map_err(unreadable)?);
    for number in 1_usize.. {
        let mut line = String::new();
        if (&mut file).take(LONGEST_LINE).read_line(&mut line).map_err(unreadable)? == 0 {
            break;
        }
        let whole = line.ends_with('\n') || (line.len() as u64) < LONGEST_LINE;
        let parsed = if whole {
            Record::parse(&line)
        } else {
            Err(format!("has more than {LONGEST_LINE} characters"))
        };
        let pushed = parsed.and_then(|record| record.map_or(Ok(()), |record| push(&record)));
        pushed.map_err(|e| {
            let e = with_flags(&e);
            Failure::new(format!("{}: line {number}: {e}; write the program again", path.display()))
        })?;
    }
    Ok(())
}

/// Names of the columns of the output table, which has one row per tick.
const COLUMNS: [&str; 5] = ["time_s", "x_mm", "y_mm", "feed_mm_per_s", "pass_idx"];

/// File format of the output table.
#[derive(Clone, Copy)]
enum Table {
    Csv,
    Npy,
}

/// Length of the head of an `.npy` file, bytes; the head has room for any number of rows.
const NPY_HEAD_BYTES: usize = 128;

impl Table {
    /// Chooses the format by the extension of the file, `.csv` or `.npy`.
    fn from_path(path: &Path) -> Result<Self, Failure> {
        match path.extension().and_then(OsStr::to_str) {
            Some("csv") => Ok(Self::Csv),
            Some("npy") => Ok(Self::Npy),
            _ => {
                let message = "is neither .csv nor .npy; give a file with one of these endings";
                Err(Failure::new(format!("--out: {} {message}", path.display())))
            }
        }
    }

    /// Returns the estimated size of a row, bytes: five numbers of 8 bytes, or of about 16 characters.
    fn bytes_per_row(self) -> usize {
        match self {
            Self::Csv => 16 * COLUMNS.len(),
            Self::Npy => size_of::<f64>() * COLUMNS.len(),
        }
    }

    fn begin(self, to: &mut impl Write) -> Result<(), Failure> {
        match self {
            Self::Csv => writeln!(to, "{}", COLUMNS.join(","))?,
            Self::Npy => to.write_all(&npy_head(0))?,
        }
        Ok(())
    }

    fn row(self, to: &mut impl Write, r: &Reference) -> std::io::Result<()> {
        let [x, y] = r.position_mm;
        match self {
            Self::Csv => {
                writeln!(to, "{},{x},{y},{},{}", r.time_s, r.feed_mm_per_s, r.pass_idx)
            }
            Self::Npy => {
                let row = [r.time_s, x, y, r.feed_mm_per_s, r.pass_idx as f64];
                row.iter().try_for_each(|v| to.write_all(&v.to_le_bytes()))
            }
        }
    }

    /// Ends the file, and writes the number of rows into the head of an `.npy` file.
    fn end(self, mut to: BufWriter<&mut File>, rows: u64) -> Result<(), Failure> {
        to.flush()?;
        if let Self::Npy = self {
            to.seek(SeekFrom::Start(0))?;
            to.write_all(&npy_head(rows))?;
            to.flush()?;
        }
        Ok(())
    }
}

/// Returns the head of an `.npy` file, format version 1.0 of NumPy: magic, version, length of the header, header.
fn npy_head(rows: u64) -> Vec<u8> {
    let columns = COLUMNS.len();
    let header =
        format!("{{'descr': '<f8', 'fortran_order': False, 'shape': ({rows}, {columns}), }}");
    let length = NPY_HEAD_BYTES - 10;
    let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
    bytes.extend((length as u16).to_le_bytes());
    bytes.extend(format!("{header:<width$}\n", width = length - 1).into_bytes());
    bytes
}
