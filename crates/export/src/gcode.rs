//! G-code for LinuxCNC and its relatives: straight lines, each in its time.
//!
//! ```text
//! G93:  F = 60 / dt            (1/min)
//! G94:  F = 60 length / dt     (mm/min)
//! ```
//!
//! Inverse time (G93) is what removal wants: it depends on the time, not on the speed. A line of no
//! length would silently lose its time there, so standing is written as `G4 P`. The tool is switched
//! with the motion by `M62 P0` (on) and `M63 P0` (off). Between two lines the motion is straight and
//! its speed is constant; a smaller `max_step_s` follows a schedule that is neither.
//!
//! The time is nominal: a planner that blends corners, or whose limits are reached, takes longer.
//!
//! Source: LinuxCNC documentation, G-codes and M-codes.

use planish_types::Invalid;
use serde::Serialize;

use crate::{Abilities, Job, Program, decimal, positive, table::Ends};

/// Decimals of a position in mm and of a time in s.
const DIGITS: usize = 9;

/// Significant digits of F. Nine keep a segment of 100 s to 1e-7 s.
const FEED_DIGITS: i32 = 9;

/// What F is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Feed {
    /// G93: lines per minute.
    InverseTime,
    /// G94: mm per minute.
    PerMinute,
}

/// How a program is written.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Settings {
    /// What F is.
    pub feed: Feed,
    /// What a time is rounded to, s.
    pub tick_s: f64,
    /// How far the path may leave the corners, mm (G64 P); 0 for an exact path (G61).
    pub path_tolerance_mm: f64,
}

impl Default for Settings {
    fn default() -> Self {
        Self { feed: Feed::InverseTime, tick_s: 1e-6, path_tolerance_mm: 0.001 }
    }
}

pub(crate) fn write(job: &Job, settings: &Settings) -> Result<Program, Invalid> {
    let tick_s = positive("tick_s", settings.tick_s)?;
    let tolerance = settings.path_tolerance_mm;
    if !(tolerance.is_finite() && tolerance >= 0.0) {
        let remedy = "give a length in mm, 0 for an exact path";
        return Err(Invalid::whole("path_tolerance_mm", format!("is {tolerance}"), remedy));
    }
    let (q, about) = job.quantised(&Abilities {
        controller: "gcode",
        tick_s,
        ticks: [1, i64::MAX >> 10],
        ends: Ends::Position,
        switches_tool: true,
        from_rest: false,
    })?;
    let (mode, unit) = match settings.feed {
        Feed::InverseTime => ("G93", "lines per minute"),
        Feed::PerMinute => ("G94", "mm per minute"),
    };
    let mut text = String::new();
    for line in about.header(&format!("mm, F in {unit}, G4 P in s")) {
        text += &format!("({line})\n");
    }
    text += "G21 G90 G17 G40 G49 G94\n";
    text += &match tolerance {
        0.0 => "G61\n".to_string(),
        // Q0: lines of one feed that are nearly straight are not merged.
        p => format!("G64 P{} Q0\n", decimal(p, DIGITS)),
    };
    let [x, y] = about.start_mm;
    text += &format!("G0 X{} Y{}\n{mode}\n", decimal(x, DIGITS), decimal(y, DIGITS));
    let mut on = None;
    for k in 0..about.segments {
        if on != Some(q.tool_on[k]) {
            text += if q.tool_on[k] { "M62 P0\n" } else { "M63 P0\n" };
            on = Some(q.tool_on[k]);
        }
        let (from, to) = (q.position_mm(k), q.position_mm(k + 1));
        let seconds = q.duration(k) as f64 * tick_s;
        let [x, y] = to.map(|v| decimal(v, DIGITS));
        // As the interpreter will read them.
        let length = (to[0] - from[0]).hypot(to[1] - from[1]);
        if q.distance(k) == [0, 0] {
            text += &format!("G4 P{}\n", decimal(seconds, DIGITS));
            continue;
        }
        let feed = match settings.feed {
            // F = 60 / dt
            Feed::InverseTime => 60.0 / seconds,
            // F = 60 length / dt
            Feed::PerMinute => 60.0 * length / seconds,
        };
        text += &format!("G1 X{x} Y{y} F{}\n", significant(feed));
    }
    text += "M63 P0\nG94 F60\nM2\n";
    Ok(Program { text, about })
}

fn significant(v: f64) -> String {
    let decimals = (FEED_DIGITS - 1 - v.log10().floor() as i32).clamp(0, 15);
    decimal(v, decimals as usize)
}
