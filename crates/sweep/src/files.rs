//! Files in the directory of a sweep: `sweep.json`, and the rows of the plans.

use std::{
    io::ErrorKind,
    path::{Path, PathBuf},
};

use planish_handoff::{Failure, Inputs, OutputFile, read_regular, words};
use planish_sweep::{
    plan::{Sweep, SweptPlan},
    row::PlanRow,
};
use serde::Serialize;

/// Version of the layout of `sweep.json`; a file with another version is refused.
pub const VERSION: u32 = 1;

/// Reads `sweep.json` in the directory `dir`.
///
/// # Errors
/// Fails if there is none, if it cannot be read, or if no expansion of this version can have written it: it has no
/// plans, a plan names a tool that it lacks, or `Sweep::check` refuses it.
pub fn read_sweep(dir: &Path) -> Result<Sweep, Failure> {
    let path = dir.join("sweep.json");
    if !path.exists() {
        let problem = "is not there; write it by planish sweep expand";
        return Err(Failure::new(format!("{}: {problem}", path.display())));
    }
    // 1e5 plans take more than an input of a stage may.
    let bytes = read_regular(&path).map_err(|e| unreadable(&path, &e))?;
    let sweep: Sweep = serde_json::from_slice(&bytes).map_err(|e| unreadable(&path, &e))?;
    if sweep.version != VERSION {
        let problem = format!(
            "has version {}, this program knows {VERSION}; expand the sweep again",
            sweep.version
        );
        return Err(Failure::new(format!("{}: {problem}", path.display())));
    }
    if sweep.rounds.is_empty() {
        return Err(Failure::new(format!(
            "{}: has no plans; expand the sweep again",
            path.display()
        )));
    }
    if let Some(plan) = sweep.plans().find(|plan| !has_tool(&sweep, plan)) {
        let problem = format!("the tool of {} is not in it; expand the sweep again", plan.id);
        return Err(Failure::new(format!("{}: {problem}", path.display())));
    }
    sweep.check().map_err(|problem| {
        Failure::new(format!("{}: {problem}; expand the sweep again", path.display()))
    })?;
    Ok(sweep)
}

/// Returns true if the sweep has the tool that a plan names, and the command that varies it.
fn has_tool(sweep: &Sweep, plan: &SweptPlan) -> bool {
    let varying = &sweep.ground.varying;
    sweep.tools.iter().any(|(name, _)| *name == plan.tool())
        && plan.varying().is_none_or(|text| varying.iter().any(|(known, _)| known == text))
}

/// Returns the `planish run` command that makes a plan again, quoted for a shell.
pub fn again(sweep: &Sweep, plan: &SweptPlan) -> String {
    let mut command = "planish run".to_string();
    for word in sweep.again(plan) {
        command += &match word.split_once('=') {
            Some((name, value)) => format!(" {name}={}", words::quote(value)),
            None => format!(" {}", words::quote(&word)),
        };
    }
    command
}

/// Reads the row (the result) of the plan `id` in the sweep `dir`; `None` if it does not exist yet.
///
/// # Errors
/// Fails if it is there and cannot be read.
pub fn read_row(dir: &Path, id: &str) -> Result<Option<PlanRow>, Failure> {
    let path = row_path(dir, id);
    match read_regular(&path) {
        Err(e) if e.kind() == ErrorKind::NotFound => Ok(None),
        Err(e) => Err(unreadable(&path, &e)),
        Ok(bytes) => serde_json::from_slice(&bytes).map(Some).map_err(|e| unreadable(&path, &e)),
    }
}

/// Returns the path of the row (the result) of the plan `id` in the sweep `dir`.
pub fn row_path(dir: &Path, id: &str) -> PathBuf {
    dir.join("plans").join(id).join("row.json")
}

/// Writes a value as a JSON file, whole or not at all. It replaces an existing file, unless that has the same
/// content.
///
/// # Errors
/// Fails if the file cannot be written.
pub fn write_json(path: &Path, value: &impl Serialize) -> Result<(), Failure> {
    let text = format!("{}\n", serde_json::to_string_pretty(value)?);
    if read_regular(path).is_ok_and(|there| there == text.as_bytes()) {
        return Ok(()); // Snakemake goes by the time of a file.
    }
    let file = OutputFile::begin("--out", path, true, &Inputs::new())?;
    Ok(file.write(text.as_bytes())?)
}

/// Returns the failure that says that the file at `path` cannot be read, because of `problem`.
pub fn unreadable(path: &Path, problem: &dyn std::fmt::Display) -> Failure {
    Failure::new(format!("{}: cannot read: {problem}", path.display()))
}
