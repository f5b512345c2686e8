//! Objective of the plan, as a function of the densities of the nodes.
//!
//! ```text
//! 1/2 mean square of the residual + lambda T
//!      + 1/2 alpha K sum (D - lo)^2 + 1/2 beta K sum (difference of neighbours)^2        (1)
//! ```
//!
//! K is the largest diagonal element of the normal matrix, so alpha and beta have no unit.
//!
//! The price lambda of a second is given, or follows from the elasticity of the plan. If the mean square of the
//! residual falls by x % when the time grows by 1 %, x is the elasticity; at the minimum of (1)
//!
//! ```text
//! d(1/2 mean square) / dT = -lambda,   x = 2 lambda T / mean square                        (2)
//! ```
//!
//! and the price is the one that gives the elasticity of the settings.
//!
//! The residual is that of the motion. Its removal M(D) is not linear in the densities: between two nodes the motion
//! has the times and feedrates of D at both, but not D itself. So near the minimum, at some densities D_k,
//!
//! ```text
//! removal(D) = B D + M(D_k) - B D_k                                                      (3)
//! ```
//!
//! takes the place of B D, and the linear term
//!
//! ```text
//! g' (D - D_k),   g = (M'(D_k) - B)' times the gradient by the removal at D_k            (4)
//! ```
//!
//! is added to the mean square. The gradient of the mean square at D_k is then that of the motion. (4) does not
//! change the curvature, so the problem stays convex. The solver simulates the motion at every iterate at which it
//! computes the mean square exactly, up to the first one of which it proves something. Up to there g is zero, because
//! steps by another curvature than that of the motion need a line search. The rounds after it have one (`problem`).

use ndarray::Array2;
use planish_dwell::residual::{Evaluation, Normal, Residual};
use planish_numerics::linear::skyline::dot;
use planish_types::Invalid;
use serde::Serialize;

use crate::{JointError, mesh::Mesh};

/// Largest relative change of the price in a step at which the price counts as found and stays. Larger: an elasticity
/// that is met less exactly. Smaller: more steps before anything can be proven. Chosen.
const PRICE_FOUND: f64 = 0.01;

/// Ratio of the complementarity (about the excess of the objective over its least value) to half the mean square below
/// which the price may be found. Larger: the residual is still falling, and the elasticity is missed. Smaller: more
/// steps. Chosen.
const NEARLY_SOLVED: f64 = 0.03;

/// Number of steps after which the price stays as it is, whether it is found or not. Larger: more steps without a
/// proof. Smaller: an elasticity that is missed. Chosen.
const PRICE_STEPS: usize = 40;

/// Ratio of the complementarity to half the mean square below which the motion is simulated. Larger: simulations at
/// densities that are far from those that will be executed. Smaller: fewer steps with the residual of the motion.
/// Chosen.
const SIMULATED_BELOW: f64 = 0.3;

/// Largest fraction of the mean square that the normal matrix on cells of pixels may have missed since the last
/// reference. Larger: steps by a curvature of less than half the true one lead away from the minimum. Smaller: smaller
/// cells, and more time. Chosen: near the minimum between 1e-4 and 0.04 is usual.
const MOST_UNSEEN: f64 = 0.1;

/// Largest ratio of the missed part of the mean square to its fall by the cells. Smaller cells are made only if both
/// this and [`MOST_UNSEEN`] are exceeded. Larger: steps that lead away. Smaller: smaller cells without need on the way
/// to the minimum. Chosen: on that way a hundredth is usual.
const MOST_UNSEEN_OF_FALL: f64 = 0.3;

/// Largest fraction of the mean square that the cells may have missed when it rose although the cells saw a fall.
/// Larger: the next steps by the same curvature go round in circles. Smaller: smaller cells for a rise that is
/// rounding. Chosen.
const MOST_UNSEEN_OF_RISE: f64 = 0.01;

/// Price of time in the objective.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Price {
    /// Fixed price of a second, relative to half the mean square of the residual, nm^2/s.
    Nm2PerS(f64),
    /// Elasticity of the plan, (2) of the module: percentage by which one percent more time would lower the mean
    /// square.
    Elasticity(f64),
}

