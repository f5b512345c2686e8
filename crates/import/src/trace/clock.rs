//! Times of the samples: stamps in the log, or a rate.
//!
//! Time stamps are checked against equal steps of h, the inverse of the rate, or the median step where no
//! rate is given. With n_i = sum of round(dt/h), the number of steps up to sample i, and the least-squares
//! line through the stamps over n_i h,
//!
//! ```text
//! t_i = t_0 + (1 + d) n_i h + e_i
//! ```
//!
//! d is the drift of the clock against the rate and e_i its scatter. A step of more than 1.5 h is a gap:
//! samples were lost, and the motion there is not known.

use planish_types::{Invalid, text::significant};
use serde::Serialize;

use super::{TimeUnit, columns::Column};

/// Step between two samples, in usual steps, above which there is a gap. Larger: a lost sample goes
/// unnoticed. Smaller: the scatter of the stamps passes for gaps. Chosen: midway between one step and the
/// two steps of a lost sample.
const GAP: f64 = 1.5;

/// Largest number of gaps that the manifest lists. Larger: longer manifests of bad logs. Smaller: fewer
/// gaps to look at.
const MOST_NAMED: usize = 10;

/// Largest drift of the clock without a warning, relative. Larger: does not notice a wrong rate. Smaller:
/// warns of usual clocks. Chosen: quartz oscillators are within 1e-4 of their frequency.
const USUAL_DRIFT: f64 = 1e-4;

/// Largest RMS scatter of the stamps without a warning, relative to their step. Larger: does not notice
/// stamps that make wrong velocities. Smaller: warns of usable stamps. At this value, independent scatter
/// makes the velocity between two samples wrong by 14 % RMS.
const USUAL_SCATTER: f64 = 0.1;

/// Inputs for the times of the samples.
pub struct Timing<'a> {
    /// Time stamps, where the log has some.
    pub stamps: Option<&'a Column>,
    /// Number of samples.
    pub samples: usize,
    /// Unit of the stamps, where it was given.
    pub unit: Option<TimeUnit>,
    /// Sample time of the controller, s.
    pub sample_s: Option<f64>,
    /// Samples per second, Hz.
    pub rate_hz: Option<f64>,
    /// Longest gap that is bridged, s.
    pub most_gap_s: f64,
}

/// A gap in the time stamps.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Gap {
    /// Index of the last sample before the gap, counted from 0.
    pub index: usize,
    /// Time of that sample since the first sample, s.
    pub at_s: f64,
    /// Time to the next sample, s.
    pub lasts_s: f64,
    /// Number of samples that are missing in the gap.
    pub missing: usize,
}

/// Comparison of the time stamps with equal steps.
#[derive(Clone, Debug, Serialize)]
pub struct Clock {
    /// Samples per second, Hz.
    pub rate_hz: f64,
    /// Source of the rate: "asked for" or "the median step of the time stamps".
    pub rate_from: &'static str,
    /// True if the times are stamps of the log; false if they are from the rate.
    pub stamps: bool,
    /// Number of gaps.
    pub gaps: usize,
    /// Total time of the gaps, s.
    pub gaps_last_s: f64,
    /// The largest gap, then others; at most 10.
    pub named_gaps: Vec<Gap>,
    /// Drift of the stamps against the rate, relative; positive if the stamps run fast. Present if the log
    /// has stamps and the rate was given.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub drift: Option<f64>,
    /// Drift at the end of the log, s.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub drift_at_the_end_s: Option<f64>,
    /// RMS scatter of the stamps about equal steps, s.
    pub scatter_s: f64,
}

