//! Following error of a log: the measured motion against its setpoint or a plan.
//!
//! With the position p(t_i) of the log and the reference r (a setpoint or a plan), the following error is
//! e_i = p(t_i) - r(t_i) on each axis. The lag is the delay d by least squares,
//!
//! ```text
//! d = arg min sum_i (p(t_i) - r(t_i - d))^2,   d <- d - sum_i e_i r'(t_i - d) / sum_i r'(t_i - d)^2
//! ```
//!
//! by Gauss-Newton steps; it is positive if the axis comes late. A log has a clock of its own. So beside a
//! plan the delay that both axes share is found first, by a search on a grid. The errors are those after
//! this delay.
//!
//! Two clocks differ by some parts per million. With the time t_i' = t_i - d in the plan, the drift s of the log against the
//! plan and a rest of the delay d0 are the least squares of
//!
//! ```text
//! e_i = -r'(t_i') (d0 + s t_i'),    standard error of s from the rest of e as white noise
//! ```

use planish_numerics::polynomial;
use planish_types::{Invalid, Trajectory, text::significant};
use serde::Serialize;

use super::clock::USUAL_DRIFT;

/// Largest number of samples that enter the least squares of the delays and of the drift. Larger: more time. Smaller: a
/// larger standard error of the lag.
const LAG_SAMPLES: usize = 100_000;
/// Largest number of samples that enter the search on a grid for the beginning of the plan. Larger: more time. Smaller:
/// the minimum on the grid is less certain.
const SEARCH_SAMPLES: usize = 1000;

/// Step of the delay in the first search for the beginning of the plan, s. Larger: the search can miss the minimum.
/// Smaller: more time. Chosen: the sum of squared errors has one minimum within a quarter of the time of a raster line,
/// which takes seconds.
const SEARCH_STEP_S: f64 = 0.02;

/// Largest time before and after the first sample in which the beginning of the plan can be searched for, s. Larger:
/// the search takes longer than some seconds. Smaller: the user has to cut more logs with `from_s`.
const LONGEST_SEARCH_S: f64 = 300.0;

/// Largest number of Gauss-Newton steps of a delay. Larger: more time. Smaller: no lag is reported where a delay
/// settles slowly.
const MOST_STEPS: usize = 30;
/// Gauss-Newton step of the delay, s, below which the delay has settled. Larger: the delay is off by up to this step.
/// Smaller: more steps, without a visible gain.
const SETTLED_S: f64 = 1e-10;
/// Largest last Gauss-Newton step of an axis' delay, in standard errors of the delay, at which the delay counts as
/// settled too. Larger: the lag is off by this part of its standard error. Smaller: no lag is reported where the
/// samples decide the last steps.
const SETTLED_PART: f64 = 0.1;

/// RMS distance of a log from a plan, relative to the RMS distance of the plan's segments from their mean, above which
/// the log is refused as one of another motion. Larger: accepts logs of other motions. Smaller: refuses logs with a
/// large following error.
const OTHER_MOTION: f64 = 0.05;

/// Fraction of the plan's time with the tool on that may be absent from the log without a warning. Larger:
/// missing removal goes unnoticed. Smaller: warns if a log begins or ends a little inside the plan.
const USUAL_ABSENCE: f64 = 1e-3;
/// Fraction of the plan's time with the tool on that may be absent from the log. With more absent, a log that the user
/// has not cut is reported as not one of the whole run. Larger: accepts incomplete logs. Smaller: reports logs that
/// miss the beginning or the end.
const MOST_ABSENCE: f64 = 0.05;

/// Smallest time of the plan before or after the log that is reported, relative to the mean time between two samples:
/// the beginning of a plan in a log is known to about this fraction. Larger: hides a short absence. Smaller: reports an
/// absence that is an error of the fit.
const SEEN_OF_A_SAMPLE: f64 = 0.1;

