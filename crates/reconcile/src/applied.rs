//! Corrections that the next plan gets, and parameters that are held at the plan (their value in the plan, which is 0).
//!
//! ```text
//! p_i ~ N(0, (t s_i)^2)                       s_i the scale of parameter i, t one number for the machine
//! L(t) = sum_k b_k^2 / (l_k + t^-2) / 2 - log(1 + t^2 l_k) / 2         t where L is largest, at most 1
//! p*   = (D + t^-2 S^-2)^-1 D p'                                        D the information of the data alone
//! ```
//!
//! The expected residual of the next run is least for the mean p* of what the run leaves possible. How far a machine is
//! off is known only roughly, so t is found from all parameters together by maximum likelihood ([`Joint::spread`]): l_k are
//! the eigenvalues of S D S, b_k the components of S D p'. Directions that the data determine are corrected as they
//! are found; of the others p* takes what the data support. It therefore needs no decision for each parameter.
//!
//! A parameter is held at the plan ([`hold`]) if it at least doubles the standard error of another one that
//! matters, and if the data favour the plan's value by `FAVOURED` to 1 over a value of the spread t s:
//!
//! ```text
//! odds = (t^2 s^2 / c)^1/2 exp(-p'^2 / 2 c)          c the variance of p' (Savage and Dickey's ratio)
//! ```
//!
//! The others and their standard errors are then those of a fit without it. If the plan's value is as probable
//! beforehand as any other, the hold is wrong in one of `FAVOURED` runs.

use nalgebra::{DMatrix, DVector, SymmetricEigen};
use planish_types::text::significant;

use crate::{
    determined::{Part, shown},
    fit::LeastSquaresFit,
    parameter::Parameter,
};

/// Ratio of an estimate to its standard error above which correcting the parameter lowers the expected residual: the
/// root of 2.
const WORTH: f64 = std::f64::consts::SQRT_2;

/// Square of the correlation of two unknowns above which holding one halves the standard error of the other.
const HALVES: f64 = 0.75;

/// Smallest odds of the plan's value with which a parameter is held. Larger: fewer holds, and fewer wrong ones.
/// Smaller: more of both.
const FAVOURED: f64 = 20.0;

/// Smallest spread (t of the module) that is tried; the constant below is the number of tried spreads per decade, up to
/// 1.
const SMALLEST_SPREAD: f64 = 1e-3;
const PER_DECADE: i32 = 20;

/// Variance of a combination of parameters in units of their scales, as a fraction of the largest one, below which it
/// is rounding.
const ROUNDING: f64 = 1e-15;

/// Estimates and covariance of all unknowns of a fit. Parameters may be moved to their value in the plan (0), and the
/// others follow by their correlation.
pub struct Joint {
    /// Estimates of all unknowns: the parameters, then the terms of the metrology.
    pub values: DVector<f64>,
    /// Covariance of the estimates.
    pub covariance: DMatrix<f64>,
}

impl Joint {
    /// Creates the joint distribution of the unknowns from a fit.
    pub fn new(fit: &LeastSquaresFit) -> Self {
        Self { values: DVector::from_vec(fit.values.clone()), covariance: fit.covariance.clone() }
    }

    /// Adds to the covariance an uncertainty that moves the first unknowns together: one standard error of it changes
    /// unknown k by `along[k]`.
    pub fn widen(&mut self, along: &[f64]) {
        for (i, a) in along.iter().enumerate() {
            for (j, b) in along.iter().enumerate() {
                self.covariance[(i, j)] += a * b;
            }
        }
    }

    /// Returns the standard error of unknown `i`.
    pub fn standard_error(&self, i: usize) -> f64 {
        self.covariance[(i, i)].max(0.0).sqrt()
    }

    /// Returns the distance of the estimate of unknown `i` from the plan, in standard errors; infinite if its variance
    /// is 0.
    fn over_error(&self, i: usize) -> f64 {
        let variance = self.covariance[(i, i)];
        if variance > 0.0 { self.values[i].abs() / variance.sqrt() } else { f64::INFINITY }
    }

    /// Returns the odds of the plan's value of unknown `i` over a value drawn with the standard deviation `spread`
    /// about it, by the formula of the module.
    fn odds(&self, i: usize, spread: f64) -> f64 {
        let z = self.over_error(i);
        (spread / self.covariance[(i, i)].sqrt()) * (-0.5 * z * z).exp()
    }

    /// Sets unknown `i` to its value in the plan; the others change by their correlation with it.
    fn put_at_plan(&mut self, i: usize) {
        let variance = self.covariance[(i, i)];
        if variance > 0.0 {
            let column = self.covariance.column(i).clone_owned();
            self.values -= &column * (self.values[i] / variance);
            self.covariance -= &column * column.transpose() / variance;
        }
        self.values[i] = 0.0;
    }

