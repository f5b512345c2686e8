//! PVT for ion beams: T. Wang et al., J. Manuf. Process. 2023, doi 10.1016/j.jmapro.2023.01.005.

use ndarray::Array2;
use planish_dwell::{
    bounded_least_squares::{self, Bound},
    columns::Columns,
    problem::Problem,
    udo,
};
use planish_numerics::statistics::{fit_plane, subtract_plane};
use planish_refine as refine;
use planish_schedule::{
    baselines::{position, pvt_as_published},
    constant_acceleration, pvt,
};
use planish_simulate::{SimulationSettings as Settings, simulate};
use planish_testkit::{ion_beam, mirror::mirror};
use planish_tool::tif_fit;
use planish_toolpath::{
    Construction, MazeSettings, RandomAdaptiveSettings, RasterSettings, Tree, maze,
    random_adaptive, raster, statistics,
};
use planish_types::{DwellTime, Surface, Tif, ToolPath, Trajectory};
use planish_verify::{Verdict, VerifySettings, verify};

use crate::{
    Outcome,
    claim::{Claim, significant},
    figure::{Axis, Series, chart, maps, stacked},
    fixture,
    node_velocities::{self, correlation},
};

/// Kind of the floor on a path. If the points are not uniform, the shift at the end removes another shape.
/// So on the random path the floor is in the model, and the residual is that of path and motion.
fn floor_on(name: &str) -> udo::Floor {
    if name == "random" { udo::Floor::Model } else { udo::Floor::Shift }
}

const NAMES: [&str; 3] = ["raster", "maze", "random"];

/// A path with dwell times for a part.
struct Run<'a> {
    desired: &'a Surface,
    tif: &'a Tif,
    path: ToolPath,
    dwell: DwellTime,
}

impl Run<'_> {
    /// Residual of a motion.
    fn residual(&self, trajectory: &Trajectory) -> Surface {
        let done = simulate(trajectory, self.tif, self.desired, Settings::Gridded);
        done.expect("a removal").removal.residual().clone()
    }

    /// RMS of the residual of a motion, plane removed, nm.
    fn residual_nm(&self, trajectory: &Trajectory) -> f64 {
        self.residual(trajectory).detilted_rms_nm()
    }

    /// Corner error: largest distance of a motion from the polygon of the path, over the part, mm. A
    /// motion is compared with its own segment of the path and the two beside it.
    fn distance_mm(&self, trajectory: &Trajectory) -> f64 {
        let points = self.path.point_mm();
        let to = |k: usize, p: [f64; 2]| {
            let (a, b) = (points[k], points[k + 1]);
            let (d, e) = ([b[0] - a[0], b[1] - a[1]], [p[0] - a[0], p[1] - a[1]]);
            let along = (d[0] * e[0] + d[1] * e[1]) / (d[0] * d[0] + d[1] * d[1]);
            let along = along.clamp(0.0, 1.0);
            (e[0] - along * d[0]).hypot(e[1] - along * d[1])
        };
        let (last, grid) = (self.path.len() - 1, self.desired.grid());
        let within = |a: &planish_types::Axis, v: f64| (a.start_mm()..=a.end_mm()).contains(&v);
        let mut largest = 0.0_f64;
        for segment in trajectory.segments() {
            let Some(k) = segment.dwell_index else { continue };
            for i in 0..=16 {
                let p = segment.position_mm(segment.duration_s * f64::from(i) / 16.0);
                if !(within(&grid.x, p[0]) && within(&grid.y, p[1])) {
                    continue;
                }
                let near = (k.saturating_sub(1)..=(k + 1).min(last)).map(|k| to(k, p));
                largest = largest.max(near.fold(f64::MAX, f64::min));
            }
        }
        largest
    }

    /// Executed residual after refinement against the motion, plane removed, nm RMS.
    fn refined_nm(&self) -> f64 {
        // Enough that no round improves it much: of fewer, rounding decides how far they come.
        let mut settings = refine::RefineSettings { max_rounds: 8, ..Default::default() };
        settings.dwell.min_dwell = Bound::SecondsPerMm(0.02);
        let done = refine::refine(self.desired, self.tif, &self.path, &ion_beam(), None, &settings);
        self.residual_nm(&done.expect("a refined plan").trajectory)
    }

    fn position(&self) -> Trajectory {
        position::schedule(&self.path, &self.dwell).expect("a schedule")
    }

    fn pvt(&self, mode: pvt::Mode) -> Trajectory {
        // The publication has no tolerance of the distance from the path.
        let settings =
            pvt::PvtSettings { max_path_distance_mm: Some(1e9), ..pvt::PvtSettings::new(mode) };
        pvt::schedule(&self.path, &self.dwell, &ion_beam(), &settings).expect("a motion").trajectory
    }

    fn constant_acceleration(
        &self,
    ) -> planish_schedule::Schedule<constant_acceleration::ConstantAccelerationReport> {
        constant_acceleration::schedule(&self.path, &self.dwell, &ion_beam()).expect("a motion")
    }
}

