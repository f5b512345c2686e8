//! Limits of a machine on the motion along the curves, as functions of the densities of two neighbouring nodes.
//!
//! ```text
//! p'' = q'' s'^2 + q' s''        on both axes a, at times of every span:  |p''_a| <= A_a           (1)
//! |q'_a| / D <= V_a              at the nodes, where the feedrate of a span is largest             (2)
//! c = 1 -+ p''_a / A_a >= 0                                                                        (3)
//! c = (r D_j - D_k) / D_0 >= 0, and back                          r = MAX_RATIO                   (4)
//! ```
//!
//! A row is one constraint `c >= 0` of (3) or (4). s' and s'' are the feedrate and the acceleration along the curve, of
//! [`crate::mesh`]; q' and q'' are the derivatives of the position by arc length, of [`crate::curve`]. Along the curve
//! the acceleration is linear in time, so its ends decide, with the smallest A_a / |q'_a| of the span. On a clothoid
//! (1) is also imposed every 0.1 rad, towards the bend. Margins allow for the motion between these places, and a judge
//! checks the motion in the end. (4) keeps the cubic of a span monotone: its feedrates at both ends are at most three
//! times its mean feedrate if r is at most 5 (F. N. Fritsch and R. E. Carlson, SIAM J. Numer. Anal. 17 (1980) 238).
//!
//! Axes beyond x and y ([`crate::axes`]) have the same rows, also on lines, because their q'' does not vanish there.
//! With f = q' / A and g = q'' / A, their acceleration over the limit is `g s'^2 + f s''`. The excess of a product of
//! two functions over the line between its values at two places is
//!
//! ```text
//! <= |change of one| |change of the other| / 4 + what either differs from its own line, times the other   (5)
//! ```
//!
//! Places of these rows are so close that (5) is at most `MOST_BETWEEN`, with the largest s' and s'' that the other
//! limits allow. Every row leaves free what (5) is beside its place. Where a velocity could be exceeded between two
//! nodes, (2) is a row too: `c = 1 - (q' / V)^2 s'^2`. Rows that the other limits imply are left out.

use std::ops::Range;

use planish_numerics::parallel;
use planish_types::Limits;
use rayon::prelude::*;

use crate::{
    axes::{Further, Scaled},
    curve::Curve,
    mesh::{Kinematics, Mesh, Span},
    piece::CurvePiece,
};

/// Largest turn of a clothoid between two points at which the acceleration is limited by (1) of the module, rad.
/// Larger: fewer rows, and more acceleration between the points than at them. Smaller: more rows. Derived: between two
/// points a component of the acceleration is larger by at most 0.6 % (it is largest before the curved end, where the
/// tool has turned further to the axis).
const TURN_PER_STEP_RAD: f64 = 0.1;

/// Least number of steps into which a clothoid is divided; at their ends the acceleration is limited by (1) of the
/// module. Larger: more rows. Smaller: the largest acceleration is missed if the tool slows down into a bend, because
/// it is before the bend. Chosen.
const LEAST_STEPS: usize = 6;

/// Ratio of the change of the curvature along a clothoid to its largest curvature up to which its ends alone are points
/// of (1) of the module. Larger: the acceleration between them exceeds that at the ends. Smaller: more rows along bent
/// paths. Chosen.
const LITTLE_CHANGE: f64 = 0.25;

/// Fraction of the limit on acceleration that the rows of a clothoid leave free. It allows for the motion between the
/// points of (1) of the module and for the cubic pieces. Larger: slower corners. Smaller: more rounds with tightened
/// rows, because `planish verify` finds the limit exceeded. Chosen.
const CURVED_MARGIN: f64 = 2e-2;

/// Fraction of the limit on velocity that is left free on a clothoid. Larger: slower corners. Smaller: the velocity
/// exceeds the limit between the points. Derived: between two points 0.1 rad apart a component is larger by up to
/// 1.3e-3.
const TURNED_MARGIN: f64 = 2e-3;

/// Fraction of the limit on the acceleration along the curve that is left free on spans with clothoids. Larger:
/// slower corners. Smaller: exceeded limits. Derived: between two points 0.1 rad apart the tangent may have a
/// component that is larger by 1.3e-3, and the cubic pieces differ by 2e-3 of the limit.
const ALONG_CURVE_MARGIN: f64 = 4e-3;

/// Fraction of a limit that is left free for rounding. Larger: slower motions. Smaller: `planish verify` may find a
/// limit exceeded by rounding. Derived: half of what `planish verify` allows.
const ROUNDING_MARGIN: f64 = 5e-10;

/// Largest excess of a further axis over its limit between two of its points, by (5) of the module. Larger: fewer rows,
/// with larger margins. Smaller: more rows. Chosen: half of [`CURVED_MARGIN`].
const MOST_BETWEEN: f64 = 1e-2;

/// Largest number of halvings of a span, or of a step on a clothoid, until (5) of the module is small enough. Larger:
/// more rows where an axis turns sharply. Smaller: larger margins there. Chosen: 32 parts of a span are closer than any
/// TIF resolves.
const MAX_HALVINGS: usize = 5;

