//! Plan of the feed and its motion from the map, the TIF and the path.
//!
//! ```text
//! passes -> knots of every pass -> first guess: the VRR feed
//!   deconvolution:  all lines at once; links; what the links remove is taken from the desired
//!                   removal, and the lines are solved again until it changes no more
//!   vrr:            the spline closest to the VRR feed
//! -> motion
//! ```
//!
//! The knots of a pass are uniform, by default a quarter of the width of the TIF apart: a
//! finer spline cannot remove more (a TIF does not see what is narrower than itself).

use ndarray::Array2;
use planish_numerics::{bspline::Knots, motion::timing_law, parallel};
use planish_types::{
    DensityNodes, DwellDensity, End, Invalid, Limits, OnLattice, PARTS_TOLERANCE, Surface, Tif,
    TifLattice, ToolPath, Trajectory, budget,
    outcome::plan::ProvenGap,
    plausible::{self, Rms},
};
use serde::Serialize;

use crate::{
    FeedError,
    deconvolution::{self, DeconvolutionSettings, Problem, Refinement, Start},
    joint::Joint,
    limited,
    motion::{FitReport, Links, Motion, motion},
    passes::{Pass, passes},
    vrr,
};

/// Sources of the feed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum FeedSource {
    /// The feed that leaves the smallest residual.
    Deconvolution,
    /// VRR / (desired removal x pitch).
    Vrr,
}

impl FeedSource {
    /// Returns the name of the source in a plan.
    pub fn name(self) -> &'static str {
        match self {
            Self::Deconvolution => "bspline",
            Self::Vrr => "vrr",
        }
    }
}

/// Treatment of the uniform part of the desired removal.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum Piston {
    /// The uniform part does not count; the solver finds it along with the feed, slowly.
    Free,
    /// The uniform part is removed as given.
    Keep,
}

/// Settings of a plan of the feed.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct FeedSettings {
    /// Source of the feed: the deconvolution, or the VRR feed.
    pub method: FeedSource,
    /// Method to keep the acceleration limit.
    pub refinement: Refinement,
    /// Distance of the knots of the splines, mm; `None` for a quarter of the TIF's width.
    pub knot_spacing_mm: Option<f64>,
    /// Distance of neighbouring passes for the VRR feed, mm; `None` for the distance measured on the path.
    pub pitch_mm: Option<f64>,
    /// Treatment of the uniform part of the desired removal.
    pub piston: Piston,
    /// Weight of the squared distance to the smallest dwell-time density, relative to the largest column of the removal
    /// basis; >= 0.
    pub tikhonov: f64,
    /// Weight of the squared second differences of the control values along a pass, relative to the largest column of
    /// the removal basis; >= 0.
    pub curvature_weight: f64,
    /// Largest gap between the objective and its proven lower bound, as a fraction of the objective, with which the
    /// solver ends. For knot removal, smallest relative decrease of the objective in a sweep.
    pub relative_gap: f64,
    /// Largest number of steps of the interior point method, or of sweeps of knot removal.
    pub max_sweeps: usize,
    /// Largest distance of the motion from that of the splines, t(s), at equal times, mm.
    pub fit_tolerance_mm: f64,
}

impl Default for FeedSettings {
    fn default() -> Self {
        Self {
            method: FeedSource::Deconvolution,
            refinement: Refinement::ConvexConcave,
            knot_spacing_mm: None,
            pitch_mm: None,
            // A free piston converges slowly: it trades time for depth of the valleys.
            piston: Piston::Keep,
            tikhonov: 1e-5,
            curvature_weight: 1e-4,
            relative_gap: 1e-3,
            max_sweeps: 200,
            fit_tolerance_mm: 1e-6,
        }
    }
}

/// Set of feeds to which the proven gap ([`FeedReport::proven`]) applies, in words for the report.
const COVERED: &str = "feeds on these knots, under the tangents of the acceleration limit at this feed, and nowhere \
                       more than 1.5 times as fast; not closer knots, other links, or another feed within the limits \
                       themselves";

