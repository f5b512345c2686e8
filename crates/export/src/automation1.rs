//! Aerotech Automation1, AeroScript: one command `MovePvt([X, Y], [p, p], [v, v], ms)` per segment with the absolute
//! positions in mm, the velocities at its end in mm/s, and its duration in ms. Further axes are Z, A, B and C, the
//! rotary ones in degrees; a radius is X. The axes of the controller must have these names.
//!
//! The time is in milliseconds, whatever the unit of time of the task is. Two public sources say so; an example
//! elsewhere, of unknown origin, has seconds. The velocities are in the time unit of the task, which the program sets.
//!
//! The tool: an output acts when its command is read, before the motion is there. So the host switches the tool, and a
//! motion that lifts it is refused.
//!
//! The start: the first command goes there from where the axes stand, so from elsewhere it would be a leap.
//!
//! Source: Automation1 C interface, `Automation1_Command_MovePvt` in its header; EPICS driver motorAutomation1, whose
//! `MovePt` has the same time. Neither states a length of a line; 120 characters are chosen for reading.

use planish_types::Invalid;

use crate::{Abilities, About, Approach, Job, Tool, decimal, header::Comment, letter};

pub(crate) const COMMENT: Comment = Comment { open: "// ", close: "", line: 120 };

/// Number of decimals of a position in mm and a velocity in mm/s, and of a time in ms. Larger: longer lines. Smaller:
/// rounding that the controller may notice. Chosen: counts below 1e-9 mm and clocks below 1e-9 s are refused.
const DIGITS: usize = 9;
const MS_DIGITS: usize = 6;

pub(crate) fn write<const N: usize>(job: &Job<N>) -> Result<(String, About), Invalid> {
    let tick_s = job.tick()?;
    let (q, mut about) = job.nodes(Abilities {
        most_ticks: i64::MAX >> 10,
        tool: Tool::LeftToTheHost(
            "this program does not switch it: an output would act when its command is read, before the motion is \
             there. The host switches it on and off, and off on every stop",
        ),
        approach: Approach::Before(
            "go to the start, tool off: positions are absolute, from elsewhere the first segment is a leap. The axes \
             of the controller have the names in the lines, and its units are mm or degrees",
        ),
    })?;
    let lengths = if job.turns() { "mm or deg, mm/s or deg/s" } else { "mm, mm/s" };
    let axes: Vec<&str> = job.plan.axes.iter().map(letter).collect();
    let axes = axes.join(", ");
    let mut text = about.header(&COMMENT, &format!("{lengths}, ms"));
    text += "program\nSetupTaskTargetMode(TargetMode.Absolute)\nSetupTaskTimeUnits(TimeUnits.Seconds)\n";
    for k in 0..about.segments {
        about.marks.add(&text, q.time_s(k), q.position(k));
        text += &format!(
            "MovePvt([{axes}], [{}], [{}], {})\n",
            list(q.position(k + 1)),
            list(q.velocity[k + 1]),
            decimal(1e3 * q.duration(k) as f64 * tick_s, MS_DIGITS)
        );
    }
    text += &format!("WaitForMotionDone([{axes}])\nend\n");
    Ok((text, about))
}

/// Returns numbers separated by commas.
fn list<const N: usize>(numbers: [f64; N]) -> String {
    numbers.map(|v| decimal(v, DIGITS)).join(", ")
}
