//! Problem (1) of [`super`], its matrix, and the largest step of an iterate.

use planish_dwell::residual::Normal;
use planish_numerics::{
    linear::{
        skyline::{Element, Skyline},
        woodbury::Woodbury,
    },
    qp::bounded::Quadratic,
};

use crate::limits::{Constraint, LimitRows};

/// Largest fraction of a slack or of a dual variable that one step may take away, dimensionless; below 1. Larger:
/// longer steps, but the next ones are short at rows that are nearly active. Smaller: more steps. Chosen.
const STEP_TO_BOUNDARY: f64 = 0.95;

/// Factor on the length of a step until no row loses too much, dimensionless; below 1. Larger: a length nearer to the
/// longest one, with more evaluations of the rows. Smaller: fewer evaluations, shorter steps. Chosen.
const BACKTRACKING: f64 = 0.8;

/// Least remainder of the matrix along the free low-order terms of the map ([`Woodbury::refined`]), relative, at which
/// a factor in single precision is used as it is. If less is left it is refined; if that fails, the factor is made in
/// double precision. Larger: more refinements. Smaller: steps by a wrong inverse. Derived: a thousand times the
/// rounding of the products.
const LEFT_TO_SINGLE: f64 = 1e-4;

/// Problem (1) of [`super`]: curvature of the objective, bounds and rows.
pub struct Program<'a> {
    /// Second derivatives of half the mean square of the residual (the normal matrix), with the nodes in an order of
    /// their own.
    pub normal: &'a Normal,
    /// Other second derivatives of the objective (the chain), which couple neighbouring nodes only. They are the
    /// diagonal (n), and element (j, j - 1) for every j (n; the first unused).
    pub chain: (&'a [f64], &'a [f64]),
    /// Least densities of the nodes (lo, n), s/mm.
    pub lo: &'a [f64],
    /// Rows (c): the limits of the machine as constraints on the densities.
    pub rows: &'a LimitRows<'a>,
}

impl<'a> Program<'a> {
    /// Returns the inverse of the normal matrix plus a tridiagonal matrix, given by its diagonal (n) and its elements
    /// (j, j - 1) (n). `row_of` has the row of the normal matrix of every node. `None` if the sum is singular to
    /// rounding.
    pub(super) fn inverse(
        &self,
        row_of: &[usize],
        (diagonal, below): (&[f64], &[f64]),
    ) -> Option<Inverse<'a>> {
        let mut added = Vec::with_capacity(2 * row_of.len());
        for (j, row) in row_of.iter().enumerate() {
            added.push(Element { row: *row, column: *row, value: diagonal[j] });
            if j > 0 && below[j] != 0.0 {
                let before = row_of[j - 1];
                let (row, column) = (before.max(*row), before.min(*row));
                added.push(Element { row, column, value: below[j] });
            }
        }
        added.sort_unstable_by_key(|e| (e.row, e.column));
        let Quadratic { k, u } = &self.normal.matrix;
        let single = k.factorise_in_single(&added).and_then(|factor| {
            Woodbury::refined(factor, u, LEFT_TO_SINGLE, |x| product_with(k, &added, x))
        });
        let by_rows = match single {
            Some(woodbury) => ByRows::Single(woodbury),
            None => {
                let mut k = k.clone();
                added.iter().for_each(|e| k.add(e.row, e.column, e.value));
                ByRows::Double(Woodbury::new(k.factorise()?, u)?)
            }
        };
        Some(Inverse { order: &self.normal.order, by_rows })
    }

    /// Shortens the step `length d` from `density` by [`BACKTRACKING`] until every row keeps at least a twentieth of
    /// its slack `c`. Returns the length, which may become nearly 0, and the densities at the end of the step.
    pub(super) fn farthest(
        &self,
        density: &[f64],
        d: &[f64],
        c: &[f64],
        mut length: f64,
    ) -> (f64, Vec<f64>) {
        loop {
            let to = moved(density, d, length);
            let after = self.rows.slacks(&to);
            let keep = after.iter().zip(c).all(|(after, c)| *after >= (1.0 - STEP_TO_BOUNDARY) * c);
            if keep || length < f64::EPSILON {
                return (length, to);
            }
            length *= BACKTRACKING;
        }
    }
}

/// Returns the product of the symmetric matrix `k`, to which the elements `added` are added, with `x` (n).
fn product_with(k: &Skyline, added: &[Element], x: &[f64]) -> Vec<f64> {
    let mut product = k.product(x);
    for e in added {
        product[e.row] += e.value * x[e.column];
        if e.column != e.row {
            product[e.column] += e.value * x[e.row];
        }
    }
    product
}

/// Returns the densities after a step, `D + length d`.
pub(super) fn moved(density: &[f64], d: &[f64], length: f64) -> Vec<f64> {
    density.iter().zip(d).map(|(u, d)| u + length * d).collect()
}

/// Inverse of a symmetric matrix over the nodes.
pub(super) struct Inverse<'a> {
    /// Node of every row of the matrix.
    order: &'a [usize],
    by_rows: ByRows,
}

/// Inverse of the matrix in the order of its rows, by a factor in single or in double precision.
enum ByRows {
    Single(Woodbury<f32>),
    Double(Woodbury),
}

impl Inverse<'_> {
    pub(super) fn solve(&self, rhs: &[f64]) -> Vec<f64> {
        let mut b: Vec<f64> = self.order.iter().map(|j| rhs[*j]).collect();
        match &self.by_rows {
            ByRows::Single(woodbury) => woodbury.solve(&mut b),
            ByRows::Double(woodbury) => woodbury.solve(&mut b),
        }
        let mut x = vec![0.0; rhs.len()];
        self.order.iter().zip(b).for_each(|(j, b)| x[*j] = b);
        x
    }
}

/// Returns the changes of the slacks by a change `d` of the densities, J d (rows).
pub(super) fn along(rows: &[Constraint], d: &[f64]) -> Vec<f64> {
    rows.iter()
        .map(|row| (0..2).map(|k| row.nodes[k].map_or(0.0, |n| row.by[k] * d[n])).sum())
        .collect()
}

/// Adds J' v to `out` (n), with `v` one number per row.
pub(super) fn add_adjoint(rows: &[Constraint], v: impl Fn(usize) -> f64, out: &mut [f64]) {
    for (i, row) in rows.iter().enumerate() {
        let v = v(i);
        for k in 0..2 {
            if let Some(n) = row.nodes[k] {
                out[n] += row.by[k] * v;
            }
        }
    }
}

/// Returns the length of the longest step along `d`, at most 1, after which every component of `v` keeps at least a
/// twentieth of itself.
pub(super) fn longest(v: &[f64], d: &[f64]) -> f64 {
    v.iter()
        .zip(d)
        .map(|(v, d)| if *d < 0.0 { -STEP_TO_BOUNDARY * v / d } else { 1.0 })
        .fold(1.0, f64::min)
}
