//! Nonlinear least squares of (1) of the crate's documentation by Gauss and Newton's steps, and the covariance of the
//! unknowns.
//!
//! ```text
//! minimise |d - F(p) - Q c|^2 + sum_i k_i p_i^2 over the pixels that are valid in both maps
//! step:        (J' J + K + lambda D) delta = J' r - K p,   J = [dF/dp, Q],  D = diag(J' J)
//! covariance:  H^-1 (J' C J + v K) H^-1,  H = J' J + K     C of the noise, from the rest (the `correlation` module)
//! ```
//!
//! k_i = v / s_i^2 is what is known beforehand as one more observation: p_i is 0, the plan, within s_i; v is the
//! variance of the noise times the pixels over the effective ones, so that both count as they should. Where the data
//! determine a parameter it changes nothing that is seen (1 % of the distance to the plan where the standard error is a
//! tenth of s_i); where they do not it keeps the parameter near the plan, so that those that are determined are not
//! fitted beside something absurd, and still carries its uncertainty into their standard errors.
//!
//! The problem is nearly linear: errors of a process change the derivatives by as little as they are. So the
//! derivatives of one point serve several steps, and are computed anew once where these have ended; when the first
//! step with them is small, this is the minimum. lambda is 0 unless a step makes the square larger (Levenberg and
//! Marquardt). Where the rest has a part along the second derivatives, which the steps leave out, they go too far and
//! back again by a ratio q < 0 of the way before; the first step from a new point is divided by 1 - q (Aitken).

use nalgebra::{DMatrix, DVector, SymmetricEigen};
use ndarray::Array2;
use planish_types::{End, Grid, Invalid, progress};

use crate::{correlation::Covariance, metrology::Term, model::RemovalModel, parameter::Parameter};

/// Largest step, in standard errors, with which the fit has converged. Larger: estimates farther from the minimum.
/// Smaller: steps from kink to kink, because the removal has kinks where samples of Keys' convolution cross the centres
/// of pixels. Chosen: an interval of two standard errors that is off by it covers 3e-4 less.
const SMALL_STEP: f64 = 0.05;

/// Largest step, in units of the scale of the parameter, with which the fit has converged however small the noise is.
/// Larger: estimates farther from the minimum. Smaller: more steps with data of low noise. Chosen: of 0.5 mm it is 0.05
/// um.
const NOTHING: f64 = 1e-4;

/// Largest number of steps with the derivatives of one point; the constant below is the largest number of points at
/// which derivatives are computed. Larger: more time before a fit ends without a minimum. Smaller: fits end before
/// their minimum. Chosen.
const MOST_STEPS: usize = 12;
const MOST_POINTS: usize = 25;

/// Number of points that a fit usually needs; the constant below is the largest fraction that the progress bar shows
/// before the end. They change only the progress that is shown. Chosen.
const USUAL_POINTS: f64 = 4.0;
const BEFORE_LAST: f64 = 0.9;

/// First and largest damping lambda, relative to the diagonal of the normal matrix. Larger: shorter first steps, and
/// more trials before the end. Smaller: more trials until a step is short enough. Chosen.
const LAMBDA: [f64; 2] = [1e-3, 1e6];

/// Largest ratio of a step back to the step before it that is taken for an oscillation. Larger: steps are divided by up
/// to 2. Smaller: oscillations die out more slowly. Chosen below 1.
const LARGEST_RETURN: f64 = 0.9;

/// Smallest eigenvalue of an independent direction of the scaled normal matrix, as a fraction of the largest one.
/// Larger: directions that the data determine are left out. Smaller: rounding, and the error of 2e-5 of the
/// derivatives, decide the step. Chosen.
const INDEPENDENT: f64 = 1e-9;

/// The data of a fit.
pub struct Data<'a> {
    /// Pixels of the maps.
    pub grid: &'a Grid,
    /// Difference of the maps before - after, shape (ny, nx), nm; 0 where invalid.
    pub data: Array2<f64>,
    /// 1 where both maps are valid, else 0 (ny, nx).
    pub valid: Array2<f64>,
}

