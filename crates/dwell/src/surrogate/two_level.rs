//! Preconditioner of conjugate gradients for the normal matrix of [`crate::bounded_least_squares`], for dwell points
//! that are much denser than the TIF can resolve.
//!
//! Here `H = B' W B - U U' + L` is the normal matrix of the free dwell times, with the matrix L of the penalty. B is a
//! low pass: it depends on the part of the dwell times that smooth functions of the position represent. On everything
//! rougher H is almost L, a tridiagonal matrix (chain) along the path that is solved in one sweep. So the smooth
//! component is taken out exactly,
//!
//! ```text
//! Q = V (V' H V)^-1 V',   V[j, node] = b(x_j / p) b(y_j / p)                              (1)
//! ```
//!
//! with cubic B-splines b on a lattice of pitch p over the dwell points (free ones only; a node without free dwell
//! points under its spline stands alone). Conjugate gradients see `(1 - Q H) L^-1` ([`planish_numerics::qp::bounded`]).
//! The number of steps of conjugate gradients depends on the part of the solution that the splines cannot represent. It
//! does not depend on the number of dwell points.
//!
//! V' H V must belong to exactly the H that is applied: an error of 1e-8 of its largest element is as large as the
//! penalty alpha. It is kept while the free dwell times change: only the rows of splines over changed ones are computed
//! anew. If none changed, the last inverse serves again. The Cholesky factor is stored in single precision. The
//! rounding is of the size of L, which conjugate gradients correct anyway (measured: the same number of products).

use std::{ops::Range, sync::Arc};

use ndarray::{Array2, s};
use planish_numerics::{
    bspline,
    counting::Grouped,
    linear::{skyline::Skyline, tridiagonal, woodbury::Woodbury},
    parallel,
    qp::bounded::Deflation,
};

use super::{
    resolution::{extent, spline_reach_mm},
    stencils::Stencils,
};
use crate::{
    model::{
        columns::{Patch, ToolPlace},
        fft_operator::Sums,
        products::{Bundle, MOST_BUNDLED},
    },
    objective::Penalty,
};

/// The lattice of splines of (1) of the module, and the position of the columns on it.
pub struct Nodes {
    /// Number of nodes (y, x).
    shape: (usize, usize),
    /// True if neighbouring rows of the matrix are nodes along x, false if along y.
    by_rows: bool,
    /// Spline values at the centre of every column (n); `None` if the column is not reached or too long.
    weights: Vec<Option<Weights>>,
    /// Columns grouped by the cells of the lattice that contain their centres.
    by_cell: Grouped,
}

/// Values of the splines at the centre of a column in the lattice cell (r, c). The spline of node (r + i, c + k) has
/// the value `y[i] x[k]`, i, k = 0 .. 3.
#[derive(Clone, Copy)]
struct Weights {
    cell: (u32, u32),
    y: [f64; 4],
    x: [f64; 4],
}

impl Weights {
    /// Returns the 16 products of the spline values along y and x, row by row.
    fn products(&self) -> impl Iterator<Item = f64> {
        self.y.iter().flat_map(|y| self.x.iter().map(move |x| y * x))
    }

    /// Returns true if the two columns are at most [`MAX_COUPLED_CELLS`] cells apart. The penalty on their difference
    /// then is in the matrix of the lattice exactly; otherwise an upper bound is.
    fn is_near(&self, other: &Self) -> bool {
        self.cell.0.abs_diff(other.cell.0) <= MAX_COUPLED_CELLS
            && self.cell.1.abs_diff(other.cell.1) <= MAX_COUPLED_CELLS
    }
}

/// Largest distance, in cells of the lattice, of two columns for which the penalty on their difference is exactly in
/// the matrix of the lattice. For columns farther apart, which would widen its skyline, the matrix has an upper bound
/// of the penalty. Larger: a larger factor. Smaller: a less exact matrix.
const MAX_COUPLED_CELLS: u32 = 1;

