//! Aerotech Automation1, AeroScript: `MovePvt([X, Y], [p, p], [v, v], ms)` per segment, between `program` and `end`, in
//! mm and mm/s (degrees and deg/s), with absolute positions and the duration of the segment in milliseconds.
//!
//! | statement | meaning |
//! |---|---|
//! | `SetupTaskTargetMode(TargetMode.Absolute)` | positions are absolute |
//! | `SetupTaskTimeUnits(TimeUnits.Seconds)` | velocities are per second |
//! | `Enable(..)`, `WaitForMotionDone(..)`, `WaitForInPosition(..)` | no motion |
//!
//! `//` begins a comment. The program switches no tool.
//!
//! Source: Automation1 C interface, `Automation1_Command_MovePvt`; EPICS driver motorAutomation1.

use planish_types::{AxesMotion, Invalid};

use super::{Knot, Layout, finite, needed, through, wrong};

/// Reads the motion of an AeroScript program, with a cubic per `MovePvt`. Refuses statements that it does not know,
/// motion before both settings, lines without all axes, times that are not positive, a velocity at the end, and a
/// program without `end`.
pub(super) fn read(text: &str, layout: &Layout) -> Result<AxesMotion, Invalid> {
    let mut knots: Vec<Knot> = Vec::new();
    let [mut absolute, mut per_second, mut ended] = [false; 3];
    for (i, line) in text.lines().enumerate() {
        let statement: String =
            line.split("//").next().unwrap_or_default().split_whitespace().collect();
        if statement.is_empty() {
            continue;
        }
        if ended {
            return Err(wrong(i + 1, "goes on after end"));
        }
        match statement.as_str() {
            "program" => {}
            "end" => ended = true,
            "SetupTaskTargetMode(TargetMode.Absolute)" if knots.is_empty() => absolute = true,
            "SetupTaskTimeUnits(TimeUnits.Seconds)" if knots.is_empty() => per_second = true,
            s if ["Enable(", "WaitForMotionDone(", "WaitForInPosition("]
                .iter()
                .any(|name| s.starts_with(name)) => {}
            s => {
                let inner = s.strip_prefix("MovePvt(").and_then(|s| s.strip_suffix(')'));
                let Some(inner) = inner else {
                    return Err(wrong(i + 1, format!("has {s:?}, which is not understood here")));
                };
                if !(absolute && per_second) {
                    let problem = "comes before TargetMode.Absolute and TimeUnits.Seconds are set";
                    return Err(wrong(i + 1, problem));
                }
                if knots.is_empty() {
                    let position = needed("start_mm", layout.start.clone())?;
                    let velocity = vec![0.0; layout.len()];
                    knots.push(Knot { time_s: 0.0, position, velocity, tool_on: true });
                }
                let next = knot(i + 1, inner, layout, knots[knots.len() - 1].time_s)?;
                knots.push(next);
            }
        }
    }
    if !ended {
        let remedy = "end it with end, or export it again: it was cut off";
        return Err(Invalid::whole("program", "has no end", remedy));
    }
    if let Some(last) = knots.last().filter(|last| last.velocity.iter().any(|v| *v != 0.0)) {
        let problem = format!("ends with the velocity {:?} mm/s or deg/s", last.velocity);
        return Err(Invalid::whole("program", problem, "end it at rest"));
    }
    through(&knots)
}

/// Returns the state at the end of a segment `[X,Y],[p,p],[v,v],ms` that begins at `before_s`.
fn knot(line: usize, arguments: &str, layout: &Layout, before_s: f64) -> Result<Knot, Invalid> {
    let lists: Vec<&str> = arguments.split("],").collect();
    let [axes, positions, velocities, ms] = lists[..] else {
        return Err(wrong(line, "has a MovePvt without axes, positions, velocities and a time"));
    };
    let list = |text: &str| -> Option<Vec<String>> {
        Some(text.strip_prefix('[')?.split(',').map(String::from).collect())
    };
    let expected: Vec<String> = layout.letters().iter().map(char::to_string).collect();
    let no_list =
        || wrong(line, format!("has lists that are not of the axes {}", expected.join(", ")));
    if list(axes).as_ref() != Some(&expected) {
        return Err(no_list());
    }
    let mut states = Vec::new();
    for text in [positions, velocities] {
        let words = list(text).filter(|words| words.len() == expected.len()).ok_or_else(no_list)?;
        let numbers: Result<Vec<f64>, _> = words.iter().map(|word| finite(line, word)).collect();
        states.push(numbers?);
    }
    let seconds = 1e-3 * finite(line, ms)?;
    if seconds <= 0.0 {
        return Err(wrong(line, format!("lasts {seconds} s")));
    }
    let [velocity, position] = [states.remove(1), states.remove(0)];
    Ok(Knot { time_s: before_s + seconds, position, velocity, tool_on: true })
}
