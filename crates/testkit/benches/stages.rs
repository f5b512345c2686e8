//! Speed of the stages on the fixture `flat-92x16` (985 x 168 px, TIF 107 x 107 px), raster of
//! 1 mm pitch and step: `just bench`. Threads: RAYON_NUM_THREADS, or all.

use std::{fs, sync::LazyLock};

use divan::{Bencher, black_box};
use nalgebra::DMatrix;
use ndarray::Array2;
use planish_dwell::{
    bounded_least_squares::{self, Bound},
    columns::Columns,
    lucy_richardson::{self, Unknowns},
    problem::Problem,
};
use planish_fixture::{Fixture, Recipe, make};
use planish_numerics::{
    fft::{convolution::Convolution, plan::Planned},
    linear::skyline::Skyline,
    vectors::Lanes,
};
use planish_schedule::{
    pvt::{self, Mode},
    trig_spline,
};
use planish_simulate::{SimulationPlan as Plan, SimulationSettings as Settings, simulate};
use planish_testkit::{case_generator, ion_beam, machine, workspace};
use planish_toolpath::{MazeSettings, RasterSettings, Tree, maze, raster};
use planish_types::{Axis, DwellTime, Grid, Surface, Tif, ToolPath, Trajectory};
use planish_verify::{VerifySettings, verify};
use rand::RngExt;

/// Allocator of the programs.
#[global_allocator]
static ALLOCATOR: planish_handoff::Allocator = planish_handoff::Allocator;

struct Case {
    surface: Surface,
    tif: Tif,
    path: ToolPath,
    dwell: DwellTime,
    trajectory: Trajectory,
}

fn solver() -> bounded_least_squares::BoundedSettings {
    bounded_least_squares::BoundedSettings { min_dwell: Bound::Seconds(0.1), ..Default::default() }
}

fn raster_settings(pitch_mm: f64) -> RasterSettings {
    RasterSettings::new(pitch_mm, pitch_mm, 5.0)
}

static CASE: LazyLock<Case> = LazyLock::new(|| {
    let recipe = fs::read_to_string(workspace().join("fixtures/flat-92x16.json")).unwrap();
    let recipe: Recipe = serde_json::from_str(&recipe).unwrap();
    let fixture = make(&recipe).unwrap();
    let path = raster(&fixture.surface, &raster_settings(1.0)).unwrap();
    let dwell =
        bounded_least_squares::solve(&fixture.surface, &fixture.tif, &path, None, &solver())
            .unwrap()
            .dwell;
    let how = pvt::PvtSettings::new(Mode::Smooth);
    let trajectory = pvt::schedule(&path, &dwell, &ion_beam(), &how).unwrap().trajectory;
    Case { surface: fixture.surface, tif: fixture.tif, path, dwell, trajectory }
});

fn main() {
    LazyLock::force(&CASE);
    divan::main();
}

#[divan::bench(sample_count = 5)]
fn dwell_bounded_least_squares() {
    let c = &*CASE;
    black_box(bounded_least_squares::solve(&c.surface, &c.tif, &c.path, None, &solver()).unwrap());
}

/// A raster on the same mirror with 1, 4 and 16 times the points and the same smallest time per area; above
/// 6000 points by the two-level method.
#[divan::bench(args = [1.0, 0.5, 0.25], sample_count = 1)]
fn dwell_bounded_least_squares_by_pitch(bencher: Bencher, pitch_mm: f64) {
    let c = &*CASE;
    let path = raster(&c.surface, &raster_settings(pitch_mm)).unwrap();
    let min_dwell = Bound::Seconds(0.1 * pitch_mm * pitch_mm);
    let settings = bounded_least_squares::BoundedSettings { min_dwell, ..solver() };
    bencher.bench_local(|| {
        black_box(bounded_least_squares::solve(&c.surface, &c.tif, &path, None, &settings).unwrap())
    });
}

