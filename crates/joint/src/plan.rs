//! Joint plan, from the surface error map to the motion.
//!
//! ```text
//! path -> smooth curves -> nodes, about one per 0.6 TIF widths and those of the corners -> their densities
//! -> motion -> its removal (simulated) and its limits (proven)
//! ```

use std::borrow::Cow;

use ndarray::Array2;
use planish_dwell::columns;
use planish_simulate::{SimulationPlan, SimulationSettings};
use planish_types::{
    DwellTime, End, Invalid, Limits, OnLattice, PARTS_TOLERANCE, Removal, Surface, Tif, TifLattice,
    TimeFactor, ToolPath, Trajectory, Variation,
    outcome::plan::ProvenGap,
    plausible::{self, Rms},
};
use planish_verify::{VerifySettings, verify};
use serde::Serialize;

use crate::{
    JointError,
    axes::{self, AxisReport, Further, Scaled},
    curve::{self, Curve, Rounding, Smooth},
    further::FurtherAxes,
    jerk::Average,
    mesh::Mesh,
    problem::{HOPELESS, LITTLE_WORK, MeshOutcome, Meshes, PlanInputs, Solved, solve},
    settings::JointSettings,
};

/// Default spacing of the nodes of the density, over the width of the TIF. Larger: less work, and a residual at
/// wavelengths that the TIF could remove. Smaller: more nodes, for densities that the removal hardly shows. Chosen.
const SPACING_OVER_TIF_WIDTH: f64 = 0.6;

/// Least width by which the nodes are spaced, over the spread of the TIF ([`Tif::spread_mm`]); it takes the place of a
/// smaller width of the TIF. A spot with steep flanks, such as a ring, is narrow by its slopes. Nodes by these are many
/// more than its removal shows: half as many leave 0.1 % more of a ring with hard edges. Larger: a larger residual with
/// such spots. Smaller: plans that take minutes. Chosen.
const LEAST_WIDTH_OVER_SPREAD: f64 = 0.4;

/// Default deviation of the curve at corners, over the width of the TIF. Larger: faster corners, further from the path.
/// Smaller: slower corners. Chosen so that a corner costs little time. It is no error of the removal, because the
/// solver knows the position of the tool.
const DEVIATION_OVER_TIF_WIDTH: f64 = 0.2;

/// Default largest radius of a corner over the width of the TIF. Larger: faster, longer corners. Smaller: slower
/// corners. Chosen.
const RADIUS_OVER_TIF_WIDTH: f64 = 1.0;

/// Largest distance of a motion that keeps a limit on jerk from the motion before averaging, over the width of the
/// TIF. Larger: the tool is further from the curve. Smaller: less of the acceleration may be used, so the plan takes
/// longer. Chosen.
const JERK_DEVIATION_OVER_TIF_WIDTH: f64 = 0.1;

/// Least spacing of the nodes over the width of the TIF. Larger: spacings that make sense are refused. Smaller: a
/// spacing in the wrong unit makes a very large problem. Chosen.
const LEAST_SPACING_OVER_TIF_WIDTH: f64 = 0.02;

/// Largest number of multiplications of one factorisation of the normal matrix at the default spacing; above it the
/// nodes are set further apart. Larger: plans that take many minutes. Smaller: a larger residual on large parts.
/// Chosen: a plan takes some 30 factorisations.
const MOST_WORK: f64 = 6e10;

/// Factor by which the spacing grows until the work is affordable, and by which it shrinks while there is little
/// work. Larger: a spacing further from the limit. Smaller: more meshes that are tried. Chosen.
const WIDENED_BY: f64 = 1.1;

/// Least spacing over the width of the TIF to which nodes move closer if there is little work. Larger: a larger
/// residual with a tool that is wide for its part. Smaller: more nodes, which hardly lower the residual. Chosen.
const CLOSEST_SPACING_OVER_TIF_WIDTH: f64 = 0.15;

/// Largest spacing over the width of the TIF to which nodes move apart to save work. Larger: a density that no longer
/// follows the removal of the TIF. Smaller: plans of large parts that take minutes. Chosen.
const WIDEST_SPACING_OVER_TIF_WIDTH: f64 = 1.5;

/// Least fraction of the time near a limit at which the summary names this limit. Larger: limits of short bends are
/// left out. Smaller: limits at single points are named. Chosen.
const LEAST_NAMED: f64 = 5e-4;

