//! The gridded simulator against the definition, closed forms and the direct quadrature.

use ndarray::Array2;
use planish_numerics::statistics;
use planish_simulate::{
    SimulationPlan, SimulationSettings, direct, frames::frames, gridded, simulate,
};
use planish_testkit::maps::{largest_difference, largest_magnitude};
use planish_types::{Axis, Grid, PARTS_TOLERANCE, Surface, Tif, Trajectory};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

const PEAK: f64 = 8.0;
const SIGMA: f64 = 0.8;

fn axis(start: f64, step: f64, n: usize) -> Axis {
    Axis::new(start, step, n).unwrap()
}

fn grid(start: [f64; 2], step: [f64; 2], n: [usize; 2]) -> Grid {
    Grid { x: axis(start[0], step[0], n[0]), y: axis(start[1], step[1], n[1]) }
}

fn tif_from(grid: Grid, f: impl Fn(f64, f64) -> f64) -> Tif {
    let rate = Array2::from_shape_fn(grid.shape(), |(r, c)| {
        f(grid.x.coordinate_mm(c), grid.y.coordinate_mm(r))
    });
    Tif::new(grid, rate).unwrap()
}

/// Makes a Gaussian TIF of [`PEAK`] and [`SIGMA`] on samples of `step` mm, out to 6 sigma: 1.5e-8 of the peak is cut.
fn gaussian(step: f64) -> Tif {
    let n = (6.0 * SIGMA / step).ceil() as usize;
    let a = axis(-(n as f64) * step, step, 2 * n + 1);
    tif_from(Grid { x: a, y: a }, |x, y| PEAK * (-(x * x + y * y) / (2.0 * SIGMA * SIGMA)).exp())
}

/// Makes an asymmetric, off-centre TIF with a border of up to a third of the peak and a deterministic roughness:
/// nothing a smooth approximation could represent.
fn rough_tif(step: [f64; 2]) -> Tif {
    let g = grid([-1.3, -0.9], step, [23, 17]);
    tif_from(g, |x, y| 5.0 + 2.0 * x - y + (37.0 * x).sin() * (29.0 * y).cos())
}

/// Makes a motion that stands at each position for the given time.
fn resting(positions: &[[f64; 2]], seconds: &[f64]) -> Trajectory {
    let mut breaks = vec![0.0];
    for s in seconds {
        breaks.push(breaks[breaks.len() - 1] + s);
    }
    let c = positions.iter().map(|p| [[p[0], 0.0, 0.0, 0.0], [p[1], 0.0, 0.0, 0.0]]).collect();
    let n = positions.len();
    Trajectory::new(breaks, c, vec![true; n], (0..n).map(Some).collect()).unwrap()
}

/// Makes a straight motion from `a` to `b` at constant velocity.
fn pass(a: [f64; 2], b: [f64; 2], seconds: f64) -> Trajectory {
    let c = [0, 1].map(|k| [a[k], (b[k] - a[k]) / seconds, 0.0, 0.0]);
    Trajectory::new(vec![0.0, seconds], vec![c], vec![true], vec![Some(0)]).unwrap()
}

fn gridded(t: &Trajectory, tif: &Tif, g: &Grid) -> Array2<f64> {
    gridded::removal_nm(t, tif, g).unwrap().0
}

fn by_definition(positions: &[[f64; 2]], seconds: &[f64], tif: &Tif, g: &Grid) -> Array2<f64> {
    Array2::from_shape_fn(g.shape(), |(r, c)| {
        positions
            .iter()
            .zip(seconds)
            .map(|(p, s)| s * tif.rate_at(g.x.coordinate_mm(c) - p[0], g.y.coordinate_mm(r) - p[1]))
            .sum()
    })
}

fn largest(a: &Array2<f64>, b: &Array2<f64>) -> f64 {
    largest_difference(a, b)
}

