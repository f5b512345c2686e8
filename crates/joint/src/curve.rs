//! A smooth curve along a tool path: straight lines, and corners rounded by pairs of clothoids.
//!
//! ```text
//! at a vertex of turn phi, from b before it to b after it:
//! kappa(s) = k s / L,  0 <= s <= L,  and mirrored       phi = k L,   r = 1 / k the least radius       (1)
//! x_L = L C(phi), y_L = L S(phi),  C + i S = integral from 0 to 1 of exp(i phi u^2 / 2) du
//! b = x_L + y_L tan(phi / 2),   e = y_L / cos(phi / 2)  the deviation at the vertex                   (2)
//! ```
//!
//! Heading and curvature are continuous, so the acceleration across the path rises from zero and falls to it; arc
//! length, heading and curvature are exact ([`planish_numerics::motion::clothoid`]). Segments in line with each other
//! are one line; a corner takes at most half of its two lines. Where the path turns back on itself no smooth curve
//! follows it: there the machine comes to rest, and the next curve begins.
//!
//! The points of a bent path, such as a spiral, are no corners. Where several vertices in a row turn little, the curve
//! goes through them with the curvature of the path (`clothoid_spline`). Corners there would have several times
//! this curvature, and lines between them.
//!
//! | symbol | variable | unit |
//! |---|---|---|
//! | phi | `turn_rad` | rad |
//! | L | `half_length_mm` | mm |
//! | b | `cut_mm` | mm |
//! | e | `deviation_mm` | mm |

use std::{collections::BTreeMap, f64::consts::PI};

use planish_numerics::motion::clothoid;
use planish_types::ToolPath;

use crate::{
    clothoid_spline::{End, angle_between, through},
    piece::{CurvePiece, Station},
};

/// Largest turn of a corner, rad. At a sharper turn the path goes back on itself: the machine rests there and the
/// next curve begins. Larger: corners with a very small radius, which the tool must pass slowly. Smaller: more rests.
/// Chosen.
pub const SHARPEST_TURN_RAD: f64 = 170.0 / 180.0 * PI;

/// Largest turn that is taken for rounding of the coordinates, rad: the line goes on there. Larger: real corners are
/// lost, and the heading steps. Smaller: rounding becomes a corner. Chosen: far above the rounding of coordinates.
const NO_TURN_RAD: f64 = 1e-9;

/// Least length of a segment with a direction, mm; shorter ones are left out. Larger: real segments are lost.
/// Smaller: the curvature of a corner between such segments overflows. Chosen: a picometre, which no machine
/// resolves.
const LEAST_SEGMENT_MM: f64 = 1e-9;

/// Least length of half a corner, mm, whatever the largest radius is; the room on its lines and the largest deviation
/// may still make it shorter. Larger: corners wider than asked for. Smaller: the motion leaves out pieces that are so
/// short, and their turn with them. Chosen: far above the shortest break of the motion, 1e-5 mm.
const LEAST_HALF_LENGTH_MM: f64 = 1e-2;

/// Fraction of the largest deviation by which smoothing may move points; the rest is left for rounding the corners
/// between them. Larger: smoother points and sharper corners. Smaller: the opposite. Chosen.
const SMOOTHED_FRACTION: f64 = 0.75;

/// Largest bend of the smoothed path over that of the path itself at which the smoothed one is used (bend: integral
/// of the root of the curvature). Larger: straight lines are bent for a small gain. Smaller: fewer paths are
/// smoothed. Chosen.
const LESS_BEND: f64 = 0.9;

/// Largest number of sweeps over the points in smoothing. Larger: more time for long runs of points. Smaller: some
/// points stop before they have reached their places; the path is still within the bound. Chosen.
const SMOOTHING_SWEEPS: usize = 200;

/// Largest movement of a point in a sweep, over the bound on movements, at which smoothing ends. Larger: fewer sweeps
/// and a little more bend. Smaller: more sweeps. Chosen: the bend does not depend on a thousandth of the bound.
const SMOOTHED_FINALLY: f64 = 1e-3;

/// Largest turn of a vertex that may be a sample of a bent path, rad. Larger: real corners of a polygon are rounded
/// over all of their lines. Smaller: coarsely sampled bends keep their corners. Chosen: 18 samples of a circle.
const BENT_TURN_RAD: f64 = PI / 9.0;

/// Largest ratio of the lengths of neighbouring chords between samples of a bent path. Larger: lines beside short
/// chords are bent. Smaller: unevenly sampled bends keep their corners. Chosen.
const MOST_UNEVEN: f64 = 2.0;

/// Least number of vertices in a row that are samples of a bent path. Larger: short bends keep their corners. Smaller:
/// a line with two corners near each other counts as bent. Chosen.
const LEAST_BENT_VERTICES: usize = 4;

/// Largest distance between two positions on a line that count as one, relative to the length of the line. Larger:
/// short parts of segments are lost. Smaller: rounding becomes a part of its own. Chosen: some thousand times the
/// rounding.
const SAME_PLACE: f64 = 1e-12;

/// Bounds on the rounding of corners.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rounding {
    /// Largest distance of the curve from a vertex of the path, mm.
    pub deviation_mm: f64,
    /// Upper bound of the least radius of a corner, mm. Corners are not made wider, even if the deviation would allow
    /// it.
    pub radius_mm: f64,
}

/// Rounded corner of a curve: two clothoids.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Corner {
    /// Arc length of the middle of the corner from the start of the curve, mm.
    pub at_mm: f64,
    /// Arc length of each of the two clothoids (L), mm.
    pub half_length_mm: f64,
    /// Turn of the corner (phi), without its sign, rad.
    pub turn_rad: f64,
    /// Least radius of the corner, mm.
    pub radius_mm: f64,
    /// Distance of the curve from the vertex (e), mm.
    pub deviation_mm: f64,
}

