//! The page that people look at, and its figures.
//!
//! [`View`] holds what the screen needs of a run, down-sampled where there is more; [`page()`] puts
//! views into one HTML file with its own style and program (`report/page.*` and `report/page/`, plain
//! JavaScript and canvas, no library, nothing from a network), [`figure`] draws them as SVG,
//! [`sparkline`] in a terminal.
//!
//! How much of the arrays is in the page is bounded, and stated on it: see the constants of `view`.

pub mod figure;
pub mod map;
pub mod motion;
pub mod pack;
mod page;
pub mod sparkline;
pub mod spectrum;
mod view;

pub use page::page;
pub use view::{Frames, Rounds, Run, RunMethod, View, views};
