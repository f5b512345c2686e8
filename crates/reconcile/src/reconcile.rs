//! Reconciliation of two maps and a plan.

use nalgebra::Matrix2;
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
    applied::{Joint, applied, hold},
    bands::{Maps, bands},
    contradictory,
    determined::{Part, Refusal, all_moves, contradicted, refusal, shown, wider_orders},
    fit::{Data, Fit, Start, dot, fit},
    left::left,
    metrology::{self, Term},
    model::Model,
    parameter::{ALL, Parameter},
    place::place,
    resample::{METHOD, are_same, resampled},
    settings::Settings,
};

/// Fewest valid pixels for every unknown.
const LEAST_PIXELS_PER_UNKNOWN: f64 = 20.0;

/// Largest ellipticity without a direction, in standard errors. Larger: directions are left out that are known.
/// Smaller: directions of noise are given. Chosen.
const NO_DIRECTION: f64 = 2.0;

/// The maps before and after a run, and what was planned.
#[derive(Clone, Copy, Debug)]
pub struct Comparison<'a> {
    /// Measured before the run.
    pub before: &'a Surface,
    /// Measured after it. A map on other pixels is resampled on those of `before`.
    pub after: &'a Surface,
    /// The motion, as planned or as it was traced.
    pub trajectory: &'a Trajectory,
    /// The TIF of the plan.
    pub tif: &'a Tif,
    /// Error budget with what is believed beforehand, where it is known.
    pub error_budget: Option<&'a ErrorBudget>,
    /// Transform that took the plan to the machine, if there was one.
    pub transform: Option<&'a Transform>,
}

/// Result of a reconciliation.
pub struct Reconciled {
    /// The numbers.
    pub outcome: ReconciliationOutcome,
    /// Correlations of all unknowns, in the order of `outcome.correlation_of`.
    pub correlation: Array2<f64>,
    /// before - after without the terms of the metrology (ny, nx), nm; NaN where a map is invalid.
    pub measured_nm: Array2<f64>,
    /// The removal that the plan promised (ny, nx), nm.
    pub planned_nm: Array2<f64>,
    /// The removal with all unknowns (ny, nx), nm.
    pub predicted_nm: Array2<f64>,
    /// The terms of the metrology (ny, nx), nm.
    pub metrology_nm: Array2<f64>,
    /// Rest of the fit (ny, nx), nm; NaN where a map is invalid.
    pub rest_nm: Array2<f64>,
    /// The TIF with the rate and the shape that are determined.
    pub tif: Tif,
    /// Transform that takes the next plan to the machine, by the parameters that are determined.
    pub transform: Transform,
    /// The errors of the next run.
    pub error_budget: ErrorBudgetFile,
    /// Reason for a negative verdict, if it is one: a parameter that was asked for by name is refused, or all are.
    pub drawback: Option<String>,
}

impl<'a> Comparison<'a> {
    /// The TIF that errors move.
    pub fn moved_tif(&self, settings: &Settings) -> Result<Tif, Invalid> {
        match settings.tif_as_sampled {
            true => Ok(self.tif.clone()),
            false => smooth(self.tif, self.tif.width_mm()),
        }
    }

    /// before - after on the pixels that are valid in both.
    pub fn data(&self, unknowns: usize) -> Result<Data<'a>, Invalid> {
        let grid = self.before.grid();
        let mut data = match are_same(grid, self.after.grid()) {
            true => self.before.height_nm() - self.after.height_nm(),
            false => self.before.height_nm() - resampled(self.after, grid)?.height_nm(),
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

/// A tool and the runs with it.
#[derive(Clone, Copy)]
struct Tool<'a> {
    runs: &'a Runs<'a>,
    tif: &'a Tif,
}

/// The tool in the ways in which a fit may take it.
struct Tools<'a> {
    /// The tool without its noise, which errors move.
    smooth: Tool<'a>,
    /// The tool as it was sampled, for the removal itself.
    as_sampled: Option<&'a Runs<'a>>,
    /// The tool as it goes on beyond samples that end before it has ended: without its noise, and as it is.
    continued: Option<[Tool<'a>; 2]>,
}

/// A fit, and what it is of.
struct Found<'a> {
    fit: Fit,
    model: Model<'a>,
    /// The tool as it goes on beyond its samples, where that explains more of the data.
    continued: Option<&'a Tif>,
    /// Parameters that contradict what was known beforehand.
    released: Vec<Parameter>,
}

