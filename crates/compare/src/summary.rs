//! Numbers of a run, method by method. A method is one way to a plan, with the plan that it made and its results.
//!
//! ```text
//! RMS       = sqrt(mean((e - mean e)^2))        over the valid pixels of the residual e
//! detilted  = RMS of e - plane(e)               least-squares plane
//! PV        = max e - min e
//! slope     = (e(x + base) - e(x)) / base       RMS without the mean, along x and along y
//! ```
//!
//! The keys of these structures are those of `summary.json`, which other programs read.
//!
//! | symbol | variable | shape | unit |
//! |---|---|---|---|
//! | e | `residual` | (ny, nx) | nm |

use planish_numerics::{
    slope::{Along, slopes, steps_of_base},
    statistics::statistics,
};
use planish_types::{
    DwellTime, Invalid, Part, Removal, Surface, Trajectory,
    outcome::{
        bound::PathFreeBounds,
        specification::SpecificationReport,
        verdict::{AxisVerdict, Check, Verdict},
    },
    reach::{Reach, ReachReport},
    text::significant,
};
use serde::{Serialize, Serializer};

use crate::{
    chain::Standing,
    error_budget::ErrorBudget,
    execution::Execution,
    low_order::{LowOrderTerms, low_order_terms},
    on_axes::OnAxes,
    places::{Division, DivisionReport, Places, ZoneRms},
    plan::{PROGRAM, PlanStatus, State, WITHOUT_MOTION},
    recommended::{Candidate, recommended},
    several::Several,
    specification::Around,
    tool_numbers::ToolNumbers,
};

/// Order of the methods in tables; others follow by name. A refined method follows its base.
const ORDER: [&str; 9] = [
    WITHOUT_MOTION,
    "average-velocity",
    "constant-acceleration",
    "stop-at-corners",
    "pvt",
    "pvt-as-published",
    "trig-spline",
    "bspline",
    "joint",
];

/// Largest difference between the coordinates of two maps that counts as none, in pixels. Larger: maps of different
/// pixels are taken for the same. Smaller: axes that passed through text are refused. Chosen between the two.
const SAME_PIXEL: f64 = 1e-4;

/// Largest error of `residual = desired - removal` that counts as rounding, relative to the largest of the three.
/// Larger: a removal of another surface is accepted. Smaller: maps that passed through 32-bit floats (6e-8) are
/// refused. Chosen far above that rounding, and far below any residual of interest.
const SAME_HEIGHT: f64 = 1e-6;

/// Largest difference between a planned dwell time and its time in the motion that goes without a remark, s. Only plans
/// with proven dwell times get the remark. Larger: real departures are not mentioned. Smaller: rounding gets a remark.
/// Chosen: the change that a dwell solver takes for none.
const SAME_DWELL_S: f64 = 1e-6;

/// Base length of the slopes, mm; the nearest whole number of pixels is taken. Larger: slopes of longer waves only.
/// Smaller: more noise in the slopes. Chosen: the length with which mirrors are specified.
const SLOPE_BASE_MM: f64 = 1.0;

/// Largest relative difference between two durations that counts as none. Larger: different motions are taken for
/// one. Smaller: rounding is refused. Chosen far above the rounding of a sum of segments.
const SAME_TIME: f64 = 1e-9;

/// Summary of one run: its surface, and the result of each method.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Summary {
    /// Name of the pipeline.
    pub pipeline: String,
    /// Name of the mirror.
    pub fixture: String,
    /// Statements of the user about the part.
    pub part: Part,
    /// Rate, widths and volume rate of the tool; `null` if it is not known, or varies over the part.
    pub tool: Option<ToolNumbers>,
    /// RMS, PV and slopes of the desired removal, before the run.
    pub initial: Initial,
    /// Base length of the slopes along [x, y], mm; `null` along an axis that is shorter than the base.
    pub slope_base_mm: [Option<f64>; 2],
    /// Waves that the tool can correct; `null` if the tool is not known, or the map has no spectrum.
    pub reach: Option<ReachReport>,
    /// Division of the mirror into zones and regions, by which residual and time are reported.
    pub division: DivisionReport,
    /// Verdicts by the specification on the maps that belong to no method.
    pub specification: Around,
    /// Effect of the errors of a process on one of the plans; `null` if there is no such prediction.
    pub error_budget: Option<ErrorBudget>,
    /// Residual of the dwell times at the dwell points, without a motion; `null` if the run has no such method.
    pub without_motion: Option<WithoutMotion>,
    /// Residuals that no path and no motion of the tool can beat; absent if the run has no bound.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub bound: Option<PathFreeBounds>,
    /// Names of the methods (schedulers or solvers) with their results.
    #[serde(serialize_with = "as_map")]
    pub methods: Vec<(String, MethodResult)>,
    /// Methods that take no part in the comparison.
    pub left_out: Vec<LeftOut>,
    /// Sentences on shared artifacts that are out of date, on verdicts and predictions that were left out because they
    /// are about another map or motion, and on a machine that was assumed.
    pub remarks: Vec<String>,
    /// Name of the method that is recommended; `null` if there is none.
    pub best: Option<String>,
    /// Plan of several tools, of which the methods are the tools in the order in which they run; absent for any other.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub several: Option<Several>,
}

