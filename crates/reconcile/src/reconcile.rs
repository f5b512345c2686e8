//! Reconciliation of two maps and a plan: the fits, the verdict on each parameter, and what the next plan gets.

use nalgebra::{Matrix2, Vector2};
use ndarray::Array2;
use planish_simulate::{
    deviation::TURNS,
    error_budget::{ErrorBudget, ErrorBudgetFile},
    runs::Runs,
    tail,
    tool::smooth,
};
use planish_types::{
    Invalid, Surface, Tif, Trajectory, Transform,
    outcome::reconciliation::{Ellipse, Estimate, Evidence, Fitted, ReconciliationOutcome},
};

use crate::{
    applied::{Held, Joint, applied, hold},
    bands::{Maps, bands},
    contradictory,
    determined::{Part, Refusal, all_moves, contradicted, refusal, shown, wider_orders},
    fit::{Data, LeastSquaresFit, Start, dot, fit},
    left::left,
    metrology::{self, Term},
    model::RemovalModel,
    parameter::{ALL, Parameter},
    place::corrected_transform,
    resample::{METHOD, are_same, resampled},
    settings::ReconcileSettings,
};

/// Smallest number of valid pixels per unknown of the fit; maps with fewer are refused. Larger: small maps are refused.
/// Smaller: fits of noise.
const LEAST_PIXELS_PER_UNKNOWN: f64 = 20.0;

/// Largest ellipticity of the TIF, in its standard errors, for which no direction is stated. Larger: directions are
/// left out that are known. Smaller: directions of noise are given. Chosen.
const NO_DIRECTION: f64 = 2.0;

/// Inputs of a reconciliation: the maps before and after a run, and its plan.
#[derive(Clone, Copy, Debug)]
pub struct Comparison<'a> {
    /// Map that was measured before the run.
    pub before: &'a Surface,
    /// Map that was measured after the run. One on other pixels is resampled on those of `before`.
    pub after: &'a Surface,
    /// Motion of the run, as planned or as it was traced.
    pub trajectory: &'a Trajectory,
    /// TIF with which the run was planned.
    pub tif: &'a Tif,
    /// Error budget with the errors that were expected before the run; `None` if there is none.
    pub error_budget: Option<&'a ErrorBudget>,
    /// Transform that took the plan to the machine; `None` if there was none.
    pub transform: Option<&'a Transform>,
}

/// Result of a reconciliation.
pub struct Reconciled {
    /// Results for the manifest.
    pub outcome: ReconciliationOutcome,
    /// Correlation matrix of all unknowns, in the order of `outcome.correlation_of`.
    pub correlation: Array2<f64>,
    /// Measured removal: before - after without the terms of the metrology, shape (ny, nx), nm; NaN where a map is
    /// invalid.
    pub measured_nm: Array2<f64>,
    /// Removal that the plan predicted, shape (ny, nx), nm.
    pub planned_nm: Array2<f64>,
    /// Removal with the fitted parameters, shape (ny, nx), nm.
    pub predicted_nm: Array2<f64>,
    /// Sum of the fitted terms of the metrology, shape (ny, nx), nm.
    pub metrology_nm: Array2<f64>,
    /// Rest of the data after the fit, shape (ny, nx), nm; NaN where a map is invalid.
    pub rest_nm: Array2<f64>,
    /// TIF of the next plan, with the corrected rate and shape.
    pub tif: Tif,
    /// Transform that takes the next plan to the machine, with the corrected position.
    pub transform: Transform,
    /// Error budget of the next run.
    pub error_budget: ErrorBudgetFile,
    /// Reason for a negative verdict: the maps do not show that they are of this run, a prior scale contradicts the
    /// data, or a parameter that was asked for by name is refused, or all are. `None` otherwise.
    pub drawback: Option<String>,
}

impl<'a> Comparison<'a> {
    /// Returns the TIF that the parameters change: smoothed, or as sampled if the settings say so.
    ///
    /// # Errors
    /// Fails if the TIF cannot be smoothed.
    pub fn moved_tif(&self, settings: &ReconcileSettings) -> Result<Tif, Invalid> {
        if settings.tif_as_sampled {
            Ok(self.tif.clone())
        } else {
            smooth(self.tif, self.tif.width_mm())
        }
    }

