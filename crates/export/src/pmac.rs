//! PMAC, PVT mode: `PVT<t>` in ms, then `X<p>:<v> Y<p>:<v>` with the absolute position in mm and the
//! velocity at the end in mm per feedrate time unit (Isx90).
//!
//! A segment takes up to 4095.9998 ms (Turbo PMAC, I42 = 0) in steps of the tick: 1 ms on a PMAC, down
//! to 1/4 us on a Turbo PMAC. Absolute positions do not drift whatever the controller rounds.
//!
//! Source: Turbo PMAC software reference, program commands PVT and {axis}{data}:{data}.

use planish_types::Invalid;
use serde::Serialize;

use crate::{Abilities, Job, Program, decimal, positive, table::Ends};

/// Longest segment, s.
const LONGEST_S: f64 = 4.095_999_8;

/// Decimals of a position in mm, and of a velocity in mm/s.
const DIGITS: usize = 9;

/// How a motion program is written.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Settings {
    /// What a time is rounded to, s.
    pub tick_s: f64,
    /// Unit of time of the velocities, s: Isx90 in ms over 1000.
    pub feedrate_time_unit_s: f64,
}

impl Default for Settings {
    fn default() -> Self {
        Self { tick_s: 1e-3, feedrate_time_unit_s: 1.0 }
    }
}

pub(crate) fn write(job: &Job, settings: &Settings) -> Result<Program, Invalid> {
    let tick_s = positive("tick_s", settings.tick_s)?;
    let unit_s = positive("feedrate_time_unit_s", settings.feedrate_time_unit_s)?;
    let most = (LONGEST_S / tick_s).floor();
    if most < 2.0 {
        let problem = format!("is {tick_s}, a segment takes {LONGEST_S} s at most");
        return Err(Invalid::whole("tick_s", problem, "give a smaller tick"));
    }
    let (q, mut about) = job.quantised(&Abilities {
        controller: "pmac",
        tick_s,
        ticks: [1, most as i64],
        ends: Ends::PositionAndVelocity,
        switches_tool: false,
        from_rest: true,
    })?;
    about.feedrate_time_unit_s = Some(unit_s);
    let units = format!("mm, mm per {unit_s} s with Isx90 = {}, ms", decimal(unit_s * 1e3, 6));
    // A velocity per millisecond needs three more.
    let more = (-unit_s.log10()).ceil().clamp(0.0, 9.0) as usize;
    let mut text = String::new();
    for line in about.header(&units) {
        text += &format!("; {line}\n");
    }
    text += "ABS\n";
    for k in 0..about.segments {
        let ([x, y], v) = (q.position_mm(k + 1), q.velocity_mm_per_s[k + 1].map(|v| v * unit_s));
        text += &format!(
            "PVT{}\nX{}:{} Y{}:{}\n",
            decimal(q.duration(k) as f64 * tick_s * 1e3, 6),
            decimal(x, DIGITS),
            decimal(v[0], DIGITS + more),
            decimal(y, DIGITS),
            decimal(v[1], DIGITS + more)
        );
    }
    Ok(Program { text, about })
}