/// Increase of the diagonal of the matrix of the lattice, as a fraction of the part of the diagonal of `V' L V` that
/// the terms alpha_j of single columns give. Without it, splines that differ on no column would make the matrix
/// singular. Larger: Q is less exact, and conjugate gradients take more steps. Smaller: the matrix may be singular to
/// rounding.
const SPLINE_RIDGE: f64 = 1e-3;

/// Largest number of elements of the removals by all splines up to which these are kept from one set of free columns to
/// the next (1.6 GB). With more, the removals by the splines near a changed one are computed again. Larger: more
/// memory. Smaller: more time.
const MAX_KEPT_PATCH_ELEMENTS: usize = 200_000_000;

impl Nodes {
    /// Makes the lattice of pitch `pitch_mm` over the columns of the mask `reached`, for a TIF of the size `tif_mm` [x,
    /// y]. The mask leaves out columns that are too long for splines.
    pub fn new(
        places: &[Vec<ToolPlace>],
        reached: &[bool],
        pitch_mm: f64,
        tif_mm: [f64; 2],
    ) -> Self {
        let centres: Vec<Option<[f64; 2]>> = places
            .iter()
            .zip(reached)
            .map(|(places, reached)| if *reached { Some(centre_mm(places)) } else { None })
            .collect();
        let (low, high) = extent(centres.iter().flatten());
        let [columns, rows] = [0, 1].map(|k| ((high[k] - low[k]) / pitch_mm) as usize + 1);
        let weights_of = |c: [f64; 2]| {
            let (r, y) = cell_and_splines((c[1] - low[1]) / pitch_mm, rows);
            let (c, x) = cell_and_splines((c[0] - low[0]) / pitch_mm, columns);
            Weights { cell: (r, c), y, x }
        };
        let weights: Vec<Option<Weights>> =
            centres.into_iter().map(|c| c.map(weights_of)).collect();
        let cells = weights
            .iter()
            .map(|w| w.as_ref().map(|w| w.cell.0 as usize * columns + w.cell.1 as usize));
        let by_cell = Grouped::new(rows * columns, cells);
        // Lines that meet lie as far apart as their splines: the product with the length of a line is the width of the
        // band.
        let ny = rows + 3;
        let nx = columns + 3;
        let reach = spline_reach_mm(tif_mm, pitch_mm);
        let by_rows = reach[1] * (nx as f64) < reach[0] * ny as f64;
        Self { shape: (ny, nx), by_rows, weights, by_cell }
    }

    /// Returns the number of nodes of the lattice.
    fn len(&self) -> usize {
        self.shape.0 * self.shape.1
    }

    /// Returns the number of nodes of a line, along which the rows of the matrix are numbered.
    fn line(&self) -> usize {
        if self.by_rows { self.shape.1 } else { self.shape.0 }
    }

    /// Returns the row of the matrix for the node (r, c); rows are numbered line by line.
    fn row(&self, r: usize, c: usize) -> usize {
        let (ny, nx) = self.shape;
        if self.by_rows { r * nx + c } else { c * ny + r }
    }

    /// Returns the node (r, c) of row i of the matrix.
    fn node(&self, i: usize) -> (usize, usize) {
        let (ny, nx) = self.shape;
        if self.by_rows { (i / nx, i % nx) } else { (i % ny, i / ny) }
    }

    /// Returns true if the penalty on the difference of two near columns can couple the rows a and b of the matrix.
    fn are_linked(&self, a: usize, b: usize) -> bool {
        let ((ra, ca), (rb, cb)) = (self.node(a), self.node(b));
        ra.abs_diff(rb) <= PENALTY_REACH && ca.abs_diff(cb) <= PENALTY_REACH
    }

    /// Returns the rows of the 16 nodes over a column, in the order of [`Weights::products`].
    fn over(&self, w: &Weights) -> impl Iterator<Item = usize> {
        let (r, c) = (w.cell.0 as usize, w.cell.1 as usize);
        (0..16).map(move |k| self.row(r + k / 4, c + k % 4))
    }