    /// Returns before - after, nm, on the pixels that are valid in both maps; a map after on other pixels is resampled.
    /// `unknowns` is the number of unknowns of the fit.
    ///
    /// # Errors
    /// Fails if the maps have fewer than 20 common valid pixels per unknown, or if the map after cannot be resampled.
    pub fn data(&self, unknowns: usize) -> Result<Data<'a>, Invalid> {
        let grid = self.before.grid();
        let mut data = if are_same(grid, self.after.grid()) {
            self.before.height_nm() - self.after.height_nm()
        } else {
            self.before.height_nm() - resampled(self.after, grid)?.height_nm()
        };
        let valid = data.mapv(|v| if v.is_nan() { 0.0 } else { 1.0 });
        data.mapv_inplace(|v| if v.is_nan() { 0.0 } else { v });
        let least = LEAST_PIXELS_PER_UNKNOWN * unknowns.max(1) as f64;
        if valid.sum() < least {
            let problem = format!("has {} pixels that are valid in both maps", valid.sum().round());
            let remedy = format!("give maps with at least {least} in common, or hold parameters");
            return Err(Invalid::whole("height_nm", problem, remedy));
        }
        Ok(Data { grid, data, valid })
    }
}

/// A TIF and the simulated runs with it.
#[derive(Clone, Copy)]
struct Tool<'a> {
    runs: &'a Runs<'a>,
    tif: &'a Tif,
}

/// Versions of the TIF that a fit may use; the one with the smallest rest is taken.
struct Tools<'a> {
    /// The tool without its noise, whose TIF the parameters change.
    smooth: Tool<'a>,
    /// Runs with the tool as it was sampled, for the removal itself; `None` if they are not needed.
    as_sampled: Option<&'a Runs<'a>>,
    /// The tool continued beyond its samples, if these end before the tool does: first without its noise, then as it
    /// is.
    continued: Option<[Tool<'a>; 2]>,
}

/// A fit of the run with its model.
struct RunFit<'a> {
    fit: LeastSquaresFit,
    model: RemovalModel<'a>,
    /// TIF that is continued beyond its samples, if it explains more of the data; otherwise `None`.
    continued: Option<&'a Tif>,
    /// Parameters whose prior scale contradicted the data and was replaced by the usual one.
    released: Vec<Parameter>,
}

impl<'a> Tools<'a> {
    /// Fits the model with every version of the tool, and returns the fit with the smallest sum of squares of the rest.
    /// `scale` is the standard deviation of a parameter as known beforehand.
    fn best_fit(
        &self,
        parameters: &[Parameter],
        (terms, data): (&[Term], &Data<'_>),
        scale: impl Fn(Parameter) -> f64 + Copy,
    ) -> Result<RunFit<'a>, Invalid> {
        let Tool { runs, tif } = self.smooth;
        let model = RemovalModel::new(runs, tif, parameters.to_vec(), scale);
        let start = Start::new(&model)?;
        let fit_of_plan = fit(&model, terms, data, &start)?;
        let mut best = RunFit { fit: fit_of_plan, model, continued: None, released: Vec::new() };
        // The TIF as it is sampled has no error of smoothing, but moves its noise: the data decide.
        let as_sampled = self.as_sampled.map(|removal| (self.smooth, removal, None));
        let continued = self.continued.map(|[smooth, own]| (smooth, own.runs, Some(own.tif)));
        for (Tool { runs, tif }, removal, continued) in as_sampled.into_iter().chain(continued) {
            let mut model = RemovalModel::new(runs, tif, parameters.to_vec(), scale);
            model.removal_from = Some(removal);
            let from = Start::from_values(&model, best.fit.values[..parameters.len()].to_vec())?;
            let again = fit(&model, terms, data, &from)?;
            if dot(&again.rest, &again.rest) < dot(&best.fit.rest, &best.fit.rest) {
                best = RunFit { fit: again, model, continued, ..best };
            }
        }
        Ok(best)
    }

    /// Fits equation (1) of the crate's documentation. Fits again with the usual scale for each parameter whose scale
    /// contradicts the data.
    fn fit(
        &self,
        parameters: &[Parameter],
        (terms, data): (&[Term], &Data<'_>),
        scale: impl Fn(Parameter) -> f64 + Copy,
        metrology_order: Option<[usize; 2]>,
    ) -> Result<RunFit<'a>, Invalid> {
        let mut released: Vec<Parameter> = Vec::new();
        loop {
            let known = |p| if released.contains(&p) { p.usual_scale() } else { scale(p) };
            let best = self.best_fit(parameters, (terms, data), known)?;
            match contradicted(&best.fit, data, metrology_order, known) {
                Some(parameter) => released.push(parameter),
                None => return Ok(RunFit { released, ..best }),
            }
        }
    }
}

