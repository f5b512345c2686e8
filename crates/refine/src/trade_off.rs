//! Residual against total time: plans at rising prices of a second, and their picture. Each price has a plan of the
//! closed loop and a joint plan of motion and times ([`planish_joint`]). Both methods minimise half the mean square
//! of the residual plus the price times the total time.
//!
//! No plan takes less time than the volume to be removed over the volumetric removal rate (VRR) of the tool,
//!
//! ```text
//! T >= sum_i (z_i - z_min) dA / VRR                                                      (1)
//! ```
//!
//! if the tool never goes beyond the edge. z_min is the height below which the fraction [`IGNORED`] of the
//! pixels lies: a pit of a few pixels would demand a layer of its depth over the whole mirror.

use planish_draw::{Frame, Scale, Svg, frame::range};
use planish_joint::{JointError, Price, plan};
use planish_types::{
    DwellTime, End, Invalid, Limits, Surface, Tif, ToolPath, plausible::Rms, progress, text::fixed,
};
use serde::Serialize;

use crate::{Iterate, RefineError, RefineSettings, refine};

/// Fraction of the valid pixels that are below the height z_min of the module, dimensionless. Larger: a lower bound (1)
/// that leaves out deeper parts of the map. Smaller: a pit of a few pixels decides the bound.
pub const IGNORED: f64 = 1e-3;

/// Largest number of prices. Larger: the curve looks the same, and takes days. Smaller: fewer points can be
/// requested.
const MOST_PRICES: usize = 1000;

/// Method that made a plan.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum PlanMethod {
    /// Correction of the dwell times against their motion, round by round.
    ClosedLoop,
    /// Joint plan: motion and times as one problem.
    Joint,
}

impl PlanMethod {
    /// Returns the name of the method in tables and pictures.
    pub fn name(self) -> &'static str {
        match self {
            Self::ClosedLoop => "closed loop",
            Self::Joint => "joint",
        }
    }
}

/// A plan at one price of a second, made by one method.
#[derive(Clone, Debug, PartialEq)]
pub struct Point {
    /// Method that made the plan.
    pub method: PlanMethod,
    /// Price of a second in the objective, nm^2/s.
    pub time_weight_nm2_per_s: f64,
    /// Results of the plan; for the closed loop those of its best round.
    pub best: Iterate,
    /// Reason why the method ended.
    pub end: End,
}

/// Returns the reason for a negative verdict on a trade-off: a plan exceeds the limits of the machine. Returns `None`
/// if all keep them.
pub fn negative(points: &[Point]) -> Option<String> {
    if points.iter().all(|p| p.best.limits_respected) {
        return None;
    }
    Some("some plan exceeds the limits of the machine".to_string())
}

/// Returns the lower bound (1) of the module on the total time of any plan, s.
pub fn least_time_s(desired: &Surface, tif: &Tif) -> f64 {
    let mut z: Vec<f64> = desired.height_nm().iter().copied().filter(|z| !z.is_nan()).collect();
    z.sort_by(f64::total_cmp);
    let low = z[((z.len() - 1) as f64 * IGNORED).round() as usize];
    let volume: f64 =
        z.iter().map(|z| (z - low).max(0.0)).sum::<f64>() * desired.grid().pixel_mm2();
    volume / tif.vrr_nm_mm2_per_s()
}

/// Returns prices of a second, nm^2/s: zero, and `count` prices of equal ratio over three and a half decades. The
/// largest is 3 % of half the mean square of the map per second of the time bound (1); a single price is the smallest.
///
/// # Errors
///
/// Refuses more than 1000 prices.
pub fn prices(desired: &Surface, tif: &Tif, count: usize) -> Result<Vec<f64>, Invalid> {
    if count > MOST_PRICES {
        let remedy = format!("give at most {MOST_PRICES}: every price is a refinement");
        return Err(Invalid::whole("prices", format!("is {count}"), remedy));
    }
    let rms = desired.statistics().rms;
    let whole = 0.5 * rms * rms / least_time_s(desired, tif).max(f64::MIN_POSITIVE);
    let priced = (0..count).map(|k| {
        let exponent = -5.0 + 3.5 * k as f64 / (count.max(2) - 1) as f64;
        whole * 10_f64.powf(exponent)
    });
    Ok(std::iter::once(0.0).chain(priced).collect())
}

/// Largest number of passes over the prices in which a refinement starts again from the plan of a neighbouring price. A
/// pass that finds no better plan is the last one. Larger: more computing time. Smaller: a better plan reaches fewer
/// neighbours.
const MAX_PASSES: usize = 4;

