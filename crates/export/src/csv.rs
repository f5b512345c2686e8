//! A table of the motion for controllers that are not known here: one row per end of a segment,
//! `t_s,x_mm,vx_mm_per_s,y_mm,vy_mm_per_s,tool_on`. Between two rows the motion is the cubic through
//! their positions and velocities; `tool_on` counts from its row to the next.

use planish_types::Invalid;
use serde::Serialize;

use crate::{Abilities, Job, Program, decimal, positive, table::Ends};

/// Decimals of all numbers.
const DIGITS: usize = 9;

/// How a table is written.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Settings {
    /// What a time is rounded to, s.
    pub tick_s: f64,
}

impl Default for Settings {
    fn default() -> Self {
        Self { tick_s: 1e-6 }
    }
}

pub(crate) fn write(job: &Job, settings: &Settings) -> Result<Program, Invalid> {
    let tick_s = positive("tick_s", settings.tick_s)?;
    let (q, about) = job.quantised(&Abilities {
        controller: "csv",
        tick_s,
        ticks: [1, i64::MAX >> 10],
        ends: Ends::PositionAndVelocity,
        switches_tool: true,
        from_rest: false,
    })?;
    let mut text = String::new();
    for line in about.header("s, mm, mm/s") {
        text += &format!("# {line}\n");
    }
    text += "t_s,x_mm,vx_mm_per_s,y_mm,vy_mm_per_s,tool_on\n";
    for k in 0..=about.segments {
        let (p, v) = (q.position_mm(k), q.velocity_mm_per_s[k]);
        text += &format!(
            "{},{},{},{},{},{}\n",
            decimal(q.time_s(k), DIGITS),
            decimal(p[0], DIGITS),
            decimal(v[0], DIGITS),
            decimal(p[1], DIGITS),
            decimal(v[1], DIGITS),
            u8::from(q.tool_on[k.min(about.segments - 1)])
        );
    }
    Ok(Program { text, about })
}
