//! The transform that takes fiducials of a map to those of a machine, by weighted least squares.
//!
//! A fiducial lies at p in the map and at q on the machine, with the standard deviation sigma per coordinate. With the
//! weights w = 1/sigma^2 and the points about their weighted means, d = p - mean p and e = q - mean q, the transform
//! takes the mean of p to the mean of q (the image), and its matrix M is
//!
//! ```text
//! rigid        theta = atan2(B, A),   A = sum w (d_x e_x + d_y e_y),   B = sum w (d_x e_y - d_y e_x)
//! similarity   M = (a, -b; b, a),     a + i b = (A + i B) / sum w |d|^2
//! affine       M = (sum w e d') N^-1, N = sum w d d'
//! ```
//!
//! in closed form, with theta the angle of a rigid transform. About the means the errors of image and matrix are
//! uncorrelated:
//!
//! ```text
//! var image = 1 / sum w per axis,   var theta = var a = var b = 1 / sum w |d|^2,   cov (M_x.) = N^-1
//! ```
//!
//! M_x. is the first row of M; the second has the same covariance. If no uncertainties were given, sigma is 1, and
//! these variances are multiplied by the mean square of the residuals per degree of freedom.

use planish_types::{Invalid, Transform, text::significant};
use serde::Serialize;

use crate::{chi_square::exceeded, fiducials::Fiducial};

/// Parameters of the transform from map to machine that are fitted.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum TransformModel {
    /// Shift and rotation.
    #[default]
    Rigid,
    /// Shift, rotation and one scale.
    Similarity,
    /// Shift and any matrix that does not mirror: also axes that are not square.
    Affine,
}

impl TransformModel {
    /// Returns the number of free parameters: 3 (rigid), 4 (similarity) or 6 (affine).
    pub fn parameters(self) -> usize {
        match self {
            Self::Rigid => 3,
            Self::Similarity => 4,
            Self::Affine => 6,
        }
    }

    /// Returns the smallest number of fiducials that determine the parameters.
    fn least_fiducials(self) -> usize {
        self.parameters().div_ceil(2)
    }
}

/// Largest standard error of an element of the matrix that a fit may have, dimensionless (for a rigid model
/// about that of the angle in rad); a fit with more is refused. Larger: accepts fiducials so close together
/// that the part may be turned by more. Smaller: asks for fiducials that are farther apart or measured
/// better. Chosen: 0.1 rad is 6 degrees, and such a part is not registered.
const MOST_MATRIX_ERROR: f64 = 0.1;

/// Smallest RMS extent of the fiducials across the line through them, relative to that along it. Below it
/// an affine fit is refused, and a mirrored part gives a warning only. Smaller: errors across the line are
/// amplified more, by the inverse of this number. Larger: more layouts count as a line.
const LEAST_ACROSS: f64 = 1e-3;

/// Probability of the residuals, given the uncertainties, below which the fit is reported as unusable.
/// Larger: more false alarms, because correct fiducials fall below it with just this probability. Smaller:
/// larger blunders go unnoticed.
const LEAST_PROBABILITY: f64 = 1e-3;

/// Factor between the RMS residuals of a fit and of its mirror image, dimensionless. If the mirror image
/// fits better by more than this factor, the fit is refused as mirrored. If the fit is not better than its
/// mirror image by this factor, a warning says that the fiducials cannot tell. Larger: fewer refusals and
/// more warnings. Smaller: noise decides.
const MIRRORED: f64 = 2.0;

/// Residual of one fiducial after the fit.
#[derive(Clone, Debug, Serialize)]
pub struct Residual {
    /// Name of the fiducial, or its number, counted from 1.
    pub name: String,
    /// Measured position on the machine minus the position that the transform gives [x, y], mm.
    pub residual_mm: [f64; 2],
    /// Standard deviation of each coordinate of the residual, mm, as given or as estimated from all
    /// residuals.
    pub uncertainty_mm: f64,
}

/// A fitted quantity with its standard error, both in the unit of the field that holds them.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Estimate {
    /// Best estimate of the quantity.
    pub value: f64,
    /// Standard error of the quantity, one sigma.
    pub standard_error: f64,
}

