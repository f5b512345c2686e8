//! Residual that the errors of a process add to the plan of a run, as `planish tolerance` found it.
//!
//! The keys are those of `process` in `summary.json`. Every RMS is without the terms of `free` (the mean, or the best
//! plane). A run is here one execution of the plan by the process, with random errors.

use planish_types::{
    outcome::tolerance::{
        Distribution, ErrorLine, Quantiles, ToleranceArrays, ToleranceOutcome, ToleranceSettings,
    },
    text::significant,
};
use serde::Serialize;
use serde_json::{Value, json};

use crate::report::map::{ScreenMap, block_side, screen_map};

/// Residual that the errors of a process add to one plan.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ErrorBudget {
    /// Name of the method whose motion is the plan.
    pub method: String,
    /// Terms that every RMS leaves out: `piston` (the mean) or `plane` (the best plane).
    pub free: String,
    /// Sentence with the expected residual.
    pub sentence: String,
    /// Name of the process, as its error budget states it.
    pub name: String,
    /// RMS of the residual that the plan leaves if the process has no errors, nm.
    pub nominal_rms_nm: f64,
    /// Expected RMS with all errors, nm: the square root of the mean square over the runs.
    pub expected_rms_nm: f64,
    /// Distribution of the RMS of the residual over the runs of the process, nm.
    pub residual: Quantiles,
    /// True if the distribution comes from simulated runs, false if it is computed without them.
    pub simulated: bool,
    /// Errors of the process, each with the RMS that it adds.
    pub errors: Vec<ErrorEffect>,
    /// Error that is best improved first; `null` if no error adds anything.
    pub first: Option<First>,
    /// Distribution of the RMS over the runs, and map of the standard deviation of the residual over the runs.
    #[serde(skip)]
    pub arrays: ToleranceArrays,
}

/// An error of the process and its effect.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ErrorEffect {
    /// Kind of the error, such as `rate_noise`.
    pub kind: String,
    /// Size of the error in `unit`.
    pub size: f64,
    /// Unit of the size.
    pub unit: String,
    /// Shape of the distribution of the error over the runs, such as `normal`.
    pub distribution: Distribution,
    /// RMS of the residual that this error adds if it is the only one, nm.
    pub adds_rms_nm: f64,
    /// RMS of the part of that added residual which the tool can correct, nm.
    pub reached_rms_nm: f64,
    /// RMS of the part of that added residual which the tool cannot correct, nm.
    pub unreached_rms_nm: f64,
}

impl From<ErrorLine> for ErrorEffect {
    fn from(line: ErrorLine) -> Self {
        let ErrorLine { kind, size, unit, distribution, .. } = line;
        let ErrorLine { adds_rms_nm, reached_rms_nm, unreached_rms_nm, .. } = line;
        Self { kind, size, unit, distribution, adds_rms_nm, reached_rms_nm, unreached_rms_nm }
    }
}

/// The error whose removal lowers the residual most, measured by the RMS that 95 % of the runs are below.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct First {
    /// Kind of the error, such as `rate_noise`.
    pub kind: String,
    /// RMS of the residual, nm, that 95 % of the runs would be below if the process did not have this error.
    pub without_it_95_percent_nm: f64,
}

/// Data of the error budget for the report page.
#[derive(Serialize)]
struct ErrorBudgetOfPage<'a> {
    #[serde(flatten)]
    numbers: &'a ErrorBudget,
    distribution: LevelsOfPage<'a>,
    #[serde(skip_serializing_if = "Option::is_none")]
    deviation: Option<ScreenMap>,
}

/// Distribution of the RMS, as two lists of one length: fractions of the runs, and the RMS that each fraction is
/// below, nm.
#[derive(Serialize)]
struct LevelsOfPage<'a> {
    part: &'a [f64],
    rms_nm: &'a [f64],
}

/// Returns the kind of an error as words: "rate noise" for `rate_noise`.
fn words(kind: &str) -> String {
    kind.replace('_', " ")
}

impl ErrorBudget {
    /// Collects the effect of the errors on the motion of `method`, from the settings, outcome and arrays of a
    /// tolerance artifact.
    pub fn new(
        method: &str,
        settings: ToleranceSettings,
        outcome: ToleranceOutcome,
        arrays: ToleranceArrays,
    ) -> Self {
        let sentence = sentence(&outcome, method);
        let ToleranceOutcome { error_budget: name, nominal_rms_nm, expected_rms_nm, .. } = outcome;
        Self {
            method: method.into(),
            free: settings.free.unwrap_or_else(|| "piston".into()),
            sentence,
            name,
            nominal_rms_nm,
            expected_rms_nm,
            residual: outcome.residual,
            simulated: outcome.simulated,
            errors: outcome.errors.into_iter().map(ErrorEffect::from).collect(),
            first: outcome.first.map(|first| First {
                kind: first.kind,
                without_it_95_percent_nm: first.without_it_95_percent_nm,
            }),
            arrays,
        }
    }

