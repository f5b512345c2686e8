//! Power spectral densities of a rectangle of samples: in two dimensions, and along its rows.
//!
//! ```text
//! F[k, l] = dx dy sum z w exp(-2 pi i (k r / ny + l c / nx)),   w = w_y(r) w_x(c)
//! two-dimensional  S[k, l] = |F|^2 / (nx dx ny dy mean(w^2)),   both signs of the frequencies
//! along x          mean over the rows of  2 dx |sum z w_x exp(..)|^2 / (nx mean(w_x^2)),
//!                  f >= 0; not doubled at f = 0 and at the Nyquist frequency
//! mean square of a band = sum of S df over the bins with f_0 <= |f| < f_1
//! ```
//!
//! The sum of S df over all bins therefore equals the mean square of the samples, each weighted
//! with w^2, exactly (Parseval). Adjoining bands add up.
//!
//! The Hann window suppresses leakage over all frequencies, which nearly every map has because it
//! is not periodic in the rectangle. It gives the middle more weight than the edges. Without a
//! window all samples have equal weight, and high bands contain leakage from low ones.
//!
//! **Invalid samples.** A density is estimated on the largest rectangle without invalid samples
//! ([`largest_rectangle`]). Setting them to zero would multiply the samples by a mask. The density
//! would then be the convolution of the true one with the spectrum of the mask, whose edges spread
//! low frequencies over the high ones (Harris, Section II). Low frequencies are usually a million
//! times stronger. Filling invalid samples with a guess would put the guess into the result, which
//! is the decision of the user.
//!
//! Source: J. M. Elson, J. M. Bennett, Appl. Opt. 34 (1995) 201; ISO 10110-8 (one-sided along a
//! line); F. J. Harris, Proc. IEEE 66 (1978) 51 (windows).
//!
//! | symbol | variable | shape | unit |
//! |---|---|---|---|
//! | z | `z` | (ny, nx) | u |
//! | dx, dy | `step` | | s |
//! | w_x, w_y | `window` | (nx), (ny) | 1 |
//! | f | `frequency*` | | 1/s |
//! | S | `density` | (ny, nx), (nx / 2 + 1) | u^2 s^2, u^2 s |

use std::f64::consts::PI;

use ndarray::{Array2, ArrayView2};

use crate::parallel;
use crate::{
    fft::{Complex64, transform},
    statistics::{fit_plane, subtract_plane},
};

/// Smallest number of samples along an axis of a rectangle for which a density is computed. Larger: small maps have no
/// density. Smaller: the density is meaningless, because the window suppresses the samples at the ends, and the bin at
/// frequency 0 has only the mean.
pub const MIN_SAMPLES: usize = 8;

/// Smallest transfer function of a tool, relative to frequency 0, at which dwell times can correct
/// a wave. Larger: fewer waves count as correctable. Smaller: waves count that no plan can correct.
/// To remove a wave of 1 nm, the dwell times vary by the removal of 1 nm / transfer. At 1 % that is
/// 100 nm, more than the whole removal of most plans, and dwell times cannot be negative.
pub const LEAST_TRANSFER: f64 = 0.01;

/// Returns the periodic Hann window of `n` samples, `w[i] = (1 - cos(2 pi i / n)) / 2`.
pub fn hann(n: usize) -> Vec<f64> {
    (0..n).map(|i| 0.5 * (1.0 - (2.0 * PI * i as f64 / n as f64).cos())).collect()
}

/// Returns the samples `z` (ny, nx) minus their mean.
pub fn without_mean(z: ArrayView2<f64>) -> Array2<f64> {
    let z = z.to_owned();
    let mean = z.mean().unwrap_or(0.0);
    z - mean
}

/// Returns `z` (ny, nx) minus its least-squares plane over the coordinates `x` and `y`, and minus its mean.
/// If the samples define no plane, only the mean is subtracted.
pub fn without_plane(z: ArrayView2<f64>, x: &[f64], y: &[f64]) -> Array2<f64> {
    match fit_plane(z, x, y) {
        Some(plane) => without_mean(subtract_plane(z, x, y, plane).view()),
        None => without_mean(z),
    }
}

/// Two-dimensional power spectral density S, for positive and negative frequencies.
#[derive(Clone, Debug, PartialEq)]
pub struct Density {
    /// Frequencies along x, cycles per unit of length, ascending (nx).
    pub frequency_x: Vec<f64>,
    /// Frequencies along y, cycles per unit of length, ascending (ny).
    pub frequency_y: Vec<f64>,
    /// Power spectral density S (ny, nx), in the squared unit of the samples times the squared unit of length.
    pub density: Array2<f64>,
    /// Area of a bin: the frequency step along x times that along y.
    pub bin: f64,
}

