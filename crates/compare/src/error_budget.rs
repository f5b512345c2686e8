//! Residual that the errors of a process add to the plan of a run, as `planish-tolerance` found it.
//!
//! The keys are those of `process` in `summary.json`. Every RMS is without the terms of `free` (the mean, or the best
//! plane).

use ndarray::Array2;
use planish_types::{Grid, Invalid, text::significant};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use crate::report::map::{block_side, screen_map};

/// Effect of the process on one plan.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ErrorBudget {
    /// The method whose motion it is.
    pub method: String,
    /// Terms that are not part of the residual: `piston` or `plane`.
    pub free: String,
    /// Expected residual, in words.
    pub sentence: String,
    /// The numbers.
    #[serde(flatten)]
    pub found: Found,
    /// The distribution, and the map.
    #[serde(skip)]
    pub arrays: ProcessArrays,
}

/// Numbers in the manifest of `planish-tolerance`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Found {
    /// Name of the process.
    #[serde(rename(deserialize = "error_budget", serialize = "name"))]
    pub name: String,
    /// RMS without errors, nm.
    pub nominal_rms_nm: f64,
    /// sqrt of the mean over runs of the mean square, nm.
    pub expected_rms_nm: f64,
    /// The distribution of the RMS over the runs.
    pub residual: Quantiles,
    /// True if the distribution is that of simulated runs.
    pub simulated: bool,
    /// Errors of the process, with the RMS that each adds.
    pub errors: Vec<Line>,
    /// Error to improve first; none if no error adds anything.
    #[serde(default)]
    pub first: Option<First>,
}

/// The distribution of the RMS over the runs.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Quantiles {
    /// Half of the runs are below, nm.
    pub median_nm: f64,
    /// 95 % of the runs are below, nm.
    pub below_95_percent_nm: f64,
    /// 95 % of the runs are between these, nm.
    pub interval_95_percent_nm: [f64; 2],
}

/// An error of the process and its effect.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Line {
    /// Its kind.
    pub kind: String,
    /// Its size.
    pub size: f64,
    /// Unit of the size.
    pub unit: String,
    /// Distribution of the error over the runs.
    pub distribution: String,
    /// RMS that this error adds alone, nm.
    pub adds_rms_nm: f64,
    /// The part of it that the tool reaches, nm.
    pub reached_rms_nm: f64,
    /// The part of it that the tool does not reach, nm.
    pub unreached_rms_nm: f64,
}

/// The error without which the residual that 95 % of the runs are below is least.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct First {
    /// Its kind.
    pub kind: String,
    /// RMS that 95 % of the runs are below without this error, nm.
    pub without_it_95_percent_nm: f64,
}

/// The arrays of a tolerance artifact.
#[derive(Clone, Debug, PartialEq)]
pub struct ProcessArrays {
    /// Fractions of the runs (m).
    pub part: Vec<f64>,
    /// RMS that these fractions are below (m), nm.
    pub rms_nm: Vec<f64>,
    /// Standard deviation over the runs of every pixel (ny, nx), nm; NaN where invalid.
    pub deviation_nm: Array2<f64>,
    /// Pixel centres.
    pub grid: Grid,
}

/// A kind in words: `rate_noise` is rate noise.
fn words(kind: &str) -> String {
    kind.replace('_', " ")
}

impl ErrorBudget {
    /// The effect on the motion of `method`, from the arrays of a tolerance artifact and the settings and outcome of
    /// its manifest.
    pub fn new(
        method: &str,
        settings: &Value,
        outcome: &Value,
        arrays: ProcessArrays,
    ) -> Result<Self, Invalid> {
        let found = Found::deserialize(outcome).map_err(|e| {
            let problem = format!("has no usable outcome ({e})");
            Invalid::whole("tolerance", problem, "run planish-tolerance again")
        })?;
        let sentence = found.sentence(method);
        let free = settings["free"].as_str().unwrap_or("piston").to_string();
        Ok(Self { method: method.into(), free, sentence, found, arrays })
    }