/// Fraction of the plan's time in which the tool of the log may differ from that of the plan without a warning, because
/// switches have latencies. The time that the samples cannot resolve is added. Larger: a wrong switch goes unnoticed.
/// Smaller: warns of latencies.
const USUAL_DIFFERENCE: f64 = 0.01;
/// Fraction of the plan's time in which the tool of the log may differ from that of the plan; above it, the log is
/// reported as one with another tool. The limit is at most half of the time of the log and of the plan. The time that
/// the samples cannot resolve is added. Larger: accepts wrong columns of the switch. Smaller: reports late switches.
const MOST_DIFFERENCE: f64 = 0.1;

/// The following error (measured minus reference position) of one axis. Against a plan, the errors are those after the
/// delay that both axes share.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct AxisError {
    /// RMS of the following error, mm.
    pub rms_mm: f64,
    /// Largest magnitude of the following error, mm.
    pub largest_mm: f64,
    /// Time of the error with the largest magnitude, s after the first sample that is compared.
    pub largest_at_s: f64,
    /// Lag of the axis, ms, positive if it is late; absent if the axis does not move or its delay has not settled.
    /// Against a plan it does not include the delay that both axes share.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lag_ms: Option<f64>,
    /// Standard error of the lag, ms, if the errors that remain after the lag are white noise; absent without a lag.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lag_standard_error_ms: Option<f64>,
    /// RMS of the following error, mm, against the reference delayed by the lag of this axis; absent without a lag.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rms_without_lag_mm: Option<f64>,
}

/// Smallest ratio of a drift to its standard error at which a warning names it. Larger: small drifts pass. Smaller:
/// noise is named a drift.
const DRIFT_SIGNIFICANT: f64 = 5.0;

/// Drift of the clock of a log against the time of the plan that was run.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Drift {
    /// Relative drift, dimensionless; positive if the log takes longer than the plan.
    pub drift: f64,
    /// Standard error of the drift, dimensionless, if the errors that remain after the fit are white noise.
    pub standard_error: f64,
    /// Drift accumulated at the end of the plan, s: the drift times the duration of the plan.
    pub at_the_end_s: f64,
}

impl Drift {
    /// Returns a warning about a drift above the usual difference of clocks and above `DRIFT_SIGNIFICANT` standard
    /// errors; `None` otherwise.
    pub fn warning(&self) -> Option<String> {
        let size = self.drift.abs();
        if size <= USUAL_DRIFT || size <= DRIFT_SIGNIFICANT * self.standard_error {
            return None;
        }
        Some(format!(
            "the clock of the log runs {} parts per million (standard error {}) {} than the plan, {} s at its end: the \
             following errors hold it; give the true `rate_hz` or `sample_s`, or record with the clock of the controller",
            significant(1e6 * size, 3),
            significant(1e6 * self.standard_error, 2),
            if self.drift > 0.0 { "faster" } else { "slower" },
            significant(self.at_the_end_s.abs(), 3)
        ))
    }
}

/// The following errors of x and y against a reference, which is the setpoint of the log or a plan.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Following {
    /// Beginning of the plan, s after the first sample; 0 for a setpoint of the log itself.
    pub reference_begins_s: f64,
    /// Following errors of x and y, in this order.
    pub axes: [AxisError; 2],
    /// Drift of the log against its plan; absent for a setpoint, which shares the clock of the log.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub drift: Option<Drift>,
}

/// Evaluation of a motion at ascending times. Before and after the motion, the axes rest.
struct Walk<'a> {
    motion: &'a Trajectory,
    /// Index of the segment at the time of the last call.
    segment: usize,
}

impl<'a> Walk<'a> {
    fn new(motion: &'a Trajectory) -> Self {
        Self { motion, segment: 0 }
    }

    /// Returns position (mm) and velocity (mm/s) of [x, y] at `t_s` after the beginning of the motion; the velocity is
    /// 0 outside of it. `t_s` must not fall from call to call.
    fn state(&mut self, t_s: f64) -> ([f64; 2], [f64; 2]) {
        let breaks = self.motion.break_time_s();
        let t = t_s + breaks[0];
        let k = self.motion.len();
        let next = self.segment + 1;
        if next < k && breaks[next] <= t {
            // Samples that are compared may be many segments apart.
            self.segment += breaks[next..k].partition_point(|b| *b <= t);
        }
        let segment = self.motion.segment(self.segment);
        let u = (t - segment.start_s).clamp(0.0, segment.duration_s);
        let moves = f64::from(u8::from(u == t - segment.start_s));
        let velocity = segment
            .coefficient_mm
            .map(|c| moves * polynomial::evaluate(&polynomial::derivative(&c), u));
        (segment.position_mm(u), velocity)
    }
}

