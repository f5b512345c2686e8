//! Times of the samples of a log: from time stamps in the log, or from a sampling rate.
//!
//! Time stamps are checked against equal steps of h, the inverse of the rate, or the usual step where no
//! rate is given. With n_i = sum of round(dt/h), the number of steps up to sample i, and the least-squares
//! line through the stamps over n_i h,
//!
//! ```text
//! t_i = t_0 + (1 + d) n_i h + e_i
//! ```
//!
//! d is the drift of the clock against the rate and e_i its scatter. A step of more than 1.5 h is a gap:
//! samples were lost, and the motion there is not known.
//!
//! Stamps are rounded to their last digit, which may be coarse: 8.6 us for days of a spreadsheet with ten decimals. Where
//! all e_i are within half of the last digit, the samples are equidistant as far as the log tells, and equal steps are taken
//! in the place of the stamps. Their rate has as few digits as the stamps allow.

use planish_types::{
    Invalid,
    text::significant,
    units::{Quantity, Unit},
};
use serde::Serialize;

use super::columns::Column;

/// Largest step between two samples without a gap, in usual steps. Larger: a lost sample goes unnoticed. Smaller: the
/// scatter of the stamps passes for gaps. Chosen: midway between one step and the two steps around a lost sample.
const GAP: f64 = 1.5;

/// Largest number of gaps that the manifest lists. Larger: longer manifests of bad logs. Smaller: fewer
/// gaps to look at.
const MOST_NAMED: usize = 10;

/// Largest relative drift of a clock without a warning. Larger: a larger shift of the removal along the path goes
/// unnoticed; at this value it is the motion of 36 ms after an hour. Smaller: warns of the usual difference of two
/// clocks.
pub(super) const USUAL_DRIFT: f64 = 1e-5;

/// Largest distance of the time stamps from equal steps, in units of their last digit, at which they count as rounded
/// equal steps. Derived: rounding is within 0.5 units, and the numbers themselves are rounded to doubles.
const ROUNDING: f64 = 0.51;

/// Smallest unit of the last digit of the time stamps, relative to their step, at which equal steps replace them.
/// Larger: rounded stamps make accelerations that the machine did not have. Smaller: no gain, because the rounding is
/// below that of positions.
const COARSE: f64 = 1e-6;

/// Latest time that the first time stamp may have, s since 1970: the year 2200. A later one is refused, because it is
/// in another unit. Larger: wrong units pass.
const LATEST_S: f64 = 7.3e9;

/// Smallest first time stamp without a unit that counts as nanoseconds since 1970: the year 2000. As microseconds or a
/// longer unit it would be far in the future.
const LEAST_UNIX_NS: f64 = 9.4e17;

/// Largest RMS scatter of the stamps without a warning, relative to their step. Larger: does not notice
/// stamps that make wrong velocities. Smaller: warns of usable stamps. At this value, independent scatter
/// makes the velocity between two samples wrong by 14 % RMS.
const USUAL_SCATTER: f64 = 0.1;

/// Time stamps and settings from which the times of the samples follow.
pub struct Timing<'a> {
    /// Column of time stamps; `None` if the log has none, so that the times follow from `rate_hz`.
    pub stamps: Option<&'a Column>,
    /// Number of samples whose times are wanted, from the first one.
    pub samples: usize,
    /// Unit of the stamps that the user states, or `None`.
    pub unit: Option<Unit>,
    /// Sample time of the controller, s, for stamps that count samples.
    pub sample_s: Option<f64>,
    /// Sampling rate that was set for the log, Hz; `None` takes the usual step of the time stamps.
    pub rate_hz: Option<f64>,
    /// Longest gap that is bridged by a straight line, s; a longer one is refused.
    pub most_gap_s: f64,
}

/// A gap between two time stamps: a step longer than `GAP` usual steps, in which samples were lost.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Gap {
    /// Index of the last sample before the gap, counted from 0.
    pub index: usize,
    /// Time of that sample since the first sample, s.
    pub at_s: f64,
    /// Time to the next sample, s.
    pub lasts_s: f64,
    /// Number of samples that are missing in the gap, at least 1: the rounded number of steps, minus 1.
    pub missing: usize,
}

