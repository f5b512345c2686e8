//! The subcommands, one file each, and arguments that several of them share.

mod draw;
mod line;
mod prepare;
mod profile;
mod psd;
mod spec;
mod statistics;
mod tif;
mod tool;

use std::path::PathBuf;

use clap::{Args, Subcommand};
use planish_handoff::{Failure, Inputs, Status};
use planish_surface::low_order::Circle;
use planish_types::{Removal, Surface};

/// The numbers of a circle on the command line.
const CIRCLE: [&str; 3] = ["CX", "CY", "R"];

#[derive(Debug, Subcommand)]
pub enum Method {
    /// Make the desired removal: crop to the clear aperture, mask outliers, level; on request fill holes
    /// and extend beyond the aperture
    Prepare(Box<prepare::PrepareArgs>),
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
    /// Prepare a measured tool influence function (border, centre, rotation, pitch, taper), or fit a
    /// formula to it
    Tif(tif::TifArgs),
    /// Make a tool whose rate depends on the place, or on the incidence of its beam
    ToolRate(tool::RateArgs),
    /// Make a tool from spots that were measured at several places, angles or edge distances
    ToolSpots(tool::SpotsArgs),
    /// Make a tool of a pad that hangs over the edge, with its pressure law
    ToolEdge(tool::EdgeArgs),
    /// Make a tool of a spot that turns with the azimuth of its place, as on a spindle
    ToolTurned(tool::TurnedArgs),
    /// Make the tool that a TIF is on a curved part, along its normal or of fixed direction
    ToolFootprint(tool::FootprintArgs),
    /// Make a tool whose rate depends on the time of the run: wear and warm-up
    ToolTime(tool::TimeArgs),
    /// Draw maps and a section through them as SVG
    Draw(draw::DrawArgs),
}

impl Method {
    pub fn run(&self) -> Result<Status, Failure> {
        match self {
            Self::Prepare(arguments) => arguments.run(),
            Self::Line(arguments) => arguments.run(),
            Self::Statistics(arguments) => arguments.run(),
            Self::Psd(arguments) => arguments.run(),
            Self::Spec(arguments) => arguments.run(),
            Self::Tif(arguments) => arguments.run(),
            Self::ToolRate(arguments) => arguments.run(),
            Self::ToolSpots(arguments) => arguments.run(),
            Self::ToolEdge(arguments) => arguments.run(),
            Self::ToolTurned(arguments) => arguments.run(),
            Self::ToolFootprint(arguments) => arguments.run(),
            Self::ToolTime(arguments) => arguments.run(),
            Self::Draw(arguments) => arguments.run(),
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
    /// The map, or the residual.
    pub fn read(&self, inputs: &mut Inputs) -> Result<Surface, Failure> {
        match (&self.surface, &self.removal) {
            (Some(dir), _) => Ok(inputs.read("surface", dir)?),
            (None, Some(dir)) => Ok(inputs.read::<Removal>("removal", dir)?.residual().clone()),
            (None, None) => Err(Failure::new("--surface: is missing; give it or --removal")),
        }
    }
}

/// The circle of the three numbers [`CIRCLE`].
fn circle(numbers: &[f64]) -> Circle {
    Circle { centre_mm: [numbers[0], numbers[1]], radius_mm: numbers[2] }
}
