//! Newport XPS, PVT trajectory file: one line `dt, dx, vx, dy, vy` per element (segment), with two columns for every
//! further positioner of the group. Distances are relative and velocities those at the end, in mm (or degrees) and s.
//! The file has no header, so what it is made from is in the file beside it only.
//!
//! A PT file ([`write_pt`]) has lines `dt, dx, dy`: no velocities. No public source states how the controller moves
//! between two of its points. The lines are therefore as short and even as those of G-code: joined by parabolas, they
//! keep the limits.
//!
//! The controller refuses an element without time and a last velocity that is not zero. It does not
//! check where a relative motion ends: the start must be where `start_mm` says.
//!
//! The tool: a line has no place for an output, so the file cannot switch one. The controller can, by
//! its events (start and end of a trajectory, start of an element) and actions on its digital outputs,
//! which the host configures before the run. A motion that lifts the tool is refused.
//!
//! Source: Newport XPS-Q8 user's manual (EDH0301), sections 8.3.6 (trajectory file description) and 8.3.8
//! (verification and execution), and XPS programmer's manual, EventExtendedConfigurationActionSet. No
//! length of a line is stated; a line here has up to 100 characters.

use planish_types::Invalid;

use crate::{Abilities, About, Approach, Job, Tool, decimal};

/// Number of decimals of a distance in mm, a velocity in mm/s and a time in s. Larger: longer lines. Smaller:
/// rounding that the controller may notice. Chosen: counts below 1e-9 mm and clocks below 1e-9 s are refused.
const DIGITS: usize = 9;

const TOOL: Tool = Tool::LeftToTheHost(
    "the file cannot switch it: the host switches it, or events of the controller (start and end \
     of the trajectory) that the host configures",
);

/// Writes a PVT file.
pub(crate) fn write<const N: usize>(job: &Job<N>) -> Result<(String, About), Invalid> {
    let tick_s = job.tick()?;
    let (q, mut about) = job.nodes(Abilities {
        most_ticks: i64::MAX >> 10,
        tool: TOOL,
        approach: Approach::Before(
            "go to the start with GroupMoveAbsolute, tool off, then MultipleAxesPVTVerification, then \
             MultipleAxesPVTExecution once: distances are relative, from elsewhere the whole run is displaced, and \
             nothing notices",
        ),
    })?;
    let n = about.segments;
    let mut text = String::new();
    for k in 0..n {
        about.marks.add(&text, q.time_s(k), q.position(k));
        let distance = q.distance(k);
        let velocity = q.velocity[k + 1];
        text += &decimal(q.duration(k) as f64 * tick_s, DIGITS);
        for axis in 0..N {
            let d = distance[axis] as f64 * q.count[axis];
            text += &format!(", {}, {}", decimal(d, DIGITS), decimal(velocity[axis], DIGITS));
        }
        text.push('\n');
    }
    Ok((text, about))
}

/// Writes a PT file.
pub(crate) fn write_pt<const N: usize>(job: &Job<N>) -> Result<(String, About), Invalid> {
    let tick_s = job.tick()?;
    let (q, mut about) = job.nodes(Abilities {
        most_ticks: i64::MAX >> 10,
        tool: TOOL,
        approach: Approach::Before(
            "go to the start with GroupMoveAbsolute, tool off, then MultipleAxesPTVerification, then \
             MultipleAxesPTExecution once: distances are relative, from elsewhere the whole run is displaced, and \
             nothing notices",
        ),
    })?;
    let mut text = String::new();
    for k in 0..about.segments {
        about.marks.add(&text, q.time_s(k), q.position(k));
        let seconds = if q.stands(k) { q.wait_s(k) } else { q.duration(k) as f64 * tick_s };
        text += &decimal(seconds, DIGITS);
        for (distance, count) in q.distance(k).into_iter().zip(q.count) {
            text += &format!(", {}", decimal(distance as f64 * count, DIGITS));
        }
        text.push('\n');
    }
    Ok((text, about))
}
