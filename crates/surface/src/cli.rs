//! Subcommands of `planish surface`, one file each, and arguments that several of them share.

mod bin;
mod draw;
mod line;
mod prepare;
mod profile;
mod psd;
mod spec;
mod statistics;

use std::path::PathBuf;

use clap::{Args, Subcommand};
use planish_form::low_order::Circle;
use planish_handoff::{Failure, Inputs, Status, Subcommands};
use planish_types::{Removal, Surface};

/// Names of the numbers of a circle on the command line: centre x, centre y and radius, mm.
const CIRCLE: [&str; 3] = ["CX", "CY", "R"];

#[derive(Debug, Subcommand)]
pub enum SurfaceCommand<Others: Subcommands> {
    /// Make the desired removal: crop to the clear aperture, mask outliers, level; on request fill holes
    /// and extend beyond the aperture
    Prepare(Box<prepare::PrepareArgs>),
    /// Make a map of fewer pixels: the means of squares of pixels
    Bin(bin::BinArgs),
    /// Make the desired removal of a strip from a profile (slopes or heights along a line), and integrate the tool
    /// across it
    Line(Box<line::LineArgs>),
    /// Print RMS, PV and robust PV of a map, or of a residual, as JSON
    Statistics(statistics::StatisticsArgs),
    /// Compute power spectral densities of a map, or of a residual, and the RMS in bands
    Psd(psd::PsdArgs),
    /// Measure slope errors, heights after the best shape, bands and spectra of a map, a residual or a
    /// profile, and judge them by a specification
    Spec(Box<spec::SpecArgs>),
    /// Draw maps and a section through them as SVG
    Draw(draw::DrawArgs),
    /// Those of another stage
    #[command(flatten)]
    Others(Others),
}

impl<Others: Subcommands> SurfaceCommand<Others> {
    pub fn run(&self) -> Result<Status, Failure> {
        match self {
            Self::Prepare(arguments) => arguments.run(),
            Self::Bin(arguments) => arguments.run(),
            Self::Line(arguments) => arguments.run(),
            Self::Statistics(arguments) => arguments.run(),
            Self::Psd(arguments) => arguments.run(),
            Self::Spec(arguments) => arguments.run(),
            Self::Draw(arguments) => arguments.run(),
            Self::Others(others) => others.run(),
        }
    }
}

#[derive(Debug, Args)]
#[group(required = true, multiple = false)]
struct MapArgs {
    /// Map [surface artifact]
    #[arg(long, value_name = "DIR")]
    surface: Option<PathBuf>,
    /// Predicted removal whose residual is the map [removal artifact]
    #[arg(long, value_name = "DIR")]
    removal: Option<PathBuf>,
}

impl MapArgs {
    /// Reads the map, or the residual. Refuses a folder that does not hold it.
    pub fn read(&self, inputs: &mut Inputs) -> Result<Surface, Failure> {
        match (&self.surface, &self.removal) {
            (Some(dir), _) => Ok(inputs.read("surface", dir)?),
            (None, Some(dir)) => Ok(inputs.read::<Removal>("removal", dir)?.residual().clone()),
            (None, None) => Err(Failure::new("--surface: is missing; give it or --removal")),
        }
    }
}

/// Returns the circle of three numbers in the order of [`CIRCLE`], mm.
fn circle(numbers: &[f64]) -> Circle {
    Circle { centre_mm: [numbers[0], numbers[1]], radius_mm: numbers[2] }
}
