//! Motions that keep a limit on jerk: the moving average in time of a motion that keeps velocity and acceleration.
//!
//! The plan keeps velocity and acceleration. Where the feedrate stops to rise and begins to fall, its acceleration
//! steps, by at most twice the limit. The planned motion p, at rest before and after, becomes a spline of its moving
//! average,
//!
//! ```text
//! p_w(t) = 1/w  integral over t - w/2 .. t + w/2 of p                                           (1)
//! P(t)   = sum_i p_w(i h) B(t / h - i),   B the uniform cubic B-spline                          (2)
//! ```
//!
//! P is twice continuously differentiable and cubic in between. Its k-th derivative is a mean of `p_w^(k)`: the
//! derivative of (2) is a mean of k-th differences of the coefficients over h^k, and these are means of derivatives:
//!
//! ```text
//! |P'| <= V,   |P''| <= A,   |P'''| <= max |p''(t + w/2) - p''(t - w/2)| / w <= 2 A / w          (3)
//! |P - p| <= A (w^2 / 24 + h^2 / 6)      where h^2 / 6 is half the variance of B                 (4)
//! ```
//!
//! So `w = 2 A / J` keeps the limit J. If (4) is then larger than allowed, the plan uses only a fraction f of A,
//! because (4) is proportional to f^3. Averaging a motion in time to bound its jerk is common in controllers: S.
//! Tajima and B. Sencer, Int. J. Mach. Tools Manuf. 112 (2017) 1, among others.

use planish_numerics::{parallel, polynomial};
use planish_types::{Invalid, Limits, MachineFile, Trajectory, TrajectoryBuilder, budget};

use crate::further::FurtherLimits;

/// Number of intervals h of the B-spline in the window w of the average. Larger: a smaller deviation, (4) of the
/// module, and more cubic pieces. Smaller: fewer pieces, a larger deviation. Chosen: (4) is then a quarter above its
/// least value.
const INTERVALS: usize = 4;

/// Fraction of the limit on jerk that is left for rounding. Larger: a longer average than needed. Smaller:
/// `planish verify` may find the limit exceeded by rounding. Chosen.
const ROUNDING_MARGIN: f64 = 1e-9;

/// Least duration of a piece over the interval h; a shorter piece is joined to its neighbour. Larger: a segment of the
/// path gets or loses more time. Smaller: pieces too short for a controller. Chosen: far below what a machine notices.
const SHORTEST_OVER_INTERVAL: f64 = 1e-3;

/// Deviation of the averaged motion, (4) of the module, over the largest allowed one, up to which the window is
/// lengthened. Larger: longer averages than the limit on jerk asks for. Smaller: more cubic pieces, for a deviation
/// that the plan need not avoid. Chosen.
const LEAST_DEVIATION: f64 = 0.25;

/// Least fraction of the limit on acceleration that the plan may use. If less would be left, the limit on jerk has
/// probably the wrong unit, and it is refused. Larger: slow machines are refused. Smaller: runs of years. Chosen.
const LEAST_FRACTION: f64 = 1e-6;

/// Moving average of a motion in time, which bounds its jerk.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Average {
    /// Length of the window of the average (w), s.
    pub window_s: f64,
    /// Fraction (f) of the limits on acceleration that the plan uses before averaging.
    pub fraction: f64,
    /// Bound on the distance of the averaged motion from the planned one, (4) of the module, mm.
    pub deviation_mm: f64,
}

impl Average {
    /// Returns the average for the limits on jerk of a machine, with a deviation of at most `deviation_mm`; `None` if
    /// the machine does not limit jerk. The bound (3) of the module does not hold for further axes, which are no linear
    /// functions of x and y; the rounds of the plan keep their limits.
    pub fn new(limits: &Limits, further: &[FurtherLimits], deviation_mm: f64) -> Option<Self> {
        // (4) holds for every axis; the distance is that of both together.
        let [a, b] = limits.max_acceleration_mm_per_s2();
        let most = a.hypot(b);
        // Of all of A: w = 2 A / J on the slower axis.
        let own = limits.axes().iter().filter_map(|axis| {
            axis.max_jerk_mm_per_s3().map(|jerk| 2.0 * axis.max_acceleration_mm_per_s2() / jerk)
        });
        let of_further = further.iter().filter_map(|axis| {
            axis.max_jerk_per_s3.map(|jerk| 2.0 * axis.max_acceleration_per_s2 / jerk)
        });
        let window_s = own.chain(of_further).reduce(f64::max)?;
        let intervals = INTERVALS as f64;
        let of_window = 1.0 / 24.0 + 1.0 / (6.0 * intervals * intervals);
        let least_s = (LEAST_DEVIATION * deviation_mm / (most * of_window)).sqrt();
        let window_s = (window_s / (1.0 - ROUNDING_MARGIN)).max(least_s);
        // f^3 A w^2 (1/24 + ...) = deviation
        let whole_mm = most * window_s * window_s * of_window;
        let fraction = (deviation_mm / whole_mm).cbrt().min(1.0);
        let window_s = fraction * window_s;
        let deviation_mm = whole_mm * fraction.powi(3);
        Some(Self { window_s, fraction, deviation_mm })
    }

