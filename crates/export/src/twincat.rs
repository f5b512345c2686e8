//! Beckhoff TwinCAT, a table of setpoints for our program in the PLC (`docs/twincat-table.st`): one row per cycle of
//! the task, which feeds them to the axes by `MC_ExtSetPointGenFeed`.
//!
//! ```text
//! cycle_s,0.002
//! cycle,x_mm,vx_mm_per_s,ax_mm_per_s2,y_mm,...,tool_on,segment
//! ```
//!
//! The row of cycle k has the position, velocity and acceleration of every axis at the time k times the cycle; a rotary
//! axis has columns in degrees. The acceleration is that after this time. `tool_on` counts from its row to the next,
//! and the last row has 0. `segment` counts the cubics of the motion: all its rows lie on the one through its first row
//! and the first row of the next.
//!
//! The start: the table begins at rest in the start position, from elsewhere its first row is a leap.
//!
//! Source: Beckhoff, TwinCAT 3 PLC Lib Tc2_MC2, *External set value generator* (MC_ExtSetPointGenEnable,
//! MC_ExtSetPointGenFeed), and Tc2_System, FB_FileGets (lines of up to 255 characters).

use planish_numerics::polynomial::{derivative, evaluate};
use planish_types::{Invalid, budget::affordable};

use crate::{Abilities, About, Approach, Job, Tool, decimal, header::Comment};

/// Form of a comment. A longer line would not fit a string of the PLC (255 characters).
pub(crate) const COMMENT: Comment = Comment { open: "# ", close: "", line: 120 };

/// Number of decimals of positions, velocities and accelerations, mm or degrees and per s. Larger: longer rows. Smaller:
/// accelerations of the cubic between two rows that are off: by 6 / T^2 of the last decimal of a position and by 4 / T
/// of that of a velocity, T being the cycle. Derived: at 1 ms these are 3e-7 and 2e-7 mm/s^2.
const DIGITS: [usize; 3] = [13, 10, 6];

/// Memory that a row needs, bytes, for the check of the memory budget. Larger: tables are refused that fit. Smaller: the
/// memory may run out. Derived: five axes with three numbers of up to 17 characters each.
const BYTES_PER_ROW: usize = 300;

pub(crate) fn write<const N: usize>(job: &Job<N>) -> Result<(String, About), Invalid> {
    let tick_s = job.tick()?;
    let (q, mut about) = job.nodes(Abilities {
        most_ticks: i64::MAX >> 10,
        tool: if job.grids.switches_tool {
            Tool::Switched(
                "column tool_on, from its row to the next, 0 in the last row: our program in the PLC sets bToolOn, \
                 and resets it on every stop"
                    .into(),
            )
        } else {
            Tool::LeftToTheHost("no output of the controller does: the host switches it")
        },
        approach: Approach::Before(
            "go to the start, tool off: the table does not say how, and our program in the PLC refuses to begin \
             elsewhere. Its task has the cycle of the table, that of the NC task",
        ),
    })?;
    let n = about.segments;
    let cycles = (q.ticks[n] - q.ticks[0]) as f64;
    affordable("rows of the table", cycles, BYTES_PER_ROW, "give a larger `tick_s`")?;
    let units = if job.turns() { "mm or deg, and per s and s^2" } else { "mm, mm/s, mm/s^2" };
    let mut text = about.header(&COMMENT, units);
    text += &format!("cycle_s,{}\ncycle,", decimal(tick_s, 9));
    for axis in job.plan.axes {
        let (name, unit) = (axis.name, axis.unit());
        text += &format!("{name}_{unit},v{name}_{unit}_per_s,a{name}_{unit}_per_s2,");
    }
    text += "tool_on,segment\n";
    let start = q.ticks[0];
    for cubic in q.pieces() {
        let k = cubic.segment;
        about.marks.add(&text, q.time_s(k), q.position(k));
        for tick in q.ticks[k]..q.ticks[k + 1] {
            let u = (tick - q.ticks[k]) as f64 * tick_s;
            let states = cubic.coefficient.map(|c| state(&c, u));
            text += &row(tick - start, &states, q.tool_on[k], k);
        }
    }
    let rest = q.position(n).map(|p| [p, 0.0, 0.0]);
    text += &row(q.ticks[n] - start, &rest, false, n);
    Ok((text, about))
}

/// Returns the position, velocity and acceleration of a cubic at the time `u` since its start, s.
fn state(c: &[f64; 4], u: f64) -> [f64; 3] {
    let v = derivative(c);
    [evaluate(c, u), evaluate(&v, u), evaluate(&derivative(&v), u)]
}

/// Returns the row of a cycle: its number, the position, velocity and acceleration of every axis, the tool, and the
/// number of the segment.
fn row<const N: usize>(
    cycle: i64,
    states: &[[f64; 3]; N],
    tool_on: bool,
    segment: usize,
) -> String {
    let mut row = format!("{cycle}");
    for state in states {
        for (value, digits) in state.iter().zip(DIGITS) {
            row += &format!(",{}", decimal(*value, digits));
        }
    }
    row + &format!(",{},{segment}\n", u8::from(tool_on))
}
