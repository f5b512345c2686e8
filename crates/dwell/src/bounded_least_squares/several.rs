//! The dwell times of several tools in one problem: which tool removes what.
//!
//! ```text
//! min over lo_k <= t_k <= hi_k, and a free piston c:
//!   1/2 sum_i w_i (z_i - c - sum_k (B_k t_k)_i)^2 + sum_k (penalty of t_k + lambda_k sum_i w_i sum_j t_kj)     (1)
//! ```
//!
//! Each tool k has its own TIF, path, bounds and price lambda_k of a second. Its penalty is that of (1) of
//! [`crate::bounded_least_squares`], relative to its own K, A and p. So the rates of the tools may differ by orders of
//! magnitude, and the penalty of a tool does not change when another one is added or left out.
//!
//! The columns of the tools are stacked, `B = [B_1 ... B_m]`, and everything else is that of one tool. The surrogate
//! has the products of columns of different tools, because a wide tool can remove nearly the same as a narrow one: a
//! surrogate without them would exchange removal between the tools in many small steps. The gap is a sum over all
//! columns, so that one certificate covers the split, too.
//!
//! Without a lower bound above 0, a further tool never raises the minimum of (1): it may stand still.
//!
//! The set-up errors of the tools ([`planish_types::SetupErrors`]) add a reserve and a term to (1), see `setup`. After a
//! map is measured between two tools, the later ones are planned again for it. [`solve_keeping`] lowers their prices
//! until they leave no more than the plan: an error of the coarse tool then costs time, and no residual.

use std::collections::BTreeSet;

use ndarray::Array2;
use planish_numerics::statistics;
use planish_types::{
    DwellTime, Invalid, OnLattice, PARTS_TOLERANCE, Surface, Tif, check_rates,
    outcome::plan::{Reserve, ToolShare},
};

use super::{
    discrepancy,
    prepared::BoundedProblem,
    report::{BoundedReport, BoundedSolution},
    settings::{BoundedSettings, Product, Program, ToolColumns, ToolTask},
    setup::{self, ExpectedSquare, Fates, Planned},
};
use crate::{
    DwellError,
    bounds::{self, pixel_weights},
    model::operator::Removal,
};

/// Part of the largest removal of a tool that dwells everywhere along its path, below which it does not reach a pixel.
/// Larger: pixels at the edge of its reach count as beyond it. Smaller: pixels at which it would dwell for hours count as
/// reached.
const LEAST_REACH: f64 = 0.01;

/// Part of the residual to be kept by which a plan may leave less, relative. Larger: a price lower than needed, so more
/// time. Smaller: more problems.
const KEPT_FRACTION: f64 = 0.02;

/// Largest number of problems of [`solve_keeping`], each at another price. Larger: a residual that no price keeps is
/// tried longer. Smaller: a price lower than needed, so more time.
const MAX_PRICES: usize = 12;

/// Plans that the gap of the report compares with.
const GAP_COVERS: &str = "all dwell times of these tools along these paths within their bounds, and every split \
                          of the removal between the tools";

/// Dwell times of several tools, and the report on all of them.
#[derive(Clone, Debug)]
pub struct SeveralSolution {
    /// Dwell times along the path of each tool, in the order of the tools.
    pub dwell: Vec<DwellTime>,
    /// Share of each tool, in the same order.
    pub shares: Vec<ToolShare>,
    /// Report on the plan of all tools together: residual, total time and gap.
    pub report: BoundedReport,
    /// Expected RMS of the set-up errors that no map shows, nm; `None` without such errors. It is not in the residual
    /// of the report.
    pub unseen_rms_nm: Option<f64>,
}

