//! Shift of a test piece between the maps before and after its spot, from the structure outside the spot.
//!
//! ```text
//! e(p) = before(p) - after(p + d) - (a + b x + c y),     sum_outside (h, 1, x, y)' e(p) = 0
//! ```
//!
//! Interpolation averages the noise of `after`, most in the middle between pixels. Least squares would
//! therefore be biased to half a pixel wherever the noise is larger than the slope per pixel. h is the slope of
//! `before` over a window about p. Its weights are odd, and the correlation of the noise is even, so h does not
//! correlate with the noise of e at p: it is an instrumental variable. The equations therefore hold at the true
//! shift, whatever the interpolation does to the noise, white or correlated.
//!
//! With H and G the rows of (h, 1, x, y) and (grad after, 1, x, y), and C the covariance of e,
//!
//! ```text
//! step = (H'G)^-1 H' e,     covariance = (H'G)^-1 H'C H (G'H)^-1
//! C(l) = w(l) / N(l) sum_p e(p) e(p + l)
//! ```
//!
//! A small window keeps fine structure, a large one averages more of the noise. The program takes the window
//! of the least covariance with C = 1. w is 1 up to half of a radius L and falls to 0 at L as a cosine. L is the first
//! radius of at least 5 correlation lengths (Madras and Sokal's automatic window), so the standard error holds for
//! noise that is correlated over some pixels.
//!
//! | symbol | variable | shape | unit |
//! |---|---|---|---|
//! | d | `d`, `px` | (2) | pixel |
//! | h | `slopes` | 2 x (ny, nx) | nm per pixel |
//! | H, G | `of_h`, `of_g` | (pixels, 5) | nm per pixel, 1 |
//! | C | `kept`: C w | (lags) | nm^2 |

use std::f64::consts::PI;

use nalgebra::{Matrix5, Vector5};
use ndarray::{Array2, s};
use planish_numerics::keys;
use planish_types::{Grid, Invalid, Surface};

/// Largest number of Gauss-Newton steps; the alignment is refused if it needs more. Larger: more time on
/// maps that do not align. Smaller: refuses maps that align slowly.
const MOST_STEPS: usize = 50;

/// Step of the shift, pixels, below which the maps are aligned. Larger: the shift is off by up to this
/// step. Smaller: more steps, without a visible gain. Chosen: far below 1e-4 of a pixel, which moves the
/// steepest spot by less than its noise.
const TOLERANCE: f64 = 1e-6;

/// Number of steps after which the set of pixels that are compared stays the same. Larger: more steps in
/// which pixels enter and leave, which keeps the steps from ending. Smaller: the pixels belong to a shift
/// that is farther from the final one.
const FREE_STEPS: usize = 6;

/// Largest standard error of the shift, pixels; a larger one is refused. Larger: accepts shifts that the
/// maps barely determine. Smaller: refuses more maps. Chosen: such a structure has slopes so small that a
/// shift by its standard error changes the removal by less than its noise.
const MOST_ERROR_PIXELS: f64 = 1.0;

/// Half sizes of the windows in which the slope is measured, pixels: along the slope and across it. More: more time.
/// Fewer: a window that is farther from the best one. Chosen: each has about four times the pixels of the one before.
const WINDOWS: [[usize; 2]; 5] = [[1, 0], [1, 1], [2, 2], [4, 4], [8, 8]];

/// Radius of the window of the noise correlation in correlation lengths; the constant below is the largest radius,
/// pixels. Larger: lags that have noise and no signal. Smaller: a part of the correlation is cut off, and standard
/// errors are too small. Chosen: a Gaussian correlation has 0.2 % of its integral beyond the flat part.
const WINDOW_OVER_LENGTH: f64 = 5.0;
const LARGEST_LAG: isize = 16;

/// Number of pixels above which only a part of them is used for the noise correlation. Larger: more time on large maps.
/// Smaller: a less certain standard error. Chosen: a tenth of a second.
const MOST_IN_CORRELATION: usize = 20_000;

/// Shift of `after` against `before`, (x, y) in pixels, with its standard error and the number of steps.
#[derive(Default)]
pub(crate) struct Shift {
    /// Shift along x and y, pixels.
    pub px: [f64; 2],
    /// Standard error of the shift along x and y, pixels.
    pub error_px: [f64; 2],
    /// Number of Gauss-Newton steps of the alignment.
    pub steps: usize,
}

