//! Headings: directions of the motion, for tools that turn with it.
//!
//! A tool at rest keeps the direction in which it came. Before the first motion it has the direction of that motion. A
//! jump between two segments counts as a motion.

use planish_numerics::polynomial;

use crate::{Pose, Segment, ToolPath, Trajectory};

/// Distance up to which a tool counts as at rest, mm. Larger: short motions lose their direction. Smaller: rounding of
/// the coordinates makes directions.
const AT_REST_MM: f64 = 1e-6;

/// Distance in time from either end of a segment at which the direction of that end is taken, over the duration. At the
/// end itself the tool may stand still. Larger: a direction further back along bent motions. Smaller: rounding decides.
const NEAR_END: f64 = 1e-3;

/// Directions of a trajectory at any time, rad; 0 is along positive x, and angles count towards positive y.
#[derive(Clone, Debug, PartialEq)]
pub struct Headings {
    /// For each segment, the direction at its end; for a segment at rest, the direction that the tool keeps.
    at_rest_rad: Vec<f64>,
}

impl Headings {
    /// Returns the directions of the motion along a trajectory.
    pub fn new(trajectory: &Trajectory) -> Self {
        let mut end_mm: Option<[f64; 2]> = None;
        let mut first_rad = None;
        let mut last_rad = Vec::with_capacity(trajectory.len());
        for s in trajectory.segments() {
            let start = s.position_mm(0.0);
            let jump_rad = end_mm.and_then(|end| along_rad([start[0] - end[0], start[1] - end[1]]));
            end_mm = Some(s.position_mm(s.duration_s));
            let [begin_rad, end_rad] =
                [NEAR_END, 1.0 - NEAR_END].map(|part| moving_rad(&s, part * s.duration_s));
            first_rad = first_rad.or(jump_rad).or(begin_rad);
            last_rad.push(end_rad.or(jump_rad));
        }
        Self { at_rest_rad: held(first_rad, last_rad) }
    }

    /// Returns the position and the direction of the tool at the time `u_s` after the start of `segment`; `index` is
    /// the index of the segment.
    pub fn pose(&self, index: usize, segment: &Segment<'_>, u_s: f64) -> Pose {
        Pose {
            position_mm: segment.position_mm(u_s),
            heading_rad: moving_rad(segment, u_s).unwrap_or(self.at_rest_rad[index]),
        }
    }
}

/// Returns the direction of each segment of a path (n), rad from positive x towards positive y. A segment without
/// length has the direction of the one before it.
pub fn headings_of_path_rad(path: &ToolPath) -> Vec<f64> {
    let all: Vec<Option<f64>> =
        (0..path.len()).map(|j| along_rad(path.displacement_mm(j))).collect();
    held(all.iter().copied().flatten().next(), all)
}

/// Returns the direction of the displacement [x, y] in mm, rad, or `None` if it is too short to have one.
fn along_rad([x, y]: [f64; 2]) -> Option<f64> {
    if x.hypot(y) > AT_REST_MM { Some(y.atan2(x)) } else { None }
}

/// Replaces each `None` by the direction before it, rad. Before the first direction it inserts `first`, the direction
/// of the first motion, or 0.
fn held(first: Option<f64>, directions: Vec<Option<f64>>) -> Vec<f64> {
    let mut last_rad = first.unwrap_or(0.0);
    let mut held_rad = Vec::with_capacity(directions.len());
    for direction in directions {
        last_rad = direction.unwrap_or(last_rad);
        held_rad.push(last_rad);
    }
    held_rad
}

/// Returns the direction at the time `u_s` after the start of a segment, rad, or `None` if the tool rests.
fn moving_rad(segment: &Segment<'_>, u_s: f64) -> Option<f64> {
    if moves(segment) { direction_rad(segment, u_s) } else { None }
}

/// Returns true if the tool may move further than [`AT_REST_MM`] during a segment.
fn moves(segment: &Segment<'_>) -> bool {
    let h = segment.duration_s;
    let most = |c: &[f64; 4]| h * (c[1].abs() + h * (c[2].abs() + h * c[3].abs()));
    segment.coefficient_mm.iter().any(|c| most(c) > AT_REST_MM)
}

