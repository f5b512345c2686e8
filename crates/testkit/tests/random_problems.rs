//! Random problems (part, tool, path, machine) through the programs, through the libraries, and by a sum of their own.
//!
//! ```text
//! removal(x) = g(x) sum over the motion of  c(t) sum_k a_k(p) phi_k(x - p) dt,     phi_k and a_k by Keys
//! ```
//!
//! * `planish-dwell` gives the dwell times of the library, and so do the joint plan and the closed loop.
//! * The residual that a solver states for dwell points is the residual that `planish-simulate` finds for the motion that
//!   stands at them.
//! * The simulated removal is the sum above. The sum is written here, shares no code with a stage, and has the tool on
//!   the lattice of the map; with the tool as it was measured it differs by no more than the stated error of that
//!   lattice allows.
//!
//! `PLANISH_PROBLEMS=200 cargo test --release --locked -p planish-testkit --test random_problems` takes some minutes.

use std::{fs, path::Path};

use ndarray::Array2;
use planish_dwell::{
    DwellError,
    baselines::non_negative_least_squares as nnls,
    bounded_least_squares::{self as squares, Bound},
    columns::Columns,
    lucy_richardson,
    problem::Problem as DwellProblem,
    tikhonov_lsqr,
};
use planish_handoff::{Artifact, Tool, artifact};
use planish_numerics::quadrature::gauss_legendre;
use planish_schedule::{Choices, SCHEDULERS};
use planish_testkit::{
    case_generator,
    program::{text, write},
};
use planish_toolpath::{MazeSettings, RasterSettings, Tree, maze, raster};
use planish_types::{
    Axis, DwellTime, Grid, Limits, MachineFile, MachineFileAxis, PARTS_TOLERANCE, PixelFactor,
    Pose, Removal, Segment, Surface, Tif, TimeFactor, ToolPath, Trajectory, TurnWeights,
    VaryingTif,
};
use rand::{Rng, RngExt};

/// Number of problems unless `PLANISH_PROBLEMS` states another one.
const DEFAULT_PROBLEMS: u64 = 10;

/// Difference of two residuals, nm, of two plans, s and mm, and of two removals, over the largest, that is none: rounding of
/// transforms and of a rate that depends on the time is below it by a factor of ten at least.
const NOTHING: f64 = 1e-6;

/// Number of pixels, in even steps over the map, at which the removal of a standing motion is compared with the sum. More:
/// a longer test, which evaluates each kernel at each position for each pixel.
const STANDING_PIXELS: usize = 40;

/// Kind of a tool.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Varies {
    No,
    ByPlace,
    ByTime,
    ByPlaceAndTime,
    ByHeading,
}

/// A problem.
#[derive(Debug)]
struct Problem {
    surface: Surface,
    tif: Tif,
    varies: Varies,
    /// True if the tool falls to zero at its border.
    is_smooth: bool,
    path: ToolPath,
    machine: MachineFile,
    solver: &'static str,
    floor_s: f64,
}

/// Solvers whose model the residual belongs to; the last two refuse a rate that depends on the time.
const SOLVERS: [&str; 4] =
    ["bounded-least-squares", "tikhonov-lsqr", "non-negative-least-squares", "lucy-richardson"];

fn problem(number: u64) -> Problem {
    let mut random = case_generator(72, 24, number);
    let surface = surface(&mut random);
    let varies = [
        Varies::No,
        Varies::ByPlace,
        Varies::No,
        Varies::ByTime,
        Varies::ByPlaceAndTime,
        Varies::ByHeading,
    ][(number % 6) as usize];
    let is_smooth = random.random_bool(0.5);
    let tif = tool(&surface, varies, is_smooth, &mut random);
    let path = path(&surface, varies, &mut random);
    let depends = matches!(varies, Varies::ByTime | Varies::ByPlaceAndTime);
    let solver = if depends { SOLVERS[0] } else { SOLVERS[random.random_range(0..SOLVERS.len())] };
    let floor_s = random.random_range(0.0..0.05);
    Problem {
        surface,
        tif,
        varies,
        is_smooth,
        path,
        machine: machine(&mut random),
        solver,
        floor_s,
    }
}