/// Returns positions inside the map, on pixel centres, on the border, outside within reach of the tool, and out of
/// reach; and the seconds at each.
fn positions() -> (Vec<[f64; 2]>, Vec<f64>) {
    let mut p =
        vec![[0.0, 0.0], [3.0, 2.0], [-1.05, 4.03], [8.3, -0.91], [50.0, 1.0], [4.0, -70.0]];
    // A deterministic scatter (golden ratio) over the map and a TIF's width around it.
    p.extend((0..60).map(|i| {
        let u = (f64::from(i) * 0.618_034) % 1.0;
        [-2.0 + 11.0 * u, -2.0 + 8.0 * f64::from(i) / 60.0]
    }));
    let seconds = (0..p.len()).map(|i| 0.1 + 0.01 * i as f64).collect();
    (p, seconds)
}

#[test]
fn a_resting_tool_leaves_its_own_image_unflipped() {
    // The argument of R is (pixel - tool): an L in the TIF is an L in the removal.
    let tif = rough_tif([0.1, 0.1]);
    let g = grid([0.0, 0.0], [0.1, 0.1], [60, 50]);
    let removal = gridded(&resting(&[[3.0, 2.0]], &[2.0]), &tif, &g);
    for (j, i) in [(0, 0), (3, 20), (16, 5), (16, 22)] {
        // Tool on a pixel: sample (j, i) with the offset (-1.3 + 0.1 i, -0.9 + 0.1 j).
        let (r, c) = (20 - 9 + j, 30 - 13 + i);
        let expected = 2.0 * tif.rate_nm_per_s()[[j, i]];
        // Below: rounding of an FFT over removals of some 20 nm.
        assert!((removal[[r, c]] - expected).abs() < 1e-12, "{} {expected}", removal[[r, c]]);
    }
    assert!(removal[[10, 30]].abs() < 1e-12 && removal[[28, 30]].abs() < 1e-12);
}

#[test]
fn exact_for_any_tif_on_the_pixels_of_the_map() {
    for step in [[0.1, 0.1], [0.13, 0.07]] {
        let tif = rough_tif(step);
        let g = grid([-0.4, 0.3], step, [71, 53]);
        let (p, s) = positions();
        let error = largest(&gridded(&resting(&p, &s), &tif, &g), &by_definition(&p, &s, &tif, &g));
        // Removals up to about 100 nm through an FFT: 1e-12 is a few hundred roundings.
        assert!(error < 1e-11, "step {step:?}: {error} nm");
    }
}

#[test]
fn exact_for_any_tif_whose_pitch_divides_that_of_the_map() {
    for (step, parts) in [([0.1, 0.1], [2.0, 2.0]), ([0.13, 0.07], [1.0, 3.0])] {
        let tif = rough_tif(step);
        let g = grid([-0.4, 0.3], [0, 1].map(|a| step[a] * parts[a]), [41, 33]);
        let (p, s) = positions();
        let (removal, numerics) = gridded::removal_nm(&resting(&p, &s), &tif, &g).unwrap();
        let error = largest(&removal, &by_definition(&p, &s, &tif, &g));
        // Rounding of an FFT over removals of some ten nm, by sums of some hundred terms.
        assert!(error < 1e-11, "step {step:?}: {error} nm");
        assert_eq!(numerics.subdivision, parts.map(|n| n as usize));
        assert_eq!(numerics.tif_interpolation_error, 0.0);
    }
}

