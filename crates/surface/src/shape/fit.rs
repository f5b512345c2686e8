//! Least-squares fit of a curve: the Levenberg-Marquardt method within the bounds of the ellipse.
//!
//! ```text
//! [J; sqrt(damping) I] step = [left; 0]
//! ```
//!
//! The columns of the Jacobian J of an ellipse are nearly parallel, because p, q and theta differ in the
//! third and fourth order only. So every step is solved by a QR decomposition.

use nalgebra::{DMatrix, DVector};
use planish_types::Invalid;

use super::{LAST_STEP, MAX_STEPS, Shape, columns::Columns, curve::Curve, too_few};

/// Damping of the first step, for Jacobian columns of length 1. It is divided by 10 after a step that lowers the sum of
/// squares, and multiplied by 10 after any other step, from [`LEAST_DAMPING`] at least. Larger: shorter first steps.
/// Smaller: the first steps may leave the range of the linear model. Both only cost steps.
const FIRST_DAMPING: f64 = 1e-3;
/// Smallest damping from which a failed step raises it, dimensionless. Larger: slower steps near the
/// minimum. Smaller: more failed steps until the damping acts.
const LEAST_DAMPING: f64 = 1e-10;

/// Damping above which a failed step ends the fit: such a step goes less than 1e-8 down the gradient.
/// Larger: more failed steps at the end. Smaller: the fit may end too early.
const LAST_DAMPING: f64 = 1e8;

/// Relative decrease of the sum of squares at which a step is the last. Larger: the fit ends earlier,
/// farther from its minimum. Smaller: more steps that rounding decides.
const LAST_GAIN: f64 = 1e-12;

/// Smallest part of a Jacobian column that is independent of the other columns, relative to its length. Below it the
/// fit is refused as not determined. Larger: refuses ellipses that the data determine. Smaller: with heights in double
/// precision, rounding would decide the parameters.
const INDEPENDENT: f64 = 1e-11;

/// Number of steps from each start of an ellipse after which the starts are compared. Larger: more time for every
/// start. Smaller: a good start may be dropped. Chosen: most of the decrease comes in the first ten steps.
const FIRST_STEPS: usize = 10;

/// Number of columns, or positions, on which the starts take their first steps (up to twice as many are
/// used). Larger: more time, in proportion. Smaller: the comparison is less certain. Chosen: curves of few
/// parameters need no more.
const COMPARED_COLUMNS: usize = 40;

/// Number of the best starts of an ellipse whose fits are continued to their ends. Larger: more time. Smaller: the
/// deepest minimum may be missed.
const FOLLOWED: usize = 5;

/// Relative decrease of the norm of the differences above which the fit from another start replaces the fit from the
/// design. Larger: keeps the design although another minimum is deeper. Smaller: rounding decides.
const NOTEWORTHY_GAIN: f64 = 1e-9;

/// Fits `curve` to `columns`, from the parameters that it has. An ellipse with free parameters is also fitted from
/// starts all over its bounds, because the sum of squares has several minima along ellipses of equal curvature. Refuses
/// points that do not determine the parameters.
pub(super) fn fitted(mut curve: Curve, columns: &Columns, shape: Shape) -> Result<Curve, Invalid> {
    curve.middle_mm[1] = columns.y_middle_mm;
    let starts = curve.starts();
    let designed = descended(curve, columns, shape, MAX_STEPS);
    let norm = |curve: &Curve| curve.left(columns).norm();
    let some = columns.thinned(COMPARED_COLUMNS);
    let mut others: Vec<(f64, Curve)> = starts
        .into_iter()
        .filter_map(|start| descended(start, &some, shape, FIRST_STEPS).ok())
        .map(|curve| (norm(&curve), curve))
        .filter(|(norm, _)| norm.is_finite())
        .collect();
    others.sort_by(|a, b| a.0.total_cmp(&b.0));
    others.truncate(FOLLOWED);
    let ends = others
        .into_iter()
        .filter_map(|(_, curve)| descended(curve, columns, shape, MAX_STEPS).ok());
    // Differences of the norms below this are rounding.
    let rounding = LAST_STEP * size(columns);
    let mut best = designed;
    for end in ends {
        let is_better = match &best {
            Ok(best) => norm(&end) < norm(best) * (1.0 - NOTEWORTHY_GAIN) - rounding,
            // The data may lie beyond the ends of the design alone.
            Err(_) => true,
        };
        if is_better {
            best = Ok(end);
        }
    }
    with_errors(best?, columns, shape)
}

/// Returns `curve` after at most `steps` steps, of which it keeps those that lower the sum of squares. Refuses points
/// beyond the ends of the ellipse, in one place, or fewer than parameters.
fn descended(
    mut curve: Curve,
    columns: &Columns,
    shape: Shape,
    steps: usize,
) -> Result<Curve, Invalid> {
    let mut left = curve.left(columns);
    let mut damping = FIRST_DAMPING;
    let mut jacobian = scaled_jacobian(&curve, columns, shape)?;
    if !left.norm().is_finite() {
        let how = "they lie beyond the ends of the ellipse";
        return Err(too_few(shape, how));
    }
    if jacobian.0.nrows() < jacobian.0.ncols() {
        let how = format!("{} for {} unknowns", jacobian.0.nrows(), jacobian.0.ncols());
        return Err(too_few(shape, &how));
    }
    for _ in 0..steps {
        let room = curve.room();
        let (matrix, scale) = &jacobian;
        let (mut step, norm) = damped_step(matrix, scale, &left, &room, damping);
        let first = step.len() - room.len();
        for (step, [low, high]) in step[first..].iter_mut().zip(&room) {
            *step = step.clamp(low.min(0.0), high.max(0.0));
        }
        let small = norm <= LAST_STEP * size(columns);
        let next = curve.moved(&step, columns);
        let then = next.left(columns);
        if then.norm() < left.norm() {
            let gains = left.norm_squared() - then.norm_squared();
            let ended = small || gains <= LAST_GAIN * left.norm_squared();
            (curve, left) = (next, then);
            damping *= 0.1;
            jacobian = scaled_jacobian(&curve, columns, shape)?;
            if ended {
                break;
            }
        } else if small || damping > LAST_DAMPING {
            break;
        } else {
            damping = 10.0 * damping.max(LEAST_DAMPING);
        }
    }
    Ok(curve)
}

