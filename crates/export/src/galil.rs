//! Galil DMC, PVT mode: two lines per segment, `PVA=dP,V,T` and `PVB=dP,V,T`, with the distance in counts, the velocity
//! at the end in counts/s and the time in samples. A is x, B is y. A program of all axes has a line for every axis, A
//! for the first axis of the machine file, B for the second and so on.
//!
//! Limits of the controller: |dP| <= 44 000 000 counts, |V| <= 22 000 000 counts/s, T from 1 to 2048
//! samples and for fast hosts a multiple of two, 255 segments of buffer. `BTAB` begins the motion; it
//! stands after as many segments as the buffer holds, and the host sends the rest as room appears
//! (`MG _PVA`).
//!
//! The argument of TM is not the sample time in us: its unit is 1/1.024 us, "TM1000 actually specifies a servo update
//! rate of 976 us". With it 1024 samples are one second, while V is in counts per true second whatever TM is. Samples
//! come in multiples of 1/32768 s (TM 31.25). The normal firmware, which PVT mode needs, has at least two of these
//! units for one or two axes, four for three and four axes, five for five.
//!
//! The tool: a segment cannot carry an output. `SB` and `CB` act when the controller reads them, and the
//! segments are read up to a whole buffer before they run, so such a line would switch up to 255 segments
//! early. The host switches: on after BTAB, off when `_BTA` (segments that have run) says so, and after
//! `ST` or `AB`, which leave outputs as they are. A motion that lifts the tool is refused.
//!
//! Source: Galil DMC-40x0 command reference (PV, BT, TM, SB, CB, ST, AB) and user manual, chapter 6
//! (PVT mode: 1024 samples per second), appendix (program size: lines of 80 characters).

use planish_types::{ControllerModel, Invalid};

use crate::{Abilities, About, Approach, Job, Tool, header::Comment, positive};

/// Limits of the controller for a segment: distance, counts; velocity, counts/s; duration, samples. Larger: the
/// controller refuses the program. Smaller: motions are refused that it could run. Source: the command reference.
const MOST_DISTANCE: i64 = 44_000_000;
const MOST_VELOCITY: f64 = 22_000_000.0;
const MOST_SAMPLES: i64 = 2048;

/// Number of samples of a tick, the clock of the program. For fast hosts the controller needs an even number of samples
/// per segment, at least two. Larger: a coarser clock. Smaller: segments that it may not take in time.
const SAMPLES_PER_TICK: i64 = 2;

/// Unit of the sample time, s (TM 31.25), and the largest sample time in these units (TM 20000). Facts of the
/// controller: other samples are refused.
const SAMPLE_UNIT_S: f64 = 1.0 / 32768.0;
const MOST_SAMPLE_UNITS: f64 = 640.0;

/// Returns the smallest sample time of a controller for this number of axes, in units of [`SAMPLE_UNIT_S`]. A fact of
/// the normal firmware (command reference, TM); the fast firmware has smaller ones and no PVT mode.
fn least_sample_units(axes: usize) -> f64 {
    match axes {
        0..=2 => 2.0,
        3 | 4 => 4.0,
        _ => 5.0,
    }
}
/// Argument of TM per second of sample time: its unit is 1/1.024e6 s. A fact of the controller.
const TM_PER_S: f64 = 1.024e6;

pub(crate) const COMMENT: Comment = Comment { open: "' ", close: "", line: 80 };

/// Number of segments that the buffer of an axis holds, a fact of the controller. The line that ends the motion takes
/// one.
const BUFFER: usize = 255;

/// Letters of the axes in the program, in their order in the machine file.
const LETTERS: [&str; 5] = ["A", "B", "C", "D", "E"];