/// A map of `side` x `side` pixels at 0.1 mm with waves of 20 and 33 mm, under the same TIF at that
/// pitch, and a raster of `pitch_mm`.
fn large_map(side: usize, pitch_mm: f64) -> (Surface, Tif, ToolPath) {
    let axis = Axis::new(0.0, 0.1, side).unwrap();
    let height = Array2::from_shape_fn((side, side), |(r, c)| {
        let (x, y) = (0.1 * c as f64, 0.1 * r as f64);
        100.0 + 30.0 * (0.31 * x).sin() * (0.19 * y).cos() + 10.0 * (0.19 * x + 0.31 * y).sin()
    });
    let surface = Surface::new(Grid { x: axis, y: axis }, height).unwrap();
    let own = Axis::new(-5.3, 0.1, 107).unwrap();
    let tif = Tif::new(Grid { x: own, y: own }, CASE.tif.rate_nm_per_s().clone()).unwrap();
    let path = raster(&surface, &raster_settings(pitch_mm)).unwrap();
    (surface, tif, path)
}

/// 20 steps, and 12 accelerated ones: 1641 x 1641 pixels in squares of 4 x 4, then to the path.
#[divan::bench(consts = [false, true], sample_count = 3)]
fn dwell_lucy_richardson_large<const ACCELERATED: bool>(bencher: Bencher) {
    let (surface, tif, path) = large_map(1641, 1.0);
    let problem = Problem {
        desired: &surface,
        tif: &tif,
        path: &path,
        weight: None,
        columns: Columns::Segment,
        min_dwell: Bound::Seconds(0.0),
    };
    let settings = lucy_richardson::LucyRichardsonSettings {
        unknowns: Unknowns::Map,
        total_variation: 0.0,
        min_decrease: 0.0,
        max_iterations: if ACCELERATED { 12 } else { 20 },
        accelerated: ACCELERATED,
        ..Default::default()
    };
    bencher.bench_local(|| black_box(lucy_richardson::solve(&problem, &settings).unwrap()));
}

/// 1641 x 1641 pixels, 3.1e4 points: by the two-level method, on 240 areas of the TIF.
#[divan::bench(sample_count = 1)]
fn dwell_large_map(bencher: Bencher) {
    let (surface, tif, path) = large_map(1641, 1.0);
    bencher.bench_local(|| {
        black_box(bounded_least_squares::solve(&surface, &tif, &path, None, &solver()).unwrap())
    });
}

#[divan::bench(args = [Mode::Smooth, Mode::Monotone], sample_count = 20)]
fn schedule_pvt(mode: Mode) {
    let c = &*CASE;
    let how = pvt::PvtSettings::new(mode);
    black_box(pvt::schedule(&c.path, &c.dwell, &ion_beam(), &how).unwrap());
}

#[divan::bench(sample_count = 20)]
fn simulate_gridded() {
    let c = &*CASE;
    black_box(simulate(&c.trajectory, &c.tif, &c.surface, Settings::Gridded).unwrap());
}

/// Simulation alone: the plan of the TIF and the map is made before.
#[divan::bench(sample_count = 20)]
fn simulate_planned(bencher: Bencher) {
    let c = &*CASE;
    let plan = Plan::new(&c.tif, c.surface.grid(), Settings::Gridded).unwrap();
    bencher.bench_local(|| black_box(plan.removal_nm(&c.trajectory).unwrap()));
}

/// 8434 resting points on lines of 136, 0.75 mm apart.
#[divan::bench(sample_count = 20)]
fn simulate_resting(bencher: Bencher) {
    let c = &*CASE;
    let at = |i: usize| [0.75 * (i % 136) as f64 - 5.0, 0.42 * (i / 136) as f64 - 5.0];
    let rest = |i: usize| at(i).map(|p| [p, 0.0, 0.0, 0.0]);
    let n = 8434;
    let breaks = (0..=n).map(|i| 0.2 * i as f64).collect();
    let trajectory =
        Trajectory::new(breaks, (0..n).map(rest).collect(), vec![true; n], vec![Some(0); n])
            .unwrap();
    let plan = Plan::new(&c.tif, c.surface.grid(), Settings::Gridded).unwrap();
    bencher.bench_local(|| black_box(plan.removal_nm(&trajectory).unwrap()));
}