    /// Returns the limits that the plan keeps before averaging: the fraction f of every acceleration, and no limit on
    /// jerk.
    ///
    /// # Errors
    ///
    /// Refuses a limit on jerk that leaves nearly nothing of the acceleration.
    pub fn limits(&self, limits: &Limits) -> Result<Limits, Invalid> {
        if self.fraction < LEAST_FRACTION {
            let problem =
                format!("limit jerk so that {:.1e} of the acceleration is left", self.fraction);
            return Err(Invalid::whole("axes", problem, "give max_jerk_mm_per_s3 in mm/s^3"));
        }
        let mut file = MachineFile::from(limits);
        for axis in &mut file.axes {
            axis.max_acceleration_mm_per_s2 *= self.fraction;
            axis.max_jerk_mm_per_s3 = None;
        }
        file.checked()
    }

    /// Returns the averaged motion, (2) of the module; it is longer by w, four h, and what makes its time a multiple of
    /// h. It changes segments of the path and the state of the tool at the same times as `motion`.
    ///
    /// # Errors
    ///
    /// Refuses a motion whose average would not fit into the memory.
    pub fn averaged(&self, motion: &Trajectory) -> Result<Trajectory, Invalid> {
        let total_s = motion.total_time_s();
        let h = self.window_s / INTERVALS as f64;
        // From the first coefficient that is not the start on; B reaches two intervals to both sides.
        let before = INTERVALS / 2 + 2;
        let pieces = (total_s / h).ceil() as usize + 2 * before;
        budget::affordable(
            "machine",
            pieces as f64,
            16 * size_of::<f64>(),
            "the limit on jerk asks for that many pieces; is it in mm/s^3?",
        )?;
        // Piece i, and the coefficient before it.
        let at_s = |i: usize| (i as f64 - before as f64) * h;
        let means = parallel::map(pieces + 3, &|i| {
            mean_mm(motion, at_s(i) - h - 0.5 * self.window_s, self.window_s)
        });

        let runs = runs(motion);
        let mut builder = TrajectoryBuilder::default();
        let mut run = 0;
        let least_s = SHORTEST_OVER_INTERVAL * h;
        for i in 0..pieces {
            let cubic = [0, 1].map(|axis| of_b_spline([0, 1, 2, 3].map(|k| means[i + k][axis]), h));
            let mut from_s = 0.0;
            loop {
                let Run { end_s, tool_on, dwell_index } = runs[run];
                let ends_s = end_s - at_s(i);
                let ends_here = ends_s < h - least_s;
                let to_s = if ends_here { ends_s.max(from_s) } else { h };
                if to_s - from_s >= least_s {
                    let part = cubic.map(|c| polynomial::shifted(&c, from_s));
                    builder.push(to_s - from_s, part, tool_on, dwell_index);
                    from_s = to_s;
                }
                if !ends_here {
                    break;
                }
                run += 1;
            }
        }
        builder.build()
    }
}

/// Consecutive pieces that belong to the same segment of the path.
struct Run {
    /// Time at which the run ends, s; infinite for the last one, because the average lasts longer.
    end_s: f64,
    tool_on: bool,
    dwell_index: Option<usize>,
}

fn runs(motion: &Trajectory) -> Vec<Run> {
    let mut runs: Vec<Run> = Vec::new();
    for (segment, end_s) in motion.segments().zip(&motion.break_time_s()[1..]) {
        let end_s = *end_s;
        let tool_on = segment.tool_on;
        let dwell_index = segment.dwell_index;
        match runs.last_mut().filter(|r| (r.tool_on, r.dwell_index) == (tool_on, dwell_index)) {
            Some(run) => run.end_s = end_s,
            None => runs.push(Run { end_s, tool_on, dwell_index }),
        }
    }
    if let Some(last) = runs.last_mut() {
        last.end_s = f64::INFINITY;
    }
    runs
}