/// Report of a plan.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct FeedReport {
    /// Lattice of the map on which the TIF was resampled; left out if the TIF was used as it is.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub tif_lattice: Option<TifLattice>,
    /// Number of straight passes.
    pub passes: usize,
    /// Number of control values of all passes.
    pub control_values: usize,
    /// Distance of the knots as given or by default, mm; those of a pass are at most this far apart.
    pub knot_spacing_mm: f64,
    /// Number of interior knots that knot removal left, over all passes; for other methods all interior knots of the
    /// splines.
    pub knots_left: usize,
    /// Number of passes in the last sweep on which knot removal failed and the convex-concave procedure took over.
    pub fallbacks: usize,
    /// Uniform removal in addition to the desired one, nm; 0 if the piston is kept.
    pub piston_nm: f64,
    /// Total number of steps of the interior point method, or of sweeps of knot removal, over all rounds.
    pub sweeps: usize,
    /// Reason why the solver ended. `converged`: the gap is within the tolerance. `settled`: the last sweep of knot
    /// removal lowered the objective by less than the tolerance, which proves nothing. `sweep-limit`: the steps or
    /// sweeps were used up, or no further step was possible. `stopped`: the next sweep would have raised the objective.
    /// `link-limit`: the removal by the links still changes after the last round. `direct`: the VRR feed, which is not
    /// iterated.
    pub end: End,
    /// Proven gap: no feed within the tangents of the acceleration limit at this feed lowers the objective by a larger
    /// fraction. Absent if nothing is proven.
    #[serde(flatten)]
    pub proven: ProvenGap,
    /// Objective at the start and after every step or sweep of the last round, nm^2.
    pub objective_nm2: Vec<f64>,
    /// Objective after a last sweep that raised it and was undone, nm^2; left out if there was none.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub given_up_nm2: Option<f64>,
    /// RMS of the residual about its mean, in the removal model of the solver, nm; left out for the VRR feed.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub model_rms_nm: Option<f64>,
    /// RMS of the same residual without its best plane, nm; left out for the VRR feed.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub model_rms_detilted_nm: Option<f64>,
    /// Largest acceleration along a pass as a fraction of its limit, from the splines.
    pub acceleration_use: f64,
    /// Largest feed as a fraction of its limit, from the smallest control value of the splines, which bounds it.
    pub feed_use: f64,
    /// Excess of the motion over the machine's limit on jerk, which this method does not control; left out if the
    /// machine has no such limit, or the motion keeps it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub jerk: Option<Jerk>,
    /// Numbers and times of the links between the passes.
    pub links: Links,
    /// Largest removal at a valid pixel by links with the tool on, nm. The deconvolution takes it into account, the VRR
    /// feed does not.
    pub link_removal_nm: f64,
    /// Deviation of the motion from that of the splines.
    pub fit: FitReport,
}

/// Excess of a motion over the machine's limit on jerk.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Jerk {
    /// Largest jerk inside pieces as a multiple of its limit, for the worse axis.
    pub inside: f64,
    /// Largest step of the acceleration between pieces, mm/s^2; no limit on jerk allows a step.
    pub largest_acceleration_step_mm_per_s2: f64,
}

/// The planned dwell-time density, its motion, and the report.
#[derive(Clone, Debug)]
pub struct FeedPlan {
    /// Dwell-time density of the splines at Greville's abscissae, which determine the splines.
    pub density: DwellDensity,
    /// Motion of the plan.
    pub trajectory: Trajectory,
    /// Report of the plan.
    pub report: FeedReport,
}

