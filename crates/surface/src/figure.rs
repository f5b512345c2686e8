//! The figure of a map: its smooth part, without the pits in it.
//!
//! ```text
//! q(u, v) = sum_ij c_ij P_i(u) P_j(v),   u, v from -1 to 1 over a window,   c = argmin sum rho(z - q)
//!           i + j <= p in the whole map, i <= p and j <= p in a smaller window
//! rho(e)  = e^2 / 2 for |e| <= t, t |e| - t^2 / 2 beyond;   t = median |z - q|
//! figure  = sum_k w_k q_k / sum_k w_k,   w_k the distance to the border of window k, along x times along y
//! ```
//!
//! Least squares would bias the fit towards a pit of 20 nm. The absolute values of rho outweigh it by the
//! other pixels, as in a median, and unlike a median a polynomial follows a slope and a curvature.
//! Polynomials with i + j <= p follow a wave along a diagonal less far than one along an axis. The misfit
//! is in the corners, where it looks like a pit. Hence the windows have more terms, for waves. A figure
//! without waves does not need these terms, and they follow a pit in a corner.
//!
//! Windows overlap by half or more, so that every pixel is far from the border of one of them; a polynomial
//! is weak at the border. The border of the map counts as infinitely far.
//!
//! The normal equations are sums of products over a lattice, and are made along x first, then along y:
//!
//! ```text
//! sum_rc w P_i(u) P_j(v) P_k(u) P_l(v) = sum_r (P_j P_l)(v_r) sum_c w_rc (P_i P_k)(u_c)
//! ```
//!
//! Source: rho, P. J. Huber, Ann. Math. Stat. 35 (1964) 73; its minimum by least squares with the weights
//! min(1, t / |e|), solved again and again, P. W. Holland, R. E. Welsch, Commun. Stat. A 6 (1977) 813.
//!
//! | symbol | variable | shape | unit |
//! |---|---|---|---|
//! | z | `map` | (ny, nx) | nm |
//! | c_ij | `c` | (terms) | nm |
//! | t | `middle` | - | nm |

use std::ops::Range;

use nalgebra::{DMatrix, DVector};
use ndarray::{Array2, ArrayView2, s};
use planish_numerics::orthogonal::legendre;
use rayon::prelude::*;

/// Number of orders of the polynomials along an axis, p + 1 in the module. Larger: follows shorter waves, and pits too,
/// in more time. Smaller: leaves waves of the figure, which then look like pits. Derived: order 10 follows one wave
/// over the window to 4e-5 of its height.
const ORDERS: usize = 11;

/// Number of different products P_i P_k of two polynomials along an axis.
const PAIRS: usize = ORDERS * (ORDERS + 1) / 2;

/// Smallest number of samples per term; with fewer samples the order is lower. Larger: lower orders in
/// small windows. Smaller: the samples do not outweigh a pit.
const SAMPLES_PER_TERM: usize = 10;

/// Largest number of samples along an axis of a window. Larger: more time, in proportion to its square. Smaller: fewer
/// samples per term. Chosen: ten times the order.
const MAX_SAMPLES: usize = 100;

/// Number of weighted fits after the first one. Larger: more time. Smaller: pits still pull the fit.
const ROUNDS: usize = 8;

/// Number that is added to the diagonal of the normal equations, relative to the mean of the diagonal. Larger: moves
/// heights. Smaller: pixels on a line cannot be fitted. Chosen: far above rounding, and far below what moves a height.
const RIDGE: f64 = 1e-10;

/// Weight of a window whose samples suffice for a lower order only, relative to a window with all orders. Larger: such
/// a window changes pixels that have a better one. Smaller: rounding. It counts only at pixels without another window.
const LAST_RESORT: f64 = 1e-6;

