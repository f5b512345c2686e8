//! Readers of other programs' files: measured maps, measured tool influence functions, programs of motion
//! controllers, and logs of machines.
//!
//! A reader turns the bytes of a file into a [`Reading`]: the numbers as they are stored, and what the file
//! says about them. [`surface`] and [`tif`] turn a reading into a map or a TIF: one multiplication to nm,
//! pitch in mm, row 0 at the smallest y. The user must state what the file does not say ([`ReadingSettings`]); it
//! is never guessed.
//!
//! | module | contents |
//! |---|---|
//! | [`mod@format`] | one file per format of maps |
//! | [`slopes`] | heights from maps of slopes |
//! | [`program`] | programs for Galil, XPS, PMAC, G-code, CSV, ROS, Aerotech, SINUMERIK, TwinCAT, Zaber |
//! | [`trace`] | logs of the motion that a machine made: CSV, HDF5, XPS, Aerotech, Galil |
//!
//! Limits on the memory and work for one file are in `budget`. Only this crate and `planish export` convert
//! units.

// The command line names this library as any other program does.
extern crate self as planish_import;

mod arrays;
mod beside;
mod budget;
mod bytes;
pub mod cli;
pub mod command;
mod draw;
pub mod format;
pub mod program;
mod reading;
mod scattered;
pub mod slopes;
pub mod trace;
mod unit;
mod unknown;

pub use budget::{MOST_FILE_BYTES, MOST_PIXELS};
pub use draw::{Scale, svg};
pub use format::{Format, read};
pub use reading::{
    Coordinates, FirstRow, Origin, Pick, Reading, ReadingSettings, Rotation, Rule, Statement,
    Window, surface, tif,
};
pub use unit::Unit;
pub use unknown::unknown;

use planish_types::file_text as text;
