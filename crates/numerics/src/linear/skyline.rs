//! A symmetric matrix in skyline (also called profile) storage, and its Cholesky factor.
//!
//! Row i stores the columns from its first nonzero one up to the diagonal. `A = L L'` has no
//! nonzero element outside of that. If every row reaches back by at most b, the factor has n b
//! elements and costs n b^2 multiplications. With full rows it is the dense factorisation.
//!
//! By blocks of rows, left-looking:
//!
//! ```text
//! A[i, k] -= L[i, j] L[k, j]',  j < k        (matrix products, nearly all of the work)
//! A[k, k]  = L[k, k] L[k, k]'                (unblocked)
//! L[i, k]  = A[i, k] L[k, k]^-T,  i > k      (by the inverse of one block)
//! ```
//!
//! The blocks below a diagonal block are independent of each other, so the result does not depend
//! on the number of threads. A factor is stored by columns within its blocks, in the order in which
//! the matrix products read it. In single precision, reading rows would take longer than the
//! multiplications.
//!
//! Source: A. George and J. Liu, Computer Solution of Large Sparse Positive Definite Systems, 1981,
//! chapter 4; Golub and Van Loan, Matrix Computations, 4th ed., section 4.2.

use std::ops::Range;

use ndarray::{Array2, ArrayView2, ArrayViewMut2, Axis, LinalgScalar, linalg::general_mat_mul, s};
use rayon::prelude::*;

use super::block_product::{BLOCK, subtract_product};
use crate::{
    precision::Real,
    vectors::{Lanes, vectorised},
};

/// A symmetric matrix (n, n), stored as the lower triangle within the skyline.
#[derive(Clone, Debug)]
pub struct Skyline {
    /// First stored column of every row: the skyline.
    first: Vec<usize>,
    blocks: Vec<RowBlock>,
}

/// Block of up to [`BLOCK`] rows of a matrix, stored row by row.
#[derive(Clone, Debug)]
struct RowBlock {
    /// First column that is stored, a multiple of [`BLOCK`].
    start: usize,
    /// Elements (rows, columns from `start` up to the end of the diagonal block); zero right of the diagonal.
    values: Array2<f64>,
}

/// An element of the lower triangle of a matrix.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Element {
    /// Index of the row.
    pub row: usize,
    /// Index of the column, at most `row`.
    pub column: usize,
    /// Value of the element.
    pub value: f64,
}

impl Skyline {
    /// Makes a zero matrix with n = `first.len()` rows. Row i stores the columns from `first[i] <= i` up to the
    /// diagonal.
    pub fn zeros(first: Vec<usize>) -> Self {
        let n = first.len();
        let blocks = (0..n).step_by(BLOCK).map(|top| {
            let end = (top + BLOCK).min(n);
            let lowest = (top..end).map(|i| first[i].min(i)).min().unwrap_or(top);
            let start = lowest / BLOCK * BLOCK;
            RowBlock { start, values: Array2::zeros((end - top, end - start)) }
        });
        let blocks = blocks.collect();
        Self { first, blocks }
    }

    /// Makes the symmetric matrix with the lower triangle of the full matrix `a`, without reading the upper one.
    pub fn from_dense(a: &Array2<f64>) -> Self {
        assert!(a.is_square(), "a square matrix");
        let mut full = Self::zeros(vec![0; a.nrows()]);
        full.fill(|i, row| row.iter_mut().enumerate().for_each(|(j, v)| *v = a[[i, j]]));
        full
    }

    /// Returns the number of rows.
    pub fn len(&self) -> usize {
        self.first.len()
    }

    /// Returns true if the matrix has no rows.
    pub fn is_empty(&self) -> bool {
        self.first.is_empty()
    }

    /// Counts the stored numbers, including the zeros that complete the blocks beyond the skyline and right of the
    /// diagonal.
    pub fn elements(&self) -> usize {
        self.blocks.iter().map(|b| b.values.len()).sum()
    }

    /// Returns the first stored column of row i.
    pub fn first(&self, i: usize) -> usize {
        self.first[i]
    }