/// A reference motion, and the samples of a log (times, s, and measured positions [x, y], mm) that are compared with
/// it.
struct Pair<'a> {
    reference: &'a Trajectory,
    time_s: &'a [f64],
    actual_mm: &'a [[f64; 2]],
}

/// Sums over the samples of one axis, for the least squares of its delay.
#[derive(Clone, Copy, Default)]
struct Sums {
    /// Sums of e^2 (`square`), of e r' (`mixed`) and of r'^2 (`speed`), with the error e and the velocity r' of the
    /// reference.
    square: f64,
    mixed: f64,
    speed: f64,
}

impl Pair<'_> {
    /// Returns the sums of both axes over every `stride`-th sample, and the number of these samples. The reference is
    /// delayed by `delay_s` [x, y].
    fn sums(&self, delay_s: [f64; 2], stride: usize) -> ([Sums; 2], f64) {
        let mut sums = [Sums::default(); 2];
        let mut walks = [Walk::new(self.reference), Walk::new(self.reference)];
        let mut count = 0.0;
        for i in (0..self.time_s.len()).step_by(stride) {
            for a in 0..2 {
                let (r, v) = walks[a].state(self.time_s[i] - delay_s[a]);
                let e = self.actual_mm[i][a] - r[a];
                sums[a].square += e * e;
                sums[a].mixed += e * v[a];
                sums[a].speed += v[a] * v[a];
            }
            count += 1.0;
        }
        (sums, count)
    }

    /// Returns the stride, in samples, at which at most `samples` of the log are compared.
    fn stride(&self, samples: usize) -> usize {
        self.time_s.len().div_ceil(samples).max(1)
    }

    /// Returns the delay that both axes share, s, by at most `MOST_STEPS` Gauss-Newton steps from `from_s`. It need not
    /// have settled.
    fn common_delay_s(&self, from_s: f64) -> f64 {
        let stride = self.stride(LAG_SAMPLES);
        let mut delay_s = from_s;
        for _ in 0..MOST_STEPS {
            let ([x, y], _) = self.sums([delay_s; 2], stride);
            let speed = x.speed + y.speed;
            if speed <= 0.0 {
                break;
            }
            let step_s = -(x.mixed + y.mixed) / speed;
            delay_s += step_s;
            if step_s.abs() < SETTLED_S {
                break;
            }
        }
        delay_s
    }

    /// Returns for each axis the delay near `from_s`, s, the sums at this delay, and the number of samples in them. An
    /// axis that does not move, or whose delay has not settled, has `None`.
    fn delays(&self, from_s: f64) -> [Option<(f64, Sums, f64)>; 2] {
        let stride = self.stride(LAG_SAMPLES);
        let mut delay_s = [from_s; 2];
        let mut last = self.sums(delay_s, stride);
        let mut step_s = [0.0; 2];
        for _ in 0..MOST_STEPS {
            step_s = last.0.map(|s| if s.speed > 0.0 { -s.mixed / s.speed } else { 0.0 });
            delay_s = [delay_s[0] + step_s[0], delay_s[1] + step_s[1]];
            last = self.sums(delay_s, stride);
            if step_s.iter().all(|s| s.abs() < SETTLED_S) {
                break;
            }
        }
        let (sums, count) = last;
        [0, 1].map(|a| {
            let error_s = (sums[a].square / count / sums[a].speed).sqrt();
            let settled = step_s[a].abs() <= SETTLED_S.max(SETTLED_PART * error_s);
            if sums[a].speed > 0.0 && delay_s[a].is_finite() && settled {
                Some((delay_s[a], sums[a], count))
            } else {
                None
            }
        })
    }

    /// Returns the following error of both axes, without a drift, if the reference begins at the time `begin_s` of the
    /// log.
    fn errors(&self, begin_s: f64) -> Following {
        let mut walk = Walk::new(self.reference);
        let mut squares = [0.0; 2];
        let mut largest = [0.0; 2];
        let mut largest_at_s = [0.0; 2];
        for (t, p) in self.time_s.iter().zip(self.actual_mm) {
            let (r, _) = walk.state(t - begin_s);
            for a in 0..2 {
                let e = p[a] - r[a];
                squares[a] += e * e;
                if e.abs() > largest[a] {
                    largest[a] = e.abs();
                    largest_at_s[a] = t - self.time_s[0];
                }
            }
        }
        let n = self.time_s.len() as f64;
        let delays = self.delays(begin_s);
        let axes = [0, 1].map(|a| AxisError {
            rms_mm: (squares[a] / n).sqrt(),
            largest_mm: largest[a],
            largest_at_s: largest_at_s[a],
            lag_ms: delays[a].map(|(d, ..)| 1e3 * (d - begin_s)),
            // var d = var e / sum r'^2
            lag_standard_error_ms: delays[a].map(|(_, s, m)| 1e3 * (s.square / m / s.speed).sqrt()),
            rms_without_lag_mm: delays[a].map(|(_, s, m)| (s.square / m).sqrt()),
        });
        Following { reference_begins_s: begin_s - self.time_s[0], axes, drift: None }
    }

    /// Returns the drift of the log against the reference, which begins at `begin_s`. Returns `None` if the reference
    /// rests at all samples, or moves at too few times to tell a drift from a delay.
    fn drift(&self, begin_s: f64) -> Option<Drift> {
        let stride = self.stride(LAG_SAMPLES);
        let total_s = self.reference.total_time_s();
        let mut walk = Walk::new(self.reference);
        let [mut pp, mut pq, mut qq, mut pe, mut qe, mut ee] = [0.0; 6];
        for i in (0..self.time_s.len()).step_by(stride) {
            let t = self.time_s[i] - begin_s;
            let (r, v) = walk.state(t);
            for a in 0..2 {
                // Columns -r' and -r' t' of the least squares, and e.
                let p = -v[a];
                let q = -v[a] * (t - 0.5 * total_s);
                let e = self.actual_mm[i][a] - r[a];
                pp += p * p;
                pq += p * q;
                qq += q * q;
                pe += p * e;
                qe += q * e;
                ee += e * e;
            }
        }
        let determinant = pp * qq - pq * pq;
        if determinant <= 1e-12 * pp * qq {
            return None;
        }
        let [d0, drift] = [(qq * pe - pq * qe) / determinant, (pp * qe - pq * pe) / determinant];
        let count = 2.0 * self.time_s.len().div_ceil(stride) as f64;
        let rest = (ee - d0 * pe - drift * qe).max(0.0) / (count - 2.0).max(1.0);
        let standard_error = (rest * pp / determinant).sqrt();
        Some(Drift { drift, standard_error, at_the_end_s: drift * total_s })
    }
}

