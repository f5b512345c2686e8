//! Cases of known truth, by a direct sum over analytic tools: nothing of it uses the simulator of the product.

#![allow(dead_code)] // the test and the example use a part each

use ndarray::Array2;
use planish_reconcile::{Comparison, ReconcileSettings, Reconciled, reconcile};
use planish_simulate::error_budget::ErrorBudgetFile;
use planish_testkit::mirror::Mirror;
use planish_types::{Axis, Grid, Surface, Tif, Trajectory, TrajectoryBuilder};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde_json::json;

const DEGREE: f64 = std::f64::consts::PI / 180.0;

/// Places along each piece at which the direct sum puts its time (Gauss's rule of two points on each half).
pub const NODES: [f64; 4] = [0.105_662_433, 0.394_337_567, 0.605_662_433, 0.894_337_567];

/// Part and tool of one kind of test case.
#[derive(Clone, Copy, Debug)]
struct Kind {
    name: &'static str,
    /// Size of the part, mm.
    size_mm: [f64; 2],
    sigma_mm: f64,
    /// Pitch of maps and tool, mm: about four samples per sigma, where Keys' convolution of a Gaussian errs by 2e-4 of
    /// its peak.
    pitch_mm: f64,
}

/// A coupon, a strip like a long flat mirror, and a plate.
const KINDS: [Kind; 3] = [
    Kind { name: "coupon", size_mm: [20.0, 12.0], sigma_mm: 1.0, pitch_mm: 0.25 },
    Kind { name: "flat", size_mm: [60.0, 16.0], sigma_mm: 1.7, pitch_mm: 0.4 },
    Kind { name: "plate", size_mm: [36.0, 24.0], sigma_mm: 1.5, pitch_mm: 0.4 },
];

/// Rate below which the planner takes the tool for ended, nm/s: 1e-6 of its peak.
const LEAST_RATE: f64 = 8e-6;

/// Radius of the tool in the direct sum, in sigmas: beyond it a tool has less than 1e-7 of its peak.
pub const REACH_SIGMA: f64 = 6.5;

/// Standard deviation of the tool of the reference mirror, and half the side of its samples, mm.
const SIGMA_MM: f64 = 1.7035;
const HALF_MM: f64 = 5.0;

/// Rounds of the multiplicative planner.
const ROUNDS: usize = 25;

/// True errors of machine and tool, in the units of the parameters.
#[derive(Clone, Copy, Debug, Default)]
pub struct Truth {
    pub rate: f64,
    pub offset_mm: [f64; 2],
    pub rotation_rad: f64,
    pub magnification: f64,
    pub width: f64,
    pub ellipticity: f64,
    pub diagonal: f64,
    pub drift: f64,
}

impl Truth {
    /// Draws the errors of the machine of a seed: half of the machines have no magnification, and half no drift.
    fn random(rng: &mut ChaCha8Rng, seed: u64) -> Self {
        Self {
            rate: rng.random_range(-0.05..0.05),
            offset_mm: [0.06 * normal(rng), 0.06 * normal(rng)],
            rotation_rad: 0.05 * DEGREE * normal(rng),
            magnification: if seed.is_multiple_of(2) { 0.0 } else { 1e-3 * normal(rng) },
            width: 0.015 * normal(rng),
            ellipticity: 0.015 * normal(rng),
            diagonal: 0.015 * normal(rng),
            drift: if seed % 4 < 2 { 0.0 } else { 0.02 * normal(rng) },
        }
    }
}

/// A tool in closed form: a Gaussian, or one with a flatter top.
#[derive(Clone, Copy, Debug)]
struct Tool {
    sigma_mm: f64,
    pitch_mm: f64,
    flatter: bool,
}

impl Tool {
    /// Returns the rate at (x, y) from the middle of the tool with the errors of its shape, nm/s; the volume is that of
    /// the tool without them.
    fn rate(&self, x: f64, y: f64, t: &Truth) -> f64 {
        // The inverse of w [[1 + e/2, d/2], [d/2, 1 - e/2]]
        let (w, e, d) = (1.0 + t.width, 0.5 * t.ellipticity, 0.5 * t.diagonal);
        let determinant = w * (1.0 - e * e - d * d);
        let u = ((1.0 - e) * x - d * y) / determinant;
        let v = ((1.0 + e) * y - d * x) / determinant;
        let q = (u * u + v * v) / (self.sigma_mm * self.sigma_mm);
        let shape =
            if self.flatter { (1.0 + 0.4 * q) * (-0.5 * q).exp() } else { (-0.5 * q).exp() };
        8.0 * shape * (1.0 + t.rate) / (w * w * (1.0 - e * e - d * d))
    }

