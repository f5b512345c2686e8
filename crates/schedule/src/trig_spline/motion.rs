//! Motion along the passes, as cubics in time that are proven within the limits, and along the links
//! with the tool off: steps 3 to 6 of [`super`].

use planish_types::{DwellTime, Limits, ToolPath, TrajectoryBuilder};

use super::{
    passes::{MARGIN, Pass, Straight},
    report::TrigSplineReport,
    spline::{STRETCH_PLACES, Stretch, TrigPiece},
};
use crate::{
    hermite::{accelerations, coefficients, peak_velocity},
    largest_along,
    shortest_cubic::{State, shortest_cubic},
};

/// Trajectory under construction: the segments so far, and the state at their end.
pub(super) struct Motion<'a> {
    path: &'a ToolPath,
    dwell: &'a DwellTime,
    limits: &'a Limits,
    tolerance_mm: f64,
    pub(super) report: TrigSplineReport,
    /// Pieces that are not proven within the limits: index of the pass, and index of the first node of the piece.
    pub(super) unproven: Vec<(usize, usize)>,
    /// Segments so far.
    pub(super) made: TrajectoryBuilder,
    /// Position and velocity at the end of the segments so far.
    now: State,
}

impl<'a> Motion<'a> {
    /// Returns the motion along all passes, with the links before, between and after them. `report` contains the
    /// changes of their densities; the motion adds its links, dropped segments and error of the fit.
    pub(super) fn along(
        path: &'a ToolPath,
        dwell: &'a DwellTime,
        limits: &'a Limits,
        tolerance_mm: f64,
        passes: &[Pass],
        report: TrigSplineReport,
    ) -> Self {
        let mut motion = Self {
            path,
            dwell,
            limits,
            tolerance_mm,
            report,
            unproven: Vec::new(),
            made: TrajectoryBuilder::default(),
            now: State::at_rest(path.point_mm()[0]),
        };
        motion.walk(passes);
        motion
    }

    fn walk(&mut self, passes: &[Pass]) {
        let mut next = 0;
        for (number, pass) in passes.iter().enumerate() {
            let start = pass.start();
            if next == pass.run.start {
                self.run_up(start);
            } else {
                self.lift(next..pass.run.start, start);
            }
            self.pass(number, pass);
            next = pass.run.end;
        }

        if next < self.path.len() {
            let end = State::at_rest(self.path.point_mm()[self.path.len()]);
            self.lift(next..self.path.len(), end);
        } else {
            self.brake();
        }
    }

    /// Adds the acceleration from rest to the start of the first pass, along its extension backwards, with the tool
    /// off.
    fn run_up(&mut self, start: State) {
        let (speed, direction) = polar(start.velocity_mm_per_s);
        if speed > 0.0 {
            let a = self.acceleration_along(direction);
            let t = speed / a;
            let distance = 0.5 * speed * speed / a;
            let c = [0, 1].map(|x| {
                let u = direction[x];
                [start.position_mm[x] - u * distance, 0.0, 0.5 * u * a, 0.0]
            });
            self.link(t, c, None);
        }
        self.now = start;
    }

    /// Adds the brake to rest after the end of the last pass, with the tool off.
    fn brake(&mut self) {
        let (speed, direction) = polar(self.now.velocity_mm_per_s);
        if speed > 0.0 {
            let a = self.acceleration_along(direction);
            let c = [0, 1].map(|x| {
                [
                    self.now.position_mm[x],
                    self.now.velocity_mm_per_s[x],
                    -0.5 * direction[x] * a,
                    0.0,
                ]
            });
            self.link(speed / a, c, None);
        }
    }

    fn acceleration_along(&self, direction: [f64; 2]) -> f64 {
        (1.0 - MARGIN) * largest_along(direction, self.limits.max_acceleration_mm_per_s2())
    }

    /// Adds a link for every segment with the tool off in `run`, at rest between them; the last one ends in the state
    /// `end`.
    fn lift(&mut self, run: std::ops::Range<usize>, end: State) {
        for i in run.clone() {
            let rest = State::at_rest(self.path.point_mm()[i + 1]);
            let to = if i + 1 == run.end { end } else { rest };
            match shortest_cubic(self.now, to, self.limits, self.dwell.dwell_s()[i]) {
                Some(link) => self.link(link.duration_s, link.coefficient_mm, Some(i)),
                None => self.report.dropped.push(i),
            }
            self.now = to;
        }
    }

    fn link(&mut self, duration_s: f64, c: [[f64; 4]; 2], dwell_index: Option<usize>) {
        // A shorter one would vanish in the rounding of the break times.
        if duration_s <= 64.0 * f64::EPSILON * self.dwell.total_s() {
            return;
        }
        self.made.push(duration_s, c, false, dwell_index);
        self.report.links += 1;
        self.report.link_s += duration_s;
    }

