//! Dwell-time density as a trigonometric spline of arc length, lifted until the machine can follow.
//!
//! The tool moves along the path at the feedrate `1/D`; the dwell-time density `D` (s/mm) joins the
//! densities `d` of the dwell points by half a period of a cosine. On a piece of length `L` from
//! density `d1` to `d2`, with `x = (s - s1)/L`, `M1 = d2 - d1`, `M2 = d1 + d2`, `e = M1/M2`:
//!
//! ```text
//! D(x) = M2/2 - M1/2 cos(pi x)                                                               (1)
//! t(x) = T (x - e/pi sin(pi x)),    T = L M2/2                      Kepler's equation        (2)
//! a    = -D'/D^3,  |a| <= 4 pi |M1| sqrt(1 - c^2) / (L M2^3 (1 + r c)^3)                     (3)
//!        r = |M1|/M2,  c = (1 - sqrt(1 + 24 r^2)) / (4 r)           exact peak
//! ```
//!
//! The acceleration is zero at every node, so it is continuous along the path.
//!
//! 1. *Densities.* Segment `k` of length `l_k` keeps its dwell time `t_k`: by (2) its time is linear
//!    in the densities of its own dwell point and its two neighbours, a tridiagonal system. (The
//!    source takes `d_k = t_k / l_k`, which smooths the dwell times.) Where the solution falls below
//!    half of that, half of it is held, and the others are solved again.
//! 2. *Repair.* The smallest offset `delta >= 0`, added to every density, with which no feed exceeds
//!    its limit (`delta >= 1/v_max - min d`) and no piece its acceleration, by (3). A constant is
//!    added to the removal density, which is a piston wherever the path goes far enough beyond the
//!    aperture. [`Repair::Local`] raises only the nodes that need it instead.
//! 3. *Corners.* Where the direction changes from `u1` to `u2` the tool leaves the path `b` before
//!    the corner and joins it again at the distance `b` after it on a parabola of constant acceleration, at a density
//!    that the axes can follow:
//!
//! ```text
//! a = v^2 (u2 - u1) / (2 b)     d >= sqrt(|u2 - u1| / (2 b a_max)) per axis     deviation b |u2 - u1| / 4
//! ```
//!
//!    The nodes before and after it are raised as far as the acceleration along the path needs it.
//! 4. *Links.* A pass starts and ends at its feed. The tool, off, runs up to it and brakes after it
//!    on the extended line at constant acceleration; lifts are links within all limits.
//! 5. *Fit.* (2) is inverted and fitted by cubic Hermite polynomials in time, with exact velocities
//!    at their ends, cut until they are within the tolerance of the position and within the limits.
//! 6. *Proof.* Every piece is within the limits by (3) and every cubic of it by its own extrema, or
//!    the smaller density of the piece is raised to the geometric mean of the two, its neighbours as
//!    far as they need it, and after a few rounds all densities by an offset; the report says so.
//!
//! Zero-length segments have no density: their time goes to the neighbours in the pass.
//!
//! Source: the trigonometric-spline scheduler of Opt. Express 32 (2024) 9255, Eqs 3-17. Corrected:
//! its Eq. 5 has the factor 8 L for 4/L and the wrong sign, and Eqs 9-16 follow it; the peak (3)
//! replaces its bound `|M1| pi / (2 L min(d)^3)`. Corners, links and axis limits are ours.
//!
//! | symbol | variable | shape | unit |
//! |---|---|---|---|
//! | s | `arc_length_mm` | (m) | mm |
//! | d | `density` | (m) | s/mm |
//! | L | `length_mm` | - | mm |
//! | delta | `offset_s_per_mm` | - | s/mm |
//! | b | `half_length_mm` | - | mm |

use std::f64::consts::PI;

use planish_numerics::{
    linear::tridiagonal::{self, Row},
    motion::timing_law,
};
use planish_types::{
    DensityNodes, DwellDensity, DwellTime, Invalid, Limits, ToolPath, Trajectory, TrajectoryBuilder,
};
use serde::Serialize;

use crate::{
    ScheduleError, check_lengths,
    link::{End, link},
    pvt::{accelerations, hermite, peak_velocity},
};

/// How densities that the machine cannot follow are repaired.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[cfg_attr(feature = "cli", derive(clap::ValueEnum))]
#[serde(rename_all = "lowercase")]
pub enum Repair {
    /// One offset for all densities.
    Offset,
    /// Only the densities that need it are raised.
    Local,
}

/// How to schedule.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Settings {
    /// How densities that the machine cannot follow are repaired.
    pub repair: Repair,
    /// Largest distance of the motion from a corner, mm; > 0. Default 0.02 mm: a hundredth of the
    /// smallest tools, and 90 degrees at 10 mm/s need no more at 1000 mm/s^2.
    pub corner_deviation_mm: f64,
    /// Largest error of the position where it is fitted by cubics, mm; > 0. Default 1e-6 mm.
    pub fit_tolerance_mm: f64,
}

impl Default for Settings {
    fn default() -> Self {
        Self { repair: Repair::Offset, corner_deviation_mm: 0.02, fit_tolerance_mm: 1e-6 }
    }
}

/// What was done.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Report {
    /// Passes: maximal runs of segments with the tool on.
    pub passes: usize,
    /// Smallest density before the repair, s/mm.
    pub smallest_density_s_per_mm: f64,
    /// Offset that the largest velocity asks for, s/mm.
    pub feed_offset_s_per_mm: f64,
    /// What the largest acceleration asks for in addition, s/mm.
    pub acceleration_offset_s_per_mm: f64,
    /// Time that the offset added, s.
    pub offset_added_s: f64,
    /// Nodes that a local repair raised.
    pub raised_nodes: usize,
    /// Dwell points whose density was held at half of its mean: their neighbours differ too much.
    pub held_densities: usize,
    /// Time that holding them added, s.
    pub held_added_s: f64,
    /// Changes of direction with the tool on, each rounded by a parabola.
    pub corners: usize,
    /// Corners at which the tool moves slower than the dwell times ask for.
    pub slowed_corners: usize,
    /// Time that slowing at corners added, braking and accelerating included, s.
    pub corner_added_s: f64,
    /// Largest distance of the motion from a corner, mm.
    pub largest_corner_deviation_mm: f64,
    /// Links with the tool off: lifts, run-ups and the last brake.
    pub links: usize,
    /// Time of the links, s.
    pub link_s: f64,
    /// Zero-length segments whose time went to their neighbours, in order.
    pub moved_dwell: Vec<usize>,
    /// Segments without length and dwell time, left out.
    pub dropped: Vec<usize>,
    /// Pieces whose motion could not be proven at first, and were evened out; see step 6.
    pub evened_pieces: usize,
    /// Offset of all densities that the proof asked for in the end, s/mm.
    pub proof_offset_s_per_mm: f64,
    /// Largest feedrate over its limit along the path, exact.
    pub feed_use: f64,
    /// Largest acceleration along the path over its limit, exact, by (3).
    pub acceleration_use: f64,
    /// Largest error of the fitted position at 9 points of every cubic, mm.
    pub fit_error_mm: f64,
}