    fn sampled(&self, errors: &Truth) -> Tif {
        // Out to 5.5 sigma, where the tool has ended
        self.sampled_to(errors, 5.5 * self.sigma_mm)
    }

    /// Samples the tool at the pitch of the map, at which a simulation is fastest, out to `half_mm` along x and y.
    fn sampled_to(&self, errors: &Truth, half_mm: f64) -> Tif {
        let step = self.pitch_mm;
        let n = (half_mm / step).ceil() as usize;
        let axis = Axis::new(-(n as f64) * step, step, 2 * n + 1).unwrap();
        let rate = |(r, c): (usize, usize)| {
            self.rate(axis.coordinate_mm(c), axis.coordinate_mm(r), errors)
        };
        Tif::new(Grid { x: axis, y: axis }, Array2::from_shape_fn((2 * n + 1, 2 * n + 1), rate))
            .unwrap()
    }
}

/// One run with known errors, and its maps.
pub struct Case {
    seed: u64,
    pub kind: &'static str,
    pub truth: Truth,
    grid: Grid,
    tool: Tool,
    /// Corners of the path, in the coordinates of the part.
    path: Vec<[f64; 2]>,
    sigma_nm: f64,
    figure: Figure,
    noise: Array2<f64>,
    pub before: Surface,
    pub after: Surface,
    pub trajectory: Trajectory,
    pub tif: Tif,
}

/// Waves of amplitude, nm, wave vector, 1/mm, and phase, on a base.
pub struct Figure {
    base_nm: f64,
    waves: Vec<[f64; 4]>,
}

impl Figure {
    pub fn new(rng: &mut ChaCha8Rng, sigma_mm: f64, amplitude_nm: f64) -> Self {
        let wave = |_| {
            // Periods of 4 to 16 sigma: the tool reaches them.
            let k = 2.0 * std::f64::consts::PI / (sigma_mm * rng.random_range(6.0..20.0));
            let turn = rng.random_range(0.0..2.0 * std::f64::consts::PI);
            let a = amplitude_nm * rng.random_range(0.5..1.5);
            [a, k * turn.cos(), k * turn.sin(), rng.random_range(0.0..6.2)]
        };
        let waves = (0..8).map(wave).collect();
        Self { base_nm: 8.0 * amplitude_nm, waves }
    }

    fn at(&self, x: f64, y: f64) -> f64 {
        let wave = |[a, kx, ky, p]: &[f64; 4]| a * (kx * x + ky * y + p).sin();
        self.base_nm + self.waves.iter().map(wave).sum::<f64>()
    }

    pub fn map(&self, grid: &Grid) -> Array2<f64> {
        Array2::from_shape_fn(grid.shape(), |(r, c)| {
            self.at(grid.x.coordinate_mm(c), grid.y.coordinate_mm(r))
        })
    }
}

/// Draws a normal number from two uniform ones (Box and Muller).
pub fn normal(rng: &mut ChaCha8Rng) -> f64 {
    let (u, v): (f64, f64) = (rng.random_range(1e-12..1.0), rng.random_range(0.0..1.0));
    (-2.0 * u.ln()).sqrt() * (2.0 * std::f64::consts::PI * v).cos()
}