/// Smooth curve along which the machine moves from rest to rest.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Curve {
    pieces: Vec<CurvePiece>,
    corners: Vec<Corner>,
    /// Largest distance from the chords of the bent parts, which have no corners, at ends and middles of clothoids, mm.
    bent_deviation_mm: f64,
}

impl Curve {
    /// Returns the pieces in order; each begins where the previous one ends.
    pub fn pieces(&self) -> &[CurvePiece] {
        &self.pieces
    }

    /// Returns the corners in order.
    pub fn corners(&self) -> &[Corner] {
        &self.corners
    }

    /// Returns the arc length of the whole curve, mm.
    pub fn length_mm(&self) -> f64 {
        self.pieces.last().map_or(0.0, CurvePiece::to_mm)
    }

    /// Returns the largest distance of the curve from the points and lines it was made of, mm, at its corners and along
    /// its bent parts. These points are those after smoothing.
    pub fn deviation_mm(&self) -> f64 {
        self.corners.iter().map(|c| c.deviation_mm).fold(self.bent_deviation_mm, f64::max)
    }

    /// Returns the largest magnitude of the curvature, 1/mm.
    pub fn most_curvature_per_mm(&self) -> f64 {
        self.pieces.iter().map(CurvePiece::most_curvature_per_mm).fold(0.0, f64::max)
    }

    /// Returns the bend of the curve: the integral of the square root of its curvature, mm^(1/2).
    fn bend(&self) -> f64 {
        self.pieces.iter().map(CurvePiece::bend).sum()
    }

    /// Returns the piece at the arc length `s` from the start of the curve, mm; where two meet, the later one.
    pub fn piece_at(&self, s: f64) -> &CurvePiece {
        let after = self.pieces.partition_point(|p| p.from_mm <= s);
        &self.pieces[after.saturating_sub(1)]
    }

    /// Returns position, direction and curvature at the arc length `s` from the start of the curve, mm.
    pub fn station(&self, s: f64) -> Station {
        let piece = self.piece_at(s);
        piece.station((s - piece.from_mm).min(piece.length_mm))
    }

    /// Returns the unit vector along the curve, and its curvature (1/mm), at the arc length `s` from its start, mm.
    pub fn direction(&self, s: f64) -> ([f64; 2], f64) {
        let piece = self.piece_at(s);
        piece.direction((s - piece.from_mm).min(piece.length_mm))
    }

    fn push(&mut self, start: Station, sharpness_per_mm2: f64, length_mm: f64, segment: usize) {
        let from_mm = self.length_mm();
        // Lengths that vanish beside the arc length would be pieces without duration.
        if from_mm + length_mm > from_mm {
            self.pieces.push(CurvePiece { start, sharpness_per_mm2, from_mm, length_mm, segment });
        }
    }
}

/// Smooth curves along a path.
#[derive(Clone, Debug, PartialEq)]
pub struct Smooth {
    /// Curves in order, each from rest to rest.
    pub curves: Vec<Curve>,
    /// Largest movement of a point of the path by smoothing, before the corners were rounded, mm.
    pub moved_mm: f64,
}

/// Straight line of the path: one segment, or several in line with each other.
struct Chord {
    /// Indices of the segments that have a length, each with the length along the chord at which it ends, mm.
    segments: Vec<(usize, f64)>,
    from: [f64; 2],
    to: [f64; 2],
    tangent: [f64; 2],
    length_mm: f64,
    tool_on: bool,
}

impl Chord {
    /// Returns the point at the length `s_mm` from the start of the chord.
    fn point_mm(&self, s_mm: f64) -> [f64; 2] {
        [0, 1].map(|k| self.from[k] + s_mm * self.tangent[k])
    }

    /// Returns the distance of a point from the straight line through the chord, mm.
    fn distance_mm(&self, point_mm: [f64; 2]) -> f64 {
        let [dx, dy] = [0, 1].map(|k| point_mm[k] - self.from[k]);
        (self.tangent[0] * dy - self.tangent[1] * dx).abs()
    }

    /// Returns the parts of the segments between two lengths along the chord: index of the segment, start and end of
    /// its part, mm.
    fn parts(&self, from_mm: f64, to_mm: f64) -> impl Iterator<Item = (usize, f64, f64)> {
        let starts = std::iter::once(0.0).chain(self.segments.iter().map(|(_, end)| *end));
        let parts = self
            .segments
            .iter()
            .zip(starts)
            .map(move |((segment, end), start)| (*segment, start.max(from_mm), end.min(to_mm)));
        // What rounding leaves of a segment belongs to its neighbour.
        parts.filter(|(_, from, to)| to - from > SAME_PLACE * self.length_mm)
    }
}

/// Returns the straight lines through the points (segments + 1); segments shorter than a picometre are left out.
/// Neighbouring segments in line with the same tool state are one line.
fn chords(point_mm: &[[f64; 2]], tool_on: &[bool]) -> Vec<Chord> {
    let mut chords: Vec<Chord> = Vec::new();
    for (segment, tool_on) in tool_on.iter().copied().enumerate() {
        let (from, to) = (point_mm[segment], point_mm[segment + 1]);
        let dx = to[0] - from[0];
        let dy = to[1] - from[1];
        let length = dx.hypot(dy);
        if length < LEAST_SEGMENT_MM {
            continue;
        }
        let tangent = [dx / length, dy / length];
        let last = chords.last_mut().filter(|last| {
            last.tool_on == tool_on && angle_between(last.tangent, tangent).abs() < NO_TURN_RAD
        });
        if let Some(last) = last {
            let along = [to[0] - last.from[0], to[1] - last.from[1]];
            last.length_mm = along[0].hypot(along[1]);
            last.tangent = along.map(|d| d / last.length_mm);
            last.to = to;
            last.segments.push((segment, last.length_mm));
            continue;
        }
        let segments = vec![(segment, length)];
        chords.push(Chord { segments, from, to, tangent, length_mm: length, tool_on });
    }
    chords
}