/// Relative difference of the objective by which the plan of a neighbouring price must be better for a refinement to
/// start again from it. Larger: prices keep worse plans. Smaller: more refinements for small gains.
const CLEARLY_BETTER: f64 = 1e-3;

/// Returns the rank of a plan by its objective, half the mean square plus price times time, nm^2. A plan that exceeds
/// the limits ranks after all others.
fn rank(plan: &Iterate, price_nm2_per_s: f64) -> (bool, f64) {
    let objective = 0.5 * plan.rms_nm.powi(2) + price_nm2_per_s * plan.total_time_s;
    (!plan.limits_respected, objective)
}

/// Replaces the plan at every price by the best of all `plans` at that price.
///
/// The best plans of a common set are monotone in the price. Let e be the RMS, and plans 1 and 2 the best ones at
/// the prices p < q. Then `e1^2 / 2 + p T1 <= e2^2 / 2 + p T2` and `e2^2 / 2 + q T2 <= e1^2 / 2 + q T1` add up to
/// `T2 <= T1`, and with that the first inequality gives `e1 <= e2`.
fn give_the_best(points: &mut [Point], plans: &[(Iterate, End)]) {
    for point in points {
        let price = point.time_weight_nm2_per_s;
        for (plan, end) in plans {
            if rank(plan, price) < rank(&point.best, price) {
                point.best = plan.clone();
                point.end = *end;
                point.best.merit_nm = (2.0 * rank(plan, price).1).sqrt();
            }
        }
    }
}

/// Refines once per price, from the dwell times of the price before, then again from those of a neighbouring price
/// whose plan is better at this price. Every price gets the best of all rounds of all prices. So a plan at a higher
/// price never takes longer, and a plan at a lower price never leaves a larger residual.
///
/// # Errors
///
/// Fails as [`refine`] does.
pub fn trade_off(
    desired: &Surface,
    tif: &Tif,
    path: &ToolPath,
    limits: &Limits,
    prices: &[f64],
    settings: &RefineSettings,
) -> Result<Vec<Point>, RefineError> {
    let mut points: Vec<Point> = Vec::new();
    let mut plans: Vec<(Iterate, End)> = Vec::new();
    let refined = |price: f64, first: Option<DwellTime>, max_rounds: usize| {
        let mut settings = RefineSettings { max_rounds, ..*settings };
        settings.dwell.time_weight_nm2_per_s = price;
        refine(desired, tif, path, limits, first, &settings)
    };
    let mut first = None;
    for (k, &price) in prices.iter().enumerate() {
        let max_rounds = match first {
            // The other prices begin with its result.
            None => settings.max_rounds.max(RefineSettings::default().max_rounds),
            Some(_) => settings.max_rounds,
        };
        let refined = progress::part(k, prices.len(), || refined(price, first.take(), max_rounds))?;
        first = Some(refined.dwell);
        let best = refined.iterates[refined.best].clone();
        let end = refined.end;
        plans.extend(refined.iterates.into_iter().map(|plan| (plan, end)));
        let method = PlanMethod::ClosedLoop;
        points.push(Point { method, time_weight_nm2_per_s: price, best, end });
    }
    for pass in 0..MAX_PASSES {
        let mut is_better = false;
        let order: Vec<usize> = match pass % 2 {
            0 => (0..points.len()).rev().collect(),
            _ => (0..points.len()).collect(),
        };
        for k in order {
            let price = prices[k];
            let own = rank(&points[k].best, price);
            let neighbours = [k.checked_sub(1), Some(k + 1).filter(|k| *k < points.len())];
            let ranked =
                neighbours.into_iter().flatten().map(|n| (rank(&points[n].best, price), n));
            let best = ranked.min_by(|a, b| a.0.0.cmp(&b.0.0).then(a.0.1.total_cmp(&b.0.1)));
            let Some((of_neighbour, neighbour)) = best else { continue };
            if of_neighbour >= (own.0, (1.0 - CLEARLY_BETTER) * own.1) {
                continue;
            }
            is_better = true;
            let first = DwellTime::new(points[neighbour].best.dwell_s.clone())?;
            let again = refined(price, Some(first), settings.max_rounds)?;
            points[k].best = again.iterates[again.best].clone();
            points[k].end = again.end;
            plans.extend(again.iterates.into_iter().map(|plan| (plan, again.end)));
        }
        if !is_better {
            break;
        }
    }
    give_the_best(&mut points, &plans);
    Ok(points)
}

