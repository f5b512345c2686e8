//! A campaign run by run: the residuals, the learnt parameters, and the decisions. A chain is a series of runs on one
//! mirror that treats the errors of the machine in one way. The place is the position of the tool relative to the part
//! (offset, rotation, magnification).
//!
//! Three chains run on machines of the same hidden errors, from the same first map:
//!
//! | chain | plans |
//! |---|---|
//! | `learning` | each with the tool and the place that were learnt from the run before |
//! | `without` | each with the tool and the place of the first plan |
//! | `known` | as without, on a machine whose tool and place are those of the plan |
//!
//! On one mirror learning gains little. Every map shows the residual of the run before, and a rate error of some
//! percent leaves some percent of that residual. Learning gains most on the next mirror, where the whole figure is
//! to be removed. So after the last run another mirror, like the first, has one run of each chain (`alike`).
//!
//! A run finds the deviation from the tool that it was planned with. It adds to the corrections of the runs before:
//! factors (rate, magnification, width) by products, the rest, which is small, by sums.

use planish_types::outcome::{reconciliation::Estimate, virtual_machine::Truth};
use serde::{Deserialize, Serialize};

use crate::decision::Verdict;

/// Returns the true value of `parameter` in the unit of its [`Estimate`]: mm for an offset, degrees for the rotation, %
/// for the others. `None` for an unknown name.
///
/// If the TIF is rotated by phi, its two ellipticities (e along the axes, d along the diagonals) transform as a tensor:
/// (e, d) -> (e cos 2 phi - d sin 2 phi, e sin 2 phi + d cos 2 phi).
pub fn true_value(truth: &Truth, parameter: &str) -> Option<f64> {
    let e = truth.tif_ellipticity;
    let d = truth.tif_diagonal_ellipticity;
    let (sine, cosine) = (2.0 * truth.tif_rotation_rad).sin_cos();
    Some(match parameter {
        "rate_scale" => 100.0 * truth.rate_scale,
        "offset_x" => truth.offset_x_mm,
        "offset_y" => truth.offset_y_mm,
        "rotation" => truth.rotation_rad.to_degrees(),
        "magnification" => 100.0 * truth.magnification,
        "tif_width" => 100.0 * truth.tif_width,
        "tif_ellipticity" => 100.0 * (e * cosine - d * sine),
        "tif_diagonal_ellipticity" => 100.0 * (e * sine + d * cosine),
        _ => return None,
    })
}

/// True result of one run, which only the virtual machine knows.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Left {
    /// True RMS of the figure on the mirror after the run, nm.
    pub rms_nm: f64,
    /// Time that the run took, s.
    pub total_time_s: f64,
}

/// True results of the run of the same number in each of the three chains.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Chains {
    /// Result of the chain whose plans use the learnt corrections.
    pub learning: Left,
    /// Result of the chain that keeps the tool of the first plan.
    pub without: Left,
    /// Result of the chain on a machine whose tool is that of the plan.
    pub known: Left,
}

impl Chains {
    /// Returns the results in the order learning, without learning, known tool.
    pub fn each(&self) -> [Left; 3] {
        [self.learning, self.without, self.known]
    }

    /// Returns two ratios of RMS: with learning to known tool, and without learning to known tool.
    pub fn over_known(&self) -> [f64; 2] {
        [self.learning, self.without].map(|left| left.rms_nm / self.known.rms_nm)
    }
}

/// One run of a campaign, as read from its artifacts.
#[derive(Clone, Debug, PartialEq)]
pub struct RunRecord {
    /// True result of the run in each chain.
    pub left: Chains,
    /// Estimates of the parameters of the tool that the learning chain made from this run.
    pub estimates: Vec<Estimate>,
    /// RMS of the map that the learning chain measured after the run, nm.
    pub measured_rms_nm: f64,
    /// Recommendation after the run, for the learning chain.
    pub verdict: Verdict,
    /// Reason for the recommendation, as a sentence.
    pub reason: String,
    /// Expected RMS on the mirror after the next run, nm: median, and ends of the interval of 95 %.
    pub expected_nm: [f64; 3],
}