impl FeedPlan {
    /// Returns the reason why the plan for the desired removal `surface`, made with `settings`, should not be executed;
    /// otherwise `None`. Reasons are an exceeded limit on jerk, no convergence, a larger error of the surface, and a
    /// run that takes too long.
    pub fn drawback(&self, surface: &Surface, settings: &FeedSettings) -> Option<String> {
        let r = &self.report;
        if let Some(jerk) = r.jerk {
            return Some(format!(
                "the limit on jerk of the machine is exceeded: by a factor of {:.3} inside pieces, and the \
                 acceleration steps by up to {:.4} mm/s^2; a B-spline feed keeps no limit on jerk: plan with \
                 `planish joint`, or `planish dwell` and `planish schedule pvt`, which keep it",
                jerk.inside, jerk.largest_acceleration_step_mm_per_s2
            ));
        }
        let total_time_s = self.trajectory.total_time_s();
        match r.end {
            End::SweepLimit => Some(match settings.refinement {
                Refinement::ConvexConcave => format!(
                    "not converged: after {} steps no proof that the objective is within {} of its minimum; \
                     raise `max_sweeps` or `relative_gap`",
                    r.sweeps, settings.relative_gap
                ),
                Refinement::KnotRemoval => format!(
                    "not converged: after {} sweeps the objective still falls by more than {} of itself; \
                     raise `max_sweeps` or `relative_gap`",
                    r.sweeps, settings.relative_gap
                ),
            }),
            End::Stopped => Some(self.stopped()),
            End::LinkLimit => Some(
                "not converged: what the turn-arounds remove still changes from round to round; give the \
                 path more overscan, so that they lie off the part"
                    .to_string(),
            ),
            _ => match (r.model_rms_nm, r.model_rms_detilted_nm) {
                (Some(rms_nm), Some(detilted_nm)) => {
                    let after = Rms { rms_nm, detilted_nm };
                    plausible::drawback(Rms::of_surface(surface), after, total_time_s)
                }
                _ => plausible::too_long(total_time_s),
            },
        }
    }

    /// Returns the message about a sweep that raised the objective and was undone.
    fn stopped(&self) -> String {
        let r = &self.report;
        let done = r.objective_nm2.len() - 1;
        let last = r.objective_nm2[done];
        let raised = r.given_up_nm2.unwrap_or(last);
        let result = if done == 0 {
            "the plan is its start, the feed of the volumetric removal rate".to_string()
        } else {
            format!("the plan is that of sweep {done}")
        };
        format!(
            "not converged: sweep {} raised the objective from {last:.6e} to {raised:.6e} nm^2 and was given \
             up, so {result}; take `refinement` convex-concave, which keeps all knots",
            done + 1
        )
    }
}

/// Largest number of rounds, each of which solves for the feed and computes the removal by the links anew. After the
/// last one this removal must no longer change. Larger: more time. Smaller: plans end with `link-limit`.
const MAX_ROUNDS: usize = 5;

/// Largest change of the removal by the links, at a pixel and between two rounds, that counts as settled. It is a
/// fraction of the RMS of the residual. Larger: the plan knows the removal by the links less exactly. Smaller: more
/// rounds.
const LINK_TOLERANCE: f64 = 1e-3;

