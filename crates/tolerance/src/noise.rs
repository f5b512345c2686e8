//! Variance that independent errors along the run add to the residual, computed without random draws.
//!
//! A piece k of the motion removes b_k(x), the integral of the TIF over it. With the deviation g_k of the rate
//! the residual changes by `-sum g_k b_k`, and for a zero-mean g of covariance C the mean square that is added is
//!
//! ```text
//! E |P sum g_k b_k|^2 = sum_kl C_kl <P b_k, P b_l>
//! ```
//!
//! No matrix of the size (pieces)^2 is made. Independent errors of every stay have a diagonal C. The
//! Ornstein-Uhlenbeck process is Markovian. The covariance of the mean of g over piece k with that over an earlier
//! piece l is `sigma^2 a_k a_l exp(-gap / tau)`, with `a = tau / h (1 - exp(-h / tau))` of the duration h. So one
//! pass over the pieces carries `s = sum_l a_l b_l exp(-gap / tau)` along, cell by cell, or for any wanted linear
//! functional of b. The variance of P n at a place is, with the free terms q,
//!
//! ```text
//! Var n(x) - 2 sum_q q(x) Cov(n(x), <q, n>) + sum_qr q(x) r(x) Cov(<q, n>, <r, n>)
//! Cov(n(x), <q, n>) = sum_k b_k(x) c_kq,    c_kq = sum_l C_kl <q, b_l>
//! ```
//!
//! and c_kq is what a pass forwards and one backwards carry.
//!
//! Every quantity here is for an error of size one.

use std::ops::Range;

use nalgebra::DMatrix;
use planish_numerics::parallel;
use planish_types::{Invalid, budget};

use crate::{
    deviation::Deviation,
    error_budget::Noise,
    field::{Change, Field, Tool, cells_of_tif, field},
    inner::Inner,
    motion::Motion,
    reach::CosinesOnCells,
    sample::Mean,
};

/// Effect on the residual of the errors of one kind at size one.
pub struct Response {
    /// Variance of the residual on every cell, without the free terms, nm^2.
    pub variance: Vec<f64>,
    /// Mean square that the errors add, without the free terms, nm^2.
    pub mean_square: f64,
    /// Part of the mean square at the wavelengths that the tool corrects, nm^2.
    pub reached: f64,
    /// Covariance of the inner products of the added residual with the fields of the basis, nm^2.
    pub covariance: DMatrix<f64>,
}

/// Removal by every piece and every stay of a motion, on the cells of a map. A stay is the part of the motion that
/// serves one dwell point.
pub struct Columns<'a> {
    motion: &'a Motion,
    inner: &'a Inner,
    /// Removal by every piece, nm.
    piece: Vec<Field>,
    /// Removal by every stay, nm.
    stay: Vec<Field>,
    /// Change of the removal by every stay per displacement along x and y, nm/mm; empty if it was not requested.
    displaced: [Vec<Field>; 2],
    /// Linear functionals that are evaluated for the fields: free terms, basis, cosines.
    functionals: Functionals,
}

/// Linear functionals of fields: inner products with the free terms and with a basis, and coefficients of cosines.
struct Functionals {
    /// Free terms, then the fields of the basis, on the cells.
    fields: Vec<Vec<f64>>,
    free: usize,
    cosines: CosinesOnCells,
    /// Coefficients of the cosines of every free term.
    of_free: Vec<Vec<f64>>,
}

impl Functionals {
    /// Returns the number of functionals: the fields and the reached pairs of cosines.
    fn len(&self) -> usize {
        self.fields.len() + self.cosines.pairs.len()
    }

    /// Returns the values of all functionals of a field; the cosines are those of the field without its free terms.
    fn values(&self, field: &Field, inner: &Inner) -> Vec<f64> {
        let per_row = inner.cells.shape.1;
        let weight = &inner.cells.weight;
        let mut all = Vec::with_capacity(self.len());
        for other in &self.fields {
            let mut sum = 0.0;
            for (first, line) in field.lines(per_row) {
                let cells = first..first + line.len();
                let each = line.iter().zip(&weight[cells.clone()]).zip(&other[cells]);
                sum += each.map(|((v, w), o)| v * w * o).sum::<f64>();
            }
            all.push(sum / inner.count);
        }
        let mut cosines = self.cosines_of(field, inner);
        for (of_free, part) in self.of_free.iter().zip(&all[..self.free]) {
            cosines.iter_mut().zip(of_free).for_each(|(c, f)| *c -= part * f);
        }
        all.extend(cosines);
        all
    }

