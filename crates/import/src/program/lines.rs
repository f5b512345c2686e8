//! Straight lines of a program that the controller joins, for the readers of such programs.
//!
//! Joined lines run at continuous velocity, from rest to rest: half a line before the first node begins the motion, and
//! half a line after the last one ends it. A stop ends a motion and begins another. With a_k = (m_k - m_{k-1}) / b_k,
//! b_k = min(T_{k-1}, T_k) and the mean velocity m of a line, the joined motion stays within |m_k - m_{k-1}| b_k / 8 of
//! the corner. Where that is more than the tolerance, all lines are read as they stand, with steps of the velocity.

use planish_types::{AxesMotion, Invalid};

use super::Layout;

/// A straight line of the motion, or a stop of the axes that may last 0 s.
pub(super) struct Part {
    pub seconds: f64,
    /// Position at the start (mm or deg) and velocity (mm/s or deg/s) of every axis.
    pub states: Vec<[f64; 2]>,
    pub tool_on: bool,
    /// True for a dwell, and for an output that switches at once: the motion before it ends first.
    pub is_stop: bool,
}

/// Cubic polynomials of the motion in succession, one per axis and piece, with the times between the pieces.
struct Cubics {
    times: Vec<f64>,
    cubics: Vec<[f64; 4]>,
    tool_on: Vec<bool>,
}

impl Cubics {
    /// Appends a piece of one cubic per axis, which lasts `seconds`. Nothing is appended for 0 s.
    fn push(&mut self, seconds: f64, cubics: impl Iterator<Item = [f64; 4]>, tool_on: bool) {
        if seconds > 0.0 {
            self.times.push(self.times[self.times.len() - 1] + seconds);
            self.cubics.extend(cubics);
            self.tool_on.push(tool_on);
        }
    }
}

/// Returns the motion of all lines and stops. Lines are joined if all joined motion stays within `tolerance_mm` along
/// the linear axes; a tolerance of 0 joins none.
pub(super) fn motion(
    parts: &[Part],
    layout: &Layout,
    tolerance_mm: f64,
) -> Result<AxesMotion, Invalid> {
    let mut pieces = Cubics { times: vec![0.0], cubics: Vec::new(), tool_on: Vec::new() };
    let mut runs = parts.split(|part| part.is_stop).filter(|run| !run.is_empty());
    let most_mm = tolerance_mm * (1.0 + 1e-6) + 1e-9;
    let is_joined = tolerance_mm > 0.0 && runs.all(|run| farthest_mm(run, layout) <= most_mm);
    let mut rest = parts;
    while let Some(part) = rest.first() {
        let lines = rest.iter().position(|part| part.is_stop).unwrap_or(rest.len());
        if is_joined && lines > 0 {
            join(&rest[..lines], &mut pieces);
            rest = &rest[lines..];
            continue;
        }
        let straight = part.states.iter().map(|[p, v]| [*p, *v, 0.0, 0.0]);
        pieces.push(part.seconds, straight, part.tool_on);
        rest = &rest[1..];
    }
    let n = pieces.tool_on.len();
    AxesMotion::new(pieces.times, pieces.cubics, pieces.tool_on, vec![None; n])
}

/// Returns the duration of the parabola around node `k` of joined lines, the start of line `k` and the end of the line
/// before it, s. It is that of the shorter of both lines.
fn parabola_s(run: &[Part], k: usize) -> f64 {
    let beside = &run[k.saturating_sub(1)..(k + 1).min(run.len())];
    beside.iter().map(|line| line.seconds).fold(f64::INFINITY, f64::min)
}

/// Returns the velocities of all axes (mm/s or deg/s) before and after node `k` of the joined lines `run`. They are 0
/// before the first and after the last line.
fn around(run: &[Part], k: usize) -> (Vec<f64>, Vec<f64>) {
    let velocities = |line: Option<&Part>| match line {
        Some(line) => line.states.iter().map(|[_, v]| *v).collect(),
        None => vec![0.0; run[0].states.len()],
    };
    (velocities(k.checked_sub(1).and_then(|k| run.get(k))), velocities(run.get(k)))
}

/// Returns the largest distance of the joined motion of the lines `run` from their corners, along the linear axes, mm.
fn farthest_mm(run: &[Part], layout: &Layout) -> f64 {
    let linear = || (0..layout.len()).filter(|a| layout.units[*a] == "mm");
    let from_corners = (0..=run.len()).map(|k| {
        let (before, after) = around(run, k);
        let change = linear().map(|a| after[a] - before[a]).fold(0.0, f64::hypot);
        change * parabola_s(run, k) / 8.0
    });
    from_corners.fold(0.0, f64::max)
}

/// Appends the joined motion of the lines `run`, from rest to rest. It begins half the time of the first line before
/// that line would begin by itself.
fn join(run: &[Part], pieces: &mut Cubics) {
    let axes = run[0].states.len();
    for k in 0..=run.len() {
        let b = parabola_s(run, k);
        let (before, after) = around(run, k);
        let node: Vec<f64> = match k {
            0 => run[0].states.iter().map(|[p, _]| *p).collect(),
            _ => run[k - 1].states.iter().map(|[p, v]| p + v * run[k - 1].seconds).collect(),
        };
        // From the node - m b/2, over b: velocity before + (after - before) t / b.
        let first: Vec<[f64; 4]> = (0..axes)
            .map(|a| {
                let change = after[a] - before[a];
                [node[a] - 0.5 * b * before[a], before[a], 0.5 * change / b, 0.0]
            })
            .collect();
        let half_s = 0.5 * b;
        let second = first.iter().map(|c| {
            [c[0] + half_s * (c[1] + half_s * c[2]), c[1] + 2.0 * half_s * c[2], c[2], 0.0]
        });
        pieces.push(half_s, first.iter().copied(), run[k.saturating_sub(1)].tool_on);
        pieces.push(half_s, second, run[k.min(run.len() - 1)].tool_on);
        let Some(line) = run.get(k) else { continue };
        let straight_s = line.seconds - 0.5 * (b + parabola_s(run, k + 1));
        // A shorter time is rounding of equal times.
        if straight_s > 1e-9 * b {
            let rest = (0..axes).map(|a| [node[a] + half_s * after[a], after[a], 0.0, 0.0]);
            pieces.push(straight_s, rest, line.tool_on);
        }
    }
}