/// Largest number of limits that the summary names. Larger: a longer sentence. Smaller: limits that matter are left
/// out. Chosen; the manifest has all of them.
const MOST_NAMED: usize = 4;

/// Report of a joint plan.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct JointReport {
    /// Number of curves along the path, each from rest to rest.
    pub curves: usize,
    /// Largest movement of a point of the path by the smoothing that precedes the rounding of corners, mm.
    pub points_moved_mm: f64,
    /// Number of corners that were rounded.
    pub corners: usize,
    /// Largest distance of a curve from a corner of the (smoothed) path, or from the chords of its bent parts, mm.
    pub corner_deviation_mm: f64,
    /// Least radius of curvature of the curves, mm; `None` if all are straight.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub least_radius_mm: Option<f64>,
    /// Sum of the arc lengths of all curves, mm.
    pub length_mm: f64,
    /// Number of nodes of the density, which are the unknowns.
    pub nodes: usize,
    /// Number of nodes of every mesh, from the one of equal distances to the last one.
    pub nodes_of_meshes: Vec<usize>,
    /// Largest distance of neighbouring nodes, mm.
    pub node_spacing_mm: f64,
    /// Widened spacing of the nodes; `None` unless the solver would take too long with the default spacing.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub widened: Option<Widened>,
    /// Price of a second in the objective, relative to half the mean square of the residual, nm^2/s.
    pub price_nm2_per_s: f64,
    /// Reason for the end of the solver: `optimal` or `iteration-limit`.
    pub end: End,
    /// Proven bound on the excess of the objective over the least one of the last convex program, relative to it.
    /// This convex program has fixed tangents in the place of the limits, which are not convex, so it bounds no other
    /// motion.
    #[serde(flatten)]
    pub proven: ProvenGap,
    /// Tikhonov weight of the pull to the least densities (alpha), dimensionless.
    pub tikhonov: f64,
    /// Part of the objective that is due to the pull to the least densities, 0 to 1.
    pub pull_part: f64,
    /// Number of steps of the solver in all its rounds, without the search for a start if the price is an elasticity.
    pub iterations: usize,
    /// Objective of the last round at its start and after every step, and of the rounds with new tangents that follow
    /// it, nm^2. The last value and some before it are computed with the removal itself, the others with the normal
    /// matrix.
    pub objective_nm2: Vec<f64>,
    /// RMS of the residual in the removal model of the solver, without the free low-order terms, nm.
    pub model_rms_nm: f64,
    /// Largest distance of a cubic piece from the exact motion along the curve at the middle of its time, mm.
    pub fit_error_mm: f64,
    /// Average of the motion in time; `None` if the machine does not limit jerk.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub average: Option<Averaged>,
    /// Number of rounds of the solver, without those with new tangents. In all but the first one the limits of some
    /// spans are tightened.
    pub rounds: usize,
    /// Ratios of every axis to its limits; empty if the machine has no axes beyond x and y.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub axes: Vec<AxisReport>,
    /// Factor by which all times of the motion are longer, because an excess over a limit of a further axis was left
    /// after the rounds. `None` if none was left, or if the motion is refused as it is.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub slowed_by: Option<f64>,
    /// Lattice of the map on which the TIF was resampled; `None` if its own samples were used.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub tif_lattice: Option<TifLattice>,
    /// Rates at the times of the plan; `None` unless the removal rate depends on the time of the run.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rates_of_time: Option<RatesOfTime>,
}

/// Returns the proven bound of a plan, with the description of the plans that it covers.
fn proven_gap(relative_gap: f64, is_before_average: bool) -> ProvenGap {
    let covered = if is_before_average { COVERED_BEFORE_AVERAGE } else { COVERED };
    ProvenGap { relative_gap: Some(relative_gap), gap: None, gap_covers: Some(covered.into()) }
}

impl JointReport {
    /// Returns the proven bound on the excess of the objective, relative to it; infinite if nothing is proven.
    pub fn relative_gap(&self) -> f64 {
        self.proven.relative_gap.unwrap_or(f64::INFINITY)
    }
}

/// Removal rates of a plan for a tool whose rate depends on the time of the run.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct RatesOfTime {
    /// Number of plans: the first with the rate of the TIF, each further one with the rates at the times of the
    /// previous one.
    pub rounds: usize,
    /// Largest relative difference between a rate that the plan uses and the rate at the times of the plan.
    pub rate_error: f64,
}