/// Returns the following error of a log against the setpoint that was recorded in the same log, without a drift.
pub fn beside_setpoint(time_s: &[f64], actual_mm: &[[f64; 2]], setpoint: &Trajectory) -> Following {
    let begin_s = time_s[0];
    Pair { reference: setpoint, time_s, actual_mm }.errors(begin_s)
}

/// Returns the following error of a log against the plan that was run. The beginning of the plan is searched for from
/// `most_offset_s` before to `most_offset_s` after the first sample.
///
/// # Errors
/// Refuses a log of another motion, and an offset that is negative or above 300 s.
pub fn beside_plan(
    time_s: &[f64],
    actual_mm: &[[f64; 2]],
    plan: &Trajectory,
    most_offset_s: f64,
) -> Result<Following, Invalid> {
    if !(0.0..=LONGEST_SEARCH_S).contains(&most_offset_s) {
        let problem = format!("is {most_offset_s}");
        let remedy =
            format!("give seconds from 0 to {LONGEST_SEARCH_S}, and cut the log with `from_s`");
        return Err(Invalid::whole("most_offset_s", problem, remedy));
    }
    let pair = Pair { reference: plan, time_s, actual_mm };
    let stride = pair.stride(SEARCH_SAMPLES);
    let steps = (most_offset_s / SEARCH_STEP_S).ceil() as i64;
    let begins_s = (-steps..=steps).map(|k| time_s[0] + k as f64 * SEARCH_STEP_S);
    let costs = begins_s.map(|begin_s| {
        let ([x, y], _) = pair.sums([begin_s; 2], stride);
        (x.square + y.square, begin_s)
    });
    let best = costs.min_by(|a, b| a.0.total_cmp(&b.0));
    let (_, begin_s) = best.expect("the grid has its middle");
    let begin_s = pair.common_delay_s(begin_s);
    let following = Following { drift: pair.drift(begin_s), ..pair.errors(begin_s) };
    check_same_motion(&following, plan)?;
    Ok(following)
}

