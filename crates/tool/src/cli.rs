//! The subcommands, one file each, and their names: those of `planish tool`, and those of other stages.

mod from_maps;
mod prepare;
mod varying;

use clap::Subcommand;
use planish_handoff::{Failure, Status, Subcommands, Task};
use planish_tool::varying::Parameter;
use serde::Serialize;

/// Name of the program and of its subcommand, as the command records them in its manifest (the record of the run).
#[derive(Clone, Copy, Debug)]
pub struct Name {
    /// Program, which also begins each line that the command prints.
    program: &'static str,
    /// Subcommand of the program.
    method: &'static str,
}

impl Name {
    /// Returns the description of the run for the manifest: this program, its version, the subcommand and `settings`.
    fn task(self, settings: impl Serialize) -> Task {
        Task::new(self.program, env!("CARGO_PKG_VERSION"), self.method, settings)
    }
}

/// The subcommands of `planish tool`. Their aliases are the names that `varying` of a pipeline and of a sweep had.
#[derive(Debug, Subcommand)]
pub enum ToolCommand {
    /// Make a TIF from maps: of rates, of the depth after a known time, or of a spot before and after
    FromMaps(Box<from_maps::FromMapsArgs>),
    /// Prepare a measured TIF (border, centre, rotation, pitch, taper), or fit a formula to it
    Prepare(prepare::PrepareArgs),
    /// Make a tool whose rate depends on the incidence of its beam
    Incidence(varying::FactorArgs),
    /// Make a tool whose rate depends on the place: x, y, radius, distance to the edge, incidence
    #[command(alias = "tool-rate")]
    Rate(varying::RateArgs),
    /// Make a tool from spots that were measured at several places, angles or edge distances
    #[command(alias = "tool-spots")]
    Spots(varying::SpotsArgs),
    /// Make a tool of a pad that hangs over the edge, with its pressure law
    #[command(alias = "tool-edge")]
    Edge(varying::EdgeArgs),
    /// Make a tool of a spot that turns with the azimuth of its place, as on a spindle
    #[command(alias = "tool-turned")]
    Turned(varying::TurnedArgs),
    /// Make the tool that a TIF is on a curved part, along its normal or of fixed direction
    #[command(alias = "tool-footprint")]
    Footprint(varying::FootprintArgs),
    /// Make a tool whose rate depends on the time of the run: wear and warm-up
    #[command(alias = "tool-time")]
    Time(varying::TimeArgs),
}

impl ToolCommand {
    pub fn run(&self) -> Result<Status, Failure> {
        match self {
            Self::FromMaps(arguments) => arguments.run(tool("from-maps")),
            Self::Prepare(arguments) => arguments.run(tool("prepare")),
            Self::Incidence(arguments) => arguments.run(tool("incidence"), Parameter::Incidence),
            Self::Rate(arguments) => arguments.run(tool("rate")),
            Self::Spots(arguments) => arguments.run(tool("spots")),
            Self::Edge(arguments) => arguments.run(tool("edge")),
            Self::Turned(arguments) => arguments.run(tool("turned")),
            Self::Footprint(arguments) => arguments.run(tool("footprint")),
            Self::Time(arguments) => arguments.run(tool("time")),
        }
    }
}

/// Returns the name that the subcommand `method` of `planish tool` records.
fn tool(method: &'static str) -> Name {
    Name { program: env!("CARGO_PKG_NAME"), method }
}

/// Subcommands of `planish surface` that make tools, by the names that they have there.
#[derive(Debug, Subcommand)]
pub enum SurfaceNames {
    /// Second name of `planish tool prepare`: prepare a measured TIF, or fit a formula to it
    Tif(prepare::PrepareArgs),
    /// Second name of `planish tool rate`: make a tool whose rate depends on the place
    ToolRate(varying::RateArgs),
    /// Second name of `planish tool spots`: make a tool from spots that were measured at several places
    ToolSpots(varying::SpotsArgs),
    /// Second name of `planish tool edge`: make a tool of a pad that hangs over the edge
    ToolEdge(varying::EdgeArgs),
    /// Second name of `planish tool turned`: make a tool of a spot that turns with the azimuth of its place
    ToolTurned(varying::TurnedArgs),
    /// Second name of `planish tool footprint`: make the tool that a TIF is on a curved part
    ToolFootprint(varying::FootprintArgs),
    /// Second name of `planish tool time`: make a tool whose rate depends on the time of the run
    ToolTime(varying::TimeArgs),
}

impl Subcommands for SurfaceNames {
    fn run(&self) -> Result<Status, Failure> {
        match self {
            Self::Tif(arguments) => arguments.run(surface("tif")),
            Self::ToolRate(arguments) => arguments.run(surface("tool-rate")),
            Self::ToolSpots(arguments) => arguments.run(surface("tool-spots")),
            Self::ToolEdge(arguments) => arguments.run(surface("tool-edge")),
            Self::ToolTurned(arguments) => arguments.run(surface("tool-turned")),
            Self::ToolFootprint(arguments) => arguments.run(surface("tool-footprint")),
            Self::ToolTime(arguments) => arguments.run(surface("tool-time")),
        }
    }
}

/// Returns the name that the subcommand `method` of `planish surface` records.
fn surface(method: &'static str) -> Name {
    Name { program: "planish-surface", method }
}

/// The subcommand of `planish import` that makes a TIF, by the name that it has there.
#[derive(Debug, Subcommand)]
pub enum ImportNames {
    /// Second name of `planish tool from-maps`: make a TIF from maps of rates, of depth, or of a spot before and after
    Tif(Box<from_maps::FromMapsArgs>),
}

impl Subcommands for ImportNames {
    fn run(&self) -> Result<Status, Failure> {
        let Self::Tif(arguments) = self;
        arguments.run(Name { program: "planish-import", method: "tif" })
    }
}