/// Returns the mean position over `window_s` from the time `from_s` on, (1) of the module, mm; a motion rests before
/// its start and after its end.
///
/// It averages the distance from the position in the middle of the window, so that the mean has the rounding of a
/// position: third differences of means are divided by h^3.
fn mean_mm(motion: &Trajectory, from_s: f64, window_s: f64) -> [f64; 2] {
    let breaks = motion.break_time_s();
    let last = motion.len() - 1;
    let total_s = motion.total_time_s();
    let segment_at = |t: f64| (breaks.partition_point(|b| *b <= t).max(1) - 1).min(last);
    let to_s = from_s + window_s;
    let middle_s = (0.5 * (from_s + to_s)).clamp(0.0, total_s);
    let middle = segment_at(middle_s);
    let about = motion.segment(middle).position_mm(middle_s - breaks[middle]);
    let [start, end] = [
        motion.segment(0).position_mm(0.0),
        motion.segment(last).position_mm(breaks[last + 1] - breaks[last]),
    ];
    let mut sum = [0.0; 2];
    let (rests_before_s, rests_after_s) =
        ((to_s.min(0.0) - from_s).max(0.0), (to_s - from_s.max(total_s)).max(0.0));
    for axis in 0..2 {
        sum[axis] += (start[axis] - about[axis]) * rests_before_s;
        sum[axis] += (end[axis] - about[axis]) * rests_after_s;
    }
    let mut k = segment_at(from_s.max(0.0));
    while k <= last && breaks[k] < to_s {
        let [u, v] = [from_s, to_s].map(|t| t.clamp(breaks[k], breaks[k + 1]) - breaks[k]);
        for (axis, c) in motion.segment(k).coefficient_mm.iter().enumerate() {
            // integral of c0 - about + c1 u + c2 u^2 + c3 u^3, by Horner's rule
            let integral = |u: f64| {
                u * (c[0] - about[axis] + u * (c[1] / 2.0 + u * (c[2] / 3.0 + u * c[3] / 4.0)))
            };
            sum[axis] += integral(v) - integral(u);
        }
        k += 1;
    }
    [0, 1].map(|axis| about[axis] + sum[axis] / window_s)
}