/// Fitted transform from map to machine, and the quality of the fit.
#[derive(Clone, Debug)]
pub struct Registration {
    /// Transform from the coordinates of the map to those of the machine.
    pub transform: Transform,
    /// Residuals, standard errors and warnings of the fit.
    pub report: FitReport,
}

/// Quality of a fitted transform: residuals, standard errors and warnings.
#[derive(Clone, Debug, Serialize)]
pub struct FitReport {
    /// Kind of transform that was fitted.
    pub model: TransformModel,
    /// Number of fiducials that were fitted.
    pub fiducials: usize,
    /// Degrees of freedom: measured coordinates (two per fiducial) minus the parameters of the transform.
    pub degrees_of_freedom: usize,
    /// True if the uncertainties were given; otherwise they are estimated from the residuals.
    pub uncertainties_given: bool,
    /// Angle by which the part is turned on the machine, degree; positive from x towards y.
    pub angle_deg: Estimate,
    /// Scale from map to machine, dimensionless, as a similarity transform would fit it, even if the model is rigid.
    pub scale: Estimate,
    /// Standard error of a transformed point at the weighted mean of the fiducials [x, y], mm.
    pub standard_error_mm: [f64; 2],
    /// Largest standard error of the transformed position of a fiducial, over all fiducials and both coordinates, mm.
    pub largest_standard_error_mm: f64,
    /// RMS of the residuals over all fiducials and both coordinates, mm.
    pub rms_mm: f64,
    /// Sum of the squares of the residuals, each divided by its uncertainty; dimensionless.
    pub chi_square: f64,
    /// Probability that the given uncertainties lead to residuals at least as large as these. It is 1 if they were not
    /// given, or without degrees of freedom.
    pub probability: f64,
    /// Residual of every fiducial, in the order of the file.
    pub residuals: Vec<Residual>,
    /// Warnings for the user.
    pub warnings: Vec<String>,
}

impl FitReport {
    /// Returns the reason not to use the transform, or `None`. A reason exists if the given uncertainties explain the
    /// residuals with a probability below 0.001.
    pub fn drawback(&self) -> Option<String> {
        if self.probability >= LEAST_PROBABILITY || self.probability.is_nan() {
            return None;
        }
        let ratios = (self.residuals.iter())
            .map(|r| (r.residual_mm[0].hypot(r.residual_mm[1]) / r.uncertainty_mm, r));
        let (_, worst) = ratios.max_by(|a, b| a.0.total_cmp(&b.0))?;
        Some(format!(
            "the fiducials miss by {} mm RMS, far more than their uncertainties (probability {}); the \
             worst is {}, by {:?} mm",
            significant(self.rms_mm, 3),
            significant(self.probability, 2),
            worst.name,
            worst.residual_mm
        ))
    }
}

/// Fiducials relative to their weighted means, with their weights.
struct Centred {
    mean: [[f64; 2]; 2],
    /// Each fiducial relative to the means: in the map (d), mm; on the machine (e), mm; and its weight (w), 1/mm^2.
    each: Vec<([f64; 2], [f64; 2], f64)>,
    sum_w: f64,
    /// Weighted sum of the squared distances from the mean in the map, sum w |d|^2; dimensionless.
    spread: f64,
}

impl Centred {
    /// Subtracts the weighted means from the fiducials. Each has the weight 1/sigma^2, from its standard deviation in
    /// `sigma_mm`.
    fn new(fiducials: &[Fiducial], sigma_mm: &[f64]) -> Self {
        let weights: Vec<f64> = sigma_mm.iter().map(|s| 1.0 / (s * s)).collect();
        let sum_w: f64 = weights.iter().sum();
        // Points [of the map, of the machine] and their weight.
        let points = fiducials.iter().zip(weights).map(|(f, w)| ([f.map_mm, f.machine_mm], w));
        let mean = [0, 1]
            .map(|k| [0, 1].map(|a| points.clone().map(|(p, w)| w * p[k][a]).sum::<f64>() / sum_w));
        let centred = points.map(|(p, w)| {
            let [d, e] = [0, 1].map(|k| [0, 1].map(|a| p[k][a] - mean[k][a]));
            (d, e, w)
        });
        let each: Vec<_> = centred.collect();
        let spread = each.iter().map(|(d, _, w)| w * (d[0] * d[0] + d[1] * d[1])).sum();
        Self { mean, each, sum_w, spread }
    }

