//! The straight passes of a tool path, what joins them, and the limits of the machine along them.
//!
//! A pass is the longest straight stretch with the tool on among the consecutive segments of one
//! `pass_idx`. The other segments of the path join the passes: turn-arounds with the tool on, lifts
//! with the tool off. They are not followed; a link between the ends of the passes takes their
//! place ([`crate::motion`]). So a segment with the tool on that is not on a pass may not lie inside
//! the clear aperture: a pixel is inside when it and its eight neighbours are valid.

use planish_types::{Grid, Limits, Surface, ToolPath};

use crate::FeedError;

/// Angle (its sine) between a segment and the first one of a straight run, rad, below which the segment continues the
/// run. It is a sideways step of 0.1 um per mm, above the rounding of coordinates that passed through 32-bit floats.
/// Larger: bent paths pass as straight. Smaller: rounding divides passes.
const STRAIGHT: f64 = 1e-4;

/// Fraction of the machine's limits on velocity and acceleration that passes leave free, for the rounding of the
/// polynomials. Larger: slower feeds. Smaller: rounding exceeds the limits.
const MARGIN: f64 = 1e-6;

/// A straight part of the path with the tool on.
#[derive(Clone, Debug, PartialEq)]
pub struct Pass {
    /// Index of its first segment in the path.
    pub first_segment: usize,
    /// Arc length of the path at the start of the pass, mm.
    pub arc_start_mm: f64,
    /// Start point [x, y], mm.
    pub start_mm: [f64; 2],
    /// Direction of the pass as a unit vector [x, y].
    pub direction: [f64; 2],
    /// Distances of the points of the path on the pass from its start, ascending from 0, mm.
    pub node_mm: Vec<f64>,
    /// True if the tool stays on until the next pass; false after the last.
    pub tool_on_after: bool,
    /// Largest feed along the pass that the limits of the axes allow, mm/s.
    pub max_feed_mm_per_s: f64,
    /// Largest acceleration along the pass, mm/s^2.
    pub max_acceleration_mm_per_s2: f64,
}

impl Pass {
    /// Returns the length of the pass, mm.
    pub fn length_mm(&self) -> f64 {
        *self.node_mm.last().expect("a pass has a segment")
    }

    /// Returns the point [x, y], mm, at the distance `s_mm` from the start of the pass.
    pub fn position(&self, s_mm: f64) -> [f64; 2] {
        [0, 1].map(|k| self.start_mm[k] + s_mm * self.direction[k])
    }
}

/// Returns the straight passes of `path` over `surface` in order; there is at least one.
///
/// # Errors
/// Refuses a path with a segment inside the clear aperture that has the tool on but belongs to no pass. Refuses a path
/// without a straight pass.
pub fn passes(path: &ToolPath, surface: &Surface, limits: &Limits) -> Result<Vec<Pass>, FeedError> {
    let idx = path.pass_idx();
    let on = path.tool_on();
    let mut arc_mm = vec![0.0];
    for i in 0..path.len() {
        arc_mm.push(arc_mm[i] + path.segment_length_mm(i));
    }
    let mut passes: Vec<Pass> = Vec::new();
    let mut begin = 0;
    while begin < path.len() {
        let end = (begin..path.len()).find(|i| idx[*i] != idx[begin]).unwrap_or(path.len());
        let runs = straight_runs(path, begin, end);
        // The first of equally long runs.
        let longest = runs.iter().copied().rev().max_by(|a, b| {
            let [a, b] = [a, b].map(|run| arc_mm[run.1] - arc_mm[run.0]);
            a.total_cmp(&b)
        });
        if let Some(run) = longest {
            for i in begin..end {
                let on_pass = (run.0..run.1).contains(&i);
                if on[i] && !on_pass {
                    refuse_inside(path, surface, i)?;
                }
            }
            passes.push(pass(path, limits, run, arc_mm[run.0]));
        }
        begin = end;
    }
    if passes.is_empty() {
        return Err(FeedError::OutOfReach);
    }
    // The tool stays on between two passes when no segment between them lifts it.
    for m in 0..passes.len() - 1 {
        let from = passes[m].first_segment + passes[m].node_mm.len() - 1;
        passes[m].tool_on_after = (from..passes[m + 1].first_segment).all(|i| on[i]);
    }
    Ok(passes)
}

/// Returns the ranges [first, end) of segments between the indices `begin` and `end` that run in one direction with the
/// tool on, each as long as possible.
fn straight_runs(path: &ToolPath, begin: usize, end: usize) -> Vec<(usize, usize)> {
    let mut runs: Vec<(usize, usize)> = Vec::new();
    let mut current: Option<[f64; 2]> = None;
    for i in begin..end {
        let l = path.segment_length_mm(i);
        let this = if l > 0.0 && path.tool_on()[i] {
            Some(path.displacement_mm(i).map(|d| d / l))
        } else {
            None
        };
        match (current, this) {
            (Some(a), Some(b))
                if (a[0] * b[1] - a[1] * b[0]).abs() < STRAIGHT
                    && a[0] * b[0] + a[1] * b[1] > 0.0 =>
            {
                runs.last_mut().expect("it has begun").1 = i + 1;
            }
            (_, Some(b)) => {
                runs.push((i, i + 1));
                current = Some(b);
            }
            (_, None) => current = None,
        }
    }
    runs
}

