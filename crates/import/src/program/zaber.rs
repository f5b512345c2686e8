//! Zaber, PVT sequence as CSV: a header, then one row per segment with its duration, and the absolute position and the
//! velocity of every axis at its end.
//!
//! The header names the columns: `Time (unit)`, and for every axis `NAME Position (unit)` and `NAME Velocity (unit/s)`.
//! Units are s or ms, and um, mm, cm or deg. The names are free; the axes are those of the configuration, in its order.
//! Between two rows every axis runs the cubic through positions and velocities. The first segment begins at rest where
//! the axes stand. The file switches no tool.
//!
//! Source: zabertech/zaber-examples, `motion_pvt_sequence_generation`; Zaber Motion Library, PvtSequence.

use planish_types::{AxesMotion, Invalid};

use super::{Knot, Layout, finite, needed, through, wrong};

/// Reads the motion of a PVT sequence. Refuses a header with other columns or units, rows with another number of
/// fields, durations that are not positive, a velocity at the end, and an absent start position.
pub(super) fn read(text: &str, layout: &Layout) -> Result<AxesMotion, Invalid> {
    let n = layout.len();
    let mut rows = text.lines().enumerate().filter(|(_, line)| !line.trim().is_empty());
    let Some((first, header)) = rows.next() else {
        return Err(Invalid::whole("program", "is empty", "give a sequence with its header"));
    };
    let units = units(header, layout).ok_or_else(|| {
        let axes = layout.names.iter().zip(&layout.units);
        let axes: String =
            axes.map(|(a, u)| format!(",{a} Position ({u}),{a} Velocity ({u}/s)")).collect();
        wrong(first + 1, format!("is not a header such as Time (s){axes}"))
    })?;
    let position = needed("start_mm", layout.start.clone())?;
    let mut last = Knot { time_s: 0.0, position, velocity: vec![0.0; n], tool_on: true };
    let mut knots = vec![last.clone()];
    for (i, line) in rows {
        let fields: Vec<f64> =
            line.split(',').map(|f| finite(i + 1, f)).collect::<Result<_, _>>()?;
        if fields.len() != 2 * n + 1 {
            return Err(wrong(i + 1, format!("has {} fields, not {}", fields.len(), 2 * n + 1)));
        }
        let scaled: Vec<f64> = fields.iter().zip(&units).map(|(v, unit)| v * unit).collect();
        if scaled[0] <= 0.0 {
            return Err(wrong(i + 1, format!("lasts {} s", scaled[0])));
        }
        last.time_s += scaled[0];
        for a in 0..n {
            last.position[a] = scaled[1 + 2 * a];
            last.velocity[a] = scaled[2 + 2 * a];
        }
        knots.push(last.clone());
    }
    if last.velocity.iter().any(|v| *v != 0.0) {
        let problem = format!("ends with the velocity {:?} mm/s or deg/s", last.velocity);
        return Err(Invalid::whole("program", problem, "end it at rest"));
    }
    through(&knots)
}

/// Returns the unit of every column in s, mm, mm/s, degrees or deg/s; `None` if a column is another one.
fn units(header: &str, layout: &Layout) -> Option<Vec<f64>> {
    let columns: Vec<&str> = header.trim().split(',').map(str::trim).collect();
    if columns.len() != 2 * layout.len() + 1 {
        return None;
    }
    let length = |unit: &str, axis: usize| match (unit, layout.units[axis].as_str()) {
        ("um", "mm") => Some(1e-3),
        ("mm", "mm") | ("deg", "deg") => Some(1.0),
        ("cm", "mm") => Some(10.0),
        _ => None,
    };
    let mut units = Vec::new();
    for (i, column) in columns.iter().enumerate() {
        let (name, unit) = column.strip_suffix(')')?.split_once(" (")?;
        units.push(match (i, i % 2) {
            (0, _) if name == "Time" && unit == "s" => 1.0,
            (0, _) if name == "Time" && unit == "ms" => 1e-3,
            (1.., 1) if name.ends_with("Position") => length(unit, (i - 1) / 2)?,
            (1.., 0) if name.ends_with("Velocity") => {
                length(unit.strip_suffix("/s")?, (i - 1) / 2)?
            }
            _ => return None,
        });
    }
    Some(units)
}
