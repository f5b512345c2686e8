//! `planish next-run run=DIR`: a run with several tools goes on after one of them, with the map that was measured.
//!
//! The run has left `several.json`: its tools in the order in which they work, its settings, and the residual that was
//! planned. The tools that are left are planned again for the measured map, at prices at which they keep that residual.
//! The directory is that of a run with several tools, so that the next one goes on after it in the same way.

use std::path::Path;

use planish_handoff::{Failure, Status, say, words};

use super::{
    execute::{Messages, Programs},
    place::{Installation, directory_name, kind_of, name_of},
    rack::CheckedRack,
    record::{RECORD, Record},
    run::end,
    several::{UserSettings, command, count},
    several_tools::Settings,
};

/// Name of a run that goes on, in the file that states the owner of its directory.
const NAME: &str = "several-next";

/// Largest number of runs that are drawn. Larger: a typing mistake takes days. Smaller: coarser quantiles.
const MOST_DRAWS: u32 = 100_000;

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
        format!("out/next-run/{}", directory_name(&format!("{run}-after-{done}")))
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
        page: record.page.clone(),
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
        format!("out/tolerance/{}", directory_name(&format!("{run}-set-up")))
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
