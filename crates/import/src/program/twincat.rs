//! Table of setpoints for TwinCAT: `cycle_s,T`, the header `cycle,x_mm,vx_mm_per_s,ax_mm_per_s2,...,tool_on`, then one
//! row per cycle. `tool_on` counts from its row to the next. Lines that start with `#` are comments.
//!
//! Between two rows the motion is the cubic through their positions and velocities. The accelerations go to the axes
//! as a feed forward: they have to be those of the cubics that begin at their rows.

use planish_types::{AxesMotion, Invalid};

use super::{Knot, Layout, finite, hermite, positive, through, wrong};

/// Largest difference of an acceleration of the table from that of its cubic, relative to the largest acceleration of
/// the table. Larger: columns that were mixed up pass. Smaller: rounding of the positions is refused. Chosen: six
/// decimals of an acceleration and thirteen of a position make 1e-6 at 1 mm/s^2.
const ACCELERATION_ROUNDING: f64 = 1e-4;

/// Reads the motion of the table. Refuses a table without its cycle, with other columns, a row that is missing, fields
/// that are no numbers, a `tool_on` other than 0 and 1 or 1 in the last row, and accelerations of another motion.
pub(super) fn read(text: &str, layout: &Layout) -> Result<AxesMotion, Invalid> {
    let n = layout.len();
    let columns = layout.names.iter().zip(&layout.units);
    let columns = columns.map(|(a, u)| format!("{a}_{u},v{a}_{u}_per_s,a{a}_{u}_per_s2,"));
    let header = format!("cycle,{}tool_on", columns.collect::<String>());
    let lines = text.lines().enumerate().map(|(i, line)| (i + 1, line.trim()));
    let mut lines = lines.filter(|(_, line)| !line.is_empty() && !line.starts_with('#'));
    let cycle = lines.next().and_then(|(_, line)| line.strip_prefix("cycle_s,")?.parse().ok());
    let cycle_s = positive("cycle_s", cycle.unwrap_or(f64::NAN))?;
    if lines.next().is_none_or(|(_, line)| line != header) {
        let remedy = "write these columns, in this order and these units";
        let problem = format!("does not have the header {header}");
        return Err(Invalid::whole("program", problem, remedy));
    }
    let mut knots: Vec<Knot> = Vec::new();
    let mut accelerations: Vec<Vec<f64>> = Vec::new();
    for (i, line) in lines {
        let fields: Vec<f64> = line.split(',').map(|f| finite(i, f)).collect::<Result<_, _>>()?;
        if fields.len() != 3 * n + 2 {
            return Err(wrong(i, format!("has {} fields, not {header}", fields.len())));
        }
        if fields[0] != knots.len() as f64 {
            return Err(wrong(i, format!("is cycle {}, not {}", fields[0], knots.len())));
        }
        let on = fields[3 * n + 1];
        if on != 0.0 && on != 1.0 {
            return Err(wrong(i, format!("has {on} for tool_on, not 0 or 1")));
        }
        let state = |k: usize| (0..n).map(|a| fields[1 + 3 * a + k]).collect();
        knots.push(Knot {
            time_s: fields[0] * cycle_s,
            position: state(0),
            velocity: state(1),
            tool_on: on != 0.0,
        });
        accelerations.push(state(2));
    }
    if knots.last().is_some_and(|last| last.tool_on) {
        return Err(Invalid::whole("program", "ends with the tool on", "end it with tool_on 0"));
    }
    check_accelerations(&knots, &accelerations, cycle_s)?;
    through(&knots)
}

/// Refuses an acceleration that is not that of the cubic which begins at its row.
fn check_accelerations(
    knots: &[Knot],
    accelerations: &[Vec<f64>],
    cycle_s: f64,
) -> Result<(), Invalid> {
    let largest = accelerations.iter().flatten().map(|a| a.abs()).fold(1.0, f64::max);
    for (k, (pair, stated)) in knots.windows(2).zip(accelerations).enumerate() {
        for (a, stated) in stated.iter().enumerate() {
            let p = [pair[0].position[a], pair[1].position[a]];
            let v = [pair[0].velocity[a], pair[1].velocity[a]];
            let own = 2.0 * hermite(p, v, cycle_s)[2];
            if (own - stated).abs() > ACCELERATION_ROUNDING * largest {
                let problem = format!("has the acceleration {stated}, and its cubic has {own}");
                let remedy = "export the table again: its columns are of different motions";
                return Err(Invalid::at_index("cycle", k, problem, remedy));
            }
        }
    }
    Ok(())
}