/// Comparison of the time stamps with equal steps of the sampling rate.
#[derive(Clone, Debug, Serialize)]
pub struct Clock {
    /// Sampling rate, Hz: the stated one, or that of the time stamps by least squares.
    pub rate_hz: f64,
    /// Source of the rate: "asked for" (the user stated it) or "the usual step of the time stamps".
    pub rate_from: &'static str,
    /// True if the log has time stamps; false if the times follow from the rate alone.
    pub stamps: bool,
    /// Number of gaps, all of which are bridged by straight lines.
    pub gaps: usize,
    /// Total duration of the gaps, s, from the sample before each to the sample after it.
    pub gaps_last_s: f64,
    /// At most 10 gaps: the largest first, then others, not sorted.
    pub named_gaps: Vec<Gap>,
    /// Relative drift of the stamps against the stated rate; positive if the samples are further apart in time than it
    /// says. Present if the log has stamps and the rate was given.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub drift: Option<f64>,
    /// Drift accumulated at the end of the log, s; present as `drift` is.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub drift_at_the_end_s: Option<f64>,
    /// RMS distance of the stamps from the least-squares line of the module (e_i), s; 0 without stamps.
    pub scatter_s: f64,
    /// Unit of the last digit of the stamps, s. Present if the stamps are equal steps rounded to it, which then replace
    /// them.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rounded_to_s: Option<f64>,
}