    /// Returns the sums A and B of the formulas at the head of the module. With `mirrored`, the y coordinates of the
    /// map change their signs.
    fn complex_sums(&self, mirrored: bool) -> [f64; 2] {
        let sign = if mirrored { -1.0 } else { 1.0 };
        self.each.iter().fold([0.0; 2], |s, (d, e, w)| {
            let d = [d[0], sign * d[1]];
            [s[0] + w * (d[0] * e[0] + d[1] * e[1]), s[1] + w * (d[0] * e[1] - d[1] * e[0])]
        })
    }

    /// Returns the normal matrix N = sum w d d' of the formulas at the head of the module.
    fn normal(&self) -> [[f64; 2]; 2] {
        let mut n = [[0.0; 2]; 2];
        for (d, _, w) in &self.each {
            for (r, s) in [(0, 0), (0, 1), (1, 0), (1, 1)] {
                n[r][s] += w * d[r] * d[s];
            }
        }
        n
    }

    /// Returns the weighted sum of squared residuals that the matrix `m` leaves. With `mirrored`, the y coordinates of
    /// the map change their signs.
    fn left(&self, m: &[[f64; 2]; 2], mirrored: bool) -> f64 {
        let sign = if mirrored { -1.0 } else { 1.0 };
        let squares = self.each.iter().map(|(d, e, w)| {
            let r = [0, 1].map(|i| e[i] - m[i][0] * d[0] - m[i][1] * sign * d[1]);
            w * (r[0] * r[0] + r[1] * r[1])
        });
        squares.sum()
    }
}

/// Returns the matrix M of a rigid transform, or of a similarity if `scaled`. With `mirrored`, it fits the map with the
/// sign of y changed.
fn rotation(centred: &Centred, scaled: bool, mirrored: bool) -> [[f64; 2]; 2] {
    let [a, b] = centred.complex_sums(mirrored);
    let size = if scaled { centred.spread } else { a.hypot(b) };
    [[a / size, -b / size], [b / size, a / size]]
}

/// Returns the two eigenvalues of a symmetric 2 x 2 matrix, the larger first.
fn eigenvalues(n: &[[f64; 2]; 2]) -> [f64; 2] {
    let mean = 0.5 * (n[0][0] + n[1][1]);
    let half = 0.5 * (n[0][0] - n[1][1]);
    let root = half.hypot(n[0][1]);
    [mean + root, (mean - root).max(0.0)]
}

/// Fits a transform of the kind `model` from map to machine to fiducials, by weighted least squares.
///
/// # Errors
/// Refuses too few fiducials, and fiducials in the same place. Refuses fiducials on a line if the model is
/// affine, fiducials too close together for their uncertainty, and correspondences that mirror the part.
pub fn fit(fiducials: &[Fiducial], model: TransformModel) -> Result<Registration, Invalid> {
    let n = fiducials.len();
    let least = model.least_fiducials();
    if n < least {
        let problem = format!("is one of {n}, and {model:?} needs {least}");
        return Err(Invalid::whole("fiducial", problem, "measure more of them"));
    }
    let (sigma_mm, is_stated) = uncertainties(fiducials)?;
    refuse_coincident(fiducials, &sigma_mm, is_stated)?;
    let degrees_of_freedom = 2 * n - model.parameters();
    if !is_stated && degrees_of_freedom == 0 {
        let problem =
            format!("is one of {n}, without uncertainties: nothing is left to estimate them from");
        return Err(Invalid::whole("fiducial", problem, "give uncertainty_mm, or measure more"));
    }
    let centred = Centred::new(fiducials, &sigma_mm);
    let normal = centred.normal();
    let eigen = eigenvalues(&normal);
    let across = (eigen[1] / eigen[0]).sqrt();
    if model == TransformModel::Affine && across < LEAST_ACROSS {
        let [along_mm, across_mm] = eigen.map(|e| (e / centred.sum_w).sqrt());
        let problem = format!(
            "is one of {n} on a line: {} mm RMS along it, {} mm across",
            significant(along_mm, 3),
            significant(across_mm, 3)
        );
        return Err(Invalid::whole(
            "fiducial",
            problem,
            "give one beside the line, or a rigid model",
        ));
    }
    let matrix = match model {
        TransformModel::Rigid => rotation(&centred, false, false),
        TransformModel::Similarity => rotation(&centred, true, false),
        TransformModel::Affine => affine(&centred, &normal),
    };
    let mut warnings = refuse_mirrored(&centred, model, &matrix, across)?;
    let chi_square = centred.left(&matrix, false);
    let variance = if is_stated { 1.0 } else { chi_square / degrees_of_freedom as f64 };
    let covariance = covariance(&centred, model, &matrix, &normal, variance);
    let transform = Transform::new(matrix, centred.mean[0], centred.mean[1], covariance)?;

    let largest = (2..6).map(|i| covariance[i][i].sqrt()).fold(0.0, f64::max);
    if largest > MOST_MATRIX_ERROR {
        let problem = format!(
            "is one of {n} within {} mm RMS of each other: the matrix would have an error of {}",
            significant((centred.spread / centred.sum_w).sqrt(), 3),
            significant(largest, 2)
        );
        let remedy = "measure fiducials that are farther apart, or more exactly";
        return Err(Invalid::whole("fiducial", problem, remedy));
    }
    let [a, b] = centred.complex_sums(false);
    let scale = Estimate {
        value: a.hypot(b) / centred.spread,
        standard_error: (variance / centred.spread).sqrt(),
    };
    if model == TransformModel::Rigid && (scale.value - 1.0).abs() > 3.0 * scale.standard_error {
        warnings.push(format!(
            "the fiducials are {} times as far apart on the machine as in the map (standard error {}): is the \
             pitch of the map right? a similarity takes the scale into account",
            significant(scale.value, 7),
            significant(scale.standard_error, 2)
        ));
    }
    let report = report(
        fiducials,
        &sigma_mm,
        &transform,
        Numbers { model, degrees_of_freedom, is_stated, chi_square, variance, scale, warnings },
    );
    Ok(Registration { transform, report })
}