/// The motion, its dwell-time density, and what was done to get them.
#[derive(Clone, Debug)]
pub struct Schedule {
    /// Motion.
    pub trajectory: Trajectory,
    /// Native parameters: the nodes of the spline. `None` when no pass has a length.
    pub density: Option<DwellDensity>,
    /// What was done.
    pub report: Report,
}

/// Part of the limits that the repair leaves free: the fitted cubics, whose acceleration swings
/// about that of the spline, then need no more than a few cuts near its peak.
const MARGIN: f64 = 1e-4;

/// Directions closer than this are the same: it makes a velocity step of 1e-7 mm/s at 100 mm/s.
const SAME_DIRECTION: f64 = 1e-9;

/// Directions are the same only where the tool, keeping to the first to the middle of the second
/// segment, is not farther from that than this, mm: a tenth of what is taken for rounding when a
/// motion is judged.
const SAME_LINE_MM: f64 = 1e-7;

/// A blend takes at most this fraction of the shorter of its two segments.
const LARGEST_BLEND: f64 = 0.25;

/// Bisections of a density: 2^-60 of the interval is its rounding.
const BISECTIONS: usize = 60;

/// Rounds of the proof that even out single pieces: densities that differ by a factor of 1e15
/// differ by 1.15 after them.
const EVENING_ROUNDS: usize = 8;

/// Most rounds of the proof: the others add an offset, which halves all relative differences.
const PROOF_ROUNDS: usize = 16;

/// Schedules `path` with the times `dwell` within `limits`.
pub fn schedule(
    path: &ToolPath,
    dwell: &DwellTime,
    limits: &Limits,
    settings: &Settings,
) -> Result<Schedule, ScheduleError> {
    check_lengths(path, dwell)?;
    for (name, value) in [
        ("corner_deviation_mm", settings.corner_deviation_mm),
        ("fit_tolerance_mm", settings.fit_tolerance_mm),
    ] {
        if !(value.is_finite() && value >= timing_law::LEAST_TOLERANCE_MM) {
            let problem = format!("is {value:?}");
            let least = timing_law::LEAST_TOLERANCE_MM;
            let remedy = format!("a tolerance is positive and finite, at least {least:e} mm");
            return Err(Invalid::whole(name, problem, remedy).into());
        }
    }
    let mut report = Report::default();
    let mut passes: Vec<Pass> = runs_with_tool_on(path)
        .map(|run| Pass::new(path, dwell, limits, settings, run, &mut report))
        .collect();
    report.passes = passes.len();
    let moving = passes.iter().filter(|p| !p.straights.is_empty());
    report.held_added_s =
        moving.map(|p| p.duration_s() - dwell.dwell_s()[p.run.clone()].iter().sum::<f64>()).sum();
    repair(&mut passes, settings.repair, &mut report);
    slow_at_corners(&mut passes, &mut report);
    let mut round = 0;
    let mut motion = loop {
        let mut motion = Motion {
            path,
            dwell,
            limits,
            tolerance_mm: settings.fit_tolerance_mm,
            report: report.clone(),
            unproven: Vec::new(),
            made: TrajectoryBuilder::default(),
            now: End { position_mm: path.point_mm()[0], velocity_mm_per_s: [0.0; 2] },
        };
        motion.walk(&passes);
        let Some(&(pass, node)) = motion.unproven.first() else { break motion };
        if round == PROOF_ROUNDS {
            let straight = &passes[pass].straights[passes[pass].straight_of[node]];
            let problem = "gives a motion that rounding keeps from being proven within the limits";
            let remedy = "raise the dwell times that are orders of magnitude below the others";
            return Err(Invalid::at("dwell_s", straight.index, problem, remedy).into());
        }
        ease(&mut passes, &motion.unproven, round, &mut report);
        round += 1;
    };
    for piece in passes.iter().flat_map(Pass::pieces) {
        let acceleration = piece.shape.peak_acceleration() / piece.max_acceleration;
        motion.report.acceleration_use = motion.report.acceleration_use.max(acceleration);
    }
    for node in passes.iter().flat_map(|p| &p.nodes) {
        motion.report.feed_use = motion.report.feed_use.max(node.fastest / node.density);
    }
    if motion.made.is_empty() {
        return Err(Invalid::whole("dwell_s", "is zero everywhere", "give a dwell time").into());
    }
    if let Some((short_s, time_s)) = motion.made.vanishing_duration_s() {
        let problem = format!(
            "gives a motion with a piece of {short_s:.6e} s, which vanishes in the rounding of its time \
             of {time_s:.6e} s"
        );
        let remedy = "raise the dwell times that are orders of magnitude below the others";
        return Err(Invalid::whole("dwell_s", problem, remedy).into());
    }
    let trajectory = motion.made.build()?;
    Ok(Schedule { trajectory, density: density_of(path, &passes)?, report: motion.report })
}

// ---------------------------------------------------------------------------------------------
// The spline

/// One piece of the spline, (1).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Piece {
    /// Densities at its ends, s/mm; > 0.
    pub density_s_per_mm: [f64; 2],
    /// Length, mm; > 0.
    pub length_mm: f64,
}

impl Piece {
    fn sum(&self) -> f64 {
        self.density_s_per_mm[0] + self.density_s_per_mm[1]
    }

    fn difference(&self) -> f64 {
        self.density_s_per_mm[1] - self.density_s_per_mm[0]
    }

    /// e = M1/M2, in (-1, 1).
    pub fn eccentricity(&self) -> f64 {
        self.difference() / self.sum()
    }

    /// T = L M2/2, s.
    pub fn duration_s(&self) -> f64 {
        0.5 * self.length_mm * self.sum()
    }

    /// (1) at the part `x` of the length, s/mm.
    pub fn density_s_per_mm_at(&self, x: f64) -> f64 {
        // Half-angle form: no density below the smaller of the two by rounding.
        let [d1, d2] = self.density_s_per_mm;
        let (sine, cosine) = ((0.5 * PI * x).sin(), (0.5 * PI * (1.0 - x)).sin());
        d1 * cosine * cosine + d2 * sine * sine
    }

    /// (2): the time between the parts `from` and `to` of the length, s, to rounding of itself: where the
    /// densities of the ends differ by orders of magnitude, a difference of two times of (2) leaves
    /// no digit of a short one.
    pub fn elapsed_s(&self, from: f64, to: f64) -> f64 {
        // The integral of (1) in half-angle form, w = to - from, m the middle; no term is negative:
        //   of sin^2(pi x/2):  (theta - sin theta)/pi + 2/pi sin^2(pi m/2) sin theta,  theta = pi w/2
        //   of cos^2(pi x/2):  the same with 1 - m
        let [d1, d2] = self.density_s_per_mm;
        let theta = 0.5 * PI * (to - from);
        let excess = angle_less_sine(theta);
        let part = |m: f64| (excess + 2.0 * (0.5 * PI * m).sin().powi(2) * theta.sin()) / PI;
        let (m, rest) = (0.5 * (from + to), 0.5 * ((1.0 - from) + (1.0 - to)));
        self.length_mm * (d1 * part(rest) + d2 * part(m))
    }