    fn pass(&mut self, number: usize, pass: &Pass) {
        if pass.straights.is_empty() {
            // Nothing but standing.
            for i in pass.run.clone() {
                let t = self.dwell.dwell_s()[i];
                let p = self.path.point_mm()[i];
                if t > 0.0 {
                    self.made.push(t, p.map(|p| [p, 0.0, 0.0, 0.0]), true, Some(i));
                } else {
                    self.report.dropped.push(i);
                }
            }
            return;
        }
        let last = pass.nodes.len() - 1;
        let first_straight = &pass.straights[0];
        let last_straight = pass.straights.len() - 1;
        self.plateau(first_straight, 0.0, 0.5 * first_straight.length, pass.nodes[0].density);
        for k in 0..last {
            if !self.piece(pass, k) {
                self.unproven.push((number, k));
            }
            if pass.nodes[k + 1].half_length_mm > 0.0 {
                self.blend(pass, k + 1);
            }
        }
        let s = &pass.straights[last_straight];
        self.plateau(s, 0.5 * s.length, s.length, pass.nodes[last].density);
        self.now = pass.end();
    }

    /// Adds a motion of constant density, s/mm, along a straight, between the distances `from` and `to` from its start,
    /// mm.
    fn plateau(&mut self, s: &Straight, from: f64, to: f64, density: f64) {
        let c = [0, 1]
            .map(|a| [s.start[a] + s.direction[a] * from, s.direction[a] / density, 0.0, 0.0]);
        self.made.push((to - from) * density, c, true, Some(s.index));
    }

    /// Adds the parabola that rounds the corner at node `k` of the pass, in two halves, one per segment of the path.
    fn blend(&mut self, pass: &Pass, k: usize) {
        let node = &pass.nodes[k];
        let s = &pass.straights[pass.straight_of[k]];
        let next = &pass.straights[pass.straight_of[k] + 1];
        let b = node.half_length_mm;
        let v = 1.0 / node.density;
        let half_s = b * node.density;
        // p(u) = corner - b u1 + v u1 u + (u2 - u1) v^2/(4 b) u^2
        let c = [0, 1].map(|a| {
            let u1 = s.direction[a];
            let u2 = next.direction[a];
            [next.start[a] - b * u1, v * u1, (u2 - u1) * v * v / (4.0 * b), 0.0]
        });
        let middle = c.map(|c| {
            [c[0] + half_s * (c[1] + half_s * c[2]), c[1] + 2.0 * c[2] * half_s, c[2], 0.0]
        });
        self.made.push(half_s, c, true, Some(s.index));
        self.made.push(half_s, middle, true, Some(next.index));
    }

    /// Adds the cubics of the piece from node `k` to the next one, by step 5 of [`super`]. Returns true if the piece
    /// and all its cubics are proven within the limits.
    fn piece(&mut self, pass: &Pass, k: usize) -> bool {
        let a = &pass.nodes[k];
        let b = &pass.nodes[k + 1];
        let own = &pass.straights[pass.straight_of[k]];
        // The straight along which the piece starts, and the start on it. A piece between two dwell points
        // is cut at the end of the first segment.
        let next = pass.straights.get(pass.straight_of[k] + 1);
        let (straight, offset) = match next {
            Some(next) if a.half_length_mm > 0.0 => (next, a.half_length_mm),
            _ => (own, 0.5 * own.length),
        };
        let limited = pass.piece(k);
        let fit = CubicFit {
            shape: limited.shape,
            // A corner's is that of two directions.
            max_velocity: 1.0 / if a.half_length_mm > 0.0 { b.fastest } else { a.fastest },
            max_acceleration: limited.max_acceleration / (1.0 - MARGIN),
            tolerance_mm: self.tolerance_mm,
        };
        let both = match next {
            Some(next) if a.half_length_mm == 0.0 && b.half_length_mm == 0.0 => {
                let [first, second] = if (own.length / next.length - 1.0).abs() <= SAME_LENGTH {
                    Stretch::WHOLE.halves()
                } else {
                    let cut = 0.5 * own.length / fit.shape.length_mm;
                    [Stretch::new(0.0, cut), Stretch::new(cut, 1.0)]
                };
                [Some((first, own.index)), Some((second, next.index))]
            }
            _ => [Some((Stretch::WHOLE, straight.index)), None],
        };
        let mut proven = !limited.is_too_fast([0.0; 2]);
        for (stretch, index) in both.into_iter().flatten() {
            fit.cubics(stretch, 0, &mut |cubic: Cubic| {
                proven &= cubic.within_limits;
                let error_mm = &mut self.report.fit_error_mm;
                *error_mm = error_mm.max(cubic.error_mm);
                let c = [0, 1].map(|x| {
                    let u = straight.direction[x];
                    let [c0, c1, c2, c3] = cubic.coefficient_mm;
                    [straight.start[x] + u * (offset + c0), u * c1, u * c2, u * c3]
                });
                self.made.push(cubic.duration_s, c, true, Some(index));
            });
        }
        proven
    }
}

