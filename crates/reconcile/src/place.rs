//! The transform that takes the next plan to the machine, corrected by the position of the part that was learnt.
//!
//! The run displaced the plan: what was to act at p acted at `D(p) = C + s + m R(theta) (p - C)`, with C the middle of
//! the map, m = 1 + magnification. The plan had been taken to the machine by T (the identity where none is given). So
//! what is to act at p has to be asked for at
//!
//! ```text
//! T'(p) = T(D^-1(p)),   D^-1(p) = C + R(-theta) (p - C - s) / m
//! ```
//!
//! What is refused is uncertain in D by what is known beforehand. The covariance is that of D alone: the
//! errors of T are among what D has found.

use nalgebra::{DMatrix, SMatrix};
use planish_types::{Grid, Invalid, Transform};

use crate::{fit::LeastSquaresFit, parameter::Parameter};

/// Parameters that move the points where the tool acts, in the order of the derivatives below.
const PLACE: [Parameter; 4] =
    [Parameter::OffsetX, Parameter::OffsetY, Parameter::Rotation, Parameter::Magnification];

/// Returns the transform T' of the next plan from the transform `before` (T) of this one. `corrections` belong to the
/// parameters and `covariance` to all unknowns of the fit; `refused[i]` is true if the data do not determine parameter
/// `i`. `scale` is the standard deviation of a parameter as known beforehand, and `grid` the map.
///
/// # Errors
/// Fails if T' is no valid transform.
pub fn corrected_transform(
    before: Option<&Transform>,
    fit: &LeastSquaresFit,
    covariance: &DMatrix<f64>,
    corrections: &[f64],
    refused: &[bool],
    scale: impl Fn(Parameter) -> f64,
    grid: &Grid,
) -> Result<Transform, Invalid> {
    let free = PLACE.map(|p| fit.parameters.iter().position(|q| *q == p));
    let determined = free.map(|i| i.filter(|i| !refused[*i]));
    let [x, y, theta, magnification] = free.map(|i| i.map_or(0.0, |i| corrections[i]));
    let of_place = SMatrix::<f64, 4, 4>::from_fn(|i, j| match (determined[i], determined[j]) {
        (Some(a), Some(b)) => covariance[(a, b)],
        // Free and refused: known beforehand. Held: as in the plan.
        (None, None) if i == j && free[i].is_some() => scale(PLACE[i]).powi(2),
        _ => 0.0,
    });
    let middle = [&grid.x, &grid.y].map(|a| 0.5 * (a.start_mm() + a.end_mm()));
    let (m, image) = match before {
        Some(t) => (*t.matrix(), t.point(middle)),
        None => ([[1.0, 0.0], [0.0, 1.0]], middle),
    };
    let m = SMatrix::<f64, 2, 2>::from_fn(|i, j| m[i][j]);
    // N = R(-theta) / m
    let (sine, cosine) = theta.sin_cos();
    let n = SMatrix::<f64, 2, 2>::new(cosine, sine, -sine, cosine) / (1.0 + magnification);
    let matrix = m * n;
    // d image = -M N ds;  d(M N) = -M N (J dtheta + dm / m), with J a quarter turn
    let turn = matrix * SMatrix::<f64, 2, 2>::new(0.0, -1.0, 1.0, 0.0);
    let [by_theta, by_m] = [turn, matrix / (1.0 + magnification)]
        .map(|m| [-m[(0, 0)], -m[(0, 1)], -m[(1, 0)], -m[(1, 1)]]);
    let by = SMatrix::<f64, 6, 4>::from_fn(|i, j| match (i, j) {
        (0 | 1, 0 | 1) => -matrix[(i, j)],
        (2.., 2) => by_theta[i - 2],
        (2.., 3) => by_m[i - 2],
        _ => 0.0,
    });
    let six = by * of_place * by.transpose();
    Transform::new(
        std::array::from_fn(|i| std::array::from_fn(|j| matrix[(i, j)])),
        [middle[0] + x, middle[1] + y],
        image,
        std::array::from_fn(|i| std::array::from_fn(|j| 0.5 * (six[(i, j)] + six[(j, i)]))),
    )
}
