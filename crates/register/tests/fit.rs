//! Fiducials of known parts: closed forms, coverage of the covariance, what is refused.

use planish_register::{
    fiducials::Fiducial,
    fit::{TransformModel, angle, fit},
};
use planish_testkit::case_generator;
use planish_types::Transform;
use rand::RngExt;
use rand_chacha::ChaCha8Rng;

/// Map coordinates [x, y] of the corners of a part of 100 x 60 mm.
const CORNERS: [[f64; 2]; 4] = [[0.0, 0.0], [100.0, 0.0], [100.0, 60.0], [0.0, 60.0]];

fn gaussian(random: &mut ChaCha8Rng) -> f64 {
    // Box and Muller
    let [u, v]: [f64; 2] = [random.random(), random.random()];
    (-2.0 * (1.0 - u).ln()).sqrt() * (std::f64::consts::TAU * v).cos()
}

fn turned(angle_deg: f64, scale: f64) -> [[f64; 2]; 2] {
    let (s, c) = angle_deg.to_radians().sin_cos();
    [[scale * c, -scale * s], [scale * s, scale * c]]
}

/// Returns fiducials at `points` of the map. On the machine they are transformed by `matrix` and a shift, with noise of
/// `sigma_mm`.
fn measured(
    points: &[[f64; 2]],
    matrix: [[f64; 2]; 2],
    sigma_mm: f64,
    given: bool,
    random: &mut ChaCha8Rng,
) -> Vec<Fiducial> {
    let shift = [-12.5, 340.0];
    let one = |(i, p): (usize, &[f64; 2])| Fiducial {
        name: format!("{i}"),
        map_mm: *p,
        machine_mm: [0, 1].map(|r| {
            shift[r] + matrix[r][0] * p[0] + matrix[r][1] * p[1] + sigma_mm * gaussian(random)
        }),
        uncertainty_mm: given.then_some(sigma_mm),
        map_uncertainty_mm: None,
    };
    points.iter().enumerate().map(one).collect()
}

fn plain(points: &[[f64; 2]], matrix: [[f64; 2]; 2]) -> Vec<Fiducial> {
    measured(points, matrix, 0.0, false, &mut case_generator(1, 1, 0))
}

#[test]
fn without_noise_every_model_is_exact() {
    let affine = [[1.01, -0.3], [0.25, 0.98]];
    for (model, matrix) in [
        (TransformModel::Rigid, turned(31.0, 1.0)),
        (TransformModel::Similarity, turned(-170.0, 1.02)),
        (TransformModel::Affine, affine),
    ] {
        let found = fit(&plain(&CORNERS, matrix), model).unwrap();
        for p in [[3.0, -7.0], [200.0, 11.0]] {
            let q = found.transform.point(p);
            let expected =
                [0, 1].map(|r| [-12.5, 340.0][r] + matrix[r][0] * p[0] + matrix[r][1] * p[1]);
            // Below: rounding of coordinates of up to 500 mm; of those of the corners; and of degrees.
            assert!(
                (0..2).all(|a| (q[a] - expected[a]).abs() < 1e-11),
                "{model:?}: {q:?} {expected:?}"
            );
        }
        // As above, over the corners.
        assert!(found.report.rms_mm < 1e-12, "{model:?}");
    }
    let found = fit(&plain(&CORNERS, turned(31.0, 1.0)), TransformModel::Rigid).unwrap();
    // Rounding of degrees.
    assert!((found.report.angle_deg.value - 31.0).abs() < 1e-12);
}

/// Returns the squared distance of the found transform from the true one, in standard errors of the parameters that the
/// model has.
fn distance(found: &Transform, truth: [[f64; 2]; 2], model: TransformModel) -> f64 {
    let centre = found.centre_mm();
    let image =
        [0, 1].map(|r| [-12.5, 340.0][r] + truth[r][0] * centre[0] + truth[r][1] * centre[1]);
    let (c, m) = (found.covariance(), found.matrix());
    let mut sum = (0..2).map(|a| (found.image_mm()[a] - image[a]).powi(2) / c[a][a]).sum::<f64>();
    match model {
        TransformModel::Rigid => {
            let angle = (truth[1][0] - truth[0][1]).atan2(truth[0][0] + truth[1][1]);
            let variance = angle_variance(found);
            sum += (found.angle_rad() - angle).powi(2) / variance;
        }
        TransformModel::Similarity => {
            sum += (m[0][0] - truth[0][0]).powi(2) / c[2][2];
            sum += (m[1][0] - truth[1][0]).powi(2) / c[4][4];
        }
        TransformModel::Affine => {
            for axis in 0..2 {
                let d = [0, 1].map(|s| m[axis][s] - truth[axis][s]);
                let block = [0, 1].map(|r| [0, 1].map(|s| c[2 + 2 * axis + r][2 + 2 * axis + s]));
                let n = inverse(&block);
                sum += d[0] * (n[0][0] * d[0] + n[0][1] * d[1])
                    + d[1] * (n[1][0] * d[0] + n[1][1] * d[1]);
            }
        }
    }
    sum
}

