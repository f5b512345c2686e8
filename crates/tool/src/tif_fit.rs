//! A formula for a measured tool influence function.
//!
//! ```text
//! q = a u^2 + 2 b u v + c v^2,   (u, v) = (x, y) - centre
//! gaussian         R = A exp(-q / 2)
//! super-gaussian   R = A exp(-q^(p/2) / 2),   p = 2 is the Gaussian, larger p a flatter top
//! mixture          R = A_1 exp(-r^2 / 2 s_1^2) + A_2 exp(-r^2 / 2 s_2^2),  r^2 = u^2 + v^2
//! ```
//!
//! by least squares over all samples with the method of Levenberg and Marquardt. The matrix
//! [a b; b c] has the standard deviations of the ellipse as its inverse square roots; it holds any
//! orientation, and a round TIF is no special case.
//!
//! Source: D. W. Marquardt, J. Soc. Ind. Appl. Math. 11 (1963) 431.
//!
//! | symbol | variable | unit |
//! |---|---|---|
//! | A | `peak_nm_per_s` | nm/s |
//! | s | `sigma_mm` | mm |
//! | p | `order` | 1 |

use nalgebra::{DMatrix, DVector};
use ndarray::Array2;
use planish_types::{Invalid, Tif};
use serde::Serialize;

/// Largest number of steps of the fit; one that needs more is reported as not converged. Larger: more time on a TIF
/// that the formula does not describe. Smaller: reports slow fits.
const MAX_STEPS: usize = 200;

/// Largest change of a parameter in a step, relative to the scale of the parameter, at which the fit has
/// converged. Larger: the fit ends earlier, farther from its minimum. Smaller: rounding keeps it from
/// ending.
const TOLERANCE: f64 = 1e-10;

/// Step of the central differences, relative to the scale of the parameter. Larger: a larger error of the
/// derivative, which is the square of the step. Smaller: a larger error by rounding, which is divided by
/// the step.
const DIFFERENCE: f64 = 1e-5;

/// Ratio of the full width at half maximum of a Gaussian to its standard deviation, 2 sqrt(2 ln 2).
const FWHM_PER_SIGMA: f64 = 2.354_820_045_030_949_3;

/// Formula to fit.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum TifModel {
    /// An elliptical Gaussian.
    Gaussian,
    /// An elliptical super-Gaussian.
    SuperGaussian,
    /// Two round Gaussians about one centre: a core with a halo.
    Mixture,
}

/// The fitted formula, and how well it describes the samples of the TIF.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct FitReport {
    /// Kind of formula that was fitted.
    pub model: TifModel,
    /// Centre of the formula [x, y], mm.
    pub centre_mm: [f64; 2],
    /// Elliptical parts of the formula: one, or for a mixture the core and then the halo.
    pub components: Vec<Component>,
    /// Exponent p of the module; 2 unless the formula is a super-Gaussian.
    pub order: f64,
    /// RMS of samples minus formula, nm/s.
    pub residual_rms_nm_per_s: f64,
    /// Largest |sample - formula|, nm/s.
    pub residual_max_nm_per_s: f64,
    /// RMS of the residual as a fraction of the largest sample.
    pub residual_rms_to_peak: f64,
    /// Volumetric removal rate (VRR) of the formula over that of the TIF, both summed over the same samples.
    pub vrr_ratio: f64,
    /// Number of steps of the fit.
    pub steps: usize,
    /// True if the last step changed every parameter by at most 1e-10 of its scale.
    pub converged: bool,
}

impl FitReport {
    /// Returns the reason why the fit is not valid, if it did not converge; otherwise `None`.
    pub fn negative(&self) -> Option<String> {
        if self.converged {
            return None;
        }
        Some(format!("the fit did not converge in {} steps", self.steps))
    }
}

/// One elliptical part of the formula.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Component {
    /// Peak rate (A of the module), nm/s.
    pub peak_nm_per_s: f64,
    /// Standard deviation along the long and the short axis, mm.
    pub sigma_mm: [f64; 2],
    /// Direction of the long axis from +x towards +y, degrees, in (-90, 90]; 0 if it is round.
    pub angle_deg: f64,
}