/// Finds the dwell times of all tools that minimise (1) of the module together, for the desired removal. Bounds and
/// prices are those of the tools; those of the settings are not used.
///
/// `weight` (ny, nx) >= 0 weighs the pixels. Without it the weights follow from the standard deviations of the map, if
/// it has any; otherwise every valid pixel counts 1.
///
/// If the tools have set-up errors that a map shows, the problem is solved twice: without a reserve, and with the one
/// that the errors of that plan ask for.
///
/// # Errors
/// Refuses no tool, two tools of one name, peak rates that differ by more than 1e6, and a rate that depends on the time
/// of the run. Refuses a reserve above an upper bound. Refuses weights, prices, settings and bounds that are not in their range. Refuses a TIF that cannot be
/// sampled on the lattice of the map or covers too many pixels, and a tool that does not reach the map. Refuses more
/// columns than can be factorised, and fails if the matrix of the surrogate is singular.
pub fn solve_several(
    desired: &Surface,
    tools: &[ToolTask<'_>],
    weight: Option<&Array2<f64>>,
    settings: &BoundedSettings,
) -> Result<SeveralSolution, DwellError> {
    check_tools(tools)?;
    settings.check()?;
    let weight = pixel_weights(desired, weight)?;
    let mut sampled = Vec::with_capacity(tools.len());
    let mut lo = Vec::new();
    let mut hi = Vec::new();
    for tool in tools {
        sampled.push(tool.prepared(desired, &mut lo, &mut hi).map_err(|e| e.of_tool(tool.name))?);
    }
    let mut places = Vec::with_capacity(lo.len());
    let mut columns = Vec::with_capacity(tools.len());
    for (tool, OnLattice { tif, .. }) in tools.iter().zip(&sampled) {
        let start = places.len();
        places.extend(settings.columns.places(tool.path, tif));
        columns.push(ToolColumns {
            name: tool.name,
            tif,
            path: tool.path,
            columns: start..places.len(),
            time_weight_nm2_per_s: tool.time_weight_nm2_per_s,
        });
    }
    let grid = desired.grid();
    let fates = Fates::new(tools);
    let mut unseen = ExpectedSquare::new(grid, &weight, settings.free, places.len());
    for k in &fates.blind {
        unseen.add(columns[*k].columns.clone(), &places, &sampled[*k].tif, tools[*k].setup)?;
    }
    let product = |t: &[f64]| unseen.product(t);
    let quadratic: Option<Product<'_>> = if unseen.is_empty() { None } else { Some(&product) };
    let mut program = Program { places: &places, lo, hi, guess: None, quadratic };
    let stack = Stack { desired, columns: &columns, weight: &weight, settings };
    let (mut stacked, mut shares, planned) = stack.solve(&program)?;
    for (earlier, next) in &fates.mended {
        let (reserve, least_s) =
            setup::reserve(tools, &planned, (earlier.as_slice(), *next), (grid, &weight));
        let own = columns[*next].columns.clone();
        setup::raise(&mut program.lo[own.clone()], &program.hi[own], &least_s, &reserve)
            .map_err(|e| DwellError::from(e).of_tool(tools[*next].name))?;
        shares[*next].reserve = Some(reserve);
    }
    if !fates.mended.is_empty() {
        program.guess = Some(stacked.dwell.dwell_s().to_vec());
        let reserves: Vec<Option<Reserve>> =
            shares.into_iter().map(|share| share.reserve).collect();
        (stacked, shares, _) = stack.solve(&program)?;
        shares.iter_mut().zip(reserves).for_each(|(share, reserve)| share.reserve = reserve);
    }
    stacked.report.proven.gap_covers = Some(GAP_COVERS.into());
    let all_s = stacked.dwell.dwell_s();
    let mut dwell = Vec::with_capacity(tools.len());
    for (k, OnLattice { lattice, .. }) in sampled.iter().enumerate() {
        shares[k].tif_lattice = lattice.if_anew();
        dwell.push(DwellTime::new(all_s[columns[k].columns.clone()].to_vec())?);
    }
    let unseen_rms_nm = if unseen.is_empty() { None } else { Some(unseen.rms_nm(all_s)) };
    Ok(SeveralSolution { dwell, shares, report: stacked.report, unseen_rms_nm })
}

/// A plan whose prices of a second are lowered until it keeps a residual.
#[derive(Clone, Debug)]
pub struct KeptPlan {
    /// The plan.
    pub solution: SeveralSolution,
    /// Factor on the prices of all tools, at most 1.
    pub price_factor: f64,
    /// True if the plan leaves at most the residual that was to be kept.
    pub is_kept: bool,
}

/// Finds dwell times that leave at most `most_rms_nm`, in little time: those of [`solve_several`] with the prices of
/// all tools multiplied by one factor, the largest one at which the residual is kept. It is 1 if the prices as they are
/// keep it, and is found to `KEPT_FRACTION` of the residual in at most `MAX_PRICES` problems.
///
/// # Errors
/// Refuses what [`solve_several`] refuses, and a residual that is not a number > 0.
pub fn solve_keeping(
    desired: &Surface,
    tools: &[ToolTask<'_>],
    weight: Option<&Array2<f64>>,
    settings: &BoundedSettings,
    most_rms_nm: f64,
) -> Result<KeptPlan, DwellError> {
    if !(most_rms_nm.is_finite() && most_rms_nm > 0.0) {
        let problem = format!("is {most_rms_nm}");
        return Err(Invalid::whole("keep_rms_nm", problem, "give a number > 0").into());
    }
    let solve_at = |price_factor: f64| -> Result<KeptPlan, DwellError> {
        let priced: Vec<ToolTask<'_>> =
            tools.iter().map(|tool| tool.priced(price_factor)).collect();
        let solution = solve_several(desired, &priced, weight, settings)?;
        let is_kept = solution.report.model_rms_nm <= most_rms_nm;
        Ok(KeptPlan { solution, price_factor, is_kept })
    };
    // `above` leaves too much, `best` keeps the residual.
    let mut above = solve_at(1.0)?;
    if above.is_kept || tools.iter().all(|tool| tool.time_weight_nm2_per_s == 0.0) {
        return Ok(above);
    }
    let mut best: Option<KeptPlan> = None;
    for _ in 1..MAX_PRICES {
        let factor = match &best {
            // Where the price decides, the residual is proportional to it.
            None => above.price_factor * 0.5 * most_rms_nm / above.solution.report.model_rms_nm,
            Some(best) => (best.price_factor * above.price_factor).sqrt(),
        };
        let next = solve_at(factor)?;
        if !next.is_kept {
            above = next;
            continue;
        }
        let is_close = next.solution.report.model_rms_nm >= (1.0 - KEPT_FRACTION) * most_rms_nm;
        best = Some(next);
        if is_close {
            break;
        }
    }
    Ok(best.unwrap_or(above))
}

/// The problem of all tools, as far as it does not depend on the bounds.
struct Stack<'a> {
    desired: &'a Surface,
    columns: &'a [ToolColumns<'a>],
    weight: &'a Array2<f64>,
    settings: &'a BoundedSettings,
}

