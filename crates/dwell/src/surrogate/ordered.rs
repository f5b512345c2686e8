//! The surrogate as a matrix: few enough dwell points for skyline Cholesky factorisations.
//!
//! Columns are coupled only where their TIFs overlap. In the order of their positions along one axis of the map
//! each row of H~ begins near its diagonal, and the factor fills nothing outside of that; of the two axes the one
//! with the smaller skyline is taken.

use planish_numerics::{
    linear::skyline::Skyline,
    qp::bounded::{self, DESCENT_STEPS, End, GradientSettings, Quadratic},
};

use crate::{model::columns::Patch, objective::Penalty};

/// Fraction of its natural residual to which a step of H~ on cells has to get: the exact gradient corrects
/// by more than that.
const RESIDUAL_FRACTION_ON_CELLS: f64 = 0.02;

/// Factorisations after which the active set method cycles, from any start; measured problems take 10 to
/// 20.
const MAX_FACTORISATIONS: usize = 30;

/// The same from where gradient steps have found most of the active set, so that another attempt is worth
/// more.
const MAX_FACTORISATIONS_AFTER_DESCENT: usize = 100;

/// The columns in an order in which H~ has a small skyline.
pub struct Ordered {
    /// Column of every row of H~; unreached ones are not among them.
    order: Vec<usize>,
    /// H~ with room for the couplings of the penalty.
    data: Quadratic,
    /// Fraction of the natural residual that a step may leave.
    enough: f64,
}

impl Ordered {
    /// H~ of the columns on the cells; `exact` when these are pixels.
    pub fn new(
        cells: &[Patch],
        u: &[Vec<f64>],
        reached: &[bool],
        penalty: &Penalty,
        exact: bool,
    ) -> Self {
        let along = |axis: usize| {
            let centre = |j: &usize| {
                let ((r, c), (ny, nx)) = (cells[*j].origin, cells[*j].rate_nm_per_s.dim());
                [2 * c + nx, 2 * r + ny][axis]
            };
            let mut order: Vec<usize> = (0..reached.len()).filter(|j| reached[*j]).collect();
            order.sort_by_key(centre);
            let first = first_columns(cells, &order, penalty);
            let elements: usize = first.iter().enumerate().map(|(i, f)| i + 1 - f).sum();
            (elements, order, first)
        };
        let (x, y) = (along(0), along(1));
        let (_, order, first) = if x.0 <= y.0 { x } else { y };

        let mut k = Skyline::zeros(first.clone());
        k.fill(|i, row| {
            for (v, l) in row.iter_mut().zip(&order[first[i]..]) {
                *v = cells[order[i]].dot(&cells[*l]);
            }
        });
        let u = u.iter().map(|u| order.iter().map(|j| u[*j]).collect()).collect();
        Self {
            order,
            data: Quadratic { k, u },
            enough: if exact { 0.0 } else { RESIDUAL_FRACTION_ON_CELLS },
        }
    }

    /// H~ and the penalty.
    pub fn penalised(&self, penalty: &Penalty) -> Penalised<'_> {
        let mut rows = vec![None; penalty.len()];
        for (i, j) in self.order.iter().enumerate() {
            rows[*j] = Some(i);
        }
        let mut h = self.data.clone();
        penalty.for_each(|j, k, v| {
            if let (Some(i), Some(l)) = (rows[j], rows[k]) {
                h.k.add(i.max(l), i.min(l), v);
            }
        });
        Penalised { order: &self.order, h, enough: self.enough }
    }
}

/// First coupled column of every row.
fn first_columns(cells: &[Patch], order: &[usize], penalty: &Penalty) -> Vec<usize> {
    let mut first: Vec<usize> = (0..order.len())
        .map(|i| {
            let own = &cells[order[i]];
            (0..i).find(|l| cells[order[*l]].overlaps(own)).unwrap_or(i)
        })
        .collect();
    let mut rows = vec![None; penalty.len()];
    for (i, j) in order.iter().enumerate() {
        rows[*j] = Some(i);
    }
    penalty.for_each(|j, k, _| {
        if let (Some(i), Some(l)) = (rows[j], rows[k]) {
            first[i.max(l)] = first[i.max(l)].min(i.min(l));
        }
    });
    first
}

/// [`Ordered`] with its penalty.
pub struct Penalised<'a> {
    order: &'a [usize],
    h: Quadratic,
    enough: f64,
}

impl Penalised<'_> {
    /// The minimum of `q'd + d'H~d / 2` within the bounds, `d` from `t`, and the factorisations.
    /// `None` when H~ is not positive definite.
    pub fn minimum(
        &self,
        t: &[f64],
        q: &[f64],
        lo: &[f64],
        hi: &[f64],
    ) -> Option<(Vec<f64>, usize)> {
        let pick = |a: &[f64]| -> Vec<f64> { self.order.iter().map(|j| a[*j]).collect() };
        let start = pick(t);
        let g: Vec<f64> = self.h.product(&start).iter().zip(pick(q)).map(|(h, q)| h - q).collect();
        let (lo, hi) = (pick(lo), pick(hi));
        let before = bounded::natural_residual(&start, &pick(q), &self.h.diagonal(), &lo, &hi);
        let enough = self.enough * before;
        let mut found =
            bounded::active_set(&self.h, &g, &lo, &hi, &start, enough, MAX_FACTORISATIONS)?;
        if found.end != End::Optimal {
            // Nearly singular: gradient steps find most of the active set, or descend at least.
            let steps = GradientSettings {
                tolerance: 0.0,
                max_iterations: DESCENT_STEPS,
                stagnation: 0.0,
                offset: 0.0,
            };
            let apply = |t: &[f64]| self.h.product(t);
            let diagonal = self.h.diagonal();
            let near = bounded::projected_gradient(apply, &diagonal, &g, &lo, &hi, &start, &steps);
            let most = MAX_FACTORISATIONS_AFTER_DESCENT;
            let second = bounded::active_set(&self.h, &g, &lo, &hi, &near.value, enough, most)?;
            let iterations = found.iterations + second.iterations;
            found = if second.end == End::Optimal { second } else { near };
            found.iterations = iterations;
        }
        let mut to = t.to_vec();
        for (j, v) in self.order.iter().zip(found.value) {
            to[*j] = v;
        }
        Some((to, found.iterations))
    }
}
