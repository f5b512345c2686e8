//! Newport XPS, PVT trajectory: one line `dt, dx, vx, dy, vy` per element, distances relative,
//! velocities at the end of the element, in mm and s. There is no header and there are no comments;
//! the last velocity is zero.
//!
//! Source: XPS user's manual, section on PVT trajectories.

use planish_types::{Invalid, Trajectory};

use super::{Configuration, Knot, finite, needed, through, wrong};

/// The motion of a program.
pub fn read(text: &str, configuration: &Configuration) -> Result<Trajectory, Invalid> {
    let start_mm = needed("start_mm", configuration.start_mm)?;
    let mut knots = vec![Knot {
        time_s: 0.0,
        position_mm: start_mm,
        velocity_mm_per_s: [0.0; 2],
        tool_on: true,
    }];
    let mut last = *knots.last().expect("one knot");
    for (i, line) in text.lines().enumerate().filter(|(_, l)| !l.trim().is_empty()) {
        let fields = line.split(',').map(|f| finite(i + 1, f));
        let fields: Vec<f64> = fields.collect::<Result<_, _>>()?;
        let [dt, dx, vx, dy, vy] = fields[..] else {
            return Err(wrong(
                i + 1,
                format!("has {} fields, not dt, dx, vx, dy, vy", fields.len()),
            ));
        };
        if dt <= 0.0 {
            return Err(wrong(i + 1, format!("lasts {dt} s")));
        }
        last.time_s += dt;
        last.position_mm = [last.position_mm[0] + dx, last.position_mm[1] + dy];
        last.velocity_mm_per_s = [vx, vy];
        knots.push(last);
    }
    if last.velocity_mm_per_s != [0.0; 2] {
        let problem = format!("ends with the velocity {:?} mm/s", last.velocity_mm_per_s);
        return Err(Invalid::whole("program", problem, "the controller wants zero"));
    }
    through(&knots)
}