impl Stack<'_> {
    /// Solves the problem within the bounds of a program. Returns the dwell times of all tools, the share of each, and
    /// what a reserve needs to know about each.
    fn solve(
        &self,
        program: &Program<'_>,
    ) -> Result<(BoundedSolution, Vec<ToolShare>, Vec<Planned>), DwellError> {
        let Self { desired, columns, weight, settings } = *self;
        let mut problem = BoundedProblem::new(desired, columns, program, weight.clone(), settings)?;
        let stacked = discrepancy::solve(&mut problem)?;
        let planned: Vec<Planned> =
            (0..columns.len()).map(|k| problem.planned(k, stacked.dwell.dwell_s())).collect();
        let shares = planned.iter().enumerate();
        let shares = shares.map(|(k, planned)| problem.share(k, planned, stacked.dwell.dwell_s()));
        let shares = shares.collect();
        Ok((stacked, shares, planned))
    }
}

impl<'a> ToolTask<'a> {
    /// Returns this tool with its price of a second multiplied by `factor`.
    fn priced(&self, factor: f64) -> Self {
        Self { time_weight_nm2_per_s: factor * self.time_weight_nm2_per_s, ..*self }
    }

    /// Samples the TIF on the lattice of the map, and appends the bounds of the dwell times to `lo` and `hi`, s.
    fn prepared(
        &self,
        desired: &Surface,
        lo: &mut Vec<f64>,
        hi: &mut Vec<f64>,
    ) -> Result<OnLattice<'a>, DwellError> {
        self.tif.same_at_all_times("a plan of several tools")?;
        let price = self.time_weight_nm2_per_s;
        if !(price.is_finite() && price >= 0.0) {
            let remedy = "give a number >= 0";
            return Err(
                Invalid::whole("time_weight_nm2_per_s", format!("is {price}"), remedy).into()
            );
        }
        let first = lo.len();
        lo.extend(bounds::lower(self.path, self.min_dwell)?);
        hi.extend(bounds::upper(self.path, self.max_dwell)?);
        if let Some(j) = (first..lo.len()).find(|j| lo[*j] > hi[*j]) {
            let problem = format!("is {} s, below the lower bound of {} s", hi[j], lo[j]);
            let remedy = "give a larger upper bound";
            return Err(Invalid::at_index("max_dwell", j - first, problem, remedy).into());
        }
        Ok(self.tif.on_lattice_of(desired.grid(), PARTS_TOLERANCE)?)
    }
}

/// Refuses no tool, two tools of one name, and rates that [`check_rates`] refuses.
fn check_tools(tools: &[ToolTask<'_>]) -> Result<(), Invalid> {
    if tools.is_empty() {
        return Err(Invalid::whole("tools", "are none", "give at least one tool"));
    }
    let mut names = BTreeSet::new();
    if let Some((k, tool)) = tools.iter().enumerate().find(|(_, tool)| !names.insert(tool.name)) {
        let problem = format!("is a second tool {:?}", tool.name);
        return Err(Invalid::at_index("tools", k, problem, "give every tool its own name"));
    }
    let rates: Vec<(&str, &Tif)> = tools.iter().map(|tool| (tool.name, tool.tif)).collect();
    check_rates(&rates)
}

impl BoundedProblem<'_> {
    /// Returns what a reserve needs to know about tool number k at the dwell times t (n) of all tools, s.
    fn planned(&self, k: usize, t: &[f64]) -> Planned {
        let tool = &self.tools[k];
        Planned {
            removal_nm: self.b.apply_one(k, t),
            line_distance_mm: tool.scale.line_distance_mm,
            reached: self.reached[tool.columns.columns.clone()].to_vec(),
        }
    }

    /// Returns the share of tool number k in the dwell times t (n) of all tools, s.
    fn share(&self, k: usize, planned: &Planned, t: &[f64]) -> ToolShare {
        let tool = &self.tools[k].columns;
        let columns = tool.columns.clone();
        let reached: Vec<usize> = columns.clone().filter(|j| self.reached[*j]).collect();
        ToolShare {
            name: tool.name.to_string(),
            time_weight_nm2_per_s: tool.time_weight_nm2_per_s,
            total_time_s: t[columns.clone()].iter().sum(),
            mean_removal_nm: (&planned.removal_nm * &self.weight).sum() / self.weight.sum(),
            points: columns.len(),
            at_lower_bound: reached.iter().filter(|j| t[**j] <= self.lo[**j]).count(),
            unreached_points: columns.len() - reached.len(),
            unreached_part: self.unreached_part(k),
            tif_lattice: None,
            reserve: None,
        }
    }
}