/// Function that returns the removal of the motion with these densities (nodes), nm: a map like the desired removal.
pub type Executed<'a> = &'a dyn Fn(&[f64]) -> Result<Array2<f64>, Invalid>;

/// Progress of the solver towards the minimum.
#[derive(Clone, Copy, Debug)]
pub struct Progress {
    /// Number of steps so far; 0 at the start.
    pub iteration: usize,
    /// Sum of slacks times dual variables, c z + (D - lo) y, nm^2: about the excess of the objective over its least
    /// value.
    pub complementarity: f64,
}

/// Value and gradient of the objective, (1) of the module, at some densities.
pub struct Objective {
    /// Value of the objective, nm^2.
    pub value: f64,
    /// Derivatives by the densities (nodes), nm^2 mm/s.
    pub gradient: Vec<f64>,
}

/// Objective, (1) of the module, on a mesh.
pub struct Merit<'a> {
    residual: &'a Residual<'a>,
    mesh: &'a Mesh,
    normal: &'a Normal,
    /// Length of the path that belongs to every node (nodes), mm: the derivative of the total time by its density.
    lengths_mm: Vec<f64>,
    /// Least densities (lo, nodes), s/mm.
    lo: &'a [f64],
    /// Weight of the squared distances from the least densities (alpha K), nm^2 mm^2/s^2.
    pub alpha: f64,
    /// Weight of the squared differences of neighbours (beta K), nm^2 mm^2/s^2.
    beta: f64,
    /// Pairs of neighbouring nodes.
    neighbours: Vec<[usize; 2]>,
    wanted: Price,
    /// Price of a second, relative to half the mean square of the residual, nm^2/s; with an elasticity it changes until
    /// it is found.
    pub price: f64,
    price_is_found: bool,
    reference: Reference,
    executed: Option<Executed<'a>>,
    /// Terms (3) and (4) of the module; `None` until the motion is simulated.
    beyond: Option<Beyond>,
    /// True if the terms (3) and (4) of the module stay as they are, see [`Self::keep_motion_of`].
    motion_is_kept: bool,
    /// Half the mean square of the residual where the objective was computed last.
    last_half_mean_square_nm2: f64,
}

/// Difference of the removal of the motion from that of the densities, at the densities D_k of (3) of the module.
struct Beyond {
    /// Difference of the removals M(D_k) - B D_k of (3) of the module, nm.
    removal_nm: Array2<f64>,
    /// Densities (D_k, nodes), s/mm.
    density: Vec<f64>,
    /// Gradient (g, nodes) of (4) of the module.
    gradient: Vec<f64>,
}

impl Beyond {
    /// Returns the linear term (4) of the module at these densities, nm^2.
    fn linear_nm2(&self, density: &[f64]) -> f64 {
        let by = self.gradient.iter().zip(density.iter().zip(&self.density));
        by.map(|(g, (d, k))| g * (d - k)).sum()
    }
}

/// Densities at which the mean square f was last computed with the removal itself. Elsewhere f follows from the normal
/// matrix H, which is on cells of pixels, and from the difference x of the densities,
///
/// ```text
/// f + f' x + x' H x / 2
/// ```
///
/// at the cost of one product with H in the place of two convolutions of the map.
struct Reference {
    density: Vec<f64>,
    half_mean_square_nm2: f64,
    gradient: Vec<f64>,
}

impl Reference {
    /// Returns the reference at these densities with this removal, nm.
    fn new(
        residual: &Residual<'_>,
        mesh: &Mesh,
        density: &[f64],
        removal_nm: &Array2<f64>,
    ) -> Self {
        let at = residual.evaluate_removal(removal_nm);
        Self {
            density: density.to_vec(),
            half_mean_square_nm2: at.half_mean_square_nm2,
            gradient: mesh.collect(&at.gradient_nm2_per_s),
        }
    }
}