/// Largest ratio of the densities of two neighbouring nodes (r of (4) of the module). Larger: the tool nearly stands in
/// the middle of a span. Smaller: densities that follow the desired removal less closely. Chosen below 5, up to which
/// the cubic of a span is monotone.
const MAX_RATIO: f64 = 3.0;

/// Slack above which a row is far from being active, dimensionless (1 at rest); its second derivatives are not
/// computed. Larger: more differences to compute. Smaller: rows whose bend (second derivative) ends a step early.
/// Chosen.
const FAR_SLACK: f64 = 0.5;

/// Step of the differences of first derivatives that give the second ones, relative to the density. Larger: an error by
/// the fourth derivatives. Smaller: rounding. Chosen between the two.
const DIFFERENCE: f64 = 1e-4;

/// Row of the problem (a constraint `c >= 0`): its span, and the quantity that it limits.
#[derive(Clone, Copy, Debug, PartialEq)]
struct LimitRow {
    span: usize,
    /// Index of the further axis that the row limits; `None` for x and y.
    further: Option<usize>,
    on: On,
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum On {
    /// Acceleration along the curve, at this fraction of the time of the span: `c = 1 - along s''`, with `along` in
    /// s^2/mm.
    Line { tau: f64, along: f64 },
    /// Acceleration of an axis on a clothoid, or of a further axis, at this length from the start of the span: `c = 1 -
    /// across s'^2 - along s''`.
    Place { s_mm: f64, across: f64, along: f64 },
    /// Ratio of the densities of both nodes, (4) of the module: `c = by D`, with `by` in mm/s.
    Ratio { by: [f64; 2] },
}

/// Row (constraint `c >= 0`) at given densities, with its derivatives by the densities of the two nodes of its span.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Constraint {
    /// Nodes at the start and at the end of the span; `None` at rest.
    pub nodes: [Option<usize>; 2],
    /// Slack (c), dimensionless; a negative slack means an exceeded limit.
    pub slack: f64,
    /// First derivatives of c by the two densities, mm/s.
    pub by: [f64; 2],
    /// Part of the second derivatives of c that bends it downwards, times -1: matrix elements 00, 01, 11, mm^2/s^2.
    pub bend: [f64; 3],
}

/// Limits of the machine along the curves, as rows (constraints on the densities of nodes) and as least densities of
/// nodes.
pub struct LimitRows<'a> {
    mesh: &'a Mesh,
    rows: Vec<LimitRow>,
    least_density: Vec<f64>,
}

impl<'a> LimitRows<'a> {
    /// Returns the rows of all spans of a mesh for the axes x and y. `reference_s_per_mm` is D_0 of (4) of the module,
    /// a density of the usual size.
    pub fn new(curves: &[Curve], mesh: &'a Mesh, limits: &Limits, reference_s_per_mm: f64) -> Self {
        let mut rows = Vec::new();
        let mut least_density = vec![0.0f64; mesh.nodes];
        let most = limits.axes().each_ref().map(|a| a.max_acceleration_mm_per_s2());
        for (i, span) in mesh.spans.iter().enumerate() {
            let samples = samples(&curves[span.curve], span);
            let mut line = f64::INFINITY;
            let mut curved = false;
            for Sample { s_mm, tangent: [tx, ty], curvature_per_mm } in samples {
                let straight = curvature_per_mm == 0.0;
                curved |= !straight;
                let margin = if straight { ROUNDING_MARGIN } else { TURNED_MARGIN };
                for (axis, t) in limits.axes().iter().zip([tx, ty]) {
                    let needed = t.abs() / (axis.max_velocity_mm_per_s() * (1.0 - margin));
                    for j in span.nodes.iter().flatten() {
                        least_density[*j] = least_density[*j].max(needed);
                    }
                }
                for (most, t) in most.iter().zip([tx, ty]) {
                    line = line.min(most / t.abs());
                }
                // q'' = kappa (-q'_y, q'_x); away from the bend the limit along the curve is the stricter one.
                let bend = [-ty * curvature_per_mm, tx * curvature_per_mm];
                for (axis, bend) in bend.into_iter().enumerate().filter(|(_, bend)| *bend != 0.0) {
                    let scale = bend.signum() / (most[axis] * (1.0 - CURVED_MARGIN));
                    let (across, along) = (scale * bend, scale * [tx, ty][axis]);
                    rows.push(LimitRow::of_part(i, On::Place { s_mm, across, along }));
                }
            }
            let margin = if curved { ALONG_CURVE_MARGIN } else { ROUNDING_MARGIN };
            let along = 1.0 / (line * (1.0 - margin));
            let inner = span.nodes.iter().all(Option::is_some);
            // At rest the acceleration is constant.
            for tau in if inner { &[0.0, 1.0][..] } else { &[0.0] } {
                for along in [along, -along] {
                    rows.push(LimitRow::of_part(i, On::Line { tau: *tau, along }));
                }
            }
            if inner {
                let r = MAX_RATIO / reference_s_per_mm;
                let one = -1.0 / reference_s_per_mm;
                rows.extend([[r, one], [one, r]].map(|by| LimitRow::of_part(i, On::Ratio { by })));
            }
        }
        Self { mesh, rows, least_density }
    }