    /// Writes every row by `write(i, row)`. `row[0]` is the element of column `first(i)`, and the
    /// last element is the diagonal.
    pub fn fill(&mut self, write: impl Fn(usize, &mut [f64]) + Sync) {
        self.fill_together(1, |rows, elements| write(rows.start, elements[0]));
    }

    /// Writes up to `most` neighbouring rows at a time by `write(rows, elements)`; `elements` has one slice per row,
    /// from its first stored column to the diagonal. `most` must divide the number of rows of a block (64).
    pub fn fill_together(
        &mut self,
        most: usize,
        write: impl Fn(Range<usize>, &mut [&mut [f64]]) + Sync,
    ) {
        assert!(most > 0 && BLOCK.is_multiple_of(most), "{most} rows do not divide a block");
        let first = &self.first;
        self.blocks.par_iter_mut().enumerate().for_each(|(b, block)| {
            let start = block.start;
            let columns = block.values.ncols();
            let all = block.values.as_slice_mut().expect("in C order");
            for (k, together) in all.chunks_mut(most * columns).enumerate() {
                let top = b * BLOCK + k * most;
                let rows = together.chunks_exact_mut(columns).enumerate();
                let mut rows: Vec<&mut [f64]> = rows
                    .map(|(r, row)| &mut row[first[top + r] - start..=top + r - start])
                    .collect();
                write(top..top + rows.len(), &mut rows);
            }
        });
    }

    /// Returns the stored elements of row i, from its first column up to the diagonal.
    pub fn row(&self, i: usize) -> &[f64] {
        let rows = &self.blocks[i / BLOCK];
        let width = rows.values.ncols();
        let all = rows.values.as_slice().expect("in C order");
        let from = (i % BLOCK) * width;
        &all[from + self.first[i] - rows.start..=from + i - rows.start]
    }

    /// Adds `value` to the element (i, j) of the lower triangle, which has to be within the
    /// skyline.
    pub fn add(&mut self, i: usize, j: usize, value: f64) {
        assert!(self.first[i] <= j && j <= i, "({i}, {j}) is outside of the skyline");
        let rows = &mut self.blocks[i / BLOCK];
        rows.values[[i % BLOCK, j - rows.start]] += value;
    }

    /// Returns the element (i, j) of the lower triangle; 0 outside of the skyline.
    pub fn element(&self, i: usize, j: usize) -> f64 {
        assert!(j <= i, "({i}, {j}) is above the diagonal");
        if j < self.first[i] { 0.0 } else { self.row(i)[j - self.first[i]] }
    }

    /// Returns the element (i, i).
    pub fn diagonal(&self, i: usize) -> f64 {
        *self.row(i).last().expect("a row has its diagonal")
    }

    /// Returns the product `A x` (n) of the whole symmetric matrix.
    pub fn product(&self, x: &[f64]) -> Vec<f64> {
        // Each task takes the rows with half of the elements; the split is the same on one thread.
        let half = self.elements() / 2;
        let mut before = 0;
        let mut middle = 0;
        for block in &self.blocks {
            before += block.values.len();
            if before > half {
                break;
            }
            middle += BLOCK;
        }
        let (mut y, lower) = both(
            self.elements() >= MIN_ELEMENTS_PARALLEL,
            || self.product_of_rows(0..middle, x),
            || self.product_of_rows(middle..self.len(), x),
        );
        y.iter_mut().zip(lower).for_each(|(y, v)| *y += v);
        y
    }

    /// Returns the part of `A x` (n) that the stored elements of `rows` and their mirror images contribute.
    fn product_of_rows(&self, rows: Range<usize>, x: &[f64]) -> Vec<f64> {
        let mut y = vec![0.0; self.len()];
        vectorised(
            #[inline(always)]
            || {
                for i in rows {
                    let row = self.row(i);
                    let left = &row[..row.len() - 1];
                    let from = self.first[i];
                    y[i] += dot(left, &x[from..i]) + row[left.len()] * x[i];
                    axpy(x[i], left, &mut y[from..i]);
                }
            },
        );
        y
    }