    /// Returns JSON for the report page: the numbers of the summary, the distribution, and the map of the deviation.
    /// The map has at most `most_pixels` pixels, and is left out if no pixel is valid.
    pub(crate) fn for_page(&self, most_pixels: usize) -> Value {
        let ToleranceArrays { part, rms_nm, deviation_nm, grid } = &self.arrays;
        let has_pixels = deviation_nm.iter().any(|v| !v.is_nan());
        json!(ErrorBudgetOfPage {
            numbers: self,
            distribution: LevelsOfPage { part, rms_nm },
            deviation: if has_pixels {
                Some(screen_map(deviation_nm.view(), grid, block_side(grid, most_pixels)))
            } else {
                None
            },
        })
    }
}

/// Returns a sentence on the expected residual of the plan `method`, on the error that adds most, and on the error
/// whose removal would lower the residual most. `outcome` is the result of `planish tolerance`.
fn sentence(outcome: &ToleranceOutcome, method: &str) -> String {
    let [low, high] = outcome.residual.interval_95_percent_nm.map(|v| significant(v, 3));
    let mut sentence = format!(
        "With this process ({}) expect {low} to {high} nm RMS of {method} in 95 % of the runs; {} nm without errors",
        outcome.error_budget,
        significant(outcome.nominal_rms_nm, 3)
    );
    // The larger of equals is the first.
    let last_first = outcome.errors.iter().rev();
    let costliest = last_first.max_by(|a, b| a.adds_rms_nm.total_cmp(&b.adds_rms_nm));
    if let Some(line) = costliest.filter(|line| line.adds_rms_nm > 0.0) {
        let adds = significant(line.adds_rms_nm, 3);
        sentence += &format!("; {} costs most: {adds} nm alone", words(&line.kind));
    }
    if let Some(first) = &outcome.first {
        let below = significant(first.without_it_95_percent_nm, 3);
        sentence += &format!(
            "; without {} 95 % of the runs would be below {below} nm, now {} nm",
            words(&first.kind),
            significant(outcome.residual.below_95_percent_nm, 3)
        );
    }
    sentence + "."
}

#[cfg(test)]
mod tests {
    use ndarray::Array2;
    use planish_types::{Axis, Grid};

    use super::*;

    fn outcome() -> ToleranceOutcome {
        let line = |kind: &str, adds: f64| {
            json!({
                "kind": kind, "size": 1.0, "unit": "%", "distribution": "normal", "note": "", "adds_rms_nm": adds,
                "reached_rms_nm": 0.6 * adds, "unreached_rms_nm": 0.8 * adds, "departs_by_rms_nm": 0.0,
                "simulated": false,
            })
        };
        serde_json::from_value(json!({
            "error_budget": "beam", "nominal_rms_nm": 0.1, "expected_rms_nm": 0.2, "simulated": false,
            "residual": {
                "median_nm": 0.19, "below_95_percent_nm": 0.3, "interval_95_percent_nm": [0.14, 0.31],
            },
            "errors": [line("rate_scale", 0.05), line("rate_drift", 0.12)],
            "first": { "index": 1, "kind": "rate_drift", "without_it_95_percent_nm": 0.21 },
        }))
        .unwrap()
    }

    fn arrays(height: f64) -> ToleranceArrays {
        let axis = Axis::new(0.0, 1.0, 3).unwrap();
        ToleranceArrays {
            part: vec![0.0, 1.0],
            rms_nm: vec![0.1, 0.4],
            deviation_nm: Array2::from_elem((3, 3), height),
            grid: Grid { x: axis, y: axis },
        }
    }

    #[test]
    fn the_sentence_says_what_to_expect_and_what_costs_most() {
        let settings = ToleranceSettings { free: Some("plane".into()) };
        let process = ErrorBudget::new("pvt", settings, outcome(), arrays(0.1));
        assert_eq!(
            process.sentence,
            "With this process (beam) expect 0.14 to 0.31 nm RMS of pvt in 95 % of the runs; 0.1 nm without errors; \
             rate drift costs most: 0.12 nm alone; without rate drift 95 % of the runs would be below 0.21 nm, now \
             0.3 nm."
        );
        let summary = json!(process);
        assert_eq!((&summary["name"], &summary["free"]), (&json!("beam"), &json!("plane")));
        assert_eq!(summary["errors"][1]["adds_rms_nm"], 0.12);
        assert!(summary.get("arrays").is_none() && summary["errors"][0].get("note").is_none());
        let page = process.for_page(100);
        assert_eq!(page["distribution"]["rms_nm"], json!([0.1, 0.4]));
        assert_eq!(page["deviation"]["size"], json!([3, 3]));
    }

    #[test]
    fn a_map_without_pixels_is_none() {
        let settings = ToleranceSettings::default();
        let process = ErrorBudget::new("pvt", settings, outcome(), arrays(f64::NAN));
        assert_eq!(process.free, "piston");
        assert!(process.for_page(100).get("deviation").is_none());
    }
}
