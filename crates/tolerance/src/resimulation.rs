//! Runs with errors as they are, not to first order.

use ndarray::Array2;
use planish_types::Invalid;
use rand_distr::{Distribution as _, StandardNormal};
use rayon::prelude::*;

use crate::{
    deviation::Deviation,
    draws::{LINE_STREAM, RUN_STREAM, draw, stream},
    lines::Linear,
    noise::{Columns, sample},
    process::Effect,
    reach::Reach,
    report::{Line, Pair},
    work::Work,
};

/// Runs from which the line of an error is taken where the first order is not enough.
const RUNS_OF_ONE_ERROR: usize = 32;

impl Work<'_> {
    /// The line of an error from simulated runs.
    pub fn simulate_line(
        &self,
        index: usize,
        line: &mut Line,
        reach: &Reach,
        seed: u64,
    ) -> Result<(), Invalid> {
        let error = &self.process.errors[index];
        let squares = (0..RUNS_OF_ONE_ERROR as u64)
            .into_par_iter()
            .map(|k| {
                let mut rng = stream(seed, LINE_STREAM + ((index as u64) << 16) + k);
                let mut run = Deviation::default();
                match error.effect {
                    Effect::Scalar(effect) => {
                        run.add(effect, error.size * draw(error.stated.distribution, &mut rng));
                    }
                    Effect::Noise(noise) => {
                        sample(noise, error.size, &self.motion, &mut rng, &mut run)
                    }
                    Effect::MapLowOrder { .. } | Effect::MapNoise => {}
                }
                let added = &self.nominal - &self.residual(&run)?;
                let square = self.inner.dot(&added, &added);
                Ok((square, reach.mean_square(&self.inner, &added).min(square)))
            })
            .collect::<Result<Vec<_>, Invalid>>()?;
        let mean = |of: fn(&(f64, f64)) -> f64| {
            (squares.iter().map(of).sum::<f64>() / squares.len() as f64).sqrt()
        };
        line.adds_rms_nm = mean(|s| s.0);
        line.reached_rms_nm = mean(|s| s.1);
        line.unreached_rms_nm = mean(|s| s.0 - s.1);
        line.simulated = true;
        Ok(())
    }

    /// Runs with all errors.
    pub fn runs(
        &self,
        count: usize,
        linear: &[Linear],
        columns: Option<&Columns<'_>>,
        seed: u64,
    ) -> Result<Vec<Pair>, Invalid> {
        let of = |k: u64| -> Result<Pair, Invalid> {
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
                    Effect::Noise(noise) => sample(noise, e.size, &self.motion, &mut rng, &mut run),
                    Effect::MapNoise => {
                        let mut white = Array2::zeros(self.inner.grid.shape());
                        for v in &mut white {
                            let xi: f64 = StandardNormal.sample(&mut rng);
                            *v = e.size * xi;
                        }
                        map += &white;
                        first += &self.inner.judged(white);
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
        };
        (0..count as u64).into_par_iter().map(of).collect()
    }
}