/// Description of the plans that [`JointReport::relative_gap`] covers.
const COVERED: &str = "plans on this curve whose density is linear between these nodes, under the tangents of the \
                       limits; not closer nodes, another curve, or another law of time between the nodes";

/// Description of the plans that [`JointReport::relative_gap`] covers on a machine that limits jerk.
const COVERED_BEFORE_AVERAGE: &str = "plans on this curve whose density is linear between these nodes, under the \
                                      tangents of the limits, and which keep the jerk by the same average in time; \
                                      not closer nodes, another curve, another law of time between the nodes, or \
                                      another way to keep the jerk";

/// Spacing of the nodes that was widened because the solver would take too long with the default.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Widened {
    /// Default spacing of the nodes, mm.
    pub from_mm: f64,
    /// Spacing of the nodes of this plan, mm.
    pub to_mm: f64,
}

/// Average of a motion in time, which keeps a limit on jerk.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Averaged {
    /// Length of the window over which the motion is averaged, s.
    pub window_s: f64,
    /// Fraction of the limits on acceleration that the plan uses before averaging.
    pub fraction_of_acceleration: f64,
    /// Proven bound on the distance from the motion before averaging, mm.
    pub deviation_mm: f64,
}

/// Joint plan: times, motion, predicted removal and report.
#[derive(Clone, Debug)]
pub struct JointPlan {
    /// Time of the motion in every segment of the path.
    pub dwell: DwellTime,
    /// Motion that the machine executes.
    pub trajectory: Trajectory,
    /// Simulated removal of the motion, with the residual.
    pub removal: Removal,
    /// Reason why the motion is refused, a limit that it exceeds; `None` if it keeps every limit.
    pub refused: Option<String>,
    /// Report on curves, nodes, solver and limits.
    pub report: JointReport,
}

impl JointReport {
    /// Returns the names of the limits that the plan is near, with the fraction of the time, the longest first; `none`
    /// if there is none.
    pub fn near_limits(&self) -> String {
        let of_axes = self.axes.iter().flat_map(|axis| {
            axis.near().map(|(quantity, part)| (part, format!("{quantity} of {}", axis.name)))
        });
        let mut all: Vec<(f64, String)> = of_axes.collect();
        all.retain(|(part, _)| *part >= LEAST_NAMED);
        all.sort_by(|a, b| b.0.total_cmp(&a.0));
        let named: Vec<String> = all
            .iter()
            .take(MOST_NAMED)
            .map(|(part, name)| format!("{name} {:.1} % of the time", 100.0 * part))
            .collect();
        if named.is_empty() { "none".into() } else { named.join(", ") }
    }
}

impl JointPlan {
    /// Returns the reason why the plan should not be run as it is; `None` if there is none. `desired` is the surface
    /// error before the plan.
    pub fn negative(&self, desired: &Surface) -> Option<String> {
        let r = &self.report;
        let unfinished = if r.end == End::Optimal {
            None
        } else {
            Some(format!(
                "{}: after {} steps the objective may be {:.1e} of itself above the least one for fixed tangents of the \
                 limits; raise `max_iterations` or `relative_gap`",
                r.end,
                r.iterations,
                r.relative_gap()
            ))
        };
        let (before, after) = (Rms::of_surface(desired), Rms::of_surface(self.removal.residual()));
        let total_time_s = self.trajectory.total_time_s();
        let other_rates = r.rates_of_time.filter(|rates| rates.rate_error > SAME_RATE).map(|rates| {
            format!(
                "not converged: after {} plans the rate at the times of the last one is up to {:.1e} off the one it is \
                 planned with; give a tool whose rate changes less within the run",
                rates.rounds, rates.rate_error
            )
        });
        let refused = self.refused.clone().or(unfinished).or(other_rates);
        refused.or_else(|| plausible::drawback(before, after, total_time_s))
    }
}

/// Relative change of a rate from one plan to the next up to which the plan counts as planned with the rates of its own
/// times. Larger: a larger residual of tools whose rate changes. Smaller: more plans.
const SAME_RATE: f64 = 1e-4;

/// Largest number of plans for a tool whose rate depends on the time of the run. Larger: more time. Smaller: plans with
/// the rates of other times.
const MAX_ROUNDS_OF_TIMES: usize = 6;