/// Dimensions of the rounding of a corner, by (1) and (2) of the module.
struct Blend {
    cut_mm: f64,
    half_length_mm: f64,
    deviation_mm: f64,
}

impl Blend {
    /// Returns the widest rounding of a corner of this turn (above 0) that the bounds and the length `room_mm` along
    /// each of its two lines allow.
    fn widest(turn_rad: f64, room_mm: f64, rounding: &Rounding) -> Self {
        // For L = 1: heading phi u^2 / 2 means a sharpness of phi.
        let [c, s] = clothoid::position(0.0, turn_rad, 1.0);
        let cut = c + s * (0.5 * turn_rad).tan();
        let deviation = s / (0.5 * turn_rad).cos();
        let by_deviation =
            if deviation > 0.0 { rounding.deviation_mm / deviation } else { f64::INFINITY };
        // r = L / phi
        let by_radius = (rounding.radius_mm * turn_rad).max(LEAST_HALF_LENGTH_MM);
        let half_length_mm = (room_mm / cut).min(by_deviation).min(by_radius);
        Self {
            cut_mm: cut * half_length_mm,
            half_length_mm,
            deviation_mm: deviation * half_length_mm,
        }
    }
}

/// Returns the curves of a path, each from rest to rest; segments shorter than a picometre are left out.
///
/// The curves follow the path itself, or points that are moved a little if that leaves less bend. The least time of a
/// machine in bends is proportional to the integral of the square root of the curvature.
pub fn curves(path: &ToolPath, rounding: &Rounding) -> Smooth {
    let along = curves_through(path.point_mm(), path.tool_on(), rounding);
    let (point_mm, moved_mm) =
        smoothed(path, SMOOTHED_FRACTION * rounding.deviation_mm, rounding.radius_mm);
    let rest =
        Rounding { deviation_mm: (1.0 - SMOOTHED_FRACTION) * rounding.deviation_mm, ..*rounding };
    let through = curves_through(&point_mm, path.tool_on(), &rest);
    let [bend_through, bend_along] =
        [&through, &along].map(|curves| curves.iter().map(Curve::bend).sum::<f64>());
    if bend_through < LESS_BEND * bend_along {
        Smooth { curves: through, moved_mm }
    } else {
        Smooth { curves: along, moved_mm: 0.0 }
    }
}

/// Returns the points of a path, moved by at most `bound_mm` so that it bends less, and the largest movement, mm.
///
/// ```text
/// min sum |P_(i-1) - 2 P_i + P_(i+1)|^2   subject to   |P_i - P_i of the path| <= bound
/// ```
///
/// It sweeps over the points and puts each where the sum is least. The ends stay, and with them every point at which
/// the machine rests, the tool is switched, or a line longer than `longest_mm` begins or ends.
fn smoothed(path: &ToolPath, bound_mm: f64, longest_mm: f64) -> (Vec<[f64; 2]>, f64) {
    let mut point_mm = path.point_mm().to_vec();
    let mut indices: Vec<usize> = vec![0];
    indices.extend((1..point_mm.len()).filter(|i| point_mm[*i - 1] != point_mm[*i]));
    let mut moved_mm = 0.0f64;
    for run in runs(path, &indices, longest_mm) {
        let original: Vec<[f64; 2]> = run.iter().map(|i| point_mm[*i]).collect();
        let mut p = original.clone();
        let n = p.len();
        for _ in 0..SMOOTHING_SWEEPS {
            let mut change = 0.0f64;
            for i in 1..n - 1 {
                // The second differences in which P_i is, without it, and its coefficient there
                let centres = [i - 1, i, i + 1].into_iter().zip([1.0, -2.0, 1.0]);
                let inside = centres.filter(|(k, _)| (1..n - 1).contains(k));
                let mut weight = 0.0;
                let mut target = [0.0; 2];
                for (k, c) in inside {
                    weight += c * c;
                    for axis in 0..2 {
                        let d = p[k - 1][axis] - 2.0 * p[k][axis] + p[k + 1][axis];
                        target[axis] -= c * (d - c * p[i][axis]);
                    }
                }
                let step = [0, 1].map(|axis| target[axis] / weight - original[i][axis]);
                let back = (bound_mm / step[0].hypot(step[1])).min(1.0);
                let next = [0, 1].map(|axis| original[i][axis] + back * step[axis]);
                change = change.max((next[0] - p[i][0]).hypot(next[1] - p[i][1]));
                p[i] = next;
            }
            if change < SMOOTHED_FINALLY * bound_mm {
                break;
            }
        }
        for (i, (p, original)) in run.iter().zip(p.into_iter().zip(original)) {
            moved_mm = moved_mm.max((p[0] - original[0]).hypot(p[1] - original[1]));
            point_mm[*i] = p;
        }
    }
    // A point that is repeated stays one point.
    for i in 1..point_mm.len() {
        if path.point_mm()[i] == path.point_mm()[i - 1] {
            point_mm[i] = point_mm[i - 1];
        }
    }
    (point_mm, moved_mm)
}