/// Plans feed and motion along `path` for the desired removal `surface`.
///
/// # Errors
/// Refuses settings out of range, a TIF that varies over the part or in time, and surface, TIF and path that do not fit
/// together. Refuses a path that turns inside the clear aperture, a tool that does not reach the part, and a problem
/// that takes too much memory. Fails if a quadratic program is not solved, or if the limits allow no motion.
pub fn plan(
    surface: &Surface,
    tif: &Tif,
    path: &ToolPath,
    limits: &Limits,
    settings: &FeedSettings,
) -> Result<FeedPlan, FeedError> {
    check(settings)?;
    tif.same_everywhere("planish bspline-feed")?;
    plausible::check_path(surface, tif, path)?;
    let OnLattice { tif, lattice } = tif.on_lattice_of(surface.grid(), PARTS_TOLERANCE)?;
    let tif = &*tif;
    // `passes` and (1) of `vrr` take the removal to be at the position of the tool, so its centroid has the offset 0.
    let centred = tif.centred_on(surface)?;
    let (surface, tif) = centred.as_ref().map_or((surface, tif), |(surface, tif)| (surface, tif));
    let passes = passes(path, surface, limits)?;
    let width_mm = width_mm(tif);
    let spacing = settings.knot_spacing_mm.unwrap_or(0.25 * width_mm);
    check_knots(&passes, spacing, width_mm)?;
    let knots: Vec<Knots> =
        passes.iter().map(|p| Knots::uniform(p.length_mm(), spans(p, spacing) as usize)).collect();
    let pitches = pitches_mm(settings, &passes, tif)?;
    let guess = Guess { surface, tif, pitches: &pitches, piston: settings.piston };
    let run =
        |d: &[Vec<f64>]| motion(&passes, &knots, d, surface, limits, settings.fit_tolerance_mm);

    let solved = match settings.method {
        FeedSource::Vrr => {
            let (d, piston_nm) = guess.baseline(&passes, &knots)?;
            let motion = run(&d)?;
            let link_removal_nm = largest(&motion.link_removal_nm(tif, surface), surface);
            let state = None;
            Solved { d, motion, link_removal_nm, piston_nm, sweeps: 0, settled: true, state }
        }
        FeedSource::Deconvolution => {
            let problem = Problem::new(&passes, knots.clone(), tif, surface)?;
            let how = deconvolution_settings(settings);
            let joint = match settings.refinement {
                Refinement::ConvexConcave => Some(Joint::new(&problem, surface, &how)?),
                Refinement::KnotRemoval => None,
            };
            let mut start = guess.start(&passes, &knots);
            if joint.is_none() {
                start = within(start, &passes, &knots)?;
            }
            let mut other_nm = Array2::zeros(surface.grid().shape());
            let mut sweeps = 0;
            let mut rounds = 0;
            loop {
                rounds += 1;
                let state = match &joint {
                    Some(joint) => joint.solve(&other_nm, start)?,
                    None => problem.sweeps(surface, &other_nm, start, &how)?,
                };
                let motion = run(&state.d)?;
                let now_nm = motion.link_removal_nm(tif, surface);
                let change = largest(&(&now_nm - &other_nm), surface);
                sweeps += state.steps;
                let settled = change <= LINK_TOLERANCE * rms_nm(&state.residual_nm, surface);
                if settled || rounds == MAX_ROUNDS {
                    break Solved {
                        d: state.d.clone(),
                        motion,
                        link_removal_nm: largest(&now_nm, surface),
                        piston_nm: state.piston_nm,
                        sweeps,
                        settled,
                        state: Some(state),
                    };
                }
                start = Start { d: state.d, piston_nm: state.piston_nm };
                other_nm = now_nm;
            }
        }
    };
    let report = report(&passes, &knots, spacing, &solved, surface, limits);
    let report = FeedReport { tif_lattice: lattice.if_anew(), ..report };
    let density = density(&passes, &knots, &solved.d)?;
    Ok(FeedPlan { density, trajectory: solved.motion.trajectory, report })
}

/// Control values of the chosen feed source with their motion, and data on the solution; `state` is `None` for the VRR
/// feed.
struct Solved {
    d: Vec<Vec<f64>>,
    motion: Motion,
    link_removal_nm: f64,
    piston_nm: f64,
    sweeps: usize,
    /// True if the removal by the links no longer changes between rounds.
    settled: bool,
    state: Option<deconvolution::State>,
}

/// Refuses settings that are out of range.
fn check(settings: &FeedSettings) -> Result<(), Invalid> {
    let positive = [
        ("knot_spacing_mm", settings.knot_spacing_mm),
        ("pitch_mm", settings.pitch_mm),
        ("fit_tolerance_mm", Some(settings.fit_tolerance_mm)),
    ];
    for (name, value) in positive {
        if let Some(v) = value.filter(|v| !(v.is_finite() && *v > 0.0)) {
            return Err(Invalid::whole(name, format!("is {v}"), "give a length in mm above 0"));
        }
    }
    let fit = settings.fit_tolerance_mm;
    let least = timing_law::LEAST_TOLERANCE_MM;
    if fit < least {
        let remedy = format!("give at least {least:e} mm: what is smaller is rounding");
        return Err(Invalid::whole("fit_tolerance_mm", format!("is {fit:?}"), remedy));
    }
    let weights = [
        ("tikhonov", settings.tikhonov),
        ("curvature_weight", settings.curvature_weight),
        ("relative_gap", settings.relative_gap),
    ];
    for (name, v) in weights {
        if !(v.is_finite() && v >= 0.0) {
            return Err(Invalid::whole(name, format!("is {v}"), "give a finite number >= 0"));
        }
    }
    if settings.max_sweeps == 0 {
        return Err(Invalid::whole("max_sweeps", "is 0", "give at least 1"));
    }
    Ok(())
}

