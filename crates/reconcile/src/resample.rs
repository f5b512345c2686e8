//! The map after a run on the pixels of the map before it.
//!
//! Lagrange's polynomial of degree five through six samples along each axis. At half a pixel its transfer is 0.999 at
//! eight pixels per period and 0.95 at four. It averages noise: at half a pixel along both axes the noise of the map
//! after keeps half of its variance. The standard errors follow, because they use the covariance of the rest and no
//! stated noise. A pixel with an invalid sample among its six along an axis is invalid.

use ndarray::Array2;
use planish_types::{Axis, Grid, Invalid, Surface};

/// Largest difference of two coordinates, in pixel steps, up to which they count as the same. Larger: maps that are
/// shifted a little are not resampled. Smaller: rounding causes resampling.
const SAME_PLACE: f64 = 1e-3;

/// Number of samples along each axis from which a value is interpolated; the degree is one less. Larger: pixels near a
/// border or an invalid sample become invalid. Smaller: short periods lose height.
const SAMPLES: usize = 6;

/// Name of the method of interpolation, for reports.
pub const METHOD: &str = "Lagrange interpolation of degree five along each axis";

/// Returns true if both grids have the same pixels, to `SAME_PLACE` of a step.
pub fn are_same(a: &Grid, b: &Grid) -> bool {
    [(&a.x, &b.x), (&a.y, &b.y)].into_iter().all(|(a, b)| {
        let tolerance = SAME_PLACE * a.step_mm();
        a.len() == b.len()
            && (a.start_mm() - b.start_mm()).abs() <= tolerance
            && (a.end_mm() - b.end_mm()).abs() <= tolerance
    })
}

/// Returns the index of the first sample, and the weights of it and the following ones, for the coordinate `to_mm`.
/// Returns `None` where the axis `from` has no sample, or fewer than three on one side.
fn weights(from: &Axis, to_mm: f64) -> Option<(usize, Vec<f64>)> {
    let position = (to_mm - from.start_mm()) / from.step_mm();
    let nearest = position.round();
    if (position - nearest).abs() <= SAME_PLACE {
        let is_inside = nearest >= 0.0 && nearest < from.len() as f64;
        return if is_inside { Some((nearest as usize, vec![1.0])) } else { None };
    }
    let first = position.floor() - (SAMPLES / 2 - 1) as f64;
    if first < 0.0 || first + SAMPLES as f64 > from.len() as f64 {
        return None;
    }
    // w_j = prod over k != j of (u - k) / (j - k)
    let u = position - first;
    let mut weights = Vec::with_capacity(SAMPLES);
    for j in 0..SAMPLES {
        let others = (0..SAMPLES).filter(|k| *k != j);
        weights.push(others.map(|k| (u - k as f64) / (j as f64 - k as f64)).product());
    }
    Some((first as usize, weights))
}

/// Returns `map` interpolated on the pixels of `grid`; NaN where one of the samples is invalid or beyond the map.
///
/// # Errors
/// Fails if no pixel of `grid` lies within the valid samples of the map.
pub fn resampled(map: &Surface, grid: &Grid) -> Result<Surface, Invalid> {
    let [x, y] = [(&map.grid().x, &grid.x), (&map.grid().y, &grid.y)].map(|(from, to)| {
        (0..to.len()).map(|i| weights(from, to.coordinate_mm(i))).collect::<Vec<_>>()
    });
    let height = map.height_nm();
    let height_nm = Array2::from_shape_fn(grid.shape(), |(r, c)| {
        let (Some((r0, rows)), Some((c0, columns))) = (&y[r], &x[c]) else { return f64::NAN };
        let row = |i: usize| {
            columns.iter().enumerate().map(|(j, w)| w * height[[r0 + i, c0 + j]]).sum::<f64>()
        };
        rows.iter().enumerate().map(|(i, w)| w * row(i)).sum()
    });
    if height_nm.iter().all(|v| v.is_nan()) {
        let problem = "has no pixel within the map before";
        let remedy = "give two maps of the same part in the same coordinates";
        return Err(Invalid::whole("height_nm", problem, remedy));
    }
    Surface::new(*grid, height_nm)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A polynomial of degree five along each axis is its own interpolant.
    #[test]
    fn polynomials_of_degree_five_are_exact_and_samples_outside_are_invalid() {
        let value = |x: f64, y: f64| (0.3 * x - 1.0).powi(5) + x * y.powi(4) - 2.0 * y;
        let map = |grid: Grid| {
            let at =
                |(r, c): (usize, usize)| value(grid.x.coordinate_mm(c), grid.y.coordinate_mm(r));
            Surface::new(grid, Array2::from_shape_fn(grid.shape(), at)).unwrap()
        };
        let from =
            Grid { x: Axis::new(0.0, 0.2, 30).unwrap(), y: Axis::new(0.0, 0.25, 20).unwrap() };
        let to = Grid { x: Axis::new(0.1, 0.2, 30).unwrap(), y: Axis::new(0.0, 0.3, 16).unwrap() };
        let (found, expected) = (resampled(&map(from), &to).unwrap(), map(to));
        let mut valid = 0;
        for (a, b) in found.height_nm().iter().zip(expected.height_nm()) {
            if !a.is_nan() {
                valid += 1;
                // Rounding of weights whose sum of magnitudes is below 2.
                assert!((a - b).abs() < 1e-9, "{a} {b}");
            }
        }
        // Along x 25 of 30 have three samples on each side. Along y the place 0.3 k / 0.25 = 1.2 k has them for
        // k = 2 to 14, and k = 0 and 15 are on samples.
        assert_eq!(valid, 25 * 15);
        assert!(are_same(&from, &from) && !are_same(&from, &to));
    }
}
