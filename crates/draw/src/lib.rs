//! Elements of SVG pictures and HTML pages that all stages (the programs of Planish) share.
//!
//! A picture is one [`Svg`]. Its plots are [`Frame`]s: rectangles with an axis along x and one
//! along y. A frame draws itself, its curves and its maps into the picture. The stage that draws a
//! picture decides what the picture shows.
//!
//! | module | contents |
//! |---|---|
//! | [`svg`] | a document and its elements, every text escaped |
//! | [`frame`] | axes, titles, curves, legend, colour bar |
//! | [`cells`] | a map drawn as rectangles, each filled with one colour |
//! | [`colour`] | colour maps, and colours of curves |
//! | `ticks` | the round numbers beside an axis |
//! | [`page`] | the head and the style of a page |

pub mod cells;
pub mod colour;
pub mod frame;
pub mod page;
pub mod svg;
mod ticks;

pub use colour::Bands;
pub use frame::{Frame, Scale};
pub use svg::Svg;