/// A map of dwell times on `side` x `side` pixels, convolved with the TIF of 107 x 107 px: one transform
/// and its inverse. A removal without approximation takes at least this time.
#[divan::bench(types = [f64, f32], args = [1641, 4096, 8192], sample_count = 3)]
fn convolution<T: Lanes + Planned>(bencher: Bencher, side: usize) {
    let rate = CASE.tif.rate_nm_per_s();
    let seconds = Array2::<f64>::ones((side + rate.nrows() - 1, side + rate.ncols() - 1));
    let plan = Convolution::<T>::new(rate.view(), seconds.dim());
    bencher.bench_local(|| black_box(plan.valid(seconds.view())));
}

/// A square map of `pixels` by `pixels`, and straight lines of `points` segments over it, with the
/// TIF of 107 x 107 px.
#[divan::bench(args = [(1641, 10_000), (4096, 10_000), (4096, 250_000), (8192, 10_000), (8192, 1_000_000)],
    sample_count = 3)]
fn simulate_large(bencher: Bencher, (pixels, points): (usize, usize)) {
    let tif = &CASE.tif;
    let step_mm = tif.grid().x.step_mm();
    let axis = Axis::new(0.0, step_mm, pixels).unwrap();
    let lines = (points as f64).sqrt() as usize;
    let (size_mm, per_line) = (step_mm * (pixels - 1) as f64, points / lines);
    let segment_mm = size_mm / per_line as f64;
    let (mut breaks, mut coefficients) = (vec![0.0], vec![]);
    for i in 0..lines * per_line {
        let (line, k) = (i / per_line, (i % per_line) as f64);
        let time_s = 0.5 + 0.25 * (0.1 * i as f64).sin();
        let v = segment_mm / time_s;
        let x = if line % 2 == 0 { [k * segment_mm, v] } else { [size_mm - k * segment_mm, -v] };
        let y = size_mm * line as f64 / (lines - 1) as f64;
        coefficients.push([[x[0], x[1], 0.0, 0.0], [y, 0.0, 0.0, 0.0]]);
        breaks.push(breaks[i] + time_s);
    }
    let n = coefficients.len();
    let trajectory =
        Trajectory::new(breaks, coefficients, vec![true; n], vec![Some(0); n]).unwrap();
    let grid = Grid { x: axis, y: axis };
    let plan = Plan::new(tif, &grid, Settings::Gridded).unwrap();
    bencher.bench_local(|| black_box(plan.removal_nm(&trajectory).unwrap()));
}

/// Lines of 1000 points at a distance of 1 mm, to and fro, 0.25 to 0.75 s per point.
fn long_path(segments: usize) -> (ToolPath, DwellTime) {
    let points = (0..=segments)
        .map(|i| {
            let (line, k) = (i / 1000, i % 1000);
            [(if line % 2 == 0 { k } else { 999 - k }) as f64, line as f64]
        })
        .collect();
    let path = ToolPath::through(points, vec![true; segments], vec![0; segments]).unwrap();
    let dwell = (0..segments).map(|i| 0.5 + 0.25 * (0.1 * i as f64).sin()).collect();
    (path, DwellTime::new(dwell).unwrap())
}

/// Numbers of segments of the paths.
const LENGTHS: [usize; 3] = [2678, 62_500, 1_000_000];

#[divan::bench(args = LENGTHS, consts = [false, true], sample_count = 3)]
fn schedule_pvt_long<const MONOTONE: bool>(bencher: Bencher, segments: usize) {
    let (path, dwell) = long_path(segments);
    let mode = if MONOTONE { Mode::Monotone } else { Mode::Smooth };
    let how = pvt::PvtSettings::new(mode);
    bencher.bench_local(|| black_box(pvt::schedule(&path, &dwell, &ion_beam(), &how).unwrap()));
}