/// Finds the dwell-time density and the motion along `path` for the desired removal, on a machine with the axes x and
/// y.
///
/// # Errors
///
/// Refuses settings out of their range, a path without a length and a TIF that nowhere reaches the map. Refuses a limit
/// on jerk that leaves nearly nothing of the acceleration, and nodes that need too much memory. Fails if the weights
/// are too small for the equations.
pub fn plan(
    desired: &Surface,
    tif: &Tif,
    path: &ToolPath,
    limits: &Limits,
    settings: &JointSettings,
) -> Result<JointPlan, JointError> {
    planned(desired, tif, path, (limits, None), settings)
}

/// Finds the density and the motion along `path` as [`plan`] does, on a machine with axes beyond x and y.
///
/// # Errors
///
/// Refuses what [`plan`] refuses, and a limit of a further axis that is not positive and finite. Refuses a path on
/// which a further axis has no position, allows nearly no feedrate, or turns within a part of a span.
pub fn plan_with_further_axes(
    desired: &Surface,
    tif: &Tif,
    path: &ToolPath,
    (limits, further): (&Limits, &dyn FurtherAxes),
    settings: &JointSettings,
) -> Result<JointPlan, JointError> {
    planned(desired, tif, path, (limits, Some(further)), settings)
}

impl From<Average> for Averaged {
    fn from(average: Average) -> Self {
        Self {
            window_s: average.window_s,
            fraction_of_acceleration: average.fraction,
            deviation_mm: average.deviation_mm,
        }
    }
}

/// Problem along smooth curves; the rates of a tool that depend on the time of the run are not part of it.
struct Task<'a> {
    desired: &'a Surface,
    tif: &'a Tif,
    path: &'a ToolPath,
    curves: &'a [Curve],
    limits: &'a Limits,
    further: Option<&'a Further<'a>>,
    average: Option<Average>,
    simulation: &'a SimulationPlan<'a>,
}

impl Task<'_> {
    /// Returns the average of a planned motion in time; `None` if the machine does not limit jerk.
    fn averaged(&self, planned: &Trajectory) -> Result<Option<Trajectory>, Invalid> {
        self.average.map(|average| average.averaged(planned)).transpose()
    }

    /// Returns the removal of a plan as it is executed, nm; `rates` has the factor of the removal rate in every segment
    /// of the path.
    fn removal_nm(&self, planned: &Trajectory, rates: &[f64]) -> Result<Array2<f64>, Invalid> {
        let averaged = self.averaged(planned)?;
        let motion = averaged.as_ref().unwrap_or(planned);
        match self.tif.variation().and_then(Variation::time_factor) {
            None => Ok(self.simulation.removal_nm(motion)?.0),
            Some(_) => {
                let rates = motion.segments().map(|s| s.dwell_index.map_or(1.0, |j| rates[j]));
                let rates = rates.collect();
                Ok(self.simulation.removal_nm(&motion.clone().with_rate_factor(rates)?)?.0)
            }
        }
    }

    /// Solves the problem. If the removal rate depends on the time of the run, it solves it again with the rates at the
    /// times of the previous plan, until the rates stay.
    fn solved(
        &self,
        meshes: &Meshes,
        settings: &JointSettings,
    ) -> Result<(Solved, Option<RatesOfTime>), JointError> {
        let Self { desired, tif, path, curves, limits, further, .. } = *self;
        let mut rates = vec![1.0; path.len()];
        let mut rounds_of_times = 0;
        loop {
            // The rates of a plan are fixed, in its model as in its motion.
            let executed = &|planned: &Trajectory| self.removal_nm(planned, &rates);
            let inputs = {
                let rates = &rates;
                PlanInputs { desired, tif, path, curves, limits, further, rates, executed }
            };
            let solved = solve(&inputs, meshes, settings)?;
            rounds_of_times += 1;
            let Some(time) = tif.variation().and_then(Variation::time_factor) else {
                return Ok((solved, None));
            };
            let trajectory = &solved.outcome.motion.trajectory;
            let own = columns::time_factors(trajectory, path.len(), tif);
            let change = own.iter().zip(&rates).map(|(a, b)| (a / b - 1.0).abs());
            let rate_error = change.fold(0.0, f64::max);
            if rate_error <= SAME_RATE || rounds_of_times == MAX_ROUNDS_OF_TIMES {
                return Ok((solved, Some(RatesOfTime { rounds: rounds_of_times, rate_error })));
            }
            rates = rates_of_same_removal(time, trajectory, &rates);
        }
    }
}

