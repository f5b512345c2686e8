//! Slope of the residual as a term of the objective.
//!
//! ```text
//! s_a(i) = (e(i + k_a) - e(i)) / b_a,     b_a = k_a steps, the whole number of steps nearest to the base
//! term   = 1/2 W sum over a = x, y, sum over i  (w(i) w(i + k_a))^1/2  s_a(i)^2 = 1/2 e' S e      (1)
//! ```
//!
//! These are the finite differences by which a specification judges slopes. W is in mm^2: the term is then in nm^2, as
//! the squares of heights are. A wave of spatial frequency f counts `1 + W (2 sin(pi f b) / b)^2` times what it counts
//! without the term, which is `1 + W (2 pi f)^2` for waves that are long against the base. A pair with an invalid pixel
//! does not count. An axis with too few pixels for one pair has no slopes.
//!
//! | symbol | variable | shape | unit |
//! |---|---|---|---|
//! | e | residual map | (ny, nx) | nm |
//! | w | `weight` | (ny, nx) | 1 |
//! | W | `weight_mm2` | - | mm^2 |
//! | b | base | (2) | mm |

use ndarray::{Array2, Axis as NdAxis, Slice, Zip};
use planish_numerics::slope::{Along, steps_of_base};
use planish_types::{Grid, Invalid, Surface};
use serde::Serialize;

/// Weight of the slope of the residual, and the base length of the slope.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct ResidualSlope {
    /// Weight W of the squared slope ((nm/mm)^2) relative to the squared height (nm^2), mm^2; > 0.
    pub weight_mm2: f64,
    /// Base length of the slopes, mm; the nearest whole number of steps is used, at least one.
    pub base_mm: f64,
}

impl ResidualSlope {
    /// Refuses a weight or a base length that is not finite and above 0.
    pub(crate) fn check(&self) -> Result<(), Invalid> {
        let named = [
            ("residual_slope_weight_mm2", self.weight_mm2),
            ("residual_slope_base_mm", self.base_mm),
        ];
        for (name, value) in named {
            if !(value.is_finite() && value > 0.0) {
                return Err(Invalid::whole(name, format!("is {value}"), "give a number > 0"));
            }
        }
        Ok(())
    }

    /// Returns W times the mean square of the slopes of a residual, nm^2, which adds to the mean square of the
    /// heights: twice the term (1) of the module, over the number of valid pixels.
    pub fn mean_square_nm2(&self, residual: &Surface) -> f64 {
        let weight = residual.height_nm().map(|z| if z.is_nan() { 0.0 } else { 1.0 });
        let known = residual.height_nm().map(|z| if z.is_nan() { 0.0 } else { *z });
        let product = SlopeTerm::new(self, residual.grid(), &weight).product(&known);
        (&product * &known).sum() / weight.sum()
    }
}

/// Matrix S of (1) of the module on the pixels of a map.
pub(crate) struct SlopeTerm {
    weight_mm2: f64,
    /// Direction of every slope: array axis, number of steps of the base, and base length, mm.
    directions: Vec<(NdAxis, usize, f64)>,
    /// Square roots of the weights of the pixels (ny, nx).
    root: Array2<f64>,
}

impl SlopeTerm {
    /// Makes the matrix S for the weights of the pixels (ny, nx). An axis for which [`steps_of_base`] returns `None`
    /// has no slopes.
    pub fn new(slope: &ResidualSlope, grid: &Grid, weight: &Array2<f64>) -> Self {
        let along = [(Along::X, &grid.x), (Along::Y, &grid.y)];
        let directions = along.into_iter().filter_map(|(along, axis)| {
            let steps = steps_of_base(slope.base_mm, axis.step_mm(), axis.len())?;
            Some((along.axis(), steps, steps as f64 * axis.step_mm()))
        });
        Self {
            weight_mm2: slope.weight_mm2,
            directions: directions.collect(),
            root: weight.mapv(f64::sqrt),
        }
    }

