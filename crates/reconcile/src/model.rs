//! The removal as a function of the parameters, and its derivatives.
//!
//! ```text
//! F(p) = (1 + a) M(q),   dF/da = M(q),   dF/dq_i = (1 + a) (M(q + h_i) - M(q - h_i)) / (2 h_i)
//! ```
//!
//! with q all parameters but the rate a. A step h_i moves the tool, or changes the TIF, by 4 % of its width: what a
//! central difference has wrong is (h/sigma)^2 / 6 = 3e-4 of the derivative. A smaller step would see the kinks of a
//! sampled TIF (Keys' convolution has a continuous slope and no more), which change from one point to the next.

use ndarray::Array2;
use planish_numerics::parallel;
use planish_simulate::{deviation::Deviation, error_budget::Scalar, runs::Runs};
use planish_types::{Invalid, Tif};

use crate::parameter::Parameter;

/// Displacement of the tool, or change of its width, in the central differences, in widths of the TIF. Larger: an error
/// of the derivatives that grows with its square. Smaller: kinks of a sampled TIF. Chosen: the error is 3e-4 of the
/// derivative.
pub const STEP: f64 = 0.04;

/// Largest displacement of the tool by a parameter of the position, in widths of the TIF; the constant below is the
/// largest relative change of the rate or the TIF. Larger: parameters at which the plan and the run have nothing in
/// common. Smaller: steps of a fit are refused that lead to the minimum. Chosen.
const LARGEST_IN_WIDTHS: f64 = 20.0;
const LARGEST_PART: f64 = 0.5;

/// Relative drift of the rate in its central difference. The removal is linear in it, so any step is exact.
const DRIFT_STEP: f64 = 0.1;

/// Removal of the executed plan as a function of the free parameters.
pub struct RemovalModel<'a> {
    /// Simulated runs with the TIF that gives the derivatives.
    pub runs: &'a Runs<'a>,
    /// Simulated runs that give the removal itself; `None` if they are those of `runs`.
    pub removal_from: Option<&'a Runs<'a>>,
    /// TIF that the parameters change.
    pub tif: &'a Tif,
    /// Free parameters of the model.
    pub parameters: Vec<Parameter>,
    /// Scale of each parameter: its standard deviation about the plan, as known beforehand.
    pub scales: Vec<f64>,
    /// Displacement of the tool in the differences, in widths of the TIF: [`STEP`].
    pub step: f64,
}

impl<'a> RemovalModel<'a> {
    /// Creates the model with the free `parameters`; `scale` returns the standard deviation of each as known
    /// beforehand.
    pub fn new(
        runs: &'a Runs<'a>,
        tif: &'a Tif,
        parameters: Vec<Parameter>,
        scale: impl Fn(Parameter) -> f64,
    ) -> Self {
        let scales = parameters.iter().map(|p| scale(*p)).collect();
        Self { runs, removal_from: None, tif, parameters, scales, step: STEP }
    }

    /// Returns the change of a parameter with this effect that displaces the tool by `mm` at most.
    fn per_mm(&self, effect: Scalar, mm: f64) -> f64 {
        mm / self.runs.displacement_per_size(effect)
    }

    /// Returns true if none of these values of the parameters is too large for a run: a position moves the tool by at
    /// most [`LARGEST_IN_WIDTHS`], and other values are at most [`LARGEST_PART`].
    pub(crate) fn is_possible(&self, values: &[f64]) -> bool {
        let width = self.tif.width_mm();
        self.parameters.iter().zip(values).all(|(parameter, value)| {
            let largest = match (parameter, parameter.effect()) {
                (Parameter::OffsetX | Parameter::OffsetY, Some(effect))
                | (Parameter::Rotation | Parameter::Magnification, Some(effect)) => {
                    self.per_mm(effect, LARGEST_IN_WIDTHS * width)
                }
                _ => LARGEST_PART,
            };
            value.abs() <= largest
        })
    }

    fn removal_runs(&self) -> &'a Runs<'a> {
        self.removal_from.unwrap_or(self.runs)
    }

    /// Splits the values of the parameters into the factor 1 + a of the rate and the deviation q of the run.
    fn split(&self, values: &[f64]) -> (f64, Deviation) {
        let mut rate = 0.0;
        let mut drift = 0.0;
        let mut run = Deviation::default();
        for (parameter, value) in self.parameters.iter().zip(values) {
            match parameter.effect() {
                None => rate += value,
                Some(Scalar::RateDrift) => drift += value,
                Some(effect) => run.add(effect, *value),
            }
        }
        // Both are parts of the planned rate: (1 + a) (1 + u d / (1 + a)) = 1 + a + u d
        run.add(Scalar::RateDrift, drift / (1.0 + rate));
        (1.0 + rate, run)
    }

    /// Returns the removal F(p) with the values `values` of the parameters, shape (ny, nx), nm.
    ///
    /// # Errors
    /// Fails if the run with these parameters cannot be simulated.
    pub fn removal_nm(&self, values: &[f64]) -> Result<Array2<f64>, Invalid> {
        let (factor, run) = self.split(values);
        Ok(self.removal_runs().removal_nm(&run)? * factor)
    }

    /// Returns the removal F(p), shape (ny, nx), nm, and its derivatives by every parameter, nm per unit of the
    /// parameter.
    ///
    /// # Errors
    /// Fails if a run with these parameters, or with one of them a step away, cannot be simulated.
    pub fn linear(&self, values: &[f64]) -> Result<(Array2<f64>, Vec<Array2<f64>>), Invalid> {
        let (factor, run) = self.split(values);
        let removal = self.removal_runs().removal_nm(&run)?;
        let derivative = |parameter: &Parameter| -> Result<Array2<f64>, Invalid> {
            let Some(effect) = parameter.effect() else { return Ok(removal.clone()) };
            let (h, by) = if effect == Scalar::RateDrift {
                (DRIFT_STEP, 1.0 / factor)
            } else {
                (self.per_mm(effect, self.step * self.tif.width_mm()), 1.0)
            };
            let side = |h: f64| {
                let mut run = run.clone();
                run.add(effect, by * h);
                self.runs.moved_nm(&run)
            };
            Ok((side(h)? - side(-h)?) * (factor / (2.0 * h)))
        };
        let derivatives: Vec<Result<_, Invalid>> =
            parallel::map(self.parameters.len(), &|k| derivative(&self.parameters[k]));
        let derivatives = derivatives.into_iter().collect::<Result<_, _>>()?;
        Ok((removal * factor, derivatives))
    }

    /// Returns `tif` with the rate and the shape that the values `known` of the parameters give; parameters of the
    /// position and the drift change nothing.
    ///
    /// # Errors
    /// Fails if they make no valid TIF.
    pub(crate) fn corrected_tif(tif: &Tif, known: &[(Parameter, f64)]) -> Result<Tif, Invalid> {
        let mut factor = 1.0;
        let mut run = Deviation::default();
        for (parameter, value) in known {
            match (parameter, parameter.effect()) {
                (Parameter::RateScale, _) => factor += value,
                (_, Some(effect)) => run.add(effect, *value),
                (_, None) => {}
            }
        }
        let shaped = run.tif(tif)?;
        let shaped = shaped.as_ref().unwrap_or(tif);
        shaped.with_kernels(|kernel| Ok((*tif.grid(), kernel.rate_nm_per_s() * factor)))
    }
}