/// Verdict on every parameter of a fit, and its correction in the next plan.
struct JudgedFit {
    /// Reason why each parameter is not determined; `None` if it is.
    refusals: Vec<Option<String>>,
    /// Reason why each parameter is held at the plan automatically; `None` if it is not.
    why_held: Vec<Option<String>>,
    /// Corrections of the next plan, one per parameter, in its unit; all 0 if there is evidence against the map after.
    corrections: Vec<f64>,
    /// Value and standard error of each parameter; those of held parameters are from the fit with all free.
    stated: Vec<[f64; 2]>,
    /// Estimates and covariance of the fit with all parameters free.
    with_all: Joint,
    /// Evidence that the map after is that of the run.
    evidence: Evidence,
    /// Sentence against the map after, because of which nothing is corrected; `None` if there is none.
    nothing: Option<String>,
}

impl RunFit<'_> {
    /// Judges every parameter of the fit. Parameters that [`hold`] holds are at the plan afterwards, in `self.fit` too.
    /// `scale` is the standard deviation of a parameter as known beforehand.
    fn judge(
        &mut self,
        comparison: &Comparison<'_>,
        settings: &ReconcileSettings,
        (data, runs): (&Data<'_>, &Runs<'_>),
        scale: impl Fn(Parameter) -> f64,
    ) -> Result<JudgedFit, Invalid> {
        let Self { fit, model, released, .. } = self;
        let count = fit.parameters.len();
        let moved_by = all_moves(fit, data, settings.metrology_order);
        let mut judged: Vec<Option<Refusal>> = Vec::with_capacity(count);
        for (i, parameter) in fit.parameters.iter().enumerate() {
            let scale = scale(*parameter);
            judged.push(if released.contains(parameter) {
                Some(Refusal::of_the_model(contradiction(fit, i, scale)))
            } else {
                refusal(fit, i, scale, &moved_by[i])
            });
        }
        let mut parts: Vec<Part> =
            judged.iter().map(|r| r.as_ref().map_or(Part::Corrected, |r| r.part)).collect();
        let mut refusals: Vec<Option<String>> =
            judged.iter().map(|r| r.as_ref().map(|r| r.reason.clone())).collect();
        let judgement = contradictory::judge(
            comparison.before.height_nm(),
            data,
            &runs.executed,
            fit,
            &fitted(fit, data, runs),
            comparison.tif.width_mm(),
            settings.same_measurement,
        );
        let nothing = judgement.against;
        if nothing.is_some() {
            refusals.fill(Some("the maps do not show that they are of this run".into()));
        }
        let with_all = Joint::new(fit);
        let mut uncertain = Joint::new(fit);
        // What moves with the metrology is uncertain along the move of all parameters together.
        let mut moves: Vec<usize> = judged.iter().flatten().filter_map(|r| r.moved).collect();
        moves.sort_unstable();
        moves.dedup();
        for k in moves {
            let along: Vec<f64> = moved_by.iter().map(|m| m[k].0.by).collect();
            uncertain.widen(&along);
        }
        let determined: Vec<usize> = (0..count).filter(|i| parts[*i] == Part::Corrected).collect();
        let spread = uncertain.spread(&determined, &model.scales);
        let mut may_be_held: Vec<bool> = Vec::with_capacity(count);
        for (parameter, refusal) in fit.parameters.iter().zip(&refusals) {
            let is_requested = settings.free.iter().any(|name| name == parameter.name());
            may_be_held
                .push(*parameter != Parameter::RateScale && !is_requested && refusal.is_none());
        }
        let spreads: Vec<f64> = model.scales.iter().map(|s| spread * s).collect();
        let (held, without) = hold(fit, &may_be_held, &spreads);
        let mut why_held: Vec<Option<String>> = vec![None; count];
        for Held { index, reason } in &held {
            why_held[*index] = Some(reason.clone());
            parts[*index] = Part::AtPlan;
        }
        let corrections = match nothing {
            Some(_) => vec![0.0; count],
            None => applied(uncertain, &parts, &model.scales),
        };
        if !held.is_empty() {
            let values = without.values.iter().copied().collect();
            fit.take(model, data, values, without.covariance)?;
        }
        let mut stated = Vec::with_capacity(count);
        for (i, why) in why_held.iter().enumerate() {
            stated.push(match why {
                Some(_) => [with_all.values[i], with_all.standard_error(i)],
                None => [fit.values[i], fit.standard_error(i)],
            });
        }
        let evidence = judgement.evidence;
        Ok(JudgedFit { refusals, why_held, corrections, stated, with_all, evidence, nothing })
    }
}

