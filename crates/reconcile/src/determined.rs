//! Checks that the data determine a parameter, so that its estimate is stated.
//!
//! Before any of it, what is known beforehand must not contradict the data ([`contradicted`]): such a parameter is
//! refused, and the others are estimated with its usual scale.
//!
//! A number is given where all of this holds, and otherwise the parameter is refused with the first that does not:
//!
//! 1. **It has a signal of its own**: less than `LARGEST_INFLATION` of variance inflation, 1 / (1 - R^2) of its column
//!    on all others, the mean of each removed. At 100 the others explain 99 % of what it does. The models of the tool, of the motion and of the
//!    metrology are not better than a percent, so what is left of it would be decided by what they have wrong.
//!    A standard error below `CLEAR` of its scale lifts this limit to `LARGEST_CLEAR_INFLATION`: the estimate still
//!    beats the prior knowledge if the model errors make its error ten times larger.
//! 2. **It can be told from every single other one**: a correlation below `LARGEST_CORRELATION` of the estimates
//!    (the piston apart, which every removal has a part of).
//! 3. **The data say more than was known beforehand**: a standard error by the data alone below its scale, that of the
//!    process where one is given ([`crate::parameter`]).
//! 4. The fit ended at a minimum, or its last step moved the parameter by less than `UNFINISHED` standard errors or a
//!    hundredth of its scale. The standard error then contains that step.
//! 5. **It is believable**: within `BELIEVABLE` scales of the plan.
//! 6. **It does not depend on what was taken as known**: with Legendre terms up to 4 x 3 (further than the fit's own), or
//!    where the fit has more terms with piston, tilt and power alone, free in the metrology, it moves by less than `SIGNIFICANT` standard errors of that move, or by less than its own
//!    standard error or a hundredth of its scale. The move is a linear function of the data, the difference of the influence fields of both fits,
//!    so its standard error takes the correlation of the noise into account as all others do (Hausman's test with the
//!    sandwich covariance). Where the noise is correlated further than the map can tell, standard errors are lower
//!    bounds, and a move beyond that of the parameter is enough.

use nalgebra::{DMatrix, DVector};
use ndarray::Array2;
use planish_types::{End, text::significant};

use crate::{
    fit::{Data, LeastSquaresFit, Normal, dot},
    metrology::terms,
    parameter::Parameter,
};

/// Largest variance inflation, dimensionless. Larger: numbers that the errors of the models decide. Smaller:
/// parameters are refused that the data determine. Chosen: at this value the other unknowns explain 99 % of the
/// signal of the parameter, and the models are not better than a percent.
const LARGEST_INFLATION: f64 = 100.0;

/// Ratio of the standard error of a parameter to its scale (known beforehand) below which a larger variance inflation
/// is allowed. Larger: numbers that the errors of the models decide. Smaller: more refusals.
const CLEAR: f64 = 0.1;

/// Largest variance inflation of a parameter whose standard error is below [`CLEAR`] of its scale. Its own signal is
/// then 1 % of its column, beside errors of the derivatives of 3e-4.
const LARGEST_CLEAR_INFLATION: f64 = 1e4;

/// Largest last step of a fit that did not converge, in standard errors of the parameter, with which its estimate is
/// stated.
const UNFINISHED: f64 = 1.0;

/// Largest correlation of two estimates with which both are stated.
const LARGEST_CORRELATION: f64 = 0.99;

/// Largest magnitude of an estimate, in units of its scale. Larger: numbers are given that take up what the model
/// leaves out. Smaller: large but true errors are refused. Chosen.
const BELIEVABLE: f64 = 3.0;

/// Smallest move of an estimate with other terms of the metrology, in standard errors of the move, that is not taken
/// for chance. Larger: parameters that depend on the metrology are given. Smaller: parameters are refused by chance.
/// Chosen.
const SIGNIFICANT: f64 = 3.0;

/// Largest move of an estimate, in units of its scale, that does not matter, however small the noise is. Larger: moves
/// that matter are accepted. Smaller: parameters of low noise are refused for moves that change no plan. Chosen.
const NEGLIGIBLE: f64 = 0.01;

