//! Record of a run with several tools: what another run needs to go on after one of them.

use std::path::{Path, PathBuf};

use planish_handoff::{Failure, Inputs, OutputFile, say};
use planish_types::{Rack, RackEntry, Surface};
use serde::{Deserialize, Serialize};

use super::{several::is_directory, several_page::PageSettings};

/// Name of the file of a run with several tools from which another one goes on.
pub const RECORD: &str = "several.json";

/// Part of the size of the part by which the measured map may end at another place along x or y. Larger: the map of
/// another part passes. Smaller: maps are refused whose edge was measured a little differently.
const MOST_APART: f64 = 0.05;

/// Record of a run with several tools, from which another one goes on after one of them.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Record {
    /// The tools of the run in the order in which they work, with absolute paths.
    pub rack: Rack,
    /// Machine file of the run.
    pub machine: PathBuf,
    /// True if the user named no machine.
    pub is_assumed: bool,
    /// Flags of the preparation of the map.
    pub prepare: Vec<String>,
    /// True if dwell times and motion are planned as one problem.
    pub is_joint: bool,
    /// Controller of the programs; `None` without programs.
    pub export: Option<String>,
    /// Further flags of the programs.
    pub export_settings: Vec<String>,
    /// Settings of the page.
    pub page: PageSettings,
    /// Map before the run.
    pub surface: PathBuf,
    /// Residual that was planned for all tools, RMS, nm.
    pub planned_rms_nm: f64,
}

impl Record {
    /// Writes the record to the directory of its run.
    ///
    /// # Errors
    /// Fails if the file cannot be written.
    pub fn write(&self, out: &str) -> Result<(), Failure> {
        let text = serde_json::to_string_pretty(self)? + "\n";
        let file = Path::new(out).join(RECORD);
        Ok(OutputFile::begin("out", &file, true, &Inputs::new())?.write(text.as_bytes())?)
    }

    /// Returns the name of the tool that was the last one to work, and the tools after it. Without `done` it is the first
    /// one.
    ///
    /// # Errors
    /// Refuses a tool that the run does not have, and its last one.
    pub fn left_after(&self, done: Option<&str>) -> Result<(&str, &[RackEntry]), Failure> {
        let tools = &self.rack.tools;
        let names: Vec<&str> = tools.iter().map(|tool| tool.name.as_str()).collect();
        let done = done.unwrap_or(names[0]);
        let Some(place) = names.iter().position(|name| *name == done) else {
            return Err(Failure::new(format!(
                "done={done} is no tool of the run; its tools are {}",
                names.join(", ")
            )));
        };
        if place + 1 == tools.len() {
            return Err(Failure::new(format!(
                "{done} is the last tool of the run, which is complete; plan another one with planish run several \
                 surface=MAP rack=FILE"
            )));
        }
        Ok((&tools[place].name, &tools[place + 1..]))
    }

    /// Reads the record of the run in the directory `of_run`.
    ///
    /// # Errors
    /// Refuses a directory without a record, and a record that cannot be read.
    pub fn read(of_run: &str) -> Result<Self, Failure> {
        is_directory("run", of_run)?;
        let file = Path::new(of_run).join(RECORD);
        if !file.is_file() {
            return Err(Failure::new(format!(
                "{of_run} has no {RECORD}: no run with several tools has ended there; give run=DIR of planish run several"
            )));
        }
        let record: Self = Inputs::new().read_json("run", &file)?;
        record.rack.check().map_err(|e| Failure::new(format!("{}: {e}", file.display())))?;
        Ok(record)
    }

    /// Refuses a measured map of another part. Prints its RMS beside the one that was predicted after the tool `done`,
    /// before the tool `next`.
    ///
    /// # Errors
    /// Fails if a map cannot be read.
    pub fn compare(
        &self,
        after: &str,
        done: &str,
        next: &str,
        of_run: &str,
    ) -> Result<(), Failure> {
        let measured: Surface = Inputs::new().read("after", Path::new(after))?;
        let before: Surface = Inputs::new().read("surface", &self.surface)?;
        let [own, expected] = [&measured, &before].map(extent_mm);
        for (axis, name) in ["x", "y"].into_iter().enumerate() {
            let size_mm = expected[axis][1] - expected[axis][0];
            let apart_mm = (0..2).map(|end| (own[axis][end] - expected[axis][end]).abs());
            if apart_mm.fold(0.0, f64::max) > MOST_APART * size_mm {
                return Err(Failure::new(format!(
                    "after {after} is valid from {name} = {:.2} to {:.2} mm, and the map of the run from {:.2} to {:.2} \
                     mm: it is the map of another part, or lies elsewhere; give the map in the coordinates of the part \
                     (planish register)",
                    own[axis][0], own[axis][1], expected[axis][0], expected[axis][1]
                )));
            }
        }
        let predicted = format!("{of_run}/tools/{next}/map");
        let predicted: Surface = Inputs::new().read("map", Path::new(&predicted))?;
        say(format!(
            "measured after {done}: {:.4} nm RMS, predicted {:.4} nm",
            measured.statistics().rms,
            predicted.statistics().rms
        ));
        Ok(())
    }
}

/// Returns the first and the last coordinate of a valid pixel along x and y, mm.
fn extent_mm(surface: &Surface) -> [[f64; 2]; 2] {
    let grid = surface.grid();
    let mut extent = [[f64::INFINITY, f64::NEG_INFINITY]; 2];
    for ((row, column), height) in surface.height_nm().indexed_iter() {
        if height.is_nan() {
            continue;
        }
        let place = [grid.x.coordinate_mm(column), grid.y.coordinate_mm(row)];
        for (range, mm) in extent.iter_mut().zip(place) {
            *range = [range[0].min(mm), range[1].max(mm)];
        }
    }
    extent
}