impl<'a> Merit<'a> {
    /// Builds the objective on a mesh, with its first reference at `density` (nodes), s/mm. The weights are alpha and
    /// beta of (1) of the module; K is the largest diagonal element of `normal`.
    pub fn new(
        residual: &'a Residual<'a>,
        normal: &'a Normal,
        mesh: &'a Mesh,
        lo: &'a [f64],
        (tikhonov, difference_weight): (f64, f64),
        wanted: Price,
        density: &[f64],
    ) -> Self {
        let strongest = normal.matrix.diagonal().into_iter().fold(0.0, f64::max);
        let neighbours = mesh.spans.iter().filter_map(|s| match s.nodes {
            [Some(a), Some(b)] => Some([a, b]),
            _ => None,
        });
        let (price, price_is_found) = match wanted {
            Price::Nm2PerS(price) => (price, true),
            Price::Elasticity(_) => (0.0, false),
        };
        Self {
            residual,
            mesh,
            normal,
            lengths_mm: mesh.lengths_mm(),
            lo,
            alpha: tikhonov * strongest,
            beta: difference_weight * strongest,
            neighbours: neighbours.collect(),
            wanted,
            price,
            price_is_found,
            reference: Reference::new(
                residual,
                mesh,
                density,
                &residual.removal_nm(&mesh.times_s(density)),
            ),
            executed: None,
            beyond: None,
            motion_is_kept: false,
            last_half_mean_square_nm2: f64::INFINITY,
        }
    }

    /// Uses the removal of the motion itself near the minimum, by (3) of the module.
    pub fn of_motion(self, executed: Executed<'a>) -> Self {
        Self { executed: Some(executed), ..self }
    }

    /// Returns the second derivatives of the objective without those of the residual. They are the diagonal (nodes),
    /// and for every node j the matrix element of this node and the one before it (nodes).
    pub fn chain(&self) -> (Vec<f64>, Vec<f64>) {
        let n = self.lo.len();
        let mut diagonal = vec![self.alpha; n];
        let mut below = vec![0.0; n];
        for [a, b] in &self.neighbours {
            diagonal[*a] += self.beta;
            diagonal[*b] += self.beta;
            below[*b] -= self.beta;
        }
        (diagonal, below)
    }

    /// Computes the mean square and its gradient at densities with the removal itself, as a new reference. Near the
    /// minimum it uses the removal of their motion; if `stays` is true, the difference (3) of the module remains that
    /// of the last simulation.
    ///
    /// The cells of the normal matrix miss a part of the mean square, for example with a TIF that ends abruptly on a
    /// small map.
    ///
    /// # Errors
    ///
    /// Refuses cells of more than one pixel that missed much of it since the last reference
    /// ([`JointError::CellsTooLarge`]). Fails if the motion cannot be simulated.
    pub fn refer_to(
        &mut self,
        at: Progress,
        density: &[f64],
        stays: bool,
    ) -> Result<(), JointError> {
        let near = at.complementarity <= SIMULATED_BELOW * self.last_half_mean_square_nm2;
        let model_nm = self.residual.removal_nm(&self.mesh.times_s(density));
        if let Some(executed) = self.executed.filter(|_| near && !stays && !self.motion_is_kept) {
            let removal_nm = executed(density)? - &model_nm;
            let gradient = vec![0.0; density.len()];
            self.beyond = Some(Beyond { removal_nm, density: density.to_vec(), gradient });
            // The residual is another one now.
            self.price_is_found &= !matches!(self.wanted, Price::Elasticity(_));
        }
        let before = self.reference.half_mean_square_nm2;
        let by_cells = self.by_cells(density).half_mean_square_nm2;
        self.reference = self.reference_at(density, model_nm);
        let there = self.reference.half_mean_square_nm2;
        let pixels = self.residual.cell_size();
        let unseen = there - by_cells;
        let fall = before - by_cells;
        let leads_away = unseen > MOST_UNSEEN * there && unseen > MOST_UNSEEN_OF_FALL * fall;
        let rises = stays && unseen > MOST_UNSEEN_OF_RISE * there && unseen > fall;
        if pixels > 1 && (leads_away || rises) {
            return Err(JointError::CellsTooLarge { pixels });
        }
        Ok(())
    }

