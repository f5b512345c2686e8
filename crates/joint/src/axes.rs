//! Further axes: the axes beyond x and y, such as z, tilts or a spindle.
//!
//! The position of such an axis is a function q of the contact point on the part. [`FurtherAxes`] gives it along a
//! curve in the plane, with its derivatives by arc length. For a motion p(t) of speed v, acceleration w along the curve
//! and curvature kappa:
//!
//! ```text
//! v = |p'|,   w = p' . p'' / v,   kappa = (p' x p'') / v^3
//! velocity q' v,   acceleration q'' v^2 + q' w                                                   (1)
//! ```
//!
//! (1) is judged on the motion itself, cubic piece by cubic piece, at times so dense that the acceleration between them
//! is known. The jerk is the derivative by time of the accelerations at these times.
//!
//! | symbol | meaning | unit |
//! |---|---|---|
//! | q | position of an axis | that of the axis |
//! | q', q'' | its derivatives by arc length | unit/mm, unit/mm^2 |

use planish_numerics::{
    parallel,
    polynomial::{derivative, evaluate, range},
};
use planish_types::{Invalid, Limits, Segment, Trajectory, TrajectoryBuilder};
use planish_verify::LIMIT_ALLOWANCE;
use serde::Serialize;

use crate::{further::FurtherAxes, jerk::Average, piece::Station};

/// Smallest and largest number of intervals into which a cubic piece is divided; at their ends velocities and
/// accelerations are compared with the limits. The number is doubled until [`MAX_BULGE`] is met. Larger: more time for
/// a judgement. Smaller: a short excess may be missed, or a steep one is not resolved. Chosen.
const JUDGED_INTERVALS: [usize; 2] = [4, 64];

/// Largest difference of an acceleration between two judged times from the straight line between its values there, as a
/// fraction of the limit. Larger: an excess of this size may be missed. Smaller: more times. Chosen below the margins
/// of [`crate::limits`].
const MAX_BULGE: f64 = 1e-3;

/// Allowance for rounding of a jerk, relative to its limit. Larger: real excesses pass. Smaller: motions at the limit
/// fail because of the rounding of accelerations, divided by the time between them. Chosen: no drive resolves it.
const JERK_ALLOWANCE: f64 = 1e-6;

/// Largest step of an acceleration from one cubic piece to the next that is taken for rounding, as a fraction of the
/// limit. Larger: real steps pass a limit on jerk. Smaller: rounding fails. Chosen as in `planish verify`.
const ACCELERATION_STEP_ALLOWANCE: f64 = 1e-6;

/// Ratio of a value to its limit from which on the report counts the axis as near the limit. Larger: a shorter time
/// near limits. Smaller: a longer one. Chosen below the margins that the plan leaves, which are some percent.
const NEAR_A_LIMIT: f64 = 0.9;

/// Number of equal times into which the report divides a cubic piece. Larger: more exact fractions of time. Smaller:
/// less exact ones. Chosen.
const REPORTED_TIMES: usize = 8;

/// Further axes of a plan (those beyond x and y), with the average in time that bounds the jerk of its motion.
#[derive(Clone, Copy)]
pub struct Further<'a> {
    axes: &'a dyn FurtherAxes,
    average: Option<Average>,
}

/// First and second derivative of the position of a further axis by arc length, at a point of a curve. They are divided
/// by the limits that the plan keeps before averaging.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Scaled {
    /// Least dwell-time density that the velocity limit allows, |q'| / V, s/mm.
    pub need_s_per_mm: f64,
    /// First derivative by arc length over the acceleration limit before averaging, q' / A, s^2/mm.
    pub along: f64,
    /// Second derivative by arc length over the acceleration limit before averaging, q'' / A, s^2/mm^2.
    pub across: f64,
}

/// Largest ratios of velocity, acceleration and jerk of an axis, in this order, to their limits; 1 is the limit itself.
/// The jerk of an axis without a limit on it counts as 0.
pub type Used = [f64; 3];

