//! The densities: found on meshes that become finer where that is worth most, until their motion keeps the limits.
//!
//! ```text
//! mesh -> near the minimum (nothing proven) -> finer mesh -> ... -> minimum, proven -> motion -> judge
//!                                                             ^------ spans that exceed a limit: tighter
//! ```

use ndarray::Array2;
use planish_dwell::{
    DwellError,
    residual::{Known, Normal, Residual},
};
use planish_numerics::linear::skyline::dot;
use planish_types::{Invalid, Limits, Surface, Tif, ToolPath, Trajectory, progress};
use planish_verify::{VerifySettings, verify};

use crate::{
    FeedError,
    curve::Curve,
    interior_point::{self, Approach, NEAR_THE_MINIMUM, Program, Solution, Start, Stop},
    limits::Rows,
    merit::{Merit, Price},
    mesh::Mesh,
    motion::{self, Motion},
    refinement::{Given, Refined},
    settings::Settings,
};

/// By what the first densities are above every bound.
const FIRST_ABOVE_BOUNDS: f64 = 1.05;

/// Rounds in which spans whose motion exceeds a limit are asked for less, and the program is solved again.
const MAX_ROUNDS: usize = 8;

/// By what the densities of a round are above those that just keep the limits, so that the next one can begin there.
const ABOVE_LIMITS: f64 = 1.001;

/// What is asked for beyond the excess.
const TIGHTENED_FURTHER: f64 = 1.002;

/// Multiplications of a factorisation on the last mesh over those on the first one, at most.
const MOST_GROWTH: f64 = 5.0;

/// Multiplications of one factorisation that take no time beside the rest. Where the first nodes need less, as with a TIF
/// that is wide for the part, they are closer, because densities that are wanted there go up and down steeply, and an
/// elasticity is looked for at more than one price.
pub const LITTLE_WORK: f64 = 1.5e8;

/// Complementarity over the objective at which two plans can be compared.
const COMPARABLE: f64 = 0.03;

/// What is less than this part of another is so for certain there.
const CLEARLY_LESS: f64 = 0.95;

/// Factor between the prices of plans at which an elasticity may be met as well.
const MUCH_CHEAPER: f64 = 30.0;

/// What is to be removed, with what, along which curves.
pub struct Asked<'a> {
    pub desired: &'a Surface,
    pub tif: &'a Tif,
    pub path: &'a ToolPath,
    pub curves: &'a [Curve],
    pub limits: &'a Limits,
    /// What the machine removes with a motion that was planned (a map like `desired`, nm).
    pub executed: &'a dyn Fn(&Trajectory) -> Result<Array2<f64>, Invalid>,
}

/// On which meshes the densities are found.
pub struct Meshes {
    pub first: Mesh,
    /// Most times that nodes are added to it,
    pub refinements: usize,
    /// as long as a factorisation takes no more multiplications than these.
    pub most_work: f64,
}

/// What was found on the last mesh.
pub struct Solved {
    pub mesh: Mesh,
    /// Nodes of every mesh, the last one that of `mesh`.
    pub nodes_of_meshes: Vec<usize>,
    pub found: Found,
}

/// The densities, and the motion that they are.
pub struct Found {
    pub solution: Solution,
    pub motion: Motion,
    /// Why the judge refuses the motion.
    pub refused: Option<String>,
    /// RMS (without what is free) of the residual in the removal model of the solver, see [`crate::merit`], nm.
    pub model_rms_nm: f64,
    /// nm^2/s.
    pub price: f64,
    pub iterations: usize,
    pub rounds: usize,
}

/// Densities on the last of some meshes, whose motion keeps the limits if the judge says so.
pub fn solve(asked: &Asked<'_>, meshes: &Meshes, settings: &Settings) -> Result<Solved, FeedError> {
    let mut most_pixels = usize::MAX;
    loop {
        match solve_on_cells(asked, meshes, settings, most_pixels) {
            Err(FeedError::CellsTooLarge { pixels }) => most_pixels = pixels / 2,
            other => return other,
        }
    }
}

