//! Statistics of a height map; NaN marks an invalid pixel and is skipped.

use std::borrow::Cow;

use ndarray::{Array2, ArrayView1, ArrayView2, s};
use rayon::prelude::*;

use crate::parallel;
use crate::vectors::vectorised;

/// RMS, PV and other statistics of the valid pixels of a map. Units are those of the map.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Statistics {
    /// Number of valid (not NaN) pixels.
    pub valid_count: usize,
    /// Arithmetic mean of the valid pixels.
    pub mean: f64,
    /// Population RMS of the valid pixels after removing their mean.
    pub rms: f64,
    /// Largest minus smallest valid value.
    pub pv: f64,
    /// Smallest valid value.
    pub min: f64,
    /// Largest valid value.
    pub max: f64,
}

/// Number of pixels that a thread takes at a time. Larger: less parallelism on small maps. Smaller:
/// more overhead. Sums are made part by part, so that this number also decides their rounding.
const PART: usize = 1 << 14;

/// Number of independent sums, each of every eighth pixel of a row. The processor adds them in one
/// vector. Larger: more sums than a vector has lanes. Smaller: idle lanes. It also decides the
/// rounding of a sum.
const SIDE_BY_SIDE: usize = 8;

/// Divides `map` into parts of neighbouring rows, of about [`PART`] pixels each. Returns the results of `evaluate` for
/// these parts, in order; it gets the index of the first row of a part, and the part.
fn by_parts<T: Send + Sync>(
    map: ArrayView2<f64>,
    evaluate: impl Fn(usize, ArrayView2<f64>) -> T + Sync,
) -> Vec<T> {
    let rows = (PART / map.ncols().max(1)).max(1);
    parallel::map(map.nrows().div_ceil(rows), &|part| {
        let from = part * rows;
        evaluate(from, map.slice(s![from..(from + rows).min(map.nrows()), ..]))
    })
}