#[test]
fn a_tif_on_other_pixels_is_accurate_to_what_is_reported_and_ends_where_it_ends() {
    // Smooth, but ending with a step of 14 % of the peak.
    let shape = |x: f64, y: f64| PEAK * (-(x * x + 1.3 * y * y) / (2.0 * SIGMA * SIGMA)).exp();
    for (tif_step, map_step) in [(0.11, 0.1), (0.05, 0.17), (0.23, 0.1)] {
        let n = (1.6 / tif_step) as usize;
        let a = axis(-(n as f64) * tif_step, tif_step, 2 * n + 1);
        let tif = tif_from(Grid { x: a, y: a }, shape);
        let g = grid([-0.4, 0.3], [map_step; 2], [51, 43]);
        let (p, s) = positions();
        let (removal, numerics) = gridded::removal_nm(&resting(&p, &s), &tif, &g).unwrap();
        let expected = by_definition(&p, &s, &tif, &g);
        let seconds: f64 = s.iter().sum();
        // Every second may contribute the reported interpolation error of the TIF, at the most.
        // (2x: it is sampled in the middle of the cells.)
        let bound = 2.0 * numerics.tif_interpolation_error * PEAK * seconds;
        let error = largest(&removal, &expected);
        assert!(error <= bound, "{tif_step} on {map_step}: {error} nm above {bound} nm");
        // A spill of the border would be 1 nm/s.
        assert!(numerics.tif_interpolation_error <= PARTS_TOLERANCE, "{numerics:?}");
    }
}

/// Returns `erf` by the Maclaurin series; |x| < 5.
fn erf(x: f64) -> f64 {
    let mut term = x;
    let mut sum = x;
    for n in 1..200 {
        let n = f64::from(n);
        term *= -x * x / n;
        sum += term / (2.0 * n + 1.0);
    }
    sum * 2.0 / std::f64::consts::PI.sqrt()
}

#[test]
fn a_finite_pass_of_a_gaussian_follows_the_error_function() {
    // A sigma sqrt(pi/2) / v exp(-y^2/2 sigma^2) [erf((x-a)/(sigma sqrt 2)) - erf((x-b)/..)]
    let (a, b, y0, seconds) = (1.0, 4.0, 1.37, 2.0);
    let closed_form = |x: f64, y: f64| {
        let v = (b - a) / seconds;
        let e = |edge: f64| erf((x - edge) / (SIGMA * 2.0_f64.sqrt()));
        PEAK * SIGMA * (std::f64::consts::FRAC_PI_2).sqrt() / v
            * (-(y - y0) * (y - y0) / (2.0 * SIGMA * SIGMA)).exp()
            * (e(a) - e(b))
    };
    let error = |step: f64| {
        let g = grid([0.0, 0.0], [step; 2], [(5.0 / step) as usize, (3.0 / step) as usize]);
        let removal = gridded(&pass([a, y0], [b, y0], seconds), &gaussian(step), &g);
        let error = |((r, c), v): ((usize, usize), &f64)| {
            v - closed_form(g.x.coordinate_mm(c), g.y.coordinate_mm(r))
        };
        largest_magnitude(removal.indexed_iter().map(error))
    };
    // The quadrature is exact; Keys' interpolation of the samples has order 3 in the pixel.
    let (coarse, fine) = (error(0.1), error(0.05));
    assert!((coarse / fine).log2() > 2.7, "order {}", (coarse / fine).log2());
    // 0.05 mm = sigma / 16, removal up to 10 nm: the reference mirror has sigma / 18.
    assert!(fine < 1e-3, "{fine} nm");
}

#[test]
fn the_removed_volume_is_the_vrr_times_the_time_for_any_motion_inside() {
    let tif = gaussian(0.1);
    let g = grid([0.0, 0.0], [0.1; 2], [140, 130]);
    // A curved, accelerated motion that stays more than the TIF's half size inside.
    let c = [[6.0, 1.0, -0.3, 0.02], [6.5, -1.2, 0.1, 0.05]];
    let t = Trajectory::new(vec![0.0, 2.5], vec![c], vec![true], vec![Some(0)]).unwrap();
    let volume = gridded(&t, &tif, &g).sum() * g.pixel_mm2();
    let expected = tif.vrr_nm_mm2_per_s() * 2.5;
    // Keys' weights sum to one, so the sum over the pixels is exact but for the 1.5e-8 of the peak
    // at which the samples end.
    assert!((volume / expected - 1.0).abs() < 1e-9, "{volume} {expected}");
}

