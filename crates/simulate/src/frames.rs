//! The removal at equal steps of time in the course of the run.
//!
//! ```text
//! M(x, t_i) = M(x, t_(i-1)) + integral over t_(i-1) .. t_i, tool on, of w(t) R(x - P(t)) dt,   M(x, 0) = 0
//! ```
//!
//! with the TIF R, the rate factor w and the position P of the tool as in the [crate], `t_i = T i / m` from the
//! start of the motion, and `T` its duration. Every part of the motion is simulated once, as [`crate::simulate`] does,
//! and the last frame is the removal of the run.
//!
//! A frame keeps every s_y-th row and every s_x-th column, the values themselves, not means over several pixels. s_x
//! and s_y are the same number s, the smallest with which a frame has at most [`MAX_PIXELS`] pixels. Along an axis of n
//! pixels it is at most n - 1, so that two rows and columns stay: a map of 90 000 x 2 pixels has s_x = 9 and s_y = 1.
//!
//! | symbol | variable | shape | unit |
//! |---|---|---|---|
//! | m | `count` | - | - |
//! | t | `time_s` | (m) | s |
//! | M | `removal_nm` | (m, ceil(ny / s_y), ceil(nx / s_x)) | nm |
//! | s_x, s_y | `stride` | (2) | pixels of the map |

use ndarray::{Array2, Array3, Axis as NdAxis, s};
use planish_numerics::polynomial::{derivative, evaluate};
use planish_types::{Axis, Grid, Invalid, Surface, Tif, Trajectory, progress};
use rayon::prelude::*;

use crate::{SimulationPlan, SimulationSettings, coverage::Coverage};

/// Largest number of pixels of a frame, for every map; 24 frames of 8 bytes per pixel take 4 MB. Larger: larger files.
/// Smaller: coarser pictures.
pub const MAX_PIXELS: usize = 20_000;

/// Largest number of frames; more are refused. Larger: large files and long runs. Smaller: coarser steps in time.
pub const MAX_COUNT: usize = 1000;

/// Number of parts of the motion that are simulated at the same time, each with its own map. Larger: more memory.
/// Smaller: threads may idle.
const SIDE_BY_SIDE: usize = 2;

/// The removal up to several times of the run.
#[derive(Clone, Debug)]
pub struct Frames {
    /// Times from the start of the motion to the end of each of m equal steps (m), s.
    pub time_s: Vec<f64>,
    /// Removal up to each time on the pixels of the frames, shape (m, rows, columns), nm.
    pub removal_nm: Array3<f64>,
    /// Pixel centres of the frames.
    pub grid: Grid,
    /// Distance of the pixels of a frame in pixels of the map, along [x, y].
    pub stride: [usize; 2],
    /// Coverage of the map by the whole motion.
    pub coverage: Coverage,
}

/// Computes the removal of `trajectory` with `tif` on some of the pixels of `desired`, at the ends of `count` equal
/// steps of time.
///
/// # Errors
///
/// Refuses numbers of frames out of their range, and what [`crate::simulate`] refuses.
pub fn frames(
    trajectory: &Trajectory,
    tif: &Tif,
    desired: &Surface,
    settings: SimulationSettings,
    count: usize,
) -> Result<Frames, Invalid> {
    if !(1..=MAX_COUNT).contains(&count) {
        let remedy = format!("give 1 to {MAX_COUNT}");
        return Err(Invalid::whole("frames", format!("are {count}"), remedy));
    }
    let full = desired.grid();
    let stride = strides(full);
    let grid = Grid { x: thinned(&full.x, stride[0])?, y: thinned(&full.y, stride[1])? };

    let plan = SimulationPlan::new(tif, full, settings)?;
    let start_s = trajectory.break_time_s()[0];
    let total_s = trajectory.total_time_s();
    let m = count as f64;
    let mut removal: Array2<f64> = Array2::zeros(full.shape());
    let mut removal_nm = Array3::zeros((count, grid.y.len(), grid.x.len()));

    // A part of the motion reaches few tiles of the map, too few for all threads: parts are simulated side by side.
    for first in (0..count).step_by(SIDE_BY_SIDE) {
        let together = first..(first + SIDE_BY_SIDE).min(count);
        let parts = together.clone().into_par_iter().map(|i| {
            let [from_s, until_s] = [i, i + 1].map(|i| start_s + total_s * i as f64 / m);
            let part = part_of(trajectory, from_s, until_s)?;
            part.map(|part| Ok(plan.removal_nm(&part)?.0)).transpose()
        });
        let parts: Vec<Result<Option<Array2<f64>>, Invalid>> = parts.collect();
        for (i, part) in together.zip(parts) {
            if let Some(part) = part? {
                removal += &part;
            }
            let frame = removal.slice(s![..;stride[1], ..;stride[0]]);
            removal_nm.index_axis_mut(NdAxis(0), i).assign(&frame);
            progress::done((i + 1) as f64 / m);
        }
    }
    let time_s = (0..count).map(|i| total_s * (i + 1) as f64 / m).collect();
    let coverage = Coverage::new(&removal, trajectory, tif, desired);
    Ok(Frames { time_s, removal_nm, grid, stride, coverage })
}