impl Timing<'_> {
    /// Returns the times since the first sample, s (n), and their comparison with equal steps. Equal steps replace
    /// stamps that are rounded to a coarse digit.
    ///
    /// # Errors
    /// Refuses stamps that do not ascend, gaps longer than `most_gap_s`, and what `unit_s` refuses. Refuses a log with
    /// neither stamps nor a rate.
    pub fn clock(&self) -> Result<(Vec<f64>, Clock), Invalid> {
        let Some(stamps) = self.stamps else { return self.by_rate() };
        let unit_s = self.unit_s(stamps)?;
        let first = stamps.values[0];
        let mut time_s: Vec<f64> =
            stamps.values[..self.samples].iter().map(|t| (t - first) * unit_s).collect();
        if let Some(i) = (1..time_s.len()).find(|&i| time_s[i] <= time_s[i - 1]) {
            let [before, after] = [i - 1, i].map(|i| stamps.first + stamps.values[i]);
            let problem = format!("is {after} after {before}");
            let remedy =
                "time stamps ascend: drop repeated samples, or give `rate_hz` instead of `time`";
            return Err(Invalid::at_index("time", i, problem, remedy));
        }
        let (step_s, rate_from) = match self.rate_hz {
            Some(rate) => (1.0 / rate, "asked for"),
            None => (usual_step(&time_s), "the usual step of the time stamps"),
        };
        let (mut clock, count) = self.compared(&time_s, step_s, rate_from)?;
        let resolution_s = stamps.resolution * unit_s;
        if resolution_s > COARSE * step_s
            && let Some(rate_hz) = even_rate_hz(&count, &time_s, ROUNDING * resolution_s)
        {
            time_s.clear();
            time_s.extend(count.iter().map(|n| n / rate_hz));
            clock.rounded_to_s = Some(resolution_s);
            if self.rate_hz.is_none() {
                clock.rate_hz = rate_hz;
            }
        } else if self.rate_hz.is_none() {
            clock.rate_hz = 1.0 / line(&count, &time_s).slope;
        }
        Ok((time_s, clock))
    }

    /// Returns equal steps of the sampling rate, for a log without time stamps. Refuses an absent rate.
    fn by_rate(&self) -> Result<(Vec<f64>, Clock), Invalid> {
        let Some(rate_hz) = self.rate_hz else {
            let remedy = "give `rate_hz`, or `time` with the column of the time stamps";
            return Err(Invalid::whole("rate_hz", "is not in a log without time stamps", remedy));
        };
        let time_s = (0..self.samples).map(|i| i as f64 / rate_hz).collect();
        let clock = Clock {
            rate_hz,
            rate_from: "asked for",
            stamps: false,
            gaps: 0,
            gaps_last_s: 0.0,
            named_gaps: Vec::new(),
            drift: None,
            drift_at_the_end_s: None,
            scatter_s: 0.0,
            rounded_to_s: None,
        };
        Ok((time_s, clock))
    }

    /// Returns the length of a unit of the time stamps, s, from the settings or the log. A number of `LEAST_UNIX_NS` or
    /// more without a unit is in ns. Refuses a contradiction, any other absent unit, a missing `sample_s` for stamps in
    /// samples, and a first stamp later than the year 2200.
    pub(super) fn unit_s(&self, stamps: &Column) -> Result<f64, Invalid> {
        let unit = match (self.unit, stamps.unit) {
            (Some(requested), Some(stated)) if requested != stated => {
                let problem =
                    format!("is {requested}, but the log has \"{}\" in {stated}", stamps.name);
                let remedy = "leave `time_unit` out, or correct the log";
                return Err(Invalid::whole("time_unit", problem, remedy));
            }
            (requested, stated) => requested.or(stated),
        };
        let unit = match unit {
            Some(unit) => unit,
            // No other unit makes a time of so large a number.
            None if stamps.first >= LEAST_UNIX_NS => Unit::read("ns", &[]).expect("a known unit"),
            None => {
                let problem =
                    format!("of the time stamps is not in the log{}", epoch(stamps.first));
                let remedy =
                    "give `time_unit`: s, ms, us, ns, min, h, d (days), or samples with `sample_s`";
                return Err(Invalid::whole("time_unit", problem, remedy));
            }
        };
        if unit.quantity() == Quantity::Samples {
            return self.sample_s.ok_or_else(|| {
                let remedy = "give `sample_s`, the sample time of the controller";
                Invalid::whole("sample_s", "is not in a log in samples", remedy)
            });
        }
        let unit_s = unit.size(0);
        if stamps.first * unit_s > LATEST_S {
            let problem = format!(
                "is {unit}, and the first time stamp {}{}",
                stamps.first,
                epoch(stamps.first)
            );
            let remedy = "it would be later than the year 2200: give the right `time_unit`, or correct the name of the column";
            return Err(Invalid::whole("time_unit", problem, remedy));
        }
        Ok(unit_s)
    }

    /// Returns the comparison of the stamps with steps of `step_s`, and the number of steps (n_i of the module) up to
    /// each sample. `rate_from` is the source of the step. Refuses a gap longer than `most_gap_s`.
    fn compared(
        &self,
        time_s: &[f64],
        step_s: f64,
        rate_from: &'static str,
    ) -> Result<(Clock, Vec<f64>), Invalid> {
        let mut named: Vec<Gap> = Vec::new();
        let mut gaps = 0;
        let mut gaps_last_s = 0.0;
        let mut count = vec![0.0; time_s.len()];
        for i in 1..time_s.len() {
            let lasts_s = time_s[i] - time_s[i - 1];
            let steps = (lasts_s / step_s).round().max(1.0);
            count[i] = count[i - 1] + steps;
            if lasts_s <= GAP * step_s {
                continue;
            }
            let missing = (steps as usize).saturating_sub(1).max(1);
            let gap = Gap { index: i - 1, at_s: time_s[i - 1], lasts_s, missing };
            if lasts_s > self.most_gap_s {
                let problem = format!(
                    "{} s after the first sample: nothing is known for {} s, some {missing} samples",
                    significant(gap.at_s, 6),
                    significant(lasts_s, 4)
                );
                let remedy = "record again without gaps, cut the log there with `until_s`, or bridge it by a \
                              straight line with a larger `most_gap_s`";
                return Err(Invalid::at_index("time", gap.index, problem, remedy));
            }
            gaps += 1;
            gaps_last_s += lasts_s;
            if named.first().is_some_and(|largest| lasts_s > largest.lasts_s) {
                named.insert(0, gap);
            } else {
                named.push(gap);
            }
            named.truncate(MOST_NAMED);
        }
        let FittedLine { slope, scatter: scatter_s, .. } = line(&count, time_s);
        let drift = self.rate_hz.map(|_| slope / step_s - 1.0);
        let clock = Clock {
            rate_hz: 1.0 / step_s,
            rate_from,
            stamps: true,
            gaps,
            gaps_last_s,
            named_gaps: named,
            drift,
            drift_at_the_end_s: drift.map(|d| d * count[count.len() - 1] * step_s),
            scatter_s,
            rounded_to_s: None,
        };
        Ok((clock, count))
    }
}