    /// Returns the product V' r (one element per row of the matrix) for r (n); only free columns count.
    fn restrict(&self, r: &[f64], free: &[bool]) -> Vec<f64> {
        let mut sums = vec![0.0; self.len()];
        for ((w, r), _) in self.weights.iter().zip(r).zip(free).filter(|(_, free)| **free) {
            if let Some(w) = w {
                self.over(w).zip(w.products()).for_each(|(i, v)| sums[i] += v * r);
            }
        }
        sums
    }

    /// Returns the product V c (n) for c (one element per row of the matrix); 0 for columns that are not free or have
    /// no splines.
    fn prolong(&self, c: &[f64], free: &[bool]) -> Vec<f64> {
        parallel::map(self.weights.len(), &|j| match &self.weights[j] {
            Some(w) if free[j] => self.over(w).zip(w.products()).map(|(i, v)| v * c[i]).sum(),
            _ => 0.0,
        })
    }

    /// Returns the elements of V in the column of a node, given by its row: (index of a free dwell point, spline
    /// value).
    fn under(&self, row: usize, free: &[bool]) -> Vec<(usize, f64)> {
        let (r, c) = self.node(row);
        let rows = self.shape.0 - 3;
        let columns = self.shape.1 - 3;
        let mut under = Vec::new();
        for y in r.saturating_sub(3)..=r.min(rows - 1) {
            for x in c.saturating_sub(3)..=c.min(columns - 1) {
                let of_cell = self.by_cell.group(y * columns + x);
                for j in of_cell.iter().map(|j| *j as usize).filter(|j| free[*j]) {
                    if let Some(w) = &self.weights[j] {
                        under.push((j, w.y[r - y] * w.x[c - x]));
                    }
                }
            }
        }
        under
    }

    /// Returns the matrix of the penalty on the lattice, V' L V, over the free columns. For columns that are not near
    /// ([`Weights::is_near`]) the square of a difference is replaced by its upper bound, `(v t_k - u t_{k-1})^2 <= 2
    /// v^2 t_k^2 + 2 u^2 t_{k-1}^2`.
    fn penalty(&self, penalty: &Penalty, free: &[bool]) -> Stencils {
        let steps = penalty.steps();
        let parts = parallel::map(PENALTY_PARTS, &|part| {
            let mut sums = self.stencils([PENALTY_REACH; 2]);
            for j in part_of(part, free.len()) {
                if let Some(w) = self.free_weights(j, free) {
                    self.add_square(&[(w, 1.0)], penalty.alpha()[j], &mut sums);
                }
            }
            for &(k, u, v) in &steps[part_of(part, steps.len())] {
                match (self.free_weights(k - 1, free), self.free_weights(k, free)) {
                    (Some(a), Some(b)) if a.is_near(b) => {
                        self.add_square(&[(b, v), (a, -u)], 1.0, &mut sums);
                    }
                    (a, b) => {
                        let factor = if a.is_some() && b.is_some() { 2.0 } else { 1.0 };
                        for (w, f) in [(a, u), (b, v)] {
                            if let Some(w) = w {
                                self.add_square(&[(w, f)], factor, &mut sums);
                            }
                        }
                    }
                }
            }
            sums
        });
        let mut sums = self.stencils([PENALTY_REACH; 2]);
        parts.iter().for_each(|part| sums.add_all(part));
        sums
    }

    /// Returns the spline values of column j; `None` if the column is not free, not reached or too long.
    fn free_weights(&self, j: usize, free: &[bool]) -> Option<&Weights> {
        if free[j] { self.weights[j].as_ref() } else { None }
    }