/// Returns the number of spans between the knots of a pass, a whole number, for knots at most `spacing_mm` apart.
fn spans(pass: &Pass, spacing_mm: f64) -> f64 {
    (pass.length_mm() / spacing_mm).ceil().max(1.0)
}

/// Refuses knots closer than the TIF's width over [`MOST_KNOTS_PER_WIDTH`], and more knots than fit into the memory.
fn check_knots(passes: &[Pass], spacing_mm: f64, width_mm: f64) -> Result<(), Invalid> {
    let least = width_mm / MOST_KNOTS_PER_WIDTH;
    if spacing_mm < least {
        return Err(Invalid::whole(
            "knot_spacing_mm",
            format!("is {spacing_mm:?} mm, far below the width of the TIF, {width_mm:.6} mm"),
            format!(
                "a tool does not see what is narrower than itself: give about {:.6} mm, at least \
                 {least:.6} mm; or is the TIF in um?",
                0.25 * width_mm
            ),
        ));
    }
    // The control values of a pass have a full matrix, and the quadratic program a second one.
    let squares: f64 = passes.iter().map(|p| (spans(p, spacing_mm) + 3.0).powi(2)).sum();
    budget::affordable(
        "knot_spacing_mm",
        squares,
        2 * size_of::<f64>(),
        "give a larger `knot_spacing_mm`, and check that path and TIF are both in mm",
    )?;
    Ok(())
}

/// Largest number of knots per width of the TIF; more are refused. Larger: knots that the TIF cannot resolve cost
/// time and memory. Smaller: fine knots are refused. Chosen: ten times the default of four.
const MOST_KNOTS_PER_WIDTH: f64 = 40.0;

/// Returns the distance of every pass from its neighbours, mm: that of the settings, or the one measured on the path.
fn pitches_mm(settings: &FeedSettings, passes: &[Pass], tif: &Tif) -> Result<Vec<f64>, Invalid> {
    let measured = vrr::pitches_mm(passes, tif);
    match settings.pitch_mm {
        Some(p) => {
            check_pitch(p, &measured)?;
            Ok(vec![p; passes.len()])
        }
        None => Ok(measured),
    }
}

/// Refuses a given distance of the passes that differs by more than the factor [`MOST_PITCH_RATIO`] from all distances
/// on the path.
fn check_pitch(pitch_mm: f64, measured_mm: &[f64]) -> Result<(), Invalid> {
    let low = measured_mm.iter().copied().fold(f64::INFINITY, f64::min);
    let high = measured_mm.iter().copied().fold(0.0, f64::max);
    if pitch_mm * MOST_PITCH_RATIO >= low && pitch_mm <= MOST_PITCH_RATIO * high {
        return Ok(());
    }
    Err(Invalid::whole(
        "pitch_mm",
        format!(
            "is {pitch_mm:?} mm, but the passes of this path are {low:.6} to {high:.6} mm apart"
        ),
        "give the distance of neighbouring passes in mm, or leave it out",
    ))
}

/// Largest ratio of a given pitch to those of the path, or of these to the given one; beyond it the pitch is refused.
/// Two rasters on top of each other are closer than their own pitch. Larger: mistakes in the units pass. Smaller: such
/// rasters are refused.
const MOST_PITCH_RATIO: f64 = 30.0;

/// Returns the settings of the deconvolution that follow from those of the plan.
fn deconvolution_settings(settings: &FeedSettings) -> DeconvolutionSettings {
    DeconvolutionSettings {
        refinement: settings.refinement,
        free_piston: settings.piston == Piston::Free,
        tikhonov: settings.tikhonov,
        curvature_weight: settings.curvature_weight,
        tolerance: settings.relative_gap,
        max_sweeps: settings.max_sweeps,
    }
}