/// Makes a joint plan of motion and times per price; every price gets the best of all of them.
///
/// # Errors
///
/// Fails as [`plan`] does.
pub fn feed_trade_off(
    desired: &Surface,
    tif: &Tif,
    path: &ToolPath,
    limits: &Limits,
    prices: &[f64],
    min_dwell_s_per_mm: f64,
) -> Result<Vec<Point>, JointError> {
    let mut points = Vec::new();
    for (k, price) in prices.iter().enumerate() {
        let price = Price::Nm2PerS(*price);
        let settings =
            planish_joint::JointSettings { min_dwell_s_per_mm, price, ..Default::default() };
        let plan = progress::part(k, prices.len(), || plan(desired, tif, path, limits, &settings))?;
        let rms = Rms::of_surface(plan.removal.residual());
        let best = Iterate {
            dwell_s: plan.dwell.dwell_s().to_vec(),
            rms_nm: rms.rms_nm,
            detilted_nm: rms.detilted_nm,
            merit_nm: (rms.rms_nm.powi(2)
                + 2.0 * plan.report.price_nm2_per_s * plan.trajectory.total_time_s())
            .sqrt(),
            expected_rms_nm: None,
            total_time_s: plan.trajectory.total_time_s(),
            stretched: 0,
            limits_respected: plan.refused.is_none(),
        };
        let time_weight_nm2_per_s = plan.report.price_nm2_per_s;
        let method = PlanMethod::Joint;
        points.push(Point { method, time_weight_nm2_per_s, best, end: plan.report.end });
    }
    let plans: Vec<_> = points.iter().map(|p| (p.best.clone(), p.end)).collect();
    give_the_best(&mut points, &plans);
    Ok(points)
}

/// Height of the text in the picture, px. Larger: easier to read, but the captions need more room.
const FONT_PX: f64 = 14.0;

/// Width and height of the frame, px.
const SIZE_PX: [f64; 2] = [610.0, 340.0];

/// Margins to the left of the frame, above, to the right and below it, px: room for numbers and titles.
const MARGIN_PX: [f64; 4] = [80.0, 40.0, 30.0, 60.0];

/// Width for the name of a method above the frame, px. Smaller: the names overlap.
const NAME_WIDTH_PX: f64 = 110.0;

/// Smallest residual in the picture, nm; a smaller one is drawn at this value, because a logarithm needs a positive
/// number. Larger: small residuals are drawn too high. Smaller: a residual of zero stretches the axis.
const LEAST_RMS_NM: f64 = 1e-12;

/// Caption of the time axis; it explains the dashed line "volume / VRR".
const TIME_AXIS: &str =
    "total time (s), at least volume to be removed / volumetric removal rate (dashed)";

/// Methods in the order of their names from the right, and the colours of their curves.
const METHODS: [(PlanMethod, &str); 2] =
    [(PlanMethod::ClosedLoop, "#365c8d"), (PlanMethod::Joint, "#b5367a")];
/// SVG attributes of the line of the time bound (1).
const BOUND: &str = "stroke=\"#d8a010\" stroke-width=\"2\" stroke-dasharray=\"6 4\"";