/// Returns the rates in the segments of the path at the times of another motion. That motion removes the same in every
/// segment as this one does at `rates`, but by the rates of its own times. The removal of a plan changes less from
/// round to round than its times.
fn rates_of_same_removal(time: &TimeFactor, motion: &Trajectory, rates: &[f64]) -> Vec<f64> {
    let mut sums = vec![(0.0, 0.0); rates.len()];
    let mut now_s = motion.break_time_s()[0];
    for segment in motion.segments() {
        let Some(j) = segment.dwell_index.filter(|j| segment.tool_on && *j < rates.len()) else {
            now_s += segment.duration_s;
            continue;
        };
        let effective_s = rates[j] * segment.duration_s;
        let duration_s = time.duration_s(now_s, effective_s);
        sums[j].0 += effective_s;
        sums[j].1 += duration_s;
        now_s += duration_s;
    }
    sums.into_iter()
        .map(
            |(effective_s, duration_s)| {
                if duration_s > 0.0 { effective_s / duration_s } else { 1.0 }
            },
        )
        .collect()
}

fn planned(
    desired: &Surface,
    tif: &Tif,
    path: &ToolPath,
    (limits, further): (&Limits, Option<&dyn FurtherAxes>),
    settings: &JointSettings,
) -> Result<JointPlan, JointError> {
    settings.check()?;
    let OnLattice { tif, lattice } = tif.on_lattice_of(desired.grid(), PARTS_TOLERANCE)?;
    let tif = &*tif;
    let tif_width_mm = tif.width_mm();
    let (rounding, spacing_mm) = scales(tif_width_mm, tif.spread_mm(), settings)?;
    let deviation_mm = JERK_DEVIATION_OVER_TIF_WIDTH * tif_width_mm;
    let further_limits = further.map_or(&[][..], FurtherAxes::limits);
    let average = Average::new(limits, further_limits, deviation_mm);
    let further = further.map(|axes| Further::new(axes, average)).transpose()?;
    let further = further.as_ref();
    let Smooth { curves, moved_mm } = curve::curves(path, &rounding);
    if curves.is_empty() {
        let remedy = "give a path that moves, or schedule rests with `planish schedule position`";
        return Err(Invalid::whole("point_mm", "has no segment with a length", remedy).into());
    }
    let (mesh, widened) = first_mesh(&curves, path, tif, spacing_mm, settings)?;
    if let Some(further) = further {
        check_further(further, &curves, &mesh, limits)?;
    }
    // No node is added if the first nodes are already as many as can be afforded.
    let refinements = if widened.is_some() { 0 } else { settings.refinements };
    let most_work = settings.node_spacing_mm.map_or(MOST_WORK, |_| f64::INFINITY);
    let constant = tif.without_time();
    let simulation = SimulationPlan::new(&constant, desired.grid(), SimulationSettings::Gridded)?;
    let slower = average.map_or(Ok(limits.clone()), |a| a.limits(limits))?;
    let meshes = Meshes { first: mesh, refinements, most_work };
    let task = {
        let curves = &curves;
        let limits = &slower;
        let simulation = &simulation;
        Task { desired, tif, path, curves, limits, further, average, simulation }
    };
    let (solved, rates_of_time) = task.solved(&meshes, settings)?;
    let Solved { mesh, nodes_of_meshes, outcome } = solved;
    let MeshOutcome { solution, motion, refused, .. } = outcome;
    let (trajectory, refused, slowed_by) = as_run(&task, &motion.trajectory, refused, limits)?;
    let axes = further.map(|f| axes::report(&trajectory, &motion.trajectory, limits, f));
    let removal = if matches!(constant, Cow::Owned(_)) {
        let of_run = SimulationPlan::new(tif, desired.grid(), SimulationSettings::Gridded)?;
        of_run.predict(&trajectory, desired)?.removal
    } else {
        simulation.predict(&trajectory, desired)?.removal
    };
    let dwell = DwellTime::new(trajectory.served_s(path.len(), |_| true)?)?;
    let report = JointReport {
        curves: curves.len(),
        points_moved_mm: moved_mm,
        corners: curves.iter().flat_map(Curve::corners).count(),
        corner_deviation_mm: curves.iter().map(Curve::deviation_mm).fold(0.0, f64::max),
        least_radius_mm: least_radius_mm(&curves),
        length_mm: curves.iter().map(Curve::length_mm).sum(),
        nodes: mesh.nodes,
        nodes_of_meshes,
        node_spacing_mm: mesh.spans.iter().map(|s| s.length_mm()).fold(0.0, f64::max),
        widened,
        price_nm2_per_s: outcome.price,
        end: solution.end,
        proven: proven_gap(solution.relative_gap, average.is_some()),
        tikhonov: outcome.tikhonov,
        pull_part: outcome.pull_part,
        iterations: outcome.iterations,
        objective_nm2: solution.objective,
        model_rms_nm: outcome.model_rms_nm,
        fit_error_mm: motion.fit_error_mm,
        average: average.map(Averaged::from),
        rounds: outcome.rounds,
        axes: axes.unwrap_or_default(),
        slowed_by,
        tif_lattice: lattice.if_anew(),
        rates_of_time,
    };
    Ok(JointPlan { dwell, trajectory, removal, refused, report })
}