impl<'a> Tools<'a> {
    /// The fit of the tool that explains most of the data, with these scales of what is known beforehand.
    fn best_fit(
        &self,
        parameters: &[Parameter],
        (terms, data): (&[Term], &Data<'_>),
        scale: impl Fn(Parameter) -> f64 + Copy,
    ) -> Result<Found<'a>, Invalid> {
        let Tool { runs, tif } = self.smooth;
        let model = Model::new(runs, tif, parameters.to_vec(), scale);
        let start = Start::new(&model)?;
        let fit_of_plan = fit(&model, terms, data, &start)?;
        let mut found = Found { fit: fit_of_plan, model, continued: None, released: Vec::new() };
        // The TIF as it is sampled has no error of smoothing, but moves its noise: the data decide.
        let as_sampled = self.as_sampled.map(|removal| (self.smooth, removal, None));
        let continued = self.continued.map(|[smooth, own]| (smooth, own.runs, Some(own.tif)));
        for (Tool { runs, tif }, removal, continued) in as_sampled.into_iter().chain(continued) {
            let mut model = Model::new(runs, tif, parameters.to_vec(), scale);
            model.removal_from = Some(removal);
            let from = Start::at(&model, found.fit.values[..parameters.len()].to_vec())?;
            let again = fit(&model, terms, data, &from)?;
            if dot(&again.rest, &again.rest) < dot(&found.fit.rest, &found.fit.rest) {
                found = Found { fit: again, model, continued, ..found };
            }
        }
        Ok(found)
    }

    /// (1), by Gauss and Newton; again with the usual scale of what contradicts the data.
    fn fit(
        &self,
        parameters: &[Parameter],
        of: (&[Term], &Data<'_>),
        scale: impl Fn(Parameter) -> f64 + Copy,
        metrology_order: Option<[usize; 2]>,
    ) -> Result<Found<'a>, Invalid> {
        let mut released: Vec<Parameter> = Vec::new();
        loop {
            let known = |p| if released.contains(&p) { p.usual_scale() } else { scale(p) };
            let found = self.best_fit(parameters, of, known)?;
            match contradicted(&found.fit, of.1, metrology_order, known) {
                Some(parameter) => released.push(parameter),
                None => return Ok(Found { released, ..found }),
            }
        }
    }
}

/// Parameters that the data determine, and their corrections in the next plan.
struct Judged {
    /// Reason for which a parameter is not determined.
    refusals: Vec<Option<String>>,
    /// Reason for which a parameter is held at the plan.
    why_held: Vec<Option<String>>,
    /// Corrections of the next plan.
    corrections: Vec<f64>,
    /// Values and standard errors; those of held parameters are as they were found with all free.
    stated: Vec<[f64; 2]>,
    /// Estimates with all parameters free.
    with_all: Joint,
    /// Numbers on whether the map after is that of the run.
    evidence: Evidence,
    /// Sentence against the map after.
    nothing: Option<String>,
}