/// Computes the figure of `map` at every pixel (ny, nx), nm; 0 where no window has a valid sample. `window` is the size
/// of the windows along y and x in pixels, limited to the size of the map.
pub fn figure(map: ArrayView2<f64>, window: (usize, usize)) -> Array2<f64> {
    let rows = windows(map.nrows(), window.0);
    let columns = windows(map.ncols(), window.1);
    let all: Vec<_> =
        rows.iter().flat_map(|r| columns.iter().map(move |c| (r.clone(), c.clone()))).collect();
    let terms = if all.len() == 1 { Terms::Sum } else { Terms::Each };
    let fits: Vec<_> = all
        .par_iter()
        .map(|(r, c)| WindowFit::new(map.slice(s![r.clone(), c.clone()]), terms))
        .collect();
    let mut sum = Array2::zeros(map.dim());
    let mut weight = Array2::<f64>::zeros(map.dim());
    for ((r, c), fit) in all.into_iter().zip(fits) {
        let Some(fit) = fit else { continue };
        let along_y = tent(&r, map.nrows());
        let along_x = tent(&c, map.ncols());
        let whole = if fit.order + 1 == ORDERS { 1.0 } else { LAST_RESORT };
        let q = fit.heights(r.len(), c.len());
        for ((k, l), q) in q.indexed_iter() {
            let w = whole * along_y[k] * along_x[l];
            sum[[r.start + k, c.start + l]] += w * q;
            weight[[r.start + k, c.start + l]] += w;
        }
    }
    // 0 where no window has a sample.
    sum.zip_mut_with(&weight, |q, w| *q = if *w > 0.0 { *q / w } else { 0.0 });
    sum
}

/// Returns the ranges of windows of `window` pixels (at most `n`) that cover `n` pixels. Neighbours overlap by half a
/// window or more.
fn windows(n: usize, window: usize) -> Vec<Range<usize>> {
    let window = window.min(n);
    let rest = n - window;
    let steps = rest.div_ceil((window / 2).max(1));
    (0..=steps).map(|k| rest * k / steps.max(1)).map(|start| start..start + window).collect()
}

/// Returns the weights of the pixels of a window along one axis: the distance to the border of the window, over its
/// size, at most 1. The border of the map, which has `n` pixels, counts as infinitely far.
fn tent(window: &Range<usize>, n: usize) -> Vec<f64> {
    let pixels = window.clone().map(|i| {
        let low = (i - window.start) as f64 + 0.5;
        let high = (window.end - i) as f64 - 0.5;
        let low = if window.start == 0 { f64::INFINITY } else { low };
        let high = if window.end == n { f64::INFINITY } else { high };
        (low.min(high) / window.len() as f64).min(1.0)
    });
    pixels.collect()
}

/// Polynomial q of the module, fitted to one window.
struct WindowFit {
    terms: Terms,
    order: usize,
    /// Coefficients of the terms, in the order of [`Terms::up_to`], nm.
    c: DVector<f64>,
}

/// Rule that selects the terms P_i P_j of an order p.
#[derive(Clone, Copy, PartialEq)]
enum Terms {
    /// Terms with i + j <= p.
    Sum,
    /// Terms with i <= p and j <= p.
    Each,
}

impl Terms {
    /// Returns (i, j) of all terms up to an order.
    fn up_to(self, order: usize) -> impl Iterator<Item = (usize, usize)> {
        let last = move |i: usize| if self == Self::Sum { order - i } else { order };
        (0..=order).flat_map(move |i| (0..=last(i)).map(move |j| (i, j)))
    }
}

/// Returns the index of the product P_i P_k among all products of an axis.
fn pair(i: usize, k: usize) -> usize {
    let low = i.min(k);
    let high = i.max(k);
    high * (high + 1) / 2 + low
}