impl Timing<'_> {
    /// Times since the first sample (n), s, and their comparison with equal steps.
    pub fn clock(&self) -> Result<(Vec<f64>, Clock), Invalid> {
        let Some(stamps) = self.stamps else { return self.by_rate() };
        let unit_s = self.unit_s(stamps)?;
        let first = stamps.values[0];
        let time_s: Vec<f64> =
            stamps.values[..self.samples].iter().map(|t| (t - first) * unit_s).collect();
        if let Some(i) = (1..time_s.len()).find(|&i| time_s[i] <= time_s[i - 1]) {
            let problem = format!("is {} after {}", stamps.values[i], stamps.values[i - 1]);
            let remedy =
                "time stamps ascend: drop repeated samples, or give `rate_hz` instead of `time`";
            return Err(Invalid::at("time", i, problem, remedy));
        }
        let (step_s, rate_from) = match self.rate_hz {
            Some(rate) => (1.0 / rate, "asked for"),
            None => (median_step(&time_s), "the median step of the time stamps"),
        };
        let clock = self.compared(&time_s, step_s, rate_from)?;
        Ok((time_s, clock))
    }

    fn by_rate(&self) -> Result<(Vec<f64>, Clock), Invalid> {
        let remedy = "give `rate_hz`, or `time` with the column of the time stamps";
        let absent = || Invalid::whole("rate_hz", "is not in a log without time stamps", remedy);
        let rate_hz = self.rate_hz.ok_or_else(absent)?;
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
        };
        Ok((time_s, clock))
    }

    /// Seconds in a unit of the stamps.
    fn unit_s(&self, stamps: &Column) -> Result<f64, Invalid> {
        let unit = match (self.unit, stamps.time_unit) {
            (Some(given), Some(stated)) if given != stated => {
                let problem =
                    format!("is {given:?}, but the log has \"{}\" in {stated:?}", stamps.name);
                let remedy = "leave `time_unit` out, or correct the log";
                return Err(Invalid::whole("time_unit", problem, remedy));
            }
            (given, stated) => given.or(stated),
        };
        match unit {
            Some(TimeUnit::S) => Ok(1.0),
            Some(TimeUnit::Ms) => Ok(1e-3),
            Some(TimeUnit::Us) => Ok(1e-6),
            Some(TimeUnit::Samples) => self.sample_s.ok_or_else(|| {
                let remedy = "give `sample_s`, the sample time of the controller";
                Invalid::whole("sample_s", "is not in a log in samples", remedy)
            }),
            None => {
                let remedy = "give `time_unit`: s, ms, us, or samples with `sample_s`";
                Err(Invalid::whole("time_unit", "of the time stamps is not in the log", remedy))
            }
        }
    }

    fn compared(
        &self,
        time_s: &[f64],
        step_s: f64,
        rate_from: &'static str,
    ) -> Result<Clock, Invalid> {
        let mut named: Vec<Gap> = Vec::new();
        let (mut gaps, mut gaps_last_s) = (0, 0.0);
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
                return Err(Invalid::at("time", gap.index, problem, remedy));
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
        let (slope, scatter_s) = line(&count, time_s);
        let drift = self.rate_hz.map(|_| slope / step_s - 1.0);
        Ok(Clock {
            rate_hz: 1.0 / step_s,
            rate_from,
            stamps: true,
            gaps,
            gaps_last_s,
            named_gaps: named,
            drift,
            drift_at_the_end_s: drift.map(|d| d * count[count.len() - 1] * step_s),
            scatter_s,
        })
    }
}

impl Clock {
    /// Longest step between two samples that is no gap, s.
    pub fn longest_step_s(&self) -> f64 {
        if self.stamps { GAP / self.rate_hz } else { f64::INFINITY }
    }

    /// Warnings of gaps, drift and scatter.
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
        {
            let how = if drift > 0.0 { "slow" } else { "fast" };
            warnings.push(format!(
                "the samples come {} parts per million too {how} for {} Hz by the time stamps: {} s at the end",
                significant(1e6 * drift.abs(), 4),
                significant(self.rate_hz, 6),
                significant(end_s, 4)
            ));
        }
        if self.scatter_s * self.rate_hz > USUAL_SCATTER {
            warnings.push(format!(
                "the time stamps scatter by {} s RMS, {} of their step: if the samples are equidistant, give \
                 their rate and no time stamps",
                significant(self.scatter_s, 3),
                significant(self.scatter_s * self.rate_hz, 2)
            ));
        }
        warnings
    }
}

fn median_step(time_s: &[f64]) -> f64 {
    let mut steps: Vec<f64> = time_s.windows(2).map(|t| t[1] - t[0]).collect();
    let middle = steps.len() / 2;
    *steps.select_nth_unstable_by(middle, f64::total_cmp).1
}

/// Slope of the least-squares line of y over x, and the RMS distance from it in y.
fn line(x: &[f64], y: &[f64]) -> (f64, f64) {
    let n = x.len() as f64;
    let mean = |v: &[f64]| v.iter().sum::<f64>() / n;
    let (mx, my) = (mean(x), mean(y));
    let each = || x.iter().zip(y).map(|(x, y)| (x - mx, y - my));
    let (sxx, sxy) = each().fold((0.0, 0.0), |s, (x, y)| (s.0 + x * x, s.1 + x * y));
    let slope = sxy / sxx;
    let beside: f64 = each().map(|(x, y)| (y - slope * x).powi(2)).sum();
    (slope, (beside / n).sqrt())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::trace::columns::Role;

    fn column(values: Vec<f64>) -> Column {
        let (position_unit, time_unit) = (None, None);
        Column { role: Role::Time, name: "t".into(), position_unit, time_unit, values }
    }

    fn timing(stamps: Option<&Column>, samples: usize) -> Timing<'_> {
        let (unit, sample_s, rate_hz) = (Some(TimeUnit::Ms), None, None);
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
        let in_samples = Timing { unit: Some(TimeUnit::Samples), ..timing(Some(&stamps), 2) };
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
}
