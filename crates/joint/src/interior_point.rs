//! Interior point method for the densities of least objective under the limits.
//!
//! ```text
//! min f(D)   subject to   c_i(D_j, D_k) >= 0,   D >= lo                                          (1)
//! ```
//!
//! f is the objective, D the densities of the nodes, and c the rows: the constraints that the limits of the machine
//! impose. f is convex. The rows c are not concave everywhere, so (1) is not convex. Every step is that of a
//! primal-dual method. It takes into account only the part of the curvature of every row that bends it downwards (C_i,
//! positive semidefinite):
//!
//! ```text
//! (H + sum_i z_i C_i + J' Z/c J + Y/(D - lo)) d = -f' + J' (mu/c) + mu/(D - lo)
//! dz = mu/c - z - Z/c J d,   dy = mu/(D - lo) - y - Y/(D - lo) d                                  (2)
//! ```
//!
//! with H the surrogate of the curvature of f, f' exact, and mu by Mehrotra's predictor and corrector. The predictor
//! (d, dz, dy) is (2) with mu = 0, and dc = J d its change of the slacks by their tangents. a is the longest part of d,
//! and b that of dz and dy, that a step may take. With N rows and bounds,
//!
//! ```text
//! g     = z'c + y'(D - lo)                                              the complementarity
//! g_ab  = (z + b dz)'(c + a dc) + (y + b dy)'(D - lo + a d)             that after the predictor
//! sigma = (g_ab / g)^3,   at least 1e-3 and at most 1;    mu = sigma g / N                        (3)
//! mu - dz_i dc_i  for row i,   mu - dy_j d_j  for bound j               in place of mu in (2)
//! ```
//!
//! Gondzio's corrections then bring outlying products of slacks and dual variables back towards mu. They measure the
//! products v after both parts of the step, each 0.3 longer and at most 1, and project them on the range from mu / 10
//! to 10 mu. The change by the projection is added to the targets of (3):
//!
//! ```text
//! target_i += max(clip(v_i, mu / 10, 10 mu) - v_i, -10 mu)                                        (4)
//! ```
//!
//! A correction is kept, and another one tried, if neither part becomes shorter and one becomes longer by 0.03. Without
//! them the steps end early at a few rows that are far from being active. A step ends where a row would lose 95 % of
//! its slack, measured on c itself, so every iterate can be executed. If the bends of the rows end a step much before
//! the tangents do, a second-order correction follows. Its right-hand side has the distance of the rows from their
//! tangents at the end of the step, and the factor is the same. The matrix keeps the skyline of H, because a row
//! couples neighbours only.
//!
//! f and f' are those of [`crate::merit`]. They are computed with the removal itself whenever the complementarity has
//! fallen to a tenth, and at every iterate of which something is to be proven. Between these iterates H gives the
//! change.
//!
//! An objective that no longer falls need not be the least one: z fits rows that bend from step to step, and is always
//! a step late. So when the complementarity is as small as the gap that is wanted, the iterate stays where it is and
//! its tangents are kept. The steps go on for the convex program with these tangents in the place of the rows. Its
//! slacks may first be larger than the tangents allow (an infeasible start). They end when its dual variables prove how
//! far the iterate is above its least value ([`crate::certificate`]). With the iterate D_0 that stays, and the gap G(D)
//! that the certificate proves of a later D under the tangents at D_0,
//!
//! ```text
//! f(D_0) - least f under the tangents <= f(D_0) - f(D) + G(D),   G(D) >= f(D) - that least f      (5)
//! ```
//!
//! and the least right side of all D is the gap of D_0. While the slacks of D still have an excess x over those that
//! the tangents allow, G has `z'(c - x)` for `z'c`. If the gap is more than is wanted, the iterate moves towards the
//! solution of this convex program, as far as the rows themselves allow. The steps under the rows then go on.
//!
//! Sources: S. Mehrotra, SIAM J. Optim. 2 (1992) 575; J. Gondzio, Comput. Optim. Appl. 6 (1996) 137; for problems that
//! are convex but for their rows T. Lipp and S. Boyd, Optim. Eng. 17 (2016) 263; for the second-order correction
//! A. Wächter and L. T. Biegler, Math. Program. 106 (2006) 25.
//!
//! | module | contents |
//! |---|---|
//! | `program` | (1), and the factorised matrix of (2) |
//! | `iterate` | an iterate, its steps by (2), and the tangents that it keeps |
//! | `search` | the states of [`solve`] |