    /// Returns the submatrix of the rows and columns with the indices `keep`, which must ascend.
    pub fn principal(&self, keep: &[usize]) -> Self {
        let first = keep.iter().map(|i| keep.partition_point(|k| *k < self.first[*i])).collect();
        let mut part = Self::zeros(first);
        let columns: Vec<usize> = part.first.clone();
        part.fill(|i, row| {
            let from = self.row(keep[i]);
            let offset = self.first[keep[i]];
            for (v, k) in row.iter_mut().zip(&keep[columns[i]..]) {
                *v = from[k - offset];
            }
        });
        part
    }

    /// Factorises the matrix into L L'; `None` if it is not positive definite to rounding.
    pub fn factorise(self) -> Option<Factor> {
        self.factorise_keeping(|panel| panel)
    }

    /// Factorises the matrix and rounds the factor to single precision. The factor needs half the memory, and half the
    /// time per solution. It is meant for a preconditioner: it solves a system whose matrix differs by about 1e-7 of
    /// the largest elements. `None` if the matrix is not positive definite to rounding.
    pub fn factorise_to_single(self) -> Option<Factor<f32>> {
        self.factorise_keeping(|panel| Panel {
            start: panel.start,
            values: panel.values.mapv(f32::rounded),
        })
    }

    /// Factorises the sum of this matrix and the elements `added`, whose rows ascend, in single precision. Only the
    /// diagonal blocks are factorised and inverted in double precision. It takes half the time. Returns `None` if the
    /// sum is not positive definite to the rounding of single precision. Panics if an element is outside the skyline.
    pub fn factorise_in_single(&self, added: &[Element]) -> Option<Factor<f32>> {
        assert!(added.is_sorted_by_key(|e| e.row), "elements whose rows ascend");
        assert!(added.last().is_none_or(|e| e.row < self.len()), "elements of this matrix");
        let panels = self.blocks.par_iter().enumerate().map(|(b, rows)| {
            let mut panel = Panel::new(rows);
            let [from, to] =
                [b * BLOCK, (b + 1) * BLOCK].map(|row| added.partition_point(|e| e.row < row));
            for e in &added[from..to] {
                assert!(self.first[e.row] <= e.column && e.column <= e.row, "{e:?} is outside");
                let v = &mut panel.values[[e.column - rows.start, e.row - b * BLOCK]];
                *v = f32::rounded(f64::from(*v) + e.value);
            }
            panel
        });
        let panels: Vec<Panel<f32>> = panels.collect();
        rayon::scope(|_| factorise_panels(panels, |panel| panel))
    }

    /// Factorises in double precision; `keep` converts each finished panel into the stored one.
    fn factorise_keeping<T: Send>(
        self,
        keep: impl Fn(Panel<f64>) -> Panel<T> + Send,
    ) -> Option<Factor<T>> {
        let panels: Vec<Panel<f64>> =
            self.blocks.into_par_iter().map(|rows| Panel::new(&rows)).collect();
        // All blocks run within one scope of the pool: entering it for every block would cost as
        // much as a small block.
        rayon::scope(|_| factorise_panels(panels, keep))
    }
}

/// Number type of a factor: `f64` or `f32`.
pub trait Number: Lanes + LinalgScalar {
    /// Smallest squared diagonal element of L (pivot), relative to the diagonal element of the matrix, that is not
    /// rounding. Larger: nearly singular matrices are refused. Smaller: a pivot that is only rounding is accepted.
    const LEAST_PIVOT: f64;
}

impl Number for f64 {
    const LEAST_PIVOT: f64 = f64::EPSILON;
}

impl Number for f32 {
    // A pivot is a sum of some hundred terms, which rounds by more than one epsilon.
    const LEAST_PIVOT: f64 = 16.0 * f32::EPSILON as f64;
}

/// Block of up to [`BLOCK`] rows of a factor (a panel), stored column by column.
#[derive(Clone, Debug)]
struct Panel<T> {
    /// First column that is stored, a multiple of [`BLOCK`].
    start: usize,
    /// Elements (columns from `start` up to the end of the diagonal block, rows); zero right of the diagonal.
    values: Array2<T>,
}