impl Found<'_> {
    /// Judges the fit; parameters that only inflate the errors of others are held, in `self.fit` too.
    fn judge(
        &mut self,
        comparison: &Comparison<'_>,
        settings: &Settings,
        (data, runs): (&Data<'_>, &Runs<'_>),
        scale: impl Fn(Parameter) -> f64,
    ) -> Result<Judged, Invalid> {
        let Self { fit: found, model, released, .. } = self;
        let count = found.parameters.len();
        let moved_by = all_moves(found, data, settings.metrology_order);
        let of = |i: usize| {
            let parameter = found.parameters[i];
            match released.contains(&parameter) {
                true => Some(Refusal::of_the_model(contradiction(found, i, scale(parameter)))),
                false => refusal(found, i, scale(parameter), &moved_by[i]),
            }
        };
        let judged: Vec<Option<Refusal>> = (0..count).map(of).collect();
        let part_of = |i: usize| judged[i].as_ref().map_or(Part::Corrected, |r| r.part);
        let reason = |r: &Option<Refusal>| r.as_ref().map(|r| r.reason.clone());
        let mut refusals: Vec<Option<String>> = judged.iter().map(reason).collect();
        let fitted = fitted(found, data, runs);
        let before = comparison.before.height_nm();
        let width_mm = comparison.tif.width_mm();
        let judgement = contradictory::judge(
            before,
            data,
            &runs.executed,
            found,
            &fitted,
            width_mm,
            settings.same_measurement,
        );
        let nothing = judgement.against;
        if nothing.is_some() {
            refusals.fill(Some("the maps do not show that they are of this run".into()));
        }
        let with_all = Joint::new(found);
        let mut uncertain = Joint::new(found);
        // What moves with the metrology is uncertain along the move of all parameters together.
        let mut moves: Vec<usize> = judged.iter().flatten().filter_map(|r| r.moved).collect();
        moves.sort_unstable();
        moves.dedup();
        for k in moves {
            let along: Vec<f64> = moved_by.iter().map(|m| m[k].0.by).collect();
            uncertain.widen(&along);
        }
        let determined: Vec<usize> =
            (0..count).filter(|i| part_of(*i) == Part::Corrected).collect();
        let spread = uncertain.spread(&determined, &model.scales);
        let may_be_held = |i: usize| {
            let p = found.parameters[i];
            let is_asked_for = settings.free.iter().any(|name| name == p.name());
            p != Parameter::RateScale && !is_asked_for && refusals[i].is_none()
        };
        let may: Vec<bool> = (0..count).map(may_be_held).collect();
        let spreads: Vec<f64> = model.scales.iter().map(|s| spread * s).collect();
        let (held, without) = hold(found, &may, &spreads);
        let why = |i: usize| held.iter().find(|h| h.index == i).map(|h| h.reason.clone());
        let why_held: Vec<Option<String>> = (0..count).map(why).collect();
        let part = |i: usize| if why_held[i].is_some() { Part::AtPlan } else { part_of(i) };
        let parts: Vec<Part> = (0..count).map(part).collect();
        let corrections = match nothing {
            Some(_) => vec![0.0; count],
            None => applied(uncertain, &parts, &model.scales),
        };
        if !held.is_empty() {
            let values = without.values.iter().copied().collect();
            found.take(model, data, values, without.covariance)?;
        }
        let state = |i: usize| match why_held[i] {
            Some(_) => [with_all.values[i], with_all.standard_error(i)],
            None => [found.values[i], found.standard_error(i)],
        };
        let stated = (0..count).map(state).collect();
        let evidence = judgement.evidence;
        Ok(Judged { refusals, why_held, corrections, stated, with_all, evidence, nothing })
    }
}

impl Judged {
    /// The estimates of all parameters, free or not.
    fn estimates(&self, found: &Fit, tif: &Tif, scale: impl Fn(Parameter) -> f64) -> Vec<Estimate> {
        let of = |p: Parameter| {
            let mut estimate = estimate(found, p, scale(p), &self.refusals);
            if !p.is_of(tif) {
                estimate.held_because = Some(format!("held at the plan: the tool {TURNS}"));
            }
            if let Some(i) = found.parameters.iter().position(|q| *q == p) {
                let factor = p.unit().1;
                // No plan corrects a drift.
                let is_corrected = p != Parameter::RateDrift;
                estimate.applied = if is_corrected { self.corrections[i] / factor } else { 0.0 };
                estimate.held_because = self.why_held[i].clone();
                if estimate.held_because.is_some() {
                    estimate.value = Some(self.stated[i][0] / factor);
                    estimate.standard_error = Some(self.stated[i][1] / factor);
                }
            }
            estimate
        };
        ALL.into_iter().map(of).collect()
    }
}

/// Removal of the run, measured and planned, and the rest of a fit.
fn fitted(found: &Fit, data: &Data<'_>, runs: &Runs<'_>) -> Fitted {
    let measured = &data.data - &found.metrology;
    Fitted {
        measured_removal_rms_nm: rms(&measured, &data.valid),
        measured_less_planned_rms_nm: rms(&(&measured - &runs.executed), &data.valid),
        rest_rms_nm: rms(&found.rest, &data.valid),
    }
}