/// Smallest orders of the Legendre terms of the wider metrology along x and y, and their smallest excess over the
/// orders of the fit. Larger: the wider fit determines less. Smaller: a dependence on the metrology is missed. Chosen.
const WIDER: [usize; 2] = [4, 3];
const FURTHER: usize = 1;

/// Change of an estimate when other terms of the metrology are free.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Move {
    /// Change of the estimate, in the unit of the parameter.
    pub by: f64,
    /// Standard error of the change.
    pub standard_error: f64,
}

/// Returns, for every parameter, the moves of its estimate with other terms of the metrology, each with the orders of
/// these terms. One move is to a wider metrology. If the fit has the orders `own`, another is back to piston, tilt and
/// power (stated as the orders 1 x 1).
pub fn all_moves(
    fit: &LeastSquaresFit,
    data: &Data<'_>,
    own: Option<[usize; 2]>,
) -> Vec<Vec<(Move, [usize; 2])>> {
    let orders = wider_orders(own);
    let mut all: Vec<_> =
        moves(fit, data, Some(orders)).into_iter().map(|m| vec![(m, orders)]).collect();
    if own.is_some() {
        for (each, back) in all.iter_mut().zip(moves(fit, data, None)) {
            each.push((back, [1, 1]));
        }
    }
    all
}

/// Returns the orders along x and y of the wider metrology, for a fit with the orders `own` (`None`: piston, tilt and
/// power).
pub fn wider_orders(own: Option<[usize; 2]>) -> [usize; 2] {
    let own = own.unwrap_or([0, 0]);
    [0, 1].map(|axis| WIDER[axis].max(own[axis] + FURTHER))
}

/// A fit with other terms of the metrology, or other prior scales, to first order at the minimum of the given fit.
struct Another {
    normal: Normal,
    inverse: DMatrix<f64>,
    /// Changes of the parameters against the given fit, then the coefficients of the terms, which are found anew.
    step: DVector<f64>,
}

impl Another {
    fn new(
        fit: &LeastSquaresFit,
        data: &Data<'_>,
        orders: Option<[usize; 2]>,
        known: Vec<f64>,
    ) -> Self {
        let maps: Vec<Array2<f64>> = terms(orders).into_iter().map(|t| t.map(data.grid)).collect();
        let parameters = &fit.columns[..fit.parameters.len()];
        let normal = Normal::new(parameters, &maps, &data.valid, known);
        let inverse = normal.inverse();
        // Its terms are found anew, so those of the fit are data again.
        let data = &fit.rest + &(&fit.metrology * &data.valid);
        let step = normal.step(&data, &fit.values, &inverse, 0.0);
        Self { normal, inverse, step }
    }

    fn influence(&self, i: usize) -> Array2<f64> {
        self.normal.influence(&self.inverse, i)
    }
}

/// Returns the standard error of the sum over the map of the data times `field`, with the noise of `fit`.
fn standard_error(fit: &LeastSquaresFit, field: &Array2<f64>) -> f64 {
    dot(field, &fit.noise.apply(field)).max(0.0).sqrt()
}

/// Returns the moves of the parameters, to first order at the minimum, if Legendre terms of these `orders` replace
/// those of the fit. `None` stands for piston, tilt and power.
pub fn moves(fit: &LeastSquaresFit, data: &Data<'_>, orders: Option<[usize; 2]>) -> Vec<Move> {
    let wider = Another::new(fit, data, orders, fit.known.clone());
    let mut moves = Vec::with_capacity(fit.parameters.len());
    for i in 0..fit.parameters.len() {
        let field = wider.influence(i) - fit.influence(i);
        moves.push(Move { by: wider.step[i], standard_error: standard_error(fit, &field) });
    }
    moves
}

/// Returns the estimate of parameter `i` from the data alone, without its prior scale, and its standard error, to first
/// order at the minimum. `own` are the orders of the fit.
fn alone(fit: &LeastSquaresFit, data: &Data<'_>, own: Option<[usize; 2]>, i: usize) -> [f64; 2] {
    let mut known = fit.known.clone();
    known[i] = 0.0;
    let freed = Another::new(fit, data, own, known);
    [fit.values[i] + freed.step[i], standard_error(fit, &freed.influence(i))]
}

