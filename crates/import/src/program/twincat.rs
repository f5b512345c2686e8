//! Table of setpoints for TwinCAT: `cycle_s,T`, the header `cycle,x_mm,vx_mm_per_s,ax_mm_per_s2,...,tool_on,segment`,
//! then one row per cycle. `tool_on` counts from its row to the next. Lines that start with `#` are comments.
//!
//! The motion has a cubic per segment: that through the positions and velocities of its first row and of the first row
//! of the next one. All rows go to the axes, so all of them have to lie on these cubics, with their velocities and
//! accelerations.

use planish_types::{AxesMotion, Invalid};

use super::{Knot, Layout, finite, hermite, positive, through, wrong};

/// Largest differences of a row from its cubic: position, mm or degrees, and velocity and acceleration relative to the
/// largest of the table. Larger: columns that were mixed up pass. Smaller: rounding is refused. Chosen: ten decimals of a
/// velocity are 1e-10 mm in a second, and six of an acceleration 1e-6 at 1 mm/s^2.
const ROUNDING: [f64; 3] = [1e-8, 1e-6, 1e-4];

/// A row of the table.
struct Row {
    /// Position, velocity and acceleration of every axis.
    states: Vec<[f64; 3]>,
    tool_on: bool,
    segment: usize,
}

/// Reads the motion of the table. Refuses a table without its cycle, with other columns, a row that is missing, fields
/// that are no numbers, a tool that changes within a segment or stays on at the end, and rows of another motion.
pub(super) fn read(text: &str, layout: &Layout) -> Result<AxesMotion, Invalid> {
    let columns = layout.names.iter().zip(&layout.units);
    let columns = columns.map(|(a, u)| format!("{a}_{u},v{a}_{u}_per_s,a{a}_{u}_per_s2,"));
    let header = format!("cycle,{}tool_on,segment", columns.collect::<String>());
    let lines = text.lines().enumerate().map(|(i, line)| (i + 1, line.trim()));
    let mut lines = lines.filter(|(_, line)| !line.is_empty() && !line.starts_with('#'));
    let cycle = lines.next().and_then(|(_, line)| line.strip_prefix("cycle_s,")?.parse().ok());
    let cycle_s = positive("cycle_s", cycle.unwrap_or(f64::NAN))?;
    if lines.next().is_none_or(|(_, line)| line != header) {
        let remedy = "write these columns, in this order and these units";
        let problem = format!("does not have the header {header}");
        return Err(Invalid::whole("program", problem, remedy));
    }
    let mut rows: Vec<Row> = Vec::new();
    for (i, line) in lines {
        let row = row(i, line, rows.len(), &header)?;
        let follows = rows.last().map_or(row.segment == 0, |before| {
            row.segment == before.segment + 1
                || row.segment == before.segment && row.tool_on == before.tool_on
        });
        if !follows {
            let problem = format!("is of segment {}, with tool_on {}", row.segment, row.tool_on);
            return Err(wrong(i, format!("{problem}, which does not follow the row before")));
        }
        rows.push(row);
    }
    if rows.last().is_some_and(|last| last.tool_on) {
        return Err(Invalid::whole("program", "ends with the tool on", "end it with tool_on 0"));
    }
    let last = rows.len().saturating_sub(1);
    let begins = |k: usize| k == 0 || k == last || rows[k].segment != rows[k - 1].segment;
    let nodes: Vec<usize> = (0..rows.len()).filter(|k| begins(*k)).collect();
    check_rows(&rows, &nodes, cycle_s)?;
    let knots: Vec<Knot> = (nodes.iter())
        .map(|k| Knot {
            time_s: *k as f64 * cycle_s,
            position: rows[*k].states.iter().map(|s| s[0]).collect(),
            velocity: rows[*k].states.iter().map(|s| s[1]).collect(),
            tool_on: rows[*k].tool_on,
        })
        .collect();
    through(&knots)
}

/// Returns the row of the cycle `cycle` in a line of the program.
fn row(line: usize, text: &str, cycle: usize, header: &str) -> Result<Row, Invalid> {
    let fields: Vec<f64> = text.split(',').map(|f| finite(line, f)).collect::<Result<_, _>>()?;
    if fields.len() != header.split(',').count() {
        return Err(wrong(line, format!("has {} fields, not {header}", fields.len())));
    }
    if fields[0] != cycle as f64 {
        return Err(wrong(line, format!("is cycle {}, not {cycle}", fields[0])));
    }
    let [on, segment] = [fields[fields.len() - 2], fields[fields.len() - 1]];
    if on != 0.0 && on != 1.0 {
        return Err(wrong(line, format!("has {on} for tool_on, not 0 or 1")));
    }
    if segment.fract() != 0.0 || segment < 0.0 {
        return Err(wrong(line, format!("has {segment} for segment, not a whole number")));
    }
    let states = fields[1..fields.len() - 2].chunks(3).map(|s| [s[0], s[1], s[2]]).collect();
    Ok(Row { states, tool_on: on != 0.0, segment: segment as usize })
}

/// Refuses a row that is not on the cubic of its segment. `nodes` are the first rows of the segments, and the last row.
fn check_rows(rows: &[Row], nodes: &[usize], cycle_s: f64) -> Result<(), Invalid> {
    let all = || rows.iter().flat_map(|row| &row.states);
    let [v, a] = [1, 2].map(|i| all().map(|s| s[i].abs()).fold(1.0, f64::max));
    let allowed = [ROUNDING[0], ROUNDING[1] * v, ROUNDING[2] * a];
    for node in nodes.windows(2) {
        let duration_s = (node[1] - node[0]) as f64 * cycle_s;
        for axis in 0..rows[node[0]].states.len() {
            let [first, last] = [node[0], node[1]].map(|k| rows[k].states[axis]);
            let c = hermite([first[0], last[0]], [first[1], last[1]], duration_s);
            for (k, row) in rows.iter().enumerate().take(node[1]).skip(node[0]) {
                let u = (k - node[0]) as f64 * cycle_s;
                let own = [
                    c[0] + u * (c[1] + u * (c[2] + u * c[3])),
                    c[1] + u * (2.0 * c[2] + 3.0 * u * c[3]),
                    2.0 * c[2] + 6.0 * u * c[3],
                ];
                let stated = row.states[axis];
                if (0..3).any(|i| (own[i] - stated[i]).abs() > allowed[i]) {
                    let problem = format!("has {stated:?}, and the cubic of its segment {own:?}");
                    let remedy = "export the table again: its rows are of different motions";
                    return Err(Invalid::at_index("cycle", k, problem, remedy));
                }
            }
        }
    }
    Ok(())
}
