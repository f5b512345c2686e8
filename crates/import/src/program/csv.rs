//! A table of the motion: `t_s,x_mm,vx_mm_per_s,y_mm,vy_mm_per_s,tool_on`, one row per knot, with two columns for every
//! further axis; `tool_on` counts from its row to the next. Lines that start with `#` are comments.
//! Blanks around a field, quotes, and semicolons or tabs for commas are read.

use planish_types::{AxesMotion, Invalid};

use super::{Knot, Layout, finite, through, wrong};
use crate::text::fields;

/// Reads the motion from the table, with a cubic between two rows. Refuses a header other than the columns of `layout`,
/// fields that are no numbers, a `tool_on` other than 0 and 1, and fewer than two rows.
pub(super) fn read(text: &str, layout: &Layout) -> Result<AxesMotion, Invalid> {
    let columns = layout.names.iter().zip(&layout.units);
    let columns = columns.map(|(name, unit)| format!("{name}_{unit},v{name}_{unit}_per_s,"));
    let expected = format!("t_s,{}tool_on", columns.collect::<String>());
    let mut knots = Vec::new();
    let mut header = false;
    for (i, line) in text.lines().enumerate() {
        let line = line.trim();
        if line.is_empty() || line.starts_with('#') {
            continue;
        }
        if !header {
            let names: Vec<String> = fields(line).map(str::to_lowercase).collect();
            if names.join(",") != expected {
                let remedy = "write these columns, in this order and these units";
                let problem = format!("is not the header {expected}");
                return Err(Invalid::at_index("program line", i + 1, problem, remedy));
            }
            header = true;
            continue;
        }
        let fields = fields(line).map(|f| finite(i + 1, f));
        let fields: Vec<f64> = fields.collect::<Result<_, _>>()?;
        if fields.len() != 2 * layout.len() + 2 {
            return Err(wrong(i + 1, format!("has {} fields, not {expected}", fields.len())));
        }
        let states = &fields[1..fields.len() - 1];
        let on = fields[fields.len() - 1];
        if on != 0.0 && on != 1.0 {
            return Err(wrong(i + 1, format!("has {on} for tool_on, not 0 or 1")));
        }
        knots.push(Knot {
            time_s: fields[0],
            position: states.iter().copied().step_by(2).collect(),
            velocity: states.iter().copied().skip(1).step_by(2).collect(),
            tool_on: on != 0.0,
        });
    }
    through(&knots)
}