fn judge(trajectory: &Trajectory) -> Verdict {
    verify(trajectory, &ion_beam(), &VerifySettings::default()).expect("a verdict")
}

fn largest(of: [f64; 2]) -> f64 {
    of[0].max(of[1])
}

fn overshoot_um(trajectory: &Trajectory) -> f64 {
    1e3 * largest(judge(trajectory).max_overshoot_mm)
}

/// Largest step of the acceleration between segments of a motion, mm/s^2.
fn acceleration_step(t: &Trajectory) -> f64 {
    let step = |a: usize| {
        t.segments().zip(t.segments().skip(1)).map(move |(s, n)| {
            let (c, d) = (s.coefficient_mm[a], n.coefficient_mm[a]);
            (2.0 * d[2] - 2.0 * c[2] - 6.0 * c[3] * s.duration_s).abs()
        })
    };
    step(0).chain(step(1)).fold(0.0, f64::max)
}

/// RMS of the acceleration over time, both axes, mm/s^2.
fn rms_acceleration(t: &Trajectory) -> f64 {
    // a is linear on a segment: integral a^2 = (h/3) (a0^2 + a0 a1 + a1^2)
    let energy: f64 = t
        .segments()
        .flat_map(|s| {
            s.coefficient_mm.map(|c| {
                let (a0, a1) = (2.0 * c[2], 2.0 * c[2] + 6.0 * c[3] * s.duration_s);
                s.duration_s / 3.0 * (a0 * a0 + a0 * a1 + a1 * a1)
            })
        })
        .sum();
    (energy / t.total_time_s()).sqrt()
}

/// The three kinds of path with lines 1 mm apart.
fn own_path(name: &str, part: &Surface, tif: &Tif) -> ToolPath {
    let overscan_mm = largest(tif.half_size_mm());
    match name {
        "raster" => raster(part, &RasterSettings::new(1.0, 1.0, overscan_mm)).expect("a raster"),
        "maze" => {
            maze(
                part,
                &MazeSettings {
                    pitch_mm: 1.0,
                    step_mm: 1.0,
                    overscan_mm,
                    corner_radius_mm: 0.0,
                    tree: Tree::DepthFirst { straightness: 0.0 },
                    open: false,
                    seed: 1,
                },
            )
            .expect("a maze")
            .path
        }
        _ => random_path(part, tif, 1),
    }
}

/// The random adaptive path: denser where more is to be removed, with about as many dwell points as the published
/// one (2466).
fn random_path(part: &Surface, tif: &Tif, seed: u64) -> ToolPath {
    let settings = RandomAdaptiveSettings {
        pitch_mm: 1.13,
        overscan_mm: largest(tif.half_size_mm()),
        step_mm: Some(1.0),
        contrast: 1.0,
        construction: Construction::MeshTree,
        rounding_passes: 1,
        seed,
    };
    random_adaptive(part, &settings).expect("a path").path
}