/// Factorises panel by panel. `keep` converts each finished panel into the stored one. `None` if the matrix is not
/// positive definite to rounding.
fn factorise_panels<S: Number, T>(
    mut panels: Vec<Panel<S>>,
    keep: impl Fn(Panel<S>) -> Panel<T>,
) -> Option<Factor<T>> {
    let len = panels.iter().map(Panel::rows).sum();
    let mut finished = Vec::with_capacity(panels.len());
    // L[k, k]^-1 of the next pivot
    let mut next = panels.first_mut().map(|panel| panel.factorise_diagonal(0));
    for (k, last) in last_panels(&panels).into_iter().enumerate() {
        let inverse = next.take()??;
        let (head, below) = panels.split_at_mut(k + 1);
        let pivot = &mut head[k];
        let top = k * BLOCK;
        if let Some((first, others)) = below.split_first_mut() {
            // Only panels with work are shared out, one at a time, because threads take halves of a
            // list.
            let others = &mut others[..last.saturating_sub(k + 1)];
            // The next pivot is ready when the others are.
            let (of_first, ()) = rayon::join(
                || {
                    first.eliminate(pivot, &inverse, top);
                    first.factorise_diagonal(top + BLOCK)
                },
                || {
                    let others = others.par_iter_mut().with_max_len(1);
                    others.for_each(|panel| panel.eliminate(pivot, &inverse, top));
                },
            );
            next = Some(of_first);
        }
        let done = Panel { start: pivot.start, values: std::mem::take(&mut pivot.values) };
        finished.push(keep(done));
    }
    Some(Factor { len, panels: finished })
}

/// Returns, for every panel k, the index of the last panel that stores columns of the diagonal block of k.
fn last_panels<T>(panels: &[Panel<T>]) -> Vec<usize> {
    let mut last: Vec<usize> = (0..panels.len()).collect();
    for (i, panel) in panels.iter().enumerate() {
        last[panel.start / BLOCK] = i;
    }
    for k in 1..last.len() {
        last[k] = last[k].max(last[k - 1]);
    }
    last
}

impl<T: Number> Panel<T> {
    /// Makes a panel from a block of rows of the matrix.
    fn new(rows: &RowBlock) -> Self {
        let (count, columns) = rows.values.dim();
        let values = Array2::from_shape_fn((columns, count), |(column, row)| {
            T::rounded(rows.values[[row, column]])
        });
        Self { start: rows.start, values }
    }

    /// Computes `L[i, k]` from `A[i, k]`, of which nothing is subtracted yet, for a pivot panel k
    /// whose rows begin at `top`.
    fn eliminate(&mut self, pivot: &Self, inverse: &Array2<T>, top: usize) {
        if self.start > top {
            return;
        }
        let (left, rest) = self.values.view_mut().split_at(Axis(0), top - self.start);
        let (mut block, _) = rest.split_at(Axis(0), inverse.nrows());
        let from = self.start.max(pivot.start);
        // All of it transposed: A[i, k]' -= L[k, j] L[i, j]'
        if from < top {
            let l = left.slice(s![from - self.start.., ..]);
            let above = pivot.values.slice(s![from - pivot.start..top - pivot.start, ..]);
            subtract(&above, &l, &mut block);
        }
        // L[i, k]' = L[k, k]^-1 A[i, k]'
        let known = block.to_owned();
        general_mat_mul(T::one(), inverse, &known, T::zero(), &mut block);
    }

    /// Computes `L[k, k]` and its inverse from `A[k, k]`, whose rows begin at `top` and of which
    /// nothing is subtracted yet. `None` if it is not positive definite to rounding.
    fn factorise_diagonal(&mut self, top: usize) -> Option<Array2<T>> {
        let (left, mut diagonal) = self.values.view_mut().split_at(Axis(0), top - self.start);
        let least: Vec<f64> =
            diagonal.diag().iter().map(|v| T::LEAST_PIVOT * (*v).into().abs()).collect();
        if left.nrows() > 0 {
            subtract(&left.view(), &left.view(), &mut diagonal);
        }
        let mut l =
            Array2::from_shape_fn(diagonal.dim(), |(row, column)| diagonal[[column, row]].into());
        factorise_unblocked(&mut l, &least)?;
        diagonal
            .indexed_iter_mut()
            .for_each(|((column, row), v)| *v = T::rounded(l[[row, column]]));
        Some(inverse(&l).mapv(T::rounded))
    }
}