/// Returns the parameter whose prior scale contradicts the data most; `None` if none does. Without the scale the data
/// put it beyond `BELIEVABLE` scales and `SIGNIFICANT` standard errors from the plan. Scales that are not narrower than
/// the usual ones are not checked.
pub fn contradicted(
    fit: &LeastSquaresFit,
    data: &Data<'_>,
    own: Option<[usize; 2]>,
    scale: impl Fn(Parameter) -> f64,
) -> Option<Parameter> {
    let mut all: Vec<(Parameter, f64)> = Vec::new();
    for (i, parameter) in fit.parameters.iter().enumerate() {
        // A scale as wide as the usual one is no knowledge of this run.
        if scale(*parameter) >= parameter.usual_scale() {
            continue;
        }
        let [value, standard_error] = alone(fit, data, own, i);
        let beyond = value.abs() / (BELIEVABLE * scale(*parameter));
        if beyond > 1.0 && value.abs() > SIGNIFICANT * standard_error {
            all.push((*parameter, beyond));
        }
    }
    all.into_iter().max_by(|a, b| a.1.total_cmp(&b.1)).map(|(parameter, _)| parameter)
}

/// Treatment of a parameter in the corrections of the next plan.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Part {
    /// The parameter is corrected as far as the data support it.
    Corrected,
    /// The parameter stays at the plan, and the others are those of a fit in which it is at the plan.
    AtPlan,
    /// The parameter stays at the plan, and the others do not change for that.
    Left,
}

/// Reason why the estimate of a parameter is not stated, and its treatment.
#[derive(Clone, Debug, PartialEq)]
pub struct Refusal {
    /// The reason, as a sentence for the user.
    pub reason: String,
    /// Treatment of the parameter in the corrections of the next plan.
    pub part: Part,
    /// Index, in the moves of the parameter, of the fit with other terms of the metrology that decided it; `None` if
    /// none did.
    pub moved: Option<usize>,
}

impl Refusal {
    /// Creates the refusal of a parameter that the data cannot distinguish from others. If the metrology has its usual
    /// terms only (`is_usual`), it is corrected together with the others.
    fn weak(reason: String, is_usual: bool) -> Self {
        let part = if is_usual { Part::Corrected } else { Part::AtPlan };
        Self { reason, part, moved: None }
    }

    /// Creates the refusal of a parameter whose estimate would take up errors of the model.
    pub(crate) fn of_the_model(reason: String) -> Self {
        Self { reason, part: Part::Left, moved: None }
    }
}

