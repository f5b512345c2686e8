//! The rack of a lab: the tools from which a plan of several tools is made, as a JSON file states them.

use std::{collections::BTreeSet, path::PathBuf};

use serde::{Deserialize, Serialize};

use crate::{Invalid, Tif};

/// Largest ratio of the peak rates of two tools; a larger one is a mistake in a unit. Larger: such mistakes pass.
/// Smaller: real racks are refused.
const MAX_RATE_RATIO: f64 = 1e6;

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
    /// Standard deviations [x, y] of the place of the tool after its set-up, mm.
    #[serde(default, skip_serializing_if = "are_zero")]
    pub setup_shift_mm: [f64; 2],
    /// Standard deviation of the removal rate of the tool after its set-up, relative to the rate.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub setup_rate_fraction: f64,
    /// True if the part is measured after this tool, and the later tools are planned again on the map.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub measured_after: bool,
}

/// Errors with which a tool is set up for its run: standard deviations of normal distributions.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct SetupErrors {
    /// Distance of the tool from its place along [x, y], mm.
    pub shift_mm: [f64; 2],
    /// Error of the removal rate, relative to the rate.
    pub rate_fraction: f64,
    /// True if the part is measured after this tool, so that a later one can mend these errors.
    pub measured_after: bool,
}

impl SetupErrors {
    /// Returns true if neither place nor rate is uncertain.
    pub fn are_zero(&self) -> bool {
        are_zero(&self.shift_mm) && self.rate_fraction == 0.0
    }
}

impl RackEntry {
    /// Returns the errors with which this tool is set up.
    pub fn setup_errors(&self) -> SetupErrors {
        SetupErrors {
            shift_mm: self.setup_shift_mm,
            rate_fraction: self.setup_rate_fraction,
            measured_after: self.measured_after,
        }
    }

    /// Returns the price of mounting this tool, nm^2: its time at the price of a second, and what its set-up error adds
    /// to half the mean square of the residual.
    pub fn change_nm2(&self) -> f64 {
        self.time_weight_nm2_per_s * self.change_s + 0.5 * self.setup_error_nm.powi(2)
    }

    /// Refuses a time or an error that is not in its range.
    fn check_numbers(&self) -> Result<(), String> {
        let [x, y] = self.setup_shift_mm;
        let numbers = [
            ("change_s", self.change_s),
            ("setup_error_nm", self.setup_error_nm),
            ("setup_shift_mm[0]", x),
            ("setup_shift_mm[1]", y),
            ("setup_rate_fraction", self.setup_rate_fraction),
        ];
        for (field, value) in numbers {
            if !(value.is_finite() && value >= 0.0) {
                return Err(format!("{field} is {value}; give a number >= 0"));
            }
        }
        if self.setup_rate_fraction >= 1.0 {
            return Err(format!(
                "setup_rate_fraction is {}; give it relative to the rate, 0.03 for 3 %",
                self.setup_rate_fraction
            ));
        }
        Ok(())
    }
}

impl Rack {
    /// Returns the cost by which plans of several tools are compared, nm^2:
    ///
    /// ```text
    /// C = RMS^2 / 2 + sum over the tools of (price of a second x time + price of the change)
    /// ```
    ///
    /// `times` are the tools that run, by name, each with the time of its motion, s.
    pub fn cost_nm2(&self, rms_nm: f64, times: &[(&str, f64)]) -> f64 {
        let mut cost_nm2 = 0.5 * rms_nm * rms_nm;
        for (name, time_s) in times {
            if let Some(tool) = self.tools.iter().find(|tool| tool.name == *name) {
                cost_nm2 += tool.time_weight_nm2_per_s * time_s + tool.change_nm2();
            }
        }
        cost_nm2
    }

    /// Refuses a rack without tools, a name that cannot name a directory, two tools of one name, and a time or an error
    /// of a change that is not in its range.
    ///
    /// # Errors
    /// Returns the refusal as the end of a sentence that begins with the file.
    pub fn check(&self) -> Result<(), String> {
        if self.tools.is_empty() {
            return Err("has no tools; give at least one".to_string());
        }
        let mut names = BTreeSet::new();
        for (k, tool) in self.tools.iter().enumerate() {
            let name = &tool.name;
            check_name(name).map_err(|problem| format!("tools[{k}].name {problem}"))?;
            tool.check_numbers().map_err(|problem| format!("tool {name:?}: {problem}"))?;
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

/// Refuses tools, each with its name, whose peak rates differ by more than a factor of 1e6.
///
/// # Errors
/// Names the slowest tool and the fastest one.
pub fn check_rates(tools: &[(&str, &Tif)]) -> Result<(), Invalid> {
    let by_rate =
        |a: &&(&str, &Tif), b: &&(&str, &Tif)| a.1.peak_nm_per_s().total_cmp(&b.1.peak_nm_per_s());
    let (Some(slowest), Some(fastest)) =
        (tools.iter().min_by(by_rate), tools.iter().max_by(by_rate))
    else {
        return Ok(());
    };
    let [least, largest] = [slowest, fastest].map(|(_, tif)| tif.peak_nm_per_s());
    if largest > MAX_RATE_RATIO * least {
        let problem = format!(
            "have peak rates of {least:e} nm/s ({:?}) and {largest:e} nm/s ({:?}), more than a factor of \
             {MAX_RATE_RATIO:e} apart",
            slowest.0, fastest.0
        );
        return Err(Invalid::whole("tools", problem, "give the rates of all TIFs in nm/s"));
    }
    Ok(())
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

fn are_zero(values: &[f64; 2]) -> bool {
    values.iter().all(is_zero)
}
