//! Newport XPS, PVT trajectory: one line `dt, dx, vx, dy, vy` per element, with two fields for every
//! further positioner of the group, distances relative,
//! velocities at the end of the element, in mm and s. There is no header and there are no comments;
//! the last velocity is zero. Blanks, tabs and semicolons separate fields as commas do.
//!
//! Source: XPS user's manual, section on PVT trajectories.

use planish_types::{AxesMotion, Invalid};

use super::{
    Knot, Layout, finite,
    lines::{Part, motion},
    needed, through, wrong,
};
use crate::text::fields;

/// Reads the motion of an XPS trajectory file, with a cubic per line. Refuses a header or comment, another number of
/// fields, a time that is not positive, a velocity at the end, and an absent start position.
pub(super) fn read(text: &str, layout: &Layout) -> Result<AxesMotion, Invalid> {
    let n = layout.len();
    let position = needed("start_mm", layout.start.clone())?;
    let mut last = Knot { time_s: 0.0, position, velocity: vec![0.0; n], tool_on: true };
    let mut knots = vec![last.clone()];
    for fields in elements(text, layout, &["d", "v"])? {
        last.time_s += fields[0];
        for (a, state) in fields[1..].chunks(2).enumerate() {
            last.position[a] += state[0];
            last.velocity[a] = state[1];
        }
        knots.push(last.clone());
    }
    if last.velocity.iter().any(|v| *v != 0.0) {
        let problem = format!("ends with the velocity {:?} mm/s or deg/s", last.velocity);
        return Err(Invalid::whole("program", problem, "the controller wants zero"));
    }
    through(&knots)
}

/// Reads the motion of a PT file, lines `dt, dx, dy`. No public source states how the controller moves between two of
/// its points: they are read as lines that are joined by parabolas, and an element without distance as a stop. Refuses
/// what [`read`] refuses.
pub(super) fn read_pt(text: &str, layout: &Layout) -> Result<AxesMotion, Invalid> {
    let mut position = needed("start_mm", layout.start.clone())?;
    let mut parts = Vec::new();
    for fields in elements(text, layout, &["d"])? {
        let seconds = fields[0];
        let distance = &fields[1..];
        let states = position.iter().zip(distance).map(|(p, d)| [*p, d / seconds]).collect();
        let is_stop = distance.iter().all(|d| *d == 0.0);
        parts.push(Part { seconds, states, tool_on: true, is_stop });
        position.iter_mut().zip(distance).for_each(|(p, d)| *p += d);
    }
    if parts.is_empty() {
        return Err(Invalid::whole("program", "moves nothing", "give a file with motion"));
    }
    motion(&parts, layout, f64::INFINITY)
}

/// Returns the numbers of every line: the time, and one number per axis for each of `kinds`. Refuses a header or
/// comment, another number of fields, and a time that is not positive.
fn elements(text: &str, layout: &Layout, kinds: &[&str]) -> Result<Vec<Vec<f64>>, Invalid> {
    let mut elements = Vec::new();
    for (i, line) in text.lines().enumerate().filter(|(_, l)| !l.trim().is_empty()) {
        if line.trim_start().starts_with(|c: char| c.is_alphabetic() || "#;%\"'/".contains(c)) {
            let problem = format!(
                "has {:?}: a header or a comment",
                line.trim().chars().take(20).collect::<String>()
            );
            let remedy = "take the line off: an XPS reads lines of numbers only";
            return Err(Invalid::at_index("program line", i + 1, problem, remedy));
        }
        let fields = fields(line).map(|f| finite(i + 1, f));
        let fields: Vec<f64> = fields.collect::<Result<_, _>>()?;
        if fields.len() != kinds.len() * layout.len() + 1 {
            let names = layout.names.iter();
            let names: String =
                names.flat_map(|a| kinds.iter().map(move |kind| format!(", {kind}{a}"))).collect();
            return Err(wrong(i + 1, format!("has {} fields, not dt{names}", fields.len())));
        }
        if fields[0] <= 0.0 {
            return Err(wrong(i + 1, format!("lasts {} s", fields[0])));
        }
        elements.push(fields);
    }
    Ok(elements)
}