impl WindowFit {
    /// Fits the polynomial to a window by the rule rho of the module, with the highest order for which there are enough
    /// samples. Returns `None` if the normal equations cannot be solved, as in a window without a valid sample.
    fn new(map: ArrayView2<f64>, terms: Terms) -> Option<Self> {
        let at_y = samples(map.nrows());
        let at_x = samples(map.ncols());
        let z = Array2::from_shape_fn((at_y.len(), at_x.len()), |(r, c)| map[[at_y[r], at_x[c]]]);
        let count = z.iter().filter(|z| !z.is_nan()).count();
        let order = (0..ORDERS)
            .rev()
            .find(|p| SAMPLES_PER_TERM * terms.up_to(*p).count() <= count)
            .unwrap_or(0);
        let along_y = with_products(&polynomials(map.nrows()), &at_y);
        let along_x = with_products(&polynomials(map.ncols()), &at_x);
        let indices: Vec<_> = terms.up_to(order).collect();
        // 0 on invalid pixels
        let mut w = z.mapv(|z| if z.is_nan() { 0.0 } else { 1.0 });
        let mut last_fit = None;
        for _ in 0..=ROUNDS {
            // A' w A c = A' w z
            let mut by_pairs = [[0.0; PAIRS]; PAIRS];
            let mut right = [[0.0; ORDERS]; ORDERS];
            for ((z, w), (p_y, pp_y)) in z.outer_iter().zip(w.outer_iter()).zip(&along_y) {
                let mut row_by_pairs = [0.0; PAIRS];
                let mut row_right = [0.0; ORDERS];
                for ((z, w), (p, pp)) in z.iter().zip(w).zip(&along_x) {
                    if *w > 0.0 {
                        row_by_pairs.iter_mut().zip(pp).for_each(|(sum, pp)| *sum += w * pp);
                        row_right.iter_mut().zip(p).for_each(|(sum, p)| *sum += w * z * p);
                    }
                }
                for (sums, pp) in by_pairs.iter_mut().zip(pp_y) {
                    sums.iter_mut().zip(&row_by_pairs).for_each(|(sum, row)| *sum += pp * row);
                }
                for (sums, p) in right.iter_mut().zip(p_y) {
                    sums.iter_mut().zip(&row_right).for_each(|(sum, row)| *sum += p * row);
                }
            }
            let mut normal = DMatrix::from_fn(indices.len(), indices.len(), |a, b| {
                let (i, j) = indices[a];
                let (k, l) = indices[b];
                by_pairs[pair(j, l)][pair(i, k)]
            });
            let ridge = RIDGE * normal.trace() / normal.nrows() as f64;
            (0..normal.nrows()).for_each(|k| normal[(k, k)] += ridge);
            let right =
                DVector::from_iterator(indices.len(), indices.iter().map(|&(i, j)| right[j][i]));
            let fit = Self { terms, order, c: normal.cholesky()?.solve(&right) };
            // w = min(1, t / |e|)
            let q = fit.on(along_y.iter().map(|a| &a.0), along_x.iter().map(|a| &a.0));
            last_fit = Some(fit);
            let errors = (&z - &q).mapv(f64::abs);
            let mut sorted: Vec<f64> = errors.iter().copied().filter(|e| !e.is_nan()).collect();
            let half = sorted.len() / 2;
            let middle = *sorted.select_nth_unstable_by(half, f64::total_cmp).1;
            if middle == 0.0 {
                break; // Most samples are on the polynomial.
            }
            w.zip_mut_with(&errors, |w, e| {
                *w = if e.is_nan() { 0.0 } else { middle / e.max(middle) }
            });
        }
        last_fit
    }
    /// Returns the fitted polynomial q on the pixels of a window (ny, nx), nm.
    fn heights(&self, ny: usize, nx: usize) -> Array2<f64> {
        self.on(polynomials(ny).iter(), polynomials(nx).iter())
    }

    fn on<'a>(
        &self,
        along_y: impl ExactSizeIterator<Item = &'a [f64; ORDERS]>,
        along_x: impl ExactSizeIterator<Item = &'a [f64; ORDERS]> + Clone,
    ) -> Array2<f64> {
        let mut q = Array2::zeros((along_y.len(), along_x.len()));
        for (v, mut line) in along_y.zip(q.outer_iter_mut()) {
            // sum_ij c_ij P_i(u) P_j(v) = sum_i a_i P_i(u)
            let mut a = [0.0; ORDERS];
            self.terms
                .up_to(self.order)
                .zip(self.c.iter())
                .for_each(|((i, j), c)| a[i] += c * v[j]);
            for (u, q) in along_x.clone().zip(line.iter_mut()) {
                *q = a.iter().zip(u).map(|(a, u)| a * u).sum();
            }
        }
        q
    }
}

/// Returns the Legendre polynomials P_0 to P_p at `n` pixels, which run from -1 to 1.
fn polynomials(n: usize) -> Vec<[f64; ORDERS]> {
    let half = 0.5 * (n - 1) as f64;
    let mut all = vec![[0.0; ORDERS]; n];
    for (i, values) in all.iter_mut().enumerate() {
        legendre((i as f64 - half) / half.max(1.0), values);
    }
    all
}

/// Returns the values of the polynomials at the pixels with the indices `samples`, each with its [`products`].
fn with_products(
    polynomials: &[[f64; ORDERS]],
    samples: &[usize],
) -> Vec<([f64; ORDERS], [f64; PAIRS])> {
    samples.iter().map(|k| (polynomials[*k], products(&polynomials[*k]))).collect()
}

/// Returns the products P_i P_k of the polynomials `p` at a pixel, in the order of [`pair`].
fn products(p: &[f64; ORDERS]) -> [f64; PAIRS] {
    let mut out = [0.0; PAIRS];
    for high in 0..ORDERS {
        for low in 0..=high {
            out[pair(low, high)] = p[low] * p[high];
        }
    }
    out
}