fn angle_variance(found: &Transform) -> f64 {
    angle(found).standard_error.to_radians().powi(2)
}

/// Checks that four fiducials with 5 um of noise give the part to 5 um and 0.01 degree. The 95 % region of the
/// covariance must contain the true transform in 95 % of the draws. With 1000 draws the standard error of this fraction
/// is 0.7 %.
#[test]
fn the_covariance_covers_the_truth_in_95_percent_of_the_draws() {
    // 95 % of chi^2 with 3, 4, 6 degrees, and of p F(p, dof) where the uncertainties are from the residuals:
    // F(3, 5) = 5.409, F(4, 4) = 6.388, F(6, 2) = 19.330.
    for (stream, model, scale, quantiles) in [
        (1, TransformModel::Rigid, 1.0, [7.815, 3.0 * 5.409]),
        (2, TransformModel::Similarity, 1.003, [9.488, 4.0 * 6.388]),
        (3, TransformModel::Affine, 1.003, [12.592, 6.0 * 19.330]),
    ] {
        for given in [true, false] {
            let truth = turned(3.0, scale);
            let (mut covered, mut shift, mut angle) = (0, 0.0, 0.0);
            for draw in 0..1000 {
                let mut random = case_generator(17, stream, draw);
                let fiducials = measured(&CORNERS, truth, 5e-3, given, &mut random);
                let found = fit(&fiducials, model).unwrap();
                let within = quantiles[usize::from(!given)];
                covered += usize::from(distance(&found.transform, truth, model) <= within);
                let q = found.transform.point([50.0, 30.0]);
                let p = [0, 1].map(|r| [-12.5, 340.0][r] + truth[r][0] * 50.0 + truth[r][1] * 30.0);
                shift += (q[0] - p[0]).powi(2) + (q[1] - p[1]).powi(2);
                angle += (found.report.angle_deg.value - 3.0).powi(2);
            }
            let part = covered as f64 / 1000.0;
            assert!((0.928..=0.972).contains(&part), "{model:?} {given}: {part}");
            let [shift, angle] = [shift, angle].map(|s: f64| (s / 1000.0).sqrt());
            println!(
                "{model:?}, given {given}: {part} covered, {shift:.5} mm, {angle:.5} degree RMS"
            );
            // 5 um sqrt(2) / sqrt(4) for the middle; 5 um / sqrt(4 * (50^2 + 30^2)) mm for the angle.
            assert!(shift < 5e-3 && angle < 0.01, "{model:?}: {shift} mm, {angle} degree");
        }
    }
}

#[test]
fn mirrored_correspondences_are_refused() {
    let mirror = [[1.0, 0.0], [0.0, -1.0]];
    for model in [TransformModel::Rigid, TransformModel::Similarity, TransformModel::Affine] {
        let fiducials =
            measured(&CORNERS, mirror, 5e-3, true, &mut case_generator(17, 4, model as u64));
        let said = fit(&fiducials, model).unwrap_err().to_string();
        assert!(said.contains("matrix: mirrors"), "{model:?}: {said}");
    }
    // On a line nothing tells; that is said.
    let line = [[0.0, 0.0], [50.0, 0.0], [100.0, 0.0]];
    let fiducials = measured(&line, mirror, 5e-3, true, &mut case_generator(17, 5, 0));
    let found = fit(&fiducials, TransformModel::Rigid).unwrap();
    assert!(found.report.warnings[0].contains("turned over"), "{:?}", found.report.warnings);
    let found = fit(&plain(&CORNERS, turned(5.0, 1.0)), TransformModel::Rigid).unwrap();
    assert!(found.report.warnings.is_empty(), "{:?}", found.report.warnings);
}