/// Makes cubic motions in all directions and rests, with lifts, all within `half` mm of the origin.
fn random_motion(rng: &mut ChaCha8Rng, half: [f64; 2]) -> Trajectory {
    let n = rng.random_range(1..40);
    let (mut breaks, mut c, mut on) = (vec![rng.random_range(-5.0..5.0)], vec![], vec![]);
    for _ in 0..n {
        let seconds = 10.0_f64.powf(rng.random_range(-4.0..1.0));
        breaks.push(breaks[breaks.len() - 1] + seconds);
        on.push(rng.random_bool(0.8));
        let rests = rng.random_bool(0.2);
        // In Bezier's form, whose control points hold the cubic between them.
        let mut cubic = |half: f64| {
            let mut point = || rng.random_range(-half..half);
            let [p, q, r, s] = [point(), point(), point(), point()];
            let powers = [p, 3.0 * (q - p), 3.0 * (p - 2.0 * q + r), s - p + 3.0 * (q - r)];
            let scale = [1.0, seconds, seconds.powi(2), seconds.powi(3)];
            std::array::from_fn(|k| if rests && k > 0 { 0.0 } else { powers[k] / scale[k] })
        };
        c.push([cubic(half[0]), cubic(half[1])]);
    }
    Trajectory::new(breaks, c, on, (0..n).map(Some).collect()).unwrap()
}

#[test]
fn no_motion_inside_the_map_gains_or_loses_material() {
    // Keys' weights of a shift sum to one, so the shifted TIF has the sum of its samples on the pixels,
    // whatever the shift; what the interpolation spills over the border, and what is made up beyond it, is
    // zero where the three outer rings of the TIF are. The weights of the quadrature sum to the time. So no
    // tool is too rough, off centre or coarse for this: the samples here are noise.
    let mut rng = ChaCha8Rng::seed_from_u64(20);
    let mut served = 0;
    for case in 0..60 {
        let step = [0, 1].map(|_| rng.random_range(0.05..0.5));
        let tool = [0, 1].map(|_| rng.random_range(8..30));
        let from = [0, 1].map(|k| -step[k] * rng.random_range(3..tool[k] - 3) as f64);
        let (ny, nx) = (tool[1], tool[0]);
        let rate = Array2::from_shape_fn((ny, nx), |(r, c)| {
            let ring = r.min(c).min(ny - 1 - r).min(nx - 1 - c);
            if ring < 3 { 0.0 } else { rng.random_range(0.0..10.0) }
        });
        let tif = Tif::new(grid(from, step, tool), rate).unwrap();
        // The tool stays within the pixels from everywhere within these of the origin.
        let (reach, beyond) = ([0, 1].map(|_| rng.random_range(5..60)), 40);
        let (start, n) = (
            [0, 1].map(|k| -step[k] * (reach[k] + beyond) as f64),
            [0, 1].map(|k| 2 * (reach[k] + beyond) + 1),
        );
        let t = random_motion(&mut rng, [0, 1].map(|k| step[k] * reach[k] as f64));
        let g = grid(start, step, n);
        let on_s: f64 = t.segments().filter(|s| s.tool_on).map(|s| s.duration_s).sum();
        let volume = gridded(&t, &tif, &g).sum() * g.pixel_mm2();
        let expected = tif.vrr_nm_mm2_per_s() * on_s;
        // A sum of up to 4e4 pixels, whose errors an FFT makes of some roundings of the largest.
        assert!((volume - expected).abs() <= 1e-12 * expected, "{case}: {volume} {expected}");
        served += usize::from(on_s > 0.0);
    }
    assert!(served > 50, "{served} cases have the tool on");
}

