//! Decision to run again or to stop: gain of the next run, its uncertainty, and its time.
//!
//! A map is the figure of the mirror minus the error m of its measurement, of variance sigma^2 over the map.
//! Another run does not remove the noise of a map, so both sides are compared without it:
//!
//! ```text
//! now:       S0^2 = M0^2 - sigma^2                  M0 the RMS of the map
//! next run:  S1^2 = T1^2 - 2 u^2                    T1 of `planish tolerance`, at every quantile over the runs
//! gain:      G = S0 - S1
//! ```
//!
//! T1 is the residual of the plan on the *map* with all errors of the process. It includes the error of the map as
//! if that were independent of the map: `T1^2 = |e0|^2 + r^2 + u^2 + ...`. The tool reaches the part r of m, and
//! does not reach the part u. But m is in the map already. The run removes r with the figure, so that r is on the
//! mirror afterwards with the opposite sign: r^2 counts once. u is in e0 and not on the mirror: e0 and the
//! tolerance each count u^2 once, and it must not count at all.
//!
//! The square M0^2 scatters with the noise. An error of the map of the RMS a with n independent values has the
//! variance `2 a^4 / n + 4 S0^2 a^2 / n`. White noise has as many values as pixels; low-order terms have at least
//! 2.
//!
//! | symbol | variable | unit |
//! |---|---|---|
//! | M0 | `measured_rms_nm` | nm |
//! | S0 | `now_rms_nm` | nm |
//! | S1 | `next` | nm |
//! | G | `gain` | nm |

use planish_types::{Invalid, text::significant};
use serde::{Deserialize, Serialize};

/// Number of independent values of a low-order error of the map: the two coefficients of its first degree. Larger: the
/// standard error of the figure becomes smaller, and the decision too sure. Smaller: a run that would gain is not
/// recommended.
const LOW_ORDER_NUMBERS: f64 = 2.0;

/// Gain that 95 % of the runs must reach, in standard errors of the RMS on the mirror now. Larger: real gains count
/// as noise. Smaller: noise counts as a gain.
const SEEN: f64 = 2.0;

/// Settings of the decision to run again or to stop.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct DecisionSettings {
    /// Least median gain for another run, in percent of the RMS on the mirror now. Larger: fewer runs. Smaller: runs
    /// for gains that do not repay their time and risk.
    pub least_gain_percent: f64,
}

impl Default for DecisionSettings {
    fn default() -> Self {
        Self { least_gain_percent: 5.0 }
    }
}

/// An error of the measured map, with the RMS that `planish tolerance` found for it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MapError {
    /// RMS that the error adds to the map, nm.
    pub adds_rms_nm: f64,
    /// RMS of the part of the error that the tool cannot correct, nm (u of the module).
    pub unreached_rms_nm: f64,
    /// True for white noise, false for low-order terms.
    pub is_white: bool,
}

/// Data for the decision: present state of the mirror, and prediction of the next run.
#[derive(Clone, Debug, PartialEq)]
pub struct Known {
    /// RMS of the map, nm (M0 of the module).
    pub measured_rms_nm: f64,
    /// Number of valid pixels of the map.
    pub pixels: usize,
    /// Errors of the measurement of the map; empty if none are known.
    pub map_errors: Vec<MapError>,
    /// Distribution of the predicted RMS T1 (see the module), as pairs in ascending order. A pair is a fraction of
    /// the simulated runs, 0 to 1, and the RMS that this fraction does not exceed, nm.
    pub levels: Vec<(f64, f64)>,
    /// Predicted RMS of the plan's residual without any error of the process, nm.
    pub nominal_rms_nm: f64,
    /// Time of the planned run, s.
    pub total_time_s: f64,
    /// Compliance with the specification before and after the next run; `None` if there is no specification.
    pub specification: Option<SpecificationKept>,
}

/// Compliance with a specification, before and after the next run.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct SpecificationKept {
    /// True if the present map keeps the specification.
    pub now: bool,
    /// True if the plan's residual, predicted without errors, keeps the specification.
    pub by_the_plan: bool,
}

/// Recommendation: run again or stop.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Verdict {
    /// Run again: the gain is large enough, or only the next run keeps the specification.
    RunAgain,
    /// Stop: the gain is too small or too uncertain, or the map keeps the specification.
    Stop,
}