/// Returns the indices of equally spaced pixels of an axis of `n` pixels, at most [`MAX_SAMPLES`] of them.
fn samples(n: usize) -> Vec<usize> {
    let step = n.div_ceil(MAX_SAMPLES).max(1);
    ((step - 1) / 2..n).step_by(step).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::TAU;

    const SHAPE: (usize, usize) = (90, 140);
    const WHOLE: (usize, usize) = SHAPE;

    fn map(height: impl Fn(f64, f64) -> f64) -> Array2<f64> {
        Array2::from_shape_fn(SHAPE, |(r, c)| height(c as f64 / 139.0, r as f64 / 89.0))
    }

    fn largest(difference: Array2<f64>) -> f64 {
        difference.iter().fold(0.0, |most, d| most.max(d.abs()))
    }

    #[test]
    fn a_polynomial_is_its_own_figure_in_every_window_with_holes_too() {
        let plane = |x: f64, y: f64| 100.0 * x - 30.0 * y;
        let of_order_10 = |x: f64, y: f64| 50.0 * x.powi(7) * y.powi(3) - 20.0 * y.powi(10) + x;
        for (height, window) in [(&plane as &dyn Fn(f64, f64) -> f64, WHOLE), (&of_order_10, WHOLE)]
            .into_iter()
            .chain([(&of_order_10 as &dyn Fn(f64, f64) -> f64, (60, 60)), (&plane, (45, 500))])
        {
            let exact = map(height);
            let mut holed = exact.clone();
            holed.slice_mut(s![20..40, 60..90]).fill(f64::NAN);
            holed.slice_mut(s![..15, ..15]).fill(f64::NAN);
            for given in [&exact, &holed] {
                // The ridge of 1e-10 of the terms, which beside holes is more of some of them, where the polynomial is
                // measured.
                let off = &figure(given.view(), window) - given;
                let off = largest(off.mapv(|d| if d.is_nan() { 0.0 } else { d }));
                assert!(off < 1e-2, "{window:?}: {off}");
            }
        }
    }

    #[test]
    fn a_wave_over_the_window_is_followed_to_a_ten_thousandth() {
        // Along y as well only in windows: the whole map has fewer terms.
        for (window, waves, along_y) in
            [(WHOLE, 1.0, 0.0), ((45, 70), 2.0, 1.0), ((40, 50), 2.5, 1.2)]
        {
            let of_x = |x: f64| 300.0 * (TAU * waves * x).sin();
            let wave = map(|x, y| of_x(x) * (TAU * along_y * y + 0.3).cos());
            let off = largest(figure(wave.view(), window) - &wave);
            assert!(off < 300.0 * 1e-4, "{window:?}: {off}");
        }
        // More of them are not.
        let wave = map(|x, _| 300.0 * (TAU * 8.0 * x).sin());
        assert!(largest(figure(wave.view(), WHOLE) - &wave) > 100.0);
    }

    #[test]
    fn a_pit_does_not_draw_it() {
        let wave = map(|x, y| 300.0 * (TAU * 2.0 * x).sin() * (TAU * y).cos() + 40.0 * x);
        for depth_nm in [20.0, 2000.0] {
            let mut pitted = wave.clone();
            pitted.slice_mut(s![40..46, 60..66]).mapv_inplace(|z| z - depth_nm);
            let off = largest(figure(pitted.view(), (45, 70)) - &wave);
            // 36 of the 3150 pixels of a window move the rest by a hundredth of what they are deep.
            assert!(off < 0.015 * depth_nm, "{depth_nm}: {off}");
        }
    }

    #[test]
    fn windows_cover_every_pixel_and_lie_over_each_other_by_half() {
        for (n, window) in [(1, 9), (9, 9), (10, 9), (100, 33), (101, 50), (1000, 45)] {
            let found = windows(n, window);
            assert_eq!((found[0].start, found[found.len() - 1].end), (0, n));
            for pair in found.windows(2) {
                assert!(2 * (pair[0].end - pair[1].start) >= window, "{n} {window} {pair:?}");
            }
            assert!(found.iter().all(|w| w.len() == window.min(n)));
        }
    }

    #[test]
    fn where_nothing_is_measured_it_is_0_and_few_pixels_have_their_mean() {
        let none = Array2::from_elem((40, 40), f64::NAN);
        assert!(figure(none.view(), (40, 40)).iter().all(|q| *q == 0.0));
        let mut one = none.clone();
        one[[3, 5]] = 7.0;
        let found = figure(one.view(), (20, 20));
        // The ridge of 1e-10.
        assert!((found[[3, 5]] - 7.0).abs() < 1e-8, "{}", found[[3, 5]]);
        assert_eq!(found[[30, 30]], 0.0);
    }
}