/// The same, with normal matrices on cells of at most so many pixels along a side.
fn solve_on_cells(
    asked: &Asked<'_>,
    meshes: &Meshes,
    settings: &Settings,
    most_pixels: usize,
) -> Result<Solved, FeedError> {
    let Meshes { first, refinements, most_work } = meshes;
    let (mut mesh, refinements) = (first.clone(), *refinements);
    let Asked { tif, path, curves, limits, .. } = *asked;
    let level_s_per_mm = level_s_per_mm(asked, &mesh, settings)?;
    // Nothing to remove is no reference: the density at the largest feed is one.
    let fastest = limits.axes().iter().map(|a| a.max_velocity_mm_per_s()).fold(0.0, f64::max);
    let given = Given {
        curves,
        path,
        limits,
        reference_s_per_mm: level_s_per_mm.max(1.0 / fastest),
        min_dwell_s_per_mm: settings.min_dwell_s_per_mm,
    };
    let most_work = (*most_work).min(MOST_GROWTH * mesh.work(tif).max(LITTLE_WORK));
    let affordable = |mesh: &Mesh| mesh.work(tif) <= most_work;
    let (mut start, mut known) = (None, None);
    let (mut iterations, mut nodes_of_meshes) = (0, vec![mesh.nodes]);
    if let (Price::Elasticity(x), true) = (settings.price, mesh.work(tif) <= LITTLE_WORK) {
        let rows = given.rows(&mesh);
        let posed = Posed::new(asked, &mesh, given.floors(&rows), None, settings, most_pixels)?;
        let uniform = posed.uniform(&rows, level_s_per_mm);
        start = Some(posed.start_of_elasticity(&rows, uniform, x, settings)?);
        known = Some(posed.normal.for_next((0..mesh.nodes).map(Some).collect()));
    }
    for k in 0..refinements {
        // The last mesh, on which the plan is proven, needs most of the steps.
        let most = (settings.max_iterations - iterations) / 2;
        if most == 0 {
            break;
        }
        let (at, refined, normal) = progress::part(k, refinements + 1, || {
            let rows = given.rows(&mesh);
            let (lo, known) = (given.floors(&rows), known.take());
            let posed = Posed::new(asked, &mesh, lo, known, settings, most_pixels)?;
            let from = start.take().unwrap_or_else(|| posed.uniform(&rows, level_s_per_mm));
            let at = posed.approach(&rows, from, (NEAR_THE_MINIMUM, most), settings)?;
            let refined = given.refined(&mesh, &rows, &at, affordable);
            Ok::<_, FeedError>((at, refined, posed.normal))
        })?;
        iterations += at.iterations;
        let Some(Refined { mesh: finer, start: from, same }) = refined else {
            let Approach { density, duals, .. } = at;
            start = Some(Start { density, duals: Some(duals) });
            known = Some(normal.for_next((0..mesh.nodes).map(Some).collect()));
            break;
        };
        nodes_of_meshes.push(finer.nodes);
        (mesh, start) = (finer, Some(from));
        known = Some(normal.for_next(same));
    }
    let found = progress::part(refinements, refinements + 1, || {
        let rows = given.rows(&mesh);
        let lo = given.floors(&rows);
        let mut posed = Posed::new(asked, &mesh, lo, known, settings, most_pixels)?;
        posed.normal = posed.normal.as_last();
        let from = start.unwrap_or_else(|| posed.uniform(&rows, level_s_per_mm));
        posed.solve(asked, rows, from, settings.max_iterations - iterations, settings)
    })?;
    let iterations = iterations + found.iterations;
    Ok(Solved { mesh, nodes_of_meshes, found: Found { iterations, ..found } })
}

/// The program on a mesh, but for its rows.
struct Posed<'a> {
    mesh: &'a Mesh,
    residual: Residual<'a>,
    normal: Normal,
    /// Least density of every node, s/mm.
    lo: Vec<f64>,
}

impl<'a> Posed<'a> {
    fn new(
        asked: &'a Asked<'_>,
        mesh: &'a Mesh,
        lo: Vec<f64>,
        known: Option<Known>,
        settings: &Settings,
        most_pixels: usize,
    ) -> Result<Self, FeedError> {
        let residual = residual(asked, mesh, settings)?.on_cells_of_at_most(most_pixels);
        let normal = residual.normal(&mesh.columns(), known)?;
        Ok(Self { mesh, residual, normal, lo })
    }

    /// A density above every bound.
    fn uniform(&self, rows: &Rows<'_>, level_s_per_mm: f64) -> Start {
        let bound = self.lo.iter().copied().fold(rows.least_uniform_density(), f64::max);
        let density = vec![level_s_per_mm.max(FIRST_ABOVE_BOUNDS * bound); self.mesh.nodes];
        Start { density, duals: None }
    }