impl Verdict {
    /// Returns the recommendation in words.
    pub fn words(self) -> &'static str {
        match self {
            Self::RunAgain => "run again",
            Self::Stop => "stop",
        }
    }
}

/// Distribution of the RMS on the mirror over the simulated runs of a plan, nm.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Spread {
    /// Median, nm.
    pub median_nm: f64,
    /// Ends of the interval that contains 95 % of the runs, nm.
    pub interval_95_percent_nm: [f64; 2],
}

/// Recommendation, its reason, and the numbers that it rests on.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Decision {
    /// Recommendation: run again or stop.
    pub verdict: Verdict,
    /// Reason, in a sentence with the numbers.
    pub reason: String,
    /// RMS of the measured map, nm (M0 of the module).
    pub measured_rms_nm: f64,
    /// RMS of the errors of the measured map, nm (sigma of the module).
    pub noise_rms_nm: f64,
    /// RMS of the figure on the mirror now, without the noise of the map, nm (S0 of the module).
    pub now_rms_nm: f64,
    /// Standard error of `now_rms_nm`, nm.
    pub now_standard_error_nm: f64,
    /// Predicted RMS of the plan's residual on the measured map, without errors of the process, nm.
    pub nominal_rms_nm: f64,
    /// RMS of the figure on the mirror after the next run, nm (S1 of the module).
    pub next: Spread,
    /// Median RMS of the map after the next run, nm: with the errors of its measurement.
    pub measured_next_median_nm: f64,
    /// Median of the gain (decrease of the RMS on the mirror) over the runs, nm (G of the module).
    pub gain_median_nm: f64,
    /// Gain (decrease of the RMS on the mirror) that 95 % of the runs exceed, nm.
    pub gain_of_95_percent_nm: f64,
    /// Fraction of the runs that lower the RMS on the mirror, 0 to 1.
    pub part_that_gains: f64,
    /// Time of the planned run, s.
    pub total_time_s: f64,
    /// Median gain divided by the time of the planned run, nm per minute.
    pub gain_per_minute_nm: f64,
    /// Compliance with the specification; `None` if there is no specification.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub specification: Option<SpecificationKept>,
}

/// Decides whether to run again: computes the gain of the next run by the equations of the module, and applies the rule
/// of `verdict`.
///
/// # Errors
/// Fails if the least gain is not between 0 and 100 %.
pub fn decide(known: &Known, settings: &DecisionSettings) -> Result<Decision, Invalid> {
    let percent = settings.least_gain_percent;
    if !(0.0..=100.0).contains(&percent) {
        let remedy = "give 0 to 100 percent of what is there";
        return Err(Invalid::whole("least_gain_percent", format!("is {percent}"), remedy));
    }
    let sigma2: f64 = known.map_errors.iter().map(|e| e.adds_rms_nm.powi(2)).sum();
    let u2: f64 = known.map_errors.iter().map(|e| e.unreached_rms_nm.powi(2)).sum();
    // S0^2 = M0^2 - sigma^2
    let now2 = (known.measured_rms_nm.powi(2) - sigma2).max(0.0);
    let now = now2.sqrt();
    let variance: f64 = known
        .map_errors
        .iter()
        .map(|e| {
            let n = if e.is_white { known.pixels.max(1) as f64 } else { LOW_ORDER_NUMBERS };
            let a2 = e.adds_rms_nm.powi(2);
            (2.0 * a2 * a2 + 4.0 * now2 * a2) / n
        })
        .sum();
    // d S0 = d(S0^2) / (2 S0), and never more than the root of it, where S0 is within the noise
    let error = if now > 0.0 {
        (0.5 * variance.sqrt() / now).min(variance.powf(0.25))
    } else {
        variance.powf(0.25)
    };
    let [low, median, sure, high] = [0.025, 0.5, 0.95, 0.975].map(|part| {
        // S1^2 = T1^2 - 2 u^2
        (level_nm(&known.levels, part).powi(2) - 2.0 * u2).max(0.0).sqrt()
    });
    let gain = now - median;
    let mut decision = Decision {
        verdict: Verdict::Stop,
        reason: String::new(),
        measured_rms_nm: known.measured_rms_nm,
        noise_rms_nm: sigma2.sqrt(),
        now_rms_nm: now,
        now_standard_error_nm: error,
        nominal_rms_nm: known.nominal_rms_nm,
        next: Spread { median_nm: median, interval_95_percent_nm: [low, high] },
        measured_next_median_nm: (median * median + sigma2).sqrt(),
        gain_median_nm: gain,
        gain_of_95_percent_nm: now - sure,
        // S1 < S0 where T1^2 < S0^2 + 2 u^2
        part_that_gains: part_below(&known.levels, (now2 + 2.0 * u2).sqrt()),
        total_time_s: known.total_time_s,
        gain_per_minute_nm: gain / (known.total_time_s / 60.0).max(f64::MIN_POSITIVE),
        specification: known.specification,
    };
    (decision.verdict, decision.reason) = verdict(&decision, settings);
    Ok(decision)
}