/// Returns `map` interpolated at every pixel moved by `d` pixels (x, y), and its slopes along x and y, nm per pixel.
/// NaN where a pixel that is needed is invalid or beyond the map.
pub(crate) fn shifted(map: &Array2<f64>, d: [f64; 2]) -> (Array2<f64>, [Array2<f64>; 2]) {
    let (ny, nx) = map.dim();
    let [(ix, fx), (iy, fy)] = d.map(|d| (d.floor() as isize, d - d.floor()));
    let [wx, wy] = [fx, fy].map(keys::weights);
    // Derivatives of Keys' weights: central differences with 1e-4 of a pixel. They only direct the steps of
    // the alignment.
    let [sx, sy] = [fx, fy].map(|f| {
        let up = keys::weights(f + 1e-4);
        let down = keys::weights(f - 1e-4);
        [0, 1, 2, 3].map(|k| (up[k] - down[k]) / 2e-4)
    });
    // K = sum_b w_b(fy) sum_a w_a(fx) g[r + b, c + a]; a weight 0 needs no pixel.
    let sum = |wy: [f64; 4], wx: [f64; 4]| {
        Array2::from_shape_fn((ny, nx), |(r, c)| {
            let mut total = 0.0;
            for (b, wb) in wy.iter().enumerate().filter(|(_, w)| **w != 0.0) {
                for (a, wa) in wx.iter().enumerate().filter(|(_, w)| **w != 0.0) {
                    let row = r.checked_add_signed(iy - 1 + b as isize);
                    let column = c.checked_add_signed(ix - 1 + a as isize);
                    let value = row.zip(column).and_then(|pixel| map.get(pixel));
                    total += wb * wa * value.copied().unwrap_or(f64::NAN);
                }
            }
            total
        })
    };
    (sum(wy, wx), [sum(wy, sx), sum(sy, wx)])
}

/// Returns the slopes of a map along x and y, nm per pixel: those of the least-squares plane over a window with these
/// half sizes, pixels, along the slope and across it. NaN where the window reaches an invalid pixel or beyond the map.
fn slopes(map: &Array2<f64>, [along, across]: [usize; 2]) -> [Array2<f64>; 2] {
    let odd: Vec<f64> = (0..=2 * along).map(|k| k as f64 - along as f64).collect();
    let squares: f64 = odd.iter().map(|k| k * k).sum();
    let odd: Vec<f64> = odd.iter().map(|k| k / squares).collect();
    let even = vec![1.0 / (2 * across + 1) as f64; 2 * across + 1];
    [(&odd, &even), (&even, &odd)].map(|(in_rows, in_columns)| {
        let columns = turned(weighted_in_rows(map, in_rows));
        turned(weighted_in_rows(&columns, in_columns))
    })
}

/// Returns weighted sums over a window along the rows of `map`; NaN where the window reaches an invalid pixel or beyond
/// the map.
fn weighted_in_rows(map: &Array2<f64>, weights: &[f64]) -> Array2<f64> {
    let (ny, nx) = map.dim();
    let half = weights.len() / 2;
    Array2::from_shape_fn((ny, nx), |(r, c)| {
        if c < half || c + half >= nx {
            return f64::NAN;
        }
        let window = map.slice(s![r, c - half..=c + half]);
        window.iter().zip(weights).map(|(v, w)| v * w).sum()
    })
}

fn turned(map: Array2<f64>) -> Array2<f64> {
    map.reversed_axes().as_standard_layout().into_owned()
}

/// Returns the pixels (row, column) outside the spot where the `slopes` of `before` are known, with these slopes along
/// [x, y]. Around each, `after` is valid wherever a shift within a pixel of `d` (pixels) looks.
fn pixels_for_shift(
    slopes: &[Array2<f64>; 2],
    after: &Array2<f64>,
    outside: &Array2<bool>,
    d: [f64; 2],
) -> Vec<([usize; 2], [f64; 2])> {
    let (ny, nx) = outside.dim();
    let [dx, dy] = d.map(|d| d.round() as isize);
    let mut pixels = Vec::new();
    for ((r, c), _) in outside.indexed_iter().filter(|(_, outside)| **outside) {
        let h = [slopes[0][[r, c]], slopes[1][[r, c]]];
        let (to_r, to_c) = (r as isize + dy, c as isize + dx);
        let is_inside = to_r >= 2 && to_c >= 2 && to_r + 2 < ny as isize && to_c + 2 < nx as isize;
        if h.iter().any(|h| h.is_nan()) || !is_inside {
            continue;
        }
        let (to_r, to_c) = (to_r as usize, to_c as usize);
        let around = after.slice(s![to_r - 2..=to_r + 2, to_c - 2..=to_c + 2]);
        if around.iter().all(|v| !v.is_nan()) {
            pixels.push(([r, c], h));
        }
    }
    pixels
}