/// Result of a least-squares fit. Its unknowns are the parameters p, followed by the coefficients c of the terms of the
/// metrology.
pub struct LeastSquaresFit {
    /// Free parameters, in the order of the unknowns.
    pub parameters: Vec<Parameter>,
    /// Terms of the metrology; their coefficients are the unknowns after the parameters.
    pub terms: Vec<Term>,
    /// Values of all unknowns, p and c.
    pub values: Vec<f64>,
    /// Covariance of the values of all unknowns.
    pub covariance: DMatrix<f64>,
    /// Variance inflation of every unknown: factor by which the other unknowns raise its variance under white noise,
    /// compared with a free piston alone. Infinite if it lies in a direction that does not change the removal.
    pub inflation: Vec<f64>,
    /// Normal matrix of the scaled columns: cosines of the angles between the columns of J.
    pub cosines: DMatrix<f64>,
    /// Singular values of the matrix J of derivatives, its columns scaled to length one, descending.
    pub singular_values: Vec<f64>,
    /// Columns of the matrix J of derivatives, one map per unknown, nm per unit; 0 where invalid.
    pub columns: Vec<Array2<f64>>,
    /// Lengths of the columns (root of the sum of squares); 1 for a column of zeros.
    pub lengths: Vec<f64>,
    /// Inverse of the matrix H of the module for scaled columns, along the independent directions.
    pub inverse: DMatrix<f64>,
    /// Weights k_i of the prior scales of the parameters (see the module); the terms of the metrology have none.
    pub known: Vec<f64>,
    /// Removal F(p) with the fitted parameters, shape (ny, nx), nm, at every pixel.
    pub removal: Array2<f64>,
    /// Sum Q c of the fitted terms of the metrology, shape (ny, nx), nm, at every pixel.
    pub metrology: Array2<f64>,
    /// Rest of the data, d - F - Q c, nm; 0 where invalid.
    pub rest: Array2<f64>,
    /// Covariance of the noise, estimated from the rest.
    pub noise: Covariance,
    /// Way in which the fit ended: at a minimum or before it.
    pub end: End,
    /// Magnitude of the first step of every parameter with the last derivatives, in standard errors; 0 if the fit
    /// converged.
    pub unfinished: Vec<f64>,
    /// Number of points at which derivatives were computed.
    pub points: usize,
}

/// Removal, nm, and its derivatives at the parameters `values` where a fit starts. Those at the plan serve many fits of
/// one plan.
pub struct Start {
    values: Vec<f64>,
    removal: Array2<f64>,
    derivatives: Vec<Array2<f64>>,
}

impl Start {
    /// Creates the start of a fit at the plan, where all parameters are 0.
    ///
    /// # Errors
    /// Fails if the removal cannot be simulated.
    pub fn new(model: &RemovalModel<'_>) -> Result<Self, Invalid> {
        Self::from_values(model, vec![0.0; model.parameters.len()])
    }

    /// Creates the start of a fit at the parameters `values`.
    ///
    /// # Errors
    /// Fails if the removal with them cannot be simulated.
    pub fn from_values(model: &RemovalModel<'_>, values: Vec<f64>) -> Result<Self, Invalid> {
        let (removal, derivatives) = model.linear(&values)?;
        Ok(Self { values, removal, derivatives })
    }
}

impl LeastSquaresFit {
    /// Returns the standard error of unknown `i`.
    pub fn standard_error(&self, i: usize) -> f64 {
        self.covariance[(i, i)].max(0.0).sqrt()
    }

    /// Returns the correlation of two unknowns, from -1 to 1; 0 if one has no variance.
    pub fn correlation(&self, i: usize, j: usize) -> f64 {
        let scale = self.standard_error(i) * self.standard_error(j);
        if scale > 0.0 { self.covariance[(i, j)] / scale } else { 0.0 }
    }

    /// Returns the names of all unknowns: the parameters, then the terms of the metrology.
    pub fn names(&self) -> Vec<String> {
        let parameters = self.parameters.iter().map(|p| p.name().to_string());
        parameters.chain(self.terms.iter().map(|t| t.name())).collect()
    }

    /// Replaces the values of all unknowns and their covariance, and computes the removal, the metrology and the rest
    /// of the data anew.
    pub(crate) fn take(
        &mut self,
        model: &RemovalModel<'_>,
        data: &Data<'_>,
        values: Vec<f64>,
        covariance: DMatrix<f64>,
    ) -> Result<(), Invalid> {
        let p = self.parameters.len();
        let maps: Vec<Array2<f64>> = self.terms.iter().map(|t| t.map(data.grid)).collect();
        self.removal = model.removal_nm(&values[..p])?;
        self.metrology = sum_of(&maps, &values[p..], self.removal.dim());
        self.rest = (&data.data - &self.removal - &self.metrology) * &data.valid;
        (self.values, self.covariance) = (values, covariance);
        Ok(())
    }