/// Returns the strides along [x, y] with which a frame has at most [`MAX_PIXELS`]: the smallest number that suffices
/// along both axes. Along an axis it is at most the number of pixels less one, so that two rows and columns stay.
fn strides(grid: &Grid) -> [usize; 2] {
    // Two rows or columns stay in any case.
    let mut strides = (1..).map(|s| [&grid.x, &grid.y].map(|axis| s.min(axis.len() - 1)));
    strides
        .find(|[x, y]| grid.x.len().div_ceil(*x) * grid.y.len().div_ceil(*y) <= MAX_PIXELS)
        .expect("a large stride keeps two rows and columns")
}

/// Returns the axis of every `stride`-th pixel.
fn thinned(axis: &Axis, stride: usize) -> Result<Axis, Invalid> {
    Axis::new(axis.start_mm(), axis.step_mm() * stride as f64, axis.len().div_ceil(stride))
}

/// Returns the part of the motion from `from_s` to `until_s`, in the time of the trajectory; `None` if it has no
/// duration.
fn part_of(t: &Trajectory, from_s: f64, until_s: f64) -> Result<Option<Trajectory>, Invalid> {
    let breaks = t.break_time_s();
    let first = breaks.partition_point(|b| *b <= from_s).saturating_sub(1);
    let mut times = vec![];
    let mut coefficients = vec![];
    let mut on = vec![];
    let mut index = vec![];
    let mut factor = vec![];
    for i in first..t.len() {
        let segment = t.segment(i);
        let start = breaks[i].max(from_s);
        let end = breaks[i + 1].min(until_s);
        if end <= start {
            break;
        }
        let shift = start - breaks[i];
        coefficients.push(segment.coefficient_mm.map(|c| shifted(&c, shift)));
        times.push(start);
        on.push(segment.tool_on);
        index.push(segment.dwell_index);
        factor.push(segment.rate_factor);
    }
    let Some(last) = times.len().checked_sub(1) else { return Ok(None) };
    times.push(breaks[first + last + 1].min(until_s));
    Trajectory::new(times, coefficients, on, index)?.with_rate_factor(factor).map(Some)
}

/// Returns the coefficients of the polynomial q(u) = p(u + d), which are q_k = p^(k)(d) / k!.
fn shifted(p: &[f64; 4], d: f64) -> [f64; 4] {
    let v = derivative(p);
    let a = derivative(&v);
    let j = derivative(&a);
    [evaluate(p, d), evaluate(&v, d), evaluate(&a, d) / 2.0, evaluate(&j, d) / 6.0]
}

#[cfg(test)]
mod tests {
    use super::*;
    use planish_testkit::maps::largest_difference;

    fn axis(start: f64, step: f64, n: usize) -> Axis {
        Axis::new(start, step, n).unwrap()
    }

    fn desired(nx: usize, ny: usize) -> Surface {
        let grid = Grid { x: axis(0.0, 0.5, nx), y: axis(-1.0, 0.5, ny) };
        Surface::new(grid, Array2::ones(grid.shape())).unwrap()
    }

