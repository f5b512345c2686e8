//! Constrained least squares: feed and acceleration limits as bounds of the dwell times.
//!
//! ```text
//! V* = min(V, sqrt(2 d A / (1 - eta^2)))                                                  (1)
//! d / V* <= t <= d / (eta V*)                                                             (2)
//! d >= V^2 (1 - eta^2) / (2 A)                                                            (3)
//! ```
//!
//! Within a segment of length d the acceleration A takes the feed from `eta V*` to `V*` (1). So a feed may change from
//! the least to the largest allowed one, or back, in any segment: every sequence of dwell times within (2) can be
//! executed by trapezoidal feeds. (3) is the pitch limit of the source: on shorter segments the machine does not reach
//! its largest feed V. On these, (2) has the least dwell time `d / V*`, above `d / V`. V and A are the limits along the
//! segment, set by the axis that reaches its own limit first. If lengths differ, the least feed is eta times the
//! largest V* of the segment and its neighbours, and the feed changes in the longer one. Changes of direction are not
//! part of the source's model: corners need more acceleration than the bounds allow for.
//!
//! The minimum within (2) is that of [`crate::bounded_least_squares`], almost without
//! regularisation.
//!
//! Source: trigonometric-spline scheduling, Opt. Express 32 (2024) 9255 (the bounds and (3), for one
//! spacing and one axis).
//!
//! | symbol | variable | shape | unit |
//! |---|---|---|---|
//! | V* | `reachable_mm_per_s` | (n) | mm/s |
//! | d | `segment_length_mm` | (n) | mm |
//! | eta | `least_feed` | - | 1 |

use ndarray::Array2;
use planish_types::{Invalid, Limits, Surface, Tif, ToolPath};
use serde::Serialize;

use crate::{
    DwellError,
    bounded_least_squares::{self, BoundedSettings, BoundedSolution, Program},
    model::columns::Columns,
    problem::check,
};

/// Settings of the constrained least squares.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct BclsSettings {
    /// Columns of the removal model: the tool stands at the dwell point, or moves along the segment.
    pub columns: Columns,
    /// Least feed as a fraction eta of the reachable feed V* ((2) of the module); in [0, 1), 0 for no least feed.
    pub least_feed: f64,
    /// Weight alpha of the Tikhonov term of the [least squares](bounded_least_squares), dimensionless.
    pub tikhonov: f64,
}

impl Default for BclsSettings {
    fn default() -> Self {
        Self { columns: Columns::Segment, least_feed: 0.0, tikhonov: 3e-8 }
    }
}

/// Feeds, lengths and violations of the bounds (2) of the module.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct BclsReport {
    /// Largest pitch limit (3) of the module among the segments with a length, mm.
    pub pitch_limit_mm: f64,
    /// Length of the shortest segment with a length above 0, mm; 0 if there is none.
    pub shortest_segment_mm: f64,
    /// Number of segments shorter than the pitch limit (3): on these the machine does not reach its largest feed.
    pub below_pitch_limit: usize,
    /// Smallest and largest reachable feed V* of (1) of the module, mm/s.
    pub reachable_mm_per_s: [f64; 2],
    /// Number of pairs of neighbouring segments whose change of feed does not fit into the longer one; 0 within the
    /// bounds.
    pub trapezoid_violations: usize,
}

/// The least-squares solution within the bounds (2) of the module.
#[derive(Clone, Debug)]
pub struct Bcls {
    /// Dwell times, with the report of the least squares.
    pub solution: BoundedSolution,
    /// Report on the bounds.
    pub report: BclsReport,
}

/// Finds the dwell times with the least residual RMS within the bounds (2) of the module.
///
/// # Errors
/// Refuses a TIF whose rate depends on the time of the run, what [`bounds`] refuses, and what
/// [`bounded_least_squares::solve_columns`] refuses.
pub fn solve(
    desired: &Surface,
    tif: &Tif,
    path: &ToolPath,
    weight: Option<&Array2<f64>>,
    limits: &Limits,
    settings: &BclsSettings,
) -> Result<Bcls, DwellError> {
    tif.same_at_all_times("bcls")?;
    let bounds = bounds(path, limits, settings.least_feed)?;
    let places = settings.columns.places(path, tif);
    let squares = BoundedSettings {
        columns: settings.columns,
        tikhonov: settings.tikhonov,
        slope_weight: 0.0,
        ..BoundedSettings::default()
    };
    let program = Program {
        places: &places,
        lo: bounds.lo.clone(),
        hi: bounds.hi.clone(),
        guess: None,
        quadratic: None,
    };
    let solution =
        bounded_least_squares::solve_columns(desired, tif, path, weight, &squares, &program)?;
    let report = bounds.report(path, solution.dwell.dwell_s());
    Ok(Bcls { solution, report })
}

/// Reachable feeds (1) and bounds of the dwell times (2) of the module for every segment (n).
#[derive(Clone, Debug, PartialEq)]
pub struct Bounds {
    /// Least dwell time d / V*, s; 0 for a rest.
    pub lo: Vec<f64>,
    /// Largest dwell time d / (eta V*), s, with the largest V* of the segment and its neighbours; infinite for a rest,
    /// or if eta is 0.
    pub hi: Vec<f64>,
    /// Reachable feed V* of every segment, mm/s; 0 for a rest.
    reachable_mm_per_s: Vec<f64>,
    /// Largest acceleration A along every segment, mm/s^2.
    acceleration_mm_per_s2: Vec<f64>,
    /// Length from which on the machine reaches its largest feed along the segment, (3) of the module, mm; 0 for a
    /// rest.
    pitch_limit_mm: Vec<f64>,
}

