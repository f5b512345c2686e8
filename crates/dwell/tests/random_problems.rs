//! The conditions of optimality (Karush, Kuhn, Tucker) of the bounded least squares on random problems,
//! computed from the definition of the problem and the columns of B alone.

use ndarray::{Array2, s};
use planish_dwell::{
    bounded_least_squares::{Algorithm, BoundedSettings, Free, Program, solve_columns},
    columns::{Columns, Patch, patches},
};
use planish_types::{Axis, End, Grid, PARTS_TOLERANCE, Surface, Tif, ToolPath};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::definition::Penalty;

/// A random problem: a map with holes, a tool, a raster that is neither straight nor everywhere on, and bounds.
struct Case {
    desired: Surface,
    weight: Array2<f64>,
    tif: Tif,
    path: ToolPath,
    lo: Vec<f64>,
    hi: Vec<f64>,
    settings: BoundedSettings,
}

fn axis(start: f64, step: f64, n: usize) -> Axis {
    Axis::new(start, step, n).unwrap()
}

/// Makes the problem of a seed. `pitch_mm` is the pitch of the TIF; that of the map is 0.25 mm.
fn case(seed: u64, pitch_mm: f64) -> Case {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let map = Grid {
        x: axis(rng.random_range(-3.0..3.0), 0.25, rng.random_range(24..40)),
        y: axis(rng.random_range(-3.0..3.0), 0.25, rng.random_range(20..32)),
    };
    // A bell of a random width, shifted, tilted, and cut off at its border by a smooth edge.
    let n = (2.6 / pitch_mm).round() as usize;
    let a = axis(-(n as f64) * pitch_mm, pitch_mm, 2 * n + 1);
    let g = Grid { x: a, y: a };
    let [sx, sy] = [0, 1].map(|_| rng.random_range(0.8..1.1));
    let [x0, y0, tilt] = [0, 1, 2].map(|_| rng.random_range(-0.3..0.3));
    let rate = Array2::from_shape_fn(g.shape(), |(r, c)| {
        let (x, y) = (g.x.coordinate_mm(c), g.y.coordinate_mm(r));
        let edge = |v: f64| (1.0 - (v / 2.7).powi(2)).max(0.0).powi(3);
        let bell = (-0.5 * (((x - x0) / sx).powi(2) + ((y - y0) / sy).powi(2))).exp();
        8.0 * bell * (1.0 + tilt * x) * edge(x) * edge(y)
    });
    let tif = Tif::new(g, rate).unwrap();

    // Lines 0.4 mm apart, over the map and 1 mm beyond, in steps of 0.3 to 0.5 mm.
    let mut points = Vec::new();
    let [wx, wy] = [map.x.end_mm() - map.x.start_mm(), map.y.end_mm() - map.y.start_mm()];
    for line in 0..((wy + 2.0) / 0.4) as usize {
        let mut x = -1.0;
        let mut on_line = Vec::new();
        while x < wx + 1.0 {
            let y = 0.4 * line as f64 - 1.0 + rng.random_range(-0.05..0.05);
            on_line.push([map.x.start_mm() + x, map.y.start_mm() + y]);
            x += rng.random_range(0.3..0.5);
        }
        if line % 2 == 1 {
            on_line.reverse();
        }
        points.extend(on_line);
    }
    let n = points.len() - 1;
    let on: Vec<bool> = (0..n).map(|_| rng.random_range(0.0..1.0) > 0.03).collect();
    let path = ToolPath::through(points, on, vec![0; n]).unwrap();

    let waves: Vec<[f64; 4]> =
        (0..6).map(|_| [0, 1, 2, 3].map(|_| rng.random_range(-1.2..1.2))).collect();
    let mut height = Array2::from_shape_fn(map.shape(), |(r, c)| {
        let (x, y) = (map.x.coordinate_mm(c), map.y.coordinate_mm(r));
        waves.iter().map(|w| 8.0 * w[0] * (w[1] * x + w[2] * y + 3.0 * w[3]).sin()).sum::<f64>()
            + rng.random_range(-0.3..0.3)
    });
    let (r, c) = (rng.random_range(0..14), rng.random_range(0..18));
    height.slice_mut(s![r..r + 4, c..c + 5]).fill(f64::NAN);
    let weight = Array2::from_shape_simple_fn(map.shape(), || {
        if rng.random_range(0.0..1.0) < 0.02 { 0.0 } else { rng.random_range(0.5..2.0) }
    });
    let lo: Vec<f64> = (0..n).map(|_| rng.random_range(0.0..0.02)).collect();
    let hi = lo.iter().map(|lo| lo + rng.random_range(0.05..0.6)).collect();
    let settings = BoundedSettings {
        tikhonov: 10.0_f64.powf(rng.random_range(-6.0..-4.0)),
        slope_weight: 10.0_f64.powf(rng.random_range(-7.0..-4.0)),
        time_weight_nm2_per_s: rng.random_range(0.0..0.01),
        free: if seed.is_multiple_of(2) { Free::Piston } else { Free::Plane },
        tolerance_s: 1e-8,
        // The certificate by the natural residual alone.
        relative_gap: 0.0,
        max_iterations: 100_000,
        ..BoundedSettings::default()
    };
    let desired = Surface::new(map, height).unwrap();
    Case { desired, weight, tif, path, lo, hi, settings }
}