    /// Adds the rows (constraints) of further axes to those of x and y, span by span. Raises the least densities to
    /// what their velocity limits demand.
    pub fn with_further(mut self, curves: &[Curve], further: &Further<'_>) -> Self {
        let mesh = self.mesh;
        let of_spans = self.of_spans();
        let spans = &mesh.spans;
        let places: Vec<Vec<FurtherPlace>> = parallel::map(spans.len(), &|i| {
            self.most(i, of_spans[i].clone()).places(&curves[spans[i].curve], further)
        });
        for (span, places) in spans.iter().zip(&places) {
            for (node, place) in span.nodes.iter().zip([places.first(), places.last()]) {
                let (Some(j), Some(place)) = (node, place) else { continue };
                for (axis, [margin, _]) in place.axes.iter().zip(&place.margins) {
                    let needed = axis.need_s_per_mm / (1.0 - margin);
                    self.least_density[*j] = self.least_density[*j].max(needed);
                }
            }
        }
        let mut rows = Vec::with_capacity(self.rows.len());
        for (i, places) in places.iter().enumerate() {
            let own = of_spans[i].clone();
            let most = self.most(i, own.clone());
            let from = rows.len();
            rows.extend_from_slice(&self.rows[own]);
            rows.extend(places.iter().flat_map(|place| most.rows(i, place)));
            // Rows at one place are evaluated together.
            rows[from..].sort_by(|a, b| a.on.place_mm().total_cmp(&b.on.place_mm()));
        }
        self.rows = rows;
        self
    }