impl JudgedFit {
    /// Returns the estimate of a parameter for the report, free or not; `scale` is its standard deviation as known
    /// beforehand.
    fn estimate(
        &self,
        fit: &LeastSquaresFit,
        tif: &Tif,
        parameter: Parameter,
        scale: f64,
    ) -> Estimate {
        let (unit, factor) = parameter.unit();
        let index = fit.parameters.iter().position(|p| *p == parameter);
        let mut estimate = estimate(fit, index, parameter.name(), unit, factor);
        estimate.known_beforehand = Some(scale / factor);
        if !parameter.is_of(tif) {
            estimate.held_because = Some(format!("held at the plan: the tool {TURNS}"));
        }
        let Some(i) = index else { return estimate };
        estimate.refused = self.refusals[i].clone();
        if estimate.refused.is_some() {
            estimate.value = None;
        }
        // No plan corrects a drift.
        if parameter != Parameter::RateDrift {
            estimate.applied = self.corrections[i] / factor;
        }
        estimate.held_because = self.why_held[i].clone();
        if estimate.held_because.is_some() {
            estimate.value = Some(self.stated[i][0] / factor);
            estimate.standard_error = Some(self.stated[i][1] / factor);
        }
        estimate
    }
}

/// Returns the RMS values, nm, of the measured removal, of its difference from the plan, and of the rest of the fit.
fn fitted(fit: &LeastSquaresFit, data: &Data<'_>, runs: &Runs<'_>) -> Fitted {
    let measured = &data.data - &fit.metrology;
    Fitted {
        measured_removal_rms_nm: rms(&measured, &data.valid),
        measured_less_planned_rms_nm: rms(&(&measured - &runs.executed), &data.valid),
        rest_rms_nm: rms(&fit.rest, &data.valid),
    }
}

/// Estimates the parameters of a run from the maps before and after it, with the corrections of the next run.
///
/// # Errors
/// Fails if the settings are refused, if the maps have too few valid pixels in common, if the tool turns with the
/// direction of its motion, or if a run cannot be simulated.
pub fn reconcile(
    comparison: &Comparison<'_>,
    settings: &ReconcileSettings,
) -> Result<Reconciled, Invalid> {
    comparison.tif.same_in_all_directions("planish reconcile")?;
    let (parameters, terms) = settings.chosen(|p| p.is_of(comparison.tif))?;
    let data = comparison.data(parameters.len() + terms.len())?;
    let moved = comparison.moved_tif(settings)?;
    let runs_of = |tif, moved| Runs::new(comparison.trajectory, tif, moved, data.grid);
    let runs = runs_of(comparison.tif, &moved)?;
    let mut as_sampled = None;
    let mut with_tail = None;
    if !settings.tif_as_sampled {
        as_sampled = Some(runs_of(comparison.tif, comparison.tif)?);
        with_tail = tail::continued(comparison.tif)?;
    }
    let smooth_tail = with_tail.as_ref().map(|t| smooth(t, t.width_mm())).transpose()?;
    let tails = with_tail.as_ref().zip(smooth_tail.as_ref());
    let tails = tails.map(|(t, smooth)| Ok((runs_of(t, smooth)?, runs_of(t, t)?))).transpose()?;
    let of_tail = smooth_tail.as_ref().zip(with_tail.as_ref());
    let tools = Tools {
        smooth: Tool { runs: &runs, tif: &moved },
        as_sampled: as_sampled.as_ref(),
        continued: tails.as_ref().zip(of_tail).map(|((of_smooth, own), (smooth, t))| {
            [Tool { runs: of_smooth, tif: smooth }, Tool { runs: own, tif: t }]
        }),
    };
    let scale =
        |p: Parameter| comparison.error_budget.map_or(p.usual_scale(), |file| p.scale_in(file));
    let mut run_fit = tools.fit(&parameters, (&terms, &data), scale, settings.metrology_order)?;
    let judged = run_fit.judge(comparison, settings, (&data, &runs), scale)?;
    result(comparison, settings, (&data, &runs), (&run_fit, &judged), scale)
}

