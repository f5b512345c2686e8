//! What is minimised, as a function of the densities of the nodes.
//!
//! ```text
//! 1/2 mean square of the residual + price T
//!      + 1/2 alpha K sum (D - lo)^2 + 1/2 beta K sum (difference of neighbours)^2        (1)
//! ```
//!
//! K is the largest diagonal element of the normal matrix, so alpha and beta have no unit.
//!
//! The price is given, or follows from what time shall be worth. Where the residual falls by x % when the time
//! grows by 1 %, x is the elasticity; at the minimum of (1)
//!
//! ```text
//! d(1/2 mean square) / dT = -price,   x = 2 price T / mean square                        (2)
//! ```
//!
//! and the price is the one for which x is as asked.

use planish_dwell::residual::{Normal, Residual};
use planish_numerics::linear::skyline::dot;
use serde::Serialize;

use crate::{
    interior_point::{Objective, Progress},
    mesh::Mesh,
};

/// The price is found when it changes by less than this fraction in a step,
const PRICE_FOUND: f64 = 0.01;

/// and the complementarity is below this fraction of the mean square: before that the residual is still falling.
const NEARLY_SOLVED: f64 = 0.03;

/// Steps in which the price is looked for.
const PRICE_STEPS: usize = 40;

/// What a second costs.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Price {
    /// Beside half the mean square of the residual, nm^2/s.
    Nm2PerS(f64),
    /// (2): by how many percent one percent more time lowers the mean square, where the plan ends.
    Elasticity(f64),
}

/// (1).
pub struct Merit<'a> {
    residual: &'a Residual<'a>,
    /// lo (nodes), s/mm.
    lo: &'a [f64],
    /// alpha K, nm^2 mm^2/s^2.
    pub alpha: f64,
    /// beta K, nm^2 mm^2/s^2.
    beta: f64,
    /// Neighbouring nodes.
    neighbours: Vec<[usize; 2]>,
    wanted: Price,
    /// nm^2/s.
    pub price: f64,
    price_is_found: bool,
}

impl<'a> Merit<'a> {
    /// With K from the normal matrix of the nodes.
    pub fn new(
        residual: &'a Residual<'a>,
        normal: &Normal,
        mesh: &Mesh,
        lo: &'a [f64],
        (tikhonov, smoothness): (f64, f64),
        wanted: Price,
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
            lo,
            alpha: tikhonov * strongest,
            beta: smoothness * strongest,
            neighbours: neighbours.collect(),
            wanted,
            price,
            price_is_found,
        }
    }

    /// The curvature of (1) without that of the residual: diagonal (nodes), and element (j, j - 1) for every j.
    pub fn chain(&self) -> (Vec<f64>, Vec<f64>) {
        let n = self.lo.len();
        let (mut diagonal, mut below) = (vec![self.alpha; n], vec![0.0; n]);
        for [a, b] in &self.neighbours {
            diagonal[*a] += self.beta;
            diagonal[*b] += self.beta;
            below[*b] -= self.beta;
        }
        (diagonal, below)
    }

    /// (1) and its gradient, and whether the price is found: while it is looked for it changes from step to step.
    pub fn evaluate(&mut self, mesh: &Mesh, at: Progress, density: &[f64]) -> (Objective, bool) {
        let residual = self.residual.evaluate(&mesh.times_s(density));
        let mut gradient = mesh.collect(&residual.gradient_nm2_per_s);
        let lengths_mm = mesh.lengths_mm();
        let total_s = dot(&lengths_mm, density);
        if let (Price::Elasticity(x), false) = (self.wanted, self.price_is_found) {
            let next = x * residual.half_mean_square_nm2 / total_s;
            let change = (next - self.price).abs();
            let near = at.complementarity <= NEARLY_SOLVED * residual.half_mean_square_nm2;
            self.price_is_found =
                near && change <= PRICE_FOUND * next || at.iteration >= PRICE_STEPS;
            self.price = next;
        }
        gradient.iter_mut().zip(&lengths_mm).for_each(|(g, l)| *g += self.price * l);
        let mut penalty = 0.0;
        for ((g, d), lo) in gradient.iter_mut().zip(density).zip(self.lo) {
            penalty += 0.5 * self.alpha * (d - lo).powi(2);
            *g += self.alpha * (d - lo);
        }
        for [a, b] in &self.neighbours {
            let d = density[*b] - density[*a];
            penalty += 0.5 * self.beta * d * d;
            gradient[*b] += self.beta * d;
            gradient[*a] -= self.beta * d;
        }
        let value = residual.half_mean_square_nm2 + self.price * total_s + penalty;
        (Objective { value, gradient }, self.price_is_found)
    }
}
