//! Residual against run time, estimated from dwell times without a motion.
//!
//! At every price lambda of a second, bounded least squares finds the dwell times t of the least
//!
//! ```text
//! M / 2 + lambda T,   M = mean square of the residual,   T = sum of t                                                 (1)
//! ```
//!
//! Along the solutions, dM/dT = -2 lambda. The plan of the time elasticity e is the one where one percent more time
//! lowers M by e percent. It has the least
//!
//! ```text
//! ln M + e ln T                                                                                                      (2)
//! ```
//!
//! The joint plan weighs the residual of its motion by the same rule. It differs from this estimate by what the limits
//! of the machine add. The dwell times of this estimate may differ much from one to the next, as no motion is made of
//! them.

use planish_types::{Invalid, PARTS_TOLERANCE, Surface, Tif, ToolPath, doubts};
use rayon::prelude::*;
use serde::Serialize;

use crate::{
    DwellError,
    bounded_least_squares::{Bound, BoundedSettings, Program, bounds, solve_columns},
    columns::ToolPlace,
};

/// Exponents of ten of the prices, relative to the mean square of the map over the time to remove its RMS. Chosen: the
/// plans of elasticity 0.2 to 2 of the fixtures lie between the first and the last.
const EXPONENTS: [f64; 6] = [-2.0, -2.8, -3.6, -4.4, -5.2, -6.0];
/// Exponent of ten of the relative price from which on the dwell times get smoother, in proportion to the price. Larger:
/// hundreds of steps of the solver where many dwell times are at their floor. Smaller: points above the front. Measured:
/// on coupon, at pitches from 0.7 to 1.5 mm, no price needs more than 60 steps.
const SMOOTHER_FROM: f64 = -5.2;
/// Tikhonov and slope weight of the dwell times at the lower prices. Larger: a residual that the joint plan does not have
/// (5e-9: 10 % more on the fixture coupon). Smaller: more steps of the solver.
const SMOOTHNESS: f64 = 1e-9;

/// Worth of time in the plan that is chosen.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Worth {
    /// Time elasticity, dimensionless; > 0.
    Elasticity(f64),
    /// Price of a second, nm^2/s; >= 0.
    Nm2PerS(f64),
}

/// Settings of a front.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct FrontSettings {
    /// Least dwell time of the segments.
    pub min_dwell: Bound,
    /// Worth of time of the chosen plan.
    pub worth: Worth,
}

/// A point of the front.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct FrontPoint {
    /// Price of a second, nm^2/s.
    pub price_nm2_per_s: f64,
    /// RMS of the residual, nm.
    pub rms_nm: f64,
    /// Sum of the dwell times, s.
    pub time_s: f64,
}

/// Residual against run time.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Front {
    /// Points, with rising time.
    pub points: Vec<FrontPoint>,
    /// The point of the wanted worth of time.
    pub chosen: FrontPoint,
    /// Probable mistakes in the inputs.
    pub doubts: Vec<String>,
}

/// Returns the residual against time along `path`, at prices that follow from the map and the tool, and at the wanted
/// worth of time.
///
/// # Errors
/// Refuses a worth out of its range, and what [`solve_columns`] refuses.
pub fn front(
    desired: &Surface,
    tif: &Tif,
    path: &ToolPath,
    settings: &FrontSettings,
) -> Result<Front, DwellError> {
    let (name, worth) = match settings.worth {
        Worth::Elasticity(x) => ("time_elasticity", x),
        Worth::Nm2PerS(price) => ("time_weight_nm2_per_s", price),
    };
    if !(worth.is_finite() && worth >= 0.0) {
        return Err(Invalid::whole(name, format!("is {worth}"), "give a finite number >= 0").into());
    }
    let mut said = Vec::new();
    if tif.variation().is_some_and(|v| v.time_factor().is_some()) {
        said.push("the rate of the tool depends on the time of the run, and the front takes it as at its start".into());
    }
    let tif = &*tif.without_time();
    let tif = &*tif.on_lattice_of(desired.grid(), PARTS_TOLERANCE)?.tif;
    let bounds = bounds(
        path,
        &BoundedSettings { min_dwell: settings.min_dwell, ..BoundedSettings::default() },
    )?;
    let places = BoundedSettings::default().columns.places(path, tif);
    let problem = Problem { desired, tif, path, places, bounds };
    let scale = problem.scale_nm2_per_s();
    let chains = EXPONENTS
        .par_chunks(EXPONENTS.len() / 2)
        .map(|exponents| problem.chain(exponents.iter().map(|e| scale * 10_f64.powf(*e))))
        .collect::<Result<Vec<_>, _>>()?;
    let mut points = chains.concat();
    let chosen = match settings.worth {
        Worth::Elasticity(x) => point_of_elasticity(&points, x),
        Worth::Nm2PerS(price) => problem.chain([price].into_iter())?[0],
    };
    if !points.contains(&chosen) {
        points.push(chosen);
    }
    points.sort_by(|a, b| a.time_s.total_cmp(&b.time_s));
    let floor_s = problem.bounds.0.iter().sum();
    said.extend(doubts::of_floor(desired, tif, floor_s));
    Ok(Front { points, chosen, doubts: said })
}