    /// Returns the largest feedrate and the largest acceleration along the curve that these rows allow on a span.
    fn most(&self, span: usize, rows: Range<usize>) -> Most<'a> {
        let span = &self.mesh.spans[span];
        // s' is largest at a node, because its cubic is not concave; s'' is linear in time.
        let feeds = span.nodes.iter().flatten().map(|j| 1.0 / self.least_density[*j]);
        let accelerations = self.rows[rows].iter().filter_map(|row| match row.on {
            On::Line { along, .. } => Some(1.0 / along.abs()),
            On::Place { .. } | On::Ratio { .. } => None,
        });
        Most {
            span,
            feed_mm_per_s: feeds.fold(0.0, f64::max),
            acceleration_mm_per_s2: accelerations.fold(f64::INFINITY, f64::min),
        }
    }

    /// Returns the number of rows (constraints).
    pub fn len(&self) -> usize {
        self.rows.len()
    }

    /// Returns true if there is no row.
    pub fn is_empty(&self) -> bool {
        self.rows.is_empty()
    }

    /// Returns the slack c of every row (rows), (3) and (4) of the module, at the densities of the nodes, s/mm. It is
    /// negative where a limit is exceeded.
    pub fn slacks(&self, density: &[f64]) -> Vec<f64> {
        let places = self.rows.par_chunk_by(LimitRow::are_at_one_place);
        let all = places.flat_map_iter(|rows| {
            let span = &self.mesh.spans[rows[0].span];
            let on = rows[0].on;
            let densities = span.densities(density);
            let at = on.motion(span, densities);
            rows.iter().map(move |row| row.on.derivatives(&at, densities).0)
        });
        all.collect()
    }

    /// Returns every row (rows) with its derivatives by the densities, at the densities of the nodes, s/mm.
    pub fn constraints(&self, density: &[f64]) -> Vec<Constraint> {
        let places = self.rows.par_chunk_by(LimitRow::are_at_one_place);
        let all = places.flat_map_iter(|rows| {
            let span = &self.mesh.spans[rows[0].span];
            let on = rows[0].on;
            let densities = span.densities(density);
            let at = on.motion(span, densities);
            // Of the densities a little higher and a little lower, one by one; where a row asks for it
            let mut around = None;
            rows.iter().map(move |row| {
                let (slack, by) = row.on.derivatives(&at, densities);
                if matches!(row.on, On::Ratio { .. }) || slack > FAR_SLACK {
                    return Constraint { nodes: span.nodes, slack, by, bend: [0.0; 3] };
                }
                let around = around.get_or_insert_with(|| {
                    [0, 1].map(|k| {
                        [1.0 + DIFFERENCE, 1.0 - DIFFERENCE].map(|factor| {
                            let mut moved = densities;
                            moved[k] = moved[k].map(|d| d * factor);
                            (on.motion(span, moved), moved)
                        })
                    })
                });
                // Second derivatives as differences of the first ones
                let mut second = [[0.0; 2]; 2];
                for k in 0..2 {
                    if let Some(d) = densities[k] {
                        let [plus, minus] =
                            [0, 1].map(|i| row.on.derivatives(&around[k][i].0, around[k][i].1).1);
                        for e in 0..2 {
                            second[k][e] = (plus[e] - minus[e]) / (2.0 * DIFFERENCE * d);
                        }
                    }
                }
                let off = 0.5 * (second[0][1] + second[1][0]);
                let bend = positive_part([-second[0][0], -off, -second[1][1]]);
                Constraint { nodes: span.nodes, slack, by, bend }
            })
        });
        all.collect()
    }

    /// Returns the range of the rows of every span (spans).
    pub fn of_spans(&self) -> Vec<Range<usize>> {
        let mut all = Vec::with_capacity(self.mesh.spans.len());
        let mut end = 0;
        for span in 0..self.mesh.spans.len() {
            let from = end;
            end += self.rows[from..].iter().take_while(|row| row.span == span).count();
            all.push(from..end);
        }
        all
    }

    /// Returns the first-order decrease of the objective if a span is halved (spans), nm^2: the increase of the slacks
    /// of its rows times their dual variables `z` (rows). It is 0 for a span that begins or ends at rest.
    ///
    /// The new node in the middle has the feedrate of a constant acceleration, which leaves the largest slacks. For a
    /// row on the whole span, the half with the smaller slack decides.
    pub fn worth_of_halving(&self, density: &[f64], z: &[f64]) -> Vec<f64> {
        let mut worth = vec![0.0; self.mesh.spans.len()];
        for (row, z) in self.rows.iter().zip(z) {
            let span = &self.mesh.spans[row.span];
            let [Some(a), Some(b)] = span.densities(density) else { continue };
            let middle = constant_acceleration(a, b);
            let [first, second] = span.halves();
            let (before, after) = ([a, middle], [middle, b]);
            let half_mm = first.length_mm();
            let halved = match row.on {
                On::Place { s_mm, across, along } if s_mm > half_mm => {
                    On::Place { s_mm: s_mm - half_mm, across, along }.slack(&second, after)
                }
                On::Place { .. } => row.on.slack(&first, before),
                On::Line { .. } | On::Ratio { .. } => {
                    row.on.slack(&first, before).min(row.on.slack(&second, after))
                }
            };
            worth[row.span] += z * (halved - row.on.slack(span, [a, b])).max(0.0);
        }
        worth
    }

    /// Tightens the rows of x and y of every span: divides their limits by `use_of_limit` (spans) where that is above
    /// 1. Ratios of densities stay.
    pub fn tighten(&mut self, use_of_limit: &[f64]) {
        for row in self.rows.iter_mut().filter(|row| row.further.is_none()) {
            row.on.tighten(use_of_limit[row.span]);
        }
    }

    /// Tightens the rows of further axes on every span: their limits are divided by `use_of_limit` (spans, axes) where
    /// that is above 1.
    ///
    /// A span may have no row of an axis, because other limits imply its velocity and acceleration, but not its jerk.
    /// The method then tightens its rows of x and y; with `all` it tightens those of all axes.
    pub fn tighten_further(&mut self, use_of_limit: &[Vec<f64>], all: bool) {
        for (span, rows) in self.of_spans().into_iter().enumerate() {
            let rows = &mut self.rows[rows];
            for (axis, factor) in use_of_limit[span].iter().enumerate().filter(|(_, f)| **f > 1.0) {
                let has_own = rows.iter().any(|row| row.further == Some(axis));
                let tightened = if has_own { Some(axis) } else { None };
                for row in rows.iter_mut().filter(|row| all || row.further == tightened) {
                    row.on.tighten(*factor);
                }
            }
        }
    }

    /// Returns the least densities of the nodes (nodes) that the velocity limits of all axes allow, (2) of the module,
    /// s/mm.
    pub fn least_density(&self) -> &[f64] {
        &self.least_density
    }

    /// Returns the least uniform density at which every row holds, except the ratios of densities, s/mm.
    ///
    /// At a uniform feedrate p'' is the square of that feedrate times its value at 1 mm/s, at rest too.
    pub fn least_uniform_density(&self) -> f64 {
        let at_one = self.slacks(&vec![1.0; self.mesh.nodes]);
        let limits =
            self.rows.iter().zip(at_one).filter(|(row, _)| !matches!(row.on, On::Ratio { .. }));
        limits.map(|(_, c)| 1.0 - c).fold(0.0, f64::max).sqrt()
    }
}

/// Returns the density in the middle between two nodes of the densities `a` and `b` if the acceleration is constant.
/// Its feedrate is the root mean square of the two feedrates.
pub fn constant_acceleration(a: f64, b: f64) -> f64 {
    (0.5 * (a.powi(-2) + b.powi(-2))).powf(-0.5)
}

impl LimitRow {
    /// Returns a row of the axes x and y.
    fn of_part(span: usize, on: On) -> Self {
        Self { span, further: None, on }
    }

    /// Returns true if two rows limit the motion of the same span at the same position or time.
    fn are_at_one_place(&self, other: &Self) -> bool {
        let same = match (self.on, other.on) {
            (On::Line { tau: a, .. }, On::Line { tau: b, .. }) => a == b,
            (On::Place { s_mm: a, .. }, On::Place { s_mm: b, .. }) => a == b,
            _ => false,
        };
        same && self.span == other.span
    }
}

impl On {
    /// Returns the position of the row on its span, mm; infinite for a row without one.
    fn place_mm(&self) -> f64 {
        match self {
            Self::Place { s_mm, .. } => *s_mm,
            Self::Line { .. } | Self::Ratio { .. } => f64::INFINITY,
        }
    }

