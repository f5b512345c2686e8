//! A table of the motion for controllers that are not known here: one row per end of a segment,
//! `t_s,x_mm,vx_mm_per_s,y_mm,vy_mm_per_s,tool_on`. Between two rows the motion is the cubic through
//! their positions and velocities; `tool_on` counts from its row to the next. The last row has 0: whoever
//! switches at every row has the tool off at the end.

use planish_types::Invalid;
use serde::Serialize;

use crate::{
    Abilities, About, Approach, Job, Tool, decimal, header::Comment, limits::Between, tick,
};

/// Decimals of all numbers.
const DIGITS: usize = 9;
/// The last of them, of a velocity.
const VELOCITY_MM_PER_S: f64 = 1e-9;

/// No controller, so no limit: what an editor shows without folding.
const COMMENT: Comment = Comment { open: "# ", close: "", line: 120 };

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

pub(crate) fn write(job: &Job, settings: &Settings) -> Result<(String, About), Invalid> {
    let tick_s = tick(settings.tick_s)?;
    let (q, about) = job.quantised(Abilities {
        controller: "csv",
        tick_s,
        ticks: [1, i64::MAX >> 10],
        velocity_mm_per_s: [VELOCITY_MM_PER_S; 2],
        between: Between::Cubic,
        tool: Tool::Switched("column tool_on, from its row to the next, 0 in the last row".into()),
        approach: Approach::Before("go to the first row, tool off: the table does not say how"),
    })?;
    let mut text = about.header(&COMMENT, "s, mm, mm/s");
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
            u8::from(k < about.segments && q.tool_on[k])
        );
    }
    Ok((text, about))
}