/// Splits the indices `at` of the points of a path into runs, each from a point that must stay to the next such point,
/// both included. [`smoothed`] says which points must stay.
fn runs(path: &ToolPath, at: &[usize], longest_mm: f64) -> Vec<Vec<usize>> {
    let mut runs = vec![vec![at[0]]];
    for w in at.windows(3) {
        let [a, b, c] = [w[0], w[1], w[2]].map(|i| path.point_mm()[i]);
        let (before, after) = ([b[0] - a[0], b[1] - a[1]], [c[0] - b[0], c[1] - b[1]]);
        let rests = angle_between(before, after).abs() > SHARPEST_TURN_RAD;
        let switched = path.tool_on()[w[1] - 1] != path.tool_on()[w[2] - 1];
        runs.last_mut().expect("begins with one").push(w[1]);
        let line = before[0].hypot(before[1]).max(after[0].hypot(after[1])) > longest_mm;
        if rests || switched || line {
            runs.push(vec![w[1]]);
        }
    }
    if at.len() > 1 {
        runs.last_mut().expect("begins with one").push(at[at.len() - 1]);
    }
    runs
}

/// Kind of the vertex between a chord and the next one.
#[derive(Clone, Copy)]
enum Vertex {
    /// The machine rests, and the next curve begins.
    Rest,
    /// A corner of this turn, rad, positive to the left.
    Corner(f64),
}

/// Returns the vertex after every chord; the last one is a rest.
fn vertices(chords: &[Chord]) -> Vec<Vertex> {
    let between = chords.windows(2).map(|w| {
        let turn = angle_between(w[0].tangent, w[1].tangent);
        let rests = turn.abs() > SHARPEST_TURN_RAD;
        if rests { Vertex::Rest } else { Vertex::Corner(turn) }
    });
    let last = chords.last().map(|_| Vertex::Rest);
    between.chain(last).collect()
}

/// Returns the turn, rad, and the rounding of the corner after chord `i`; `None` if the machine rests there or the turn
/// is rounding.
fn blend(
    chords: &[Chord],
    vertices: &[Vertex],
    i: usize,
    rounding: &Rounding,
) -> Option<(f64, Blend)> {
    let Vertex::Corner(turn) = vertices[i] else { return None };
    let room_mm = 0.5 * chords[i].length_mm.min(chords[i + 1].length_mm);
    if turn.abs() < NO_TURN_RAD {
        return None;
    }
    Some((turn, Blend::widest(turn.abs(), room_mm, rounding)))
}

/// Bent part of a path: the clothoids along its chords.
struct Bent {
    /// Clothoids in order, each with the index of its chord and the start and end of its part of the chord, as
    /// fractions.
    arcs: Vec<(usize, [f64; 2], CurvePiece)>,
    /// Length that the bent part covers of its last chord, from the start of the chord, mm.
    taken_mm: f64,
    deviation_mm: f64,
}

impl Bent {
    /// Returns the bent part whose first vertex is after the chord `first` and whose last one is after `last`. `None`
    /// if no spline is found, if it would be farther from the path than the rounding allows, or if corners would be
    /// less curved.
    fn new(
        chords: &[Chord],
        vertices: &[Vertex],
        [first, last]: [usize; 2],
        rounding: &Rounding,
    ) -> Option<Self> {
        let (before, after) = (&chords[first], &chords[last + 1]);
        let begins_at_rest = first == 0 || matches!(vertices[first - 1], Vertex::Rest);
        let from_rest = begins_at_rest && are_even(chords, first);
        let to_rest = matches!(vertices[last + 1], Vertex::Rest) && are_even(chords, last);
        // Half of what the next chord has, where that is left of the line
        let lead_mm = 0.5 * before.length_mm.min(chords[first + 1].length_mm);
        let trail_mm = 0.5 * after.length_mm.min(chords[last].length_mm);
        // Point, end, first vertex that is a point, and fraction of the chord at which the curve begins; and likewise ends
        let (start, first_end, from, begin) = if from_rest {
            (before.from, End::Rest, first, 0.0)
        } else {
            let end = End::Line(lead_mm / (lead_mm + chords[first + 1].length_mm));
            let fraction = 1.0 - lead_mm / before.length_mm;
            (before.point_mm(before.length_mm - lead_mm), end, first + 1, fraction)
        };
        let (stop, last_end, to, taken_mm) = if to_rest {
            (after.to, End::Rest, last, after.length_mm)
        } else {
            let end = End::Line(trail_mm / (trail_mm + chords[last].length_mm));
            (after.point_mm(trail_mm), end, last - 1, trail_mm)
        };
        let vertices_mm = chords[from..=to].iter().map(|c| c.to);
        let points: Vec<[f64; 2]> =
            std::iter::once(start).chain(vertices_mm).chain(std::iter::once(stop)).collect();
        let arcs = through(&points, [first_end, last_end], [before.tangent, after.tangent])?;
        let along = (first..).zip(arcs.concat()).map(|(chord, arc)| {
            let begins = if chord == first { begin } else { 0.0 };
            let ends = if chord == last + 1 { taken_mm / after.length_mm } else { 1.0 };
            (chord, [begins, ends], arc)
        });
        let mut bent = Self { arcs: along.collect(), taken_mm, deviation_mm: 0.0 };
        bent.deviation_mm = bent.deviation_mm(chords);
        let corners = (first..=last).filter_map(|i| blend(chords, vertices, i, rounding));
        let most_of_corners =
            corners.map(|(turn, b)| turn.abs() / b.half_length_mm).fold(0.0, f64::max);
        let curvatures = bent.arcs.iter().map(|(_, _, arc)| arc.most_curvature_per_mm());
        let most = curvatures.fold(0.0, f64::max);
        let is_better = bent.deviation_mm <= rounding.deviation_mm && most < most_of_corners;
        if is_better { Some(bent) } else { None }
    }