/// Returns the motion of a plan as the machine runs it: averaged in time, and within the limits of the further axes.
/// The second value is the reason why it is refused, the third the factor on all times; `None` if there is none.
fn as_run(
    task: &Task<'_>,
    planned: &Trajectory,
    refused: Option<String>,
    limits: &Limits,
) -> Result<(Trajectory, Option<String>, Option<f64>), Invalid> {
    let (trajectory, refused) = match task.averaged(planned)? {
        None => (planned.clone(), refused),
        Some(trajectory) => {
            let verdict = verify(&trajectory, limits, &VerifySettings::default())?;
            (trajectory, verdict.reason())
        }
    };
    match task.further {
        None => Ok((trajectory, refused, None)),
        Some(further) => within_axes(trajectory, refused, limits, further),
    }
}

/// Returns a motion that keeps the limits of the further axes: the same one, or one with all times longer. A motion
/// whose ratio to a limit (as a factor on accelerations) is above [`HOPELESS`] is returned as it is, and refused. The
/// second value is the reason why the motion is refused, the third the factor on all times; `None` if there is none.
fn within_axes(
    trajectory: Trajectory,
    refused: Option<String>,
    limits: &Limits,
    further: &Further<'_>,
) -> Result<(Trajectory, Option<String>, Option<f64>), Invalid> {
    let factor = further.slower_by(&trajectory);
    if factor * factor > HOPELESS {
        let refused = refused.or(further.reason(&trajectory));
        return Ok((trajectory, refused, None));
    }
    if factor == 1.0 {
        return Ok((trajectory, refused, None));
    }
    let trajectory = axes::slowed(&trajectory, factor)?;
    let refused = verify(&trajectory, limits, &VerifySettings::default())?.reason();
    Ok((trajectory, refused, Some(factor)))
}

/// Returns the first mesh, and the widened spacing if that is larger than `spacing_mm` to save work. A spacing in the
/// settings is taken as it is; the default one also shrinks where there is little work.
fn first_mesh(
    curves: &[Curve],
    path: &ToolPath,
    tif: &Tif,
    spacing_mm: f64,
    settings: &JointSettings,
) -> Result<(Mesh, Option<Widened>), Invalid> {
    if settings.node_spacing_mm.is_some() {
        return Ok((Mesh::new(curves, path, spacing_mm)?, None));
    }
    let [closest_mm, widest_mm] =
        [CLOSEST_SPACING_OVER_TIF_WIDTH, WIDEST_SPACING_OVER_TIF_WIDTH].map(|w| w * tif.width_mm());
    let (mesh, taken_mm) = affordable(curves, path, tif, [spacing_mm, widest_mm], MOST_WORK)?;
    let mesh = closer(curves, path, tif, (mesh, taken_mm), closest_mm)?;
    let widened = Widened { from_mm: spacing_mm, to_mm: taken_mm };
    Ok((mesh, if taken_mm > spacing_mm { Some(widened) } else { None }))
}

/// Largest ratio of the dwell-time density that the velocity limit of a further axis demands to the inverse of the
/// smaller velocity limit of x and y. Larger: a plan that stands still near the centre of a spindle. Smaller: paths
/// that pass near it are refused. Chosen: a tool that takes ten thousand times as long over a point removes far too
/// much there.
const MOST_SLOWED: f64 = 1e4;

/// Number of parts of every span at whose ends [`check_further`] evaluates the axes. Larger: more time. Smaller: paths
/// are refused that the rows of [`crate::limits`] could resolve. Chosen: that of their halvings.
const CHECKED_PARTS: usize = 32;