impl Case {
    /// Makes the case of a seed: part, tool and path change with it, and half of the machines have no magnification.
    pub fn new(seed: u64, sigma_nm: f64) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let kind = KINDS[(seed % 3) as usize];
        let (sigma_mm, pitch_mm) = (kind.sigma_mm, kind.pitch_mm);
        let tool = Tool { sigma_mm, pitch_mm, flatter: seed % 2 == 1 };
        let axis = |start: f64, size: f64| {
            Axis::new(start, pitch_mm, (size / pitch_mm).round() as usize).unwrap()
        };
        let grid = Grid { x: axis(-3.0, kind.size_mm[0]), y: axis(2.0, kind.size_mm[1]) };
        let figure = Figure::new(&mut rng, tool.sigma_mm, 4.0);
        let path = path_over(&grid, 0.75 * tool.sigma_mm, 2.5 * tool.sigma_mm, seed / 3 % 4);
        let truth = Truth::random(&mut rng, seed);
        let shape = grid.shape();
        let noise = Array2::from_shape_simple_fn(shape, || sigma_nm * normal(&mut rng));
        let after_noise = Array2::from_shape_simple_fn(shape, || sigma_nm * normal(&mut rng));
        let tif = tool.sampled(&Truth::default());
        let real = figure.map(&grid);
        let before = Surface::new(grid, &real + &noise).unwrap();
        let seconds = planned(&grid, &path, &real, &|x, y| tool.rate(x, y, &Truth::default()));
        let trajectory = motion(&path, &seconds);
        let removal = executed(&grid, &trajectory, &tool, &truth);
        let after = Surface::new(grid, &real - &removal + &after_noise).unwrap();
        Self {
            seed,
            kind: kind.name,
            truth,
            grid,
            tool,
            path,
            sigma_nm,
            figure,
            noise,
            before,
            after,
            trajectory,
            tif,
        }
    }

    /// Makes a run on the reference mirror, with its published raster and dwell times at even speed along each segment.
    /// The tool is a Gaussian without an end, and its samples end at 1.3 % of its peak; those of the published TIF end
    /// at more.
    pub fn on_mirror(mirror: &Mirror, seed: u64, sigma_nm: f64) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(3_000_000 + seed);
        let grid = *mirror.desired.grid();
        let tool = Tool { sigma_mm: SIGMA_MM, pitch_mm: grid.x.step_mm(), flatter: false };
        let truth = Truth::random(&mut rng, seed);
        let real = mirror.desired.height_nm();
        let noise = Array2::from_shape_simple_fn(grid.shape(), || sigma_nm * normal(&mut rng));
        let after = Array2::from_shape_simple_fn(grid.shape(), || sigma_nm * normal(&mut rng));
        let path = mirror.path("raster").point_mm().to_vec();
        let trajectory = motion(&path, mirror.dwell("raster").dwell_s());
        let removal = executed(&grid, &trajectory, &tool, &truth);
        Self {
            seed,
            kind: "reference",
            truth,
            grid,
            tool,
            path,
            sigma_nm,
            figure: Figure::new(&mut rng, SIGMA_MM, 4.0),
            before: Surface::new(grid, real + &noise).unwrap(),
            after: Surface::new(grid, real - &removal + &after).unwrap(),
            noise,
            trajectory,
            tif: tool.sampled_to(&Truth::default(), HALF_MM),
        }
    }

    /// Returns the same run with samples of the tool for the planner that end at `sigmas` standard deviations.
    pub fn with_cut_tool(mut self, sigmas: f64) -> Self {
        self.tif = self.tool.sampled_to(&Truth::default(), sigmas * self.tool.sigma_mm);
        self
    }

    /// Returns the map after the run on other pixels, with noise of its own.
    pub fn after_on(&self, grid: Grid) -> Surface {
        let removal = executed(&grid, &self.trajectory, &self.tool, &self.truth);
        let mut rng = ChaCha8Rng::seed_from_u64(2_000_000 + self.seed);
        let noise = Array2::from_shape_simple_fn(grid.shape(), || self.sigma_nm * normal(&mut rng));
        Surface::new(grid, self.figure.map(&grid) - &removal + &noise).unwrap()
    }

    pub fn learn(&self) -> Reconciled {
        self.learn_from(&self.after)
    }

    /// Reconciles the run with the map `after`. The settings say that both maps were measured in the same way, because
    /// hardly any of these plans leaves a sign of that in the maps.
    pub fn learn_from(&self, after: &Surface) -> Reconciled {
        self.learn_by(after, true)
    }

    pub fn learn_by(&self, after: &Surface, same_measurement: bool) -> Reconciled {
        let comparison = Comparison {
            before: &self.before,
            after,
            trajectory: &self.trajectory,
            tif: &self.tif,
            error_budget: None,
            transform: None,
        };
        reconcile(
            &comparison,
            &ReconcileSettings { same_measurement, ..ReconcileSettings::default() },
        )
        .unwrap()
    }

    /// Reconciles the run with an error budget: the sizes from which the errors of these machines are drawn.
    pub fn learn_with_budget(&self) -> Reconciled {
        let sizes = [
            ("rate_scale", 2.9, "%"),
            ("offset_x", 60.0, "um"),
            ("offset_y", 60.0, "um"),
            ("rotation", 0.05, "deg"),
            ("magnification", 0.07, "%"),
            ("tif_width", 1.5, "%"),
            ("tif_ellipticity", 1.5, "%"),
            ("tif_diagonal_ellipticity", 1.5, "%"),
            ("rate_drift", 1.4, "%"),
        ];
        let errors = sizes.map(|(kind, size, unit)| {
            json!({ "kind": kind, "size": size, "unit": unit, "distribution": "normal", "note": "" })
        });
        let file: ErrorBudgetFile =
            serde_json::from_value(json!({ "name": "known", "errors": errors })).unwrap();
        let budget = file.checked().unwrap();
        let comparison = Comparison {
            before: &self.before,
            after: &self.after,
            trajectory: &self.trajectory,
            tif: &self.tif,
            error_budget: Some(&budget),
            transform: None,
        };
        reconcile(
            &comparison,
            &ReconcileSettings { same_measurement: true, ..ReconcileSettings::default() },
        )
        .unwrap()
    }

    /// Returns the error of every parameter over its standard error; `None` if it is not determined.
    pub fn over_errors(&self, found: &Reconciled) -> Vec<(String, Option<f64>)> {
        let t = &self.truth;
        let truth = [
            100.0 * t.rate,
            t.offset_mm[0],
            t.offset_mm[1],
            t.rotation_rad / DEGREE,
            100.0 * t.magnification,
            100.0 * t.width,
            100.0 * t.ellipticity,
            100.0 * t.diagonal,
            100.0 * t.drift,
        ];
        let estimates = found.outcome.parameters.iter().zip(truth);
        let one = |(e, truth): (&planish_types::outcome::reconciliation::Estimate, f64)| {
            let off = e.value.map(|v| (v - truth) / e.standard_error.unwrap());
            (e.name.clone(), off)
        };
        estimates.map(one).collect()
    }

    /// Returns the true residual of another mirror of the kind with what was learnt, without it, and with a known tool,
    /// nm RMS.
    pub fn next_mirror_nm(&self, found: &Reconciled) -> [f64; 3] {
        let mut rng = ChaCha8Rng::seed_from_u64(1_000_000 + self.seed);
        let figure = Figure::new(&mut rng, self.tool.sigma_mm, 4.0);
        let real = figure.map(&self.grid);
        let measured = &real + &self.noise;
        // No plan corrects a drift, so the machine of the known tool has it, too.
        let shape = Truth { drift: 0.0, ..self.truth };
        let true_tool = self.tool.sampled(&shape);
        let residual = |rate: &dyn Fn(f64, f64) -> f64, place: &dyn Fn([f64; 2]) -> [f64; 2]| {
            let seconds = planned(&self.grid, &self.path, &measured, rate);
            let corners: Vec<[f64; 2]> = self.path.iter().map(|p| place(*p)).collect();
            let done = executed(&self.grid, &motion(&corners, &seconds), &self.tool, &self.truth);
            (&real - &done).std(0.0)
        };
        let middle = middle(&self.grid);
        let known = |p: [f64; 2]| {
            let t = &self.truth;
            let (sine, cosine) = t.rotation_rad.sin_cos();
            let d = [0, 1].map(|k| (p[k] - middle[k] - t.offset_mm[k]) / (1.0 + t.magnification));
            [middle[0] + cosine * d[0] + sine * d[1], middle[1] - sine * d[0] + cosine * d[1]]
        };
        [
            residual(&|x, y| found.tif.rate_at(x, y), &|p| found.transform.point(p)),
            residual(&|x, y| self.tif.rate_at(x, y), &|p| p),
            residual(&|x, y| true_tool.rate_at(x, y), &known),
        ]
    }
}