impl Summary {
    /// Returns the names of the mirror and the pipeline. If the mirror has no name, it returns `run`, that of the
    /// run.
    pub fn part_and_pipeline(&self, run: &str) -> Vec<String> {
        let part = if self.fixture.is_empty() { run } else { &self.fixture };
        let mut names = vec![part.to_string(), self.pipeline.clone()];
        names.dedup();
        names
    }
}

/// A method that is left out of the comparison: its artifacts do not belong together or to this run, some are missing,
/// or its stage refused to make a plan.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct LeftOut {
    /// Name of the method.
    pub name: String,
    /// Validity of the method: `not-valid`, `out-of-date` or `refused`.
    pub standing: Standing,
    /// Reasons why the method takes no part in the comparison, as sentences.
    pub reasons: Vec<String>,
}

/// Statistics of the desired removal before the run: RMS, peak-to-valley, slopes, and the RMS of its short waves and of
/// its edge zone.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Initial {
    /// RMS of the desired removal, mean removed, nm.
    pub rms_nm: f64,
    /// Largest minus smallest desired removal, nm.
    pub pv_nm: f64,
    /// RMS slope along [x, y], mean removed, nrad; `null` along an axis that is shorter than the base of the slopes.
    pub slope_rms_nrad: [Option<f64>; 2],
    /// RMS of the waves that are too short for the tool to correct, nm; `null` if the tool is not known, or the map has
    /// no rectangle large enough for a spectrum.
    pub short_wave_rms_nm: Option<f64>,
    /// RMS of the desired removal in the edge zone and inside of it, about the mean of the whole map.
    pub zone_rms: ZoneRms,
    /// Low-order terms of the desired removal; `null` if its valid pixels do not determine them.
    pub low_order: Option<LowOrderTerms>,
}

/// Result of the dwell times applied at the dwell points, without a motion between them.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct WithoutMotion {
    /// RMS of the residual, mean removed, nm.
    pub rms_nm: f64,
    /// Sum of the dwell times, s.
    pub total_time_s: f64,
}

/// Result of one method of a run.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct MethodResult {
    /// RMS of the residual, mean removed, nm.
    pub rms_nm: f64,
    /// Largest minus smallest residual, nm.
    pub pv_nm: f64,
    /// RMS of the residual, plane removed, nm.
    pub rms_detilted_nm: f64,
    /// RMS slope of the residual along [x, y], mean removed, nrad; `null` along an axis that is shorter than the base
    /// of the slopes.
    pub slope_rms_nrad: [Option<f64>; 2],
    /// RMS of the waves of the residual that are too short for the tool to correct, nm. `null` if the tool is not known
    /// or not that of the prediction, or if the map has no rectangle large enough for a spectrum.
    pub short_wave_rms_nm: Option<f64>,
    /// Low-order terms of the residual; `null` if its valid pixels do not determine them.
    pub low_order: Option<LowOrderTerms>,
    /// Duration of the motion, s.
    pub total_time_s: f64,
    /// Largest magnitude of the velocity along [x, y], mm/s.
    pub max_velocity_mm_per_s: [f64; 2],
    /// Largest magnitude of the acceleration inside segments along [x, y], mm/s^2.
    pub max_acceleration_mm_per_s2: [f64; 2],
    /// Largest step in velocity along [x, y] between two segments, mm/s.
    pub max_velocity_step_mm_per_s: [f64; 2],
    /// Largest step in acceleration along [x, y] between two segments, mm/s^2.
    pub max_acceleration_step_mm_per_s2: [f64; 2],
    /// True if the verdict found every limit of the machine kept.
    pub limits_respected: bool,
    /// Names of the limits that the verdict found broken: `path`, `travel`, `velocity`, `acceleration`, `jerk`, or
    /// `jumps`. Empty if all are kept, or if the verdict does not say.
    pub broken_limits: Vec<&'static str>,
    /// RMS of the residual after the servo of the machine, mean removed, nm; `null` if the process has no servo, or
    /// it was not asked for.
    pub after_servo_rms_nm: Option<f64>,
    /// Name of the machine that the verdict is about; `null` if its manifest does not say.
    pub machine: Option<String>,
    /// Wall time of the scheduler, s; `null` if it was not measured.
    pub schedule_wall_s: Option<f64>,
    /// Wall time of the simulation, s; `null` if it was not measured.
    pub simulate_wall_s: Option<f64>,
    /// Deviations of the motion from the plan: dwell times, overshoot, jerk.
    pub execution: Execution,
    /// Residual and time by position on the part: worst points, edge zone, regions.
    pub places: Places,
    /// State of the plan: whether its optimality is proven, or the method converged at all (see [`crate::plan`]).
    pub plan: PlanStatus,
    /// Verdict on the residual by a specification; `null` if there is none, or if it is about another map or by another
    /// specification than the other verdicts of the run.
    pub specification: Option<SpecificationReport>,
    /// Result of the plan when all axes of the machine run it; absent if the run has no such motion.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub on_axes: Option<OnAxes>,
    /// Further remarks on the method, as sentences.
    pub remarks: Vec<String>,
}