/// A part with a mask and holes.
fn surface(random: &mut impl Rng) -> Surface {
    let step = random.random_range(0.2..0.7);
    let aspect = if random.random_bool(0.5) { 1.0 } else { random.random_range(0.7..1.4) };
    let axis = |random: &mut dyn FnMut() -> f64, step: f64, len: usize| {
        Axis::new(20.0 * random() - 10.0, step, len).unwrap()
    };
    let (nx, ny) = (random.random_range(14..34), random.random_range(12..26));
    let mut number = || random.random::<f64>();
    let grid = Grid { x: axis(&mut number, step, nx), y: axis(&mut number, step * aspect, ny) };
    let waves: Vec<[f64; 4]> = (0..6).map(|_| [(); 4].map(|()| number())).collect();
    let (layer, disk) = (20.0 * number(), number() < 0.5);
    let holes: Vec<f64> = (0..nx * ny).map(|_| number()).collect();
    let height = Array2::from_shape_fn(grid.shape(), |(r, c)| {
        let (u, v) =
            (2.0 * c as f64 / (nx - 1) as f64 - 1.0, 2.0 * r as f64 / (ny - 1) as f64 - 1.0);
        if disk && u.hypot(v) > 1.0 || holes[r * nx + c] < 0.01 {
            return f64::NAN;
        }
        let wave = |w: &[f64; 4]| {
            8.0 * w[0] * (5.0 * (w[1] - 0.5) * u + 5.0 * (w[2] - 0.5) * v + 6.3 * w[3]).sin()
        };
        layer + waves.iter().map(wave).sum::<f64>()
    });
    Surface::new(grid, height).unwrap()
}