    /// Returns what the data alone say about the parameters `indices`, in units of their `scales`: the eigenvalues l_k
    /// and components b_k of the module, and the eigenvectors.
    fn information(
        &self,
        indices: &[usize],
        scales: &[f64],
    ) -> (Vec<f64>, DVector<f64>, DMatrix<f64>) {
        let n = indices.len();
        let scaled = DMatrix::from_fn(n, n, |a, b| {
            let [a, b] = [indices[a], indices[b]];
            self.covariance[(a, b)] / (scales[a] * scales[b])
        });
        let values = DVector::from_fn(n, |a, _| self.values[indices[a]] / scales[indices[a]]);
        let eigen = SymmetricEigen::new(scaled);
        let least = (ROUNDING * eigen.eigenvalues.max()).max(f64::MIN_POSITIVE);
        let along = eigen.eigenvectors.transpose() * values;
        // The fit has the scales as one observation more.
        let precisions = eigen.eigenvalues.map(|variance| variance.max(least).recip());
        let information = precisions.iter().map(|precision| (precision - 1.0).max(0.0)).collect();
        let right = precisions.component_mul(&along);
        (information, right, eigen.eigenvectors)
    }

    /// Returns the common spread t of the parameters `indices` in units of their `scales`, by maximum likelihood; 1e-3
    /// to 1. It is 1 if there are no parameters.
    pub fn spread(&self, indices: &[usize], scales: &[f64]) -> f64 {
        if indices.is_empty() {
            return 1.0;
        }
        let (information, right, _) = self.information(indices, scales);
        // L(t)
        let likelihood = |t: f64| -> f64 {
            let pairs = information.iter().zip(right.iter());
            pairs.map(|(l, b)| 0.5 * b * b / (l + t.powi(-2)) - 0.5 * (t * t * l).ln_1p()).sum()
        };
        let decades = -SMALLEST_SPREAD.log10();
        let count = (decades * f64::from(PER_DECADE)).round() as i32;
        let tried = (0..=count).map(|k| 10_f64.powf(f64::from(k - count) / f64::from(PER_DECADE)));
        let best = tried.max_by(|a, b| likelihood(*a).total_cmp(&likelihood(*b)));
        best.unwrap_or(1.0)
    }

    /// Returns the corrections p* of the module for the parameters `indices`, with the spread `t`.
    pub fn mean(&self, indices: &[usize], scales: &[f64], t: f64) -> Vec<f64> {
        let (information, right, vectors) = self.information(indices, scales);
        let along =
            DVector::from_fn(indices.len(), |k, _| right[k] / (information[k] + t.powi(-2)));
        let values = vectors * along;
        indices.iter().enumerate().map(|(a, i)| values[a] * scales[*i]).collect()
    }
}

/// A parameter that is held at its value in the plan automatically.
pub struct Held {
    /// Index of the parameter in the fit.
    pub index: usize,
    /// Reason for the hold, as a sentence for the user.
    pub reason: String,
}

/// Holds the parameters that the rule of the module holds. Returns them, and the distribution of all unknowns with them
/// at the plan. `may_be_held[i]` is true if parameter `i` may be held; `spread[i]` is its spread t s_i of the module,
/// in its unit.
pub fn hold(fit: &LeastSquaresFit, may_be_held: &[bool], spread: &[f64]) -> (Vec<Held>, Joint) {
    let mut joint = Joint::new(fit);
    let mut held: Vec<Held> = Vec::new();
    loop {
        let is_held = |i: usize| held.iter().any(|h| h.index == i);
        let matters =
            |i: usize| fit.parameters[i] == Parameter::RateScale || joint.over_error(i) > WORTH;
        let c = &joint.covariance;
        let mut worst: Option<(usize, usize, f64)> = None;
        for q in (0..may_be_held.len()).filter(|q| may_be_held[*q] && !is_held(*q)) {
            if joint.odds(q, spread[q]) < FAVOURED {
                continue;
            }
            for i in (0..may_be_held.len()).filter(|i| *i != q && !is_held(*i) && matters(*i)) {
                let square = c[(i, q)].powi(2) / (c[(i, i)] * c[(q, q)]);
                if square >= HALVES && worst.is_none_or(|w| square > w.2) {
                    worst = Some((q, i, square));
                }
            }
        }
        let Some((q, i, square)) = worst else { break };
        let alone = (c[(i, i)] * (1.0 - square).max(0.0)).sqrt();
        let reason = format!(
            "held at the plan: its estimate is {} standard errors ({}) from it, the data favour the plan by {} to 1, \
             and it raises the standard error of {} from {} to {}",
            significant(joint.over_error(q), 2),
            shown(fit.parameters[q], c[(q, q)].sqrt()),
            significant(joint.odds(q, spread[q]), 2),
            fit.parameters[i].name(),
            shown(fit.parameters[i], alone),
            shown(fit.parameters[i], c[(i, i)].sqrt()),
        );
        joint.put_at_plan(q);
        held.push(Held { index: q, reason });
    }
    (held, joint)
}

/// Returns the corrections of the next plan from the estimates of all unknowns, one per parameter, in its unit; 0 for
/// those that stay at the plan. `parts` says how each is treated.
pub fn applied(mut joint: Joint, parts: &[Part], scales: &[f64]) -> Vec<f64> {
    for i in (0..parts.len()).filter(|i| parts[*i] == Part::AtPlan) {
        joint.put_at_plan(i);
    }
    let free: Vec<usize> = (0..parts.len()).filter(|i| parts[*i] != Part::AtPlan).collect();
    let mut corrections = vec![0.0; parts.len()];
    if free.is_empty() {
        return corrections;
    }
    let t = joint.spread(&free, scales);
    for (i, value) in free.iter().zip(joint.mean(&free, scales, t)) {
        if parts[*i] == Part::Corrected {
            corrections[*i] = value;
        }
    }
    corrections
}
