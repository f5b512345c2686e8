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
//! with H the surrogate of the curvature of f, f' exact, and mu by Mehrotra's predictor and corrector. Then Gondzio's
//! corrections bring products of slacks and dual variables that have become outliers back towards mu; without them the
//! steps end early at a few rows that are far from being active. A step ends where a row would lose more than most
//! of what it has left, measured on c itself: every iterate can be executed. The matrix keeps the skyline of H, because
//! a row couples neighbours only.
//!
//! The certificate is the gap of the convex program of the last iterate, f over the tangents of the rows, with the
//! dual variables z >= 0 and y >= 0:
//!
//! ```text
//! f - min <= z' c + y' (D - lo) + sum over r_j < 0 of r_j^2 / (2 alpha),   r = f' - J' z - y        (3)
//! ```
//!
//! where y takes what is positive of r. Sources: S. Mehrotra, SIAM J. Optim. 2 (1992) 575; J. Gondzio, Comput. Optim.
//! Appl. 6 (1996) 137; for programs that are convex but for their rows T. Lipp and S. Boyd, Optim. Eng. 17 (2016) 263.

use planish_dwell::residual::Normal;
use planish_numerics::linear::{skyline::dot, woodbury::Woodbury};
use planish_types::End;

use crate::limits::{Constraint, Rows};

/// Fraction of a slack or dual variable that a step may take.
const STEP_TO_BOUNDARY: f64 = 0.95;

/// By what a step is shortened until no row loses too much.
const BACKTRACKING: f64 = 0.8;

/// Least centring: mu falls to no less than this fraction in a step.
const LEAST_CENTRING: f64 = 1e-3;

/// Most corrections of a step that bring outlying products back.
const MAX_CENTRALITY_CORRECTIONS: usize = 3;

/// By how much further than a step the products are looked at that a correction shall bring back.
const FURTHER: f64 = 0.3;

/// Part of that by which a correction must lengthen the step to be worth another one.
const LEAST_GAIN: f64 = 0.1;

/// A product further than this factor from mu is an outlier.
const OUTLIER: f64 = 10.0;

/// Gap at the start over the objective there.
const FIRST_RELATIVE_GAP: f64 = 0.3;

/// Least product of a slack and its dual variable at the start, over their mean.
const LEAST_PRODUCT: f64 = 0.1;

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
    /// z (rows) and y (n) at the last one.
    pub duals: [Vec<f64>; 2],
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

/// How the method came to an iterate.
#[derive(Clone, Copy, Debug)]
pub struct Progress {
    /// 0 at the start.
    pub iteration: usize,
    /// c z + (D - lo) y, summed: about how far the objective is above its least value, nm^2.
    pub complementarity: f64,
}

/// Where to begin.
#[derive(Clone, Debug)]
pub struct Start {
    /// D (n), strictly inside.
    pub density: Vec<f64>,
    /// z and y of a program with nearly the same rows, if there was one.
    pub duals: Option<[Vec<f64>; 2]>,
}