/// Draws the picture as SVG text. It has one curve per method, the total time to the right and the residual upwards
/// (logarithmic), and the time bound as a dashed line.
pub fn svg(points: &[Point], least_time_s: f64) -> String {
    let place = |p: &Point| [p.best.total_time_s, p.best.rms_nm.max(LEAST_RMS_NM)];
    let end_s = 1.08 * points.iter().map(|p| place(p)[0]).fold(least_time_s, f64::max);
    // A tenth of a decade of room below and above.
    let [low, high] = range(points.iter().map(|p| place(p)[1].log10()));
    let rms = [low - 0.1, high + 0.1].map(|power| 10_f64.powf(power));
    let scales = [Scale::linear([0.0, end_s]), Scale::logarithmic(rms)];
    let frame = Frame::new([0.0; 2], SIZE_PX, MARGIN_PX, scales);

    let mut svg = Svg::new(FONT_PX);
    frame.grid(&mut svg);
    frame.axes(&mut svg, [TIME_AXIS, "RMS of the executed residual (nm)"]);
    frame.upright(&mut svg, least_time_s, BOUND);
    let label = format!("volume / VRR = {} s", fixed(least_time_s, 1));
    svg.text([frame.px([least_time_s, 1.0])[0] + 8.0, frame.top + 16.0], "", &label);
    let [left, top, right, bottom] = MARGIN_PX;
    let mut name_x = left + SIZE_PX[0];
    for (method, colour) in METHODS {
        let of_method = points.iter().filter(|p| p.method == method);
        let curve: Vec<[f64; 2]> = of_method.map(place).collect();
        if curve.is_empty() {
            continue;
        }
        frame.curve(&mut svg, curve.iter().copied(), colour);
        for point in curve {
            let [x, y] = frame.px(point);
            svg.put(format_args!(
                "<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"4\" fill=\"{colour}\"/>"
            ));
        }
        let attributes = format!("fill=\"{colour}\" text-anchor=\"end\"");
        svg.text([name_x, top - 12.0], &attributes, method.name());
        name_x -= NAME_WIDTH_PX;
    }
    svg.finish([left + SIZE_PX[0] + right, top + SIZE_PX[1] + bottom])
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The front of the coupon, found price by price, has six prices with the same plan, then one that is worse than
    /// the next in both RMS and time. Another plan is better than all, but exceeds the limits.
    #[test]
    fn every_price_has_the_best_of_all_plans_so_the_front_is_monotone() {
        let plan = |total_time_s: f64, rms_nm: f64, limits_respected: bool| Iterate {
            dwell_s: vec![total_time_s],
            rms_nm,
            detilted_nm: rms_nm,
            expected_rms_nm: None,
            merit_nm: rms_nm,
            total_time_s,
            stretched: 0,
            limits_respected,
        };
        let found = [(265.5, 0.33), (265.5, 0.33), (112.9, 0.779), (109.7, 0.763), (80.0, 1.5)];
        let prices = [0.0, 1e-5, 1e-4, 1e-3, 1e-2];
        let mut points: Vec<Point> = found
            .iter()
            .zip(prices)
            .map(|((time_s, rms_nm), price)| Point {
                method: PlanMethod::ClosedLoop,
                time_weight_nm2_per_s: price,
                best: plan(*time_s, *rms_nm, true),
                end: End::NoImprovement,
            })
            .collect();
        let mut plans: Vec<_> = points.iter().map(|p| (p.best.clone(), p.end)).collect();
        plans.push((plan(1.0, 0.01, false), End::RoundLimit));
        give_the_best(&mut points, &plans);
        for pair in points.windows(2) {
            let [cheap, dear] = [&pair[0].best, &pair[1].best];
            assert!(dear.total_time_s <= cheap.total_time_s && cheap.rms_nm <= dear.rms_nm);
        }
        assert!(points.iter().all(|p| p.best.limits_respected && p.best.total_time_s != 112.9));
        // sqrt(0.763^2 + 2e-4 * 109.7) is less than with the first plan: 0.5 * 0.33^2 + 1e-4 * 265.5 = 0.0810, and 0.302.
        assert_eq!(points[2].best.total_time_s, 265.5);
    }

    #[test]
    fn every_plan_is_a_dot_and_the_bound_is_where_its_time_is() {
        let point = |method: PlanMethod, total_time_s: f64, rms_nm: f64| Point {
            method,
            time_weight_nm2_per_s: 0.0,
            best: Iterate {
                dwell_s: vec![total_time_s],
                rms_nm,
                detilted_nm: rms_nm,
                expected_rms_nm: None,
                merit_nm: rms_nm,
                total_time_s,
                stretched: 0,
                limits_respected: true,
            },
            end: End::NoImprovement,
        };
        let (closed, joint) = (PlanMethod::ClosedLoop, PlanMethod::Joint);
        let points =
            [point(closed, 100.0, 0.5), point(closed, 200.0, 0.0), point(joint, 90.0, 0.4)];
        let svg = svg(&points, 54.0);
        let of = |colour: &str| svg.matches(&format!("r=\"4\" fill=\"{colour}\"")).count();
        assert_eq!(METHODS.map(|(_, colour)| of(colour)), [2, 1]);
        assert!(svg.contains(">closed loop<") && svg.contains(">joint<"), "{svg}");
        // The axis ends 8 % beyond 200 s: a quarter of its 610 px is 54 s, from 80 px.
        assert!(svg.contains("stroke-dasharray=\"6 4\" d=\"M232.5 40.0v340.0\""), "{svg}");
        // The longest plan: 80 + 610 / 1.08.
        assert!(svg.contains("<circle cx=\"644.8\""), "{svg}");
        assert!(!svg.contains("NaN") && !svg.contains("inf"), "{svg}");
    }
}