/// Ratios of all further axes to their limits on one cubic piece.
struct UseOfPiece {
    used: Vec<Used>,
    /// Acceleration of every axis over its limit at the start and at the end of the piece.
    ends: [Vec<f64>; 2],
}

impl<'a> Further<'a> {
    /// Checks the limits of `axes`, and stores the axes with the average in time that the motion of the plan will have;
    /// `None` if it will not be averaged.
    ///
    /// # Errors
    ///
    /// Refuses a limit that is not positive and finite.
    pub fn new(axes: &'a dyn FurtherAxes, average: Option<Average>) -> Result<Self, Invalid> {
        for (i, axis) in axes.limits().iter().enumerate() {
            let limits = [
                ("max_velocity_per_s", Some(axis.max_velocity_per_s)),
                ("max_acceleration_per_s2", Some(axis.max_acceleration_per_s2)),
                ("max_jerk_per_s3", axis.max_jerk_per_s3),
            ];
            for (name, value) in limits {
                if let Some(v) = value.filter(|v| !(v.is_finite() && *v > 0.0)) {
                    let problem = format!("{name} of the axis {} is {v:?}", axis.name);
                    return Err(Invalid::at_index(
                        "further axes",
                        i,
                        problem,
                        "a limit is positive and finite",
                    ));
                }
            }
        }
        Ok(Self { axes, average })
    }

    fn fraction(&self) -> f64 {
        self.average.map_or(1.0, |a| a.fraction)
    }

    /// Returns the position of every axis at a point of a curve, and its two derivatives by arc length. `None` unless
    /// all are given and finite.
    fn derivatives(&self, there: &Station) -> Option<Vec<[f64; 3]>> {
        let Station { point_mm, tangent, curvature_per_mm } = *there;
        let all = self.axes.along(point_mm, tangent, curvature_per_mm)?;
        let finite = all.len() == self.axes.limits().len()
            && all.iter().flatten().all(|value| value.is_finite());
        if finite { Some(all) } else { None }
    }

    /// Returns the scaled derivatives of every axis (axes) at a point of the curve, relative to the limits that the
    /// plan keeps before averaging. `None` where an axis has no position or no derivative.
    pub fn scaled(&self, there: &Station) -> Option<Vec<Scaled>> {
        let mut all = Vec::new();
        for ([_, first, second], axis) in self.derivatives(there)?.iter().zip(self.axes.limits()) {
            let most = axis.max_acceleration_per_s2 * self.fraction();
            all.push(Scaled {
                need_s_per_mm: first.abs() / axis.max_velocity_per_s,
                along: first / most,
                across: second / most,
            });
        }
        Some(all)
    }

    /// Returns velocity and acceleration of every axis (axes) over their limits, by (1) of the module. The contact
    /// point has position `p`, velocity `v` and acceleration `a` along x and y, in mm and s. `None` where an axis has
    /// no position or no derivative.
    fn of_motion(&self, p: [f64; 2], v: [f64; 2], a: [f64; 2]) -> Option<Vec<[f64; 2]>> {
        let speed = v[0].hypot(v[1]);
        let curvature_per_mm = (v[0] * a[1] - v[1] * a[0]) / speed.powi(3);
        let mut values: Vec<[f64; 2]> = if curvature_per_mm.is_finite() {
            let along = (v[0] * a[0] + v[1] * a[1]) / speed;
            let there = Station { point_mm: p, tangent: v.map(|d| d / speed), curvature_per_mm };
            let axes = self.derivatives(&there)?.into_iter();
            axes.map(|[_, first, second]| [first * speed, second * speed * speed + first * along])
                .collect()
        } else {
            // At rest the acceleration alone moves the axes, in its own direction.
            let size = a[0].hypot(a[1]);
            let (direction, of_size) = if size > 0.0 { (a, size) } else { ([1.0, 0.0], 1.0) };
            let tangent = direction.map(|d| d / of_size);
            let there = Station { point_mm: p, tangent, curvature_per_mm: 0.0 };
            let axes = self.derivatives(&there)?.into_iter();
            axes.map(|[_, first, _]| [0.0, first * size]).collect()
        };
        for ([velocity, acceleration], axis) in values.iter_mut().zip(self.axes.limits()) {
            *velocity /= axis.max_velocity_per_s;
            *acceleration /= axis.max_acceleration_per_s2;
        }
        Some(values)
    }