/// A spot that is not centred, not round and leans to one side, on samples of the pitch of the map, of a part of it or of
/// any other one.
fn tool(surface: &Surface, varies: Varies, is_smooth: bool, random: &mut impl Rng) -> Tif {
    let grid = surface.grid();
    let width_mm = random.random_range(1.5..4.0) * grid.x.step_mm();
    let pitch = match random.random_range(0..5) {
        0 => 1.0,
        1 => 0.5,
        _ => random.random_range(0.4..2.2),
    };
    let half = random.random_range(1.6..2.6) * width_mm;
    let axis = |step: f64, off: f64| {
        let len = ((2.0 * half / step) as usize).max(6);
        Axis::new((off - 0.5 * (len - 1) as f64) * step, step, len).unwrap()
    };
    let (off_x, off_y) = (random.random_range(-0.7..0.7), random.random_range(-0.7..0.7));
    let offsets =
        Grid { x: axis(pitch * grid.x.step_mm(), off_x), y: axis(pitch * grid.y.step_mm(), off_y) };
    let [lean, aspect] = [random.random_range(-0.4..0.4), random.random_range(0.7..1.4)];
    let peak = random.random_range(2.0..30.0);
    let end = [&offsets.x, &offsets.y]
        .map(|a| (0.5 * (a.start_mm() + a.end_mm()), 0.5 * (a.end_mm() - a.start_mm())));
    let spot = Array2::from_shape_fn(offsets.shape(), |(r, c)| {
        let (x, y) = (offsets.x.coordinate_mm(c), offsets.y.coordinate_mm(r));
        let bell = (-0.5 * (x * x + (aspect * y).powi(2)) / (0.25 * width_mm * width_mm)).exp();
        let rim =
            |v: f64, (middle, half): (f64, f64)| (1.0 - ((v - middle) / half).powi(2)).max(0.0);
        let taper = if is_smooth { (rim(x, end[0]) * rim(y, end[1])).powi(2) } else { 1.0 };
        peak * bell * (1.0 + lean * (x / half)) * taper
    });
    if varies == Varies::No {
        return Tif::new(offsets, spot).unwrap();
    }
    let scaled = |of: fn(f64, f64) -> f64| {
        let of = |(r, c): (usize, usize)| {
            of(offsets.x.coordinate_mm(c) / half, offsets.y.coordinate_mm(r) / half)
        };
        &spot * &Array2::from_shape_fn(offsets.shape(), of)
    };
    let mut number = || random.random::<f64>();
    let [wide, high] = grid.size_mm();
    let positions = Grid {
        x: Axis::new(grid.x.start_mm() - 0.1 * wide, 0.3 * wide, 5).unwrap(),
        y: Axis::new(grid.y.start_mm() - 0.1 * high, 0.4 * high, 4).unwrap(),
    };
    let by_place = matches!(varies, Varies::ByPlace | Varies::ByPlaceAndTime);
    let mut weight = |mean: f64, scatter: f64| {
        Array2::from_shape_simple_fn(positions.shape(), || mean + scatter * (number() - 0.5))
    };
    let (kernels, weights) = match by_place {
        true => (
            vec![spot.clone(), scaled(|x, _| x), scaled(|x, y| x * y)],
            vec![weight(1.0, 0.3), weight(0.0, 0.4), weight(0.1, 0.3)],
        ),
        false => (vec![spot.clone(), scaled(|x, _| x)], vec![weight(1.0, 0.0), weight(0.3, 0.0)]),
    };
    let pixels = by_place.then(|| PixelFactor {
        grid: *grid,
        factor: Array2::from_shape_simple_fn(grid.shape(), || 0.9 + 0.2 * number()),
    });
    let time = matches!(varies, Varies::ByTime | Varies::ByPlaceAndTime).then(|| TimeFactor {
        time_s: vec![0.0, 5.0, 40.0 + 20.0 * number()],
        factor: vec![1.0, 0.8 + 0.4 * number(), 0.5 + number()],
    });
    let turn = |k: usize, degrees: f64| if k == 0 { 1.0 } else { degrees.to_radians().cos() };
    let heading = (varies == Varies::ByHeading).then(|| {
        let degrees: Vec<f64> = (0..24).map(|i| 15.0 * f64::from(i)).collect();
        let weights = (0..2).map(|k| degrees.iter().map(|d| turn(k, *d)).collect()).collect();
        TurnWeights::by_heading(degrees, weights).unwrap()
    });
    let varying =
        VaryingTif { offsets, kernels, positions, weights, azimuth: None, heading, pixels, time };
    Tif::varying(varying).unwrap()
}

/// A raster, a maze or points anywhere with lifts; a line where the tool turns with its heading, because the motion that
/// stands at the points of a bend has the directions of its jumps.
fn path(surface: &Surface, varies: Varies, random: &mut impl Rng) -> ToolPath {
    let grid = surface.grid();
    let [wide, high] = grid.size_mm();
    let pitch_mm = high / random.random_range(4.0..8.0);
    if varies == Varies::ByHeading {
        let (n, y) = (random.random_range(15..50), grid.y.start_mm() + 0.4 * high);
        let at = |i: usize| [grid.x.start_mm() + wide * i as f64 / n as f64, y + 0.1 * i as f64];
        return ToolPath::through((0..=n).map(at).collect(), vec![true; n], vec![0; n]).unwrap();
    }
    match random.random_range(0..3) {
        0 => raster(surface, &RasterSettings::new(pitch_mm, pitch_mm, 0.5 * pitch_mm)).unwrap(),
        1 => {
            let settings = MazeSettings {
                pitch_mm,
                step_mm: pitch_mm,
                overscan_mm: pitch_mm,
                corner_radius_mm: 0.0,
                tree: Tree::Wilson,
                open: false,
                seed: random.random(),
            };
            maze(surface, &settings).unwrap().path
        }
        _ => {
            let n = random.random_range(20..60);
            let mut point = || {
                [
                    grid.x.start_mm() + wide * random.random_range(-0.1..1.1),
                    grid.y.start_mm() + high * random.random_range(-0.1..1.1),
                ]
            };
            let points = (0..=n).map(|_| point()).collect();
            let on = (0..n).map(|i| i % 7 != 3).collect();
            ToolPath::through(points, on, vec![0; n]).unwrap()
        }
    }
}

