//! Statistics of a height map; NaN marks an invalid pixel and is skipped.

use ndarray::{Array2, ArrayView2, Axis};
use rayon::prelude::*;

/// RMS, PV and friends of the valid pixels of a map. Units are those of the map.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Statistics {
    /// Number of valid (not NaN) pixels.
    pub valid_count: usize,
    /// Arithmetic mean.
    pub mean: f64,
    /// Population RMS after removing the mean.
    pub rms: f64,
    /// Largest minus smallest value.
    pub pv: f64,
    /// Smallest value.
    pub min: f64,
    /// Largest value.
    pub max: f64,
}

/// Elements whose sums are made on one thread.
const PART: usize = 1 << 14;

/// Sums of what `of` makes of (row, column, value) of every valid pixel: parts of rows, then their sums in
/// order, the same on any number of threads.
fn sums<const N: usize>(
    map: ArrayView2<f64>,
    of: impl Fn(usize, usize, f64) -> [f64; N] + Sync,
) -> [f64; N] {
    let rows = (PART / map.ncols().max(1)).max(1);
    let parts: Vec<[f64; N]> = map
        .axis_chunks_iter(Axis(0), rows)
        .into_par_iter()
        .enumerate()
        .map(|(part, map)| {
            let mut total = [0.0; N];
            for (r, line) in map.outer_iter().enumerate() {
                let mut sums = [0.0; N];
                for (c, v) in line.iter().enumerate().filter(|(_, v)| !v.is_nan()) {
                    add(&mut sums, of(part * rows + r, c, *v));
                }
                add(&mut total, sums);
            }
            total
        })
        .collect();
    parts.into_iter().fold([0.0; N], |mut total, part| {
        add(&mut total, part);
        total
    })
}

fn add<const N: usize>(total: &mut [f64; N], part: [f64; N]) {
    total.iter_mut().zip(part).for_each(|(t, p)| *t += p);
}

/// Smallest and largest of the valid pixels.
fn range(map: ArrayView2<f64>) -> (f64, f64) {
    // min and max pass over NaN
    let of = |map: ArrayView2<f64>| {
        let least = map.iter().copied().fold(f64::INFINITY, f64::min);
        (least, map.iter().copied().fold(f64::NEG_INFINITY, f64::max))
    };
    let rows = (PART / map.ncols().max(1)).max(1);
    map.axis_chunks_iter(Axis(0), rows)
        .into_par_iter()
        .map(of)
        .reduce(|| (f64::INFINITY, f64::NEG_INFINITY), |a, b| (a.0.min(b.0), a.1.max(b.1)))
}

/// Statistics of the valid pixels; `None` when there are none.
pub fn statistics(map: ArrayView2<f64>) -> Option<Statistics> {
    let [n, sum] = sums(map, |_, _, v| [1.0, v]);
    if n == 0.0 {
        return None;
    }
    let mean = sum / n;
    // Two passes: sum (z - mean)^2 keeps its digits when the mean is large.
    let [squares] = sums(map, |_, _, v| [(v - mean).powi(2)]);
    let (min, max) = range(map);
    let rms = (squares / n).sqrt();
    Some(Statistics { valid_count: n as usize, mean, rms, pv: max - min, min, max })
}

/// Least-squares plane `z = a + b x + c y` through the valid pixels.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Plane {
    /// Height at the coordinate origin.
    pub a: f64,
    /// Slope along x.
    pub b: f64,
    /// Slope along y.
    pub c: f64,
}