    /// Returns the largest difference between the accelerations of a further axis for two accelerations `a` of the
    /// contact point, as a fraction of the limit. Position `p` and velocity `v` are the same for both. It is 0 where an
    /// axis has no position or no derivative.
    pub fn acceleration_error(&self, p: [f64; 2], v: [f64; 2], a: [[f64; 2]; 2]) -> f64 {
        let [Some(first), Some(second)] = a.map(|a| self.of_motion(p, v, a)) else { return 0.0 };
        first.iter().zip(second).map(|(a, b)| (a[1] - b[1]).abs()).fold(0.0, f64::max)
    }

    /// Returns velocity and acceleration over the limits, by (1) of the module, at equally spaced times of a cubic
    /// piece (times, axes), ends included. `None` where an axis has no position or no derivative.
    fn sampled(&self, segment: &Segment<'_>, intervals: usize) -> Option<Vec<Vec<[f64; 2]>>> {
        (0..=intervals)
            .map(|k| {
                let u = segment.duration_s * k as f64 / intervals as f64;
                let [p, v, a] = motion_at(segment, u);
                self.of_motion(p, v, a)
            })
            .collect()
    }

    /// Returns the largest ratios to the limits on a cubic piece; `None` where an axis has no position or no
    /// derivative.
    fn use_of_piece(&self, segment: &Segment<'_>) -> Option<UseOfPiece> {
        let limits = self.axes.limits();
        let [mut intervals, most] = JUDGED_INTERVALS;
        loop {
            let samples = self.sampled(segment, intervals)?;
            let h = segment.duration_s / intervals as f64;
            let mut used = vec![[0.0f64; 3]; limits.len()];
            let mut bulge = 0.0f64;
            for (i, (axis, used)) in limits.iter().zip(&mut used).enumerate() {
                let velocity = |k: usize| samples[k][i][0];
                let acceleration = |k: usize| samples[k][i][1];
                let over = axis.max_velocity_per_s / axis.max_acceleration_per_s2;
                for k in 0..=intervals {
                    used[0] = used[0].max(velocity(k).abs());
                    used[1] = used[1].max(acceleration(k).abs());
                }
                for k in 0..intervals {
                    // The mean value theorem: somewhere between the two times the acceleration is this, also where the
                    // velocity steps.
                    let secant = (velocity(k + 1) - velocity(k)) * over / h;
                    let mean = 0.5 * (acceleration(k) + acceleration(k + 1));
                    if (secant - mean).abs() > MAX_BULGE {
                        used[1] = used[1].max(secant.abs());
                    }
                    bulge = bulge.max((secant - mean).abs());
                }
                for k in 1..intervals {
                    used[0] = used[0].max(peak([k - 1, k, k + 1].map(velocity)));
                    let [a, b, c] = [k - 1, k, k + 1].map(acceleration);
                    used[1] = used[1].max(peak([a, b, c]));
                    bulge = bulge.max((0.125 * (a - 2.0 * b + c)).abs());
                }
                if let Some(jerk) = axis.max_jerk_per_s3 {
                    let scale = axis.max_acceleration_per_s2 / (jerk * h);
                    for k in 1..intervals {
                        let [a, b, c] = [k - 1, k, k + 1].map(acceleration);
                        // Of the parabola through three accelerations, at its ends and in its middle
                        let [from, to] =
                            [-1.5 * a + 2.0 * b - 0.5 * c, 0.5 * a - 2.0 * b + 1.5 * c];
                        let here = from.abs().max(to.abs()).max((0.5 * (c - a)).abs());
                        used[2] = used[2].max(here * scale);
                    }
                }
            }
            if bulge <= MAX_BULGE || intervals >= most {
                let ends = [0, intervals].map(|k| samples[k].iter().map(|axis| axis[1]).collect());
                return Some(UseOfPiece { used, ends });
            }
            intervals *= 2;
        }
    }