    /// Returns the largest distance of the ends and middles of the clothoids from their chords, mm.
    fn deviation_mm(&self, chords: &[Chord]) -> f64 {
        let distances = self.arcs.iter().flat_map(|(chord, _, arc)| {
            [0.5, 1.0].map(|f| chords[*chord].distance_mm(arc.station(f * arc.length_mm).point_mm))
        });
        distances.fold(0.0, f64::max)
    }
}

/// Returns the bent parts of a path, each under the index of the chord before its first vertex.
fn bent_parts(chords: &[Chord], vertices: &[Vertex], rounding: &Rounding) -> BTreeMap<usize, Bent> {
    let mut bent_parts = BTreeMap::new();
    let mut first = 0;
    while first < chords.len() {
        // The chord before the first vertex may be a long line.
        let run = (first..chords.len()).take_while(|i| {
            is_sample(chords, vertices, *i, rounding)
                && (*i <= first + 1 || are_even(chords, *i - 1))
        });
        let count = run.count();
        if count >= LEAST_BENT_VERTICES {
            let last = first + count - 1;
            if let Some(bent) = Bent::new(chords, vertices, [first, last], rounding) {
                bent_parts.insert(first, bent);
            }
        }
        // A run that ends between uneven chords is followed by one that begins there.
        first += count.max(1);
    }
    bent_parts
}

/// Returns true if the vertex after chord `i` may be a sample of a bent path: it turns little, and an arc through it
/// stays near.
fn is_sample(chords: &[Chord], vertices: &[Vertex], i: usize, rounding: &Rounding) -> bool {
    let Vertex::Corner(turn) = vertices[i] else { return false };
    // A circle through three points l apart that turns by phi there is l phi / 8 from the chord
    let sagitta_mm = 0.125 * chords[i].length_mm.min(chords[i + 1].length_mm) * turn.abs();
    (NO_TURN_RAD..=BENT_TURN_RAD).contains(&turn.abs()) && sagitta_mm <= rounding.deviation_mm
}

/// Returns true if chord `i` and the next one may be samples of the same bent path: their lengths differ little.
fn are_even(chords: &[Chord], i: usize) -> bool {
    let a = chords[i].length_mm;
    let b = chords[i + 1].length_mm;
    a.max(b) <= MOST_UNEVEN * a.min(b)
}

fn curves_through(point_mm: &[[f64; 2]], tool_on: &[bool], rounding: &Rounding) -> Vec<Curve> {
    let chords = chords(point_mm, tool_on);
    let vertices = vertices(&chords);
    let bent = bent_parts(&chords, &vertices, rounding);
    let mut curves = Vec::new();
    let mut curve = Curve::default();
    // Length of the chord that the corner or the bent part before it takes, mm
    let mut taken_mm = 0.0;
    let mut i = 0;
    while i < chords.len() {
        while let Some(bent) = bent.get(&i) {
            curve.line(&chords[i], [taken_mm, bent.arcs[0].1[0] * chords[i].length_mm]);
            curve.follow(&chords, bent);
            taken_mm = bent.taken_mm;
            i = bent.arcs[bent.arcs.len() - 1].0;
        }
        let blend = blend(&chords, &vertices, i, rounding);
        let cut_mm = blend.as_ref().map_or(0.0, |(_, b)| b.cut_mm);
        curve.line(&chords[i], [taken_mm, chords[i].length_mm - cut_mm]);
        taken_mm = cut_mm;
        if let Some((turn, blend)) = blend {
            curve.round(&chords[i], &chords[i + 1], turn, &blend);
        } else if matches!(vertices[i], Vertex::Rest) {
            curves.push(std::mem::take(&mut curve));
        }
        i += 1;
    }
    curves.retain(|c| !c.pieces.is_empty());
    curves
}

impl Curve {
    /// Adds the straight line between two lengths along a chord from its start, mm.
    fn line(&mut self, chord: &Chord, [from_mm, to_mm]: [f64; 2]) {
        for (segment, from_mm, to_mm) in chord.parts(from_mm, to_mm) {
            let start = Station {
                point_mm: chord.point_mm(from_mm),
                tangent: chord.tangent,
                curvature_per_mm: 0.0,
            };
            self.push(start, 0.0, to_mm - from_mm, segment);
        }
    }

    /// Adds a bent part of the path. A fraction of a clothoid belongs to the segment at this fraction of its chord.
    fn follow(&mut self, chords: &[Chord], bent: &Bent) {
        for (chord, [from, to], arc) in &bent.arcs {
            let chord = &chords[*chord];
            let [first, last] = [from, to].map(|f| f * chord.length_mm);
            for (segment, from_mm, to_mm) in chord.parts(first, last) {
                let fractions = [from_mm, to_mm].map(|s| (s - first) / (last - first));
                self.push_part(arc, fractions, segment);
            }
        }
        self.bent_deviation_mm = self.bent_deviation_mm.max(bent.deviation_mm);
    }

