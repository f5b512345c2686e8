//! Newport XPS, PVT trajectory file: one line `dt, dx, vx, dy, vy` per element, distances relative,
//! velocities at the end, in mm and s. The file has no header, so what it is made from is in the file
//! beside it only.
//!
//! The controller refuses an element without time and a last velocity that is not zero. It does not
//! check where a relative motion ends: the start must be where `start_mm` says.
//!
//! Source: XPS user's manual, section on PVT trajectories.

use planish_types::Invalid;
use serde::Serialize;

use crate::{Abilities, Job, Program, decimal, positive, table::Ends};

/// Decimals of a distance in mm, a velocity in mm/s and a time in s.
const DIGITS: usize = 9;

/// How a trajectory file is written.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Settings {
    /// What a time is rounded to, s.
    pub tick_s: f64,
}

impl Default for Settings {
    fn default() -> Self {
        // The servo cycle.
        Self { tick_s: 1e-4 }
    }
}

pub(crate) fn write(job: &Job, settings: &Settings) -> Result<Program, Invalid> {
    let tick_s = positive("tick_s", settings.tick_s)?;
    let (q, about) = job.quantised(&Abilities {
        controller: "xps",
        tick_s,
        ticks: [1, i64::MAX >> 10],
        ends: Ends::PositionAndVelocity,
        switches_tool: false,
        from_rest: true,
    })?;
    let n = about.segments;
    let mut text = String::new();
    for k in 0..n {
        let distance = q.distance(k);
        // The last velocity is zero to rounding; the controller wants it exactly.
        let velocity = if k + 1 == n { [0.0; 2] } else { q.velocity_mm_per_s[k + 1] };
        text += &decimal(q.duration(k) as f64 * tick_s, DIGITS);
        for axis in 0..2 {
            let d = distance[axis] as f64 * job.common.count_mm[axis];
            text += &format!(", {}, {}", decimal(d, DIGITS), decimal(velocity[axis], DIGITS));
        }
        text.push('\n');
    }
    Ok(Program { text, about })
}