/// Largest change of the first derivative of an axis between two points of [`check_further`] that its second
/// derivatives there do not explain. It is a fraction of the first derivative. Larger: the plan may miss a limit there.
/// Smaller: steep axes are refused. Chosen: where an axis is resolved it is some percent, and 2 where the tool passes
/// the centre of a spindle.
const MOST_UNSHOWN: f64 = 0.5;

/// Refuses a path on which a further axis has no position, allows nearly no feedrate, or turns within a part of a span.
fn check_further(
    further: &Further<'_>,
    curves: &[Curve],
    mesh: &Mesh,
    limits: &Limits,
) -> Result<(), Invalid> {
    let slowest = limits.max_velocity_mm_per_s().into_iter().fold(f64::INFINITY, f64::min);
    let most_mm_per_s2 = limits.max_acceleration_mm_per_s2().into_iter().fold(0.0, f64::max);
    for span in &mesh.spans {
        let mut before: Option<Vec<Scaled>> = None;
        let part_mm = span.length_mm() / CHECKED_PARTS as f64;
        for k in 0..=CHECKED_PARTS {
            let s_mm = span.from_mm + part_mm * k as f64;
            let there = curves[span.curve].station(s_mm);
            let [x, y] = there.point_mm;
            let Some(scaled) = further.scaled(&there) else {
                let problem = format!(
                    "passes ({x:.4}, {y:.4}) mm, where an axis of the machine has no position or no derivative"
                );
                let remedy =
                    "let the path keep away from there, or give a form that covers all of it";
                return Err(Invalid::whole("point_mm", problem, remedy));
            };
            for (axis, name) in scaled.iter().zip(further.names()) {
                let allowed = 1.0 / axis.need_s_per_mm;
                if allowed * MOST_SLOWED < slowest {
                    let problem = format!(
                        "passes ({x:.4}, {y:.4}) mm, where the velocity of the axis {name} allows {allowed:.2e} mm/s"
                    );
                    let remedy = "let the path keep away from there, or let this axis turn faster";
                    return Err(Invalid::whole("point_mm", problem, remedy));
                }
            }
            for ((a, b), name) in before.iter().flatten().zip(&scaled).zip(further.names()) {
                let shown = 0.5 * part_mm * (a.across + b.across);
                let unshown = (b.along - a.along - shown).abs();
                let derivative = a.along.abs().max(b.along.abs());
                if unshown > MOST_UNSHOWN * derivative && unshown * most_mm_per_s2 > 1.0 {
                    let problem = format!(
                        "passes ({x:.4}, {y:.4}) mm, where the axis {name} turns within {part_mm:.1e} mm"
                    );
                    let remedy = "let the path keep away from there";
                    return Err(Invalid::whole("point_mm", problem, remedy));
                }
            }
            before = Some(scaled);
        }
    }
    Ok(())
}

/// Returns the least radius of curvature of the curves, mm; `None` if all are straight.
fn least_radius_mm(curves: &[Curve]) -> Option<f64> {
    let most = curves.iter().map(Curve::most_curvature_per_mm).fold(0.0, f64::max);
    if most > 0.0 { Some(1.0 / most) } else { None }
}

/// Returns the limits on the rounding of corners, and the spacing of the nodes (mm), for the width and the spread of
/// the TIF. Refuses a spacing that is far below the width.
fn scales(
    tif_width_mm: f64,
    tif_spread_mm: f64,
    settings: &JointSettings,
) -> Result<(Rounding, f64), Invalid> {
    let node_width_mm = tif_width_mm.max(LEAST_WIDTH_OVER_SPREAD * tif_spread_mm);
    let spacing_mm = settings.node_spacing_mm.unwrap_or(SPACING_OVER_TIF_WIDTH * node_width_mm);
    if spacing_mm < LEAST_SPACING_OVER_TIF_WIDTH * tif_width_mm {
        let problem = format!("is {spacing_mm:?} mm, the TIF is {tif_width_mm:.6} mm wide");
        let remedy = "a tool does not see what is narrower than itself; give mm";
        return Err(Invalid::whole("node_spacing_mm", problem, remedy));
    }
    let rounding = Rounding {
        deviation_mm: settings
            .corner_deviation_mm
            .unwrap_or(DEVIATION_OVER_TIF_WIDTH * tif_width_mm),
        radius_mm: settings.corner_radius_mm.unwrap_or(RADIUS_OVER_TIF_WIDTH * tif_width_mm),
    };
    Ok((rounding, spacing_mm))
}