    /// Returns the influence field of unknown `i`, shape (ny, nx): to first order its estimate is the sum of the data
    /// times the field.
    pub fn influence(&self, i: usize) -> Array2<f64> {
        influence(&self.columns, &self.lengths, &self.inverse, i)
    }
}

/// Returns the influence field of unknown `i` (see [`LeastSquaresFit::influence`]).
fn influence(
    columns: &[Array2<f64>],
    lengths: &[f64],
    inverse: &DMatrix<f64>,
    i: usize,
) -> Array2<f64> {
    let mut field = Array2::zeros(columns[0].dim());
    for (j, column) in columns.iter().enumerate() {
        field.scaled_add(inverse[(i, j)] / (lengths[i] * lengths[j]), column);
    }
    field
}

/// Returns the sum over all pixels of the products of two maps of one shape.
pub fn dot(a: &Array2<f64>, b: &Array2<f64>) -> f64 {
    let rows = a.outer_iter().zip(b.outer_iter());
    rows.map(|(a, b)| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>()).sum()
}

/// The matrix of derivatives J and its normal matrix at one point of the fit.
pub(crate) struct Normal {
    /// Columns of J, one map per unknown; 0 where invalid.
    pub columns: Vec<Array2<f64>>,
    /// Lengths of the columns: roots of their sums of squares. The normal matrix is scaled by them.
    pub lengths: Vec<f64>,
    cosines: DMatrix<f64>,
    /// Weights k_i of the prior scales; unknowns beyond its length have none.
    known: Vec<f64>,
}

impl Normal {
    /// Creates the matrix from the maps of derivatives by the parameters and of the terms of the metrology; `valid` is
    /// 1 at valid pixels, else 0. `known` are the weights k_i of the prior scales.
    pub fn new(
        derivatives: &[Array2<f64>],
        terms: &[Array2<f64>],
        valid: &Array2<f64>,
        known: Vec<f64>,
    ) -> Self {
        let columns: Vec<Array2<f64>> =
            derivatives.iter().chain(terms).map(|column| column * valid).collect();
        let n = columns.len();
        // A column of nothing has the length one, and no direction.
        let lengths: Vec<f64> = columns
            .iter()
            .map(|c| Some(dot(c, c).sqrt()).filter(|l| *l > 0.0).unwrap_or(1.0))
            .collect();
        let mut cosines = DMatrix::zeros(n, n);
        for i in 0..n {
            for j in 0..=i {
                let v = dot(&columns[i], &columns[j]) / (lengths[i] * lengths[j]);
                cosines[(i, j)] = v;
                cosines[(j, i)] = v;
            }
        }
        Self { columns, lengths, cosines, known }
    }

    /// Returns the matrix H of the module for scaled columns.
    fn matrix(&self) -> DMatrix<f64> {
        let mut matrix = self.cosines.clone();
        for (i, k) in self.known.iter().enumerate() {
            matrix[(i, i)] += k / (self.lengths[i] * self.lengths[i]);
        }
        matrix
    }

    /// Returns orthonormal fields that span the same space as the columns of J.
    pub fn orthonormal(&self) -> Vec<Array2<f64>> {
        let Some(first) = self.columns.first() else { return Vec::new() };
        let eigen = SymmetricEigen::new(self.cosines.clone());
        let least = INDEPENDENT * eigen.eigenvalues.max();
        let mut fields = Vec::new();
        for k in (0..self.columns.len()).filter(|k| eigen.eigenvalues[*k] > least) {
            let mut field = Array2::zeros(first.dim());
            for (j, column) in self.columns.iter().enumerate() {
                let weight = eigen.eigenvectors[(j, k)] / eigen.eigenvalues[k].sqrt();
                field.scaled_add(weight / self.lengths[j], column);
            }
            fields.push(field);
        }
        fields
    }

    /// Returns the inverse of the matrix H for scaled columns, along the independent directions.
    pub fn inverse(&self) -> DMatrix<f64> {
        inverted(&self.matrix()).inverse
    }

    /// Returns the influence field of unknown `i`, as [`LeastSquaresFit::influence`] does; `inverse` is that of
    /// [`Self::inverse`].
    pub fn influence(&self, inverse: &DMatrix<f64>, i: usize) -> Array2<f64> {
        influence(&self.columns, &self.lengths, inverse, i)
    }