/// Returns the sample time, s: half the clock of the program. Refuses one that PVT mode does not have with this number
/// of axes.
pub(crate) fn sample_s(grids: &ControllerModel, axes: usize) -> Result<f64, Invalid> {
    let sample_s = positive("sample_s", grids.tick_s / SAMPLES_PER_TICK as f64)?;
    let units = sample_s / SAMPLE_UNIT_S;
    // A little less or more is the rounding of a number that was typed.
    let least = least_sample_units(axes);
    if !(least - 1e-3..=MOST_SAMPLE_UNITS + 1e-3).contains(&units) {
        let problem = format!(
            "is {sample_s}, and PVT mode with {axes} axes has samples from TM {} ({} s) to TM 20000 (0.01953125 s)",
            least * SAMPLE_UNIT_S * TM_PER_S,
            least * SAMPLE_UNIT_S
        );
        return Err(Invalid::whole("sample_s", problem, "give 0.0009765625 for TM 1000"));
    }
    Ok(sample_s)
}

pub(crate) fn write<const N: usize>(job: &Job<N>) -> Result<(String, About), Invalid> {
    let sample_s = sample_s(&job.grids, N)?;
    let units = sample_s / SAMPLE_UNIT_S;
    let (q, mut about) = job.nodes(Abilities {
        most_ticks: MOST_SAMPLES / SAMPLES_PER_TICK,
        tool: Tool::LeftToTheHost(
            "this program does not switch it: the host switches it on after BTAB, off when _BTA says that \
             the last segment has run, and off on every stop",
        ),
        approach: Approach::Before(
            "go to the start with PA and BG, tool off: distances are relative, from elsewhere the whole run is displaced, \
             and nothing notices",
        ),
    })?;
    about.sample_s = Some(sample_s);
    if (units - units.round()).abs() > 1e-3 {
        about.warnings.push(format!(
            "no TM gives samples of {sample_s} s; TM 1000 gives 0.0009765625 s, and samples come in \
             multiples of 1/32768 s"
        ));
    }
    let n = about.segments;
    if n + 1 > BUFFER {
        about.buffer_segments = Some(BUFFER);
        let windows = (0..=n - BUFFER).map(|k| q.time_s(k + BUFFER) - q.time_s(k));
        about.buffer_lasts_s = Some(windows.fold(f64::INFINITY, f64::min));
    }
    let count = q.count;
    let mut axes = String::new();
    for ((axis, letter), count) in job.plan.axes.iter().zip(LETTERS).zip(count) {
        axes += &format!("{letter} = {} in counts of {count} {}, ", axis.name, axis.unit());
    }
    let units = format!("{axes}counts/s, samples of {sample_s} s, TM {}", sample_s * TM_PER_S);
    let mut text = about.header(&COMMENT, &units);
    let starts = LETTERS.iter().zip(q.counts[0]).map(|(letter, c)| format!("{letter} {c}"));
    text += &format!("' start: {} counts\n", starts.collect::<Vec<_>>().join(", "));
    text += &job.prologue();
    text += &LETTERS[..N].iter().map(|letter| format!("PV{letter}=0,0,-1\n")).collect::<String>();
    for k in 0..n {
        about.marks.add(&text, q.time_s(k), q.position(k));
        let distance = q.distance(k);
        let t = q.duration(k) * SAMPLES_PER_TICK;
        for (axis, letter) in LETTERS[..N].iter().enumerate() {
            let name = format!("PV{letter}");
            let p = distance[axis];
            let v = (q.velocity[k + 1][axis] / count[axis]).round();
            if p.abs() > MOST_DISTANCE || v.abs() > MOST_VELOCITY {
                let problem =
                    format!("{name}={p},{v},{t} is beyond 44000000 counts, 22000000 counts/s");
                let is_rotary = job.plan.axes[axis].is_rotary;
                let count = if is_rotary { "count_deg" } else { "count_mm" };
                let remedy = format!("give a larger `{count}`");
                return Err(Invalid::at_index("segment", k, problem, remedy));
            }
            text += &format!("{name}={p},{v:.0},{t}\n").replace(",-0,", ",0,");
        }
        if k + 1 == BUFFER.min(n) {
            text += &format!("BT{}\n", LETTERS[..N].concat());
        }
    }
    text += &LETTERS[..N].iter().map(|letter| format!("PV{letter}=0,0,0\n")).collect::<String>();
    text += &job.epilogue();
    Ok((text, about))
}