/// Minimises (1) from densities strictly inside; `objective` may change from step to step (a price that is still
/// being found) as long as it says so: the first value that it returns with `true` is the first that counts.
pub fn solve(
    program: &Program<'_>,
    start: Start,
    stop: &Stop,
    mut objective: impl FnMut(Progress, &[f64]) -> (Objective, bool),
) -> Option<Solution> {
    let Program { normal, alpha, lo, rows, .. } = *program;
    let n = start.density.len();
    let mut row_of = vec![0; n];
    normal.order.iter().enumerate().for_each(|(i, j)| row_of[*j] = i);
    let mut density = start.density;
    let (mut f, mut settled) =
        objective(Progress { iteration: 0, complementarity: f64::INFINITY }, &density);
    let mut here = rows.constraints(&density);
    let mut c: Vec<f64> = here.iter().map(|row| row.slack).collect();
    let members = (rows.len() + n) as f64;
    let room: Vec<f64> = density.iter().zip(lo).map(|(d, lo)| d - lo).collect();
    let [mut z, mut y] = match start.duals {
        Some([z, y]) => {
            // Products far below their mean would hold the steps back.
            let least = LEAST_PRODUCT * (dot(&c, &z) + dot(&room, &y)) / members;
            let raised = |v: Vec<f64>, slack: &[f64]| -> Vec<f64> {
                v.into_iter().zip(slack).map(|(v, slack)| v.max(least / slack)).collect()
            };
            [raised(z, &c), raised(y, &room)]
        }
        None => {
            let mu = FIRST_RELATIVE_GAP * f.value / members;
            [&c, &room].map(|slack| slack.iter().map(|c| mu / c).collect())
        }
    };
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

        let at =
            Iterate { program, density: &density, here: &here, c: &c, room: &room, z: &z, y: &y };
        let inverse = at.inverse(&row_of)?;
        let towards = |t: &Products| at.direction(&f.gradient, &inverse, t);
        let zero = Products { rows: vec![0.0; c.len()], bounds: vec![0.0; n] };
        let predictor = towards(&zero);
        let after = at.products(&predictor, at.primal(&predictor).0, at.dual(&predictor));
        let centring = (after.sum() / complementarity).powi(3).clamp(LEAST_CENTRING, 1.0);
        let mu = centring * complementarity / members;
        let second = at.second_order(&predictor);
        let centred = Products { rows: vec![mu; c.len()], bounds: vec![mu; n] };
        let mut target = centred.minus(&second);
        let mut step = towards(&target);
        for _ in 0..MAX_CENTRALITY_CORRECTIONS {
            let (a, b) = (at.by_tangents(&step), at.dual(&step));
            let [further_a, further_b] = [a, b].map(|v| (v + FURTHER).min(1.0));
            let correction = at.products(&step, further_a, further_b).correction(mu);
            let corrected = target.plus(&correction);
            let next = towards(&corrected);
            let gained = (at.by_tangents(&next) - a, at.dual(&next) - b);
            if gained.0.min(gained.1) < 0.0 || gained.0.max(gained.1) < LEAST_GAIN * FURTHER {
                break;
            }
            (target, step) = (corrected, next);
        }
        let (length, to) = at.primal(&step);
        let b = at.dual(&step);
        let after = at.products(&step, length, b);
        density = to;
        z.iter_mut().zip(&step.z).for_each(|(z, d)| *z += b * d);
        y.iter_mut().zip(&step.y).for_each(|(y, d)| *y += b * d);
        iteration += 1;
        here = rows.constraints(&density);
        c = here.iter().map(|row| row.slack).collect();
        (f, settled) = objective(Progress { iteration, complementarity: after.sum() }, &density);
    };
    let (_, density, relative_gap) = best?;
    Some(Solution { density, objective: values, duals: [z, y], relative_gap, end })
}

/// (2).
struct Step {
    density: Vec<f64>,
    /// J d.
    c: Vec<f64>,
    z: Vec<f64>,
    y: Vec<f64>,
}

/// Of a slack and its dual variable: c z (rows) and (D - lo) y (n).
struct Products {
    rows: Vec<f64>,
    bounds: Vec<f64>,
}

impl Products {
    fn sum(&self) -> f64 {
        self.rows.iter().sum::<f64>() + self.bounds.iter().sum::<f64>()
    }

    fn combined(&self, other: &Self, of: impl Fn(f64, f64) -> f64) -> Self {
        let each = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| of(*a, *b)).collect();
        Self { rows: each(&self.rows, &other.rows), bounds: each(&self.bounds, &other.bounds) }
    }

    fn plus(&self, other: &Self) -> Self {
        self.combined(other, |a, b| a + b)
    }

    fn minus(&self, other: &Self) -> Self {
        self.combined(other, |a, b| a - b)
    }

    /// What brings outliers back to where they are no more than a decade from `mu`.
    fn correction(&self, mu: f64) -> Self {
        let of = |v: &f64| (v.clamp(mu / OUTLIER, mu * OUTLIER) - v).max(-mu * OUTLIER);
        Self {
            rows: self.rows.iter().map(of).collect(),
            bounds: self.bounds.iter().map(of).collect(),
        }
    }
}

/// Where the method stands.
struct Iterate<'a> {
    program: &'a Program<'a>,
    density: &'a [f64],
    here: &'a [Constraint],
    /// Slacks of the rows and of the bounds, and their dual variables.
    c: &'a [f64],
    room: &'a [f64],
    z: &'a [f64],
    y: &'a [f64],
}