/// Refuses a log whose RMS distance from the plan is above `OTHER_MOTION` of the extent of the plan: it is one of
/// another motion.
fn check_same_motion(following: &Following, plan: &Trajectory) -> Result<(), Invalid> {
    let n = plan.len() as f64;
    let starts: Vec<[f64; 2]> = plan.segments().map(|s| s.position_mm(0.0)).collect();
    let mean = [0, 1].map(|a| starts.iter().map(|p| p[a]).sum::<f64>() / n);
    let squares = starts.iter().map(|p| (p[0] - mean[0]).powi(2) + (p[1] - mean[1]).powi(2));
    let extent_mm = (squares.sum::<f64>() / n).sqrt();
    let apart_mm = following.axes[0].rms_mm.hypot(following.axes[1].rms_mm);
    if apart_mm.is_nan() || apart_mm > OTHER_MOTION * extent_mm {
        let problem = format!(
            "is {} mm RMS from the log at best, and extends over {} mm RMS",
            significant(apart_mm, 4),
            significant(extent_mm, 4)
        );
        let remedy = "give the plan that was run, in the frame of the machine (planish register apply), or a \
                      larger `most_offset_s` where the log begins long before it";
        return Err(Invalid::whole("planned", problem, remedy));
    }
    Ok(())
}

/// Part of a plan that a log covers, and the difference between the tool states of both.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Extent {
    /// Total duration of the plan, s.
    pub plan_s: f64,
    /// Duration of the plan before the first sample of the log, s; 0 below `SEEN_OF_A_SAMPLE` of a mean interval.
    pub before_the_log_s: f64,
    /// Duration of the plan after the last sample of the log, s; 0 below the same limit.
    pub after_the_log_s: f64,
    /// Duration of the whole plan with the tool on, s.
    pub tool_on_s: f64,
    /// Duration of the plan with the tool on that the log does not cover, s.
    pub tool_on_absent_s: f64,
    /// Duration within the plan in which the tool is on in either the log or the plan, but not in both, s. It is absent
    /// if the log has no tool state.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub tool_differs_s: Option<f64>,
    /// Duration of the log from its first to its last sample, s.
    #[serde(skip)]
    log_s: f64,
    /// Duration that both log and plan cover, with the tool off in the plan, s.
    #[serde(skip)]
    planned_off_s: f64,
    /// Duration that the samples cannot resolve, s: one mean interval between samples per switch of the plan within the
    /// log.
    #[serde(skip)]
    unresolved_s: f64,
}

