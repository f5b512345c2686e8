//! Cubic B-splines on clamped knots.
//!
//! ```text
//! D(s) = sum_i d_i B_i(s),   knots t_0 = .. = t_3 < t_4 < .. < t_n = .. = t_{n+3}
//! D'(s) = sum_i 3 (d_{i+1} - d_i) / (t_{i+4} - t_{i+1}) B_{i+1}^2(s)
//! integral_{t_0}^s D = sum_j e_j B_j^4(s),   e_j = sum_{i<j} d_i (t_{i+4} - t_i) / 4
//! ```
//!
//! The `B_i` are positive and sum to 1, so D lies between its smallest and largest control value.
//!
//! Source: C. de Boor, *A Practical Guide to Splines*, chapters IX and X (recurrence, derivative,
//! integral); W. Boehm, Comput. Aided Des. 12 (1980) 199 (knot insertion).

use ndarray::Array2;

/// Returns the values of the four cubic B-splines that are not 0 on a cell between two knots, for knots at distance 1,
/// in ascending order of their middles. The argument `f` in [0, 1] is the offset from the start of the cell.
#[inline]
pub fn on_a_cell(f: f64) -> [f64; 4] {
    let g = 1.0 - f;
    [g * g * g / 6.0, inner_spline(f), inner_spline(g), f * f * f / 6.0]
}

/// Returns the value of a cubic B-spline, for knots at distance 1, in one of its two inner cells, at the distance `f`
/// in [0, 1] from its middle.
#[inline]
fn inner_spline(f: f64) -> f64 {
    (4.0 - 6.0 * f * f + 3.0 * f * f * f) / 6.0
}

/// Degree of the splines: 3, cubic. [`Knots::basis`] and its callers assume it.
const P: usize = 3;

/// Clamped knots of cubic splines: strictly ascending, except that the first and the last knot occur four times.
#[derive(Clone, Debug, PartialEq)]
pub struct Knots {
    t: Vec<f64>,
}

impl Knots {
    /// Makes knots with `spans >= 1` intervals of equal length on [0, `length`].
    pub fn uniform(length: f64, spans: usize) -> Self {
        let inner = (1..spans).map(|k| length * k as f64 / spans as f64);
        let t = [0.0; P + 1].into_iter().chain(inner).chain([length; P + 1]).collect();
        Self { t }
    }

    /// Returns the number of control values n, one per B-spline.
    #[allow(clippy::len_without_is_empty)] // never empty
    pub fn len(&self) -> usize {
        self.t.len() - P - 1
    }

    /// Returns all knots (n+4), ascending, with the fourfold ends.
    pub fn all(&self) -> &[f64] {
        &self.t
    }

    /// Returns the knots without their repetitions, ascending: the ends of the intervals.
    pub fn breaks(&self) -> &[f64] {
        &self.t[P..self.t.len() - P]
    }

    /// Returns the two ends of the interval on which the B-spline `B_i` is not zero.
    pub fn support(&self, i: usize) -> (f64, f64) {
        (self.t[i], self.t[i + P + 1])
    }

    /// Returns the Greville abscissae (n), one for each B-spline `B_i`: the mean of its three inner knots.
    ///
    /// They are the control values of D = s. The values of a spline at these abscissae determine
    /// it.
    pub fn greville(&self) -> Vec<f64> {
        (0..self.len()).map(|i| (self.t[i + 1] + self.t[i + 2] + self.t[i + 3]) / 3.0).collect()
    }

    /// Returns the index k of the knot interval that contains `s`: the largest k with `t_k <= s` and `t_k < t_{k+1}`.
    /// For an `s` beyond the knots it is the first or the last interval.
    fn span(&self, s: f64) -> usize {
        let inner = &self.t[P + 1..self.len()];
        P + inner.partition_point(|t| *t <= s)
    }

    /// Returns the index i of the first B-spline that is not zero on the knot interval of `s`, and the values of `B_i
    /// .. B_{i+3}` at `s`; all others are zero there.
    pub fn basis(&self, s: f64) -> (usize, [f64; 4]) {
        let k = self.span(s);
        (k - P, recurrence::<4>(|i| self.t[i], k, s))
    }