    /// (2) inverted: the part of the length at the part `m` of the time, by Newton's method kept in
    /// a bracket by bisection.
    pub fn progress(&self, m: f64) -> f64 {
        let e = self.eccentricity();
        let (mut low, mut high) = (0.0, 1.0);
        let mut x = m.clamp(0.0, 1.0);
        for _ in 0..60 {
            // f = x - e/pi sin(pi x) - m,  f' = 1 - e cos(pi x) > 0
            let f = x - e / PI * (PI * x).sin() - m;
            if f.abs() <= f64::EPSILON {
                break;
            }
            if f > 0.0 {
                high = x
            } else {
                low = x
            }
            let next = x - f / (1.0 - e * (PI * x).cos());
            x = if next > low && next < high { next } else { 0.5 * (low + high) };
        }
        x
    }

    /// (3), mm/s^2.
    pub fn peak_acceleration(&self) -> f64 {
        let r = self.eccentricity().abs();
        let [d1, d2] = self.density_s_per_mm;
        // (3) where 1 - r, 1 + r c and 1 + c would cancel: q = 1 - r = 2 min(d)/M2, s^2 = 1 + 24 r^2,
        //   1 + r c = 6 q (1 + r)/(5 + s),    1 - |c| = 2 q/(1 + s + 4 r)
        let q = 2.0 * d1.min(d2) / self.sum();
        let s = (1.0 + 24.0 * r * r).sqrt();
        let below_one = 2.0 * q / (1.0 + s + 4.0 * r);
        let slowest = self.sum() * (6.0 * q * (1.0 + r) / (5.0 + s));
        // 1 - c^2 = (1 - |c|) (1 + |c|); M2^3 (1 + r c)^3 by factors, which neither under- nor overflow
        let sine = (below_one * (2.0 - below_one)).sqrt();
        4.0 * PI * r * sine * (self.sum() / slowest) / (self.length_mm * slowest * slowest)
    }

    fn raised(&self, by: [f64; 2]) -> Self {
        let [d1, d2] = self.density_s_per_mm;
        Self { density_s_per_mm: [d1 + by[0], d2 + by[1]], ..*self }
    }
}

/// x - sin x for 0 <= x <= pi/2 to rounding of itself.
fn angle_less_sine(x: f64) -> f64 {
    if x > 0.5 {
        return x - x.sin();
    }
    // x^3/3! - x^5/5! + ...; 0.5^18/19! is below rounding.
    let x2 = x * x;
    let (mut term, mut sum) = (x * x2 / 6.0, 0.0);
    for k in 1..=8 {
        sum += term;
        term *= -x2 / f64::from((2 * k + 2) * (2 * k + 3));
    }
    sum
}

/// A piece with what the machine allows along it.
#[derive(Clone, Copy, Debug)]
struct Limited {
    shape: Piece,
    /// Along the path, mm/s^2; the margin is taken off.
    max_acceleration: f64,
}

impl Limited {
    fn is_too_fast(&self, by: [f64; 2]) -> bool {
        self.shape.raised(by).peak_acceleration() > self.max_acceleration
    }

    /// The smallest offset >= `offset` that keeps the acceleration. Raising both densities by the
    /// same amount leaves D' and raises D: |D'|/D^3 falls.
    fn offset(&self, offset: f64) -> f64 {
        if !self.is_too_fast([offset; 2]) {
            return offset;
        }
        // min(d) + delta >= (pi |M1| / (2 L a))^(1/3) is sufficient: |D'| <= pi |M1| / (2 L).
        let slope = 0.5 * PI * self.shape.difference().abs() / self.shape.length_mm;
        let bound = (slope / self.max_acceleration).cbrt();
        bisect(offset, offset.max(bound), |by| !self.is_too_fast([by; 2]))
    }

    /// How much the smaller density at the end `which` must grow at least. It lowers |D'| and
    /// raises D everywhere; at equal densities there is no acceleration.
    fn raise(&self, which: usize) -> f64 {
        let by = |amount: f64| if which == 0 { [amount, 0.0] } else { [0.0, amount] };
        let all = self.shape.difference().abs();
        if !self.is_too_fast([0.0; 2]) {
            return 0.0;
        }
        bisect(0.0, all, |amount| !self.is_too_fast(by(amount)))
    }
}

/// The smallest value in (low, high] that is `good`; `high` is, and everything above a good value.
fn bisect(mut low: f64, mut high: f64, good: impl Fn(f64) -> bool) -> f64 {
    for _ in 0..BISECTIONS {
        let middle = 0.5 * (low + high);
        if good(middle) { high = middle } else { low = middle }
    }
    high
}

// ---------------------------------------------------------------------------------------------
// Passes

/// A blend at the end of a segment.
#[derive(Clone, Copy, Debug)]
struct Corner {
    /// b.
    half_length_mm: f64,
    /// u2 - u1.
    turn: [f64; 2],
}

/// A dwell point or a corner.
#[derive(Clone, Copy, Debug)]
struct Node {
    density: f64,
    /// Smallest density that its velocity, and the acceleration of a corner, allow.
    least: f64,
    /// Smallest density that the velocity alone allows, without the margin.
    fastest: f64,
    /// Length on which the density is constant before and after it; b of a corner, else 0.
    half_length_mm: f64,
}

/// A straight segment of a pass.
#[derive(Clone, Copy, Debug)]
struct Straight {
    /// Index in the path.
    index: usize,
    start: [f64; 2],
    direction: [f64; 2],
    length: f64,
    /// Of the whole path up to here, mm.
    arc_length: f64,
    /// Along its direction, mm/s^2; the margin is taken off.
    max_acceleration: f64,
    /// Corner at its end.
    corner: Option<Corner>,
}

/// A run of segments with the tool on.
#[derive(Clone, Debug)]
struct Pass {
    /// Segments [first, end) of the path.
    run: std::ops::Range<usize>,
    /// Where it starts.
    start_mm: [f64; 2],
    /// Those with a length; none when the tool stands.
    straights: Vec<Straight>,
    /// Dwell points, and the corners between them.
    nodes: Vec<Node>,
    /// For each node the straight it is the middle of, or at the end of.
    straight_of: Vec<usize>,
}

/// Maximal runs of segments with the tool on.
fn runs_with_tool_on(path: &ToolPath) -> impl Iterator<Item = std::ops::Range<usize>> + '_ {
    let on = path.tool_on();
    let mut next = 0;
    std::iter::from_fn(move || {
        let first = (next..on.len()).find(|i| on[*i])?;
        let after = (first..on.len()).find(|i| !on[*i]).unwrap_or(on.len());
        next = after;
        Some(first..after)
    })
}

/// Largest magnitude along `direction` that keeps `max` on both axes.
fn along(direction: [f64; 2], max: [f64; 2]) -> f64 {
    let axis = |a: usize| max[a] / direction[a].abs(); // infinite across
    axis(0).min(axis(1))
}

