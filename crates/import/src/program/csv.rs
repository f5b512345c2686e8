//! A table of the motion: `t_s,x_mm,vx_mm_per_s,y_mm,vy_mm_per_s,tool_on`, one row per knot; `tool_on`
//! counts from its row to the next. Lines that start with `#` are comments.

use planish_types::{Invalid, Trajectory};

use super::{Knot, finite, through, wrong};

const HEADER: &str = "t_s,x_mm,vx_mm_per_s,y_mm,vy_mm_per_s,tool_on";

/// The motion of a table.
pub fn read(text: &str) -> Result<Trajectory, Invalid> {
    let mut knots = Vec::new();
    let mut header = false;
    for (i, line) in text.lines().enumerate() {
        let line = line.trim();
        if line.is_empty() || line.starts_with('#') {
            continue;
        }
        if !header {
            if line != HEADER {
                return Err(wrong(i + 1, format!("is not the header {HEADER}")));
            }
            header = true;
            continue;
        }
        let fields = line.split(',').map(|f| finite(i + 1, f));
        let fields: Vec<f64> = fields.collect::<Result<_, _>>()?;
        let [time_s, x, vx, y, vy, on] = fields[..] else {
            return Err(wrong(i + 1, format!("has {} fields, not {HEADER}", fields.len())));
        };
        if on != 0.0 && on != 1.0 {
            return Err(wrong(i + 1, format!("has {on} for tool_on, not 0 or 1")));
        }
        knots.push(Knot {
            time_s,
            position_mm: [x, y],
            velocity_mm_per_s: [vx, vy],
            tool_on: on != 0.0,
        });
    }
    through(&knots)
}
