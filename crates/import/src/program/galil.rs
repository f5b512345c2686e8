//! Galil DMC-3xxxx, 4xxxx, 5xxxx, PVT mode: `PVA=dP,V,T` and `PVB=dP,V,T` add a segment each, with
//! a distance in counts, the velocity at its end in counts/s and a time of 1 to 2048 samples;
//! T = -1 clears the buffer, `0,0,0` ends the motion, `BT` begins it. A is x, B is y; in a program of all axes the
//! letters follow the list of axes.
//!
//! A file may have what a program of the controller has around the segments: labels (`#A`, `EN`), comments (`'`, `REM`, `NO`),
//! lower case, blanks, messages and waits of the host (`MG`, `WT`, `AM`, `MC`), `SH`. `TM` states the sample time: n units
//! of 1/1.024e6 s.
//!
//! Errors are refused that would change the motion without a trace: clearing the buffer after the first
//! segment, a segment after the end, and a missing end or beginning (a program that was cut off).
//!
//! Source: Galil DMC-40x0 command reference, PV and BT.

use planish_types::{AxesMotion, Invalid};

use super::{Configuration, Knot, Layout, finite, needed, positive, through, wrong};

/// Letters of the axes of the controller, in their order.
const LETTERS: &str = "ABCDEFGH";

/// Largest time of a segment, samples; a longer one is refused (Galil DMC-40x0 command reference, PV).
const MOST_SAMPLES: i64 = 2048;
/// Largest distance of a segment, counts, in either direction; a longer one is refused (Galil DMC-40x0 command
/// reference, PV).
const MOST_DISTANCE: i64 = 44_000_000;
/// Largest velocity at the end of a segment, counts/s, in either direction; a higher one is refused (Galil DMC-40x0
/// command reference, PV).
const MOST_VELOCITY: i64 = 22_000_000;

/// Commands that change no motion: end of a program, servo on, waits, and messages to the host.
const WITHOUT_MOTION: [&str; 6] = ["EN", "SH", "AM", "MC", "MG", "WT"];

/// Time units of the command TM (sample time) per second (DMC-40x0 command reference, TM).
const TM_PER_S: f64 = 1.024e6;

/// A command of the program that the reader acts on.
enum GalilCommand {
    /// A segment of the axis with this index: distance (counts), velocity (counts/s) and time (samples).
    Segment(usize, [i64; 3]),
    /// Clears the buffer of the axis with this index.
    Clear(usize),
    /// Ends the motion of the axis with this index.
    End(usize),
    /// Begins the motion of all axes.
    Begin,
}

/// Reads the motion of a Galil program. Refuses what the module names, other commands, and absent settings.
pub(super) fn read(
    text: &str,
    configuration: &Configuration,
    layout: &Layout,
) -> Result<AxesMotion, Invalid> {
    let n = layout.len();
    let letters = LETTERS.get(..n).unwrap_or(LETTERS);
    // Distance, velocity, samples of every segment.
    let mut axes: Vec<Vec<[i64; 3]>> = vec![Vec::new(); n];
    let mut ended = vec![false; n];
    let mut begun = false;
    let mut sample_s = configuration.sample_s;
    for (i, line) in text.lines().enumerate() {
        let line = line.trim().to_ascii_uppercase();
        if line.starts_with("REM") {
            continue;
        }
        for command in line.split(';').map(str::trim).filter(|c| !c.is_empty()) {
            // The rest of the line is a comment.
            if command.starts_with('\'') || command == "NO" || command.starts_with("NO ") {
                break;
            }
            if command.starts_with('#')
                || command.get(..2).is_some_and(|c| WITHOUT_MOTION.contains(&c))
            {
                continue;
            }
            if let Some(units) = command.strip_prefix("TM") {
                sample_s = Some(sample_of(i + 1, units, sample_s)?);
                continue;
            }
            let command: String = command.split_whitespace().collect();
            match parse(i + 1, &command, letters)? {
                GalilCommand::Segment(axis, _)
                | GalilCommand::Clear(axis)
                | GalilCommand::End(axis)
                    if ended[axis] =>
                {
                    return Err(wrong(i + 1, "goes on after the end of the motion (0,0,0)"));
                }
                GalilCommand::Segment(axis, numbers) => axes[axis].push(numbers),
                GalilCommand::Clear(axis) if axes[axis].is_empty() => {}
                GalilCommand::Clear(_) => {
                    return Err(wrong(i + 1, "clears the segments before it (T = -1)"));
                }
                GalilCommand::End(axis) => ended[axis] = true,
                GalilCommand::Begin if begun => {
                    return Err(wrong(i + 1, "begins the motion again"));
                }
                GalilCommand::Begin => begun = true,
            }
        }
    }
    check_complete(&axes, &ended, begun, letters)?;
    through(&knots(&axes, layout, sample_s, letters)?)
}

