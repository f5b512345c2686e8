//! The subcommands, one file each.

mod apply;
mod fit;
mod join;
mod maps;
mod mean;
mod place;

use std::path::PathBuf;

use clap::Subcommand;
use planish_handoff::{Failure, Inputs, Status, with_flags};
use planish_register::{fit::Estimate, series::RefusedMap};
use planish_types::{Surface, text::significant};

#[derive(Debug, Subcommand)]
pub enum RegisterMethod {
    /// Fit the transform from map to machine to fiducials
    Fit(fit::FitArgs),
    /// Write the transform that a machine file states, for a part that nobody measured
    Place(place::PlaceArgs),
    /// Transform a tool path or a motion to the frame of the machine, or back to that of the part
    Apply(apply::ApplyArgs),
    /// Fit the transform from a map to a later map of the same part, from the features that both have
    Maps(maps::MapsArgs),
    /// Take the mean of repeated measurements, with the standard deviation of every pixel
    Mean(mean::MeanArgs),
    /// Join overlapping sub-aperture maps; pistons and tilts by least squares on the overlaps
    Join(join::JoinArgs),
}

impl RegisterMethod {
    pub fn run(&self) -> Result<Status, Failure> {
        match self {
            Self::Fit(arguments) => arguments.run(),
            Self::Place(arguments) => arguments.run(),
            Self::Apply(arguments) => arguments.run(),
            Self::Maps(arguments) => arguments.run(),
            Self::Mean(arguments) => arguments.run(),
            Self::Join(arguments) => arguments.run(),
        }
    }
}

/// Returns an estimate with its standard error as text, in the unit of the estimate. The value has `digits` decimals,
/// the error two significant digits.
fn with_error(estimate: Estimate, digits: usize) -> String {
    let error = significant(estimate.standard_error, 2);
    format!("{:.digits$} (standard error {error})", estimate.value)
}

/// Reads the surface error maps in these artifact directories, in their order, and records them as inputs.
fn read_maps(inputs: &mut Inputs, paths: &[PathBuf]) -> Result<Vec<Surface>, Failure> {
    paths.iter().map(|dir| Ok(inputs.read("maps", dir)?)).collect()
}

/// Returns the message that refuses one map of several: its directory, the reason, and `remedy` at the end. If a
/// setting is at fault, the message names no directory.
fn about_map(paths: &[PathBuf], refused: &RefusedMap, remedy: &str) -> Failure {
    // What is wrong with a setting is not about a map.
    const SETTINGS: [&str; 4] =
        ["free_order", "most_shift_mm", "most_rotation_deg", "shorter_than_mm"];
    let reason = with_flags(&refused.reason.to_string());
    if SETTINGS.contains(&refused.reason.array) {
        return Failure::new(reason);
    }
    Failure::new(format!("{}: {reason}{remedy}", paths[refused.index].display()))
}