/// Returns the recommendation and its reason. A map that keeps the specification means stop, otherwise a plan that
/// keeps it means run again. Without such a decision, a run must promise two gains: the one that 95 % of the runs
/// exceed is above [`SEEN`] standard errors, and the median is at least `least_gain_percent`. `d` holds the numbers.
fn verdict(d: &Decision, settings: &DecisionSettings) -> (Verdict, String) {
    let least = 0.01 * settings.least_gain_percent * d.now_rms_nm;
    let seen = SEEN * d.now_standard_error_nm;
    let expected = format!(
        "half of the runs would gain {} nm, and 95 % at least {} nm, in {:.1} min",
        significant(d.gain_median_nm, 3),
        significant(d.gain_of_95_percent_nm, 3),
        d.total_time_s / 60.0
    );
    match d.specification {
        Some(SpecificationKept { now: true, .. }) => {
            return (Verdict::Stop, format!("the map keeps the specification; {expected}"));
        }
        Some(SpecificationKept { by_the_plan: true, .. }) => {
            let reason = "the map does not keep the specification, and the plan does";
            return (Verdict::RunAgain, format!("{reason}; {expected}"));
        }
        _ => {}
    }
    let also = match d.specification {
        Some(_) => "; the plan does not keep the specification either",
        None => "",
    };
    if d.gain_of_95_percent_nm <= seen {
        let reason = format!(
            "{expected}, which is not more than the {} nm to which the mirror is known now ({SEEN} standard errors){also}",
            significant(seen, 3)
        );
        return (Verdict::Stop, reason);
    }
    if d.gain_median_nm < least {
        let reason = format!(
            "{expected}, less than the {} nm ({} % of what is there) that a run is worth{also}",
            significant(least, 3),
            settings.least_gain_percent
        );
        return (Verdict::Stop, reason);
    }
    let reason = format!(
        "{expected}; the mirror is known to {} nm ({SEEN} standard errors){also}",
        significant(seen, 3)
    );
    (Verdict::RunAgain, reason)
}

/// Returns the RMS, nm, that the fraction `part` (0 to 1) of the runs does not exceed. It interpolates linearly
/// between `levels`, pairs of (fraction, RMS in nm).
fn level_nm(levels: &[(f64, f64)], part: f64) -> f64 {
    let after = levels.partition_point(|(p, _)| *p < part);
    match (after.checked_sub(1).map(|k| levels[k]), levels.get(after)) {
        (Some((p, v)), Some((q, w))) => v + (w - v) * (part - p) / (q - p),
        (None, Some((_, w))) => *w,
        (Some((_, v)), None) => v,
        (None, None) => f64::NAN,
    }
}