    /// Returns the step of all unknowns from `values`, where the fit leaves `rest` of the data. `inverse` is that of
    /// [`Self::inverse`], and `lambda` damps the step.
    pub fn step(
        &self,
        rest: &Array2<f64>,
        values: &[f64],
        inverse: &DMatrix<f64>,
        lambda: f64,
    ) -> DVector<f64> {
        let n = self.lengths.len();
        // J' r - K p
        let known = |i: usize| self.known.get(i).map_or(0.0, |k| k * values[i]);
        let right =
            DVector::from_fn(n, |i, _| (dot(&self.columns[i], rest) - known(i)) / self.lengths[i]);
        let mut damped = None;
        if lambda > 0.0 {
            let mut matrix = self.matrix();
            (0..n).for_each(|i| matrix[(i, i)] += lambda);
            damped = matrix.cholesky().map(|c| c.solve(&right));
        }
        let scaled = damped.unwrap_or_else(|| inverse * &right);
        DVector::from_fn(n, |i, _| scaled[i] / self.lengths[i])
    }
}

/// Inverse of a symmetric matrix along its independent directions, with its eigenvalues.
struct Inverted {
    /// Inverse along the independent directions.
    inverse: DMatrix<f64>,
    /// Eigenvalues, descending.
    eigenvalues: Vec<f64>,
    /// True for the unknowns that take part in a direction that is not independent.
    is_dependent: Vec<bool>,
}

/// Inverts a symmetric matrix along the directions whose eigenvalue is not negligible.
fn inverted(matrix: &DMatrix<f64>) -> Inverted {
    let n = matrix.nrows();
    if n == 0 {
        return Inverted { inverse: matrix.clone(), eigenvalues: vec![], is_dependent: vec![] };
    }
    let eigen = SymmetricEigen::new(matrix.clone());
    let least = INDEPENDENT * eigen.eigenvalues.max();
    let mut inverse = DMatrix::zeros(n, n);
    let mut is_dependent = vec![false; n];
    for (k, value) in eigen.eigenvalues.iter().enumerate() {
        let vector = eigen.eigenvectors.column(k);
        if *value > least {
            inverse += vector * vector.transpose() / *value;
        } else {
            // A direction has length one: of n unknowns one has 1 / sqrt(n) at least.
            let flags = is_dependent.iter_mut().zip(vector.iter());
            flags.for_each(|(flag, v)| *flag |= v.abs() > 0.1 / (n as f64).sqrt());
        }
    }
    let mut eigenvalues: Vec<f64> = eigen.eigenvalues.iter().copied().collect();
    eigenvalues.sort_unstable_by(|a, b| b.total_cmp(a));
    Inverted { inverse, eigenvalues, is_dependent }
}

/// Values of all unknowns, the removal with them, and the rest of the data.
struct Point {
    values: DVector<f64>,
    removal: Array2<f64>,
    rest: Array2<f64>,
}

/// Result of the steps with the derivatives of one point.
struct Steps {
    /// Magnitude of the first step, for every parameter, in the unit of the parameter.
    first: Vec<f64>,
    first_was_small: bool,
    /// True if the steps ended where they began: none lowered the objective.
    is_stuck: bool,
}