/// Returns the FWHM of the Gaussian with the second moment of the TIF, mm: `sqrt(8 ln 2) sigma`, `sigma^2 = integral R
/// r^2 / (2 integral R)`, about its centre of mass. It is at least the larger sample step of the TIF.
pub fn width_mm(tif: &Tif) -> f64 {
    let grid = tif.grid();
    let mass = moment(tif, |_, _| 1.0);
    let cx = moment(tif, |x, _| x) / mass;
    let cy = moment(tif, |_, y| y) / mass;
    let r2 = moment(tif, |x, y| (x - cx).powi(2) + (y - cy).powi(2)) / mass;
    // Between its samples a TIF is interpolated: of one sample it is no narrower than their distance.
    let least = grid.x.step_mm().max(grid.y.step_mm());
    ((8.0 * std::f64::consts::LN_2).sqrt() * (0.5 * r2).sqrt()).max(least)
}

/// Returns the sum of `f(x, y)` over the samples of the TIF, weighted by their rates; negative rates count as 0.
fn moment(tif: &Tif, f: impl Fn(f64, f64) -> f64) -> f64 {
    let grid = tif.grid();
    let samples = tif.rate_nm_per_s().indexed_iter();
    samples
        .map(|((r, c), v)| v.max(0.0) * f(grid.x.coordinate_mm(c), grid.y.coordinate_mm(r)))
        .sum::<f64>()
}

/// Returns the control values within the limits that are close to those of `start`, with the same piston.
fn within(start: Start, passes: &[Pass], knots: &[Knots]) -> Result<Start, FeedError> {
    let near = parallel::map(passes.len(), &|m| {
        limited::next_within(&knots[m], deconvolution::limits(&passes[m]), start.d[m].clone())
            .map_err(|status| FeedError::Solver { pass: m, status })
    });
    Ok(Start { d: near.into_iter().collect::<Result<_, _>>()?, ..start })
}

/// Inputs from which the VRR feed is computed; `pitches` are the distances of the passes, mm.
struct Guess<'a> {
    surface: &'a Surface,
    tif: &'a Tif,
    pitches: &'a [f64],
    piston: Piston,
}

impl Guess<'_> {
    /// Returns control values, s/mm, by the VRR feed of the map averaged over the TIF; they ignore the acceleration
    /// limit. A free piston is the one with which the lowest average gets the largest feed; otherwise the piston is 0.
    fn start(&self, passes: &[Pass], knots: &[Knots]) -> Start {
        let vrr = self.tif.vrr_nm_mm2_per_s();
        let seen: Vec<Vec<Option<f64>>> = (passes.iter().zip(knots))
            .map(|(p, k)| k.greville().iter().map(|s| self.average_nm(p.position(*s))).collect())
            .collect();
        let lowest = seen.iter().flatten().flatten().copied().fold(f64::INFINITY, f64::min);
        let piston_nm = match self.piston {
            Piston::Free if lowest.is_finite() => self.floor_nm(passes) - lowest,
            _ => 0.0,
        };
        let d = (0..passes.len()).map(|m| {
            let least = 1.0 / passes[m].max_feed_mm_per_s;
            let heights = seen[m].iter().map(|z| z.map_or(0.0, |z| z + piston_nm));
            heights.map(|z| vrr::density_s_per_mm(z, self.pitches[m], vrr, least)).collect()
        });
        Start { d: d.collect(), piston_nm }
    }

    /// Returns the control values, s/mm, of the splines closest to the VRR feed within the limits. A free piston, nm,
    /// is the one with which the lowest pixel gets the largest feed; otherwise the piston is 0.
    fn baseline(
        &self,
        passes: &[Pass],
        knots: &[Knots],
    ) -> Result<(Vec<Vec<f64>>, f64), FeedError> {
        let vrr = self.tif.vrr_nm_mm2_per_s();
        let piston_nm = match self.piston {
            Piston::Free => self.floor_nm(passes) - self.surface.statistics().min,
            Piston::Keep => 0.0,
        };
        let mut all = Vec::with_capacity(passes.len());
        for (m, (pass, knots)) in passes.iter().zip(knots).enumerate() {
            let limits = deconvolution::limits(pass);
            let least = limits.min_density_s_per_mm;
            let wanted = |s: f64| {
                let pixel = self.surface.nearest_valid(pass.position(s));
                let z = self.surface.height_nm()[pixel] + piston_nm;
                vrr::density_s_per_mm(z, self.pitches[m], vrr, least)
            };
            let objective = vrr::closest(knots, wanted);
            let start = knots.greville().iter().map(|s| wanted(*s)).collect();
            let d = limited::closest_within(&objective, knots, limits, start)
                .map_err(|status| FeedError::Solver { pass: m, status })?;
            all.push(d);
        }
        Ok((all, piston_nm))
    }

    /// Returns the removal by neighbouring passes at the largest feed, nm, with feed and pitch of the first pass.
    fn floor_nm(&self, passes: &[Pass]) -> f64 {
        self.tif.vrr_nm_mm2_per_s() / (passes[0].max_feed_mm_per_s * self.pitches[0])
    }

    /// Returns the desired removal averaged over the TIF at the position `p`, `sum R z / sum R` over the valid pixels,
    /// nm. `None` if less than a tenth of the TIF's volume is on valid pixels.
    fn average_nm(&self, p: [f64; 2]) -> Option<f64> {
        let mut rate = crate::columns::window(p.map(|v| (v, v)), self.tif, self.surface);
        crate::columns::add_rate(&mut rate, p, 1.0, self.tif, self.surface);
        let mut sum = 0.0;
        let mut weight = 0.0;
        for ((r, c), w) in rate.removal.indexed_iter() {
            let z = self.surface.height_nm()[[rate.origin.0 + r, rate.origin.1 + c]];
            if !z.is_nan() {
                sum += w * z;
                weight += w;
            }
        }
        let volume = weight * self.surface.grid().pixel_mm2();
        if volume > 0.1 * self.tif.vrr_nm_mm2_per_s() { Some(sum / weight) } else { None }
    }
}