/// Fits a plane to the valid pixels of `map` (ny, nx) at the coordinates `x` (nx), `y` (ny).
///
/// `None` when the valid pixels do not define one: fewer than three, or all on one line.
///
/// The coordinates are centred on the valid pixels and scaled to [-1, 1] before the 2 x 2
/// normal equations are solved, so the condition number is that of the mask, not of the units.
pub fn fit_plane(map: ArrayView2<f64>, x: &[f64], y: &[f64]) -> Option<Plane> {
    let [n, x_sum, y_sum, z_sum] = sums(map, |r, c, v| [1.0, x[c], y[r], v]);
    if n == 0.0 {
        return None;
    }
    let [x_mean, y_mean, z_mean] = [x_sum, y_sum, z_sum].map(|sum| sum / n);
    let x_scale = x.iter().fold(0.0_f64, |m, v| m.max((v - x_mean).abs())).max(f64::MIN_POSITIVE);
    let y_scale = y.iter().fold(0.0_f64, |m, v| m.max((v - y_mean).abs())).max(f64::MIN_POSITIVE);
    let [xx, xy, yy, xz, yz] = sums(map, |r, c, v| {
        let (u, w, z) = ((x[c] - x_mean) / x_scale, (y[r] - y_mean) / y_scale, v - z_mean);
        [u * u, u * w, w * w, u * z, w * z]
    });
    // [xx xy; xy yy] [b; c] = [xz; yz]
    let determinant = xx * yy - xy * xy;
    // Collinear pixels: the determinant vanishes against the product of the diagonal.
    if determinant <= 1e-10 * xx * yy || determinant <= 0.0 {
        return None;
    }
    let b = (xz * yy - yz * xy) / determinant / x_scale;
    let c = (yz * xx - xz * xy) / determinant / y_scale;
    Some(Plane { a: z_mean - b * x_mean - c * y_mean, b, c })
}

/// `map` minus `plane`; NaN stays NaN.
pub fn subtract_plane(map: ArrayView2<f64>, x: &[f64], y: &[f64], plane: Plane) -> Array2<f64> {
    let mut out = map.to_owned();
    for ((r, c), v) in out.indexed_iter_mut() {
        *v -= plane.a + plane.b * x[c] + plane.c * y[r];
    }
    out
}

/// Population RMS after removing the least-squares plane; falls back to the mean-removed RMS
/// where the valid pixels do not define a plane. `None` without valid pixels.
pub fn detilted_rms(map: ArrayView2<f64>, x: &[f64], y: &[f64]) -> Option<f64> {
    let Some(plane) = fit_plane(map, x, y) else { return statistics(map).map(|s| s.rms) };
    // The mean of what is left is zero but for rounding.
    let [n, squares] = sums(map, |r, c, v| {
        let left = v - (plane.a + plane.b * x[c] + plane.c * y[r]);
        [1.0, left * left]
    });
    Some((squares / n).sqrt())
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::array;

    #[test]
    fn rms_is_the_population_rms_about_the_mean_and_skips_nan() {
        let s = statistics(array![[1.0, f64::NAN], [3.0, 5.0]].view()).unwrap();
        // mean 3, squares 4 + 0 + 4 over n = 3 (not n - 1).
        assert!((s.rms - (8.0_f64 / 3.0).sqrt()).abs() < 1e-15);
        assert_eq!((s.valid_count, s.mean, s.pv), (3, 3.0, 4.0));
        assert!(statistics(array![[f64::NAN]].view()).is_none());
    }

    #[test]
    fn a_plane_is_recovered_on_a_masked_map_far_from_the_origin() {
        let x: Vec<f64> = (0..40).map(|i| 1000.0 + 0.1 * f64::from(i)).collect();
        let y: Vec<f64> = (0..30).map(|i| -500.0 + 0.2 * f64::from(i)).collect();
        let mut map = Array2::from_shape_fn((30, 40), |(r, c)| 7.0 + 0.03 * x[c] - 0.5 * y[r]);
        for r in 0..10 {
            for c in 0..(10 - r) {
                map[[r, c]] = f64::NAN;
            }
        }
        let p = fit_plane(map.view(), &x, &y).unwrap();
        assert!((p.b - 0.03).abs() < 1e-12 && (p.c + 0.5).abs() < 1e-12, "{p:?}");
        // Heights of 300 carry rounding of about 1e-13; the fit may add one digit.
        assert!(detilted_rms(map.view(), &x, &y).unwrap() < 1e-11);
    }

    #[test]
    fn collinear_pixels_define_no_plane() {
        let x = [0.0, 1.0, 2.0];
        let map = array![[1.0, 2.0, 4.0], [f64::NAN, f64::NAN, f64::NAN]];
        assert!(fit_plane(map.view(), &x, &[0.0, 1.0]).is_none());
    }
}