/// Returns the pixels of a row as a slice, copied if they are not contiguous in memory.
#[inline(always)]
fn pixels(row: ArrayView1<'_, f64>) -> Cow<'_, [f64]> {
    row.to_slice().map_or_else(|| row.to_vec().into(), Cow::Borrowed)
}

/// Returns the sums of `terms(x, y, value)` over all valid pixels. `x` has a number for every column, `y` for
/// every row. The sums are made over parts of rows, and added in order: they are the same on any
/// number of threads.
fn sums<const N: usize>(
    map: ArrayView2<f64>,
    (x, y): (&[f64], &[f64]),
    terms: impl Fn(f64, f64, f64) -> [f64; N] + Sync,
) -> [f64; N] {
    let parts = by_parts(map, |first, map| {
        vectorised(
            #[inline(always)]
            || {
                let mut total = [0.0; N];
                for (row, y) in map.outer_iter().zip(&y[first..]) {
                    let mut sums = [[0.0; SIDE_BY_SIDE]; N];
                    let row = pixels(row);
                    let places = x.chunks(SIDE_BY_SIDE);
                    for (pixels, x) in row.chunks(SIDE_BY_SIDE).zip(places) {
                        if let (Ok(pixels), Ok(x)) = (pixels.try_into(), x.try_into()) {
                            add::<SIDE_BY_SIDE, N>(pixels, x, *y, &terms, &mut sums);
                        } else {
                            // The last pixels of a row, padded with NaN, which does not count.
                            let mut whole = [[f64::NAN; SIDE_BY_SIDE]; 2];
                            whole[0][..pixels.len()].copy_from_slice(pixels);
                            whole[1][..x.len()].copy_from_slice(x);
                            add(&whole[0], &whole[1], *y, &terms, &mut sums);
                        }
                    }
                    for (total, sums) in total.iter_mut().zip(sums) {
                        *total += sums.iter().sum::<f64>();
                    }
                }
                total
            },
        )
    });
    parts.into_iter().fold([0.0; N], |mut total, part| {
        total.iter_mut().zip(part).for_each(|(t, p)| *t += p);
        total
    })
}

/// Adds `terms_of(x, y, value)` of M neighbouring pixels of a row to `sums`, where pixel i of the M adds to the sums
/// with the index i. NaN adds nothing.
#[inline(always)]
fn add<const M: usize, const N: usize>(
    pixels: &[f64; M],
    x: &[f64; M],
    y: f64,
    terms_of: &impl Fn(f64, f64, f64) -> [f64; N],
    sums: &mut [[f64; M]; N],
) {
    for i in 0..M {
        let terms = terms_of(x[i], y, pixels[i]);
        for k in 0..N {
            sums[k][i] += if pixels[i].is_nan() { 0.0 } else { terms[k] };
        }
    }
}

/// Returns the sums of `terms(value)` over all valid pixels ([`sums`]).
fn sums_of_values<const N: usize>(
    map: ArrayView2<f64>,
    terms: impl Fn(f64) -> [f64; N] + Sync,
) -> [f64; N] {
    let nowhere = vec![0.0; map.nrows().max(map.ncols())];
    sums(
        map,
        (&nowhere[..map.ncols()], &nowhere),
        #[inline(always)]
        |_, _, v| terms(v),
    )
}

/// Returns the smallest and the largest of the valid pixels; infinity and minus infinity if there is none.
pub fn range(map: ArrayView2<f64>) -> (f64, f64) {
    let none = (f64::INFINITY, f64::NEG_INFINITY);
    let parts = by_parts(map, |_, map| {
        vectorised(
            #[inline(always)]
            || {
                let mut ends = [none; SIDE_BY_SIDE];
                for row in map.outer_iter() {
                    for pixels in pixels(row).chunks(SIDE_BY_SIDE) {
                        // No comparison with NaN is true.
                        for ((low, high), v) in ends.iter_mut().zip(pixels) {
                            *low = if v < low { *v } else { *low };
                            *high = if v > high { *v } else { *high };
                        }
                    }
                }
                ends
            },
        )
    });
    parts.into_iter().flatten().fold(none, |a, b| (a.0.min(b.0), a.1.max(b.1)))
}

/// Counts the valid (not NaN) pixels of a map.
pub fn valid_count(map: ArrayView2<f64>) -> usize {
    sums_of_values(
        map,
        #[inline(always)]
        |_| [1.0],
    )[0] as usize
}

/// Returns, for each number in `values`, the count of the valid pixels that are equal to it.
pub fn counts<const N: usize>(map: ArrayView2<f64>, values: [f64; N]) -> [usize; N] {
    let counts = sums_of_values(
        map,
        #[inline(always)]
        |v| values.map(|value| if v == value { 1.0 } else { 0.0 }),
    );
    counts.map(|n| n as usize)
}

/// Returns the sum of `value - level` over the valid pixels above `level`.
pub fn sum_above(map: ArrayView2<f64>, level: f64) -> f64 {
    let above = sums_of_values(
        map,
        #[inline(always)]
        |v| [if v > level { v - level } else { 0.0 }],
    );
    above[0]
}

/// Step between the rows that [`lowest`] samples for an upper bound of its result. Larger: a weaker bound, so that more
/// pixels are sorted. Smaller: more pixels are sampled. It does not change the result.
const ROWS_PER_LOOK: usize = 16;

/// Returns the lowest valid pixel after leaving out the lowest `fraction`, in [0, 1). If weights (ny, nx) are
/// given, only pixels with a `weight` > 0 count. `None` if no pixel counts.
pub fn lowest(map: ArrayView2<f64>, weight: Option<ArrayView2<f64>>, fraction: f64) -> Option<f64> {
    let rows = (0..map.nrows()).into_par_iter();
    let count = match weight {
        Some(_) => rows.clone().map(|r| counted(map, weight, r).count()).sum(),
        None => valid_count(map),
    };
    let rank = ((fraction * count as f64) as usize).min(count.checked_sub(1)?);
    // At least as many of all pixels as of the sampled ones are at or below this bound.
    let sampled = (0..map.nrows()).step_by(ROWS_PER_LOOK).flat_map(|r| counted(map, weight, r));
    let bound = ranked(sampled.collect(), rank).unwrap_or(f64::INFINITY);
    let low = rows.flat_map_iter(|r| counted(map, weight, r).filter(|v| *v <= bound));
    ranked(low.collect(), rank)
}

/// Returns the valid pixels of row r with a weight above 0. Without weights, returns all valid pixels of the row.
fn counted<'a>(
    map: ArrayView2<'a, f64>,
    weight: Option<ArrayView2<'a, f64>>,
    r: usize,
) -> impl Iterator<Item = f64> + use<'a> {
    let row = map.slice_move(s![r, ..]).into_iter().enumerate();
    row.filter(move |(c, v)| !v.is_nan() && weight.is_none_or(|w| w[[r, *c]] > 0.0))
        .map(|(_, v)| *v)
}