/// Returns the reason why the data do not determine parameter `i` of a fit; `None` if they do. `scale` is its standard
/// deviation as known beforehand, `moved` its moves with other terms of the metrology.
pub fn refusal(
    fit: &LeastSquaresFit,
    i: usize,
    scale: f64,
    moved: &[(Move, [usize; 2])],
) -> Option<Refusal> {
    let parameter = fit.parameters[i];
    let error = fit.standard_error(i);
    let names = fit.names();
    // More terms of the metrology than the usual four take up errors of the model, and the rest says less of them.
    let is_usual = fit.terms.len() <= crate::metrology::NAMES.len();
    let is_clear = error < CLEAR * scale && is_usual;
    let largest = if is_clear { LARGEST_CLEAR_INFLATION } else { LARGEST_INFLATION };
    if fit.inflation[i] > largest {
        let is_finite = fit.inflation[i].is_finite();
        let inflation =
            if is_finite { significant(fit.inflation[i], 3) } else { "infinite".into() };
        let is_corrected = is_usual && fit.inflation[i] <= LARGEST_CLEAR_INFLATION;
        let reason = format!(
            "the data do not tell it from {}: variance inflation {inflation} (at most {largest}), smallest \
             singular value {}",
            confounded(fit, i, &names),
            significant(fit.singular_values.last().copied().unwrap_or(0.0), 2)
        );
        return Some(Refusal::weak(reason, is_corrected));
    }
    let twin = (0..names.len())
        .filter(|j| !is_clear && *j != i && names[*j] != "piston")
        .find(|j| fit.correlation(i, *j).abs() > LARGEST_CORRELATION);
    if let Some(j) = twin {
        let reason = format!(
            "its estimate correlates by {} with that of {}",
            significant(fit.correlation(i, j), 4),
            names[j]
        );
        return Some(Refusal::weak(reason, is_usual));
    }
    // 1 / error^2 = 1 / scale^2 + 1 / (that of the data)^2
    if error > scale * std::f64::consts::FRAC_1_SQRT_2 {
        let of_the_data = (error.powi(-2) - scale.powi(-2)).max(0.0).sqrt().recip();
        let is_finite = of_the_data.is_finite();
        let size = if is_finite { shown(parameter, of_the_data) } else { "nothing".into() };
        let reason = format!(
            "the data alone give it to {size}, beyond the {} that are known beforehand",
            shown(parameter, scale)
        );
        return Some(Refusal::weak(reason, is_usual));
    }
    let last = fit.unfinished[i];
    if fit.end != End::Converged && last > UNFINISHED && last * error > NEGLIGIBLE * scale {
        let reason = format!(
            "the fit did not end at a minimum: its last step moves the parameter by {} standard errors",
            significant(last, 2)
        );
        return Some(Refusal::weak(reason, is_usual));
    }
    if fit.values[i].abs() > BELIEVABLE * scale {
        return Some(Refusal::of_the_model(format!(
            "its estimate is beyond {BELIEVABLE} times {}, which is known beforehand: the model leaves something out \
             that it takes up",
            shown(parameter, scale)
        )));
    }
    let cut = fit.noise.noise.window_is_cut;
    for (k, (moved, orders)) in moved.iter().enumerate() {
        let is_no_chance = cut || moved.by.abs() > SIGNIFICANT * moved.standard_error;
        if is_no_chance && moved.by.abs() > error.max(NEGLIGIBLE * scale) {
            let reason = format!(
                "it depends on the metrology: with Legendre terms up to {} x {} free it moves by {} ({} standard errors \
                 of the move)",
                orders[0],
                orders[1],
                shown(parameter, moved.by),
                significant(moved.by.abs() / moved.standard_error, 2)
            );
            return Some(Refusal { moved: Some(k), ..Refusal::weak(reason, is_usual) });
        }
    }
    None
}

/// Returns the value of a parameter as a text with its unit, for the user.
pub fn shown(parameter: Parameter, value: f64) -> String {
    let (unit, factor) = parameter.unit();
    format!("{} {unit}", significant(value / factor, 3))
}

/// Returns the names of up to three other unknowns that together have nearly the effect of unknown `i`, the largest
/// contributions first, joined by "and".
fn confounded(fit: &LeastSquaresFit, i: usize, names: &[String]) -> String {
    // The regression of a scaled column on the others has the coefficients -inverse_ij / inverse_ii; where it is
    // dependent the null vectors say the same, which the cosines show.
    // Of every column the part that is no piston: the inflation is without it, too.
    let piston = names.iter().position(|n| n == "piston");
    let mut others: Vec<(&str, f64)> = Vec::new();
    for (j, name) in names.iter().enumerate().filter(|(j, _)| *j != i) {
        let without_piston =
            piston.map_or(1.0, |k| (1.0 - fit.cosines[(j, k)].powi(2)).max(0.0)).sqrt();
        let part = if fit.inflation[i].is_finite() {
            fit.inverse[(i, j)] / fit.inverse[(i, i)]
        } else {
            fit.cosines[(i, j)]
        };
        others.push((name, part.abs() * without_piston));
    }
    others.sort_by(|a, b| b.1.total_cmp(&a.1));
    let largest = others.first().map_or(0.0, |(_, part)| *part);
    let main = others.iter().take(3).filter(|(_, part)| *part > 0.2 * largest);
    main.map(|(name, _)| *name).collect::<Vec<_>>().join(" and ")
}