#[test]
fn parallel_lines_leave_the_ripple_of_the_poisson_sum() {
    // Lines of pitch d at feed v: mean V/(v d), ripple PV = 4 mean exp(-2 pi^2 sigma^2 / d^2).
    let (d, v) = (2.0 * SIGMA, 5.0);
    let step = SIGMA / 20.0;
    let tif = gaussian(step);
    let half = 30.0 * SIGMA;
    let mut breaks = vec![0.0];
    let mut c = Vec::new();
    for i in -12..=12 {
        c.push([[-half, v, 0.0, 0.0], [f64::from(i) * d, 0.0, 0.0, 0.0]]);
        breaks.push(breaks[breaks.len() - 1] + 2.0 * half / v);
    }
    let n = c.len();
    let t = Trajectory::new(breaks, c, vec![true; n], vec![Some(0); n]).unwrap();
    let g = grid([0.0, -d], [step; 2], [2, (2.0 * d / step) as usize + 1]);
    let removal = gridded(&t, &tif, &g);
    let s = statistics::statistics(removal.column(0).insert_axis(ndarray::Axis(1))).unwrap();
    let gaussian_volume = 2.0 * std::f64::consts::PI * PEAK * SIGMA * SIGMA;
    let mean = gaussian_volume / (v * d);
    let pv = 4.0 * mean * (-2.0 * (std::f64::consts::PI * SIGMA / d).powi(2)).exp();
    // First harmonic only: the next one is exp(-6 pi^2 / 4 * ...) < 1e-6 of it.
    assert!((s.pv / pv - 1.0).abs() < 1e-3, "{} {pv}", s.pv);
    assert!((removal.mean().unwrap() / mean - 1.0).abs() < 2e-3);
}

/// Makes a wavy path over the map.
fn wavy() -> Trajectory {
    let mut breaks = vec![0.0];
    let mut c = Vec::new();
    for i in 0..6 {
        let (x, s) = (f64::from(i), if i % 2 == 0 { 1.0 } else { -1.0 });
        c.push([[x, 2.0, 0.5, -1.0], [2.0, 3.0 * s, -6.0 * s, 0.7]]);
        breaks.push(breaks[breaks.len() - 1] + 0.7);
    }
    let n = c.len();
    Trajectory::new(breaks, c, vec![true; n], vec![Some(0); n]).unwrap()
}

#[test]
fn the_direct_quadrature_converges_to_the_gridded_result() {
    let g = grid([0.0, 0.0], [0.1; 2], [70, 45]);
    let t = wavy();
    let errors = |tif: &Tif| {
        let exact = gridded(&t, tif, &g);
        [8, 16, 32].map(|m| largest(&direct::removal_nm(&t, tif, &g, m).unwrap().0, &exact))
    };
    // A TIF that ends smoothly: the midpoint rule has order 2.
    let [_, b, c] = errors(&gaussian(0.1));
    let order = (b / c).log2();
    // The order is 2; at 16 and 32 steps the next order takes a part of it.
    assert!((1.9..2.1).contains(&order), "order {order}");
    // A TIF with a border: order 1, and still towards the gridded result.
    let [a, _, c] = errors(&rough_tif([0.1, 0.1]));
    let order = (a / c).log2() / 2.0;
    // The phase of the steps against the border scatters the order about 1.
    assert!((0.6..1.7).contains(&order), "order {order}");
}

#[test]
fn a_lifted_tool_and_time_reversal() {
    let tif = rough_tif([0.1, 0.1]);
    let g = grid([0.0, 0.0], [0.1; 2], [40, 30]);
    let t = pass([-1.0, 0.4], [4.5, 2.7], 3.0);
    let back = pass([4.5, 2.7], [-1.0, 0.4], 3.0);
    // Below: rounding of an FFT.
    assert!(largest(&gridded(&t, &tif, &g), &gridded(&back, &tif, &g)) < 1e-12);
    let lifted =
        Trajectory::new(vec![0.0, 3.0], t.coefficient_mm().to_vec(), vec![false], vec![None])
            .unwrap();
    assert!(gridded(&lifted, &tif, &g).iter().all(|v| v.abs() < 1e-15));
}

