//! Pieces of a motion of the contact point; on each piece every axis runs one cubic.
//!
//! ```text
//! q(u) = q0 + v0 u + (3 dq/h^2 - (2 v0 + v1)/h) u^2 + (-2 dq/h^3 + (v0 + v1)/h^2) u^3      u in [0, h]   (1)
//! ```
//!
//! with the exact positions q0, q0 + dq and velocities v0, v1 of the axis at both ends. A segment of the motion is
//! halved until the contact point of (1) stays near that of the motion. The distance falls by 16 with each half.

use planish_kinematics::{AxisMap, CENTRE_MM, Series};
use planish_numerics::polynomial::{derivative, evaluate};
use planish_types::{Invalid, Segment, Trajectory};

/// Number of points inside a piece at which contact points are compared. Larger: more time. Smaller: the largest
/// distance of a fourth-order error, in the middle of a smooth piece, is missed by more. Chosen: 7 with the middle
/// among them.
pub(crate) const INNER_POINTS: usize = 7;

/// Part of the tolerance that the pieces use: slowing the motion down changes their cubics a little. Larger: the
/// executed motion may leave the tolerance. Smaller: more pieces. Chosen.
const PART_OF_TOLERANCE: f64 = 0.5;

/// Largest turn of a spindle within a piece, degrees. Larger: half turns become ambiguous. Smaller: more pieces.
/// Chosen: half of a half turn.
const MOST_TURN_DEG: f64 = 90.0;

/// Largest number of times that a segment of the motion is halved. Larger: memory for 2^n pieces. Smaller: fewer long
/// segments of strongly curved parts succeed. Derived: 2^12 halves lower the distance by 2.8e14.
const MOST_HALVES: u32 = 12;

/// Largest jump of a spindle at a node that counts as rounding, degrees. Larger: real jumps pass. Smaller: rounding of
/// a path at 1e-9 mm from the centre is refused. Chosen: `planish verify` reports the smaller jumps that are real.
const MOST_JUMP_DEG: f64 = 1.0;

const AWAY_FROM_CENTRE: &str = "lead the path farther from the centre of the spindle";

/// Position of an axis, mm or deg, and its velocity, mm/s or deg/s.
pub(crate) type State = [f64; 2];

/// Piece of a motion, with the position and velocity of all axes at its start and end, before any stretch of time.
#[derive(Clone, Debug)]
pub(crate) struct AxesPiece {
    /// Index of the segment of the motion to which the piece belongs.
    pub(crate) segment: usize,
    /// Local time in this segment at which the piece begins, s; `to_s` is that of its end.
    pub(crate) from_s: f64,
    pub(crate) to_s: f64,
    pub(crate) start: Vec<State>,
    pub(crate) end: Vec<State>,
}

impl AxesPiece {
    /// Returns the duration of the piece before any stretch of time, s.
    pub(crate) fn duration_s(&self) -> f64 {
        self.to_s - self.from_s
    }

    /// Returns the cubics of the axes over `h` seconds, (1) of the module. It divides the velocities at the start and
    /// at the end by `slower`.
    pub(crate) fn cubics(&self, h: f64, slower: [f64; 2]) -> impl Iterator<Item = [f64; 4]> {
        self.start.iter().zip(&self.end).map(move |(start, end)| {
            cubic([start[0], start[1] / slower[0]], [end[0], end[1] / slower[1]], h)
        })
    }
}

/// Returns the cubic of one axis between two states that are `h` seconds apart, (1) of the module: ascending
/// coefficients.
pub(crate) fn cubic([q0, v0]: State, [q1, v1]: State, h: f64) -> [f64; 4] {
    let mean = (q1 - q0) / h;
    [q0, v0, (3.0 * mean - 2.0 * v0 - v1) / h, (-2.0 * mean + v0 + v1) / (h * h)]
}

/// Returns position, velocity and acceleration of the contact point along x and y, mm and s. `u` is the local time of a
/// segment with the coefficients `c`.
pub(crate) fn moving(c: &[[f64; 4]; 2], u: f64) -> [Series; 2] {
    c.each_ref().map(|c| {
        let v = derivative(c);
        Series {
            value: evaluate(c, u),
            first: evaluate(&v, u),
            second: evaluate(&derivative(&v), u),
        }
    })
}