/// Means over a ring of the frequency plane: the bins whose radial frequency |f| is in one interval.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ring {
    /// Mean of the radial frequency |f| over the bins of the ring.
    pub frequency: f64,
    /// Mean of the power spectral density S over the bins of the ring.
    pub density: f64,
}

impl Density {
    /// Computes the power spectral density S of `z` (ny, nx), which has no invalid samples. Its sample steps are [dx,
    /// dy], and the windows [w_x, w_y] have nx and ny weights.
    pub fn new(z: ArrayView2<f64>, [dx, dy]: [f64; 2], [w_x, w_y]: [&[f64]; 2]) -> Self {
        let (ny, nx) = z.dim();
        // S = |F|^2 / (nx dx ny dy mean(w^2)), F = dx dy DFT(z w)
        let weighted = Array2::from_shape_fn((ny, nx), |(r, c)| z[[r, c]] * w_y[r] * w_x[c]);
        let scale = dx * dy / ((nx * ny) as f64 * mean_square(w_x) * mean_square(w_y));
        let power = transform::forward(weighted.view()).mapv(|v| v.norm_sqr() * scale);
        let order_x = ascending(nx);
        let order_y = ascending(ny);
        Self {
            frequency_x: order_x.iter().map(|k| transform::frequency(*k, nx) / dx).collect(),
            frequency_y: order_y.iter().map(|k| transform::frequency(*k, ny) / dy).collect(),
            density: Array2::from_shape_fn((ny, nx), |(r, c)| power[[order_y[r], order_x[c]]]),
            bin: 1.0 / (nx as f64 * dx * ny as f64 * dy),
        }
    }

    /// Returns the density S summed over all bins times the area of a bin. It equals the mean square of the windowed
    /// samples.
    pub fn total(&self) -> f64 {
        self.density.sum() * self.bin
    }

    /// Returns the mean square in a band: the density S summed over the bins with `low` <= |f| < `high`, times the
    /// area of a bin.
    pub fn mean_square(&self, [low, high]: [f64; 2]) -> f64 {
        let inside = self.bins().filter(|(f, _)| *f >= low && *f < high);
        inside.map(|(_, s)| s).sum::<f64>() * self.bin
    }

    /// Returns the mean frequency and density of each of `count` rings. `ring_of` gives the index of the ring of a
    /// radial frequency |f|; for `None` or an index from `count` on, the bin is left out. A ring without a bin is
    /// `None`.
    pub fn rings(&self, count: usize, ring_of: impl Fn(f64) -> Option<usize>) -> Vec<Option<Ring>> {
        let mut sums = vec![(0.0, 0.0, 0_usize); count];
        for (f, s) in self.bins() {
            if let Some(sum) = ring_of(f).and_then(|ring| sums.get_mut(ring)) {
                *sum = (sum.0 + f, sum.1 + s, sum.2 + 1);
            }
        }
        let rings = sums.into_iter().map(|(f, s, n)| {
            if n == 0 {
                return None;
            }
            Some(Ring { frequency: f / n as f64, density: s / n as f64 })
        });
        rings.collect()
    }

    /// Returns the radial frequency |f| and the density S of every bin.
    fn bins(&self) -> impl Iterator<Item = (f64, f64)> {
        let bins = self.density.indexed_iter();
        bins.map(|((r, c), s)| (self.frequency_x[c].hypot(self.frequency_y[r]), *s))
    }
}

/// Returns the frequencies f >= 0 (n / 2 + 1) and the one-sided density, averaged over the rows of `z` (rows, n).
/// `step` is the distance of the samples; `window` has n weights.
pub fn along_rows(z: ArrayView2<f64>, step: f64, window: &[f64]) -> (Vec<f64>, Vec<f64>) {
    let (rows, n) = z.dim();
    let mut sums = vec![0.0; n / 2 + 1];
    for row in z.outer_iter() {
        let line = Array2::from_shape_fn((1, n), |(_, c)| row[c] * window[c]);
        let spectrum = transform::forward(line.view());
        sums.iter_mut().zip(&spectrum).for_each(|(s, v)| *s += v.norm_sqr());
    }
    let scale = step / (n as f64 * mean_square(window) * rows as f64);
    let density = sums.iter().enumerate().map(|(k, s)| {
        let is_single = k == 0 || 2 * k == n;
        s * scale * if is_single { 1.0 } else { 2.0 }
    });
    let density = density.collect();
    ((0..=n / 2).map(|k| k as f64 / (n as f64 * step)).collect(), density)
}

