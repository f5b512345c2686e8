//! A table of the motion for controllers that are not known here: one row per end of a segment,
//! `t_s,x_mm,vx_mm_per_s,y_mm,vy_mm_per_s,tool_on`. Between two rows the motion is the cubic through
//! their positions and velocities; `tool_on` counts from its row to the next. The last row has 0: whoever
//! switches at every row has the tool off at the end.

use planish_types::Invalid;

use crate::{Abilities, About, Approach, Job, Tool, decimal, header::Comment};

/// Number of decimals of all numbers. Larger: longer rows. Smaller: rounding that a controller may notice. Chosen:
/// counts below 1e-9 mm and clocks below 1e-9 s are refused.
const DIGITS: usize = 9;

/// No controller, so no limit: what an editor shows without folding.
const COMMENT: Comment = Comment { open: "# ", close: "", line: 120 };

pub(crate) fn write(job: &Job) -> Result<(String, About), Invalid> {
    job.tick()?;
    let (q, about) = job.nodes(Abilities {
        most_ticks: i64::MAX >> 10,
        tool: match job.grids.switches_tool {
            true => {
                Tool::Switched("column tool_on, from its row to the next, 0 in the last row".into())
            }
            false => Tool::LeftToTheHost("no output of the controller does: the host switches it"),
        },
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