fn machine(random: &mut impl Rng) -> MachineFile {
    let mut axis = |name: &str| MachineFileAxis {
        name: name.into(),
        max_velocity_mm_per_s: random.random_range(20.0..300.0),
        max_acceleration_mm_per_s2: random.random_range(100.0..3000.0),
        max_jerk_mm_per_s3: random.random_bool(0.3).then_some(1e5),
        ..MachineFileAxis::default()
    };
    let axes = vec![axis("x"), axis("y")];
    MachineFile { name: "random".into(), axes, ..MachineFile::default() }
}

/// Keys' kernel of the cubic convolution at a distance, in steps.
fn keys(distance: f64) -> f64 {
    let s = distance.abs();
    match s {
        _ if s < 1.0 => (1.5 * s - 2.5) * s * s + 1.0,
        _ if s < 2.0 => ((-0.5 * s + 2.5) * s - 4.0) * s + 2.0,
        _ => 0.0,
    }
}

/// The number at a node, which beyond the ends is that of the parabola through the last three.
fn node(at: &dyn Fn(isize) -> f64, i: isize, n: isize) -> f64 {
    match i {
        _ if i < 0 => 3.0 * node(at, i + 1, n) - 3.0 * node(at, i + 2, n) + node(at, i + 3, n),
        _ if i >= n => 3.0 * node(at, i - 1, n) - 3.0 * node(at, i - 2, n) + node(at, i - 3, n),
        _ => at(i),
    }
}

/// Keys' interpolation of samples at the coordinates [x, y] in steps.
fn interpolated(samples: &Array2<f64>, [x, y]: [f64; 2]) -> f64 {
    let (ny, nx) = samples.dim();
    let first = |s: f64| s.floor() as isize - 1;
    let along = |r: isize| -> f64 {
        let at = |c: isize| samples[[r as usize, c as usize]];
        let terms =
            (first(x)..first(x) + 4).map(|c| keys(x - c as f64) * node(&at, c, nx as isize));
        terms.sum()
    };
    let terms = first(y)..first(y) + 4;
    terms.map(|r| keys(y - r as f64) * node(&along, r, ny as isize)).sum()
}

/// A tool in the numbers of its artifact, with its upper edge.
struct Numbers {
    tool: VaryingTif,
    edge_mm: [f64; 2],
}

impl Numbers {
    fn of(tif: &Tif) -> Self {
        Self { tool: tif.numbers(), edge_mm: tif.edge_mm() }
    }

    /// Rate at the offset of a pixel from a tool in a pose, nm/s, without the factors of pixels and time.
    fn rate(&self, pose: Pose, offset_mm: [f64; 2]) -> f64 {
        let VaryingTif { offsets, kernels, positions, weights, heading, .. } = &self.tool;
        let start = [offsets.x.start_mm(), offsets.y.start_mm()];
        if (0..2).any(|a| offset_mm[a] < start[a] || offset_mm[a] > self.edge_mm[a]) {
            return 0.0;
        }
        let steps = |grid: &Grid, mm: [f64; 2]| {
            [
                (mm[0] - grid.x.start_mm()) / grid.x.step_mm(),
                (mm[1] - grid.y.start_mm()) / grid.y.step_mm(),
            ]
        };
        let last = [positions.x.len(), positions.y.len()].map(|n| (n - 1) as f64);
        let place = steps(positions, pose.position_mm);
        let place = [0, 1].map(|a| place[a].clamp(0.0, last[a]));
        let turn = |k: usize| {
            let Some(heading) = heading else { return 1.0 };
            let row = &heading.weights()[k];
            let n = row.len() as isize;
            let s = (pose.heading_rad.to_degrees() - heading.angle_deg()[0]) * n as f64 / 360.0;
            let first = s.floor() as isize - 1;
            (first..first + 4).map(|i| keys(s - i as f64) * row[i.rem_euclid(n) as usize]).sum()
        };
        let offset = steps(offsets, offset_mm);
        let of = |k: usize| {
            let weight = if weights[k].len() > 4 { interpolated(&weights[k], place) } else { 1.0 };
            weight * turn(k) * interpolated(&kernels[k], offset)
        };
        (0..kernels.len()).map(of).sum()
    }