/// Computes the transfer function of a kernel (my, mx) with samples at `x` and `y`, at the frequencies `f_x` and
/// `f_y`, relative to frequency 0: |sum t exp(-2 pi i (f_x x + f_y y))| / |sum t|, (ny, nx).
///
/// It is a direct sum, one axis after the other, because the steps of the kernel and of the
/// frequencies are unrelated.
pub fn transfer(
    kernel: ArrayView2<f64>,
    [x, y]: [&[f64]; 2],
    [f_x, f_y]: [&[f64]; 2],
) -> Array2<f64> {
    // Along x: (nx, my)
    let rows: Vec<Vec<Complex64>> = parallel::map(f_x.len(), &|k| {
        let waves = waves(f_x[k], x);
        let rows = kernel.outer_iter();
        rows.map(|row| row.iter().zip(&waves).map(|(t, w)| w * t).sum()).collect()
    });
    let whole = kernel.sum().abs();
    let lines: Vec<Vec<f64>> = parallel::map(f_y.len(), &|k| {
        let waves = waves(f_y[k], y);
        let sums =
            rows.iter().map(|row| row.iter().zip(&waves).map(|(t, w)| t * w).sum::<Complex64>());
        sums.map(|sum| sum.norm() / whole).collect()
    });
    Array2::from_shape_fn((f_y.len(), f_x.len()), |(r, c)| lines[r][c])
}

/// Returns the complex wave `exp(-2 pi i f x)` of the frequency `f` at every coordinate of `x`.
fn waves(f: f64, x: &[f64]) -> Vec<Complex64> {
    x.iter().map(|x| Complex64::cis(-2.0 * PI * f * x)).collect()
}

/// Returns the mean of the squared weights of a window.
pub fn mean_square(window: &[f64]) -> f64 {
    window.iter().map(|w| w * w).sum::<f64>() / window.len() as f64
}

/// Returns the indices of the elements of a transform of length `n`, sorted by ascending frequency from the most
/// negative one.
fn ascending(n: usize) -> Vec<usize> {
    (n / 2 + 1..n).chain(0..=n / 2).collect()
}

