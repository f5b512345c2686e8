//! Search for the best position of the later map on a lattice of shifts and angles; the Gauss-Newton steps start there.

use rayon::prelude::*;

use super::Pose;
use crate::field::Field;

/// Largest number of pixels of the later map that are compared: those with the steepest slopes, which
/// determine the place best. Larger: more time. Smaller: the correlation of a place is less certain.
const COMPARED: usize = 3000;

/// Largest number of values of the x shift, of the y shift and of the rotation; the search tries their product.
/// Larger: time grows with the cube. Smaller: steps larger than a pixel begin at smaller limits of the search.
const MOST_PLACES: usize = 61;

/// Smallest number of compared pixels that must fall on valid ones; a place with fewer is skipped. Larger:
/// skips places with little overlap. Smaller: a few pixels correlate by chance.
const LEAST_COMPARED: usize = COMPARED / 10;

/// Returns the pose with the largest correlation within `limits` (shift in mm, rotation in rad). `values` are the
/// heights of the later and of the earlier map without their free terms, nm, row by row.
pub(super) fn best(
    values: &[Vec<f64>; 2],
    after: &Field,
    before: &Field,
    centre_mm: [f64; 2],
    limits: [f64; 2],
) -> Pose {
    let [a, b] = values;
    let grid = after.grid();
    let from = before.grid();
    let mut steep: Vec<(f64, usize)> = after
        .valid_indexed()
        .filter_map(|([r, c], ..)| {
            let g = after.gradient([r, c])?;
            Some((g[0].hypot(g[1]), r * grid.x.len() + c))
        })
        .collect();
    // Steepest first, then by place: the same pixels on every machine.
    steep.sort_by(|p, q| q.0.total_cmp(&p.0).then(p.1.cmp(&q.1)));
    steep.truncate(COMPARED);
    let points: Vec<([f64; 2], f64)> = steep
        .iter()
        .map(|(_, i)| {
            let x =
                [grid.x.coordinate_mm(i % grid.x.len()), grid.y.coordinate_mm(i / grid.x.len())];
            ([x[0] - centre_mm[0], x[1] - centre_mm[1]], a[*i])
        })
        .collect();
    let half = 0.5 * grid.size_mm()[0].hypot(grid.size_mm()[1]);
    let pixel_mm = from.x.step_mm().min(from.y.step_mm());
    let shifts = places(limits[0], pixel_mm);
    let angles = places(limits[1], pixel_mm / half);
    let by_angle = angles.par_iter().map(|angle| {
        let (sin, cos) = angle.sin_cos();
        let mut best = (f64::NEG_INFINITY, [0.0; 3]);
        for y in &shifts {
            for x in &shifts {
                let pairs = points.iter().filter_map(|(d, z)| {
                    let d = [d[0] - x, d[1] - y];
                    let [r, c] = before.nearest([
                        centre_mm[0] + cos * d[0] + sin * d[1],
                        centre_mm[1] - sin * d[0] + cos * d[1],
                    ])?;
                    let height = b[r * from.x.len() + c];
                    if height.is_finite() { Some((*z, height)) } else { None }
                });
                let correlation = correlation(pairs);
                if correlation > best.0 {
                    best = (correlation, [*x, *y, *angle]);
                }
            }
        }
        best
    });
    let by_angle: Vec<(f64, Pose)> = by_angle.collect();
    // The first of the best, whatever the order in which the threads end.
    by_angle.into_iter().fold((f64::NEG_INFINITY, [0.0; 3]), |m, e| if e.0 > m.0 { e } else { m }).1
}

/// Returns the values from `-limit` to `limit` in steps of `step`, zero among them, in the unit of `limit`. The steps
/// are larger if there would be more than [`MOST_PLACES`].
fn places(limit: f64, step: f64) -> Vec<f64> {
    let half = ((limit / step).floor() as usize).min(MOST_PLACES / 2);
    let step = if half == MOST_PLACES / 2 { limit / half as f64 } else { step };
    (0..=2 * half).map(|k| (k as f64 - half as f64) * step).collect()
}

/// Returns the correlation coefficient of pairs of heights; minus infinity if there are fewer than [`LEAST_COMPARED`],
/// or without variance.
fn correlation(pairs: impl Iterator<Item = (f64, f64)>) -> f64 {
    let [mut n, mut a, mut b, mut aa, mut bb, mut ab] = [0.0; 6];
    for (p, q) in pairs {
        n += 1.0;
        a += p;
        b += q;
        aa += p * p;
        bb += q * q;
        ab += p * q;
    }
    if n < LEAST_COMPARED as f64 {
        return f64::NEG_INFINITY;
    }
    let variance = (aa - a * a / n) * (bb - b * b / n);
    if variance > 0.0 { (ab - a * b / n) / variance.sqrt() } else { f64::NEG_INFINITY }
}