#[test]
fn degenerate_fiducials_are_refused_with_numbers() {
    let said = |points: &[[f64; 2]], sigma: f64, given: bool, model| {
        let fiducials =
            measured(points, turned(1.0, 1.0), sigma, given, &mut case_generator(17, 6, 0));
        fit(&fiducials, model).unwrap_err().to_string()
    };
    let one = said(&CORNERS[..1], 1e-3, true, TransformModel::Rigid);
    assert!(one.contains("is one of 1, and Rigid needs 2"), "{one}");
    let two = said(&CORNERS[..2], 1e-3, true, TransformModel::Affine);
    assert!(two.contains("is one of 2, and Affine needs 3"), "{two}");
    let line = said(&[[0.0, 0.0], [50.0, 0.01], [100.0, 0.0]], 1e-3, true, TransformModel::Affine);
    assert!(line.contains("on a line: 40.8 mm RMS along it, 0.00471 mm across"), "{line}");
    let same = said(&[[0.0, 0.0], [1e-3, 0.0], [50.0, 0.0]], 5e-3, true, TransformModel::Rigid);
    assert!(same.contains("map_mm[1]: is [0.001, 0.0], where fiducial 0 is already"), "{same}");
    let close = said(&[[0.0, 0.0], [0.03, 0.0]], 5e-3, true, TransformModel::Rigid);
    assert!(close.contains("within 0.015 mm RMS of each other"), "{close}");
    let unknown = said(&CORNERS[..2], 0.0, false, TransformModel::Similarity);
    assert!(unknown.contains("nothing is left to estimate them from"), "{unknown}");
    let mut some = measured(&CORNERS, turned(1.0, 1.0), 1e-3, true, &mut case_generator(17, 7, 0));
    some[2].uncertainty_mm = None;
    let some = fit(&some, TransformModel::Rigid).unwrap_err().to_string();
    assert!(some.contains("uncertainty_mm[2]: is absent, 3 of 4 have one"), "{some}");
}

#[test]
fn fiducials_that_do_not_belong_together_are_a_drawback() {
    let truth = turned(2.0, 1.0);
    let mut fiducials = measured(&CORNERS, truth, 5e-3, true, &mut case_generator(17, 8, 0));
    assert!(fit(&fiducials, TransformModel::Rigid).unwrap().report.drawback().is_none());
    fiducials[1].machine_mm[1] += 0.2;
    let found = fit(&fiducials, TransformModel::Rigid).unwrap();
    let drawback = found.report.drawback().unwrap();
    assert!(drawback.contains("far more than their uncertainties"), "{drawback}");
    // A pitch that is wrong by 1 % shows in the scale that is not free.
    let scaled = measured(&CORNERS, turned(2.0, 1.01), 5e-3, true, &mut case_generator(17, 9, 0));
    let found = fit(&scaled, TransformModel::Rigid).unwrap();
    assert!(found.report.warnings[0].contains("1.01"), "{:?}", found.report.warnings);
    let found = fit(&scaled, TransformModel::Similarity).unwrap();
    assert!(found.report.drawback().is_none() && found.report.warnings.is_empty());
}

/// Checks that an exact fiducial counts more than an uncertain one: the weighted fit follows it.
#[test]
fn uncertainties_are_weights() {
    let mut fiducials = plain(&CORNERS, turned(0.0, 1.0));
    for (i, f) in fiducials.iter_mut().enumerate() {
        f.uncertainty_mm = Some(if i == 3 { 0.1 } else { 1e-3 });
    }
    fiducials[3].machine_mm[0] += 0.1;
    let found = fit(&fiducials, TransformModel::Rigid).unwrap();
    let left = found.report.residuals.iter().map(|r| r.residual_mm[0].abs()).collect::<Vec<_>>();
    // The weight of the last is 1e-4 of the others': some 1e-5 of its 0.1 mm goes to them.
    assert!(left[..3].iter().all(|l| *l < 1e-4) && left[3] > 0.0999, "{left:?}");
}

fn inverse(n: &[[f64; 2]; 2]) -> [[f64; 2]; 2] {
    let determinant = n[0][0] * n[1][1] - n[0][1] * n[1][0];
    [[n[1][1], -n[0][1]], [-n[1][0], n[0][0]]].map(|row| row.map(|v| v / determinant))
}