/// Returns a cubic piece of duration `h` of the B-spline, (2) of the module, from the four coefficients that act on it.
fn of_b_spline([a, b, c, d]: [f64; 4], h: f64) -> [f64; 4] {
    let (before, here, after) = (b - a, c - b, d - c);
    [
        b + (here - before) / 6.0,
        0.5 * (here + before) / h,
        0.5 * (here - before) / (h * h),
        ((after - here) - (here - before)) / (6.0 * h * h * h),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;
    use planish_types::MachineFileAxis;
    use planish_verify::{VerifySettings, verify};

    fn machine(jerk: Option<f64>) -> Limits {
        let axis = |name: &str, acceleration: f64| MachineFileAxis {
            name: name.into(),
            max_velocity_mm_per_s: 40.0,
            max_acceleration_mm_per_s2: acceleration,
            max_jerk_mm_per_s3: jerk,
            ..MachineFileAxis::default()
        };
        let axes = vec![axis("x", 800.0), axis("y", 400.0)];
        MachineFile { name: "test".into(), axes, min_segment_s: 0.0, ..MachineFile::default() }
            .checked()
            .unwrap()
    }

    /// Returns a motion up and down with the full acceleration: up with the tool on, back with it off.
    fn full_speed(limits: &Limits) -> Trajectory {
        let [a, _] = limits.max_acceleration_mm_per_s2();
        let t = 0.04;
        let mut builder = TrajectoryBuilder::default();
        let (mut x, mut v) = (3.0, 0.0);
        for (sign, k) in [(1.0, 0), (-1.0, 0), (-1.0, 1), (1.0, 2)] {
            let acceleration = sign * a;
            builder.push(
                t,
                [[x, v, 0.5 * acceleration, 0.0], [1.0, 0.0, 0.0, 0.0]],
                k == 0,
                Some(k),
            );
            x += v * t + 0.5 * acceleration * t * t;
            v += acceleration * t;
        }
        builder.build().unwrap()
    }

    #[test]
    fn the_average_keeps_every_limit_and_is_as_near_as_it_says() {
        for jerk in [2e4, 1e5, 1e6] {
            let limits = machine(Some(jerk));
            let average = Average::new(&limits, &[], 0.05).unwrap();
            // The bound itself: rounding.
            assert!(average.deviation_mm <= 0.05 * (1.0 + 1e-12), "{average:?}");
            let motion = full_speed(&average.limits(&limits).unwrap());
            assert!(
                !verify(&motion, &limits, &VerifySettings::default()).unwrap().limits_respected
            );
            let smooth = average.averaged(&motion).unwrap();
            let verdict = verify(&smooth, &limits, &VerifySettings::default()).unwrap();
            assert!(verdict.limits_respected, "{jerk}: {:?}", verdict.reason());
            // At rest at both ends, where the motion was.
            let ends = [smooth.segment(0), smooth.segment(smooth.len() - 1)];
            let [first, last] = ends.map(|s| [0.0, s.duration_s].map(|u| s.position_mm(u)[0]));
            // Rounding of a position of 3 mm; the last one is the end of a sum over the pieces.
            assert!((first[0] - 3.0).abs() < 1e-12 && (last[1] - 3.0).abs() < 1e-9);
            // Both times run from the same moment: the average begins earlier by so much.
            let before_s = 0.5 * (smooth.total_time_s() - motion.total_time_s());
            let mut farthest = 0.0f64;
            for (segment, start) in smooth.segments().zip(smooth.break_time_s()) {
                let t =
                    start - (0.5 * average.window_s + 2.0 * average.window_s / INTERVALS as f64);
                let k = (motion.break_time_s().partition_point(|b| *b <= t).max(1) - 1).min(3);
                let u = (t - motion.break_time_s()[k]).clamp(0.0, 0.04);
                let there = motion.segment(k).position_mm(u)[0];
                farthest = farthest.max((segment.position_mm(0.0)[0] - there).abs());
            }
            assert!(before_s > 0.0);
            // The motion is along x. While all of its acceleration lasts longer than the average, (4) is exact.
            let [a, b] = limits.max_acceleration_mm_per_s2();
            let reached = farthest / (average.deviation_mm * a / a.hypot(b));
            assert!(
                reached < 1.0 + 1e-9 && (jerk < 5e4 || reached > 1.0 - 1e-6),
                "{jerk}: {reached}"
            );
        }
    }

    #[test]
    fn segments_of_the_path_keep_their_times() {
        let limits = machine(Some(1e5));
        let average = Average::new(&limits, &[], 0.05).unwrap();
        let motion = full_speed(&limits);
        let smooth = average.averaged(&motion).unwrap();
        let of = |t: &Trajectory| t.served_s(3, |_| true).unwrap();
        let (planned, kept) = (of(&motion), of(&smooth));
        // Below: rounding of sums of the durations of some hundred pieces.
        assert!((planned[1] - kept[1]).abs() < 1e-9, "{planned:?} {kept:?}");
        // What is before and after it belongs to the first and last one.
        assert!(kept[0] > planned[0] && kept[2] > planned[2]);
        let on: f64 = smooth.segments().filter(|s| s.tool_on).map(|s| s.duration_s).sum();
        assert!((on - kept[0]).abs() < 1e-9);
        for pair in smooth.coefficient_mm().windows(2).zip(smooth.break_time_s().windows(2)) {
            let ([a, b], times) = (pair.0, pair.1) else { unreachable!() };
            let h = times[1] - times[0];
            for axis in 0..2 {
                // Rounding of positions of some mm.
                assert!((polynomial::evaluate(&a[axis], h) - b[axis][0]).abs() < 1e-12);
            }
        }
    }

    #[test]
    fn a_machine_without_a_limit_needs_no_average_and_a_low_one_takes_less_of_the_acceleration() {
        assert_eq!(Average::new(&machine(None), &[], 0.1), None);
        let [low, high] =
            [1e3, 1e9].map(|jerk| Average::new(&machine(Some(jerk)), &[], 0.1).unwrap());
        // A low limit: of the acceleration it leaves less than a fifth, and the other one leaves all.
        assert!(low.fraction < 0.2 && high.fraction == 1.0, "{low:?} {high:?}");
        // w = 2 f A / J on the slower axis.
        assert!((low.window_s / (2.0 * low.fraction * 800.0 / 1e3) - 1.0).abs() < 1e-6);
        // The bound itself: rounding.
        assert!((low.deviation_mm / 0.1 - 1.0).abs() < 1e-12);
    }
}