    fn merit<'m>(&'m self, density: &[f64], settings: &Settings) -> Merit<'m> {
        let weights = (settings.tikhonov, settings.smoothness);
        let Self { mesh, residual, normal, lo } = self;
        Merit::new(residual, normal, mesh, lo, weights, settings.price, density)
    }

    fn program<'p>(&'p self, chain: (&'p [f64], &'p [f64]), rows: &'p Rows<'p>) -> Program<'p> {
        Program { normal: &self.normal, chain, lo: &self.lo, rows }
    }

    /// Near the minimum after at most so many iterations; nothing is proven.
    fn approach(
        &self,
        rows: &Rows<'_>,
        start: Start,
        (near, max_iterations): (f64, usize),
        settings: &Settings,
    ) -> Result<Approach, FeedError> {
        let mut merit = self.merit(&start.density, settings);
        let (diagonal, below) = merit.chain();
        let program = self.program((&diagonal, &below), rows);
        interior_point::approach(&program, start, near, max_iterations, &mut merit)?
            .ok_or(FeedError::Singular { tikhonov: settings.tikhonov })
    }

    /// Where to begin so that an elasticity is met where it is best to meet it.
    ///
    /// The mean square m falls with the total time T by x percent for one percent where m T^x is stationary. With a
    /// tool that is wide for the part there may be several such plans: low orders go in little time, details in much.
    /// So the plans around a price that is much higher, and much lower, are tried, and that with the least m T^x is taken.
    fn start_of_elasticity(
        &self,
        rows: &Rows<'_>,
        uniform: Start,
        x: f64,
        settings: &Settings,
    ) -> Result<Start, FeedError> {
        let most = (COMPARABLE, settings.max_iterations);
        let product = |density: &[f64]| {
            let m = 2.0 * self.residual.evaluate(&self.mesh.times_s(density)).half_mean_square_nm2;
            let total_s = dot(&self.mesh.lengths_mm(), density);
            (0.5 * x * m / total_s, m * total_s.powf(x))
        };
        let mut found = self.approach(rows, uniform.clone(), most, settings)?;
        let (price, mut least) = product(&found.density);
        for factor in [1.0 / MUCH_CHEAPER, MUCH_CHEAPER] {
            let priced = Settings { price: Price::Nm2PerS(price * factor), ..*settings };
            let Approach { density, duals, .. } =
                self.approach(rows, uniform.clone(), most, &priced)?;
            let from = Start { density, duals: Some(duals) };
            let other = self.approach(rows, from, most, settings)?;
            let of_other = product(&other.density).1;
            if of_other < CLEARLY_LESS * least {
                (found, least) = (other, of_other);
            }
        }
        let Approach { density, duals, .. } = found;
        Ok(Start { density, duals: Some(duals) })
    }

    /// Rounds of the solver until the judge finds the limits of the motion kept.
    fn solve(
        &self,
        asked: &Asked<'_>,
        mut rows: Rows<'_>,
        mut start: Start,
        max_iterations: usize,
        settings: &Settings,
    ) -> Result<Found, FeedError> {
        let Asked { path, curves, limits, executed, .. } = *asked;
        let mesh = self.mesh;
        let stop = Stop { relative_gap: settings.relative_gap, max_iterations };
        let executed = |density: &[f64]| {
            executed(&motion::motion(curves, mesh, path, limits, density)?.trajectory)
        };
        let mut merit = self.merit(&start.density, settings).of_motion(&executed);
        let (diagonal, below) = merit.chain();
        let (mut iterations, mut rounds) = (0, 0);
        let (solution, motion, refused) = loop {
            rounds += 1;
            let program = self.program((&diagonal, &below), &rows);
            let solution = interior_point::solve(&program, start, &stop, &mut merit)?
                .ok_or(FeedError::Singular { tikhonov: settings.tikhonov })?;
            iterations += solution.iterations;
            let motion = motion::motion(curves, mesh, path, limits, &solution.density)?;
            let verdict = verify(&motion.trajectory, limits, &VerifySettings::default())?;
            let used = motion.use_of_acceleration(mesh.spans.len(), limits);
            let excess = used.iter().copied().fold(1.0, f64::max);
            if verdict.limits_respected || excess <= 1.0 || rounds == MAX_ROUNDS {
                break (solution, motion, verdict.reason());
            }
            let tighter: Vec<f64> =
                used.iter().map(|u| if *u > 1.0 { u * TIGHTENED_FURTHER } else { 1.0 }).collect();
            rows.tighten(&tighter);
            // Times longer by a factor have accelerations smaller by its square.
            let factor = ABOVE_LIMITS * (excess * TIGHTENED_FURTHER).sqrt();
            let density = solution.density.iter().map(|d| d * factor).collect();
            start = Start { density, duals: Some(solution.duals) };
        };
        let model_rms_nm = (2.0 * merit.half_mean_square_nm2(&solution.density)).sqrt();
        let price = merit.price;
        Ok(Found { solution, motion, refused, model_rms_nm, price, iterations, rounds })
    }
}

/// The residual as a function of the times at the points of a mesh.
fn residual<'a>(
    asked: &Asked<'a>,
    mesh: &'a Mesh,
    settings: &Settings,
) -> Result<Residual<'a>, FeedError> {
    let Asked { desired, tif, path, .. } = *asked;
    Residual::new(desired, tif, &mesh.points_mm, None, settings.free).map_err(|e| match e {
        // The points of the mesh are nothing that was given.
        DwellError::OutOfReach { .. } => DwellError::OutOfReach { points: path.len() }.into(),
        e => e.into(),
    })
}

/// The uniform density, s/mm, that removes on average what is above the lowest point.
fn level_s_per_mm(asked: &Asked<'_>, mesh: &Mesh, settings: &Settings) -> Result<f64, FeedError> {
    let residual = residual(asked, mesh, settings)?;
    let heights = asked.desired.height_nm().iter().filter(|z| !z.is_nan());
    let (sum, count, low) =
        heights.fold((0.0, 0.0, f64::INFINITY), |(sum, n, low), z| (sum + z, n + 1.0, low.min(*z)));
    let rate = residual.mean_removal_nm(&mesh.times_s(&vec![1.0; mesh.nodes]));
    Ok(((sum / count - low) / rate).max(0.0))
}