impl Clock {
    /// Returns the longest step between two samples that is no gap, s; infinity without time stamps.
    pub fn longest_step_s(&self) -> f64 {
        if self.stamps { GAP / self.rate_hz } else { f64::INFINITY }
    }

    /// Returns the warnings about gaps, drift and scatter that are beyond the usual.
    pub(super) fn warnings(&self) -> Vec<String> {
        let mut warnings = Vec::new();
        if let Some(largest) = self.named_gaps.first() {
            warnings.push(format!(
                "{} gap(s) of {} s together are bridged by straight lines; the largest: {} s ({} samples) \
                 after sample {}, at {} s",
                self.gaps,
                significant(self.gaps_last_s, 4),
                significant(largest.lasts_s, 4),
                largest.missing,
                largest.index,
                significant(largest.at_s, 6)
            ));
        }
        if let (Some(drift), Some(end_s)) = (self.drift, self.drift_at_the_end_s)
            && drift.abs() > USUAL_DRIFT
            && end_s.abs() > self.rounded_to_s.unwrap_or(0.0)
        {
            let how = if drift > 0.0 { "slow" } else { "fast" };
            warnings.push(format!(
                "the samples come {} parts per million too {how} for {} Hz by the time stamps: {} s at the end",
                significant(1e6 * drift.abs(), 4),
                significant(self.rate_hz, 6),
                significant(end_s, 4)
            ));
        }
        if self.scatter_s * self.rate_hz <= USUAL_SCATTER {
            return warnings;
        }
        warnings.push(match self.rounded_to_s {
            Some(rounded_s) => format!(
                "the time stamps are rounded to {} s, {} of their step: equal steps are within that, and are taken",
                significant(rounded_s, 3),
                significant(rounded_s * self.rate_hz, 2)
            ),
            None => format!(
                "the time stamps scatter by {} s RMS, {} of their step: if the samples are equidistant, give \
                 their rate and no time stamps",
                significant(self.scatter_s, 3),
                significant(self.scatter_s * self.rate_hz, 2)
            ),
        });
        warnings
    }
}

/// Returns a note for a message about the probable unit of the first time stamp, if it is a date from 1990 to 2100 in
/// some unit since 1970 or in days of a spreadsheet. The note is empty if it is none.
fn epoch(first: f64) -> &'static str {
    // From the year 1990 to 2100.
    const SINCE_1970_S: std::ops::Range<f64> = 6.3e8..4.1e9;
    let units = [
        (1.0, " (in s since 1970 it is a date of these years)"),
        (1e-3, " (in ms since 1970 it is a date of these years)"),
        (1e-6, " (in us since 1970 it is a date of these years)"),
        (1e-9, " (in ns since 1970 it is a date of these years)"),
        // Days since the end of 1899.
        (86_400.0, " (in days of a spreadsheet it is a date of these years)"),
    ];
    for (unit_s, words) in units {
        let offset_s = if unit_s == 86_400.0 { 25_569.0 * 86_400.0 } else { 0.0 };
        if SINCE_1970_S.contains(&(first * unit_s - offset_s)) {
            return words;
        }
    }
    ""
}

/// Returns the usual step between two stamps, s: the mean of the steps from half to one and a half of their median. The
/// median alone would be one of the two lengths that rounded steps have.
fn usual_step(time_s: &[f64]) -> f64 {
    let mut steps: Vec<f64> = time_s.windows(2).map(|t| t[1] - t[0]).collect();
    let middle = steps.len() / 2;
    let median = *steps.select_nth_unstable_by(middle, f64::total_cmp).1;
    steps.retain(|step| (0.5 * median..=GAP * median).contains(step));
    steps.iter().sum::<f64>() / steps.len() as f64
}