    /// Returns the largest ratios of every axis to its limits on every cubic piece (pieces, axes). The ratio of a
    /// limited jerk is infinite where the acceleration steps at the start of a piece. All ratios of a piece are
    /// infinite where an axis has no position or no derivative.
    pub fn used(&self, trajectory: &Trajectory) -> Vec<Vec<Used>> {
        let limits = self.axes.limits();
        let pieces: Vec<Option<UseOfPiece>> =
            parallel::map(trajectory.len(), &|i| self.use_of_piece(&trajectory.segment(i)));
        let mut before = vec![0.0; limits.len()];
        let mut all = Vec::with_capacity(pieces.len());
        for piece in pieces {
            let Some(UseOfPiece { mut used, ends: [start, end] }) = piece else {
                all.push(vec![[f64::INFINITY; 3]; limits.len()]);
                continue;
            };
            for (i, axis) in limits.iter().enumerate() {
                let step = (start[i] - before[i]).abs();
                if axis.max_jerk_per_s3.is_some() && step > ACCELERATION_STEP_ALLOWANCE {
                    used[i][2] = f64::INFINITY;
                }
            }
            before = end;
            all.push(used);
        }
        all
    }

    /// Returns the largest ratio to a limit of every axis on every span of the mesh (spans, axes), as a factor on
    /// accelerations. It is at most 1 where the axis keeps its limits. If the motion is averaged, it judges the
    /// averaged motion, for every span that takes part in the average. `span` has the index of the span for every
    /// segment of the `planned` motion; there are `spans` of them.
    /// # Errors
    ///
    /// Fails where the motion cannot be averaged.
    pub fn excess(
        &self,
        planned: &Trajectory,
        span: &[usize],
        spans: usize,
    ) -> Result<Vec<Vec<f64>>, Invalid> {
        let mut of_spans = vec![vec![0.0f64; self.axes.limits().len()]; spans];
        let Some(average) = self.average else {
            for (used, span) in self.used(planned).iter().zip(span) {
                raise(&mut of_spans[*span], used);
            }
            return Ok(of_spans);
        };
        let averaged = average.averaged(planned)?;
        let breaks = planned.break_time_s();
        // The average begins earlier by its window, and takes part of as much to both sides.
        for (used, times) in self.used(&averaged).iter().zip(averaged.break_time_s().windows(2)) {
            let from_s = times[0] - 2.0 * average.window_s;
            let to_s = times[1];
            let first = breaks.partition_point(|b| *b < from_s).max(1) - 1;
            for (k, span) in span.iter().enumerate().skip(first) {
                if breaks[k] > to_s {
                    break;
                }
                raise(&mut of_spans[*span], used);
            }
        }
        Ok(of_spans)
    }

    /// Returns the least factor on all times with which the motion keeps the limits of the further axes. It is 1 if the
    /// motion keeps them already, and infinite if a ratio of [`Self::used`] is.
    pub fn slower_by(&self, trajectory: &Trajectory) -> f64 {
        let used = self.used(trajectory);
        let factors = used.iter().flatten().map(|used| {
            let [velocity, acceleration, jerk] = without_rounding(used);
            velocity.max(acceleration.sqrt()).max(jerk.cbrt())
        });
        factors.fold(1.0, f64::max)
    }

    /// Returns the names of the further axes.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        self.axes.limits().iter().map(|axis| axis.name.as_str())
    }

    /// Returns a sentence on the largest excess over a limit of the motion, and its remedy; `None` without pieces or
    /// axes.
    pub fn reason(&self, trajectory: &Trajectory) -> Option<String> {
        let used = self.used(trajectory);
        let pieces = used.iter().zip(trajectory.segments());
        let all = pieces.flat_map(|(used, segment)| {
            let axes = self.names().zip(used);
            axes.map(move |(name, used)| (name, as_acceleration(used), segment.position_mm(0.0)))
        });
        let (name, excess, [x, y]) = all.max_by(|a, b| a.1.total_cmp(&b.1))?;
        Some(format!(
            "the axis {name} exceeds a limit {excess:.1e} times near ({x:.4}, {y:.4}) mm; let the path keep away from there"
        ))
    }
}