/// Fits `model` to the samples of `tif`. Returns the TIF of the formula on the same samples, and the report. Refuses
/// fewer than two samples per parameter.
pub fn fit(tif: &Tif, model: TifModel) -> Result<(Tif, FitReport), Invalid> {
    let g = tif.grid();
    let mut theta = start(tif, model);
    if tif.rate_nm_per_s().len() < 2 * theta.len() {
        return Err(Invalid::whole(
            "tif fit",
            format!("{} samples for {} parameters", tif.rate_nm_per_s().len(), theta.len()),
            "give at least two samples per parameter",
        ));
    }
    let scale = theta.iter().map(|s| s.1).collect::<Vec<f64>>();
    let samples: Vec<[f64; 3]> = tif
        .rate_nm_per_s()
        .indexed_iter()
        .map(|((r, c), v)| [g.x.coordinate_mm(c), g.y.coordinate_mm(r), *v])
        .collect();
    let mut p: Vec<f64> = theta.drain(..).map(|s| s.0).collect();
    let mut now = cost(model, &p, &samples);
    let mut damping = 1e-3;
    let mut steps = 0;
    let mut converged = false;
    while steps < MAX_STEPS && !converged {
        steps += 1;
        let (normal, gradient) = linearised(model, &p, &scale, &samples);
        // (J'J + damping diag(J'J)) step = J' residual, in units of the scales.
        loop {
            let mut damped = normal.clone();
            for k in 0..p.len() {
                damped[(k, k)] += damping * normal[(k, k)] + f64::MIN_POSITIVE;
            }
            let step = damped.cholesky().map(|c| c.solve(&gradient));
            let Some(step) = step else {
                damping *= 10.0;
                if damping > 1e12 {
                    break;
                }
                continue;
            };
            let trial: Vec<f64> =
                p.iter().zip(&scale).zip(step.iter()).map(|((p, s), d)| p + s * d).collect();
            let then = cost(model, &trial, &samples);
            let small = step.amax() <= TOLERANCE;
            if then <= now {
                p = trial;
                now = then;
                converged = small;
                damping = (damping * 0.1).max(1e-12);
                break;
            }
            // A step that rounding makes worse means convergence if it is small.
            converged = small;
            damping *= 10.0;
            if converged || damping > 1e12 {
                break;
            }
        }
        if damping > 1e12 {
            break;
        }
    }
    let errors = residual(model, &p, &samples);
    let rms = (errors.iter().map(|e| e * e).sum::<f64>() / errors.len() as f64).sqrt();
    let rate = Array2::from_shape_fn(g.shape(), |(r, c)| {
        value(model, &p, g.x.coordinate_mm(c), g.y.coordinate_mm(r))
    });
    let fitted = Tif::new(*g, rate)?;
    let report = FitReport {
        model,
        centre_mm: [p[1], p[2]],
        components: components(model, &p),
        order: if model == TifModel::SuperGaussian { p[6] } else { 2.0 },
        residual_rms_nm_per_s: rms,
        residual_max_nm_per_s: errors.iter().map(|e| e.abs()).fold(0.0, f64::max),
        residual_rms_to_peak: rms / tif.peak_nm_per_s(),
        vrr_ratio: fitted.vrr_nm_mm2_per_s() / tif.vrr_nm_mm2_per_s(),
        steps,
        converged,
    };
    Ok((fitted, report))
}

/// Returns sample minus formula with the parameters `p`, nm/s, for `samples` [x, y, rate].
fn residual(model: TifModel, p: &[f64], samples: &[[f64; 3]]) -> Vec<f64> {
    samples.iter().map(|[x, y, v]| v - value(model, p, *x, *y)).collect()
}

/// Returns the sum of the squared residuals, (nm/s)^2; infinity if the parameters `p` describe no spot.
fn cost(model: TifModel, p: &[f64], samples: &[[f64; 3]]) -> f64 {
    if !is_sound(model, p) {
        return f64::INFINITY;
    }
    residual(model, p, samples).iter().map(|e| e * e).sum()
}

/// Returns the start value and the scale of every parameter: A, centre x, centre y, then a, b, c (Gaussian); a, b, c, p
/// (super-Gaussian); or s_1, A_2, s_2 (mixture).
fn start(tif: &Tif, model: TifModel) -> Vec<(f64, f64)> {
    let g = tif.grid();
    let peak = tif.peak_nm_per_s();
    let sigma = tif.half_maximum_width_mm() / FWHM_PER_SIGMA;
    // The centroid of what is above half of the peak, which a pedestal does not move.
    let mut sum = [0.0; 3];
    for ((r, c), v) in tif.rate_nm_per_s().indexed_iter().filter(|(_, v)| **v >= 0.5 * peak) {
        let add = [v * g.x.coordinate_mm(c), v * g.y.coordinate_mm(r), *v];
        sum.iter_mut().zip(add).for_each(|(s, a)| *s += a);
    }
    let centre = [sum[0] / sum[2], sum[1] / sum[2]];
    let inverse = sigma.powi(-2);
    let mut p = vec![(peak, peak), (centre[0], sigma), (centre[1], sigma)];
    match model {
        TifModel::Gaussian => p.extend([(inverse, inverse), (0.0, inverse), (inverse, inverse)]),
        TifModel::SuperGaussian => {
            p.extend([(inverse, inverse), (0.0, inverse), (inverse, inverse), (2.0, 1.0)]);
        }
        TifModel::Mixture => {
            p[0].0 = 0.7 * peak;
            p.extend([(0.8 * sigma, sigma), (0.3 * peak, peak), (1.6 * sigma, sigma)]);
        }
    }
    p
}