/// Returns the states at the ends of the segments, in mm or deg and per s, from the start position on. `axes` has
/// distance (counts), velocity (counts/s) and duration (samples) of every segment, by axis. Refuses missing settings,
/// sizes of counts or samples that are not positive, and axes whose segments differ in time.
fn knots(
    axes: &[Vec<[i64; 3]>],
    layout: &Layout,
    sample_s: Option<f64>,
    letters: &str,
) -> Result<Vec<Knot>, Invalid> {
    let n = axes.len();
    let count = needed("count_mm", layout.count.clone())?;
    let sample_s = positive("sample_s", needed("sample_s", sample_s)?)?;
    let start = needed("start_mm", layout.start.clone())?;
    for c in &count {
        positive("count_mm", *c)?;
    }
    let state = |samples: i64, counts: &[i64], velocity: &[i64]| Knot {
        time_s: samples as f64 * sample_s,
        position: (0..n).map(|k| start[k] + counts[k] as f64 * count[k]).collect(),
        velocity: (0..n).map(|k| velocity[k] as f64 * count[k]).collect(),
        tool_on: true,
    };
    // Counts and samples add up without rounding.
    let mut samples = 0i64;
    let mut counts = vec![0i64; n];
    let mut knots = vec![state(0, &counts, &counts)];
    for i in 0..axes[0].len() {
        let first = axes[0][i];
        if let Some(k) = (1..n).find(|k| axes[*k][i][2] != first[2]) {
            let letter = &letters[k..=k];
            let problem =
                format!("takes {} samples for A, {} for {letter}", first[2], axes[k][i][2]);
            return Err(Invalid::at_index("segment", i, problem, "give all axes the same time"));
        }
        // Both are bounded by the length of the text: 1e9 lines of 44e6 counts stay below 2^63.
        samples += first[2];
        counts.iter_mut().zip(axes).for_each(|(sum, axis)| *sum += axis[i][0]);
        let velocity: Vec<i64> = axes.iter().map(|axis| axis[i][1]).collect();
        knots.push(state(samples, &counts, &velocity));
    }
    Ok(knots)
}

/// Refuses axes with different numbers of segments, a motion without a beginning, and an axis without an end.
fn check_complete(
    axes: &[Vec<[i64; 3]>],
    ended: &[bool],
    begun: bool,
    letters: &str,
) -> Result<(), Invalid> {
    let n = axes.len();
    if let Some(k) = (1..n).find(|k| axes[*k].len() != axes[0].len()) {
        let [first, other] = [0, k].map(|k| axes[k].len());
        let problem = format!("has {first} segment(s) of A, {other} of {}", &letters[k..=k]);
        return Err(Invalid::whole("program", problem, "give all axes the same segments"));
    }
    if begun && ended.iter().all(|e| *e) {
        return Ok(());
    }
    let problem = if begun {
        let ends: Vec<String> = (0..n).map(|k| format!("PV{}=0,0,0", &letters[k..=k])).collect();
        format!("does not end with {}", ends.join(" and "))
    } else {
        format!("has no BT{letters}")
    };
    Err(Invalid::whole("program", problem, "complete it if it was cut off"))
}

/// Returns the sample time, s, from the number `units` after `TM`. Refuses one that differs from that of the settings
/// or of an earlier `TM` by more than a thousandth.
fn sample_of(line: usize, units: &str, sample_s: Option<f64>) -> Result<f64, Invalid> {
    let stated_s = finite(line, units.trim_start_matches([' ', '=']))? / TM_PER_S;
    // A little less or more is the rounding of a number that was typed.
    match sample_s.filter(|s| (s - stated_s).abs() > 1e-3 * stated_s) {
        Some(other) => {
            let problem = format!("sets samples of {stated_s} s (TM), and {other} s are given");
            let remedy = "give `sample_s` as the program has it, or leave it out";
            Err(Invalid::at_index("program line", line, problem, remedy))
        }
        None => Ok(stated_s),
    }
}

/// Returns the command that a text stands for. Refuses an unknown one, and a segment beyond the limits of the
/// controller.
fn parse(line: usize, command: &str, letters: &str) -> Result<GalilCommand, Invalid> {
    if command.strip_prefix("BT") == Some(letters) {
        return Ok(GalilCommand::Begin);
    }
    let unknown = || {
        let segments: String = letters.chars().map(|l| format!("PV{l}=, ")).collect();
        let short: String = command.chars().take(20).collect();
        wrong(line, format!("has {short:?}, not {segments}or BT{letters}"))
    };
    let named = command.strip_prefix("PV").and_then(|rest| rest.split_once('='));
    let (letter, rest) = named.filter(|(letter, _)| letter.len() == 1).ok_or_else(unknown)?;
    let axis = letters.find(letter).ok_or_else(unknown)?;
    let numbers = rest.split(',').map(|f| {
        f.trim().parse::<i64>().map_err(|_| {
            let short: String = f.trim().chars().take(20).collect();
            wrong(line, format!("has {short:?} where a whole number should be"))
        })
    });
    let numbers: Vec<i64> = numbers.collect::<Result<_, _>>()?;
    match numbers[..] {
        [0, 0, -1] => Ok(GalilCommand::Clear(axis)),
        [0, 0, 0] => Ok(GalilCommand::End(axis)),
        [p, v, t] if (1..=MOST_SAMPLES).contains(&t) => {
            if p.unsigned_abs() > MOST_DISTANCE as u64 || v.unsigned_abs() > MOST_VELOCITY as u64 {
                let most = format!("{MOST_DISTANCE} counts, {MOST_VELOCITY} counts/s");
                return Err(wrong(line, format!("has {p},{v}, which is beyond {most}")));
            }
            Ok(GalilCommand::Segment(axis, [p, v, t]))
        }
        [_, _, t] => Err(wrong(line, format!("takes {t} samples, not 1 to {MOST_SAMPLES}"))),
        _ => Err(unknown()),
    }
}
