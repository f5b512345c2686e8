//! Separable cubic convolution (Keys, 1981) on a uniform lattice.
//!
//! The interpolant of samples `g[m]`, m = 0..n-1, at the lattice coordinate `s` is
//!
//! ```text
//! K(s) = sum_{d=-1}^{2} w_d(f) g[i + d],   i = floor(s),  f = s - i
//! ```
//!
//! with Keys' weights for a = -1/2. The two nodes that the formula needs beyond the
//! samples are quadratic continuations of the three nearest ones,
//!
//! ```text
//! g[-1] = 3 g[0] - 3 g[1] + g[2],   g[n] = 3 g[n-1] - 3 g[n-2] + g[n-3]
//! ```
//!
//! so that every quadratic is reproduced exactly in every cell, the first and the last
//! included.
//!
//! Source: R. Keys, IEEE Trans. Acoust. Speech Signal Process. 29 (1981) 1153, Eqs 15, 19, 25.

use ndarray::{Array2, ArrayView2, s};

/// Returns Keys' weights `[w_-1, w_0, w_1, w_2]` at the offset `f` in [0, 1], in steps, from the node with the weight
/// w_0.
#[inline]
pub fn weights(f: f64) -> [f64; 4] {
    [
        ((-0.5 * f + 1.0) * f - 0.5) * f,
        (1.5 * f - 2.5) * f * f + 1.0,
        ((-1.5 * f + 2.0) * f + 0.5) * f,
        (0.5 * f - 0.5) * f * f,
    ]
}

/// Returns the means of Keys' four weights over a set of offsets f, from `[f, f^2, f^3]`: the means of their powers
/// over the set.
#[inline]
pub fn mean_weights([f, f2, f3]: [f64; 3]) -> [f64; 4] {
    [f2 - 0.5 * (f3 + f), 1.0 + 1.5 * f3 - 2.5 * f2, 2.0 * f2 - 1.5 * f3 + 0.5 * f, 0.5 * (f3 - f2)]
}

/// Returns `samples` (ny, nx) with one more node, called ghost node, on every side: (ny+2, nx+2). Ghost nodes continue
/// the samples quadratically, as the module says.
///
/// An axis with fewer than three samples continues with the highest order that it has: linear for
/// two samples, constant for one.
pub fn with_ghosts(samples: ArrayView2<f64>) -> Array2<f64> {
    let (ny, nx) = samples.dim();
    let mut g = Array2::zeros((ny + 2, nx + 2));
    g.slice_mut(s![1..=ny, 1..=nx]).assign(&samples);
    for r in 1..=ny {
        g[[r, 0]] = continuation(nx, |k| g[[r, 1 + k]]);
        g[[r, nx + 1]] = continuation(nx, |k| g[[r, nx - k]]);
    }
    for c in 0..nx + 2 {
        g[[0, c]] = continuation(ny, |k| g[[1 + k, c]]);
        g[[ny + 1, c]] = continuation(ny, |k| g[[ny - k, c]]);
    }
    g
}

/// Returns the ghost node before `node(0)`. `node(k)`, k < n, are the samples from the border inwards.
fn continuation(n: usize, node: impl Fn(usize) -> f64) -> f64 {
    match n {
        1 => node(0),
        2 => 2.0 * node(0) - node(1),
        _ => 3.0 * node(0) - 3.0 * node(1) + node(2),
    }
}

/// Largest distance of a lattice coordinate from an integer at which it counts as that integer, in
/// steps.
///
/// The interpolated field may jump to zero at its last node. Without this tolerance, rounding in
/// `(x - x0) / h` would decide whether a point on the border belongs to it. Larger: lateral
/// accuracy is lost. Smaller: rounding decides again; it is about 1e-12 for coordinates of 1e4
/// steps.
pub const SNAP: f64 = 1e-9;

/// Returns the lattice cell (the index of the node below) and the offset in [0, 1) of the coordinate `s`, in steps. A
/// coordinate within [`SNAP`] of a node is moved to it.
#[inline]
pub fn split(s: f64) -> (isize, f64) {
    // floor, without a call where the processor that is compiled for has no instruction for it
    let truncated = s as isize;
    let floor = truncated - isize::from(truncated as f64 > s);
    let f = s - floor as f64;
    if f <= SNAP {
        (floor, 0.0)
    } else if 1.0 - f <= SNAP {
        (floor + 1, 0.0)
    } else {
        (floor, f)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Interpolates a function that is sampled at 0, 1, .. n-1 at the coordinate s, through `with_ghosts`.
    fn interpolate(f: impl Fn(f64) -> f64, n: usize, s: f64) -> f64 {
        let samples = Array2::from_shape_fn((1, n), |(_, c)| f(c as f64));
        let g = with_ghosts(samples.view());
        let (i, t) = split(s);
        let i = i.clamp(0, n as isize - 2);
        let t = if s > i as f64 { s - i as f64 } else { t };
        let w = weights(t);
        (0..4).map(|d| w[d] * g[[1, (i as usize) + d]]).sum()
    }

    #[test]
    fn quadratics_are_exact_in_every_cell() {
        let q = |x: f64| 0.3 - 1.7 * x + 0.45 * x * x;
        for n in [3usize, 4, 7] {
            for k in 0..=10 * (n as u32 - 1) {
                let s = f64::from(k) / 10.0;
                // Rounding of values up to ~20.
                assert!((interpolate(q, n, s) - q(s)).abs() < 1e-13, "n {n} s {s}");
            }
        }
    }

    #[test]
    fn means_of_weights_are_those_of_powers() {
        let offsets = [0.0, 0.25, 0.6, 1.0];
        let mean = |of: &dyn Fn(f64) -> f64| offsets.iter().map(|f| of(*f)).sum::<f64>() / 4.0;
        let found = mean_weights([1, 2, 3].map(|k| mean(&|f| f.powi(k))));
        for (d, found) in found.into_iter().enumerate() {
            // Rounding of sums of numbers up to 2.
            assert!((found - mean(&|f| weights(f)[d])).abs() < 1e-15, "{d}");
        }
    }

    #[test]
    fn error_of_a_smooth_function_falls_with_the_third_power_of_the_step() {
        let worst = |h: f64| {
            (0..200)
                .map(|k| 1.0 + f64::from(k) / 100.37)
                .map(|x| {
                    (interpolate(|s| (s * h).sin(), (4.0 / h) as usize, x / h) - x.sin()).abs()
                })
                .fold(0.0, f64::max)
        };
        let order = (worst(0.2) / worst(0.1)).log2();
        // The order is 3; at steps of 0.1 and 0.2 the next order takes a part of it.
        assert!(order > 2.8, "order {order}");
    }

    #[test]
    fn weights_sum_to_one_and_are_symmetric() {
        for k in 0..=20 {
            let f = f64::from(k) / 20.0;
            let (w, m) = (weights(f), weights(1.0 - f));
            // Below: rounding of four weights up to 1.
            assert!((w.iter().sum::<f64>() - 1.0).abs() < 1e-15);
            for d in 0..4 {
                assert!((w[d] - m[3 - d]).abs() < 1e-15);
            }
        }
    }

    #[test]
    fn split_snaps_to_nodes_and_floors_negatives() {
        assert_eq!(split(2.0 + 1e-12), (2, 0.0));
        assert_eq!(split(2.0 - 1e-12), (2, 0.0));
        assert_eq!(split(-0.25).0, -1);
        // Rounding.
        assert!((split(-0.25).1 - 0.75).abs() < 1e-15);
    }
}