impl Extent {
    /// Compares a log with `plan`, which begins at `begin_s` on the clock of `time_s`. `removes` is the tool state of
    /// the log in the intervals between its n samples (n-1), true if on; `None` if it has none.
    pub fn new(time_s: &[f64], removes: Option<&[bool]>, plan: &Trajectory, begin_s: f64) -> Self {
        let [first_s, last_s] = [time_s[0], time_s[time_s.len() - 1]];
        let to_log = begin_s - plan.break_time_s()[0];
        // The beginning of the plan is known to a fraction of an interval only.
        let least_s = SEEN_OF_A_SAMPLE * (last_s - first_s) / (time_s.len() - 1) as f64;
        let absent_s = [first_s - begin_s, begin_s + plan.total_time_s() - last_s];
        let [before_the_log_s, after_the_log_s] =
            absent_s.map(|s| if s > least_s { s } else { 0.0 });
        let mut tool_on_s = 0.0;
        let mut tool_on_absent_s = 0.0;
        for s in plan.segments().filter(|s| s.tool_on) {
            let from_s = s.start_s + to_log;
            let until_s = s.start_s + to_log + s.duration_s;
            let seen_s = (until_s.min(last_s) - from_s.max(first_s)).max(0.0);
            tool_on_s += s.duration_s;
            tool_on_absent_s += (s.duration_s - seen_s).max(0.0);
        }
        let planned = tool_of_plan(time_s, plan, begin_s);
        // Index and duration of the intervals in the plan. Before and after the plan its tool is off, and the state of
        // the machine does not matter.
        let mut intervals = Vec::new();
        for (i, t) in time_s.windows(2).enumerate() {
            let middle_s = 0.5 * (t[0] + t[1]) - begin_s;
            if (0.0..plan.total_time_s()).contains(&middle_s) {
                intervals.push((i, t[1] - t[0]));
            }
        }
        let tool_differs_s = removes.map(|on| {
            intervals.iter().filter(|(i, _)| on[*i] != planned[*i]).map(|(_, s)| s).sum()
        });
        let planned_off_s = intervals.iter().filter(|(i, _)| !planned[*i]).map(|(_, s)| s).sum();
        let switches = planned.windows(2).filter(|p| p[0] != p[1]).count() as f64;
        Self {
            plan_s: plan.total_time_s(),
            before_the_log_s,
            after_the_log_s,
            tool_on_s,
            tool_on_absent_s,
            tool_differs_s,
            log_s: last_s - first_s,
            planned_off_s,
            unresolved_s: switches * (last_s - first_s) / planned.len() as f64,
        }
    }

    /// Returns the reason why the log is not one of the whole plan, or why its tool is not that of the plan; otherwise
    /// `None`. With `cut`, the user has cut the log, and it may be shorter than the plan.
    pub fn drawback(&self, cut: bool) -> Option<String> {
        if !cut && self.tool_on_absent_s > MOST_ABSENCE * self.tool_on_s {
            return Some(format!(
                "the log is not one of the whole run: {}; what it removes is that of this part only",
                self.absence()
            ));
        }
        let differs_s = self.tool_differs_s?;
        let in_log_s = self.log_s.min(self.plan_s);
        let most_s = (MOST_DIFFERENCE * self.plan_s).min(0.5 * in_log_s) + self.unresolved_s;
        if differs_s <= most_s {
            return None;
        }
        let inverted = differs_s > 0.5 * in_log_s;
        let question = if inverted { "; is it inverted?" } else { "; is it that of this run?" };
        let difference = self.difference(differs_s);
        Some(format!("the tool of the log is not that of the plan: {difference}{question}"))
    }

    /// Returns the warnings about missing parts of the plan, about differing tool states, and about a log without a
    /// tool state although the plan switches the tool off.
    pub fn warnings(&self) -> Vec<String> {
        let mut warnings = Vec::new();
        if self.tool_on_absent_s > USUAL_ABSENCE * self.tool_on_s {
            warnings.push(self.absence());
        }
        match self.tool_differs_s {
            Some(differs_s) if differs_s > USUAL_DIFFERENCE * self.plan_s + self.unresolved_s => {
                warnings.push(self.difference(differs_s));
            }
            None if self.planned_off_s > USUAL_DIFFERENCE * self.plan_s => warnings.push(format!(
                "the log does not tell whether the tool is on, and the plan has it off for {} s of it: the motion \
                 removes there, too; give `tool_on`, `current` or `tool_from_plan`",
                significant(self.planned_off_s, 4)
            )),
            _ => {}
        }
        warnings
    }

