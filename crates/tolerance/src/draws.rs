//! The distribution of the residual, from draws in the few dimensions that the errors span.
//!
//! ```text
//! e    = e0 - sum_i eta_i f_i - n         n: all that is noise, of covariance S
//! |e|^2 = |a0 - sum_i eta_i a_i - z|^2 + |n_perp|^2
//! ```
//!
//! in coordinates of an orthonormal basis of e0 and the f_i: a are theirs, z ~ N(0, basis' S basis) is what of the
//! noise is among them. The rest of the noise, n_perp, is orthogonal to all of them; its mean square is a sum of
//! squares of normal numbers, for which stands the gamma distribution of the same mean and variance,
//! trace(S_perp) and 2 trace(S_perp^2).

use nalgebra::{DMatrix, DVector, SymmetricEigen};
use planish_simulate::sample::{draw, stream};
use rand_distr::{Distribution as _, Gamma, StandardNormal};
use rayon::prelude::*;

use crate::error_budget::Distribution;

/// Number of draws from one stream of random numbers. Larger: fewer tasks for the threads. Smaller: more overhead.
/// Another value draws other numbers.
const DRAWS_PER_STREAM: usize = 1000;

/// First stream of random numbers of the runs with one error, by which its departure from the first order is measured.
/// The other uses of a seed have the streams after it: fields of the noise, runs with all errors, runs for a row of the
/// table, draws.
pub const DEPARTURE_STREAM: u64 = 0;
/// First stream of random numbers of the fields of the noise.
pub const POOL_STREAM: u64 = 1 << 20;
/// First stream of random numbers of the runs with all errors.
pub const RUN_STREAM: u64 = 1 << 24;
/// First stream of random numbers of the simulated runs for a row of the table.
pub const LINE_STREAM: u64 = 1 << 30;
/// First stream of random numbers of the draws, which use all streams from here on.
const FIRST_STREAM: u64 = 1 << 32;

/// Eigenvalue of a Gram matrix, as a fraction of the largest, up to which its direction is left out of the basis.
/// Larger: weak errors are left out. Smaller: rounding adds directions.
const INDEPENDENT: f64 = 1e-12;

/// An error that a single random number describes: the distribution of the number, and its effect.
#[derive(Clone, Debug)]
pub struct Term {
    /// Distribution of the number about zero, at size one.
    pub distribution: Distribution,
    /// Coordinates of the field of the error at its size (a_i of the module), nm.
    pub coordinates: DVector<f64>,
}

/// Model of the residual from which its RMS is drawn.
#[derive(Clone, Debug)]
pub struct ResidualModel {
    /// Coordinates of the residual of the plan (a0 of the module), nm.
    pub nominal: DVector<f64>,
    /// Errors that a single number describes, with their fields f_i.
    pub terms: Vec<Term>,
    /// Covariance of the noise in the span of the fields (z of the module), nm^2.
    pub noise: DMatrix<f64>,
    /// Mean square of the noise outside the span, trace(S_perp), nm^2.
    pub rest: f64,
    /// Variance of that mean square, 2 trace(S_perp^2), nm^4.
    pub rest_variance: f64,
}

/// Orthonormalises vectors with the Gram matrix `gram`. Returns their coordinates in an orthonormal basis of their
/// span, as columns, and the basis as combinations of the vectors, as columns.
pub fn orthonormal(gram: &DMatrix<f64>) -> (DMatrix<f64>, DMatrix<f64>) {
    let eigen = SymmetricEigen::new(gram.clone());
    let largest = eigen.eigenvalues.iter().fold(0.0_f64, |m, v| m.max(*v));
    let n = gram.nrows();
    let above: Vec<usize> =
        (0..n).filter(|i| eigen.eigenvalues[*i] > INDEPENDENT * largest).collect();
    let root: Vec<f64> = above.iter().map(|i| eigen.eigenvalues[*i].sqrt()).collect();
    let vector = |i: usize, k: usize| eigen.eigenvectors[(i, above[k])];
    let coordinates = DMatrix::from_fn(above.len(), n, |k, i| root[k] * vector(i, k));
    let basis = DMatrix::from_fn(n, above.len(), |i, k| vector(i, k) / root[k]);
    (coordinates, basis)
}

impl ResidualModel {
    /// Returns the mean over the runs of the mean square of the residual, nm^2.
    pub fn mean_square(&self) -> f64 {
        let mut e = self.nominal.clone();
        let mut square = self.noise.trace() + self.rest;
        for term in &self.terms {
            match term.distribution {
                Distribution::Fixed => e -= &term.coordinates,
                Distribution::Normal => square += term.coordinates.norm_squared(),
                Distribution::Uniform => square += term.coordinates.norm_squared() / 3.0,
            }
        }
        e.norm_squared() + square
    }

    /// Draws the RMS of the residual of `count` runs, nm, in ascending order.
    pub fn sorted(&self, count: usize, seed: u64) -> Vec<f64> {
        let mut rms = self.draw(count, seed);
        rms.sort_unstable_by(f64::total_cmp);
        rms
    }

    /// Draws the RMS of the residual of `count` runs, nm.
    pub fn draw(&self, count: usize, seed: u64) -> Vec<f64> {
        // noise = root root'; a map of one pixel has no residual, and no dimension
        let root = if self.noise.is_empty() {
            self.noise.clone()
        } else {
            let eigen = SymmetricEigen::new(self.noise.clone());
            let scale = eigen.eigenvalues.map(|v| v.max(0.0).sqrt());
            &eigen.eigenvectors * DMatrix::from_diagonal(&scale)
        };
        let rest = if self.rest_variance > 0.0 && self.rest > 0.0 {
            let shape = self.rest * self.rest / self.rest_variance;
            Gamma::new(shape, self.rest_variance / self.rest).ok()
        } else {
            None
        };
        let streams = count.div_ceil(DRAWS_PER_STREAM);
        (0..streams)
            .into_par_iter()
            .flat_map_iter(|s| {
                let mut rng = stream(seed, FIRST_STREAM + s as u64);
                let here = DRAWS_PER_STREAM.min(count - s * DRAWS_PER_STREAM);
                let mut e = self.nominal.clone();
                let root = &root;
                let rest = &rest;
                (0..here).map(move |_| {
                    e.copy_from(&self.nominal);
                    for term in &self.terms {
                        e.axpy(-draw(term.distribution, &mut rng), &term.coordinates, 1.0);
                    }
                    for column in root.column_iter() {
                        let xi: f64 = StandardNormal.sample(&mut rng);
                        e.axpy(-xi, &column, 1.0);
                    }
                    let more = rest.as_ref().map_or(self.rest, |gamma| gamma.sample(&mut rng));
                    (e.norm_squared() + more).sqrt()
                })
            })
            .collect()
    }
}

/// Returns the quantile of the ascending values `sorted` for the fraction `part`, 0 to 1, interpolated between two of
/// them.
pub fn quantile(sorted: &[f64], part: f64) -> f64 {
    let place = part * (sorted.len() - 1) as f64;
    let below = place.floor() as usize;
    let f = place.fract();
    let above = (below + 1).min(sorted.len() - 1);
    sorted[below] + f * (sorted[above] - sorted[below])
}
