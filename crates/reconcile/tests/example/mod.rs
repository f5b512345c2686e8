//! A small plan: a raster whose time follows the map that it is to remove.

#![allow(dead_code)] // each file of tests uses a part

use ndarray::Array2;
use planish_types::{Axis, Grid, Surface, Tif, Trajectory, TrajectoryBuilder};

/// Returns the grid of the map: 18 x 12 mm in pixels of 0.3 mm.
pub fn grid() -> Grid {
    Grid { x: Axis::new(-2.0, 0.3, 61).unwrap(), y: Axis::new(1.0, 0.3, 41).unwrap() }
}

/// Amplitude, nm, and wave vector, 1/mm, of the waves that the raster is to remove: of many lengths and directions, so
/// that they tell the rate, the width and the ellipticities apart, which all change the amplitudes of waves.
const WAVES: [(f64, f64, f64); 8] = [
    (3.0, 0.8, 0.1),
    (3.0, 0.3, 0.9),
    (1.5, 1.3, -0.4),
    (3.0, 0.2, 0.5),
    (1.5, -0.6, 1.2),
    (2.0, 1.0, 0.7),
    (3.0, 0.45, -0.35),
    (1.5, -0.2, 1.5),
];

/// Returns the desired removal of the raster, nm.
fn wanted_nm(x: f64, y: f64) -> f64 {
    let wave = |(k, (a, kx, ky)): (usize, &(f64, f64, f64))| a * (kx * x + ky * y + k as f64).sin();
    30.0 + WAVES.iter().enumerate().map(wave).sum::<f64>()
}

/// Makes the map before the run, with two invalid pixels.
pub fn before() -> Surface {
    let grid = grid();
    let height =
        |(r, c): (usize, usize)| wanted_nm(grid.x.coordinate_mm(c), grid.y.coordinate_mm(r));
    let mut height = Array2::from_shape_fn(grid.shape(), height);
    height[[3, 7]] = f64::NAN;
    height[[30, 50]] = f64::NAN;
    Surface::new(grid, height).unwrap()
}

/// Makes a Gaussian of the peak 8 nm/s and 1 mm, stretched by `along` and `across` at the angle `angle_rad`, out to 4.5
/// mm, on the pixels of the map; the volume is that of the round one, times `scale`.
pub fn gaussian(scale: f64, along: f64, across: f64, angle_rad: f64) -> Tif {
    let axis = Axis::new(-4.5, 0.3, 31).unwrap();
    let grid = Grid { x: axis, y: axis };
    let (sine, cosine) = angle_rad.sin_cos();
    let rate = |(r, c): (usize, usize)| {
        let (x, y) = (axis.coordinate_mm(c), axis.coordinate_mm(r));
        let (u, v) = ((cosine * x + sine * y) / along, (cosine * y - sine * x) / across);
        scale * 8.0 / (along * across) * (-0.5 * (u * u + v * v)).exp()
    };
    Tif::new(grid, Array2::from_shape_fn(grid.shape(), rate)).unwrap()
}

/// Function from a point of the plan to the position at which the machine executes it, mm.
pub type Place<'a> = &'a dyn Fn([f64; 2]) -> [f64; 2];

/// Makes lines 0.8 mm apart from 3 mm before the map to 3 mm beyond, in pieces of 0.8 mm; every point where `place`
/// says.
pub fn raster(place: Place<'_>) -> Trajectory {
    let mut motion = TrajectoryBuilder::default();
    for line in 0..23 {
        let y = -2.0 + 0.8 * f64::from(line);
        for k in 0..30 {
            let (from, to) = if line % 2 == 0 { (k, k + 1) } else { (30 - k, 29 - k) };
            let [from, to] = [from, to].map(|i| -5.0 + 0.8 * f64::from(i));
            // Height times the area of the piece over the volumetric removal rate 2 pi 8
            let h = wanted_nm(0.5 * (from + to), y) * 0.64 / 50.265;
            let (p, q) = (place([from, y]), place([to, y]));
            let line = |a: usize| [p[a], (q[a] - p[a]) / h, 0.0, 0.0];
            motion.push(h, [line(0), line(1)], true, None);
        }
    }
    motion.build().unwrap()
}

/// Returns the raster as planned.
pub fn planned() -> Trajectory {
    raster(&|p| p)
}