pub fn middle(grid: &Grid) -> [f64; 2] {
    [&grid.x, &grid.y].map(|a| 0.5 * (a.start_mm() + a.end_mm()))
}

/// Returns the corners of a raster along x or y, in both directions or always in one, with pieces as long as the pitch.
pub fn path_over(grid: &Grid, pitch: f64, beyond: f64, kind: u64) -> Vec<[f64; 2]> {
    let [x, y] = [&grid.x, &grid.y].map(|a| (a.start_mm() - beyond, a.end_mm() + beyond));
    let count = |(from, to): (f64, f64)| ((to - from) / pitch).ceil() as usize + 1;
    let (along, across) = if kind.is_multiple_of(2) { (x, y) } else { (y, x) };
    let mut path = Vec::new();
    for line in 0..count(across) {
        let v = across.0 + pitch * line as f64;
        let n = count(along);
        for k in 0..n {
            let k = if line % 2 == 0 { k } else { n - 1 - k };
            let u = along.0 + pitch * k as f64;
            path.push(if kind.is_multiple_of(2) { [u, v] } else { [v, u] });
        }
    }
    if kind >= 2 {
        path.reverse();
    }
    path
}

/// Returns the time of every piece, s, by multiplicative rounds from an even dwell, with the tool that the planner
/// assumes.
pub fn planned(
    grid: &Grid,
    path: &[[f64; 2]],
    wanted: &Array2<f64>,
    rate: &dyn Fn(f64, f64) -> f64,
) -> Vec<f64> {
    // The middle of a piece stands for it: what this errs by is in every plan alike.
    let pixels = grid.x.len() * grid.y.len();
    let of: Vec<Vec<(usize, f64)>> = path
        .windows(2)
        .map(|ends| {
            let at = [0, 1].map(|a| 0.5 * (ends[0][a] + ends[1][a]));
            let one = |i: usize| {
                let (r, c) = (i / grid.x.len(), i % grid.x.len());
                (i, rate(grid.x.coordinate_mm(c) - at[0], grid.y.coordinate_mm(r) - at[1]))
            };
            (0..pixels).map(one).filter(|(_, v)| *v > LEAST_RATE).collect()
        })
        .collect();
    let wanted: Vec<f64> = wanted.iter().copied().collect();
    let weights: Vec<f64> =
        of.iter().map(|piece| piece.iter().map(|(_, v)| v).sum::<f64>().max(1e-9)).collect();
    let mut seconds = vec![wanted.iter().sum::<f64>() / weights.iter().sum::<f64>(); of.len()];
    for _ in 0..ROUNDS {
        let mut done = vec![1e-9; pixels];
        for (piece, h) in of.iter().zip(&seconds) {
            piece.iter().for_each(|(i, v)| done[*i] += v * h);
        }
        for ((piece, h), weight) in of.iter().zip(&mut seconds).zip(&weights) {
            let ratio = piece.iter().map(|(i, v)| v * wanted[*i] / done[*i]).sum::<f64>() / weight;
            *h = (*h * ratio).max(1e-3);
        }
    }
    seconds
}

