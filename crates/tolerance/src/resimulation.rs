//! Simulated runs, in which errors act as they are and not to first order.

use nalgebra::{DMatrix, SymmetricEigen};
use ndarray::Array2;
use planish_numerics::{parallel, quadrature::gauss_legendre};
use planish_types::{Invalid, outcome::tolerance::ErrorLine, progress};

use crate::{
    deviation::Deviation,
    draws::{LINE_STREAM, RUN_STREAM},
    error_budget::{Distribution, Effect},
    lines::Linear,
    noise::Columns,
    reach::Reach,
    report::Pair,
    sample::{draw, sample, stream, white},
    work::Work,
};

/// Number of simulated runs for the table row of a noise whose first order is not enough; their standard error is
/// stated. Larger: more time. Smaller: a larger standard error.
const RUNS_OF_NOISE: usize = 32;

/// Number of nodes of the quadrature over the one number of an error whose first order is not enough. It is exact for
/// the square of a polynomial of the 5th degree. An even number has no node at 0, at which a response without a
/// derivative there (a TIF with noise that moves over the pixels) would not be seen. The farthest node is at 3.32
/// standard deviations, at which the largest fraction that a process may state leaves a rate or a width positive.
/// Larger: more time, and farther nodes. Smaller: less exact.
const NODES: usize = 6;

/// Returns values of an error of size one and their weights, which sum to one: the weighted sum of a function at them
/// is its mean. The rule is that of Gauss and Hermite, of Gauss and Legendre, or the single value of a fixed error.
fn quadrature(distribution: Distribution) -> Vec<(f64, f64)> {
    match distribution {
        // Golub and Welsch: the Jacobi matrix of the polynomials orthogonal under the normal density has sqrt(k)
        // beside its diagonal.
        Distribution::Normal => {
            let jacobi = DMatrix::from_fn(NODES, NODES, |i, j| {
                if i.abs_diff(j) == 1 { (i.max(j) as f64).sqrt() } else { 0.0 }
            });
            let eigen = SymmetricEigen::new(jacobi);
            (0..NODES).map(|k| (eigen.eigenvalues[k], eigen.eigenvectors[(0, k)].powi(2))).collect()
        }
        Distribution::Uniform => {
            let rule = gauss_legendre::<NODES>();
            rule.iter().map(|(node, weight)| (2.0 * node - 1.0, *weight)).collect()
        }
        Distribution::Fixed => vec![(1.0, 1.0)],
    }
}