/// Returns the fraction of the runs whose RMS is below `value`, nm. It interpolates linearly between `levels`, pairs
/// of (fraction, RMS in nm).
fn part_below(levels: &[(f64, f64)], value: f64) -> f64 {
    let after = levels.partition_point(|(_, v)| *v < value);
    match (after.checked_sub(1).map(|k| levels[k]), levels.get(after)) {
        (Some((p, v)), Some((q, w))) => p + (q - p) * (value - v) / (w - v),
        (None, _) => 0.0,
        (Some(_), None) => 1.0,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns the data of a mirror with a map of RMS `measured`, nm, and a plan whose RMS T1 (see the module) is
    /// uniform from 0.9 to 1.1 times `t`, nm.
    fn known(measured: f64, t: f64) -> Known {
        Known {
            measured_rms_nm: measured,
            pixels: 10_000,
            map_errors: vec![],
            levels: (0..=200).map(f64::from).map(|k| (k / 200.0, t * (0.9 + 0.001 * k))).collect(),
            nominal_rms_nm: 0.9 * t,
            total_time_s: 120.0,
            specification: None,
        }
    }

    fn decided(known: &Known) -> Decision {
        decide(known, &DecisionSettings::default()).unwrap()
    }

    #[test]
    fn without_noise_the_gain_is_the_difference() {
        let d = decided(&known(2.0, 1.0));
        assert_eq!(d.verdict, Verdict::RunAgain);
        let near = |a: f64, b: f64| (a - b).abs() < 1e-12;
        // Below: rounding of formulas of numbers up to 2.
        assert!(near(d.now_rms_nm, 2.0) && near(d.next.median_nm, 1.0));
        assert!(near(d.gain_median_nm, 1.0) && near(d.gain_of_95_percent_nm, 2.0 - 1.09));
        assert!(near(d.part_that_gains, 1.0) && near(d.gain_per_minute_nm, 0.5));
        // 1.05 is above three quarters of the runs, which is less than 95 %.
        let d = decided(&known(1.05, 1.0));
        // Rounding, as above.
        assert!(near(d.part_that_gains, 0.75) && d.verdict == Verdict::Stop, "{d:?}");
        assert!(d.gain_of_95_percent_nm < 0.0);
        // 1.15 is above all of them: a gain of 0.15 in the half of them, 13 % of what is there.
        assert_eq!(decided(&known(1.15, 1.0)).verdict, Verdict::RunAgain);
        let strict = DecisionSettings { least_gain_percent: 15.0 };
        assert_eq!(decide(&known(1.15, 1.0), &strict).unwrap().verdict, Verdict::Stop);
        assert!(decide(&known(1.0, 1.0), &DecisionSettings { least_gain_percent: -1.0 }).is_err());
    }

    /// Checks that nothing is gained, whatever the noise, if the tool reaches nothing. The mirror has waves of RMS s
    /// that the tool does not reach, measured with noise a. The map has (s^2 + a^2)^1/2, the plan leaves the map as it
    /// is, and the tolerance adds the noise once more. The RMS on the mirror is s before and after.
    #[test]
    fn noise_that_the_tool_does_not_reach_is_no_gain() {
        let (s, a) = (0.3_f64, 0.5_f64);
        let rms = s.hypot(a);
        let mut k = known(rms, 0.0);
        k.map_errors = vec![MapError { adds_rms_nm: a, unreached_rms_nm: a, is_white: true }];
        k.levels = vec![(0.0, rms.hypot(a)), (1.0, rms.hypot(a))];
        let d = decided(&k);
        // Below: rounding of formulas of numbers up to 1.
        assert!((d.now_rms_nm - s).abs() < 1e-12 && d.gain_median_nm.abs() < 1e-12, "{d:?}");
        assert!((d.measured_next_median_nm - rms).abs() < 1e-12);
        assert_eq!(d.verdict, Verdict::Stop);
        let expected = (2.0 * a.powi(4) + 4.0 * s * s * a * a).sqrt() / (2.0 * s) / 100.0;
        assert!((d.now_standard_error_nm - expected).abs() < 1e-12);
    }

    /// Checks that more noise of the map means less gain, because a run transfers the noise that the tool reaches to
    /// the mirror.
    #[test]
    fn noise_that_the_tool_reaches_is_brought_onto_the_mirror() {
        let (s, a) = (0.3_f64, 0.5_f64);
        let mut k = known(s.hypot(a), 0.0);
        k.map_errors = vec![MapError { adds_rms_nm: a, unreached_rms_nm: 0.0, is_white: false }];
        // The plan removes all of the map.
        k.levels = vec![(0.0, a), (1.0, a)];
        let d = decided(&k);
        // Rounding of a difference of squares.
        assert!((d.next.median_nm - a).abs() < 1e-12 && d.gain_median_nm < 0.0, "{d:?}");
        assert_eq!((d.verdict, d.part_that_gains), (Verdict::Stop, 0.0));
    }

    #[test]
    fn a_specification_decides_first() {
        for (now, by_the_plan, measured, verdict) in [
            (true, true, 2.0, Verdict::Stop),
            (false, true, 1.05, Verdict::RunAgain),
            (false, false, 2.0, Verdict::RunAgain),
            (false, false, 1.05, Verdict::Stop),
        ] {
            let specification = Some(SpecificationKept { now, by_the_plan });
            let d = decided(&Known { specification, ..known(measured, 1.0) });
            assert_eq!(d.verdict, verdict, "{d:?}");
            assert!(d.reason.contains("specification"), "{}", d.reason);
        }
    }
}