/// Terms of the equations for the shift at one pixel; the symbols are those of the module.
struct ShiftEquation {
    pixel: [usize; 2],
    /// Coordinates of the pixel, scaled to -1 .. 1 over the map.
    place: [f64; 2],
    h: [f64; 2],
    g: [f64; 2],
    e: f64,
}

impl ShiftEquation {
    /// Returns the row (h, 1, x, y) of the matrix H of the module.
    fn h_row(&self) -> Vector5<f64> {
        Vector5::new(self.h[0], self.h[1], 1.0, self.place[0], self.place[1])
    }
    /// Returns the row (grad after, 1, x, y) of the matrix G of the module.
    fn g_row(&self) -> Vector5<f64> {
        Vector5::new(self.g[0], self.g[1], 1.0, self.place[0], self.place[1])
    }
}

/// Returns the terms of the equations at the pixels `used`, with `after` moved by `d` pixels [x, y]; pixels where
/// `after` is unknown there are left out.
fn rows(
    before: &Array2<f64>,
    after: &Array2<f64>,
    used: &[([usize; 2], [f64; 2])],
    d: [f64; 2],
) -> Vec<ShiftEquation> {
    let (moved, [gx, gy]) = shifted(after, d);
    let (ny, nx) = before.dim();
    let rows = used.iter().map(|(pixel, h)| {
        let [r, c] = *pixel;
        // e = before - after(p + d) = gx dx + gy dy + a + b x + c y at the next step
        let e = before[[r, c]] - moved[[r, c]];
        let g = [gx[[r, c]], gy[[r, c]]];
        let place = [2.0 * c as f64 / nx as f64 - 1.0, 2.0 * r as f64 / ny as f64 - 1.0];
        ShiftEquation { pixel: *pixel, place, h: *h, g, e }
    });
    rows.filter(|row| !row.e.is_nan() && row.g.iter().all(|v| !v.is_nan())).collect()
}

/// Returns the matrix (H'G)^-1 of the module; `None` if H'G is singular, because the maps have no structure to align
/// by.
fn inverse(rows: &[ShiftEquation]) -> Option<Matrix5<f64>> {
    rows.iter().map(|r| r.h_row() * r.g_row().transpose()).sum::<Matrix5<f64>>().try_inverse()
}

/// Returns the slopes of `before` over the window that gives the least covariance of the shift for white noise; `None`
/// if no window determines the shift.
fn best_slopes(
    before: &Array2<f64>,
    after: &Array2<f64>,
    outside: &Array2<bool>,
) -> Option<[Array2<f64>; 2]> {
    let all = WINDOWS.iter().filter_map(|window| {
        let slopes = slopes(before, *window);
        let rows =
            rows(before, after, &pixels_for_shift(&slopes, after, outside, [0.0; 2]), [0.0; 2]);
        let inverse = inverse(&rows).filter(|_| rows.len() > 5)?;
        let instruments: Matrix5<f64> =
            rows.iter().map(|r| r.h_row() * r.h_row().transpose()).sum();
        let covariance = inverse * instruments * inverse.transpose();
        Some((covariance[(0, 0)] + covariance[(1, 1)], slopes))
    });
    all.filter(|(v, _)| v.is_finite()).min_by(|a, b| a.0.total_cmp(&b.0)).map(|(_, slopes)| slopes)
}