/// Returns the standard deviation of the coordinates of each fiducial, mm, and true if the file states them. Without
/// any statement all are 1 mm. Refuses a file that states only some of them.
fn uncertainties(fiducials: &[Fiducial]) -> Result<(Vec<f64>, bool), Invalid> {
    let with = fiducials.iter().filter(|f| f.uncertainty_mm.is_some()).count();
    if with == 0 {
        return Ok((vec![1.0; fiducials.len()], false));
    }
    let each = fiducials.iter().enumerate().map(|(i, f)| match f.uncertainty_mm {
        // The scale between map and machine is near one.
        Some(s) => Ok(s.hypot(f.map_uncertainty_mm.unwrap_or(0.0))),
        None => {
            let problem = format!("is absent, {with} of {} have one", fiducials.len());
            Err(Invalid::at_index("uncertainty_mm", i, problem, "give all of them one, or none"))
        }
    });
    Ok((each.collect::<Result<_, _>>()?, true))
}

/// Refuses two fiducials that are closer, in the map or on the machine, than their joint standard deviation. Without
/// stated uncertainties, only equal positions are refused.
fn refuse_coincident(
    fiducials: &[Fiducial],
    sigma_mm: &[f64],
    is_stated: bool,
) -> Result<(), Invalid> {
    // Fiducials are sorted along x, and only neighbours are compared: that is enough to find a point that
    // was given twice.
    let mut order: Vec<usize> = (0..fiducials.len()).collect();
    let map_mm: Vec<[f64; 2]> = fiducials.iter().map(|f| f.map_mm).collect();
    let machine_mm: Vec<[f64; 2]> = fiducials.iter().map(|f| f.machine_mm).collect();
    for (name, points) in [("map_mm", map_mm), ("machine_mm", machine_mm)] {
        order.sort_by(|i, j| points[*i][0].total_cmp(&points[*j][0]));
        for (k, i) in order.iter().enumerate() {
            for j in &order[k + 1..] {
                let [p, q] = [points[*i], points[*j]];
                let close = if is_stated { sigma_mm[*i].hypot(sigma_mm[*j]) } else { 0.0 };
                if q[0] - p[0] > close {
                    break;
                }
                if (q[0] - p[0]).hypot(q[1] - p[1]) <= close {
                    let problem =
                        format!("is {q:?}, where fiducial {} is already", fiducials[*i].name);
                    let remedy = "measure two different points, or leave one out";
                    return Err(Invalid::at_index(name, *j, problem, remedy));
                }
            }
        }
    }
    Ok(())
}

