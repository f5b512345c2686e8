//! A part that is shifted or mirrored must give a plan that is shifted or mirrored: a fixture mirror goes
//! through path, dwell times, schedule and simulation. The test finds a sign, an axis or an offset that one
//! stage has and another one lacks.

use std::fs;

use ndarray::{Array2, Axis as Dimension, s};
use planish_dwell::bounded_least_squares::{self, Bound};
use planish_fixture::{Recipe, make};
use planish_schedule::{baselines::position, constant_acceleration, pvt, trig_spline};
use planish_simulate::simulate;
use planish_testkit::{
    ion_beam,
    maps::{largest_difference, largest_magnitude},
    workspace,
};
use planish_toolpath::{RasterSettings, raster};
use planish_types::{Axis, DwellTime, Grid, Surface, Tif, ToolPath, Trajectory};

/// x -> sign x + shift, along x and y.
#[derive(Clone, Copy, Debug)]
struct Motion {
    mirrored: [bool; 2],
    shift_mm: [f64; 2],
}

impl Motion {
    const fn shift(x_mm: f64, y_mm: f64) -> Self {
        Self { mirrored: [false; 2], shift_mm: [x_mm, y_mm] }
    }

    const fn mirror(x: bool, y: bool) -> Self {
        Self { mirrored: [x, y], shift_mm: [0.0; 2] }
    }

    fn coordinate(&self, axis: usize, mm: f64) -> f64 {
        if self.mirrored[axis] { self.shift_mm[axis] - mm } else { self.shift_mm[axis] + mm }
    }

    fn grid(&self, grid: &Grid) -> Grid {
        let moved = |k: usize, axis: &Axis| {
            let start = if self.mirrored[k] { axis.end_mm() } else { axis.start_mm() };
            Axis::new(self.coordinate(k, start), axis.step_mm(), axis.len()).unwrap()
        };
        Grid { x: moved(0, &grid.x), y: moved(1, &grid.y) }
    }

    fn array(&self, array: &Array2<f64>) -> Array2<f64> {
        let mut array = array.clone();
        for (k, of) in [Dimension(1), Dimension(0)].into_iter().enumerate() {
            if self.mirrored[k] {
                array.invert_axis(of);
            }
        }
        array.as_standard_layout().into_owned()
    }

    fn surface(&self, surface: &Surface) -> Surface {
        Surface::new(self.grid(surface.grid()), self.array(surface.height_nm())).unwrap()
    }

    /// The tool turns with the part and is not shifted: its coordinates are offsets.
    fn tif(&self, tif: &Tif) -> Tif {
        let turned = Self { shift_mm: [0.0; 2], ..*self };
        Tif::new(turned.grid(tif.grid()), turned.array(tif.rate_nm_per_s())).unwrap()
    }

    fn path(&self, path: &ToolPath) -> ToolPath {
        let moved = |points: &[[f64; 2]]| {
            points.iter().map(|p| [0, 1].map(|k| self.coordinate(k, p[k]))).collect()
        };
        let (points, dwell_points) = (moved(path.point_mm()), moved(path.dwell_point_mm()));
        ToolPath::new(points, dwell_points, path.tool_on().to_vec(), path.pass_idx().to_vec())
            .unwrap()
    }
}

/// The coupon without its lower left corner, and a tool that is lopsided along both axes.
///
/// The tool falls to zero at its border: at a step a line of the path along a line of pixels would be within
/// it or not by rounding.
fn part() -> (Surface, Tif) {
    let recipe = fs::read_to_string(workspace().join("fixtures/coupon.json")).unwrap();
    let recipe: Recipe = serde_json::from_str(&recipe).unwrap();
    let made = make(&recipe).unwrap();
    let mut height = made.surface.height_nm().clone();
    height.slice_mut(s![..9, ..14]).fill(f64::NAN);
    let grid = *made.tif.grid();
    let half = grid.x.end_mm();
    let rate = Array2::from_shape_fn(grid.shape(), |(r, c)| {
        let (x, y) = (grid.x.coordinate_mm(c) / half, grid.y.coordinate_mm(r) / half);
        let window = ((1.0 - x * x) * (1.0 - y * y)).powi(2);
        made.tif.rate_nm_per_s()[[r, c]] * window * (1.0 + 0.5 * x - 0.3 * y)
    });
    (Surface::new(*made.surface.grid(), height).unwrap(), Tif::new(grid, rate).unwrap())
}

