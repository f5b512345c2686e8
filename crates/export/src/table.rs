//! The ends of a trajectory's segments.
//!
//! A cubic is known by position and velocity at both ends, so a PVT program loses nothing of a
//! trajectory whose positions and velocities are continuous. A segment that is longer than a
//! controller allows is cut into equal times on the same cubic.

use planish_types::{Invalid, Trajectory};

/// Steps in position and velocity that are rounding, mm and mm/s: the accuracy to which a schedule
/// is fitted by cubics.
const STEP_MM: f64 = 1e-6;
const STEP_MM_PER_S: f64 = 1e-6;

/// What a program keeps at the end of a segment.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Ends {
    /// One position.
    Position,
    /// One position and one velocity.
    PositionAndVelocity,
}

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
}

impl Table {
    /// The ends of `trajectory`, at most `step_s` apart.
    pub fn of(trajectory: &Trajectory, step_s: f64, ends: Ends) -> Result<Self, Invalid> {
        let start_s = trajectory.break_time_s()[0];
        let mut table = Self {
            time_s: Vec::new(),
            position_mm: Vec::new(),
            velocity_mm_per_s: Vec::new(),
            tool_on: Vec::new(),
        };
        let mut last: Option<([f64; 2], [f64; 2])> = None;
        for (i, segment) in trajectory.segments().enumerate() {
            let at = |u: f64| {
                let v = segment.coefficient_mm.map(|c| c[1] + u * (2.0 * c[2] + u * 3.0 * c[3]));
                (segment.position_mm(u), v)
            };
            if let Some(before) = last {
                join(i, before, at(0.0), ends)?;
            }
            let parts = (segment.duration_s / step_s).ceil();
            if parts > 1e7 {
                let problem = format!("would be cut into {parts} parts");
                return Err(Invalid::at("segment", i, problem, "give a longer --max-step-s"));
            }
            let parts = parts.max(1.0) as usize;
            for k in 0..parts {
                let u = segment.duration_s * k as f64 / parts as f64;
                let (p, v) = at(u);
                table.time_s.push(segment.start_s - start_s + u);
                table.position_mm.push(p);
                table.velocity_mm_per_s.push(v);
                table.tool_on.push(segment.tool_on);
            }
            last = Some(at(segment.duration_s));
        }
        let (p, v) = last.expect("a trajectory has a segment");
        table.time_s.push(trajectory.total_time_s());
        table.position_mm.push(p);
        table.velocity_mm_per_s.push(v);
        Ok(table)
    }

    /// Refuses a motion that does not start and end at rest.
    pub fn check_rest(&self) -> Result<(), Invalid> {
        let n = self.tool_on.len();
        for (name, i) in [("starts", 0), ("ends", n)] {
            let v = self.velocity_mm_per_s[i];
            if v.iter().any(|v| v.abs() > STEP_MM_PER_S) {
                let problem = format!("{name} with the velocity {v:?} mm/s");
                let remedy = "a PVT program starts and ends at rest; schedule from rest to rest";
                return Err(Invalid::whole("trajectory", problem, remedy));
            }
        }
        Ok(())
    }
}

/// Whether segment `i` goes on where the one before it ends.
fn join(
    i: usize,
    before: ([f64; 2], [f64; 2]),
    after: ([f64; 2], [f64; 2]),
    ends: Ends,
) -> Result<(), Invalid> {
    for axis in 0..2 {
        let jump = after.0[axis] - before.0[axis];
        if jump.abs() > STEP_MM {
            let problem = format!("begins {jump} mm from the end of the one before");
            return Err(Invalid::at(
                "segment",
                i,
                problem,
                "no axis jumps; export another schedule",
            ));
        }
        let step = after.1[axis] - before.1[axis];
        let rounding = STEP_MM_PER_S * before.1[axis].abs().max(1.0);
        if ends == Ends::PositionAndVelocity && step.abs() > rounding {
            let problem = format!("begins with a step in velocity of {step} mm/s");
            let remedy = "a PVT program has one velocity there; use gcode, or a smooth schedule";
            return Err(Invalid::at("segment", i, problem, remedy));
        }
    }
    Ok(())
}