/// Subtracts the matrix product `a' b` from `c`.
fn subtract<T: Number>(a: &ArrayView2<'_, T>, b: &ArrayView2<'_, T>, c: &mut ArrayViewMut2<'_, T>) {
    let (a_all, b_all, c_all) = (a.as_slice(), b.as_slice(), c.as_slice_mut());
    match (a_all, b_all, c_all) {
        (Some(a), Some(b), Some(c)) if c.len() == BLOCK * BLOCK => subtract_product(a, b, c),
        // The last rows of a matrix
        _ => general_mat_mul(-T::one(), &a.t(), b, T::one(), c),
    }
}

impl<T> Panel<T> {
    /// Returns the number of rows of this block.
    fn rows(&self) -> usize {
        self.values.ncols()
    }
}

impl<T: Copy> Panel<T> {
    /// Splits the elements into those of the columns before the diagonal block and those of the diagonal block. `top`
    /// is the first row of the panel.
    fn split(&self, top: usize) -> (&[T], &[T]) {
        let all = self.values.as_slice().expect("in C order");
        all.split_at((top - self.start) * self.rows())
    }
}

/// Factor L of `A = L L'`, in double or in single precision.
#[derive(Clone, Debug)]
pub struct Factor<T = f64> {
    len: usize,
    panels: Vec<Panel<T>>,
}

impl<T: Number> Factor<T> {
    /// Returns the smallest squared diagonal element of L (a pivot). It is at least the smallest eigenvalue of A.
    pub fn least_pivot(&self) -> f64 {
        let of_panels = self.panels.iter().map(|panel| {
            let rows = panel.rows();
            let top = panel.values.nrows() - rows;
            (0..rows)
                .map(|i| panel.values[[top + i, i]].into().powi(2))
                .fold(f64::INFINITY, f64::min)
        });
        of_panels.fold(f64::INFINITY, f64::min)
    }

    /// Solves `A x = b`; x replaces b.
    pub fn solve(&self, b: &mut [f64]) {
        assert_eq!(b.len(), self.len, "length of the right-hand side");
        let elements: usize = self.panels.iter().map(|panel| panel.values.len()).sum();
        if elements < MIN_ELEMENTS_PARALLEL {
            self.solve_by_panels(b, false);
        } else {
            rayon::scope(|_| self.solve_by_panels(b, true));
        }
    }

    /// Solves panel after panel. Two threads share the part of each panel outside its diagonal
    /// block, which is nearly all of it.
    fn solve_by_panels(&self, b: &mut [f64], parallel: bool) {
        // L y = b
        for (k, panel) in self.panels.iter().enumerate() {
            let top = k * BLOCK;
            let (y, rest) = b.split_at_mut(top);
            let y = &y[panel.start..];
            let rows = panel.rows();
            let (left, diagonal) = panel.split(top);
            let middle = y.len() / 2;
            let (early, late) = both(
                parallel,
                || products(&left[..middle * rows], &y[..middle], rows),
                || products(&left[middle * rows..], &y[middle..], rows),
            );
            let x = &mut rest[..rows];
            x.iter_mut().zip(early.iter().zip(&late)).for_each(|(x, (a, b))| *x -= a + b);
            for (i, column) in diagonal.chunks_exact(rows).enumerate() {
                x[i] /= column[i].into();
                axpy(-x[i], &column[i + 1..], &mut x[i + 1..]);
            }
        }
        // L' x = y
        for (k, panel) in self.panels.iter().enumerate().rev() {
            let top = k * BLOCK;
            let (y, x) = b.split_at_mut(top);
            let rows = panel.rows();
            let x = &mut x[..rows];
            let (left, diagonal) = panel.split(top);
            for (i, column) in diagonal.chunks_exact(rows).enumerate().rev() {
                x[i] = (x[i] - dot(&column[i + 1..], &x[i + 1..])) / column[i].into();
            }
            let y = &mut y[panel.start..];
            let middle = y.len() / 2;
            let (before, after) = y.split_at_mut(middle);
            let (left_before, left_after) = left.split_at(middle * rows);
            both(
                parallel,
                || subtract_products(left_before, x, before),
                || subtract_products(left_after, x, after),
            );
        }
    }
}