/// A parameter of the tool or its position, as it is known after some runs.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct LearntParameter {
    /// Name of the parameter, such as `rate_scale`.
    pub name: String,
    /// Unit of the value, of its standard error, of the truth and of the corrections.
    pub unit: String,
    /// Value from all runs so far, in `unit`; `None` if no run determined it.
    pub value: Option<f64>,
    /// Standard error of the value in `unit`, from the run that determined it last; `None` if no run did.
    pub standard_error: Option<f64>,
    /// Hidden true value in `unit`; `None` if the virtual machine has no such parameter.
    pub truth: Option<f64>,
    /// True if the last of the runs so far determined the value, false if an earlier one did or none.
    pub is_of_this_run: bool,
    /// Reason for which this run did not determine the parameter; `None` if it did.
    pub refused: Option<String>,
    /// Corrections of all runs so far in `unit`, with which the next run is planned.
    #[serde(default)]
    pub applied: f64,
}

/// One run of a campaign, with the parameters that are known after it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct CampaignRun {
    /// Number of the run, from 1.
    pub number: usize,
    /// True result of the run in each chain.
    #[serde(flatten)]
    pub left: Chains,
    /// RMS of the map that the learning chain measured after the run, nm.
    pub measured_rms_nm: f64,
    /// Parameters as they are known after the run.
    pub parameters: Vec<LearntParameter>,
    /// Recommendation after the run: run again or stop.
    pub verdict: Verdict,
    /// Reason for the recommendation, as a sentence.
    pub reason: String,
    /// Expected RMS on the mirror after the next run, nm: median, and ends of the interval of 95 %.
    pub expected_nm: [f64; 3],
}

/// Summary of a campaign, which is a series of runs on one mirror.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Campaign {
    /// Name of the mirror.
    pub mirror: String,
    /// Random seed of the virtual machine.
    pub seed: u64,
    /// RMS of the mirror before the first run, nm.
    pub before_rms_nm: f64,
    /// Runs of the campaign, in the order in which they were made.
    pub runs: Vec<CampaignRun>,
    /// Results of the first run on another mirror that is like the first, after all runs on the first.
    pub alike: Chains,
    /// Sentence that says which machine was assumed because the user named none; absent otherwise.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub assumed_machine: Option<String>,
}

impl Campaign {
    /// Makes the summary of a campaign from the `records` of its runs, in their order. `truth` holds the hidden
    /// errors of the virtual machine, and `alike` the results on the other mirror.
    pub fn new(
        mirror: &str,
        seed: u64,
        before_rms_nm: f64,
        truth: &Truth,
        records: Vec<RunRecord>,
        alike: Chains,
    ) -> Self {
        let mut runs: Vec<CampaignRun> = Vec::new();
        for record in records {
            let before = runs.last().map_or(&[][..], |run| &run.parameters);
            let parameters = record.estimates.iter().map(|f| after(before, f, truth)).collect();
            runs.push(CampaignRun {
                number: runs.len() + 1,
                left: record.left,
                measured_rms_nm: record.measured_rms_nm,
                parameters,
                verdict: record.verdict,
                reason: record.reason,
                expected_nm: record.expected_nm,
            });
        }
        Self { mirror: mirror.into(), seed, before_rms_nm, runs, alike, assumed_machine: None }
    }
}

/// Returns the knowledge of a parameter after one more run. `before` are the parameters after the runs so far, and
/// `estimate` is that of the new run.
fn after(before: &[LearntParameter], estimate: &Estimate, truth: &Truth) -> LearntParameter {
    let earlier = before.iter().find(|p| p.name == estimate.name);
    let known = earlier.and_then(|p| p.value);
    // A run finds what the corrections so far have left.
    let corrected = earlier.map_or(0.0, |p| p.applied);
    let value = estimate.value.map(|v| combined(&estimate.name, corrected, v)).or(known);
    LearntParameter {
        name: estimate.name.clone(),
        unit: estimate.unit.clone(),
        value,
        standard_error: match estimate.value {
            Some(_) => estimate.standard_error,
            None => earlier.and_then(|p| p.standard_error),
        },
        truth: true_value(truth, &estimate.name),
        is_of_this_run: estimate.value.is_some(),
        refused: estimate.refused.clone(),
        applied: combined(&estimate.name, corrected, estimate.applied),
    }
}

