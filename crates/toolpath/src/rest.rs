//! Rest of a path after an abort: from the place where the machine stands to the end of the path.
//!
//! The last dwell point that the executed motion served says where on the path the machine is, also where the path
//! comes to a place twice. From there the nearest of the next segments counts, because the stop may lead beyond the end of a
//! segment.

use planish_types::{Invalid, ToolPath, Trajectory};

/// Number of segments after the last one that are compared with the place of the machine. Larger: the neighbouring
/// line may be nearer. Smaller: a stop that leads over more segments is placed too early.
const AHEAD: usize = 3;
/// Part of a segment that is too short to be a segment of its own; the rest then begins with the next one. Larger: the
/// path leaves its line. Smaller: the plan has steep dwell times.
const SHORT: f64 = 0.1;

/// Returns the rest of `path` for a machine that stands where the motion `executed` ends.
///
/// # Errors
/// Refuses a motion that serves no dwell point of the path, one that ends far from the path, and one after which
/// nothing is left.
pub fn rest(path: &ToolPath, executed: &Trajectory) -> Result<ToolPath, Invalid> {
    let last = executed.segment(executed.len() - 1);
    let place = last.position_mm(last.duration_s);
    let served = executed.dwell_index().iter().rev().flatten().next().copied();
    let served = served.filter(|i| *i < path.len()).ok_or_else(|| {
        let problem = "serves no dwell point of the tool path";
        Invalid::whole("trajectory", problem, "give that of planish schedule abort")
    })?;
    let mut on = Foot::new(path, served, place);
    for i in served + 1..path.len().min(served + 1 + AHEAD) {
        let next = Foot::new(path, i, place);
        // A machine at the end of a segment is on the next one.
        if next.distance_mm <= on.distance_mm + 1e-9 {
            on = next;
        }
    }
    refuse_far(path, place, on.distance_mm)?;
    let first = if 1.0 - on.fraction <= SHORT { on.segment + 1 } else { on.segment };
    if first == path.len() {
        let problem = "ends at the end of the tool path";
        return Err(Invalid::whole("trajectory", problem, "nothing is left to be planned"));
    }
    let mut point_mm = path.point_mm()[first..].to_vec();
    point_mm[0] = place;
    let mut dwell_point_mm = path.dwell_point_mm()[first..].to_vec();
    if first == on.segment && Foot::new(path, first, dwell_point_mm[0]).fraction <= on.fraction {
        dwell_point_mm[0] = [0, 1].map(|k| 0.5 * (place[k] + point_mm[1][k]));
    }
    ToolPath::new(
        point_mm,
        dwell_point_mm,
        path.tool_on()[first..].to_vec(),
        path.pass_idx()[first..].to_vec(),
    )
}

/// Refuses a place that is farther from the path than its longest segment.
fn refuse_far(path: &ToolPath, place: [f64; 2], distance_mm: f64) -> Result<(), Invalid> {
    let longest_mm = (0..path.len()).map(|i| path.segment_length_mm(i)).fold(0.0, f64::max);
    if distance_mm <= longest_mm {
        return Ok(());
    }
    let [x, y] = place;
    let problem = format!("ends at ({x:.3}, {y:.3}) mm, {distance_mm:.3} mm from the tool path");
    Err(Invalid::whole("trajectory", problem, "give a motion in the coordinates of the part"))
}

/// Foot of the perpendicular from a place to a segment of the path.
struct Foot {
    segment: usize,
    /// Part of the segment before the foot, 0 to 1.
    fraction: f64,
    /// Distance of the place from the foot, mm.
    distance_mm: f64,
}

impl Foot {
    fn new(path: &ToolPath, segment: usize, place: [f64; 2]) -> Self {
        let from = path.point_mm()[segment];
        let [dx, dy] = path.displacement_mm(segment);
        let [px, py] = [place[0] - from[0], place[1] - from[1]];
        let squared = dx * dx + dy * dy;
        // A segment of no length has one foot, its end.
        let fraction =
            if squared > 0.0 { ((px * dx + py * dy) / squared).clamp(0.0, 1.0) } else { 1.0 };
        let distance_mm = (px - fraction * dx).hypot(py - fraction * dy);
        Self { segment, fraction, distance_mm }
    }
}

#[cfg(test)]
mod tests {
    use planish_types::TrajectoryBuilder;

    use super::*;

    fn path() -> ToolPath {
        let points = vec![[0.0, 0.0], [1.0, 0.0], [2.0, 0.0], [2.0, 1.0], [0.0, 1.0]];
        ToolPath::through(points, vec![true, true, false, true], vec![0, 0, 0, 1]).unwrap()
    }

    /// A motion that stands at `place` and serves dwell point `served`.
    fn at(place: [f64; 2], served: Option<usize>) -> Trajectory {
        let mut builder = TrajectoryBuilder::default();
        builder.push(1.0, place.map(|p| [p, 0.0, 0.0, 0.0]), true, served);
        builder.build().unwrap()
    }

    #[test]
    fn the_rest_begins_where_the_machine_stands() {
        let left = rest(&path(), &at([0.7, 0.01], Some(0))).unwrap();
        assert_eq!(left.point_mm()[..2], [[0.7, 0.01], [1.0, 0.0]]);
        assert_eq!((left.len(), left.dwell_point_mm()[0]), (4, [0.85, 0.005]));
        assert_eq!(left.tool_on(), [true, true, false, true]);
        // Before the dwell point of its segment.
        assert_eq!(
            rest(&path(), &at([0.2, 0.0], Some(0))).unwrap().dwell_point_mm()[0],
            [0.5, 0.0]
        );
        // Stopped beyond the end of the segment, and shortly before an end.
        assert_eq!(rest(&path(), &at([1.4, 0.0], Some(0))).unwrap().len(), 3);
        let left = rest(&path(), &at([0.95, 0.0], Some(0))).unwrap();
        assert_eq!((left.len(), left.point_mm()[1]), (3, [2.0, 0.0]));
    }

    #[test]
    fn a_motion_elsewhere_or_at_the_end_is_refused() {
        for (place, served, part) in [
            ([0.5, 0.0], None, "serves no dwell point"),
            ([0.5, 0.0], Some(9), "serves no dwell point"),
            ([0.5, 5.0], Some(0), "4.000 mm from the tool path"),
            ([0.1, 1.0], Some(3), "nothing is left"),
        ] {
            let refusal = rest(&path(), &at(place, served)).unwrap_err().to_string();
            assert!(refusal.contains(part), "{refusal}");
        }
    }
}