impl Pass {
    fn new(
        path: &ToolPath,
        dwell: &DwellTime,
        limits: &Limits,
        settings: &Settings,
        run: std::ops::Range<usize>,
        report: &mut Report,
    ) -> Self {
        let (v_max, a_max) = (limits.max_velocity_mm_per_s(), limits.max_acceleration_mm_per_s2());
        let mut arc_length: f64 = (0..run.start).map(|i| path.segment_length_mm(i)).sum();
        let mut straights: Vec<Straight> = Vec::new();
        for index in run.clone() {
            let length = path.segment_length_mm(index);
            if length > 0.0 {
                let direction = path.displacement_mm(index).map(|d| d / length);
                straights.push(Straight {
                    index,
                    start: path.point_mm()[index],
                    direction,
                    length,
                    arc_length,
                    max_acceleration: (1.0 - MARGIN) * along(direction, a_max),
                    corner: None,
                });
            }
            arc_length += length;
        }
        for k in 1..straights.len() {
            let (before, after) = (straights[k - 1], straights[k]);
            let turn = [0, 1].map(|a| after.direction[a] - before.direction[a]);
            let size = turn[0].hypot(turn[1]);
            let aside_mm = 0.5 * size * before.length.max(after.length);
            if size > SAME_DIRECTION || aside_mm > SAME_LINE_MM {
                // deviation = b |u2 - u1| / 4
                let half_length_mm = (4.0 * settings.corner_deviation_mm / size)
                    .min(LARGEST_BLEND * before.length.min(after.length));
                straights[k - 1].corner = Some(Corner { half_length_mm, turn });
                report.corners += 1;
                let deviation = 0.25 * half_length_mm * size;
                report.largest_corner_deviation_mm =
                    report.largest_corner_deviation_mm.max(deviation);
            }
        }
        let start_mm = path.point_mm()[run.start];
        let mut pass =
            Self { run, start_mm, straights, nodes: Vec::new(), straight_of: Vec::new() };
        if pass.straights.is_empty() {
            return pass;
        }
        let times = pass.times(dwell, report);
        let densities = pass.densities(&times, report);
        for (k, s) in pass.straights.iter().enumerate() {
            let fastest = 1.0 / along(s.direction, v_max);
            let least = fastest / (1.0 - MARGIN);
            let density = densities[k];
            pass.nodes.push(Node { density, least, fastest, half_length_mm: 0.0 });
            pass.straight_of.push(k);
            let Some(corner) = s.corner else { continue };
            let next = &pass.straights[k + 1];
            let fastest = fastest.max(1.0 / along(next.direction, v_max));
            let b = corner.half_length_mm;
            // a = v^2 (u2 - u1) / (2 b)
            let bend =
                |a: usize| (corner.turn[a].abs() / (2.0 * b * (1.0 - MARGIN) * a_max[a])).sqrt();
            let least = (fastest / (1.0 - MARGIN)).max(bend(0)).max(bend(1));
            let weights = corner_weights(s.length, next.length);
            let density = weights[0] * density + weights[1] * densities[k + 1];
            pass.nodes.push(Node { density, least, fastest, half_length_mm: b });
            pass.straight_of.push(k);
        }
        pass
    }

    /// Dwell time of every straight; a segment without length gives its time to the straights
    /// before and after it.
    fn times(&self, dwell: &DwellTime, report: &mut Report) -> Vec<f64> {
        let mut times: Vec<f64> = self.straights.iter().map(|s| dwell.dwell_s()[s.index]).collect();
        let has_length = |i: &usize| self.straights.binary_search_by_key(i, |s| s.index).is_ok();
        for i in self.run.clone().filter(|i| !has_length(i)) {
            let t = dwell.dwell_s()[i];
            if t == 0.0 {
                report.dropped.push(i);
                continue;
            }
            let after = self.straights.partition_point(|s| s.index < i);
            let takers = after.saturating_sub(1)..(after + 1).min(times.len());
            let part = t / takers.len() as f64;
            times[takers].iter_mut().for_each(|time| *time += part);
            report.moved_dwell.push(i);
        }
        times
    }

    /// Densities of the dwell points that give every straight its time: row k holds the time that
    /// a density of 1 at the dwell points k-1, k, k+1 gives straight k.
    fn densities(&self, times: &[f64], report: &mut Report) -> Vec<f64> {
        let n = self.straights.len();
        let mut rows = vec![[0.0; 3]; n];
        for k in 0..n {
            rows[k][1] += match (k == 0, k + 1 == n) {
                (true, true) => self.straights[k].length,
                (true, false) | (false, true) => 0.5 * self.straights[k].length,
                (false, false) => 0.0,
            };
        }
        for k in 0..n - 1 {
            let (s, next) = (&self.straights[k], &self.straights[k + 1]);
            let [before, after] = match s.corner {
                Some(corner) => {
                    // Dwell point, cosine to the corner, plateau b | b, cosine, dwell point:
                    // (l/2 - b) (d + d_c)/2 + b d_c
                    let weights = corner_weights(s.length, next.length);
                    let half = |length: f64, own: usize| {
                        let rest = 0.5 * length - corner.half_length_mm;
                        let at_corner = 0.5 * rest + corner.half_length_mm;
                        let mut weight = weights.map(|w| w * at_corner);
                        weight[own] += 0.5 * rest;
                        weight
                    };
                    [half(s.length, 0), half(next.length, 1)]
                }
                None => {
                    // Cut at x = l/2 / L: integral of (1) to x, L (M2 x/2 - M1/(2 pi) sin(pi x))
                    let length = 0.5 * (s.length + next.length);
                    let x = 0.5 * s.length / length;
                    let swing = (PI * x).sin() / PI;
                    let first = [0.5 * length * (x + swing), 0.5 * length * (x - swing)];
                    [first, [0.5 * length - first[0], 0.5 * length - first[1]]]
                }
            };
            rows[k][1] += before[0];
            rows[k][2] += before[1];
            rows[k + 1][0] += after[0];
            rows[k + 1][1] += after[1];
        }
        // A density that falls too low is held, and its row given up; the others stay exact.
        let least: Vec<f64> = (0..n).map(|k| 0.5 * times[k] / self.straights[k].length).collect();
        let mut held = vec![false; n];
        loop {
            // Every row is diagonally dominant, at least weakly.
            let d = tridiagonal::solve(n, |k| match held[k] {
                true => Row::held(least[k]),
                false => Row { elements: rows[k], right: times[k] },
            });
            let low: Vec<usize> =
                (0..n).filter(|k| !held[*k] && (d[*k].is_nan() || d[*k] < least[*k])).collect();
            if low.is_empty() {
                report.held_densities += held.iter().filter(|h| **h).count();
                return d;
            }
            low.into_iter().for_each(|k| held[k] = true);
        }
    }

    /// The piece from node k to the next one.
    fn piece(&self, k: usize) -> Limited {
        let (a, b) = (&self.nodes[k], &self.nodes[k + 1]);
        let (from, to) = (self.arc_length(k), self.arc_length(k + 1));
        let length_mm = to - b.half_length_mm - (from + a.half_length_mm);
        let straight = &self.straights[self.straight_of[k]];
        // After a corner the direction is that of the next straight.
        let straight = if a.half_length_mm > 0.0 {
            &self.straights[self.straight_of[k] + 1]
        } else {
            straight
        };
        Limited {
            shape: Piece { density_s_per_mm: [a.density, b.density], length_mm },
            max_acceleration: straight.max_acceleration,
        }
    }

