//! PMAC, PVT mode: `PVT<t>` sets the time of the segments that follow, in ms; `X<p>:<v> Y<p>:<v>` is
//! a segment to a position (`ABS`) or by a distance (`INC`) with the velocity at its end, in mm per
//! feedrate time unit. A velocity that is left out is zero, an axis that is left out stands still.
//!
//! Source: Turbo PMAC software reference, program commands PVT and {axis}{data}:{data}.

use planish_types::{Invalid, Trajectory};

use super::{Configuration, Knot, finite, needed, positive, through, wrong};

/// The motion of a program.
pub fn read(text: &str, configuration: &Configuration) -> Result<Trajectory, Invalid> {
    let start_mm = needed("start_mm", "--start-mm", configuration.start_mm)?;
    let unit_s = needed(
        "feedrate_time_unit_s",
        "--feedrate-time-unit-s",
        configuration.feedrate_time_unit_s,
    )?;
    let unit_s = positive("feedrate_time_unit_s", unit_s)?;
    let mut last =
        Knot { time_s: 0.0, position_mm: start_mm, velocity_mm_per_s: [0.0; 2], tool_on: true };
    let mut knots = vec![last];
    let (mut segment_ms, mut absolute, mut total_ms) = (None, true, 0.0);
    for (i, line) in text.lines().enumerate() {
        let line = line.split(';').next().unwrap_or_default().trim();
        match line {
            "" => continue,
            "ABS" => absolute = true,
            "INC" => absolute = false,
            _ if line.starts_with("PVT") => {
                let ms = finite(i + 1, line[3..].trim_matches(['(', ')']))?;
                if ms <= 0.0 {
                    return Err(wrong(i + 1, format!("lasts {ms} ms")));
                }
                segment_ms = Some(ms);
            }
            _ => {
                let Some(ms) = segment_ms else {
                    return Err(wrong(i + 1, "moves before PVT sets a time"));
                };
                // Milliseconds add up; dividing every one of them would round every one.
                total_ms += ms;
                last.time_s = total_ms / 1e3;
                last.velocity_mm_per_s = [0.0; 2];
                for word in line.split_whitespace() {
                    let axis = match word.as_bytes()[0] {
                        b'X' => 0,
                        b'Y' => 1,
                        _ => {
                            return Err(wrong(
                                i + 1,
                                format!("has \"{}\", not X or Y", &short(word)),
                            ));
                        }
                    };
                    let (p, v) = word[1..].split_once(':').unwrap_or((&word[1..], "0"));
                    let (p, v) = (finite(i + 1, p)?, finite(i + 1, v)?);
                    last.position_mm[axis] = if absolute { p } else { last.position_mm[axis] + p };
                    last.velocity_mm_per_s[axis] = v / unit_s;
                }
                knots.push(last);
            }
        }
    }
    through(&knots)
}

fn short(word: &str) -> String {
    word.chars().take(20).collect()
}