fn path(surface: &Surface) -> ToolPath {
    let settings = RasterSettings::new(1.0, 1.0, 3.5);
    raster(surface, &settings).unwrap()
}

/// Natural residual at which the dwell solver stops, s. Larger: two solutions differ more. Smaller: more
/// steps, down to rounding. Chosen: far below any need of a plan.
const NATURAL_RESIDUAL_S: f64 = 1e-11;

/// Largest difference of two solutions of the same problem, s. Each solution is within its natural residual
/// of the minimum, times the condition of the problem as the solver scales it; the factor 100 allows for
/// the condition. Larger: the test misses small errors. Smaller: it fails by rounding.
const DWELL_TOLERANCE_S: f64 = 100.0 * NATURAL_RESIDUAL_S;

fn dwell(surface: &Surface, tif: &Tif, path: &ToolPath) -> DwellTime {
    let settings = bounded_least_squares::BoundedSettings {
        min_dwell: Bound::Seconds(0.02),
        tolerance_s: NATURAL_RESIDUAL_S,
        relative_gap: 0.0,
        ..Default::default()
    };
    bounded_least_squares::solve(surface, tif, path, None, &settings).unwrap().dwell
}

type Scheduler = fn(&ToolPath, &DwellTime) -> Trajectory;

/// Schedulers, each with the largest relative difference of the removal: the effect of a rounding of
/// coordinates and times on its motion.
const SCHEDULERS: [(&str, Scheduler, f64); 5] = [
    // The scheduler computes nothing: rounding of an FFT.
    ("position", |path, dwell| position::schedule(path, dwell).unwrap(), 1e-13),
    // Velocities to the margin that it leaves below the limits for the tolerance of its program.
    (
        "pvt, smooth",
        |path, dwell| {
            let settings = pvt::PvtSettings::new(pvt::Mode::Smooth);
            pvt::schedule(path, dwell, &ion_beam(), &settings).unwrap().trajectory
        },
        // And the lengths to which segments that would leave the path are stretched: 2e-6 were seen.
        5e-6,
    ),
    (
        "pvt, monotone",
        |path, dwell| {
            let settings = pvt::PvtSettings::new(pvt::Mode::Monotone);
            pvt::schedule(path, dwell, &ion_beam(), &settings).unwrap().trajectory
        },
        1e-6,
    ),
    // Roots of differences that vanish where an axis just arrives: sqrt(2^-52) = 1.5e-8.
    (
        "constant acceleration",
        |path, dwell| constant_acceleration::schedule(path, dwell, &ion_beam()).unwrap().trajectory,
        1.5e-8,
    ),
    // Closed forms along the path.
    (
        "trigonometric spline",
        |path, dwell| {
            trig_spline::schedule(path, dwell, &ion_beam(), &Default::default()).unwrap().trajectory
        },
        1e-12,
    ),
];

fn removal_nm(surface: &Surface, tif: &Tif, trajectory: &Trajectory) -> Array2<f64> {
    let gridded = planish_simulate::SimulationSettings::Gridded;
    simulate(trajectory, tif, surface, gridded).unwrap().removal.removal_nm().clone()
}

/// Shifts by whole and by fractional pixels of 0.25 mm, mirrors, and both.
const MOTIONS: [Motion; 6] = [
    Motion::shift(3.0 * 0.25, -40.0 * 0.25),
    Motion::shift(0.37 * 0.25, -0.61 * 0.25),
    Motion::mirror(true, false),
    Motion::mirror(false, true),
    Motion::mirror(true, true),
    Motion { mirrored: [true, false], shift_mm: [17.13, 5.417] },
];

