//! Galil DMC-3xxxx, 4xxxx, 5xxxx, PVT mode: `PVA=dP,V,T` and `PVB=dP,V,T` add a segment each, with
//! a distance in counts, the velocity at its end in counts/s and a time of 1 to 2048 samples;
//! T = -1 clears the buffer, `0,0,0` ends the motion, `BT` begins it. A is x, B is y.
//!
//! Source: Galil DMC-40x0 command reference, PV and BT.

use planish_types::{Invalid, Trajectory};

use super::{Configuration, Knot, needed, positive, through, wrong};

/// Most samples of a segment.
const MOST_SAMPLES: i64 = 2048;

/// The motion of a program.
pub fn read(text: &str, configuration: &Configuration) -> Result<Trajectory, Invalid> {
    // Distance, velocity, samples of every segment.
    let mut axes: [Vec<[i64; 3]>; 2] = [Vec::new(), Vec::new()];
    for (i, line) in text.lines().enumerate() {
        let line = line.trim();
        if line.starts_with('\'') || line.starts_with("REM") || line.starts_with("NO ") {
            continue;
        }
        for command in line.split(';').map(str::trim).filter(|c| !c.is_empty()) {
            if let Some((axis, numbers)) = segment(i + 1, command)? {
                axes[axis].push(numbers);
            }
        }
    }
    let [a, b] = &axes;
    if a.len() != b.len() {
        let problem = format!("has {} segment(s) of A, {} of B", a.len(), b.len());
        return Err(Invalid::whole("program", problem, "give both axes the same segments"));
    }
    let count_mm = needed("count_mm", "--count-mm", configuration.count_mm)?;
    let sample_s = positive("sample_s", needed("sample_s", "--sample-s", configuration.sample_s)?)?;
    let start_mm = needed("start_mm", "--start-mm", configuration.start_mm)?;
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
        samples += a[2];
        counts = [counts[0].saturating_add(a[0]), counts[1].saturating_add(b[0])];
        knots.push(state(samples, counts, [a[1], b[1]]));
    }
    through(&knots)
}

/// The axis and the numbers of a segment; `None` for a command that makes no motion.
fn segment(line: usize, command: &str) -> Result<Option<(usize, [i64; 3])>, Invalid> {
    if command == "BTAB" || command == "BGAB" {
        return Ok(None);
    }
    let short = || command.chars().take(20).collect::<String>();
    let unknown = || wrong(line, format!("has \"{}\", not PVA=, PVB= or BTAB", short()));
    let (axis, rest) = match (command.strip_prefix("PVA="), command.strip_prefix("PVB=")) {
        (Some(rest), _) => (0, rest),
        (_, Some(rest)) => (1, rest),
        _ => return Err(unknown()),
    };
    let numbers = rest.split(',').map(|f| {
        f.trim().parse::<i64>().map_err(|_| {
            let short: String = f.trim().chars().take(20).collect();
            wrong(line, format!("has \"{short}\" where a whole number should be"))
        })
    });
    let numbers: Vec<i64> = numbers.collect::<Result<_, _>>()?;
    match numbers[..] {
        [_, _, -1] | [0, 0, 0] => Ok(None),
        [p, v, t] if (1..=MOST_SAMPLES).contains(&t) => Ok(Some((axis, [p, v, t]))),
        [_, _, t] => Err(wrong(line, format!("takes {t} samples, not 1 to {MOST_SAMPLES}"))),
        _ => Err(unknown()),
    }
}