    /// Returns the product S e of the matrix of (1) of the module with a residual map e (ny, nx).
    pub fn product(&self, map: &Array2<f64>) -> Array2<f64> {
        let mut sum = Array2::zeros(map.dim());
        for (axis, steps, base_mm) in &self.directions {
            let pairs_along = map.len_of(*axis) - steps;
            let near = Slice::from(..pairs_along);
            let far = Slice::from(*steps..);
            // D e, weighted
            let factor = self.weight_mm2 / (base_mm * base_mm);
            let mut pairs = Zip::from(map.slice_axis(*axis, near))
                .and(map.slice_axis(*axis, far))
                .and(self.root.slice_axis(*axis, near))
                .and(self.root.slice_axis(*axis, far))
                .map_collect(|a, b, v, w| factor * v * w * (b - a));
            // D' of it
            let add = |s: &mut f64, d: &f64| *s += d;
            Zip::from(sum.slice_axis_mut(*axis, far)).and(&pairs).for_each(add);
            pairs.mapv_inplace(|d| -d);
            Zip::from(sum.slice_axis_mut(*axis, near)).and(&pairs).for_each(add);
        }
        sum
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use planish_types::Axis;
    use std::f64::consts::PI;

    fn grid(ny: usize, nx: usize) -> Grid {
        Grid { x: Axis::new(0.0, 0.5, nx).unwrap(), y: Axis::new(0.0, 0.25, ny).unwrap() }
    }

    /// The map has four whole periods along x: the mean square slope of `a sin(2 pi f x)` over a base b is `(2 a sin(pi
    /// f b) / b)^2 / 2`.
    #[test]
    fn a_wave_has_the_slope_of_the_formula() {
        let (a, f, n) = (3.0, 0.2, 40);
        let wave = |c: usize| a * (2.0 * PI * f * 0.5 * c as f64 + 0.3).sin();
        for steps in [1, 5] {
            // Pairs over whole periods: n samples and the base.
            let g = grid(3, n + steps);
            let map = Array2::from_shape_fn(g.shape(), |(_, c)| wave(c));
            let base_mm = 0.5 * steps as f64;
            let slope = ResidualSlope { weight_mm2: 7.0, base_mm };
            let found = slope.mean_square_nm2(&Surface::new(g, map).unwrap());
            let one = (2.0 * a * (PI * f * base_mm).sin() / base_mm).powi(2) / 2.0;
            let want = 7.0 * one * n as f64 / (n + steps) as f64;
            // Rounding of sums of a hundred numbers.
            assert!((found / want - 1.0).abs() < 1e-12, "{steps}: {found} {want}");
        }
    }

    #[test]
    fn the_product_is_symmetric_and_invalid_pixels_do_not_count() {
        let g = grid(6, 9);
        let number = |k: usize| (1.7 * k as f64).sin();
        let map = |s: usize| Array2::from_shape_fn(g.shape(), |(r, c)| number(s + 9 * r + c));
        let mut weight = map(100).mapv(f64::abs);
        weight[[2, 3]] = 0.0;
        let term = SlopeTerm::new(&ResidualSlope { weight_mm2: 2.0, base_mm: 1.0 }, &g, &weight);
        let (a, b) = (map(1), map(500));
        let (left, right) = ((&a * &term.product(&b)).sum(), (&b * &term.product(&a)).sum());
        // Rounding of sums over 54 pixels.
        assert!((left - right).abs() < 1e-12 * left.abs().max(1.0), "{left} {right}");
        assert!((&a * &term.product(&a)).sum() > 0.0);
        // Constants have no slope, and neither has what is invalid.
        let product = term.product(&Array2::ones(g.shape()));
        assert!(product.iter().all(|v| *v == 0.0));
        let mut other = a.clone();
        other[[2, 3]] = 1e6;
        assert_eq!(term.product(&a), term.product(&other));
        // A map that is shorter than the base has no slope along it: 6 rows of 0.25 mm.
        let wide = ResidualSlope { weight_mm2: 2.0, base_mm: 2.0 };
        assert_eq!(SlopeTerm::new(&wide, &g, &weight).directions.len(), 1);
    }

    #[test]
    fn numbers_that_are_not_positive_are_refused() {
        for (weight_mm2, base_mm, name) in
            [(0.0, 1.0, "residual_slope_weight_mm2"), (1.0, f64::NAN, "residual_slope_base_mm")]
        {
            let refused = ResidualSlope { weight_mm2, base_mm }.check().unwrap_err();
            assert_eq!(refused.array, name);
        }
    }
}
