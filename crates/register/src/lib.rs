//! Registration of a part: the transform from the coordinates of its map to those of the machine.
//!
//! A map has the coordinates of an interferometer, a machine those of its axes. The transform between them
//! is fitted to fiducials that are measured in both ([`fit`]). For a map taken after a run and the map
//! before it, the transform comes from the features that both maps have ([`maps`]). A tool path is then
//! transformed to the machine ([`planish_types::Transform`]); the map is never resampled.
//!
//! Several maps of one part become one: the mean of repeated measurements ([`series`]), or the whole of
//! overlapping sub-apertures ([`join`]).
//!
//! | symbol | variable | unit |
//! |---|---|---|
//! | p | `map_mm` | mm |
//! | q | `machine_mm` | mm |
//! | M, of q = M (p - centre) + image | `matrix` | 1 |
//!
//! Sources: S. Umeyama, IEEE Trans. Pattern Anal. Mach. Intell. 13 (1991) 376, for the rigid and the similar
//! transform, which in a plane is a regression of complex numbers; E. B. Wilson, M. M. Hilferty, Proc. Natl.
//! Acad. Sci. 17 (1931) 684, for the probability of a sum of squares.

// The command line names this library as any other program does.
extern crate self as planish_register;

mod chi_square;
mod cli;
pub mod command;
pub mod fiducials;
mod field;
pub mod fit;
pub mod join;
mod low_order;
pub mod maps;
mod resampled;
pub mod series;