/// Result of a reconciliation: the parameters and the corrections.
pub fn reconcile(comparison: &Comparison<'_>, settings: &Settings) -> Result<Reconciled, Invalid> {
    comparison.tif.same_in_all_directions("planish-reconcile")?;
    let (parameters, terms) = settings.chosen(|p| p.is_of(comparison.tif))?;
    let data = comparison.data(parameters.len() + terms.len())?;
    let moved = comparison.moved_tif(settings)?;
    let runs_of = |tif, moved| Runs::new(comparison.trajectory, tif, moved, data.grid);
    let runs = runs_of(comparison.tif, &moved)?;
    let (as_sampled, with_tail) = match settings.tif_as_sampled {
        true => (None, None),
        false => (Some(runs_of(comparison.tif, comparison.tif)?), tail::continued(comparison.tif)?),
    };
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
    let mut found = tools.fit(&parameters, (&terms, &data), scale, settings.metrology_order)?;
    let judged = found.judge(comparison, settings, (&data, &runs), scale)?;
    result(comparison, settings, (&data, &runs), (&found, &judged), scale)
}

/// Numbers, maps, and what the next plan has of a fit that was judged.
fn result(
    comparison: &Comparison<'_>,
    settings: &Settings,
    (data, runs): (&Data<'_>, &Runs<'_>),
    (fit_of_run, judged): (&Found<'_>, &Judged),
    scale: impl Fn(Parameter) -> f64 + Copy,
) -> Result<Reconciled, Invalid> {
    let Found { fit: found, model, continued, released, .. } = fit_of_run;
    let Judged { refusals, corrections, stated, with_all, evidence, nothing, .. } = judged;
    let tool = continued.unwrap_or(comparison.tif);
    let refused: Vec<bool> = refusals.iter().map(Option::is_some).collect();
    let measured = &data.data - &found.metrology;
    let maps = Maps { measured: &measured, planned: &runs.executed, predicted: &found.removal };
    let outcome = ReconciliationOutcome {
        parameters: judged.estimates(found, comparison.tif, scale),
        metrology: metrology_estimates(found, settings),
        ellipse: ellipse(found, refusals),
        correlation_of: found.names(),
        singular_values: found.singular_values.clone(),
        noise: found.noise.noise,
        fitted: fitted(found, data, runs),
        bands: bands(&maps, &data.valid, data.grid, comparison.tif.width_mm()),
        end: found.end.to_string(),
        points: found.points,
        tried_orders: wider_orders(settings.metrology_order),
        tif_is_as_sampled: settings.tif_as_sampled || model.removal_from.is_some(),
        tif_is_continued: continued.is_some(),
        resampled: (!are_same(data.grid, comparison.after.grid())).then(|| METHOD.into()),
        evidence: *evidence,
        explains_nothing: nothing.clone(),
    };
    let with_nan = |map: &Array2<f64>| {
        let mut map = map.clone();
        map.zip_mut_with(&data.valid, |v, valid| *v = if *valid == 0.0 { f64::NAN } else { *v });
        map
    };
    let n = found.values.len();
    let known: Vec<(Parameter, f64)> =
        found.parameters.iter().copied().zip(corrections.iter().copied()).collect();
    let transform = {
        let (before, covariance) = (comparison.transform, &with_all.covariance);
        place(before, found, covariance, corrections, &refused, scale, data.grid)?
    };
    Ok(Reconciled {
        drawback: nothing.clone().or_else(|| drawback(settings, found, refusals, released)),
        correlation: Array2::from_shape_fn((n, n), |(i, j)| found.correlation(i, j)),
        measured_nm: with_nan(&measured),
        planned_nm: runs.executed.clone(),
        predicted_nm: found.removal.clone(),
        metrology_nm: found.metrology.clone(),
        rest_nm: with_nan(&found.rest),
        tif: Model::corrected_tif(tool, &known)?,
        transform,
        error_budget: left(comparison.error_budget, found, stated, corrections, &refused, scale),
        outcome,
    })
}

/// RMS over the valid pixels, mean removed.
fn rms(map: &Array2<f64>, valid: &Array2<f64>) -> f64 {
    let count = valid.sum();
    let mean = (map * valid).sum() / count;
    let square = map.iter().zip(valid).map(|(v, w)| w * (v - mean).powi(2)).sum::<f64>();
    (square / count).sqrt()
}

fn estimate(fit: &Fit, parameter: Parameter, scale: f64, refusals: &[Option<String>]) -> Estimate {
    let (unit, factor) = parameter.unit();
    let at = fit.parameters.iter().position(|p| *p == parameter);
    let refused = at.and_then(|i| refusals[i].clone());
    let inflation = at.map(|i| fit.inflation[i]).filter(|v| v.is_finite());
    Estimate {
        name: parameter.name().into(),
        unit: unit.into(),
        value: at.filter(|_| refused.is_none()).map(|i| fit.values[i] / factor),
        standard_error: at.filter(|_| inflation.is_some()).map(|i| fit.standard_error(i) / factor),
        known_beforehand: Some(scale / factor),
        variance_inflation: inflation,
        refused,
        held: at.is_none(),
        held_because: None,
        applied: 0.0,
    }
}

fn metrology_estimates(fit: &Fit, settings: &Settings) -> Vec<Estimate> {
    let all = metrology::terms(settings.metrology_order);
    let one = |term: Term| {
        let at = fit.terms.iter().position(|t| *t == term).map(|k| fit.parameters.len() + k);
        let inflation = at.map(|i| fit.inflation[i]).filter(|v| v.is_finite());
        let refused = at.filter(|_| inflation.is_none());
        let refused = refused.map(|_| String::from("the data do not tell it from the others"));
        Estimate {
            name: term.name(),
            unit: "nm RMS".into(),
            value: at.filter(|_| inflation.is_some()).map(|i| fit.values[i]),
            standard_error: at.filter(|_| inflation.is_some()).map(|i| fit.standard_error(i)),
            known_beforehand: None,
            variance_inflation: inflation,
            refused,
            held: at.is_none(),
            held_because: None,
            applied: 0.0,
        }
    };
    all.into_iter().map(one).collect()
}

/// e = (E^2 + D^2)^1/2 along phi = atan2(D, E) / 2, and their standard errors to first order.
fn ellipse(fit: &Fit, refusals: &[Option<String>]) -> Option<Ellipse> {
    let at = |p: Parameter| {
        let i = fit.parameters.iter().position(|q| *q == p)?;
        refusals[i].is_none().then_some(i)
    };
    let i = at(Parameter::TifEllipticity)?;
    let j = at(Parameter::TifDiagonalEllipticity)?;
    let (e, d) = (fit.values[i], fit.values[j]);
    let size = e.hypot(d);
    if size == 0.0 {
        return None;
    }
    let c = &fit.covariance;
    let covariance = Matrix2::new(c[(i, i)], c[(i, j)], c[(i, j)], c[(j, j)]);
    let error = |along: [f64; 2]| {
        let v = nalgebra::Vector2::from(along);
        (v.transpose() * covariance * v)[0].max(0.0).sqrt()
    };
    let standard_error = error([e / size, d / size]);
    let has_direction = size > NO_DIRECTION * standard_error;
    Some(Ellipse {
        ellipticity_percent: 100.0 * size,
        standard_error_percent: 100.0 * standard_error,
        direction_deg: has_direction.then(|| (0.5 * d.atan2(e)).to_degrees()),
        direction_standard_error_deg: has_direction
            .then(|| (0.5 * error([-d / size, e / size]) / size).to_degrees()),
    })
}

/// Message on parameter `i`, whose scale contradicts the data.
fn contradiction(fit: &Fit, i: usize, scale: f64) -> String {
    let parameter = fit.parameters[i];
    format!(
        "the data contradict the {} that are known beforehand: without them they give {} +- {}; the other parameters are \
         estimated without them, too",
        shown(parameter, scale),
        shown(parameter, fit.values[i]),
        shown(parameter, fit.standard_error(i))
    )
}

fn drawback(
    settings: &Settings,
    fit: &Fit,
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
    let wanted = |p: &Parameter| settings.free.iter().any(|name| name == p.name());
    let refused: Vec<&str> = (0..refusals.len())
        .filter(|i| refusals[*i].is_some() && wanted(&fit.parameters[*i]))
        .map(|i| fit.parameters[i].name())
        .collect();
    if !refused.is_empty() {
        return Some(format!("the data do not determine {}", refused.join(", ")));
    }
    let all = !refusals.is_empty() && refusals.iter().all(Option::is_some);
    all.then(|| "the data determine none of the parameters".into())
}
