//! The model for the distribution of the residual: coordinates of e0 and the f_i in an orthonormal basis, and the noise
//! that is orthogonal to all of them. Symbols are those of [`crate::draws`].

use nalgebra::DMatrix;
use ndarray::Array2;

use crate::{
    deviation::Deviation,
    draws::{POOL_STREAM, ResidualModel, Term, orthonormal},
    error_budget::Effect,
    lines::Linear,
    noise::{Columns, Response},
    sample::{sample, stream},
    work::Work,
};
use planish_numerics::parallel;

/// Number of drawn noise fields from which trace(S_perp^2) is estimated, by its 48 x 47 / 2 = 1128 pairs. Larger: more
/// time. Smaller: a less exact variance of the orthogonal noise.
const POOL: usize = 48;

/// The residual of the plan (e0) and the fields of the errors (f_i) in an orthonormal basis of their span.
pub struct Span {
    /// Coordinates in the basis: of e0 in the first column, then of each f_i.
    coordinates: DMatrix<f64>,
    /// Fields of the basis on the cells.
    pub basis: Vec<Vec<f64>>,
}

impl Span {
    /// Computes the basis from the residual of the plan and the fields `linear` of the errors.
    pub fn new(work: &Work<'_>, linear: &[Linear]) -> Self {
        let maps: Vec<&Array2<f64>> =
            [&work.nominal].into_iter().chain(linear.iter().map(|l| &l.field)).collect();
        let n = maps.len();
        let rows: Vec<Vec<f64>> =
            parallel::map(n, &|i| (0..=i).map(|j| work.inner.dot(maps[i], maps[j])).collect());
        let gram = DMatrix::from_fn(n, n, |i, j| rows[i.max(j)][i.min(j)]);
        let (coordinates, basis) = orthonormal(&gram);
        let on_cells: Vec<Vec<f64>> = maps.iter().map(|m| work.inner.to_cells(m)).collect();
        let basis = basis
            .column_iter()
            .map(|b| {
                let mut field = vec![0.0; work.inner.cells.weight.len()];
                for (map, b) in on_cells.iter().zip(b.iter()) {
                    field.iter_mut().zip(map).for_each(|(v, m)| *v += b * m);
                }
                work.inner.project_on_cells(&mut field);
                field
            })
            .collect();
        Self { coordinates, basis }
    }
}

/// Results for all errors of a process, from which models are made.
pub struct Errors<'a> {
    work: &'a Work<'a>,
    linear: &'a [Linear],
    /// For each noise along the run: index of the error, size, and response at size one.
    responses: &'a [(usize, f64, Response)],
    span: &'a Span,
    /// Estimate of trace(S_perp^2) of all the noise along the run, nm^4.
    noise_squares: f64,
}

impl<'a> Errors<'a> {
    /// Collects the results for all errors, and estimates the trace of the squared covariance from noise drawn with
    /// `seed`. `columns` is absent without noise along the run.
    pub fn new(
        work: &'a Work<'a>,
        linear: &'a [Linear],
        responses: &'a [(usize, f64, Response)],
        span: &'a Span,
        columns: Option<&Columns<'_>>,
        seed: u64,
    ) -> Self {
        let noise_squares = columns.map_or(0.0, |c| noise_squares(work, c, &span.basis, seed));
        Self { work, linear, responses, span, noise_squares }
    }

    /// Returns the model from which residuals are drawn; the error with the index `without` is left out, or none.
    pub fn model(&self, without: Option<usize>) -> ResidualModel {
        let coordinates = &self.span.coordinates;
        let dimension = coordinates.nrows();
        let terms = self.linear.iter().enumerate().map(|(i, l)| Term {
            distribution: l.distribution,
            coordinates: coordinates.column(i + 1)
                * if Some(l.error) == without { 0.0 } else { l.size },
        });
        let mut noise = DMatrix::zeros(dimension, dimension);
        let mut all = 0.0;
        let mut total = 0.0;
        for (i, size, response) in self.responses {
            let square = size * size;
            total += square * response.mean_square;
            if Some(*i) != without {
                noise += &response.covariance * square;
                all += square * response.mean_square;
            }
        }
        let smooth = (all - noise.trace()).max(0.0);
        // trace(S_perp^2) of the whole noise, for what is left of it
        let part = if total > 0.0 { all / total } else { 0.0 };
        let squares = self.noise_squares * part * part;
        // White noise of the map: m numbers, less the free terms, of the same variance on every pixel
        let white = self.white(without);
        let m = self.work.inner.count;
        for k in 0..dimension {
            noise[(k, k)] += white / m;
        }
        let free = self.work.inner.cells.free.len() as f64;
        let pixels = (m - free - dimension as f64).max(0.0);
        ResidualModel {
            nominal: coordinates.column(0).into_owned(),
            terms: terms.collect(),
            rest: smooth + white * pixels / m,
            rest_variance: 2.0
                * (squares + 2.0 * white / m * smooth + white * white * pixels / (m * m)),
            noise,
        }
    }

    /// Returns the variance of a pixel of the map by its white noise, nm^2; the error with the index `without` is left
    /// out, or none.
    fn white(&self, without: Option<usize>) -> f64 {
        let each = self.work.process.errors.iter().enumerate();
        each.filter(|(i, e)| e.effect == Effect::MapNoise && Some(*i) != without)
            .map(|(_, e)| e.size * e.size)
            .sum()
    }
}

/// Returns an estimate of trace(S_perp^2) of the noise along the run, nm^4, from inner products of independent draws: E
/// <n, n'>^2 = trace(S^2).
fn noise_squares(work: &Work<'_>, columns: &Columns<'_>, basis: &[Vec<f64>], seed: u64) -> f64 {
    let noises = work.noises();
    let inner = &work.inner;
    let fields: Vec<Vec<f64>> = parallel::map(POOL, &|k| {
        let mut rng = stream(seed, POOL_STREAM + k as u64);
        let mut run = Deviation::default();
        for (_, noise, size) in &noises {
            sample(*noise, *size, work.motion(), &mut rng, &mut run);
        }
        let mut field = columns.change(&run);
        inner.project_on_cells(&mut field);
        for q in basis {
            let c = inner.dot_on_cells(q, &field);
            field.iter_mut().zip(q).for_each(|(v, q)| *v -= c * q);
        }
        field
    });
    let squares: Vec<f64> = parallel::map(POOL, &|i| {
        (0..i).map(|j| inner.dot_on_cells(&fields[i], &fields[j]).powi(2)).sum()
    });
    squares.iter().sum::<f64>() / (POOL * (POOL - 1) / 2) as f64
}
