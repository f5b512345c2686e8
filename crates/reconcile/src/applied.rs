//! The correction that the next run gets.
//!
//! ```text
//! E |p - p'|^2 < E |p - 0|^2   only if   p^2 > var(p'),   and E p'^2 = p^2 + var(p')
//! ```
//!
//! An estimate p' therefore lowers the expected residual of the next run only if it exceeds sqrt(2) of its standard
//! error. Every other parameter stays at the plan. The applied values are those of the fit with these parameters, and
//! the refused ones, at the plan. They leave less of this run's removal unexplained than a part of the joint estimate.
//!
//! [`hold`] takes the same step before the numbers are stated. A parameter within sqrt(2) standard errors of the plan
//! that makes the standard error of another one at least twice as large is held at the plan. The others take the values
//! of the fit without it. Their standard errors remain those of the fit with it: they contain the error that the hold
//! may cause.

use nalgebra::{DMatrix, DVector};
use planish_types::text::significant;

use crate::{determined::shown, fit::Fit, parameter::Parameter};

/// Estimate over its standard error from which a correction lowers the expected residual.
const WORTH: f64 = std::f64::consts::SQRT_2;

/// Square of the correlation from which holding one unknown halves the standard error of another.
const HALVES: f64 = 0.75;

/// Estimates and their covariance while parameters are taken to the plan.
struct Joint {
    values: DVector<f64>,
    covariance: DMatrix<f64>,
}

impl Joint {
    fn new(fit: &Fit) -> Self {
        Self { values: DVector::from_vec(fit.values.clone()), covariance: fit.covariance.clone() }
    }

    fn over_error(&self, i: usize) -> f64 {
        let variance = self.covariance[(i, i)];
        if variance > 0.0 { self.values[i].abs() / variance.sqrt() } else { f64::INFINITY }
    }

    /// Takes unknown `i` to the plan; the others follow by their correlation with it.
    fn put_at_plan(&mut self, i: usize) {
        let variance = self.covariance[(i, i)];
        if variance > 0.0 {
            let column = self.covariance.column(i).clone_owned();
            self.values -= &column * (self.values[i] / variance);
            self.covariance -= &column * column.transpose() / variance;
        }
        self.values[i] = 0.0;
    }
}

/// One parameter that is held automatically.
pub struct Held {
    /// Its place among the parameters.
    pub index: usize,
    /// The reason, for people.
    pub reason: String,
}

/// Holds what only inflates: the parameters and the values of all unknowns with them at the plan. `may[i]` says whether
/// parameter `i` may be held.
pub fn hold(fit: &Fit, may: &[bool]) -> (Vec<Held>, Vec<f64>) {
    let mut joint = Joint::new(fit);
    let mut held: Vec<Held> = Vec::new();
    loop {
        let is_held = |i: usize| held.iter().any(|h| h.index == i);
        let matters =
            |i: usize| fit.parameters[i] == Parameter::RateScale || joint.over_error(i) > WORTH;
        let c = &joint.covariance;
        let mut worst: Option<(usize, usize, f64)> = None;
        for q in (0..may.len()).filter(|q| may[*q] && !is_held(*q)) {
            if joint.over_error(q) > WORTH {
                continue;
            }
            for i in (0..may.len()).filter(|i| *i != q && !is_held(*i) && matters(*i)) {
                let square = c[(i, q)].powi(2) / (c[(i, i)] * c[(q, q)]);
                if square >= HALVES && worst.is_none_or(|w| square > w.2) {
                    worst = Some((q, i, square));
                }
            }
        }
        let Some((q, i, square)) = worst else { break };
        let alone = (c[(i, i)] * (1.0 - square).max(0.0)).sqrt();
        let reason = format!(
            "held at the plan: its estimate is {} standard errors from it, and it raises the standard error of {} from \
             {} to {}; the stated standard errors still contain it",
            significant(joint.over_error(q), 2),
            fit.parameters[i].name(),
            shown(fit.parameters[i], alone),
            shown(fit.parameters[i], c[(i, i)].sqrt()),
        );
        joint.put_at_plan(q);
        held.push(Held { index: q, reason });
    }
    (held, joint.values.iter().copied().collect())
}

/// The corrections of the next run, 0 for what stays at the plan. `learnt[i]` is false for a parameter that is refused
/// or held; `follows[i]` is false for one that the others must not make up for.
pub fn applied(fit: &Fit, learnt: &[bool], follows: &[bool]) -> Vec<f64> {
    let mut joint = Joint::new(fit);
    let mut stays: Vec<bool> = learnt.iter().map(|l| !l).collect();
    for i in (0..learnt.len()).filter(|i| stays[*i]) {
        if follows[i] {
            joint.put_at_plan(i);
        }
    }
    loop {
        let rest = (0..learnt.len()).filter(|i| !stays[*i]);
        let least = rest.min_by(|a, b| joint.over_error(*a).total_cmp(&joint.over_error(*b)));
        match least {
            Some(i) if joint.over_error(i) <= WORTH => {
                joint.put_at_plan(i);
                stays[i] = true;
            }
            _ => break,
        }
    }
    (0..learnt.len()).map(|i| if stays[i] { 0.0 } else { joint.values[i] }).collect()
}
