//! `planish-run next-run run=DIR`: a run with several tools goes on after one of them, with the map that was measured.
//!
//! The run has left `several.json`: its tools in the order in which they work, its settings, and the residual that was
//! planned. The tools that are left are planned again for the measured map, at prices at which they keep that residual.
//! The directory is that of a run with several tools, so that the next one goes on after it in the same way.

use std::path::{Path, PathBuf};

use planish_handoff::{Failure, Inputs, OutputFile, Status, say, words};
use planish_types::{Rack, RackEntry, Surface};
use serde::{Deserialize, Serialize};

use super::{
    execute::{Messages, Programs},
    place::{Installation, directory_name, kind_of, name_of},
    rack::CheckedRack,
    run::end,
    several::{UserSettings, command, count, is_directory},
    several_tools::Settings,
};

/// Name of the file of a run with several tools from which another one goes on.
const RECORD: &str = "several.json";

/// Name of a run that goes on, in the file that states the owner of its directory.
const NAME: &str = "several-next";

/// Part of the size of the part by which the measured map may end at another place along x or y. Larger: the map of
/// another part passes. Smaller: maps are refused whose edge was measured a little differently.
const MOST_APART: f64 = 0.05;

/// Largest number of runs that are drawn. Larger: a typing mistake takes days. Smaller: coarser quantiles.
const MOST_DRAWS: u32 = 100_000;

/// Record of a run with several tools, from which another one goes on after one of them.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Record {
    /// The tools of the run in the order in which they work, with absolute paths.
    rack: Rack,
    /// Machine file of the run.
    machine: PathBuf,
    /// True if the user named no machine.
    is_assumed: bool,
    /// Flags of the preparation of the map.
    prepare: Vec<String>,
    /// True if dwell times and motion are planned as one problem.
    is_joint: bool,
    /// Controller of the programs; `None` without programs.
    export: Option<String>,
    export_settings: Vec<String>,
    /// Map before the run.
    surface: PathBuf,
    /// Residual that was planned for all tools, RMS, nm.
    planned_rms_nm: f64,
}

impl Record {
    /// Makes the record of a run with these tools for the map `surface`, whose plan leaves `planned_rms_nm`.
    ///
    /// # Errors
    /// Fails if the current directory cannot be found.
    pub fn new(
        settings: &Settings,
        tools: Vec<RackEntry>,
        surface: &str,
        planned_rms_nm: f64,
    ) -> Result<Self, Failure> {
        Ok(Self {
            rack: Rack { tools },
            machine: std::path::absolute(&settings.machine)?,
            is_assumed: settings.is_assumed,
            prepare: settings.prepare.clone(),
            is_joint: settings.is_joint,
            export: settings.export.clone(),
            export_settings: settings.export_settings.clone(),
            surface: std::path::absolute(surface)?,
            planned_rms_nm: settings.keep_rms_nm.unwrap_or(planned_rms_nm),
        })
    }

    /// Writes the record to the directory of its run.
    ///
    /// # Errors
    /// Fails if the file cannot be written.
    pub fn write(&self, out: &str) -> Result<(), Failure> {
        let text = serde_json::to_string_pretty(self)? + "\n";
        let file = Path::new(out).join(RECORD);
        Ok(OutputFile::begin("out", &file, true, &Inputs::new())?.write(text.as_bytes())?)
    }