/// Returns `curve`, which is at a minimum, with its standard errors. Refuses it if the points do not determine its
/// parameters.
fn with_errors(mut curve: Curve, columns: &Columns, shape: Shape) -> Result<Curve, Invalid> {
    let left = curve.left(columns);
    let (matrix, scale) = scaled_jacobian(&curve, columns, shape)?;
    let r = matrix.qr().r();
    if (0..r.ncols()).any(|k| r[(k, k)].abs() < INDEPENDENT) {
        let problem =
            format!("the points do not tell the parameters of the shape {} apart", shape.name());
        let remedy = match shape {
            Shape::Ellipse => "fit fewer of p, q and theta",
            _ => "give points along more of x and y",
        };
        return Err(Invalid::whole("shape", problem, remedy));
    }
    curve.standard_error = errors(&curve, &r, &scale, &left);
    Ok(curve)
}

/// Returns a damped step of the parameters, in their own units, and its length in the scaled Jacobian. `matrix` is this
/// Jacobian (or R of its QR factors) and `left` the differences (or Q' of them). `scale` contains the lengths of the
/// columns before the scaling. `room` limits the last parameters, down and up; one that the step would take beyond its
/// bound stays.
pub(crate) fn damped_step(
    matrix: &DMatrix<f64>,
    scale: &[f64],
    left: &DVector<f64>,
    room: &[[f64; 2]],
    damping: f64,
) -> (Vec<f64>, f64) {
    let unknowns = matrix.ncols();
    let gradient = matrix.tr_mul(left);
    let first = unknowns - room.len();
    let mut moving: Vec<usize> = (0..first).collect();
    for (k, [low, high]) in room.iter().enumerate() {
        let downhill = gradient[first + k];
        let rests = *low >= 0.0 && downhill < 0.0 || *high <= 0.0 && downhill > 0.0;
        if !rests {
            moving.push(first + k);
        }
    }
    // [J; sqrt(damping) I] step = [left; 0]
    let (n, m) = (matrix.nrows(), moving.len());
    let damped = DMatrix::from_fn(n + m, m, |i, k| match i.checked_sub(n) {
        None => matrix[(i, moving[k])],
        Some(row) => f64::from(u8::from(row == k)) * damping.sqrt(),
    });
    let mut right = DVector::zeros(n + m);
    right.rows_mut(0, n).copy_from(left);
    let qr = damped.qr();
    qr.q_tr_mul(&mut right);
    let right = right.rows(0, m).into_owned();
    let solved = qr.r().solve_upper_triangular(&right).unwrap_or_else(|| DVector::zeros(m));
    let mut step = vec![0.0; unknowns];
    moving.iter().zip(&solved).for_each(|(k, v)| step[*k] = v / scale[*k]);
    (step, solved.norm())
}

/// Returns the Jacobian with columns of length 1, and their lengths before. Refuses a column of length 0 or not finite.
fn scaled_jacobian(
    curve: &Curve,
    columns: &Columns,
    shape: Shape,
) -> Result<(DMatrix<f64>, Vec<f64>), Invalid> {
    let mut jacobian = curve.jacobian(columns);
    let scale: Vec<f64> = jacobian.column_iter().map(|c| c.norm()).collect();
    if !scale.iter().all(|s| s.is_finite() && *s > 0.0) {
        let how = "they lie beyond the ends of the ellipse, or in one place";
        return Err(too_few(shape, how));
    }
    jacobian.column_iter_mut().zip(&scale).for_each(|(mut c, s)| c /= *s);
    Ok((jacobian, scale))
}

/// Returns the weighted norm (root of the sum of squares) of the heights, mm, or slopes, rad, that are fitted.
fn size(columns: &Columns) -> f64 {
    let weighted = columns.mean_mm.iter().enumerate();
    let squares = weighted.map(|(i, v)| (v * columns.weight.get(i).unwrap_or(&1.0)).powi(2));
    squares.sum::<f64>().sqrt()
}

/// Returns the relative standard errors of p, q, theta: the roots of the diagonal of G C G'. C = s^2 (J' J)^-1 is the
/// covariance of the fitted coordinates, with s^2 = |left|^2 / (rows - unknowns). G has the derivatives of ln p, ln q
/// and ln theta by these coordinates.
fn errors(curve: &Curve, r: &DMatrix<f64>, scale: &[f64], left: &DVector<f64>) -> [f64; 3] {
    let Some(moved) = &curve.ellipse else { return [0.0; 3] };
    let unknowns = r.ncols();
    let spare = left.len().saturating_sub(unknowns).max(1) as f64;
    let Some(inverse) = r.clone().try_inverse() else { return [0.0; 3] };
    let first = unknowns - moved.count();
    [0, 1, 2].map(|parameter| {
        let mut row = DVector::zeros(unknowns);
        for k in 0..moved.count() {
            let by_coordinate =
                moved.derivative(k, |e| [e.p_mm, e.q_mm, e.theta_rad][parameter].abs().ln());
            row[first + k] = by_coordinate / scale[first + k];
        }
        let error = inverse.tr_mul(&row).norm() * left.norm() / spare.sqrt();
        if error.is_nan() { f64::INFINITY } else { error }
    })
}