    /// Factor of a pixel.
    fn of_pixel(&self, index: (usize, usize)) -> f64 {
        self.tool.pixels.as_ref().map_or(1.0, |pixels| pixels.factor[index])
    }

    /// Factor of the time.
    fn of_time(&self, time_s: f64) -> f64 {
        let Some(TimeFactor { time_s: times, factor }) = &self.tool.time else { return 1.0 };
        let after = times.iter().position(|t| *t > time_s);
        match after {
            Some(0) => factor[0],
            Some(i) => {
                let part = (time_s - times[i - 1]) / (times[i] - times[i - 1]);
                factor[i - 1] + part * (factor[i] - factor[i - 1])
            }
            None => factor[factor.len() - 1],
        }
    }

    /// Times, s, within a segment at which the factor of the time has a knee, or a velocity changes its sign and the tool
    /// may turn at once; with the ends of the segment.
    fn knees(&self, s: &Segment<'_>) -> Vec<f64> {
        let to_s = s.start_s + s.duration_s;
        let times = self.tool.time.iter().flat_map(|time| time.time_s.iter().copied());
        let turns = s.coefficient_mm.iter().flat_map(|c| roots([c[1], 2.0 * c[2], 3.0 * c[3]]));
        let mut knees: Vec<f64> = times
            .chain(turns.map(|u_s| s.start_s + u_s))
            .filter(|t| *t > s.start_s && *t < to_s)
            .chain([s.start_s, to_s])
            .collect();
        knees.sort_by(f64::total_cmp);
        knees
    }

    /// Parts of a segment that are a fortieth of a sample long; the kinks of Keys' interpolation then leave 1e-7 of the
    /// removal.
    fn parts(&self, s: &Segment<'_>) -> usize {
        let h = s.duration_s;
        let way = |c: &[f64; 4]| h * (c[1].abs() + h * (c[2].abs() + h * c[3].abs()));
        let [x, y] = s.coefficient_mm.each_ref().map(way);
        let Grid { x: along_x, y: along_y } = &self.tool.offsets;
        let samples = (x / along_x.step_mm()).max(y / along_y.step_mm());
        ((40.0 * samples).ceil() as usize).max(1)
    }

    /// Removal of a motion at a pixel, nm, by Gauss' rule of four points on parts of every segment.
    fn removal(&self, motion: &Trajectory, grid: &Grid, (r, c): (usize, usize)) -> f64 {
        let pixel = [grid.x.coordinate_mm(c), grid.y.coordinate_mm(r)];
        let rule = gauss_legendre::<4>();
        let mut sum = 0.0;
        let mut heading_rad = first_heading(motion);
        for s in motion.segments() {
            let is_at_rest = s.coefficient_mm.iter().all(|c| c[1..] == [0.0; 3]);
            for piece in self.knees(&s).windows(2) {
                let parts = self.parts(&s);
                let length = (piece[1] - piece[0]) / parts as f64;
                for k in 0..parts {
                    for (u, w) in rule {
                        let time_s = piece[0] + (k as f64 + u) * length;
                        let u_s = time_s - s.start_s;
                        let position_mm = s.position_mm(u_s);
                        if !is_at_rest {
                            let [vx, vy] = s
                                .coefficient_mm
                                .map(|c| c[1] + u_s * (2.0 * c[2] + 3.0 * u_s * c[3]));
                            heading_rad = vy.atan2(vx);
                        }
                        if s.tool_on {
                            let pose = Pose { position_mm, heading_rad };
                            let offset = [0, 1].map(|a| pixel[a] - position_mm[a]);
                            sum += w * length * self.of_time(time_s) * self.rate(pose, offset);
                        }
                    }
                }
            }
        }
        sum * self.of_pixel((r, c))
    }
}

