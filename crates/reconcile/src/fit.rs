//! Nonlinear least squares of (1) by Gauss and Newton's steps, and the covariance of what they find.
//!
//! ```text
//! minimise |d - F(p) - Q c|^2 over the pixels that are valid in both maps
//! step:        (J' J + lambda D) delta = J' r,   J = [dF/dp, Q],  D = diag(J' J)
//! covariance:  (J' J)^-1  J' C J  (J' J)^-1       C of the noise, from the rest (the `correlation` module)
//! ```
//!
//! The problem is nearly linear: errors of a process change the derivatives by as little as they are. So the
//! derivatives of one point serve several steps, and are computed anew once where these have ended; when the first
//! step with them is small, this is the minimum. lambda is 0 unless a step makes the square larger (Levenberg and
//! Marquardt).

use nalgebra::{DMatrix, DVector, SymmetricEigen};
use ndarray::Array2;
use planish_types::{End, Grid, Invalid};

use crate::{correlation::Covariance, metrology::Term, model::Model, parameter::Parameter};

/// A step below this part of the standard errors is none: it moves no interval by more than 1 %.
const SMALL_STEP: f64 = 0.005;

/// Steps with the derivatives of one point, and how often they are computed anew.
const MOST_STEPS: usize = 12;
const MOST_POINTS: usize = 8;

/// First and largest lambda.
const LAMBDA: [f64; 2] = [1e-3, 1e6];

/// Directions of the scaled normal matrix below this part of the largest eigenvalue are none: rounding, and the
/// 2e-5 of the derivatives, would decide the step along them.
const INDEPENDENT: f64 = 1e-9;

/// The data of a fit.
pub struct Data<'a> {
    /// Pixels.
    pub grid: &'a Grid,
    /// before - after (ny, nx), nm; 0 where invalid.
    pub data: Array2<f64>,
    /// 1 where both maps are valid, else 0 (ny, nx).
    pub valid: Array2<f64>,
}

/// What a fit found.
pub struct Fit {
    /// Parameters, in their order.
    pub parameters: Vec<Parameter>,
    /// Terms of the metrology, after the parameters.
    pub terms: Vec<Term>,
    /// p and c.
    pub values: Vec<f64>,
    /// Their covariance.
    pub covariance: DMatrix<f64>,
    /// The variance inflation of every unknown: how much larger the others make its variance with white noise;
    /// infinite where it lies in a direction that does not change the removal.
    pub inflation: Vec<f64>,
    /// Scaled normal matrix: the cosines of the angles between the columns.
    pub cosines: DMatrix<f64>,
    /// Singular values of J with columns of the length one, descending.
    pub singular_values: Vec<f64>,
    /// Columns of J, 0 where invalid.
    pub columns: Vec<Array2<f64>>,
    /// Lengths of the columns.
    pub lengths: Vec<f64>,
    /// (J' J)^-1 with the scaled columns, along the directions that are independent.
    pub inverse: DMatrix<f64>,
    /// F(p) (ny, nx), nm, on every pixel.
    pub removal: Array2<f64>,
    /// Q c (ny, nx), nm, on every pixel.
    pub metrology: Array2<f64>,
    /// d - F - Q c, 0 where invalid.
    pub rest: Array2<f64>,
    /// What is known of the noise.
    pub noise: Covariance,
    /// How it ended.
    pub end: End,
    /// Points at which derivatives were computed.
    pub points: usize,
}

/// F and its derivatives at the plan, which no data change: for many fits of one plan.
pub struct Start {
    removal: Array2<f64>,
    derivatives: Vec<Array2<f64>>,
}

impl Start {
    /// Of a model.
    pub fn new(model: &Model<'_>) -> Result<Self, Invalid> {
        let (removal, derivatives) = model.linear(&vec![0.0; model.parameters.len()])?;
        Ok(Self { removal, derivatives })
    }
}

impl Fit {
    /// Standard error of unknown `i`.
    pub fn standard_error(&self, i: usize) -> f64 {
        self.covariance[(i, i)].max(0.0).sqrt()
    }

    /// Correlation of two unknowns.
    pub fn correlation(&self, i: usize, j: usize) -> f64 {
        let scale = self.standard_error(i) * self.standard_error(j);
        if scale > 0.0 { self.covariance[(i, j)] / scale } else { 0.0 }
    }

    /// Names of the unknowns.
    pub fn names(&self) -> Vec<String> {
        let parameters = self.parameters.iter().map(|p| p.name().to_string());
        parameters.chain(self.terms.iter().map(|t| t.name())).collect()
    }