    /// Adds `factor g g'` to `sums`. The vector g is the sum of the columns of V' for the given dwell points, which
    /// must be near each other, each times the number that is given with it.
    fn add_square(&self, columns: &[(&Weights, f64)], factor: f64, sums: &mut Stencils) {
        const SIDE: usize = 1 + PENALTY_REACH;
        let r0 = columns.iter().map(|c| c.0.cell.0).min().unwrap_or(0);
        let c0 = columns.iter().map(|c| c.0.cell.1).min().unwrap_or(0);
        let mut g = [[0.0; SIDE]; SIDE];
        for (w, f) in columns {
            let r = (w.cell.0 - r0) as usize;
            let c = (w.cell.1 - c0) as usize;
            for (k, v) in w.products().enumerate() {
                g[r + k / 4][c + k % 4] += f * v;
            }
        }
        let mut nodes = [([0; 2], 0.0); SIDE * SIDE];
        let mut count = 0;
        for (r, g) in g.iter().enumerate() {
            for (c, g) in g.iter().enumerate().filter(|(_, g)| **g != 0.0) {
                let (r, c) = (r0 as usize + r, c0 as usize + c);
                nodes[count] = (if self.by_rows { [r, c] } else { [c, r] }, *g);
                count += 1;
            }
        }
        for (a, (i, u)) in nodes[..count].iter().enumerate() {
            for (k, v) in &nodes[..=a] {
                sums.add(*i.max(k), *i.min(k), factor * u * v);
            }
        }
    }

    /// Makes the zero matrix of all nodes, with room for couplings up to `reach` nodes [across, along] the lines.
    fn stencils(&self, reach: [usize; 2]) -> Stencils {
        Stencils::zeros(self.len(), self.line(), reach)
    }
}

/// Returns the mean position of a column, weighted by the fractions of its places, mm.
fn centre_mm(places: &[ToolPlace]) -> [f64; 2] {
    [0, 1].map(|k| places.iter().map(|p| p.fraction * p.position_mm[k]).sum::<f64>())
}

/// Returns the index of the cell that contains a position along an axis, given in cells from the first one, and the
/// values there of the four splines of the cell.
fn cell_and_splines(position: f64, cells: usize) -> (u32, [f64; 4]) {
    let i = (position as usize).min(cells - 1);
    (i as u32, bspline::on_a_cell(position - i as f64))
}

/// Returns the range of indices below `len` that is part number `part` of [`PENALTY_PARTS`].
fn part_of(part: usize, len: usize) -> Range<usize> {
    part * len / PENALTY_PARTS..(part + 1) * len / PENALTY_PARTS
}
/// Number of parts into which the columns are divided for the sum of `V' L V`. It does not depend on the number of
/// threads, so the result does not either. Larger: more memory. Another value changes the last digits of the result.
const PENALTY_PARTS: usize = 2;

/// Largest distance, in nodes, of two nodes that the difference of near columns couples. It follows from the width of
/// the splines and [`MAX_COUPLED_CELLS`].
const PENALTY_REACH: usize = 3 + MAX_COUPLED_CELLS as usize;

/// Matrix `V' B' W B V` of the splines on the lattice, over a set of free columns, which can be changed.
pub struct Coarse {
    free: Vec<bool>,
    /// Removal rate `W^1/2 B V` by the spline of every row. If `keeps_patches` is false, patches exist only while the
    /// rows near them are computed.
    patches: Vec<Patch>,
    keeps_patches: bool,
    matrix: Stencils,
    /// First stored column of every row of the factor.
    first: Vec<usize>,
    /// Last inverse made from this matrix, for the same free columns, and its penalty; `None` before the first one, or
    /// if the matrix was singular.
    last: Option<(Penalty, Arc<Woodbury<f32>>)>,
}

/// Ranges of the rows and columns of the map that a column or spline reaches.
type Extent = (Range<usize>, Range<usize>);

/// Returns true if two ranges have an element in common.
fn meet(a: &Range<usize>, b: &Range<usize>) -> bool {
    a.start < b.end && b.start < a.end
}