    /// Adds the corner between two chords. Every part of it belongs to the segment of the path next to it: a fraction
    /// of a clothoid to the same fraction of the part of the chord that the corner replaces.
    fn round(&mut self, chord: &Chord, next: &Chord, turn: f64, blend: &Blend) {
        let [tx, ty] = chord.tangent;
        let v = chord.to;
        let l = blend.half_length_mm;
        let peak = turn / l;
        let cut = blend.cut_mm;
        let start = Station {
            point_mm: [v[0] - cut * tx, v[1] - cut * ty],
            tangent: chord.tangent,
            curvature_per_mm: 0.0,
        };
        let before = CurvePiece {
            start,
            sharpness_per_mm2: peak / l,
            from_mm: 0.0,
            length_mm: l,
            segment: 0,
        };
        let first = chord.length_mm - cut;
        for (segment, from, to) in chord.parts(first, chord.length_mm) {
            self.push_part(&before, [from, to].map(|s| (s - first) / cut), segment);
        }
        let at_mm = self.length_mm();
        // The middle lies on the bisector, towards the inside.
        let inside = [next.tangent[0] - tx, next.tangent[1] - ty];
        let size = inside[0].hypot(inside[1]);
        let e = blend.deviation_mm;
        let half = [tx + next.tangent[0], ty + next.tangent[1]];
        let length = half[0].hypot(half[1]);
        let middle = Station {
            point_mm: [v[0] + e * inside[0] / size, v[1] + e * inside[1] / size],
            tangent: [half[0] / length, half[1] / length],
            curvature_per_mm: peak,
        };
        let after = CurvePiece { start: middle, sharpness_per_mm2: -peak / l, ..before };
        for (segment, from, to) in next.parts(0.0, cut) {
            self.push_part(&after, [from, to].map(|s| s / cut), segment);
        }
        let turn_rad = turn.abs();
        let radius_mm = l / turn_rad;
        self.corners.push(Corner {
            at_mm,
            half_length_mm: l,
            turn_rad,
            radius_mm,
            deviation_mm: e,
        });
    }