/// Returns the sampling rate, Hz, with the fewest digits at which all stamps are within `within_s` of equal steps.
/// `count` is the number of steps up to each stamp. Returns `None` if no rate fits; if only one with many digits fits,
/// that of the least-squares line.
fn even_rate_hz(count: &[f64], time_s: &[f64], within_s: f64) -> Option<f64> {
    let rate_hz = 1.0 / line(count, time_s).slope;
    if spread_s(count, time_s, rate_hz) > 2.0 * within_s {
        return None;
    }
    for decimals in 0..8 {
        let Ok(short) = format!("{rate_hz:.decimals$e}").parse::<f64>() else { continue };
        if short > 0.0 && spread_s(count, time_s, short) <= 2.0 * within_s {
            return Some(short);
        }
    }
    Some(rate_hz)
}

/// Returns the largest minus the smallest difference, s, between the stamps and equal steps of a rate. `count` is the
/// number of steps up to each stamp.
fn spread_s(count: &[f64], time_s: &[f64], rate_hz: f64) -> f64 {
    let away = count.iter().zip(time_s).map(|(n, t)| t - n / rate_hz);
    let low = away.clone().fold(f64::INFINITY, f64::min);
    away.fold(f64::NEG_INFINITY, f64::max) - low
}

/// A least-squares line of y over x: slope and scatter.
struct FittedLine {
    slope: f64,
    /// RMS distance of the points from the line, in y.
    scatter: f64,
}