    /// Returns the reference at these densities with the terms (3) and (4) of the module.
    fn reference_at(&self, density: &[f64], model_nm: Array2<f64>) -> Reference {
        let Some(beyond) = &self.beyond else {
            return Reference::new(self.residual, self.mesh, density, &model_nm);
        };
        let removal_nm = model_nm + &beyond.removal_nm;
        let mut reference = Reference::new(self.residual, self.mesh, density, &removal_nm);
        reference.half_mean_square_nm2 += beyond.linear_nm2(density);
        reference.gradient.iter_mut().zip(&beyond.gradient).for_each(|(g, beyond)| *g += beyond);
        reference
    }

    /// Fixes the terms (3) and (4) of the module at these densities, and the price, for all steps that follow.
    ///
    /// # Errors
    ///
    /// Fails where the motion cannot be simulated.
    pub fn keep_motion_of(&mut self, density: &[f64]) -> Result<(), JointError> {
        let model_nm = self.residual.removal_nm(&self.mesh.times_s(density));
        if let Some(executed) = self.executed {
            let executed_nm = executed(density)?;
            let at = self.residual.evaluate_removal(&executed_nm);
            self.beyond = Some(Beyond {
                removal_nm: executed_nm - &model_nm,
                density: density.to_vec(),
                gradient: self.mesh.collect_beyond(&at.gradient_nm2_per_s, density),
            });
        }
        self.motion_is_kept = true;
        self.price_is_found = true;
        self.reference = self.reference_at(density, model_nm);
        Ok(())
    }

    /// Returns the objective with the removal of the simulated motion, nm^2, for densities (nodes), s/mm.
    ///
    /// # Errors
    ///
    /// Fails where the motion cannot be simulated.
    pub fn of_execution_nm2(&self, density: &[f64]) -> Result<f64, JointError> {
        let removal_nm = match self.executed {
            Some(executed) => executed(density)?,
            None => self.residual.removal_nm(&self.mesh.times_s(density)),
        };
        let left = self.residual.evaluate_removal(&removal_nm);
        Ok(self.priced(density, left.half_mean_square_nm2, vec![0.0; density.len()]).value)
    }

    /// Returns the objective by the normal matrix, starting from the last reference, nm^2.
    pub fn value_nm2(&self, density: &[f64]) -> f64 {
        let half_mean_square_nm2 = self.by_cells(density).half_mean_square_nm2;
        self.priced(density, half_mean_square_nm2, vec![0.0; density.len()]).value
    }

    /// Returns half the mean square of the residual with the removal (3) of the module, nm^2.
    pub fn half_mean_square_nm2(&self, density: &[f64]) -> f64 {
        let mut removal_nm = self.residual.removal_nm(&self.mesh.times_s(density));
        if let Some(beyond) = &self.beyond {
            removal_nm += &beyond.removal_nm;
        }
        self.residual.evaluate_removal(&removal_nm).half_mean_square_nm2
    }

    /// Returns half the mean square and its gradient by the normal matrix, starting from the last reference.
    fn by_cells(&self, density: &[f64]) -> Evaluation {
        let reference = &self.reference;
        let off: Vec<f64> = density.iter().zip(&reference.density).map(|(d, r)| d - r).collect();
        let curved = self.normal.product(&off);
        let half_mean_square_nm2 = reference.half_mean_square_nm2
            + dot(&reference.gradient, &off)
            + 0.5 * dot(&curved, &off);
        let gradient_nm2_per_s =
            reference.gradient.iter().zip(&curved).map(|(g, c)| g + c).collect();
        Evaluation { half_mean_square_nm2, gradient_nm2_per_s }
    }