    /// Adds the part of a piece between two fractions of its length; it belongs to this segment of the path.
    fn push_part(&mut self, whole: &CurvePiece, [from, to]: [f64; 2], segment: usize) {
        let l = whole.length_mm;
        self.push(whole.station(from * l), whole.sharpness_per_mm2, (to - from) * l, segment);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn path(points: &[[f64; 2]]) -> ToolPath {
        let n = points.len() - 1;
        ToolPath::through(points.to_vec(), vec![true; n], vec![0; n]).unwrap()
    }

    fn rounded(points: &[[f64; 2]], rounding: &Rounding) -> Vec<Curve> {
        curves_through(points, &vec![true; points.len() - 1], rounding)
    }

    const WIDE: Rounding = Rounding { deviation_mm: 10.0, radius_mm: 100.0 };

    #[test]
    fn points_that_no_machine_tells_apart_are_one() {
        let points = [[0.0, 0.0], [3.0, 0.0], [3.0, 2.0]];
        let twice = [[0.0, 0.0], [3.0, 0.0], [3.0 + 1e-12, 3e-319], [3.0, 2.0]];
        let length_mm = |points| rounded(points, &WIDE)[0].length_mm();
        // The points are 1e-12 mm apart on 5 mm, and round.
        assert!((length_mm(&points) / length_mm(&twice) - 1.0).abs() < 1e-11);
        // All of a path, as bytes in the wrong order give it.
        let tiny: Vec<[f64; 2]> = (0..9).map(|i| [3e-319 * f64::from(i % 2), 9.5e-322]).collect();
        assert!(curves(&path(&tiny), &WIDE).curves.is_empty());
    }

    #[test]
    fn pieces_join_in_position_and_heading_and_curvature() {
        let points = [[0.0, 0.0], [3.0, 0.0], [3.0, 2.0], [1.0, 2.5], [4.0, 4.0], [9.0, -1.0]];
        let narrow = Rounding { deviation_mm: 0.05, radius_mm: 0.4 };
        for rounding in [WIDE, narrow] {
            let curves = rounded(&points, &rounding);
            assert_eq!(curves.len(), 1);
            let curve = &curves[0];
            assert_eq!(curve.corners().len(), 4);
            for w in curve.pieces().windows(2) {
                let (end, start) = (w[0].station(w[0].length_mm), w[1].station(0.0));
                for k in 0..2 {
                    // Coordinates of some mm, rounded some tens of times.
                    assert!((end.point_mm[k] - start.point_mm[k]).abs() < 1e-13);
                    assert!((end.tangent[k] - start.tangent[k]).abs() < 1e-13);
                }
                let gap = (end.curvature_per_mm - start.curvature_per_mm).abs();
                assert!(gap < 1e-12 * start.curvature_per_mm.abs().max(1.0));
            }
            let (first, last) = (curve.station(0.0), curve.station(curve.length_mm()));
            assert_eq!(first.point_mm, points[0]);
            // Some tens of roundings, as above.
            assert!((last.point_mm[0] - 9.0).abs() + (last.point_mm[1] + 1.0).abs() < 1e-13);
        }
    }

    #[test]
    fn a_corner_keeps_its_deviation_and_its_radius() {
        let corner = |turn: f64, rounding: Rounding| {
            let to = [10.0 + 10.0 * turn.cos(), 10.0 * turn.sin()];
            let curve = rounded(&[[0.0, 0.0], [10.0, 0.0], to], &rounding).remove(0);
            let c = curve.corners()[0];
            let middle = curve.station(c.at_mm).point_mm;
            ((middle[0] - 10.0).hypot(middle[1]), 1.0 / curve.station(c.at_mm).curvature_per_mm, c)
        };
        for turn in [0.1, 1.0, 0.5 * PI, 2.5, 2.9] {
            let (distance, radius, c) =
                corner(turn, Rounding { deviation_mm: 0.1, radius_mm: 100.0 });
            // Below: some tens of roundings of coordinates of 10 mm.
            assert!((distance - c.deviation_mm).abs() < 1e-13 && c.deviation_mm <= 0.1 + 1e-15);
            assert!((radius - c.radius_mm).abs() < 1e-12 * radius, "{turn}");
            let (distance, radius, _) =
                corner(turn, Rounding { deviation_mm: 9.0, radius_mm: 0.3 });
            assert!((radius - 0.3).abs() < 1e-13 && distance > 0.0);
        }
        // 90 degrees, L = 1: C = 0.94... by the series of the Fresnel integrals,
        // C = 1 - a^2/10 + a^4/216, S = a/3 - a^3/42 + a^5/1320, a = phi / 2 = pi / 4
        let a = 0.25 * PI;
        let c = 1.0 - a.powi(2) / 10.0 + a.powi(4) / 216.0 - a.powi(6) / 9360.0;
        let s = a / 3.0 - a.powi(3) / 42.0 + a.powi(5) / 1320.0 - a.powi(7) / 75_600.0;
        let blend = Blend::widest(0.5 * PI, 2.0, &WIDE);
        // The next terms of the series are below 2e-7.
        assert!((blend.cut_mm - 2.0).abs() < 1e-14);
        assert!((blend.half_length_mm - 2.0 / (c + s)).abs() < 2e-6);
        let deviation = blend.half_length_mm * s * 2f64.sqrt();
        // As above.
        assert!((blend.deviation_mm - deviation).abs() < 2e-6);
    }

    #[test]
    fn the_arc_length_is_that_of_the_curve() {
        let curve = curves(&path(&[[0.0, 0.0], [2.0, 0.0], [2.5, 1.5], [0.0, 3.0]]), &WIDE)
            .curves
            .remove(0);
        let steps = 20_000;
        let at = |k: usize| curve.station(curve.length_mm() * k as f64 / steps as f64).point_mm;
        let chord = |k: usize| (at(k + 1)[0] - at(k)[0]).hypot(at(k + 1)[1] - at(k)[1]);
        let length: f64 = (0..steps).map(chord).sum();
        // A chord is shorter than its arc by kappa^2 h^3 / 24 with h = 3e-4: 1e-7 of the whole at kappa = 5.
        assert!((length / curve.length_mm() - 1.0).abs() < 2e-7);
    }

    #[test]
    fn segments_in_line_are_one_line_and_each_is_served() {
        let fine = [[0.0, 0.0], [1.0, 0.0], [1.7, 0.0], [3.0, 0.0], [3.0, 0.4], [3.0, 2.0]];
        let coarse = [[0.0, 0.0], [3.0, 0.0], [3.0, 2.0]];
        let of = |points: &[[f64; 2]]| rounded(points, &WIDE).remove(0);
        let (fine, coarse) = (of(&fine), of(&coarse));
        assert_eq!(fine.corners(), coarse.corners());
        // The corner takes half of the shorter line, 1 mm, whichever segments that line is made of.
        assert!(
            (fine.corners()[0].deviation_mm - Blend::widest(0.5 * PI, 1.0, &WIDE).deviation_mm)
                .abs()
                < 1e-13
        );
        // Below: some tens of roundings of coordinates of some mm, and of curvatures of some 1 / mm.
        assert!((fine.length_mm() - coarse.length_mm()).abs() < 1e-13);
        for k in 0..=200 {
            let s = coarse.length_mm() * f64::from(k) / 200.0;
            let (a, b) = (fine.station(s), coarse.station(s));
            assert!((a.point_mm[0] - b.point_mm[0]).hypot(a.point_mm[1] - b.point_mm[1]) < 1e-13);
            assert!((a.curvature_per_mm - b.curvature_per_mm).abs() < 1e-11);
        }
        let mut served: Vec<usize> = fine.pieces().iter().map(|p| p.segment).collect();
        served.dedup();
        assert_eq!(served, [0, 1, 2, 3, 4]);
        // 1 mm of line is left of segment 0, and a third of 1.3 mm of segment 2.
        assert_eq!(fine.pieces()[0].length_mm, 1.0);
    }

    #[test]
    fn points_are_moved_where_that_takes_bend_away_and_nowhere_else() {
        // A wave with a corner at every point, alternately flat and sharp
        let rough: Vec<[f64; 2]> = (0..60)
            .map(|i| {
                [0.5 * f64::from(i), 2.0 * (0.2 * f64::from(i)).sin() + 0.1 * f64::from(i % 2)]
            })
            .collect();
        let rounding = Rounding { deviation_mm: 0.3, radius_mm: 5.0 };
        let Smooth { curves: smooth, moved_mm } = curves(&path(&rough), &rounding);
        let bound = SMOOTHED_FRACTION * rounding.deviation_mm;
        // The bound itself: rounding.
        assert!(moved_mm > 0.03 && moved_mm <= bound * (1.0 + 1e-12), "{moved_mm}");
        let on = vec![true; rough.len() - 1];
        let as_it_is: f64 = curves_through(&rough, &on, &rounding).iter().map(Curve::bend).sum();
        let bend: f64 = smooth.iter().map(Curve::bend).sum();
        // Without its alternation the wave has a tenth of the curvature, a third of the square root.
        assert!(bend < 0.6 * as_it_is, "{bend} {as_it_is}");
        // The bound itself: rounding.
        assert!(smooth[0].corners().iter().all(|c| c.deviation_mm <= 0.25 * 0.3 + 1e-15));
        let (first, last) = (smooth[0].station(0.0), smooth[0].station(smooth[0].length_mm()));
        assert_eq!(first.point_mm, rough[0]);
        let end = rough[rough.len() - 1];
        // Some tens of roundings of coordinates of 30 mm.
        assert!((last.point_mm[0] - end[0]).hypot(last.point_mm[1] - end[1]) < 1e-12);
        // A point where the tool is switched stays, and lines with right angles stay lines.
        let mut on = on;
        on[30..].fill(false);
        let switched = ToolPath::through(rough.clone(), on, vec![0; 59]).unwrap();
        let (points, _) = smoothed(&switched, bound, 5.0);
        assert_eq!(points[30], rough[30]);
        assert_ne!(points[29], rough[29]);
        let lines: Vec<[f64; 2]> = (0..20)
            .map(|i| [if (i / 2) % 2 == 0 { 0.0 } else { 40.0 }, f64::from((i + 1) / 2)])
            .collect();
        assert_eq!(curves(&path(&lines), &rounding).moved_mm, 0.0);
    }

    /// Returns points of a spiral of 1 mm per turn, `step_mm` apart, from a radius of 4 mm on.
    fn spiral(step_mm: f64, points: usize) -> Vec<[f64; 2]> {
        let mut angle = 8.0 * PI;
        let next = |_| {
            let r = angle / (2.0 * PI);
            let point = [r * angle.cos(), r * angle.sin()];
            angle += step_mm / r;
            point
        };
        (0..points).map(next).collect()
    }

    #[test]
    fn samples_of_a_bent_path_are_no_corners() {
        let rounding = Rounding { deviation_mm: 0.1, radius_mm: 1.0 };
        let points = spiral(0.8, 200);
        let curve = rounded(&points, &rounding).remove(0);
        assert!(curve.corners().is_empty());
        // One clothoid per chord, through all points
        assert_eq!(curve.pieces().len(), points.len() - 1);
        for (piece, point) in curve.pieces().iter().zip(&points) {
            assert_eq!(piece.station(0.0).point_mm, *point);
        }
        // 1 / r but for the pitch, (1 / (2 pi r))^2 = 2e-3, and the sampling, (0.8 / r)^2 / 12 = 3e-3. Corners of the
        // radius 1 mm would have 1.
        for (piece, point) in curve.pieces().iter().zip(&points) {
            let curvature = piece.station(0.0).curvature_per_mm * point[0].hypot(point[1]);
            assert!((curvature - 1.0).abs() < 8e-3, "{curvature}");
        }
        // The sagitta of the first chord, 0.8^2 / (8 r) = 0.02
        assert!(curve.deviation_mm() > 0.015 && curve.deviation_mm() < 0.021);
        // Where that is too much, the points stay corners.
        let narrow = Rounding { deviation_mm: 0.01, radius_mm: 1.0 };
        assert!(rounded(&points, &narrow)[0].corners().len() > 50);
    }

    #[test]
    fn lines_and_corners_join_a_bent_part_in_position_and_heading_and_curvature() {
        let arc = |k: i32| {
            let angle = PI * (f64::from(k) / 12.0 - 0.5);
            [10.0 + 2.0 * angle.cos(), 2.0 + 2.0 * angle.sin()]
        };
        let mut points = vec![[0.0, 0.0]];
        points.extend((0..=12).map(arc));
        points.extend([[0.0, 4.0], [0.0, 7.0]]);
        let curve = rounded(&points, &Rounding { deviation_mm: 0.1, radius_mm: 0.5 }).remove(0);
        assert_eq!(curve.corners().len(), 1, "the right angle after the bend");
        for w in curve.pieces().windows(2) {
            let (end, start) = (w[0].station(w[0].length_mm), w[1].station(0.0));
            for k in 0..2 {
                // Coordinates of some mm, rounded some tens of times
                assert!((end.point_mm[k] - start.point_mm[k]).abs() < 1e-13);
                assert!((end.tangent[k] - start.tangent[k]).abs() < 1e-13);
            }
            assert!((end.curvature_per_mm - start.curvature_per_mm).abs() < 1e-12);
        }
        // The arc has 0.5; the way in and out of it a little more.
        let bent = curve.pieces().iter().filter(|p| p.station(0.0).point_mm[0] > 5.0);
        let most = bent.map(CurvePiece::most_curvature_per_mm).fold(0.0, f64::max);
        assert!(most > 0.49 && most < 0.6, "{most}");
        let mut served: Vec<usize> = curve.pieces().iter().map(|p| p.segment).collect();
        served.dedup();
        assert_eq!(served, (0..points.len() - 1).collect::<Vec<_>>());
    }

    #[test]
    fn the_bend_is_the_integral_of_the_root_of_the_curvature() {
        let points = [[0.0, 0.0], [3.0, 0.0], [3.0, 2.0], [1.0, 2.5]];
        let curve = rounded(&points, &WIDE).remove(0);
        let steps = 20_000;
        let h = curve.length_mm() / f64::from(steps);
        let root = |k: i32| curve.station(h * (f64::from(k) + 0.5)).curvature_per_mm.abs().sqrt();
        let sum: f64 = (0..steps).map(|k| h * root(k)).sum();
        // The root is steep where a bend begins: the sum is off by some h^(3/2).
        assert!((curve.bend() - sum).abs() < 1e-4 * sum, "{} {sum}", curve.bend());
    }

    #[test]
    fn the_machine_rests_where_the_path_turns_back() {
        let there_and_back =
            curves(&path(&[[0.0, 0.0], [4.0, 0.0], [4.0, 0.0], [1.0, 0.0], [1.0, 2.0]]), &WIDE)
                .curves;
        let lengths: Vec<usize> = there_and_back.iter().map(|c| c.pieces().len()).collect();
        assert_eq!(lengths.len(), 2);
        assert_eq!(there_and_back[0].length_mm(), 4.0);
        assert_eq!(there_and_back[1].corners().len(), 1);
        assert_eq!(there_and_back[1].pieces()[0].segment, 2);
        assert!(curves(&path(&[[1.0, 1.0], [1.0, 1.0]]), &WIDE).curves.is_empty());
    }
}