    /// JSON for the page: the numbers of the summary, the distribution, and the map on the screen. The map has at
    /// most `most_pixels`, and is left out if no pixel is valid.
    pub fn for_page(&self, most_pixels: usize) -> Value {
        let ProcessArrays { part, rms_nm, deviation_nm, grid } = &self.arrays;
        let mut page = json!(self);
        page["distribution"] = json!({ "part": part, "rms_nm": rms_nm });
        if deviation_nm.iter().any(|v| !v.is_nan()) {
            let every = block_side(grid, most_pixels);
            page["deviation"] = json!(screen_map(deviation_nm.view(), grid, every));
        }
        page
    }
}

impl Found {
    fn sentence(&self, method: &str) -> String {
        let [low, high] = self.residual.interval_95_percent_nm.map(|v| significant(v, 3));
        let mut sentence = format!(
            "With this process ({}) expect {low} to {high} nm RMS of {method} in 95 % of the runs; {} nm without errors",
            self.name,
            significant(self.nominal_rms_nm, 3)
        );
        // The larger of equals is the first.
        let larger = |a: &&Line, b: &&Line| a.adds_rms_nm.total_cmp(&b.adds_rms_nm);
        let costliest = self.errors.iter().rev().max_by(larger).filter(|l| l.adds_rms_nm > 0.0);
        if let Some(line) = costliest {
            let adds = significant(line.adds_rms_nm, 3);
            sentence += &format!("; {} costs most: {adds} nm alone", words(&line.kind));
        }
        if let Some(first) = &self.first {
            let below = significant(first.without_it_95_percent_nm, 3);
            sentence += &format!(
                "; without {} 95 % of the runs would be below {below} nm, now {} nm",
                words(&first.kind),
                significant(self.residual.below_95_percent_nm, 3)
            );
        }
        sentence + "."
    }
}

#[cfg(test)]
mod tests {
    use planish_types::Axis;

    use super::*;

    fn outcome() -> Value {
        let line = |kind: &str, adds: f64| {
            json!({
                "kind": kind, "size": 1.0, "unit": "%", "distribution": "normal", "note": "", "adds_rms_nm": adds,
                "reached_rms_nm": 0.6 * adds, "unreached_rms_nm": 0.8 * adds, "departs_by_rms_nm": 0.0,
                "simulated": false,
            })
        };
        json!({
            "error_budget": "beam", "nominal_rms_nm": 0.1, "expected_rms_nm": 0.2, "simulated": false,
            "residual": {
                "median_nm": 0.19, "below_95_percent_nm": 0.3, "interval_95_percent_nm": [0.14, 0.31],
            },
            "errors": [line("rate_scale", 0.05), line("rate_drift", 0.12)],
            "first": { "index": 1, "kind": "rate_drift", "without_it_95_percent_nm": 0.21 },
        })
    }

    fn arrays(height: f64) -> ProcessArrays {
        let axis = Axis::new(0.0, 1.0, 3).unwrap();
        ProcessArrays {
            part: vec![0.0, 1.0],
            rms_nm: vec![0.1, 0.4],
            deviation_nm: Array2::from_elem((3, 3), height),
            grid: Grid { x: axis, y: axis },
        }
    }

    #[test]
    fn the_sentence_says_what_to_expect_and_what_costs_most() {
        let settings = json!({ "free": "plane" });
        let process = ErrorBudget::new("pvt", &settings, &outcome(), arrays(0.1)).unwrap();
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
    fn an_outcome_without_its_numbers_is_refused_and_a_map_without_pixels_is_none() {
        let mut broken = outcome();
        broken["errors"][0]["adds_rms_nm"] = json!("much");
        let error = ErrorBudget::new("pvt", &json!({}), &broken, arrays(0.1)).unwrap_err();
        assert!(error.to_string().contains("tolerance: has no usable outcome"), "{error}");
        let process = ErrorBudget::new("pvt", &json!({}), &outcome(), arrays(f64::NAN)).unwrap();
        assert!(process.for_page(100).get("deviation").is_none());
    }
}
