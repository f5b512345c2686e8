//! Zaber, PVT sequence as the CSV file of the motion library: a header with the name and the unit of every column, then
//! one row per segment with its duration, and the absolute position and the velocity of every axis at its end. The
//! library rounds positions to microsteps, velocities to 1 / 1.6384 microsteps per second and durations to 0.1 ms, and
//! it sends the rows to the queue of the controller. Between two points every axis runs a cubic.
//!
//! The file has no place for comments, so what it is made from is in the file beside it only. All axes have to be those
//! of one controller. The first segment begins where the axes stand.
//!
//! The tool: the library can put outputs between the points, which the file does not; the host switches it.
//!
//! Source: Zaber Motion Library, *Position Velocity Time (PVT)* and PvtSequence (load_sequence_data, relative times);
//! zabertech/zaber-examples, `motion_pvt_sequence_generation` (columns, the cubic); zabertech/motorZaberMotion, its
//! tests of `pvt 1 point abs p .. v .. t ..` (microsteps, ms with one decimal).

use planish_types::Invalid;

use crate::{Abilities, About, Approach, Job, Tool, decimal};

/// Number of decimals of all numbers. Larger: longer rows. Smaller: rounding beside that of the library. Chosen:
/// counts below 1e-9 mm and clocks below 1e-9 s are refused.
const DIGITS: usize = 9;

pub(crate) fn write<const N: usize>(job: &Job<N>) -> Result<(String, About), Invalid> {
    let tick_s = job.tick()?;
    let (q, mut about) = job.nodes(Abilities {
        most_ticks: i64::MAX >> 10,
        tool: Tool::LeftToTheHost(
            "the file does not switch it: the host switches it on when the sequence begins, off when it ends, and \
             off on every stop",
        ),
        approach: Approach::Before(
            "go to the start, tool off: positions are absolute, from elsewhere the first segment is a leap. The axes \
             of the sequence are those of the columns, in their order, on one controller",
        ),
    })?;
    let mut text = String::from("Time (s)");
    for axis in job.plan.axes {
        let (name, unit) = (axis.name, axis.unit());
        text += &format!(",{name} Position ({unit}),{name} Velocity ({unit}/s)");
    }
    text.push('\n');
    for k in 0..about.segments {
        about.marks.add(&text, q.time_s(k), q.position(k));
        text += &decimal(q.duration(k) as f64 * tick_s, DIGITS);
        for (p, v) in q.position(k + 1).into_iter().zip(q.velocity[k + 1]) {
            text += &format!(",{},{}", decimal(p, DIGITS), decimal(v, DIGITS));
        }
        text.push('\n');
    }
    Ok((text, about))
}
