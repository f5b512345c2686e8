//! Midpoint quadrature, pixel by pixel: slow and simple, the independent check (oracle) of [`crate::gridded`].
//!
//! ```text
//! M(x) = sum over segments with the tool on, w sum_{q=0}^{m-1} (h / m) R(x - P((q + 1/2) h / m))
//! ```
//!
//! with the duration h of a segment, its rate factor w (1 but for logs that have a beam current), m = `steps`, and the
//! position P in the time of the segment. For a tool that varies, R(x - P) is K(x; P, t) of
//! [`planish_types::Variation`] at the position and the time of each step.
//!
//! Order 2 in 1/m for a TIF that ends smoothly, order 1 where its samples end with a step.

use ndarray::Array2;
use planish_types::{
    Grid, Headings, Invalid, Pose, Tif, Trajectory, Variation, progress::PieceCounter,
};
use rayon::prelude::*;

use crate::{Numerics, Tell};

/// Largest number of quadrature points (2.4 GB); more are refused. Larger: more memory. Smaller: long motions are
/// refused unless they have fewer steps per segment.
const MAX_SAMPLES: usize = 100_000_000;

/// Position and direction of the tool at one quadrature point; `time_s` is its time, scaled to the rate of the TIF.
struct Sample {
    pose: Pose,
    time_s: f64,
}

/// Computes the removal (ny, nx) in nm on `grid`, with `steps` equal time steps per segment.
///
/// # Errors
///
/// Refuses 0 steps, and more than 1e8 steps over all segments, those with the tool off included.
pub fn removal_nm(
    trajectory: &Trajectory,
    tif: &Tif,
    grid: &Grid,
    steps: usize,
) -> Result<(Array2<f64>, Numerics), Invalid> {
    removal_with_progress(trajectory, tif, grid, steps, &|_| ())
}

/// Computes the removal as [`removal_nm`] does, and calls `tell` with the fraction that is done.
pub(crate) fn removal_with_progress(
    trajectory: &Trajectory,
    tif: &Tif,
    grid: &Grid,
    steps: usize,
    tell: Tell<'_>,
) -> Result<(Array2<f64>, Numerics), Invalid> {
    if steps == 0 {
        return Err(Invalid::whole("steps", "is 0", "give at least one time step per segment"));
    }
    if trajectory.len().saturating_mul(steps) > MAX_SAMPLES {
        let problem = format!("is {steps} for {} segments", trajectory.len());
        return Err(Invalid::whole("steps", problem, "give fewer: at most 1e8 samples in total"));
    }
    let samples = samples(trajectory, tif, steps);
    let factor = tif.variation().and_then(|v| v.factor_on(grid));
    let mut removal_nm = Array2::zeros(grid.shape());
    let pieces = PieceCounter::new(grid.y.len());
    removal_nm.outer_iter_mut().into_par_iter().enumerate().for_each(|(r, mut row)| {
        let y = grid.y.coordinate_mm(r);
        let near = samples.iter().filter(|s| {
            let d = y - s.pose.position_mm[1];
            d >= tif.grid().y.start_mm() - grid.y.step_mm()
                && d <= tif.grid().y.end_mm() + grid.y.step_mm()
        });
        let near: Vec<&Sample> = near.collect();
        for (c, out) in row.iter_mut().enumerate() {
            *out = sum_nm(&near, tif, grid.x.coordinate_mm(c), y)
                * factor.as_ref().map_or(1.0, |g| g[[r, c]]);
        }
        tell(pieces.one_more());
    });
    let numerics = Numerics {
        quadrature_points: samples.len(),
        subdivision: [1, 1],
        tif_interpolation_error: 0.0,
    };
    Ok((removal_nm, numerics))
}

/// Computes the removal in nm at the point (`x_mm`, `y_mm`), without the factor of the pixels of a tool that varies,
/// with `steps` equal time steps per segment.
pub fn removal_at_nm(
    trajectory: &Trajectory,
    tif: &Tif,
    x_mm: f64,
    y_mm: f64,
    steps: usize,
) -> f64 {
    sum_nm(&samples(trajectory, tif, steps).iter().collect::<Vec<_>>(), tif, x_mm, y_mm)
}

/// Returns the removal of the quadrature points `samples` at the point (`x_mm`, `y_mm`), nm.
fn sum_nm(samples: &[&Sample], tif: &Tif, x_mm: f64, y_mm: f64) -> f64 {
    samples
        .iter()
        .map(|s| {
            let [x, y] = s.pose.position_mm;
            s.time_s * tif.rate_of_tool_at(s.pose, [x_mm - x, y_mm - y])
        })
        .sum()
}

fn samples(trajectory: &Trajectory, tif: &Tif, steps: usize) -> Vec<Sample> {
    let time = tif.variation().and_then(Variation::time_factor);
    let mut samples = Vec::with_capacity(trajectory.len() * steps);
    let headings = Headings::new(trajectory);
    for (k, segment) in trajectory.segments().enumerate().filter(|(_, s)| s.tool_on) {
        let time_s = segment.duration_s / steps as f64;
        samples.extend((0..steps).map(|q| {
            let u_s = (q as f64 + 0.5) * time_s;
            let factor = time.map_or(1.0, |time| time.factor_at(segment.start_s + u_s));
            Sample {
                pose: headings.pose(k, &segment, u_s),
                time_s: segment.rate_factor * factor * time_s,
            }
        }));
    }
    samples
}