mod iterate;
mod program;
mod search;

pub use iterate::Start;
pub use program::Program;
pub use search::{Solution, Stop};

use self::{
    iterate::Iterate,
    search::{FIRST, Next, REFERRED_AGAIN, Search},
};
use crate::{
    JointError,
    merit::{Merit, Progress},
};

/// Ratio of the complementarity (the sum of slacks times dual variables) to the objective f at which an [`approach`]
/// may end. Larger: dual variables that do not tell which rows decide. Smaller: more steps on a mesh that is not the
/// last one. Chosen: by then the dual variables of the rows that decide are far above the others.
pub const NEAR_THE_MINIMUM: f64 = 0.3;

/// Least number of steps of an [`approach`]. Larger: more time per mesh. Smaller: dual variables that still belong to
/// the rows of the coarser mesh. Chosen.
const LEAST_STEPS_OF_AN_APPROACH: usize = 3;

/// Minimises the problem (1) of the module from densities strictly inside the limits. The objective may change from
/// step to step while its price is still being found; nothing is proven or compared before. Returns `None` if the
/// matrix is singular to rounding.
/// # Errors
///
/// Refuses cells of the normal matrix that miss too much of the mean square ([`JointError::CellsTooLarge`]). Fails
/// where the motion cannot be simulated.
pub fn solve(
    program: &Program<'_>,
    start: Start,
    stop: &Stop,
    merit: &mut Merit<'_>,
) -> Result<Option<Solution>, JointError> {
    let mut search = Search::new(program, start, *stop, merit);
    loop {
        let look = search.look();
        let look = search.refer(look, merit)?;
        if look.decides() {
            let Some(gap_nm2) = search.prove(&look, merit) else { return Ok(None) };
            match search.conclude(&look, gap_nm2) {
                Next::End(end) => return Ok(search.solution(end)),
                Next::Move => {
                    search.move_towards_solution(&look, merit);
                    continue;
                }
                Next::KeepTangents => search.keep_tangents(gap_nm2),
                Next::Step => {}
            }
        }
        if search.step(merit).is_none() {
            return Ok(None);
        }
    }
}

/// Iterate near the minimum; its distance from the minimum is not proven.
#[derive(Clone, Debug)]
pub struct Approach {
    /// Densities of the nodes (D, n), s/mm.
    pub density: Vec<f64>,
    /// Dual variables of the rows (z) and of the bounds (y, n).
    pub duals: [Vec<f64>; 2],
    /// Objective (f), nm^2.
    pub value: f64,
    /// Mean product of a slack and its dual variable, nm^2.
    pub mean_product: f64,
    /// Number of steps.
    pub iterations: usize,
}