/// Returns the checks of an axis in a verdict, each with the name of the limit that it belongs to. A step in velocity
/// is an infinite acceleration, and a step in acceleration an infinite jerk.
fn checks_and_limits(axis: &AxisVerdict) -> [(&Check, &'static str); 7] {
    [
        (&axis.position_step_mm, "jumps"),
        (&axis.position_mm, "travel"),
        (&axis.velocity_mm_per_s, "velocity"),
        (&axis.velocity_step_mm_per_s, "acceleration"),
        (&axis.acceleration_mm_per_s2, "acceleration"),
        (&axis.acceleration_step_mm_per_s2, "jerk"),
        (&axis.jerk_mm_per_s3, "jerk"),
    ]
}

/// Returns the names of the limits that a verdict found broken, each once; empty if the verdict does not say.
fn broken_limits(verdict: &Verdict) -> Vec<&'static str> {
    let mut broken = Vec::new();
    if verdict.path_distance.is_some_and(|distance| !distance.within) {
        broken.push("path");
    }
    let [x, y] = verdict.axes.each_ref().map(checks_and_limits);
    for ((x, limit), (y, _)) in x.into_iter().zip(y) {
        if (x.exceeded || y.exceeded) && !broken.contains(&limit) {
            broken.push(limit);
        }
    }
    broken
}

/// Wall times of two stages of a method, scheduler and simulation.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct WallTimes {
    /// Wall time of the scheduler, s; `None` if it was not measured.
    pub schedule_s: Option<f64>,
    /// Wall time of the simulation, s; `None` if it was not measured.
    pub simulate_s: Option<f64>,
}

/// Data of a method other than its arrays and its verdict.
#[derive(Clone, Debug)]
pub struct MethodFacts {
    /// Times that the stages of the method took.
    pub wall: WallTimes,
    /// Name of the machine that the verdict is about; `None` if it is not known.
    pub machine: Option<String>,
    /// State of the plan: whether its optimality is proven, or the method converged at all (see [`crate::plan`]).
    pub plan: PlanStatus,
    /// RMS of the waves of the residual that are too short for the tool to correct, nm. `None` if the tool is not known
    /// or not that of the prediction, or if the map has no rectangle large enough for a spectrum.
    pub short_wave_rms_nm: Option<f64>,
    /// Verdict on the residual by a specification; `None` if there is none that counts.
    pub specification: Option<SpecificationReport>,
    /// RMS of the residual after the servo of the machine, nm; `None` if the process has no servo, or it was not asked
    /// for.
    pub after_servo_rms_nm: Option<f64>,
    /// Result when all axes of the machine run the plan; `None` if the run has no such motion.
    pub on_axes: Option<OnAxes>,
    /// Further remarks on the method, as sentences.
    pub remarks: Vec<String>,
}

impl MethodResult {
    /// Returns the RMS by which plans are compared, nm. It is that after the servo if the process has one, otherwise
    /// that on all axes of the machine if they run the plan, otherwise that of the residual.
    pub(crate) fn compared_rms_nm(&self) -> f64 {
        let on_axes = self.on_axes.as_ref().map_or(self.rms_nm, |o| o.rms_nm);
        self.after_servo_rms_nm.unwrap_or(on_axes)
    }

    /// Returns true if the report may recommend the method. It must be a motion that keeps the limits, also on all
    /// axes if they run it, and no baseline.
    pub(crate) fn is_candidate(&self) -> bool {
        let shown_only = matches!(self.plan.state, State::WithoutMotion | State::Baseline);
        self.keeps_all_limits() && !shown_only
    }

    /// Returns true if the motion keeps the limits, also on all axes if they run it.
    pub(crate) fn keeps_all_limits(&self) -> bool {
        self.limits_respected && self.on_axes.as_ref().is_none_or(|o| o.limits_respected)
    }

    /// Returns the numbers of the method by which a plan is chosen: RMS, time, and whether it keeps the
    /// specification.
    pub(crate) fn candidate(&self) -> Candidate {
        let judged = self.specification.as_ref();
        Candidate {
            rms_nm: self.compared_rms_nm(),
            total_time_s: self.on_axes.as_ref().map_or(self.total_time_s, |o| o.total_time_s),
            keeps_specification: judged.is_none_or(|judged| judged.passed),
        }
    }