    /// Returns the slack c of the row on `span` with these densities at its nodes, s/mm.
    fn slack(&self, span: &Span, densities: [f64; 2]) -> f64 {
        let densities = densities.map(Some);
        self.derivatives(&self.motion(span, densities), densities).0
    }
    /// Divides the limit of the row by `factor` if that is above 1; a row on the ratio of densities stays.
    fn tighten(&mut self, factor: f64) {
        let factor = factor.max(1.0);
        match self {
            Self::Line { along, .. } => *along *= factor,
            Self::Place { across, along, .. } => {
                *across *= factor;
                *along *= factor;
            }
            Self::Ratio { .. } => {}
        }
    }

    /// Returns the motion on `span` at the position or time of the row; for a ratio of densities, which needs none,
    /// that at the start.
    fn motion(&self, span: &Span, densities: [Option<f64>; 2]) -> Kinematics {
        match *self {
            Self::Ratio { .. } => span.kinematics(0.0, densities),
            Self::Line { tau, .. } => span.kinematics(tau, densities),
            Self::Place { s_mm, .. } => span.at_place(s_mm, densities),
        }
    }

    /// Returns the slack c and its derivatives by the densities of the two nodes, for the motion `at` the position of
    /// the row.
    fn derivatives(&self, at: &Kinematics, densities: [Option<f64>; 2]) -> (f64, [f64; 2]) {
        let (across, along) = match *self {
            Self::Ratio { by } => {
                let d = densities.map(|d| d.unwrap_or(0.0));
                return (by[0] * d[0] + by[1] * d[1], by);
            }
            Self::Line { along, .. } => (0.0, along),
            Self::Place { across, along, .. } => (across, along),
        };
        let slack = 1.0 - across * at.feed_mm_per_s.powi(2) - along * at.acceleration_mm_per_s2;
        let by = [0, 1].map(|k| {
            -2.0 * across * at.feed_mm_per_s * at.feed_by[k] - along * at.acceleration_by[k]
        });
        (slack, by)
    }
}

/// Returns the nearest symmetric matrix without negative eigenvalues; matrices are elements 00, 01, 11.
fn positive_part([a, b, c]: [f64; 3]) -> [f64; 3] {
    let middle = 0.5 * (a + c);
    let half = 0.5 * (a - c);
    let radius = half.hypot(b);
    let high = (middle + radius).max(0.0);
    let low = (middle - radius).max(0.0);
    if radius == 0.0 {
        return [high, 0.0, high];
    }
    // The projector on the eigenvector of `high` is (1 + [half, b; b, -half] / radius) / 2.
    let mean = 0.5 * (high + low);
    let difference = 0.5 * (high - low) / radius;
    [mean + difference * half, difference * b, mean - difference * half]
}

/// Point of a span at which the acceleration is limited by (1) of the module.
struct Sample {
    /// Length from the start of the span to the point, mm.
    s_mm: f64,
    /// Unit vector along the curve (q').
    tangent: [f64; 2],
    /// Curvature of the curve there, 1/mm; 0 on a straight line.
    curvature_per_mm: f64,
}

/// Returns the number of equal steps into which a clothoid is divided; x and y are limited at their ends.
fn steps_of(piece: &CurvePiece) -> usize {
    let least = if piece.change_of_curvature() > LITTLE_CHANGE { LEAST_STEPS } else { 1 };
    ((piece.turn_rad() / TURN_PER_STEP_RAD).ceil() as usize).max(least)
}

fn samples(curve: &Curve, span: &Span) -> Vec<Sample> {
    let mut samples = Vec::new();
    let first = curve.pieces().partition_point(|p| p.to_mm() <= span.from_mm);
    for piece in curve.pieces()[first..].iter().take_while(|p| p.from_mm < span.to_mm) {
        let (from, to) = (piece.from_mm.max(span.from_mm), piece.to_mm().min(span.to_mm));
        let steps = if piece.is_straight() { 1 } else { steps_of(piece) };
        for k in 0..=steps {
            let s = piece.from_mm + piece.length_mm * k as f64 / steps as f64;
            // Where a node stands within the piece, the part on this side of it has its end there.
            let s = s.clamp(from, to);
            let (tangent, curvature_per_mm) = piece.direction(s - piece.from_mm);
            samples.push(Sample { s_mm: s - span.from_mm, tangent, curvature_per_mm });
        }
    }
    samples.dedup_by(|b, a| a.s_mm == b.s_mm);
    samples
}

/// Point of a span at which further axes are limited.
struct FurtherPlace {
    /// Length from the start of the span to the point, mm.
    s_mm: f64,
    /// Scaled derivatives of every axis; empty where an axis has no position, because the motion is refused there.
    axes: Vec<Scaled>,
    /// Fractions of the limits on velocity and on acceleration of every axis that are left free.
    margins: Vec<[f64; 2]>,
}

impl FurtherPlace {
    /// Returns the point at `s_mm` from the start of the span, with the margins for rounding only.
    fn new(curve: &Curve, span: &Span, further: &Further<'_>, s_mm: f64) -> Self {
        let axes = further.scaled(&curve.station(span.from_mm + s_mm)).unwrap_or_default();
        let margins = vec![[ROUNDING_MARGIN; 2]; axes.len()];
        Self { s_mm, axes, margins }
    }
}