/// Returns the mesh with nodes `spacing_mm[0]` apart, and its spacing. The spacing grows up to `spacing_mm[1]` while a
/// factorisation would need more than `most_work` multiplications.
fn affordable(
    curves: &[Curve],
    path: &ToolPath,
    tif: &Tif,
    [mut spacing_mm, widest_mm]: [f64; 2],
    most_work: f64,
) -> Result<(Mesh, f64), Invalid> {
    loop {
        let mesh = Mesh::new(curves, path, spacing_mm)?;
        if spacing_mm >= widest_mm || mesh.work(tif) <= most_work {
            return Ok((mesh, spacing_mm));
        }
        spacing_mm = (WIDENED_BY * spacing_mm).min(widest_mm);
    }
}

/// Returns the mesh, or one with nodes closer than `spacing_mm`, down to `closest_mm`, as long as its factorisation
/// needs at most [`LITTLE_WORK`].
fn closer(
    curves: &[Curve],
    path: &ToolPath,
    tif: &Tif,
    (mut mesh, mut spacing_mm): (Mesh, f64),
    closest_mm: f64,
) -> Result<Mesh, Invalid> {
    while spacing_mm > closest_mm {
        spacing_mm = (spacing_mm / WIDENED_BY).max(closest_mm);
        let finer = Mesh::new(curves, path, spacing_mm)?;
        if finer.work(tif) > LITTLE_WORK {
            break;
        }
        mesh = finer;
    }
    Ok(mesh)
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::Array2;
    use planish_types::{Axis, Grid};

    #[test]
    fn nodes_are_further_apart_where_as_many_would_take_too_long() {
        let own = Axis::new(-2.0, 0.5, 9).unwrap();
        let tif = Tif::new(Grid { x: own, y: own }, Array2::ones((9, 9))).unwrap();
        // Ten lines of 30 mm, 1 mm apart.
        let ends = (0..10).flat_map(|i| {
            let (y, there) = (f64::from(i), [0.0, 30.0]);
            let [from, to] = if i % 2 == 0 { there } else { [there[1], there[0]] };
            [[from, y], [to, y]]
        });
        let points: Vec<[f64; 2]> = ends.collect();
        let path = ToolPath::through(points, vec![true; 19], vec![0; 19]).unwrap();
        let rounding = Rounding { deviation_mm: 0.1, radius_mm: 0.3 };
        let curves = curve::curves(&path, &rounding).curves;
        let work = |spacing_mm: f64| Mesh::new(&curves, &path, spacing_mm).unwrap().work(&tif);
        // Along x ten lines of nodes are within 4 mm of each other, along y five with 30 mm each: the former is less,
        // and it is the cube of the density of the nodes but for those of the corners.
        let nodes = Mesh::new(&curves, &path, 0.25).unwrap().nodes as f64;
        let expected = nodes * (nodes * 4.0 / 30.0).powi(2);
        assert!((work(0.25) / expected - 1.0).abs() < 0.15, "{} {expected}", work(0.25));
        let taken =
            |most_work: f64| affordable(&curves, &path, &tif, [0.25, 0.8], most_work).unwrap();
        assert_eq!(taken(work(0.25)).1, 0.25);
        let (mesh, spacing_mm) = taken(work(0.25) / 8.0);
        // An eighth of the work is twice the spacing, 0.5 mm, but for the nodes of the corners.
        assert!((0.4..0.75).contains(&spacing_mm), "{spacing_mm}");
        assert!(mesh.work(&tif) <= work(0.25) / 8.0);
        assert_eq!(taken(1.0).1, 0.8);
        // So little work is no reason for nodes as far apart: they are closer, down to the closest or to little work.
        let closer = |closest_mm: f64| {
            let mesh = Mesh::new(&curves, &path, 0.25).unwrap();
            closer(&curves, &path, &tif, (mesh, 0.25), closest_mm).unwrap()
        };
        assert!(work(0.25) < LITTLE_WORK / 2.0);
        assert_eq!(closer(0.24).nodes, Mesh::new(&curves, &path, 0.24).unwrap().nodes);
        let closest = closer(0.01);
        assert!(closest.nodes as f64 > nodes);
        let work = closest.work(&tif);
        // The next spacing, a tenth less, would take up to WIDENED_BY^3 times the work.
        assert!((LITTLE_WORK / 1.4..=LITTLE_WORK).contains(&work), "{work}");
    }
}