    /// Computes the numbers of one method. `dwell` are the planned dwell times; `None` if they are not known.
    ///
    /// # Errors
    /// Refuses a removal whose pixels or heights do not belong to `desired`, a verdict on a motion of another duration,
    /// and, if `dwell` is known, a motion that names a dwell point which `dwell` does not have.
    pub fn new(
        desired: &Surface,
        division: &Division,
        removal: &Removal,
        trajectory: &Trajectory,
        dwell: Option<&DwellTime>,
        verdict: &Verdict,
        facts: MethodFacts,
    ) -> Result<Self, Invalid> {
        let MethodFacts {
            wall,
            machine,
            plan,
            short_wave_rms_nm,
            specification,
            after_servo_rms_nm,
            on_axes,
            mut remarks,
        } = facts;
        check_same_surface(desired, removal)?;
        let total_time_s = trajectory.total_time_s();
        if (verdict.total_time_s - total_time_s).abs() > SAME_TIME * total_time_s {
            return Err(Invalid::whole(
                "verdict",
                format!(
                    "is about {} s of motion, the trajectory takes {total_time_s} s",
                    verdict.total_time_s
                ),
                "verify this trajectory",
            ));
        }
        let execution = Execution::new(trajectory, dwell)?;
        let departure_s = execution.dwell_error_worst_s.map_or(0.0, f64::abs);
        if plan.state == State::DwellOptimal && departure_s > SAME_DWELL_S {
            remarks.push(format!(
                "the proof is about the planned dwell times; the motion departs from one of them by {} s",
                significant(departure_s, 4)
            ));
        }
        if let Some(rms_nm) = after_servo_rms_nm {
            let rms_nm = significant(rms_nm, 4);
            remarks.push(format!("after the servo of the process it leaves {rms_nm} nm RMS"));
        }
        let residual = removal.residual();
        let statistics = residual.statistics();
        Ok(Self {
            rms_nm: statistics.rms,
            pv_nm: statistics.pv,
            rms_detilted_nm: residual.detilted_rms_nm(),
            slope_rms_nrad: slope_rms_nrad(residual),
            short_wave_rms_nm,
            low_order: low_order_terms(residual),
            total_time_s,
            max_velocity_mm_per_s: verdict.max_velocity_mm_per_s,
            max_acceleration_mm_per_s2: verdict.max_acceleration_mm_per_s2,
            max_velocity_step_mm_per_s: verdict.max_velocity_step_mm_per_s,
            max_acceleration_step_mm_per_s2: verdict.max_acceleration_step_mm_per_s2,
            limits_respected: verdict.limits_respected,
            broken_limits: broken_limits(verdict),
            after_servo_rms_nm,
            machine,
            schedule_wall_s: wall.schedule_s,
            simulate_wall_s: wall.simulate_s,
            execution,
            places: division.places(residual, trajectory),
            plan,
            specification,
            on_axes,
            remarks,
        })
    }
}

/// Returns the base of the slopes along x and y, as a number of pixels and its length, mm; `None` along an axis that is
/// shorter. The base is [`SLOPE_BASE_MM`], rounded to whole pixels of `surface`.
fn slope_base(surface: &Surface) -> [Option<(usize, f64)>; 2] {
    let grid = surface.grid();
    [&grid.x, &grid.y].map(|axis| {
        let steps = steps_of_base(SLOPE_BASE_MM, axis.step_mm(), axis.len())?;
        Some((steps, steps as f64 * axis.step_mm()))
    })
}

/// Returns the RMS slope along x and y, mean removed, nrad; `None` along an axis that is shorter than the base of the
/// slopes.
fn slope_rms_nrad(surface: &Surface) -> [Option<f64>; 2] {
    let grid = surface.grid();
    let [x, y] = slope_base(surface);
    [(x, &grid.x, Along::X), (y, &grid.y, Along::Y)].map(|(base, axis, along)| {
        let values = slopes(surface.height_nm().view(), &axis.coordinates(), along, base?.0);
        // nm/mm is urad.
        Some(1e3 * statistics(values.view())?.rms)
    })
}

impl Summary {
    /// Collects the numbers of a run, sorts the methods (by `ORDER`), and chooses the recommended one. A controller
    /// program that was read back gets the state of the plan from which it was written. `fixture` is the name of the
    /// mirror.
    pub fn new(
        pipeline: impl Into<String>,
        fixture: impl Into<String>,
        desired: &Surface,
        division: &Division,
        mut methods: Vec<(String, MethodResult)>,
        left_out: Vec<LeftOut>,
        remarks: Vec<String>,
    ) -> Self {
        // A controller's program is as good as the plan that it was written from.
        let plans: Vec<(String, PlanStatus)> =
            methods.iter().map(|(name, m)| (name.clone(), m.plan.clone())).collect();
        for (name, method) in methods.iter_mut().filter(|(_, m)| m.plan.word == PROGRAM) {
            let base_name = name.rsplit_once('+').map(|(base, _)| base);
            if let Some((base, plan)) = plans.iter().find(|(n, _)| Some(n.as_str()) == base_name) {
                // The proof is about the plan; the word says whose motion this is.
                let text = format!("of {base}, {}: {}", plan.word, plan.text);
                method.plan = PlanStatus { word: PROGRAM.into(), text, ..plan.clone() };
            }
        }
        methods.sort_by_cached_key(|(name, _)| {
            let base = name.split('+').next().unwrap_or_default();
            let rank = ORDER.iter().position(|o| *o == base).unwrap_or(ORDER.len());
            (rank, name.clone())
        });
        let without_motion = methods
            .iter()
            .find(|(name, _)| name == WITHOUT_MOTION)
            .map(|(_, m)| WithoutMotion { rms_nm: m.rms_nm, total_time_s: m.total_time_s });
        let statistics = desired.statistics();
        let candidates: Vec<(&str, Candidate)> = methods
            .iter()
            .filter(|(_, m)| m.is_candidate())
            .map(|(name, m)| (name.as_str(), m.candidate()))
            .collect();
        let best = recommended(&candidates).map(String::from);
        Self {
            pipeline: pipeline.into(),
            fixture: fixture.into(),
            part: Part::default(),
            tool: None,
            initial: Initial {
                rms_nm: statistics.rms,
                pv_nm: statistics.pv,
                slope_rms_nrad: slope_rms_nrad(desired),
                short_wave_rms_nm: None,
                zone_rms: division.zone_rms(desired),
                low_order: low_order_terms(desired),
            },
            slope_base_mm: slope_base(desired).map(|base| base.map(|(_, mm)| mm)),
            reach: None,
            division: division.report(),
            specification: Around::default(),
            error_budget: None,
            without_motion,
            bound: None,
            methods,
            left_out,
            remarks,
            best,
            several: None,
        }
    }