/// Real roots of c[0] + c[1] u + c[2] u^2; none of a constant.
fn roots(c: [f64; 3]) -> Vec<f64> {
    if c[2] == 0.0 {
        return if c[1] == 0.0 { Vec::new() } else { vec![-c[0] / c[1]] };
    }
    let square = c[1] * c[1] - 4.0 * c[0] * c[2];
    if square < 0.0 {
        return Vec::new();
    }
    // The sum of numbers of one sign loses no digits.
    let q = -0.5 * (c[1] + square.sqrt().copysign(c[1]));
    let mut roots = vec![q / c[2]];
    if q != 0.0 {
        roots.push(c[0] / q);
    }
    roots
}

/// Direction of the first motion or jump, rad; the paths of tools that turn are lines.
fn first_heading(motion: &Trajectory) -> f64 {
    let places: Vec<[f64; 2]> =
        motion.segments().map(|s| s.position_mm(0.5 * s.duration_s)).collect();
    let way = |p: &[f64; 2]| [p[0] - places[0][0], p[1] - places[0][1]];
    let there = places.iter().map(way).find(|d| d[0].hypot(d[1]) > 1e-6);
    there.map_or(0.0, |d| d[1].atan2(d[0]))
}

/// Runs `planish-<command>` in `dir`, and returns its message if it refuses; a negative verdict does not matter here.
fn refusal(dir: &Path, command: &str) -> Option<String> {
    let mut words = command.split_whitespace();
    let program = format!("planish-{}", words.next().unwrap());
    let output =
        planish_testkit::program::stage(&program).args(words).current_dir(dir).output().unwrap();
    match output.status.code() {
        Some(0 | 1) => None,
        Some(2) => Some(text(&output.stderr)),
        code => panic!("planish-{command} ends with {code:?}: {}", text(&output.stderr)),
    }
}

fn run(dir: &Path, command: &str) {
    assert_eq!(refusal(dir, command), None, "planish-{command}");
}

/// The outcome in a manifest.
fn outcome(dir: &Path) -> serde_json::Value {
    let text = fs::read_to_string(dir.join("manifest.json")).unwrap();
    serde_json::from_str::<serde_json::Value>(&text).unwrap()["outcome"].clone()
}

fn read<T: Artifact>(dir: &Path) -> T {
    artifact::read::<T>(dir).unwrap().value
}

/// Dwell times by the library, and the RMS that it states, nm.
fn by_library(p: &Problem) -> Result<(DwellTime, f64), DwellError> {
    let (columns, min_dwell) = (Columns::Point, Bound::Seconds(p.floor_s));
    if p.solver == SOLVERS[0] {
        let settings =
            squares::BoundedSettings { columns, min_dwell, ..squares::BoundedSettings::default() };
        let found = squares::solve(&p.surface, &p.tif, &p.path, None, &settings)?;
        return Ok((found.dwell, found.report.model_rms_nm));
    }
    let Problem { surface: desired, tif, path, .. } = p;
    let problem = DwellProblem { desired, tif, path, weight: None, columns, min_dwell };
    let (dwell, outcome) = match p.solver {
        "tikhonov-lsqr" => {
            let found =
                tikhonov_lsqr::solve(&problem, &tikhonov_lsqr::TikhonovLsqrSettings::default())?;
            (found.dwell, found.outcome)
        }
        "non-negative-least-squares" => {
            let found = nnls::solve(&problem, &nnls::NonNegativeSettings::default())?;
            (found.dwell, found.outcome)
        }
        _ => {
            let found = lucy_richardson::solve(
                &problem,
                &lucy_richardson::LucyRichardsonSettings::default(),
            )?;
            (found.dwell, found.outcome)
        }
    };
    Ok((dwell, outcome.model_rms_nm))
}