/// Returns the reachable feeds (1) and the bounds (2) of the module for every segment.
///
/// # Errors
/// Refuses a least feed that is not in [0, 1), and a path on which the lengths of neighbouring segments differ too much
/// for it.
pub fn bounds(path: &ToolPath, limits: &Limits, least_feed: f64) -> Result<Bounds, Invalid> {
    check(
        "least_feed",
        least_feed,
        |e| (0.0..1.0).contains(&e),
        "give a fraction from 0 to below 1",
    )?;
    let n = path.len();
    let change = 1.0 - least_feed * least_feed;
    let velocity: Vec<f64> =
        (0..n).map(|j| limit_along(path, j, limits.max_velocity_mm_per_s())).collect();
    let acceleration: Vec<f64> =
        (0..n).map(|j| limit_along(path, j, limits.max_acceleration_mm_per_s2())).collect();
    // V* = min(V, sqrt(2 d A / (1 - eta^2)))
    let reachable: Vec<f64> = (0..n)
        .map(|j| {
            let d = path.segment_length_mm(j);
            if d > 0.0 { velocity[j].min((2.0 * d * acceleration[j] / change).sqrt()) } else { 0.0 }
        })
        .collect();
    let lo: Vec<f64> = (0..n)
        .map(|j| if reachable[j] > 0.0 { path.segment_length_mm(j) / reachable[j] } else { 0.0 })
        .collect();
    let hi: Vec<f64> = (0..n)
        .map(|j| {
            let around = &reachable[j.saturating_sub(1)..(j + 2).min(n)];
            let largest = around.iter().copied().fold(0.0, f64::max);
            if least_feed * largest > 0.0 && reachable[j] > 0.0 {
                path.segment_length_mm(j) / (least_feed * largest)
            } else {
                f64::INFINITY
            }
        })
        .collect();
    if let Some(j) = (0..n).find(|j| hi[*j] < lo[*j]) {
        let problem = format!(
            "has the length {:.4} mm between segments on which the machine is more than {:.3} times \
             as fast",
            path.segment_length_mm(j),
            1.0 / least_feed
        );
        let remedy = "lower `least_feed`, or give a path with segments of more equal length";
        return Err(Invalid::at_index("point_mm", j, problem, remedy));
    }
    let pitch_limit_mm = (0..n)
        .map(|j| {
            let limit = velocity[j] * velocity[j] * change / (2.0 * acceleration[j]);
            if limit.is_finite() { limit } else { 0.0 }
        })
        .collect();
    Ok(Bounds {
        lo,
        hi,
        reachable_mm_per_s: reachable,
        acceleration_mm_per_s2: acceleration,
        pitch_limit_mm,
    })
}

/// Returns the limit of the speed or acceleration along segment j, from the limits [x, y] of the axes. The axis that
/// reaches its own limit first decides. Infinite for a rest, which has no direction.
fn limit_along(path: &ToolPath, j: usize, limit: [f64; 2]) -> f64 {
    let d = path.displacement_mm(j);
    let length = path.segment_length_mm(j);
    let [x, y] =
        [0, 1].map(|a| if d[a] == 0.0 { f64::INFINITY } else { limit[a] * length / d[a].abs() });
    x.min(y)
}

impl Bounds {
    /// Returns the report on the bounds for some dwell times (n), s.
    fn report(&self, path: &ToolPath, dwell_s: &[f64]) -> BclsReport {
        let length_mm = |j: &usize| path.segment_length_mm(*j);
        let moving: Vec<usize> = (0..path.len()).filter(|j| length_mm(j) > 0.0).collect();
        let shortest = moving.iter().map(length_mm).fold(f64::INFINITY, f64::min);
        let reachable = moving.iter().map(|j| self.reachable_mm_per_s[*j]);
        let is_short = |j: &&usize| length_mm(j) < self.pitch_limit_mm[**j] * (1.0 - 1e-12);
        BclsReport {
            pitch_limit_mm: moving.iter().map(|j| self.pitch_limit_mm[*j]).fold(0.0, f64::max),
            shortest_segment_mm: if shortest.is_finite() { shortest } else { 0.0 },
            below_pitch_limit: moving.iter().filter(is_short).count(),
            reachable_mm_per_s: [
                reachable.clone().fold(f64::INFINITY, f64::min).min(1e12),
                reachable.fold(0.0, f64::max),
            ],
            trapezoid_violations: self.trapezoid_violations(path, dwell_s),
        }
    }

    /// Counts the pairs of neighbouring segments with `|v_{k+1}^2 - v_k^2| > max(2 A d)`, the maximum over both: the
    /// change of feed (v = d / t) does not fit into the longer of them.
    pub fn trapezoid_violations(&self, path: &ToolPath, dwell_s: &[f64]) -> usize {
        let n = path.len();
        let d: Vec<f64> = (0..n).map(|j| path.segment_length_mm(j)).collect();
        let v: Vec<f64> =
            (0..n).map(|j| if dwell_s[j] > 0.0 { d[j] / dwell_s[j] } else { 0.0 }).collect();
        let room: Vec<f64> = (0..n).map(|j| 2.0 * self.acceleration_mm_per_s2[j] * d[j]).collect();
        (1..n)
            .filter(|k| d[k - 1] > 0.0 && d[*k] > 0.0)
            .filter(|k| {
                let change = (v[*k].powi(2) - v[k - 1].powi(2)).abs();
                // Rounding of the squares.
                change > room[k - 1].max(room[*k]) * (1.0 + 1e-9)
            })
            .count()
    }
}
