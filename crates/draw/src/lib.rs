//! What the pictures of the stages share, as SVG text.
//!
//! A picture is one [`Svg`]; its plots are [`Frame`]s, rectangles with an axis along x and one along
//! y, which draw themselves, their curves and their maps into it. What a picture shows is decided by
//! the stage that draws it.
//!
//! | module | what |
//! |---|---|
//! | [`svg`] | a document and its elements, every text escaped |
//! | [`frame`] | axes, titles, curves, legend, bar of colours |
//! | [`cells`] | a map in rectangles of one colour |
//! | [`colour`] | maps of colours, and colours of lines |
//! | [`ticks`] | the round numbers of an axis |

pub mod cells;
pub mod colour;
pub mod frame;
pub mod svg;
pub mod ticks;

pub use colour::Bands;
pub use frame::{Frame, Scale};
pub use svg::Svg;