pub fn motion(path: &[[f64; 2]], seconds: &[f64]) -> Trajectory {
    let mut motion = TrajectoryBuilder::default();
    for (k, h) in seconds.iter().enumerate() {
        let line = |a: usize| [path[k][a], (path[k + 1][a] - path[k][a]) / h, 0.0, 0.0];
        motion.push(*h, [line(0), line(1)], true, None);
    }
    motion.build().unwrap()
}

/// Returns the removal by a direct sum, nm: the analytic tool at the displaced points, four per piece, with the rate of
/// their time.
fn executed(grid: &Grid, trajectory: &Trajectory, tool: &Tool, t: &Truth) -> Array2<f64> {
    let middle = middle(grid);
    let (sine, cosine) = t.rotation_rad.sin_cos();
    let breaks = trajectory.break_time_s();
    let total = breaks[breaks.len() - 1];
    let mut removal = Array2::zeros(grid.shape());
    for (k, c) in trajectory.coefficient_mm().iter().enumerate() {
        let h = breaks[k + 1] - breaks[k];
        let drift = 1.0 + t.drift * ((breaks[k] + 0.5 * h) / total - 0.5) / (1.0 + t.rate);
        for node in NODES {
            let d = [0, 1]
                .map(|a| (1.0 + t.magnification) * (c[a][0] + c[a][1] * node * h - middle[a]));
            let at = [
                middle[0] + cosine * d[0] - sine * d[1] + t.offset_mm[0],
                middle[1] + sine * d[0] + cosine * d[1] + t.offset_mm[1],
            ];
            let reach = REACH_SIGMA * tool.sigma_mm;
            let near = |axis: &Axis, at: f64| {
                let of = |mm: f64| {
                    ((mm - axis.start_mm()) / axis.step_mm()).clamp(0.0, axis.len() as f64)
                };
                of(at - reach) as usize..of(at + reach).ceil() as usize
            };
            for r in near(&grid.y, at[1]) {
                for c in near(&grid.x, at[0]) {
                    let (x, y) = (grid.x.coordinate_mm(c) - at[0], grid.y.coordinate_mm(r) - at[1]);
                    if x * x + y * y < reach * reach {
                        removal[[r, c]] += tool.rate(x, y, t) * 0.25 * h * drift;
                    }
                }
            }
        }
    }
    removal
}
