//! The surrogate as a matrix: few enough dwell points for skyline Cholesky factorisations.
//!
//! With its columns sorted along one axis of the map, H~ has a small skyline (few stored elements): `model::products`.

use planish_numerics::qp::bounded::{
    self, DESCENT_STEPS, End, GradientSettings, LastFactor, Quadratic,
};

use crate::{
    model::{
        columns::Patch,
        products::{Order, rows},
    },
    objective::Penalty,
};

/// Fraction of the natural residual (how far the bounded problem is from its minimum) that a step by H~ on cells may
/// leave; the error of the cells is larger than that. Larger: more corrections. Smaller: more factorisations per step.
const RESIDUAL_FRACTION_ON_CELLS: f64 = 0.02;

/// Number of factorisations after which the first attempt of the active-set method counts as cycling; gradient steps
/// then give another start. Larger: a cycle takes longer. Smaller: slow problems get the other start without need.
/// Chosen: measured problems take 10 to 20.
const MAX_FACTORISATIONS: usize = 30;

/// Number of factorisations after which the second attempt, which starts from the result of the gradient steps, is
/// given up. The step is then the result of the gradient steps. They have found most of the active set, so that a
/// longer attempt is justified.
const MAX_FACTORISATIONS_AFTER_DESCENT: usize = 100;

/// The surrogate H~ of the normal matrix as a skyline matrix, (1) of [`super`], its columns in an order in which the
/// skyline is small.
pub struct Ordered {
    /// Dwell point of every row of H~; unreached ones have no row.
    order: Vec<usize>,
    /// H~ without the penalty, with room for the elements that the penalty adds.
    data: Quadratic,
    /// Fraction of the natural residual at which the search for a step ends; 0 if the cells are pixels.
    enough: f64,
}

impl Ordered {
    /// Makes H~ from the columns of B on the cells and the columns `u` of U (n each). Only columns of the mask
    /// `reached` have a row; `exact` is true if the cells are pixels.
    pub fn new(
        cells: &[Patch],
        u: &[Vec<f64>],
        reached: &[bool],
        penalty: &Penalty,
        exact: bool,
    ) -> Self {
        let columns: Vec<usize> = (0..reached.len()).filter(|j| reached[*j]).collect();
        let mut pairs = Vec::new();
        penalty.for_each(|j, k, _| pairs.push((j, k)));
        // Twice the centre of a column, in cells.
        let centre = |axis: usize, j: usize| {
            let range = cells[j].range(1 - axis);
            (range.start + range.end) as f64
        };
        let ordered = Order::new(&columns, cells, centre, &pairs);
        let k = ordered.products(cells, |_, _| None);
        let order = ordered.order;
        let u = u.iter().map(|u| order.iter().map(|j| u[*j]).collect()).collect();
        Self {
            order,
            data: Quadratic { k, u },
            enough: if exact { 0.0 } else { RESIDUAL_FRACTION_ON_CELLS },
        }
    }

    /// Returns H~ plus the matrix of the penalty.
    pub fn penalised(&self, penalty: &Penalty) -> Penalised {
        let rows = rows(&self.order, penalty.len());
        let mut h = self.data.clone();
        penalty.for_each(|j, k, v| {
            if let (Some(i), Some(l)) = (rows[j], rows[k]) {
                h.k.add(i.max(l), i.min(l), v);
            }
        });
        let order = self.order.clone();
        Penalised { order, h, enough: self.enough, last: LastFactor::default() }
    }
}

/// [`Ordered`] with the matrix of the penalty added.
pub struct Penalised {
    order: Vec<usize>,
    h: Quadratic,
    enough: f64,
    last: LastFactor,
}

impl Penalised {
    /// Returns the dwell times that minimise `q'd + d'H~d / 2` within the bounds `lo` and `hi`, s, for steps d from the
    /// dwell times `t`. `q` (n) is the gradient of the objective at `t`. Returns the number of sets of free dwell times
    /// that were solved for, too. `None` if H~ is not positive definite on such a set.
    pub fn minimum(
        &mut self,
        t: &[f64],
        q: &[f64],
        lo: &[f64],
        hi: &[f64],
    ) -> Option<(Vec<f64>, usize)> {
        let Self { order, h, enough, last } = self;
        let [start, q, lo, hi] = [t, q, lo, hi].map(|a| order.iter().map(|j| a[*j]).collect());
        let [start, q, lo, hi]: [Vec<f64>; 4] = [start, q, lo, hi];
        let g: Vec<f64> = h.product(&start).iter().zip(&q).map(|(h, q)| h - q).collect();
        let bounds = (lo.as_slice(), hi.as_slice());
        let before = bounded::natural_residual(&start, &q, &h.diagonal(), &lo, &hi);
        let enough = *enough * before;
        let most = MAX_FACTORISATIONS;
        let mut solved = bounded::active_set(h, &g, bounds, &start, enough, most, last)?;
        if solved.end != End::Optimal {
            // Nearly singular: gradient steps find most of the active set, or descend at least.
            let steps = GradientSettings {
                tolerance: 0.0,
                max_iterations: DESCENT_STEPS,
                stagnation: 0.0,
                offset: 0.0,
            };
            let diagonal = h.diagonal();
            let near = bounded::projected_gradient(
                |t: &[f64]| h.product(t),
                &diagonal,
                &g,
                &lo,
                &hi,
                &start,
                &steps,
            );
            let most = MAX_FACTORISATIONS_AFTER_DESCENT;
            let second = bounded::active_set(h, &g, bounds, &near.value, enough, most, last)?;
            let iterations = solved.iterations + second.iterations;
            solved = if second.end == End::Optimal { second } else { near };
            solved.iterations = iterations;
        }
        let mut to = t.to_vec();
        for (j, v) in order.iter().zip(solved.value) {
            to[*j] = v;
        }
        Some((to, solved.iterations))
    }
}