/// Parts of the objective (1) of the bounded least squares, by its definition.
struct Definition {
    columns: Vec<Patch>,
    /// Given weights of the pixels (ny, nx), 0 on invalid pixels.
    weight: Array2<f64>,
    /// Free functions (piston, or plane), each (ny, nx), orthonormal under the weights.
    free: Vec<Array2<f64>>,
    /// Diagonal of the matrix `B' W B - U U'` (n).
    diagonal: Vec<f64>,
}

impl Definition {
    fn new(case: &Case) -> Self {
        let grid = case.desired.grid();
        let columns = patches(&Columns::Segment.places(&case.path, &case.tif), &case.tif, grid);
        let valid = case.desired.height_nm().mapv(|z| if z.is_nan() { 0.0 } else { 1.0 });
        let weight = &case.weight * &valid;
        let plane = [
            Array2::ones(grid.shape()),
            Array2::from_shape_fn(grid.shape(), |(_, c)| c as f64 - 15.0),
            Array2::from_shape_fn(grid.shape(), |(r, _)| r as f64 - 12.0),
        ];
        let count = if case.settings.free == Free::Piston { 1 } else { 3 };
        let mut free: Vec<Array2<f64>> = Vec::new();
        for f in plane.iter().take(count) {
            let mut f = f.clone();
            // Gram-Schmidt, twice.
            for _ in 0..2 {
                for g in &free {
                    let c = (&f * g * &weight).sum();
                    f.scaled_add(-c, g);
                }
            }
            let length = (&f * &f * &weight).sum().sqrt();
            free.push(f / length);
        }
        let mut found = Self { columns, weight, free, diagonal: Vec::new() };
        found.diagonal = (found.columns.iter())
            .map(|p| {
                let energy = found.along(p, &p.rate_nm_per_s);
                let of_free = found.free.iter().map(|f| {
                    let ((r, c), (ny, nx)) = (p.origin, p.rate_nm_per_s.dim());
                    found.along(p, &f.slice(s![r..r + ny, c..c + nx]).to_owned()).powi(2)
                });
                energy - of_free.sum::<f64>()
            })
            .collect();
        found
    }

    /// Returns `sum_i w_i B_ij m_i` for the column `p` of B and values m on its pixels.
    fn along(&self, p: &Patch, m: &Array2<f64>) -> f64 {
        let ((r, c), (ny, nx)) = (p.origin, p.rate_nm_per_s.dim());
        (&p.rate_nm_per_s * m * self.weight.slice(s![r..r + ny, c..c + nx])).sum()
    }

    /// Returns the residual `z - B t` (ny, nx) without its free part, nm; 0 where the weight is 0.
    fn residual(&self, case: &Case, t: &[f64]) -> Array2<f64> {
        let mut residual = case.desired.height_nm().mapv(|z| if z.is_nan() { 0.0 } else { z });
        for (p, t) in self.columns.iter().zip(t) {
            let ((r, c), (ny, nx)) = (p.origin, p.rate_nm_per_s.dim());
            residual.slice_mut(s![r..r + ny, c..c + nx]).scaled_add(-t, &p.rate_nm_per_s);
        }
        for f in &self.free {
            let c = (&residual * f * &self.weight).sum();
            residual.scaled_add(-c, f);
        }
        residual
    }

    /// Returns the natural residual, the largest |t - clip(t - gradient / H_jj)| over columns that reach the map, s,
    /// for a given D.
    fn natural_residual(&self, case: &Case, t: &[f64], d: f64) -> f64 {
        let largest = self.diagonal.iter().copied().fold(0.0, f64::max);
        // In (1) an unreached column stays at its bound.
        let held = |j: usize| if self.diagonal[j] > 1e-9 * largest { t[j] } else { case.lo[j] };
        let t = &(0..t.len()).map(held).collect::<Vec<f64>>()[..];
        let BoundedSettings { tikhonov, slope_weight, time_weight_nm2_per_s, .. } = case.settings;
        let weights = (tikhonov, slope_weight);
        let penalty = Penalty::new(&case.path, &case.tif, &self.columns, &self.weight, d, weights);
        let residual = self.residual(case, t);
        let n = t.len();
        let mut q: Vec<f64> = (self.columns.iter())
            .map(|p| {
                let ((r, c), (ny, nx)) = (p.origin, p.rate_nm_per_s.dim());
                -self.along(p, &residual.slice(s![r..r + ny, c..c + nx]).to_owned())
            })
            .collect();
        let mut h = self.diagonal.clone();
        let (slope, curvature) = (penalty.gradient(t, &case.lo), penalty.diagonal());
        for j in 0..n {
            q[j] += slope[j] + time_weight_nm2_per_s * self.weight.sum();
            h[j] += curvature[j];
        }
        (0..n)
            .filter(|j| self.diagonal[*j] > 2e-9 * largest)
            .map(|j| (t[j] - (t[j] - q[j] / h[j]).clamp(case.lo[j], case.hi[j])).abs())
            .fold(0.0, f64::max)
    }
}