    /// Returns the index i of the first B-spline that is not zero on the knot interval of `s`, and the derivatives of
    /// `B_i .. B_{i+3}` at `s`.
    pub fn basis_derivative(&self, s: f64) -> (usize, [f64; 4]) {
        let k = self.span(s);
        let lower = recurrence::<3>(|i| self.t[i], k, s);
        // B_i' = 3 (B_i^2 / (t_{i+3} - t_i) - B_{i+1}^2 / (t_{i+4} - t_{i+1}))
        let first = k - P;
        // Parts 3 B_i^2 / (t_{i+3} - t_i) for i = k - 2, k - 1, k.
        let part = [0, 1, 2].map(|r| 3.0 * lower[r] / (self.t[k + 1 + r] - self.t[k + r - 2]));
        let derivative = [0, 1, 2, 3].map(|j| {
            let rising = if j > 0 { part[j - 1] } else { 0.0 };
            let falling = if j < 3 { part[j] } else { 0.0 };
            rising - falling
        });
        (first, derivative)
    }

    /// Returns the value D(s) of the spline with the control values `d` (n).
    pub fn value(&self, d: &[f64], s: f64) -> f64 {
        combine(d, self.basis(s))
    }

    /// Returns the derivative D'(s) of the spline with the control values `d` (n).
    pub fn derivative(&self, d: &[f64], s: f64) -> f64 {
        combine(d, self.basis_derivative(s))
    }

    /// Returns the integral, from the first knot to s, of the spline with the control values `d` (n), in closed form.
    pub fn integral(&self, d: &[f64]) -> Integral<'_> {
        let mut e = vec![0.0];
        for i in 0..self.len() {
            e.push(e[i] + d[i] * (self.t[i + P + 1] - self.t[i]) / (P + 1) as f64);
        }
        Integral { knots: self, e }
    }

    /// Returns the knots without the inner knot that has the index `k` in [`Self::breaks`]; `k` is neither the first
    /// nor the last index.
    pub fn without(&self, k: usize) -> Self {
        let mut t = self.t.clone();
        t.remove(P + k);
        Self { t }
    }

    /// Returns the matrix (n of `fine`, n) from control values on these knots to control values of the same
    /// spline on `fine`, which has these knots and more.
    pub fn refinement(&self, fine: &Self) -> Array2<f64> {
        let mut knots = self.clone();
        let mut k_matrix = Array2::eye(self.len());
        for &new in fine.breaks() {
            let k = knots.span(new);
            if knots.t[k] == new || new >= knots.t[knots.len()] {
                continue;
            }
            // e_i = a_i d_i + (1 - a_i) d_{i-1},  a_i = (t - t_i) / (t_{i+3} - t_i), in [0, 1]
            let n = knots.len();
            let mut next = Array2::zeros((n + 1, self.len()));
            for i in 0..=n {
                let a = if i + P <= k {
                    1.0
                } else if i > k {
                    0.0
                } else {
                    (new - knots.t[i]) / (knots.t[i + P] - knots.t[i])
                };
                let mut row = next.row_mut(i);
                if a > 0.0 {
                    row.scaled_add(a, &k_matrix.row(i));
                }
                if a < 1.0 {
                    row.scaled_add(1.0 - a, &k_matrix.row(i - 1));
                }
            }
            k_matrix = next;
            knots.t.insert(k + 1, new);
        }
        k_matrix
    }
}

/// Integral of a cubic spline from the first knot: a quartic spline.
#[derive(Clone, Debug)]
pub struct Integral<'a> {
    knots: &'a Knots,
    e: Vec<f64>,
}

impl Integral<'_> {
    /// Returns the integral of the spline from the first knot to `s`.
    pub fn value(&self, s: f64) -> f64 {
        let t = &self.knots.t;
        let k = self.knots.span(s);
        // The quartic knots have one more repetition at either end: their index is one higher.
        let basis = recurrence::<5>(|i| t[(i.max(1) - 1).min(t.len() - 1)], k + 1, s);
        (0..5).map(|j| self.e[k + 1 - 4 + j] * basis[j]).sum()
    }
}

/// Returns the sum of the four B-splines that are not zero, each times its control value of `d`; the first has the
/// index `first`.
fn combine(d: &[f64], (first, basis): (usize, [f64; 4])) -> f64 {
    (0..4).map(|j| d[first + j] * basis[j]).sum()
}

