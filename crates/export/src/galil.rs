//! Galil DMC, PVT mode: two lines per segment, `PVA=dP,V,T` and `PVB=dP,V,T`, with the distance in
//! counts, the velocity at the end in counts/s and the time in samples. A is x, B is y.
//!
//! Limits of the controller: |dP| <= 44 000 000 counts, |V| <= 22 000 000 counts/s, T from 1 to 2048
//! samples and for fast hosts a multiple of two, 255 segments of buffer. `BTAB` begins the motion; it
//! stands after as many segments as the buffer holds, and the host sends the rest as room appears
//! (`MG _PVA`).
//!
//! Source: Galil DMC-40x0 command reference, PV and BT.

use planish_types::Invalid;
use serde::Serialize;

use crate::{Abilities, Job, Program, positive, table::Ends};

/// Limits of a segment.
const MOST_DISTANCE: i64 = 44_000_000;
const MOST_VELOCITY: f64 = 22_000_000.0;
const MOST_SAMPLES: i64 = 2048;

/// Samples of a tick: the controller needs two samples per segment.
const SAMPLES_PER_TICK: i64 = 2;

/// Segments of the buffer of an axis. The line that ends the motion takes one.
const BUFFER: usize = 255;

/// How a program for a Galil is written.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Settings {
    /// Sample time, s: TM in microseconds.
    pub sample_s: f64,
}

impl Default for Settings {
    fn default() -> Self {
        Self { sample_s: 1e-3 }
    }
}

pub(crate) fn write(job: &Job, settings: &Settings) -> Result<Program, Invalid> {
    let sample_s = positive("sample_s", settings.sample_s)?;
    let (q, mut about) = job.quantised(&Abilities {
        controller: "galil",
        tick_s: SAMPLES_PER_TICK as f64 * sample_s,
        ticks: [1, MOST_SAMPLES / SAMPLES_PER_TICK],
        ends: Ends::PositionAndVelocity,
        switches_tool: false,
        from_rest: true,
    })?;
    about.sample_s = Some(sample_s);
    let n = about.segments;
    if n + 1 > BUFFER {
        about.buffer_segments = Some(BUFFER);
        let windows = (0..=n - BUFFER).map(|k| q.time_s(k + BUFFER) - q.time_s(k));
        about.buffer_lasts_s = Some(windows.fold(f64::INFINITY, f64::min));
    }
    let count = job.common.count_mm;
    let units = format!(
        "A = x in counts of {} mm, B = y in counts of {} mm, counts/s, samples of {sample_s} s, TM {:.0}",
        count[0],
        count[1],
        sample_s * 1e6
    );
    let mut text = String::new();
    for line in about.header(&units) {
        text += &format!("' {line}\n");
    }
    let [a, b] = q.counts[0];
    text += &format!("' start: A {a}, B {b} counts\nPVA=0,0,-1\nPVB=0,0,-1\n");
    for k in 0..n {
        let (distance, t) = (q.distance(k), q.duration(k) * SAMPLES_PER_TICK);
        for (axis, name) in ["PVA", "PVB"].into_iter().enumerate() {
            let (p, v) = (distance[axis], (q.velocity_mm_per_s[k + 1][axis] / count[axis]).round());
            if p.abs() > MOST_DISTANCE || v.abs() > MOST_VELOCITY {
                let problem =
                    format!("{name}={p},{v},{t} is beyond 44000000 counts, 22000000 counts/s");
                return Err(Invalid::at("segment", k, problem, "give a larger --count-mm"));
            }
            text += &format!("{name}={p},{v:.0},{t}\n").replace(",-0,", ",0,");
        }
        if k + 1 == BUFFER.min(n) {
            text += "BTAB\n";
        }
    }
    text += "PVA=0,0,0\nPVB=0,0,0\n";
    Ok(Program { text, about })
}
