//! The subcommands, one file each.

mod apply;
mod fit;
mod maps;
mod place;

use clap::Subcommand;
use planish_handoff::{Failure, Status};
use planish_register::fit::Estimate;
use planish_types::text::significant;

#[derive(Debug, Subcommand)]
pub enum Method {
    /// Fit the transform from map to machine to fiducials
    Fit(fit::FitArgs),
    /// Write the transform that a machine file states, for a part that nobody measured
    Place(place::PlaceArgs),
    /// Transform a tool path or a motion to the frame of the machine, or back to that of the part
    Apply(apply::ApplyArgs),
    /// Fit the transform from a map to a later map of the same part, from the features that both have
    Maps(maps::MapsArgs),
}

impl Method {
    pub fn run(&self) -> Result<Status, Failure> {
        match self {
            Self::Fit(arguments) => arguments.run(),
            Self::Place(arguments) => arguments.run(),
            Self::Apply(arguments) => arguments.run(),
            Self::Maps(arguments) => arguments.run(),
        }
    }
}

/// Text of a value with its standard error; the value with `digits` decimals.
fn with_error(estimate: Estimate, digits: usize) -> String {
    let error = significant(estimate.standard_error, 2);
    format!("{:.digits$} (standard error {error})", estimate.value)
}
