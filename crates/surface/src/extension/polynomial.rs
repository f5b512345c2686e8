//! The continuation of a polynomial fit.
//!
//! ```text
//! z(p) = sum_(i <= I, j <= J) c_ij T_i(u) T_j(v),   u, v = -1 .. 1 over the enlarged map
//! c    = least squares over the valid pixels, and over the ring: the outermost pixels of the
//!        enlarged map with the heights of the nearest extension
//! ```
//!
//! Without the ring nothing holds the polynomial beyond the aperture and it explodes, unless the
//! map is a polynomial of this order; then it is continued exactly. With the ring it is smooth,
//! and follows the low orders of the map over the edge; it leaves a step there, of what the
//! polynomial does not describe (`misfit_rms_nm`).
//!
//! For maps whose error is a figure of low order, and for iterations that only try to correct what
//! is correctable.
//!
//! Source: T. Wang et al., Opt. Express 29 (2021) 15114 (robust iterative surface extension), for
//! the idea; the ring's heights are the nearest ones here.

use ndarray::Array2;
use planish_numerics::statistics::statistics;
use planish_types::{Axis, Grid, Invalid};
use serde::Serialize;
use serde_json::{Value, json};

use super::nearest;
use crate::basis::{Basis, Polynomial, fit};

/// Highest order: 31 x 31 terms.
const MAX_ORDER: u32 = 30;

/// Which polynomial.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Settings {
    /// Highest orders [I along x, J along y]; at most 30.
    pub order: [u32; 2],
    /// Whether the ring holds it. Without the ring only for maps that are polynomials.
    pub ring: bool,
}

/// `map` (ny, nx) with a height on every pixel.
pub(super) fn extend(
    map: &Array2<f64>,
    grid: &Grid,
    settings: &Settings,
) -> Result<(Array2<f64>, Value), Invalid> {
    let [along_x, along_y] = settings.order;
    if along_x.max(along_y) > MAX_ORDER {
        return Err(Invalid::whole(
            "extension order",
            format!("is {along_x} along x, {along_y} along y"),
            format!("give at most {MAX_ORDER}"),
        ));
    }
    let ends = |axis: &Axis| [axis.start_mm(), axis.end_mm()];
    let terms = (0..=along_x).flat_map(|i| (0..=along_y).map(move |j| [i, j])).collect();
    let basis =
        Basis::tensor(grid, [ends(&grid.x), ends(&grid.y)], Polynomial::Chebyshev, terms);
    let mut data = map.clone();
    if settings.ring {
        let near = nearest::extend(map, grid);
        let (ny, nx) = map.dim();
        for ((r, c), z) in data.indexed_iter_mut() {
            if z.is_nan() && (r == 0 || c == 0 || r == ny - 1 || c == nx - 1) {
                *z = near[[r, c]];
            }
        }
    }
    let found = fit(&basis, data.view())?;
    let misfit_rms_nm = statistics((map - &found.map).view()).map_or(0.0, |s| s.rms);
    Ok((found.map, json!({ "misfit_rms_nm": misfit_rms_nm, "condition": found.condition })))
}