/// Returns the rectangle of largest area in which all flags are true: its first (row, column) and its size (rows,
/// columns). Of equal rectangles, the first. Without a true flag the size is (0, 0).
pub fn largest_rectangle(flags: &Array2<bool>) -> ((usize, usize), (usize, usize)) {
    let (ny, nx) = flags.dim();
    let mut best = ((0, 0), (0, 0));
    let mut height = vec![0_usize; nx];
    for r in 0..ny {
        for c in 0..nx {
            height[c] = if flags[[r, c]] { height[c] + 1 } else { 0 };
        }
        // Columns of ascending heights whose rectangles are still open: (first column, height).
        let mut open: Vec<(usize, usize)> = Vec::new();
        for c in 0..=nx {
            let h = if c < nx { height[c] } else { 0 };
            let mut start = c;
            while let Some(&(first, tall)) = open.last().filter(|o| o.1 >= h) {
                if tall * (c - first) > best.1.0 * best.1.1 {
                    best = ((r + 1 - tall, first), (tall, c - first));
                }
                start = first;
                open.pop();
            }
            open.push((start, h));
        }
    }
    best
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::s;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    #[test]
    fn the_mean_square_of_all_bins_is_that_of_the_weighted_samples() {
        let mut rng = ChaCha8Rng::seed_from_u64(4);
        for (nx, ny) in [(30, 21), (31, 22), (16, 16), (17, 9)] {
            let z = Array2::from_shape_simple_fn((ny, nx), || rng.random_range(-3.0..5.0));
            let (w_x, w_y) = (hann(nx), hann(ny));
            let found = Density::new(z.view(), [0.1, 0.15], [&w_x, &w_y]).mean_square([0.0, 99.0]);
            let weighted = z.indexed_iter().map(|((r, c), z)| (z * w_y[r] * w_x[c]).powi(2));
            let weights = (nx * ny) as f64 * mean_square(&w_x) * mean_square(&w_y);
            // Sums of a few hundred terms.
            assert!((found * weights / weighted.sum::<f64>() - 1.0).abs() < 1e-12);
            let (f, s) = along_rows(z.view(), 0.1, &w_x);
            let weighted = z.indexed_iter().map(|((_, c), z)| (z * w_x[c]).powi(2));
            let mean = weighted.sum::<f64>() / ((nx * ny) as f64 * mean_square(&w_x));
            // Sums of a few hundred terms, as above.
            assert!((s.iter().sum::<f64>() * f[1] / mean - 1.0).abs() < 1e-12);
        }
    }

    #[test]
    fn rings_are_means_and_an_empty_one_is_none() {
        let z = Array2::from_shape_fn((8, 8), |(_, c)| (PI * c as f64 / 2.0).cos());
        let density = Density::new(z.view(), [1.0, 1.0], [&[1.0; 8], &[1.0; 8]]);
        // Frequencies k / 8: the wave is at +-2 / 8 along x, S = (1/4) 64 in both bins.
        let rings = density.rings(3, |f| match f {
            0.0 => Some(0),
            f if f < 0.3 => Some(2),
            _ => Some(7),
        });
        assert_eq!(rings[1], None);
        let ring = rings[2].unwrap();
        // Bins with 0 < |f| < 0.3: 20 (radius 2.4 bins); two of them hold 16.
        assert!((ring.density - 2.0 * 16.0 / 20.0).abs() < 1e-12, "{ring:?}");
        // The square of the rounding of a sum of 64 terms.
        assert!(rings[0].unwrap().density < 1e-28);
    }

    #[test]
    fn the_transfer_of_a_gaussian_is_a_gaussian_and_falls_to_its_bins() {
        // Samples every 0.1 to 6 sigma: aliases are exp(-2 pi^2 sigma^2 (10 - f)^2), the cut tails 1e-8.
        let (sigma_x, sigma_y) = (0.8, 1.3);
        let at = |n: i32| (-n..=n).map(|i| 0.1 * f64::from(i)).collect::<Vec<f64>>();
        let (x, y) = (at(48), at(78));
        let kernel = Array2::from_shape_fn((y.len(), x.len()), |(r, c)| {
            3.0 * (-0.5 * ((x[c] / sigma_x).powi(2) + (y[r] / sigma_y).powi(2))).exp()
        });
        let (f_x, f_y) = ([-0.3, 0.0, 0.11, 0.5], [0.0, 0.2, -0.45]);
        // A kernel beside its centre has another phase, and the same size.
        let beside: Vec<f64> = x.iter().map(|x| x + 0.7).collect();
        let found = transfer(kernel.view(), [&beside, &y], [&f_x, &f_y]);
        for ((r, c), gain) in found.indexed_iter() {
            let power = (sigma_x * f_x[c]).powi(2) + (sigma_y * f_y[r]).powi(2);
            assert!((gain - (-2.0 * PI * PI * power).exp()).abs() < 1e-7, "{r} {c} {gain}");
        }
    }

    #[test]
    fn a_plane_has_no_density() {
        let (x, y): (Vec<f64>, Vec<f64>) =
            ((0..9).map(f64::from).collect(), (0..8).map(f64::from).collect());
        let z = Array2::from_shape_fn((8, 9), |(r, c)| 3.0 * x[c] - y[r] + 7.0);
        // Below: rounding of sums of 72 heights of some 30.
        assert!(without_plane(z.view(), &x, &y).iter().all(|z| z.abs() < 1e-12));
        assert!((without_mean(z.view()).sum()).abs() < 1e-12);
    }

    #[test]
    fn the_largest_rectangle_is_found_like_by_trying_all() {
        let mut rng = ChaCha8Rng::seed_from_u64(12);
        for _ in 0..40 {
            let (ny, nx) = (rng.random_range(1..8), rng.random_range(1..9));
            let flags = Array2::from_shape_simple_fn((ny, nx), || rng.random_range(0.0..1.0) < 0.7);
            let mut want = 0;
            for (r0, c0) in (0..ny).flat_map(|r| (0..nx).map(move |c| (r, c))) {
                for (r1, c1) in (r0..ny).flat_map(|r| (c0..nx).map(move |c| (r, c))) {
                    if flags.slice(s![r0..=r1, c0..=c1]).iter().all(|f| *f) {
                        want = want.max((r1 + 1 - r0) * (c1 + 1 - c0));
                    }
                }
            }
            let ((r, c), (h, w)) = largest_rectangle(&flags);
            assert_eq!(h * w, want, "{flags:?}");
            assert!(flags.slice(s![r..r + h, c..c + w]).iter().all(|f| *f));
        }
    }
}