    /// Returns the name of the tool that was the last one to work, and the tools after it.
    fn left_after(&self, done: Option<&str>) -> Result<(&str, &[RackEntry]), Failure> {
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
}

/// Goes on after a tool of a run with several tools: run=DIR after=MAP, and done=NAME, the last tool that has worked.
///
/// # Errors
/// Refuses a directory that no run with several tools has left, a tool that it does not have or that was its last one, a
/// map of another part, and settings that the run has decided.
pub fn run(user: &mut UserSettings) -> Result<Status, Failure> {
    let place = Installation::find()?;
    let mut needed = |name: &str| {
        let path = user.take_path(name);
        path.ok_or_else(|| Failure::new(format!("{name} is not given; give run=DIR after=MAP")))
    };
    let [of_run, after] = [needed("run")?, needed("after")?];
    let done = user.take("done");
    let surface_settings = user.take_or("surface_settings", "");
    let surface_settings = words::split(&surface_settings)
        .map_err(|e| Failure::new(format!("surface_settings={surface_settings}: {e}")))?;
    let own_out = user.take_path("out");
    if let Some(word) = user.settings.iter().chain(&user.words).next() {
        return Err(Failure::new(format!(
            "'{word}' is decided by the run with several tools; give run, after, surface_settings, done and out alone"
        )));
    }
    let record = Record::read(&of_run)?;
    let (done, left) = record.left_after(done.as_deref())?;
    if !Path::new(&after).exists() {
        return Err(Failure::new(format!(
            "after {after} is not there; give the map that was measured after {done}"
        )));
    }
    if kind_of(&after) != "file" {
        record.compare(&after, done, &left[0].name, &of_run)?;
    }
    let out = own_out.unwrap_or_else(|| {
        let run = name_of(&std::path::absolute(&of_run).unwrap_or_default());
        format!("{}out/next-run/{}", place.home(), directory_name(&format!("{run}-after-{done}")))
    });
    let settings = Settings {
        surface: after,
        surface_settings,
        rack: format!("{of_run}/{RECORD}"),
        machine: record.machine.display().to_string(),
        is_assumed: record.is_assumed,
        prepare: record.prepare.clone(),
        chooses: false,
        is_joint: record.is_joint,
        export: record.export.clone(),
        export_settings: record.export_settings.clone(),
        keep_rms_nm: Some(record.planned_rms_nm),
        out,
    };
    let names: Vec<&str> = left.iter().map(|tool| tool.name.as_str()).collect();
    say(format!("after {done}, planned again for the measured map: {}", names.join(", ")));
    let rack = CheckedRack::of_entries(left.to_vec(), &settings.rack)?;
    settings.run(&place, rack, NAME)
}

/// Draws runs of a plan of several tools with the set-up errors of its tools: run=DIR, draws=N, seed=N and out=DIR.
///
/// # Errors
/// Refuses a directory that no run with several tools has left, tools without set-up errors, and other settings.
pub fn tolerance(user: &mut UserSettings) -> Result<Status, Failure> {
    let place = Installation::find()?;
    let of_run = user.take_path("run").ok_or_else(|| Failure::new("run is empty; give run=DIR"))?;
    let draws = count("draws", &user.take_or("draws", "40"), MOST_DRAWS)?;
    let seed = count("seed", &user.take_or("seed", "1"), u32::MAX)?;
    let own_out = user.take_path("out");
    if let Some(word) = user.settings.iter().chain(&user.words).next() {
        return Err(Failure::new(format!(
            "'{word}' is decided by the run with several tools; give run, draws, seed and out alone"
        )));
    }
    let record = Record::read(&of_run)?;
    let tools = &record.rack.tools;
    if tools.iter().all(|tool| tool.setup_errors().are_zero()) {
        return Err(Failure::new(format!(
            "the tools of {of_run} have no set-up errors; give setup_shift_mm and setup_rate_fraction in the rack, and \
             run it again"
        )));
    }
    let out = own_out.unwrap_or_else(|| {
        let run = name_of(&std::path::absolute(&of_run).unwrap_or_default());
        format!("{}out/tolerance/{}", place.home(), directory_name(&format!("{run}-set-up")))
    });
    // The rack of the first tool has all tools, with the least dwell times of their machines.
    let rack = format!("{of_run}/tools/{}/rack.json", tools[0].name);
    let surface = format!("{of_run}/surface");
    let [draws, seed] = [format!("--setup-draws={draws}"), format!("--seed={seed}")];
    let flags = ["several-tools", "--surface", &surface, "--rack", &rack, &draws, &seed];
    let programs = Programs::new(&place, Messages::Shown)?;
    end(programs
        .run(&command("planish-dwell", &[&flags[..], &["--out", &out, "--force"]].concat()))?)
}

impl Record {
    /// Reads the record of the run in the directory `of_run`.
    fn read(of_run: &str) -> Result<Self, Failure> {
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
    fn compare(&self, after: &str, done: &str, next: &str, of_run: &str) -> Result<(), Failure> {
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
                     (planish-register)",
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