/// Returns the value that has `rank` lower ones among `values`; `None` if there are too few values.
fn ranked(mut values: Vec<f64>, rank: usize) -> Option<f64> {
    if rank >= values.len() {
        return None;
    }
    Some(*values.select_nth_unstable_by(rank, f64::total_cmp).1)
}

/// Returns the statistics of the valid pixels of a map; `None` if there are none.
pub fn statistics(map: ArrayView2<f64>) -> Option<Statistics> {
    let [n, sum] = sums_of_values(
        map,
        #[inline(always)]
        |v| [1.0, v],
    );
    if n == 0.0 {
        return None;
    }
    let mean = sum / n;
    // Two passes: sum (z - mean)^2 keeps its digits when the mean is large.
    let [squares] = sums_of_values(
        map,
        #[inline(always)]
        |v| [(v - mean) * (v - mean)],
    );
    let (min, max) = range(map);
    let rms = (squares / n).sqrt();
    Some(Statistics { valid_count: n as usize, mean, rms, pv: max - min, min, max })
}

/// Least-squares plane `z = a + b x + c y` through the valid pixels.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Plane {
    /// Value of the plane at the coordinate origin, in the unit of the map.
    pub a: f64,
    /// Slope along x, in the unit of the map per unit of the coordinates.
    pub b: f64,
    /// Slope along y, in the unit of the map per unit of the coordinates.
    pub c: f64,
}

/// Fits a plane to the valid pixels of `map` (ny, nx) at the coordinates `x` (nx), `y` (ny).
///
/// `None` if the valid pixels do not define a plane: fewer than three, or all on one line.
///
/// The coordinates are centred on the valid pixels and scaled to [-1, 1] before the 2 x 2 normal
/// equations are solved. The condition number therefore depends on the mask, not on the units.
pub fn fit_plane(map: ArrayView2<f64>, x: &[f64], y: &[f64]) -> Option<Plane> {
    let [n, x_sum, y_sum, z_sum] = sums(
        map,
        (x, y),
        #[inline(always)]
        |x, y, v| [1.0, x, y, v],
    );
    if n == 0.0 {
        return None;
    }
    let [x_mean, y_mean, z_mean] = [x_sum, y_sum, z_sum].map(|sum| sum / n);
    let x_scale = x.iter().fold(0.0_f64, |m, v| m.max((v - x_mean).abs())).max(f64::MIN_POSITIVE);
    let y_scale = y.iter().fold(0.0_f64, |m, v| m.max((v - y_mean).abs())).max(f64::MIN_POSITIVE);
    let [xx, xy, yy, xz, yz] = sums(
        map,
        (&scaled(x, x_mean, x_scale), &scaled(y, y_mean, y_scale)),
        #[inline(always)]
        |u, w, v| {
            let z = v - z_mean;
            [u * u, u * w, w * w, u * z, w * z]
        },
    );
    // [xx xy; xy yy] [b; c] = [xz; yz]
    let determinant = xx * yy - xy * xy;
    // Collinear pixels: the determinant is negligible against the product of the diagonal.
    if determinant <= 1e-10 * xx * yy || determinant <= 0.0 {
        return None;
    }
    let b = (xz * yy - yz * xy) / determinant / x_scale;
    let c = (yz * xx - xz * xy) / determinant / y_scale;
    Some(Plane { a: z_mean - b * x_mean - c * y_mean, b, c })
}

/// Returns `(coordinate - mean) / scale` for every coordinate.
fn scaled(coordinates: &[f64], mean: f64, scale: f64) -> Vec<f64> {
    coordinates.iter().map(|v| (v - mean) / scale).collect()
}