    fn pieces(&self) -> impl Iterator<Item = Limited> + '_ {
        (1..self.nodes.len()).map(|k| self.piece(k - 1))
    }

    /// Arc length of node k from the start of the pass; that of a corner is its middle.
    fn arc_length(&self, k: usize) -> f64 {
        let s = &self.straights[self.straight_of[k]];
        let part = if self.nodes[k].half_length_mm > 0.0 { s.length } else { 0.5 * s.length };
        s.arc_length - self.straights[0].arc_length + part
    }

    fn standing(&self) -> End {
        End { position_mm: self.start_mm, velocity_mm_per_s: [0.0; 2] }
    }

    fn start(&self) -> End {
        let s = self.straights.first().zip(self.nodes.first());
        s.map_or_else(
            || self.standing(),
            |(s, n)| End {
                position_mm: s.start,
                velocity_mm_per_s: s.direction.map(|u| u / n.density),
            },
        )
    }

    fn end(&self) -> End {
        let s = self.straights.last().zip(self.nodes.last());
        s.map_or_else(
            || self.standing(),
            |(s, n)| End {
                position_mm: [0, 1].map(|a| s.start[a] + s.direction[a] * s.length),
                velocity_mm_per_s: s.direction.map(|u| u / n.density),
            },
        )
    }

    /// Time of the pass, s.
    fn duration_s(&self) -> f64 {
        let (Some(first), Some(last)) = (self.nodes.first(), self.nodes.last()) else { return 0.0 };
        let half = |s: &Straight| 0.5 * s.length;
        let plateaus: f64 = self.nodes.iter().map(|n| 2.0 * n.half_length_mm * n.density).sum();
        half(&self.straights[0]) * first.density
            + half(&self.straights[self.straights.len() - 1]) * last.density
            + plateaus
            + self.pieces().map(|p| p.shape.duration_s()).sum::<f64>()
    }
}

/// Weights of the dwell points before and after it in the density of a corner: the nearer has more.
fn corner_weights(before: f64, after: f64) -> [f64; 2] {
    [after / (before + after), before / (before + after)]
}

// ---------------------------------------------------------------------------------------------
// Repair

/// Step 2; O(N): the offset grows piece by piece, and no piece is visited twice.
fn repair(passes: &mut [Pass], how: Repair, report: &mut Report) {
    let before: f64 = passes.iter().map(Pass::duration_s).sum();
    let all = || passes.iter().flat_map(|p| &p.nodes).filter(|n| n.half_length_mm == 0.0);
    let smallest = all().map(|n| n.density).fold(f64::INFINITY, f64::min);
    report.smallest_density_s_per_mm = if smallest.is_finite() { smallest } else { 0.0 };
    match how {
        Repair::Offset => {
            // delta >= 1/v_max - min d
            let feed = all().map(|n| n.least - n.density).fold(0.0, f64::max);
            let pieces = passes.iter().flat_map(Pass::pieces);
            let offset = pieces.fold(feed, |offset, piece| piece.offset(offset));
            report.feed_offset_s_per_mm = feed;
            report.acceleration_offset_s_per_mm = offset - feed;
            let nodes = passes.iter_mut().flat_map(|p| &mut p.nodes);
            nodes.for_each(|n| n.density += offset);
        }
        Repair::Local => {
            for pass in passes.iter_mut() {
                for n in pass.nodes.iter_mut().filter(|n| n.density < n.least) {
                    n.density = n.least;
                    report.raised_nodes += 1;
                }
                report.raised_nodes += sweep(pass);
            }
        }
    }
    report.offset_added_s = passes.iter().map(Pass::duration_s).sum::<f64>() - before;
}

/// Step 3.
fn slow_at_corners(passes: &mut [Pass], report: &mut Report) {
    let before: f64 = passes.iter().map(Pass::duration_s).sum();
    for pass in passes.iter_mut() {
        for n in pass.nodes.iter_mut().filter(|n| n.density < n.least) {
            n.density = n.least;
            report.slowed_corners += 1;
        }
        sweep(pass);
    }
    report.corner_added_s = passes.iter().map(Pass::duration_s).sum::<f64>() - before;
}

/// Raises the smaller density of every piece until its acceleration is kept, along the path and
/// back; returns how many nodes were raised. Raising the smaller end of a piece keeps a piece that
/// was kept, so one sweep each way is enough.
fn sweep(pass: &mut Pass) -> usize {
    let n = pass.nodes.len();
    let mut raised = 0;
    let forth = (1..n).map(|k| (k - 1, 1));
    let back = (1..n).rev().map(|k| (k - 1, 0));
    for (k, which) in forth.chain(back) {
        let piece = pass.piece(k);
        let [d1, d2] = piece.shape.density_s_per_mm;
        if (which == 1) == (d2 < d1) {
            let by = piece.raise(which);
            raised += usize::from(by > 0.0);
            pass.nodes[k + which].density += by;
        }
    }
    raised
}

/// Step 6: less of what could not be proven, the pieces (pass, first node).
fn ease(passes: &mut [Pass], unproven: &[(usize, usize)], round: usize, report: &mut Report) {
    let before: f64 = passes.iter().map(Pass::duration_s).sum();
    if round < EVENING_ROUNDS {
        report.evened_pieces += unproven.len();
        for &(p, k) in unproven {
            let [a, b] = [0, 1].map(|end| passes[p].nodes[k + end].density);
            let smaller = if a < b { k } else { k + 1 };
            let node = &mut passes[p].nodes[smaller];
            node.density = node.density.max(a.sqrt() * b.sqrt());
        }
        // Nodes are raised only, so that every limit that they kept is kept; what that does to the
        // pieces beside them is swept.
        passes.iter_mut().for_each(|pass| {
            sweep(pass);
        });
    } else {
        let densities = passes.iter().flat_map(|p| &p.nodes).map(|n| n.density);
        let offset = densities.fold(0.0, f64::max);
        report.proof_offset_s_per_mm += offset;
        passes.iter_mut().flat_map(|p| &mut p.nodes).for_each(|n| n.density += offset);
    }
    report.offset_added_s += passes.iter().map(Pass::duration_s).sum::<f64>() - before;
}

// ---------------------------------------------------------------------------------------------
// Motion

/// The trajectory so far.
struct Motion<'a> {
    path: &'a ToolPath,
    dwell: &'a DwellTime,
    limits: &'a Limits,
    tolerance_mm: f64,
    report: Report,
    /// Pieces that are not proven: number of the pass, first node.
    unproven: Vec<(usize, usize)>,
    /// The segments so far.
    made: TrajectoryBuilder,
    /// Where the motion is, and how fast.
    now: End,
}

