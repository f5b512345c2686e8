//! Galil DMC-3xxxx, 4xxxx, 5xxxx, PVT mode: `PVA=dP,V,T` and `PVB=dP,V,T` add a segment each, with
//! a distance in counts, the velocity at its end in counts/s and a time of 1 to 2048 samples;
//! T = -1 clears the buffer, `0,0,0` ends the motion, `BT` begins it. A is x, B is y.
//!
//! Errors are refused that would change the motion without a trace: clearing the buffer after the first
//! segment, a segment after the end, and a missing end or beginning (a program that was cut off).
//!
//! Source: Galil DMC-40x0 command reference, PV and BT.

use planish_types::{Invalid, Trajectory};

use super::{Configuration, Knot, needed, positive, through, wrong};

/// Largest time of a segment, samples (Galil DMC-40x0 command reference, PV).
const MOST_SAMPLES: i64 = 2048;
/// Largest distance of a segment, counts (Galil DMC-40x0 command reference, PV).
const MOST_DISTANCE: i64 = 44_000_000;
/// Largest velocity at the end of a segment, counts/s (Galil DMC-40x0 command reference, PV).
const MOST_VELOCITY: i64 = 22_000_000;

/// Command of a line.
enum Command {
    /// A segment of an axis.
    Segment(usize, [i64; 3]),
    /// Clear the buffer of an axis.
    Clear(usize),
    /// The end of the motion of an axis.
    End(usize),
    /// Begin the motion of both axes.
    Begin,
}

/// The motion of a program.
pub fn read(text: &str, configuration: &Configuration) -> Result<Trajectory, Invalid> {
    // Distance, velocity, samples of every segment.
    let mut axes: [Vec<[i64; 3]>; 2] = [Vec::new(), Vec::new()];
    let (mut ended, mut begun) = ([false; 2], false);
    for (i, line) in text.lines().enumerate() {
        let line = line.trim();
        if line.starts_with('\'') || line.starts_with("REM") || line.starts_with("NO ") {
            continue;
        }
        for command in line.split(';').map(str::trim).filter(|c| !c.is_empty()) {
            match parse(i + 1, command)? {
                Command::Segment(axis, _) | Command::Clear(axis) | Command::End(axis)
                    if ended[axis] =>
                {
                    return Err(wrong(i + 1, "goes on after the end of the motion (0,0,0)"));
                }
                Command::Segment(axis, numbers) => axes[axis].push(numbers),
                Command::Clear(axis) if axes[axis].is_empty() => {}
                Command::Clear(_) => {
                    return Err(wrong(i + 1, "clears the segments before it (T = -1)"));
                }
                Command::End(axis) => ended[axis] = true,
                Command::Begin if begun => return Err(wrong(i + 1, "begins the motion again")),
                Command::Begin => begun = true,
            }
        }
    }
    let [a, b] = &axes;
    if a.len() != b.len() {
        let problem = format!("has {} segment(s) of A, {} of B", a.len(), b.len());
        return Err(Invalid::whole("program", problem, "give both axes the same segments"));
    }
    if !(begun && ended == [true; 2]) {
        let problem =
            if begun { "does not end with PVA=0,0,0 and PVB=0,0,0" } else { "has no BTAB" };
        return Err(Invalid::whole("program", problem, "it was cut off: write the program again"));
    }
    let count_mm = needed("count_mm", configuration.count_mm)?;
    let sample_s = positive("sample_s", needed("sample_s", configuration.sample_s)?)?;
    let start_mm = needed("start_mm", configuration.start_mm)?;
    for c in count_mm {
        positive("count_mm", c)?;
    }
    let state = |samples: i64, counts: [i64; 2], velocity: [i64; 2]| Knot {
        time_s: samples as f64 * sample_s,
        position_mm: [0, 1].map(|k| start_mm[k] + counts[k] as f64 * count_mm[k]),
        velocity_mm_per_s: [0, 1].map(|k| velocity[k] as f64 * count_mm[k]),
        tool_on: true,
    };
    // Counts and samples add up without rounding.
    let (mut samples, mut counts) = (0i64, [0i64; 2]);
    let mut knots = vec![state(0, counts, [0, 0])];
    for (i, (a, b)) in a.iter().zip(b).enumerate() {
        if a[2] != b[2] {
            let problem = format!("takes {} samples for A, {} for B", a[2], b[2]);
            return Err(Invalid::at("segment", i, problem, "give both axes the same time"));
        }
        // Both are bounded by the length of the text: 1e9 lines of 44e6 counts stay below 2^63.
        samples += a[2];
        counts = [counts[0] + a[0], counts[1] + b[0]];
        knots.push(state(samples, counts, [a[1], b[1]]));
    }
    through(&knots)
}

fn parse(line: usize, command: &str) -> Result<Command, Invalid> {
    if command == "BTAB" {
        return Ok(Command::Begin);
    }
    let short = || command.chars().take(20).collect::<String>();
    let unknown = || wrong(line, format!("has {:?}, not PVA=, PVB= or BTAB", short()));
    let (axis, rest) = match (command.strip_prefix("PVA="), command.strip_prefix("PVB=")) {
        (Some(rest), _) => (0, rest),
        (_, Some(rest)) => (1, rest),
        _ => return Err(unknown()),
    };
    let numbers = rest.split(',').map(|f| {
        f.trim().parse::<i64>().map_err(|_| {
            let short: String = f.trim().chars().take(20).collect();
            wrong(line, format!("has {short:?} where a whole number should be"))
        })
    });
    let numbers: Vec<i64> = numbers.collect::<Result<_, _>>()?;
    match numbers[..] {
        [0, 0, -1] => Ok(Command::Clear(axis)),
        [0, 0, 0] => Ok(Command::End(axis)),
        [p, v, t] if (1..=MOST_SAMPLES).contains(&t) => {
            if p.unsigned_abs() > MOST_DISTANCE as u64 || v.unsigned_abs() > MOST_VELOCITY as u64 {
                let most = format!("{MOST_DISTANCE} counts, {MOST_VELOCITY} counts/s");
                return Err(wrong(line, format!("has {p},{v}, which is beyond {most}")));
            }
            Ok(Command::Segment(axis, [p, v, t]))
        }
        [_, _, t] => Err(wrong(line, format!("takes {t} samples, not 1 to {MOST_SAMPLES}"))),
        _ => Err(unknown()),
    }
}