/// Seeds of the random paths; the tables show medians over them.
const SEEDS: [u64; 5] = [1, 2, 3, 4, 5];

/// Median and range of an odd number of values.
fn median_and_range(values: &[f64]) -> (f64, String) {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    let median = sorted[sorted.len() / 2];
    let [low, high] = [sorted[0], sorted[sorted.len() - 1]].map(|v| significant(v, 3));
    (median, format!("{} ({low} to {high})", significant(median, 3)))
}

/// UDO with 0.1 s per point at least: as the source has it by a shift of all at the end, or in the model.
fn udo_dwell(
    part: &Surface,
    tif: &Tif,
    path: &ToolPath,
    iterations: usize,
    floor: udo::Floor,
) -> DwellTime {
    let problem = Problem {
        desired: part,
        tif,
        path,
        weight: None,
        columns: Columns::Point,
        min_dwell: Bound::Seconds(0.1),
    };
    let settings =
        udo::UdoSettings { floor, max_iterations: iterations, ..udo::UdoSettings::default() };
    udo::solve(&problem, &settings).expect("dwell times").dwell
}

/// Numbers of rounds of UDO that are shown, because the source does not state its number.
const UDO_ROUNDS: [usize; 4] = [0, 1, 2, 10];

fn statement(what: &str, paper: &str, ours: String, holds: bool) -> Claim {
    Claim::statement(what, paper, ours, holds)
}

fn slashes(values: &[f64]) -> String {
    values.iter().map(|v| significant(*v, 3)).collect::<Vec<_>>().join(" / ")
}

fn nm(values: &[f64]) -> String {
    format!("{} nm", slashes(values))
}

/// Largest over smallest.
fn spread(values: &[f64]) -> f64 {
    let (low, high) = values.iter().fold((f64::MAX, 0.0_f64), |(l, h), v| (l.min(*v), h.max(*v)));
    high / low
}

fn ascending(v: &[f64]) -> bool {
    v.windows(2).all(|w| w[0] < w[1])
}

pub fn reproduce() -> Outcome {
    let part = fixture("flat-92x16");
    let runs = NAMES.map(|name| {
        let path = own_path(name, &part.surface, &part.tif);
        let dwell = udo_dwell(&part.surface, &part.tif, &path, 10, floor_on(name));
        Run { desired: &part.surface, tif: &part.tif, path, dwell }
    });
    let smooth = runs.each_ref().map(|r| r.pvt(pvt::Mode::Smooth));
    let mut tables = vec![("pvt", on_the_fixture(&runs, &smooth))];
    let on_the_mirror = on_the_mirror().map(|mut rows| {
        rows.extend(node_velocities::rows());
        rows
    });
    tables.extend(on_the_mirror.map(|rows| ("pvt-mirror", rows)));
    let figures = vec![
        ("pvt-velocity", velocities(&runs[1])),
        ("pvt-paths", residual_maps(&runs, &smooth)),
        ("pvt-paths-velocity", velocities_along(&smooth)),
    ];
    Outcome { tables, figures }
}

