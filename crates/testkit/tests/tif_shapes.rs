//! Tools of any sampling through the dwell solver and the simulator: odd and even numbers of
//! samples, centred and off centre, on the map's pixels and between them.

use ndarray::Array2;
use planish_dwell::{
    bounded_least_squares::{BoundedSettings as DwellSettings, solve},
    columns::Columns,
};
use planish_schedule::baselines::position;
use planish_simulate::{SimulationSettings as Settings, simulate};
use planish_types::{Axis, Grid, Surface, Tif, ToolPath};

/// Standard deviation of the Gaussian TIF, mm; four pixels of the map.
const SIGMA_MM: f64 = 0.8;
/// Pixel of the map, mm.
const PITCH_MM: f64 = 0.2;

fn map() -> Surface {
    let grid =
        Grid { x: Axis::new(0.0, PITCH_MM, 51).unwrap(), y: Axis::new(0.0, PITCH_MM, 31).unwrap() };
    let z = Array2::from_shape_fn(grid.shape(), |(r, c)| {
        let (x, y) = (grid.x.coordinate_mm(c), grid.y.coordinate_mm(r));
        20.0 + 6.0 * (0.6 * x).cos() + 4.0 * (0.8 * y).sin()
    });
    Surface::new(grid, z).unwrap()
}

/// 8 nm/s, centred on the tool, sampled on `first + k step`.
fn tif(first: [f64; 2], n: [usize; 2], step: f64) -> Tif {
    let axis = |k: usize| Axis::new(first[k], step, n[k]).unwrap();
    let grid = Grid { x: axis(0), y: axis(1) };
    let rate = Array2::from_shape_fn(grid.shape(), |(r, c)| {
        let r2 = grid.x.coordinate_mm(c).powi(2) + grid.y.coordinate_mm(r).powi(2);
        8.0 * (-0.5 * r2 / (SIGMA_MM * SIGMA_MM)).exp()
    });
    Tif::new(grid, rate).unwrap()
}

fn path() -> ToolPath {
    let mut points = Vec::new();
    for j in 0..11 {
        for i in 0..15 {
            let i = if j % 2 == 0 { i } else { 14 - i };
            points.push([f64::from(i) - 2.0, f64::from(j) - 2.0]);
        }
    }
    let n = points.len() - 1;
    ToolPath::through(points, vec![true; n], vec![0; n]).unwrap()
}

/// Removal of the dwell times that a tool's solver finds, simulated with the same tool.
fn residual(tif: &Tif) -> (f64, Vec<f64>, Array2<f64>) {
    let (map, path) = (map(), path());
    let settings = DwellSettings { columns: Columns::Point, ..DwellSettings::default() };
    let solution = solve(&map, tif, &path, None, &settings).unwrap();
    let trajectory = position::schedule(&path, &solution.dwell).unwrap();
    let found = simulate(&trajectory, tif, &map, Settings::Gridded).unwrap();
    let rms = found.removal.residual().statistics().rms;
    (rms, solution.dwell.dwell_s().to_vec(), found.removal.removal_nm().clone())
}

#[test]
fn odd_even_shifted_and_lopsided_samples_of_one_tool_do_the_same() {
    // Out to 5 sigma = 4 mm: 4e-6 of the peak is cut.
    let odd = residual(&tif([-4.0, -4.0], [41, 41], PITCH_MM));
    let others = [
        ("even", tif([-4.1, -4.1], [42, 42], PITCH_MM)),
        ("even along x", tif([-4.1, -4.0], [42, 41], PITCH_MM)),
        ("shifted by a fraction of a sample", tif([-4.07, -4.03], [42, 42], PITCH_MM)),
        ("more samples on one side", tif([-4.0, -6.0], [52, 51], PITCH_MM)),
        ("another pitch, even", tif([-4.05, -4.05], [82, 82], 0.1)),
    ];
    for (name, tool) in others {
        let (rms, dwell, removal) = residual(&tool);
        // Keys' interpolation of a Gaussian with four samples per sigma errs by 2e-3 of the rate at
        // most, with alternating sign: in a removal of 30 nm 2e-3 nm are left (the samples
        // shifted by a fraction of a pixel), and 2e-4 of the total time.
        assert!((rms - odd.0).abs() < 1e-3, "{name}: {rms} nm, odd {} nm", odd.0);
        let difference = (&removal - &odd.2).iter().fold(0.0_f64, |m, v| m.max(v.abs()));
        assert!(difference < 1e-2, "{name}: removal differs by {difference} nm");
        let total: f64 = dwell.iter().sum();
        let want: f64 = odd.1.iter().sum();
        assert!((total / want - 1.0).abs() < 1e-3, "{name}: {total} s, odd {want} s");
    }
}

#[test]
fn a_tool_that_is_mounted_off_centre_removes_beside_its_path() {
    // The samples say that the tool acts 1 mm beside the point that is steered, along x.
    let centred = tif([-4.0, -4.0], [41, 41], PITCH_MM);
    let g = centred.grid();
    let moved = Grid { x: Axis::new(-3.0, PITCH_MM, 41).unwrap(), y: g.y };
    let off = Tif::new(moved, centred.rate_nm_per_s().clone()).unwrap();
    let (map, path) = (map(), path());
    let dwell = planish_types::DwellTime::new(vec![0.3; path.len()]).unwrap();
    let trajectory = position::schedule(&path, &dwell).unwrap();
    let removal = |t: &Tif| {
        simulate(&trajectory, t, &map, Settings::Gridded).unwrap().removal.removal_nm().clone()
    };
    let (a, b) = (removal(&centred), removal(&off));
    for (r, c) in (0..31).flat_map(|r| (5..51).map(move |c| (r, c))) {
        // The same convolution, displaced by five pixels: rounding of an FFT.
        assert!((b[[r, c]] - a[[r, c - 5]]).abs() < 1e-9, "{r} {c}");
    }
    // And its solver puts the path's times where they belong: nothing is lost.
    let (rms, ..) = residual(&off);
    assert!(rms < 1.1 * residual(&centred).0 + 0.05, "{rms}");
}