#[test]
fn dwell_times_and_removal_follow_the_part() {
    let (surface, tif) = part();
    let path = path(&surface);
    let base_dwell = dwell(&surface, &tif, &path);
    // Dwell points on a square of 1 mm: what all of them together remove in a second, nm.
    let everywhere_nm_per_s = tif.vrr_nm_mm2_per_s() / 1.0;
    for motion in MOTIONS {
        let (moved_surface, moved_tif) = (motion.surface(&surface), motion.tif(&tif));
        let moved_path = motion.path(&path);
        let moved_dwell = dwell(&moved_surface, &moved_tif, &moved_path);
        let apart_s = largest_difference(base_dwell.dwell_s(), moved_dwell.dwell_s());
        println!("{motion:?}: {apart_s:.1e} s");
        assert!(apart_s <= DWELL_TOLERANCE_S, "{motion:?}: {apart_s} s");
        for (name, schedule, accuracy) in SCHEDULERS {
            let base = removal_nm(&surface, &tif, &schedule(&path, &base_dwell));
            let expected = motion.array(&base);
            let trajectory = schedule(&moved_path, &moved_dwell);
            let moved = removal_nm(&moved_surface, &moved_tif, &trajectory);
            let apart_nm = largest_difference(&expected, &moved);
            let largest_nm = largest_magnitude(base.iter().copied());
            let allowed_nm = DWELL_TOLERANCE_S * everywhere_nm_per_s + accuracy * largest_nm;
            println!("  {name}: {apart_nm:.1e} nm of {largest_nm:.1}, allowed {allowed_nm:.1e}");
            assert!(apart_nm <= allowed_nm, "{motion:?}, {name}: {apart_nm} {allowed_nm}");
            // It is a test: a tool that is not turned with the part removes something else.
            if motion.mirrored != [false; 2] {
                let unturned = removal_nm(&moved_surface, &tif, &trajectory);
                assert!(largest_difference(&expected, &unturned) > 0.5, "{motion:?}, {name}");
            }
        }
    }
}

#[test]
fn invalid_pixels_around_the_map_change_nothing() {
    let (surface, tif) = part();
    let path = path(&surface);
    let base_dwell = dwell(&surface, &tif, &path);
    // The pixels of the map keep their places and get other indices: whole shifts of the arrays.
    let (left, right, below, above) = (5, 2, 3, 11);
    let wider = |axis: &Axis, before: usize, after: usize| {
        let start_mm = axis.start_mm() - before as f64 * axis.step_mm();
        Axis::new(start_mm, axis.step_mm(), before + axis.len() + after).unwrap()
    };
    let (g, (ny, nx)) = (surface.grid(), surface.grid().shape());
    let frame = Grid { x: wider(&g.x, left, right), y: wider(&g.y, below, above) };
    let inside = s![below..below + ny, left..left + nx];
    let mut height = Array2::from_elem(frame.shape(), f64::NAN);
    height.slice_mut(inside).assign(surface.height_nm());
    let framed = Surface::new(frame, height).unwrap();

    let framed_dwell = dwell(&framed, &tif, &path);
    let apart_s = largest_difference(base_dwell.dwell_s(), framed_dwell.dwell_s());
    assert!(apart_s <= DWELL_TOLERANCE_S, "{apart_s} s");
    let trajectory = position::schedule(&path, &base_dwell).unwrap();
    let base = removal_nm(&surface, &tif, &trajectory);
    let moved = removal_nm(&framed, &tif, &trajectory);
    let apart_nm = largest_difference(&base, moved.slice(inside));
    // The same sums by an FFT of another length.
    let largest_nm = largest_magnitude(base.iter().copied());
    assert!(apart_nm <= 1e-13 * largest_nm, "{apart_nm} of {largest_nm} nm");
}

#[test]
fn a_raster_follows_the_part_that_is_shifted() {
    let (surface, _) = part();
    let base = path(&surface);
    for motion in MOTIONS.into_iter().filter(|motion| motion.mirrored == [false; 2]) {
        let (moved, expected) = (path(&motion.surface(&surface)), motion.path(&base));
        let points = |path: &ToolPath| path.point_mm().as_flattened().to_vec();
        let apart_mm = largest_difference(&points(&moved), &points(&expected));
        // A few roundings of coordinates of some 30 mm.
        assert!(apart_mm <= 3e-14, "{motion:?}: {apart_mm} mm");
        assert_eq!((moved.tool_on(), moved.pass_idx()), (expected.tool_on(), expected.pass_idx()));
    }
}