/// Returns the direction of the velocity at the time `u_s` after the start of a segment, rad, or `None` if the velocity
/// is 0.
fn direction_rad(segment: &Segment<'_>, u_s: f64) -> Option<f64> {
    let [vx, vy] = [0, 1].map(|axis| {
        polynomial::evaluate(&polynomial::derivative(&segment.coefficient_mm[axis]), u_s)
    });
    if vx != 0.0 || vy != 0.0 { Some(vy.atan2(vx)) } else { None }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::{FRAC_PI_2, PI};

    use super::*;

    #[test]
    fn a_tool_at_rest_keeps_the_direction_in_which_it_came() {
        // It rests, goes up to a stop, rests, and comes back to the left from rest.
        let (rest, up) = ([[0.0; 4]; 2], [[0.0; 4], [0.0, 2.0, -1.0, 0.0]]);
        let there = [[0.0; 4], [1.0, 0.0, 0.0, 0.0]];
        let left = [[0.0, 0.0, -1.0, 0.0], [1.0, 0.0, 0.0, 0.0]];
        let breaks = vec![0.0, 1.0, 2.0, 3.0, 4.0];
        let motion =
            Trajectory::new(breaks, vec![rest, up, there, left], vec![true; 4], vec![None; 4]);
        let motion = motion.unwrap();
        let headings = Headings::new(&motion);
        let at = |k: usize, u: f64| headings.pose(k, &motion.segment(k), u).heading_rad;
        let expected = [FRAC_PI_2, FRAC_PI_2, FRAC_PI_2, PI];
        for (k, expected) in expected.into_iter().enumerate() {
            for u in [0.0, 0.3, 1.0] {
                // At u = 0 of the last segment the tool stands, and its end decides.
                assert!((at(k, u) - expected).abs() < 1e-12, "{k} {u}: {}", at(k, u));
            }
        }
    }

    #[test]
    fn a_tool_that_jumps_has_the_direction_of_the_jump() {
        let at = |x: f64, y: f64| [[x, 0.0, 0.0, 0.0], [y, 0.0, 0.0, 0.0]];
        let places = vec![at(0.0, 0.0), at(0.0, 1.0), at(-1.0, 1.0)];
        let breaks = vec![0.0, 1.0, 2.0, 3.0];
        let motion = Trajectory::new(breaks, places, vec![true; 3], vec![None; 3]).unwrap();
        let headings = Headings::new(&motion);
        let found = [0, 1, 2].map(|k| headings.pose(k, &motion.segment(k), 0.5).heading_rad);
        assert_eq!(found, [FRAC_PI_2, FRAC_PI_2, PI]);
    }

    #[test]
    fn a_bent_motion_has_the_direction_of_its_velocity() {
        // (u, u^2): the direction is atan(2 u).
        let c = [[0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]];
        let motion = Trajectory::new(vec![0.0, 2.0], vec![c], vec![true], vec![None]).unwrap();
        let pose = Headings::new(&motion).pose(0, &motion.segment(0), 1.5);
        assert_eq!(pose.position_mm, [1.5, 2.25]);
        // Rounding of an angle of the order 1.
        assert!((pose.heading_rad - 3.0_f64.atan()).abs() < 1e-15);
    }

    #[test]
    fn segments_of_a_path_without_a_length_have_the_direction_before() {
        let points = vec![[0.0, 0.0], [0.0, 0.0], [1.0, 1.0], [1.0, 1.0], [1.0, 0.0]];
        let path = ToolPath::through(points, vec![true; 4], vec![0; 4]).unwrap();
        let found = headings_of_path_rad(&path);
        let expected = [0.25 * PI, 0.25 * PI, 0.25 * PI, -FRAC_PI_2];
        // Rounding of angles of the order 1.
        assert!(found.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-15), "{found:?}");
    }
}