/// Differences between the programs, the libraries and the sum, in words.
fn differences(number: u64) -> Vec<String> {
    let p = problem(number);
    let (varies, solver) = (p.varies, p.solver);
    let mut found = Vec::new();
    let mut compare = |what: &str, difference: f64, most: f64| {
        if difference.is_nan() || difference > most {
            found.push(format!(
                "problem {number} (tool varies: {varies:?}, {solver}): {what}: {difference:.3e}, at most {most:.1e}"
            ));
        }
    };
    let tmp = tempfile::tempdir().unwrap();
    let dir = tmp.path();
    write(dir, "surface", &p.surface);
    write(dir, "path", &p.path);
    match p.varies {
        Varies::No => write(dir, "tif", &p.tif),
        _ => write(dir, "tif", &Tool(p.tif.clone())),
    }
    fs::write(dir.join("machine.json"), serde_json::to_string(&p.machine).unwrap()).unwrap();
    // What the files hold, to the last digit of their axes.
    let tif = match p.varies {
        Varies::No => read::<Tif>(&dir.join("tif")),
        _ => read::<Tool>(&dir.join("tif")).0,
    };
    let p = Problem { surface: read(&dir.join("surface")), tif, ..p };
    let mirror = "--surface surface --tif tif";

    let command = format!(
        "dwell {} {mirror} --tool-path path --columns point --min-dwell-s {:?} --out dwell",
        p.solver, p.floor_s
    );
    let (dwell, rms_nm) = match (refusal(dir, &command), by_library(&p)) {
        (None, Ok(found)) => found,
        (Some(_), Err(_)) => return Vec::new(),
        (program, library) => {
            return vec![format!("problem {number}: program {program:?}, library {library:?}")];
        }
    };
    let program: DwellTime = read(&dir.join("dwell"));
    let off = |a: &DwellTime, b: &DwellTime| {
        let pairs = a.dwell_s().iter().zip(b.dwell_s());
        pairs.map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
    };
    compare("dwell times of program and library, s", off(&dwell, &program), NOTHING);
    let stated = outcome(&dir.join("dwell"))["report"]["model_rms_nm"].as_f64().unwrap();
    compare("residual of program and library, nm", (stated - rms_nm).abs(), NOTHING);

    run(
        dir,
        "schedule position --tool-path path --dwell dwell --machine machine.json --out position",
    );
    run(dir, &format!("simulate {mirror} --trajectory position --out removal"));
    let removal: Removal = read(&dir.join("removal"));
    let rms = removal.residual().statistics().rms;
    let off = (stated - rms).abs() / largest_of(&removal);
    compare("stated and simulated residual, over the largest removal", off, NOTHING);

    let on_lattice = p.tif.on_lattice_of(p.surface.grid(), PARTS_TOLERANCE).unwrap();
    let (sum, of_tif) = (Numbers::of(&on_lattice.tif), Numbers::of(&p.tif));
    let error = on_lattice.lattice.error * on_lattice.tif.peak_nm_per_s();
    let position: Trajectory = read(&dir.join("position"));
    let stride = (p.surface.height_nm().len() / STANDING_PIXELS).max(1);
    let off = largest_off(&p, &sum, &position, &removal, stride);
    compare("simulated removal and sum, standing", off, NOTHING);
    // (2) of the lattice with the largest factors of time and pixels, 1.5 and 1.1. The measured error is at thirds of
    // the cells.
    let most = 2.0 * error * position.total_time_s() / largest_of(&removal) + NOTHING;
    let off = largest_off(&p, &of_tif, &position, &removal, stride);
    compare("simulated removal and sum of the TIF as measured", off, most);

    if p.is_smooth {
        run(dir, "schedule pvt --tool-path path --dwell dwell --machine machine.json --out motion");
        run(dir, &format!("simulate {mirror} --trajectory motion --out executed"));
        let (motion, removal) = (read(&dir.join("motion")), read(&dir.join("executed")));
        let stride = p.surface.height_nm().len() / 5;
        let off = largest_off(&p, &sum, &motion, &removal, stride);
        compare("simulated removal and sum, moving", off, NOTHING);
    }
    if number.is_multiple_of(5) {
        plans(dir, &p, &mut compare);
    }
    found
}