fn value(model: TifModel, p: &[f64], x: f64, y: f64) -> f64 {
    let (u, v) = (x - p[1], y - p[2]);
    // q = a u^2 + 2 b u v + c v^2
    let q = || p[3] * u * u + 2.0 * p[4] * u * v + p[5] * v * v;
    match model {
        TifModel::Gaussian => p[0] * (-0.5 * q()).exp(),
        TifModel::SuperGaussian => p[0] * (-0.5 * q().max(0.0).powf(0.5 * p[6])).exp(),
        TifModel::Mixture => {
            let r2 = u * u + v * v;
            p[0] * (-0.5 * r2 / (p[3] * p[3])).exp() + p[4] * (-0.5 * r2 / (p[5] * p[5])).exp()
        }
    }
}

/// Returns true if the parameters `p` describe a spot of finite size.
fn is_sound(model: TifModel, p: &[f64]) -> bool {
    match model {
        TifModel::Gaussian => p[3] > 0.0 && p[3] * p[5] > p[4] * p[4],
        TifModel::SuperGaussian => p[3] > 0.0 && p[3] * p[5] > p[4] * p[4] && p[6] > 0.0,
        TifModel::Mixture => p[3] > 0.0 && p[5] > 0.0,
    }
}

/// Returns J'J and J' times the residual, where J holds the derivatives dR / d(parameter / scale) by central
/// differences.
fn linearised(
    model: TifModel,
    p: &[f64],
    scale: &[f64],
    samples: &[[f64; 3]],
) -> (DMatrix<f64>, DVector<f64>) {
    let n = p.len();
    let shifted: Vec<[Vec<f64>; 2]> = (0..n)
        .map(|k| {
            [1.0, -1.0].map(|sign| {
                let mut q = p.to_vec();
                q[k] += sign * DIFFERENCE * scale[k];
                q
            })
        })
        .collect();
    let mut normal = DMatrix::zeros(n, n);
    let mut gradient = DVector::zeros(n);
    let mut row = vec![0.0; n];
    for [x, y, v] in samples {
        for (j, [up, down]) in row.iter_mut().zip(&shifted) {
            *j = (value(model, up, *x, *y) - value(model, down, *x, *y)) / (2.0 * DIFFERENCE);
        }
        let e = v - value(model, p, *x, *y);
        for k in 0..n {
            gradient[k] += row[k] * e;
            for l in 0..n {
                normal[(k, l)] += row[k] * row[l];
            }
        }
    }
    (normal, gradient)
}

fn components(model: TifModel, p: &[f64]) -> Vec<Component> {
    if model == TifModel::Mixture {
        let mut both = [(p[0], p[3]), (p[4], p[5])].map(|(peak_nm_per_s, s)| Component {
            peak_nm_per_s,
            sigma_mm: [s, s],
            angle_deg: 0.0,
        });
        // The core first.
        both.sort_by(|a, b| a.sigma_mm[0].total_cmp(&b.sigma_mm[0]));
        return both.to_vec();
    }
    // Eigenvalues of [a b; b c]: mean +- half the difference; the smaller one is the long axis.
    let mean = 0.5 * (p[3] + p[5]);
    let half = 0.5 * (p[3] - p[5]);
    let b = p[4];
    let radius = half.hypot(b);
    // Round to 1e-9: its direction is rounding.
    let round = radius <= 1e-9 * mean;
    let angle = if round { 0.0 } else { 0.5 * (-b).atan2(-half) };
    vec![Component {
        peak_nm_per_s: p[0],
        sigma_mm: [(mean - radius).powf(-0.5), (mean + radius).powf(-0.5)],
        angle_deg: angle.to_degrees(),
    }]
}