/// Returns the magnitude of a vector and its unit vector; the unit vector is zero for the zero vector.
fn polar(v: [f64; 2]) -> (f64, [f64; 2]) {
    let speed = v[0].hypot(v[1]);
    (speed, v.map(|v| if speed > 0.0 { v / speed } else { 0.0 }))
}

/// Difference of the lengths of two neighbours that counts as rounding, relative. Their piece is then cut
/// in the middle, where the values of the spline are in a table. Larger: the cut is off by as much.
/// Smaller: equal steps with rounded coordinates miss the table, and take more computing time.
const SAME_LENGTH: f64 = 1e-12;

/// Piece of the spline to be fitted by cubics, with its limits and the tolerance of the position.
#[derive(Clone, Copy, Debug)]
struct CubicFit {
    shape: TrigPiece,
    max_velocity: f64,
    max_acceleration: f64,
    tolerance_mm: f64,
}

/// Cubic in local time for a part of a piece of the spline.
#[derive(Clone, Copy, Debug)]
struct Cubic {
    duration_s: f64,
    /// Ascending coefficients of the distance from the start of the piece of the spline, mm/s^order.
    coefficient_mm: [f64; 4],
    /// Error of the position, mm: an upper bound, or, if that exceeds the tolerance, the largest error at the check
    /// points of the stretch.
    error_mm: f64,
    /// True if the velocity and the acceleration of the cubic keep the limits, at its own extrema.
    within_limits: bool,
}

/// Largest number of halvings of a piece. Each divides the error by 16, and the deviation of the
/// acceleration from that of the spline by 4. Larger: a hopeless piece becomes more cubics. Smaller:
/// pieces stay unproven that another halving would prove.
const MAX_HALVINGS: usize = 20;

/// Largest ratio of the error at the check points of a stretch to the tolerance at which a cubic is accepted. The error
/// of Hermite interpolation has one hump, u^2 (1-u)^2, which is at most 2 % higher between two check points. Larger:
/// the error between them can exceed the tolerance. Smaller: more cubics.
const FIT_SAFETY: f64 = 0.95;

impl CubicFit {
    /// Emits the cubics along a stretch, in order; it halves the stretch where one cubic is not enough.
    fn cubics(&self, stretch: Stretch, halvings: usize, emit: &mut impl FnMut(Cubic)) {
        if let Some(cubic) = self.cubic(&stretch, halvings == MAX_HALVINGS) {
            return emit(cubic);
        }
        for half in stretch.halves() {
            self.cubics(half, halvings + 1, emit);
        }
    }

    /// Returns the Hermite cubic along a stretch; `None` if it misses the tolerance or the limits and the stretch can
    /// still be halved.
    fn cubic(&self, stretch: &Stretch, is_last: bool) -> Option<Cubic> {
        let piece = &self.shape;
        let ends = piece.ends(stretch);
        let [v0, v1] = ends.map(|end| 1.0 / end.density_s_per_mm);
        let h = piece.elapsed_s_to(stretch, STRETCH_PLACES);
        let dp = piece.length_mm * (stretch.to - stretch.from);
        let c = coefficients(piece.length_mm * stretch.from, dp, v0, v1, h);
        let most_mm = FIT_SAFETY * self.tolerance_mm;
        // Hermite interpolation: error <= h^4 / 384 max |d^4 s/dt^4|
        let mut error_mm = (h * h).powi(2) / 384.0 * piece.fourth_derivative_bound(ends);
        if error_mm.is_nan() || error_mm > most_mm {
            // The middle first: a cubic that misses the tolerance nearly always misses it there.
            if self.error_mm(stretch, &c, STRETCH_PLACES / 2) > most_mm && !is_last {
                return None;
            }
            let errors = (1..STRETCH_PLACES).map(|k| self.error_mm(stretch, &c, k));
            error_mm = errors.fold(0.0, f64::max);
            if error_mm > most_mm && !is_last {
                return None;
            }
        }
        let (start, end) = accelerations(dp, v0, v1, h);
        let within_limits = start.abs().max(end.abs()) <= self.max_acceleration
            && peak_velocity(dp, v0, v1, h).0 <= self.max_velocity;
        if !within_limits && !is_last {
            return None;
        }
        Some(Cubic { duration_s: h, coefficient_mm: c, error_mm, within_limits })
    }

    /// Returns the distance of the cubic `c` from the spline at the check point `k` of a stretch, mm.
    fn error_mm(&self, stretch: &Stretch, c: &[f64; 4], k: usize) -> f64 {
        let u = self.shape.elapsed_s_to(stretch, k);
        let position_mm = c[0] + u * (c[1] + u * (c[2] + u * c[3]));
        (position_mm - self.shape.length_mm * stretch.part(k)).abs()
    }
}
