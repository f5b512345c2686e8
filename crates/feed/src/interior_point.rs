//! The least objective under the rows: an interior point method for densities.
//!
//! ```text
//! min f(D)   subject to   c_i(D_j, D_k) >= 0,   D >= lo                                          (1)
//! ```
//!
//! f is convex, c is not concave everywhere: (1) is not convex. Every step is that of a primal-dual method, with of
//! the curvature of every c the part that bends it downwards (C_i, positive semidefinite) alone,
//!
//! ```text
//! (H + sum_i z_i C_i + J' Z/c J + Y/(D - lo)) d = -f' + J' (mu/c) + mu/(D - lo)
//! dz = mu/c - z - Z/c J d,   dy = mu/(D - lo) - y - Y/(D - lo) d                                  (2)
//! ```
//!
//! with H the surrogate of the curvature of f, f' exact, and mu by Mehrotra's predictor and corrector. A step ends
//! where a row would lose more than most of what it has left, measured on c itself: every iterate can be
//! executed. The matrix keeps the skyline of H, because a row couples neighbours only.
//!
//! The certificate is the gap of the convex program of the last iterate, f over the tangents of the rows, with the
//! dual variables z >= 0 and y >= 0:
//!
//! ```text
//! f - min <= z' c + y' (D - lo) + sum over r_j < 0 of r_j^2 / (2 alpha),   r = f' - J' z - y        (3)
//! ```
//!
//! where y takes what is positive of r. Sources: S. Mehrotra, SIAM J. Optim. 2 (1992) 575; for programs that are
//! convex but for their rows T. Lipp and S. Boyd, Optim. Eng. 17 (2016) 263.

use planish_dwell::residual::Normal;
use planish_numerics::linear::{skyline::dot, woodbury::Woodbury};
use planish_types::End;

use crate::limits::{Constraint, Rows};

/// Fraction of a slack or dual variable that a step may take.
const STEP_TO_BOUNDARY: f64 = 0.99;

/// By what a step is shortened until no row loses too much.
const BACKTRACKING: f64 = 0.8;

/// Least centring: mu falls to no less than this fraction in a step.
const LEAST_CENTRING: f64 = 1e-3;

/// Shorter predictor steps say nothing of the second order.
const LEAST_CORRECTED_STEP: f64 = 0.1;

/// Gap at the start over the objective there.
const FIRST_RELATIVE_GAP: f64 = 0.3;

/// f and f' at densities.
pub struct Objective {
    /// nm^2.
    pub value: f64,
    /// By the densities (n).
    pub gradient: Vec<f64>,
}

/// (1).
pub struct Program<'a> {
    /// Curvature of f without its chain, in an order of its own.
    pub normal: &'a Normal,
    /// Curvature of f beside it: diagonal (n), and element (j, j - 1) for every j (n; the first unused).
    pub chain: (&'a [f64], &'a [f64]),
    /// A lower bound of the curvature of f, > 0.
    pub alpha: f64,
    /// lo (n).
    pub lo: &'a [f64],
    /// c.
    pub rows: &'a Rows<'a>,
}

/// When to stop.
#[derive(Clone, Copy, Debug)]
pub struct Stop {
    /// Gap (3) over the objective.
    pub relative_gap: f64,
    /// Most steps.
    pub max_iterations: usize,
}

/// The best iterate.
#[derive(Clone, Debug)]
pub struct Solution {
    /// D (n).
    pub density: Vec<f64>,
    /// f at every iterate, nm^2.
    pub objective: Vec<f64>,
    /// (3) over f at the last one.
    pub relative_gap: f64,
    /// `optimal` or `iteration-limit`.
    pub end: End,
}

/// J d.
fn along(rows: &[Constraint], d: &[f64]) -> Vec<f64> {
    let of =
        |row: &Constraint| (0..2).map(|k| row.nodes[k].map_or(0.0, |n| row.by[k] * d[n])).sum();
    rows.iter().map(of).collect()
}

