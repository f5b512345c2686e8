//! Aerotech Ensemble, AeroBasic: after `PVT INIT TIME ABS`, one line `PVT X p,v Y p,v TIME t` per segment with the
//! absolute positions in mm, the velocities at its end in mm/s, and the time of its end in s since the start. Further
//! axes are Z, A, B and C, the rotary ones in degrees; a radius is X. The axes of the controller must have these
//! names.
//!
//! `ABS` makes positions absolute, `VELOCITY ON` keeps the velocity from one line to the next. Absolute positions and
//! times do not drift whatever the controller rounds. The controller refuses a time of 0. Its queue holds 16 commands,
//! which the program refills by itself while it runs.
//!
//! The tool: an output acts when its line is read, up to 16 commands before the motion is there. So the host switches
//! the tool, and a motion that lifts it is refused.
//!
//! The start: the first line goes there from where the axes stand, so from elsewhere it would be a leap.
//!
//! Source: EPICS motor module, `AerotechSrc/doCommand.ab` and `EnsembleTrajectoryScan.st` (Advanced Photon Source);
//! Lauecollect, `image_scan.py` and its AeroBasic programs (National Institutes of Health). Neither states a length
//! of a line; 80 characters are those of a terminal.

use planish_types::Invalid;

use crate::{Abilities, About, Approach, Job, Tool, decimal, header::Comment, letter};

pub(crate) const COMMENT: Comment = Comment { open: "' ", close: "", line: 80 };

/// Number of decimals of a position in mm, a velocity in mm/s and a time in s. Larger: longer lines. Smaller: rounding
/// that the controller may notice. Chosen: counts below 1e-9 mm and clocks below 1e-9 s are refused.
const DIGITS: usize = 9;

pub(crate) fn write<const N: usize>(job: &Job<N>) -> Result<(String, About), Invalid> {
    job.tick()?;
    let (q, mut about) = job.nodes(Abilities {
        most_ticks: i64::MAX >> 10,
        tool: Tool::LeftToTheHost(
            "this program does not switch it: an output would act when its line is read, up to 16 commands early. The \
             host switches it on and off, and off on every stop",
        ),
        approach: Approach::Before(
            "go to the start, tool off: positions are absolute, from elsewhere the first segment is a leap. The axes \
             of the controller have the names in the lines, its units are mm or degrees, and seconds",
        ),
    })?;
    let lengths = if job.turns() { "mm or deg, mm/s or deg/s" } else { "mm, mm/s" };
    let axes: Vec<&str> = job.plan.axes.iter().map(letter).collect();
    let mut text = about.header(&COMMENT, &format!("{lengths}, s since the start"));
    text += "PROGRAM\n";
    text += &job.prologue();
    text += "ABS\nVELOCITY ON\nPVT INIT TIME ABS\n";
    for k in 1..=about.segments {
        about.marks.add(&text, q.time_s(k - 1), q.position(k - 1));
        let states = axes.iter().zip(q.position(k)).zip(q.velocity[k]);
        let words = states
            .map(|((axis, p), v)| format!("{axis} {},{} ", decimal(p, DIGITS), decimal(v, DIGITS)));
        text +=
            &format!("PVT {}TIME {}\n", words.collect::<String>(), decimal(q.time_s(k), DIGITS));
    }
    text += &format!("WAIT MOVEDONE {}\nVELOCITY OFF\n", axes.join(" "));
    text += &job.epilogue();
    text += "END PROGRAM\n";
    Ok((text, about))
}