/// Inputs of (1), without the price.
struct Problem<'a> {
    desired: &'a Surface,
    tif: &'a Tif,
    path: &'a ToolPath,
    /// Places of the tool in each column of the removal matrix.
    places: Vec<Vec<ToolPlace>>,
    /// Lower and upper bounds of the dwell times, s.
    bounds: (Vec<f64>, Vec<f64>),
}

impl Problem<'_> {
    /// Solves (1) at falling prices, nm^2/s, each from the dwell times of the one before.
    fn chain(&self, prices: impl Iterator<Item = f64>) -> Result<Vec<FrontPoint>, DwellError> {
        let mut points = Vec::new();
        let mut guess = None;
        for price_nm2_per_s in prices {
            let (lo, hi) = self.bounds.clone();
            let program = Program { places: &self.places, lo, hi, guess, quadratic: None };
            let settings = self.bounded(price_nm2_per_s);
            let solution =
                solve_columns(self.desired, self.tif, self.path, None, &settings, &program)?;
            let report = &solution.report;
            points.push(FrontPoint {
                price_nm2_per_s,
                rms_nm: report.model_rms_nm,
                time_s: report.total_time_s,
            });
            guess = Some(solution.dwell.dwell_s().to_vec());
        }
        Ok(points)
    }

    fn bounded(&self, time_weight_nm2_per_s: f64) -> BoundedSettings {
        let smooth_price = self.scale_nm2_per_s() * 10_f64.powf(SMOOTHER_FROM);
        let smoothness = SMOOTHNESS * (time_weight_nm2_per_s / smooth_price).max(1.0);
        BoundedSettings {
            time_weight_nm2_per_s,
            tikhonov: smoothness,
            slope_weight: smoothness,
            ..BoundedSettings::default()
        }
    }

    /// Returns the mean square of the map over the time in which the tool removes its RMS everywhere, nm^2/s.
    fn scale_nm2_per_s(&self) -> f64 {
        let area_mm2 =
            self.desired.statistics().valid_count as f64 * self.desired.grid().pixel_mm2();
        let rms_nm = self.desired.statistics().rms;
        // rms^2 / (rms area / VRR)
        rms_nm * self.tif.vrr_nm_mm2_per_s() / area_mm2
    }
}

/// Returns the point at the least value of (2), from points at prices that fall by one factor. Over the logarithm of the
/// price, the logarithms of M and T are parabolas through the least of these points and its neighbours, and so is (2). Its
/// vertex is the point. If the least one is the first or the last, it is the point.
fn point_of_elasticity(points: &[FrontPoint], elasticity: f64) -> FrontPoint {
    let values: Vec<f64> =
        points.iter().map(|p| 2.0 * p.rms_nm.ln() + elasticity * p.time_s.ln()).collect();
    let least = (0..values.len()).min_by(|a, b| values[*a].total_cmp(&values[*b])).unwrap_or(0);
    if least == 0 || least + 1 == points.len() {
        return points[least];
    }
    let bend = values[least - 1] - 2.0 * values[least] + values[least + 1];
    let fall = 0.5 * (values[least - 1] - values[least + 1]);
    // One step is the factor between two prices.
    let steps = if bend > 0.0 { fall / bend } else { 0.0 };
    let at = |number: fn(&FrontPoint) -> f64| {
        let [before, at, after] =
            [-1, 0, 1].map(|offset| number(&points[least.saturating_add_signed(offset)]).ln());
        let slope = 0.5 * (after - before);
        (at + slope * steps + 0.5 * (before - 2.0 * at + after) * steps * steps).exp()
    };
    FrontPoint {
        price_nm2_per_s: at(|p| p.price_nm2_per_s),
        rms_nm: at(|p| p.rms_nm),
        time_s: at(|p| p.time_s),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Points of M = T^(-4) at times that rise by a factor, as a smooth front has, beside a floor of M.
    fn points(floor_nm2: f64) -> Vec<FrontPoint> {
        let step = 10_f64.powf(0.8);
        (0..8)
            .map(|k| {
                // dM/dT = -2 price, with M = T^(-4) + floor
                let price_nm2_per_s = 2.0 / step.powi(k);
                let time_s = (2.0 / price_nm2_per_s).powf(0.2);
                FrontPoint { price_nm2_per_s, time_s, rms_nm: (time_s.powi(-4) + floor_nm2).sqrt() }
            })
            .collect()
    }

    #[test]
    fn the_point_of_an_elasticity_is_where_a_percent_of_time_is_worth_it() {
        let floor = 1e-2;
        let points = points(floor);
        for elasticity in [0.5, 1.0, 2.0] {
            let chosen = point_of_elasticity(&points, elasticity);
            // Elasticity 4 T^(-4) / (T^(-4) + floor) = e gives T^(-4) = e floor / (4 - e).
            let time = (elasticity * floor / (4.0 - elasticity)).powf(-0.25);
            let exact = 2.0 * time.powi(-5);
            // The parabola spans a factor of 40 of the price.
            let ratio = chosen.price_nm2_per_s / exact;
            assert!(ratio.ln().abs() < 0.5, "{elasticity}: {chosen:?} {exact}");
            // The times of two points differ by a factor of 1.4, and the parabola follows ln M to 2 %.
            let mean_square = chosen.time_s.powi(-4) + floor;
            assert!((chosen.rms_nm.powi(2) / mean_square).ln().abs() < 0.05, "{chosen:?}");
        }
    }
}
