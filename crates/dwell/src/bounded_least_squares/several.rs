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

use std::collections::BTreeSet;

use ndarray::Array2;
use planish_types::{
    DwellTime, Invalid, OnLattice, PARTS_TOLERANCE, Surface, Tif, TifLattice, ToolPath,
};
use serde::Serialize;

use super::{
    discrepancy,
    prepared::BoundedProblem,
    report::BoundedReport,
    settings::{BoundedSettings, Program, ToolColumns},
};
use crate::{
    DwellError,
    bounds::{self, Bound, pixel_weights},
};

/// Largest ratio of the peak rates of two tools; a larger one is a mistake in a unit. Larger: such mistakes pass.
/// Smaller: real racks are refused.
const MAX_RATE_RATIO: f64 = 1e6;

/// Plans that the gap of the report compares with.
const GAP_COVERS: &str = "all dwell times of these tools along these paths within their bounds, and every split \
                          of the removal between the tools";

/// One tool of a problem of several.
#[derive(Clone, Copy, Debug)]
pub struct ToolTask<'a> {
    /// Name of the tool, different from those of the others.
    pub name: &'a str,
    /// Removal rate; it may vary over the part, but not with the time of the run.
    pub tif: &'a Tif,
    /// Path along which it dwells.
    pub path: &'a ToolPath,
    /// Lower bound of every dwell time of this tool.
    pub min_dwell: Bound,
    /// Upper bound of every dwell time of this tool; none if absent.
    pub max_dwell: Option<Bound>,
    /// Price of a second of this tool: its weight in half the mean square of the residual, nm^2/s; >= 0.
    pub time_weight_nm2_per_s: f64,
}

/// Share of one tool in a plan of several.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ShareOfTool {
    /// Name of the tool.
    pub name: String,
    /// Price of a second of this tool, nm^2/s.
    pub time_weight_nm2_per_s: f64,
    /// Sum of its dwell times, s.
    pub total_time_s: f64,
    /// Weighted mean of what it removes, nm.
    pub mean_removal_nm: f64,
    /// Number of its dwell points.
    pub points: usize,
    /// Number of its reached dwell points at their lower bound.
    pub at_lower_bound: usize,
    /// Number of its dwell points that do not reach the map.
    pub unreached_points: usize,
    /// Lattice of the map on which its TIF was sampled anew; left out where the samples are its own.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub tif_lattice: Option<TifLattice>,
}

/// Dwell times of several tools, and the report on all of them.
#[derive(Clone, Debug)]
pub struct SeveralSolution {
    /// Dwell times along the path of each tool, in the order of the tools.
    pub dwell: Vec<DwellTime>,
    /// Share of each tool, in the same order.
    pub shares: Vec<ShareOfTool>,
    /// Report on the plan of all tools together: residual, total time and gap.
    pub report: BoundedReport,
}

/// Finds the dwell times of all tools that minimise (1) of the module together, for the desired removal. Bounds and
/// prices are those of the tools; those of the settings are not used.
///
/// `weight` (ny, nx) >= 0 weighs the pixels. Without it the weights follow from the standard deviations of the map, if
/// it has any; otherwise every valid pixel counts 1.
///
/// # Errors
/// Refuses no tool, two tools of one name, peak rates that differ by more than 1e6, and a rate that depends on the time
/// of the run. Refuses weights, prices, settings and bounds that are not in their range. Refuses a TIF that cannot be
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
    let program = Program { places: &places, lo, hi, guess: None, quadratic: None };
    let mut problem = BoundedProblem::new(desired, &columns, &program, weight, settings)?;
    let mut stacked = discrepancy::solve(&mut problem)?;
    stacked.report.proven.gap_covers = Some(GAP_COVERS.into());
    let mut dwell = Vec::with_capacity(tools.len());
    let mut shares = Vec::with_capacity(tools.len());
    for (k, OnLattice { lattice, .. }) in sampled.iter().enumerate() {
        let mut share = problem.share(k, stacked.dwell.dwell_s());
        share.tif_lattice = lattice.if_anew();
        shares.push(share);
        dwell.push(DwellTime::new(stacked.dwell.dwell_s()[columns[k].columns.clone()].to_vec())?);
    }
    Ok(SeveralSolution { dwell, shares, report: stacked.report })
}

impl<'a> ToolTask<'a> {
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

/// Refuses no tool, two tools of one name, and peak rates that differ by more than [`MAX_RATE_RATIO`].
fn check_tools(tools: &[ToolTask<'_>]) -> Result<(), Invalid> {
    let by_rate = |a: &&ToolTask<'_>, b: &&ToolTask<'_>| {
        a.tif.peak_nm_per_s().total_cmp(&b.tif.peak_nm_per_s())
    };
    let (Some(slowest), Some(fastest)) =
        (tools.iter().min_by(by_rate), tools.iter().max_by(by_rate))
    else {
        return Err(Invalid::whole("tools", "are none", "give at least one tool"));
    };
    let mut names = BTreeSet::new();
    if let Some((k, tool)) = tools.iter().enumerate().find(|(_, tool)| !names.insert(tool.name)) {
        let problem = format!("is a second tool {:?}", tool.name);
        return Err(Invalid::at_index("tools", k, problem, "give every tool its own name"));
    }
    let [least, largest] = [slowest, fastest].map(|tool| tool.tif.peak_nm_per_s());
    if largest > MAX_RATE_RATIO * least {
        let problem = format!(
            "have peak rates of {least:e} nm/s ({:?}) and {largest:e} nm/s ({:?}), more than a factor of \
             {MAX_RATE_RATIO:e} apart",
            slowest.name, fastest.name
        );
        return Err(Invalid::whole("tools", problem, "give the rates of all TIFs in nm/s"));
    }
    Ok(())
}

impl BoundedProblem<'_> {
    /// Returns the share of tool number k in the dwell times t (n) of all tools, s.
    fn share(&self, k: usize, t: &[f64]) -> ShareOfTool {
        let tool = &self.tools[k].columns;
        let columns = tool.columns.clone();
        let removal_nm = self.b.apply_one(k, t);
        let reached: Vec<usize> = columns.clone().filter(|j| self.reached[*j]).collect();
        ShareOfTool {
            name: tool.name.to_string(),
            time_weight_nm2_per_s: tool.time_weight_nm2_per_s,
            total_time_s: t[columns.clone()].iter().sum(),
            mean_removal_nm: (&removal_nm * &self.weight).sum() / self.weight.sum(),
            points: columns.len(),
            at_lower_bound: reached.iter().filter(|j| t[**j] <= self.lo[**j]).count(),
            unreached_points: columns.len() - reached.len(),
            tif_lattice: None,
        }
    }
}