/// Moves `point` by steps with the derivatives in `normal` while they lower the objective, and shortens a first step
/// that does not. `way` is the step that led to this point, if any; `rest_of` returns the rest for a removal and
/// values.
fn steps(
    point: &mut Point,
    model: &RemovalModel<'_>,
    normal: &Normal,
    (variance, known): (f64, &[f64]),
    way: Option<&DVector<f64>>,
    rest_of: impl Fn(&Array2<f64>, &DVector<f64>) -> Array2<f64>,
) -> Result<Steps, Invalid> {
    let p = model.parameters.len();
    let start = point.values.clone();
    let inverse = normal.inverse();
    let objective = |rest: &Array2<f64>, values: &DVector<f64>| {
        dot(rest, rest) + known.iter().zip(values.iter()).map(|(k, v)| k * v * v).sum::<f64>()
    };
    let mut lambda = 0.0;
    let errors: Vec<f64> = (0..normal.lengths.len())
        .map(|i| (variance * inverse[(i, i)].max(0.0)).sqrt() / normal.lengths[i])
        .map(|error| error.max(f64::MIN_POSITIVE))
        .collect();
    let mut first = Vec::new();
    let mut first_was_small = false;
    let mut is_stuck = false;
    for k in 0..MOST_STEPS {
        let mut step = normal.step(&point.rest, point.values.as_slice(), &inverse, lambda);
        // The terms of the metrology are linear: they follow.
        let small = (0..p).all(|i| {
            step[i].abs() <= SMALL_STEP * errors[i] || step[i].abs() <= NOTHING * model.scales[i]
        });
        if let (0, Some(way)) = (k, way) {
            let along = scaled_product(&step, way, &errors);
            let square = scaled_product(way, way, &errors).max(f64::MIN_POSITIVE);
            let q = (along / square).clamp(-LARGEST_RETURN, 0.0);
            step /= 1.0 - q;
        }
        first_was_small |= k == 0 && small;
        if k == 0 {
            first = (0..p).map(|i| step[i].abs()).collect();
        }
        let values = &point.values + &step;
        let mut next = None;
        if model.is_possible(&values.as_slice()[..p]) {
            let removal = model.removal_nm(&values.as_slice()[..p])?;
            let rest = rest_of(&removal, &values);
            next = Some(Point { values, removal, rest });
        }
        match next {
            // A step below SMALL_STEP raises the square by less than this, whatever the derivatives err by.
            Some(next)
                if objective(&next.rest, &next.values)
                    <= objective(&point.rest, &point.values) + SMALL_STEP.powi(2) * variance =>
            {
                *point = next;
                lambda = if lambda > LAMBDA[0] { 0.1 * lambda } else { 0.0 };
            }
            // Derivatives of a point that is left: new ones rather than a shorter step
            _ if k > 0 && lambda == 0.0 => break,
            _ => lambda = (10.0 * lambda).max(LAMBDA[0]),
        }
        if small || lambda > LAMBDA[1] {
            is_stuck = point.values == start;
            break;
        }
    }
    Ok(Steps { first, first_was_small, is_stuck })
}

/// Returns the scalar product a . b, with every unknown in units of its standard error `errors`.
fn scaled_product(a: &DVector<f64>, b: &DVector<f64>, errors: &[f64]) -> f64 {
    (0..a.len()).map(|i| a[i] * b[i] / errors[i].powi(2)).sum::<f64>()
}

/// Fits `model` and the coefficients of `terms` to `data`, beginning at `start`. If it ends without a minimum, `end` of
/// the result says so.
///
/// # Errors
/// Fails if the removal cannot be simulated at parameters that the fit tries.
pub fn fit(
    model: &RemovalModel<'_>,
    terms: &[Term],
    data: &Data<'_>,
    start: &Start,
) -> Result<LeastSquaresFit, Invalid> {
    let maps: Vec<Array2<f64>> = terms.iter().map(|t| t.map(data.grid)).collect();
    let p = model.parameters.len();
    let rest_of = |removal: &Array2<f64>, values: &DVector<f64>| {
        (&data.data - removal - sum_of(&maps, &values.as_slice()[p..], removal.dim())) * &data.valid
    };
    let mut values = DVector::zeros(p + maps.len());
    values.rows_mut(0, p).copy_from_slice(&start.values);
    let removal = start.removal.clone();
    let mut derivatives = start.derivatives.clone();
    // The terms of the metrology first: a piston of the whole removal is no noise
    let linear = Normal::new(&[], &maps, &data.valid, Vec::new());
    let alone = linear.step(&rest_of(&removal, &values), &[], &linear.inverse(), 0.0);
    values.rows_mut(p, maps.len()).copy_from(&alone);
    let rest = rest_of(&removal, &values);
    let mut point = Point { values, removal, rest };
    // v, and k = v / s^2
    let weigh = |rest: &Array2<f64>| {
        let noise = Covariance::new(rest, &data.valid, data.grid, p + maps.len(), &[]).noise;
        let v = noise.rest_rms_nm.powi(2) * noise.pixels as f64 / noise.effective_pixels;
        (v, model.scales.iter().map(|s| v / (s * s)).collect::<Vec<f64>>())
    };
    let (mut variance, mut known) = weigh(&point.rest);
    let mut normal = Normal::new(&derivatives, &maps, &data.valid, known.clone());
    let mut points = 1;
    let mut end = End::RoundLimit;
    let mut way: Option<DVector<f64>> = None;
    let mut last;
    loop {
        progress::done((points as f64 / USUAL_POINTS).min(BEFORE_LAST));
        let before = point.values.clone();
        let steps = steps(&mut point, model, &normal, (variance, &known), way.as_ref(), rest_of)?;
        last = steps.first;
        if points > 1 && steps.first_was_small {
            end = End::Converged;
            break;
        }
        // Not even a step that is none lowers the square: new derivatives would be the same.
        if points > 1 && steps.is_stuck {
            end = End::NoImprovement;
            break;
        }
        if points == MOST_POINTS {
            break;
        }
        points += 1;
        way = Some(&point.values - &before);
        (point.removal, derivatives) = model.linear(&point.values.as_slice()[..p])?;
        point.rest = rest_of(&point.removal, &point.values);
        (variance, known) = weigh(&point.rest);
        normal = Normal::new(&derivatives, &maps, &data.valid, known.clone());
    }
    let Point { values, removal, rest } = point;
    let metrology = sum_of(&maps, &values.as_slice()[p..], data.data.dim());
    let noise = Covariance::new(&rest, &data.valid, data.grid, values.len(), &normal.orthonormal());
    let maps = (removal, metrology, rest);
    let last = if end == End::Converged { vec![0.0; p] } else { last };
    Ok(finished(model, terms, values, normal, maps, (noise, variance), (end, last), points))
}

