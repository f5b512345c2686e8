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
    /// The transform from map to machine, from fiducials
    Fit(fit::FitArgs),
    /// The transform that a machine file states: where the part lies when nobody measured it
    Place(place::PlaceArgs),
    /// A tool path or a motion in the frame of the machine, or back in that of the part
    Apply(apply::ApplyArgs),
    /// Where a map lies on an earlier one, from the features that both have
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

/// A number with its standard error, for a line.
fn with_error(estimate: Estimate, digits: usize) -> String {
    let error = significant(estimate.standard_error, 2);
    format!("{:.digits$} (standard error {error})", estimate.value)
}