/// Lines at a distance of 0.5 mm with a point every 0.4 mm, to and fro, 0.04 to 0.06 s per point. One point
/// in twenty has 0.002 to 0.004 s only: the limits stretch it and some of its neighbours.
fn short_times(segments: usize) -> (ToolPath, DwellTime) {
    let per_line = segments.isqrt();
    let points = (0..=segments)
        .map(|i| {
            let (line, k) = (i / per_line, i % per_line);
            [0.4 * (if line % 2 == 0 { k } else { per_line - 1 - k }) as f64, 0.5 * line as f64]
        })
        .collect();
    let path = ToolPath::through(points, vec![true; segments], vec![0; segments]).unwrap();
    let mut generator = case_generator(1, 0, 0);
    let mut time = || {
        let is_short = generator.random_range(0.0..1.0) < 0.05;
        let part: f64 = generator.random_range(0.0..1.0);
        if is_short { 0.002 + 0.002 * part } else { 0.04 + 0.02 * part }
    };
    let dwell = (0..segments).map(|_| time()).collect();
    (path, DwellTime::new(dwell).unwrap())
}

/// PVT schedule that searches for the shortest times in many places.
#[divan::bench(args = [3000, 50_000], sample_count = 3)]
fn schedule_pvt_stretched(bencher: Bencher, segments: usize) {
    let (path, dwell) = short_times(segments);
    let how = pvt::PvtSettings::new(Mode::Monotone);
    bencher.bench_local(|| black_box(pvt::schedule(&path, &dwell, &ion_beam(), &how).unwrap()));
}

#[divan::bench(args = [2678, 42_848, 685_568], sample_count = 3)]
fn schedule_trig_spline_long(bencher: Bencher, segments: usize) {
    let (path, dwell) = long_path(segments);
    let how = trig_spline::TrigSplineSettings::default();
    bencher.bench_local(|| {
        black_box(trig_spline::schedule(&path, &dwell, &ion_beam(), &how).unwrap())
    });
}

/// A fixture along a path, without a least dwell time.
fn without_floor<'a>(fixture: &'a Fixture, path: &'a ToolPath) -> Problem<'a> {
    Problem {
        desired: &fixture.surface,
        tif: &fixture.tif,
        path,
        weight: None,
        columns: Columns::Segment,
        min_dwell: Bound::Seconds(0.0),
    }
}

/// The set-up of the trigonometric-spline paper: 1641 x 1641 pixels, lines and steps of 0.2 mm, 4000 mm/min and 2000
/// mm/s^2; repair and motion of its 249 900 segments.
#[divan::bench(sample_count = 5, sample_size = 1)]
fn schedule_trig_spline_of_the_source(bencher: Bencher) {
    let recipe = fs::read_to_string(workspace().join("fixtures/disk-100-1641.json")).unwrap();
    let fixture = make(&serde_json::from_str::<Recipe>(&recipe).unwrap()).unwrap();
    let settings = RasterSettings { line_origin_mm: Some(0.0), ..raster_settings(0.2) };
    let path = raster(&fixture.surface, &settings).unwrap();
    let how = lucy_richardson::LucyRichardsonSettings {
        unknowns: Unknowns::Map,
        max_iterations: 60,
        stop_at_max: true,
        ..Default::default()
    };
    let problem = without_floor(&fixture, &path);
    let dwell = lucy_richardson::solve(&problem, &how).unwrap().dwell;
    let limits = machine([4000.0 / 60.0; 2], [2000.0; 2]);
    let how = trig_spline::TrigSplineSettings::default();
    bencher.bench_local(|| black_box(trig_spline::schedule(&path, &dwell, &limits, &how).unwrap()));
}

/// Positions of the real-time interpolator within one block: 10 000 of a usual block, and as many of the
/// worst one. The densities of the worst block are nine orders of magnitude apart, so that Newton's method
/// falls back to bisection.
#[divan::bench(args = ["usual", "worst"], sample_count = 20)]
fn interpolate_10000_ticks(bencher: Bencher, block: &str) {
    let density_s_per_mm = if block == "usual" { [0.03, 0.05] } else { [1e-9, 1.0] };
    let piece = trig_spline::TrigPiece { density_s_per_mm, length_mm: 0.2 };
    bencher.bench_local(|| {
        for k in 0..10_000 {
            let part = f64::from(k) / 10_000.0;
            // Where the worst block begins its density is almost zero.
            let m = if block == "usual" { part } else { part.powi(4) };
            black_box(piece.density_s_per_mm_at(piece.progress(black_box(m))));
        }
    });
}

