//! Dependence of a prediction on the interpolation of the TIF between its samples.
//!
//! Nothing is known of a tool between the samples of its TIF. Of a smooth TIF Keys' cubics are right to the third order
//! in the step, and straight lines to the second; of a hard edge that falls within a step neither is right, and the
//! prediction depends on the choice. So the residual e is compared with the one that straight lines give:
//!
//! ```text
//! e_linear = e + d,   d(x) = integral of (R - B)(x - P(t)) w(t) dt
//! ```
//!
//! with R Keys' convolution of the samples and B their bilinear interpolation, on some pixels that are spread over the
//! map (the sequence of M. Roberts' generalised golden ratio), by the midpoint rule. The change of the RMS is a ratio
//! of two means over the same pixels; its standard error is stated.

use planish_numerics::polynomial::evaluate;
use planish_types::{Removal, Segment, Tif, Trajectory, text::significant};
use rayon::prelude::*;
use serde::Serialize;

/// Number of values of the TIF that the comparison reads in all; it takes some tenths of a second. Larger: more pixels,
/// a smaller standard error, and more time. Smaller: fewer pixels.
const READINGS: f64 = 4e6;

/// Smallest and largest number of pixels that are compared. The standard error of a change by c of the RMS is about c
/// over the root of the number of pixels. Larger: more time. Smaller: a larger standard error.
const PIXELS: [f64; 2] = [64.0, 1000.0];

/// Number of places on the map that are tried for each pixel that is compared; only valid pixels are compared.
/// Larger: maps with few valid pixels are compared on more of them. Smaller: on fewer.
const PLACES_PER_PIXEL: usize = 8;

/// Length of a step of the midpoint rule along the motion, as a fraction of the pitch of the TIF. Larger: less exact.
/// Smaller: more readings per pixel, and fewer pixels.
const PARTS_OF_A_STEP: f64 = 0.5;
/// Largest number of steps of the midpoint rule over the whole motion. Larger: more memory. Smaller: long motions are
/// integrated with longer steps.
const MOST_POINTS: f64 = 2e6;

/// Number of parts of the motion that are summed separately. It does not depend on the number of threads, so that the
/// result does not either. Larger: more overhead. Smaller: fewer tasks for the threads.
const PARTS: usize = 64;

/// Relative change of the RMS of the residual above which the warning of a TIF that is sampled too coarsely is given.
/// Larger: coarse TIFs pass without a warning. Smaller: warnings about changes without consequence.
const NAMED: f64 = 0.01;
/// Change of the RMS of the residual, in standard errors of this change, above which the warning is given. Larger: real
/// changes pass without a warning. Smaller: warnings by chance.
const STANDARD_ERRORS: f64 = 2.0;

/// Plastic number g, about 1.3247: multiples of 1 / g and 1 / g^2 give the most evenly spread sequence of pairs.
const GOLDEN: f64 = 1.324_717_957_244_746;

/// Comparison of the residual for two interpolations of the TIF: Keys' cubics and straight lines.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Between {
    /// Number of pixels that were compared.
    pub pixels: usize,
    /// RMS about its mean of the difference between the removals with Keys' cubics and with straight lines, over the
    /// compared pixels, nm.
    pub difference_rms_nm: f64,
    /// Relative change of the RMS of the residual with straight lines in place of Keys' cubics.
    pub residual_change: f64,
    /// Standard error of `residual_change`.
    pub standard_error: f64,
}

impl Between {
    /// Compares the prediction `removal` of `trajectory` with `tif` to that with straight lines between the samples of
    /// the TIF. Returns `None` if fewer than two valid pixels are found, or if the residual is the same at all of them.
    pub fn new(trajectory: &Trajectory, tif: &Tif, removal: &Removal) -> Option<Self> {
        let residual = removal.residual();
        let grid = residual.grid();
        let [map_mm, tif_mm] = [grid.size_mm(), tif.grid().size_mm()];
        let points = quadrature_points(trajectory, tif);

        // Pixels by their x: [x, y], and the residual there.
        let part = [0, 1].map(|a| (tif_mm[a] / map_mm[a]).min(1.0));
        let readings = (points.len() as f64 * part[0] * part[1]).max(1.0);
        let count = (READINGS / readings).clamp(PIXELS[0], PIXELS[1]) as usize;
        let (ny, nx) = grid.shape();
        let places = (0..PLACES_PER_PIXEL * count).map(|k| {
            let [r, c] = [(GOLDEN * GOLDEN, ny), (GOLDEN, nx)].map(|(step, n)| {
                (((0.5 + k as f64 / step).fract() * n as f64) as usize).min(n - 1)
            });
            (r, c)
        });
        let height = residual.height_nm();
        let valid = places.filter(|place| !height[*place].is_nan());
        let mut pixels: Vec<([f64; 2], f64)> = valid
            .take(count)
            .map(|(r, c)| ([grid.x.coordinate_mm(c), grid.y.coordinate_mm(r)], height[[r, c]]))
            .collect();
        pixels.sort_by(|a, b| a.0[0].total_cmp(&b.0[0]));

        let parts: Vec<Vec<f64>> = points
            .par_chunks(points.len().div_ceil(PARTS).max(1))
            .map(|points| differences(points, &pixels, tif))
            .collect();
        let mut difference = vec![0.0; pixels.len()];
        for part in parts {
            difference.iter_mut().zip(part).for_each(|(d, part)| *d += part);
        }
        let before: Vec<f64> = pixels.iter().map(|p| p.1).collect();
        Self::compared(&before, &difference)
    }