#[test]
fn the_residual_is_desired_minus_removal() {
    let g = grid([0.0, 0.0], [0.1; 2], [40, 30]);
    let desired = Surface::new(g, Array2::from_elem(g.shape(), 7.0)).unwrap();
    let (tif, t) = (gaussian(0.1), pass([0.0, 1.0], [4.0, 1.0], 1.0));
    let p = simulate(&t, &tif, &desired, SimulationSettings::Gridded).unwrap();
    let sum = p.removal.removal_nm() + p.removal.residual().height_nm();
    // Rounding of 7 nm.
    assert!(sum.iter().all(|v| (v - 7.0).abs() < 1e-14));
    assert!(p.removal.removal_nm()[[10, 20]] > 1.0);
    assert!(simulate(&t, &tif, &desired, SimulationSettings::Direct { steps: 0 }).is_err());
}

/// Makes cubic motions in all directions over and beyond the map, with rests between them, on a pixel, on a line of
/// pixels and anywhere, and a lift.
fn everywhere() -> Trajectory {
    let (mut breaks, mut c, mut on) = (vec![0.0], vec![], vec![]);
    let mut last: f64 = 0.0;
    let mut push = |seconds: f64, motion: [[f64; 4]; 2], tool_on: bool| {
        last += seconds;
        breaks.push(last);
        c.push(motion);
        on.push(tool_on);
    };
    let rest = |x: f64, y: f64| [[x, 0.0, 0.0, 0.0], [y, 0.0, 0.0, 0.0]];
    for i in 0..24 {
        let i = f64::from(i);
        let angle = 2.4 * i;
        let (vx, vy) = (9.0 * angle.cos(), 7.0 * angle.sin());
        let from = [12.0 + 11.0 * (1.7 * i).sin(), 8.0 + 8.0 * (2.3 * i).cos()];
        push(0.8, [[from[0], vx, 1.0, -0.8], [from[1], vy, -2.0, 1.1]], i != 7.0);
        push(0.1, rest(from[0], from[1]), true);
    }
    push(0.3, rest(3.0, 2.0), true);
    // along a line of pixels, from rest, and back
    push(1.0, [[2.0, 0.0, 9.0, -3.0], [3.0, 0.0, 0.0, 0.0]], true);
    push(1.0, [[8.0, 0.0, -9.0, 3.0], [3.0, 0.0, 0.0, 0.0]], true);
    push(0.5, rest(-400.0, 2.0), true);
    push(1.0, [[300.0, 5.0, 0.0, 0.0], [2.0, 0.0, 0.0, 0.0]], true);
    let n = c.len();
    Trajectory::new(breaks, c, on, (0..n).map(Some).collect()).unwrap()
}

/// Compares the gridded result with the limit of the direct quadrature, for a smooth TIF that ends with a step below
/// 1e-8 of its peak.
#[test]
fn the_gridded_result_is_the_limit_of_the_direct_quadrature_in_all_directions() {
    let g = grid([0.0, 0.0], [0.2; 2], [121, 83]);
    let t = everywhere();
    let tif = gaussian(0.2);
    let exact = gridded(&t, &tif, &g);
    let [a, b, c] = [16, 32, 64].map(|m| direct::removal_nm(&t, &tif, &g, m).unwrap().0);
    let order = (largest(&a, &exact) / largest(&b, &exact)).log2();
    // The order is 2, as above.
    assert!((1.9..2.1).contains(&order), "order {order}");
    // Without its term of the order 2 the kinks of R'' are left, at most of the order 3.
    let limit = |coarse: &Array2<f64>, fine: &Array2<f64>| (4.0 * fine - coarse) / 3.0;
    let errors = [limit(&a, &b), limit(&b, &c)].map(|l| largest(&l, &exact));
    // The goal: 1e-3 nm.
    assert!(errors[1] < 5e-4, "{errors:?} nm");
    // The order 3 is a factor of 8; half of it is asked for.
    assert!(errors[1] < errors[0] / 4.0, "{errors:?}");
    assert!(exact.iter().any(|v| *v > 1.0));
}