/// Returns the matrix M of an affine transform, from the centred fiducials and their normal matrix N.
fn affine(centred: &Centred, normal: &[[f64; 2]; 2]) -> [[f64; 2]; 2] {
    let inverse = inverse(normal);
    let mut moment = [[0.0; 2]; 2];
    for (d, e, w) in &centred.each {
        for (r, s) in [(0, 0), (0, 1), (1, 0), (1, 1)] {
            moment[r][s] += w * e[r] * d[s];
        }
    }
    [0, 1].map(|r| [0, 1].map(|s| moment[r][0] * inverse[0][s] + moment[r][1] * inverse[1][s]))
}

/// Returns the inverse of a 2 x 2 matrix.
fn inverse(n: &[[f64; 2]; 2]) -> [[f64; 2]; 2] {
    let determinant = n[0][0] * n[1][1] - n[0][1] * n[1][0];
    [
        [n[1][1] / determinant, -n[0][1] / determinant],
        [-n[1][0] / determinant, n[0][0] / determinant],
    ]
}

/// Fits `model` to fiducials on axes that mirror the part. The sign of x of the machine is changed before
/// the fit and changed back after it.
///
/// # Errors
/// Refuses what [`fit`] refuses, and correspondences that do not mirror.
pub fn fit_mirrored(
    fiducials: &[Fiducial],
    model: TransformModel,
) -> Result<Registration, Invalid> {
    let mut turned_over = fiducials.to_vec();
    for fiducial in &mut turned_over {
        fiducial.machine_mm[0] = -fiducial.machine_mm[0];
    }
    let Registration { transform: t, mut report } = fit(&turned_over, model)?;
    // q_x = -(image_x + M_xx d_x + M_xy d_y): the parameters 0, 2 and 3 change their signs.
    const SIGN: [f64; 6] = [-1.0, 1.0, -1.0, -1.0, 1.0, 1.0];
    let [[a, b], row] = *t.matrix();
    let [x, y] = t.image_mm();
    let six =
        std::array::from_fn(|i| std::array::from_fn(|j| SIGN[i] * SIGN[j] * t.covariance()[i][j]));
    let transform = Transform::new([[-a, -b], row], t.centre_mm(), [-x, y], six)?;
    for each in &mut report.residuals {
        each.residual_mm[0] = -each.residual_mm[0];
    }
    report.angle_deg = angle(&transform);
    Ok(Registration { transform, report })
}

/// Refuses fiducials whose positions on the machine mirror those in the map. `across` is their RMS extent across the
/// line through them over that along it. Returns a warning if the fiducials cannot tell.
fn refuse_mirrored(
    centred: &Centred,
    model: TransformModel,
    matrix: &[[f64; 2]; 2],
    across: f64,
) -> Result<Vec<String>, Invalid> {
    let remedy = "give the `machine` whose axes mirror, or else those that do not; turn the map over, or check which \
                  fiducial is which";
    let [[a, b], [c, d]] = *matrix;
    if model == TransformModel::Affine {
        let determinant = a * d - b * c;
        if determinant > 0.0 {
            return Ok(Vec::new());
        }
        let problem = format!("mirrors: its determinant is {}", significant(determinant, 4));
        return Err(Invalid::whole("matrix", problem, remedy));
    }
    let mirrored = rotation(centred, model == TransformModel::Similarity, true);
    let [as_is_mm, mirrored_mm] = [centred.left(matrix, false), centred.left(&mirrored, true)]
        .map(|left| (left / centred.sum_w).sqrt());
    if MIRRORED * mirrored_mm < as_is_mm && across > LEAST_ACROSS {
        let problem = format!(
            "mirrors: the fiducials miss by {} mm RMS, and by {} mm where the map is turned over",
            significant(as_is_mm, 4),
            significant(mirrored_mm, 4)
        );
        return Err(Invalid::whole("matrix", problem, remedy));
    }
    if as_is_mm * MIRRORED > mirrored_mm || across <= LEAST_ACROSS {
        return Ok(vec![
            "the fiducials are on a line, or nearly: they do not tell whether the part is turned over".into(),
        ]);
    }
    Ok(Vec::new())
}