    /// Field by which unknown `i` is estimated: its value is the sum of the data times it (to first order).
    pub fn influence(&self, i: usize) -> Array2<f64> {
        let mut field = Array2::zeros(self.rest.dim());
        for (j, column) in self.columns.iter().enumerate() {
            let weight = self.inverse[(i, j)] / (self.lengths[i] * self.lengths[j]);
            field.scaled_add(weight, column);
        }
        field
    }
}

/// Sum of the products over the map.
pub fn dot(a: &Array2<f64>, b: &Array2<f64>) -> f64 {
    let rows = a.outer_iter().zip(b.outer_iter());
    rows.map(|(a, b)| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>()).sum()
}

/// The normal matrix at one point.
pub(crate) struct Normal {
    /// Columns of J, 0 where invalid.
    pub columns: Vec<Array2<f64>>,
    /// Their lengths.
    pub lengths: Vec<f64>,
    cosines: DMatrix<f64>,
}

impl Normal {
    /// Of derivatives and terms.
    pub fn new(derivatives: &[Array2<f64>], terms: &[Array2<f64>], valid: &Array2<f64>) -> Self {
        let columns: Vec<Array2<f64>> =
            derivatives.iter().chain(terms).map(|column| column * valid).collect();
        let n = columns.len();
        // A column of nothing has the length one, and no direction.
        let length = |c: &Array2<f64>| Some(dot(c, c).sqrt()).filter(|l| *l > 0.0).unwrap_or(1.0);
        let lengths: Vec<f64> = columns.iter().map(length).collect();
        let mut cosines = DMatrix::zeros(n, n);
        for i in 0..n {
            for j in 0..=i {
                let v = dot(&columns[i], &columns[j]) / (lengths[i] * lengths[j]);
                cosines[(i, j)] = v;
                cosines[(j, i)] = v;
            }
        }
        Self { columns, lengths, cosines }
    }

    /// The inverse along the independent directions, the eigenvalues, and which unknowns have a part in the others.
    pub fn inverse(&self) -> (DMatrix<f64>, Vec<f64>, Vec<bool>) {
        let n = self.lengths.len();
        if n == 0 {
            return (DMatrix::zeros(0, 0), Vec::new(), Vec::new());
        }
        let eigen = SymmetricEigen::new(self.cosines.clone());
        let least = INDEPENDENT * eigen.eigenvalues.max();
        let mut inverse = DMatrix::zeros(n, n);
        let mut is_dependent = vec![false; n];
        for (k, value) in eigen.eigenvalues.iter().enumerate() {
            let vector = eigen.eigenvectors.column(k);
            if *value > least {
                inverse += &vector * vector.transpose() / *value;
            } else {
                // A direction has length one: of n unknowns one has 1 / sqrt(n) at least.
                let flags = is_dependent.iter_mut().zip(vector.iter());
                flags.for_each(|(flag, v)| *flag |= v.abs() > 0.1 / (n as f64).sqrt());
            }
        }
        let mut values: Vec<f64> = eigen.eigenvalues.iter().copied().collect();
        values.sort_unstable_by(|a, b| b.total_cmp(a));
        (inverse, values, is_dependent)
    }

    /// The step that `rest` asks for.
    pub fn step(&self, rest: &Array2<f64>, inverse: &DMatrix<f64>, lambda: f64) -> DVector<f64> {
        let n = self.lengths.len();
        let right = DVector::from_fn(n, |i, _| dot(&self.columns[i], rest) / self.lengths[i]);
        let damped = || {
            let mut matrix = self.cosines.clone();
            (0..n).for_each(|i| matrix[(i, i)] += lambda);
            matrix.cholesky().map(|c| c.solve(&right))
        };
        let scaled = match lambda > 0.0 {
            true => damped().unwrap_or_else(|| inverse * &right),
            false => inverse * &right,
        };
        DVector::from_fn(n, |i, _| scaled[i] / self.lengths[i])
    }
}