    /// Returns value and gradient of the objective, and true if the price of time is found. Before that, the price
    /// changes from step to step.
    pub fn evaluate(&mut self, at: Progress, density: &[f64]) -> (Objective, bool) {
        let Evaluation { half_mean_square_nm2, gradient_nm2_per_s } = self.by_cells(density);
        self.last_half_mean_square_nm2 = half_mean_square_nm2;
        let total_s = dot(&self.lengths_mm, density);
        if let (Price::Elasticity(x), false) = (self.wanted, self.price_is_found) {
            let next = x * half_mean_square_nm2 / total_s;
            let change = (next - self.price).abs();
            let near = at.complementarity <= NEARLY_SOLVED * half_mean_square_nm2;
            self.price_is_found =
                near && change <= PRICE_FOUND * next || at.iteration >= PRICE_STEPS;
            self.price = next;
        }
        let objective = self.priced(density, half_mean_square_nm2, gradient_nm2_per_s);
        (objective, self.price_is_found)
    }

    /// Returns the pull to the least densities: the term with alpha in (1) of the module, nm^2.
    pub fn pull_nm2(&self, density: &[f64]) -> f64 {
        0.5 * self.alpha * density.iter().zip(self.lo).map(|(d, lo)| (d - lo).powi(2)).sum::<f64>()
    }

    /// Returns the objective and its gradient from half the mean square and its gradient.
    fn priced(
        &self,
        density: &[f64],
        half_mean_square_nm2: f64,
        mut gradient: Vec<f64>,
    ) -> Objective {
        let total_s = dot(&self.lengths_mm, density);
        gradient.iter_mut().zip(&self.lengths_mm).for_each(|(g, l)| *g += self.price * l);
        let mut penalty = self.pull_nm2(density);
        for ((g, d), lo) in gradient.iter_mut().zip(density).zip(self.lo) {
            *g += self.alpha * (d - lo);
        }
        for [a, b] in &self.neighbours {
            let d = density[*b] - density[*a];
            penalty += 0.5 * self.beta * d * d;
            gradient[*b] += self.beta * d;
            gradient[*a] -= self.beta * d;
        }
        let value = half_mean_square_nm2 + self.price * total_s + penalty;
        Objective { value, gradient }
    }