/// Returns the duration of a piece whose time is stretched, s. The factor is linear in the planned time, from `ends[0]`
/// at the start to `ends[1]` at the end.
pub(crate) fn stretched_s(piece: &AxesPiece, ends: [f64; 2]) -> f64 {
    0.5 * (ends[0] + ends[1]) * piece.duration_s()
}

/// Returns the fraction of the unstretched duration that has passed after the fraction `part` of the stretched one. The
/// factors of the stretch at the ends are w0 and w1; the fraction is the root f of `w0 f + (w1 - w0) f^2 / 2 = part (w0
/// + w1) / 2`.
pub(crate) fn planned_part(part: f64, [w0, w1]: [f64; 2]) -> f64 {
    let area = 0.5 * part * (w0 + w1);
    2.0 * area / (w0 + (w0 * w0 + 2.0 * (w1 - w0) * area).sqrt())
}

/// Returns the direction in which a point at rest in the centre of a spindle moves away, at the local time `u` of a
/// segment; backwards in time if `sign` is -1. `None` if the point has a velocity, or stays in the centre.
///
/// ```text
/// p(t) = v t + a t^2 / 2 + j t^3 / 6     the first term that moves the point gives the direction
/// ```
///
/// A term counts as rounding where it moves the point by less than [`CENTRE_MM`] in the time of its segment. The
/// velocity of a computed motion at rest is rounding, and its direction says nothing.
fn direction_from_rest(segment: &Segment<'_>, u: f64, sign: f64) -> Option<[f64; 2]> {
    let h = segment.duration_s;
    let orders = segment.coefficient_mm.each_ref().map(|c| {
        let v = derivative(c);
        let a = derivative(&v);
        [sign * evaluate(&v, u), evaluate(&a, u), sign * evaluate(&derivative(&a), u)]
    });
    let ways = [(0, h), (1, h * h / 2.0), (2, h * h * h / 6.0)];
    let (order, length) = ways.into_iter().find_map(|(order, factor)| {
        let length = orders[0][order].hypot(orders[1][order]);
        if length * factor >= CENTRE_MM { Some((order, length)) } else { None }
    })?;
    if order == 0 { None } else { Some([0, 1].map(|k| orders[k][order] / length)) }
}

/// Returns the distance of the point `x` from the path of a piece, mm; `c` are the coefficients of its segment. The
/// search starts after the fraction `f` of the duration and takes two Newton steps for the nearest point, (p - x) . p'
/// = 0.
pub(crate) fn distance_mm(c: &[[f64; 4]; 2], piece: &AxesPiece, f: f64, x: [f64; 2]) -> f64 {
    let mut u = piece.from_s + f * piece.duration_s();
    for _ in 0..2 {
        let p = moving(c, u);
        let d = [0, 1].map(|k| p[k].value - x[k]);
        let speed = p[0].first.powi(2) + p[1].first.powi(2);
        let slope = speed + d[0] * p[0].second + d[1] * p[1].second;
        if slope <= 0.0 {
            break;
        }
        u -= (d[0] * p[0].first + d[1] * p[1].first) / slope;
        u = u.clamp(piece.from_s, piece.to_s);
    }
    let p = moving(c, u);
    (p[0].value - x[0]).hypot(p[1].value - x[1])
}

/// Motion of the contact point, with what is needed to divide it into pieces.
pub(crate) struct AxesPieces<'a> {
    pub(crate) map: &'a AxisMap,
    pub(crate) trajectory: &'a Trajectory,
    /// Index of the axis c of a spindle; `None` for a machine without a spindle.
    pub(crate) turning: Option<usize>,
    pub(crate) tolerance_mm: f64,
    pub(crate) min_segment_s: f64,
}