/// Collects the results of a judged fit: numbers, maps, and the corrections for the next plan.
fn result(
    comparison: &Comparison<'_>,
    settings: &ReconcileSettings,
    (data, runs): (&Data<'_>, &Runs<'_>),
    (run_fit, judged): (&RunFit<'_>, &JudgedFit),
    scale: impl Fn(Parameter) -> f64 + Copy,
) -> Result<Reconciled, Invalid> {
    let RunFit { fit, model, continued, released, .. } = run_fit;
    let JudgedFit { refusals, corrections, stated, with_all, evidence, nothing, .. } = judged;
    let tool = continued.unwrap_or(comparison.tif);
    let refused: Vec<bool> = refusals.iter().map(Option::is_some).collect();
    let measured = &data.data - &fit.metrology;
    let maps = Maps { measured: &measured, planned: &runs.executed, predicted: &fit.removal };
    let parameters = ALL.map(|p| judged.estimate(fit, comparison.tif, p, scale(p)));
    let is_resampled = !are_same(data.grid, comparison.after.grid());
    let outcome = ReconciliationOutcome {
        parameters: parameters.into(),
        metrology: metrology_estimates(fit, settings),
        ellipse: ellipse(fit, refusals),
        correlation_of: fit.names(),
        singular_values: fit.singular_values.clone(),
        noise: fit.noise.noise,
        fitted: fitted(fit, data, runs),
        bands: bands(&maps, &data.valid, data.grid, comparison.tif.width_mm()),
        end: fit.end.to_string(),
        points: fit.points,
        tried_orders: wider_orders(settings.metrology_order),
        tif_is_as_sampled: settings.tif_as_sampled || model.removal_from.is_some(),
        tif_is_continued: continued.is_some(),
        resampled: if is_resampled { Some(METHOD.into()) } else { None },
        evidence: *evidence,
        explains_nothing: nothing.clone(),
    };
    let n = fit.values.len();
    let known: Vec<(Parameter, f64)> =
        fit.parameters.iter().copied().zip(corrections.iter().copied()).collect();
    let covariance = &with_all.covariance;
    Ok(Reconciled {
        drawback: nothing.clone().or_else(|| drawback(settings, fit, refusals, released)),
        correlation: Array2::from_shape_fn((n, n), |(i, j)| fit.correlation(i, j)),
        measured_nm: with_nan(&measured, &data.valid),
        planned_nm: runs.executed.clone(),
        predicted_nm: fit.removal.clone(),
        metrology_nm: fit.metrology.clone(),
        rest_nm: with_nan(&fit.rest, &data.valid),
        tif: RemovalModel::corrected_tif(tool, &known)?,
        transform: corrected_transform(
            comparison.transform,
            fit,
            covariance,
            corrections,
            &refused,
            scale,
            data.grid,
        )?,
        error_budget: left(comparison.error_budget, fit, stated, corrections, &refused, scale),
        outcome,
    })
}

/// Returns the map with NaN at its invalid pixels.
fn with_nan(map: &Array2<f64>, valid: &Array2<f64>) -> Array2<f64> {
    let mut map = map.clone();
    map.zip_mut_with(valid, |v, valid| *v = if *valid == 0.0 { f64::NAN } else { *v });
    map
}

/// Returns the RMS of `map` over the valid pixels about their mean, in the unit of `map`.
fn rms(map: &Array2<f64>, valid: &Array2<f64>) -> f64 {
    let count = valid.sum();
    let mean = (map * valid).sum() / count;
    let square = map.iter().zip(valid).map(|(v, w)| w * (v - mean).powi(2)).sum::<f64>();
    (square / count).sqrt()
}

/// Returns the estimate of the unknown at `index` for the report, in units of `factor`. If `index` is `None`, the
/// unknown is held and has no value.
fn estimate(
    fit: &LeastSquaresFit,
    index: Option<usize>,
    name: &str,
    unit: &str,
    factor: f64,
) -> Estimate {
    let inflation = index.map(|i| fit.inflation[i]).filter(|v| v.is_finite());
    let with_error = index.filter(|_| inflation.is_some());
    Estimate {
        name: name.into(),
        unit: unit.into(),
        value: index.map(|i| fit.values[i] / factor),
        standard_error: with_error.map(|i| fit.standard_error(i) / factor),
        known_beforehand: None,
        variance_inflation: inflation,
        refused: None,
        held: index.is_none(),
        held_because: None,
        applied: 0.0,
    }
}

/// Returns the estimates of the coefficients of all terms of the metrology, nm RMS.
fn metrology_estimates(fit: &LeastSquaresFit, settings: &ReconcileSettings) -> Vec<Estimate> {
    let mut estimates = Vec::new();
    for term in metrology::terms(settings.metrology_order) {
        let index = fit.terms.iter().position(|t| *t == term).map(|k| fit.parameters.len() + k);
        let mut estimate = estimate(fit, index, &term.name(), "nm RMS", 1.0);
        if index.is_some() && estimate.variance_inflation.is_none() {
            estimate.value = None;
            estimate.refused = Some("the data do not tell it from the others".into());
        }
        estimates.push(estimate);
    }
    estimates
}

/// Returns the ellipticity e = (E^2 + D^2)^1/2 and its direction phi = atan2(D, E) / 2, with standard errors to first
/// order. E and D are the ellipticities along x and along the diagonal. Returns `None` if one of them is not free or
/// not determined, or if both are 0.
fn ellipse(fit: &LeastSquaresFit, refusals: &[Option<String>]) -> Option<Ellipse> {
    let i = determined_index(fit, refusals, Parameter::TifEllipticity)?;
    let j = determined_index(fit, refusals, Parameter::TifDiagonalEllipticity)?;
    let e = fit.values[i];
    let d = fit.values[j];
    let size = e.hypot(d);
    if size == 0.0 {
        return None;
    }
    let c = &fit.covariance;
    let covariance = Matrix2::new(c[(i, i)], c[(i, j)], c[(i, j)], c[(j, j)]);
    let standard_error = error_along(&covariance, [e / size, d / size]);
    let mut ellipse = Ellipse {
        ellipticity_percent: 100.0 * size,
        standard_error_percent: 100.0 * standard_error,
        direction_deg: None,
        direction_standard_error_deg: None,
    };
    if size > NO_DIRECTION * standard_error {
        let error = error_along(&covariance, [-d / size, e / size]);
        ellipse.direction_deg = Some((0.5 * d.atan2(e)).to_degrees());
        ellipse.direction_standard_error_deg = Some((0.5 * error / size).to_degrees());
    }
    Some(ellipse)
}

/// Returns the index of a parameter in the fit; `None` if it is not free or the data do not determine it.
fn determined_index(
    fit: &LeastSquaresFit,
    refusals: &[Option<String>],
    parameter: Parameter,
) -> Option<usize> {
    fit.parameters.iter().position(|p| *p == parameter).filter(|i| refusals[*i].is_none())
}

/// Returns the standard error of the component along the unit vector `along`.
fn error_along(covariance: &Matrix2<f64>, along: [f64; 2]) -> f64 {
    let v = Vector2::from(along);
    (v.transpose() * covariance * v)[0].max(0.0).sqrt()
}

/// Returns the message on parameter `i`, whose prior scale contradicts the data.
fn contradiction(fit: &LeastSquaresFit, i: usize, scale: f64) -> String {
    let parameter = fit.parameters[i];
    format!(
        "the data contradict the {} that are known beforehand: without them they give {} +- {}; the other parameters are \
         estimated without them, too",
        shown(parameter, scale),
        shown(parameter, fit.values[i]),
        shown(parameter, fit.standard_error(i))
    )
}

/// Returns the reason for a negative verdict: a prior scale that contradicts the data, a parameter named in the
/// settings that is refused, or all refused. Returns `None` for a positive verdict.
fn drawback(
    settings: &ReconcileSettings,
    fit: &LeastSquaresFit,
    refusals: &[Option<String>],
    released: &[Parameter],
) -> Option<String> {
    if !released.is_empty() {
        let names: Vec<&str> = released.iter().map(|p| p.name()).collect();
        return Some(format!(
            "the data contradict what the process says of {}: mend the process, or plan with its wider error",
            names.join(", ")
        ));
    }
    let names = fit.parameters.iter().map(|p| p.name());
    let refused: Vec<&str> = names
        .zip(refusals)
        .filter(|(name, refusal)| refusal.is_some() && settings.free.iter().any(|n| n == name))
        .map(|(name, _)| name)
        .collect();
    if !refused.is_empty() {
        return Some(format!("the data do not determine {}", refused.join(", ")));
    }
    if !refusals.is_empty() && refusals.iter().all(Option::is_some) {
        return Some("the data determine none of the parameters".into());
    }
    None
}
