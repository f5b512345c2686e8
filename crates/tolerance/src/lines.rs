//! The table of the errors: the RMS that each adds alone, to first order, and the departure of a run with it from the
//! first order.

use ndarray::Array2;
use planish_numerics::parallel;
use planish_types::{Invalid, outcome::tolerance::ErrorLine};

use crate::{
    deviation::Deviation,
    draws::DEPARTURE_STREAM,
    error_budget::{Distribution, Effect, ProcessError, Scalar},
    noise::{Columns, Response},
    reach::Reach,
    sample::{sample, stream},
    work::Work,
};

/// Displacement of the tool, or change of its width, in a pair of simulated deviations, in widths of the TIF; for
/// errors of the rate it is their fraction. The third order, which does not cancel, is 1e-4 / 6 of the first. Larger:
/// more of the third order. Smaller: more rounding.
pub const STEP: f64 = 0.01;

/// First-order field (f_i of the crate's documentation) of an error that a single number describes. A low-order error
/// of the map has one for each polynomial.
pub struct Linear {
    /// Index of the error in the error budget.
    pub error: usize,
    /// Distribution of the error from run to run.
    pub distribution: Distribution,
    /// Removal that the error adds at size one, without the free terms, shape (ny, nx), nm per size; the residual
    /// changes by minus this.
    pub field: Array2<f64>,
    /// Size of the error, in the unit of the calculation; for one polynomial, its fraction of the size.
    pub size: f64,
}