impl Motion<'_> {
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
        let rest = |p: [f64; 2]| End { position_mm: p, velocity_mm_per_s: [0.0; 2] };
        if next < self.path.len() {
            self.lift(next..self.path.len(), rest(self.path.point_mm()[self.path.len()]));
        } else {
            self.brake();
        }
    }

    /// From rest to the start of the first pass, along its extension backwards.
    fn run_up(&mut self, start: End) {
        let (speed, direction) = polar(start.velocity_mm_per_s);
        if speed > 0.0 {
            let a = self.acceleration_along(direction);
            let (t, distance) = (speed / a, 0.5 * speed * speed / a);
            let c = [0, 1].map(|x| {
                let u = direction[x];
                [start.position_mm[x] - u * distance, 0.0, 0.5 * u * a, 0.0]
            });
            self.link(t, c, None);
        }
        self.now = start;
    }

    /// To rest after the end of the last pass.
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
        (1.0 - MARGIN) * along(direction, self.limits.max_acceleration_mm_per_s2())
    }

    /// Segments with the tool off: a link each, at rest in between.
    fn lift(&mut self, run: std::ops::Range<usize>, end: End) {
        for i in run.clone() {
            let rest =
                End { position_mm: self.path.point_mm()[i + 1], velocity_mm_per_s: [0.0; 2] };
            let to = if i + 1 == run.end { end } else { rest };
            match link(self.now, to, self.limits, self.dwell.dwell_s()[i]) {
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
        let (first_straight, last_straight) = (&pass.straights[0], pass.straights.len() - 1);
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

    /// Constant density from `from` to `to` along a straight.
    fn plateau(&mut self, s: &Straight, from: f64, to: f64, density: f64) {
        let c = [0, 1]
            .map(|a| [s.start[a] + s.direction[a] * from, s.direction[a] / density, 0.0, 0.0]);
        self.made.push((to - from) * density, c, true, Some(s.index));
    }

    /// The parabola at corner node k, in two halves.
    fn blend(&mut self, pass: &Pass, k: usize) {
        let (node, s) = (&pass.nodes[k], &pass.straights[pass.straight_of[k]]);
        let next = &pass.straights[pass.straight_of[k] + 1];
        let (b, v) = (node.half_length_mm, 1.0 / node.density);
        let half_s = b * node.density;
        // p(u) = corner - b u1 + v u1 u + (u2 - u1) v^2/(4 b) u^2
        let c = [0, 1].map(|a| {
            let (u1, u2) = (s.direction[a], next.direction[a]);
            [next.start[a] - b * u1, v * u1, (u2 - u1) * v * v / (4.0 * b), 0.0]
        });
        let middle = c.map(|c| {
            [c[0] + half_s * (c[1] + half_s * c[2]), c[1] + 2.0 * c[2] * half_s, c[2], 0.0]
        });
        self.made.push(half_s, c, true, Some(s.index));
        self.made.push(half_s, middle, true, Some(next.index));
    }

    /// Step 5 for the piece from node k to the next one; whether it is proven within the limits.
    fn piece(&mut self, pass: &Pass, k: usize) -> bool {
        let (a, b) = (&pass.nodes[k], &pass.nodes[k + 1]);
        let own = &pass.straights[pass.straight_of[k]];
        // Where the piece starts and along what; a piece between two dwell points is cut where the
        // first segment ends.
        let next = pass.straights.get(pass.straight_of[k] + 1);
        let (straight, offset) = match next {
            Some(next) if a.half_length_mm > 0.0 => (next, a.half_length_mm),
            _ => (own, 0.5 * own.length),
        };
        let limited = pass.piece(k);
        let fit = Fit {
            shape: limited.shape,
            // A corner's is that of two directions.
            max_velocity: 1.0 / if a.half_length_mm > 0.0 { b.fastest } else { a.fastest },
            max_acceleration: limited.max_acceleration / (1.0 - MARGIN),
            tolerance_mm: self.tolerance_mm,
        };
        let parts = match next {
            Some(next) if a.half_length_mm == 0.0 && b.half_length_mm == 0.0 => {
                let cut = 0.5 * own.length / fit.shape.length_mm;
                vec![(0.0, cut, own.index), (cut, 1.0, next.index)]
            }
            _ => vec![(0.0, 1.0, straight.index)],
        };
        let mut proven = !limited.is_too_fast([0.0; 2]);
        for (from, to, index) in parts {
            for cubic in fit.cubics(from, to) {
                proven &= cubic.within_limits;
                let error_mm = &mut self.report.fit_error_mm;
                *error_mm = error_mm.max(cubic.error_mm);
                let c = [0, 1].map(|x| {
                    let u = straight.direction[x];
                    let [c0, c1, c2, c3] = cubic.coefficient_mm;
                    [straight.start[x] + u * (offset + c0), u * c1, u * c2, u * c3]
                });
                self.made.push(cubic.duration_s, c, true, Some(index));
            }
        }
        proven
    }
}

/// Magnitude and direction.
fn polar(v: [f64; 2]) -> (f64, [f64; 2]) {
    let speed = v[0].hypot(v[1]);
    (speed, v.map(|v| if speed > 0.0 { v / speed } else { 0.0 }))
}

/// How a piece is fitted.
#[derive(Clone, Copy, Debug)]
struct Fit {
    shape: Piece,
    max_velocity: f64,
    max_acceleration: f64,
    tolerance_mm: f64,
}

/// A cubic in local time for a part of a piece.
#[derive(Clone, Copy, Debug)]
struct Cubic {
    duration_s: f64,
    /// Distance from the start of the piece.
    coefficient_mm: [f64; 4],
    error_mm: f64,
    /// The largest velocity and acceleration of the cubic, at its own extrema.
    within_limits: bool,
}

/// Most halvings of a piece: the error falls by 16 with each, the swing of the acceleration by 4.
const MAX_HALVINGS: usize = 20;

/// Inner points at which the error is looked at; that of Hermite interpolation has one hump.
const FIT_POINTS: usize = 9;

/// Part of the tolerance that the error at these points may take: between two of them the hump
/// u^2 (1-u)^2 is higher by 2 % at most.
const FIT_SAFETY: f64 = 0.95;

impl Fit {
    /// Cubics from the part `from` to the part `to` of the length.
    fn cubics(&self, from: f64, to: f64) -> Vec<Cubic> {
        let (mut done, mut open) = (Vec::new(), vec![(from, to, 0)]);
        while let Some((from, to, halvings)) = open.pop() {
            let cubic = self.cubic(from, to);
            let good = cubic.within_limits && cubic.error_mm <= FIT_SAFETY * self.tolerance_mm;
            if good || halvings == MAX_HALVINGS {
                done.push(cubic);
            } else {
                let middle = 0.5 * (from + to);
                open.push((middle, to, halvings + 1));
                open.push((from, middle, halvings + 1));
            }
        }
        done
    }

    /// The Hermite cubic between the two parts of the length.
    fn cubic(&self, from: f64, to: f64) -> Cubic {
        let piece = &self.shape;
        let [v0, v1] = [from, to].map(|x| 1.0 / piece.density_s_per_mm_at(x));
        let h = piece.elapsed_s(from, to);
        let dp = piece.length_mm * (to - from);
        let c = hermite(piece.length_mm * from, dp, v0, v1, h);
        let error_mm = (1..=FIT_POINTS)
            .map(|i| {
                let x = from + (to - from) * i as f64 / (FIT_POINTS + 1) as f64;
                let u = piece.elapsed_s(from, x);
                (c[0] + u * (c[1] + u * (c[2] + u * c[3])) - piece.length_mm * x).abs()
            })
            .fold(0.0, f64::max);
        let (start, end) = accelerations(dp, v0, v1, h);
        let within_limits = start.abs().max(end.abs()) <= self.max_acceleration
            && peak_velocity(dp, v0, v1, h).0 <= self.max_velocity;
        Cubic { duration_s: h, coefficient_mm: c, error_mm, within_limits }
    }
}

/// Nodes of all passes that have a length: start, dwell points, three for every corner, end.
fn density_of(path: &ToolPath, passes: &[Pass]) -> Result<Option<DwellDensity>, Invalid> {
    let mut nodes = DensityNodes::default();
    for (number, pass) in passes.iter().filter(|p| !p.straights.is_empty()).enumerate() {
        let mut push = |straight: &Straight, along: f64, density: f64, is_corner: bool| {
            let at = [0, 1].map(|a| straight.start[a] + straight.direction[a] * along);
            nodes.arc_length_mm.push(straight.arc_length + along);
            nodes.dwell_density_s_per_mm.push(density);
            nodes.point_mm.push(at);
            nodes.pass_idx.push(number as i64);
            nodes.corner.push(is_corner);
        };
        let (first, last) = (&pass.straights[0], &pass.straights[pass.straights.len() - 1]);
        push(first, 0.0, pass.nodes[0].density, false);
        for (node, k) in pass.nodes.iter().zip(&pass.straight_of) {
            let (straight, b) = (&pass.straights[*k], node.half_length_mm);
            if b == 0.0 {
                push(straight, 0.5 * straight.length, node.density, false);
            } else {
                push(straight, straight.length - b, node.density, false);
                push(straight, straight.length, node.density, true);
                push(&pass.straights[*k + 1], b, node.density, false);
            }
        }
        push(last, last.length, pass.nodes[pass.nodes.len() - 1].density, false);
    }
    debug_assert!(nodes.arc_length_mm.len() <= 6 * path.len());
    if nodes.arc_length_mm.is_empty() { Ok(None) } else { DwellDensity::new(nodes).map(Some) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use planish_types::{MachineFile, MachineFileAxis};

    fn machine(v: [f64; 2], a: [f64; 2]) -> Limits {
        let axis = |i: usize| MachineFileAxis {
            name: ["x", "y"][i].into(),
            max_velocity_mm_per_s: v[i],
            max_acceleration_mm_per_s2: a[i],
            max_jerk_mm_per_s3: None,
        };
        MachineFile { name: "m".into(), axes: vec![axis(0), axis(1)], min_segment_s: 0.0 }
            .checked()
            .unwrap()
    }

    fn piece(d1: f64, d2: f64, length_mm: f64) -> Piece {
        Piece { density_s_per_mm: [d1, d2], length_mm }
    }

    #[test]
    fn the_peak_of_the_acceleration_is_exact() {
        let p = piece(0.02, 0.05, 0.2);
        assert!((p.peak_acceleration() - 11_658.766).abs() < 5e-4, "{}", p.peak_acceleration());
        // a = d(1/D)/dt = -D'/D^3 from differences of (1); the largest of 1e5 samples.
        let (n, step) = (100_000, 1e-6);
        let v = |x: f64| 1.0 / p.density_s_per_mm_at(x);
        let largest = (1..n)
            .map(|i| {
                let x = f64::from(i) / f64::from(n);
                // a = v dv/ds
                v(x) * (v(x + step) - v(x - step)) / (2.0 * step * p.length_mm)
            })
            .fold(0.0, |m: f64, a| m.max(a.abs()));
        assert!((largest / p.peak_acceleration() - 1.0).abs() < 1e-7, "{largest}");
        assert_eq!(piece(0.3, 0.3, 1.0).peak_acceleration(), 0.0);
        // The same backwards; (3) depends on |M1|.
        assert_eq!(piece(0.05, 0.02, 0.2).peak_acceleration(), p.peak_acceleration());
    }

    #[test]
    fn time_is_the_integral_of_the_density_and_is_inverted() {
        // Kepler's equation at M/pi = 0.3.
        assert!((piece(0.02, 0.05, 0.2).eccentricity() - 3.0 / 7.0).abs() < 1e-15);
        assert!((piece(0.02, 0.05, 0.2).progress(0.3) - 0.433_447_626_1).abs() < 1e-10);
        assert!((piece(0.3, 0.1, 1.0).progress(0.3) - 0.204_600_118_2).abs() < 1e-10);
        for (d1, d2) in [(1.0, 1.0), (1.0, 3.0), (5.0, 1e-3), (1e-3, 1.999), (1.999, 1e-3)] {
            let p = piece(d1, d2, 0.7);
            let n = 1000;
            // Simpson's rule, exact to rounding for a cosine at this step.
            let mut t = 0.0;
            for i in 0..n {
                let x = |k: f64| (f64::from(i) + k) / f64::from(n);
                let d = |k: f64| p.density_s_per_mm_at(x(k));
                t += 0.7 / f64::from(n) * (d(0.0) + 4.0 * d(0.5) + d(1.0)) / 6.0;
                assert!(
                    (t - p.elapsed_s(0.0, x(1.0))).abs() < 1e-12 * p.duration_s(),
                    "{d1} {d2} {i}"
                );
                // The residual of the equation; its inverse may be ill-conditioned.
                let m = p.progress(x(1.0));
                let found = p.elapsed_s(0.0, m) / p.duration_s();
                assert!((found - x(1.0)).abs() < 1e-15, "{d1} {d2}: {found} {}", x(1.0));
            }
        }
    }

    #[test]
    fn the_repair_is_the_smallest_and_idempotent() {
        let p = Limited { shape: piece(0.02, 0.05, 0.2), max_acceleration: 2000.0 };
        let offset = p.offset(0.0);
        // The bound of the source with its corrected coefficient: min(d) >= 0.0490223.
        assert!(offset > 0.0 && offset <= 0.049_022_3 - 0.02, "{offset}");
        let peak = |by: f64| p.shape.raised([by; 2]).peak_acceleration();
        assert!(peak(offset) <= 2000.0 && peak(offset - 1e-12) > 2000.0);
        let repaired = Limited { shape: p.shape.raised([offset; 2]), ..p };
        assert_eq!(repaired.offset(0.0), 0.0);
        let raise = p.raise(0);
        assert!(p.shape.raised([raise, 0.0]).peak_acceleration() <= 2000.0);
        assert!(p.shape.raised([raise - 1e-12, 0.0]).peak_acceleration() > 2000.0);
    }

    #[test]
    fn short_times_and_small_densities_keep_their_digits() {
        // Densities 1e9 apart: near the small one D = d1 + d2 sin^2(pi x/2), and over a part w of
        // the length the time is L (d1 w + d2 pi^2 w^3/12) to w^2.
        let (d1, d2) = (1e-3, 1e6);
        let w = 2.0_f64.powi(-20);
        let expected = 3.0 * (d1 * w + d2 * PI * PI * w.powi(3) / 12.0);
        let there = piece(d1, d2, 3.0).elapsed_s(0.0, w);
        // The next term, (pi w/2)^2/5 of the last one, is 1e-12 of the whole.
        assert!((there / expected - 1.0).abs() < 1e-11, "{there} {expected}");
        assert_eq!(piece(d2, d1, 3.0).elapsed_s(1.0 - w, 1.0), there);
        // The parts of a part, from both ends of the cancellation in `angle_less_sine`.
        for (from, to) in [(0.0, 0.25), (0.1, 0.9), (0.3, 0.31), (0.25, 1.0)] {
            let p = piece(d1, d2, 3.0);
            let parts = p.elapsed_s(from, 0.5 * (from + to)) + p.elapsed_s(0.5 * (from + to), to);
            assert!((p.elapsed_s(from, to) / parts - 1.0).abs() < 1e-14, "{from} {to}");
        }
        // (3) for d1/d2 -> 0 at x = pi X/2 sqrt(d2/d1): D = d1 (1 + x^2), a ~ x/(1 + x^2)^3 is
        // largest at x^2 = 1/5: a = pi sqrt(d2/d1) sqrt(1/5) (5/6)^3 / (L d1^2).
        let a = PI * (d2 / d1).sqrt() * 0.2_f64.sqrt() * (5.0_f64 / 6.0).powi(3) / (3.0 * d1 * d1);
        let peak = piece(d1, d2, 3.0).peak_acceleration();
        // To the order d1/d2.
        assert!((peak / a - 1.0).abs() < 1e-8, "{peak} {a}");
    }

    #[test]
    fn what_cannot_be_proven_is_evened_out_and_nothing_is_lowered() {
        let points: Vec<[f64; 2]> =
            (0..=30).map(|i| [f64::from(i / 3), 0.5 * f64::from(i % 2)]).collect();
        let path = ToolPath::through(points, vec![true; 30], vec![0; 30]).unwrap();
        let t = (0..30).map(|i| [1e-3, 2.0, 0.1][i % 3]).collect();
        let limits = machine([50.0; 2], [300.0, 200.0]);
        let mut report = Report::default();
        let settings = Settings::default();
        let dwell = DwellTime::new(t).unwrap();
        let mut passes = vec![Pass::new(&path, &dwell, &limits, &settings, 0..30, &mut report)];
        repair(&mut passes, Repair::Local, &mut report);
        slow_at_corners(&mut passes, &mut report);
        let time_s = passes[0].duration_s();
        let added_s = report.offset_added_s;
        let unproven = [(0, 4), (0, 17), (0, 40)];
        let ratio = |pass: &Pass, k: usize| {
            let [a, b] = [k, k + 1].map(|k| pass.nodes[k].density);
            (a / b).ln().abs()
        };
        assert!(unproven.iter().any(|(_, k)| ratio(&passes[0], *k) > 0.1));
        for round in 0..PROOF_ROUNDS {
            let before = passes[0].clone();
            ease(&mut passes, &unproven, round, &mut report);
            for (a, b) in before.nodes.iter().zip(&passes[0].nodes) {
                assert!(b.density >= a.density && b.density >= b.least);
            }
            assert!(passes[0].pieces().all(|p| !p.is_too_fast([0.0; 2])), "round {round}");
            if round >= EVENING_ROUNDS {
                // Twice the largest, and no less for the others.
                let n = before.nodes.len();
                assert!((1..n).all(|k| ratio(&passes[0], k - 1) <= 0.7 * ratio(&before, k - 1)));
            }
        }
        assert_eq!(report.evened_pieces, EVENING_ROUNDS * unproven.len());
        let added_s = report.offset_added_s - added_s;
        assert!((passes[0].duration_s() - time_s - added_s).abs() < 1e-9 * added_s);
    }

    fn straight(n: usize, step: f64) -> ToolPath {
        let points = (0..=n).map(|i| [step * i as f64, 3.0]).collect();
        ToolPath::through(points, vec![true; n], vec![0; n]).unwrap()
    }

    /// Time of every segment of the path in the motion.
    fn times(t: &Trajectory, n: usize) -> Vec<f64> {
        t.served_s(n, |_| true).unwrap()
    }

    #[test]
    fn every_segment_keeps_its_dwell_time_along_a_line_and_around_corners() {
        let free = machine([1e6; 2], [1e9; 2]);
        let t: Vec<f64> = (0..40).map(|i| 1.0 + 0.3 * (0.7 * f64::from(i)).sin()).collect();
        let corners: Vec<[f64; 2]> =
            (0..=40).map(|i| [f64::from(i / 2), f64::from((i + 1) / 2)]).collect();
        let stairs = ToolPath::through(corners, vec![true; 40], vec![0; 40]).unwrap();
        for path in [straight(40, 0.8), stairs] {
            let dwell = DwellTime::new(t.clone()).unwrap();
            let s = schedule(&path, &dwell, &free, &Settings::default()).unwrap();
            assert_eq!((s.report.held_densities, s.report.slowed_corners), (0, 0));
            for (i, (found, wanted)) in times(&s.trajectory, 40).iter().zip(&t).enumerate() {
                // Rounding of times of 40 s.
                assert!((found - wanted).abs() < 1e-12, "{i}: {found} {wanted}");
            }
        }
    }

    #[test]
    fn equal_density_is_constant_feed() {
        let s = schedule(
            &straight(10, 0.5),
            &DwellTime::new(vec![0.25; 10]).unwrap(),
            &machine([10.0; 2], [10.0; 2]),
            &Settings::default(),
        )
        .unwrap();
        for k in 1..s.trajectory.len() - 1 {
            let c = s.trajectory.coefficient_mm()[k][0];
            assert!((c[1] - 2.0).abs() < 1e-12 && c[2].abs() + c[3].abs() < 1e-9, "{k}: {c:?}");
        }
        // Run-up and brake of v/a = 0.2 s each, and the dwell time.
        assert!((s.trajectory.total_time_s() - 2.9).abs() < 1e-4);
        assert_eq!(s.report.links, 2);
        assert!((s.report.feed_use - 0.2).abs() < 1e-12 && s.report.acceleration_use < 1e-9);
    }

    #[test]
    fn the_offset_is_what_the_feed_limit_asks_for() {
        // One dwell point of no time: delta = 1/v_max - 0.
        let mut t = vec![1.0; 21];
        t[10] = 0.0;
        let dwell = DwellTime::new(t).unwrap();
        let limits = machine([66.6667; 2], [1e9; 2]);
        let s = schedule(&straight(21, 1.0), &dwell, &limits, &Settings::default()).unwrap();
        assert!((s.report.feed_offset_s_per_mm - 0.015).abs() < 1e-5, "{:?}", s.report);
        assert!(s.report.feed_use <= 1.0 && s.report.feed_use > 0.999);
    }

    #[test]
    fn a_blend_is_tangent_to_both_segments_and_within_its_deviation() {
        for angle in [0.01_f64, 0.5, 1.57, 2.8, PI] {
            let end = [1.0 + angle.cos(), angle.sin()];
            let points = vec![[0.0, 0.0], [1.0, 0.0], end];
            let path = ToolPath::through(points, vec![true; 2], vec![0; 2]).unwrap();
            let dwell = DwellTime::new(vec![0.5, 0.5]).unwrap();
            let limits = machine([50.0; 2], [300.0, 200.0]);
            let s = schedule(&path, &dwell, &limits, &Settings::default()).unwrap();
            assert_eq!(s.report.corners, 1);
            let corner = [1.0, 0.0];
            let distance = |p: [f64; 2]| (p[0] - corner[0]).hypot(p[1] - corner[1]);
            let nearest = s
                .trajectory
                .segments()
                .flat_map(|s| [s.position_mm(0.0), s.position_mm(s.duration_s)])
                .map(distance)
                .fold(f64::INFINITY, f64::min);
            let deviation = s.report.largest_corner_deviation_mm;
            assert!(deviation <= 0.02 + 1e-15, "{deviation}");
            assert!((nearest - deviation).abs() < 1e-12, "{angle}: {nearest} {deviation}");
        }
    }
}
