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
use planish_types::{Invalid, Surface, Tif, Trajectory, Transform};

use crate::{
    applied::{Joint, applied, hold},
    bands::{Maps, bands},
    contradictory::explains_nothing,
    determined::{Part, Refusal, all_moves, contradicted, refusal, shown, wider_orders},
    fit::{Data, Fit, Start, dot, fit},
    left::left,
    metrology,
    model::Model,
    parameter::{ALL, Parameter},
    place::place,
    report::{Ellipse, Estimate, Fitted, Outcome},
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
    pub outcome: Outcome,
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

/// Result of a reconciliation: the parameters and the corrections.
pub fn reconcile(comparison: &Comparison<'_>, settings: &Settings) -> Result<Reconciled, Invalid> {
    let (parameters, terms) = settings.chosen(|p| p.is_of(comparison.tif))?;
    let data = comparison.data(parameters.len() + terms.len())?;
    let moved = comparison.moved_tif(settings)?;
    let runs = Runs::new(comparison.trajectory, comparison.tif, &moved, data.grid)?;
    let as_sampled = match settings.tif_as_sampled {
        true => None,
        false => Some(Runs::new(comparison.trajectory, comparison.tif, comparison.tif, data.grid)?),
    };
    // The tool as it goes on beyond samples that end before it has ended.
    let with_tail = match settings.tif_as_sampled {
        true => None,
        false => tail::continued(comparison.tif)?,
    };
    let smooth_tail = with_tail.as_ref().map(|t| smooth(t, t.width_mm())).transpose()?;
    let tails = match (&with_tail, &smooth_tail) {
        (Some(t), Some(smooth)) => {
            let runs = |moved| Runs::new(comparison.trajectory, t, moved, data.grid);
            Some((runs(smooth)?, runs(t)?, smooth))
        }
        _ => None,
    };
    let scale =
        |p: Parameter| comparison.error_budget.map_or(p.usual_scale(), |file| p.scale_in(file));
    // (1), by Gauss and Newton; again with the usual scale of what contradicts the data
    let mut released: Vec<Parameter> = Vec::new();
    let (mut found, model, start, tool) = loop {
        let scale = |p| if released.contains(&p) { p.usual_scale() } else { scale(p) };
        let mut model = Model::new(&runs, &moved, parameters.clone(), scale);
        let start = Start::new(&model)?;
        let mut found = fit(&model, &terms, &data, &start)?;
        // The TIF as it is sampled has no error of smoothing, but moves its noise: the data decide.
        if let Some(as_sampled) = &as_sampled {
            let mut other = Model::new(&runs, &moved, parameters.clone(), scale);
            other.removal_from = Some(as_sampled);
            let from = Start::at(&other, found.values[..parameters.len()].to_vec())?;
            let again = fit(&other, &terms, &data, &from)?;
            if dot(&again.rest, &again.rest) < dot(&found.rest, &found.rest) {
                (found, model) = (again, other);
            }
        }
        let mut tool = comparison.tif;
        if let (Some((smooth, as_sampled, moved)), Some(with_tail)) = (&tails, &with_tail) {
            let mut other = Model::new(smooth, moved, parameters.clone(), scale);
            other.removal_from = Some(as_sampled);
            let from = Start::at(&other, found.values[..parameters.len()].to_vec())?;
            let again = fit(&other, &terms, &data, &from)?;
            if dot(&again.rest, &again.rest) < dot(&found.rest, &found.rest) {
                (found, model, tool) = (again, other, with_tail);
            }
        }
        match contradicted(&found, &data, settings.metrology_order, scale) {
            Some(parameter) => released.push(parameter),
            None => break (found, model, start, tool),
        }
    };

    // What of it the data determine
    let orders = wider_orders(settings.metrology_order);
    let moved_by = all_moves(&found, &data, settings.metrology_order);
    let judged: Vec<Option<Refusal>> = (0..found.parameters.len())
        .map(|i| {
            let parameter = found.parameters[i];
            match released.contains(&parameter) {
                true => Some(Refusal::of_the_model(contradiction(&found, i, scale(parameter)))),
                false => refusal(&found, i, scale(parameter), &moved_by[i]),
            }
        })
        .collect();
    let part_of = |i: usize| judged[i].as_ref().map_or(Part::Corrected, |r| r.part);
    let mut refusals: Vec<Option<String>> =
        judged.iter().map(|r| r.as_ref().map(|r| r.reason.clone())).collect();
    let fitted = |found: &Fit| {
        let measured = &data.data - &found.metrology;
        Fitted {
            measured_removal_rms_nm: rms(&measured, &data.valid),
            measured_less_planned_rms_nm: rms(&(&measured - &runs.executed), &data.valid),
            rest_rms_nm: rms(&found.rest, &data.valid),
        }
    };
    let before = comparison.before.height_nm();
    let nothing = explains_nothing(before, &data, &start, &terms, &found.rest, &fitted(&found));
    if nothing.is_some() {
        refusals.fill(Some("the fit explains nothing of this run".into()));
    }
    let count = found.parameters.len();
    let with_all = Joint::new(&found);
    let determined: Vec<usize> = (0..count).filter(|i| part_of(*i) == Part::Corrected).collect();
    let mut uncertain = Joint::new(&found);
    // What moves with the metrology is uncertain along the move of all parameters together.
    let mut moves: Vec<usize> = judged.iter().flatten().filter_map(|r| r.moved).collect();
    moves.sort_unstable();
    moves.dedup();
    for k in moves {
        let along: Vec<f64> = moved_by.iter().map(|m| m[k].0.by).collect();
        uncertain.widen(&along);
    }
    let spread = uncertain.spread(&determined, &model.scales);
    let may: Vec<bool> = (0..count)
        .map(|i| {
            let p = found.parameters[i];
            let is_asked_for = settings.free.iter().any(|name| name == p.name());
            p != Parameter::RateScale && !is_asked_for && refusals[i].is_none()
        })
        .collect();
    let spreads: Vec<f64> = model.scales.iter().map(|s| spread * s).collect();
    let (held, without) = hold(&found, &may, &spreads);
    let why_held: Vec<Option<String>> =
        (0..count).map(|i| held.iter().find(|h| h.index == i).map(|h| h.reason.clone())).collect();
    let parts: Vec<Part> =
        (0..count).map(|i| if why_held[i].is_some() { Part::AtPlan } else { part_of(i) }).collect();
    let corrections = match nothing {
        Some(_) => vec![0.0; count],
        None => applied(uncertain, &parts, &model.scales),
    };
    if !held.is_empty() {
        let values = without.values.iter().copied().collect();
        found.take(&model, &data, values, without.covariance)?;
    }
    // With the held ones as they were found with all free
    let stated: Vec<[f64; 2]> = (0..count)
        .map(|i| match why_held[i] {
            Some(_) => [with_all.values[i], with_all.standard_error(i)],
            None => [found.values[i], found.standard_error(i)],
        })
        .collect();
    let known: Vec<(Parameter, f64)> =
        found.parameters.iter().copied().zip(corrections.iter().copied()).collect();

    let refused: Vec<bool> = refusals.iter().map(Option::is_some).collect();
    let measured = &data.data - &found.metrology;
    let maps = Maps { measured: &measured, planned: &runs.executed, predicted: &found.removal };
    let n = found.values.len();
    let outcome = Outcome {
        parameters: ALL
            .into_iter()
            .map(|p| {
                let mut estimate = estimate(&found, p, scale(p), &refusals);
                if !p.is_of(comparison.tif) {
                    estimate.held_because = Some(format!("held at the plan: the tool {TURNS}"));
                }
                if let Some(i) = found.parameters.iter().position(|q| *q == p) {
                    let factor = p.unit().1;
                    // No plan corrects a drift.
                    let is_corrected = p != Parameter::RateDrift;
                    estimate.applied = if is_corrected { corrections[i] / factor } else { 0.0 };
                    estimate.held_because = why_held[i].clone();
                    if estimate.held_because.is_some() {
                        estimate.value = Some(stated[i][0] / factor);
                        estimate.standard_error = Some(stated[i][1] / factor);
                    }
                }
                estimate
            })
            .collect(),
        metrology: metrology_estimates(&found, settings),
        ellipse: ellipse(&found, &refusals),
        correlation_of: found.names(),
        singular_values: found.singular_values.clone(),
        noise: found.noise.noise,
        fitted: fitted(&found),
        bands: bands(&maps, &data.valid, data.grid, comparison.tif.width_mm()),
        end: found.end.to_string(),
        points: found.points,
        tried_orders: orders,
        tif_is_as_sampled: settings.tif_as_sampled || model.removal_from.is_some(),
        tif_is_continued: !std::ptr::eq(tool, comparison.tif),
        resampled: (!are_same(data.grid, comparison.after.grid())).then_some(METHOD),
        explains_nothing: nothing.clone(),
    };
    let with_nan = |map: &Array2<f64>| {
        let mut map = map.clone();
        map.zip_mut_with(&data.valid, |v, valid| {
            if *valid == 0.0 {
                *v = f64::NAN;
            }
        });
        map
    };
    Ok(Reconciled {
        drawback: nothing.or_else(|| drawback(settings, &found, &refusals, &released)),
        correlation: Array2::from_shape_fn((n, n), |(i, j)| found.correlation(i, j)),
        measured_nm: with_nan(&measured),
        planned_nm: runs.executed.clone(),
        predicted_nm: found.removal.clone(),
        metrology_nm: found.metrology.clone(),
        rest_nm: with_nan(&found.rest),
        tif: Model::corrected_tif(tool, &known)?,
        transform: place(
            comparison.transform,
            &found,
            &with_all.covariance,
            &corrections,
            &refused,
            scale,
            data.grid,
        )?,
        error_budget: left(comparison.error_budget, &found, &stated, &corrections, &refused, scale),
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
        unit,
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
    let one = |term: metrology::Term| {
        let at = fit.terms.iter().position(|t| *t == term).map(|k| fit.parameters.len() + k);
        let inflation = at.map(|i| fit.inflation[i]).filter(|v| v.is_finite());
        let refused = at.filter(|_| inflation.is_none());
        let refused = refused.map(|_| String::from("the data do not tell it from the others"));
        Estimate {
            name: term.name(),
            unit: "nm RMS",
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