impl Work<'_> {
    /// Returns the first-order fields, at size one, of all errors that a single number describes, and of the low-order
    /// errors of the map; errors of size 0 have none. `width` is that of the TIF, mm.
    ///
    /// # Errors
    /// Refuses a deviation that cannot be simulated.
    pub fn linear(&self, width: f64) -> Result<Vec<Linear>, Invalid> {
        let errors = &self.process.errors;
        let each: Vec<Result<Vec<Linear>, Invalid>> =
            parallel::map(errors.len(), &|i| self.linear_of(i, &errors[i], width));
        Ok(each.into_iter().collect::<Result<Vec<_>, _>>()?.into_iter().flatten().collect())
    }

    /// Returns the first-order fields of the error `e`, whose index is `error`.
    fn linear_of(
        &self,
        error: usize,
        e: &ProcessError,
        width: f64,
    ) -> Result<Vec<Linear>, Invalid> {
        let distribution = e.stated.distribution;
        match e.effect {
            _ if e.size == 0.0 => Ok(Vec::new()),
            // A planner has one size, which is fixed: its effect is the difference of two runs.
            Effect::Scalar(effect) if effect.is_of_planner() => {
                let mut run = Deviation::default();
                run.add(effect, e.size);
                let field = (self.residual(&Deviation::default())? - self.residual(&run)?) / e.size;
                Ok(vec![Linear { error, distribution, field, size: e.size }])
            }
            Effect::Scalar(effect) => {
                // A servo of any order begins as a lag.
                let effect = match effect {
                    Scalar::ServoFirstOrder | Scalar::ServoSecondOrder { .. } => {
                        Scalar::VelocityLag
                    }
                    other => other,
                };
                let per_size = self.displacement_per_size(effect);
                let step = match effect {
                    // Hysteresis has no derivative: half the play decides which turns are seen at all.
                    Scalar::Backlash => e.size,
                    _ if per_size > 0.0 => STEP * width / per_size,
                    // What acts on the rate is linear: any step will do.
                    _ => STEP,
                };
                let [below, above] = [-step, step].map(|step| {
                    let mut run = Deviation::default();
                    run.add(effect, step);
                    self.residual(&run)
                });
                let field = (below? - above?) / (2.0 * step);
                Ok(vec![Linear { error, distribution, field, size: e.size }])
            }
            Effect::MapLowOrder { degree } => {
                let terms = self.low_order(degree);
                let size = e.size / (terms.len() as f64).sqrt();
                // The residual has it on top.
                let fields = terms.into_iter().map(|t| -self.inner.judged(t));
                Ok(fields.map(|field| Linear { error, distribution, field, size }).collect())
            }
            Effect::Noise(_) | Effect::MapNoise => Ok(Vec::new()),
        }
    }

    /// Returns, for every error, the RMS difference between a simulated run with it alone and its first order, nm. An
    /// error of one number has its size in this run, and noise is drawn once. It is 0 for errors of the map, which are
    /// exact.
    ///
    /// # Errors
    /// Refuses a deviation that cannot be simulated.
    pub fn departures(
        &self,
        linear: &[Linear],
        columns: Option<&Columns<'_>>,
        seed: u64,
    ) -> Result<Vec<f64>, Invalid> {
        let errors = &self.process.errors;
        let departures =
            parallel::map(errors.len(), &|i| self.departure(i, &errors[i], linear, columns, seed));
        departures.into_iter().collect()
    }

    /// Returns the departure from the first order of the error `e` with the index `i`, nm.
    fn departure(
        &self,
        i: usize,
        e: &ProcessError,
        linear: &[Linear],
        columns: Option<&Columns<'_>>,
        seed: u64,
    ) -> Result<f64, Invalid> {
        let mut run = Deviation::default();
        match (e.effect, columns) {
            _ if e.size == 0.0 => Ok(0.0),
            (Effect::Scalar(effect), _) => {
                let l = linear.iter().find(|l| l.error == i).expect("it has a field");
                run.add(effect, l.size);
                let added = &self.nominal - &self.residual(&run)?;
                let first = &l.field * l.size;
                let difference = &added - &first;
                Ok(self.rms(&difference))
            }
            (Effect::Noise(noise), Some(columns)) => {
                let mut rng = stream(seed, DEPARTURE_STREAM + i as u64);
                sample(noise, e.size, self.motion(), &mut rng, &mut run);
                let added = &self.nominal - &self.residual(&run)?;
                let mut added = self.inner.to_cells(&added);
                let mut first = columns.change(&run);
                self.inner.project_on_cells(&mut first);
                added.iter_mut().zip(&first).for_each(|(a, f)| *a -= f);
                Ok(self.inner.dot_on_cells(&added, &added).sqrt())
            }
            // What the map has wrong is in the residual as it is.
            _ => Ok(0.0),
        }
    }

    /// Returns the rows of the table, to first order, one for each error. `departures` are those of every error, nm.
    pub fn lines(
        &self,
        linear: &[Linear],
        responses: &[(usize, f64, Response)],
        reach: &Reach,
        departures: &[f64],
    ) -> Vec<ErrorLine> {
        let lines = self.process.errors.iter().enumerate().map(|(i, e)| {
            let mut square = 0.0;
            let mut reached = 0.0;
            for l in linear.iter().filter(|l| l.error == i) {
                let variance = match l.distribution {
                    Distribution::Normal | Distribution::Fixed => l.size * l.size,
                    Distribution::Uniform => l.size * l.size / 3.0,
                };
                square += variance * self.inner.dot(&l.field, &l.field);
                reached += variance * reach.mean_square(&self.inner, &l.field);
            }
            for (_, size, response) in responses.iter().filter(|(error, ..)| *error == i) {
                square += size * size * response.mean_square;
                reached += size * size * response.reached;
            }
            if e.effect == Effect::MapNoise {
                let free = self.inner.cells.free.len() as f64;
                let m = self.inner.count;
                square = e.size * e.size * (1.0 - free / m).max(0.0);
                reached = (e.size * e.size * reach.of_white(&self.inner)).min(square);
            }
            let stated = &e.stated;
            ErrorLine {
                kind: stated.kind.name(),
                size: stated.size,
                unit: stated.unit.clone(),
                distribution: stated.distribution,
                note: stated.note.clone(),
                adds_rms_nm: square.sqrt(),
                reached_rms_nm: reached.sqrt(),
                unreached_rms_nm: (square - reached).max(0.0).sqrt(),
                departs_by_rms_nm: departures[i],
                simulated: false,
                standard_error_nm: None,
            }
        });
        lines.collect()
    }

    /// Returns the standard deviation of the residual over the runs at every pixel, to first order, shape (ny, nx), nm;
    /// NaN at invalid pixels.
    pub fn deviation_map(
        &self,
        linear: &[Linear],
        responses: &[(usize, f64, Response)],
    ) -> Array2<f64> {
        let mut variance = vec![0.0; self.inner.cells.weight.len()];
        for (_, size, response) in responses {
            let each = variance.iter_mut().zip(&response.variance);
            each.for_each(|(v, more)| *v += size * size * more);
        }
        let mut map = self.inner.from_cells(&variance);
        for l in linear {
            let scale = match l.distribution {
                Distribution::Normal => l.size,
                Distribution::Uniform => l.size / 3.0_f64.sqrt(),
                Distribution::Fixed => continue,
            };
            map.zip_mut_with(&l.field, |v, f| *v += (scale * f).powi(2));
        }
        for e in self.process.errors.iter().filter(|e| e.effect == Effect::MapNoise) {
            map += e.size * e.size;
            for q in self.inner.free() {
                map.zip_mut_with(q, |v, q| *v -= e.size * e.size * q * q / self.inner.count);
            }
        }
        self.inner.with_nan(map.mapv(|v| v.max(0.0).sqrt()))
    }
}