/// Returns the largest difference of the indices of two lines of nodes whose removals overlap. `nodes` gives, for every
/// node, the index of its line and the range of pixels that its removal reaches across the lines.
fn line_reach<'a>(lines: usize, nodes: impl Iterator<Item = (usize, &'a Range<usize>)>) -> usize {
    let mut of_lines: Vec<Option<Range<usize>>> = vec![None; lines];
    for (line, reach) in nodes.filter(|(_, reach)| !reach.is_empty()) {
        let whole = of_lines[line].get_or_insert_with(|| reach.clone());
        *whole = whole.start.min(reach.start)..whole.end.max(reach.end);
    }
    let mut most = 0;
    for (k, reach) in of_lines.iter().enumerate() {
        let Some(reach) = reach else { continue };
        let meets = |before: &Option<Range<usize>>| before.as_ref().is_some_and(|b| meet(b, reach));
        let first = of_lines[..k].iter().position(meets).unwrap_or(k);
        most = most.max(k - first);
    }
    most
}

impl Coarse {
    /// Makes the zero matrix, for no free column, with room for all columns of the mask `reached`.
    pub fn new(nodes: &Nodes, sums: &Sums, reached: &[bool]) -> Self {
        let extents: Vec<Extent> = parallel::map(nodes.len(), &|i| {
            sums.extent(nodes.under(i, reached).into_iter().map(|(j, _)| j))
        });
        let (ny, nx) = nodes.shape;
        let [of_rows, of_columns] = [
            line_reach(ny, extents.iter().enumerate().map(|(i, e)| (nodes.node(i).0, &e.0))),
            line_reach(nx, extents.iter().enumerate().map(|(i, e)| (nodes.node(i).1, &e.1))),
        ]
        .map(|reach| reach.max(PENALTY_REACH));
        let reach = if nodes.by_rows { [of_rows, of_columns] } else { [of_columns, of_rows] };
        let line = nodes.line();
        let first = parallel::map(nodes.len(), &|i| {
            let mut near = (i / line).saturating_sub(reach[0]) * line..i;
            let is_coupled = |k: &usize| {
                let [a, b] = [*k, i].map(|k| &extents[k]);
                nodes.are_linked(*k, i) || meet(&a.0, &b.0) && meet(&a.1, &b.1)
            };
            near.find(is_coupled).unwrap_or(i)
        });
        let cells: usize = extents.iter().map(|(rows, columns)| rows.len() * columns.len()).sum();
        Self {
            free: vec![false; reached.len()],
            patches: vec![Patch::default(); nodes.len()],
            keeps_patches: cells <= MAX_KEPT_PATCH_ELEMENTS,
            matrix: nodes.stencils(reach),
            first,
            last: None,
        }
    }

    /// Returns true if the last inverse exists and is for this penalty, and all columns that were free for it are in
    /// the mask `free`.
    pub fn is_of(&self, penalty: &Penalty, free: &[bool]) -> bool {
        let known = self.last.as_ref().is_some_and(|(last, _)| last == penalty);
        known && self.free.iter().zip(free).all(|(own, free)| *free || !own)
    }

    /// Updates the matrix to the free columns of the mask `free`; computes only elements of splines over columns that
    /// changed. `weight` has the weights of the samples (W_c).
    fn update(&mut self, nodes: &Nodes, sums: &Sums, weight: &Array2<f64>, free: &[bool]) {
        let mut changed = vec![false; nodes.len()];
        for (j, w) in nodes.weights.iter().enumerate() {
            if let Some(w) = w.as_ref().filter(|_| self.free[j] != free[j]) {
                nodes.over(w).for_each(|i| changed[i] = true);
            }
        }
        self.free.copy_from_slice(free);
        let is_needed =
            if self.keeps_patches { changed.clone() } else { self.matrix.coupled_with(&changed) };
        let mut before = 0..0;
        for rows in self.matrix.parts() {
            let patches = self.patches[rows.clone()].iter_mut().zip(rows.clone());
            parallel::consume(patches.filter(|(_, i)| is_needed[*i]), &|_, (patch, i)| {
                *patch = sums.patch(&nodes.under(i, free));
                let (r, c) = patch.origin;
                let (ny, nx) = patch.rate_nm_per_s.dim();
                let weight = weight.slice(s![r..r + ny, c..c + nx]);
                patch.rate_nm_per_s.zip_mut_with(&weight, |v, w| *v *= w.sqrt());
            });
            let patches = &self.patches;
            self.matrix.fill(rows.clone(), MOST_BUNDLED, |mut near| {
                let rows = near.rows();
                let of_rows = changed[rows.clone()].contains(&true);
                let mut bundle = None;
                for k in near.coupled().filter(|k| of_rows || changed[*k]) {
                    let bundle =
                        bundle.get_or_insert_with(|| Bundle::new(patches[rows.clone()].iter()));
                    for (i, dot) in rows.clone().zip(bundle.dots(&patches[k])) {
                        if let Some(v) = near.element(i, k).filter(|_| changed[i] || changed[k]) {
                            *v = dot;
                        }
                    }
                }
            });
            if !self.keeps_patches {
                self.patches[before].fill(Patch::default());
            }
            before = rows;
        }
        if !self.keeps_patches {
            self.patches[before].fill(Patch::default());
        }
    }

