//! Tool paths: the lines along which the tool moves, before the dwell times are computed.
//!
//! One file per method, all of one shape: `XxxSettings`, and a function from the map (whose valid
//! pixels are the clear aperture) to a [`planish_types::ToolPath`].
//!
//! * [`mod@raster`]: parallel lines, back and forth; any angle, order and adaptive pitch.
//! * [`mod@maze`]: one random closed line through every cell of a lattice.
//! * [`mod@random_adaptive`]: random directions, denser where more is to be removed.
//! * [`mod@multi_pitch`]: regions by depth, each a raster of its own pitch.
//! * [`mod@spiral`]: one line from the inside out, for round parts.
//!
//! [`mod@along`] makes each of them along the surface of a curved part.
//!
//! [`mod@passes`] repeats any of them, there and back. [`mod@rest`] is what is left of one after an abort.
//!
//! For any path: [`mod@statistics`] (length, steps, turns, crossings, coverage, least time), [`PathReport`]
//! (these, and what the user should know) and [`mod@draw`] (a picture).

// The command line names this library as any other program does.
extern crate self as planish_toolpath;

pub mod along;
mod cli;
pub mod command;
mod draft;
pub mod draw;
pub mod maze;
pub mod multi_pitch;
pub mod passes;
pub mod random_adaptive;
pub mod raster;
mod region;
mod report;
pub mod rest;
mod segments;
pub mod spiral;
pub mod statistics;

pub use along::{AlongReport, OnForm};
pub use draw::svg;
pub use maze::{Maze, MazeSettings, Tree, maze};
pub use multi_pitch::{MultiPitch, MultiPitchReport, MultiPitchSettings, multi_pitch};
pub use passes::{PassesSettings, passes};
pub use random_adaptive::{
    Construction, RandomAdaptive, RandomAdaptiveReport, RandomAdaptiveSettings, random_adaptive,
};
pub use raster::{LineOrder, RasterSettings, Scan, Turn, raster};
pub use region::{inset, usual_overscan_mm};
pub use report::{PathReport, travel_warnings};
pub use rest::rest;
pub use spiral::{SpiralSettings, spiral};
pub use statistics::{PathStatistics, PitchLimit, pitch_limit, statistics, time_lower_bound_s};

use planish_types::Invalid;

/// Largest number of segments of a path; a plan with more is refused as a mistake in the units. Larger: such mistakes
/// exhaust the memory. Smaller: fine paths on large parts are refused.
pub const MAX_SEGMENTS: usize = 20_000_000;

/// Reasons for which a path cannot be made.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ToolPathError {
    /// A value that cannot be what it claims to be.
    #[error(transparent)]
    Invalid(#[from] Invalid),
    /// More segments than [`MAX_SEGMENTS`].
    #[error(
        "path: a pitch of {pitch_mm:?} mm and a step of {step_mm:?} mm need more than {MAX_SEGMENTS} \
         segments over a region of {:.6} mm by {:.6} mm; check the units, or give a larger pitch \
         or step",
        extent_mm[0], extent_mm[1]
    )]
    TooManySegments {
        /// Distance between the lines, mm.
        pitch_mm: f64,
        /// Longest segment, mm.
        step_mm: f64,
        /// Extent of the region, mm.
        extent_mm: [f64; 2],
    },
    /// No 2 x 2 cells of a maze fit into the region.
    #[error(
        "pitch_mm: no 2 x 2 cells of {pitch_mm} mm fit into the region ({:.6} mm by {:.6} mm, \
         overscan included), so that a maze has no room to turn; give a smaller pitch or a \
         larger overscan, or use a raster",
        extent_mm[0], extent_mm[1]
    )]
    TooThin {
        /// Side of a cell, mm.
        pitch_mm: f64,
        /// Extent of the region, mm.
        extent_mm: [f64; 2],
    },
    /// No line of a raster with a given origin falls into the region.
    #[error(
        "line_origin_mm: no line {origin_mm} + k * {pitch_mm} mm lies in the region \
         ({low_mm} .. {high_mm} mm); give another origin or a smaller pitch"
    )]
    NoLine {
        /// Given coordinate of one line across the lines, mm.
        origin_mm: f64,
        /// Distance between the lines, mm.
        pitch_mm: f64,
        /// Smallest coordinate of the region across the lines, mm.
        low_mm: f64,
        /// Largest coordinate of the region across the lines, mm.
        high_mm: f64,
    },
}
