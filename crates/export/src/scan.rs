//! The arrays of the public trajectory-scan program of the PMAC (EPICS module `pmac`), which pymalcolm and ophyd-async
//! fill: a time in us, a position and a velocity per axis, and the number of a user program for every point.
//!
//! The arrays have the numbers of the lines of the motion program, so both make the same motion: the cubic from point
//! to point. A point is the end of a segment.
//!
//! | array | process variable | unit |
//! |---|---|---|
//! | `time_us` | `ProfileTimeArray` | us, at most 4 095 999 |
//! | `user` | `UserArray` | 1 in a segment with the tool on, 2 with the tool off; 0 if the program does not switch it |
//! | `axes.X.positions` | `X:Positions` | mm or degrees |
//! | `axes.X.velocities` | `X:Velocities`, with `ProfileCalcVel` off | mm/s or degrees/s |
//!
//! Source: bluesky/ophyd-async, `epics/pmac/_pmac_io.py` and `_pmac_trajectory_generation.py` (user programs 1, 2);
//! DiamondLightSource/pymalcolm, `modules/pmac/parts/pmactrajectorypart.py` (times in us).

use std::collections::BTreeMap;

use planish_types::Invalid;
use serde::Serialize;

use crate::Program;

/// User programs of the points.
const UNSWITCHED: u8 = 0;
const ON: u8 = 1;
const OFF: u8 = 2;

#[derive(Serialize)]
struct ScanFile<'a> {
    program_blake3: &'a str,
    dry_run: bool,
    time_us: Vec<f64>,
    user: Vec<u8>,
    axes: BTreeMap<String, ScanAxis>,
}

#[derive(Default, Serialize)]
struct ScanAxis {
    positions: Vec<f64>,
    velocities: Vec<f64>,
}

/// Returns the arrays of a PMAC program as JSON.
///
/// # Errors
/// Refuses a program with a time that is no whole number of microseconds, which the arrays cannot hold.
pub fn scan_arrays(program: &Program) -> Result<String, Invalid> {
    let about = &program.about;
    let unit_s = about.feedrate_time_unit_s.unwrap_or(1.0);
    let is_switched = program.text.lines().any(|line| line.starts_with('M') && line.contains("=="));
    let mut file = ScanFile {
        program_blake3: &about.program_blake3,
        dry_run: about.dry_run,
        time_us: Vec::with_capacity(about.segments),
        user: Vec::with_capacity(about.segments),
        axes: BTreeMap::new(),
    };
    let mut user = if is_switched { OFF } else { UNSWITCHED };
    for line in program.text.lines() {
        if let Some(ms) = line.strip_prefix("PVT").and_then(number) {
            let us = 1e3 * ms;
            if (us - us.round()).abs() > 1e-6 {
                let problem = format!("is {ms} ms, no whole number of microseconds");
                let index = file.time_us.len();
                let remedy = "give `tick_s` as a multiple of 0.000001";
                return Err(Invalid::at_index("segment", index, problem, remedy));
            }
            file.time_us.push(us.round());
            file.user.push(user);
        } else if line.starts_with('M') && line.contains("==") {
            user = if line.ends_with('1') { ON } else { OFF };
        } else if line.contains(':') && !line.starts_with(';') {
            for word in line.split(' ') {
                let Some((position, velocity)) = word.get(1..).and_then(|w| w.split_once(':'))
                else {
                    continue;
                };
                let axis = file.axes.entry(word[..1].into()).or_default();
                axis.positions.extend(number(position));
                axis.velocities.extend(number(velocity).map(|v| v / unit_s));
            }
        }
    }
    Ok(serde_json::to_string(&file).expect("finite numbers") + "\n")
}

fn number(text: &str) -> Option<f64> {
    text.parse().ok()
}