    /// Returns the coefficient of every pair of cosines: `sum over the cells of w f cos(y) cos(x) / sqrt(m)`.
    fn cosines_of(&self, field: &Field, inner: &Inner) -> Vec<f64> {
        let CosinesOnCells { y, x, pairs } = &self.cosines;
        let ny = y.ncols();
        let nx = x.ncols();
        let mut table = vec![0.0; ny * nx];
        let mut along_x = vec![0.0; nx];
        for (r, (first, line)) in field.lines(inner.cells.shape.1).enumerate() {
            along_x.fill(0.0);
            for (c, v) in line.iter().enumerate() {
                let v = v * inner.cells.weight[first + c];
                let cosines = x.row(field.columns.start + c);
                along_x.iter_mut().zip(cosines).for_each(|(a, x)| *a += v * x);
            }
            for (k, y) in y.row(field.rows.start + r).iter().enumerate() {
                let into = &mut table[k * nx..(k + 1) * nx];
                into.iter_mut().zip(&along_x).for_each(|(t, a)| *t += y * a);
            }
        }
        let scale = inner.count.sqrt();
        pairs.iter().map(|(k, j)| table[k * nx + j] / scale).collect()
    }
}

impl<'a> Columns<'a> {
    /// Computes the removal by the pieces and stays of a motion, and if `displaced` is true also its change with the
    /// position of the tool. `basis` are fields on the cells without free terms.
    ///
    /// # Errors
    /// Refuses a motion of so many pieces that its fields take too much memory.
    pub fn new(
        motion: &'a Motion,
        inner: &'a Inner,
        tool: &Tool,
        cosines: CosinesOnCells,
        basis: Vec<Vec<f64>>,
        displaced: bool,
    ) -> Result<Self, Invalid> {
        let kinds = if displaced { 3.0 } else { 1.0 };
        let cells = cells_of_tif(inner, &tool.tif);
        let functionals = inner.cells.free.len() + basis.len() + cosines.pairs.len();
        let each = 2.0 * kinds * cells as f64 + 2.0 * kinds * functionals as f64;
        let remedy = "give a motion of fewer segments, or crop and bin the map and the TIF";
        budget::affordable("trajectory", motion.pieces.len() as f64 * each, 8, remedy)?;

        let free = inner.cells.free.len();
        let fields: Vec<Vec<f64>> = inner.cells.free.iter().cloned().chain(basis).collect();
        let mut functionals = Functionals { fields, free, cosines, of_free: Vec::new() };
        functionals.of_free = inner
            .cells
            .free
            .iter()
            .map(|f| {
                let (rows, columns) = inner.cells.shape;
                let whole = Field { rows: 0..rows, columns: 0..columns, value: f.clone() };
                functionals.cosines_of(&whole, inner)
            })
            .collect();
        let fields = |change: Change| -> Vec<Field> {
            parallel::map(motion.pieces.len(), &|k| field(&motion.pieces[k], inner, tool, change))
        };
        let piece = fields(Change::AsItIs);
        let stay = by_stay(motion, &piece);
        let displaced = if displaced {
            [0, 1].map(|axis| by_stay(motion, &fields(Change::Along(axis))))
        } else {
            Default::default()
        };
        Ok(Self { motion, inner, piece, stay, displaced, functionals })
    }

    /// Returns the effect on the residual of the errors of a kind at size one.
    pub fn response(&self, noise: Noise) -> Response {
        match noise {
            Noise::Rate { correlation_s } => self.of_rate(correlation_s),
            Noise::Position => self.of_independent(self.displaced.iter().flatten().cloned(), 1.0),
            Noise::Jitter => self.of_independent(self.longer().into_iter(), 1.0),
            Noise::Tick => {
                // The boundary i moves: the stay before it is longer, that after it shorter.
                let longer = self.longer();
                let nothing = Field::default();
                let moved = (0..=longer.len()).map(|i| {
                    let before = if i > 0 { &longer[i - 1] } else { &nothing };
                    let after = longer.get(i).unwrap_or(&nothing);
                    Field::sum(&[(before, 1.0), (after, -1.0)])
                });
                self.of_independent(moved, TICK_VARIANCE)
            }
        }
    }

    /// Returns the removal of every stay per second of its time, nm/s.
    fn longer(&self) -> Vec<Field> {
        let stays = self.stay.iter().zip(&self.motion.stay_s);
        stays.map(|(f, t)| Field::sum(&[(f, 1.0 / t)])).collect()
    }