/// Returns the largest magnitude of `map` on the valid pixels of `surface`.
fn largest(map: &Array2<f64>, surface: &Surface) -> f64 {
    let valid = map.iter().zip(surface.height_nm()).filter(|(_, z)| !z.is_nan());
    valid.map(|(v, _)| v.abs()).fold(0.0, f64::max)
}

/// Returns the RMS of the residual over the valid pixels about its mean, nm.
fn rms_nm(residual_nm: &Array2<f64>, surface: &Surface) -> f64 {
    let masked = masked(residual_nm, surface);
    planish_numerics::statistics::statistics(masked.view()).map_or(0.0, |s| s.rms)
}

/// Returns the RMS of the residual with and without its best plane, nm; `None` if the residual makes no valid map.
fn residual(residual_nm: &Array2<f64>, surface: &Surface) -> Option<Rms> {
    let map = Surface::new(*surface.grid(), masked(residual_nm, surface));
    map.ok().map(|s| Rms::of_surface(&s))
}

/// Returns the residual with NaN at invalid pixels.
fn masked(residual_nm: &Array2<f64>, surface: &Surface) -> Array2<f64> {
    ndarray::Zip::from(residual_nm)
        .and(surface.height_nm())
        .map_collect(|r, z| if z.is_nan() { f64::NAN } else { *r })
}

