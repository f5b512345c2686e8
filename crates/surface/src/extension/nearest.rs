//! Extension in which every new pixel has the height of the nearest valid one.
//!
//! ```text
//! z(p) = z(q),  q the valid pixel with the least |p - q|
//! ```
//!
//! The method has no settings, makes no new extremes and no step at the edge, but a kink there. The dwell
//! times of a solver stay as long beyond the edge as on it. It is a good default if an extension is needed.

use ndarray::Array2;
use planish_types::Grid;

use crate::distance;

/// Returns `map` (ny, nx), which has the margin already, with the height of the nearest valid pixel on every invalid
/// one.
pub(super) fn extend(map: &Array2<f64>, grid: &Grid) -> Array2<f64> {
    distance::nearest(map.view(), grid).place.mapv(|pixel| map[pixel])
}