#[cfg(test)]
mod tests {
    use super::*;
    use planish_types::{Axis, Grid};
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, Normal};

    fn sampled(f: impl Fn(f64, f64) -> f64) -> Tif {
        // Even along x, odd along y.
        let grid =
            Grid { x: Axis::new(-5.1, 0.2, 52).unwrap(), y: Axis::new(-5.0, 0.2, 51).unwrap() };
        let rate = Array2::from_shape_fn(grid.shape(), |(r, c)| {
            f(grid.x.coordinate_mm(c), grid.y.coordinate_mm(r))
        });
        Tif::new(grid, rate).unwrap()
    }

    /// Returns the quadratic form q of an elliptical spot with its long axis at 25 degrees.
    fn q(x: f64, y: f64) -> f64 {
        let (cos, sin) = (25.0_f64.to_radians().cos(), 25.0_f64.to_radians().sin());
        let (x, y) = (x - 0.3, y + 0.2);
        ((x * cos + y * sin) / 1.4).powi(2) + ((y * cos - x * sin) / 0.9).powi(2)
    }

    #[test]
    fn planted_parameters_come_back() {
        let gaussian = sampled(|x, y| 8.0 * (-0.5 * q(x, y)).exp());
        let flat = sampled(|x, y| 8.0 * (-0.5 * q(x, y).powf(1.6)).exp());
        for (tif, model, order) in
            [(gaussian, TifModel::Gaussian, 2.0), (flat, TifModel::SuperGaussian, 3.2)]
        {
            let (_, report) = fit(&tif, model).unwrap();
            assert!(report.converged, "{report:?}");
            let c = report.components[0];
            let got = [c.peak_nm_per_s, c.sigma_mm[0], c.sigma_mm[1], c.angle_deg, report.order];
            for (got, want) in got.into_iter().zip([8.0, 1.4, 0.9, 25.0, order]) {
                assert!((got / want - 1.0).abs() < 1e-7, "{report:?}");
            }
            let [x, y] = report.centre_mm;
            assert!((x - 0.3).abs() < 1e-7 && (y + 0.2).abs() < 1e-7, "{report:?}");
            assert!(report.residual_rms_to_peak < 1e-8);
            assert!((report.vrr_ratio - 1.0).abs() < 1e-8);
        }
    }

    #[test]
    fn a_core_and_its_halo_are_told_apart() {
        let tif = sampled(|x, y| {
            let r2 = (x - 0.1).powi(2) + y * y;
            6.0 * (-0.5 * r2 / 0.49).exp() + 2.0 * (-0.5 * r2 / 1.96).exp()
        });
        let (_, report) = fit(&tif, TifModel::Mixture).unwrap();
        let [core, halo] = report.components[..] else { panic!("{report:?}") };
        let got = [core.peak_nm_per_s, core.sigma_mm[0], halo.peak_nm_per_s, halo.sigma_mm[0]];
        for (got, want) in got.into_iter().zip([6.0, 0.7, 2.0, 1.4]) {
            assert!((got / want - 1.0).abs() < 1e-6, "{report:?}");
        }
        // One Gaussian is a worse description, and says so.
        let (_, one) = fit(&tif, TifModel::Gaussian).unwrap();
        assert!(one.residual_rms_to_peak > 5e-3 && report.residual_rms_to_peak < 1e-8);
    }

    #[test]
    fn the_residual_of_a_noisy_tif_is_its_noise() {
        let normal = Normal::new(0.0, 0.02).unwrap();
        let mut tif = sampled(|x, y| 8.0 * (-0.5 * q(x, y)).exp());
        let mut rng = ChaCha8Rng::seed_from_u64(2);
        let noisy = tif.rate_nm_per_s().mapv(|v| v + normal.sample(&mut rng));
        tif = Tif::new(*tif.grid(), noisy).unwrap();
        let (fitted, report) = fit(&tif, TifModel::Gaussian).unwrap();
        // 2652 samples know their standard deviation to 1.4 %.
        assert!((report.residual_rms_nm_per_s / 0.02 - 1.0).abs() < 0.05, "{report:?}");
        assert!((report.components[0].sigma_mm[0] - 1.4).abs() < 5e-3);
        assert_eq!(fitted.grid(), tif.grid());
    }

    #[test]
    fn a_round_spot_has_no_direction() {
        let tif = sampled(|x, y| 3.0 * (-0.5 * (x * x + y * y)).exp());
        let (_, report) = fit(&tif, TifModel::Gaussian).unwrap();
        let [long, short] = report.components[0].sigma_mm;
        assert!((long - 1.0).abs() < 1e-8 && (short - 1.0).abs() < 1e-8, "{report:?}");
    }

    #[test]
    fn too_few_samples_are_refused() {
        let axis = Axis::new(0.0, 1.0, 3).unwrap();
        let tif = Tif::new(Grid { x: axis, y: axis }, Array2::ones((3, 3))).unwrap();
        let error = fit(&tif, TifModel::Gaussian).unwrap_err().to_string();
        assert!(error.contains("9 samples for 6 parameters"), "{error}");
    }
}