/// Raises the largest ratio of every axis on a span to that on a cubic piece of this span, if that is larger.
fn raise(excess_of_span: &mut [f64], used: &[Used]) {
    for (most, used) in excess_of_span.iter_mut().zip(used) {
        *most = most.max(as_acceleration(used));
    }
}

/// Returns the ratios to the limits, divided by 1 plus the allowances for rounding.
fn without_rounding([velocity, acceleration, jerk]: &Used) -> Used {
    let [velocity, acceleration] = [velocity, acceleration].map(|u| u / (1.0 + LIMIT_ALLOWANCE));
    [velocity, acceleration, jerk / (1.0 + JERK_ALLOWANCE)]
}

/// Returns the largest of three ratios to limits: that of the acceleration, that of the jerk, and the square of that of
/// the velocity. If all times are longer by a factor, a velocity is lower by this factor and an acceleration by its
/// square.
fn as_acceleration(used: &Used) -> f64 {
    let [velocity, acceleration, jerk] = without_rounding(used);
    velocity.powi(2).max(acceleration).max(jerk)
}

/// Returns the position, velocity and acceleration at the local time `u_s` of a piece, in mm and s.
fn motion_at(segment: &Segment<'_>, u_s: f64) -> [[f64; 2]; 3] {
    let mut c = *segment.coefficient_mm;
    [0; 3].map(|_| {
        let value = c.each_ref().map(|c| evaluate(c, u_s));
        c = c.each_ref().map(derivative);
        value
    })
}

/// Returns the largest magnitude of the parabola through three equidistant values if its vertex is between them; 0
/// otherwise.
fn peak([a, b, c]: [f64; 3]) -> f64 {
    let slope = 0.5 * (c - a);
    let bend = a - 2.0 * b + c;
    if slope.abs() < bend.abs() { (b - 0.5 * slope * slope / bend).abs() } else { 0.0 }
}

/// Returns the same motion with all times longer by `factor`.
///
/// # Errors
///
/// Fails where a time is no longer finite.
pub fn slowed(trajectory: &Trajectory, factor: f64) -> Result<Trajectory, Invalid> {
    let mut builder = TrajectoryBuilder::default();
    for segment in trajectory.segments() {
        let c = segment.coefficient_mm.map(|[a, b, c, d]| {
            [a, b / factor, c / (factor * factor), d / (factor * factor * factor)]
        });
        builder.push(segment.duration_s * factor, c, segment.tool_on, segment.dwell_index);
    }
    builder.build()
}

/// Largest ratios of an axis to its limits by the motion of a plan, and the time and places near the limits.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct AxisReport {
    /// Name of the axis; `contact x` and `contact y` for the contact point along x and y of the part.
    pub name: String,
    /// Ratio of the largest |velocity| to its limit.
    pub velocity_over_limit: f64,
    /// Ratio of the largest |acceleration| to its limit.
    pub acceleration_over_limit: f64,
    /// Ratio of the largest |jerk| to its limit; `None` for x and y, and for an axis without a limit on jerk.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub jerk_over_limit: Option<f64>,
    /// Fraction of the time in which the velocity is above nine tenths of its limit, in the motion before averaging.
    pub time_near_velocity_limit: f64,
    /// Fraction of the time in which the acceleration is above nine tenths of what the plan may use, in the motion
    /// before averaging. The plan may use all of the limit, or the fraction that a limit on jerk leaves.
    pub time_near_acceleration_limit: f64,
    /// Box of the contact points with a velocity near the limit, mm: least x and y, largest x and y. `None` without
    /// such points.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub near_velocity_limit_mm: Option<[[f64; 2]; 2]>,
    /// Box of the contact points with an acceleration near the limit, mm: least x and y, largest x and y. `None`
    /// without such points.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub near_acceleration_limit_mm: Option<[[f64; 2]; 2]>,
}