/// Returns the covariance of the six parameters of the transform: image x, image y (mm), then the matrix row by row.
/// `variance` multiplies it: 1, or the mean square residual if no uncertainties are given.
fn covariance(
    centred: &Centred,
    model: TransformModel,
    matrix: &[[f64; 2]; 2],
    normal: &[[f64; 2]; 2],
    variance: f64,
) -> [[f64; 6]; 6] {
    let mut c = [[0.0; 6]; 6];
    for i in 0..2 {
        c[i][i] = variance / centred.sum_w;
    }
    let of_matrix = variance / centred.spread;
    let mut add = |gradient: [f64; 4]| {
        for i in 0..4 {
            for j in 0..4 {
                c[2 + i][2 + j] += of_matrix * gradient[i] * gradient[j];
            }
        }
    };
    match model {
        // dM / d theta = (-sin, -cos; cos, -sin)
        TransformModel::Rigid => add([-matrix[1][0], -matrix[0][0], matrix[0][0], -matrix[1][0]]),
        TransformModel::Similarity => {
            add([1.0, 0.0, 0.0, 1.0]);
            add([0.0, -1.0, 1.0, 0.0]);
        }
        TransformModel::Affine => {
            let inverse = inverse(normal);
            for axis in 0..2 {
                for (r, s) in [(0, 0), (0, 1), (1, 0), (1, 1)] {
                    c[2 + 2 * axis + r][2 + 2 * axis + s] = variance * inverse[r][s];
                }
            }
        }
    }
    c
}

/// Numbers that `report` needs beside the transform.
struct Numbers {
    model: TransformModel,
    degrees_of_freedom: usize,
    /// True if the file states uncertainties of the fiducials.
    is_stated: bool,
    chi_square: f64,
    variance: f64,
    scale: Estimate,
    warnings: Vec<String>,
}

/// Compiles the report of a fit: residuals, RMS, chi-square and its probability.
fn report(
    fiducials: &[Fiducial],
    sigma_mm: &[f64],
    transform: &Transform,
    numbers: Numbers,
) -> FitReport {
    let factor = numbers.variance.sqrt();
    let residuals: Vec<Residual> = fiducials
        .iter()
        .zip(sigma_mm)
        .map(|(f, sigma)| {
            let q = transform.point(f.map_mm);
            Residual {
                name: f.name.clone(),
                residual_mm: [f.machine_mm[0] - q[0], f.machine_mm[1] - q[1]],
                uncertainty_mm: sigma * factor,
            }
        })
        .collect();
    let squares: f64 = residuals.iter().flat_map(|r| r.residual_mm).map(|v| v * v).sum();
    let errors = fiducials.iter().flat_map(|f| transform.standard_error_mm(f.map_mm));
    let freedom = numbers.degrees_of_freedom as f64;
    let probability = if numbers.is_stated && numbers.degrees_of_freedom > 0 {
        exceeded(numbers.chi_square, freedom)
    } else {
        1.0
    };
    FitReport {
        model: numbers.model,
        fiducials: fiducials.len(),
        degrees_of_freedom: numbers.degrees_of_freedom,
        uncertainties_given: numbers.is_stated,
        angle_deg: angle(transform),
        scale: numbers.scale,
        standard_error_mm: transform.standard_error_mm(transform.centre_mm()),
        largest_standard_error_mm: errors.fold(0.0, f64::max),
        rms_mm: (squares / (2 * fiducials.len()) as f64).sqrt(),
        chi_square: numbers.chi_square
            / if numbers.is_stated { 1.0 } else { numbers.variance.max(f64::MIN_POSITIVE) },
        probability,
        residuals,
        warnings: numbers.warnings,
    }
}

/// Returns the rotation angle of a transform with its standard error, degree; positive from x towards y.
pub fn angle(transform: &Transform) -> Estimate {
    // theta = atan2(c - m b, a + m d), with M = (a, b; c, d) and m = -1 where M mirrors
    let m = if transform.mirrors() { -1.0 } else { 1.0 };
    let [[a, b], [c, d]] = *transform.matrix();
    let [s, t] = [c - m * b, a + m * d];
    let r = s * s + t * t;
    let gradient = [0.0, 0.0, -s / r, -m * t / r, t / r, -m * s / r];
    Estimate {
        value: transform.angle_rad().to_degrees(),
        standard_error: transform.variance(&gradient).sqrt().to_degrees(),
    }
}