/// Fits a least-squares line to `y` over `x`. The values of `x` must not be all the same.
fn line(x: &[f64], y: &[f64]) -> FittedLine {
    let n = x.len() as f64;
    let [mx, my] = [x, y].map(|v| v.iter().sum::<f64>() / n);
    let points = x.iter().zip(y).map(|(x, y)| (x - mx, y - my));
    let product: f64 = points.clone().map(|(x, y)| x * y).sum();
    let square: f64 = points.clone().map(|(x, _)| x * x).sum();
    let slope = product / square;
    let scatter = (points.map(|(x, y)| (y - slope * x).powi(2)).sum::<f64>() / n).sqrt();
    FittedLine { slope, scatter }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::trace::columns::Role;

    fn column(values: Vec<f64>) -> Column {
        Column::of_values(Role::Time, "t".into(), None, values)
    }

    fn timing(stamps: Option<&Column>, samples: usize) -> Timing<'_> {
        let (unit, sample_s, rate_hz) = (Unit::read("ms", &[]), None, None);
        Timing { stamps, samples, unit, sample_s, rate_hz, most_gap_s: 0.1 }
    }

    #[test]
    fn drift_is_the_slope_of_the_stamps_against_the_rate() {
        // 300 parts per million slow, from a late start, three samples lost after sample 400.
        let stamp = |i: usize| 5e8 + 1.0003 * (i + if i > 400 { 3 } else { 0 }) as f64;
        let stamps = column((0..1000).map(stamp).collect());
        let by_rate = Timing { rate_hz: Some(1000.0), ..timing(Some(&stamps), 1000) };
        let (time_s, clock) = by_rate.clock().unwrap();
        assert_eq!((time_s[0], clock.gaps), (0.0, 1));
        // Stamps of 5e8 have 6e-8 ms.
        assert!((clock.drift.unwrap() - 3e-4).abs() < 1e-10, "{clock:?}");
        // Stamps have 6e-11 s, as above.
        assert!((clock.drift_at_the_end_s.unwrap() - 3e-4 * 1.002).abs() < 1e-9);
        let gap = &clock.named_gaps[0];
        assert_eq!((gap.index, gap.missing), (400, 3));
        // Stamps have 6e-11 s, as above.
        assert!((gap.lasts_s - 4.0012e-3).abs() < 1e-9);
        let warnings = clock.warnings();
        assert!(warnings[0].contains("after sample 400"), "{warnings:?}");
        assert!(warnings[1].contains("300 parts per million too slow for 1000 Hz"), "{warnings:?}");
        // Without a rate there is nothing to drift against.
        let (_, clock) = timing(Some(&stamps), 1000).clock().unwrap();
        // Stamps of 6e-11 s over 1 s: 1e-7 Hz.
        assert!(clock.drift.is_none() && (clock.rate_hz - 1e3 / 1.0003).abs() < 1e-3);
        // Stamps have 6e-11 s, as above.
        assert!(clock.scatter_s < 1e-9);
    }

    #[test]
    fn what_is_no_clock_is_refused() {
        let said = |values: Vec<f64>| {
            let n = values.len();
            timing(Some(&column(values)), n).clock().unwrap_err().to_string()
        };
        assert!(said(vec![0.0, 1.0, 1.0, 2.0]).contains("time[2]: is 1 after 1"));
        let long = said(vec![0.0, 1.0, 2.0, 103.0, 104.0]);
        assert!(
            long.contains(
                "time[2]: 0.002 s after the first sample: nothing is known for 0.101 s, some 100"
            ),
            "{long}"
        );
        let none = timing(None, 5).clock().unwrap_err().to_string();
        assert!(none.contains("rate_hz: is not in a log without time stamps"), "{none}");
        let stamps = column(vec![0.0, 1.0]);
        let in_samples = Timing { unit: Unit::read("samples", &[]), ..timing(Some(&stamps), 2) };
        assert!(in_samples.clock().unwrap_err().to_string().contains("`sample_s`"));
        let unknown = Timing { unit: None, ..timing(Some(&stamps), 2) };
        assert!(unknown.clock().unwrap_err().to_string().contains("`time_unit`"));
    }

    #[test]
    fn scattered_stamps_are_named() {
        let stamps = column((0..500).map(|i| f64::from(i * 10 + i % 3 * 2)).collect());
        let (_, clock) = timing(Some(&stamps), 500).clock().unwrap();
        // 0, 2, 4 ms in turn scatter by the root of 8/3 ms about their mean.
        assert!((clock.scatter_s - (8.0_f64 / 3.0).sqrt() * 1e-3).abs() < 1e-5, "{clock:?}");
        assert!(clock.warnings().iter().any(|w| w.contains("scatter")));
    }

    #[test]
    fn rounded_stamps_are_equal_steps() {
        // 400 Hz in whole ms: 0, 3, 5, 8 and so on.
        let stamps = |rate: f64, last: f64| {
            let values = (0..200).map(|i| (f64::from(i) / rate * 1e3 / last).round() * last);
            Column { resolution: last, ..column(values.collect()) }
        };
        for (rate, last) in [(400.0, 1.0), (1000.0, 0.00864), (512.0, 0.1)] {
            let stamps = stamps(rate, last);
            let (time_s, clock) = timing(Some(&stamps), 200).clock().unwrap();
            assert_eq!(clock.rate_hz, rate);
            assert_eq!(clock.rounded_to_s, Some(last * 1e-3));
            assert_eq!(time_s[199], 199.0 / rate);
            assert_eq!(clock.gaps, 0);
        }
        // Stamps that scatter by more than their last digit are kept.
        let scattered = Column { resolution: 1e-3, ..stamps(400.0, 1.0) };
        let (time_s, clock) = timing(Some(&scattered), 200).clock().unwrap();
        assert!(clock.rounded_to_s.is_none() && (time_s[1] - 3e-3).abs() < 1e-15, "{clock:?}");
    }

    #[test]
    fn epochs_are_named_and_nanoseconds_taken() {
        let said = |first: f64, unit: &str| {
            let stamps = Column { first, ..column(vec![0.0, 1.0]) };
            let timing = Timing { unit: Unit::read(unit, &[]), ..timing(Some(&stamps), 2) };
            timing.clock().map(|(time_s, _)| time_s[1]).map_err(|e| e.to_string())
        };
        assert_eq!(said(1.76e18, ""), Ok(1e-9));
        for (first, unit) in [(1.76e9, "s"), (1.76e12, "ms"), (1.76e15, "us"), (46_082.5, "days")] {
            let asked = said(first, "").unwrap_err();
            assert!(
                asked.contains(&format!("in {unit} ")) && asked.contains("`time_unit`"),
                "{asked}"
            );
        }
        let wrong = said(1.76e12, "s").unwrap_err();
        assert!(wrong.contains("in ms since 1970") && wrong.contains("the year 2200"), "{wrong}");
        assert!(!said(5.0, "").unwrap_err().contains("1970"));
    }
}