    /// Returns the inverse `(V' H V)^-1` for the columns of the last [`Self::update`], whose mask `free` must be;
    /// `None` if the matrix is singular to rounding. `u` has the columns of U (n each).
    fn inverse(
        &self,
        nodes: &Nodes,
        penalty: &Penalty,
        u: &[Vec<f64>],
        free: &[bool],
    ) -> Option<Woodbury<f32>> {
        let stencils = nodes.penalty(penalty, free);
        let mut h = Skyline::zeros(self.first.clone());
        h.fill(|i, row| {
            self.matrix.add_row(i, self.first[i], row);
            stencils.add_row(i, self.first[i], row);
        });
        let mut squares = vec![0.0; nodes.len()];
        for ((w, alpha), _) in
            nodes.weights.iter().zip(penalty.alpha()).zip(free).filter(|(_, free)| **free)
        {
            if let Some(w) = w {
                nodes.over(w).zip(w.products()).for_each(|(i, v)| squares[i] += alpha * v * v);
            }
        }
        for (i, square) in squares.iter().enumerate() {
            let stands_alone = *square == 0.0;
            h.add(i, i, if stands_alone { 1.0 } else { SPLINE_RIDGE * square });
        }
        // V' H V = K - U U', with the K of `h` and U restricted to the lattice
        let u: Vec<Vec<f64>> = u.iter().map(|u| nodes.restrict(u, free)).collect();
        h.factorise_to_single().and_then(|factor| Woodbury::new(factor, &u))
    }
}

/// Preconditioner for some free columns: the coarse solution Q of (1) of the module, and the inverse L^-1 of the
/// penalty.
pub struct TwoLevel<'a> {
    nodes: &'a Nodes,
    free: Vec<bool>,
    /// Factor of the matrix L of the penalty on the free columns.
    chain: tridiagonal::Factor,
    /// Inverse `(V' H V)^-1`; `None` if the matrix is singular to rounding.
    inverse: Option<Arc<Woodbury<f32>>>,
}

impl<'a> TwoLevel<'a> {
    /// Makes the preconditioner for the mask `free`, and updates `coarse` to it unless `coarse` is of this mask and
    /// penalty already. `u` has the columns of U (n each).
    pub fn new(
        nodes: &'a Nodes,
        coarse: &mut Coarse,
        (sums, weight): (&Sums, &Array2<f64>),
        penalty: &Penalty,
        u: &[Vec<f64>],
        free: &[bool],
    ) -> Self {
        if coarse.free != free || coarse.last.as_ref().is_none_or(|(last, _)| last != penalty) {
            // The one before goes first: each is as large as the matrix.
            coarse.last = None;
            coarse.update(nodes, sums, weight, free);
            let inverse = coarse.inverse(nodes, penalty, u, free);
            coarse.last = inverse.map(|inverse| (penalty.clone(), Arc::new(inverse)));
        }
        Self::again(nodes, coarse, penalty, free)
    }