/// Returns the product of the matrix `columns` (`rows`, length of y) and y. It is stored column by column; elements
/// beyond `rows` are zero.
fn products<T: Number>(columns: &[T], y: &[f64], rows: usize) -> [f64; BLOCK] {
    let mut sums = [0.0; BLOCK];
    vectorised(
        #[inline(always)]
        || add_products(columns, y, &mut sums[..rows]),
    );
    sums
}

/// Subtracts from y the product of the transposed matrix `columns` and x. The matrix is stored column by column.
fn subtract_products<T: Number>(columns: &[T], x: &[f64], y: &mut [f64]) {
    vectorised(
        #[inline(always)]
        || {
            for (column, y) in columns.chunks_exact(x.len()).zip(y) {
                *y -= dot(column, x);
            }
        },
    );
}

/// Adds the product of the matrix `columns` and y to `sums`. The matrix is stored column by column, and has as many
/// rows as there are sums.
#[inline(always)]
fn add_products<T: Number>(columns: &[T], y: &[f64], sums: &mut [f64]) {
    let rows = sums.len();
    // Two columns at once: the sums are read and written half as often.
    let mut pairs = columns.chunks_exact(2 * rows);
    let mut ys = y.chunks_exact(2);
    for (pair, y) in pairs.by_ref().zip(ys.by_ref()) {
        let (a, b) = pair.split_at(rows);
        for (sum, (a, b)) in sums.iter_mut().zip(a.iter().zip(b)) {
            *sum += (*a).into() * y[0] + (*b).into() * y[1];
        }
    }
    if let [y] = ys.remainder() {
        axpy(*y, pairs.remainder(), sums);
    }
}

/// Smallest number of elements of a factor at which two threads solve faster than one. Larger: one
/// thread for larger problems. Smaller: the overhead of a second thread exceeds its gain. Chosen by
/// the times of problems; the value does not change the result.
const MIN_ELEMENTS_PARALLEL: usize = 1_000_000;

/// Runs both functions, on two threads if `parallel`, and returns their results.
fn both<R: Send>(
    parallel: bool,
    a: impl FnOnce() -> R + Send,
    b: impl FnOnce() -> R + Send,
) -> (R, R) {
    if parallel { rayon::join(a, b) } else { (a(), b()) }
}

/// Returns the scalar product of a and b, in double precision.
#[inline(always)]
pub fn dot<T: Copy + Into<f64>>(a: &[T], b: &[f64]) -> f64 {
    let mut sums = Sums::default();
    sums.add_products(a, b);
    sums.total()
}

/// A sum as eight independent sums, which a compiler turns into vectors.
#[derive(Default)]
struct Sums([f64; 8]);

impl Sums {
    /// Adds the products of the elements of two slices of the same length.
    #[inline(always)]
    fn add_products<T: Copy + Into<f64>>(&mut self, a: &[T], b: &[f64]) {
        let (a8, a_rest) = a.as_chunks::<8>();
        let (b8, b_rest) = b.as_chunks::<8>();
        for (a, b) in a8.iter().zip(b8) {
            for k in 0..8 {
                self.0[k] += a[k].into() * b[k];
            }
        }
        for (sum, (a, b)) in self.0.iter_mut().zip(a_rest.iter().zip(b_rest)) {
            *sum += (*a).into() * b;
        }
    }

    /// Returns the sum of the eight sums.
    #[inline(always)]
    fn total(&self) -> f64 {
        self.0.iter().sum()
    }
}

/// Adds `a x`, the vector x times a number, to `y`.
#[inline(always)]
pub fn axpy<T: Copy + Into<f64>>(a: f64, x: &[T], y: &mut [f64]) {
    for (y, x) in y.iter_mut().zip(x) {
        *y += a * (*x).into();
    }
}