impl Iterate<'_> {
    /// The matrix of (2), factorised; `row_of` has the row of every node. `None` if it is singular to rounding.
    fn inverse(&self, row_of: &[usize]) -> Option<Woodbury> {
        let Program { normal, chain, .. } = self.program;
        let n = row_of.len();
        let mut k = normal.matrix.k.clone();
        let mut diagonal: Vec<f64> =
            (0..n).map(|j| chain.0[j] + self.y[j] / self.room[j]).collect();
        let mut below = chain.1.to_vec();
        for ((row, z), c) in self.here.iter().zip(self.z).zip(self.c) {
            let (s, by, bend) = (z / c, row.by, row.bend.map(|b| z * b));
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
        Woodbury::new(k.factorise()?, normal.matrix.u.clone())
    }

    /// (2) with `target` in place of mu.
    fn direction(&self, gradient: &[f64], inverse: &Woodbury, target: &Products) -> Step {
        let Self { program, here, c, room, z, y, .. } = self;
        let order = &program.normal.order;
        let t = target.bounds.iter().zip(*room).map(|(t, room)| t / room);
        let mut rhs: Vec<f64> = gradient.iter().zip(t).map(|(g, t)| t - g).collect();
        add_adjoint(here, |i| target.rows[i] / c[i], &mut rhs);
        let mut b: Vec<f64> = order.iter().map(|j| rhs[*j]).collect();
        inverse.solve(&mut b);
        let mut d = vec![0.0; rhs.len()];
        order.iter().zip(b).for_each(|(j, b)| d[*j] = b);
        let j_d = along(here, &d);
        let of_z = |i: usize| (target.rows[i] - z[i] * j_d[i]) / c[i] - z[i];
        let of_y = |j: usize| (target.bounds[j] - y[j] * d[j]) / room[j] - y[j];
        Step {
            z: (0..c.len()).map(of_z).collect(),
            y: (0..d.len()).map(of_y).collect(),
            c: j_d,
            density: d,
        }
    }

    /// The longest step by the tangents of the rows.
    fn by_tangents(&self, step: &Step) -> f64 {
        longest(self.room, &step.density).min(longest(self.c, &step.c))
    }

    /// The longest step by the rows themselves, and where it ends.
    fn primal(&self, step: &Step) -> (f64, Vec<f64>) {
        // The tangents say nearly how far.
        let mut length = self.by_tangents(step);
        loop {
            let moved = self.density.iter().zip(&step.density).map(|(d, s)| d + length * s);
            let to: Vec<f64> = moved.collect();
            let after = self.program.rows.slacks(&to);
            let keeps = |(after, before): (&f64, &f64)| *after >= (1.0 - STEP_TO_BOUNDARY) * before;
            if after.iter().zip(self.c).all(keeps) || length < f64::EPSILON {
                return (length, to);
            }
            length *= BACKTRACKING;
        }
    }

    fn dual(&self, step: &Step) -> f64 {
        longest(self.z, &step.z).min(longest(self.y, &step.y))
    }

    /// The products after a primal step of length `a` and a dual one of length `b`, by the tangents.
    fn products(&self, step: &Step, a: f64, b: f64) -> Products {
        let of = |v: &[f64], dv: &[f64], z: &[f64], dz: &[f64]| {
            (0..v.len()).map(|i| (v[i] + a * dv[i]) * (z[i] + b * dz[i])).collect()
        };
        Products {
            rows: of(self.c, &step.c, self.z, &step.z),
            bounds: of(self.room, &step.density, self.y, &step.y),
        }
    }

    /// What a full step changes the products by in the second order.
    fn second_order(&self, step: &Step) -> Products {
        let of = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).collect();
        Products { rows: of(&step.c, &step.z), bounds: of(&step.density, &step.y) }
    }
}

/// The longest step, at most 1, after which no component of `v` is below a twentieth of itself.
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
        let curves = curves(&path, &Rounding { deviation_mm: 0.1, radius_mm: 0.5 }).curves;
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
            let density = vec![(1.05 * least).max(0.3); mesh.nodes];
            let start = Start { density, duals: None };
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