/// Upper bounds on feedrate and acceleration along the curve on a span.
struct Most<'a> {
    span: &'a Span,
    feed_mm_per_s: f64,
    acceleration_mm_per_s2: f64,
}

impl Most<'_> {
    /// Returns the points of the span at which further axes are limited. Between them (5) of the module is at most
    /// [`MOST_BETWEEN`], or the part was halved [`MAX_HALVINGS`] times. Their margins contain (5).
    fn places(&self, curve: &Curve, further: &Further<'_>) -> Vec<FurtherPlace> {
        let span = self.span;
        let mut places = Vec::new();
        let mut start = FurtherPlace::new(curve, span, further, 0.0);
        for (to_mm, curved) in self.steps(curve) {
            // From the last place on: the ends of the parts that are still to be made.
            let mut ends = vec![(FurtherPlace::new(curve, span, further, to_mm), 0)];
            while let Some((mut end, halvings)) = ends.pop() {
                let length_mm = end.s_mm - start.s_mm;
                let inside = [0.25, 0.5, 0.75]
                    .map(|f| FurtherPlace::new(curve, span, further, start.s_mm + f * length_mm));
                let [a, b, c] = &inside;
                let between = self.between([&start, a, b, c, &end]);
                let most = between.iter().flatten().copied().fold(0.0, f64::max);
                if most > MOST_BETWEEN && halvings < MAX_HALVINGS {
                    let [_, middle, _] = inside;
                    ends.extend([(end, halvings + 1), (middle, halvings + 1)]);
                    continue;
                }
                let least = if curved { [TURNED_MARGIN, CURVED_MARGIN] } else { [0.0; 2] };
                for place in [&mut start, &mut end] {
                    for (margins, between) in place.margins.iter_mut().zip(&between) {
                        for k in 0..2 {
                            let needed = between[k].min(CURVED_MARGIN).max(least[k]);
                            margins[k] = margins[k].max(needed);
                        }
                    }
                }
                places.push(std::mem::replace(&mut start, end));
            }
        }
        places.push(start);
        places
    }

    /// Returns the ends of the parts into which the span is divided before any halving, as lengths from its start, mm.
    /// They are the steps on clothoids, and the lines between them as a whole. The flag is true for a part of a
    /// clothoid.
    fn steps(&self, curve: &Curve) -> Vec<(f64, bool)> {
        let from_mm = self.span.from_mm;
        let to_mm = self.span.to_mm;
        let mut steps: Vec<(f64, bool)> = Vec::new();
        let first = curve.pieces().partition_point(|p| p.to_mm() <= from_mm);
        for piece in curve.pieces()[first..].iter().take_while(|p| p.from_mm < to_mm) {
            let curved = !piece.is_straight();
            // The halvings find the largest acceleration before a bend, for which clothoids have more steps above.
            let parts = (piece.turn_rad() / TURN_PER_STEP_RAD).ceil().max(1.0) as usize;
            for k in 1..=parts {
                let s = piece.from_mm + piece.length_mm * k as f64 / parts as f64;
                let s = s.clamp(from_mm, to_mm) - from_mm;
                let last = steps.last().copied();
                if !curved && last.is_some_and(|(_, curved)| !curved) {
                    steps.pop();
                } else if last.is_some_and(|(before, _)| s <= before) || s <= 0.0 {
                    continue;
                }
                steps.push((s, curved));
            }
        }
        steps
    }

    /// Returns the bound (5) of the module on velocity and acceleration of every axis, over its limits, from five
    /// equidistant points.
    fn between(&self, at: [&FurtherPlace; 5]) -> Vec<[f64; 2]> {
        let axes = at.iter().map(|place| place.axes.len()).min().unwrap_or(0);
        let length_mm = at[4].s_mm - at[0].s_mm;
        // The slowest feedrate that some axis asks for all over the part
        let slowest =
            |i: usize| at.iter().map(|p| p.axes[i].need_s_per_mm).fold(f64::INFINITY, f64::min);
        let feed = (0..axes).map(|i| 1.0 / slowest(i)).fold(self.feed_mm_per_s, f64::min);
        let bounds = (0..axes).map(|i| {
            let need = at.map(|place| place.axes[i].need_s_per_mm);
            let along = at.map(|place| place.axes[i].along);
            let across = at.map(|place| place.axes[i].across);
            let f = largest(along);
            let g = largest(across);
            let acceleration = self.acceleration_mm_per_s2;
            let velocity = if largest(need) * self.feed_mm_per_s <= 1.0 {
                0.0
            } else {
                let faster = (2.0 * acceleration * length_mm).sqrt().min(feed);
                0.25 * change(need) * faster + off_line(need) * feed
            };
            // An axis whose second derivative is not that of its first one has a step that no place shows.
            let [a, b, c, d, e] = across;
            let mean = (7.0 * (a + e) + 32.0 * (b + d) + 12.0 * c) / 90.0;
            let step = (along[4] - along[0] - length_mm * mean).abs() * acceleration;
            if g * feed * feed + f * acceleration <= 1.0 {
                return [velocity, step];
            }
            // Squares of feedrates and accelerations, as far as this axis itself allows
            let squared = ((1.0 + f * acceleration) / g).min(feed * feed);
            let acceleration = ((1.0 + g * squared) / f).min(acceleration);
            let share = length_mm / self.span.length_mm();
            let products = change(along) * 2.0 * acceleration * share
                + change(across) * (2.0 * acceleration * length_mm).min(squared);
            let own = off_line(across) * squared + off_line(along) * acceleration;
            [velocity, 0.25 * products + own + step]
        });
        bounds.collect()
    }

    /// Returns the rows of the further axes at a point of the span with the index `span`, without those that the other
    /// limits imply.
    fn rows(&self, span: usize, place: &FurtherPlace) -> Vec<LimitRow> {
        let s_mm = place.s_mm;
        let feed = self.feed_mm_per_s;
        let acceleration = self.acceleration_mm_per_s2;
        let [start, end] = self.span.nodes;
        let at_node =
            s_mm == 0.0 && start.is_some() || s_mm == self.span.length_mm() && end.is_some();
        let mut rows = Vec::new();
        for (i, (axis, [of_velocity, of_acceleration])) in
            place.axes.iter().zip(&place.margins).enumerate()
        {
            let need = axis.need_s_per_mm / (1.0 - of_velocity);
            if need * feed > 1.0 && !at_node {
                let on = On::Place { s_mm, across: need * need, along: 0.0 };
                rows.push(LimitRow { span, further: Some(i), on });
            }
            let [across, along] = [axis.across, axis.along].map(|v| v / (1.0 - of_acceleration));
            for sign in [1.0, -1.0] {
                let bend = (sign * across).max(0.0) * feed * feed;
                if bend + along.abs() * acceleration > 1.0 {
                    let on = On::Place { s_mm, across: sign * across, along: sign * along };
                    rows.push(LimitRow { span, further: Some(i), on });
                }
            }
        }
        rows
    }
}