    /// Returns the response to independent errors of this variance, one for each of `fields`, which it multiplies.
    fn of_independent(&self, fields: impl Iterator<Item = Field>, variance: f64) -> Response {
        let fields: Vec<Field> = fields.collect();
        let all: Vec<Vec<f64>> =
            parallel::map(fields.len(), &|k| self.functionals.values(&fields[k], self.inner));
        let mut on_cells = vec![0.0; self.inner.cells.weight.len()];
        for field in &fields {
            for (first, line) in field.lines(self.inner.cells.shape.1) {
                let into = &mut on_cells[first..first + line.len()];
                into.iter_mut().zip(line).for_each(|(s, v)| *s += variance * v * v);
            }
        }
        let (free, basis) = self.parts();
        let mut squares = vec![0.0; self.functionals.len()];
        let mut covariance = DMatrix::zeros(basis.len(), basis.len());
        for z in &all {
            squares.iter_mut().zip(z).for_each(|(s, v)| *s += variance * v * v);
            add_outer(&mut covariance, &z[basis.clone()], &z[basis.clone()], variance);
        }
        let mean_square = self.mean_square(&on_cells, &squares[free.clone()]);
        let carried: Vec<Vec<f64>> =
            all.iter().map(|z| z[free.clone()].iter().map(|z| variance * z).collect()).collect();
        self.remove_free(&mut on_cells, &fields, &all, &carried);
        self.finish(on_cells, mean_square, &squares[basis.end..], covariance)
    }

    /// Returns the response to a relative rate that is an Ornstein-Uhlenbeck process of standard deviation one and
    /// correlation time `tau`, s.
    fn of_rate(&self, tau: f64) -> Response {
        let all: Vec<Vec<f64>> = parallel::map(self.piece.len(), &|k| {
            self.functionals.values(&self.piece[k], self.inner)
        });
        let cells = self.inner.cells.weight.len();
        let mut on_cells = vec![0.0; cells];
        // s of the module on every cell, at the time up to which it is known
        let mut carried = vec![0.0; cells];
        let mut until = vec![0.0; cells];
        let (free, basis) = self.parts();
        let mut squares = vec![0.0; self.functionals.len()];
        let mut covariance = DMatrix::zeros(basis.len(), basis.len());
        let mut carried_z = vec![0.0; self.functionals.len()];
        let mut now = 0.0;
        // c_kq
        let mut with_all = Vec::with_capacity(all.len());
        for ((piece, field), z) in self.motion.pieces.iter().zip(&self.piece).zip(&all) {
            let start = piece.start_s;
            let h = piece.duration_s;
            let mean = Mean::over(h / tau);
            for (first, line) in field.lines(self.inner.cells.shape.1) {
                for (c, v) in line.iter().enumerate() {
                    let i = first + c;
                    let b = *v;
                    let s = carried[i] * ((until[i] - start) / tau).exp();
                    on_cells[i] += mean.variance * b * b + 2.0 * mean.weight * b * s;
                    carried[i] = s * (-h / tau).exp() + mean.weight * b;
                    until[i] = start + h;
                }
            }
            let gap = ((now - start) / tau).exp();
            carried_z.iter_mut().for_each(|s| *s *= gap);
            for ((square, v), s) in squares.iter_mut().zip(z).zip(&carried_z) {
                *square += mean.variance * v * v + 2.0 * mean.weight * v * s;
            }
            let each = z[free.clone()].iter().zip(&carried_z);
            let with_earlier = each.map(|(z, s)| mean.variance * z + mean.weight * s);
            with_all.push(with_earlier.collect::<Vec<f64>>());
            let b = &z[basis.clone()];
            let s = &carried_z[basis.clone()];
            add_outer(&mut covariance, b, b, mean.variance);
            add_outer(&mut covariance, b, s, mean.weight);
            add_outer(&mut covariance, s, b, mean.weight);
            let decay = (-h / tau).exp();
            for (s, v) in carried_z.iter_mut().zip(z) {
                *s = *s * decay + mean.weight * v;
            }
            now = start + h;
        }
        let mut later = vec![0.0; free.len()];
        for ((piece, z), c) in self.motion.pieces.iter().zip(&all).zip(&mut with_all).rev() {
            let end = piece.start_s + piece.duration_s;
            let h = piece.duration_s;
            let mean = Mean::over(h / tau);
            let gap = ((end - now) / tau).exp();
            let decay = (-h / tau).exp();
            for ((s, z), c) in later.iter_mut().zip(z).zip(c) {
                *s *= gap;
                *c += mean.weight * *s;
                *s = *s * decay + mean.weight * z;
            }
            now = piece.start_s;
        }
        let mean_square = self.mean_square(&on_cells, &squares[free]);
        self.remove_free(&mut on_cells, &self.piece, &all, &with_all);
        self.finish(on_cells, mean_square, &squares[basis.end..], covariance)
    }