    fn tif() -> Tif {
        let a = axis(-2.0, 0.5, 9);
        let rate = |(r, c): (usize, usize)| {
            let (x, y) = (a.coordinate_mm(c), a.coordinate_mm(r));
            (-(x * x + 2.0 * y * y)).exp() * (1.0 + 0.1 * x)
        };
        Tif::new(Grid { x: a, y: a }, Array2::from_shape_fn((9, 9), rate)).unwrap()
    }

    /// Makes a curved motion with a lift and a rest; the frames do not end at its breaks.
    fn motion() -> Trajectory {
        let c = vec![
            [[0.0, 1.5, 0.2, -0.05], [0.0, 0.3, 0.0, 0.01]],
            [[5.0, 0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0]],
            [[5.0, -1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0]],
        ];
        Trajectory::new(
            vec![2.0, 5.0, 6.3, 9.1],
            c,
            vec![true, true, false],
            vec![Some(0), Some(1), None],
        )
        .unwrap()
    }

    #[test]
    fn the_last_frame_is_the_removal() {
        let (surface, tif) = (desired(21, 9), tif());
        let f = frames(&motion(), &tif, &surface, SimulationSettings::Gridded, 5).unwrap();
        assert_eq!((f.time_s.len(), f.stride), (5, [1, 1]));
        // Rounding of a time of 7 s.
        assert!((f.time_s[4] - 7.1).abs() < 1e-12);
        let plan = SimulationPlan::new(&tif, surface.grid(), SimulationSettings::Gridded).unwrap();
        let (whole, _) = plan.removal_nm(&motion()).unwrap();
        let last = f.removal_nm.index_axis(NdAxis(0), 4);
        // The cuts between the frames move the points of the quadrature, whose remainder of the
        // degrees above 5 is 2.6e-7 nm here.
        let e = largest_difference(last, &whole);
        assert!(e < 1e-6, "{e}");
        assert!(whole.iter().any(|v| *v > 0.1));
    }

    #[test]
    fn a_frame_agrees_with_the_other_method() {
        let (surface, tif) = (desired(21, 9), tif());
        let of = |settings| frames(&motion(), &tif, &surface, settings, 3).unwrap();
        let (a, b) =
            (of(SimulationSettings::Gridded), of(SimulationSettings::Direct { steps: 400 }));
        // The midpoint rule over 400 steps of 7 ms: (0.007 s)^2 / 24 times 3 s times the second
        // derivative of the rate along the motion, below 10 nm/s^3.
        let e = largest_difference(&a.removal_nm, &b.removal_nm);
        assert!(e < 1e-4, "{e}");
    }

    #[test]
    fn large_maps_are_thinned_to_the_pixels_themselves() {
        let (surface, tif) = (desired(301, 203), tif());
        let f = frames(&motion(), &tif, &surface, SimulationSettings::Gridded, 1).unwrap();
        assert_eq!((f.stride, f.grid.shape()), ([2, 2], (102, 151)));
        let plan = SimulationPlan::new(&tif, surface.grid(), SimulationSettings::Gridded).unwrap();
        let (whole, _) = plan.removal_nm(&motion()).unwrap();
        for ((_, r, c), v) in f.removal_nm.indexed_iter() {
            let e = (v - whole[[2 * r, 2 * c]]).abs();
            // The remainder of the quadrature, as above.
            assert!(e < 1e-6, "{e}");
        }
        assert_eq!(f.grid.x.coordinate_mm(7), surface.grid().x.coordinate_mm(14));
        // Two rows of 10 000 pixels.
        assert_eq!(strides(desired(90_000, 2).grid()), [9, 1]);
    }

    #[test]
    fn a_shifted_polynomial_is_the_same_motion() {
        let p = [1.0, -2.0, 0.5, 0.25];
        let q = shifted(&p, 1.75);
        for u in [0.0, 0.5, 3.0] {
            // Rounding of terms of up to 30.
            assert!((evaluate(&q, u) - evaluate(&p, u + 1.75)).abs() < 1e-13);
        }
    }

    #[test]
    fn no_frames_and_too_many_are_refused() {
        for count in [0, 1001] {
            let f = frames(&motion(), &tif(), &desired(5, 5), SimulationSettings::Gridded, count);
            assert!(f.unwrap_err().to_string().contains("give 1 to 1000"));
        }
    }
}