/// Goes towards the minimum of the problem (1) of the module without a proof. It ends after `max_iterations` steps, or
/// when the complementarity is at most the fraction `near` of the objective, but not before three steps. Returns `None`
/// if the matrix is singular to rounding.
///
/// # Errors
///
/// Fails as [`solve`] does.
pub fn approach(
    program: &Program<'_>,
    start: Start,
    near: f64,
    max_iterations: usize,
    merit: &mut Merit<'_>,
) -> Result<Option<Approach>, JointError> {
    let row_of = program.normal.row_of();
    let f = merit.evaluate(FIRST, &start.density).0;
    let mut at = Iterate::new(program, start, f);
    let mut iterations = 0;
    let mut complementarity = at.complementarity();
    let mut referred_at = complementarity;
    while iterations < max_iterations
        && (iterations < LEAST_STEPS_OF_AN_APPROACH || complementarity > near * at.f.value)
    {
        let Some(step) = at.step(&row_of) else { return Ok(None) };
        let by_tangents = at.advance(&step);
        iterations += 1;
        let there = Progress { iteration: iterations, complementarity: by_tangents };
        complementarity = at.complementarity();
        if complementarity <= REFERRED_AGAIN * referred_at {
            merit.refer_to(there, &at.density, true)?;
            referred_at = complementarity;
        }
        at.f = merit.evaluate(there, &at.density).0;
    }
    let mean_product = complementarity / (at.c.len() + at.room.len()) as f64;
    let Iterate { density, z, y, f, .. } = at;
    Ok(Some(Approach { density, duals: [z, y], value: f.value, mean_product, iterations }))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        curve::{Rounding, curves},
        limits::LimitRows,
        merit::Price,
        mesh::Mesh,
    };
    use clarabel::{
        algebra::CscMatrix,
        solver::{DefaultSettingsBuilder, DefaultSolver, IPSolver, SupportedConeT},
    };
    use ndarray::Array2;
    use planish_dwell::residual::{Free, Residual};
    use planish_numerics::linear::skyline::dot;
    use planish_types::{
        Axis, End, Grid, Limits, MachineFile, MachineFileAxis, Surface, Tif, ToolPath,
    };

    pub(super) fn machine(velocity: f64, acceleration: f64) -> Limits {
        let axis = |name: &str, factor: f64| MachineFileAxis {
            name: name.into(),
            max_velocity_mm_per_s: factor * velocity,
            max_acceleration_mm_per_s2: factor * acceleration,
            max_jerk_mm_per_s3: None,
            ..MachineFileAxis::default()
        };
        let axes = vec![axis("x", 1.0), axis("y", 0.6)];
        MachineFile { name: "test".into(), axes, min_segment_s: 0.0, ..MachineFile::default() }
            .checked()
            .unwrap()
    }

    fn sparse(rows: &[Vec<(usize, f64)>], columns: usize) -> CscMatrix<f64> {
        let mut triplets: (Vec<usize>, Vec<usize>, Vec<f64>) = Default::default();
        for (i, row) in rows.iter().enumerate() {
            for (j, v) in row.iter().filter(|(_, v)| *v != 0.0) {
                triplets.0.push(i);
                triplets.1.push(*j);
                triplets.2.push(*v);
            }
        }
        CscMatrix::new_from_triplets(rows.len(), columns, triplets.0, triplets.1, triplets.2)
    }

    /// Returns a small case: a map with a bump, a tool, and a raster of eight lines.
    pub(super) fn part() -> (Surface, Tif, ToolPath) {
        let own = Axis::new(-2.0, 0.25, 17).unwrap();
        let g = Grid { x: own, y: own };
        let rate = Array2::from_shape_fn(g.shape(), |(r, c)| {
            20.0 * (-(g.x.coordinate_mm(c).powi(2) + g.y.coordinate_mm(r).powi(2)) / 0.8).exp()
        });
        let tif = Tif::new(g, rate).unwrap();
        let axis = |n: usize| Axis::new(0.0, 0.25, n).unwrap();
        let grid = Grid { x: axis(41), y: axis(21) };
        let z = Array2::from_shape_fn(grid.shape(), |(r, c)| {
            let bump = (-((c as f64 - 14.0).powi(2) + (r as f64 - 9.0).powi(2)) / 30.0).exp();
            20.0 + 15.0 * bump + 3.0 * (0.2 * c as f64).sin()
        });
        let desired = Surface::new(grid, z).unwrap();
        let mut points = Vec::new();
        for line in 0..8 {
            let (y, ends) = (0.9 * f64::from(line) - 0.6, [-2.0, 12.0]);
            let (from, to) = if line % 2 == 0 { (ends[0], ends[1]) } else { (ends[1], ends[0]) };
            points.extend([[from, y], [to, y]]);
        }
        let n = points.len() - 1;
        let path = ToolPath::through(points, vec![true; n], vec![0; n]).unwrap();
        (desired, tif, path)
    }

    /// Compares with another solver on the convex program of the last iterate: the objective is exactly quadratic, and
    /// the rows are tangents.
    #[test]
    fn the_certificate_holds_by_another_solver() {
        let (desired, tif, path) = part();
        let curves = curves(&path, &Rounding { deviation_mm: 0.1, radius_mm: 0.5 }).curves;
        let mesh = Mesh::new(&curves, &path, 0.7).unwrap();
        let residual = Residual::new(&desired, &tif, &mesh.points_mm, None, Free::Piston).unwrap();
        let normal = residual.normal(&mesh.columns(), None).unwrap();
        let strongest = normal.matrix.diagonal().into_iter().fold(0.0, f64::max);
        let lengths = mesh.lengths_mm();
        for (acceleration, price, alpha) in [(400.0, 1e-4, 1e-4), (4000.0, 1e-3, 1e-3)] {
            let rows = LimitRows::new(&curves, &mesh, &machine(60.0, acceleration), 0.1);
            let lo = rows.least_density().to_vec();
            let tikhonov = alpha;
            let alpha = alpha * strongest;
            let objective = |d: &[f64]| {
                let at = residual.evaluate(&mesh.times_s(d));
                let mut gradient = mesh.collect(&at.gradient_nm2_per_s);
                let mut value = at.half_mean_square_nm2;
                for j in 0..mesh.nodes {
                    value += price * lengths[j] * d[j] + 0.5 * alpha * (d[j] - lo[j]).powi(2);
                    gradient[j] += price * lengths[j] + alpha * (d[j] - lo[j]);
                }
                (value, gradient)
            };
            let least = lo.iter().copied().fold(rows.least_uniform_density(), f64::max);
            let stop = Stop { relative_gap: 1e-3, max_iterations: 100 };
            let density = vec![(1.05 * least).max(0.3); mesh.nodes];
            let wanted = Price::Nm2PerS(price);
            let weights = (tikhonov, 0.0);
            let mut merit = Merit::new(&residual, &normal, &mesh, &lo, weights, wanted, &density);
            let chain = merit.chain();
            let chain = (&chain.0[..], &chain.1[..]);
            let program = Program { normal: &normal, chain, lo: &lo, rows: &rows };
            let start = Start { density: density.clone(), duals: None };
            let solution = solve(&program, start, &stop, &mut merit).unwrap().unwrap();
            assert_eq!(solution.end, End::Optimal);
            let d = &solution.density;
            // Where it ended f is that of the removal itself; far from there what the cells lose is missing, some
            // percent of what the difference of the densities removes.
            let there = Progress { iteration: 0, complementarity: 0.0 };
            let (value, gradient) = objective(d);
            // Rounding of sums over the pixels, by two orders of the same terms.
            assert!((solution.objective.last().unwrap() / value - 1.0).abs() < 1e-9);
            let (far, before) = (merit.evaluate(there, &density).0, objective(&density));
            let x: Vec<f64> = density.iter().zip(d).map(|(a, b)| a - b).collect();
            let linear = value + dot(&gradient, &x);
            assert!((far.value - before.0).abs() < 0.02 * (before.0 - linear), "{}", far.value);
            // Cells are of one pixel here, so what proves is the curvature of the removal, exactly: f is quadratic.
            let product = merit.lower_curvature(&x);
            let largest = product.iter().fold(0.0f64, |m, v| m.max(v.abs()));
            for ((found, a), b) in product.iter().zip(&before.1).zip(&gradient) {
                // Rounding, as above.
                assert!((found - (a - b)).abs() < 1e-9 * largest, "{found} {}", a - b);
            }
            assert!(rows.slacks(d).iter().all(|c| *c > 0.0));
            assert!(d.iter().zip(&lo).all(|(d, lo)| d > lo));

            // f(D + x) = f + f' x + x' H x / 2, H column by column from differences, exact for a quadratic
            let mut h = vec![Vec::new(); mesh.nodes];
            for j in 0..mesh.nodes {
                let mut moved = d.clone();
                moved[j] += 1.0;
                let column = objective(&moved).1;
                for i in 0..=j {
                    h[i].push((j, column[i] - gradient[i]));
                }
            }
            // -J x <= c, -x <= D - lo
            let constraints = rows.constraints(d);
            let mut a: Vec<Vec<(usize, f64)>> = constraints
                .iter()
                .map(|row| (0..2).filter_map(|k| row.nodes[k].map(|n| (n, -row.by[k]))).collect())
                .collect();
            a.extend((0..mesh.nodes).map(|j| vec![(j, -1.0)]));
            let mut b: Vec<f64> = constraints.iter().map(|row| row.slack).collect();
            b.extend(d.iter().zip(&lo).map(|(d, lo)| d - lo));
            let settings = DefaultSettingsBuilder::default().verbose(false).build().unwrap();
            let cones = [SupportedConeT::NonnegativeConeT(b.len())];
            let (h, a) = (sparse(&h, mesh.nodes), sparse(&a, mesh.nodes));
            let mut other = DefaultSolver::new(&h, &gradient, &a, &b, &cones, settings).unwrap();
            other.solve();
            let could_fall = -other.solution.obj_val;
            // What is left to gain is real, and within the certificate; clarabel's tolerance is 1e-8.
            assert!(could_fall > -1e-7 * value, "{could_fall} of {value}");
            // The tolerance of clarabel, 1e-8 of the objective, beside a gap of up to 1e-3.
            assert!(could_fall <= solution.relative_gap * value * (1.0 + 1e-6));
            // The gap at which it stops.
            assert!(solution.relative_gap <= 1e-3);
            // Rows decide: without them the objective would be lower.
            let active = constraints.iter().filter(|row| row.slack < 1e-3).count();
            assert!(active > 5, "{active} rows are active");
        }
    }
}