/// Returns the largest magnitude of five values.
fn largest(v: [f64; 5]) -> f64 {
    v.into_iter().fold(0.0, |m: f64, v| m.max(v.abs()))
}

/// Returns the magnitude of the difference of the last and the first of five values.
fn change(v: [f64; 5]) -> f64 {
    (v[4] - v[0]).abs()
}

/// Returns the largest difference of five equidistant values from the line between the first and the last one.
fn off_line(v: [f64; 5]) -> f64 {
    let [a, b, c] = [1, 2, 3].map(|k| (v[k] - v[0] - (v[4] - v[0]) * k as f64 / 4.0).abs());
    a.max(b).max(c)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        curve::{Rounding, curves},
        motion::motion,
    };
    use planish_types::{MachineFile, MachineFileAxis, ToolPath};

    fn machine() -> Limits {
        let axis = |name: &str, a: f64| MachineFileAxis {
            name: name.into(),
            max_velocity_mm_per_s: 80.0,
            max_acceleration_mm_per_s2: a,
            max_jerk_mm_per_s3: None,
            ..MachineFileAxis::default()
        };
        let axes = vec![axis("x", 900.0), axis("y", 500.0)];
        MachineFile { name: "test".into(), axes, min_segment_s: 0.0, ..MachineFile::default() }
            .checked()
            .unwrap()
    }

    /// Returns a path with right angles, an acute and an obtuse corner, and a rest where it turns back.
    fn path() -> ToolPath {
        let points = vec![
            [0.0, 0.0],
            [4.0, 0.0],
            [4.0, 1.0],
            [0.5, 1.0],
            [1.5, 2.5],
            [2.0, 5.0],
            [2.0, 3.0],
            [6.0, 4.0],
        ];
        ToolPath::through(points, vec![true; 7], vec![0; 7]).unwrap()
    }

    #[test]
    fn rows_are_what_the_motion_does_and_their_derivatives_are_right() {
        let (path, limits) = (path(), machine());
        let curves = curves(&path, &Rounding { deviation_mm: 0.15, radius_mm: 1.0 }).curves;
        let mesh = Mesh::new(&curves, &path, 0.8).unwrap();
        let rows = LimitRows::new(&curves, &mesh, &limits, 0.1);
        let density: Vec<f64> =
            (0..mesh.nodes).map(|j| 0.09 + 0.03 * (2.1 * j as f64).sin()).collect();
        let constraints = rows.constraints(&density);
        for (i, row) in constraints.iter().enumerate() {
            for (node, by) in row.nodes.iter().zip(row.by) {
                let Some(node) = *node else { continue };
                let slack = |h: f64| {
                    let mut moved = density.clone();
                    moved[node] += h;
                    rows.slacks(&moved)[i]
                };
                // Central differences: h^2 of the third derivative, some 1e5, and rounding / h.
                let difference = (slack(1e-6) - slack(-1e-6)) / 2e-6;
                assert!(
                    (difference - by).abs() < 1e-5 * by.abs().max(1.0),
                    "{i}: {difference} {by}"
                );
            }
            let [a, b, c] = row.bend;
            // Rounding of a determinant.
            assert!(a >= 0.0 && c >= 0.0 && b * b <= a * c * (1.0 + 1e-9) + 1e-12);
        }
        // The largest use of the limits that the rows know is that of the motion.
        let motion = motion(&curves, &mesh, &path, &limits, None, &density).unwrap();
        let used = motion.use_of_acceleration(mesh.spans.len(), &limits);
        for (span, used) in used.iter().enumerate() {
            let of_span = rows
                .rows
                .iter()
                .zip(&constraints)
                .filter(|(row, _)| row.span == span && !matches!(row.on, On::Ratio { .. }));
            let known = of_span.map(|(_, c)| 1.0 - c.slack).fold(0.0, f64::max);
            // CURVED_MARGIN, for what happens between the places of the rows; on this density it is below 1e-5.
            assert!(*used <= known * 1.02, "span {span}: {used} of {known}");
            // On a line the rows take the stricter axis, whichever the motion uses.
            assert!(*used >= 0.5 * known, "span {span}: {used} of {known}");
        }
    }

    #[test]
    fn what_halving_a_span_is_worth_is_what_its_rows_leave_more() {
        let points = vec![[0.0, 0.0], [5.0, 0.0], [5.5, 0.0], [9.0, 0.0]];
        let path = ToolPath::through(points, vec![true; 3], vec![0; 3]).unwrap();
        let limits = machine();
        let curves = curves(&path, &Rounding { deviation_mm: 0.15, radius_mm: 1.0 }).curves;
        let mesh = Mesh::new(&curves, &path, 0.7).unwrap();
        let rows = LimitRows::new(&curves, &mesh, &limits, 0.1);
        let density: Vec<f64> =
            (0..mesh.nodes).map(|j| 0.09 + 0.03 * (2.1 * j as f64).sin()).collect();
        let slacks = rows.slacks(&density);
        let z: Vec<f64> = (0..rows.len()).map(|i| 1.0 + (i % 7) as f64).collect();
        let worth = rows.worth_of_halving(&density, &z);
        for (i, span) in mesh.spans.iter().enumerate() {
            let [Some(a), Some(b)] = span.densities(&density) else {
                assert_eq!(worth[i], 0.0);
                continue;
            };
            // The mesh in which this span alone is halved, with the mean of the squared feedrates in the middle.
            let halved: Vec<bool> = (0..mesh.spans.len()).map(|k| k == i).collect();
            let finer = mesh.refined(&curves, &path, &halved);
            assert_eq!(finer.nodes, mesh.nodes + 1);
            let [v, w] = [1.0 / a, 1.0 / b];
            let middle = 1.0 / ((v * v + w * w) / 2.0).sqrt();
            let mut of_finer = density.clone();
            of_finer.insert(span.nodes[1].unwrap(), middle);
            let finer_rows = LimitRows::new(&curves, &finer, &limits, 0.1);
            let of_halves = finer_rows.slacks(&of_finer);
            let (whole, halves) = (rows.of_spans()[i].clone(), finer_rows.of_spans());
            let mut expected = 0.0;
            for (k, row) in whole.enumerate() {
                let least = of_halves[halves[i].start + k].min(of_halves[halves[i + 1].start + k]);
                expected += z[row] * (least - slacks[row]).max(0.0);
            }
            // Rounding of sums of weights up to 7.
            assert!((worth[i] - expected).abs() < 1e-12, "{} {expected}", worth[i]);
            assert!(worth[i] > 0.0);
        }
        // A uniform feedrate uses no more of the limits between two nodes than at them.
        let uniform = rows.worth_of_halving(&vec![0.1; mesh.nodes], &z);
        // Rounding, as above.
        assert!(uniform.iter().all(|w| w.abs() < 1e-12), "{uniform:?}");
    }

    #[test]
    fn a_uniform_feed_just_keeps_the_limits() {
        let (path, limits) = (path(), machine());
        let curves = curves(&path, &Rounding { deviation_mm: 0.15, radius_mm: 1.0 }).curves;
        let mesh = Mesh::new(&curves, &path, 0.8).unwrap();
        let rows = LimitRows::new(&curves, &mesh, &limits, 0.1);
        let least = rows.least_uniform_density();
        let slack = |d: f64| rows.slacks(&vec![d; mesh.nodes]).into_iter().fold(1.0, f64::min);
        // Rounding of 1.
        assert!(
            slack(least).abs() < 1e-12 && slack(1.01 * least) > 0.0 && slack(0.99 * least) < 0.0
        );
    }

    #[test]
    fn the_positive_part_drops_what_bends_upwards() {
        assert_eq!(positive_part([2.0, 0.0, -3.0]), [2.0, 0.0, 0.0]);
        assert_eq!(positive_part([-2.0, 0.0, -3.0]), [0.0, 0.0, 0.0]);
        // Eigenvalues 3 and -1, the first along (1, 1).
        let [a, b, c] = positive_part([1.0, 2.0, 1.0]);
        // Below: rounding of numbers up to 3.
        assert!([a, b, c].iter().all(|v| (v - 1.5).abs() < 1e-15));
        let kept = [3.0, 1.0, 2.0];
        assert!(positive_part(kept).iter().zip(kept).all(|(a, b)| (a - b).abs() < 1e-15));
    }
}
