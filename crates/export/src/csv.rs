//! A table of the motion for controllers that are not known here: one row per end of a segment,
//! `t_s,x_mm,vx_mm_per_s,y_mm,vy_mm_per_s,tool_on`, with two columns for every further axis, `a_deg,va_deg_per_s` for
//! one that turns. Between two rows the motion is the cubic through their positions and velocities; `tool_on` counts
//! from its row to the next. The last row has 0: whoever switches at every row has the tool off at the end.

use planish_types::Invalid;

use crate::{Abilities, About, Approach, Job, Tool, decimal, header::Comment};

/// Number of decimals of all numbers of the table. Larger: longer rows. Smaller: rounding that a controller may notice.
/// Chosen: counts below 1e-9 mm and clocks below 1e-9 s are refused.
const DIGITS: usize = 9;

/// Form of a comment line. The table is for no known controller, so 120 characters are chosen for reading.
pub(crate) const COMMENT: Comment = Comment { open: "# ", close: "", line: 120 };

pub(crate) fn write<const N: usize>(job: &Job<N>) -> Result<(String, About), Invalid> {
    job.tick()?;
    let (q, mut about) = job.nodes(Abilities {
        most_ticks: i64::MAX >> 10,
        tool: if job.grids.switches_tool {
            Tool::Switched("column tool_on, from its row to the next, 0 in the last row".into())
        } else {
            Tool::LeftToTheHost("no output of the controller does: the host switches it")
        },
        approach: Approach::Before("go to the first row, tool off: the table does not say how"),
    })?;
    let units = if job.turns() { "s, mm, mm/s, deg, deg/s" } else { "s, mm, mm/s" };
    let mut text = about.header(&COMMENT, units);
    let columns = job.plan.axes.iter().map(|axis| {
        let name = axis.name;
        let unit = axis.unit();
        format!("{name}_{unit},v{name}_{unit}_per_s,")
    });
    text += &format!("t_s,{}tool_on\n", columns.collect::<String>());
    for k in 0..=about.segments {
        about.marks.add(&text, q.time_s(k), q.position(k));
        text += &decimal(q.time_s(k), DIGITS);
        for (p, v) in q.position(k).into_iter().zip(q.velocity[k]) {
            text += &format!(",{},{}", decimal(p, DIGITS), decimal(v, DIGITS));
        }
        text += &format!(",{}\n", u8::from(k < about.segments && q.tool_on[k]));
    }
    Ok((text, about))
}