/// Returns the same motion with every segment divided in two.
fn halved(t: &Trajectory) -> Trajectory {
    let (mut breaks, mut c, mut on) = (vec![t.break_time_s()[0]], vec![], vec![]);
    for s in t.segments() {
        let d = 0.5 * s.duration_s;
        let later = |p: &[f64; 4]| {
            [
                p[0] + d * (p[1] + d * (p[2] + d * p[3])),
                p[1] + d * (2.0 * p[2] + 3.0 * d * p[3]),
                p[2] + 3.0 * d * p[3],
                p[3],
            ]
        };
        breaks.extend([s.start_s + d, s.start_s + s.duration_s]);
        c.extend([*s.coefficient_mm, [later(&s.coefficient_mm[0]), later(&s.coefficient_mm[1])]]);
        on.extend([s.tool_on; 2]);
    }
    let n = c.len();
    Trajectory::new(breaks, c, on, (0..n).map(Some).collect()).unwrap()
}

#[test]
fn the_remainder_of_the_quadrature_is_far_below_the_goal() {
    let g = grid([0.0, 0.0], [0.2; 2], [121, 83]);
    // The goal is 1e-3 nm. What is left are the degrees above 5 of an accelerated motion in a cell,
    // which count where neighbouring samples differ as much as in the second TIF.
    for (tif, tolerance) in [(gaussian(0.2), 1e-7), (border_tif(), 1e-4)] {
        let coarse = everywhere();
        let fine = halved(&halved(&coarse));
        let error = largest(&gridded(&coarse, &tif, &g), &gridded(&fine, &tif, &g));
        assert!(error < tolerance, "{error} nm");
    }
}

/// Makes a TIF that ends with steps of a third of its peak.
fn border_tif() -> Tif {
    tif_from(grid([-2.2, -1.6], [0.2; 2], [23, 17]), |x, y| {
        5.0 + x - 0.5 * y + (7.0 * x).sin() * (9.0 * y).cos()
    })
}

#[test]
fn tifs_with_borders_agree_with_a_fine_direct_quadrature() {
    // Even, larger than the map on one axis, and both.
    for (n, map) in [([22, 16], [61, 47]), ([41, 30], [30, 60]), ([40, 30], [17, 12])] {
        let h = [0.1, 0.1];
        let tif = tif_from(grid([-1.3, -0.9], h, n), |x, y| {
            5.0 + 0.5 * x - 0.4 * y + (7.0 * x).sin() * (9.0 * y).cos()
        });
        let g = grid([0.0, 0.0], h, map);
        let t = pass([-2.0, 0.413], [5.5, 3.77], 3.0);
        let steps = 120_000;
        let expected = |(r, c)| {
            direct::removal_at_nm(&t, &tif, g.x.coordinate_mm(c), g.y.coordinate_mm(r), steps)
        };
        let found = gridded(&t, &tif, &g);
        for (r, c) in [(0, 0), (3, 5), (map[1] / 2, map[0] / 2), (map[1] - 1, map[0] - 1)] {
            // The border costs the midpoint rule at most two steps of 25 us at 8 nm/s.
            let error = (found[[r, c]] - expected((r, c))).abs();
            assert!(error < 4e-4, "{n:?} on {map:?}, {r} {c}: {error} nm");
        }
    }
}

#[test]
fn exact_on_a_map_of_several_tiles() {
    // 500 x 330 pixels and a TIF of 23 x 17: bands and strips whose parts differ in size.
    let h = [0.1, 0.1];
    let (tif, g) = (rough_tif(h), grid([-0.4, 0.3], h, [500, 330]));
    let p: Vec<[f64; 2]> = (0..300)
        .map(|i| [49.0 * ((f64::from(i) * 0.618_034) % 1.0), 0.5 + 32.0 * f64::from(i) / 300.0])
        .chain([[20.0, 11.3], [24.6, 16.7], [24.55, 16.8]])
        .collect();
    let s: Vec<f64> = (0..p.len()).map(|i| 0.1 + 0.001 * i as f64).collect();
    let t = resting(&p, &s);
    let error = largest(&gridded(&t, &tif, &g), &by_definition(&p, &s, &tif, &g));
    // Removals of some nm through an FFT: a few hundred roundings.
    assert!(error < 1e-11, "{error} nm");
    // Every point is counted once, although several tiles use it.
    let count = gridded::removal_nm(&t, &tif, &g).unwrap().1.quadrature_points;
    assert_eq!(count, p.len());
}