impl Work<'_> {
    /// Replaces the table row `line` of the error `index` by the result of simulated runs: the RMS that is added, its
    /// reached and unreached part, and for noise the standard error.
    ///
    /// # Errors
    /// Refuses a deviation that cannot be simulated.
    pub fn simulate_line(
        &self,
        index: usize,
        line: &mut ErrorLine,
        reach: &Reach,
        seed: u64,
    ) -> Result<(), Invalid> {
        let error = &self.process.errors[index];
        let noise = matches!(error.effect, Effect::Noise(_));
        let nodes = if noise {
            vec![(0.0, 1.0 / RUNS_OF_NOISE as f64); RUNS_OF_NOISE]
        } else {
            quadrature(error.stated.distribution)
        };
        let runs: Vec<Result<_, Invalid>> = parallel::map(nodes.len(), &|k| {
            let (eta, weight) = nodes[k];
            let mut rng = stream(seed, LINE_STREAM + ((index as u64) << 16) + k as u64);
            let mut run = Deviation::default();
            match error.effect {
                Effect::Scalar(effect) => run.add(effect, error.size * eta),
                Effect::Noise(noise) => {
                    sample(noise, error.size, self.motion(), &mut rng, &mut run)
                }
                Effect::MapLowOrder { .. } | Effect::MapNoise => {}
            }
            let added = &self.nominal - &self.residual(&run)?;
            let square = self.inner.dot(&added, &added);
            let reached = reach.mean_square(&self.inner, &added).min(square);
            Ok((weight, square, reached))
        });
        let runs = runs.into_iter().collect::<Result<Vec<_>, Invalid>>()?;
        let mean = |value: fn(&(f64, f64, f64)) -> f64| -> f64 {
            runs.iter().map(|run| run.0 * value(run)).sum()
        };
        let square = mean(|r| r.1);
        let of_square = mean(|r| r.1 * r.1);
        line.adds_rms_nm = square.sqrt();
        line.reached_rms_nm = mean(|r| r.2).sqrt();
        line.unreached_rms_nm = mean(|r| r.1 - r.2).sqrt();
        line.simulated = true;
        // d sqrt(s) = ds / (2 sqrt(s)), and the variance of a mean over n runs
        let variance = (of_square - square * square).max(0.0) / (RUNS_OF_NOISE - 1) as f64;
        line.standard_error_nm = if noise && square > 0.0 {
            Some(variance.sqrt() / (2.0 * square.sqrt()))
        } else {
            None
        };
        Ok(())
    }

    /// Simulates `count` runs with all errors, and computes the same runs to first order.
    ///
    /// # Errors
    /// Refuses a deviation that cannot be simulated.
    pub fn runs(
        &self,
        count: usize,
        linear: &[Linear],
        columns: Option<&Columns<'_>>,
        seed: u64,
    ) -> Result<Vec<Pair>, Invalid> {
        let pieces = progress::PieceCounter::new(count);
        let runs = parallel::map(count, &|k| {
            let pair = self.run_with_all(k as u64, linear, columns, seed);
            progress::done(pieces.one_more());
            pair
        });
        runs.into_iter().collect()
    }

    /// Simulates run number `k` with all errors, and computes the same run to first order.
    fn run_with_all(
        &self,
        k: u64,
        linear: &[Linear],
        columns: Option<&Columns<'_>>,
        seed: u64,
    ) -> Result<Pair, Invalid> {
        let mut rng = stream(seed, RUN_STREAM + k);
        let mut run = Deviation::default();
        let mut first = self.nominal.clone();
        let mut map = Array2::zeros(self.inner.grid.shape());
        for (i, e) in self.process.errors.iter().enumerate().filter(|(_, e)| e.size != 0.0) {
            let mine = linear.iter().filter(|l| l.error == i);
            match e.effect {
                Effect::Scalar(effect) => {
                    for l in mine {
                        let eta = l.size * draw(l.distribution, &mut rng);
                        run.add(effect, eta);
                        first.scaled_add(-eta, &l.field);
                    }
                }
                Effect::MapLowOrder { degree } => {
                    for (l, term) in mine.zip(self.low_order(degree)) {
                        let eta = l.size * draw(l.distribution, &mut rng);
                        map.scaled_add(eta, &term);
                        first.scaled_add(-eta, &l.field);
                    }
                }
                Effect::Noise(noise) => sample(noise, e.size, self.motion(), &mut rng, &mut run),
                Effect::MapNoise => {
                    let noise = white(e.size, self.inner.grid.shape(), &mut rng);
                    map += &noise;
                    first += &self.inner.judged(noise);
                }
            }
        }
        let mut square = self.inner.dot(&first, &first);
        if let Some(columns) = columns {
            // |first - n|^2
            let mut noise = columns.change(&run);
            self.inner.project_on_cells(&mut noise);
            let first = self.inner.to_cells(&first);
            square += self.inner.dot_on_cells(&noise, &noise)
                - 2.0 * self.inner.dot_on_cells(&first, &noise);
        }
        run.map_nm = Some(map);
        let simulated = self.residual(&run)?;
        Ok(Pair {
            simulated_rms_nm: self.rms(&simulated),
            first_order_rms_nm: square.max(0.0).sqrt(),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Moments of the normal distribution, 1, 1, 3, 15, .., and of the uniform one, 1 / (k + 1).
    #[test]
    fn the_quadratures_have_the_moments_of_their_distributions() {
        let moment = |of, k: i32| -> f64 {
            quadrature(of).iter().map(|(node, weight)| weight * node.powi(k)).sum()
        };
        for (k, normal) in [(0, 1.0), (2, 1.0), (4, 3.0), (6, 15.0), (8, 105.0), (10, 945.0)] {
            // Below: rounding of sums of up to 1e3, relative, of nodes and weights with 15 digits or more.
            assert!((moment(Distribution::Normal, k) / normal - 1.0).abs() < 1e-12, "{k}");
            let uniform = 1.0 / f64::from(k + 1);
            assert!((moment(Distribution::Uniform, k) / uniform - 1.0).abs() < 1e-12, "{k}");
            // Odd moments cancel to the same rounding.
            assert!(moment(Distribution::Normal, k + 1).abs() < 1e-11 * normal);
        }
        assert_eq!(quadrature(Distribution::Fixed), [(1.0, 1.0)]);
    }
}