/// Makes the report of a plan; only the lattice of its TIF is added later.
fn report(
    passes: &[Pass],
    knots: &[Knots],
    spacing: f64,
    solved: &Solved,
    surface: &Surface,
    limits: &Limits,
) -> FeedReport {
    let mut acceleration_use = 0.0_f64;
    let mut feed_use = 0.0_f64;
    for ((pass, knots), d) in passes.iter().zip(knots).zip(&solved.d) {
        let peak = limited::highest_peak(knots, d).acceleration_mm_per_s2;
        acceleration_use = acceleration_use.max(peak / pass.max_acceleration_mm_per_s2);
        // D is no smaller than its smallest control value.
        let least = d.iter().copied().fold(f64::INFINITY, f64::min);
        feed_use = feed_use.max(1.0 / (least * pass.max_feed_mm_per_s));
    }
    let residual = solved.state.as_ref().and_then(|s| residual(&s.residual_nm, surface));
    let left = solved.state.as_ref().map_or(knots, |s| &s.knots_left);
    FeedReport {
        tif_lattice: None,
        passes: passes.len(),
        control_values: knots.iter().map(Knots::len).sum(),
        knot_spacing_mm: spacing,
        knots_left: left.iter().map(|k| k.breaks().len() - 2).sum(),
        fallbacks: solved.state.as_ref().map_or(0, |s| s.fallbacks),
        piston_nm: solved.piston_nm,
        sweeps: solved.sweeps,
        end: match &solved.state {
            None => End::Direct,
            Some(state) if state.given_up_nm2.is_some() => End::Stopped,
            Some(state) if !state.converged => End::SweepLimit,
            Some(_) if !solved.settled => End::LinkLimit,
            Some(state) if state.gap.is_none() => End::Settled,
            Some(_) => End::Converged,
        },
        proven: match solved.state.as_ref().and_then(|s| s.gap) {
            Some(gap) => {
                ProvenGap { relative_gap: None, gap: Some(gap), gap_covers: Some(COVERED.into()) }
            }
            None => ProvenGap::default(),
        },
        objective_nm2: solved.state.as_ref().map_or(Vec::new(), |s| s.objective.clone()),
        given_up_nm2: solved.state.as_ref().and_then(|s| s.given_up_nm2),
        model_rms_nm: solved.state.as_ref().map(|s| rms_nm(&s.residual_nm, surface)),
        model_rms_detilted_nm: residual.map(|r| r.detilted_nm),
        acceleration_use,
        feed_use,
        jerk: jerk(&solved.motion.trajectory, limits),
        links: solved.motion.links,
        link_removal_nm: solved.link_removal_nm,
        fit: solved.motion.fit,
    }
}

/// Step of the acceleration, as a fraction of the limit on the acceleration, up to which it counts as rounding. Larger:
/// real steps count as kept. Smaller: rounding counts as an exceeded limit.
const STEP_ROUNDING: f64 = 1e-6;

/// Returns the excess of the motion over the limits on jerk; `None` if no axis has one, or the motion keeps them all.
/// Steps of the acceleration at the start and end of the motion count.
fn jerk(trajectory: &Trajectory, limits: &Limits) -> Option<Jerk> {
    let mut jerk = Jerk { inside: 0.0, largest_acceleration_step_mm_per_s2: 0.0 };
    let mut exceeded = false;
    for (k, axis) in limits.axes().iter().enumerate() {
        let Some(limit) = axis.max_jerk_mm_per_s3() else { continue };
        let mut before = 0.0;
        let mut largest_step = 0.0_f64;
        for segment in trajectory.segments() {
            let [_, _, c2, c3] = segment.coefficient_mm[k];
            jerk.inside = jerk.inside.max(6.0 * c3.abs() / limit);
            largest_step = largest_step.max((2.0 * c2 - before).abs());
            before = 2.0 * c2 + 6.0 * c3 * segment.duration_s;
        }
        largest_step = largest_step.max(before.abs());
        exceeded |= largest_step > STEP_ROUNDING * axis.max_acceleration_mm_per_s2();
        jerk.largest_acceleration_step_mm_per_s2 =
            jerk.largest_acceleration_step_mm_per_s2.max(largest_step);
    }
    if exceeded || jerk.inside > 1.0 { Some(jerk) } else { None }
}

/// Returns the dwell-time density of the splines at Greville's abscissae of their knots, pass by pass.
fn density(passes: &[Pass], knots: &[Knots], d: &[Vec<f64>]) -> Result<DwellDensity, Invalid> {
    let mut nodes = DensityNodes::default();
    for (m, pass) in passes.iter().enumerate() {
        for s in knots[m].greville() {
            nodes.arc_length_mm.push(pass.arc_start_mm + s);
            nodes.dwell_density_s_per_mm.push(knots[m].value(&d[m], s));
            nodes.point_mm.push(pass.position(s));
            nodes.pass_idx.push(m as i64);
            nodes.corner.push(false);
        }
    }
    DwellDensity::new(nodes)
}