/// 60 steps of Lucy-Richardson on the map of the part of the trigonometric-spline paper, with `side` x
/// `side` pixels: on the pixels of the small map, on squares of 4 x 4 of the large one.
#[divan::bench(args = [411, 1641], sample_count = 2, sample_size = 1)]
fn dwell_lucy_richardson_map(bencher: Bencher, side: usize) {
    let name = if side == 411 { "disk-100" } else { "disk-100-1641" };
    let recipe = fs::read_to_string(workspace().join(format!("fixtures/{name}.json"))).unwrap();
    let recipe: Recipe = serde_json::from_str(&recipe).unwrap();
    let fixture = make(&recipe).unwrap();
    let path = raster(&fixture.surface, &raster_settings(1.0)).unwrap();
    let problem = without_floor(&fixture, &path);
    let how = lucy_richardson::LucyRichardsonSettings {
        unknowns: Unknowns::Map,
        max_iterations: 60,
        min_decrease: 0.0,
        ..Default::default()
    };
    bencher.bench_local(|| black_box(lucy_richardson::solve(&problem, &how).unwrap()));
}

#[divan::bench(sample_count = 20)]
fn verify_trajectory() {
    black_box(verify(&CASE.trajectory, &ion_beam(), &VerifySettings::default()).unwrap());
}

/// A positive definite matrix of the size of the active set on this mirror.
fn matrix(n: usize) -> Array2<f64> {
    Array2::from_shape_fn((n, n), |(i, j)| {
        let d = i.abs_diff(j) as f64;
        (-0.01 * d * d).exp() + f64::from(i == j)
    })
}

#[divan::bench(args = [1000, 2000], sample_count = 5)]
fn cholesky_blocked(bencher: Bencher, n: usize) {
    bencher
        .with_inputs(|| Skyline::from_dense(&matrix(n)))
        .bench_values(|a| a.factorise().unwrap());
}

#[divan::bench(args = [1000, 2000], sample_count = 5)]
fn cholesky_nalgebra(bencher: Bencher, n: usize) {
    let a = matrix(n);
    bencher
        .with_inputs(|| DMatrix::from_fn(n, n, |i, j| a[[i, j]]))
        .bench_values(|a| a.cholesky().unwrap());
}

/// 400 x 400 mm at a pitch of 0.5 mm, 6.4e5 cells: shall take less than 3 s.
#[divan::bench(args = ["depth-first", "wilson"], sample_count = 5)]
fn maze_of_a_large_part(tree: &str) {
    let axis = Axis::new(0.0, 0.5, 801).unwrap();
    let part = Surface::new(Grid { x: axis, y: axis }, Array2::zeros((801, 801))).unwrap();
    let tree = match tree {
        "wilson" => Tree::Wilson,
        _ => Tree::DepthFirst { straightness: 0.0 },
    };
    let settings = MazeSettings {
        pitch_mm: 0.5,
        step_mm: 0.5,
        overscan_mm: 0.0,
        seed: 1,
        tree,
        corner_radius_mm: 0.0,
        open: false,
    };
    black_box(maze(&part, &settings).unwrap());
}

/// Bandwidth of the memory of the machine: `a[i] = b[i] + 3 c[i]` over three arrays of 256 MiB, larger than
/// any cache. The loop moves 768 MiB, or 1024 MiB if a write first reads its cache line.
#[divan::bench(args = [1, 2], sample_count = 7, sample_size = 1)]
fn memory_triad(bencher: Bencher, threads: usize) {
    const LENGTH: usize = 1 << 25;
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
    let (mut a, b, c) = (vec![1.0_f64; LENGTH], vec![2.0_f64; LENGTH], vec![0.5_f64; LENGTH]);
    let part = LENGTH / threads;
    bencher.bench_local(|| {
        pool.scope(|s| {
            for ((a, b), c) in a.chunks_mut(part).zip(b.chunks(part)).zip(c.chunks(part)) {
                s.spawn(move |_| {
                    a.iter_mut().zip(b).zip(c).for_each(|((a, b), c)| *a = b + 3.0 * c);
                });
            }
        });
        black_box(&mut a);
    });
}