/// `out += J' v`.
fn add_adjoint(rows: &[Constraint], v: impl Fn(usize) -> f64, out: &mut [f64]) {
    for (i, row) in rows.iter().enumerate() {
        let v = v(i);
        for k in 0..2 {
            if let Some(n) = row.nodes[k] {
                out[n] += row.by[k] * v;
            }
        }
    }
}

/// Minimises (1) from densities strictly inside; `objective` may change from step to step (a price that is still
/// being found) as long as it says so: the first value that it returns with `true` is the first that counts.
pub fn solve(
    program: &Program<'_>,
    start: Vec<f64>,
    stop: &Stop,
    mut objective: impl FnMut(usize, &[f64]) -> (Objective, bool),
) -> Option<Solution> {
    let Program { normal, chain, alpha, lo, rows } = *program;
    let n = start.len();
    let mut row_of = vec![0; n];
    normal.order.iter().enumerate().for_each(|(i, j)| row_of[*j] = i);
    let mut density = start;
    let (mut f, mut settled) = objective(0, &density);
    let mut here = rows.constraints(&density);
    let mut c: Vec<f64> = here.iter().map(|row| row.slack).collect();
    let members = (rows.len() + n) as f64;
    let first_mu = FIRST_RELATIVE_GAP * f.value / members;
    let mut z: Vec<f64> = c.iter().map(|c| first_mu / c).collect();
    let mut y: Vec<f64> = density.iter().zip(lo).map(|(d, lo)| first_mu / (d - lo)).collect();
    let mut best: Option<(f64, Vec<f64>, f64)> = None;
    let (mut values, mut iteration) = (Vec::new(), 0);
    let end = loop {
        let room: Vec<f64> = density.iter().zip(lo).map(|(d, lo)| d - lo).collect();
        // r = f' - J' z - y
        let mut j_z = vec![0.0; n];
        add_adjoint(&here, |i| z[i], &mut j_z);
        let complementarity = dot(&c, &z) + dot(&room, &y);
        let certified: f64 = dot(&c, &z)
            + (0..n)
                .map(|j| match f.gradient[j] - j_z[j] {
                    r if r > 0.0 => r * room[j],
                    r => r * r / (2.0 * alpha),
                })
                .sum::<f64>();
        let relative_gap = certified / f.value;
        values.push(f.value);
        if !settled || best.as_ref().is_none_or(|b| f.value <= b.0) {
            best = Some((f.value, density.clone(), relative_gap));
        }
        if settled && relative_gap <= stop.relative_gap {
            best = Some((f.value, density.clone(), relative_gap));
            break End::Optimal;
        }
        if iteration >= stop.max_iterations {
            break End::IterationLimit;
        }

        // The matrix of (2)
        let mut k = normal.matrix.k.clone();
        let mut diagonal: Vec<f64> = (0..n).map(|j| chain.0[j] + y[j] / room[j]).collect();
        let mut below = chain.1.to_vec();
        for (i, row) in here.iter().enumerate() {
            let (s, by, bend) = (z[i] / c[i], row.by, row.bend.map(|b| z[i] * b));
            for e in 0..2 {
                if let Some(j) = row.nodes[e] {
                    diagonal[j] += s * by[e] * by[e] + bend[2 * e];
                }
            }
            if let [Some(_), Some(b)] = row.nodes {
                below[b] += s * by[0] * by[1] + bend[1];
            }
        }
        for j in 0..n {
            k.add(row_of[j], row_of[j], diagonal[j]);
            if j > 0 && below[j] != 0.0 {
                let (a, b) = (row_of[j - 1], row_of[j]);
                k.add(a.max(b), a.min(b), below[j]);
            }
        }
        let inverse = Woodbury::new(k.factorise()?, normal.matrix.u.clone())?;
        let step = |mu: f64, second: Option<&Step>| {
            let c_second = |i: usize| second.map_or(0.0, |s| s.c[i] * s.z[i]);
            let y_second = |j: usize| second.map_or(0.0, |s| s.density[j] * s.y[j]);
            let mut rhs: Vec<f64> =
                (0..n).map(|j| -f.gradient[j] + (mu - y_second(j)) / room[j]).collect();
            add_adjoint(&here, |i| (mu - c_second(i)) / c[i], &mut rhs);
            let mut b: Vec<f64> = normal.order.iter().map(|j| rhs[*j]).collect();
            inverse.solve(&mut b);
            let mut d = vec![0.0; n];
            normal.order.iter().zip(b).for_each(|(j, b)| d[*j] = b);
            let j_d = along(&here, &d);
            let of_z = |i: usize| (mu - c_second(i) - z[i] * j_d[i]) / c[i] - z[i];
            let of_y = |j: usize| (mu - y_second(j) - y[j] * d[j]) / room[j] - y[j];
            Step {
                z: (0..rows.len()).map(of_z).collect(),
                y: (0..n).map(of_y).collect(),
                c: j_d,
                density: d,
            }
        };
        let primal = |s: &Step| {
            // The tangents say nearly how far.
            let mut length = longest(&room, &s.density).min(longest(&c, &s.c));
            loop {
                let to: Vec<f64> =
                    density.iter().zip(&s.density).map(|(d, s)| d + length * s).collect();
                let after = rows.slacks(&to);
                let keeps =
                    |(after, before): (&f64, &f64)| *after >= (1.0 - STEP_TO_BOUNDARY) * before;
                if after.iter().zip(&c).all(keeps) || length < f64::EPSILON {
                    return (length, to);
                }
                length *= BACKTRACKING;
            }
        };
        let dual = |s: &Step| longest(&z, &s.z).min(longest(&y, &s.y));
        let predictor = step(0.0, None);
        let (a, b) = (primal(&predictor).0, dual(&predictor));
        let moved = |v: &[f64], d: &[f64], a: f64, z: &[f64], dz: &[f64], b: f64| -> f64 {
            (0..v.len()).map(|i| (v[i] + a * d[i]) * (z[i] + b * dz[i])).sum()
        };
        let after = moved(&c, &predictor.c, a, &z, &predictor.z, b)
            + moved(&room, &predictor.density, a, &y, &predictor.y, b);
        let centring = (after / complementarity).powi(3).clamp(LEAST_CENTRING, 1.0);
        let mu = centring * complementarity / members;
        let corrector = step(mu, (a > LEAST_CORRECTED_STEP).then_some(&predictor));
        let (_, to) = primal(&corrector);

        let b = dual(&corrector);
        density = to;
        z.iter_mut().zip(&corrector.z).for_each(|(z, d)| *z += b * d);
        y.iter_mut().zip(&corrector.y).for_each(|(y, d)| *y += b * d);
        iteration += 1;
        here = rows.constraints(&density);
        c = here.iter().map(|row| row.slack).collect();
        (f, settled) = objective(iteration, &density);
    };
    let (_, density, relative_gap) = best?;
    Some(Solution { density, objective: values, relative_gap, end })
}

