//! Tools: tool influence functions (TIFs) from measured maps, their preparation, and tools that are not the same
//! everywhere.
//!
//! * [`spot`]: a TIF from the map of a spot, or from two maps, which `shift` aligns.
//! * [`tif`], [`tif_fit`]: preparation of a TIF, and its description by a formula.
//! * [`varying`]: tools that vary over the part, from their causes.

// The command line names this library as any other program does.
extern crate self as planish_tool;

mod cli;
pub mod command;
mod shift;
mod spot;
pub mod tif;
pub mod tif_fit;
pub mod varying;

pub use spot::{Alignment, Baseline, Spot, SpotSettings, spot};