/// Returns the inverse X of the lower triangular matrix L, row by row: `X[i, :] = (1[i, :] - sum_{k < i} L[i, k] X[k,
/// :]) / L[i, i]`.
fn inverse(l: &Array2<f64>) -> Array2<f64> {
    let n = l.nrows();
    let mut x = Array2::zeros((n, n));
    for i in 0..n {
        let (above, mut rest) = x.view_mut().split_at(Axis(0), i);
        let mut row = rest.row_mut(0);
        let row = row.as_slice_mut().expect("rows are contiguous");
        for (k, known) in above.outer_iter().enumerate() {
            let known = known.to_slice().expect("rows are contiguous");
            axpy(-l[[i, k]], &known[..=k], &mut row[..=k]);
        }
        let scale = 1.0 / l[[i, i]];
        row[..i].iter_mut().for_each(|v| *v *= scale);
        row[i] = scale;
    }
    x
}

/// Replaces the lower triangle by L and the upper one by zero. `None` if a squared diagonal element of L (pivot) is not
/// above the element of `least` for its row.
fn factorise_unblocked(a: &mut Array2<f64>, least: &[f64]) -> Option<()> {
    let n = a.nrows();
    for i in 0..n {
        let (above, mut rest) = a.view_mut().split_at(Axis(0), i);
        let mut row = rest.row_mut(0);
        let row = row.as_slice_mut().expect("rows are contiguous");
        for j in 0..i {
            let l = above.row(j);
            let l = l.as_slice().expect("rows are contiguous");
            row[j] = (row[j] - dot(&row[..j], &l[..j])) / l[j];
        }
        let value = row[i] - dot(&row[..i], &row[..i]);
        if value.is_nan() || value <= least[i] {
            return None;
        }
        row[i] = value.sqrt();
        row[i + 1..].fill(0.0);
    }
    Some(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{DMatrix, DVector};
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    /// Returns a positive definite matrix with rows of different lengths, sparse and dense: diagonally dominant,
    /// eigenvalues from 1 to about 5.
    fn spd(n: usize, reach: usize) -> (Skyline, Array2<f64>) {
        let mut rng = ChaCha8Rng::seed_from_u64((n * 1000 + reach) as u64);
        let mut dense = Array2::<f64>::zeros((n, n));
        let first: Vec<usize> =
            (0..n).map(|i| i.saturating_sub(rng.random_range(0..=reach))).collect();
        let size = 1.0 / (1.0 + reach as f64);
        for i in 0..n {
            for j in first[i]..i {
                let v = size * rng.random_range(-1.0..1.0);
                (dense[[i, j]], dense[[j, i]]) = (v, v);
            }
            dense[[i, i]] = 3.0;
        }
        let mut a = Skyline::zeros(first.clone());
        for i in 0..n {
            for j in first[i]..=i {
                a.add(i, j, dense[[i, j]]);
            }
        }
        (a, dense)
    }

    #[test]
    fn agrees_with_another_factorisation_across_block_edges() {
        for (n, reach) in
            [(1, 0), (2, 1), (63, 5), (64, 64), (65, 3), (200, 30), (257, 257), (300, 90)]
        {
            let (a, dense) = spd(n, reach);
            let mut x: Vec<f64> = (0..n).map(|i| (i as f64).sin()).collect();
            let b = DVector::from_vec(x.clone());
            let other = DMatrix::from_fn(n, n, |i, j| dense[[i, j]]).cholesky().unwrap().solve(&b);
            a.factorise().unwrap().solve(&mut x);
            // Condition number about 5, order 1 values.
            assert!((0..n).all(|i| (x[i] - other[i]).abs() < 1e-13), "n {n} reach {reach}");
        }
    }

    #[test]
    fn a_large_factor_solves_by_two_threads() {
        let (n, reach) = (2100, 900);
        let (a, _) = spd(n, reach);
        assert!(a.elements() >= MIN_ELEMENTS_PARALLEL);
        let expected: Vec<f64> = (0..n).map(|i| (i as f64).sin()).collect();
        let mut x = a.product(&expected);
        // By two threads as well; each row and column once.
        let by_rows = |i: usize| {
            let of = |j: usize| a.element(i.max(j), i.min(j)) * expected[j];
            (0..n).map(of).sum::<f64>()
        };
        // A thousand roundings of order 1 values.
        assert!((0..n).step_by(97).all(|i| (x[i] - by_rows(i)).abs() < 1e-12));
        a.factorise().unwrap().solve(&mut x);
        // Condition number about 5, order 1 values.
        assert!((0..n).all(|i| (x[i] - expected[i]).abs() < 1e-12));
    }

    #[test]
    fn a_factor_in_single_precision_is_that_of_the_sum() {
        for (n, reach) in [(3, 1), (65, 3), (200, 30), (300, 90)] {
            let (a, _) = spd(n, reach);
            // Twice at the same place, and beside the diagonal where there is room.
            let mut added = Vec::new();
            for row in 0..n {
                if row % 7 == 0 {
                    added.extend([0.5, 1.0].map(|value| Element { row, column: row, value }));
                } else if a.first(row) < row {
                    added.push(Element { row, column: row - 1, value: 0.1 });
                }
            }
            let mut sum = a.clone();
            added.iter().for_each(|e| sum.add(e.row, e.column, e.value));
            let expected: Vec<f64> = (0..n).map(|i| (i as f64).cos()).collect();
            let mut x = sum.product(&expected);
            let mut of_double = x.clone();
            a.factorise_in_single(&added).unwrap().solve(&mut x);
            sum.factorise_to_single().unwrap().solve(&mut of_double);
            for found in [x, of_double] {
                // Condition number about 5, and some hundred roundings to 6e-8.
                let error = found.iter().zip(&expected).map(|(a, b)| (a - b).abs());
                assert!(error.fold(0.0, f64::max) < 3e-6, "n {n} reach {reach}");
            }
        }
    }

    #[test]
    fn what_is_singular_to_single_precision_is_refused_by_it_alone() {
        // All elements 1, and a little more on the diagonal: in one block and in many.
        for n in [2, 65, 300] {
            let ones = Array2::ones((n, n));
            let a = Skyline::from_dense(&(ones + Array2::<f64>::eye(n) * 1e-9));
            assert!(a.factorise_in_single(&[]).is_none(), "n {n}");
            let factor = a.factorise().unwrap();
            // The last pivot of ones + e is e (n + e) / (n - 1 + e).
            let expected = 1e-9 * n as f64 / (n - 1) as f64;
            // Rounding of n subtractions of numbers of order 1.
            assert!((factor.least_pivot() - expected).abs() < 1e-15 * n as f64, "n {n}");
        }
    }

    #[test]
    fn products_and_parts_are_those_of_the_full_matrix() {
        let (a, dense) = spd(150, 40);
        let x: Vec<f64> = (0..150_u32).map(|i| (0.3 * f64::from(i)).cos()).collect();
        let expected = dense.dot(&ndarray::aview1(&x));
        // Below: rounding of sums of at most 81 terms of the order 1.
        assert!(a.product(&x).iter().zip(&expected).all(|(a, b)| (a - b).abs() < 1e-13));
        let keep: Vec<usize> = (0..150).filter(|i| i % 3 != 1).collect();
        let part = a.principal(&keep);
        for (i, &k) in keep.iter().enumerate() {
            let row = part.row(i);
            for (v, &l) in row.iter().zip(&keep[part.first(i)..]) {
                assert_eq!(*v, dense[[k, l]]);
            }
            assert!(keep[..part.first(i)].iter().all(|l| dense[[k, *l]] == 0.0));
        }
        let full = Skyline::from_dense(&dense).product(&x);
        // As above.
        assert!(full.iter().zip(&expected).all(|(a, b)| (a - b).abs() < 1e-13));
    }

    #[test]
    fn indefinite_singular_and_nan_are_refused() {
        let (a, _) = spd(80, 20);
        let mut b = a.clone();
        b.add(70, 70, -4.0);
        assert!(b.factorise().is_none());
        let mut b = a;
        b.add(70, 70, f64::NAN);
        assert!(b.factorise().is_none());
        assert!(Skyline::from_dense(&Array2::ones((3, 3))).factorise().is_none());
    }
}