/// Combines two deviations a and b of a parameter, in its unit. For a factor, in percent, it returns 100 ((1 +
/// a/100)(1 + b/100) - 1), otherwise the sum.
fn combined(parameter: &str, a: f64, b: f64) -> f64 {
    let is_factor = ["rate_scale", "magnification", "tif_width"].contains(&parameter);
    if is_factor { a + b + 0.01 * a * b } else { a + b }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn estimates(name: &str, value: Option<f64>, standard_error: f64) -> Estimate {
        let refused = value.is_none().then(|| "the data say less".to_string());
        Estimate {
            name: name.into(),
            unit: "%".into(),
            value,
            standard_error: Some(standard_error),
            refused,
            applied: value.unwrap_or(0.0),
            ..Estimate::default()
        }
    }

    #[test]
    fn a_value_that_no_run_corrects_does_not_add_up() {
        let first = Estimate { applied: 0.0, ..estimates("magnification", Some(0.2), 0.1) };
        let one = after(&[], &first, &Truth::default());
        assert_eq!((one.value, one.applied), (Some(0.2), 0.0));
        let two = after(&[one], &estimates("magnification", Some(0.25), 0.1), &Truth::default());
        assert_eq!((two.value, two.applied), (Some(0.25), 0.25));
    }

    #[test]
    fn factors_multiply_shifts_add_and_a_run_that_says_nothing_changes_nothing() {
        let truth = Truth { rate_scale: 0.05, offset_x_mm: 0.1, ..Truth::default() };
        let left = Left { rms_nm: 1.0, total_time_s: 60.0 };
        let chains = Chains { learning: left, without: left, known: left };
        let run = |rate, offset| RunRecord {
            left: chains,
            estimates: vec![
                estimates("rate_scale", rate, 0.3),
                estimates("offset_x", offset, 0.002),
            ],
            measured_rms_nm: 1.1,
            verdict: Verdict::Stop,
            reason: String::new(),
            expected_nm: [1.0; 3],
        };
        let records =
            vec![run(None, Some(0.08)), run(Some(10.0), Some(0.03)), run(Some(-5.0), None)];
        let campaign = Campaign::new("coupon", 7, 10.0, &truth, records, chains);
        let of = |k: usize, p: usize| campaign.runs[k].parameters[p].value;
        assert_eq!((of(0, 0), of(1, 0)), (None, Some(10.0)));
        // 1.1 x 0.95
        assert!((of(2, 0).unwrap() - 4.5).abs() < 1e-12);
        // Rounding of a sum.
        assert!((of(2, 1).unwrap() - 0.11).abs() < 1e-12);
        let last = &campaign.runs[2].parameters[1];
        assert!(
            !last.is_of_this_run && last.refused.is_some() && last.standard_error == Some(0.002)
        );
        assert_eq!((last.truth, campaign.runs[2].number), (Some(0.1), 3));
    }

    #[test]
    fn an_ellipticity_turns_with_its_tensor() {
        let truth = Truth {
            tif_ellipticity: 0.02,
            tif_rotation_rad: std::f64::consts::FRAC_PI_4,
            ..Truth::default()
        };
        // Longer along x, turned by 45 degrees, is longer along the diagonal.
        assert!((true_value(&truth, "tif_diagonal_ellipticity").unwrap() - 2.0).abs() < 1e-12);
        // Rounding of the cosine of 90 degrees.
        assert!(true_value(&truth, "tif_ellipticity").unwrap().abs() < 1e-12);
        assert_eq!(true_value(&truth, "wobble"), None);
    }
}
