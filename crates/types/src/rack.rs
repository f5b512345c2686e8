//! The rack of a lab: the tools from which a plan of several tools is made, as a JSON file states them.

use std::{collections::BTreeSet, path::PathBuf};

use serde::{Deserialize, Serialize};

/// A rack file. Paths in it start at its directory.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Rack {
    /// The tools, each with a name of its own.
    pub tools: Vec<RackEntry>,
}

/// One tool as the rack states it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RackEntry {
    /// Name of the tool, and of the directory of its dwell times.
    pub name: String,
    /// Directory of its TIF, or of a tool that varies over the part.
    pub tif: PathBuf,
    /// Directory of its tool path; without one, a run makes a raster of the pitch `pitch_mm`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub tool_path: Option<PathBuf>,
    /// Distance of the lines of its raster, and of its dwell points, mm.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub pitch_mm: Option<f64>,
    /// Distance by which its raster goes beyond the aperture, mm; half the size of the tool if absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub overscan_mm: Option<f64>,
    /// File of the machine that runs it; that of the run if absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub machine: Option<PathBuf>,
    /// Smallest dwell time of every dwell point, s.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub min_dwell_s: Option<f64>,
    /// Smallest dwell time per length, s/mm.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub min_dwell_s_per_mm: Option<f64>,
    /// Largest dwell time of every dwell point, s.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub max_dwell_s: Option<f64>,
    /// Largest dwell time per length, s/mm.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub max_dwell_s_per_mm: Option<f64>,
    /// Price of a second of this tool, relative to half the mean square of the residual, nm^2/s.
    #[serde(default)]
    pub time_weight_nm2_per_s: f64,
    /// Time to mount this tool, s. A choice of tools counts it at the price of a second.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub change_s: f64,
    /// RMS that the set-up error of this tool adds to the residual, nm. A choice of tools counts half its square.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub setup_error_nm: f64,
}

impl Rack {
    /// Refuses a rack without tools, a name that cannot name a directory, and two tools of one name.
    ///
    /// # Errors
    /// Returns the refusal as the end of a sentence that begins with the file.
    pub fn check_names(&self) -> Result<(), String> {
        if self.tools.is_empty() {
            return Err("has no tools; give at least one".to_string());
        }
        let mut names = BTreeSet::new();
        for (k, RackEntry { name, .. }) in self.tools.iter().enumerate() {
            check_name(name).map_err(|problem| format!("tools[{k}].name {problem}"))?;
            // Two directories that differ in case are one on some systems.
            if !names.insert(name.to_lowercase()) {
                return Err(format!(
                    "tools[{k}].name is {name:?} again; give every tool its own name"
                ));
            }
        }
        Ok(())
    }
}

/// Refuses a name that cannot name a directory on every system.
fn check_name(name: &str) -> Result<(), String> {
    let is_plain = |c: char| c.is_ascii_alphanumeric() || "-_.".contains(c);
    if name.starts_with(|c: char| c.is_ascii_alphanumeric()) && name.chars().all(is_plain) {
        return Ok(());
    }
    Err(format!(
        "is {name:?}, which names a directory of the output; give letters, digits, `-`, `_` and `.`, a letter or digit \
         first"
    ))
}

fn is_zero(value: &f64) -> bool {
    *value == 0.0
}
