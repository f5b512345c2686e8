//! `planish register join`.

use std::path::PathBuf;

use clap::Args;
use planish_handoff::{
    Artifact, Begin, Failure, Inputs, Output, Status, flags::OutputArgs, say, task, warn,
};
use planish_register::join::{Difference, JoinSettings, join};
use planish_types::{Surface, text::significant};
use serde_json::json;

use super::{about_map, read_maps};

#[derive(Debug, Args)]
pub struct JoinArgs {
    /// Overlapping maps in the coordinates of the part; the first one gives piston, tilt and pitch [surface artifacts]
    #[arg(required = true, value_name = "DIR")]
    maps: Vec<PathBuf>,
    /// Terms by which two maps may differ
    #[arg(long, value_enum, default_value = "plane")]
    differ_by: Difference,
    /// Smallest number of common pixels at which two maps overlap
    #[arg(long, value_name = "N", default_value_t = JoinSettings::default().least_overlap)]
    least_overlap: usize,
    #[command(flatten)]
    output: OutputArgs,
}

impl JoinArgs {
    pub fn run(&self) -> Result<Status, Failure> {
        let settings =
            JoinSettings { differ_by: self.differ_by, least_overlap: self.least_overlap };
        let mut inputs = Inputs::new();
        let maps = read_maps(&mut inputs, &self.maps)?;
        let output = Output::directory(&self.output, Surface::KIND);
        let mut output = match output.begin(&task!("join", settings), &inputs)? {
            Begin::Unchanged(status) => return Ok(status),
            Begin::Run(output) => output,
        };
        let joined = join(&maps, &settings).map_err(|e| about_map(&self.maps, &e, ""))?;
        let report = &joined.report;
        output.write(&joined.joined, json!({ "join": report }), &Status::Done)?;
        for overlap in &report.overlaps {
            let [first, second] = overlap.maps.map(|k| self.maps[k - 1].display());
            say(format!(
                "planish register: {first} and {second} differ by {} nm RMS on {} common pixels",
                significant(overlap.rms_nm, 4),
                overlap.pixels
            ));
        }
        if report.same_place {
            warn(
                "all maps lie at the same place, so that they are averaged and not joined: the files may state no place; give \
                 each its own with planish import surface --place-mm X,Y",
            );
        }
        let (ny, nx) = joined.joined.grid().shape();
        say(format!(
            "planish register: {} maps joined to {nx} x {ny} pixels, {} valid, {} in overlaps; misfit {} nm -> {}",
            maps.len(),
            report.pixels,
            report.overlap_pixels,
            significant(report.misfit_nm, 4),
            self.output.out.display()
        ));
        Ok(Status::Done)
    }
}