/// Returns `map` (ny, nx) minus `plane` at the coordinates `x` (nx) and `y` (ny); NaN stays NaN.
pub fn subtract_plane(map: ArrayView2<f64>, x: &[f64], y: &[f64], plane: Plane) -> Array2<f64> {
    let mut out = map.to_owned();
    for ((r, c), v) in out.indexed_iter_mut() {
        *v -= plane.a + plane.b * x[c] + plane.c * y[r];
    }
    out
}

/// Returns the population RMS of `map` after removing its least-squares plane over the coordinates `x` (nx) and `y`
/// (ny). If the valid pixels define no plane, only the mean is removed. `None` if there are no valid pixels.
pub fn detilted_rms(map: ArrayView2<f64>, x: &[f64], y: &[f64]) -> Option<f64> {
    let Some(plane) = fit_plane(map, x, y) else { return statistics(map).map(|s| s.rms) };
    // The mean of the remainder is zero but for rounding.
    let [n, squares] = sums(
        map,
        (x, y),
        #[inline(always)]
        |x, y, v| {
            let left = v - (plane.a + plane.b * x + plane.c * y);
            [1.0, left * left]
        },
    );
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
    fn sums_are_those_of_every_valid_pixel_whatever_the_width_and_the_order_in_memory() {
        for (ny, nx) in [(1, 1), (3, 8), (7, 13), (300, 71)] {
            let map = Array2::from_shape_fn((ny, nx), |(r, c)| {
                if (3 * r + c) % 7 == 2 { f64::NAN } else { ((5 * r + 11 * c) % 23) as f64 - 7.0 }
            });
            for map in [map.view(), map.t()] {
                let valid: Vec<f64> = map.iter().copied().filter(|v| !v.is_nan()).collect();
                let s = statistics(map).unwrap();
                // Sums of integers are exact. The squares of the remainder round.
                let mean = valid.iter().sum::<f64>() / valid.len() as f64;
                let squares: f64 = valid.iter().map(|v| (v - mean).powi(2)).sum();
                assert_eq!((s.valid_count, s.mean), (valid.len(), mean));
                // Rounding of sums of up to 2e4 squares in another order.
                assert!((s.rms.powi(2) * valid.len() as f64 - squares).abs() <= 1e-13 * squares);
                assert_eq!(s.min, valid.iter().copied().fold(f64::INFINITY, f64::min));
                assert_eq!(s.max, valid.iter().copied().fold(f64::NEG_INFINITY, f64::max));
                let above = valid.iter().map(|v| (v - 3.0).max(0.0)).sum::<f64>();
                assert_eq!(sum_above(map, 3.0), above);
            }
        }
    }

    #[test]
    fn the_lowest_but_for_a_fraction_is_that_of_a_sorted_list() {
        // 100 x 41 pixels, one in five invalid, a third without weight; values repeat
        let value = |r: usize, c: usize| ((37 * r + 91 * c) % 257) as f64 - 128.0;
        let map = Array2::from_shape_fn((100, 41), |(r, c)| {
            if (r + 2 * c) % 5 == 0 { f64::NAN } else { value(r, c) }
        });
        let weight = Array2::from_shape_fn(map.dim(), |(r, c)| ((r * 3 + c) % 3) as f64);
        for weight in [None, Some(weight.view())] {
            let mut sorted: Vec<f64> = (map.indexed_iter())
                .filter(|(at, v)| !v.is_nan() && weight.is_none_or(|w| w[*at] > 0.0))
                .map(|(_, v)| *v)
                .collect();
            sorted.sort_by(f64::total_cmp);
            for fraction in [0.0, 1e-3, 0.01, 0.3, 0.999] {
                let rank = (fraction * sorted.len() as f64) as usize;
                assert_eq!(lowest(map.view(), weight, fraction), Some(sorted[rank]), "{fraction}");
            }
        }
        assert_eq!(lowest(array![[f64::NAN]].view(), None, 0.0), None);
        assert_eq!(lowest(array![[1.0]].view(), Some(array![[0.0]].view()), 0.0), None);
        assert_eq!(counts(array![[1.0, f64::NAN], [2.0, 1.0]].view(), [1.0, 3.0]), [2, 0]);
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
        // Heights of 500 have rounding of 1e-13, over sides of 4 and 6.
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