    /// Makes the preconditioner from the last inverse of `coarse`, for free columns that include those of `coarse`. The
    /// other free columns take part in L only, not in V.
    pub fn again(nodes: &'a Nodes, coarse: &Coarse, penalty: &Penalty, free: &[bool]) -> Self {
        let inverse = coarse.last.as_ref().map(|(_, inverse)| inverse.clone());
        Self { nodes, free: coarse.free.clone(), chain: chain(penalty, free), inverse }
    }
}

impl Deflation for TwoLevel<'_> {
    /// Returns the coarse solution `Q r = V (V' H V)^-1 V' r`. It is zero if the matrix is singular to rounding, which
    /// only costs steps.
    fn coarse(&self, r: &[f64]) -> Vec<f64> {
        let Some(inverse) = &self.inverse else { return vec![0.0; r.len()] };
        let mut c = self.nodes.restrict(r, &self.free);
        inverse.solve(&mut c);
        self.nodes.prolong(&c, &self.free)
    }

    fn smooth(&self, r: &[f64]) -> Vec<f64> {
        self.chain.solve(r)
    }
}

/// Returns the factor of the penalty matrix L on the free columns. L is tridiagonal, because it couples only neighbours
/// along the path.
fn chain(penalty: &Penalty, free: &[bool]) -> tridiagonal::Factor {
    let mut diagonal = vec![0.0; free.len()];
    let mut below = vec![0.0; free.len()];
    penalty.for_each(|j, k, v| {
        if j == k && free[j] {
            diagonal[j] += v;
        } else if j != k && free[j] && free[k] {
            below[j] += v;
        }
    });
    tridiagonal::Factor::new(diagonal, below, penalty.least_alpha())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        model::{
            columns::Columns,
            fft_operator::{FftOperator, Spread},
        },
        objective::{PenaltyScale, PenaltyWeights},
    };
    use planish_numerics::linear::skyline::dot;
    use planish_testkit::maps::{largest_difference, largest_magnitude};
    use planish_types::{Axis, Grid, Tif, ToolPath};

    #[test]
    fn what_the_splines_say_is_solved_exactly_whatever_is_free() {
        // Lines of the lattice along y, and along x where a TIF would reach far along that.
        assert!(!are_along_x_and_solved_exactly([4.0, 4.0]));
        assert!(are_along_x_and_solved_exactly([40.0, 4.0]));
    }

    fn are_along_x_and_solved_exactly(tif_mm: [f64; 2]) -> bool {
        let axis = |start: f64, n: usize| Axis::new(start, 0.25, n).unwrap();
        let map = Grid { x: axis(0.0, 37), y: axis(0.0, 23) };
        let own = Grid { x: axis(-2.0, 17), y: axis(-2.0, 17) };
        let rate = Array2::from_shape_fn(own.shape(), |(r, c)| {
            (-(own.x.coordinate_mm(c).powi(2) + 1.3 * own.y.coordinate_mm(r).powi(2)) / 2.0).exp()
        });
        let tif = Tif::new(own, rate).unwrap();
        let points: Vec<[f64; 2]> = (0..1200)
            .map(|j| {
                let (line, k) = (j / 40, j % 40);
                let k = if line % 2 == 0 { k } else { 39 - k };
                [0.25 * f64::from(k) - 0.4, 0.2 * f64::from(line) - 0.3]
            })
            .collect();
        let n = points.len() - 1;
        let path = ToolPath::through(points, vec![true; n], vec![0; n]).unwrap();
        let places = Columns::Segment.places(&path, &tif);
        let b = FftOperator::without_border(&places, &tif, &map, Spread::Keys);
        let weight =
            Array2::from_shape_fn(map.shape(), |(r, c)| if r < 5 && c > 20 { 0.0 } else { 1.0 });
        let weights =
            PenaltyWeights { tikhonov: 1e-7, slope_weight: 1e-6, time_weight_nm2_per_s: 0.0 };
        // Areas of 0.25 x 0.2 mm: alpha A / a = 1e-5, and beta A^2 / (p l^3) = 8e-3.
        let scale = PenaltyScale {
            strongest: 12.0,
            pixel_weight: 1.0,
            area_mm2: 5.0,
            line_distance_mm: 0.2,
        };
        let penalty = Penalty::new(&path, &vec![0.0; n], &scale, &weights);
        let u =
            vec![b.adjoint(&weight).iter().map(|v| v / weight.sum().sqrt()).collect::<Vec<_>>()];
        let h = |t: &[f64]| {
            let mut h_t = b.adjoint(&(b.apply(t) * &weight));
            let c = dot(&u[0], t);
            h_t.iter_mut().zip(&u[0]).for_each(|(h, u)| *h -= u * c);
            penalty.add_product(t, &mut h_t);
            h_t
        };
        let sums = Sums::new(&places, &tif, &map, 5.0, Spread::Keys);
        let nodes = Nodes::new(&places, &vec![true; n], 1.0, tif_mm);
        let mut coarse = Coarse::new(&nodes, &sums, &vec![true; n]);
        let mut forgetful = Coarse::new(&nodes, &sums, &vec![true; n]);
        assert!(coarse.keeps_patches);
        forgetful.keeps_patches = false;
        // From one to the other only what changed is computed.
        let frees: [&dyn Fn(usize) -> bool; 4] =
            [&|_| true, &|j| j % 97 > 3, &|j| j % 97 > 3 && j > 300, &|j| j < 700];
        for free in frees {
            let free: Vec<bool> = (0..n).map(free).collect();
            let two = TwoLevel::new(&nodes, &mut coarse, (&sums, &weight), &penalty, &u, &free);
            // The same matrix, of which nothing else is left.
            forgetful.update(&nodes, &sums, &weight, &free);
            assert_eq!(forgetful.matrix, coarse.matrix);
            assert!(forgetful.patches.iter().all(|patch| patch.rate_nm_per_s.is_empty()));
            let c: Vec<f64> = (0..nodes.len()).map(|i| (1.7 * i as f64).sin()).collect();
            // Q H V c = V c
            let v_c = nodes.prolong(&c, &free);
            let found = two.coarse(&h(&v_c));
            let size = largest_magnitude(v_c.iter().copied());
            let error = largest_difference(&found, &v_c);
            // The ridge is 1e-3 of the least that (1) costs.
            assert!(error < 1e-2 * size, "{error} of {size}");
            // L L^-1 = 1 on what is free.
            let r: Vec<f64> =
                (0..n).map(|j| if free[j] { (j as f64).cos() } else { 0.0 }).collect();
            let mut back = vec![0.0; n];
            penalty.add_product(&two.smooth(&r), &mut back);
            let error = (0..n).filter(|j| free[*j]).map(|j| back[j] - r[j]);
            // Condition number 4 beta A^2 / (p l^3) / (alpha A / a) = 3e3.
            assert!(largest_magnitude(error) < 1e-11);
        }
        // The same free columns with another penalty, of which the smooth component is 1e-2 of H.
        let weights =
            PenaltyWeights { tikhonov: 1e-2, slope_weight: 1e-2, time_weight_nm2_per_s: 0.0 };
        let stiff = Penalty::new(&path, &vec![0.0; n], &scale, &weights);
        let free: Vec<bool> = (0..n).map(|j| j < 700).collect();
        let two = TwoLevel::new(&nodes, &mut coarse, (&sums, &weight), &stiff, &u, &free);
        let c: Vec<f64> = (0..nodes.len()).map(|i| (0.1 * i as f64).sin()).collect();
        let v_c = nodes.prolong(&c, &free);
        let mut h_v_c = h(&v_c);
        let mut own = vec![0.0; n];
        penalty.add_product(&v_c, &mut own);
        h_v_c.iter_mut().zip(&own).for_each(|(h, own)| *h -= own);
        stiff.add_product(&v_c, &mut h_v_c);
        let error = largest_difference(&two.coarse(&h_v_c), &v_c);
        // As above; with the inverse for the other penalty it would be 1e2.
        assert!(error < 1e-2 * largest_magnitude(v_c.iter().copied()), "{error}");
        nodes.by_rows
    }
}
