//! The report page that people look at, and its figures.
//!
//! [`View`] holds the data of a run for the page, down-sampled if there are too many. [`page()`] puts views into one
//! HTML file with its own style and program (`report/page.*` and `report/page/`). The program is plain JavaScript and
//! canvas, without a library, and loads nothing from a network. [`figure`] draws views as SVG, [`sparkline`] in a
//! terminal.
//!
//! The amount of data in the page is bounded, and the page states the bounds: see the constants of `view`.

pub mod figure;
pub mod map;
pub mod motion;
pub mod on_axes;
pub mod pack;
mod page;
mod part;
pub mod sparkline;
pub mod spectrum;
pub mod tool;
mod view;

pub use page::page;
pub use view::{Frames, Rounds, RunData, RunMethod, View, views};