    /// Returns the summary with the waves that the tool can correct (`reach`), the RMS of `desired` beyond them, and
    /// the verdicts by the specification (`around`) added.
    pub fn with(self, desired: &Surface, reach: Option<&Reach>, around: Around) -> Self {
        let short_wave_rms_nm = reach.map(|reach| reach.short_wave_rms_nm(desired));
        Self {
            initial: Initial { short_wave_rms_nm, ..self.initial },
            reach: reach.map(Reach::report),
            specification: around,
            ..self
        }
    }

    /// Recommends the method `name`, a controller program that was read back, because that motion will run. If it may
    /// not be recommended (see `is_candidate`), for example because it breaks a limit, no method is recommended.
    ///
    /// # Errors
    /// Refuses a method that the summary does not have, with the names of those that it has.
    pub(crate) fn recommend(&mut self, name: &str) -> Result<(), String> {
        let Some((_, method)) = self.methods.iter().find(|(row, _)| row == name) else {
            let rows: Vec<&str> = self.methods.iter().map(|(row, _)| row.as_str()).collect();
            return Err(format!("there is no row {name}; the rows are {}", rows.join(", ")));
        };
        self.best = if method.is_candidate() { Some(name.into()) } else { None };
        Ok(())
    }

    /// Returns true if the method is to be run: the recommended one, or any tool of a plan of several that is.
    pub(crate) fn is_to_be_run(&self, name: &str) -> bool {
        match &self.best {
            Some(best) => best == name || self.several.is_some(),
            None => false,
        }
    }

    /// Returns the reason why a run has no plan to recommend, for a run whose plans are all unfit.
    pub(crate) fn why_no_plan(&self) -> &'static str {
        let mut methods = self.methods.iter().map(|(_, m)| m);
        if methods.any(|m| m.limits_respected && m.plan.state == State::Baseline) {
            "only baselines keep the limits of the machine, and a baseline is not recommended"
        } else {
            "no method keeps the limits of the machine"
        }
    }

    /// Returns the reasons why the run has no plan that can be recommended without reserve; empty if it has one.
    /// Reasons are methods that are not valid, no recommended plan, or a recommended plan that did not converge.
    fn reserves(&self) -> Vec<String> {
        let mut reasons = Vec::new();
        for m in self.left_out.iter().filter(|m| m.standing == Standing::NotValid) {
            reasons.push(format!("{} is not valid: {}", m.name, m.reasons.join("; ")));
        }
        let best = self.methods.iter().find(|(name, _)| self.best.as_ref() == Some(name));
        match best {
            None => reasons.push(self.why_no_plan().into()),
            Some((name, m)) if m.plan.state == State::Unconverged => {
                reasons.push(format!("{name} is the best, but not optimal: {}", m.plan.text));
            }
            Some(_) => {}
        }
        reasons
    }
}

/// Returns the reasons why some runs have no plan that can be recommended without reserve, each with the name of its
/// run. `None` if every run has one.
pub fn negative(runs: &[(&str, &Summary)]) -> Option<String> {
    let mut reserves = Vec::new();
    for (name, summary) in runs {
        let whose = if runs.len() > 1 { format!("{name}: ") } else { String::new() };
        reserves.extend(summary.reserves().iter().map(|reserve| format!("{whose}{reserve}")));
    }
    if reserves.is_empty() { None } else { Some(reserves.join("; ")) }
}

/// Serialises the methods as an object whose keys are their names.
fn as_map<S: Serializer>(
    methods: &[(String, MethodResult)],
    serializer: S,
) -> Result<S::Ok, S::Error> {
    serializer.collect_map(methods.iter().map(|(name, method)| (name, method)))
}