    /// Compares the residual `before`, nm, with its change `difference`, nm, at the same pixels. Returns `None` for
    /// fewer than two pixels, or if `before` is the same at all of them.
    fn compared(before: &[f64], difference: &[f64]) -> Option<Self> {
        let n = before.len() as f64;
        let [r, d] = [before, difference].map(|v| -> Vec<f64> {
            let mean = v.iter().sum::<f64>() / n;
            v.iter().map(|x| x - mean).collect()
        });
        let after: Vec<f64> = r.iter().zip(&d).map(|(r, d)| r + d).collect();
        let of_before = mean_square(&r);
        let of_after = mean_square(&after);
        if before.len() < 2 || of_before.is_nan() || of_before <= 0.0 {
            return None;
        }
        // A ratio of means over the same pixels varies by a_i - ratio b_i.
        let ratio = of_after / of_before;
        let beside: Vec<f64> = r.iter().zip(&after).map(|(r, a)| a * a - ratio * r * r).collect();
        let error = (mean_square(&beside) / n).sqrt() / of_before;
        Some(Self {
            pixels: before.len(),
            difference_rms_nm: mean_square(&d).sqrt(),
            residual_change: ratio.sqrt() - 1.0,
            standard_error: if ratio > 0.0 { error / (2.0 * ratio.sqrt()) } else { 0.0 },
        })
    }

    /// Returns the warning that the TIF is sampled too coarsely. Returns `None` if the change of the RMS is at most
    /// `NAMED`, or at most `STANDARD_ERRORS` of its standard errors.
    pub fn warning(&self) -> Option<String> {
        let change = self.residual_change;
        let seen = change.abs() > NAMED && change.abs() > STANDARD_ERRORS * self.standard_error;
        if !seen {
            return None;
        }
        Some(format!(
            "the TIF is sampled too coarsely for its edges: with straight lines in the place of cubics between its \
             samples the residual is {} % {} (standard error {} %, from {} pixels); measure the TIF at a smaller \
             pitch",
            significant(100.0 * change.abs(), 2),
            if change > 0.0 { "larger" } else { "smaller" },
            significant(100.0 * self.standard_error, 2),
            self.pixels
        ))
    }
}

/// Returns the points of the midpoint rule along the motion with the tool on. Each has its position [x, y], mm, and its
/// time, s, times the rate factor of the segment.
fn quadrature_points(trajectory: &Trajectory, tif: &Tif) -> Vec<([f64; 2], f64)> {
    let step_mm = tif.grid().x.step_mm().min(tif.grid().y.step_mm());
    let on = || trajectory.segments().filter(|s| s.tool_on);
    let wanted: f64 = on().map(|s| steps(&s, step_mm)).sum();
    let fewer = (wanted / MOST_POINTS).max(1.0);
    on().flat_map(|s| {
        let count = (steps(&s, step_mm) / fewer).ceil();
        let time_s = s.duration_s / count;
        (0..count as usize).map(move |k| {
            let u = (k as f64 + 0.5) * time_s;
            (s.coefficient_mm.map(|c| evaluate(&c, u)), s.rate_factor * time_s)
        })
    })
    .collect()
}

/// Returns the number of steps of the midpoint rule along a segment, not rounded, for a TIF with samples `step_mm`
/// apart.
fn steps(s: &Segment<'_>, step_mm: f64) -> f64 {
    let h = s.duration_s;
    // At least as long as the way.
    let [x, y] = s.coefficient_mm.map(|c| ((c[3].abs() * h + c[2].abs()) * h + c[1].abs()) * h);
    (x.hypot(y) / (PARTS_OF_A_STEP * step_mm)).clamp(1.0, MOST_POINTS)
}

/// Returns the difference of the removals by Keys' cubics and by straight lines, nm, at the `pixels` (sorted by x),
/// with the tool at the `points`.
fn differences(points: &[([f64; 2], f64)], pixels: &[([f64; 2], f64)], tif: &Tif) -> Vec<f64> {
    let mut sums = vec![0.0; pixels.len()];
    for ([x, y], time_s) in points {
        let [from, to] = [tif.grid().x.start_mm() + x, tif.grid().x.end_mm() + x];
        let first = pixels.partition_point(|p| p.0[0] < from);
        for (p, sum) in pixels.iter().zip(&mut sums).skip(first) {
            if p.0[0] > to {
                break;
            }
            let d = [p.0[0] - x, p.0[1] - y];
            if d[1] >= tif.grid().y.start_mm() && d[1] <= tif.grid().y.end_mm() {
                *sum += time_s * (tif.rate_at(d[0], d[1]) - bilinear(tif, d));
            }
        }
    }
    sums
}

/// Returns the mean of the squares of the values.
fn mean_square(v: &[f64]) -> f64 {
    v.iter().map(|x| x * x).sum::<f64>() / v.len() as f64
}

/// Returns the bilinear interpolation of the samples of the TIF at the offset `d` (mm) from the tool, within the
/// samples, nm/s.
fn bilinear(tif: &Tif, d: [f64; 2]) -> f64 {
    let axes = [tif.grid().x, tif.grid().y];
    let [(i, fx), (j, fy)] = [0, 1].map(|a| {
        let s = (d[a] - axes[a].start_mm()) / axes[a].step_mm();
        let i = (s.max(0.0) as usize).min(axes[a].len() - 2);
        (i, (s - i as f64).clamp(0.0, 1.0))
    });
    let rate = tif.rate_nm_per_s();
    let [lower, upper] = [j, j + 1].map(|j| (1.0 - fx) * rate[[j, i]] + fx * rate[[j, i + 1]]);
    (1.0 - fy) * lower + fy * upper
}