/// Returns the reports on x, y and the further axes, in this order: the largest ratios to the limits by the motion
/// `executed`, and the time near limits of the motion `planned` before any average.
pub fn report(
    executed: &Trajectory,
    planned: &Trajectory,
    limits: &Limits,
    further: &Further<'_>,
) -> Vec<AxisReport> {
    let own = limits.axes().iter().map(|axis| (format!("contact {}", axis.name()), None));
    let others = further.axes.limits().iter().map(|a| (a.name.clone(), a.max_jerk_per_s3));
    let mut reports: Vec<AxisReport> = own
        .chain(others)
        .map(|(name, jerk)| AxisReport {
            name,
            velocity_over_limit: 0.0,
            acceleration_over_limit: 0.0,
            jerk_over_limit: jerk.map(|_| 0.0),
            time_near_velocity_limit: 0.0,
            time_near_acceleration_limit: 0.0,
            near_velocity_limit_mm: None,
            near_acceleration_limit_mm: None,
        })
        .collect();
    for segment in executed.segments() {
        for (c, (report, axis)) in
            segment.coefficient_mm.iter().zip(reports.iter_mut().zip(limits.axes()))
        {
            let rate = derivative(c);
            let [velocity, acceleration] =
                [rate, derivative(&rate)].map(|c| range(&c, segment.duration_s).peak().0.abs());
            let velocity = velocity / axis.max_velocity_mm_per_s();
            let acceleration = acceleration / axis.max_acceleration_mm_per_s2();
            report.velocity_over_limit = report.velocity_over_limit.max(velocity);
            report.acceleration_over_limit = report.acceleration_over_limit.max(acceleration);
        }
    }
    for used in further.used(executed) {
        for (report, [velocity, acceleration, jerk]) in reports[2..].iter_mut().zip(used) {
            report.velocity_over_limit = report.velocity_over_limit.max(velocity);
            report.acceleration_over_limit = report.acceleration_over_limit.max(acceleration);
            report.jerk_over_limit = report.jerk_over_limit.map(|j| j.max(jerk));
        }
    }
    near_limits(&mut reports, planned, limits, further);
    reports
}

/// Adds the times and the boxes near limits to the reports.
fn near_limits(
    reports: &mut [AxisReport],
    planned: &Trajectory,
    limits: &Limits,
    further: &Further<'_>,
) {
    let total_s = planned.total_time_s();
    for segment in planned.segments() {
        let fraction = segment.duration_s / (REPORTED_TIMES as f64 * total_s);
        for k in 0..REPORTED_TIMES {
            let u = segment.duration_s * (k as f64 + 0.5) / REPORTED_TIMES as f64;
            let [p, v, a] = motion_at(&segment, u);
            let Some(others) = further.of_motion(p, v, a) else { continue };
            let own = [0, 1].map(|i| {
                let axis = &limits.axes()[i];
                [v[i] / axis.max_velocity_mm_per_s(), a[i] / axis.max_acceleration_mm_per_s2()]
            });
            for (report, [velocity, acceleration]) in
                reports.iter_mut().zip(own.into_iter().chain(others))
            {
                if velocity.abs() > NEAR_A_LIMIT {
                    report.time_near_velocity_limit += fraction;
                    widen(&mut report.near_velocity_limit_mm, p);
                }
                if acceleration.abs() > NEAR_A_LIMIT * further.fraction() {
                    report.time_near_acceleration_limit += fraction;
                    widen(&mut report.near_acceleration_limit_mm, p);
                }
            }
        }
    }
}

impl AxisReport {
    /// Returns the fractions of the time in which velocity and acceleration are near what the plan may use, each after
    /// the name of its quantity.
    pub fn near(&self) -> [(&'static str, f64); 2] {
        [
            ("velocity", self.time_near_velocity_limit),
            ("acceleration", self.time_near_acceleration_limit),
        ]
    }
}

/// Widens a box so that it contains the point `p`, mm; `None` is the empty box.
fn widen(box_mm: &mut Option<[[f64; 2]; 2]>, p: [f64; 2]) {
    let [low, high] = box_mm.unwrap_or([p, p]);
    *box_mm = Some([[0, 1].map(|i| low[i].min(p[i])), [0, 1].map(|i| high[i].max(p[i]))]);
}