/// (2).
struct Step {
    density: Vec<f64>,
    /// J d.
    c: Vec<f64>,
    z: Vec<f64>,
    y: Vec<f64>,
}

/// The longest step, at most 1, after which no component of `v` is below a hundredth of itself.
fn longest(v: &[f64], d: &[f64]) -> f64 {
    let of = |(v, d): (&f64, &f64)| if *d < 0.0 { -STEP_TO_BOUNDARY * v / d } else { 1.0 };
    v.iter().zip(d).map(of).fold(1.0, f64::min)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        curve::{Rounding, curves},
        mesh::Mesh,
    };
    use clarabel::{
        algebra::CscMatrix,
        solver::{DefaultSettingsBuilder, DefaultSolver, IPSolver, SupportedConeT},
    };
    use ndarray::Array2;
    use planish_dwell::residual::{Free, Residual};
    use planish_types::{Axis, Grid, Limits, MachineFile, MachineFileAxis, Surface, Tif, ToolPath};

    fn machine(velocity: f64, acceleration: f64) -> Limits {
        let axis = |name: &str, factor: f64| MachineFileAxis {
            name: name.into(),
            max_velocity_mm_per_s: factor * velocity,
            max_acceleration_mm_per_s2: factor * acceleration,
            max_jerk_mm_per_s3: None,
        };
        let axes = vec![axis("x", 1.0), axis("y", 0.6)];
        MachineFile { name: "test".into(), axes, min_segment_s: 0.0 }.checked().unwrap()
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

    /// Another solver on the convex program of the last iterate: f is exactly quadratic, the rows are tangents.
    #[test]
    fn the_certificate_holds_by_another_solver() {
        let own = Axis::new(-2.0, 0.25, 17).unwrap();
        let g = Grid { x: own, y: own };
        let rate = Array2::from_shape_fn(g.shape(), |(r, c)| {
            20.0 * (-(g.x.at(c).powi(2) + g.y.at(r).powi(2)) / 0.8).exp()
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
        let curves = curves(&path, &Rounding { deviation_mm: 0.1, radius_mm: 0.5 });
        let mesh = Mesh::new(&curves, &path, 0.7).unwrap();
        let residual = Residual::new(&desired, &tif, &mesh.points_mm, None, Free::Piston).unwrap();
        let normal = residual.normal(&mesh.columns()).unwrap();
        let strongest = normal.matrix.diagonal().into_iter().fold(0.0, f64::max);
        let lengths = mesh.lengths_mm();
        for (acceleration, price, alpha) in [(400.0, 1e-4, 1e-4), (4000.0, 1e-3, 1e-3)] {
            let rows = Rows::new(&curves, &mesh, &machine(60.0, acceleration), 0.1);
            let lo = rows.least_density().to_vec();
            let alpha = alpha * strongest;
            let objective = |d: &[f64]| {
                let at = residual.evaluate(&mesh.times_s(d));
                let mut gradient = mesh.collect(&at.gradient_nm2_per_s);
                let mut value = at.half_mean_square_nm2;
                for j in 0..mesh.nodes {
                    value += price * lengths[j] * d[j] + 0.5 * alpha * (d[j] - lo[j]).powi(2);
                    gradient[j] += price * lengths[j] + alpha * (d[j] - lo[j]);
                }
                Objective { value, gradient }
            };
            let (diagonal, below) = (vec![alpha; mesh.nodes], vec![0.0; mesh.nodes]);
            let program = Program {
                normal: &normal,
                chain: (&diagonal, &below),
                alpha,
                lo: &lo,
                rows: &rows,
            };
            let least = lo.iter().copied().fold(rows.least_uniform_density(), f64::max);
            let stop = Stop { relative_gap: 1e-3, max_iterations: 100 };
            let start = vec![(1.05 * least).max(0.3); mesh.nodes];
            let solution = solve(&program, start, &stop, |_, d| (objective(d), true)).unwrap();
            assert_eq!(solution.end, End::Optimal);
            let d = &solution.density;
            assert!(rows.slacks(d).iter().all(|c| *c > 0.0));
            assert!(d.iter().zip(&lo).all(|(d, lo)| d > lo));

            // f(D + x) = f + f' x + x' H x / 2, H column by column from differences, exact for a quadratic
            let at = objective(d);
            let mut h = vec![Vec::new(); mesh.nodes];
            for j in 0..mesh.nodes {
                let mut moved = d.clone();
                moved[j] += 1.0;
                let column = objective(&moved).gradient;
                for i in 0..=j {
                    h[i].push((j, column[i] - at.gradient[i]));
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
            let mut other = DefaultSolver::new(&h, &at.gradient, &a, &b, &cones, settings).unwrap();
            other.solve();
            let could_fall = -other.solution.obj_val;
            // What is left to gain is real, and within the certificate; clarabel's tolerance is 1e-8.
            assert!(could_fall > -1e-7 * at.value, "{could_fall} of {}", at.value);
            assert!(could_fall <= solution.relative_gap * at.value * (1.0 + 1e-6));
            assert!(solution.relative_gap <= 1e-3);
            // Rows decide: without them the objective would be lower.
            let active = constraints.iter().filter(|row| row.slack < 1e-3).count();
            assert!(active > 5, "{active} rows are active");
        }
    }
}
