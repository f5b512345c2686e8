//! Every new pixel has the height of the nearest valid one.
//!
//! ```text
//! z(p) = z(q),  q the valid pixel with the least |p - q|
//! ```
//!
//! No settings, no new extremes, no step at the edge; a kink there. The dwell time that a solver
//! finds stays as high beyond the edge as on it. A good default where an extension is needed.

use ndarray::Array2;
use planish_types::Grid;

use crate::distance;

/// `map` (ny, nx) with a height on every pixel.
pub(super) fn extend(map: &Array2<f64>, grid: &Grid) -> Array2<f64> {
    distance::nearest(map.view(), grid).place.mapv(|at| map[at])
}