#[test]
fn the_same_bytes_on_one_and_two_threads() {
    let tif = border_tif();
    // One tile, and several.
    for n in [[31, 23], [500, 330]] {
        let g = grid([0.0, 0.0], [0.2; 2], n);
        let desired = Surface::new(g, Array2::zeros(g.shape())).unwrap();
        let t = everywhere();
        let on = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| {
                let plan = SimulationPlan::new(&tif, &g, SimulationSettings::Gridded).unwrap();
                let (planned, numerics) = plan.removal_nm(&t).unwrap();
                assert_eq!(plan.removal_nm(&t).unwrap().0, planned);
                let once = simulate(&t, &tif, &desired, SimulationSettings::Gridded).unwrap();
                assert_eq!(once.removal.removal_nm(), &planned);
                let frames = frames(&t, &tif, &desired, SimulationSettings::Gridded, 3).unwrap();
                (planned, numerics, frames.removal_nm)
            })
        };
        let (one, two) = (on(1), on(2));
        let bits = |a: &Array2<f64>| a.iter().map(|v| v.to_bits()).collect::<Vec<_>>();
        assert_eq!(bits(&one.0), bits(&two.0));
        assert_eq!(one.1, two.1);
        assert!(one.2.iter().zip(&two.2).all(|(a, b)| a.to_bits() == b.to_bits()));
        assert!(one.0.iter().any(|v| *v > 1.0));
    }
}

/// Tests that a rate factor acts as a time: the tool at 0.4 of its rate for 5 s removes what it removes at its rate in
/// 2 s. It holds at rest and in motion, by both methods and in the frames.
#[test]
fn a_rate_factor_is_time() {
    let tif = rough_tif([0.11, 0.13]);
    let g = grid([-3.0, -3.0], [0.11, 0.13], [50, 45]);
    let at = [[0.3, -0.2], [1.0, 0.4]];
    let whole = resting(&at, &[2.0, 1.0]);
    let slow = resting(&at, &[5.0, 1.0]).with_rate_factor(vec![0.4, 1.0]).unwrap();
    let e = largest_difference(&gridded(&whole, &tif, &g), &gridded(&slow, &tif, &g));
    // Below: rounding of transforms of removals of some ten nm.
    assert!(e < 1e-10, "{e}");
    // In motion, with the border of the TIF: one half of the rate is one half of the removal.
    let run = pass([-2.0, -1.0], [2.0, 1.5], 3.0);
    let half = run.clone().with_rate_factor(vec![0.5]).unwrap();
    let e = largest_difference(&(gridded(&run, &tif, &g) * 0.5), &gridded(&half, &tif, &g));
    assert!(e < 1e-12, "{e}");
    let direct = |t: &Trajectory| direct::removal_nm(t, &tif, &g, 16).unwrap().0;
    let e = largest_difference(&(direct(&run) * 0.5), &direct(&half));
    assert!(e < 1e-12, "{e}");
    let surface = Surface::new(g, Array2::ones(g.shape())).unwrap();
    let found = frames(&half, &tif, &surface, SimulationSettings::Gridded, 3).unwrap();
    let last = found.removal_nm.index_axis(ndarray::Axis(0), 2).to_owned();
    // The frames cut the motion elsewhere than the lattice does: 1e-6 of the removal.
    let e = largest_difference(&last, &gridded(&half, &tif, &g));
    assert!(e < 1e-4 && largest_magnitude(last.iter().copied()) > 1.0, "{e}");
}