/// Makes the pass of the segments `run.0` to `run.1 - 1`, which starts at the arc length `arc_start_mm` of the path.
fn pass(path: &ToolPath, limits: &Limits, run: (usize, usize), arc_start_mm: f64) -> Pass {
    let points = &path.point_mm()[run.0..=run.1];
    let start_mm = points[0];
    let end_mm = points[points.len() - 1];
    let dx = end_mm[0] - start_mm[0];
    let dy = end_mm[1] - start_mm[1];
    let length = dx.hypot(dy);
    let direction = [dx / length, dy / length];
    let node_mm = points
        .iter()
        .map(|p| (p[0] - start_mm[0]) * direction[0] + (p[1] - start_mm[1]) * direction[1])
        .collect();
    // F = min_axis V / |t|,  A = min_axis A / |t|
    let [max_feed, max_acceleration] =
        [limits.max_velocity_mm_per_s(), limits.max_acceleration_mm_per_s2()].map(|limit| {
            let [x, y] = [0, 1].map(|k| (1.0 - MARGIN) * limit[k] / direction[k].abs());
            x.min(y)
        });
    Pass {
        first_segment: run.0,
        arc_start_mm,
        start_mm,
        direction,
        node_mm,
        tool_on_after: false,
        max_feed_mm_per_s: max_feed,
        max_acceleration_mm_per_s2: max_acceleration,
    }
}

/// Refuses segment `i`, which is on no pass, if one of its ends or its middle lies inside the clear aperture.
fn refuse_inside(path: &ToolPath, surface: &Surface, i: usize) -> Result<(), FeedError> {
    let a = path.point_mm()[i];
    let d = path.displacement_mm(i);
    for f in [0.0, 0.5, 1.0] {
        let point_mm = [a[0] + f * d[0], a[1] + f * d[1]];
        if is_inside(surface, point_mm) {
            return Err(FeedError::CornerInside { segment: i, point_mm });
        }
    }
    Ok(())
}

/// Returns true if the pixel nearest to the point, mm, and its eight neighbours exist and are valid.
pub(crate) fn is_inside(surface: &Surface, [x, y]: [f64; 2]) -> bool {
    let Grid { x: ax, y: ay } = surface.grid();
    let c = ((x - ax.start_mm()) / ax.step_mm()).round();
    let r = ((y - ay.start_mm()) / ay.step_mm()).round();
    if [(c, ax.len()), (r, ay.len())].iter().any(|(v, n)| !(*v >= 1.0 && v + 1.0 < *n as f64)) {
        return false;
    }
    let r = r as usize;
    let c = c as usize;
    (r - 1..=r + 1).all(|r| (c - 1..=c + 1).all(|c| !surface.height_nm()[[r, c]].is_nan()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::Array2;
    use planish_types::Axis;

    fn machine() -> Limits {
        planish_testkit::machine([10.0, 20.0], [100.0, 50.0])
    }

    /// Makes a map of 4 x 4 mm in pixels of 0.5 mm around (0, 0).
    fn square() -> Surface {
        let axis = Axis::new(-2.0, 0.5, 9).unwrap();
        Surface::new(Grid { x: axis, y: axis }, Array2::ones((9, 9))).unwrap()
    }

    #[test]
    fn a_raster_has_its_lines_and_knows_what_joins_them() {
        let points = vec![
            [-3.0, -1.0],
            [0.0, -1.0],
            [3.0, -1.0], // pass 0
            [3.0, 0.0],  // turn
            [0.0, 0.0],
            [-3.0, 0.0], // pass 1
            [-3.0, 1.0], // lift
            [3.0, 1.0],  // pass 2
        ];
        let on = vec![true, true, true, true, true, false, true];
        let path = ToolPath::through(points, on, vec![0, 0, 0, 1, 1, 1, 2]).unwrap();
        let passes = passes(&path, &square(), &machine()).unwrap();
        let summary: Vec<_> = passes
            .iter()
            .map(|p| (p.first_segment, p.arc_start_mm, p.direction, p.length_mm(), p.tool_on_after))
            .collect();
        assert_eq!(
            summary,
            [
                (0, 0.0, [1.0, 0.0], 6.0, true),
                (3, 7.0, [-1.0, 0.0], 6.0, false),
                (6, 14.0, [1.0, 0.0], 6.0, false),
            ]
        );
        assert_eq!(passes[0].node_mm, [0.0, 3.0, 6.0]);
        assert!((passes[0].max_feed_mm_per_s / 10.0 - 1.0).abs() < 2.0 * MARGIN);
    }

    #[test]
    fn a_diagonal_pass_is_limited_by_the_weaker_axis() {
        let path = ToolPath::through(vec![[-3.0, -4.0], [3.0, 4.0]], vec![true], vec![0]).unwrap();
        let pass = &passes(&path, &square(), &machine()).unwrap()[0];
        // 10/0.6 < 20/0.8;  50/0.8 < 100/0.6
        assert!((pass.max_feed_mm_per_s * 0.6 / 10.0 - 1.0).abs() < 2.0 * MARGIN);
        assert!((pass.max_acceleration_mm_per_s2 * 0.8 / 50.0 - 1.0).abs() < 2.0 * MARGIN);
    }

    #[test]
    fn a_corner_inside_the_aperture_is_refused_and_one_on_its_edge_is_not() {
        let corner = |x: f64| {
            let points = vec![[-3.0, -1.0], [x, -1.0], [x, 1.0]];
            let path = ToolPath::through(points, vec![true; 2], vec![0; 2]).unwrap();
            passes(&path, &square(), &machine())
        };
        assert!(matches!(corner(1.0), Err(FeedError::CornerInside { segment: 1, .. })));
        assert!(corner(2.0).is_ok(), "the outermost pixels are the edge");
    }

    #[test]
    fn a_path_that_is_lifted_everywhere_is_refused() {
        let path = ToolPath::through(vec![[-3.0, 0.0], [3.0, 0.0]], vec![false], vec![0]).unwrap();
        assert_eq!(passes(&path, &square(), &machine()), Err(FeedError::OutOfReach));
    }
}