    /// Returns a sentence about the part of the plan that the log does not cover.
    fn absence(&self) -> String {
        let [log, plan, before, after, absent, on] = [
            self.log_s,
            self.plan_s,
            self.before_the_log_s,
            self.after_the_log_s,
            self.tool_on_absent_s,
            self.tool_on_s,
        ]
        .map(|s| significant(s, 4));
        format!(
            "the log holds {log} s, and the plan takes {plan} s: it lacks the first {before} s and the last {after} s \
             of the plan, in which the plan has the tool on for {absent} s of {on} s"
        )
    }

    /// Returns a sentence about the duration `differs_s` in which the tool states differ.
    fn difference(&self, differs_s: f64) -> String {
        let [differs, log] = [differs_s, self.log_s.min(self.plan_s)].map(|s| significant(s, 4));
        format!(
            "in {differs} s of {log} s one of the log and the plan has the tool on, and the other off"
        )
    }
}

/// Returns the tool state of the plan in the intervals between the n samples of a log (n-1), true if on. The plan
/// begins at `begin_s`; before and after it the tool is off.
pub fn tool_of_plan(time_s: &[f64], plan: &Trajectory, begin_s: f64) -> Vec<bool> {
    let breaks = plan.break_time_s();
    let middles_s = time_s.windows(2).map(|t| 0.5 * (t[0] + t[1]) - begin_s + breaks[0]);
    let is_on = middles_s.map(|middle_s| {
        let i = breaks.partition_point(|b| *b <= middle_s);
        i > 0 && i < breaks.len() && plan.tool_on()[i - 1]
    });
    is_on.collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::trace::motion::{Between, through};

    /// Returns a position [x, y], mm, at the time `t`, s: x swings, and y advances slowly.
    fn at(t: f64) -> [f64; 2] {
        [40.0 * (0.8 * t).sin(), 0.2 * t]
    }

    fn plan() -> Trajectory {
        let time_s: Vec<f64> = (0..=2000).map(|i| f64::from(i) * 0.01).collect();
        let p: Vec<_> = time_s.iter().map(|t| at(*t)).collect();
        through(&time_s, &p, f64::INFINITY, Between::Cubic).unwrap()
    }

    #[test]
    fn a_delay_is_found_with_its_sign() {
        let plan = plan();
        let time_s: Vec<f64> = (0..20_000).map(|i| f64::from(i) * 1e-3).collect();
        // x comes 4 ms late, y 1 ms early.
        let late = |t: f64| [at((t - 4e-3).max(0.0))[0], at(t + 1e-3)[1]];
        let actual: Vec<_> = time_s.iter().map(|t| late(*t)).collect();
        let found = beside_setpoint(&time_s, &actual, &plan);
        let lag = found.axes.map(|a| a.lag_ms.unwrap());
        // The ends, where the log rests and the plan does not, are 1e-4 of the samples.
        assert!((lag[0] - 4.0).abs() < 0.02 && (lag[1] + 1.0).abs() < 0.02, "{lag:?}");
        // 4 ms at up to 32 mm/s.
        assert!((found.axes[0].largest_mm - 0.128).abs() < 1e-3, "{found:?}");
        // Regression bound: 1.9e-6 was seen.
        assert!(found.axes[0].rms_without_lag_mm.unwrap() < 0.02 * found.axes[0].rms_mm);
    }

    #[test]
    fn the_clock_of_a_log_is_found_beside_a_plan() {
        let plan = plan();
        for begin_s in [-0.777, 0.0, 2.345] {
            let time_s: Vec<f64> = (0..22_000).map(|i| f64::from(i) * 1e-3).collect();
            let actual: Vec<_> =
                time_s.iter().map(|t| at((t - begin_s).clamp(0.0, 20.0))).collect();
            let found = beside_plan(&time_s, &actual, &plan, 5.0).unwrap();
            // Regression bound: 2.4e-11 s was seen.
            assert!((found.reference_begins_s - begin_s).abs() < 1e-6, "{begin_s}: {found:?}");
            // Regression bound: 1.6e-7 mm was seen: cubics between samples of 1 ms.
            assert!(found.axes.iter().all(|a| a.rms_mm < 1e-5), "{found:?}");
            let on = tool_of_plan(&time_s, &plan, found.reference_begins_s);
            let seconds = on.iter().filter(|on| **on).count() as f64 * 1e-3;
            let whole = 20.0 + begin_s.min(0.0);
            // Two samples.
            assert!((seconds - whole.min(21.999 - begin_s.max(0.0))).abs() < 2e-3, "{seconds}");
        }
    }

    /// The search moves the phase of r = sin wt against its log c sin(wt - p) by -c sin(phase - p) in a step. For c = 2.5
    /// the phase goes to and fro for ever. Earlier, the phase of the last step was reported as the lag.
    #[test]
    fn a_delay_that_does_not_settle_is_not_reported() {
        let time_s: Vec<f64> = (0..20_000).map(|i| f64::from(i) * 1e-3).collect();
        let sine = |of: f64, by_s: f64| -> Vec<[f64; 2]> {
            time_s
                .iter()
                .map(|t| [of * (2.0 * (t - by_s)).sin(), (2.0 * (t - by_s)).cos()])
                .collect()
        };
        let setpoint = through(&time_s, &sine(1.0, 0.0), f64::INFINITY, Between::Cubic).unwrap();
        let [x, y] = beside_setpoint(&time_s, &sine(2.5, 0.05), &setpoint).axes;
        assert!(x.lag_ms.is_none() && x.rms_without_lag_mm.is_none(), "{x:?}");
        // Regression bound: 1.4e-14 ms was seen.
        assert!((y.lag_ms.unwrap() - 50.0).abs() < 1.0, "{y:?}");
    }

    #[test]
    fn another_motion_is_refused_and_an_axis_at_rest_has_no_lag() {
        let plan = plan();
        let time_s: Vec<f64> = (0..2000).map(|i| f64::from(i) * 0.01).collect();
        let other: Vec<_> = time_s.iter().map(|t| [at(*t)[1], at(*t)[0]]).collect();
        let said = beside_plan(&time_s, &other, &plan, 5.0).unwrap_err().to_string();
        assert!(said.contains("planned: is") && said.contains("RMS from the log"), "{said}");
        let still: Vec<_> = time_s.iter().map(|t| [at(*t)[0], 3.0]).collect();
        let setpoint = through(&time_s, &still, f64::INFINITY, Between::Cubic).unwrap();
        let found = beside_setpoint(&time_s, &still, &setpoint);
        assert!(found.axes[0].lag_ms.is_some() && found.axes[1].lag_ms.is_none());
    }

    /// Checks a log whose clock runs 40 parts per million fast, as two quartz oscillators may differ.
    #[test]
    fn a_drift_against_the_plan_is_named() {
        let plan = plan();
        let log = |drift: f64, noise_mm: f64| {
            let time_s: Vec<f64> = (0..20_000).map(|i| f64::from(i) * 1e-3).collect();
            let noise = |i: usize| noise_mm * (i as f64 * 12.9898).sin();
            let p: Vec<_> = (time_s.iter().enumerate())
                .map(|(i, t)| at(t / (1.0 + drift)).map(|p| p + noise(i)))
                .collect();
            beside_plan(&time_s, &p, &plan, 1.0).unwrap().drift.unwrap()
        };
        for drift in [40e-6, -40e-6] {
            let found = log(drift, 0.0);
            // The delay is fitted first, and the drift is of first order.
            assert!((found.drift / drift - 1.0).abs() < 0.01, "{found:?}");
            let said = found.warning().unwrap();
            let how = if drift > 0.0 { "faster" } else { "slower" };
            assert!(said.contains("40 parts per million") && said.contains(how), "{said}");
        }
        // Regression bound: 1e-8 was allowed for cubics between samples of 1 ms.
        assert!(log(0.0, 0.0).drift.abs() < 1e-7 && log(0.0, 0.0).warning().is_none());
        // A micrometre of noise.
        assert!(log(0.0, 1e-3).warning().is_none());
    }
}