fn conditions_hold(seed: u64, pitch_mm: f64, max_factorised_points: usize) {
    let mut case = case(seed, pitch_mm);
    case.settings.max_factorised_points = max_factorised_points;
    // The solver has the tool on the lattice of the map.
    let on_lattice = case.tif.on_lattice_of(case.desired.grid(), PARTS_TOLERANCE).unwrap();
    case.tif = on_lattice.tif.into_owned();
    let places = Columns::Segment.places(&case.path, &case.tif);
    let program = Program {
        places: &places,
        lo: case.lo.clone(),
        hi: case.hi.clone(),
        guess: None,
        quadratic: None,
    };
    let Case { desired, tif, path, weight, settings, .. } = &case;
    let found = solve_columns(desired, tif, path, Some(weight), settings, &program).unwrap();
    let (t, report) = (found.dwell.dwell_s(), &found.report);
    let context = format!("seed {seed}, pitch {pitch_mm} mm: {report:?}");
    let algorithm =
        if max_factorised_points == 0 { Algorithm::TwoLevel } else { Algorithm::ActiveSet };
    assert_eq!((report.algorithm, report.end), (algorithm, End::Optimal), "{context}");
    // Some are at every bound, and some are free: otherwise the conditions would be no test.
    let free = t.len() - report.at_lower_bound - report.at_upper_bound - report.unreached_points;
    assert!(report.at_lower_bound.min(report.at_upper_bound).min(free) > 0, "{context}");

    let definition = Definition::new(&case);
    let largest = definition.diagonal.iter().copied().fold(0.0, f64::max);
    for j in 0..t.len() {
        assert!((case.lo[j]..=case.hi[j]).contains(&t[j]), "{context} {j}");
    }
    // D is the diagonal element of the strongest column; the two-level method estimates by FFT which
    // one that is, with the mean of R^2 over a segment in place of the square of the mean: segments of 0.5
    // mm under a bell of sigma 0.8 mm differ by 1 - exp(-(0.5 / 0.8)^2 / 24) = 2 %.
    let is_strongest = |d: &f64| match algorithm {
        Algorithm::ActiveSet => *d == largest,
        _ => *d >= 0.98 * largest,
    };
    let natural = (definition.diagonal.iter().copied().filter(is_strongest))
        .map(|d| definition.natural_residual(&case, t, d))
        .fold(f64::INFINITY, f64::min);
    // What the solver was asked for, in the scale of its own H_jj (2 % as above), and the rounding of q_j:
    // some hundred times that of a sum |B_j| |r|, by FFT |R| |r|, over H_jj >= alpha K A / a_j, where A / a_j is above 10: lines and points of 0.4 mm
    // under a bell of some 8 mm^2.
    let norm = |m: &Array2<f64>| m.iter().map(|v| v * v).sum::<f64>().sqrt();
    let left = norm(&definition.residual(&case, t));
    let rate = norm(tif.rate_nm_per_s());
    let rounding = 100.0 * f64::EPSILON * rate * left / (10.0 * settings.tikhonov * largest);
    let allowed = 1.02 * settings.tolerance_s + rounding;
    assert!(rounding < settings.tolerance_s, "the test is too coarse: {rounding}");
    assert!(natural <= allowed, "{natural} s, allowed {allowed} s: {context}");

    // And they are not met anywhere else nearby: a thousandth of a second more on one free point.
    let j = (0..t.len())
        .filter(|j| definition.diagonal[*j] > 0.1 * largest && t[*j] + 2e-3 < case.hi[*j])
        .find(|j| t[*j] > case.lo[*j])
        .unwrap();
    let mut moved = t.to_vec();
    moved[j] += 1e-3;
    // 1e-3 s on a point whose H_jj is at least a tenth of the largest.
    assert!(definition.natural_residual(&case, &moved, largest) > 1e-4, "{context}");
}

#[test]
fn conditions_of_optimality_hold_with_b_by_fft() {
    (0..8).for_each(|seed| conditions_hold(seed, 0.25, 6000));
}

#[test]
fn conditions_of_optimality_hold_with_b_by_stored_columns() {
    // A TIF of another pitch than the map.
    (100..108).for_each(|seed| conditions_hold(seed, 0.19, 6000));
}

#[test]
fn conditions_of_optimality_hold_by_the_two_level_method() {
    (200..206).for_each(|seed| conditions_hold(seed, 0.25, 0));
}