    /// Returns the product of the densities `d` (nodes) with a matrix that is nowhere above the curvature of the
    /// objective, and nowhere below alpha.
    pub fn lower_curvature(&self, d: &[f64]) -> Vec<f64> {
        let mut product = if self.normal.below_curvature {
            self.normal.product(d)
        } else {
            self.mesh.collect(&self.residual.curvature(&self.mesh.times_s(d)))
        };
        product.iter_mut().zip(d).for_each(|(p, d)| *p += self.alpha * d);
        for [a, b] in &self.neighbours {
            let difference = self.beta * (d[*b] - d[*a]);
            product[*b] += difference;
            product[*a] -= difference;
        }
        product
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::curve::{Rounding, curves};
    use planish_dwell::residual::Free;
    use planish_numerics::linear::woodbury::Woodbury;
    use planish_types::{Axis, Grid, Surface, Tif, ToolPath};

    #[test]
    fn a_mean_square_that_rises_where_cells_see_a_fall_asks_for_smaller_cells() {
        // A Gaussian that ends at two sigma, on a map that is little larger.
        let a = Axis::new(-4.0, 0.1, 81).unwrap();
        let g = Grid { x: a, y: a };
        let rate = Array2::from_shape_fn(g.shape(), |(r, c)| {
            10.0 * (-(g.x.coordinate_mm(c).powi(2) + g.y.coordinate_mm(r).powi(2)) / 8.0).exp()
        });
        let tif = Tif::new(g, rate).unwrap();
        let axis = |n: usize| Axis::new(0.0, 0.1, n).unwrap();
        let grid = Grid { x: axis(101), y: axis(61) };
        let flat = Surface::new(grid, Array2::zeros(grid.shape())).unwrap();
        let points = vec![[-2.0, 1.0], [12.0, 1.0], [12.0, 3.0], [-2.0, 3.0]];
        let path = ToolPath::through(points, vec![true; 3], vec![0; 3]).unwrap();
        let curves = curves(&path, &Rounding { deviation_mm: 0.1, radius_mm: 0.5 }).curves;
        let mesh = Mesh::new(&curves, &path, 0.5).unwrap();
        let residual = |desired| Residual::new(desired, &tif, &mesh.points_mm, None, Free::Piston);
        let of_flat = residual(&flat).unwrap();
        let pixels = of_flat.cell_size();
        assert!(pixels > 1);
        let normal = of_flat.normal(&mesh.columns(), None).unwrap();
        let strongest = normal.matrix.diagonal().into_iter().fold(0.0, f64::max);

        // Densities v of which the cells see least beside their curvature H: H v = l (H of the cells + alpha) v
        let alpha = 1e-5 * strongest;
        let mut k = normal.matrix.k.clone();
        (0..mesh.nodes).for_each(|i| k.add(i, i, alpha));
        let inverse = Woodbury::new(k.factorise().unwrap(), &normal.matrix.u).unwrap();
        let by_cells = |d: &[f64]| -> Vec<f64> {
            let h = mesh.collect(&of_flat.curvature(&mesh.times_s(d)));
            let mut step: Vec<f64> = normal.order.iter().map(|j| h[*j]).collect();
            inverse.solve(&mut step);
            let mut by_nodes = vec![0.0; d.len()];
            normal.order.iter().zip(step).for_each(|(j, s)| by_nodes[*j] = s);
            by_nodes
        };
        let mut v: Vec<f64> = (0..mesh.nodes).map(|j| (1.7 * (j * j) as f64).sin()).collect();
        let mut l = 0.0;
        for _ in 0..50 {
            v = by_cells(&v);
            l = dot(&v, &v).sqrt();
            v.iter_mut().for_each(|v| *v /= l);
        }
        // A step of Newton's method by the cells would be l times as long as it should be.
        assert!(l > 2.5, "{l}");

        // What these remove is desired, beside what a density everywhere does, and a pattern that no tool sees.
        let level = vec![10.0; mesh.nodes];
        let best: Vec<f64> = level.iter().zip(&v).map(|(d, v)| d + v).collect();
        let mut height_nm = of_flat.removal_nm(&mesh.times_s(&best));
        let pixel = |((r, c), z): ((usize, usize), &mut f64)| *z += [-0.2, 0.2][(r + c) % 2];
        height_nm.indexed_iter_mut().for_each(pixel);
        let desired = Surface::new(grid, height_nm).unwrap();
        let residual = residual(&desired).unwrap();
        let lo = vec![0.0; mesh.nodes];
        let there = Progress { iteration: 1, complementarity: 0.0 };
        // Half the mean square there, there by the cells, and at the level; and what is said of it.
        let refer = |part: f64, stays: bool| {
            let (weights, price) = ((1e-5, 0.0), Price::Nm2PerS(0.0));
            let mut merit = Merit::new(&residual, &normal, &mesh, &lo, weights, price, &level);
            let to: Vec<f64> = level.iter().zip(&v).map(|(d, v)| d + part * v).collect();
            let seen = merit.by_cells(&to).half_mean_square_nm2;
            let [before, after] = [&level, &to].map(|d| merit.half_mean_square_nm2(d));
            ([after, seen, before], merit.refer_to(there, &to, stays))
        };
        // All of the way to the best: it falls, by less than the cells say.
        let ([after, seen, before], said) = refer(1.0, true);
        assert!(seen < after && after < before);
        assert_eq!(said, Ok(()));
        // Two and a half times as far it has risen where the cells say that it fell by more; where the motion is
        // simulated anew it may have risen for that.
        let ([after, seen, before], said) = refer(2.5, true);
        assert!(seen < before && before < after);
        assert_eq!(said, Err(JointError::CellsTooLarge { pixels }));
        assert_eq!(refer(2.5, false).1, Ok(()));
        // Much further a tenth of it is unseen.
        assert_eq!(refer(6.0, false).1, Err(JointError::CellsTooLarge { pixels }));
    }
}