impl BoundedProblem<'_> {
    /// Returns the part of the pixels that count, by number, at which tool number k removes less than [`LEAST_REACH`] of
    /// its largest removal if all of its dwell times are equal.
    fn unreached_part(&self, k: usize) -> f64 {
        let reach = self.b.apply_one(k, &vec![1.0; self.reached.len()]);
        let least = LEAST_REACH * reach.iter().copied().fold(0.0, f64::max);
        let counted = || reach.iter().zip(&self.weight).filter(|(_, w)| **w > 0.0);
        counted().filter(|(reach, _)| **reach < least).count() as f64 / counted().count() as f64
    }
}

/// Errors with which a tool is set up in one run.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct SetupDraw {
    /// Distance of the tool from its place along [x, y], mm.
    pub shift_mm: [f64; 2],
    /// Error of the removal rate, relative to the rate.
    pub rate_fraction: f64,
}

/// Result of a plan of several tools in one run with set-up errors.
#[derive(Clone, Debug, PartialEq)]
pub struct ExecutedPlan {
    /// Residual after the last tool, RMS, nm.
    pub rms_nm: f64,
    /// Sum of the dwell times of each tool, in the order of the tools, s.
    pub time_s: Vec<f64>,
    /// True if every plan after a map kept the residual of the plan before the run.
    pub is_kept: bool,
}

/// Executes a plan of these tools with these errors of their set-up, in their order of use. With `has_maps`, the part is
/// measured where the tools say so, and the later ones are planned again, keeping the residual of `plan`.
///
/// # Errors
/// Refuses what [`solve_keeping`] refuses.
pub fn execute_with_errors(
    (desired, weight, settings): (&Surface, Option<&Array2<f64>>, &BoundedSettings),
    tools: &[ToolTask<'_>],
    plan: &SeveralSolution,
    draws: &[SetupDraw],
    has_maps: bool,
) -> Result<ExecutedPlan, DwellError> {
    let order = setup::order_of_use(tools);
    let mut map = desired.height_nm().clone();
    let mut dwell: Vec<DwellTime> = plan.dwell.clone();
    let mut is_kept = true;
    for (place, k) in order.iter().enumerate() {
        map -= &tools[*k].executed(desired, &dwell[*k], &draws[*k], settings)?;
        let later = &order[place + 1..];
        if !has_maps || !tools[*k].setup.measured_after || later.is_empty() {
            continue;
        }
        let measured = Surface::new(*desired.grid(), map.clone())?;
        let left: Vec<ToolTask<'_>> = later.iter().map(|k| tools[*k]).collect();
        let most_rms_nm = plan.report.model_rms_nm;
        let again = solve_keeping(&measured, &left, weight, settings, most_rms_nm)?;
        is_kept &= again.is_kept;
        for (k, own) in later.iter().zip(again.solution.dwell) {
            dwell[*k] = own;
        }
    }
    let rms_nm = statistics::statistics(map.view()).map_or(0.0, |s| s.rms);
    let time_s = dwell.iter().map(|dwell| dwell.dwell_s().iter().sum()).collect();
    Ok(ExecutedPlan { rms_nm, time_s, is_kept })
}

impl ToolTask<'_> {
    /// Returns the removal (ny, nx), nm, of these dwell times with errors of the set-up.
    fn executed(
        &self,
        desired: &Surface,
        dwell: &DwellTime,
        draw: &SetupDraw,
        settings: &BoundedSettings,
    ) -> Result<Array2<f64>, DwellError> {
        let tif = &*self.tif.on_lattice_of(desired.grid(), PARTS_TOLERANCE)?.tif;
        let path = setup::displaced(self.path, draw.shift_mm)?;
        let b = Removal::new(&settings.columns.places(&path, tif), tif, desired.grid(), true)?;
        Ok(b.apply(dwell.dwell_s()) * (1.0 + draw.rate_fraction))
    }
}
