//! The surrogate as a matrix: few enough dwell points for skyline Cholesky factorisations.
//!
//! With its columns sorted along one axis of the map, H~ has a small skyline (few stored elements): `model::products`.

use std::ops::Range;

use planish_numerics::qp::bounded::{
    self, DESCENT_STEPS, End, GradientSettings, LastFactor, Quadratic,
};
use planish_types::Invalid;

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

/// Largest number of elements of the matrix of several tools (2.4 GB, and as much again for a factorisation). Larger:
/// more memory, and factorisations of minutes. Smaller: more problems are refused.
const MAX_ELEMENTS: usize = 300_000_000;

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
        let order = in_order(cells, reached, penalty, &[]);
        Self::in_this_order(order, cells, u, exact)
    }

    /// Makes H~ of several tools as [`Self::new`] makes that of one. `tools` are the ranges of their columns.
    ///
    /// Columns of a wide tool meet most others and would widen every row between them. So the columns of the widest
    /// tools are put after all others, and only their own rows are long. The number of tools that are put there is the
    /// one for which a factorisation takes the fewest multiplications.
    ///
    /// # Errors
    /// Refuses columns whose matrix has more than [`MAX_ELEMENTS`] elements in each of these orders.
    pub fn of_several(
        tools: &[Range<usize>],
        cells: &[Patch],
        u: &[Vec<f64>],
        reached: &[bool],
        penalty: &Penalty,
        exact: bool,
    ) -> Result<Self, Invalid> {
        let mut by_width: Vec<&Range<usize>> = tools.iter().collect();
        by_width.sort_by_key(|columns| largest_area(&cells[(*columns).clone()]));
        let orders = (1..=by_width.len()).map(|k| {
            let last: Vec<Range<usize>> = by_width[k..].iter().map(|r| (*r).clone()).collect();
            in_order(cells, reached, penalty, &last)
        });
        let quickest = orders.min_by(|a, b| a.work().total_cmp(&b.work()));
        let order = quickest.expect("there are tools");
        if order.elements > MAX_ELEMENTS {
            let problem = format!(
                "have {} columns, whose matrix would have {} elements, more than {MAX_ELEMENTS}",
                order.order.len(),
                order.elements
            );
            let remedy = "give the wide tools paths with lines and points as far apart as a quarter of their width, \
                          or leave a tool out";
            return Err(Invalid::whole("tools", problem, remedy));
        }
        Ok(Self::in_this_order(order, cells, u, exact))
    }

    /// Makes H~ with its rows in this order.
    fn in_this_order(ordered: Order, cells: &[Patch], u: &[Vec<f64>], exact: bool) -> Self {
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

/// Returns the order of the reached columns with the smaller skyline along x or y. The columns in the ranges `last`
/// come after all others, those of each range after those of the range before.
fn in_order(cells: &[Patch], reached: &[bool], penalty: &Penalty, last: &[Range<usize>]) -> Order {
    let columns: Vec<usize> = (0..reached.len()).filter(|j| reached[*j]).collect();
    let mut pairs = Vec::new();
    penalty.for_each(|j, k, _| pairs.push((j, k)));
    let mut rank = vec![0.0; cells.len()];
    for (k, range) in last.iter().enumerate() {
        rank[range.clone()].fill((k + 1) as f64);
    }
    // More than twice the last cell of every column.
    let ends = cells.iter().map(|cell| cell.range(0).end.max(cell.range(1).end));
    let beyond = 2.0 * (ends.max().unwrap_or(0) + 1) as f64;
    Order::new(&columns, cells, |axis, j| rank[j] * beyond + twice_centre(&cells[j], axis), &pairs)
}

/// Returns twice the centre of a column along x (`axis` 0) or y (1), in cells.
fn twice_centre(cells: &Patch, axis: usize) -> f64 {
    let range = cells.range(1 - axis);
    (range.start + range.end) as f64
}

/// Returns the largest number of cells under a column.
fn largest_area(cells: &[Patch]) -> usize {
    cells.iter().map(|cell| cell.rate_nm_per_s.len()).max().unwrap_or(0)
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