impl AxesPieces<'_> {
    /// Returns the pieces of the motion, in order. Refuses a motion that leaves the form, one that the axes cannot
    /// follow within the tolerance, and one in which a spindle jumps.
    pub(crate) fn all(&self) -> Result<Vec<AxesPiece>, Invalid> {
        let mut pieces: Vec<AxesPiece> = Vec::new();
        for (i, segment) in self.trajectory.segments().enumerate() {
            let h = segment.duration_s;
            let mut start = self.state(i, &segment, 0.0, false)?;
            if let Some(before) = pieces.last() {
                self.join(i, &segment, 0.0, &before.end, &mut start)?;
            }
            let end = self.state(i, &segment, h, true)?;
            // The last of the open pieces is the next one; the number says how often it was halved.
            let mut open = vec![(AxesPiece { segment: i, from_s: 0.0, to_s: h, start, end }, 0)];
            while let Some((mut piece, halves)) = open.pop() {
                self.unwrap(&piece.start.clone(), &mut piece.end);
                let away = self.away_mm(&piece, &segment);
                if away <= PART_OF_TOLERANCE * self.tolerance_mm {
                    pieces.push(piece);
                    continue;
                }
                let half = 0.5 * piece.duration_s();
                if halves == MOST_HALVES || half < self.min_segment_s {
                    return Err(self.too_far(&piece, &segment, away));
                }
                let [first, second] = self.halved(piece, &segment)?;
                open.push((second, halves + 1));
                open.push((first, halves + 1));
            }
        }
        Ok(pieces)
    }

    /// Returns both halves of a piece, cut in the middle of its time.
    fn halved(&self, piece: AxesPiece, segment: &Segment<'_>) -> Result<[AxesPiece; 2], Invalid> {
        let i = piece.segment;
        let middle_s = 0.5 * (piece.from_s + piece.to_s);
        let mut end = self.state(i, segment, middle_s, true)?;
        self.unwrap(&piece.start, &mut end);
        let mut start = self.state(i, segment, middle_s, false)?;
        self.join(i, segment, middle_s, &end, &mut start)?;
        // Whole turns that were added to the start are in the end of the piece already, or are added to it now.
        let mut last = piece.end.clone();
        self.unwrap(&start, &mut last);
        let second = AxesPiece { from_s: middle_s, start, end: last, ..piece.clone() };
        Ok([AxesPiece { to_s: middle_s, end, ..piece }, second])
    }

    /// Halves the pieces that leave the path by more than the tolerance once their time is stretched, and returns all
    /// pieces; `None` if none does. A stretch that changes within a piece bends its cubics. Refuses pieces that would
    /// become shorter than `min_segment_s`.
    pub(crate) fn finer(
        &self,
        pieces: &[AxesPiece],
        stretch: &[f64],
    ) -> Result<Option<Vec<AxesPiece>>, Invalid> {
        let mut finer = Vec::with_capacity(pieces.len());
        for (k, piece) in pieces.iter().enumerate() {
            let ends = [stretch[k], stretch[k + 1]];
            let segment = self.trajectory.segment(piece.segment);
            let h = stretched_s(piece, ends);
            let cubics: Vec<[f64; 4]> = piece.cubics(h, ends).collect();
            let away = (1..=INNER_POINTS).map(|j| {
                let part = j as f64 / (INNER_POINTS + 1) as f64;
                let q: Vec<f64> = cubics.iter().map(|c| evaluate(c, part * h)).collect();
                let contact = self.map.contact(&q)?;
                let c = segment.coefficient_mm;
                Some(distance_mm(c, piece, planned_part(part, ends), contact.point_mm))
            });
            let away = away.fold(0.0, |a: f64, b| a.max(b.unwrap_or(f64::INFINITY)));
            if away <= self.tolerance_mm {
                finer.push(piece.clone());
            } else if 0.5 * h < self.min_segment_s {
                return Err(self.too_far(piece, &segment, away));
            } else {
                finer.extend(self.halved(piece.clone(), &segment)?);
            }
        }
        Ok(if finer.len() > pieces.len() { Some(finer) } else { None })
    }

    /// Returns the position and velocity of all axes at the local time `u` of segment `i`. In the centre of a spindle c
    /// has the direction in which the point moves away, or from which it comes if `arrives`. For a point at rest in the
    /// centre, c has the direction in which it begins to move (or from which it came), and all axes rest.
    fn state(
        &self,
        i: usize,
        segment: &Segment<'_>,
        u: f64,
        arrives: bool,
    ) -> Result<Vec<State>, Invalid> {
        let sign = if arrives { -1.0 } else { 1.0 };
        // Backwards in time, a point that arrives moves away.
        let mut p =
            moving(segment.coefficient_mm, u).map(|s| Series { first: sign * s.first, ..s });
        let is_centre =
            self.turning.is_some() && self.map.radius_mm([p[0].value, p[1].value]) < CENTRE_MM;
        let from_rest = if is_centre { direction_from_rest(segment, u, sign) } else { None };
        if let Some(direction) = from_rest {
            p = [0, 1].map(|k| Series { first: direction[k], second: 0.0, ..p[k] });
        }
        let axes = self.map.positions(p).ok_or_else(|| {
            let [x, y] = p.map(|s| s.value);
            let at_s = segment.start_s + u;
            let problem =
                format!("is at {x:.4}, {y:.4} mm at {at_s:.6} s, where the form does not exist");
            let remedy = "give a form that covers the whole motion, with its overscan";
            Invalid::at_index("coefficient_mm", i, problem, remedy)
        })?;
        let speed = if from_rest.is_some() { 0.0 } else { sign };
        Ok(axes.iter().map(|q| [q.value, speed * q.first]).collect())
    }

    /// Adds whole turns of the spindle to the state `after` a node, to be near the state `before` it. Refuses a jump
    /// that is left, which a path through the centre causes.
    fn join(
        &self,
        i: usize,
        segment: &Segment<'_>,
        u: f64,
        before: &[State],
        after: &mut [State],
    ) -> Result<(), Invalid> {
        self.unwrap(before, after);
        let Some(c) = self.turning else { return Ok(()) };
        let jump = (after[c][0] - before[c][0]).abs();
        if jump <= MOST_JUMP_DEG {
            return Ok(());
        }
        let point = segment.position_mm(u);
        let problem = format!(
            "is at {:.4}, {:.4} mm at {:.6} s, where c jumps by {jump:.3} deg, {:.6} mm from the centre of the spindle",
            point[0],
            point[1],
            segment.start_s + u,
            self.map.radius_mm(point)
        );
        Err(Invalid::at_index("coefficient_mm", i, problem, AWAY_FROM_CENTRE))
    }

    /// Adds whole turns of the spindle to the state `after` so that its angle is nearest to that of `before`.
    fn unwrap(&self, before: &[State], after: &mut [State]) {
        if let Some(c) = self.turning {
            after[c][0] -= 360.0 * ((after[c][0] - before[c][0]) / 360.0).round();
        }
    }

    /// Returns the largest distance of the contact point of a piece from that of the motion at the same time, mm. It is
    /// infinite if the spindle turns too far within the piece, or if the tool meets no surface.
    fn away_mm(&self, piece: &AxesPiece, segment: &Segment<'_>) -> f64 {
        if self.turning.is_some_and(|c| (piece.end[c][0] - piece.start[c][0]).abs() > MOST_TURN_DEG)
        {
            return f64::INFINITY;
        }
        let h = piece.duration_s();
        let cubics: Vec<[f64; 4]> = piece.cubics(h, [1.0; 2]).collect();
        let mut largest: f64 = 0.0;
        for j in 1..=INNER_POINTS {
            let u = h * j as f64 / (INNER_POINTS + 1) as f64;
            let q: Vec<f64> = cubics.iter().map(|c| evaluate(c, u)).collect();
            let Some(contact) = self.map.contact(&q) else { return f64::INFINITY };
            let [x, y] = segment.position_mm(piece.from_s + u);
            largest = largest.max((contact.point_mm[0] - x).hypot(contact.point_mm[1] - y));
        }
        largest
    }

    fn too_far(&self, piece: &AxesPiece, segment: &Segment<'_>, away: f64) -> Invalid {
        let at_s = segment.start_s + piece.from_s;
        let point = segment.position_mm(piece.from_s);
        let half_ms = 500.0 * piece.duration_s();
        let mut problem = format!(
            "is at {:.4}, {:.4} mm at {at_s:.6} s, where the contact point of the axes stays {:.3} um away even within \
             {half_ms:.4} ms",
            point[0],
            point[1],
            1e3 * away
        );
        let mut remedy = "give a larger `contact_tolerance_um`, or a smoother motion";
        if self.turning.is_some() {
            let radius = self.map.radius_mm(point);
            problem += &format!(", {radius:.6} mm from the centre of the spindle");
            remedy = AWAY_FROM_CENTRE;
        }
        Invalid::at_index("coefficient_mm", piece.segment, problem, remedy)
    }
}