/// Returns the matrix H'C H of the module, with the correlation of the residual e after the step `change`. `shape` is
/// that of the map.
fn squares(rows: &[ShiftEquation], shape: (usize, usize), change: &Vector5<f64>) -> Matrix5<f64> {
    let mut row_at = Array2::from_elem(shape, usize::MAX);
    for (k, row) in rows.iter().enumerate() {
        row_at[row.pixel] = k;
    }
    let left: Vec<f64> = rows.iter().map(|row| row.e - row.g_row().dot(change)).collect();
    let step = rows.len().div_ceil(MOST_IN_CORRELATION);
    // C(l), and sum_p h(p) h(p + l)' of every pixel, for one of the lags l and -l
    let correlation = |[dr, dc]: [isize; 2]| {
        let mut product = 0.0;
        let mut count = 0.0;
        let mut both = Matrix5::<f64>::zeros();
        for (k, row) in rows.iter().enumerate().step_by(step) {
            let [r, c] = [row.pixel[0] as isize + dr, row.pixel[1] as isize + dc];
            if r < 0 || c < 0 || r >= shape.0 as isize || c >= shape.1 as isize {
                continue;
            }
            let Some(other) = rows.get(row_at[[r as usize, c as usize]]) else { continue };
            product += left[k] * left[row_at[[r as usize, c as usize]]];
            both += row.h_row() * other.h_row().transpose();
            count += 1.0;
        }
        (product / f64::max(count, 1.0), both * step as f64)
    };
    let (variance, mut sum) = correlation([0, 0]);
    sum *= variance;
    let reach = -LARGEST_LAG..=LARGEST_LAG;
    let mut lags: Vec<(f64, [isize; 2])> = (0..=LARGEST_LAG)
        .flat_map(|dr| reach.clone().map(move |dc| [dr, dc]))
        .filter(|[dr, dc]| *dr > 0 || *dc > 0)
        .map(|lag| ((lag[0] as f64).hypot(lag[1] as f64), lag))
        .collect();
    lags.sort_by(|a, b| a.0.total_cmp(&b.0));
    let mut correlations = Vec::new();
    let mut pixels = 1.0_f64;
    let mut largest = LARGEST_LAG as f64;
    for (radius, lag) in lags.into_iter().filter(|(radius, _)| *radius <= LARGEST_LAG as f64) {
        // Two pixels, so that there is a taper
        if radius >= 2.0 && radius >= WINDOW_OVER_LENGTH * (pixels.max(0.0) / PI).sqrt() {
            largest = radius;
            break;
        }
        let (c, both) = correlation(lag);
        pixels += 2.0 * c / variance.max(f64::MIN_POSITIVE);
        correlations.push((radius, c, both));
    }
    for (radius, c, both) in correlations {
        let part = radius / largest;
        let w = if part <= 0.5 { 1.0 } else { 0.5 * (1.0 + (PI * (2.0 * part - 1.0)).cos()) };
        sum += (both + both.transpose()) * (w * c);
    }
    sum
}

/// Returns the shift of `after` against `before`, in pixels, from the structure at the pixels where `outside` is true.
/// Refuses maps without structure there, a shift of more than a quarter of the map, a standard error above one pixel,
/// and steps that do not settle.
pub(crate) fn align(
    grid: &Grid,
    before: &Surface,
    after: &Surface,
    outside: &Array2<bool>,
) -> Result<Shift, Invalid> {
    let before = before.height_nm();
    let after = after.height_nm();
    let (ny, nx) = grid.shape();
    let slopes = best_slopes(before, after, outside)
        .ok_or_else(|| lost("there is nothing outside the spot to align by"))?;
    let mut d = [0.0; 2];
    let mut used = Vec::new();
    for step in 1..=MOST_STEPS {
        if step <= FREE_STEPS {
            used = pixels_for_shift(&slopes, after, outside, d);
        }
        let rows = rows(before, after, &used, d);
        if rows.len() <= 5 || (0..2).any(|i| rows.iter().all(|r| r.h[i] == 0.0)) {
            return Err(lost("there is nothing outside the spot to align by"));
        }
        let inverse = inverse(&rows).ok_or_else(|| lost("the maps have no structure"))?;
        let change = inverse * rows.iter().map(|r| r.h_row() * r.e).sum::<Vector5<f64>>();
        d = [d[0] + change[0], d[1] + change[1]];
        if d.iter().any(|v| v.is_nan())
            || d[0].abs() > 0.25 * nx as f64
            || d[1].abs() > 0.25 * ny as f64
        {
            return Err(lost(
                "the maps do not fit by a shift of less than a quarter of their size",
            ));
        }
        if change[0].abs().max(change[1].abs()) < TOLERANCE {
            let covariance = inverse * squares(&rows, (ny, nx), &change) * inverse.transpose();
            let error_px = [0, 1].map(|i| covariance[(i, i)].max(0.0).sqrt());
            if error_px[0].max(error_px[1]) > MOST_ERROR_PIXELS {
                return Err(lost(&format!(
                    "the structure outside the spot tells the shift to {:.1} and {:.1} pixels only",
                    error_px[0], error_px[1]
                )));
            }
            return Ok(Shift { px: d, error_px, steps: step });
        }
    }
    Err(lost("the shift does not settle"))
}

/// Returns the error for maps that do not determine the shift; `problem` says why.
fn lost(problem: &str) -> Invalid {
    let remedy = "give `align` none, or maps with structure outside the spot";
    Invalid::whole("align", problem, remedy)
}
