//! The error budget of the next run, after the corrections of this one.
//!
//! An error that was learnt is corrected in the next plan, and what is left of it is the standard error of its
//! estimate. It takes the place of all errors of the process that act on the same quantity; where the TIF's ellipticity
//! is learnt in both directions, these are its rotation, too. What was refused, or not asked for, stays as it was
//! known. Correlations between the estimates are not in the error budget, whose errors are independent.

use planish_simulate::error_budget::{
    Distribution, Effect, ErrorBudget, ErrorBudgetFile, ErrorFile, Kind, Scalar,
};

use crate::{fit::LeastSquaresFit, parameter::Parameter};

/// Notes of `planish reconcile` on the errors in a file.
const LEARNT: &str = "learnt: standard error of planish reconcile";
const BELIEVED: &str = "not learnt: what is believed of a machine that nobody knows";
const DRIFTS: &str = "learnt by planish reconcile; the next plan does not correct it";
const FROM_THE_REST: &str =
    "learnt: what the fit of planish reconcile leaves, over the root of two maps";

/// Returns the error budget of the next run. `refused[i]` is true if the data do not determine parameter `i`,
/// `estimates[i]` is its value and standard error, and `corrections[i]` its correction in the next plan. `process` is
/// the error budget of this run, and `scale` the standard deviation of a parameter as known beforehand.
pub fn left(
    process: Option<&ErrorBudget>,
    fit: &LeastSquaresFit,
    estimates: &[[f64; 2]],
    corrections: &[f64],
    refused: &[bool],
    scale: impl Fn(Parameter) -> f64,
) -> ErrorBudgetFile {
    let drifts = |i: usize| estimates[i][0].abs() > std::f64::consts::SQRT_2 * estimates[i][1];
    let remaining_error = |p: Parameter| {
        let i = fit.parameters.iter().position(|q| *q == p)?;
        let [value, standard_error] = estimates[i];
        // What stays at the plan is off by its estimate, too.
        let uncorrected = match p {
            Parameter::RateDrift if drifts(i) => 0.0,
            Parameter::RateDrift => value,
            _ if corrections[i] == 0.0 => value,
            _ => 0.0,
        };
        if refused[i] { None } else { Some(standard_error.hypot(uncorrected)) }
    };
    let is_replaced = |effect: &Effect| {
        let Effect::Scalar(scalar) = effect else { return false };
        let both = [Parameter::TifEllipticity, Parameter::TifDiagonalEllipticity];
        if *scalar == Scalar::TifRotation {
            return both.iter().all(|p| remaining_error(*p).is_some());
        }
        let mut parameters = fit.parameters.iter().filter(|p| p.scalar() == *scalar);
        parameters.any(|p| remaining_error(*p).is_some())
    };
    let stated = process.map_or(&[][..], |p| &p.errors);
    let mut errors: Vec<ErrorFile> =
        stated.iter().filter(|e| !is_replaced(&e.effect)).map(|e| e.stated.clone()).collect();
    for p in &fit.parameters {
        match remaining_error(*p) {
            Some(error) => errors.push(entry(*p, error, LEARNT)),
            // Without a process what is believed of it stands nowhere else.
            None if process.is_none() => errors.push(entry(*p, scale(*p), BELIEVED)),
            None => {}
        }
    }
    // No plan corrects a drift: where it is clear it is known, and stays.
    let drift = fit.parameters.iter().position(|p| *p == Parameter::RateDrift);
    if let Some(i) = drift.filter(|i| !refused[*i] && drifts(*i)) {
        let mut known = entry(Parameter::RateDrift, estimates[i][0], DRIFTS);
        known.distribution = Distribution::Fixed;
        errors.push(known);
    }
    if !stated.iter().any(|e| e.effect == Effect::MapNoise) {
        let size = fit.noise.noise.rest_rms_nm * std::f64::consts::FRAC_1_SQRT_2;
        errors.push(error(Kind::MapNoise, size, "nm", FROM_THE_REST));
    }
    let name = process.map_or("what a run taught".into(), |p| p.name.clone());
    ErrorBudgetFile { name, errors }
}

fn entry(parameter: Parameter, size: f64, note: &str) -> ErrorFile {
    let (unit, factor) = parameter.unit();
    error(parameter.kind(), size / factor, unit, note)
}

fn error(kind: Kind, size: f64, unit: &str, note: &str) -> ErrorFile {
    ErrorFile {
        kind,
        size,
        unit: unit.into(),
        distribution: Distribution::Normal,
        note: note.into(),
        correlation_s: None,
        time_constant_s: None,
        damping_ratio: None,
        acceleration_mm_per_s2: None,
        degree: None,
    }
}