/// Returns the sum of the terms of the metrology with the coefficients `c`, Q c, shape (ny, nx), nm.
fn sum_of(maps: &[Array2<f64>], c: &[f64], shape: (usize, usize)) -> Array2<f64> {
    let mut sum = Array2::zeros(shape);
    for (map, c) in maps.iter().zip(c) {
        sum.scaled_add(*c, map);
    }
    sum
}

/// Returns the result of the fit with its covariance, from the parts that its last point has.
#[allow(clippy::too_many_arguments)] // the parts of a fit, each made once
fn finished(
    model: &RemovalModel<'_>,
    terms: &[Term],
    values: DVector<f64>,
    normal: Normal,
    (removal, metrology, rest): (Array2<f64>, Array2<f64>, Array2<f64>),
    (noise, variance): (Covariance, f64),
    (end, last): (End, Vec<f64>),
    points: usize,
) -> LeastSquaresFit {
    let inverse = normal.inverse();
    // What the data alone say
    let alone = inverted(&normal.cosines);
    let n = values.len();
    // H^-1 (J' C J + v K) H^-1, in scaled columns
    let applied: Vec<Array2<f64>> = normal.columns.iter().map(|c| noise.apply(c)).collect();
    let mut middle = DMatrix::from_fn(n, n, |i, j| {
        dot(&normal.columns[i], &applied[j]) / (normal.lengths[i] * normal.lengths[j])
    });
    for (i, k) in normal.known.iter().enumerate() {
        middle[(i, i)] += variance * k / (normal.lengths[i] * normal.lengths[i]);
    }
    let scaled = &inverse * middle * &inverse;
    let mut covariance = DMatrix::from_fn(n, n, |i, j| {
        0.5 * (scaled[(i, j)] + scaled[(j, i)]) / (normal.lengths[i] * normal.lengths[j])
    });
    let mut unfinished = vec![0.0; last.len()];
    for (i, step) in last.into_iter().enumerate() {
        let error = covariance[(i, i)].max(0.0).sqrt().max(f64::MIN_POSITIVE);
        unfinished[i] = step / error;
        // The fit may end anywhere within its last step.
        covariance[(i, i)] += step * step;
    }
    // Of the part of a column that is no piston: every removal has a mean, which says nothing of anything
    let piston = terms.iter().position(|t| *t == Term::Legendre(0, 0));
    let piston = piston.map(|k| model.parameters.len() + k);
    let inflation = (0..n).map(|i| {
        let without_piston = match piston {
            Some(k) if k != i => 1.0 - normal.cosines[(i, k)].powi(2),
            _ => 1.0,
        };
        if alone.is_dependent[i] { f64::INFINITY } else { alone.inverse[(i, i)] * without_piston }
    });
    LeastSquaresFit {
        parameters: model.parameters.clone(),
        terms: terms.to_vec(),
        values: values.iter().copied().collect(),
        covariance,
        inflation: inflation.collect(),
        singular_values: alone.eigenvalues.iter().map(|v| v.max(0.0).sqrt()).collect(),
        cosines: normal.cosines,
        columns: normal.columns,
        lengths: normal.lengths,
        inverse,
        known: normal.known,
        removal,
        metrology,
        rest,
        noise,
        end,
        unfinished,
        points,
    }
}