    /// Returns the mean square of the residual without the free terms, nm^2. `variance` is that on the cells, `free`
    /// the mean squares of the coefficients of the free terms.
    fn mean_square(&self, variance: &[f64], free: &[f64]) -> f64 {
        let weight = &self.inner.cells.weight;
        let all = variance.iter().zip(weight).map(|(v, w)| v * w).sum::<f64>() / self.inner.count;
        (all - free.iter().sum::<f64>()).max(0.0)
    }

    /// Removes the free terms from the variance on the cells. `carried` are the numbers c_kq of the module.
    fn remove_free(
        &self,
        variance: &mut [f64],
        fields: &[Field],
        functionals: &[Vec<f64>],
        carried: &[Vec<f64>],
    ) {
        let free = &self.inner.cells.free;
        let mut between = DMatrix::zeros(free.len(), free.len());
        for (z, c) in functionals.iter().zip(carried) {
            add_outer(&mut between, &z[..free.len()], c, 1.0);
        }
        for (q, term) in free.iter().enumerate() {
            for (r, other) in free.iter().enumerate() {
                let between_terms = between[(q, r)];
                let pairs = variance.iter_mut().zip(term).zip(other);
                pairs.for_each(|((v, q), r)| *v += between_terms * q * r);
            }
            for (field, c) in fields.iter().zip(carried) {
                for (first, line) in field.lines(self.inner.cells.shape.1) {
                    let cells = first..first + line.len();
                    let each = variance[cells.clone()].iter_mut().zip(&term[cells]).zip(line);
                    each.for_each(|((v, term), b)| *v -= 2.0 * c[q] * term * b);
                }
            }
        }
        variance.iter_mut().for_each(|v| *v = v.max(0.0));
    }

    /// Returns the ranges of the free terms and of the basis among the functionals.
    fn parts(&self) -> (Range<usize>, Range<usize>) {
        let f = &self.functionals;
        (0..f.free, f.free..f.fields.len())
    }

    /// Makes the response from its parts; `cosines` are the mean squares of the coefficients of the reached cosines.
    fn finish(
        &self,
        variance: Vec<f64>,
        mean_square: f64,
        cosines: &[f64],
        covariance: DMatrix<f64>,
    ) -> Response {
        // What sampling on cells adds to the cosines is not more than there is.
        let reached = cosines.iter().sum::<f64>().clamp(0.0, mean_square);
        Response { variance, mean_square, reached, covariance }
    }

    /// Returns the change of the removal by the errors of a run, to first order, on the cells, nm.
    pub fn change(&self, run: &Deviation) -> Vec<f64> {
        let mut change = vec![0.0; self.inner.cells.weight.len()];
        for (field, g) in self.piece.iter().zip(&run.rate_of_piece) {
            self.add(&mut change, field, *g);
        }
        for ((field, t), more) in self.stay.iter().zip(&self.motion.stay_s).zip(&run.time_of_stay_s)
        {
            self.add(&mut change, field, more / t);
        }
        for (axis, fields) in self.displaced.iter().enumerate() {
            for (field, place) in fields.iter().zip(&run.place_of_stay_mm) {
                self.add(&mut change, field, place[axis]);
            }
        }
        change
    }

    /// Adds a field times the number `by` to `sum` on the cells.
    fn add(&self, sum: &mut [f64], field: &Field, by: f64) {
        for (first, line) in field.lines(self.inner.cells.shape.1) {
            let into = &mut sum[first..first + line.len()];
            into.iter_mut().zip(line).for_each(|(s, v)| *s += by * v);
        }
    }
}

/// Returns, for every stay, the sum of the fields of its pieces.
fn by_stay(motion: &Motion, of_piece: &[Field]) -> Vec<Field> {
    let mut rest = of_piece;
    let mut stays = Vec::with_capacity(motion.stay_s.len());
    for pieces in motion.pieces.chunk_by(|a, b| a.stay == b.stay) {
        let (own, others) = rest.split_at(pieces.len());
        let parts: Vec<_> = own.iter().map(|f| (f, 1.0)).collect();
        stays.push(Field::sum(&parts));
        rest = others;
    }
    stays
}

/// Variance of a time that is uniform over one tick, in squared ticks: 1/12.
const TICK_VARIANCE: f64 = 1.0 / 12.0;

/// Adds `by` times the outer product `a b'` to the matrix m.
fn add_outer(m: &mut DMatrix<f64>, a: &[f64], b: &[f64], by: f64) {
    for (mut column, b) in m.column_iter_mut().zip(b) {
        column.iter_mut().zip(a).for_each(|(m, a)| *m += by * a * b);
    }
}
