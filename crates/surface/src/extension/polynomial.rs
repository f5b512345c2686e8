//! Extension by the continuation of a polynomial fit.
//!
//! ```text
//! z(p) = sum_(i <= I, j <= J) c_ij T_i(u) T_j(v),   u, v = -1 .. 1 over all pixels of the fit
//! c    = least squares over the valid pixels, and over the ring with the heights of the nearest
//!        extension: the outermost pixels, and all at least the margin away from a valid one
//! ```
//!
//! Without the ring the polynomial has no data beyond the aperture and grows without limit, unless the map
//! is a polynomial of this order; then it is continued exactly. With the ring the polynomial is smooth and
//! continues the low orders of the map over the edge. It leaves a step there: the part of the map that the
//! polynomial does not describe (`misfit_rms_nm`).
//!
//! Use it for maps whose error is a figure of low order, and for iterations that correct only what the tool
//! can correct.
//!
//! Source: T. Wang et al., Opt. Express 29 (2021) 15114 (robust iterative surface extension), for
//! the idea; the ring's heights are the nearest ones here.

use ndarray::Array2;
use planish_form::{
    basis::{Basis, Polynomial, fit},
    low_order::bounding_box_mm,
};
use planish_numerics::statistics::statistics;
use planish_types::{Grid, Invalid};
use serde::Serialize;
use serde_json::{Value, json};

use crate::distance;

/// Highest order along an axis that a caller may ask for; 31 x 31 terms. Larger: normal equations that take
/// long and determine their terms badly. Smaller: a coarser continuation.
const MAX_ORDER: u32 = 30;

/// Settings of the polynomial that continues the map.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct PolynomialSettings {
    /// Highest orders of the polynomials [I along x, J along y] in the module; at most 30.
    pub order: [u32; 2],
    /// True to fit the ring too, with the heights of the nearest extension. False is for maps that are
    /// polynomials only.
    pub ring: bool,
}

impl Default for PolynomialSettings {
    fn default() -> Self {
        Self { order: [9, 6], ring: true }
    }
}

/// Returns the polynomial on every pixel of `map` (ny, nx), which is enlarged by `margin_mm` already, and numbers for
/// the report. Refuses an order above 30, and pixels that do not determine the terms.
pub(super) fn extend(
    map: &Array2<f64>,
    grid: &Grid,
    margin_mm: f64,
    settings: &PolynomialSettings,
) -> Result<(Array2<f64>, Value), Invalid> {
    let [along_x, along_y] = settings.order;
    if along_x.max(along_y) > MAX_ORDER {
        return Err(Invalid::whole(
            "extension order",
            format!("is {along_x} along x, {along_y} along y"),
            format!("give at most {MAX_ORDER}"),
        ));
    }
    let mut data = map.clone();
    if settings.ring {
        // Without the corners beyond a round aperture the polynomial would swing there.
        let near = distance::nearest(map.view(), grid);
        let (ny, nx) = map.dim();
        let far_mm = margin_mm - 0.5 * grid.x.step_mm().min(grid.y.step_mm());
        for ((r, c), z) in data.indexed_iter_mut() {
            let outermost = r == 0 || c == 0 || r == ny - 1 || c == nx - 1;
            if z.is_nan() && (outermost || near.distance_mm[[r, c]] >= far_mm) {
                *z = map[near.place[[r, c]]];
            }
        }
    }
    let box_mm = bounding_box_mm(&data, grid);
    if box_mm.iter().any(|[low, high]| low == high) {
        return Err(Invalid::whole(
            "extension",
            "the valid pixels are in one row or one column",
            "give a map of at least 2 x 2 valid pixels",
        ));
    }
    let terms = (0..=along_x).flat_map(|i| (0..=along_y).map(move |j| [i, j])).collect();
    let basis = Basis::tensor(grid, box_mm, Polynomial::Chebyshev, terms);
    let polynomial = fit(&basis, data.view())?;
    let misfit_rms_nm = statistics((map - &polynomial.map).view()).map_or(0.0, |s| s.rms);
    Ok((
        polynomial.map,
        json!({ "misfit_rms_nm": misfit_rms_nm, "condition": polynomial.condition }),
    ))
}