/// Returns the values at `s` of the N B-splines of degree N - 1 that are not zero in the knot interval k, by the
/// recurrence of Cox and de Boor. `t(i)` is knot i.
fn recurrence<const N: usize>(t: impl Fn(usize) -> f64, k: usize, s: f64) -> [f64; N] {
    let mut b = [0.0; N];
    b[0] = 1.0;
    for degree in 1..N {
        // B_i^p = (s - t_i)/(t_{i+p} - t_i) B_i^{p-1} + (t_{i+p+1} - s)/(t_{i+p+1} - t_{i+1}) B_{i+1}^{p-1}
        let mut carried = 0.0;
        for r in 0..degree {
            let left = t(k + 1 + r - degree);
            let right = t(k + 1 + r);
            let fraction = b[r] / (right - left);
            b[r] = carried + (right - s) * fraction;
            carried = (s - left) * fraction;
        }
        b[degree] = carried;
    }
    b
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn uneven() -> Knots {
        let fine = Knots::uniform(3.0, 9);
        fine.without(2).without(4)
    }

    #[test]
    fn on_a_cell_they_are_those_of_uniform_knots() {
        let knots = Knots::uniform(9.0, 9);
        for f in [0.0, 0.3, 0.8, 0.999] {
            let (first, expected) = knots.basis(4.0 + f);
            assert_eq!(first, 4);
            let found = on_a_cell(f);
            // Rounding of values up to 1.
            assert!((0..4).all(|k| (found[k] - expected[k]).abs() < 1e-15), "{f}: {found:?}");
        }
    }

    #[test]
    fn basis_sums_to_one_and_its_derivative_to_zero() {
        let knots = uneven();
        for k in 0..=60 {
            let s = 3.0 * f64::from(k) / 60.0;
            // Below: rounding of values up to 1, and of derivatives, which divide by the distance of the knots.
            assert!((knots.basis(s).1.iter().sum::<f64>() - 1.0).abs() < 1e-15);
            assert!(knots.basis_derivative(s).1.iter().sum::<f64>().abs() < 1e-13);
        }
    }

    #[test]
    fn the_line_has_grevilles_abscissae_as_control_values() {
        let knots = uneven();
        let d = knots.greville();
        for k in 0..=60 {
            let s = 3.0 * f64::from(k) / 60.0;
            // Below: rounding of values up to 4.5, and of derivatives, which divide by the distance of the knots.
            assert!((knots.value(&d, s) - s).abs() < 1e-14);
            assert!((knots.derivative(&d, s) - 1.0).abs() < 1e-13);
            assert!((knots.integral(&d).value(s) - 0.5 * s * s).abs() < 1e-14);
        }
    }

    proptest! {
        #[test]
        fn derivative_and_integral_belong_to_the_value(
            d in prop::collection::vec(-2.0..2.0_f64, 10), at in 0.01..0.99_f64,
        ) {
            let knots = uneven();
            let (s, h) = (3.0 * at, 1e-5);
            let slope = (knots.value(&d, s + h) - knots.value(&d, s - h)) / (2.0 * h);
            // Third derivatives up to 2 * 6 * 8 / h_span^3 = 3e3; h^2/6 of it, and at a knot its jump.
            prop_assert!((slope - knots.derivative(&d, s)).abs() < 1e-6);
            let integral = knots.integral(&d);
            let mean = (integral.value(s + h) - integral.value(s - h)) / (2.0 * h);
            // Second derivatives up to 300; h^2/6 of it, and rounding 1e-15 / h.
            prop_assert!((mean - knots.value(&d, s)).abs() < 1e-7);
        }

        #[test]
        fn a_refined_spline_is_the_same(d in prop::collection::vec(-2.0..2.0_f64, 10), at in 0.0..=1.0_f64) {
            let (coarse, fine) = (uneven(), Knots::uniform(3.0, 9));
            let k = coarse.refinement(&fine);
            prop_assert_eq!(k.dim(), (fine.len(), coarse.len()));
            let e = k.dot(&ndarray::ArrayView1::from(&d)).to_vec();
            let s = 3.0 * at;
            prop_assert!((coarse.value(&d, s) - fine.value(&e, s)).abs() < 1e-13);
        }
    }
}