/// Refuses a removal whose pixels or heights do not belong to the surface `desired`.
fn check_same_surface(desired: &Surface, removal: &Removal) -> Result<(), Invalid> {
    let grid = desired.grid();
    let other = removal.residual().grid();
    for (name, wanted, other) in [("x_mm", &grid.x, &other.x), ("y_mm", &grid.y, &other.y)] {
        let tolerance_mm = SAME_PIXEL * wanted.step_mm();
        let same = wanted.len() == other.len()
            && (wanted.start_mm() - other.start_mm()).abs() <= tolerance_mm
            && (wanted.end_mm() - other.end_mm()).abs() <= tolerance_mm;
        if !same {
            let [other, wanted] = [other, wanted]
                .map(|a| format!("{} pixels from {} to {} mm", a.len(), a.start_mm(), a.end_mm()));
            let problem = format!("the removal has {other}, the surface {wanted}");
            return Err(Invalid::whole(name, problem, "simulate on the surface of this run"));
        }
    }
    // residual = desired - removal
    let residual = removal.residual().height_nm();
    for ((index, z), r) in residual.indexed_iter().zip(removal.removal_nm()) {
        let d = desired.height_nm()[index];
        let same = if d.is_nan() {
            z.is_nan()
        } else {
            (d - r - z).abs() <= SAME_HEIGHT * d.abs().max(r.abs()).max(z.abs())
        };
        if !same {
            let problem = format!("is {z} nm where the surface has {d} nm and the removal {r} nm");
            let remedy = "residual = desired - removal; simulate on the surface of this run";
            return Err(Invalid::at_index("residual_nm", index, problem, remedy));
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::{Array2, array};
    use planish_types::{Axis, Grid};
    use serde_json::{Value, json};

    fn grid(nx: usize, ny: usize) -> Grid {
        Grid { x: Axis::new(-1.0, 1.0, nx).unwrap(), y: Axis::new(5.0, 1.0, ny).unwrap() }
    }

    /// Returns a map of [[1, -1], [-1, 1]] nm plus a tilt of 2 nm per pixel along x and a piston of 7 nm.
    fn desired() -> Surface {
        Surface::new(grid(2, 2), array![[11.0, 11.0], [9.0, 13.0]]).unwrap()
    }

    fn removal() -> Removal {
        Removal::new(&desired(), Array2::from_elem((2, 2), 3.0)).unwrap()
    }

    fn trajectory() -> Trajectory {
        Trajectory::new(vec![0.0, 4.0], vec![[[0.0; 4]; 2]], vec![true], vec![Some(0)]).unwrap()
    }

    fn verdict_json(total_time_s: f64) -> Value {
        json!({
            "total_time_s": total_time_s, "max_velocity_mm_per_s": [1.0, 2.0],
            "max_acceleration_mm_per_s2": [3.0, 4.0], "max_velocity_step_mm_per_s": [5.0, 6.0],
            "max_acceleration_step_mm_per_s2": [7.0, 8.0], "limits_respected": true, "more": 1
        })
    }

    fn verdict(total_time_s: f64) -> Verdict {
        serde_json::from_value(verdict_json(total_time_s)).unwrap()
    }

    fn method() -> Result<MethodResult, Invalid> {
        let verdict = verdict(4.0);
        let wall = WallTimes { schedule_s: Some(0.25), simulate_s: None };
        let told = told(wall);
        MethodResult::new(&desired(), &division(), &removal(), &trajectory(), None, &verdict, told)
    }

    fn division() -> Division {
        Division::new(&desired(), None)
    }

    fn told(wall: WallTimes) -> MethodFacts {
        MethodFacts {
            wall,
            machine: Some("fast".into()),
            plan: plan(),
            short_wave_rms_nm: None,
            specification: None,
            after_servo_rms_nm: None,
            on_axes: None,
            remarks: vec![],
        }
    }

    fn plan() -> PlanStatus {
        PlanStatus { state: State::Certified, word: "certified".into(), text: "near".into() }
    }

    fn summary_of(methods: Vec<(String, MethodResult)>) -> Summary {
        Summary::new("raster", "coupon", &desired(), &division(), methods, vec![], vec![])
    }

    #[test]
    fn the_numbers_of_a_residual_that_is_known() {
        let m = method().unwrap();
        // Heights 8, 8, 6, 10 about their mean 8: squares 0, 0, 4, 4 over 4 pixels.
        assert!((m.rms_nm - 2.0_f64.sqrt()).abs() < 1e-14);
        assert_eq!(m.pv_nm, 4.0);
        // Plane 8 + (x - mean) * 2 leaves +-1 on every pixel.
        assert!((m.rms_detilted_nm - 1.0).abs() < 1e-14);
        assert_eq!(m.total_time_s, 4.0);
        // Heights [[8, 8], [6, 10]] on pixels of 1 mm: slopes 0 and 4 along x, -2 and 2 along y, nm/mm.
        assert_eq!(m.slope_rms_nrad, [Some(2000.0), Some(2000.0)]);
    }

    #[test]
    fn the_keys_are_the_interface() {
        let methods = vec![
            ("mine".to_string(), method().unwrap()),
            ("pvt+refined".to_string(), method().unwrap()),
            ("pvt".to_string(), method().unwrap()),
            ("position".to_string(), MethodResult { total_time_s: 3.5, ..method().unwrap() }),
        ];
        let summary = summary_of(methods);
        let json = json!(summary);
        let keys = |v: &Value| v.as_object().unwrap().keys().cloned().collect::<Vec<_>>();
        assert_eq!(
            keys(&json),
            [
                "pipeline",
                "fixture",
                "part",
                "tool",
                "initial",
                "slope_base_mm",
                "reach",
                "division",
                "specification",
                "error_budget",
                "without_motion",
                "methods",
                "left_out",
                "remarks",
                "best",
            ]
        );
        assert_eq!(json["slope_base_mm"], json!([1.0, 1.0]));
        assert_eq!(keys(&json["methods"]["pvt"]["plan"]), ["state", "word", "text"]);
        assert_eq!(
            keys(&json["initial"]),
            ["rms_nm", "pv_nm", "slope_rms_nrad", "short_wave_rms_nm", "zone_rms", "low_order"]
        );
        assert_eq!(keys(&json["without_motion"]), ["rms_nm", "total_time_s"]);
        assert_eq!(json["without_motion"]["total_time_s"], 3.5);
        assert_eq!(keys(&json["methods"]), ["position", "pvt", "pvt+refined", "mine"]);
        assert_eq!(
            keys(&json["methods"]["pvt"]),
            [
                "rms_nm",
                "pv_nm",
                "rms_detilted_nm",
                "slope_rms_nrad",
                "short_wave_rms_nm",
                "low_order",
                "total_time_s",
                "max_velocity_mm_per_s",
                "max_acceleration_mm_per_s2",
                "max_velocity_step_mm_per_s",
                "max_acceleration_step_mm_per_s2",
                "limits_respected",
                "broken_limits",
                "after_servo_rms_nm",
                "machine",
                "schedule_wall_s",
                "simulate_wall_s",
                "execution",
                "places",
                "plan",
                "specification",
                "remarks",
            ]
        );
        for (key, expected) in [
            ("max_velocity_mm_per_s", [1.0, 2.0]),
            ("max_acceleration_mm_per_s2", [3.0, 4.0]),
            ("max_velocity_step_mm_per_s", [5.0, 6.0]),
            ("max_acceleration_step_mm_per_s2", [7.0, 8.0]),
        ] {
            assert_eq!(json["methods"]["pvt"][key], json!(expected), "{key}");
        }
        assert_eq!(json["methods"]["pvt"]["schedule_wall_s"], 0.25);
        assert!(json["methods"]["pvt"]["simulate_wall_s"].is_null());
        assert!(json!(summary_of(vec![]))["without_motion"].is_null());
    }

    #[test]
    fn the_best_keeps_the_limits() {
        let with = |rms_nm, limits_respected| MethodResult {
            rms_nm,
            limits_respected,
            ..method().unwrap()
        };
        let methods = vec![
            ("average-velocity".to_string(), with(0.1, false)),
            ("pvt".to_string(), with(0.3, true)),
            ("constant-acceleration".to_string(), with(0.2, true)),
        ];
        let summary = summary_of(methods);
        assert_eq!(summary.best.as_deref(), Some("constant-acceleration"));
        assert!(summary.reserves().is_empty());
        // 2 % of RMS are 4 % of its square, which 8 % of time are worth; twice the square is worth four times the time.
        let timed = |rms_nm, total_time_s| MethodResult { total_time_s, ..with(rms_nm, true) };
        for (rms_nm, total_time_s, expected) in [
            (0.204, 91.0, "joint"),
            (0.204, 94.0, "pvt"),
            (0.28, 25.0, "joint"),
            (0.285, 25.0, "pvt"),
            (0.2, 99.0, "joint"),
        ] {
            let other = ("joint".to_string(), timed(rms_nm, total_time_s));
            let summary = summary_of(vec![("pvt".to_string(), timed(0.2, 100.0)), other]);
            assert_eq!(summary.best.as_deref(), Some(expected), "{rms_nm} {total_time_s}");
        }
        // A plan that keeps the specification comes before one that leaves less.
        let judged = |passed| SpecificationReport { name: "strict".into(), passed, limits: vec![] };
        let specified = |rms_nm, passed| MethodResult {
            specification: Some(judged(passed)),
            ..with(rms_nm, true)
        };
        let of = |first, second| {
            let methods = [("pvt", 0.1, first), ("joint", 0.2, second)];
            let of = |(name, rms_nm, passed): (&str, f64, bool)| {
                (name.to_string(), specified(rms_nm, passed))
            };
            summary_of(methods.map(of).to_vec()).best
        };
        assert_eq!(of(false, true).as_deref(), Some("joint"));
        assert_eq!(of(false, false).as_deref(), Some("pvt"));
        let none = summary_of(vec![("pvt".into(), with(0.1, false))]);
        assert_eq!((none.best.as_deref(), none.reserves().len()), (None, 1));
        // Dwell times without a motion are no plan, also on a path on which they happen to keep the limits.
        let state = |state| PlanStatus { state, ..plan() };
        let mut still = with(0.1, true);
        still.plan = state(State::WithoutMotion);
        let summary = summary_of(vec![("position".into(), still), ("pvt".into(), with(0.3, true))]);
        assert_eq!(summary.best.as_deref(), Some("pvt"));
        let mut baseline = with(0.1, true);
        baseline.plan = state(State::Baseline);
        let rows = [("pvt-as-published".into(), baseline.clone()), ("pvt".into(), with(0.3, true))];
        assert_eq!(summary_of(rows.to_vec()).best.as_deref(), Some("pvt"));
        let alone = summary_of(vec![("pvt-as-published".into(), baseline)]);
        assert_eq!(alone.best, None);
        assert!(alone.reserves()[0].contains("only baselines keep the limits"));
        let mut stagnated = with(0.1, true);
        stagnated.plan = state(State::Unconverged);
        let summary = summary_of(vec![("pvt".into(), stagnated)]);
        assert!(summary.reserves()[0].contains("pvt is the best, but not optimal"));
    }

    #[test]
    fn with_a_servo_the_best_is_the_one_after_it_and_the_answer_says_so() {
        let with = |rms_nm, after_servo_rms_nm| MethodResult {
            rms_nm,
            after_servo_rms_nm,
            ..method().unwrap()
        };
        let of = |feed, pvt| {
            summary_of(vec![
                ("joint".to_string(), with(0.1, feed)),
                ("pvt".to_string(), with(0.2, pvt)),
            ])
        };
        assert_eq!(of(None, None).best.as_deref(), Some("joint"));
        let followed = of(Some(0.3), Some(0.22));
        assert_eq!(followed.best.as_deref(), Some("pvt"));
        let answer = crate::answer::answer(&followed);
        let said = "The plans are compared by the RMS after the servo of the process, where pvt leaves 0.22 nm.";
        assert!(answer.why.contains(said), "{}", answer.why);
        assert!(answer.why.contains("joint with 0.3 nm"), "{}", answer.why);
    }

    #[test]
    fn the_answer_names_the_limits_that_a_plan_does_not_keep() {
        let mut outcome = verdict_json(4.0);
        outcome["limits_respected"] = json!(false);
        outcome["axes"] = json!([
            { "jerk_mm_per_s3": { "exceeded": true }, "velocity_mm_per_s": { "exceeded": false } },
            { "acceleration_step_mm_per_s2": { "exceeded": true } },
        ]);
        let broken_limits = broken_limits(&serde_json::from_value(outcome).unwrap());
        assert_eq!(broken_limits, ["jerk"]);
        let rough = MethodResult { limits_respected: false, broken_limits, ..method().unwrap() };
        let rows = [("pvt", method().unwrap()), ("constant-acceleration", rough)];
        let summary = summary_of(rows.map(|(name, m)| (name.to_string(), m)).to_vec());
        let why = crate::answer::answer(&summary).why;
        assert!(why.ends_with(" constant-acceleration does not keep: jerk."), "{why}");
    }

    #[test]
    fn the_program_that_will_run_is_recommended_if_it_keeps_the_limits() {
        let (plan, mut broken) = (method().unwrap(), method().unwrap());
        broken.limits_respected = false;
        let rows = [("pvt", &plan), ("pvt+galil", &plan), ("pvt+csv", &broken)]
            .map(|(n, m)| (n.into(), m.clone()));
        let mut summary = summary_of(rows.to_vec());
        summary.recommend("pvt+galil").unwrap();
        assert_eq!(summary.best.as_deref(), Some("pvt+galil"));
        // The program takes no less time than its plan: the reason is that of the plan.
        for (_, row) in summary.methods.iter_mut().filter(|(name, _)| name == "pvt+galil") {
            row.plan.word = PROGRAM.into();
            row.rms_nm *= 1.5;
            row.total_time_s *= 1.0 + 1e-6;
        }
        let why = crate::answer::answer(&summary).why;
        let reason = "pvt+galil, because it is the program of pvt, and pvt is chosen because it is the only plan here";
        assert!(why.starts_with(reason), "{why}");
        summary.recommend("pvt+csv").unwrap();
        assert_eq!(summary.best, None);
        let said = summary.recommend("joint+galil").unwrap_err();
        assert!(said.contains("no row joint+galil; the rows are pvt"), "{said}");
    }

    #[test]
    fn a_program_is_as_good_as_the_plan_behind_it() {
        let mut program = method().unwrap();
        program.plan = PlanStatus { state: State::Unknown, word: PROGRAM.into(), text: "".into() };
        let methods = |base: &str| {
            vec![
                (base.to_string(), method().unwrap()),
                ("pvt+refined+galil".to_string(), program.clone()),
            ]
        };
        let found = summary_of(methods("pvt+refined")).methods.pop().unwrap().1.plan;
        assert_eq!(
            (found.state, found.word.as_str(), found.text.as_str()),
            (State::Certified, PROGRAM, "of pvt+refined, certified: near")
        );
        let alone = summary_of(methods("trig-spline")).methods.remove(0).1.plan;
        assert_eq!(alone.state, State::Unknown);
    }

    #[test]
    fn what_does_not_belong_together_is_refused() {
        let good = verdict(4.0);
        let error = |desired: &Surface, removal: &Removal, verdict: &Verdict| {
            let told = told(WallTimes::default());
            let division = Division::new(desired, None);
            MethodResult::new(desired, &division, removal, &trajectory(), None, verdict, told)
                .unwrap_err()
                .to_string()
        };
        let late = verdict(4.1);
        assert!(error(&desired(), &removal(), &late).contains("4.1 s of motion"));
        let wide = Surface::new(grid(3, 2), Array2::ones((2, 3))).unwrap();
        assert!(error(&wide, &removal(), &good).contains("x_mm: the removal has 2 pixels"));
        let mut heights = desired().height_nm().clone();
        heights[[1, 0]] += 0.01;
        let other = Surface::new(grid(2, 2), heights.clone()).unwrap();
        assert!(error(&other, &removal(), &good).contains("residual_nm[1, 0]: is 6 nm"));
        heights[[1, 0]] = f64::NAN;
        let masked = Surface::new(grid(2, 2), heights).unwrap();
        assert!(error(&masked, &removal(), &good).contains("residual_nm[1, 0]"));
        let mut lacking = verdict_json(4.0);
        lacking.as_object_mut().unwrap().remove("limits_respected");
        let message = serde_json::from_value::<Verdict>(lacking).unwrap_err().to_string();
        assert!(message.contains("missing field `limits_respected`"), "{message}");
    }
}
