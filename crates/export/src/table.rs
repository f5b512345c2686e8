//! The ends of a trajectory's segments.
//!
//! A cubic is known by position and velocity at both ends, so a PVT program loses nothing of a
//! trajectory whose positions and velocities are continuous. A segment that is longer than a
//! controller allows is cut into equal times on the same cubic.

use planish_numerics::polynomial::{derivative, evaluate};
use planish_types::{Invalid, Segment, Trajectory, budget::affordable};

/// Memory of a segment: ends as floats and as counts, and two lines of text (up to 60 bytes each).
const BYTES_PER_SEGMENT: usize = 256;

/// Fractions of a segment at which a cubic is compared with a straight line: what lies between is larger by a few percent.
const WITHIN: [f64; 3] = [0.25, 0.5, 0.75];

/// Ends of segments: n + 1 of them, with n flags of the tool between.
#[derive(Clone, Debug)]
pub struct Table {
    /// Time since the start of the motion (n+1), s.
    pub time_s: Vec<f64>,
    /// Position [x, y] (n+1), mm.
    pub position_mm: Vec<[f64; 2]>,
    /// Velocity [x, y] (n+1), mm/s.
    pub velocity_mm_per_s: Vec<[f64; 2]>,
    /// Whether the tool removes (n).
    pub tool_on: Vec<bool>,
    /// Largest distance of the motion from the straight line between two ends, at equal times, mm.
    pub from_straight_mm: f64,
}

impl Table {
    /// The ends of `trajectory`, at most `step_s` apart; `remedy` says how the user makes that longer.
    pub fn of(trajectory: &Trajectory, step_s: f64, remedy: &str) -> Result<Self, Invalid> {
        let parts = |duration_s: f64| (duration_s / step_s).ceil().max(1.0);
        let all: f64 = trajectory.segments().map(|s| parts(s.duration_s)).sum();
        let all = affordable("program segments", all, BYTES_PER_SEGMENT, remedy)?;
        let start_s = trajectory.break_time_s()[0];
        let mut table = Self {
            time_s: Vec::with_capacity(all + 1),
            position_mm: Vec::with_capacity(all + 1),
            velocity_mm_per_s: Vec::with_capacity(all + 1),
            tool_on: Vec::with_capacity(all),
            from_straight_mm: 0.0,
        };
        for segment in trajectory.segments() {
            let parts = parts(segment.duration_s) as usize;
            for k in 0..parts {
                let u = segment.duration_s * k as f64 / parts as f64;
                table.push(segment.start_s - start_s + u, &segment, u);
                table.tool_on.push(segment.tool_on);
                let at = |f: f64| segment.position_mm(u + f * segment.duration_s / parts as f64);
                let (from, to) = (at(0.0), at(1.0));
                for f in WITHIN {
                    let p = at(f);
                    let off = [0, 1].map(|a| p[a] - from[a] - f * (to[a] - from[a]));
                    table.from_straight_mm = table.from_straight_mm.max(off[0].hypot(off[1]));
                }
            }
        }
        let last = trajectory.segment(trajectory.len() - 1);
        table.push(trajectory.total_time_s(), &last, last.duration_s);
        Ok(table)
    }

    /// The state at the local time `u_s` of `segment`.
    fn push(&mut self, time_s: f64, segment: &Segment, u_s: f64) {
        self.time_s.push(time_s);
        self.position_mm.push(segment.position_mm(u_s));
        self.velocity_mm_per_s.push(segment.coefficient_mm.map(|c| evaluate(&derivative(&c), u_s)));
    }

    /// How far the motion goes along the axis along which it goes farthest, mm.
    pub fn extent_mm(&self) -> f64 {
        let extent = |axis: usize| {
            let along = || self.position_mm.iter().map(|p| p[axis]);
            along().fold(f64::MIN, f64::max) - along().fold(f64::MAX, f64::min)
        };
        extent(0).max(extent(1))
    }
}