/// Fig. 6: residual maps of PVT along the three paths, with their RMS.
fn residual_maps(runs: &[Run<'_>; 3], smooth: &[Trajectory; 3]) -> String {
    let left = [0, 1, 2].map(|k| without_plane(&runs[k].residual(&smooth[k])));
    let titled = [0, 1, 2].map(|k| {
        let rms = significant(left[k].detilted_rms_nm(), 3);
        (format!("{}, {rms} nm", NAMES[k]), &left[k])
    });
    maps(&titled, 5, 1.0, 8.0)
}

fn without_plane(map: &Surface) -> Surface {
    let (z, grid) = (map.height_nm().view(), map.grid());
    let (x, y) = (grid.x.coordinates(), grid.y.coordinates());
    let plane = fit_plane(z, &x, &y).expect("a plane");
    Surface::new(*grid, subtract_plane(z, &x, &y, plane)).expect("a map")
}

/// Fig. 6: velocities along the three paths, from the middle of each on.
fn velocities_along(smooth: &[Trajectory; 3]) -> String {
    let x = Axis { label: "time, s", ticks: (0..=6).map(f64::from).collect(), log: false };
    let y = ["raster, mm/s", "maze, mm/s", "random path, mm/s"].map(|label| Axis {
        label,
        ticks: vec![-12.0, -6.0, 0.0, 6.0, 12.0],
        log: false,
    });
    let charts = [0, 1, 2].map(|k| {
        let along = |axis, name| velocity(&smooth[k], axis, name, [middle_s(&smooth[k]), 6.0]);
        (&x, &y[k], vec![along(1, "along y"), along(0, "along x")])
    });
    stacked(200.0, &charts)
}

fn on_the_fixture(runs: &[Run; 3], smooth: &[Trajectory; 3]) -> Vec<Claim> {
    let monotone = runs[1].pvt(pvt::Mode::Monotone);
    let constant = runs[1].constant_acceleration();
    let residual: Vec<f64> = runs.iter().zip(smooth).map(|(r, t)| r.residual_nm(t)).collect();
    let variation: Vec<f64> = smooth.iter().map(rms_acceleration).collect();
    let corner = [0, 1, 2].map(|k| 1e3 * runs[k].distance_mm(&smooth[k]));
    let refined = runs.each_ref().map(Run::refined_nm);
    let ideal = runs[0].residual_nm(&runs[0].position());
    let steps = [&smooth[1], &constant.trajectory].map(acceleration_step);
    let [smooth_um, monotone_um] = [&smooth[1], &monotone].map(overshoot_um);
    // A segment of this motion has two pieces; its own report counts by segment.
    let constant_um = 1e3 * largest(constant.report.largest_overshoot_mm);
    let executed = residual[0] / ideal;
    vec![
        statement(
            "the executed raster leaves what dwelling at the points leaves",
            "the same",
            format!("{} of it", significant(executed, 3)),
            (executed - 1.0).abs() < 0.1,
        ),
        statement(
            "velocity varies more on raster, maze, random path (RMS acceleration)",
            "in this order",
            format!("{} mm/s^2", slashes(&variation)),
            ascending(&variation),
        ),
        statement(
            "residual of PVT on raster, maze, random path",
            "in this order",
            nm(&residual),
            ascending(&residual),
        ),
        statement(
            "corner error of PVT on the same (distance from the path, over the part)",
            "in this order (Fig. 6)",
            format!("{} um", slashes(&corner)),
            corner[0] < corner[1] && corner[0] < corner[2],
        ),
        Claim::check(
            "the order of the residuals vanishes when the dwell times are refined against the motion (at least 0.02 s/mm)",
            nm(&refined),
            spread(&refined) < 1.06,
        ),
        statement(
            "PVT is smoother than constant acceleration (largest step of the acceleration, maze)",
            "continuous; steps",
            format!("{}; {:.0} mm/s^2", tiny(steps[0]), steps[1]),
            steps[0] < 1e-6 && steps[1] > 100.0,
        ),
        statement(
            "constant acceleration overshoots (maze, segments in x and y)",
            "it does",
            format!(
                "{} and {}, up to {} um",
                constant.report.visible_overshoot_segments[0],
                constant.report.visible_overshoot_segments[1],
                significant(constant_um, 3)
            ),
            constant.report.overshoot_segments.iter().all(|n| *n > 0),
        ),
        statement(
            "PVT avoids the overshoot (maze, smooth: continuous acceleration)",
            "less than constant acceleration",
            format!("{} um against {} um", significant(smooth_um, 3), significant(constant_um, 3)),
            smooth_um < constant_um,
        )
        .differs("a motion with continuous acceleration swings beyond the corners"),
        statement(
            "PVT avoids the overshoot (maze, monotone)",
            "none",
            format!("{} um", tiny(monotone_um)),
            monotone_um < 1e-6,
        )
        .remark("at the price of steps in the acceleration"),
    ]
}

fn tiny(value: f64) -> String {
    if value < 1e-6 { "below 1e-6".into() } else { significant(value, 3) }
}

/// RMS without the pit: pixels within 1.2 mm of the one with the lowest residual do not count.
fn without_pit_nm(run: &Run<'_>, trajectory: &Trajectory) -> f64 {
    let residual = run.residual(trajectory);
    let (z, grid) = (residual.height_nm(), residual.grid());
    let mean = residual.statistics().mean;
    let far = z.indexed_iter().max_by(|a, b| (a.1 - mean).abs().total_cmp(&(b.1 - mean).abs()));
    let ((row, column), _) = far.expect("a map has pixels");
    let masked = Array2::from_shape_fn(z.dim(), |(r, c)| {
        let (dy, dx) = (
            grid.y.coordinate_mm(r) - grid.y.coordinate_mm(row),
            grid.x.coordinate_mm(c) - grid.x.coordinate_mm(column),
        );
        if dx.abs().max(dy.abs()) <= 1.2 { f64::NAN } else { z[[r, c]] }
    });
    Surface::new(*grid, masked).expect("a map").detilted_rms_nm()
}

/// Random paths on one map, by seeds: medians, and medians with ranges.
struct Seeds {
    minutes: (f64, String),
    position_nm: (f64, String),
    shifted_nm: (f64, String),
    executed_nm: (f64, String),
    corner_um: (f64, String),
}

impl Seeds {
    /// Medians and ranges over the runs with the floor in the model, and over those with the floor by a
    /// shift.
    fn new(model: &[Run<'_>; 5], shifted: &[Run<'_>; 5]) -> Self {
        let of = |runs: &[Run<'_>; 5], f: &dyn Fn(&Run<'_>) -> f64| {
            median_and_range(&runs.each_ref().map(f))
        };
        let at_points = |r: &Run<'_>| r.residual_nm(&r.position());
        let smooth = model.each_ref().map(|r| r.pvt(pvt::Mode::Smooth));
        let by_motion = |f: &dyn Fn(&Run<'_>, &Trajectory) -> f64| {
            let values: Vec<f64> = model.iter().zip(&smooth).map(|(r, t)| f(r, t)).collect();
            median_and_range(&values)
        };
        Self {
            minutes: of(model, &|r| r.dwell.total_s() / 60.0),
            position_nm: of(model, &at_points),
            shifted_nm: of(shifted, &at_points),
            executed_nm: by_motion(&|r, t| r.residual_nm(t)),
            corner_um: by_motion(&|r, t| 1e3 * r.distance_mm(t)),
        }
    }
}

fn on_the_mirror() -> Option<Vec<Claim>> {
    let mirror = mirror()?;
    let (desired, tif) = (&mirror.desired, &mirror.tif);
    let run = |path: ToolPath, dwell: DwellTime| Run { desired, tif, path, dwell };
    let raster = run(mirror.path("raster"), mirror.dwell("raster"));
    let maze = run(mirror.path("maze"), mirror.dwell("maze"));
    let on_random = |seed: u64, floor: udo::Floor| {
        let path = random_path(desired, tif, seed);
        let dwell = udo_dwell(desired, tif, &path, 10, floor);
        run(path, dwell)
    };
    let seeds = SEEDS.map(|seed| on_random(seed, udo::Floor::Model));
    let shifted = SEEDS.map(|seed| on_random(seed, udo::Floor::Shift));
    let random = &seeds[0];
    let runs = [&raster, &maze, random];
    let of_seeds = Seeds::new(&seeds, &shifted);

    let smooth = runs.map(|r| r.pvt(pvt::Mode::Smooth));
    let residual: Vec<f64> = runs.iter().zip(&smooth).map(|(r, t)| r.residual_nm(t)).collect();
    let variation: Vec<f64> = smooth.iter().map(rms_acceleration).collect();
    let position = runs.map(|r| r.residual_nm(&r.position()));
    let constant = maze.constant_acceleration();
    let monotone = maze.pvt(pvt::Mode::Monotone);
    let [smooth_um, monotone_um] = [&smooth[1], &monotone].map(overshoot_um);
    // A segment of this motion has two pieces; its own report counts by segment.
    let constant_um = 1e3 * largest(constant.report.largest_overshoot_mm);
    let steps = [&smooth[1], &constant.trajectory].map(acceleration_step);
    let published =
        pvt_as_published::schedule(&maze.path, &maze.dwell, &ion_beam(), &Default::default());
    let published = published.expect("a motion").report;
    let udo = UDO_ROUNDS.map(|rounds| {
        let dwell = udo_dwell(desired, tif, &raster.path, rounds, udo::Floor::Shift);
        let run = run(raster.path.clone(), dwell);
        let alike = correlation(run.dwell.dwell_s(), raster.dwell.dwell_s());
        [run.residual_nm(&run.position()), alike]
    });
    let [udo_nm, udo_alike] = [0, 1].map(|k| udo.map(|of| of[k]));
    let best = bounded_least_squares::solve(
        desired,
        tif,
        &raster.path,
        None,
        &bounded_least_squares::BoundedSettings {
            columns: Columns::Point,
            min_dwell: Bound::Seconds(0.1),
            tikhonov: 2.8e-8,
            slope_weight: 0.0,
            ..bounded_least_squares::BoundedSettings::default()
        },
    )
    .expect("dwell times");
    let best = run(raster.path.clone(), best.dwell);
    let best_nm = best.residual_nm(&best.position());
    let (ny, nx) = desired.grid().shape();
    let without_pit = without_pit_nm(&raster, &raster.position());
    let measured =
        Surface::new(*desired.grid(), mirror.map("after_ibf_measured_nm")).expect("a map");
    let fitted = tif_fit::fit(tif, tif_fit::TifModel::Gaussian).expect("a fit").1.components[0];
    let refined = runs.map(Run::refined_nm);
    let corner = [0, 1, 2].map(|k| 1e3 * runs[k].distance_mm(&smooth[k]));
    let minutes = |r: &Run<'_>| r.dwell.total_s() / 60.0;
    let paths = [&raster, &maze].map(|r| statistics(&r.path, desired));
    Some(vec![
        // The paper states three digits: half of the last one is the tolerance.
        Claim::number("initial error, RMS", "nm", 6.32, desired.statistics().rms, 1e-3)
            .by_arithmetic("the RMS of the published map"),
        statement("size of the map", "168 x 985 px", format!("{ny} x {nx} px"), (ny, nx) == (168, 985))
            .by_arithmetic("the shape of the published array"),
        Claim::check(
            "the TIF: peak, standard deviations of the fitted Gaussian, volume per time",
            format!(
                "{} nm/s; {} and {} mm; {} nm mm^2/s",
                significant(tif.peak_nm_per_s(), 4),
                significant(fitted.sigma_mm[0], 4),
                significant(fitted.sigma_mm[1], 4),
                significant(tif.vrr_nm_mm2_per_s(), 5)
            ),
            (tif.peak_nm_per_s() / 7.961 - 1.0).abs() < 1e-4
                && (tif.vrr_nm_mm2_per_s() / 147.33 - 1.0).abs() < 1e-4,
        ),
        Claim::number("distance of the dwell points", "mm", 0.5, paths[0].median_step_mm, 1e-2)
            .differs("the published points are 1 mm apart, on both paths"),
        Claim::number("total time, raster", "min", 8.15, minutes(&raster), 1e-3)
            .by_arithmetic("the sum of the published dwell times"),
        Claim::number("total time, maze", "min", 8.17, minutes(&maze), 1e-3)
            .by_arithmetic("the sum of the published dwell times"),
        statement(
            "total time, random path (five seeds, median and range)",
            "7.64 min",
            format!("{} min", of_seeds.minutes.1),
            (of_seeds.minutes.0 / 7.64 - 1.0).abs() < 0.02,
        )
        .differs("own paths and own dwell times: the published ones are not in the mirror"),
        Claim::number("published dwell times at the points, raster, RMS", "nm", 0.204, position[0], 3e-3),
        Claim::number("the same, maze", "nm", 0.263, position[1], 3e-3),
        statement(
            "UDO at the points, random path, the floor by a shift as published (five seeds)",
            "0.513 nm",
            format!("{} nm", of_seeds.shifted_nm.1),
            (of_seeds.shifted_nm.0 / 0.513 - 1.0).abs() < 0.1,
        )
        .differs("our own paths and dwell times: those of the paper are not in the mirror"),
        Claim::check(
            "the same over what the raster leaves (median)",
            format!("{} times", significant(of_seeds.shifted_nm.0 / position[0], 2)),
            of_seeds.shifted_nm.0 > 2.0 * position[0],
        )
        .remark("the paper's ratio is 2.5; both say that the random path leaves more than twice as much"),
        Claim::check(
            "the same with the floor in the model",
            format!("{} nm", of_seeds.position_nm.1),
            of_seeds.position_nm.0 < 0.6 * of_seeds.shifted_nm.0,
        )
        .remark("most of what the random path leaves is the shift, not the path"),
        statement(
            "what the random path leaves comes of its corners (PVT of the same five, over the median at the points)",
            "it does",
            format!(
                "{} nm, {} of it",
                of_seeds.executed_nm.1,
                significant(of_seeds.executed_nm.0 / of_seeds.position_nm.0, 3)
            ),
            of_seeds.executed_nm.0 > 1.1 * of_seeds.position_nm.0,
        )
        .differs("the motion around the corners leaves no more than dwelling at the points does"),
        Claim::check(
            "one pit of 0.6 mm is two fifths of the variance that the raster leaves (RMS without it)",
            format!("{} nm", significant(without_pit, 3)),
            (0.3..0.5).contains(&(1.0 - (without_pit / position[0]).powi(2))),
        ),
        Claim::number("raster executed by PVT, RMS", "nm", 0.19, residual[0], 0.05),
        Claim::number("the map measured after the polish, over it", "", 1.0, measured.detilted_rms_nm() / residual[0], 0.1)
            .remark(format!("{} nm, from the mirror's file", significant(measured.detilted_rms_nm(), 3))),
        statement(
            "residual of PVT on raster, maze, random path",
            "in this order",
            nm(&residual),
            ascending(&residual),
        ),
        statement(
            "velocity varies more in the same order (RMS acceleration)",
            "in this order",
            format!("{} mm/s^2", slashes(&variation)),
            ascending(&variation),
        ),
        statement(
            "corner error of PVT on raster, maze, random path (distance from the path, over the part)",
            "in this order (Fig. 6)",
            format!("{} um", slashes(&corner)),
            corner[0] < corner[1] && corner[0] < corner[2],
        ),
        Claim::check(
            "the same of the five random paths",
            format!("{} um", of_seeds.corner_um.1),
            of_seeds.corner_um.0 > corner[0],
        ),
        Claim::check(
            "the order of the residuals vanishes when the dwell times are refined against the motion (at least 0.02 s/mm)",
            nm(&refined),
            spread(&refined) < 1.06,
        ),
        Claim::check(
            "maze executed by constant acceleration over the same by PVT (smooth), RMS",
            format!(
                "{} over {} nm",
                significant(maze.residual_nm(&constant.trajectory), 3),
                significant(residual[1], 3)
            ),
            maze.residual_nm(&constant.trajectory) > residual[1],
        ),
        statement(
            "constant acceleration overshoots (maze, segments in x and y)",
            "it does",
            format!("{} and {}, up to {} um", constant.report.overshoot_segments[0], constant.report.overshoot_segments[1], significant(constant_um, 3)),
            constant.report.overshoot_segments.iter().all(|n| *n > 0),
        ),
        statement(
            "PVT is smoother (largest step of the acceleration, maze)",
            "continuous; steps",
            format!("{}; {:.0} mm/s^2", tiny(steps[0]), steps[1]),
            steps[0] < 1e-6 && steps[1] > 100.0,
        ),
        statement(
            "PVT avoids the overshoot (maze, smooth)",
            "less than constant acceleration",
            format!("{} um against {} um", significant(smooth_um, 3), significant(constant_um, 3)),
            smooth_um < constant_um,
        )
        .differs("a motion with continuous acceleration swings beyond the corners"),
        statement(
            "PVT avoids the overshoot (maze, monotone)",
            "none",
            format!("{} um", tiny(monotone_um)),
            monotone_um < 1e-6,
        )
        .remark("at the price of steps in the acceleration"),
        statement(
            "the least squares of Eq. 14 pass through the points (maze)",
            "they do",
            format!("up to {} mm off", significant(largest(published.largest_position_error_mm), 2)),
            largest(published.largest_position_error_mm) < 1e-6,
        )
        .differs("the objective adds lengths, velocities and accelerations; with the second as the unit of time lengths weigh least"),
        statement(
            "UDO on the raster, RMS after 0 / 1 / 2 / 10 rounds",
            "0.204 nm; rounds not given",
            nm(&udo_nm),
            udo_nm.windows(2).all(|w| w[1] < w[0]) && udo_nm[0] > 0.204 && 0.204 > udo_nm[3],
        )
        .remark("within the range; the source's interpolation beyond the edge is another one, so its rounds cannot be told"),
        statement(
            "correlation of these dwell times with the published ones",
            "1",
            udo_alike.map(|v| significant(v, 4)).join(" / "),
            udo_alike.iter().all(|v| *v > 0.98),
        ),
        Claim::small("least squares with the same floor on the same points, RMS", "nm", 0.204, best_nm, 0.01)
            .better("it minimises what UDO only lowers"),
        Claim::small("the same, total time", "min", 8.15, minutes(&best), 0.01)
            .better("the floor is part of the problem, not added afterwards"),
    ])
}

/// Time at which half of the segments are done, s.
fn middle_s(t: &Trajectory) -> f64 {
    t.break_time_s()[t.len() / 2]
}

/// Velocity of an axis in a part of a motion, (start, duration) in s.
fn velocity(t: &Trajectory, axis: usize, name: &'static str, part_s: [f64; 2]) -> Series {
    let [start, duration] = part_s;
    let mut points = Vec::new();
    for s in t.segments() {
        for k in 0..10 {
            let u = s.duration_s * f64::from(k) / 10.0;
            let at = s.start_s + u - start;
            let c = s.coefficient_mm[axis];
            if (0.0..=duration).contains(&at) {
                points.push([at, c[1] + 2.0 * c[2] * u + 3.0 * c[3] * u * u]);
            }
        }
    }
    Series { name, points, dots: false }
}

/// x velocity in the middle of the maze.
fn velocities(run: &Run<'_>) -> String {
    let constant = run.constant_acceleration().trajectory;
    let (smooth, monotone) = (run.pvt(pvt::Mode::Smooth), run.pvt(pvt::Mode::Monotone));
    let middle = middle_s(&constant);
    let curve = |name, t| velocity(t, 0, name, [middle, 4.0]);
    chart(
        &Axis { label: "time, s", ticks: vec![0.0, 1.0, 2.0, 3.0, 4.0], log: false },
        &Axis {
            label: "velocity along x, mm/s",
            ticks: vec![-8.0, -4.0, 0.0, 4.0, 8.0, 12.0],
            log: false,
        },
        &[
            curve("constant acceleration", &constant),
            curve("PVT, smooth", &smooth),
            curve("PVT, monotone", &monotone),
        ],
    )
}