/// Largest simulated removal, nm; at least 1.
fn largest_of(removal: &Removal) -> f64 {
    removal.removal_nm().iter().copied().fold(1.0, f64::max)
}

/// Largest difference of a simulated removal from the sum over the motion, over the largest removal, at one in `stride`
/// pixels.
fn largest_off(
    p: &Problem,
    sum: &Numbers,
    motion: &Trajectory,
    removal: &Removal,
    stride: usize,
) -> f64 {
    let pixels = removal.removal_nm().indexed_iter().step_by(stride);
    let off = pixels
        .map(|(index, simulated)| (simulated - sum.removal(motion, p.surface.grid(), index)).abs());
    off.fold(0.0, f64::max) / largest_of(removal)
}

/// Compares the joint plan and the closed loop of the programs with those of the libraries.
fn plans(dir: &Path, p: &Problem, compare: &mut impl FnMut(&str, f64, f64)) {
    let mirror = "--surface surface --tif tif --tool-path path --machine machine.json";
    let limits: Limits = p.machine.clone().checked().unwrap();
    let Problem { surface, tif, path, .. } = p;
    let apart = |a: &Trajectory, b: &Trajectory| {
        let numbers = |t: &Trajectory| -> Vec<f64> {
            t.segments()
                .flat_map(|s| s.coefficient_mm.concat())
                .chain(t.break_time_s().iter().copied())
                .collect()
        };
        let (a, b) = (numbers(a), numbers(b));
        match a.len() == b.len() {
            true => a.iter().zip(&b).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max),
            false => f64::INFINITY,
        }
    };
    let refused = refusal(dir, &format!("joint {mirror} --out joint")).is_some();
    let settings = planish_joint::JointSettings::default();
    match planish_joint::plan(surface, tif, path, &limits, &settings) {
        Err(_) if refused => {}
        Ok(plan) if !refused => {
            let program: Trajectory = read(&dir.join("joint/trajectory"));
            compare(
                "joint plan of program and library",
                apart(&plan.trajectory, &program),
                NOTHING,
            );
        }
        _ => compare("joint plan refused by one of program and library", f64::INFINITY, NOTHING),
    }

    run(dir, &format!("refine {mirror} --max-rounds 3 --out refined"));
    let scheduler = SCHEDULERS[0].scheduler(&Choices::default(), &limits);
    let settings = planish_refine::RefineSettings {
        scheduler: &*scheduler,
        max_rounds: 3,
        ..planish_refine::RefineSettings::default()
    };
    let refined = planish_refine::refine(surface, tif, path, &limits, None, &settings).unwrap();
    let program: Trajectory = read(&dir.join("refined/trajectory"));
    compare("closed loop of program and library", apart(&refined.trajectory, &program), NOTHING);
}

#[test]
fn programs_libraries_and_a_sum_agree_on_random_problems() {
    let count = std::env::var("PLANISH_PROBLEMS").map_or(DEFAULT_PROBLEMS, |n| n.parse().unwrap());
    let found: Vec<String> = (0..count).flat_map(differences).collect();
    assert!(found.is_empty(), "{} differences:\n{}", found.len(), found.join("\n"));
}