/// Fits `model` and these terms to `data`; `start` is the model at the plan.
pub fn fit(
    model: &Model<'_>,
    terms: &[Term],
    data: &Data<'_>,
    start: &Start,
) -> Result<Fit, Invalid> {
    let maps: Vec<Array2<f64>> = terms.iter().map(|t| t.map(data.grid)).collect();
    let p = model.parameters.len();
    let rest_of = |removal: &Array2<f64>, values: &DVector<f64>| {
        let mut rest = &data.data - removal;
        for (map, c) in maps.iter().zip(values.iter().skip(p)) {
            rest.scaled_add(-c, map);
        }
        rest * &data.valid
    };
    let mut values = DVector::zeros(p + maps.len());
    let (mut removal, mut derivatives) = (start.removal.clone(), start.derivatives.clone());
    let mut rest = rest_of(&removal, &values);
    let mut normal = Normal::new(&derivatives, &maps, &data.valid);
    let (mut points, mut end) = (1, End::RoundLimit);
    let degrees = (data.valid.sum() - values.len() as f64).max(1.0);
    loop {
        let (inverse, ..) = normal.inverse();
        let mut lambda = 0.0;
        let mut first_was_small = false;
        let mut ended = false;
        for k in 0..MOST_STEPS {
            let step = normal.step(&rest, &inverse, lambda);
            // In standard errors of white noise, which are the least that there are
            let sigma = (dot(&rest, &rest) / degrees).sqrt();
            let small = (0..step.len()).all(|i| {
                let error = sigma * inverse[(i, i)].max(0.0).sqrt() / normal.lengths[i];
                step[i].abs() <= SMALL_STEP * error.max(f64::MIN_POSITIVE)
            });
            let tried = &values + &step;
            let possible = model.is_possible(&tried.as_slice()[..p]);
            let after = match possible {
                true => Some(model.removal_nm(&tried.as_slice()[..p])?),
                false => None,
            };
            let better = after.map(|r| (rest_of(&r, &tried), r));
            match better {
                Some((r, f)) if dot(&r, &r) <= dot(&rest, &rest) => {
                    (values, rest, removal) = (tried, r, f);
                    lambda = if lambda > LAMBDA[0] { 0.1 * lambda } else { 0.0 };
                    first_was_small |= k == 0 && small;
                    if small {
                        ended = true;
                        break;
                    }
                }
                // A step that is as small as rounding does not lower the square any more.
                _ if small => {
                    first_was_small |= k == 0;
                    ended = true;
                    break;
                }
                _ => {
                    lambda = (10.0 * lambda).max(LAMBDA[0]);
                    if lambda > LAMBDA[1] {
                        break;
                    }
                }
            }
        }
        if points > 1 && first_was_small && ended {
            end = End::Converged;
            break;
        }
        if points == MOST_POINTS {
            break;
        }
        points += 1;
        (removal, derivatives) = model.linear(&values.as_slice()[..p])?;
        rest = rest_of(&removal, &values);
        normal = Normal::new(&derivatives, &maps, &data.valid);
    }
    let mut metrology = Array2::zeros(data.data.dim());
    for (map, c) in maps.iter().zip(values.iter().skip(p)) {
        metrology.scaled_add(*c, map);
    }
    let noise = Covariance::of(&rest, &data.valid, data.grid, values.len());
    Ok(finished(model, terms, values, normal, (removal, metrology, rest), noise, end, points))
}

/// The covariance, and all that is said of the fit.
#[allow(clippy::too_many_arguments)] // the parts of a fit, each made once
fn finished(
    model: &Model<'_>,
    terms: &[Term],
    values: DVector<f64>,
    normal: Normal,
    (removal, metrology, rest): (Array2<f64>, Array2<f64>, Array2<f64>),
    noise: Covariance,
    end: End,
    points: usize,
) -> Fit {
    let (inverse, eigenvalues, is_dependent) = normal.inverse();
    let n = values.len();
    // (J' J)^-1 J' C J (J' J)^-1, in scaled columns
    let applied: Vec<Array2<f64>> = normal.columns.iter().map(|c| noise.apply(c)).collect();
    let middle = DMatrix::from_fn(n, n, |i, j| {
        dot(&normal.columns[i], &applied[j]) / (normal.lengths[i] * normal.lengths[j])
    });
    let scaled = &inverse * middle * &inverse;
    let covariance = DMatrix::from_fn(n, n, |i, j| {
        0.5 * (scaled[(i, j)] + scaled[(j, i)]) / (normal.lengths[i] * normal.lengths[j])
    });
    let inflation = (0..n).map(|i| match is_dependent[i] {
        true => f64::INFINITY,
        false => inverse[(i, i)],
    });
    Fit {
        parameters: model.parameters.clone(),
        terms: terms.to_vec(),
        values: values.iter().copied().collect(),
        covariance,
        inflation: inflation.collect(),
        singular_values: eigenvalues.iter().map(|v| v.max(0.0).sqrt()).collect(),
        cosines: normal.cosines,
        columns: normal.columns,
        lengths: normal.lengths,
        inverse,
        removal,
        metrology,
        rest,
        noise,
        end,
        points,
    }
}
